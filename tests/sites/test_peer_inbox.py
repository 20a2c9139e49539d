"""Arriving messages are a peer's samples, or are counted by reason and dropped; nothing raises."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sites.site_loop import PeerInbox
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from trilat_net.core.links.link import AHEAD_LIMIT_NS
from trilat_net.core.step.site_setup import LinkSetup
from trilat_net.core.step.ticks import MAX_ARRIVALS
from trilat_net.net.messages import VERSION
from trilat_net.net.offset import OffsetEstimate
from trilat_net.net.timing import LinkTimingMonitor, PeerClock, SentStamps
from trilat_net.net.wire import MAX_BYTES, make_sample_reader
from trilat_net.scenario import load_scenario

PEERS = ("m2", "s")
SETUP = load_scenario("paper").setup("m1")
BOOTS = (11, 12)
RATE_HZ = 1000


def encode_sample(tick: int = 0, peer: int = 0, **changed: Any) -> bytes:
    message = {"v": VERSION, "site": PEERS[peer], "boot": BOOTS[peer], "tick": tick}
    vectors = {"q": [0.1 * tick, 0.2], "qd": [0.3, 0.4], "tau_x": [0.5, 0.6]}
    return msgpack.packb({**message, **vectors, "sent_ns": tick * 1_000_000, **changed})


EPOCH_NS = 7_000_000_000


class Desk:
    """An intake with two peers, and their ends of the rings."""

    def __init__(
        self,
        capacity: int = 16_384,
        rates: tuple[int, int] = (RATE_HZ, RATE_HZ),
        links: Sequence[LinkSetup] = SETUP.links,
    ) -> None:
        network = LocalNetwork()
        receiver = network.join()
        sender = network.join()
        self.clock = ManualClock(EPOCH_NS)
        read = make_sample_reader(SETUP.layout)
        rings = [
            receiver.stamped_inbox(name, self.clock.monotonic_ns, read, capacity)
            for name in PEERS
        ]
        self.send = [sender.publisher(name) for name in PEERS]
        self.dropped: Counter[str] = Counter()
        self.meters = [
            LinkTimingMonitor(
                PeerClock(name, EPOCH_NS, 0, OffsetEstimate.exact(0), None), SentStamps()
            )
            for name in PEERS
        ]
        paced = [
            link._replace(rate_hz=rate_hz) for link, rate_hz in zip(links, rates, strict=True)
        ]
        self.intake = PeerInbox(paced, rings, BOOTS, self.meters, self.dropped)

    def wait(self, until_ns: int) -> None:
        self.clock.sleep_until(EPOCH_NS + until_ns)


def test_samples_come_by_peer_in_order() -> None:
    desk = Desk()
    for tick in (0, 1, 3, 2):
        desk.send[1](encode_sample(tick, 1))
        desk.send[0](encode_sample(tick, 0))
    arrivals = desk.intake.drain(5_000_000)
    assert [(a.peer, a.tick) for a in arrivals] == [
        (p, t) for p in (0, 1) for t in (0, 1, 3, 2)
    ]
    assert [a.q for a in arrivals[:2]] == [[0.0, 0.2], [0.1, 0.2]]
    assert desk.intake.drain(6_000_000) == []


def test_delay_is_stamp_to_arrival() -> None:
    desk = Desk(rates=(300, 1000))
    desk.wait(40_000_000)
    desk.send[0](encode_sample(3, 0, sent_ns=12_345_678))
    desk.send[1](encode_sample(20, 1, sent_ns=19_999_001))
    desk.wait(900_000_000)
    assert [a.latency_us for a in desk.intake.drain(900_000_000)] == [27_654, 20_000]


def test_early_arrivals_are_counted_and_used() -> None:
    desk = Desk()
    desk.wait(5_000_000)
    desk.send[0](encode_sample(0, 0, sent_ns=5_000_001))
    desk.send[0](encode_sample(1, 0, sent_ns=4_000_000))
    assert [(a.tick, a.latency_us) for a in desk.intake.drain(5_000_000)] == [
        (0, -1),
        (1, 1000),
    ]
    assert [meter.faults for meter in desk.meters] == [1, 0]
    assert desk.meters[0].worst_ns == 1
    assert not desk.dropped


REFUSED = {
    "malformed": [
        b"",
        b"\xc1",
        b"garbage",
        msgpack.packb([1, 2]),
        encode_sample(qd=[1.0, 2.0, 3.0]),
        encode_sample(sent_ns=-(2**63)),
        encode_sample(sent_ns=0.5),
        encode_sample(echo=7),
        encode_sample(echo=[[0, 0, 0]] * 33),
        b"\x91" * 2_000,
    ],
    "of 1 joint; the scenario has 2": [encode_sample(q=[1.0])],
    "oversized": [
        encode_sample(padding="x" * 3_000),
        bytes(MAX_BYTES + 1),
    ],  # thousands may wait
    "version": [encode_sample(v=VERSION + 1), encode_sample(v=0)],
    "not finite": [
        encode_sample(q=[float("nan"), 0.0]),
        encode_sample(qd=[0.0, float("-inf")]),
    ],
    "stranger": [encode_sample(boot=99), encode_sample(site="s"), encode_sample(site="nobody")],
    "ahead": [
        encode_sample(tick=AHEAD_LIMIT_NS // 1_000_000 + 1),
        encode_sample(tick=2**40 - 1, sent_ns=0),
    ],
}


@pytest.mark.parametrize(("reason", "sent"), [(r, p) for r, ps in REFUSED.items() for p in ps])
def test_invalid_samples_are_counted_and_dropped(reason: str, sent: bytes) -> None:
    desk = Desk()
    # the last that is taken
    for message in (
        encode_sample(0),
        sent,
        encode_sample(AHEAD_LIMIT_NS // 1_000_000),
    ):
        desk.send[0](message)
    assert [a.tick for a in desk.intake.drain(0)] == [0, 10_000]
    del desk.dropped["missing"]
    assert desk.dropped == {reason: 1}


@given(
    st.dictionaries(
        st.sampled_from(
            ["v", "site", "boot", "tick", "q", "qd", "tau_x", "sent_ns", "echo", "more"]
        ),
        st.recursive(
            st.none()
            | st.booleans()
            | st.integers(-(2**63), 2**64 - 1)
            | st.floats()
            | st.text(max_size=5),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(st.text(max_size=3), inner, max_size=3)
            ),
            max_leaves=6,
        ),
    )
)
def test_no_field_of_any_type_raises(changed: dict[str, Any]) -> None:
    desk = Desk()
    desk.send[0](msgpack.packb({**msgpack.unpackb(encode_sample(3)), **changed}))
    arrivals = desk.intake.drain(10_000_000_000)
    assert len(arrivals) + sum(desk.dropped.values()) - desk.dropped["missing"] == 1


def test_one_tick_takes_a_bounded_number() -> None:
    desk = Desk()
    for tick in range(MAX_ARRIVALS + 10):
        desk.send[0](encode_sample(tick, 0))
    for tick in range(5):
        desk.send[1](encode_sample(tick, 1))
    first = desk.intake.drain(10_000_000_000)
    assert [(a.peer, a.tick) for a in first] == [(0, tick) for tick in range(MAX_ARRIVALS)]
    rest = desk.intake.drain(10_000_000_000)
    assert [(a.peer, a.tick) for a in rest] == [
        *((0, tick) for tick in range(MAX_ARRIVALS, MAX_ARRIVALS + 10)),
        *((1, tick) for tick in range(5)),
    ]


def test_lost_ring_entries_count_as_missing() -> None:
    desk = Desk(capacity=4)
    for tick in range(10):
        desk.send[0](encode_sample(tick, 0))
    assert [a.tick for a in desk.intake.drain(1_000_000_000)] == [6, 7, 8, 9]
    assert desk.dropped == {"missing": 6}


def test_duplicates_are_kept_for_the_record() -> None:
    desk = Desk()
    for tick in (0, 1, 1, 0):
        desk.send[0](encode_sample(tick, 0))
    assert [a.tick for a in desk.intake.drain(1_000_000_000)] == [0, 1, 1, 0]
    assert not desk.dropped


GUARDED = (
    load_scenario("paper", {"on_stale.action": "glide", "limits.qd_limit_rad_s": 5.0})
    .setup("m1")
    .links
)
"""At 5 rad/s, 5 mrad in a period, and 20 mrad besides."""


@pytest.mark.parametrize(
    ("q", "qd", "taken"),
    [
        ([0.024, 0.2], [0.0, 0.0], True),
        ([0.026, 0.2], [0.0, 0.0], False),
        ([0.0, 0.2], [0.0, 4.9], True),
        ([0.0, 0.2], [0.0, -5.1], False),
        ([1e6, 0.2], [0.0, 0.0], False),
    ],
)
def test_guarded_sites_drop_impossible_samples(
    q: list[float], qd: list[float], taken: bool
) -> None:
    desk = Desk(links=GUARDED)
    desk.send[0](encode_sample(7, q=[0.0, 0.2], qd=[0.0, 0.0]))
    desk.send[0](encode_sample(8, q=q, qd=qd))
    desk.send[0](encode_sample(9, q=[0.003, 0.2], qd=[0.0, 0.0]))
    assert [a.tick for a in desk.intake.drain(9_000_000)] == ([7, 8, 9] if taken else [7, 9])
    assert desk.dropped["implausible"] == (not taken)


def test_restarted_peers_may_be_at_any_tick() -> None:
    desk = Desk(links=GUARDED)
    desk.send[0](encode_sample(100, q=[0.5, 0.2]))
    desk.send[0](encode_sample(20, q=[0.15, 0.2]))  # 80 ms earlier
    assert len(desk.intake.drain(100_000_000)) == 2
    desk.intake.admit(0, 99, 200)
    desk.send[0](encode_sample(200, boot=99, q=[-2.0, 0.2]))
    assert len(desk.intake.drain(200_000_000)) == 1
    assert not desk.dropped["implausible"]


def test_guarded_sites_refuse_stamps_one_second_ahead() -> None:
    for links, ahead in ((GUARDED, [1000]), (SETUP.links, [1000, 1001])):
        desk = Desk(links=links)
        for tick in (1000, 1001):
            desk.send[0](encode_sample(tick, q=[0.0, 0.2]))
        assert [a.tick for a in desk.intake.drain(0)] == ahead

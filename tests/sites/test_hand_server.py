"""Hands of a live session: used by programs, received by a site, and attacked."""

import math
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sites.hand_server import MESSAGES_KEPT, HandServer
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.core.life.live_hand import ANOTHER_HOLDS, HandInForce
from trilat_net.errors import UsageError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log
from trilat_net.net import topics
from trilat_net.net.arm_client import Hand
from trilat_net.net.bus import Bus
from trilat_net.net.requests import HandMessage
from trilat_net.net.wire import encode
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import Session, reach_session

LIVE = {f"sites.{name}.hands": [{"kind": "live"}] for name in ("m1", "m2")}
SCENARIO = load_scenario("paper", {"duration_s": 1.5, **LIVE})
PERIOD_NS = 16_666_667
Say = Callable[[Hand, int], object]


class Felt:
    def __init__(self) -> None:
        self.ticks: list[int] = []
        self.forces: list[tuple[float, ...]] = []
        self.poses: list[tuple[float, ...]] = []


def make_holding_program(
    site: str, say: Say, felt: Felt, first: int = 12, last: int = 60
) -> Any:
    """A program that holds an arm, sixty times a second; it lets go at the end of its context."""

    def act(bus: Bus, clock: RelayClock) -> None:
        with reach_session(bus, clock).open_hand(
            bus, site, SCENARIO, f"hand at {site}"
        ) as hand:
            while hand.record is None:
                sleep_for_ns(clock, 1_000_000)
            for n in range(last):
                if n >= first:
                    say(hand, n)
                sleep_for_ns(clock, PERIOD_NS)
                if hand.record is not None:
                    felt.ticks.append(hand.record.tick)
                    felt.forces.append(hand.force)
                    felt.poses.append(hand.pose)

    return act


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Log, Felt]:
    held = Session.whole(SCENARIO, tmp_path_factory.mktemp("held"))
    felt = Felt()
    held.stranger(
        make_holding_program(
            "m1", lambda hand, n: hand.move(1.6 + 0.1 * math.sin(0.2 * n), 0.6), felt
        )
    )
    held.stranger(
        make_holding_program("m2", lambda hand, n: hand.move(1.5, 0.3 + 0.005 * n), Felt())
    )
    held.stranger(
        make_holding_program(
            "m1", lambda hand, _: hand.move(0.0, 0.0), Felt(), first=30, last=50
        )
    )
    return held.run(), felt


def test_a_session_with_people_is_verified_and_repeated(
    session: tuple[Log, Felt],
) -> None:
    log, _ = session
    verification = verify_log(log)
    assert verification.passed
    assert verification.identical == verification.records == 3 * 1500
    assert compare_with_virtual(log).fed.identical == verification.records


def test_events_name_holders_and_count_refusals(session: tuple[Log, Felt]) -> None:
    log, _ = session
    said = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert sorted(said) == sorted(
        f"m{n}: hand at m{n} {what}" for n in (1, 2) for what in ("takes hold", "lets go")
    )
    assert log.link_stats("m1")[-1].dropped[ANOTHER_HOLDS] >= 20
    assert not any("hand" in reason for reason in log.link_stats("m2")[-1].dropped)


def test_felt_torque_equals_the_arms_torque(session: tuple[Log, Felt]) -> None:
    log, felt = session
    part = log["m1"]
    l1, l2 = SCENARIO.arms["m1"].lengths_m
    seen = 0
    for tick, force, pose in zip(felt.ticks, felt.forces, felt.poses, strict=True):
        q1 = part.q[tick, 0]
        q12 = part.q[tick].sum()
        x, y = l1 * math.cos(q1) + l2 * math.cos(q12), l1 * math.sin(q1) + l2 * math.sin(q12)
        assert pose == pytest.approx((x, y))
        J = np.array([[-y, -l2 * math.sin(q12)], [x, l2 * math.cos(q12)]])
        assert J.T @ force == pytest.approx(-part.tau_x[tick], abs=1e-6)
        seen += math.hypot(*force) > 1.0
    assert seen > 30


def test_hands_follow_their_mode() -> None:
    bus = LocalNetwork().join()
    clock = ManualClock()
    running = reach_session(bus, clock)
    with running.open_hand(bus, "m1", SCENARIO) as hand:
        with pytest.raises(UsageError, match="can move, not push"):
            hand.push(1.0, 2.0)
        with pytest.raises(UsageError, match="finite"):
            hand.move(math.nan, 0.0)
    with pytest.raises(UsageError, match="such an operator are m1, m2"):
        running.open_hand(bus, "s", SCENARIO)


class Served:
    def __init__(self) -> None:
        network = LocalNetwork()
        self.dropped: Counter[str] = Counter()
        live = SCENARIO.sites["m1"].find_live_hand()
        arm = SCENARIO.arms["m1"]
        assert live is not None
        key = topics.key("t", "m1", topics.HAND)
        inbox = network.join().inbox(key, MESSAGES_KEPT)
        self._site: Any = SimpleNamespace(name="m1", rate_hz=1000, q=[0.3, 0.4])
        self.server = HandServer(self._site, live, arm, inbox, self.dropped)
        self.publish = network.join().publisher(key)
        self.k = -1

    def take(self, *messages: bytes) -> HandInForce:
        for message in messages:
            self.publish(message)
        self.k += 1
        return HandInForce.read(self.server.track(self._site, self.k))


def encode_message(**fields: Any) -> bytes:
    return encode(
        HandMessage(
            **{"site": "m1", "boot": 5, "n": 0, "target": [1.5, 0.5], "sent_ns": 0, **fields}
        )
    )


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xc1", "hand: malformed"),
        (encode_message(target=[math.nan, 0.0]), "hand: not finite"),
        (encode_message(target=[math.inf, 0.0]), "hand: not finite"),
        (encode_message(target=[1000.0, 0.0]), "hand: out of range"),
        (encode_message(target=[1e308, 1e308]), "hand: out of range"),
        (encode_message(target=[1.0, 0.0, 0.0]), "hand: no target of 2 numbers"),
        (encode_message(target=[], force=[1e9, 0.0]), "hand: no target of 2 numbers"),
        (encode_message(site="m2"), "hand: stranger"),
        (bytes(70_000), "hand: oversized"),
    ],
)
def test_a_hostile_message_is_refused_and_counted(payload: bytes, reason: str) -> None:
    served = Served()
    assert served.take(payload) == HandInForce.read(HandInForce.list_empty(2))
    assert served.dropped == {reason: 1}


def test_floods_are_read_slowly_and_move_nobody() -> None:
    """A hundred messages a tick of others: the holder's arm stays still, and few messages are read."""
    served = Served()
    served.take(encode_message())
    for k in range(1, 100):
        flood = [encode_message(boot=100 + n, n=k, target=[9.0, 9.0]) for n in range(100)]
        hand = served.take(*flood, encode_message(n=k, target=[1.5, 0.5]))
    assert hand.source == 5
    assert hand.number == 99
    assert served.dropped == {ANOTHER_HOLDS: 99 * (MESSAGES_KEPT - 1)}
    assert [text for _, text in served.server.news] == [
        "m1: hand 00000005 takes hold at t = 0.000 s"
    ]

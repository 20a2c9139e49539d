"""A column is the field of every record, bit for bit; what is no record is refused as `decode` refuses it."""

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.core.step.site_setup import Layout
from trilat_net.core.step.ticks import Mode
from trilat_net.errors import WireError
from trilat_net.log.record_columns import RecordColumns
from trilat_net.log.site_log import SiteLog
from trilat_net.net.messages import READABLE, State
from trilat_net.net.wire import decode

STATE_VECTORS = Layout().lengths()

PEERS = ("m2", "s")
whole = st.integers(-(2**62), 2**62)
# so that sums are finite too
numbers = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: x / 16)
stamps = st.lists(
    st.tuples(st.integers(0, 1), st.integers(-5, 2**40), whole.map(lambda n: n >> 4)).map(list)
)


@st.composite
def draw_fields(draw: st.DrawFn) -> dict[str, object]:
    vectors = {
        field: draw(st.lists(numbers, min_size=n, max_size=n))
        for field, n in STATE_VECTORS.items()
    }
    record: dict[str, object] = {
        "v": draw(st.sampled_from(READABLE)),
        "site": "m1",
        "boot": draw(st.integers(0, 2**64 - 1)),
        "tick": draw(st.integers(0, 2**40 - 1)),
        "t_ns": draw(whole),
        "mode": draw(st.sampled_from([mode.name.lower() for mode in Mode])),
        **vectors,
        "used": draw(st.dictionaries(st.sampled_from(PEERS), whole)),
        "rx": draw(stamps),
        "rx_crc": 0,
        "cmd": draw(st.lists(st.text(max_size=5), max_size=2)),
        "mem": [],
        "late_us": draw(whole),
        "busy_us": draw(whole),
    }
    if draw(st.booleans()):
        record |= {"sent_ns": draw(whole.map(lambda n: n >> 4)), "echo": []}
    return record


def site_log(payloads: list[bytes]) -> SiteLog:
    return SiteLog("m1", PEERS, 1000, payloads, "log")


@settings(max_examples=40)
@given(st.lists(draw_fields(), max_size=5))
def test_every_column_is_its_field_of_every_record(entries: list[dict[str, object]]) -> None:
    payloads = [msgpack.packb(entry) for entry in entries]
    states = sorted(
        (decode(payload, State, READABLE) for payload in payloads), key=lambda s: s.tick
    )
    part = site_log(payloads)
    together = site_log(payloads)
    together.prepare(*STATE_VECTORS)
    assert list(part.states) == states
    assert part.tick.tolist() == [s.tick for s in states]
    for field, count in STATE_VECTORS.items():
        rows = getattr(part, field)
        assert rows.shape == (len(states), count)
        assert rows.tobytes() == getattr(together, field).tobytes()
        assert (
            rows.tobytes()
            == np.array([getattr(s, field) for s in states], dtype=np.float64).tobytes()
        )
    for field in ("t_ns", "late_us", "busy_us", "sent_ns"):
        assert part.numbers(field).tolist() == [getattr(s, field) for s in states]
    assert part.mode.tolist() == [s.mode for s in states]
    assert {p: part.used[p].tolist() for p in PEERS} == {
        p: [s.used.get(p, -1) for s in states] for p in PEERS
    }
    counts, entered = part.arrivals
    assert counts.tolist() == [len(s.rx) for s in states]
    assert entered.tolist() == [entry for s in states for entry in s.rx]
    assert part.changes() == {s.tick: s.cmd for s in states if s.cmd}


GOOD: dict[str, object] = {
    "v": 3, "site": "m1", "boot": 1, "tick": 7, "t_ns": 7, "mode": "run", "used": {}, "rx": [], "rx_crc": 0,
    "cmd": [], "mem": [], "late_us": 0, "busy_us": 0,
    **{field: [0.5] * count for field, count in STATE_VECTORS.items()},
}  # fmt: skip


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("q", [0.5]),
        ("q", [0.5, 0.5, 0.5]),
        ("q", [0.5, float("nan")]),
        ("tau", [float("-inf"), 0.5]),
        ("theta_hat", "no"),
        ("t_ns", 2**64 - 1),
        ("t_ns", 0.5),
        ("mode", "walk"),
        ("mode", 3),
        ("used", {"m2": "x"}),
        ("used", 3),
        ("rx", [[0, 1]]),
        ("cmd", [3]),
    ],
)
def test_a_column_with_an_invalid_value_is_refused(field: str, value: object) -> None:
    part = site_log([msgpack.packb(GOOD), msgpack.packb({**GOOD, field: value})])
    ask = {"rx": "arrivals", "cmd": "changes"}.get(field, field)
    with pytest.raises(Exception, match="log: a record of m1 cannot be read") as raised:
        _ = getattr(part, ask)() if ask == "changes" else getattr(part, ask)
    assert type(raised.value).__name__ == "LogError"


@pytest.mark.parametrize(
    "change", [{"v": 5}, {"v": "3"}, {"tick": -1}, {"tick": 2**40}, {"tick": None}]
)
def test_records_without_version_or_tick_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(WireError):
        RecordColumns([msgpack.packb(GOOD), msgpack.packb({**GOOD, **change})]).ticks()


def test_unrequested_fields_are_not_parsed() -> None:
    part = site_log([msgpack.packb({**GOOD, "tau": "no"})])
    assert part.q.tolist() == [[0.5, 0.5]]
    with pytest.raises(Exception, match="record of m1"):
        _ = part.states


def test_an_overlong_payload_is_refused() -> None:
    with pytest.raises(WireError, match="oversized"):
        RecordColumns([msgpack.packb({**GOOD, "cmd": ["x" * 70_000]})]).ticks()


def test_disordered_records_are_sorted_with_their_times() -> None:
    payloads = [msgpack.packb({**GOOD, "tick": tick}) for tick in (4, 2, 3)]
    arrivals_ns = np.array([40, 20, 30])
    part = SiteLog("m1", PEERS, 1000, payloads, "log", (arrivals_ns, arrivals_ns + 1))
    assert part.tick.tolist() == [2, 3, 4]
    assert part.log_time_ns.tolist() == [20, 30, 40]
    assert part.publish_time_ns.tolist() == [21, 31, 41]
    assert part.missing == 2
    assert list(part.payloads) == [payloads[1], payloads[2], payloads[0]]


def test_a_site_without_records_is_empty_arrays() -> None:
    part = site_log([])
    assert (part.q.shape, part.theta_hat.shape, part.tick.shape, part.missing) == (
        (0, 2),
        (0, 5),
        (0,),
        0,
    )
    assert part.used["m2"].shape == (0,)
    assert repr(part) == "<m1: no records>"

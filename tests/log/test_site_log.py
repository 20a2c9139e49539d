"""Many records read like a list of them, in bounded memory."""

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from trilat_net.core.step.site_setup import Layout
from trilat_net.log import site_log
from trilat_net.log.site_log import LazyRecords, RecordsByTick, compute_task_errors
from trilat_net.net.messages import State

STATE_VECTORS = Layout().lengths()

EMPTY = State(
    v=3, site="m1", boot=1, tick=0, t_ns=0, mode="run", used={}, rx=[], rx_crc=0, cmd=[], mem=[], late_us=0,
    busy_us=0, **{field: [0.0] * count for field, count in STATE_VECTORS.items()},
)  # fmt: skip


def make_state(tick: int) -> State:
    return msgspec.structs.replace(EMPTY, tick=tick)


def decode_ticks(payloads: Sequence[bytes]) -> list[State]:
    return [make_state(int(payload)) for payload in payloads]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site_log, "BLOCK_RECORDS", 4)
    monkeypatch.setattr(site_log, "MAX_DECODED_RECORDS", 8)


counts = st.integers(0, 30)


@given(counts, st.lists(st.one_of(st.integers(-35, 35), st.slices(30)), max_size=10))
def test_site_logs_equal_lists_of_records(count: int, looks: list[int | slice]) -> None:
    payloads = [str(n).encode() for n in range(count)]
    all_records = decode_ticks(payloads)
    some = LazyRecords(payloads, decode_ticks)
    assert (len(some), list(some), list(reversed(some))) == (
        count,
        all_records,
        all_records[::-1],
    )
    for look in looks:
        try:
            expected = all_records[look]
        except IndexError:
            with pytest.raises(IndexError):
                some[look]
        else:
            assert some[look] == expected


def test_only_recent_blocks_are_held() -> None:
    first_ticks: list[int] = []

    def counted(payloads: Sequence[bytes]) -> list[State]:
        first_ticks.append(int(payloads[0]))
        return decode_ticks(payloads)

    some = LazyRecords([str(n).encode() for n in range(16)], counted)
    for n in (0, 1, 4, 0, 8, 0, 4):  # 4 was looked at longest ago when 8 came
        assert some[n].tick == n
    assert first_ticks == [0, 4, 8, 4]


def test_few_records_are_a_list() -> None:
    assert isinstance(LazyRecords.decode_short([b"1"] * 8, decode_ticks), list)
    assert isinstance(LazyRecords.decode_short([b"1"] * 9, decode_ticks), LazyRecords)


@pytest.mark.parametrize("field", ["rx", "echo", "cmd", "mem", "used"])
def test_long_records_are_held_few_at_once(field: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever list it is, and in either record: memory is bounded by all that a record may hold."""
    monkeypatch.setattr(site_log, "HEAVY_BYTES", 9_000)
    values = {f"m{n}": n for n in range(300)} if field == "used" else [0] * 300
    heavy = msgspec.structs.replace(EMPTY, **{field: values})
    assert isinstance(LazyRecords.decode_short([b""] * 2, lambda _: [EMPTY, EMPTY]), list)
    assert isinstance(
        LazyRecords.decode_short([b""] * 2, lambda _: [heavy, EMPTY]), LazyRecords
    )
    assert isinstance(
        LazyRecords.decode_short([b""] * 2, lambda _: [EMPTY, heavy]), LazyRecords
    )


@given(st.lists(st.integers(0, 20), max_size=20).map(sorted))
def test_records_by_tick_equal_their_dictionary(ticks: list[int]) -> None:
    states = [
        msgspec.structs.replace(make_state(tick), late_us=n) for n, tick in enumerate(ticks)
    ]
    by_tick = RecordsByTick(states, np.array(ticks, dtype=np.int64))
    assert dict(by_tick) == {s.tick: s for s in states}
    assert len(by_tick) == len(set(ticks))
    assert [by_tick.get(tick) for tick in range(-1, 22)] == [
        {s.tick: s for s in states}.get(tick) for tick in range(-1, 22)
    ]


def test_orientation_errors_equal_scipys_turns() -> None:
    rng = np.random.default_rng(5)
    x, x_des = rng.normal(size=(2, 400, 6))
    x_des[:100, 3:] = x[:100, 3:] + 10.0 ** rng.uniform(-12.0, -1.0, (100, 1)) * rng.normal(
        size=(100, 3)
    )
    x_des[100:110, 3:] = x[100:110, 3:]
    x[110:120, 3:] = 0.0
    # half a turn
    x[120:140, 3:] *= np.pi / np.linalg.norm(x[120:140, 3:], axis=1, keepdims=True)
    reference, actual = (Rotation.from_rotvec(poses[:, 3:]) for poses in (x_des, x))
    e = compute_task_errors(x, x_des, [1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    assert np.abs(e[:, 3:] - (actual * reference.inv()).as_rotvec()).max() <= 1e-14
    assert not e[100:110, 3:].any()
    assert np.array_equal(e[:, :2], x[:, :2] - x_des[:, :2])
    assert not e[:, 2].any()
    assert compute_task_errors(x[:0], x_des[:0], [1.0] * 6).shape == (0, 6)

"""The first difference between a record and an execution: site, tick, field, both values.

Two criteria: equal bits on the platform that made the log, else |a - b| <= 1e-9 (1 + |a|).
"""

from array import array
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from ..core.law_channel import LawChannel
from ..core.ticks import TickRecord
from ..errors import LawFailed
from ..net.messages import STATE_VECTORS, State

TOLERANCE = 1e-9
"""Across platforms, a and b count as equal if |a - b| <= TOLERANCE (1 + |a|)."""

NumberEquality = Callable[[float, float], bool]


class RecordDifference(NamedTuple):
    """A field of a record, with the index of the number in it, that differs from the execution."""

    site: str
    tick: int
    field: str
    logged: Any
    computed: Any

    def __str__(self) -> str:
        logged, computed = (
            f"{value!r} ({value.hex()})" if isinstance(value, float) else repr(value)
            for value in (self.logged, self.computed)
        )
        return f"{self.site}, tick {self.tick}, {self.field}: logged {logged}, computed {computed}"


def equal_bits(a: float, b: float) -> bool:
    """True if two numbers have the same bits (-0.0 is not 0.0)."""
    return a.hex() == b.hex()


def equal_to_tolerance(a: float, b: float) -> bool:
    """True if two numbers agree as well as two platforms can."""
    return abs(a - b) <= TOLERANCE * (1.0 + abs(a))


def describe_law_failure(failed: LawFailed) -> RecordDifference:
    """Returns the difference of a user law that fails now and did not when the log was made."""
    return RecordDifference(failed.site, failed.tick or 0, "record", "is there", failed.problem)


def _pack(a: State | TickRecord) -> bytes:
    return array(
        "d",
        [
            *(*a.q, *a.qd, *a.q_des, *a.qd_des, *a.tau, *a.tau_x, *a.theta_hat),
            *(*a.x, *a.xd, *a.wrench, *a.ch, *a.hand),
        ],
    ).tobytes()


def equal_record(logged: State, computed: TickRecord, peers: tuple[str, ...]) -> bool:
    """True if every computed field of a record has the same bits; fast, for the common case."""
    a, b = logged, computed
    return (
        _pack(a) == _pack(b)
        and a.used == dict(zip(peers, b.used, strict=True))
        and (a.tick, a.t_ns, a.rx_crc) == (b.tick, b.t_ns, b.rx_crc)
        and a.mode == b.mode.name.lower()
        and a.cmd == b.cmd
        and array("d", a.mem).tobytes() == array("d", b.mem).tobytes()
    )


def find_first_difference(
    logged: State,
    computed: TickRecord,
    peers: tuple[str, ...],
    equal: NumberEquality,
    channel: LawChannel = LawChannel(),  # noqa: B008
) -> RecordDifference | None:
    """Returns the first field in which a record differs from an execution, or None.

    `channel` has the names of what the site's law sends.
    """
    for field, a, b, same in _compare_fields(logged, computed, peers, equal, channel):
        if not same:
            return RecordDifference(logged.site, logged.tick, field, a, b)
    return None


def _compare_fields(
    logged: State, computed: TickRecord, peers: tuple[str, ...], equal: NumberEquality, channel: LawChannel
) -> Iterator[tuple[str, Any, Any, bool]]:
    mode = computed.mode.name.lower()
    yield "tick", logged.tick, computed.tick, logged.tick == computed.tick
    yield "t_ns", logged.t_ns, computed.t_ns, logged.t_ns == computed.t_ns
    yield "mode", logged.mode, mode, logged.mode == mode
    sent = [f"ch.{entry}" for entry in channel.entries(peers)]
    for field in STATE_VECTORS:
        before, now = getattr(logged, field), getattr(computed, field)
        if len(before) != len(now):
            yield f"{field} (how many numbers)", len(before), len(now), False
            continue
        for n, (a, b) in enumerate(zip(before, now, strict=True)):
            name = sent[n] if field == "ch" and n < len(sent) else f"{field}[{n}]"
            yield name, float(a), b, equal(float(a), b)
    used = dict(zip(peers, computed.used, strict=True))
    for peer in sorted({*logged.used, *used}):
        a, b = logged.used.get(peer), used.get(peer)
        yield f"used[{peer}]", a, b, a == b
    yield "rx (its CRC-32)", logged.rx_crc, computed.rx_crc, logged.rx_crc == computed.rx_crc
    yield "cmd", logged.cmd, computed.cmd, logged.cmd == computed.cmd
    alike = all(equal(float(a), float(b)) for a, b in zip(logged.mem, computed.mem, strict=False))
    yield "mem", logged.mem, computed.mem, alike and len(logged.mem) == len(computed.mem)

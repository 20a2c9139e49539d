"""The grid of ticks: integers for time, one rounding rule, no drift.

Law (L1): tick k of a loop of `rate_hz` lies at `k * 10^9 // rate_hz` nanoseconds after the epoch.
"""

from .jit import leaf

NS_PER_S = 1_000_000_000
BUCKETS_PER_S = 20
"""Where a run is told by its largest values, it is by those of so many equal parts of each second."""


@leaf
def tick_ns(tick: int, rate_hz: int) -> int:
    """Returns the nominal time of a tick, ns since the epoch."""
    return tick * 1_000_000_000 // rate_hz


@leaf
def first_tick_at(due_ns: int, rate_hz: int) -> int:
    """Returns the first tick whose nominal time is at or after `due_ns`, ns since the epoch.

    Exact: floor(k 10^9 / rate) >= due holds just where k 10^9 >= due * rate.
    """
    return -(-due_ns * rate_hz // 1_000_000_000)

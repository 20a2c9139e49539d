"""Load of this machine before a session begins on it: whether its processors have time left.

Invariant: a measurement changes nothing and takes a fifth of a second; where the system does
not tell how busy it is, nothing is said.
"""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from trilat_net import process
from trilat_net.errors import count_nouns
from trilat_net.net.clock import Clock

MEASURED_NS = 200_000_000
"""Time over which the load is measured."""
BUSY_SHARE = 0.8
"""A machine that is busy for this share of the time has none left for a recorder, which has no
priority.
"""
_STATISTICS = Path("/proc/stat")
_IDLE_COLUMNS = slice(3, 5)  # idle, and waiting for a disk
_TIME_COLUMNS = slice(0, 8)  # guests are counted in the time of users already


class ProcessorTimes(NamedTuple):
    """Time that all processors have spent since the machine was started, in ticks of the
    system.
    """

    idle: int
    total: int

    @classmethod
    def parse(cls, text: str) -> "ProcessorTimes":
        """Returns the times in the first line of /proc/stat (proc_stat(5))."""
        columns = [int(word) for word in text.splitlines()[0].split()[1:]]
        return cls(sum(columns[_IDLE_COLUMNS]), sum(columns[_TIME_COLUMNS]))


def measure_busy_share(clock: Clock) -> float | None:
    """Returns the share of time for which the machine's processors are busy, 0 to 1; None if
    unknown.
    """
    with suppress(OSError, ValueError, IndexError):
        before = ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        clock.sleep_until(clock.monotonic_ns() + MEASURED_NS)
        after = ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        passed = after.total - before.total
        return 1.0 - (after.idle - before.idle) / passed if passed > 0 else None
    return None


def describe_load(busy_share: float | None) -> str:
    """Returns a warning about a busy machine, with what to do; "" if it has time left or does
    not tell.
    """
    if busy_share is None or busy_share < BUSY_SHARE:
        return ""
    cores = process.count_cores()
    processors = (
        f"{count_nouns(cores, 'processor is', 'processors are')}"
        if cores > 1
        else "one processor is"
    )
    return (
        f"this machine's {processors} {busy_share:.0%} busy with other programs, so that ticks may be "
        "late and the recorder may miss records: end those programs, or lower the rate, as in "
        "--set rate_hz=200"
    )

"""Warns before a session if other programs keep the processors of this machine busy.

On a busy machine, control loops run late. The load is measured over 0.2 s from the statistics
that Linux provides in /proc/stat. On other operating systems, no warning is given.
"""

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from trilat_net import workers
from trilat_net.errors import count_nouns

from ..net import Clock

MEASURED_NS = 200_000_000
"""Time over which the load is measured, in ns."""
BUSY_SHARE = 0.8
"""Fraction of busy time above which a warning is printed.

Above it, a recorder may receive too little computing time, because it has no priority.
"""
_STATISTICS = Path("/proc/stat")
"""File in which Linux reports how much time the processors have spent on each kind of work."""
_IDLE_COLUMNS = slice(3, 5)  # idle, and waiting for a disk
_TIME_COLUMNS = slice(0, 8)  # without guests, whose time the column "user" includes


def check_machine_load(clock: Clock) -> str:
    """Returns a warning if other programs keep this machine busy.

    On a busy machine, the ticks of a control loop begin late, which changes the motion of the
    arm.

    Args:
        clock: Clock of this process.

    Returns:
        The warning and a remedy, or an empty string if the machine is not busy.
    """
    return _describe_load(_measure_busy_share(clock))


class _ProcessorTimes(NamedTuple):
    """Idle and total time of all processors since the machine was started.

    Two readings give the load between them. The unit is the clock tick of the kernel, usually
    10 ms.

    Attributes:
        idle: Idle time, summed over the processors.
        total: Idle and busy time, summed over the processors.
    """

    idle: int
    total: int

    @classmethod
    def parse(cls, text: str) -> "_ProcessorTimes":
        """Parses the idle and total processor times from the content of /proc/stat on Linux.

        The times are read from the first line of the file, which contains the sums over all
        processors; see proc_stat(5).

        Args:
            text: Content of the file.
        """
        columns = [int(word) for word in text.splitlines()[0].split()[1:]]
        return cls(sum(columns[_IDLE_COLUMNS]), sum(columns[_TIME_COLUMNS]))


def _measure_busy_share(clock: Clock) -> float | None:
    """Measures the fraction of time during which the processors of this machine are busy.

    For example, it is 0.25 if one of four processors is always busy.

    Args:
        clock: Clock of this process.

    Returns:
        The fraction, between 0 and 1, or None if the operating system does not report it.
    """
    with suppress(OSError, ValueError, IndexError):
        before = _ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        clock.sleep_until(clock.monotonic_ns() + MEASURED_NS)
        after = _ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        passed = after.total - before.total
        if passed > 0:
            idle_share = (after.idle - before.idle) / passed
            return 1.0 - idle_share
    return None


def _describe_load(busy_share: float | None) -> str:
    """Returns a warning with a remedy if other programs keep the machine busy.

    On a busy machine, the ticks of control loops may begin too late.

    Args:
        busy_share: Fraction of time during which the processors are busy. None if unknown.

    Returns:
        The warning. Empty if the machine has time to spare, or if the load is unknown.
    """
    if busy_share is None or busy_share < BUSY_SHARE:
        return ""

    cores = workers.count_cores()
    processors = "one processor is"
    if cores > 1:
        processors = count_nouns(cores, "processor is", "processors are")
    return (
        f"this machine's {processors} {busy_share:.0%} busy with other programs, "
        "so ticks may be late and the recorder may miss records: "
        "end those programs, or lower the rate, as in --set rate_hz=200"
    )

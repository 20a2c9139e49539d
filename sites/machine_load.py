"""Load of this machine before a session begins: whether its processors have time left.

Invariant:
    - A measurement changes nothing and takes 0.2 s.
    - There is no warning if the operating system does not report its load.
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
"""Share of busy time above which a recorder, which has no priority, may get too little."""
_STATISTICS = Path("/proc/stat")
_IDLE_COLUMNS = slice(3, 5)  # idle, and waiting for a disk
_TIME_COLUMNS = slice(0, 8)  # without guests, whose time the column "user" includes


class ProcessorTimes(NamedTuple):
    """Time that all processors have spent since the start of the machine, in system ticks.

    Attributes:
        idle: the time without work.
        total: all time.
    """

    idle: int
    total: int

    @classmethod
    def parse(cls, text: str) -> "ProcessorTimes":
        """Returns the times in the first line of /proc/stat (proc_stat(5))."""
        columns = [int(word) for word in text.splitlines()[0].split()[1:]]
        return cls(sum(columns[_IDLE_COLUMNS]), sum(columns[_TIME_COLUMNS]))


def measure_busy_share(clock: Clock) -> float | None:
    """Returns the share of time in which the processors are busy, 0 to 1; None if unknown."""
    with suppress(OSError, ValueError, IndexError):
        before = ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        clock.sleep_until(clock.monotonic_ns() + MEASURED_NS)
        after = ProcessorTimes.parse(_STATISTICS.read_text(encoding="ascii"))
        passed = after.total - before.total
        return 1.0 - (after.idle - before.idle) / passed if passed > 0 else None
    return None


def describe_load(busy_share: float | None) -> str:
    """Returns a warning about a busy machine, with a remedy.

    Returns "" if the machine has time left, or if its load is unknown.
    """
    if busy_share is None or busy_share < BUSY_SHARE:
        return ""
    cores = process.count_cores()
    processors = "one processor is"
    if cores > 1:
        processors = count_nouns(cores, "processor is", "processors are")
    return (
        f"this machine's {processors} {busy_share:.0%} busy with other programs, "
        "so that ticks may be late and the recorder may miss records: "
        "end those programs, or lower the rate, as in --set rate_hz=200"
    )

"""Real-time settings of a process, such as its priority and its locked memory.

The settings are processor affinity, timer slack, memory, scheduling and garbage collection.

Invariant:
    - A setting that fails is reported, and the site continues.
    - A loop without privileges runs as well as it can, and its log records the settings that it
      obtained.
"""

import ctypes
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from trilat_net import process
from trilat_net.errors import count_nouns

FIFO_PRIORITY = 50
NICE = -10
SITES_PER_PROCESSOR = 2
"""Largest number of loops with priority on one processor.

With more, Zenoh and the recorder would get too little time, and connections would be lost.
"""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_MCL_ONFAULT = 4


def prepare(cpu: int | None, sites: int = 1) -> dict[str, str]:
    """Requests every setting that helps a loop, and returns the obtained ones by name.

    Args:
        cpu: the processor to bind the process to; None for any.
        sites: the number of sites of the session on this machine.
    """
    cpus = os.cpu_count() or 1
    has_room = sites <= SITES_PER_PROCESSOR * cpus

    def describe_shared() -> str:
        shares = count_nouns(sites, "site shares", "sites share")
        return f"normal ({shares} {count_nouns(cpus, 'processor')})"

    memory_flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    steps: dict[str, Callable[[], str]] = {
        "affinity": lambda: _set_affinity(cpu),
        "timer_slack": lambda: _call_libc("1 ns", "prctl", _PR_SET_TIMERSLACK, 1),
        "memory": lambda: _call_libc("locked", "mlockall", memory_flags),
        "scheduling": _set_scheduling if has_room else describe_shared,
        "collector": _stop_collector,
    }
    obtained = {}
    for name, step in steps.items():
        try:
            obtained[name] = step()
        except (OSError, AttributeError, ValueError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or "not on this platform"
            obtained[name] = f"not obtained ({reason})"
    return obtained


def _set_affinity(cpu: int | None) -> str:
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    return "cpu " + ",".join(str(n) for n in sorted(os.sched_getaffinity(0)))


def _call_libc(obtained: str, function: str, *arguments: int) -> str:
    if not sys.platform.startswith("linux"):
        raise AttributeError
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, function)(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return obtained


def _set_scheduling() -> str:
    try:
        _set_threads(
            lambda thread: os.sched_setscheduler(
                thread, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY - 1)
            )
        )
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except (OSError, AttributeError):
        try:
            _set_threads(lambda thread: os.setpriority(os.PRIO_PROCESS, thread, NICE))
        except (OSError, AttributeError):
            return "normal (neither SCHED_FIFO nor a better nice value was permitted)"
        return f"nice {NICE} (SCHED_FIFO was not permitted)"
    return f"SCHED_FIFO {FIFO_PRIORITY}"


def _set_threads(change: Callable[[int], None]) -> None:
    """Applies a change to this thread and then to all threads of the process.

    Another thread that waits for a processor may hold the interpreter lock.
    """
    change(0)
    tasks = Path("/proc/self/task")
    for thread in tasks.iterdir() if tasks.is_dir() else ():
        with suppress(ProcessLookupError):  # it has ended
            change(int(thread.name))


def _stop_collector() -> str:
    process.disable_gc()
    return "frozen and off"

"""Requests real-time settings from the operating system, such as priority and locked memory.

The ticks of an arm's control loop must start on time. The settings reduce how late they start:
pinning to a processor, precise sleeping (timer slack), memory that is not swapped to disk,
real-time scheduling, and no garbage collection.

Invariant:
    - If the operating system denies a setting, the site continues without it.
    - The log contains the settings that each site has obtained, because they explain how
      punctual its ticks are.
"""

import ctypes
import os
import sys
from collections.abc import Callable

from trilat_net import process
from trilat_net.errors import count_nouns

_SITES_PER_PROCESSOR = 2
"""Maximum number of loops per processor that receive priority.

If there were more, the network threads and the recorder would receive too little time, and
connections would be lost.
"""

# Constants of Linux, from sys/prctl.h and sys/mman.h.
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_MCL_ONFAULT = 4


def prepare(cpu: int | None, sites: int = 1) -> dict[str, str]:
    """Requests all real-time settings for this process, such as priority and locked memory.

    The settings make the ticks of the control loop start on time. Those that the operating
    system does not permit are left out.

    Args:
        cpu: Processor to which the process is pinned. If None, all processors may be used.
        sites: Number of sites of the session on this machine. If there are too many, normal
            scheduling is kept.

    Returns:
        A mapping from each setting to a description of what was obtained, or to the reason why
        it was not obtained.
    """
    cpus = os.cpu_count() or 1
    has_room = sites <= _SITES_PER_PROCESSOR * cpus

    def describe_crowded_machine() -> str:
        """Explains why real-time scheduling is not requested on a crowded machine.

        Example: "normal (3 sites share 2 processors)".
        """
        shares = count_nouns(sites, "site shares", "sites share")
        return f"normal ({shares} {count_nouns(cpus, 'processor')})"

    memory_flags = _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT
    steps: dict[str, Callable[[], str]] = {
        "affinity": lambda: _set_affinity(cpu),
        "timer_slack": lambda: _call_libc("1 ns", "prctl", _PR_SET_TIMERSLACK, 1),
        "memory": lambda: _call_libc("locked", "mlockall", memory_flags),
        "scheduling": process.request_real_time_scheduling
        if has_room
        else describe_crowded_machine,
        "collector": _stop_collector,
    }
    # A setting that is refused or does not exist on this platform does not prevent the others.
    obtained = {}
    for name, step in steps.items():
        try:
            obtained[name] = step()
        except (OSError, AttributeError, ValueError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or "not on this platform"
            obtained[name] = f"not obtained ({reason})"
    return obtained


def _set_affinity(cpu: int | None) -> str:
    """Pins the process to one processor, so that the system does not move it to another one.

    Moving a process takes time and empties its cache, which delays ticks.

    Args:
        cpu: Number of the processor. If None, nothing is changed.

    Returns:
        The processors that the process may use, as stored in the log, such as "cpu 0,1".
    """
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    return "cpu " + ",".join(str(n) for n in sorted(os.sched_getaffinity(0)))


def _call_libc(setting: str, function: str, *arguments: int) -> str:
    """Calls a function of the C library that applies a real-time setting to this process.

    For example, `mlockall` keeps the memory of the process in RAM. The function must return 0
    on success.

    Args:
        setting: Description of the setting for the user, such as "locked" for memory.
        function: Name of the function.
        *arguments: Arguments of the function.

    Returns:
        The argument `setting`, because `prepare` reports for each step what was obtained.

    Raises:
        AttributeError: The platform is not Linux. `prepare` reports this error, which is also
            raised if the function is missing, as "not on this platform".
        OSError: The call has failed.
    """
    if not sys.platform.startswith("linux"):
        raise AttributeError
    libc = ctypes.CDLL(None, use_errno=True)
    has_failed = getattr(libc, function)(*arguments) != 0
    if has_failed:
        error_number = ctypes.get_errno()
        raise OSError(error_number, os.strerror(error_number))
    return setting


def _stop_collector() -> str:
    """Turns off Python's garbage collection, because its pauses delay ticks.

    Returns:
        A description of what was done, for the log.
    """
    process.disable_gc()
    return "frozen and off"

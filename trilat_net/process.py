"""Process priority and garbage collection settings that keep a control loop on time.

A control loop must not wait for other programs (`request_real_time_scheduling`,
`raise_priority`) or for Python's garbage collector (`disable_gc`, `freeze_gc`). `pause_gc`
speeds up code that creates many objects.

Invariant:
    - `pause_gc` is used only around code that creates many objects without reference cycles,
      such as records and lists of numbers. Garbage collection would take time there and free
      nothing.
"""

import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FIFO_PRIORITY = 50
"""Real-time priority (SCHED_FIFO) of the thread that runs a control loop."""
LOOP_NICE = -10
"""Nice value of a control loop if real-time scheduling is not permitted."""


@contextmanager
def pause_gc() -> Iterator[None]:
    """Pauses Python's garbage collector inside the `with` block.

    Code that creates many objects runs faster this way, because the collector does not traverse
    them.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def freeze_gc() -> None:
    """Speeds up later garbage collections by exempting all existing objects from them.

    A collection is run first. Without this function, each full collection traverses all objects
    of the imported modules, which takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def disable_gc() -> None:
    """Disables the garbage collector permanently in a process whose loop must not pause.

    A collection is run first. After that, unused objects remain in memory only if they are part
    of reference cycles.
    """
    freeze_gc()
    gc.disable()


def request_real_time_scheduling() -> str:
    """Requests real-time scheduling for this process, or at least a better nice value.

    Intended for programs that must exchange messages with a site in every tick, such as the
    driver of an arm or of a haptic device. Their loops then run on time even on a busy machine.
    Note that a loop that never sleeps would block a processor.

    >>> tn.request_real_time_scheduling()  # doctest: +SKIP
    'SCHED_FIFO 50'

    All threads of the process get real-time scheduling (SCHED_FIFO), and the calling thread
    gets the highest priority. The other threads are included because the calling thread may
    have to wait for the interpreter lock held by one of them.

    Returns:
        Description of the scheduling that was obtained, for example "SCHED_FIFO 50".
    """
    calling_thread = 0  # in system calls, 0 stands for the calling thread
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):  # not permitted, or not on this platform
            lower_priority = os.sched_param(FIFO_PRIORITY - 1)
            _change_threads(
                lambda thread: os.sched_setscheduler(thread, os.SCHED_FIFO, lower_priority)
            )
            os.sched_setscheduler(calling_thread, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
            return f"SCHED_FIFO {FIFO_PRIORITY}"

    if sys.platform != "win32":
        with suppress(OSError, AttributeError):  # not permitted, or not on this platform
            _change_threads(lambda thread: os.setpriority(os.PRIO_PROCESS, thread, LOOP_NICE))
            return f"nice {LOOP_NICE} (SCHED_FIFO was not permitted)"

    return "normal (neither SCHED_FIFO nor a better nice value was permitted)"


def _change_threads(change: Callable[[int], None]) -> None:
    """Applies a change, such as a higher priority, to all threads of this process.

    The calling thread is changed first.

    Args:
        change: Function that changes the thread with a given ID. 0 denotes the calling thread.
    """
    change(0)
    threads_folder = Path("/proc/self/task")  # Linux lists the threads of a process here
    if not threads_folder.is_dir():
        return
    for thread in threads_folder.iterdir():
        with suppress(ProcessLookupError):  # the thread has ended meanwhile
            change(int(thread.name))


def raise_priority(nice: int) -> bool:
    """Raises the priority of all threads of this process except the main thread, if permitted.

    On a busy machine, other programs then delay these threads less. The main thread is
    excluded, unless it is the calling thread, because child processes would inherit its
    priority. Only Linux has a nice value per thread. On other systems, and without the required
    privilege, nothing changes.

    Args:
        nice: The nice value. Values below 0 mean a higher priority than normal, and -20 is the
            highest priority.

    Returns:
        True if the calling thread has the requested priority.
    """
    threads_folder = Path("/proc/self/task")  # Linux lists the threads of a process here
    if not sys.platform.startswith("linux"):
        return False
    if not threads_folder.is_dir():
        return False

    calling_thread = threading.get_native_id()
    main_thread = os.getpid()  # on Linux the main thread has the number of the process
    all_threads = [int(entry.name) for entry in threads_folder.iterdir()]
    others = [thread for thread in all_threads if thread not in (calling_thread, main_thread)]
    try:
        for thread in (calling_thread, *others):
            with suppress(ProcessLookupError):  # the thread has ended meanwhile
                os.setpriority(os.PRIO_PROCESS, thread, nice)
    except OSError:
        return False
    _raise_session_priority(nice)
    return True


def _raise_session_priority(nice: int) -> None:
    """Raises the priority of the operating system session that this process leads, if any.

    A session is a group of processes (`setsid`). Linux may distribute processor time first
    among sessions, and only then among the threads of each session (`man 7 sched`, "The
    autogroup feature"). In this case, the nice value of a thread has no effect outside its
    session. If another process, for example a shell, leads the session, nothing is changed,
    because this would also affect its other processes.
    """
    if sys.platform.startswith("linux") and os.getsid(0) == os.getpid():
        with suppress(OSError):  # not permitted, or the system has no such groups
            Path("/proc/self/autogroup").write_text(f"{nice}\n", "ascii", newline="\n")

"""Keeps the process of a control loop on time: its priority, and Python's garbage collector.

A control loop must not wait for other programs or for Python's garbage collector.
`request_real_time_scheduling` and `raise_priority` address the first, `disable_gc` and
`freeze_gc` the second. `pause_gc` speeds up code that creates many objects.

Invariant:
    - `pause_gc` is used only around code that creates many objects without reference cycles,
      such as records and lists of numbers. Collecting them would cost time and free nothing.
"""

import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FIFO_PRIORITY = 50
"""Priority of the thread of a control loop with real-time scheduling (SCHED_FIFO)."""
LOOP_NICE = -10
"""Nice value of a control loop if real-time scheduling is not permitted."""


@contextmanager
def pause_gc() -> Iterator[None]:
    """Pauses the garbage collector of Python inside the `with` block.

    Code that creates many objects then runs faster, because the collector does not search them.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def freeze_gc() -> None:
    """Speeds up later garbage collections by exempting all objects that exist now.

    One collection runs first. Without this function, each full collection traverses all objects
    of the imported modules, which takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def disable_gc() -> None:
    """Turns off the garbage collector for the rest of a process whose loop must not pause.

    One collection runs first. Afterwards, unused objects stay in memory only if they are in
    reference cycles.
    """
    freeze_gc()
    gc.disable()


def request_real_time_scheduling() -> str:
    """Requests real-time scheduling for this process, or at least a better nice value.

    Call it in a program that must exchange messages with a site in every period, such as the
    driver of an arm or of a haptic device. On a busy machine its loop then still runs on time.
    A loop that never sleeps would block a processor.

    >>> tn.request_real_time_scheduling()  # doctest: +SKIP
    'SCHED_FIFO 50'

    All threads of the process get real-time scheduling (SCHED_FIFO), and the calling thread has
    the highest priority. The other threads are included because one of them may hold the
    interpreter lock, for which the calling thread would have to wait.

    Returns:
        Description of the scheduling that was obtained, for example "SCHED_FIFO 50".
    """
    calling_thread = 0  # in system calls, 0 stands for the calling thread
    try:
        lower_priority = os.sched_param(FIFO_PRIORITY - 1)
        _change_threads(
            lambda thread: os.sched_setscheduler(thread, os.SCHED_FIFO, lower_priority)
        )
        os.sched_setscheduler(calling_thread, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        return f"SCHED_FIFO {FIFO_PRIORITY}"
    except (OSError, AttributeError):
        pass  # not permitted, or not on this platform

    try:
        _change_threads(lambda thread: os.setpriority(os.PRIO_PROCESS, thread, LOOP_NICE))
        return f"nice {LOOP_NICE} (SCHED_FIFO was not permitted)"
    except (OSError, AttributeError):
        return "normal (neither SCHED_FIFO nor a better nice value was permitted)"


def _change_threads(change: Callable[[int], None]) -> None:
    """Applies a change, such as a higher priority, to all threads of this process.

    The calling thread comes first.

    Args:
        change: Function that changes the thread with a given number. 0 is the calling thread.
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

    On a busy machine, these threads are then delayed less by other programs. The main thread is
    excluded because the processes that it starts would inherit the priority. If it is the
    calling thread, its priority is raised too. Only Linux has a priority (nice value) for each
    thread. On other systems, and without the privilege, nothing changes.

    Args:
        nice: The nice value. Values below 0 are above the normal priority, and -20 is the
            highest.

    Returns:
        True if the calling thread got the priority.
    """
    threads_folder = Path("/proc/self/task")  # Linux lists the threads of a process here
    if not (sys.platform.startswith("linux") and threads_folder.is_dir()):
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
    """Raises the priority of the operating system's session that this process leads, if any.

    A session is a group of processes (`setsid`). Linux may share the processors among sessions
    first, and only then among the threads of a session (`man 7 sched`, "The autogroup
    feature"). The nice value of a thread then has no effect outside its session. If another
    process leads the session, for example a shell, nothing changes, because its other processes
    would be raised too.
    """
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # not permitted, or the system has no such groups
            Path("/proc/self/autogroup").write_text(f"{nice}\n", "ascii", newline="\n")

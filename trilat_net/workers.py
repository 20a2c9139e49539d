"""Starts worker processes, which compute the parts of a large task in parallel.

For example, a parameter sweep assigns each of its runs to one of the workers:

    with worker_pool(count_cores()) as pool:
        results = list(pool.map(compute_run, settings))

Invariant:
    - Worker processes ignore Ctrl-C, which is handled by the process that started them. They
      end when that process ends or fails.
"""

import os
import signal
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from .errors import TrilatError
from .signals import hold_sigint

_PARENT_POLL_S = 0.5
"""Interval, in s, at which a worker process checks that its parent process still exists."""


def count_cores() -> int:
    """Returns the number of processors that this process may use.

    This may be fewer than the machine has, for example in a container.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def worker_pool(count: int) -> Iterator[Executor]:
    """Context manager that yields an executor with worker processes.

    All processes have ended when the block exits. They are spawned rather than forked, which is
    safe with threads and compiled code, and do not import the caller's script. If the block
    raises an exception, for example because of Ctrl-C, the processes are killed in the middle
    of their work.

    Args:
        count: Number of processes.
    """
    from loky import ProcessPoolExecutor

    # loky warns if the program pgrep is missing, but the workers have no children to kill.
    warnings.filterwarnings("ignore", "Failed to kill subprocesses")
    # loky restarts a worker whose memory grows. This is expected: a worker keeps the laws that
    # it compiled.
    warnings.filterwarnings("ignore", "A worker was restarted")
    arguments = (os.getpid(), TrilatError.in_command)
    pool = ProcessPoolExecutor(count, initializer=_prepare_worker, initargs=arguments)
    try:
        with hold_sigint():
            # The first task starts all processes, which inherit the held signal.
            pool.submit(os.getpid)
        yield pool
        pool.shutdown()
    finally:
        pool.shutdown(kill_workers=True)


def _prepare_worker(parent: int, in_command: bool) -> None:
    """Prepares a new worker process, so that its lifetime is controlled only by its parent.

    The worker ignores Ctrl-C, and ends as soon as its parent has ended.

    Args:
        parent: Process ID of the parent.
        in_command: True if the parent runs a command of `trilat`, which affects the wording of
            errors (`TrilatError.in_command`).
    """
    TrilatError.in_command = in_command
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: int) -> None:
    """Ends this worker process as soon as its parent process has ended for any reason.

    Runs in a thread. Without this thread, workers would continue computing after their parent
    was killed.

    Args:
        parent: Process ID of the parent.
    """
    from multiprocessing import connection, parent_process

    # On Windows, the recorded number of the parent stays the same after the parent has ended,
    # but the sentinel, a handle of the parent, becomes ready.
    sentinel = getattr(parent_process(), "sentinel", None)
    if os.name == "nt" and sentinel is not None:
        connection.wait([sentinel])
        os._exit(1)
    # On other systems, a process whose parent has ended gets another parent.
    pause = threading.Event()  # never set: `wait` only pauses
    while os.getppid() == parent:
        pause.wait(_PARENT_POLL_S)
    os._exit(1)

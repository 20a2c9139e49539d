"""Controls this process: garbage collection, signals, priority, and worker processes.

A worker process computes one part of a large task, such as one of many runs, at the same time
as other workers.

Invariant:
    - Garbage collection pauses only around code that creates many objects without reference
      cycles, such as records and lists of numbers. Collecting them would cost time and free
      nothing.
    - Ctrl-C or another ending signal does not end the program by itself. A loop polls for the
      signal, and then ends in an orderly way.
    - Worker processes ignore Ctrl-C, and leave it to the process that started them. They end
      when that process ends or fails.
"""

import gc
import os
import queue
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from .errors import TrilatError

FIFO_PRIORITY = 50
"""Priority of the thread of a control loop with real-time scheduling (SCHED_FIFO)."""
LOOP_NICE = -10
"""Nice value of a control loop if real-time scheduling is not permitted."""
_PARENT_POLL_S = 0.5
"""Period in which a worker process checks that its parent process still exists, in s."""


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
    """Makes later collections of garbage faster, by exempting all objects that exist now.

    Garbage is collected once before. Without this function, each full collection traverses all
    objects of the imported modules, which takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def disable_gc() -> None:
    """Stops the garbage collector for the rest of a process whose loop must not pause.

    Garbage is collected once before. Afterwards, only objects in reference cycles stay in
    memory.
    """
    freeze_gc()
    gc.disable()


class LinePrinter:
    """Prints lines in a separate thread, so that a control loop never waits for the terminal.

    It is used as a context manager. Up to 256 lines wait to be printed, and further lines are
    lost.

    Args:
        print_line: Function that prints a line.
    """

    def __init__(self, print_line: Callable[[str], None]) -> None:
        self._print_line = print_line
        self._lines: queue.Queue[str | None] = queue.Queue(256)
        self._thread = threading.Thread(target=self._print_lines, daemon=True)

    def __enter__(self) -> "LinePrinter":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(queue.Full):
            self._lines.put(None, timeout=1.0)
        self._thread.join(1.0)

    def put(self, text: str) -> None:
        """Adds a line to the lines that wait to be printed. The method does not wait.

        The line is lost if too many lines wait already.

        Args:
            text: The line.
        """
        with suppress(queue.Full):
            self._lines.put_nowait(text)

    def _print_lines(self) -> None:
        """Prints the waiting lines until None arrives, in the thread of the printer."""
        while (text := self._lines.get()) is not None:
            with suppress(OSError):
                self._print_line(text)


# The signal of a terminal or window that has closed.
_HANG_UP = getattr(signal, "SIGHUP", getattr(signal, "SIGBREAK", None))
_SIGNALS = (signal.SIGINT, signal.SIGTERM, _HANG_UP)
ENDING_SIGNALS = tuple(number for number in _SIGNALS if number is not None)
"""Signals that request the end of the program, such as that of Ctrl-C."""
_SAME_REQUEST_S = 0.2
"""Signals within this time, in s, count as one request.

A terminal and a parent process may both deliver the same signal.
"""


class Interrupt:
    """Records signals that request the end of the program, as a context manager.

    The first signal requests an orderly end, which may take seconds. A second signal requests
    the end at once (`is_repeated`). A process that ignores the closing of its terminal, for
    example one started by `nohup`, continues to ignore it.

    Args:
        compiles: True if a signal may end the process at once during a compilation. This is
            allowed if the process has nothing to finish then.

    Attributes:
        number: Number of the first signal. 0 if no signal has arrived.
        compiles: The value of the argument.
        raises: True within a `with` block of `raising`, where a signal raises
            KeyboardInterrupt.
    """

    def __init__(self, *, compiles: bool = False) -> None:
        self.number = 0
        self.compiles = compiles
        # Time of the first SIGINT or SIGTERM.
        self._requested_s: float | None = None
        self._is_repeated = False
        self._before: dict[int, Any] = {}
        self.raises = False

    def __enter__(self) -> "Interrupt":
        for number in ENDING_SIGNALS:
            if number != _HANG_UP or signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        # An enclosing `Interrupt` learns of the signal that ends this block.
        outer = getattr(self._before.get(signal.SIGINT), "__self__", None)
        if kind is KeyboardInterrupt and isinstance(outer, Interrupt):
            outer.number = outer.number or self.number

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        """Records a signal that requests the end of the program, such as that of Ctrl-C.

        The first signal requests an orderly end. A second Ctrl-C requests the end at once, for
        a user who does not want to wait. Two signals in quick succession count as one request,
        because a terminal and a parent process may both deliver the same signal.

        Args:
            number: Number of the signal.

        Raises:
            KeyboardInterrupt: The signal has arrived in a `with` block of `raising`.
        """
        self.number = self.number or number
        # A terminal that closes and its shell send one SIGHUP each: these are not repetitions.
        if number != _HANG_UP:
            now_s = os.times().elapsed
            if self._requested_s is None:
                self._requested_s = now_s
            elif now_s - self._requested_s > _SAME_REQUEST_S:
                self._is_repeated = True
        if self.raises:  # within a `with` block of `raising`
            raise KeyboardInterrupt

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Lets a signal raise KeyboardInterrupt in a `with` block, to interrupt long work.

        It is meant for work that does not regularly check whether a signal has arrived. Python
        discards an exception that is raised within a `__del__` method. If this happens, the
        exception is raised again at the end of the block.
        """
        self.raises = True
        try:
            yield
        finally:
            self.raises = False
        if self.is_requested():
            raise KeyboardInterrupt

    def is_requested(self) -> bool:
        """Returns True once a signal, such as Ctrl-C, has requested the end of the program."""
        return self.number != 0

    def is_repeated(self) -> bool:
        """Returns True once a second signal has arrived that is not a copy of the first.

        Only SIGINT (Ctrl-C) and SIGTERM count.
        """
        return self._is_repeated

    @property
    def exit_code(self) -> int:
        """Exit code of a process that was ended by the first signal, according to shell rules.

        It is 128 plus the number of the signal.
        """
        return 128 + self.number


def end_process_at_signals() -> Callable[[], None]:
    """Makes signals end this process at once, if the current `Interrupt` allows it.

    Python handles a signal only between two of its instructions. A single call of the compiler
    may take minutes, during which Ctrl-C would have no effect. Therefore the default action of
    the operating system is restored, which ends the process. The first process of a container
    (PID 1) has no default action, so a thread ends the process there.

    Returns:
        A function that restores the handlers of the signals.
    """
    if threading.current_thread() is not threading.main_thread():
        # Python permits only the main thread to change handlers.
        return lambda: None

    replaced = {}
    for number in ENDING_SIGNALS:
        handler = signal.getsignal(number)
        if _may_interrupt(getattr(handler, "__self__", None)):
            replaced[number] = handler

    is_first_process = bool(replaced) and os.getpid() == 1
    for number in replaced:
        signal.signal(number, _exit_by_signal if is_first_process else signal.SIG_DFL)
    unwatch = _watch_signals() if is_first_process else lambda: None

    def restore() -> None:
        """Restores the handlers of the signals that were replaced."""
        unwatch()
        for number, handler in replaced.items():
            signal.signal(number, handler)

    return restore


def _exit_by_signal(number: int, _frame: FrameType | None) -> None:
    """Ends the process at once with the exit code of a signal."""
    os._exit(128 + number)


def _watch_signals() -> Callable[[], None]:
    """Starts a thread that ends the process as soon as an ending signal arrives.

    The part of Python that runs outside of its instructions writes the number of each signal
    into a pipe (`signal.set_wakeup_fd`). The thread reads the pipe, and therefore works even
    while the main thread is inside the compiler.

    Returns:
        A function that stops the thread.
    """
    reader, writer = os.pipe()
    # Python requires a pipe that never blocks, which Windows does not support. It is not needed
    # there, because no container has this program as its first process.
    if sys.platform != "win32":
        os.set_blocking(writer, False)
    previous_descriptor = signal.set_wakeup_fd(writer)

    def wait() -> None:
        """Ends the process as soon as a signal arrives that requests its end.

        The function runs in a thread of its own. Python writes the number of each signal into a
        pipe, which the function reads until `unwatch` closes the pipe.
        """
        with os.fdopen(reader, "rb", 0) as pipe:
            while data := pipe.read(1):  # a byte with the number of the signal
                number = data[0]
                if number in ENDING_SIGNALS:
                    os._exit(128 + number)

    def unwatch() -> None:
        """Stops the thread by closing its pipe."""
        signal.set_wakeup_fd(previous_descriptor)
        os.close(writer)

    threading.Thread(target=wait, daemon=True).start()
    return unwatch


def _may_interrupt(owner: object) -> bool:
    """Returns True if the owner of a signal's handler allows the signal to interrupt its work.

    Args:
        owner: Object whose method handles the signal. None if the handler is a plain function.
    """
    return isinstance(owner, Interrupt) and (owner.raises or owner.compiles)


def join_arguments(arguments: Iterable[str]) -> str:
    """Returns a command as a user would type it into a shell of this operating system.

    Args:
        arguments: Name of the program and its arguments.
    """
    if os.name != "nt":
        return shlex.join(arguments)
    # Both cmd and PowerShell accept this form.
    texts = []
    for argument in arguments:
        escaped = argument.replace('"', '\\"')
        needs_quotes = not re.fullmatch(r"[\w.:/\\=+-]+", escaped)
        texts.append(f'"{escaped}"' if needs_quotes else escaped)
    return " ".join(texts)


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
    try:
        _change_threads(
            lambda thread: os.sched_setscheduler(
                thread, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY - 1)
            )
        )
        calling_thread = 0
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
    """Applies a change to this thread, and then to all other threads of the process.

    Args:
        change: Function that changes the thread of a given number. 0 is the calling thread.
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

    The main thread is excluded because the processes that it starts would inherit the priority.
    If it is the calling thread, its priority is raised too. Only Linux has a nice value for
    each thread. On other systems, and without the privilege, nothing changes.

    On a busy machine, these threads are then delayed less by other programs.

    Args:
        nice: The nice value. Values below 0 are above the normal priority, and -20 is the
            highest.

    Returns:
        True if the calling thread got the priority.
    """
    tasks = Path("/proc/self/task")
    if not (sys.platform.startswith("linux") and tasks.is_dir()):
        return False
    calling_thread = threading.get_native_id()
    main_thread = os.getpid()  # on Linux the main thread has the number of the process
    all_threads = [int(entry.name) for entry in tasks.iterdir()]
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
    """Raises the priority of this process among other sessions, if it leads one (`setsid`).

    Linux may share the processors among sessions first, and only then among the threads of a
    session (`man 7 sched`, "The autogroup feature"). The nice value of a thread then has no
    effect outside its session. If another process leads the session, for example a shell,
    nothing changes, because its other processes would be raised too.
    """
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # not permitted, or the system has no such groups
            Path("/proc/self/autogroup").write_text(f"{nice}\n", "ascii", newline="\n")


def count_cores() -> int:
    """Returns the number of processors that this process may use.

    It may be smaller than the number of processors of the machine, for example in a container.
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def worker_pool(count: int) -> Iterator[Executor]:
    """Yields an executor with worker processes, which have all ended when the block ends.

    The processes are started anew, not forked, so that threads and compiled code are safe. They
    do not import the script of the caller. If the block raises an exception, for example
    because of Ctrl-C, they are killed in the middle of their work.

    Args:
        count: Number of processes.
    """
    from loky import ProcessPoolExecutor

    # loky misses pgrep, but the workers have no children to kill.
    warnings.filterwarnings("ignore", "Failed to kill subprocesses")
    # A worker whose memory grows is restarted, since it keeps the laws that it compiled.
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


@contextmanager
def hold_sigint() -> Iterator[None]:
    """Delays Ctrl-C inside the `with` block, and hides it from processes started there.

    The signal mask is inherited by the started processes, which is its purpose. It does not
    delay Ctrl-C in this process if another thread receives the signal, because Python runs the
    handler in the main thread anyway. Therefore the handler is replaced as well.
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _frame: arrived.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if arrived:
            signal.raise_signal(signal.SIGINT)


def _prepare_worker(parent: int, in_command: bool) -> None:
    """Prepares a worker process: it ignores Ctrl-C, and ends after its parent process.

    Args:
        parent: Process number of the parent.
        in_command: True if the parent runs a command of `trilat`, which changes the wording of
            errors (`TrilatError.in_command`).
    """
    TrilatError.in_command = in_command
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: int) -> None:
    """Waits until the parent process has ended, and then ends this process.

    Args:
        parent: Process number of the parent.
    """
    from multiprocessing import connection, parent_process

    sentinel = getattr(parent_process(), "sentinel", None)
    # On Windows the number of the parent does not change when the parent has ended.
    if os.name == "nt" and sentinel is not None:
        connection.wait([sentinel])
        os._exit(1)
    pause = threading.Event()
    while os.getppid() == parent:
        pause.wait(_PARENT_POLL_S)
    os._exit(1)

"""Process control: garbage collection, signals that end a program, commands for a shell, worker
processes.

Invariants: garbage collection pauses only around code whose many objects form no cycles
(records, lists of numbers). A signal ends nothing by itself: a loop polls it and ends in order.
Worker processes leave Ctrl-C to the process that started them, and end with it or when it
fails.
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

_PARENT_POLL_S = 0.5
"""How often a worker looks whether its parent is still there."""


@contextmanager
def pause_gc() -> Iterator[None]:
    """Pauses the garbage collector inside the block."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def freeze_gc() -> None:
    """Collects once and exempts all existing objects: later rounds visit new objects alone.

    A full round over everything that a program has imported takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def disable_gc() -> None:
    """Freezes and stops the collector, for a loop that must not pause."""
    freeze_gc()
    gc.disable()


class LinePrinter:
    """A context that prints lines in a thread of its own, so that a loop never waits for a
    terminal.

    Of lines that are not printed yet it keeps 256; more are lost.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lines: queue.Queue[str | None] = queue.Queue(256)
        self._thread = threading.Thread(target=self._print, daemon=True)

    def __enter__(self) -> "LinePrinter":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(queue.Full):
            self._lines.put(None, timeout=1.0)
        self._thread.join(1.0)

    def put(self, text: str) -> None:
        """Prints a line soon."""
        with suppress(queue.Full):
            self._lines.put_nowait(text)

    def _print(self) -> None:
        while (text := self._lines.get()) is not None:
            with suppress(OSError):
                self._say(text)


# the terminal, or window, has gone
_HANG_UP = getattr(signal, "SIGHUP", getattr(signal, "SIGBREAK", None))
ENDING_SIGNALS = tuple(
    one for one in (signal.SIGINT, signal.SIGTERM, _HANG_UP) if one is not None
)
"""Signals that end a program in order."""
_SAME_WISH_S = 0.2
"""Signals that come within this time are one wish: a terminal and a parent process may both
deliver it.
"""


class Interrupt:
    """A context that records the first signal that ends a program, as `number` (else 0).

    The first signal asks for an orderly end, which may take seconds; a second one `insists` on
    an end at once. Whoever ignores the end of its terminal (`nohup`) goes on doing so. Where it
    `compiles`, and nothing else is to be ended in order, a signal ends the process at once
    while the compiler runs.
    """

    def __init__(self, *, compiles: bool = False) -> None:
        self.number = 0
        self.compiles = compiles
        self._asked_s: float | None = None  # when the first SIGINT or SIGTERM came
        self._insists = False
        self._before: dict[int, Any] = {}
        self.raises = False

    def __enter__(self) -> "Interrupt":
        for name in ENDING_SIGNALS:
            if name != _HANG_UP or signal.getsignal(name) is not signal.SIG_IGN:
                self._before[name] = signal.signal(name, self._take)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for name, handler in self._before.items():
            signal.signal(name, handler)
        outer = getattr(self._before.get(signal.SIGINT), "__self__", None)
        if kind is KeyboardInterrupt and isinstance(outer, Interrupt):
            outer.number = outer.number or self.number

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.number = self.number or number
        if number != _HANG_UP:  # a terminal that closes, and its shell, send one each
            now_s = os.times().elapsed
            self._insists |= self._asked_s is not None and now_s - self._asked_s > _SAME_WISH_S
            self._asked_s = now_s if self._asked_s is None else self._asked_s
        if self.raises:
            raise KeyboardInterrupt

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Lets a signal interrupt the block at once, for long work that polls nothing.

        Python swallows an exception raised inside a `__del__`; then the block is left at its
        end.
        """
        self.raises = True
        try:
            yield
        finally:
            self.raises = False
        if self.is_requested():
            raise KeyboardInterrupt

    def is_requested(self) -> bool:
        """True once a signal has arrived."""
        return self.number != 0

    def is_repeated(self) -> bool:
        """True once a second SIGINT or SIGTERM has arrived, later than one that a parent passes
        on.
        """
        return self._insists

    @property
    def exit_code(self) -> int:
        """Exit code of a process that the signal ended, by the shell's convention."""
        return 128 + self.number


def end_process_at_signals() -> Callable[[], None]:
    """Lets signals end the process at once where they may break off work; the function returned
    ends that.

    Python sees a signal between two of its instructions: one call of a compiler takes minutes.
    The first process of a container is not ended by what it leaves to the kernel: there a
    thread ends it.
    """
    if threading.current_thread() is not threading.main_thread():
        return lambda: None
    handlers = ((name, signal.getsignal(name)) for name in ENDING_SIGNALS)
    taken = {name: one for name, one in handlers if _breaks_off(getattr(one, "__self__", None))}
    first = bool(taken) and os.getpid() == 1
    for name in taken:
        signal.signal(
            name, (lambda number, _: os._exit(128 + number)) if first else signal.SIG_DFL
        )
    unwatch = _watch_signals() if first else lambda: None

    def restore() -> None:
        unwatch()
        for name, handler in taken.items():
            signal.signal(name, handler)

    return restore


def _watch_signals() -> Callable[[], None]:
    """Ends the process at a signal, from a thread, until the function returned is called."""
    reader, writer = os.pipe()
    if sys.platform != "win32":  # where no process is the first of a container
        os.set_blocking(writer, False)
    before = signal.set_wakeup_fd(writer)

    def wait() -> None:
        with os.fdopen(reader, "rb", 0) as arrived:
            while number := arrived.read(1):
                if number[0] in ENDING_SIGNALS:
                    os._exit(128 + number[0])

    def unwatch() -> None:
        signal.set_wakeup_fd(before)
        os.close(writer)

    threading.Thread(target=wait, daemon=True).start()
    return unwatch


def _breaks_off(owner: object) -> bool:
    return isinstance(owner, Interrupt) and (owner.raises or owner.compiles)


def join_arguments(words: Iterable[str]) -> str:
    """Returns a command as it is typed into a shell of this system."""
    if os.name != "nt":
        return shlex.join(words)
    # as cmd and PowerShell both take it
    quoted = ('"' + word.replace('"', '\\"') + '"' for word in words)
    return " ".join(
        one[1:-1] if re.fullmatch(r'"[\w.:/\\=+-]+"', one) else one for one in quoted
    )


def raise_priority(nice: int) -> bool:
    """Runs the threads of this process but the main one above normal priority, where that is
    permitted.

    The main thread is left out because the processes that it starts would inherit the priority.
    Linux gives every thread a nice value of its own; on other systems, and without the
    privilege, nothing changes.

    Args:
        nice: below 0 for a priority above normal; -20 is the highest.

    Returns:
        True if the calling thread got the priority.
    """
    tasks = Path("/proc/self/task")
    if not (sys.platform.startswith("linux") and tasks.is_dir()):
        return False
    own = threading.get_native_id()
    others = (int(entry.name) for entry in tasks.iterdir())
    threads = [own, *(thread for thread in others if thread not in (own, os.getpid()))]
    try:
        for thread in threads:
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.setpriority(os.PRIO_PROCESS, thread, nice)
    except OSError:
        return False
    return True


def count_cores() -> int:
    """Returns the number of processors that this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


@contextmanager
def worker_pool(count: int) -> Iterator[Executor]:
    """Yields an executor over worker processes; all of them are gone when the block ends.

    The processes are started afresh (never forked, so threads and compiled code are safe) and
    do not import the caller's script. An exception in the block, Ctrl-C included, kills them in
    the middle of their work.
    """
    from loky import ProcessPoolExecutor

    # no pgrep: workers have no children
    warnings.filterwarnings("ignore", "Failed to kill subprocesses")
    # each keeps the laws that it compiled
    warnings.filterwarnings("ignore", "A worker was restarted")
    facts = (os.getpid(), TrilatError.in_command)
    pool = ProcessPoolExecutor(count, initializer=_prepare_worker, initargs=facts)
    try:
        with hold_sigint():
            pool.submit(os.getpid)  # starts all processes, which inherit it
        yield pool
        pool.shutdown()
    finally:
        pool.shutdown(kill_workers=True)


@contextmanager
def hold_sigint() -> Iterator[None]:
    """Holds Ctrl-C back in the block: processes that start there never get it, this one does
    afterwards.

    The mask is for the processes. It does not hold what arrives in another thread of this one,
    whose handler Python runs here all the same: so the handler is exchanged too.
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
    TrilatError.in_command = in_command
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: int) -> None:
    from multiprocessing import connection, parent_process

    started_by = getattr(parent_process(), "sentinel", None)
    # the number of a parent stays the same when it has gone
    if os.name == "nt" and started_by is not None:
        connection.wait([started_by])
        os._exit(1)
    pause = threading.Event()
    while os.getppid() == parent:
        pause.wait(_PARENT_POLL_S)
    os._exit(1)

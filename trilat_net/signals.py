"""Lets loops shut down cleanly after Ctrl-C or another termination signal.

By default, Python raises an exception at an arbitrary line. A control loop or a recorder must
stop at the end of a step instead.

Invariant:
    - Ctrl-C or another termination signal does not end the program by itself. A loop polls for
      the signal and then shuts down cleanly.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

# The signal of a terminal or window that has closed.
_HANG_UP = getattr(signal, "SIGHUP", getattr(signal, "SIGBREAK", None))
_SIGNALS = (signal.SIGINT, signal.SIGTERM, _HANG_UP)
ENDING_SIGNALS = tuple(number for number in _SIGNALS if number is not None)
"""Signals that request the end of the program, such as SIGINT (Ctrl-C)."""
_SAME_REQUEST_S = 0.2
"""Time, in s, within which signals count as one request.

A terminal and a parent process may both deliver the same signal.
"""


class Interrupt:
    """Context manager that records signals that request the end of the program.

    The first signal requests a clean shutdown, which may take seconds. A second signal requests
    an immediate end (`is_repeated`). A process that ignores the closing of its terminal, for
    example one started by `nohup`, continues to ignore it.

    Args:
        compiles: True if a signal may end the process immediately during a compilation. The
            caller must then have nothing to finish at that time.

    Attributes:
        number: Number of the first signal. 0 if no signal has arrived.
        compiles: Value of the argument `compiles`.
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
        # The signal that ends this block is also recorded in an enclosing `Interrupt`.
        outer = getattr(self._before.get(signal.SIGINT), "__self__", None)
        if kind is KeyboardInterrupt and isinstance(outer, Interrupt):
            outer.number = outer.number or self.number

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        """Records a signal that requests the end of the program, such as SIGINT (Ctrl-C).

        The first signal requests a clean shutdown. A second Ctrl-C requests an immediate end,
        for users who do not want to wait. Two signals in quick succession count as one request,
        because a terminal and a parent process may both deliver the same signal.

        Args:
            number: Number of the signal.

        Raises:
            KeyboardInterrupt: The signal arrived in a `with` block of `raising`.
        """
        self.number = self.number or number
        # When a terminal closes, the terminal and its shell each send SIGHUP. The second one
        # does not count as a repetition.
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
        """Context manager in which a signal raises KeyboardInterrupt, to interrupt long work.

        Intended for work that does not check for signals regularly. Python discards exceptions
        raised within a `__del__` method. If this happens, the exception is raised again at the
        end of the block.
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
        """Exit code of a process ended by the first signal, following shell conventions.

        The code is 128 plus the number of the signal.
        """
        return 128 + self.number


def end_process_at_signals() -> Callable[[], None]:
    """Makes signals end this process immediately, if the current `Interrupt` allows it.

    Python handles signals only between bytecode instructions. A single call of the compiler may
    take minutes, during which Ctrl-C would have no effect. The operating system's default
    action, which ends the process, is therefore restored. The first process of a container (PID
    1) has no default action, so a thread ends that process.

    Returns:
        A function that restores the signal handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        # Python permits only the main thread to change handlers.
        return lambda: None

    replaced = {}
    for number in ENDING_SIGNALS:
        handler = signal.getsignal(number)
        interrupt = getattr(handler, "__self__", None)  # handlers are methods of an `Interrupt`
        if _may_interrupt(interrupt):
            replaced[number] = handler

    is_first_process = bool(replaced) and os.getpid() == 1
    for number in replaced:
        signal.signal(number, _exit_by_signal if is_first_process else signal.SIG_DFL)
    unwatch = _watch_signals() if is_first_process else lambda: None

    def restore() -> None:
        """Restores the previous signal handlers, so that loops can check for signals again."""
        unwatch()
        for number, handler in replaced.items():
            signal.signal(number, handler)

    return restore


def _exit_by_signal(number: int, _frame: FrameType | None) -> None:
    """Ends the process immediately with the exit code 128 + number, as shells do.

    Used as the signal handler during compilation in the first process of a container.
    """
    os._exit(128 + number)


def _watch_signals() -> Callable[[], None]:
    """Starts a thread that ends the process as soon as a termination signal arrives.

    Python's signal handler in C writes the number of each signal into a pipe
    (`signal.set_wakeup_fd`). Since the thread reads from this pipe, it works even while the
    main thread is inside the compiler.

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
        """Ends the process as soon as a termination signal arrives.

        Runs in a separate thread. Python writes the number of each signal into a pipe, from
        which this function reads until `unwatch` closes the pipe.
        """
        with os.fdopen(reader, "rb", 0) as pipe:
            while data := pipe.read(1):  # a byte with the number of the signal
                number = data[0]
                if number in ENDING_SIGNALS:
                    os._exit(128 + number)

    def unwatch() -> None:
        """Ends the thread that waits for signals by closing its pipe."""
        signal.set_wakeup_fd(previous_descriptor)
        os.close(writer)

    threading.Thread(target=wait, daemon=True).start()
    return unwatch


def _may_interrupt(owner: object) -> bool:
    """Returns True if a signal may interrupt the current work of the process.

    This is decided by the object that handles the signal.

    Args:
        owner: Object whose method handles the signal. None if the handler is a plain function.
    """
    return isinstance(owner, Interrupt) and (owner.raises or owner.compiles)


@contextmanager
def hold_sigint() -> Iterator[None]:
    """Delays Ctrl-C inside the `with` block, and shields processes started in it from Ctrl-C.

    The signal is blocked, and the started processes inherit the signal mask. The mask alone
    does not delay Ctrl-C in this process: another thread may receive the signal, and Python
    then runs the handler in the main thread. The handler is therefore also replaced.
    """
    is_main_thread = threading.current_thread() is threading.main_thread()
    # Windows has no signal masks, and only the main thread may change handlers.
    if sys.platform == "win32" or not is_main_thread:
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

"""Signals that ask a process to end, as a value that its loop looks at.

Law: a signal ends nothing by itself; whoever loops looks, and ends in order.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any


class Interrupt:
    """Remembers the first SIGINT or SIGTERM; a context, which puts things back as they were.

    Attributes:
        number: that signal, or 0.
    """

    def __init__(self) -> None:
        self.number = 0
        self._before: dict[int, Any] = {}
        self._raises = False

    def __enter__(self) -> "Interrupt":
        for name in (signal.SIGINT, signal.SIGTERM):
            self._before[name] = signal.signal(name, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name, handler in self._before.items():
            signal.signal(name, handler)

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.number = self.number or number
        if self._raises:
            raise KeyboardInterrupt

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Lets a signal break off the block at once: for long work that looks at nothing.

        Python passes over what is raised inside a `__del__`; then the block is left at its end.
        """
        self._raises = True
        try:
            yield
        finally:
            self._raises = False
        if self.requested():
            raise KeyboardInterrupt

    def requested(self) -> bool:
        """True once a signal has come."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """What a process ends with that was ended by the signal, by the shell's custom."""
        return 128 + self.number

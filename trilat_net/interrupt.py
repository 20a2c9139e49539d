"""Signals that ask a process to end, as a value that its loop looks at.

Law: a signal ends nothing by itself; whoever loops looks, and ends in order.
"""

import signal
from types import FrameType


class Interrupt:
    """Remembers the first SIGINT or SIGTERM.

    Attributes:
        number: that signal, or 0.
    """

    def __init__(self) -> None:
        self.number = 0

    def install(self) -> "Interrupt":
        """Begins to take the signals of this process, and returns itself."""
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, self._take)
        return self

    def _take(self, number: int, _frame: FrameType | None) -> None:
        self.number = self.number or number

    def requested(self) -> bool:
        """True once a signal has come."""
        return self.number != 0

    @property
    def exit_code(self) -> int:
        """What a process ends with that was ended by the signal, by the shell's custom."""
        return 128 + self.number

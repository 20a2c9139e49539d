"""Prints lines in a thread of its own, so that a control loop never waits for the terminal.

A terminal may block a program that prints, for example while its user has paused the output.
The control loop of an arm must not stop for that.
"""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress


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
        """Queues a line that another thread prints, without waiting for the terminal.

        A control loop must not wait for a slow terminal. The line is lost if too many lines
        wait already.

        Args:
            text: The line.
        """
        with suppress(queue.Full):
            self._lines.put_nowait(text)

    def _print_lines(self) -> None:
        """Prints the queued lines in the printer's thread, until the queue returns None.

        Errors of the output, for example a closed pipe, do not end the session.
        """
        while (text := self._lines.get()) is not None:
            with suppress(OSError):
                self._print_line(text)

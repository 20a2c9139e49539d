"""What was handed to the operating system is put onto the disk: so that a loss of power loses little.

Law: whoever writes does not wait for a slow disk, unless it was asked to.
"""

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

SYNC_NS = 1_000_000_000
"""How often, where it is not at once."""


class Syncing:
    """The syncing of one file.

    Args:
        descriptor: the file's.
        durable: at once, each time; else once a second, in a thread beside.
        now_ns: the time.
    """

    def __init__(self, descriptor: int, durable: bool, now_ns: Callable[[], int]) -> None:
        self._descriptor, self._durable, self._now_ns = descriptor, durable, now_ns
        self._done_ns = now_ns()
        self._beside: threading.Thread | None = None
        self._trouble: OSError | None = None

    def due(self) -> None:
        """Is called when there is something new; puts it onto the disk, or sees to it.

        Raises:
            OSError: the disk refuses now, or refused what was there before.
        """
        if self._durable:
            _datasync(self._descriptor)
            return
        if self._trouble is not None:
            raise self._trouble
        now_ns = self._now_ns()
        if now_ns - self._done_ns >= SYNC_NS and not (self._beside and self._beside.is_alive()):
            self._done_ns = now_ns
            self._beside = threading.Thread(target=self._run, name="sync", daemon=True)
            self._beside.start()

    def _run(self) -> None:
        try:
            _datasync(self._descriptor)
        except OSError as error:
            self._trouble = error

    def wait(self) -> None:
        """Returns once nothing is under way beside; after it the file may be closed."""
        if self._beside is not None:
            self._beside.join()


def _datasync(descriptor: int) -> None:
    """Puts a file's content onto the disk, and as much of what is known of it as reading it back needs."""
    getattr(os, "fdatasync", os.fsync)(descriptor)


def sync_folder(folder: Path) -> None:
    """Puts a folder's names onto the disk, where such a thing is possible."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

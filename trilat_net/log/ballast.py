"""Room that is kept on a disk, to be given up when the disk is full: so that a file can still be finished.

Law: it is no more than room. Nobody sees it, it never outlives the process, and a disk on which there can be
none does without.
"""

import errno
import os
import tempfile
from pathlib import Path
from typing import BinaryIO

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""What a disk says that takes no more."""
STEP_BYTES = 1 << 19
"""It grows by this."""


class Ballast:
    """A file without a name.

    Args:
        folder: where it lies, on the disk that it keeps room on.

    Attributes:
        size: how much room it keeps, bytes.
    """

    def __init__(self, folder: Path) -> None:
        self.size = 0
        self._folder = folder
        self._file: BinaryIO | None = None
        self._possible = True

    def grow(self, size: int) -> None:
        """Keeps room for `size` bytes at least.

        Raises:
            OSError: the disk has no room for it.
        """
        if not self._possible or size <= self.size:
            return
        wanted = -(-size // STEP_BYTES) * STEP_BYTES
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            _allocate(self._file.fileno(), self.size, wanted)
        except OSError as error:
            if error.errno in FULL:
                raise
            self.release()  # no such thing on this disk
        else:
            self.size = wanted

    def release(self) -> None:
        """Gives the room back, for good."""
        self._possible = False
        self.size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _allocate(descriptor: int, begin: int, end: int) -> None:
    """Makes a file that long, with every block of it on the disk."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, begin, end - begin)
            return
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                raise
    os.lseek(descriptor, begin, os.SEEK_SET)
    written = 0
    while written < end - begin:
        written += os.write(descriptor, bytes(end - begin - written))

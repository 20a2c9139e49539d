"""What of a sweep is done, written down run by run.

Law: a line that is there was whole when it was written, or its checksum tells; whatever ends a process, and
when, loses no line that was written before and spoils none that is written after.
"""

import errno
import json
import os
import shlex
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from ..errors import LogRefused
from .cell import Entry

JOURNAL = "cells.journal"

Key = tuple[int, int]
"""A run: cell and seed."""


class Journal:
    """The runs that are done, in a file that is only ever appended to; a context, which closes it.

    Args:
        path: the file; made where there is none.
        sweep: what names the sweep: lines of another one count for nothing.

    Attributes:
        done: the runs, by cell and seed.
    """

    def __init__(self, path: Path, sweep: str) -> None:
        self._path, self._sweep = path, sweep
        self.done: dict[Key, Entry] = {}
        before = path.read_bytes() if path.exists() else b""
        for entry in _entries(before, sweep):
            self.done.setdefault((entry.cell, entry.seed), entry)
        self._file = path.open("ab", buffering=0)
        if before and not before.endswith(b"\n"):  # a line that was torn stays torn, by itself
            self._put(b"\n")

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        os.fsync(self._file.fileno())
        self._file.close()

    def add(self, entry: Entry) -> None:
        """Writes one run down, at once; one that is there already changes nothing.

        Raises:
            LogRefused: the disk refused it.
        """
        if (entry.cell, entry.seed) in self.done:
            return
        self._put(line(entry, self._sweep))
        self.done[entry.cell, entry.seed] = entry

    def _put(self, data: bytes) -> None:
        try:
            written = self._file.write(data)
        except OSError as error:
            raise not_written(self._path, error) from None
        if written != len(data):  # a disk that became full takes a part, and says nothing
            raise not_written(self._path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))


def not_written(path: Path, error: OSError) -> LogRefused:
    """Returns what is said of a file of a sweep that the disk refused."""
    return LogRefused(
        f"{path}: cannot be written: {error.strerror}; what is done is kept: make room, and go on with: "
        f"trilat sweep --resume {shlex.quote(str(path.parent))}"
    )


def line(entry: Entry, sweep: str) -> bytes:
    """Returns the line of a run: JSON, a tab, and the CRC-32 of sweep and JSON in hexadecimal digits."""
    text = json.dumps(msgspec.to_builtins(entry), separators=(",", ":")).encode()
    return b"%s\t%08x\n" % (text, _checksum(text, sweep))


def _checksum(text: bytes, sweep: str) -> int:
    return zlib.crc32(text, zlib.crc32(sweep.encode()))


def _entries(data: bytes, sweep: str) -> Iterator[Entry]:
    for one in data.split(b"\n"):
        text, tab, digits = one.rpartition(b"\t")
        if tab and digits == b"%08x" % _checksum(text, sweep):
            yield msgspec.convert(_plain(text), Entry)


def _plain(text: bytes) -> Any:
    return json.loads(text)  # unlike msgspec it knows infinity

"""The journal of a study: a line per finished run, in a file that is only ever appended to.

A line is JSON, a tab, and the CRC-32 of study and JSON in hexadecimal digits.

Invariant: by that checksum a torn line is ignored, and so is one of another study; a process that dies at any
moment loses no earlier line and spoils no later one.
"""

import errno
import json
import os
import zlib
from collections.abc import Hashable
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import msgspec

from ..files import describe_write_error


class JournalEntry(Protocol):
    """A finished run: a structure of plain values, one per cell and seed."""

    @property
    def cell(self) -> Hashable:
        """What is run."""

    @property
    def seed(self) -> int:
        """With which seed."""


E = TypeVar("E", bound=JournalEntry)


class RunJournal(Generic[E]):
    """The runs that are done; a context, which closes it.

    Args:
        path: the file.
        study: what the runs belong to, as a text.
        kind: the type of its entries.
        remedy: what the error of a full disk advises.

    Attributes:
        done: the runs, by cell and seed; lines of another study count for nothing.
    """

    def __init__(self, path: Path, study: str, kind: type[E], remedy: str) -> None:
        self._path, self._study, self._remedy = path, study, remedy
        self.done: dict[tuple[Any, int], E] = {}
        before = path.read_bytes() if path.exists() else b""
        for line in before.split(b"\n"):
            text, tab, digits = line.rpartition(b"\t")
            if tab and digits == b"%08x" % self._checksum(text):
                entry = msgspec.convert(json.loads(text), kind)  # unlike msgspec, json knows infinity
                self.done.setdefault((entry.cell, entry.seed), entry)
        self._file = path.open("ab", buffering=0)
        if before and not before.endswith(b"\n"):  # a line that was torn stays torn, by itself
            self._put(b"\n")

    def __enter__(self) -> "RunJournal[E]":
        return self

    def __exit__(self, *_: object) -> None:
        os.fsync(self._file.fileno())
        self._file.close()

    def add(self, entry: E) -> None:
        """Writes one run down, at once; one that is there already changes nothing.

        Raises:
            LogRefused: the disk refused it.
        """
        if (entry.cell, entry.seed) in self.done:
            return
        text = json.dumps(msgspec.to_builtins(entry), separators=(",", ":")).encode()
        self._put(b"%s\t%08x\n" % (text, self._checksum(text)))
        self.done[entry.cell, entry.seed] = entry

    def _put(self, data: bytes) -> None:
        try:
            if self._file.write(data) != len(data):  # a disk that became full takes a part, and says nothing
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise describe_write_error(self._path, error, self._remedy) from None

    def _checksum(self, text: bytes) -> int:
        return zlib.crc32(text, zlib.crc32(self._study.encode()))

"""Stores the results of the runs of a study: a journal of the finished runs, and CSV tables.

A study consists of many runs, for example a sweep over parameters. Each finished run is
appended to the journal as one line, so an interrupted study can continue where it stopped. A
line consists of JSON, a tab, and a checksum in hexadecimal digits: the CRC-32 of the string
that identifies the study, followed by the JSON. Existing lines of the journal are never
modified.

Invariant:
    - A torn line or a line of another study has a wrong checksum and is ignored.
    - A process that dies at any moment loses no earlier line and spoils no later line.
    - A run that is in the journal is never repeated.
"""

import csv
import errno
import io
import itertools
import json
import os
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Generic, Protocol, TypeVar

import msgspec

from ..errors import LogRefused, count_nouns, join_arguments
from ..files import describe_write_error, refuse_link
from .executor import Progress, Together, WorkerPool


def _extend_file(path: Path) -> BinaryIO:
    """Opens a file for appending without a buffer, and creates it if it does not exist.

    Without a buffer, a line is in the file as soon as it is written, even if the process is
    killed afterwards.

    Args:
        path: Path of the file.

    Raises:
        UsageError: The path is a symbolic link.
        OSError: The file cannot be opened.
    """
    refuse_link(path)
    # A link that appears after the check is refused by this flag, which Windows lacks.
    no_follow = getattr(os, "O_NOFOLLOW", 0)

    def open_without_following(name: str, flags: int) -> int:
        return os.open(name, flags | no_follow, 0o666)

    return open(path, "ab", buffering=0, opener=open_without_following)


def encode_csv(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = (), *, header: bool = True
) -> str:
    """Converts a table to CSV text.

    `None` becomes an empty field.

    Args:
        rows: The rows, each a mapping from column name to value.
        columns: Column names. If empty, all keys of the rows are used, in order of first
            appearance.
        header: True to begin with a line of column names. When a table is written in pieces,
            only the first piece needs this line.
    """
    stream = io.StringIO()
    all_keys = itertools.chain.from_iterable(rows)
    names = columns or list(dict.fromkeys(all_keys))
    writer = csv.DictWriter(stream, names, extrasaction="ignore", lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


class _JournalEntry(Protocol):
    """Result of a finished run, as a `RunJournal` stores it in a file.

    An entry is a structure of plain values. The cell (combination of settings) and the random
    seed together identify its run.
    """

    @property
    def cell(self) -> Hashable:
        """Identifies the part of the study to which the run belongs.

        An example is the index of a grid point in a parameter sweep. To continue an interrupted
        study, the journal must show which runs of a cell are finished.
        """

    @property
    def seed(self) -> int:
        """Random seed of the run. The runs of one cell differ only in their seeds."""


T = TypeVar("T")
E = TypeVar("E", bound=_JournalEntry)


class _RunKey(msgspec.Struct, frozen=True):
    """Key of one run of a study: its cell (combination of settings) and its random seed.

    Attributes:
        cell: Identifier of the part of the study to which the run belongs.
        seed: Seed of the run's random numbers.
    """

    cell: Any
    seed: int


_KEYS = msgspec.json.Decoder(_RunKey)


def _read_key(text: bytes, kind: type[E]) -> _RunKey:
    """Reads the cell and the seed of the run that a line of the journal describes.

    If possible, the rest of the line is not decoded, because a journal may have many runs.

    Args:
        text: The line without its checksum.
        kind: Type of the entries.
    """
    try:
        return _KEYS.decode(text)
    except msgspec.DecodeError:
        # The module json accepts infinity, and msgspec does not. Entries may derive their cell
        # from several fields.
        entry = msgspec.convert(json.loads(text), kind)
        return _RunKey(entry.cell, entry.seed)


class _StoredRuns(Mapping[tuple[Any, int], E]):
    """Finished runs of a study by cell and seed, which are read from the journal when needed.

    Only the offsets of the lines are in memory, about 120 bytes for each run, so that a study
    may have millions of runs. Runs with the same seed are iterated in the order of the lines.

    Args:
        path: Path of the journal.
        kind: Type of the entries.
    """

    def __init__(self, path: Path, kind: type[E]) -> None:
        self._path = path
        self._kind = kind
        self._offsets: dict[int, dict[Any, int]] = {}
        self._file: BinaryIO | None = None

    def add_offset(self, key: _RunKey, offset: int) -> None:
        """Stores the position in the file at which a finished run is recorded.

        If a run occurs twice, the first occurrence counts.

        Args:
            key: Cell and seed of the run.
            offset: Position of the run's line in the file, in bytes.
        """
        self._offsets.setdefault(key.seed, {}).setdefault(key.cell, offset)

    def close(self) -> None:
        """Closes the file with the stored runs. It is reopened when a run is read."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __getitem__(self, key: tuple[Any, int]) -> E:
        cell, seed = key
        offset = self._offsets.get(seed, {})[cell]
        if self._file is None:
            self._file = self._path.open("rb")
        self._file.seek(offset)
        text, _, _ = self._file.readline().rpartition(b"\t")
        # The module json is used, because msgspec does not accept infinity.
        return msgspec.convert(json.loads(text), self._kind)

    def __contains__(self, key: object) -> bool:
        if not isinstance(key, tuple):
            return False
        cell, seed = key
        return cell in self._offsets.get(seed, ())

    def __iter__(self) -> Iterator[tuple[Any, int]]:
        for seed, offsets in self._offsets.items():
            for cell in offsets:
                yield cell, seed

    def __len__(self) -> int:
        return sum(map(len, self._offsets.values()))


class RunJournal(Generic[E]):
    """A file to which a study appends the result of each run as soon as it has finished.

    A sweep may take hours. If it is interrupted, it can continue from this file without
    repeating finished runs. The journal is a context manager that closes the file on exit.

    Args:
        path: Path of the file. Existing lines are read.
        study: String that identifies the study, such as the digest of its plan.
        kind: Type of the entries.
        remedy: Advice for the error message if the disk is full.

    Attributes:
        done: Finished runs, keyed by cell and seed. Lines of other studies are ignored.
    """

    def __init__(self, path: Path, study: str, kind: type[E], remedy: str) -> None:
        self._path = path
        self._study = study
        self._remedy = remedy
        self.done: _StoredRuns[E] = _StoredRuns(path, kind)

        # Read the runs that an interrupted study has stored already.
        offset = 0
        is_torn = False
        if path.exists():
            with path.open("rb") as stream:
                for line in stream:
                    text, tab, digits = line.removesuffix(b"\n").rpartition(b"\t")
                    if tab and digits == b"%08x" % self._checksum(text):
                        self.done.add_offset(_read_key(text, kind), offset)
                    offset += len(line)
                    is_torn = not line.endswith(b"\n")

        self._file = _extend_file(path)
        if is_torn:
            # The last line is torn. It is ended here, so that it does not spoil the next one.
            self._write(b"\n")

    @staticmethod
    def build_resume_hint(*arguments: str) -> str:
        """Returns a sentence on how to continue a study after the disk was full.

        Args:
            arguments: Arguments of the command that continues the study.
        """
        command = join_arguments(["trilat", *arguments])
        return f"finished runs are kept: make room, and continue with: {command}"

    def __enter__(self) -> "RunJournal[E]":
        return self

    def __exit__(self, *_: object) -> None:
        os.fsync(self._file.fileno())
        self._file.close()
        self.done.close()

    def add(self, entry: E) -> None:
        """Writes the result of a finished run to the journal file immediately.

        The run is then not lost if the study is interrupted. A run that is already in the
        journal is ignored.

        Args:
            entry: Result of the run.

        Raises:
            LogRefused: The disk is full.
        """
        if (entry.cell, entry.seed) in self.done:
            return

        values = msgspec.to_builtins(entry)
        text = json.dumps(values, separators=(",", ":")).encode()
        checksum = self._checksum(text)
        line = b"%s\t%08x\n" % (text, checksum)
        self._write(line)

        offset = self._file.tell() - len(line)
        self.done.add_offset(_RunKey(entry.cell, entry.seed), offset)

    def run_pending(
        self,
        pool: WorkerPool,
        run: Callable[[T], E],
        tasks: Iterable[T],
        done: int,
        total: int,
        show: Progress | None,
        together: Together[T, E] | None = None,
        together_count: int = 1,
        note: Callable[[E], None] | None = None,
    ) -> None:
        """Executes the unfinished runs of a study in parallel, storing each one when it ends.

        An interrupted study therefore loses only the runs in progress.

        Args:
            pool: Workers that execute the runs.
            run: Function that executes the run of a task.
            tasks: Tasks of the pending runs, at most `total - done`.
            done: Number of runs finished so far.
            total: Total number of runs.
            show: Function that is called with the number of finished runs and `total`, if any.
            together: Function that executes the runs of several tasks at once.
            together_count: Number of tasks to pass to `together`.
            note: Function that is called with each run after it was written.

        Raises:
            LogRefused: The disk is full. The message states how many runs are finished.
        """
        results = pool.iterate_results(
            run,
            tasks,
            count=total - done,
            together=together,
            together_count=together_count,
        )
        for number, (_, entry) in enumerate(results, done + 1):
            try:
                self.add(entry)
            except LogRefused as error:
                progress = f"{number - 1} of {count_nouns(total, 'run')} had finished"
                raise LogRefused(f"{error}; {progress}") from None

            if note is not None:
                note(entry)
            if show is not None:
                show(number, total)

    def _write(self, data: bytes) -> None:
        """Appends bytes to the journal, the file with the finished runs of a study.

        Args:
            data: The bytes.

        Raises:
            LogRefused: The disk is full.
        """
        try:
            # On a full disk, write() returns a smaller number of bytes without an error.
            written = self._file.write(data)
            if written != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise describe_write_error(self._path, error, self._remedy) from None

    def _checksum(self, text: bytes) -> int:
        """Returns the CRC-32 of the study's identification and the text of a line."""
        study_checksum = zlib.crc32(self._study.encode())
        return zlib.crc32(text, study_checksum)

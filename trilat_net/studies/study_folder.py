"""The folder of a study: its plan, and a journal with one line per finished run.

A line of the journal is JSON, a tab, and the CRC-32 of study and JSON in hexadecimal digits.
The journal is only appended to.

Invariant:
    - A torn line, and a line of another study, has a wrong checksum and is ignored.
    - A process that dies at any moment loses no earlier line and spoils no later line.
    - A run that is in the journal is never repeated.
"""

import csv
import errno
import io
import json
import os
import zlib
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import msgspec
import tomli_w

from ..core.fingerprint import compute_fingerprint
from ..errors import ScenarioError
from ..files import describe_write_error, extend_file
from ..log.log_layout import collect_provenance
from ..process import join_arguments
from ..scenario.imported_code import name_law_classes
from .executor import Progress, WorkerPool


def format_command(*arguments: str) -> str:
    """Returns a command line of the program with these arguments."""
    return join_arguments(["trilat", *arguments])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns the arguments --set KEY=VALUE of a command for overrides KEY=VALUE."""
    arguments = []
    for text in overrides:
        arguments += ["--set", text]
    return arguments


def format_toml_value(value: Any) -> str:
    """Returns a value as TOML on one line, with numbers as short as possible.

    Raises:
        ScenarioError: TOML has no such value.
    """
    value = name_law_classes(value)
    if isinstance(value, Mapping):
        entries = [f"{key} = {format_toml_value(entry)}" for key, entry in value.items()]
        return f"{{{', '.join(entries)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml_value, value))}]"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    try:
        return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")
    except TypeError:
        raise ScenarioError(
            f"{value!r:.80} is no value of a scenario: scenarios have values of TOML"
        ) from None


_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")


def describe_program() -> tuple[str, dict[str, str]]:
    """Returns the fingerprint of the arithmetic and the versions of the computing packages.

    Results depend on both.
    """
    provenance = collect_provenance()
    return compute_fingerprint(), {name: provenance[name] for name in _VERSIONS}


def build_resume_hint(*arguments: str) -> str:
    """Returns a hint how to continue a study that a full disk interrupted."""
    command = format_command(*arguments)
    return f"finished runs are kept: make room, and continue with: {command}"


def encode_csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Returns rows as CSV with a header; None becomes an empty field.

    Args:
        rows: the rows.
        columns: the columns; empty: all keys of the rows, in their order.
    """
    stream = io.StringIO()
    header = columns or list(dict.fromkeys(key for row in rows for key in row))
    writer = csv.DictWriter(stream, header, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


class JournalEntry(Protocol):
    """A finished run: a structure of plain values, one per cell and seed."""

    @property
    def cell(self) -> Hashable:
        """The cell of the run."""

    @property
    def seed(self) -> int:
        """The seed of the run."""


P = TypeVar("P")
T = TypeVar("T")
E = TypeVar("E", bound=JournalEntry)


class RunJournal(Generic[E]):
    """The finished runs of a study; a context manager that closes the file.

    Args:
        path: the file.
        study: text that identifies the study.
        kind: the type of the entries.
        remedy: advice in the error for a full disk.

    Attributes:
        done: the finished runs, by cell and seed; lines of another study are ignored.
    """

    def __init__(self, path: Path, study: str, kind: type[E], remedy: str) -> None:
        self._path = path
        self._study = study
        self._remedy = remedy
        self.done: dict[tuple[Any, int], E] = {}
        content = path.read_bytes() if path.exists() else b""
        for line in content.split(b"\n"):
            text, tab, digits = line.rpartition(b"\t")
            if tab and digits == b"%08x" % self._checksum(text):
                # json and not msgspec, because it accepts infinity
                entry = msgspec.convert(json.loads(text), kind)
                self.done.setdefault((entry.cell, entry.seed), entry)
        self._file = extend_file(path)
        if content and not content.endswith(b"\n"):
            # ends the torn line, so that it does not spoil the next one
            self._write(b"\n")

    def __enter__(self) -> "RunJournal[E]":
        return self

    def __exit__(self, *_: object) -> None:
        os.fsync(self._file.fileno())
        self._file.close()

    def add(self, entry: E) -> None:
        """Writes a run to the file at once; ignores a run that the journal has already.

        Raises:
            LogRefused: the disk is full.
        """
        if (entry.cell, entry.seed) in self.done:
            return
        text = json.dumps(msgspec.to_builtins(entry), separators=(",", ":")).encode()
        self._write(b"%s\t%08x\n" % (text, self._checksum(text)))
        self.done[entry.cell, entry.seed] = entry

    def run_pending(
        self,
        pool: WorkerPool,
        run: Callable[[T], E],
        tasks: Iterable[T],
        done: int,
        total: int,
        show: Progress,
    ) -> None:
        """Executes the pending runs of a study, and writes each to the file as it ends.

        Args:
            pool: the workers.
            run: executes the run of a task.
            tasks: the pending tasks, at most `total - done`.
            done: number of finished runs.
            total: number of all runs.
            show: called with the number of finished runs and `total`.
        """
        results = pool.iterate_results(run, tasks, count=total - done)
        for number, (_, entry) in enumerate(results, done + 1):
            self.add(entry)
            show(number, total)

    def _write(self, data: bytes) -> None:
        """Appends bytes to the file, or raises LogRefused."""
        try:
            # on a full disk, write() returns the number of written bytes without an error
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise describe_write_error(self._path, error, self._remedy) from None

    def _checksum(self, text: bytes) -> int:
        """Returns the CRC-32 of the study and a line's text."""
        return zlib.crc32(text, zlib.crc32(self._study.encode()))


class StudyFolder(NamedTuple, Generic[P, E]):
    """The folder of a study.

    Attributes:
        path: path of the folder.
        plan: the plan of the study.
        facts: identification of the study, its arithmetic, and the package versions.
        remedy: advice in the error for a full disk.
        journal: function that opens the journal.
    """

    path: Path
    plan: P
    facts: Mapping[str, Any]
    remedy: str
    journal: Callable[[], RunJournal[E]]

    def read_done(self) -> list[tuple[Any, int]]:
        """Returns the cells and seeds of the finished runs."""
        with self.journal() as journal:
            return list(journal.done)

"""The folder of a study: its plan, and the journal with a line per finished run, which is only
appended to.

A line is JSON, a tab, and the CRC-32 of study and JSON in hexadecimal digits.

Invariant: by that checksum a torn line is ignored, and so is one of another study; a process
that dies at any moment loses no earlier line and spoils no later one. A run that is in the
journal is never made again.
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


def format_command(*words: str) -> str:
    """Returns a command of the program."""
    return join_arguments(["trilat", *words])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns overrides, as texts KEY=VALUE, as options of a command."""
    return [word for text in overrides for word in ("--set", text)]


def format_toml_value(value: Any) -> str:
    """Returns a value as TOML on one line; numbers as short as they can be."""
    value = name_law_classes(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {format_toml_value(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml_value, value))}]"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    try:
        return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")
    except TypeError:
        raise ScenarioError(
            f"{value!r:.80} is no value of a scenario: those are of TOML"
        ) from None


_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")


def describe_program() -> tuple[str, dict[str, str]]:
    """Returns the arithmetic, and the versions of what computes: results depend on both."""
    known = collect_provenance()
    return compute_fingerprint(), {name: known[name] for name in _VERSIONS}


def build_resume_hint(*words: str) -> str:
    """Returns how a command goes on with a study that the disk interrupted."""
    return f"what is done is kept: make room, and go on with: {format_command(*words)}"


def encode_csv(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """Returns rows as CSV with a line of heads: these columns, else all that rows have; None is
    empty.
    """
    stream = io.StringIO()
    heads = columns or list(dict.fromkeys(key for row in rows for key in row))
    writer = csv.DictWriter(stream, heads, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


class JournalEntry(Protocol):
    """A finished run: a structure of plain values, one per cell and seed."""

    @property
    def cell(self) -> Hashable:
        """What is run."""

    @property
    def seed(self) -> int:
        """With which seed."""


P = TypeVar("P")
T = TypeVar("T")
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
        self._path = path
        self._study = study
        self._remedy = remedy
        self.done: dict[tuple[Any, int], E] = {}
        before = path.read_bytes() if path.exists() else b""
        for line in before.split(b"\n"):
            text, tab, digits = line.rpartition(b"\t")
            if tab and digits == b"%08x" % self._checksum(text):
                # unlike msgspec, json knows infinity
                entry = msgspec.convert(json.loads(text), kind)
                self.done.setdefault((entry.cell, entry.seed), entry)
        self._file = extend_file(path)
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

    def run_pending(
        self,
        pool: WorkerPool,
        run: Callable[[T], E],
        tasks: Iterable[T],
        done: int,
        total: int,
        show: Progress,
    ) -> None:
        """Makes the runs of a study that are left, and writes each down as it ends.

        Args:
            pool: makes them.
            run: makes the run of a task.
            tasks: those that are left, `total - done` at most.
            done: how many runs there are already.
            total: how many there will be.
            show: called with the runs that are done, and their number.
        """
        for number, (_, entry) in enumerate(
            pool.each(run, tasks, count=total - done), done + 1
        ):
            self.add(entry)
            show(number, total)

    def _put(self, data: bytes) -> None:
        try:
            # a disk that became full takes a part, and says nothing
            if self._file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise describe_write_error(self._path, error, self._remedy) from None

    def _checksum(self, text: bytes) -> int:
        return zlib.crc32(text, zlib.crc32(self._study.encode()))


class StudyFolder(NamedTuple, Generic[P, E]):
    """The folder of a study.

    Attributes:
        path: where it is.
        plan: what is asked of it.
        facts: what names the study, its arithmetic, and the versions it is made with.
        remedy: what the error of a full disk advises.
        journal: opens the journal.
    """

    path: Path
    plan: P
    facts: Mapping[str, Any]
    remedy: str
    journal: Callable[[], RunJournal[E]]

    def read_done(self) -> list[tuple[Any, int]]:
        """Returns the cells and seeds of the runs that are done."""
        with self.journal() as journal:
            return list(journal.done)

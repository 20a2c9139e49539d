"""A log in one file, or in parts: `run-001.mcap`, `run-002.mcap`, ...

Law: a message is in one part, whole, and the parts one behind the other are what one file would be. Every
part explains itself: session, scenario and schemas are repeated, and it names the part before it. The file
changes between two messages, on the thread that writes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from ..core.tick import Output
from ..errors import LogRefused, UsageError
from ..net.messages import Event, LinkStats, State
from .choice import ALL, Choice
from .container import Sink
from .logfile import LogFile, refuse_existing
from .names import ACTIVE, active, existing, part_path
from .writer import LogWriter

ACCOUNTS_BYTES = 16 << 10
"""Room that the accounts of a part may take, and the views that go with one message."""


@dataclass(frozen=True, slots=True)
class Storage:
    """Where a log goes, and how.

    Attributes:
        path: its name; parts add their number to it.
        force: whether it may replace what exists.
        durable: whether every flush puts it onto the disk.
        split_bytes: no part is longer than this.
        split_ns: nor does one take messages over a longer time.
        carry_on: where there is a log of that name, finished or not, write the part after it.
        choice: which channels it takes.
        views_hz: messages a second of the standard channels beside its own, see `views`; 0 for none.
    """

    path: Path
    force: bool = False
    durable: bool = False
    split_bytes: int | None = None
    split_ns: int | None = None
    carry_on: bool = False
    choice: Choice = ALL
    views_hz: float = 0.0

    @property
    def splits(self) -> bool:
        """Whether it is to have parts from the start."""
        return self.split_bytes is not None or self.split_ns is not None

    def first(self) -> tuple[int, str]:
        """Returns the number of the part to begin with, 0 for a log without parts; and which is before it.

        Raises:
            UsageError: the name is taken, and not just one of `force` and `carry_on` is given.
        """
        if self.carry_on and self.force:
            raise UsageError("--continue keeps what exists, --force replaces it; give one of them")
        there = existing(self.path)
        if self.carry_on and there:
            last = max(there)
            return last + 1, there[last].name.removesuffix(ACTIVE)
        refuse_existing(self.path, active(self.path), force=self.force)
        if self.splits and there and not self.force:
            raise UsageError(
                f"{there[max(there)]}: exists; choose another name, carry on behind it with --continue, or "
                "replace it with --force"
            )
        return int(self.splits), ""


def storage(
    path: Path,
    *,
    split_mib: float | None,
    split_s: float | None,
    choice: Choice,
    force: bool,
    carry_on: bool,
    durable: bool,
    views_hz: float = 0.0,
) -> Storage:
    """Returns what a person asks for; see `Storage`.

    Raises:
        UsageError: a part cannot be that small or that large.
    """
    if split_mib is not None and not 1.0 <= split_mib <= 1e6:
        raise UsageError(f"--split-size is a number of MiB from 1 to 1e6, not {split_mib:g}")
    if split_s is not None and not 1.0 <= split_s <= 1e6:
        raise UsageError(f"--split-duration is a number of seconds from 1 to 1e6, not {split_s:g}")
    return Storage(
        path,
        force=force,
        durable=durable,
        split_bytes=None if split_mib is None else int(split_mib * (1 << 20)),
        split_ns=None if split_s is None else int(split_s * 1e9),
        carry_on=carry_on,
        choice=choice,
        views_hz=views_hz,
    )


class LogParts:
    """A `LogWriter` over as many files as it takes; to be used in a `with` statement.

    Args:
        storage: where it goes.
        begin: begins the log in a file; told what to say of the part, nothing of a log without parts.
        opened: opens a file by name; else `LogFile`.

    Attributes:
        so_far: the accounts, to stand in a part that is full.

    Raises:
        UsageError: the name is taken, or the file cannot be made.
        LogRefused: the disk refused.
    """

    def __init__(
        self,
        storage: Storage,
        begin: Callable[[Sink, Mapping[str, str]], LogWriter],
        opened: Callable[[Path], LogFile] | None = None,
    ) -> None:
        self.so_far: Callable[[], Mapping[str, str]] = dict
        self._storage, self._begin_log = storage, begin
        self._opened = opened or self._open_file
        self._number, self._previous = storage.first()
        if storage.force and storage.splits:
            _remove(storage.path)
        self._since_ns: int | None = None
        self._before_bytes = 0
        self._begin()

    def _open_file(self, path: Path) -> LogFile:
        return LogFile(path, force=self._storage.force, durable=self._storage.durable)

    def _begin(self) -> None:
        """Begins a part."""
        path = part_path(self._storage.path, self._number)
        part = {"index": str(self._number), "previous": self._previous} if self._number else {}
        self._file = file = self._opened(path)
        try:
            self._writer = self._begin_log(file, part)
        except LogRefused as error:
            file.discard()
            raise (error if file.trouble is None else file.refused(file.trouble)) from None
        self._since_ns = None
        self._previous = path.name

    def _roll(self) -> None:
        """Ends a part and begins the next one."""
        self._writer.finish(self.so_far())
        self._before_bytes += self._writer.written_bytes
        self._close()
        self._number += 1
        try:
            self._begin()
        except UsageError as error:  # the caller's no more: the disk took the parts before
            raise LogRefused(f"{error}; the log ends with {self._previous}") from None

    def _full(self, payload: bytes, log_time_ns: int) -> bool:
        """True where a message belongs into the next part."""
        limit, writer = self._storage, self._writer
        if limit.split_ns is not None:
            if self._since_ns is None:
                self._since_ns = log_time_ns
            elif log_time_ns - self._since_ns >= limit.split_ns:
                return True
        return (
            limit.split_bytes is not None
            and writer.messages > 0
            and writer.most_bytes + len(payload) + ACCOUNTS_BYTES > limit.split_bytes
        )

    @property
    def path(self) -> Path:
        """Name of the file that is being written, once it is whole."""
        return self._file.path

    @property
    def written_bytes(self) -> int:
        """How many bytes all parts have so far."""
        return self._before_bytes + self._writer.written_bytes

    @property
    def ended(self) -> bool:
        """True once nothing more can be added: it is finished, or the disk has refused."""
        return self._writer.ended

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: State | Output | LinkStats | Event | None = None,
    ) -> None:
        """Writes one message; see `LogWriter.add`."""
        if self._storage.splits and not self._writer.ended and self._full(payload, log_time_ns):
            self._roll()
            self._since_ns = log_time_ns
        self._writer.add(key, payload, t_ns, log_time_ns, number, message)

    def flush(self) -> None:
        """Hands everything so far to the operating system; see `LogWriter.flush`."""
        self._writer.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Ends the last part; see `LogWriter.finish`."""
        self._writer.finish(accounts)

    def _close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            raise self._file.refused(self._file.trouble or error) from None

    def __enter__(self) -> "LogParts":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Closes the last part, and says what is kept where the disk refused."""
        self._close()
        if isinstance(error, LogRefused) and self._file.trouble is not None:
            raise self._file.refused(self._file.trouble) from None


def _remove(path: Path) -> None:
    """Removes a log that is replaced, and all its parts: what was left of them would seem to belong to it."""
    for name in (path, *(part_path(path, number) for number in existing(path))):
        name.unlink(missing_ok=True)
        active(name).unlink(missing_ok=True)

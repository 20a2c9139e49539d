"""A log's file while it is written: `run.mcap.active` first, `run.mcap` once it is whole.

Law: what was flushed survives the death of the process, and what was synced that of the machine. The name of
a finished log stands on nothing else, and nothing that exists is replaced unasked. Where the disk is full the
file ends in order, with all that was given to it.
"""

import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from ..errors import LogRefused, UsageError
from ..net import topics
from ..net.clock import SystemClock
from .ballast import Ballast
from .container import MAGIC
from .names import active
from .syncing import Syncing, sync_folder

MARGIN_BYTES = 1 << 16
"""Room that is kept for the accounts."""
_ELSEWHERE = "take another disk with -o"
_ADVICE = {
    errno.ENOSPC: ("the disk is full", f"make room, or {_ELSEWHERE}"),
    errno.EDQUOT: ("your quota of the disk is used up", f"make room, or {_ELSEWHERE}"),
    errno.EFBIG: ("the file system takes no longer file", "split the log, as in --split-size 1000"),
    errno.EIO: ("the disk fails", _ELSEWHERE),
    errno.EROFS: ("the disk has become read-only", _ELSEWHERE),
}


class Room(Protocol):
    """What keeps room on the disk, see `Ballast`."""

    def grow(self, size: int) -> None:
        """Keeps room for so many bytes."""

    def release(self) -> None:
        """Gives it back."""


def refuse_existing(path: Path, working: Path, *, force: bool) -> None:
    """Refuses a name that is taken.

    Raises:
        UsageError: the log exists, or one that was not finished; or it is no file at all.
    """
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        raise UsageError(f"{path}: exists, and is no file; choose another name")
    if force:
        return
    if path.exists():
        raise UsageError(f"{path}: exists; choose another name, or replace it with --force")
    if working.exists():
        raise UsageError(
            f"{working}: exists: it is being written, or was never finished; make it whole with: trilat log "
            f"recover {working}; or choose another name, or replace it with --force"
        )


class LogFile:
    """A file that is written in order and survives whatever ends that.

    What is written stays in memory until `flush`, so that the file always ends where a flush ended.

    Args:
        path: its name once it is whole.
        force: whether it may replace what exists.
        durable: whether every flush puts it onto the disk; else that happens once a second, beside.
        working: its name until then; by default `active(path)`.
        room: what keeps room for its end; by default a `Ballast` beside it.
        opened: opens a file without a buffer, by name and mode.
        now_ns: the time.

    Attributes:
        path: its name once it is whole.
        working: its name until then.
        size: how many bytes it has; all of them were flushed.
        trouble: what the disk refused first, or None.

    Raises:
        UsageError: it exists, or cannot be made.
    """

    def __init__(
        self,
        path: Path,
        *,
        force: bool = False,
        durable: bool = False,
        working: Path | None = None,
        room: Room | None = None,
        opened: Callable[[Path, str], Any] | None = None,
        now_ns: Callable[[], int] | None = None,
    ) -> None:
        self.path, self.working = path, working or active(path)
        self.size = 0
        self.trouble: OSError | None = None
        self._force = force
        try:
            refuse_existing(path, self.working, force=force)
            self._raw = (opened or _opened)(self.working, "wb" if force else "xb")
        except OSError as error:
            raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
        sync_folder(path.parent)
        self._room = room or Ballast(path.parent)
        self._syncing = Syncing(self._raw.fileno(), durable, now_ns or SystemClock().monotonic_ns)
        self._pending, self._done = bytearray(), 0
        self._owed = 0
        self._tail = b""
        self._broken = self._closed = self._published = False

    def write(self, data: bytes, /) -> int:
        """Takes bytes, to be written by the next `flush`."""
        self._pending += data
        return len(data)

    def reserve(self, size: int) -> None:
        """Is told how many bytes the end of the file will take."""
        self._owed = size

    def flush(self) -> None:
        """Hands everything to the operating system, in one piece where it takes that.

        Raises:
            OSError: the disk refuses. The first time, what was pending has been written all the same if the
                room that was kept for it sufficed. The end of the file may follow, and nothing else.
        """
        if self._broken and self.trouble:
            raise self.trouble
        try:
            if self._pending and not self.trouble:
                self._room.grow(len(self._pending) + self._owed + MARGIN_BYTES)
            self._put()
            if not self.trouble:
                self._syncing.due()
        except OSError as error:
            self.trouble = self.trouble or error
            self._room.release()
            try:
                self._put()
            except OSError:
                self._cut()
            raise

    def _put(self) -> None:
        """Writes what is pending, or the rest of it."""
        while self._done < len(self._pending):
            taken = self._raw.write(memoryview(self._pending)[self._done :])
            if not taken:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            self._done += taken
        self._tail = bytes((self._tail + self._pending[-len(MAGIC) :])[-len(MAGIC) :])
        self.size += self._done
        self._pending, self._done = bytearray(), 0

    def _cut(self) -> None:
        """Takes back what could not be written whole: the file ends where the last flush ended."""
        self._broken = True
        self._pending, self._done = bytearray(), 0
        with suppress(OSError):
            self._raw.truncate(self.size)

    @property
    def whole(self) -> bool:
        """True once the file ends with its end mark."""
        return self._tail == MAGIC and self.size > len(MAGIC) and not self._broken

    def close(self) -> None:
        """Closes the file, and gives it its name if it is whole; what is empty is removed.

        Raises:
            UsageError: its name is taken by now.
            OSError: the disk refuses.
        """
        if self._closed:
            return
        self._closed = True
        self._syncing.wait()
        try:
            if self.whole:
                os.fsync(self._raw.fileno())
        except OSError as error:
            self.trouble = self.trouble or error
            raise
        finally:
            self._raw.close()
            self._room.release()
        if self.whole:
            self._publish()
            self._published = True
        elif not self.size:
            self.working.unlink(missing_ok=True)
        sync_folder(self.path.parent)

    def discard(self) -> None:
        """Closes the file and removes it, whatever is in it."""
        with suppress(OSError):
            self.close()
        self.working.unlink(missing_ok=True)
        self.size = 0

    def _publish(self) -> None:
        if self._force:
            self.working.replace(self.path)
            return
        try:
            os.link(self.working, self.path)  # unlike a renaming it never replaces
            self.working.unlink()
        except FileExistsError:
            raise UsageError(
                f"{self.path}: exists by now; the finished log is {self.working}: give it a name"
            ) from None
        except OSError:  # a file system without links
            refuse_existing(self.path, self.path, force=False)
            self.working.rename(self.path)

    def refused(self, error: OSError) -> LogRefused:
        """Returns what to say of a file that the disk refused, once it is closed."""
        what, advice = _ADVICE.get(error.errno or 0, (error.strerror or str(error), _ELSEWHERE))
        if self._published:
            return LogRefused(
                f"{self.path}: {what}; the log ends there, finished, with {_content(self.path)}; {advice}"
            )
        if not self.size:
            return LogRefused(f"{self.path}: {what}; nothing was written; {advice}")
        return LogRefused(
            f"{self.working}: {what}, even for the end of the log; its {self.size / 1e6:.1f} MB up to the "
            f"last whole chunk are kept; {advice}; make it whole with: trilat log recover {self.working}"
        )


def _opened(path: Path, mode: str) -> Any:
    return path.open(mode, buffering=0)


def _content(path: Path) -> str:
    """Returns what is in a finished file, in words."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topic = {number: channel.topic for number, channel in summary.channels.items()}
    records = sum(count for n, count in counts.items() if topic[n].endswith(f"/{topics.STATE}"))
    return f"{records} records and {summary.statistics.message_count - records} other messages"


@contextmanager
def new_log(path: Path, *, force: bool = False, durable: bool = False) -> Iterator[LogFile]:
    """Opens a log for writing; at the end closes it, and gives it its name if it was finished.

    Args:
        path: its name.
        force: whether it may replace what exists.
        durable: whether every flush puts it onto the disk.

    Raises:
        UsageError: it exists, or cannot be made.
        LogRefused: the disk refused something; says what is kept, and where.
    """
    with closing_log(LogFile(path, force=force, durable=durable)) as file:
        yield file


@contextmanager
def closing_log(file: LogFile) -> Iterator[LogFile]:
    """Closes a log's file at the end, whatever ends it, and says what is kept where the disk refused.

    Raises:
        LogRefused: the disk refused something.
    """
    refused: LogRefused | None = None
    try:
        yield file
    except LogRefused as error:
        refused = error
    finally:
        try:
            file.close()
        except OSError as error:
            raise file.refused(file.trouble or error) from None
    if refused is not None:
        raise (refused if file.trouble is None else file.refused(file.trouble)) from None

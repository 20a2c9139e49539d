"""The file of a log while it is written: `run.mcap.active` first, `run.mcap` once it is
complete.

Invariant: flushed data survives the death of the process, synced data a loss of power. Only a
finished log bears the final name, and nothing is replaced without `force`. Disk space for the
end of the file is reserved, so that a full disk ends the file in order, with all data given to
it. Syncing runs in a thread unless `durable` is set.
"""

import errno
import os
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import IO, Any

from ..errors import LogRefused, UsageError, count_nouns
from ..files import publish_file, refuse_existing, sync_folder
from ..net import topics
from ..net.clock import SystemClock
from .log_layout import active_path
from .mcap_records import MAGIC

DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a disk that takes no more."""
RESERVE_STEP_BYTES = 1 << 19
"""Step by which a reserve grows."""


class DiskReserve:
    """Space reserved on a disk, as a file without a name in a folder there; `size` is its
    length, bytes.
    """

    def __init__(self, folder: Path) -> None:
        self.size = 0
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._possible = True

    def grow(self, size: int) -> None:
        """Reserves so many bytes at least.

        Raises:
            OSError: the disk has no room for it.
        """
        if not self._possible or size <= self.size:
            return
        wanted = -(-size // RESERVE_STEP_BYTES) * RESERVE_STEP_BYTES
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            _allocate(self._file.fileno(), self.size, wanted)
        except OSError as error:
            if error.errno in DISK_FULL_ERRNOS:
                raise
            self.release()  # this disk cannot reserve space
        else:
            self.size = wanted

    def release(self) -> None:
        """Gives the space back, for good."""
        self._possible = False
        self.size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _allocate(descriptor: int, begin: int, end: int) -> None:
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


SYNC_PERIOD_NS = 1_000_000_000
"""Period of syncing in a thread."""


class FileSync:
    """Syncing of one file: at once if `durable`, else once a second in a thread."""

    def __init__(self, descriptor: int, durable: bool, now_ns: Callable[[], int]) -> None:
        self._descriptor = descriptor
        self._durable = durable
        self._now_ns = now_ns
        self._done_ns = now_ns()
        self._thread: threading.Thread | None = None
        self._trouble: OSError | None = None

    def sync_new(self) -> None:
        """Puts new data onto the disk, now or in a thread when it is time.

        Raises:
            OSError: the disk refuses now, or refused earlier data.
        """
        if self._durable:
            _datasync(self._descriptor)
            return
        if self._trouble is not None:
            raise self._trouble
        now_ns = self._now_ns()
        if now_ns - self._done_ns >= SYNC_PERIOD_NS and not (
            self._thread and self._thread.is_alive()
        ):
            self._done_ns = now_ns
            self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        try:
            _datasync(self._descriptor)
        except OSError as error:
            self._trouble = error

    def wait(self) -> None:
        """Waits for the thread; then the file may be closed."""
        if self._thread is not None:
            self._thread.join()


def _datasync(descriptor: int) -> None:
    getattr(os, "fdatasync", os.fsync)(descriptor)  # of the metadata what reading it back needs


RESERVE_MARGIN_BYTES = 1 << 16
"""Space that is reserved for the accounts."""
_ELSEWHERE = "take another disk with -o"
_ADVICE = {
    errno.ENOSPC: ("the disk is full", f"make room, or {_ELSEWHERE}"),
    errno.EDQUOT: ("your quota of the disk is used up", f"make room, or {_ELSEWHERE}"),
    errno.EFBIG: (
        "the file system takes no longer file",
        "split the log, as in --split-size 1000",
    ),
    errno.EIO: ("the disk fails", _ELSEWHERE),
    errno.EROFS: ("the disk has become read-only", _ELSEWHERE),
}


class LogFile:
    """A file that is written in order and survives any end of its writer; for use in a `with`
    statement.

    Written data stay in memory until `flush`, so that the file always ends at the end of a
    flush.

    Args:
        path: its name once it is complete.
        force: True if it may replace a file.
        durable: True if every flush syncs it; else that happens once a second, in a thread.
        working: its name until then; by default `active_path(path)`.
        room: space reserved for its end; by default a `DiskReserve` in its folder.
        opened: opens a file without a buffer, by name and mode.
        now_ns: the clock.

    Attributes:
        size: its bytes; all of them were flushed.
        disk_error: the first error of the disk, or None.

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
        room: DiskReserve | None = None,
        opened: Callable[[Path, str], Any] | None = None,
        now_ns: Callable[[], int] | None = None,
    ) -> None:
        self.path = path
        self.working = working or active_path(path)
        self.size = 0
        self.disk_error: OSError | None = None
        self._force = force
        try:
            refuse_existing(path, force=force, unfinished=self.working)
            if force:  # what is left there is removed, not written to: it may be a link
                self.working.unlink(missing_ok=True)
            self._raw = (opened or FileIO)(self.working, "xb")
        except OSError as error:
            raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
        sync_folder(path.parent)
        self._room = room or DiskReserve(path.parent)
        self._syncing = FileSync(
            self._raw.fileno(), durable, now_ns or SystemClock().monotonic_ns
        )
        self._pending = bytearray()
        self._done = 0
        self._owed = 0
        self._tail = b""
        self._broken = self._closed = self._published = False

    def write(self, data: bytes, /) -> int:
        """Takes bytes, to be written by the next `flush`."""
        self._pending += data
        return len(data)

    def reserve(self, size: int) -> None:
        """Sets how many bytes the end of the file will take."""
        self._owed = size

    def flush(self) -> None:
        """Hands everything to the operating system, in one piece where it takes that.

        Raises:
            OSError: the disk refuses. The first time, pending data have been written all the
                same if the reserved space sufficed. The end of the file may follow, and nothing
                else.
        """
        if self._broken and self.disk_error:
            raise self.disk_error
        try:
            if self._pending and not self.disk_error:
                self._room.grow(len(self._pending) + self._owed + RESERVE_MARGIN_BYTES)
            self._put()
            if not self.disk_error:
                self._syncing.sync_new()
        except OSError as error:
            self.disk_error = self.disk_error or error
            self._room.release()
            try:
                self._put()
            except OSError:
                self._cut()
            raise

    def _put(self) -> None:
        while self._done < len(self._pending):
            taken = self._raw.write(memoryview(self._pending)[self._done :])
            if not taken:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            self._done += taken
        self._tail = bytes((self._tail + self._pending[-len(MAGIC) :])[-len(MAGIC) :])
        self.size += self._done
        self._pending = bytearray()
        self._done = 0

    def _cut(self) -> None:
        self._broken = True
        self._pending = bytearray()
        self._done = 0
        with suppress(OSError):
            self._raw.truncate(self.size)

    @property
    def whole(self) -> bool:
        """True once the file ends with the end mark."""
        return self._tail == MAGIC and self.size > len(MAGIC) and not self._broken

    def close(self) -> None:
        """Closes the file, and gives it its name if it is complete; an empty one is removed.

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
            self.disk_error = self.disk_error or error
            raise
        finally:
            self._raw.close()
            self._room.release()
        if self.whole:
            publish_file(self.working, self.path, force=self._force)
            self._published = True
        elif not self.size:
            self.working.unlink(missing_ok=True)
        sync_folder(self.path.parent)

    def discard(self) -> None:
        """Closes the file and removes it."""
        with suppress(OSError):
            self.close()
        self.working.unlink(missing_ok=True)
        self.size = 0

    def end(self, error: BaseException | None = None) -> None:
        """Closes the file, whatever ended it.

        Raises:
            LogRefused: the disk refused, now or as `error` says; the text states what is kept,
                and where.
        """
        try:
            self.close()
        except OSError as failure:
            raise self.refused(self.disk_error or failure) from None
        if isinstance(error, LogRefused) and self.disk_error is not None:
            raise self.refused(self.disk_error) from None

    def __enter__(self) -> "LogFile":
        return self

    def __exit__(
        self, _: type[BaseException] | None, error: BaseException | None, __: object
    ) -> None:
        self.end(error)

    def refused(self, error: OSError) -> LogRefused:
        """Returns the error of a file that the disk refused, once it is closed."""
        what, advice = _ADVICE.get(error.errno or 0, (error.strerror or str(error), _ELSEWHERE))
        if self._published:
            content = _describe_content(self.path)
            return LogRefused(
                f"{self.path}: {what}; the log ends there, finished, with {content}; {advice}"
            )
        if not self.size:
            return LogRefused(f"{self.path}: {what}; nothing was written; {advice}")
        # another program has what it should replace open, on Windows
        if self.whole and self.disk_error is None:
            return LogRefused(
                f"{self.path}: {what}; the finished log is {self.working}: give it a name"
            )
        return LogRefused(
            f"{self.working}: {what}, even for the end of the log; its {self.size / 1e6:.1f} MB up to the "
            f"last whole chunk are kept; {advice}; make it whole with: trilat log recover {self.working}"
        )


def _describe_content(path: Path) -> str:
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topic = {number: channel.topic for number, channel in summary.channels.items()}
    records = sum(count for n, count in counts.items() if topic[n].endswith(f"/{topics.STATE}"))
    return (
        f"{count_nouns(records, 'record')} and "
        f"{count_nouns(summary.statistics.message_count - records, 'other message')}"
    )

"""Writes the file of a log so that it survives crashes, power failures and full disks.

A log contains the messages of a run. While it is recorded, the file is called run.mcap.active,
and after it is complete, run.mcap. Data are flushed once the operating system has them, and
synced once they are on the disk.

Invariant:
    - Flushed data survive the death of the process. Synced data survive a loss of power.
    - Only a finished log gets the final name. An existing file is replaced only with `force`.
    - Disk space for the end of the file is reserved. If the disk becomes full, the file still
      ends as the format requires, with all data that were written before.
    - Syncing may block for a long time. It runs in a thread unless `durable` is set.
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
from ..files import describe_write_error, publish_file, refuse_existing
from ..net import SystemClock, topics
from .log_layout import active_path
from .mcap_records import MAGIC

_DISK_FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Error numbers of a disk that accepts no more data."""
RESERVE_STEP_BYTES = 1 << 19
"""Step by which the reserved space grows, in bytes."""


class DiskReserve:
    """Disk space that is reserved by a temporary file without a name.

    When the space is needed, the temporary file is closed, and another file on the same disk
    can use the space.

    Args:
        folder: Any folder on the disk.

    Attributes:
        size: Reserved space, in bytes.
    """

    def __init__(self, folder: Path) -> None:
        self.size = 0
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._is_possible = True

    def grow(self, size: int) -> None:
        """Reserves disk space, so that it cannot be used up by other programs.

        Nothing happens if the disk does not support reservations, or if the space has been
        released.

        Args:
            size: Number of bytes that must be reserved in total.

        Raises:
            OSError: The disk has no room.
        """
        if not self._is_possible or size <= self.size:
            return
        # Rounded up to a multiple of the step: -(-a // b) rounds a / b up.
        new_size = -(-size // RESERVE_STEP_BYTES) * RESERVE_STEP_BYTES
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            _allocate(self._file.fileno(), self.size, new_size)
        except OSError as error:
            if error.errno in _DISK_FULL_ERRNOS:
                raise
            self.release()  # this disk cannot reserve space
        else:
            self.size = new_size

    def release(self) -> None:
        """Frees the reserved disk space, so that the last part of a log fits on a full disk.

        This happens when the disk refuses data, or when the file is closed. Later calls of
        `grow` reserve nothing.
        """
        self._is_possible = False
        self.size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _allocate(descriptor: int, begin: int, end: int) -> None:
    """Reserves disk space for a file from one offset up to another.

    If the file system cannot reserve space, zeros are written.

    Raises:
        OSError: The disk has no room.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, begin, end - begin)
            return
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
                raise
    os.lseek(descriptor, begin, os.SEEK_SET)
    missing_bytes = end - begin
    while missing_bytes > 0:
        missing_bytes -= os.write(descriptor, bytes(missing_bytes))


SYNC_PERIOD_NS = 1_000_000_000
"""Period with which a thread syncs the file, in ns."""


class _FileSync:
    """Forces the data of one file onto the disk (sync), so that they survive a loss of power.

    Args:
        descriptor: Descriptor of the file in the operating system.
        durable: True to sync in every call, which blocks the caller. Otherwise a thread syncs
            once a second.
        now_ns: Function that returns the time in ns.
    """

    def __init__(self, descriptor: int, durable: bool, now_ns: Callable[[], int]) -> None:
        self._descriptor = descriptor
        self._durable = durable
        self._now_ns = now_ns
        self._synced_ns = now_ns()
        self._thread: threading.Thread | None = None
        self._disk_error: OSError | None = None

    def sync_new(self) -> None:
        """Forces the data that were written since the last call onto the disk.

        If `durable` is set, the method waits until the data are on the disk. Otherwise a thread
        forces them onto the disk. The thread is started only if its previous work has ended and
        began at least a second ago.

        Raises:
            OSError: The disk refuses the data, or has refused earlier data.
        """
        if self._durable:
            _datasync(self._descriptor)
            return
        if self._disk_error is not None:
            raise self._disk_error
        now_ns = self._now_ns()
        is_syncing = self._thread is not None and self._thread.is_alive()
        if now_ns - self._synced_ns >= SYNC_PERIOD_NS and not is_syncing:
            self._synced_ns = now_ns
            self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        """Syncs the file in the thread, and stores an error for the next call of `sync_new`."""
        try:
            _datasync(self._descriptor)
        except OSError as error:
            self._disk_error = error

    def wait(self) -> None:
        """Waits until a thread has forced the written data of the log onto the disk.

        The file must not be closed before that, because the thread uses its descriptor.
        """
        if self._thread is not None:
            self._thread.join()


def _datasync(descriptor: int) -> None:
    """Forces the written data of a file onto the disk, so that a power failure loses nothing.

    If the system has `fdatasync`, it is used instead of `fsync`, because it leaves out metadata
    that are not necessary to read the file.
    """
    getattr(os, "fdatasync", os.fsync)(descriptor)


RESERVE_MARGIN_BYTES = 1 << 16
"""Space that is reserved for the counts of messages at the end, in bytes."""
_ELSEWHERE = "choose another disk with -o"
_ADVICE = {
    errno.ENOSPC: ("the disk is full", f"make room, or {_ELSEWHERE}"),
    errno.EDQUOT: ("your disk quota is used up", f"make room, or {_ELSEWHERE}"),
    errno.EFBIG: (
        "the file system does not accept a longer file",
        "split the log, as in --split-size 1000",
    ),
    errno.EIO: ("the disk fails", _ELSEWHERE),
    errno.EROFS: ("the disk has become read-only", _ELSEWHERE),
}
"""Problem and advice for the user, by the error number of the disk."""


def sync_folder(folder: Path) -> None:
    """Forces the names of new files in a folder onto the disk, so that they survive a crash.

    Without this, a file may be stored completely, but its name may be lost when the power
    fails. Nothing happens on platforms that do not support this.

    Args:
        folder: The folder.
    """
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class LogFile:
    """Context manager for the file of a log, which is written from its beginning to its end.

    Written data stay in memory until `flush`, so that the file always ends at the end of a
    flush, even if the process is killed at any time.

    Args:
        path: Name of the complete file.
        force: True if the file may replace an existing one.
        durable: True to sync the file at every flush. Otherwise a thread syncs it once a
            second.
        working: Name of the file until it is complete. If None, `active_path(path)` is used.
        room: Space that is reserved for the end. If None, a `DiskReserve` in the file's folder
            is created.
        opened: Function that opens a file without a buffer, by name and mode. For tests.
        now_ns: Function that returns the time in ns. If None, the clock of the system is used.

    Attributes:
        path: Name of the complete file.
        working: Name of the file until it is complete.
        size: Number of flushed bytes.
        disk_error: The first error of the disk. None if there was no error.

    Raises:
        UsageError: The file exists, or cannot be created.
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
        """Creates the log under a working name, which shows that it is not complete yet."""
        self.path = path
        self.working = working or active_path(path)
        self.size = 0
        self.disk_error: OSError | None = None
        self._force = force

        try:
            refuse_existing(path, force=force, unfinished=self.working)
            if force:
                # An existing file is removed rather than overwritten, because it may be a link.
                self.working.unlink(missing_ok=True)
            self._raw = (opened or FileIO)(self.working, "xb")
        except OSError as error:
            raise UsageError(str(describe_write_error(path, error))) from None
        sync_folder(path.parent)

        self._room = room or DiskReserve(path.parent)
        self._syncing = _FileSync(
            self._raw.fileno(), durable, now_ns or SystemClock().monotonic_ns
        )
        self._pending = bytearray()
        # Number of bytes of `_pending` that the operating system has accepted.
        self._written = 0
        # Number of bytes that the end of the file will need.
        self._end_bytes = 0
        # The last bytes that were written, with the length of the end mark.
        self._tail = b""
        # True if the disk accepted no data, even after the reserved space was released.
        self._broken = False
        self._closed = False
        # True once the file has its final name.
        self._published = False

    def write(self, data: bytes, /) -> int:
        """Stores bytes in memory. The next `flush` writes them to the file.

        A slow disk therefore cannot stop the caller while messages arrive.

        Args:
            data: The bytes.

        Returns:
            Their number.
        """
        self._pending += data
        return len(data)

    def reserve(self, size: int) -> None:
        """Sets the number of bytes that the end of the file will need.

        The next `flush` reserves disk space for them, so that the file can end properly even
        if the disk becomes full.

        Args:
            size: The number of bytes.
        """
        self._end_bytes = size

    def flush(self) -> None:
        """Writes all stored data to the file.

        There are three cases:

        1. There was no error so far. Before the data are written, disk space is reserved for
           them and for the end of the file.
        2. The disk refuses the data for the first time. The reserved space is released, and the
           data are written again. If this succeeds, they are in the file, but the error is
           still raised, so that the caller stops and writes only the end of the file.
        3. The disk refuses the data even then. The file is cut off at the end of the previous
           flush. Every later call raises the first error.

        Raises:
            OSError: The disk refuses the data, now or in an earlier call. Only the end of the
                file may be written afterwards.
        """
        if self._broken and self.disk_error:
            raise self.disk_error
        try:
            has_had_error = self.disk_error is not None
            if self._pending and not has_had_error:
                self._room.grow(len(self._pending) + self._end_bytes + RESERVE_MARGIN_BYTES)
            self._write_pending()
            if not has_had_error:
                self._syncing.sync_new()
        except OSError as error:
            self.disk_error = self.disk_error or error
            self._room.release()
            try:
                self._write_pending()
            except OSError:
                self._cut_off()
            raise

    def _write_pending(self) -> None:
        """Passes the bytes in memory to the operating system, and notes where the file ends.

        After an error, the next call continues after the bytes that were accepted.

        Raises:
            OSError: The disk refuses the data.
        """
        while self._written < len(self._pending):
            accepted = self._raw.write(memoryview(self._pending)[self._written :])
            if not accepted:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            self._written += accepted
        # The last bytes show whether the file is complete, that is, whether it ends with the
        # end mark.
        mark_bytes = len(MAGIC)
        self._tail = bytes((self._tail + self._pending[-mark_bytes:])[-mark_bytes:])
        self.size += self._written
        self._pending = bytearray()
        self._written = 0

    def _cut_off(self) -> None:
        """Removes partly written data, so that the file ends where a complete flush ended.

        A log that ends with half a chunk could only be read after a recovery.
        """
        self._broken = True
        self._pending = bytearray()
        self._written = 0
        with suppress(OSError):
            self._raw.truncate(self.size)

    @property
    def whole(self) -> bool:
        """True if the log is complete: it ends with the end mark of the MCAP format.

        Only a complete file gets its final name. Any other file keeps the suffix ".active", and
        can be recovered.
        """
        return self._tail == MAGIC and self.size > len(MAGIC) and not self._broken

    def close(self) -> None:
        """Closes the file. A complete file gets its final name, and an empty file is removed.

        An incomplete file keeps its working name. Further calls have no effect.

        Raises:
            UsageError: A file with the final name has appeared since the start.
            OSError: The disk refuses the data.
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
        """Closes and removes the file of a log that is not wanted.

        An error while closing is ignored, since no data need to be saved.
        """
        with suppress(OSError):
            self.close()
        self.working.unlink(missing_ok=True)
        self.size = 0

    def end(self, error: BaseException | None = None) -> None:
        """Closes the log's file, and explains an error of the disk to the user.

        Args:
            error: Exception that interrupted the writing. None if nothing interrupted it.

        Raises:
            LogRefused: The disk refuses the last data, or `error` states that it has refused
                earlier data. The text states which data are saved, and where.
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
        """Composes the error for the user after the disk refused data.

        The file must be closed before this call, because the text depends on the final state of
        the file:

        - The reserved space was sufficient for the end: the log is finished, under its final
          name (`path`), with the data up to the error.
        - Nothing was written: there is no file.
        - The log is finished, and no write failed, but the file could not be renamed: it keeps
          its working name.
        - Otherwise the file has no proper end, and keeps its working name. The user can recover
          it.

        Args:
            error: The error of the operating system.

        Returns:
            The error, whose text states the problem, which data are saved, and what the user
            can do.
        """
        problem, advice = _ADVICE.get(
            error.errno or 0, (error.strerror or str(error), _ELSEWHERE)
        )
        if self._published:
            content = _describe_content(self.path)
            return LogRefused(
                f"{self.path}: {problem}; the log ends there, finished, with {content}; "
                f"{advice}"
            )
        if not self.size:
            return LogRefused(f"{self.path}: {problem}; nothing was written; {advice}")
        has_only_renaming_failed = self.whole and self.disk_error is None
        if has_only_renaming_failed:
            # On Windows, the file to replace may be open in another program.
            return LogRefused(
                f"{self.path}: {problem}; the finished log is {self.working}: give it a name"
            )
        return LogRefused(
            f"{self.working}: {problem}, even for the end of the log; the "
            f"{self.size / 1e6:.1f} MB up to the last complete chunk are kept; {advice}; "
            f"recover the log with: trilat log recover {self.working}"
        )


def _describe_content(path: Path) -> str:
    """Returns the numbers of records and other messages in a finished log, as a string.

    The numbers are read from the statistics at the end of the file.
    """
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    records = sum(
        counts.get(number, 0)
        for number, channel in summary.channels.items()
        if channel.topic.endswith(f"/{topics.STATE}")
    )
    others = summary.statistics.message_count - records
    return f"{count_nouns(records, 'record')} and {count_nouns(others, 'other message')}"

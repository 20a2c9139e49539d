"""Writes the file of a log in a way that survives crashes, power failures and full disks.

While it is being recorded, the file is called run.mcap.active; once complete, it is renamed to
run.mcap. Data are flushed when the operating system has them, and synced when they are on the
disk.

Invariant:
    - Flushed data survive the death of the process. Synced data survive a power failure.
    - Only a finished log gets the final name. An existing file is replaced only with `force`.
    - Disk space is reserved for the end of the file. If the disk fills up, the file still ends
      as the format requires and contains all data written before.
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
"""Error numbers that indicate a disk that accepts no more data."""
RESERVE_STEP_BYTES = 1 << 19
"""Increment by which the reserved space grows, in bytes."""


class DiskReserve:
    """Disk space reserved by an unnamed temporary file.

    Closing the temporary file frees the space for another file on the same disk.

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
        """Reserves disk space so that other programs cannot use it up.

        Does nothing if the disk does not support reservations, or if the space has been
        released.

        Args:
            size: Total number of bytes that must be reserved.

        Raises:
            OSError: The disk is full.
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

        Called when a write fails or the file is closed. Later calls of `grow` reserve nothing.
        """
        self._is_possible = False
        self.size = 0
        if self._file is not None:
            self._file.close()
            self._file = None


def _allocate(descriptor: int, begin: int, end: int) -> None:
    """Reserves disk space for a file from one offset to another.

    If the file system cannot reserve space, zeros are written.

    Raises:
        OSError: The disk is full.
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
"""Period at which a thread syncs the file, in ns."""


class _FileSync:
    """Syncs the data of one file to the disk, so that they survive a power failure.

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
        """Syncs the data written since the last call to the disk.

        If `durable` is set, the method blocks until the data are on the disk. Otherwise a
        thread syncs them, and it is started only if the previous sync has finished and began at
        least a second ago.

        Raises:
            OSError: Writing to the disk failed, in this call or an earlier one.
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
        """Syncs the file in the thread, and stores any error for the next `sync_new`."""
        try:
            _datasync(self._descriptor)
        except OSError as error:
            self._disk_error = error

    def wait(self) -> None:
        """Waits until the thread has finished syncing the log to the disk.

        The file must not be closed earlier, because the thread uses its descriptor.
        """
        if self._thread is not None:
            self._thread.join()


def _datasync(descriptor: int) -> None:
    """Syncs the written data of a file to the disk, so that a power failure loses nothing.

    Uses `fdatasync` instead of `fsync` where available, because it skips metadata that are not
    needed to read the file.
    """
    getattr(os, "fdatasync", os.fsync)(descriptor)


RESERVE_MARGIN_BYTES = 1 << 16
"""Space reserved for the message counts at the end, in bytes."""
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
"""Maps the error number of the disk to the problem and advice for the user."""


def sync_folder(folder: Path) -> None:
    """Syncs the names of new files in a folder to the disk, so that they survive a crash.

    Otherwise a power failure may lose the name of a file whose contents were stored completely.
    Does nothing on platforms without support for syncing folders.

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
    """Context manager that writes the file of a log from start to finish.

    Written data stay in memory until `flush`. Even if the process is killed, the file therefore
    always ends where a flush ended.

    Args:
        path: Name of the complete file.
        force: True to allow replacing an existing file.
        durable: True to sync the file at every flush. Otherwise a thread syncs it once a
            second.
        working: Name of the file until it is complete. If None, `active_path(path)` is used.
        room: Disk space reserved for the end of the file. If None, a `DiskReserve` in the
            folder of the file is created.
        opened: Function that opens an unbuffered file, given its name and mode. For tests.
        now_ns: Function that returns the time in ns. If None, the system clock is used.

    Attributes:
        path: Name of the complete file.
        working: Name of the file until it is complete.
        size: Number of flushed bytes.
        disk_error: The first disk error, or None if there was none.

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
        """Creates the log under a working name, which shows that it is not yet complete."""
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
        """Buffers bytes in memory until the next `flush`, and returns their number.

        A slow disk therefore cannot block the caller while messages arrive.

        Args:
            data: The bytes to write.
        """
        self._pending += data
        return len(data)

    def reserve(self, size: int) -> None:
        """Sets the number of bytes that the end of the file will need.

        The next `flush` reserves disk space for them, so that the file can be finished properly
        even if the disk fills up.

        Args:
            size: The number of bytes.
        """
        self._end_bytes = size

    def flush(self) -> None:
        """Writes all buffered data to the file.

        There are three cases:

        1. No write has failed so far. Disk space is reserved for the data and for the end of
           the file, then the data are written.
        2. A write fails for the first time. The reserved space is released, and the data are
           written again. Even if this succeeds, the error is raised, so that the caller stops
           and writes only the end of the file.
        3. The second write fails too. The file is truncated to where the previous flush ended,
           and every later call raises the first error.

        Raises:
            OSError: Writing to the disk failed, in this call or an earlier one. Only the end of
                the file may be written afterwards.
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
        """Passes the buffered bytes to the operating system, and records where the file ends.

        After an error, the next call continues after the bytes that were accepted.

        Raises:
            OSError: Writing to the disk failed.
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
        """Truncates the file to where a complete flush ended, removing partly written data.

        A log that ends with half a chunk could only be read after a recovery.
        """
        self._broken = True
        self._pending = bytearray()
        self._written = 0
        with suppress(OSError):
            self._raw.truncate(self.size)

    @property
    def whole(self) -> bool:
        """True if the log is complete, that is, ends with the end mark of the MCAP format.

        Only a complete file gets its final name. Any other file keeps the suffix ".active" and
        can be recovered.
        """
        return self._tail == MAGIC and self.size > len(MAGIC) and not self._broken

    def close(self) -> None:
        """Closes the file, renaming it to its final name if complete or deleting it if empty.

        An incomplete file keeps its working name. Further calls have no effect.

        Raises:
            UsageError: A file with the final name has been created in the meantime.
            OSError: Writing to the disk failed.
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
        """Closes and deletes the file of a log that is not wanted.

        Errors while closing are ignored, since there are no data to save.
        """
        with suppress(OSError):
            self.close()
        self.working.unlink(missing_ok=True)
        self.size = 0

    def end(self, error: BaseException | None = None) -> None:
        """Closes the file of the log, and explains any disk error to the user.

        Args:
            error: Exception that interrupted the writing, or None.

        Raises:
            LogRefused: The last data could not be written, or `error` reports an earlier failed
                write. The message states which data were saved, and where.
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
        """Builds the error shown to the user after a write to the disk failed.

        The file must be closed first, because the message depends on its final state:

        - The reserved space was sufficient for the end: the log is finished under its final
          name (`path`) and contains the data up to the error.
        - Nothing was written: there is no file.
        - The log is finished and no write failed, but the file could not be renamed: it keeps
          its working name.
        - Otherwise the file has no proper end and keeps its working name. The user can recover
          it.

        Args:
            error: The error reported by the operating system.

        Returns:
            An error whose message states the problem, which data were saved, and what the user
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
    """Returns a description of how many records and other messages a finished log contains.

    The counts are read from the statistics at the end of the file.
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

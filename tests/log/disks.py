"""Disks that have little room, or take little at a time: stand-ins for `FileIO` and `DiskReserve`."""

import errno
import io
import os
from pathlib import Path

from trilat_net.log.log_file import DiskReserve, LogFile
from trilat_net.log.mcap_writer import McapWriter


class SmallDisk:
    """A disk with so many bytes, for one file and the room that is kept for it.

    Args:
        capacity: bytes.
        error: what it says when they are used up.
        most: how many bytes it takes at once.
    """

    def __init__(self, capacity: int, error: int = errno.ENOSPC, most: int = 1 << 30) -> None:
        self.capacity = capacity
        self.error = error
        self.most = most
        self.written = 0
        self.kept = 0

    def refuse(self) -> OSError:
        return OSError(self.error, os.strerror(self.error))

    def opened(self, path: Path, mode: str) -> "SmallFile":
        return SmallFile(self, path, mode)


class SmallFile(io.FileIO):
    """A file on a small disk."""

    def __init__(self, disk: SmallDisk, path: Path, mode: str) -> None:
        super().__init__(path, mode)
        self._disk = disk

    def write(self, data: memoryview) -> int:  # type: ignore[override]
        disk = self._disk
        taken = min(len(data), disk.most, disk.capacity - disk.written - disk.kept)
        if taken <= 0 < len(data):
            raise disk.refuse()
        disk.written += taken
        return super().write(data[:taken])

    def truncate(self, size: int | None = None) -> int:
        self._disk.written = size or 0
        return super().truncate(size)


class SmallRoom(DiskReserve):
    """Space reserved on a small disk; nothing is reserved if `possible` is False."""

    def __init__(self, disk: SmallDisk, possible: bool = True) -> None:
        super().__init__(Path())
        self._disk = disk
        self._possible = possible

    def grow(self, size: int) -> None:
        if not self._possible or size <= self._disk.kept:
            return
        if self._disk.written + size > self._disk.capacity:
            raise self._disk.refuse()
        self._disk.kept = size

    def release(self) -> None:
        self._possible = False
        self._disk.kept = 0


def open_file_on(disk: SmallDisk, path: Path, room: bool = True) -> LogFile:
    return LogFile(path, room=SmallRoom(disk, room), opened=disk.opened)


Sent = tuple[int, int, bytes, int, int]
"""Channel, log time, payload, publish time, sequence."""


def draw_messages(count: int) -> list[Sent]:
    """Returns messages with random payloads, which do not compress."""
    return [(1 + n % 2, 10 * n, os.urandom(40), 10 * n + 1, n) for n in range(count)]


def begin_container(file: LogFile) -> McapWriter:
    """Returns the flushed writer of a file with two channels."""
    container = McapWriter(file, "lib")
    schema = container.register_schema("S", "jsonschema", b"{}")
    for name in "ab":
        container.register_channel(f"/{name}", "msgpack", schema)
    container.flush()
    return container

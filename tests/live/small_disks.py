"""A disk of some MiB in memory, visible only to chosen processes.

Invariant:
- Nothing stays: the disk is mounted in its own namespace, which ends with the last process in it.
"""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class NoSmallDisk(Exception):  # noqa: N818 - it names a reason
    """The reason why small disks are not available."""


class SmallDisk:
    """A disk of some MiB that only those see who are told to.

    Attributes:
        folder: where it is for them.
        before: the words before a command that is to see it.
    """

    def __init__(self, folder: Path, mib: int) -> None:
        self.folder = folder
        mount = f"mount -t tmpfs -o size={mib}m none {folder} && echo ready && exec sleep 600"
        self._holder = subprocess.Popen(
            ["unshare", "-m", "sh", "-c", mount],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != "ready\n":
            _, problem = self._holder.communicate(timeout=10)
            raise NoSmallDisk(problem.strip())
        self.before = (
            "nsenter",
            f"--mount=/proc/{self._holder.pid}/ns/mnt",
            f"--wd={folder.parent}",
        )

    def seen(self, path: Path) -> Path:
        return Path(f"/proc/{self._holder.pid}/root{path}")

    def remove(self) -> None:
        self._holder.kill()
        self._holder.communicate(timeout=10)


@contextmanager
def small_disk(folder: Path, mib: int) -> Iterator[SmallDisk]:
    """A disk that is gone at the end.

    Raises:
        NoSmallDisk: there can be none here.
    """
    if shutil.which("unshare") is None or shutil.which("nsenter") is None:
        raise NoSmallDisk("there is no `unshare` or no `nsenter` (util-linux)")
    disk = SmallDisk(folder, mib)
    try:
        yield disk
    finally:
        disk.remove()

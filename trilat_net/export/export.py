"""Exports a log, by the name of the form.

Law: whatever can be refused is refused before anything is read or written.
"""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

from ..log.reader import Log
from ..log.ros2 import export_ros2
from .arrays import mat_file, npz_file
from .folder import Write, csv_folder, parquet_folder
from .target import made_whole, refuse_existing

Progress = Callable[[int, int], None]
"""Told how much of something is done: (so far, in all)."""


class Form(StrEnum):
    """What a log can be exported to."""

    ROS2 = "ros2"
    PARQUET = "parquet"
    CSV = "csv"
    NPZ = "npz"
    MAT = "mat"

    @property
    def is_folder(self) -> bool:
        """True where it is a folder of files, False where it is one file."""
        return self in (Form.CSV, Form.PARQUET)


class Exporter:
    """What exports a log to one form, at one place.

    Args:
        form: what to.
        path: where to: a file, or a folder of files.
        force: whether an export that is there may be replaced.

    Raises:
        UsageError: the place is taken, or a package is missing.
    """

    def __init__(self, form: Form, path: Path, *, force: bool = False) -> None:
        self._form, self._path, self._force = form, path, force
        refuse_existing(path, folder=form.is_folder, force=force)
        self._write = _WRITES[form]()

    def export(self, log: Log, progress: Progress | None = None) -> None:
        """Exports a log.

        Args:
            log: the log.
            progress: told how many records are written, and how many there are.

        Raises:
            LogError: a record cannot be read.
            LogRefused: the disk is full.
            UsageError: the place cannot be written to.
        """
        total = sum(len(log[site]) for site in log.sites)
        done = 0

        def written(records: int) -> None:
            nonlocal done
            done += records
            if progress is not None:
                progress(done, total)

        with made_whole(self._path, folder=self._form.is_folder, force=self._force) as path:
            self._write(log, path, written)


def default_path(form: Form, first: Path) -> Path:
    """Returns where an export goes if nobody says: beside the log, by its name.

    Args:
        form: what to.
        first: the log, or its first part.
    """
    name = first.name.removesuffix(".active").removesuffix(".mcap")
    ending = {Form.NPZ: ".npz", Form.MAT: ".mat", Form.ROS2: "-ros2.mcap"}.get(form, f"-{form}")
    return first.with_name(f"{name}{ending}")


_WRITES: dict[Form, Callable[[], Write]] = {
    Form.ROS2: lambda: export_ros2,
    Form.PARQUET: parquet_folder,
    Form.CSV: csv_folder,
    Form.NPZ: npz_file,
    Form.MAT: mat_file,
}

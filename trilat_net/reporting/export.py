"""Export of a log to a file format given by name.

Invariant: everything that can be refused is refused before anything is read or written.
"""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

from ..files import refuse_existing, stage_output
from ..log.log_reader import Log
from .export_tables import (
    EXPORT_MANIFEST,
    WriteExport,
    make_csv_writer,
    make_mat_writer,
    make_npz_writer,
    make_parquet_writer,
)
from .ros2_bag import export_ros2

ExportProgress = Callable[[int, int], None]
"""Called with the number of records that are written, and of all."""


class ExportFormat(StrEnum):
    """A format of exports."""

    ROS2 = "ros2"
    PARQUET = "parquet"
    CSV = "csv"
    NPZ = "npz"
    MAT = "mat"

    @property
    def is_folder(self) -> bool:
        """True if an export is a folder of files, False if it is one file."""
        return self in (ExportFormat.CSV, ExportFormat.PARQUET)


class Exporter:
    """An export to a path, which is refused before a log is read.

    Args:
        form: its format.
        path: a file, or a folder of files.
        force: whether an earlier export may be replaced.

    Raises:
        UsageError: the place is taken, or a package is missing.
    """

    def __init__(self, form: ExportFormat, path: Path, *, force: bool = False) -> None:
        self._form, self._path, self._force = form, path, force
        self._manifest = EXPORT_MANIFEST if form.is_folder else None
        refuse_existing(path, force=force, manifest=self._manifest)
        self._write = _WRITES[form]()

    def export(self, log: Log, progress: ExportProgress | None = None) -> None:
        """Exports a log.

        Args:
            log: the log.
            progress: called with the number of records that are written, and of all.

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

        with stage_output(self._path, force=self._force, manifest=self._manifest) as path:
            self._write(log, path, written)


def default_export_path(form: ExportFormat, first: Path) -> Path:
    """Returns the default path of an export: next to the log, or its first part, and named after it."""
    name = first.name.removesuffix(".active").removesuffix(".mcap")
    ending = {ExportFormat.NPZ: ".npz", ExportFormat.MAT: ".mat", ExportFormat.ROS2: "-ros2.mcap"}.get(
        form, f"-{form}"
    )
    return first.with_name(f"{name}{ending}")


_WRITES: dict[ExportFormat, Callable[[], WriteExport]] = {
    ExportFormat.ROS2: lambda: export_ros2,
    ExportFormat.PARQUET: make_parquet_writer,
    ExportFormat.CSV: make_csv_writer,
    ExportFormat.NPZ: make_npz_writer,
    ExportFormat.MAT: make_mat_writer,
}

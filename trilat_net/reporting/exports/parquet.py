"""Exports a log as a folder of Parquet files, a file per table."""

import io
from pathlib import Path

from ...log.data_tables import Table, to_data_frame
from ...log.log_reader import Log
from ..export import ExportFormat, Written, describe_folder, store_tables


def _write(log: Log, folder: Path, written: Written) -> None:
    """Writes the tables of a log, its scenario and their description into a folder."""
    description = store_tables(
        log,
        written,
        lambda table: f"{table.label}.parquet",
        lambda table, file_name: _write_table(table, folder / file_name),
    )
    describe_folder(log, folder, description)


def _write_table(table: Table, path: Path) -> None:
    """Writes a table as a Parquet file."""
    # written by Python and not by polars, so that a full disk is an OSError
    buffer = io.BytesIO()
    to_data_frame(table).write_parquet(buffer, compression="zstd")
    path.write_bytes(buffer.getbuffer())


FORMAT = ExportFormat(
    _write, "-parquet", folder=True, extra=("polars", "frames", "Parquet files")
)

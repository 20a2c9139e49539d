"""Exports a log as a folder of Parquet files, one file per table.

A table contains, for instance, the records of one arm, with one row per tick. Parquet is a
compressed columnar format that pandas, polars and DuckDB can read. Two more files in the folder
contain the descriptions of the columns and the scenario.
"""

import io
from pathlib import Path

from ...files import Extra
from ...log import Log, Table
from ..export import ExportFormat, Written, write_table_files


def _write(log: Log, folder: Path, written: Written) -> None:
    """Exports a log as Parquet tables in a folder, with their description and the scenario.

    Args:
        log: Log of the run to export.
        folder: Existing folder for the files.
        written: Function that is called with the number of records written since the last call.
    """
    write_table_files(log, folder, written, ".parquet", _write_table)


def _write_table(table: Table, path: Path) -> None:
    """Writes a table as a Parquet file."""
    # The file is written by Python and not by polars, so that a full disk raises OSError.
    buffer = io.BytesIO()
    table.to_data_frame().write_parquet(buffer, compression="zstd")
    path.write_bytes(buffer.getbuffer())


_EXTRA = Extra("frames", "Parquet files")
FORMAT = ExportFormat(_write, "-parquet", folder=True, extra=_EXTRA, module="polars")

"""Exports a log as a folder of CSV files, one file per table.

A table contains, for instance, the records of one arm, with one row per tick. Each file starts
with a line of column names. Numbers are written with as many digits as Python needs to read
them back unchanged, and a missing value is an empty field. Two more files contain the
descriptions of the columns and the scenario.
"""

import csv
from pathlib import Path

from ...log import Log, Table
from ..export import ExportFormat, Written, write_table_files

_ROWS_AT_ONCE = 4096
"""Number of rows converted to text at a time, to limit memory use."""


def _write(log: Log, folder: Path, written: Written) -> None:
    """Exports a log as CSV tables in a folder, with their description and the scenario.

    Args:
        log: Log of the run to export.
        folder: Existing folder for the files.
        written: Function that is called with the number of records written since the last call.
    """
    write_table_files(log, folder, written, ".csv", _write_table)


def _write_table(table: Table, path: Path) -> None:
    """Writes a table as a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(column.name for column in table.columns)
        for first in range(0, len(table), _ROWS_AT_ONCE):
            last = first + _ROWS_AT_ONCE
            columns = [column.rows(first, last) for column in table.columns]
            writer.writerows(zip(*columns, strict=True))


FORMAT = ExportFormat(_write, "-csv", folder=True)

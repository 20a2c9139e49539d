"""A folder of CSV files: a file per site and kind, numbers as Python shows them."""

import csv
from pathlib import Path

from ...log.data_tables import Table
from ...log.log_reader import Log
from ..export import ExportFormat, Written, describe_folder, store_tables

_ROWS = 4096
"""Rows that are converted to text together."""


def _write(log: Log, folder: Path, written: Written) -> None:
    """Writes CSV files: a line of names, then a row per line, numbers as Python shows them."""

    def store(table: Table, name: str) -> None:
        with (folder / name).open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(column.name for column in table.columns)
            for first in range(0, len(table), _ROWS):
                columns = (column.rows(first, first + _ROWS) for column in table.columns)
                writer.writerows(zip(*columns, strict=True))

    describe_folder(
        log, folder, store_tables(log, written, lambda table: f"{table.label}.csv", store)
    )


FORMAT = ExportFormat(_write, "-csv", folder=True)

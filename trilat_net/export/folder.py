"""A folder with a file per table, and beside them what they are: CSV, or Parquet.

Law: a number read back is the number, bit for bit.
"""

import csv
import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ..extra import extra
from ..log.frame import frame
from ..log.reader import Log
from ..log.table import Table
from ..log.tables import all_tables
from ..log.writer import SCENARIO
from .about import about, table_facts
from .target import ABOUT

_ROWS = 4096
"""Rows that are turned into text together."""

Write = Callable[[Log, Path, Callable[[int], None]], None]
"""Writes a log to a path, and calls with how many more records are written."""


def csv_folder() -> Write:
    """Returns what writes CSV: a line of names, then a row per line, numbers as Python shows them."""
    return partial(_write, ".csv", _write_csv)


def parquet_folder() -> Write:
    """Returns what writes Parquet.

    Raises:
        UsageError: polars is not installed.
    """
    extra("polars", "frames", "Parquet files")
    return partial(_write, ".parquet", _write_parquet)


def _write(
    ending: str,
    write: Callable[[Table, Path], Any],
    log: Log,
    folder: Path,
    written: Callable[[int], None],
) -> None:
    facts = []
    for table in all_tables(log):
        name = f"{table.label}{ending}"
        write(table, folder / name)
        facts.append((name, table_facts(table)))
        written(len(table) if table.kind == "state" else 0)
    (folder / ABOUT).write_text(about(log, facts), encoding="utf-8")
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def _write_csv(table: Table, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(column.name for column in table.columns)
        for first in range(0, len(table), _ROWS):
            columns = (column.rows(first, first + _ROWS) for column in table.columns)
            writer.writerows(zip(*columns, strict=True))


def _write_parquet(table: Table, path: Path) -> None:
    made = io.BytesIO()  # a disk that is full is an error of ours to tell, not of polars
    frame(table).write_parquet(made, compression="zstd")
    path.write_bytes(made.getbuffer())

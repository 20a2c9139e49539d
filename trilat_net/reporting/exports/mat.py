"""A MATLAB file with a struct per site, and in it an array per column."""

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UsageError
from ...files import import_extra
from ...log.data_tables import Column, Table
from ...log.log_reader import Log
from ..export import ExportFormat, Written, name_inside, read_texts, store_tables

_EXTRA = ("scipy.io", "mat", "MAT files")
_EXACT = 2**53
"""Largest integer up to which all are exact as floats, the numbers of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global",
    "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""


def _write(log: Log, path: Path, written: Written) -> None:
    """Writes a struct per site (`m1.q1_rad`, `m1.link.age_s_us`), `events`, and two texts."""
    variables: dict[str, Any] = {}

    def store(table: Table, place: str) -> None:
        struct: dict[str, Any] = {
            column.name: _matlab(column, table) for column in table.columns
        }
        struct["units"] = {column.name: column.unit for column in table.columns}
        name, _, kind = place.partition(".")
        (variables[name] if kind else variables)[kind or name] = struct

    def place_of(table: Table) -> str:
        return name_inside(
            table, f"{table.name}_site" if table.name in _KEYWORDS else table.name, "."
        )

    about = store_tables(log, written, place_of, store)
    variables |= {"about_json": about, "scenario_toml": log.scenario_text}
    savemat = import_extra(*_EXTRA).savemat
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        text = f"too large for a MAT file ({error}); export it --to npz, or --to parquet"
        raise UsageError(f"{log.source}: {text}") from None


def _matlab(column: Column, table: Table) -> Any:
    """Returns a column for MATLAB: doubles if they are exact, rows of characters or cells."""
    if column.is_text:
        return read_texts(column) if table.kind else column.values.reshape(-1, 1)
    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    exact = values.dtype == np.int64 and bool((np.abs(values) <= _EXACT).all())
    if is_stamp or values.dtype.kind not in "iu" or not exact:
        return values
    return values.astype(np.float64)


FORMAT = ExportFormat(_write, ".mat", extra=_EXTRA)

"""Exports a log as a MATLAB file (.mat) with a struct per site and an array per column."""

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UsageError
from ...files import import_extra
from ...log.data_tables import Column, Table
from ...log.log_reader import Log
from ..export import ExportFormat, Written, name_inside, read_texts, store_tables

_EXTRA = ("scipy.io", "mat", "MAT files")
_MAX_EXACT_INTEGER = 2**53
"""Integers of at most this size are exact as doubles, the usual numbers of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for",
    "function", "global", "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch",
    "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""


def _write(log: Log, path: Path, written: Written) -> None:
    """Writes a struct per site, the struct `events`, and two texts.

    Columns have names such as `m1.q1_rad` and `m1.link.age_s_us`. The texts are the
    description, `about_json`, and the scenario, `scenario_toml`.

    Raises:
        UsageError: the log is too large for a MATLAB file.
    """
    variables: dict[str, Any] = {}

    def store(table: Table, table_name: str) -> None:
        struct = _build_struct(table)
        site, _, kind = table_name.partition(".")
        if kind:
            # store_tables stores the records of a site before its other tables
            variables[site][kind] = struct
        else:
            variables[site] = struct

    variables["about_json"] = store_tables(log, written, _name_table, store)
    variables["scenario_toml"] = log.scenario_text
    savemat = import_extra(*_EXTRA).savemat
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{log.source}: too large for a MAT file ({error}); "
            "export it --to npz, or --to parquet"
        ) from None


def _name_table(table: Table) -> str:
    """Returns the name of a table in the file; a site named like a keyword gets an ending."""
    name = f"{table.name}_site" if table.name in _KEYWORDS else table.name
    return name_inside(table, name, ".")


def _build_struct(table: Table) -> dict[str, Any]:
    """Returns a struct of the columns of a table, with their units in the field `units`."""
    struct = {column.name: _convert_column(column, table) for column in table.columns}
    struct["units"] = {column.name: column.unit for column in table.columns}
    return struct


def _convert_column(column: Column, table: Table) -> Any:
    """Returns a column for MATLAB.

    Texts are rows of characters in the tables of sites, and cells in the table of events.
    Integers become doubles if all of them are exact as doubles. Stamps in ns stay integers.
    """
    if column.is_text:
        return read_texts(column) if table.kind else column.values.reshape(-1, 1)
    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    if is_stamp or values.dtype != np.int64:
        return values
    is_exact = bool((np.abs(values) <= _MAX_EXACT_INTEGER).all())
    return values.astype(np.float64) if is_exact else values


FORMAT = ExportFormat(_write, ".mat", extra=_EXTRA)

"""Exports a log as a MATLAB file (.mat) with one struct per arm and one array per column.

For example, `m1.q1_rad` contains the angle of the first joint of arm m1 at every tick, and
`m1.link.age_s_us` is a column of its link statistics. The struct `events` contains the session
events. The string `about_json` describes all columns, and the string `scenario_toml` is the
scenario.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UsageError
from ...files import Extra
from ...log import Column, Log, Table
from ..export import ExportFormat, Written, name_inside, store_tables

_EXTRA = Extra("mat", "MAT files")
_MAX_EXACT_INTEGER = 2**53
"""Limit up to which all integers are exact as doubles, the default numeric type of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for",
    "function", "global", "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch",
    "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""


def _write(log: Log, path: Path, written: Written) -> None:
    """Exports a log as a MATLAB file: tables as structs, with description and scenario.

    Args:
        log: Log of the run to export.
        path: The file.
        written: Function that is called with the number of records written since the last call.

    Raises:
        UsageError: The log is too large for a MATLAB file.
    """
    variables: dict[str, Any] = {}

    def store(table: Table, table_name: str) -> None:
        """Adds a table as a struct to the variables of the MATLAB file.

        Args:
            table: Table of the log, such as the records of a site.
            table_name: Name of the table: "m1" for the records of site m1, or for example
                "m1.link" for another table of the site, which becomes a field of the struct m1.
        """
        struct = _build_struct(table)
        site, _, kind = table_name.partition(".")
        if kind:
            # The struct of the site exists already, because `store_tables` stores the records
            # of a site before its other tables.
            variables[site][kind] = struct
        else:
            variables[site] = struct

    variables["about_json"] = store_tables(log, written, _name_table, store)
    variables["scenario_toml"] = log.scenario_text
    savemat = _EXTRA.import_module("scipy.io").savemat
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{log.source}: too large for a MAT file ({error}); "
            "export it --to npz, or --to parquet"
        ) from None


def _name_table(table: Table) -> str:
    """Returns the name under which a table is stored in the MATLAB file.

    If the name is a MATLAB keyword, such as "end", the suffix "_site" is appended.
    """
    name = f"{table.name}_site" if table.name in _KEYWORDS else table.name
    return name_inside(table, name, ".")


def _build_struct(table: Table) -> dict[str, Any]:
    """Returns the columns of a table as fields of a struct, with their units in `units`."""
    struct = {column.name: _convert_column(column, table) for column in table.columns}
    struct["units"] = {column.name: column.unit for column in table.columns}
    return struct


def _convert_column(column: Column, table: Table) -> Any:
    """Converts the values of a column to a type that is convenient in MATLAB.

    Strings become char arrays, or cell arrays in the table of events. Integers become doubles,
    the type in which MATLAB computes, if all of them are exact as doubles. Time stamps in ns
    remain integers, because most of them are too large for that.
    """
    if column.is_text:
        is_event_table = not table.kind
        return column.values.reshape(-1, 1) if is_event_table else column.texts()

    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    if is_stamp or values.dtype != np.int64:
        return values

    is_exact = bool((np.abs(values) <= _MAX_EXACT_INTEGER).all())
    return values.astype(np.float64) if is_exact else values


FORMAT = ExportFormat(_write, ".mat", extra=_EXTRA, module="scipy.io")

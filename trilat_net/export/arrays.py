"""One file with every column as an array: NPZ for NumPy, MAT for MATLAB.

Law: a number read back is the number, bit for bit; names are the columns', and the file says what they are.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..extra import extra
from ..log.reader import Log
from ..log.table import Column, Table
from ..log.tables import all_tables
from .about import about, table_facts
from .folder import Write

_EXACT = 2**53
"""Whole numbers up to here are exact as floats, which is what MATLAB computes with."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global",
    "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip
"""What no variable may be called in MATLAB."""


def npz_file() -> Write:
    """Returns what writes NPZ: arrays "m1/q1_rad", "m1/link/age_s_us", "events/text", and two texts."""
    return _write_npz


def mat_file() -> Write:
    """Returns what writes MAT: a struct per site (`m1.q1_rad`, `m1.link.age_s_us`), `events`, and two texts.

    Raises:
        UsageError: scipy is not installed.
    """
    savemat = extra("scipy.io", "mat", "MAT files").savemat
    return lambda log, path, written: _write_mat(log, path, written, savemat)


def _write_npz(log: Log, path: Path, written: Callable[[int], None]) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    facts = []
    for table in all_tables(log):
        place = table.name if table.kind in ("", "state") else f"{table.name}/{table.kind}"
        for column in table.columns:
            arrays[f"{place}/{column.name}"] = _texts(column) if column.is_text else column.numbers()
        facts.append((place, table_facts(table)))
        written(len(table) if table.kind == "state" else 0)
    arrays["about_json"] = np.array(about(log, facts))
    arrays["scenario_toml"] = np.array(log.scenario_text)
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # its stubs take every name for allow_pickle's


def _write_mat(log: Log, path: Path, written: Callable[[int], None], savemat: Callable[..., None]) -> None:
    variables: dict[str, Any] = {}
    facts = []
    for table in all_tables(log):
        name = f"{table.name}_site" if table.name in _KEYWORDS else table.name
        struct: dict[str, Any] = {column.name: _matlab(column, table) for column in table.columns}
        struct["units"] = {column.name: column.unit for column in table.columns}
        if table.kind in ("", "state"):
            variables[name] = struct
            facts.append((name, table_facts(table)))
        else:
            variables[name][table.kind] = struct
            facts.append((f"{name}.{table.kind}", table_facts(table)))
        written(len(table) if table.kind == "state" else 0)
    variables |= {"about_json": about(log, facts), "scenario_toml": log.scenario_text}
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        text = f"too large for a MAT file ({error}); export it --to npz, or --to parquet"
        raise UsageError(f"{log.source}: {text}") from None


def _texts(column: Column) -> NDArray[Any]:
    return np.array(column.values.tolist(), dtype=np.str_)


def _matlab(column: Column, table: Table) -> Any:
    """Returns a column as MATLAB has it: doubles where they are exact, rows of characters or cells."""
    if column.is_text:
        return _texts(column) if table.kind else column.values.reshape(-1, 1)
    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    if is_stamp or values.dtype.kind not in "iu" or not _exact(values):
        return values
    return values.astype(np.float64)


def _exact(values: NDArray[Any]) -> bool:
    return values.dtype == np.int64 and bool((np.abs(values) <= _EXACT).all())

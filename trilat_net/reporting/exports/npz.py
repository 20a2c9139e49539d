"""Exports a log as a NumPy file (.npz) with an array per column of its tables."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...log.data_tables import Column, Table
from ...log.log_reader import Log
from ..export import ExportFormat, Written, name_inside, read_texts, store_tables


def _write(log: Log, path: Path, written: Written) -> None:
    """Writes the columns of a log as arrays, and two texts.

    The arrays have names such as "m1/q1_rad", "m1/link/age_s_us" and "events/text". The texts
    are the description, "about_json", and the scenario, "scenario_toml".
    """
    arrays: dict[str, NDArray[Any]] = {}

    def store(table: Table, table_name: str) -> None:
        for column in table.columns:
            arrays[f"{table_name}/{column.name}"] = _build_array(column)

    description = store_tables(log, written, _name_table, store)
    arrays["about_json"] = np.array(description)
    arrays["scenario_toml"] = np.array(log.scenario_text)
    with path.open("wb") as stream:
        # the stubs of NumPy take every keyword for `allow_pickle`
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def _name_table(table: Table) -> str:
    """Returns the name of a table in the file."""
    return name_inside(table, table.name, "/")


def _build_array(column: Column) -> NDArray[Any]:
    """Returns the values of a column as an array of numbers or of texts."""
    return read_texts(column) if column.is_text else column.numbers()


FORMAT = ExportFormat(_write, ".npz")

"""Exports a log as a NumPy file (.npz) with one array per table column.

Array names look like "m1/q1_rad", "m1/link/age_s_us" and "events/text". The entry "about_json"
describes all columns, and the entry "scenario_toml" contains the scenario.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...log import Log, Table
from ..export import ExportFormat, Written, name_inside, store_tables


def _write(log: Log, path: Path, written: Written) -> None:
    """Exports a log as a NumPy .npz file: columns as arrays, with description and scenario.

    Args:
        log: Log of the run to export.
        path: The file.
        written: Function that is called with the number of records written since the last call.
    """
    arrays: dict[str, NDArray[Any]] = {}

    def store(table: Table, table_name: str) -> None:
        """Adds each column of a table to the arrays of the NumPy file (NPZ).

        Args:
            table: Table of the log, such as the records of a site.
            table_name: Name of the table, used as the prefix of its array names.
        """
        for column in table.columns:
            values = column.texts() if column.is_text else column.numbers()
            arrays[f"{table_name}/{column.name}"] = values

    description = store_tables(log, written, _name_table, store)
    arrays["about_json"] = np.array(description)
    arrays["scenario_toml"] = np.array(log.scenario_text)
    with path.open("wb") as stream:
        # The type stubs of NumPy mistake every keyword for `allow_pickle`.
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def _name_table(table: Table) -> str:
    """Returns the name of a table in the file, such as "m1" or "m1/link"."""
    return name_inside(table, table.name, "/")


FORMAT = ExportFormat(_write, ".npz")

"""A NumPy file with an array per column."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...log.data_tables import Table
from ...log.log_reader import Log
from ..export import ExportFormat, Written, name_inside, read_texts, store_tables


def _write(log: Log, path: Path, written: Written) -> None:
    """Writes arrays "m1/q1_rad", "m1/link/age_s_us", "events/text", and two texts."""
    arrays: dict[str, NDArray[Any]] = {}

    def store(table: Table, place: str) -> None:
        for column in table.columns:
            arrays[f"{place}/{column.name}"] = (
                read_texts(column) if column.is_text else column.numbers()
            )

    about = store_tables(log, written, lambda table: name_inside(table, table.name, "/"), store)
    arrays |= {"about_json": np.array(about), "scenario_toml": np.array(log.scenario_text)}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # its stubs take every name for allow_pickle's


FORMAT = ExportFormat(_write, ".npz")

"""Export of a log's tables: a folder of CSV or Parquet files, or one file for NumPy or MATLAB.

Invariant: a number read back is the same, bit for bit. An export describes itself: unit, meaning and
source of every column, and its session.
"""

import csv
import io
import json
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..files import import_extra
from ..log.data_tables import Column, Table, to_data_frame
from ..log.log_layout import SCENARIO, collect_provenance
from ..log.log_reader import Log

TableFacts = dict[str, Any]

EXPORT_MANIFEST = "about.json"
"""File of an exported folder; it distinguishes such a folder from any other."""


def describe_table(table: Table) -> TableFacts:
    """Returns the description of a table's rows and columns."""
    return {
        "row": table.about,
        "rows": len(table),
        "columns": {
            column.name: {"unit": column.unit, "meaning": column.meaning, "source": column.source}
            for column in table.columns
        },
    }


def describe_export(log: Log, tables: Iterable[tuple[str, TableFacts]]) -> str:
    """Returns the description of an export as JSON, with that of every table by its place."""
    facts = {
        "exported_by": f"trilat-net {collect_provenance()['version_trilat-net']}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": dict(tables),
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


_ROWS = 4096
"""Rows that are converted to text together."""

WriteExport = Callable[[Log, Path, Callable[[int], None]], None]
"""Writes a log to a path; calls a function with the number of records just written."""


def make_csv_writer() -> WriteExport:
    """Returns the writer of CSV: a line of names, then a row per line, numbers as Python shows them."""
    return partial(_write, ".csv", _write_csv)


def make_parquet_writer() -> WriteExport:
    """Returns the writer of Parquet.

    Raises:
        UsageError: polars is not installed.
    """
    import_extra("polars", "frames", "Parquet files")
    return partial(_write, ".parquet", _write_parquet)


def _write(
    ending: str,
    write: Callable[[Table, Path], Any],
    log: Log,
    folder: Path,
    written: Callable[[int], None],
) -> None:
    facts = []
    for table in log.tables():
        name = f"{table.label}{ending}"
        write(table, folder / name)
        facts.append((name, describe_table(table)))
        written(len(table) if table.kind == "state" else 0)
    (folder / EXPORT_MANIFEST).write_text(describe_export(log, facts), encoding="utf-8")
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def _write_csv(table: Table, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(column.name for column in table.columns)
        for first in range(0, len(table), _ROWS):
            columns = (column.rows(first, first + _ROWS) for column in table.columns)
            writer.writerows(zip(*columns, strict=True))


def _write_parquet(table: Table, path: Path) -> None:
    made = io.BytesIO()  # a full disk is reported here, not by polars
    to_data_frame(table).write_parquet(made, compression="zstd")
    path.write_bytes(made.getbuffer())


_EXACT = 2**53
"""Largest integer up to which all are exact as floats, the numbers of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global",
    "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""


def make_npz_writer() -> WriteExport:
    """Returns the writer of NPZ: arrays "m1/q1_rad", "m1/link/age_s_us", "events/text", and two texts."""
    return _write_npz


def make_mat_writer() -> WriteExport:
    """Returns the writer of MAT: a struct per site (`m1.q1_rad`, `m1.link.age_s_us`), `events`, two texts.

    Raises:
        UsageError: scipy is not installed.
    """
    savemat = import_extra("scipy.io", "mat", "MAT files").savemat
    return lambda log, path, written: _write_mat(log, path, written, savemat)


def _write_npz(log: Log, path: Path, written: Callable[[int], None]) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    facts = []
    for table in log.tables():
        place = table.name if table.kind in ("", "state") else f"{table.name}/{table.kind}"
        for column in table.columns:
            arrays[f"{place}/{column.name}"] = _texts(column) if column.is_text else column.numbers()
        facts.append((place, describe_table(table)))
        written(len(table) if table.kind == "state" else 0)
    arrays["about_json"] = np.array(describe_export(log, facts))
    arrays["scenario_toml"] = np.array(log.scenario_text)
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # its stubs take every name for allow_pickle's


def _write_mat(log: Log, path: Path, written: Callable[[int], None], savemat: Callable[..., None]) -> None:
    variables: dict[str, Any] = {}
    facts = []
    for table in log.tables():
        name = f"{table.name}_site" if table.name in _KEYWORDS else table.name
        struct: dict[str, Any] = {column.name: _matlab(column, table) for column in table.columns}
        struct["units"] = {column.name: column.unit for column in table.columns}
        if table.kind in ("", "state"):
            variables[name] = struct
            facts.append((name, describe_table(table)))
        else:
            variables[name][table.kind] = struct
            facts.append((f"{name}.{table.kind}", describe_table(table)))
        written(len(table) if table.kind == "state" else 0)
    variables |= {"about_json": describe_export(log, facts), "scenario_toml": log.scenario_text}
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        text = f"too large for a MAT file ({error}); export it --to npz, or --to parquet"
        raise UsageError(f"{log.source}: {text}") from None


def _texts(column: Column) -> NDArray[Any]:
    return np.array(column.values.tolist(), dtype=np.str_)


def _matlab(column: Column, table: Table) -> Any:
    """Returns a column for MATLAB: doubles if they are exact, rows of characters or cells."""
    if column.is_text:
        return _texts(column) if table.kind else column.values.reshape(-1, 1)
    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    if is_stamp or values.dtype.kind not in "iu" or not _exact(values):
        return values
    return values.astype(np.float64)


def _exact(values: NDArray[Any]) -> bool:
    return values.dtype == np.int64 and bool((np.abs(values) <= _EXACT).all())

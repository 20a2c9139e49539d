"""Export of a log for other tools: a ROS 2 bag, a folder of CSV or Parquet files, or a NumPy or MATLAB file.

Invariant: a number read back is the same, bit for bit. An export describes itself: unit, meaning and source
of every column, and its session. What can be refused is refused before anything is read or written.
"""

import csv
import io
import json
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..files import import_extra, refuse_existing, stage_output
from ..log.data_tables import Column, Table, to_data_frame
from ..log.log_layout import SCENARIO, collect_provenance
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from .ros2_bag import export_ros2

EXPORT_MANIFEST = "about.json"
"""File of an exported folder; it distinguishes such a folder from any other."""
_ROWS = 4096
"""Rows that are converted to text together."""
_EXACT = 2**53
"""Largest integer up to which all are exact as floats, the numbers of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global",
    "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""

_Written = Callable[[int], None]
"""Called with the number of records just written."""


class ExportFormat(StrEnum):
    """A format of exports."""

    ROS2 = "ros2"
    PARQUET = "parquet"
    CSV = "csv"
    NPZ = "npz"
    MAT = "mat"


_EXTRAS = {
    ExportFormat.PARQUET: ("polars", "frames", "Parquet files"),
    ExportFormat.MAT: ("scipy.io", "mat", "MAT files"),
}


class Exporter:
    """An export to a file, or to a folder of CSV or Parquet files, which is refused before a log is read.

    Raises:
        UsageError: the place is taken and `force` is false, or a package is missing.
    """

    def __init__(self, form: ExportFormat, path: Path, *, force: bool = False) -> None:
        self._form, self._path, self._force = form, path, force
        self._manifest = EXPORT_MANIFEST if form in (ExportFormat.CSV, ExportFormat.PARQUET) else None
        refuse_existing(path, force=force, manifest=self._manifest)
        if form in _EXTRAS:
            import_extra(*_EXTRAS[form])

    def export(self, log: Log, progress: Progress = lambda _done, _total: None) -> None:
        """Exports a log; `progress` is called with the number of records that are written, and of all.

        Raises:
            LogError: a record cannot be read.
            LogRefused: the disk is full.
            UsageError: the place cannot be written to.
        """
        total = sum(len(log[site]) for site in log.sites)
        done = 0

        def written(records: int) -> None:
            nonlocal done
            done += records
            progress(done, total)

        with stage_output(self._path, force=self._force, manifest=self._manifest) as path:
            _WRITERS[self._form](log, path, written)


def default_export_path(form: ExportFormat, first: Path) -> Path:
    """Returns the default path of an export: next to the log, or its first part, and named after it."""
    name = first.name.removesuffix(".active").removesuffix(".mcap")
    ending = {ExportFormat.NPZ: ".npz", ExportFormat.MAT: ".mat", ExportFormat.ROS2: "-ros2.mcap"}
    return first.with_name(name + ending.get(form, f"-{form}"))


def _store_tables(
    log: Log, written: _Written, place: Callable[[Table], str], store: Callable[[Table, str], Any]
) -> str:
    """Stores every table at its place, and returns the description of the export as JSON."""
    tables = {}
    for table in log.tables():
        where = place(table)
        store(table, where)
        columns = {c.name: {"unit": c.unit, "meaning": c.meaning, "source": c.source} for c in table.columns}
        tables[where] = {"row": table.about, "rows": len(table), "columns": columns}
        written(len(table) if table.kind == "state" else 0)
    facts = {
        "exported_by": f"trilat-net {collect_provenance()['version_trilat-net']}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": tables,
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


def _write_csv(log: Log, folder: Path, written: _Written) -> None:
    """Writes CSV files: a line of names, then a row per line, numbers as Python shows them."""

    def store(table: Table, name: str) -> None:
        with (folder / name).open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(column.name for column in table.columns)
            for first in range(0, len(table), _ROWS):
                columns = (column.rows(first, first + _ROWS) for column in table.columns)
                writer.writerows(zip(*columns, strict=True))

    _describe_folder(log, folder, _store_tables(log, written, lambda table: f"{table.label}.csv", store))


def _write_parquet(log: Log, folder: Path, written: _Written) -> None:
    def store(table: Table, name: str) -> None:
        made = io.BytesIO()  # a full disk is reported here, not by polars
        to_data_frame(table).write_parquet(made, compression="zstd")
        (folder / name).write_bytes(made.getbuffer())

    _describe_folder(log, folder, _store_tables(log, written, lambda table: f"{table.label}.parquet", store))


def _describe_folder(log: Log, folder: Path, about: str) -> None:
    (folder / EXPORT_MANIFEST).write_text(about, encoding="utf-8")
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def _place(table: Table, name: str, separator: str) -> str:
    return name if table.kind in ("", "state") else f"{name}{separator}{table.kind}"


def _write_npz(log: Log, path: Path, written: _Written) -> None:
    """Writes arrays "m1/q1_rad", "m1/link/age_s_us", "events/text", and two texts."""
    arrays: dict[str, NDArray[Any]] = {}

    def store(table: Table, place: str) -> None:
        for column in table.columns:
            arrays[f"{place}/{column.name}"] = _texts(column) if column.is_text else column.numbers()

    about = _store_tables(log, written, lambda table: _place(table, table.name, "/"), store)
    arrays |= {"about_json": np.array(about), "scenario_toml": np.array(log.scenario_text)}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # its stubs take every name for allow_pickle's


def _write_mat(log: Log, path: Path, written: _Written) -> None:
    """Writes a struct per site (`m1.q1_rad`, `m1.link.age_s_us`), `events`, and two texts."""
    variables: dict[str, Any] = {}

    def store(table: Table, place: str) -> None:
        struct: dict[str, Any] = {column.name: _matlab(column, table) for column in table.columns}
        struct["units"] = {column.name: column.unit for column in table.columns}
        name, _, kind = place.partition(".")
        (variables[name] if kind else variables)[kind or name] = struct

    def place_of(table: Table) -> str:
        return _place(table, f"{table.name}_site" if table.name in _KEYWORDS else table.name, ".")

    about = _store_tables(log, written, place_of, store)
    variables |= {"about_json": about, "scenario_toml": log.scenario_text}
    savemat = import_extra(*_EXTRAS[ExportFormat.MAT]).savemat
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
    exact = values.dtype == np.int64 and bool((np.abs(values) <= _EXACT).all())
    if is_stamp or values.dtype.kind not in "iu" or not exact:
        return values
    return values.astype(np.float64)


_WRITERS: dict[ExportFormat, Callable[[Log, Path, _Written], None]] = {
    ExportFormat.ROS2: export_ros2,
    ExportFormat.PARQUET: _write_parquet,
    ExportFormat.CSV: _write_csv,
    ExportFormat.NPZ: _write_npz,
    ExportFormat.MAT: _write_mat,
}

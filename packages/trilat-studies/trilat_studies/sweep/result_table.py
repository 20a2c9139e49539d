"""Reads and writes results.csv, the table of a sweep with one row per run.

A sweep may have millions of runs, more than fit into memory. Rows are therefore written one by
one, and a large table stays on disk while it is used. `ResultTable` builds the row of a
finished run, including the command that repeats the run.

Invariant:
    - Reading the CSV table restores all numbers bit for bit.
    - A row in memory equals the same row in the file.
"""

import csv
import io
import json
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, overload

import msgspec

from trilat_net.errors import UsageError
from trilat_net.work import encode_csv

from .sweep_cell import CellResult, CellRun, apply_diff, diff_lines
from .sweep_plan import SweepPlan

ResultRow = Mapping[str, Any]
"""One run, as a mapping with these keys: `cell`, the value on each axis under the key of the
axis, `law`, `seed`, `random`, the further metrics under their keys, all fields of `CellResult`,
`scenario_sha256`, `command` and `scenario`. The classes of the run are strings. `scenario` is
the canonical text of the scenario that was run.
"""
ROWS_IN_MEMORY = 20_000
"""Largest number of table rows that are kept in memory, at about 5 kB each."""
_SCENARIO_COLUMN = "scenario_changes"
"""Column of the CSV table for the scenario of a row. To save space, it contains only the
differences from the swept scenario, as JSON.
"""

_LONGEST_CELL = 2**26
"""Largest number of characters in a cell of the CSV table. A scenario with a delay trace
exceeds the default limit of the csv module, 131 072 characters.
"""


def encode_table(
    rows: Iterable[Mapping[str, Any]], column_types: Mapping[str, type]
) -> Iterator[str]:
    """Yields a table as CSV text line by line, so that a large table needs little memory.

    Args:
        rows: The rows, each a mapping from column name to value.
        column_types: Column names in order of output, mapped to the type of their values.

    Yields:
        The header line, then one line per row. Numbers can be read back bit for bit.
    """
    columns = list(column_types)
    yield encode_csv([], columns)
    for row in rows:
        texts = {name: _format_cell(row[name], kind) for name, kind in column_types.items()}
        yield encode_csv([texts], columns, header=False)


class ResultTable:
    """Columns of a sweep's results.csv, for writing and reading its rows.

    The columns depend on the sweep, because each swept parameter has a column.

    Args:
        plan: The sweep.
    """

    def __init__(self, plan: SweepPlan) -> None:
        self._plan = plan
        self._kinds = _list_result_columns(plan)
        self._has_text_axis = not all(axis.numeric for axis in plan.axes)

    @property
    def columns(self) -> list[str]:
        """Names of all columns, in the order of the CSV file."""
        return [*self._kinds, _SCENARIO_COLUMN]

    def encode(self, rows: Iterable[ResultRow]) -> Iterator[str]:
        """Yields the results as CSV text: the header line, then one line per row.

        Args:
            rows: The rows, one per run, each a mapping from column name to value.
        """
        column_types = {**self._kinds, _SCENARIO_COLUMN: str}
        yield from encode_table(map(self._add_changes, rows), column_types)

    def _add_changes(self, row: ResultRow) -> ResultRow:
        """Returns a row with the column that represents its scenario in the CSV table."""
        changes = diff_lines(row["scenario"], self._plan.base.text)
        return {**row, _SCENARIO_COLUMN: json.dumps(changes, ensure_ascii=False)}

    def parse(self, line: Mapping[str, str]) -> ResultRow:
        """Converts one line of the CSV table to a row, and restores the text of its scenario.

        To save space, the table contains only the differences from the swept scenario.

        Args:
            line: Mapping from column name to the string in the file.
        """
        row = {name: _parse_cell(line[name], kind) for name, kind in self._kinds.items()}
        # A run that was not simulated has no motion.
        row["motion"] = row["motion"] or None
        if self._has_text_axis:
            # An axis of words may contain numbers. Their texts look the same as those of words.
            values = self._plan.cell(row["cell"]).values
            for axis, value in zip(self._plan.axes, values, strict=True):
                row[axis.key] = value
        row["scenario"] = apply_diff(json.loads(line[_SCENARIO_COLUMN]), self._plan.base.text)
        return row

    def read_rows(self, file: Path) -> Sequence[ResultRow]:
        """Reads the results of a sweep. The rows of a large table stay on disk.

        Args:
            file: The CSV table.

        Raises:
            UsageError: The table cannot be read.
        """
        rows = StoredRows(file, self)
        return list(rows) if len(rows) <= ROWS_IN_MEMORY else rows

    def iterate_cells(self, done: Mapping[tuple[int, int], CellRun]) -> Iterator[list[CellRun]]:
        """Yields the finished runs of each cell, ordered by cell and then by seed.

        The fixed order makes the results independent of the order in which worker processes
        finish.

        Args:
            done: The finished runs, by cell and seed.
        """
        seeds = self._plan.seeds
        cells: Iterable[int] = (cell for cell, _ in done)
        if len(seeds) > 1:
            cells = set(cells)  # a cell has an entry for each seed
        for cell in sorted(cells):
            yield [done[cell, seed] for seed in seeds if (cell, seed) in done]

    def build_rows(self, runs: Sequence[CellRun]) -> Iterator[ResultRow]:
        """Yields the results of one cell, with one row per run.

        Args:
            runs: All finished runs of the cell.
        """
        for entry in runs:
            # The log of a cell with a single run needs no seed in its name.
            suffix = f"-seed-{entry.seed}" if len(runs) > 1 else ""
            yield self._build_row(entry, f"cell-{entry.cell}{suffix}.mcap")

    def _build_row(self, entry: CellRun, log: str) -> ResultRow:
        """Returns the table row of a finished run, including the command that repeats it.

        Args:
            entry: The run.
            log: Name of the log that the command in the row records.
        """
        plan = self._plan
        cell = plan.cell(entry.cell)
        command = plan.build_sim_command(
            overrides=cell.overrides,
            seed=entry.seed,
            duration_s=plan.reproduction_duration_s(entry.outcome),
            log=log,
        )

        axis_keys = [axis.key for axis in plan.axes]
        axis_values = dict(zip(axis_keys, cell.values, strict=True))

        scenario_text = apply_diff(entry.scenario, plan.base.text)
        return {
            "cell": cell.number,
            **axis_values,
            "law": entry.law,
            "seed": entry.seed,
            "random": entry.random,
            **entry.metrics,
            **msgspec.to_builtins(entry.outcome),
            "scenario_sha256": entry.sha256,
            "command": command,
            "scenario": scenario_text,
        }


class StoredRows(Sequence[ResultRow]):
    """Rows of a results.csv that is too large for memory, read from disk on demand.

    The object can be used like a list. Only the offset of each row (8 bytes) is kept in memory.

    Args:
        file: The CSV table.
        table: Its columns.

    Raises:
        UsageError: The file cannot be read, or a column is missing.
    """

    def __init__(self, file: Path, table: ResultTable) -> None:
        self._file = file
        self._table = table
        self._offsets = array("q")

        offset = 0
        quotes = 0
        with self._explaining_errors():
            with file.open("rb") as stream:
                for line in stream:
                    # A line feed between quotation marks belongs to a text.
                    if quotes % 2 == 0:
                        self._offsets.append(offset)
                    quotes += line.count(b'"')
                    offset += len(line)
            self._offsets.append(offset)
            with file.open(encoding="utf-8", newline="") as stream:
                self._names = _read_next(csv.reader(stream, strict=True)) or []

        for name in table.columns:
            if name not in self._names:
                raise UsageError(
                    f"{file} contains no results of a sweep: the column {name!r} is missing"
                )

    def __len__(self) -> int:
        return max(0, len(self._offsets) - 2)  # the header, and the end of the file

    @overload
    def __getitem__(self, index: int) -> ResultRow: ...

    @overload
    def __getitem__(self, index: slice) -> list[ResultRow]: ...

    def __getitem__(self, index: int | slice) -> ResultRow | list[ResultRow]:
        if isinstance(index, slice):
            return [self[n] for n in range(len(self))[index]]
        line_number = range(len(self))[index] + 1  # line 0 is the header
        first, stop = self._offsets[line_number : line_number + 2]
        with self._explaining_errors():
            with self._file.open("rb") as stream:
                stream.seek(first)
                text = stream.read(stop - first).decode()
            fields = _read_next(csv.reader(io.StringIO(text, newline=""), strict=True))
            return self._table.parse(self._name_fields(fields or []))

    def __iter__(self) -> Iterator[ResultRow]:
        for line in self._iterate_lines():
            with self._explaining_errors():
                row = self._table.parse(line)
            yield row

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence) or len(self) != len(other):
            return NotImplemented if not isinstance(other, Sequence) else False
        return all(row == other_row for row, other_row in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def find_cell(self, number: int) -> list[ResultRow]:
        """Reads the results of one cell, with one row per random seed.

        Args:
            number: Number of the cell.
        """
        text = str(number)
        lines = [line for line in self._iterate_lines() if line["cell"] == text]
        with self._explaining_errors():
            return [self._table.parse(line) for line in lines]

    def _iterate_lines(self) -> Iterator[dict[str, str]]:
        """Yields each row of the file as a mapping from column name to unparsed string."""
        with (
            self._explaining_errors(),
            self._file.open(encoding="utf-8", newline="") as stream,
        ):
            reader = csv.reader(stream, strict=True)
            _read_next(reader)
            while (fields := _read_next(reader)) is not None:
                if fields:
                    yield self._name_fields(fields)

    def _name_fields(self, fields: Sequence[str]) -> dict[str, str]:
        """Maps the column names to the fields of one line of the CSV table.

        Raises:
            ValueError: The row has too few or too many fields.
        """
        return dict(zip(self._names, fields, strict=True))

    @contextmanager
    def _explaining_errors(self) -> Iterator[None]:
        """Converts errors from a damaged CSV table to a UsageError that names the file.

        Raises:
            UsageError: The table cannot be read.
        """
        try:
            yield
        except (OSError, ValueError, TypeError, IndexError, KeyError, csv.Error) as error:
            raise UsageError(
                f"{self._file} cannot be read as results of a sweep: {error}"
            ) from None


def _read_next(reader: Iterator[list[str]]) -> list[str] | None:
    """Reads the next row of a CSV table, whose cells may contain the full text of a scenario.

    The field size limit of the csv module applies to the whole process, so it is raised only
    during this call.

    Returns:
        The fields of the row, or `None` after the last row.
    """
    limit = csv.field_size_limit(_LONGEST_CELL)
    try:
        return next(reader, None)
    finally:
        csv.field_size_limit(limit)


def _list_result_columns(plan: SweepPlan) -> dict[str, type]:
    """Returns the column names of the CSV table, in order, mapped to the type of their values.

    The scenario column is not included, because it needs special treatment.
    """
    column_types = {**plan.list_axis_columns(), "seed": int, "random": bool}
    # All fields of a result are numbers, except those whose types are corrected below.
    number_columns = (*plan.metrics, *CellResult.__struct_fields__)
    column_types |= dict.fromkeys(number_columns, float)
    text_columns = ("verdict", "motion", "reasons", "stability", "rests_on", "scenario_sha256")
    column_types |= dict.fromkeys((*text_columns, "command"), str)
    return column_types | {"extended": int}


def _format_cell(value: Any, kind: type) -> str:
    """Converts a value to a field of a CSV table, from which numbers can be read bit for bit.

    Args:
        value: The value. `None` becomes an empty string.
        kind: Type of the column.
    """
    if value is None:
        return ""
    if kind is bool:
        return "true" if value else "false"
    return repr(float(value)) if kind is float else str(value)


def _parse_cell(text: str, kind: type) -> Any:
    """Converts a field of a sweep's CSV table to a value; the inverse of `_format_cell`.

    Args:
        text: Text of the field.
        kind: Type of the column.

    Raises:
        ValueError: The text is not a number in a numeric column, or is neither "true" nor
            "false" in a column of bools.
    """
    if kind is str:
        return text
    if kind is bool:
        if text not in ("true", "false"):
            raise ValueError(f"{text!r} is neither true nor false")
        return text == "true"
    return kind(text) if text else None

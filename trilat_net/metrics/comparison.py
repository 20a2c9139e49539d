"""Runs side by side: one column per log, one row per quantity.

Law: a row is one quantity of whole runs, by one definition; a run that has none says why.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..log.reader import Log
from .catalogue import QUANTITIES, Quantity
from .measurement import Measurement, measure
from .said import Said


class Row(NamedTuple):
    """A quantity of every run.

    Attributes:
        quantity: what it is: its key, its name, its unit, its group.
        entries: per column the number, or why there is none.
    """

    quantity: Quantity
    entries: tuple[Said, ...]

    @property
    def values(self) -> tuple[float | None, ...]:
        """The numbers, None where there is none."""
        return tuple(entry.value for entry in self.entries)


class Comparison(NamedTuple):
    """Runs side by side.

    Attributes:
        columns: the names of the runs.
        rows: the quantities of which at least one run could have one, in the order of the catalogue.
    """

    columns: tuple[str, ...]
    rows: tuple[Row, ...]

    def row(self, key: str) -> Row:
        """Returns a quantity's row by its key; KeyError where there is none."""
        for row in self.rows:
            if row.quantity.key == key:
                return row
        raise KeyError(key)


def compare(logs: Sequence[Log], names: Sequence[str] = ()) -> Comparison:
    """Returns logs side by side.

    Args:
        logs: the logs; torn, short and empty ones too.
        names: what the columns are called; left out: by the logs' files.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    return beside([measure(log) for log in logs], tuple(names) or tuple(map(_name, logs)))


def beside(measured: Sequence[Measurement], names: Sequence[str]) -> Comparison:
    """Returns measurements side by side.

    Args:
        measured: one per run.
        names: of the columns.
    """
    rows = [Row(quantity, tuple(one.whole(quantity) for one in measured)) for quantity in QUANTITIES]
    kept = tuple(row for row in rows if any(entry.applies for entry in row.entries))
    return Comparison(tuple(names), kept)


def comparison_facts(comparison: Comparison) -> dict[str, Any]:
    """Returns a comparison, ready for JSON: finite numbers, and null with its reason in `unknown`."""
    return {
        "columns": list(comparison.columns),
        "rows": [
            {
                "key": row.quantity.key,
                "name": row.quantity.name,
                "unit": row.quantity.unit,
                "group": row.quantity.group,
                "values": list(row.values),
                "unknown": [entry.why or None for entry in row.entries],
            }
            for row in comparison.rows
        ],
    }


def _name(log: Log) -> str:
    return Path(log.source).stem

"""A part of a log as a table, for programs that know nothing of it.

Law: a column's name ends in its unit, and says with its meaning and its source what it is; a value that does
not exist is none, never a number that stands for it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError

SUFFIXES = {
    "rad": "rad",
    "rad/s": "rad_s",
    "N m": "nm",
    "kg m^2": "kg_m2",
    "kg m": "kg_m",
    "s": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "ns/s": "ppb",
    "tick": "tick",
    "byte": "bytes",
}
"""How a unit stands at the end of a name."""


def named(stem: str, unit: str) -> str:
    """Returns a column's name: what it is, and its unit unless that is named already."""
    suffix = SUFFIXES.get(unit, "")
    return stem if not suffix or stem == suffix or stem.endswith(f"_{suffix}") else f"{stem}_{suffix}"


def whole(values: Iterable[int], source: str, field: str, kind: Any = np.int64) -> NDArray[Any]:
    """Returns whole numbers as an array.

    Args:
        values: the numbers.
        source: what errors call the file.
        field: what they are.
        kind: how an array holds them.

    Raises:
        LogError: 64 bits do not hold one.
    """
    try:
        return np.fromiter(values, kind)
    except OverflowError:
        raise LogError(f"{source}: {field} has a number that is out of range") from None


class Column(NamedTuple):
    """One column.

    Attributes:
        name: its name, with the unit at its end.
        values: its values, shape (K,): numbers, or texts as objects.
        unit: their unit; "" for texts and counts.
        meaning: what they are.
        source: the field of the message that they are from.
        known: which rows have a value, shape (K,); None where all have.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    meaning: str = ""
    source: str = ""
    known: NDArray[np.bool_] | None = None

    @property
    def is_text(self) -> bool:
        """True where the values are texts."""
        return self.values.dtype == np.object_

    def numbers(self) -> NDArray[Any]:
        """Returns the values of a column of numbers, with NaN where there is none."""
        if self.known is None or self.known.all():
            return self.values
        return np.where(self.known, self.values, np.nan)

    def rows(self, first: int, last: int) -> list[Any]:
        """Returns the values of some rows as Python's own numbers and texts, None where there is none."""
        values: list[Any] = self.values[first:last].tolist()
        if self.known is None:
            return values
        known = self.known[first:last].tolist()
        return [value if there else None for value, there in zip(values, known, strict=True)]


@dataclass(frozen=True)
class Table:
    """Columns of one length.

    Attributes:
        name: the site, or what else it is of.
        kind: of a site, what of it: "state", "link" or "arrivals"; else "".
        about: what a row is.
        columns: the columns.
    """

    name: str
    kind: str
    about: str
    columns: tuple[Column, ...] = field(repr=False)

    def __len__(self) -> int:
        return len(self.columns[0].values) if self.columns else 0

    def __getitem__(self, name: str) -> Column:
        """Returns a column by its name.

        Raises:
            KeyError: there is none of that name.
        """
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(f"no column {name!r}; there are {', '.join(column.name for column in self.columns)}")

    @property
    def label(self) -> str:
        """Its name as that of a file: "m1_link", "events"."""
        return f"{self.name}_{self.kind}" if self.kind else self.name

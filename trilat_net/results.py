"""Results of commands and functions, which can be converted to text, a table or JSON.

Terminal commands and functions of the Python interface produce the same objects. The terminal
prints `summary()`, and programs read the values or call `to_dict()`.

Invariant:
    - A result contains only values. Computing modules therefore do not depend on formatting
      modules: the package `presentation` registers the functions that compose texts in `hooks`.
    - JSON output contains no NaN or infinity. An unknown quantity is null.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas

from .files import Extra
from .hooks import find_hook

_REPR_LENGTH = 200


class Result:
    """Base class of the results of all commands and of the corresponding Python functions.

    Each result can be printed as text, printed as JSON, or converted to a pandas data frame. A
    subclass overrides `to_dict` if its JSON keys differ from its fields, and `to_rows` if its
    table has several rows.
    """

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to plain values that can be written as JSON.

        The keys are those printed by the command with --json.
        """
        return dict(vars(self))

    def to_rows(self) -> Sequence[Mapping[str, Any]]:
        """Returns the rows of the result's table, each a mapping from column name to value.

        Used by `to_frame`. By default, there is a single row with all plain values of the
        result.
        """
        values = self.to_dict().items()
        row = {key: value for key, value in values if not isinstance(value, dict | list)}
        return [row]

    def summary(self) -> str:
        """Returns the text that the command prints in the terminal.

        If the command has the option --all, this is the text that it prints with that option.
        """
        return str(find_hook("summarize a result")(self))

    def to_frame(self) -> "pandas.DataFrame":
        """Converts the result to a pandas data frame.

        The rows are those of `to_rows`, with one column per key.

        Raises:
            UsageError: pandas is not installed.
        """
        pandas = Extra("frames", "data frames").import_module("pandas")
        return pandas.DataFrame(list(self.to_rows()))

    def headline(self) -> str:
        """Returns the result in one line: the first non-blank line of its summary.

        This line is shown in lists of several results. Returns "nothing" if the summary is
        empty.
        """
        for line in self.summary().splitlines():
            if line.strip():
                return line.strip()
        return "nothing"

    def __repr__(self) -> str:
        text = self.headline()
        short = text if len(text) <= _REPR_LENGTH else text[:_REPR_LENGTH] + "..."
        return f"<{type(self).__name__} {short}>"

    def _repr_html_(self) -> str:
        return str(find_hook("render a result as HTML")(self))


JsonObject = dict[str, Any]


def finite_or_none(value: float) -> float | None:
    """Returns a number, or None if it is NaN or infinite, which JSON cannot represent.

    Args:
        value: The number.
    """
    return value if math.isfinite(value) else None

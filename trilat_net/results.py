"""Defines what commands and functions return: objects that become text, a table or JSON.

The commands in the terminal and the functions of the Python interface return the same objects.
The terminal prints `summary()`, and programs read the values or call `to_dict()`.

Invariant:
    - A result contains only values. Modules that compute therefore do not depend on modules
      that format: the package `presentation` registers the functions that compose texts in
      `hooks`.
    - JSON contains no NaN and no infinity. An unknown quantity is null.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas

from .files import import_extra
from .hooks import find_hook

_REPR_LENGTH = 200


class Result:
    """Base class of the results of all commands and of the corresponding Python functions.

    Each result can be printed as text, printed as JSON, or converted to a pandas data frame. A
    subclass overrides `to_dict` if its JSON keys differ from its fields, and `to_rows` if its
    table has several rows.
    """

    def to_dict(self) -> dict[str, Any]:
        """Returns the result as plain values, which can be written as JSON.

        The keys are those that the command prints with --json.
        """
        return dict(vars(self))

    def to_rows(self) -> Sequence[Mapping[str, Any]]:
        """Returns the result as rows of a table, for `to_frame`.

        By default, there is one row with all plain values of the result.
        """
        values = self.to_dict().items()
        row = {key: value for key, value in values if not isinstance(value, dict | list)}
        return [row]

    def summary(self) -> str:
        """Returns the text about the result that the command prints in the terminal.

        A command that has the option --all prints the whole text only with this option.
        """
        return str(find_hook("summarize a result")(self))

    def to_frame(self) -> "pandas.DataFrame":
        """Returns the result as a pandas data frame.

        It has the rows of `to_rows`, and one column per key of these rows.

        Raises:
            UsageError: pandas is not installed.
        """
        pandas = import_extra("pandas", "frames", "data frames")
        return pandas.DataFrame(list(self.to_rows()))

    def headline(self) -> str:
        """Returns the result in one line: the first line of its summary that is not blank.

        Lists of several results show this line. A result with an empty summary gives "nothing".
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
    """Returns a number, or None in place of NaN or infinity, which JSON cannot express.

    Args:
        value: The number.

    Returns:
        The number. None if it is NaN or infinite, which JSON cannot express.
    """
    return value if math.isfinite(value) else None

"""What a command found, as an object: in a line, as the text that the command prints, as a
table, as JSON.

Invariant: a result holds values alone. Its text has one home, in `reporting`, which is imported
when it is asked for: so a room that computes knows nothing of what is for eyes. JSON has no
words for NaN and infinity; a quantity that is not known is null.
"""

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas

from .files import import_extra

_REPR_LENGTH = 200


class Result:
    """What a command found. A type states `to_dict` where that is not its fields; `to_rows` for
    many rows.
    """

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of the command's --json."""
        return dict(vars(self))

    def to_rows(self) -> Sequence[Mapping[str, Any]]:
        """Returns the rows of `to_frame`."""
        return [
            {
                key: one
                for key, one in self.to_dict().items()
                if not isinstance(one, dict | list)
            }
        ]

    def summary(self) -> str:
        """Returns the text that the command prints."""
        return str(_texts().summarize(self))

    def to_frame(self) -> "pandas.DataFrame":
        """Returns a pandas data frame.

        Raises:
            UsageError: pandas is not installed.
        """
        return import_extra("pandas", "frames", "data frames").DataFrame(list(self.to_rows()))

    def headline(self) -> str:
        """Returns the result in one line."""
        return next(
            (line.strip() for line in self.summary().splitlines() if line.strip()), "nothing"
        )

    def __repr__(self) -> str:
        text = self.headline()
        short = text if len(text) <= _REPR_LENGTH else text[:_REPR_LENGTH] + "..."
        return f"<{type(self).__name__} {short}>"

    def _repr_html_(self) -> str:
        return str(_texts().render_html(self))


def _texts() -> Any:
    return import_module(f"{__package__}.reporting.result_text")


JsonObject = dict[str, Any]


def finite_or_none(value: float) -> float | None:
    """Returns a number for JSON; None for NaN and infinity."""
    return value if math.isfinite(value) else None

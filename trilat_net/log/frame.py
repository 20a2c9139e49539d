"""A table as a data frame.

Law: names and numbers are the table's, and what does not exist is null.
"""

from typing import TYPE_CHECKING, Any, cast

from ..extra import extra
from .table import Column, Table

if TYPE_CHECKING:
    import polars


def frame(table: Table) -> "polars.DataFrame":
    """Returns a table as a polars data frame.

    Raises:
        UsageError: polars is not installed.
    """
    pl = extra("polars", "frames", "data frames")

    return cast("polars.DataFrame", pl.DataFrame([_series(pl, column) for column in table.columns]))


def _series(pl: Any, column: Column) -> Any:
    if column.is_text:
        made = pl.Series(column.name, column.values.tolist(), dtype=pl.String)
    else:
        made = pl.Series(column.name, column.values)
    if column.known is None:
        return made
    return made.zip_with(pl.Series(column.known), pl.Series([None], dtype=made.dtype))

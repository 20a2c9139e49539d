"""Render the records of a site as HTML for notebooks: a heading and a table of quantities.

Invariant:
    - The table has only fields that the records of this site contain.
    - Rendering does not change the records.
"""

from collections.abc import Iterator
from html import escape

from ..core.vectors import Array
from ..log.site_log import SiteLog
from .result_text import TextTable, format_number

FIELDS = ("q", "qd", "q_des", "e", "tau", "tau_x", "theta_hat", "x", "xd", "wrench")
"""Vectors of a record that the table shows, a row per element."""


def render_site_html(site: SiteLog) -> str:
    """Returns a heading and a table with a row per number of a record.

    A row shows the first, last, least and greatest value over the run. Without records the
    heading stands alone.
    """
    heading = f"<p>{escape(repr(site).strip('<>'))}</p>"
    if not len(site):
        return heading
    headers = ("quantity", "first", "last", "least", "greatest", "meaning")
    table = TextTable(headers, list(_list_rows(site)), align="lrrrrl")
    return heading + table.html()


def _list_rows(site: SiteLog) -> Iterator[list[str]]:
    """Yields the rows of the table: the time, then a row per element of each field."""
    start = format_number(float(site.t_s[0]))
    end = format_number(float(site.t_s[-1]))
    yield ["t_s", start, end, start, end, "time, s"]
    for field in FIELDS:
        vectors = getattr(site, field)
        for index, values in enumerate(vectors.T):
            # the meaning stands in the first row of a field alone
            meaning = _describe_field(field) if index == 0 else ""
            yield [f"{field}[{index}]", *_summarize(values), meaning]


def _summarize(values: Array) -> list[str]:
    """Returns the first, last, least and greatest of the values, shape (K,), as text."""
    numbers = (values[0], values[-1], values.min(), values.max())
    return [format_number(float(number)) for number in numbers]


def _describe_field(field: str) -> str:
    """Returns the first line of the docstring of a field of `SiteLog`."""
    docstring = getattr(SiteLog, field).__doc__ or ""
    return docstring.split("\n")[0].rstrip(".")

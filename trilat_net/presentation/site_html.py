"""Renders the records of an arm as HTML for Jupyter notebooks.

A notebook shows this HTML when a cell ends with `log["m1"]`: a heading, and a table that
summarises each quantity over the run.

Invariant:
    - The table contains only quantities that are present in the records of this arm.
    - Rendering does not modify the records.
"""

from collections.abc import Iterator

from markupsafe import Markup

from ..core import Array
from ..log import SiteLog
from .html_templates import render_macro
from .result_text import TextTable, format_number

FIELDS = ("q", "qd", "q_des", "e", "tau", "tau_x", "theta_hat", "x", "xd", "wrench")
"""Record vectors shown in the table, with one row per component."""


def render_site_html(site: SiteLog) -> Markup:
    """Renders the records of a site as HTML, for display in a notebook.

    The heading is followed by a table with one row per vector component in a record. Each row
    contains the first, last, smallest and largest value over the run. If there are no records,
    only the heading is rendered.

    Args:
        site: Records of the site.
    """
    heading = render_macro("result.html", "heading", text=repr(site).strip("<>"))
    if not len(site):
        return heading

    headers = ("quantity", "first", "last", "least", "greatest", "meaning")
    table = TextTable(headers, list(_list_rows(site)), align="lrrrrl")
    return heading + table.html()


def _list_rows(site: SiteLog) -> Iterator[list[str]]:
    """Yields the rows of the table: the time, then one row per component of each vector."""
    start = format_number(float(site.t_s[0]))
    end = format_number(float(site.t_s[-1]))
    yield ["t_s", start, end, start, end, "time, s"]
    for field in FIELDS:
        vectors = getattr(site, field)
        for index, values in enumerate(vectors.T):
            # Only the first row of a vector states its meaning.
            meaning = _describe_field(field) if index == 0 else ""
            yield [f"{field}[{index}]", *_summarize(values), meaning]


def _summarize(values: Array) -> list[str]:
    """Returns the first, last, minimum and maximum of the values, shape (K,), as strings."""
    numbers = (values[0], values[-1], values.min(), values.max())
    return [format_number(float(number)) for number in numbers]


def _describe_field(field: str) -> str:
    """Returns the meaning of a vector: the first line of the docstring of its property."""
    docstring = getattr(SiteLog, field).__doc__ or ""
    return docstring.split("\n")[0].rstrip(".")

"""The records of a site as HTML, for notebooks: what they are, and a table of their quantities.

Invariant: the table has only fields that the records of this site contain, and looking at it
changes nothing.
"""

from collections.abc import Iterator
from html import escape

from ..log.site_log import SiteLog
from .result_text import TextTable, format_number

FIELDS = ("q", "qd", "q_des", "e", "tau", "tau_x", "theta_hat", "x", "xd", "wrench")


def render_site_html(site: SiteLog) -> str:
    """Returns a heading, and a row per number of a record with its values over the run."""
    heading = f"<p>{escape(repr(site).strip('<>'))}</p>"
    if not len(site):
        return heading
    heads = ("quantity", "first", "last", "least", "greatest", "meaning")
    return heading + TextTable(heads, list(_rows(site)), align="lrrrrl").html()


def _rows(site: SiteLog) -> Iterator[tuple[str, ...]]:
    yield ("t_s", *(format_number(float(site.t_s[n])) for n in (0, -1, 0, -1)), "time, s")
    for field in FIELDS:
        values = getattr(site, field)
        meaning = (getattr(type(site), field).__doc__ or "").split("\n")[0].rstrip(".")
        for n in range(values.shape[1]):
            column = values[:, n]
            numbers = (column[0], column[-1], column.min(), column.max())
            yield (
                f"{field}[{n}]",
                *(format_number(float(number)) for number in numbers),
                meaning,
            )
            meaning = ""

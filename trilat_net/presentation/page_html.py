"""Renders small pieces of HTML, such as tables, for the report of a run.

The modules `page_...` compose the sections of the report from these pieces.

Invariant:
    - Every function that renders HTML returns `Markup`. Plain strings that become part of this
      HTML are escaped.
    - A reader who uses the keyboard can scroll every region that scrolls sideways.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from ..log import Log
from .html_templates import render_macro

NO_NUMBER = "–"
"""Cell of a missing number."""


def render_section(heading: str, intro: str, body: Markup, name: str = "") -> Markup:
    """Renders a section of a report's web page: heading, explaining sentence and content.

    Args:
        heading: Heading, as plain text.
        intro: Sentence that says what the reader sees, as plain text. Text in backticks is
            shown as code.
        body: HTML of the content.
        name: Identifier of the section, for links and style. Empty for no identifier.
    """
    return _render("section", heading=heading, intro=intro, body=body, name=name)


def render_details(summary: str, body: Markup, *, is_open: bool = False) -> Markup:
    """Renders content that readers can unfold, so that the page stays short at first.

    Args:
        summary: Line that is always visible, as plain text.
        body: HTML of the content.
        is_open: True if the content is unfolded at first.
    """
    return _render("details", summary=summary, body=body, is_open=is_open)


def render_folds(folds: Iterable[Markup]) -> Markup:
    """Renders several parts that unfold side by side, for details that few readers need.

    While the parts are folded, they take up one line.

    Args:
        folds: HTML of each part, from `render_details`. Empty for a part that does not exist.
    """
    return _render("folds", folds=folds)


def render_note(text: str) -> Markup:
    """Renders a remark as an HTML paragraph in small type, for example below a chart.

    Args:
        text: The remark, as plain text.
    """
    return _render("note", text=text)


def render_facts(facts: Iterable[tuple[str, str]]) -> Markup:
    """Renders a table with two columns: the name and the text of each fact about a run.

    If the table is wider than the screen, it scrolls inside its own frame.
    """
    return render_scrolling(_render("facts", facts=facts), "facts")


def render_table(
    columns: Mapping[str, str], rows: Iterable[Sequence[str]], text_columns: Sequence[int] = ()
) -> Markup:
    """Renders a table as HTML, which scrolls sideways if the screen is too narrow.

    Args:
        columns: Meaning of each column, by its header. Both are plain text. The meaning is
            shown while the pointer rests on the header. It is empty for a header that needs no
            explanation.
        rows: Rows of cells, one cell per column. A cell is plain text, or `Markup` if it
            contains a coloured square or line breaks.
        text_columns: Indices of the columns that hold texts, which may wrap. The first column
            is always a text.
    """
    table = _render("table", columns=columns, rows=rows, text_columns=text_columns)
    return render_scrolling(table, next(iter(columns)))


def render_legend(columns: Mapping[str, str]) -> Markup:
    """Renders the meanings of a table's columns as a line of text, for touch screens.

    On other screens, the meaning of a column is shown while the pointer is on its header.

    Args:
        columns: Meanings of the columns by header. Columns with an empty meaning are left out.

    Returns:
        The line. Empty if no column has a meaning.
    """
    items = [f"{header}: {meaning}" for header, meaning in columns.items() if meaning]
    return _render("legend", text="; ".join(items)) if items else Markup()


def render_scrolling(content: Markup, label: str) -> Markup:
    """Renders wide content in a region that scrolls sideways, also by the keyboard.

    The page itself then never becomes wider than the screen.

    Args:
        content: HTML of the content of the region.
        label: Name of the region for screen readers, as plain text.
    """
    return _render("scrolling", content=content, label=label)


def render_code(text: str) -> Markup:
    """Renders commands or the content of a file as HTML in a fixed-width type.

    Line breaks are kept.

    Args:
        text: The commands or the content, as plain text.
    """
    return _render("code", text=text)


def label_site(log: Log, name: str) -> Markup:
    """Renders the label of a site in a table, for example "m1 (master)".

    A square before the label has the colour of the site in all charts.
    """
    role = log.scenario.sites[name].role
    return _render("labelled", index=log.sites.index(name), text=f"{name} ({role})")


def label_link(log: Log, link: str) -> Markup:
    """Renders the label of a link in a table, for example "m1 → s" for the link "m1->s".

    A square before the label has the colour of the sending site.
    """
    peer, site = link.split("->")
    return _render("labelled", index=log.sites.index(peer), text=f"{peer} → {site}")


def _render(macro: str, **values: Any) -> Markup:
    """Renders a macro of the template that contains the pieces of a page."""
    return render_macro("parts.html", macro, **values)


def format_cell(value: float | None) -> str:
    """Returns the text of a number in a table, such as "15000" or "0.1235" for 0.12346.

    Integers are printed with all digits, other numbers with four significant digits. A missing
    number (`None`) is a dash.
    """
    if value is None:
        return NO_NUMBER
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def format_numbers(values: Iterable[float] | None) -> str:
    """Returns numbers as one cell of a table, for example "0.1000, -0.2500".

    `None`, for values that do not exist, gives a dash.
    """
    if values is None:
        return NO_NUMBER
    return ", ".join(f"{value:.4f}" for value in values)


def to_percent(share: float | None) -> float | None:
    """Converts a fraction to percent: 0.05 gives 5. `None` (unknown) gives `None`."""
    return None if share is None else 100.0 * share

"""Renders small pieces of HTML, such as tables, for the report of a run.

The `page_...` modules build the sections of the report from these pieces.

Invariant:
    - Every function that renders HTML returns `Markup`, and escapes plain strings that become
      part of it.
    - Every region that scrolls sideways can also be scrolled with the keyboard.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from .html_templates import render_macro

NO_NUMBER = "–"
"""Cell content for a missing number."""


def render_section(heading: str, intro: str, body: Markup, name: str = "") -> Markup:
    """Renders a section of a report's web page: heading, introductory sentence and content.

    Args:
        heading: Heading, as plain text.
        intro: Sentence that explains what the section shows, as plain text. Text in backticks
            is shown as code.
        body: HTML of the content.
        name: HTML id of the section, for links and styles. Empty for none.
    """
    return _render("section", heading=heading, intro=intro, body=body, name=name)


def render_details(summary: str, body: Markup, *, is_open: bool = False) -> Markup:
    """Renders collapsible content, which keeps the page short initially.

    Args:
        summary: Line that is always visible, as plain text.
        body: HTML of the content.
        is_open: True to expand the content initially.
    """
    return _render("details", summary=summary, body=body, is_open=is_open)


def render_folds(folds: Iterable[Markup]) -> Markup:
    """Renders several collapsible parts side by side, for details that few readers need.

    While collapsed, the parts share a single line.

    Args:
        folds: HTML of each part, from `render_details`. Empty for a part that is omitted.
    """
    return _render("folds", folds=folds)


def render_note(text: str) -> Markup:
    """Renders a remark as an HTML paragraph in small print, for example below a chart.

    Args:
        text: The remark, as plain text.
    """
    return _render("note", text=text)


def render_facts(facts: Iterable[tuple[str, str]]) -> Markup:
    """Renders a table with two columns: the name of each fact about a run, and its text.

    A table wider than the screen scrolls inside its own frame.
    """
    return render_scrolling(_render("facts", facts=facts), "facts")


def render_table(
    columns: Mapping[str, str], rows: Iterable[Sequence[str]], text_columns: Sequence[int] = ()
) -> Markup:
    """Renders a table as HTML, which scrolls sideways if the screen is too narrow.

    Args:
        columns: Mapping from column header to its explanation, both as plain text. The
            explanation is shown while the pointer hovers over the header. It is empty if the
            header needs none.
        rows: Rows of cells, one cell per column. A cell is plain text, or `Markup` if it
            contains a coloured square or line breaks.
        text_columns: Indices of the columns that contain text, which may wrap. The first column
            is always treated as text.
    """
    table = _render("table", columns=columns, rows=rows, text_columns=text_columns)
    return render_scrolling(table, next(iter(columns)))


def render_scrolling(content: Markup, label: str) -> Markup:
    """Renders wide content in a region that can be scrolled sideways by mouse or keyboard.

    This keeps the page itself from becoming wider than the screen.

    Args:
        content: HTML of the content of the region.
        label: Name of the region for screen readers, as plain text.
    """
    return _render("scrolling", content=content, label=label)


def _render(macro: str, **values: Any) -> Markup:
    """Renders a macro of the template for pieces of a page."""
    return render_macro("parts.html", macro, **values)


def format_cell(value: float | None) -> str:
    """Formats a number for a table cell, for example "15000", or "0.1235" for 0.12346.

    Integers are written with all digits, other numbers with four significant digits. A missing
    number (`None`) becomes a dash.
    """
    if value is None:
        return NO_NUMBER
    return str(value) if isinstance(value, int) else f"{value:.4g}"

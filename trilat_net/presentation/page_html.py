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
    return _render_scrolling(_render("facts", facts=facts), "facts")


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
    return _render_scrolling(table, next(iter(columns)))


def _render_scrolling(content: Markup, label: str) -> Markup:
    """Renders wide content in a region that scrolls sideways, also by the keyboard.

    The page itself then never becomes wider than the screen.

    Args:
        content: HTML of the content of the region.
        label: Name of the region for screen readers, as plain text.
    """
    return _render("scrolling", content=content, label=label)


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

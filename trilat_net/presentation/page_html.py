"""Renders the pieces of HTML from which the sections of a report's page are made.

A report is a web page about a recorded run. A site is a process that controls one robot arm,
and a link is the directed connection from one site to another.

Invariant:
    - Texts and headers are escaped here. The cells of `render_table` and the bodies of
      `render_details` and `render_section` are HTML already, and their callers escape the texts
      in them.
    - A reader who uses the keyboard can scroll every region that scrolls sideways.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from ..log.log_reader import Log
from .result_text import escape_text

_CODE = re.compile(r"`([^`]+)`")
"""Text in backticks, which the page shows as code."""
NO_NUMBER = "–"
"""Cell of a missing number."""


def render_section(heading: str, intro: str, body: str, name: str = "") -> str:
    """Renders a section of the page: its heading, a sentence about its content, and the body.

    Args:
        heading: Heading, as plain text.
        intro: Sentence that says what the reader sees, as plain text. Text in backticks is
            shown as code.
        body: HTML of the content.
        name: Identifier of the section, for links and style. Empty for none.
    """
    attribute = f' id="{name}"' if name else ""
    title = f"<h2>{escape(heading)}</h2>"
    return f"<section{attribute}>{title}<p>{render_text(intro)}</p>{body}</section>"


def render_text(text: str) -> str:
    """Renders plain text as HTML, with text in backticks as code."""
    return _CODE.sub(r"<code>\1</code>", escape(text))


def render_details(summary: str, body: str, *, is_open: bool = False) -> str:
    """Renders content that the reader can unfold.

    Args:
        summary: Line that is always visible, as plain text.
        body: HTML of the content.
        is_open: True if the content is unfolded at first.
    """
    attribute = " open" if is_open else ""
    return f"<details{attribute}><summary>{escape(summary)}</summary>{body}</details>"


def render_folds(folds: Iterable[str]) -> str:
    """Renders parts that unfold, side by side while they are folded.

    Args:
        folds: HTML of each part, from `render_details`. Empty for a part that does not exist.
    """
    return f'<div class="folds">{"".join(folds)}</div>'


def render_note(text: str) -> str:
    """Renders a string as a paragraph in small type."""
    return f'<p class="note">{escape(text)}</p>'


def render_facts(facts: Iterable[tuple[str, str]]) -> str:
    """Renders a table with two columns: the name and the text of each fact."""
    rows = ""
    for name, text in facts:
        rows += f'<tr><th scope="row">{escape(name)}</th><td>{escape_text(text)}</td></tr>'
    return render_scrolling(f'<table class="facts">{rows}</table>', "facts")


def render_table(
    columns: Mapping[str, str], rows: Iterable[Sequence[str]], text_columns: Sequence[int] = ()
) -> str:
    """Renders an HTML table, which scrolls sideways where it is wider than the screen.

    Args:
        columns: Meaning of each column, by its header. Both are plain text. The meaning is
            shown while the pointer rests on the header. It is empty for a header that needs no
            explanation.
        rows: Rows of cells, one cell per column. The cells are HTML already, so that they can
            contain coloured squares and line breaks.
        text_columns: Indices of the columns that hold texts, which may wrap. The first column
            is always a text.
    """
    attributes = [
        ' class="words"' if column in text_columns else "" for column in range(len(columns))
    ]

    head = ""
    for attribute, (header, meaning) in zip(attributes, columns.items(), strict=True):
        label = escape(header)
        if meaning:
            label = f'<abbr title="{escape(meaning)}">{label}</abbr>'
        head += f'<th scope="col"{attribute}>{label}</th>'

    body = ""
    for row in rows:
        cells = ""
        for attribute, cell in zip(attributes, row, strict=True):
            cells += f"<td{attribute}>{cell}</td>"
        body += f"<tr>{cells}</tr>"
    table = f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
    first_header = next(iter(columns))
    return render_scrolling(f'<table class="sites">{table}</table>', first_header)


def render_legend(columns: Mapping[str, str]) -> str:
    """Renders the meanings of a table's columns as a line, for screens without a pointer."""
    items = [f"{header}: {meaning}" for header, meaning in columns.items() if meaning]
    text = escape("; ".join(items))
    return f'<p class="note legend">{text}.</p>' if items else ""


def render_scrolling(html: str, label: str) -> str:
    """Renders HTML in a region that scrolls sideways, also by the keyboard.

    Args:
        html: Content of the region.
        label: Name of the region for screen readers, as plain text.
    """
    name = escape(label)
    return f'<div class="scroll" role="group" aria-label="{name}" tabindex="0">{html}</div>'


def render_code(text: str) -> str:
    """Renders lines of commands or of a file as they are."""
    return f'<pre tabindex="0">{escape(text)}</pre>'


def render_swatch(log: Log, site: str) -> str:
    """Renders a small square in the colour of a site."""
    return f'<span class="swatch fill-{log.sites.index(site)}"></span>'


def label_site(log: Log, name: str) -> str:
    """Renders the name and the role of a site, behind a square in the colour of the site."""
    role = log.scenario.sites[name].role
    return f"{render_swatch(log, name)}{escape(name)} ({escape(role)})"


def label_link(log: Log, link: str) -> str:
    """Renders the name of a link, as in "m1 → s", behind a square in its sender's colour."""
    peer, site = link.split("->")
    return f"{render_swatch(log, peer)}{escape(peer)} → {escape(site)}"


def format_cell(value: float | None) -> str:
    """Returns a number as text: an integer with all digits, or four digits of another number.

    Returns a dash for None.
    """
    if value is None:
        return NO_NUMBER
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def format_numbers(values: Iterable[float] | None) -> str:
    """Returns numbers with four decimals, separated by commas. Returns a dash for None."""
    if values is None:
        return NO_NUMBER
    return ", ".join(f"{value:.4f}" for value in values)


def to_percent(share: float | None) -> float | None:
    """Returns a share between 0 and 1 in percent. Returns None for None."""
    return None if share is None else 100.0 * share

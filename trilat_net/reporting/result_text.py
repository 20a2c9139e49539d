"""The text of results: composed of lines and tables once, for the terminal, as plain text and
as HTML.

Invariant: all three have the same blocks in the same order. Results of `studies` compose their
own; those of the rooms below have a module here.

Every cell of a table is text already, and all forms show the same cells in the same order.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.text import Text

from ..results import Result
from .terminal_output import MAX_LETTERS, sanitize

if TYPE_CHECKING:
    from rich.table import Table

_COLOURS = {"ok": "green", "warn": "yellow", "open": "yellow", "fail": "red", "FAIL": "red"}
MARKS = {word: f"[{colour}]{word:<4}[/{colour}]" for word, colour in _COLOURS.items()} | {
    "note": "note"
}
"""Of findings, by their state."""


HASH = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])[0-9a-f]{12,64}\b")
"""A hash in hexadecimal digits, or the beginning of one: it stays on one line, so that it can
be copied.
"""


def escape_text(text: str) -> str:
    """Returns a text as HTML in which no line breaks within a hash."""
    return HASH.sub(r'<span style="white-space:nowrap">\g<0></span>', escape(text))


class TextTable(NamedTuple):
    """A table of texts.

    Attributes:
        headers: one per column; all empty for a table without a header line.
        rows: one text per column each. A shorter row leaves its last cells empty; a row of one
            text in a wider table is the heading of a group of rows.
        align: a letter per column, "l" for words and "r" for numbers; the last one holds for
            all columns that follow.
        units: one per column, appended to its header; "" for none. May be shorter than
            `headers`.
        styles: on a terminal, styles of cells by their texts, as in {"fails": "yellow"}.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str = "l"
    units: Sequence[str] = ()
    styles: Mapping[str, str] = {}

    @property
    def titles(self) -> list[str]:
        """The headers with their units."""
        units = [*self.units, *[""] * len(self.headers)]
        return [
            f"{head} {unit}".strip() for head, unit in zip(self.headers, units, strict=False)
        ]

    @property
    def to_the_right(self) -> list[bool]:
        """Per column, True if its cells are aligned to the right."""
        return [letter == "r" for letter in self.align.ljust(len(self.headers), self.align[-1])]

    def rich(self) -> "Table":
        """Returns it for a Rich console: no borders, cells folded where the terminal is too
        narrow.
        """
        from rich.table import Table

        table = Table(box=None, pad_edge=False, show_header=any(self.titles))
        for n, (title, right) in enumerate(zip(self.titles, self.to_the_right, strict=True)):
            cells = [row[n] for row in self.rows if n < len(row)]
            widest = max(
                (len(found) for cell in cells for found in HASH.findall(cell)), default=None
            )
            side: Any = "right" if right else "left"
            # Rich narrows columns that may wrap before it looks at the least widths of the others.
            holds_hashes = widest is not None and all(len(cell) <= widest for cell in cells)
            table.add_column(
                Text(sanitize(title)),
                justify=side,
                overflow="fold",
                min_width=widest,
                no_wrap=holds_hashes,
            )
        for row in self.rows:
            heading = "bold" if len(row) == 1 < len(self.headers) else ""
            table.add_row(
                *(Text(sanitize(cell), style=self.styles.get(cell, heading)) for cell in row)
            )
        return table

    def markdown(self) -> str:
        """Returns it in Markdown."""
        rule = ["--:" if right else "---" for right in self.to_the_right]
        blank = [""] * len(self.headers)
        cells = (self.titles, rule, *([*row, *blank[len(row) :]] for row in self.rows))
        return "\n".join(
            f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
            for row in cells
        )

    def html(self) -> str:
        """Returns it in HTML."""
        sides = ["right" if right else "left" for right in self.to_the_right]

        def line(cells: Sequence[str], kind: str) -> str:
            pairs = zip(cells, sides, strict=False)
            made = (
                f'<{kind} style="text-align:{side}">{escape_text(cell)}</{kind}>'
                for cell, side in pairs
            )
            return f"<tr>{''.join(made)}</tr>"

        head = f"<thead>{line(self.titles, 'th')}</thead>" if any(self.titles) else ""
        return f"<table>{head}<tbody>{''.join(line(row, 'td') for row in self.rows)}</tbody></table>"

    def lines(self) -> list[str]:
        """Returns its lines with columns aligned by spaces; the first holds the headers, if
        there are any.
        """
        table = [self.titles, *self.rows] if any(self.titles) else self.rows
        widths = [
            max((len(row[n]) for row in table if n < len(row)), default=0)
            for n in range(len(self.headers))
        ]
        return [
            "  ".join(
                cell.rjust(width) if right else cell.ljust(width)
                for cell, width, right in zip(row, widths, self.to_the_right, strict=False)
            ).rstrip()
            for row in table
        ]


def format_number(value: float | None, digits: int = 3) -> str:
    """Returns a number as a cell of a table shows it; a dash for None."""
    return "-" if value is None else f"{value:.{digits}g}"


class MarkedText(NamedTuple):
    """A line behind a mark.

    Attributes:
        mark: in Rich's markup, as in "[green]ok[/green]"; "" for none.
        text: the line.
        failed: True if a command prints it to standard error.
    """

    mark: str
    text: str
    failed: bool = False

    def lines(self) -> list[str]:
        """Returns it without colours, as a line."""
        return [f"{Text.from_markup(self.mark).plain} {self.text}" if self.mark else self.text]

    def html(self) -> str:
        """Returns it in HTML."""
        text = escape_text(sanitize(self.lines()[0], MAX_LETTERS))
        return f'<div style="white-space:pre-wrap">{text or "&nbsp;"}</div>'


Block = str | MarkedText | TextTable
"""A part of a result's text; "" is an empty line."""

_COMPOSERS = {
    "Certificate": "certificate_text:compose_certificate",
    "LinearAnalysis": "linear_text:compose_linear",
    "Log": "summary_text:compose_log",
    "LogCheckReport": "summary_text:compose_verification",
    "LogCheckResult": "summary_text:compose_log_check",
    "LogMetrics": "summary_text:compose_metrics",
    "DoctorReport": "summary_text:compose_doctor",
    "FileOverview": "overview_tables:compose_overview",
    "NetworkBenchmark": "summary_text:compose_benchmark",
    "PingReport": "summary_text:compose_ping",
    "TopicDelays": "summary_text:compose_topic_delays",
    "Recovery": "summary_text:compose_recovery",
    "PushedTwins": "certificate_text:compose_twins",
    "Rerun": "summary_text:compose_rerun",
}
"""By type what composes its text."""


def compose(result: Result) -> list[MarkedText | TextTable]:
    """Returns the lines and tables of a result, in order."""
    own = getattr(result, "blocks", None)
    if own is None:
        known = next(one.__name__ for one in type(result).__mro__ if one.__name__ in _COMPOSERS)
        module, _, name = _COMPOSERS[known].partition(":")
        own = partial(getattr(import_module(f"{__package__}.{module}"), name), result)
    blocks: Iterable[Block] = own()
    return [MarkedText("", block) if isinstance(block, str) else block for block in blocks]


def summarize(result: Result) -> str:
    """Returns a result as plain text."""
    lines = (line for block in compose(result) for line in block.lines())
    return "\n".join(sanitize(line, MAX_LETTERS) for line in lines).strip("\n")


def render_html(result: Result) -> str:
    """Returns a result as HTML, with its tables as such."""
    return "\n".join(block.html() for block in compose(result))

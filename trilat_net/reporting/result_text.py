"""Text of results as a list of blocks, which are shown on the terminal, as text or as HTML.

A block is a line, a marked line (`MarkedText`) or a table (`TextTable`). Results of `studies`
compose their blocks in a method `blocks`. For the results of the packages below, which do not
know about text, `_COMPOSERS` names a function in this folder.

Invariant:
    - The terminal, the plain text and the HTML have the same blocks in the same order.
    - Every cell of a table is text. All three forms show the same cells in the same order.
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
"""Marks in Rich's markup, by the state of a finding."""

HASH = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])[0-9a-f]{12,64}\b")
"""Pattern of a hash in hexadecimal digits, or of the first 12 or more digits of a hash.

A hash is kept on one line so that it can be copied.
"""


def escape_text(text: str) -> str:
    """Returns a text as HTML in which no line breaks within a hash."""
    return HASH.sub(r'<span style="white-space:nowrap">\g<0></span>', escape(text))


class TextTable(NamedTuple):
    """A table of texts.

    Attributes:
        headers: a text per column; all empty for a table without a header line.
        rows: lists of a text per column. A shorter row leaves its last cells empty. A row of
            a single text in a wider table is the heading of a group of rows.
        align: a letter per column, "l" for texts and "r" for numbers. The last letter also
            holds for all further columns.
        units: a unit per column, appended to the header; "" for a column without a unit. May
            be shorter than `headers`.
        styles: the styles of cells on a terminal, by the text of the cell, as in
            {"fails": "yellow"}.
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
        """Returns the table for a Rich console, without borders.

        Cells are folded if the terminal is too narrow, except cells that hold only hashes.
        """
        from rich.table import Table

        table = Table(box=None, pad_edge=False, show_header=any(self.titles))
        columns = zip(self.titles, self.to_the_right, strict=True)
        for index, (title, right) in enumerate(columns):
            cells = [row[index] for row in self.rows if index < len(row)]
            hash_widths = [len(digits) for cell in cells for digits in HASH.findall(cell)]
            widest = max(hash_widths, default=None)
            side: Any = "right" if right else "left"
            # Rich narrows columns that may wrap before it respects the least widths of others
            holds_hashes = widest is not None and all(len(cell) <= widest for cell in cells)
            table.add_column(
                Text(sanitize(title)),
                justify=side,
                overflow="fold",
                min_width=widest,
                no_wrap=holds_hashes,
            )
        for row in self.rows:
            is_heading = len(row) == 1 < len(self.headers)
            default = "bold" if is_heading else ""
            texts = [Text(sanitize(cell), style=self.styles.get(cell, default)) for cell in row]
            table.add_row(*texts)
        return table

    def markdown(self) -> str:
        """Returns the table in Markdown."""
        rule = ["--:" if right else "---" for right in self.to_the_right]
        rows = [self.titles, rule]
        for row in self.rows:
            missing = len(self.headers) - len(row)
            rows.append([*row, *[""] * missing])
        lines = []
        for row in rows:
            cells = [cell.replace("|", "\\|") for cell in row]
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join(lines)

    def html(self) -> str:
        """Returns the table in HTML."""
        sides = ["right" if right else "left" for right in self.to_the_right]

        def render_row(cells: Sequence[str], tag: str) -> str:
            columns = [
                f'<{tag} style="text-align:{side}">{escape_text(cell)}</{tag}>'
                for cell, side in zip(cells, sides, strict=False)
            ]
            return f"<tr>{''.join(columns)}</tr>"

        head = f"<thead>{render_row(self.titles, 'th')}</thead>" if any(self.titles) else ""
        body = "".join(render_row(row, "td") for row in self.rows)
        return f"<table>{head}<tbody>{body}</tbody></table>"

    def lines(self) -> list[str]:
        """Returns the lines of the table, with columns aligned by spaces.

        The first line holds the headers, unless all headers are empty.
        """
        table = [self.titles, *self.rows] if any(self.titles) else self.rows
        widths = []
        for index in range(len(self.headers)):
            lengths = [len(row[index]) for row in table if index < len(row)]
            widths.append(max(lengths, default=0))
        lines = []
        for row in table:
            columns = zip(row, widths, self.to_the_right, strict=False)
            cells = [
                cell.rjust(width) if right else cell.ljust(width)
                for cell, width, right in columns
            ]
            lines.append("  ".join(cells).rstrip())
        return lines


def format_number(value: float | None, digits: int = 3) -> str:
    """Returns a number as a cell of a table, or a dash for None."""
    return "-" if value is None else f"{value:.{digits}g}"


class MarkedText(NamedTuple):
    """A line behind a mark.

    Attributes:
        mark: the mark in Rich's markup, as in "[green]ok[/green]", or "".
        text: the line.
        failed: True if a command prints it to standard error.
    """

    mark: str
    text: str
    failed: bool = False

    def lines(self) -> list[str]:
        """Returns a list of one line, without colours."""
        return [f"{Text.from_markup(self.mark).plain} {self.text}" if self.mark else self.text]

    def html(self) -> str:
        """Returns the line in HTML."""
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
"""Functions that compose the text of results, as "module:function", by class name."""


def compose(result: Result) -> list[MarkedText | TextTable]:
    """Returns the lines and tables of a result, in order."""
    compose_blocks = getattr(result, "blocks", None)
    if compose_blocks is None:
        classes = [cls.__name__ for cls in type(result).__mro__]
        known = next(name for name in classes if name in _COMPOSERS)
        module, _, function = _COMPOSERS[known].partition(":")
        composer = getattr(import_module(f"{__package__}.{module}"), function)
        compose_blocks = partial(composer, result)
    blocks: Iterable[Block] = compose_blocks()
    return [MarkedText("", block) if isinstance(block, str) else block for block in blocks]


def summarize(result: Result) -> str:
    """Returns a result as plain text."""
    lines = (line for block in compose(result) for line in block.lines())
    return "\n".join(sanitize(line, MAX_LETTERS) for line in lines).strip("\n")


def render_html(result: Result) -> str:
    """Returns a result as HTML, with HTML tables."""
    return "\n".join(block.html() for block in compose(result))

"""Represents the text of a result as blocks, for the terminal, plain text and HTML.

A block is a line, a line that begins with a mark such as a green "ok" (`MarkedText`), or a
table (`TextTable`).

A result class may have a method `blocks` that returns its blocks. For other classes, a function
in this folder composes the blocks; `_COMPOSERS` lists these functions by class name, so that
the classes do not depend on this folder.

Invariant:
    - Terminal, plain text and HTML have the same blocks in the same order.
    - Every table cell is a string. All three forms have the same cells in the same order.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from rich.text import Text

from ..results import Result
from .untrusted_text import HASH, MAX_LETTERS, sanitize

if TYPE_CHECKING:
    from markupsafe import Markup
    from rich.table import Table

_COLOURS = {
    "ok": "green",
    "warn": "yellow",
    "open": "yellow",
    "fail": "red",
    "FAIL": "red",
}
MARKS = {state: f"[{colour}]{state:<4}[/{colour}]" for state, colour in _COLOURS.items()}
MARKS["note"] = "note"
"""Marks in Rich markup, keyed by the state of a finding."""


class TextTable(NamedTuple):
    """A table of strings that can be printed, or rendered as Markdown or HTML.

    Attributes:
        headers: Header of each column. If all are empty, the table has no header line.
        rows: Cells of each row. In a row that is too short, the last cells are empty. A row
            with a single cell in a wider table is the heading of a group of rows.
        align: One letter per column, "l" for text and "r" for numbers. The last letter also
            applies to all further columns.
        units: Unit of each column, which is appended to the header. Empty for a column without
            a unit. There may be fewer units than headers.
        styles: Mapping from cell text to its style on a terminal, as in {"fails": "yellow"}.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str = "l"
    units: Sequence[str] = ()
    styles: Mapping[str, str] = {}

    @property
    def titles(self) -> list[str]:
        """Headers of the columns, each followed by its unit, such as "error rad"."""
        missing = len(self.headers) - len(self.units)
        units = [*self.units, *[""] * missing]
        columns = zip(self.headers, units, strict=False)
        return [f"{header} {unit}".strip() for header, unit in columns]

    @property
    def to_the_right(self) -> list[bool]:
        """For each table column, True if its cells are right-aligned, as numbers are.

        If `align` has fewer letters than there are columns, its last letter applies to the
        remaining columns.
        """
        letters = self.align.ljust(len(self.headers), self.align[-1])
        return [letter == "r" for letter in letters]

    def rich(self) -> "Table":
        """Converts the table to a Rich table, which can be printed to a terminal.

        The table has no borders. Cells wrap if the terminal is too narrow, except for those
        that contain a hash.
        """
        from rich.table import Table

        table = Table(box=None, pad_edge=False, show_header=any(self.titles))
        columns = zip(self.titles, self.to_the_right, strict=True)
        for index, (title, is_right) in enumerate(columns):
            hash_width = self._find_hash_width(index)
            table.add_column(
                Text(sanitize(title)),
                justify="right" if is_right else "left",
                overflow="fold",
                min_width=hash_width,
                # Rich ignores the minimum width of a column that may wrap. Therefore a column
                # of hashes must not wrap.
                no_wrap=hash_width is not None and self._fits(index, hash_width),
            )

        for row in self.rows:
            is_heading = len(row) == 1 < len(self.headers)
            default_style = "bold" if is_heading else ""
            texts = []
            for cell in row:
                style = self.styles.get(cell, default_style)
                texts.append(Text(sanitize(cell), style=style))
            table.add_row(*texts)
        return table

    def _list_cells(self, index: int) -> list[str]:
        """Returns the cells of a column, skipping rows that are too short to have one."""
        return [row[index] for row in self.rows if index < len(row)]

    def _find_hash_width(self, index: int) -> int | None:
        """Returns the length of the longest hash in a column, or `None` if there is no hash."""
        widths = []
        for cell in self._list_cells(index):
            widths += [len(digits) for digits in HASH.findall(cell)]
        return max(widths, default=None)

    def _fits(self, index: int, width: int) -> bool:
        """Returns True if no cell of a column exceeds the given width."""
        return all(len(cell) <= width for cell in self._list_cells(index))

    def markdown(self) -> str:
        """Renders the table as Markdown. Short rows are padded with empty cells.

        A "|" in a cell is escaped, because it would start a new column.
        """
        separators = ["--:" if right else "---" for right in self.to_the_right]
        rows = [self.titles, separators]
        for row in self.rows:
            missing_cells = len(self.headers) - len(row)
            rows.append([*row, *[""] * missing_cells])
        lines = []
        for row in rows:
            cells = [cell.replace("|", "\\|") for cell in row]
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join(lines)

    def html(self) -> "Markup":
        """Renders the table as HTML, for notebooks and for the page of a report."""
        from .html_templates import render_macro

        titles = self.titles
        return render_macro(
            "result.html",
            "table",
            titles=titles if any(titles) else (),
            rows=self.rows,
            sides=["right" if right else "left" for right in self.to_the_right],
        )

    def lines(self) -> list[str]:
        """Renders the table as plain lines, with columns aligned by spaces.

        The first line contains the headers, unless all headers are empty. Each column is as
        wide as its longest cell.
        """
        table = list(self.rows)
        if any(self.titles):
            table.insert(0, self.titles)

        widths = [0] * len(self.headers)
        for row in table:
            for index, cell in enumerate(row[: len(widths)]):
                widths[index] = max(widths[index], len(cell))

        lines = []
        for row in table:
            columns = zip(row, widths, self.to_the_right, strict=False)
            cells = []
            for cell, width, is_right in columns:
                cells.append(cell.rjust(width) if is_right else cell.ljust(width))
            lines.append("  ".join(cells).rstrip())
        return lines


def format_number(value: float | None, digits: int = 3) -> str:
    """Formats a number for a table cell: 0.123 for 0.12345, and a dash for `None`.

    Args:
        value: The number, or `None`.
        digits: Number of significant digits.

    Returns:
        The formatted number.
    """
    return "-" if value is None else f"{value:.{digits}g}"


class MarkedText(NamedTuple):
    """A line of a result's text that begins with a mark, such as a green "ok".

    Attributes:
        mark: The mark in Rich markup, as in "[green]ok[/green]". Empty for no mark.
        text: The line.
        failed: True if commands print the line to standard error.
    """

    mark: str
    text: str
    failed: bool = False

    def lines(self) -> list[str]:
        """Returns the text as one line without colours, such as "ok all records".

        Returns:
            A list that contains this line only. The result is a list because other kinds of
            block have several lines.
        """
        if not self.mark:
            return [self.text]
        mark = Text.from_markup(self.mark).plain
        return [f"{mark} {self.text}"]

    def html(self) -> "Markup":
        """Renders the mark and the text as one line of HTML, without colours.

        The text may come from a file or from another computer, so control characters are
        replaced and very long texts are truncated.
        """
        from .html_templates import render_macro

        line = sanitize(self.lines()[0], MAX_LETTERS)
        return render_macro("result.html", "line", text=line)


Block = str | MarkedText | TextTable
"""A part of a result's text. An empty string is an empty line."""

_COMPOSERS = {
    "Certificate": "certificate_text:compose_certificate",
    "CheckReport": "log_text:compose_checks",
    "LinearAnalysis": "linear_text:compose_linear",
    "Log": "log_text:compose_log",
    "LogCheckReport": "log_text:compose_verification",
    "LogCheckResult": "log_text:compose_log_check",
    "LogMetrics": "metrics_text:compose_metrics",
    "FileOverview": "overview_tables:compose_overview",
    "Recovery": "log_text:compose_recovery",
    "PushedTwins": "certificate_text:compose_twins",
    "Rerun": "rerun_text:compose_rerun",
}
"""Functions that compose the text of results, given as "module:function" and keyed by class
name.
"""
_BRIEF_COMPOSERS = {
    "Certificate": "brief_text:compose_key_reasons",
    "LogMetrics": "brief_text:compose_key_metrics",
}
"""Functions that compose the ten most important lines of long results, keyed by class name."""


def compose(result: Result, *, brief: bool = False) -> list[MarkedText | TextTable]:
    """Collects the lines and tables that make up the text of a result.

    The terminal, plain text and HTML are all rendered from these blocks, and therefore have the
    same content.

    Args:
        result: Result of a command, such as the metrics of a run.
        brief: True for the ten most important lines of a certificate, of metrics or of a
            comparison of logs.

    Returns:
        The blocks in text order. Each line is a `MarkedText`, whose mark (such as a green "ok")
        may be empty.
    """
    # A class may have methods for its text, or a function in this folder composes the text.
    compose_blocks = getattr(result, "brief_blocks", None) if brief else None
    if compose_blocks is None:
        compose_blocks = getattr(result, "blocks", None)
    if compose_blocks is None:
        composers = _BRIEF_COMPOSERS if brief else _COMPOSERS
        compose_blocks = partial(_import_composer(result, composers), result)

    blocks: Iterable[Block] = compose_blocks()
    return [MarkedText("", block) if isinstance(block, str) else block for block in blocks]


def _import_composer(
    result: Result, composers: Mapping[str, str]
) -> Callable[[Result], Iterable[Block]]:
    """Imports the function that composes the text of a result, when it is first needed.

    Importing all such modules at startup would make every command slow. For a subclass of a
    listed class, the function of the listed class is used.

    Args:
        result: The result.
        composers: Functions as "module:function", keyed by class name, such as `_COMPOSERS`.
    """
    classes = [cls.__name__ for cls in type(result).__mro__]
    listed_class = next(name for name in classes if name in composers)
    module_name, _, function_name = composers[listed_class].partition(":")
    module = import_module(f"{__package__}.{module_name}")
    composer: Callable[[Result], Iterable[Block]] = getattr(module, function_name)
    return composer


def summarize(result: Result) -> str:
    """Renders the result of a command as plain text, for printing it in a Python session.

    Args:
        result: Result of a command or function.
    """
    lines = []
    for block in compose(result):
        lines += [sanitize(line, MAX_LETTERS) for line in block.lines()]
    return "\n".join(lines).strip("\n")


def render_html(result: Result) -> str:
    """Renders the result of a command as HTML with tables, for example for a notebook.

    Args:
        result: Result of a command or function.
    """
    return "\n".join(block.html() for block in compose(result))

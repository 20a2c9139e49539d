"""The text of results: composed of lines and tables once, for the terminal, as plain text and as HTML.

Invariant: all three have the same blocks in the same order. Results of `studies` compose their own; those of
the rooms below have a module here.
"""

from collections.abc import Iterable
from html import escape
from importlib import import_module
from typing import NamedTuple

from rich.text import Text

from ..results import Result
from .terminal_output import sanitize
from .text_table import TextTable


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

    @property
    def plain(self) -> str:
        """The line without colours."""
        return f"{Text.from_markup(self.mark).plain} {self.text}" if self.mark else self.text


Block = str | MarkedText | TextTable

_COMPOSERS = {
    "Certificate": "certificate_text:compose_certificate",
    "LinearAnalysis": "linear_text:compose_linear",
    "Log": "summary_text:compose_log",
    "LogCheckReport": "checks_text:compose_verification",
    "LogCheckResult": "checks_text:compose_log_check",
    "LogMetrics": "metrics_text:compose_metrics",
    "DoctorReport": "session_text:compose_doctor",
    "FileOverview": "overview_tables:compose_overview",
    "NetworkBenchmark": "session_text:compose_benchmark",
    "PingReport": "session_text:compose_ping",
    "Recovery": "checks_text:compose_recovery",
    "PushedTwins": "certificate_text:compose_twins",
    "Rerun": "rerun_text:compose_rerun",
}
"""By type what composes its text."""


def compose(result: Result) -> Iterable[Block]:
    """Returns the lines and tables of a result, in order; "" is an empty line."""
    own = getattr(result, "blocks", None)
    if own is not None:
        return list(own())
    known = next(one.__name__ for one in type(result).__mro__ if one.__name__ in _COMPOSERS)
    module, _, name = _COMPOSERS[known].partition(":")
    return list(getattr(import_module(f"{__package__}.{module}"), name)(result))


def summarize(result: Result) -> str:
    """Returns a result as plain text."""
    lines: list[str] = []
    for block in compose(result):
        if isinstance(block, TextTable):
            lines += block.lines() if any(block.titles) else block.lines()[1:]
        else:
            lines.append(block.plain if isinstance(block, MarkedText) else block)
    return "\n".join(sanitize(line, 4000) for line in lines).strip("\n")


def render_html(result: Result) -> str:
    """Returns a result as HTML, with its tables as such."""
    parts = []
    for block in compose(result):
        if isinstance(block, TextTable):
            parts.append(block.html())
        else:
            text = sanitize(block.plain if isinstance(block, MarkedText) else block, 4000)
            parts.append(f'<div style="white-space:pre-wrap">{escape(text) or "&nbsp;"}</div>')
    return "\n".join(parts)

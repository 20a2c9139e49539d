"""The text of results: composed of lines and tables once, for the terminal, as plain text and as HTML.

Invariant: all three have the same blocks in the same order. Results of `studies` compose their own; those of
the rooms below have a module here.
"""

from collections.abc import Iterable
from functools import partial
from html import escape
from importlib import import_module
from typing import NamedTuple

from rich.text import Text

from ..results import Result
from .terminal_output import MAX_LETTERS, sanitize
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

    def lines(self) -> list[str]:
        """Returns it without colours, as a line."""
        return [f"{Text.from_markup(self.mark).plain} {self.text}" if self.mark else self.text]

    def html(self) -> str:
        """Returns it in HTML."""
        text = escape(sanitize(self.lines()[0], MAX_LETTERS))
        return f'<div style="white-space:pre-wrap">{text or "&nbsp;"}</div>'


Block = str | MarkedText | TextTable
"""A part of a result's text; "" is an empty line."""

_COMPOSERS = {
    "Certificate": "certificate_text:compose_certificate",
    "LinearAnalysis": "linear_text:compose_linear",
    "Log": "summary_text:compose_log",
    "LogCheckReport": "summary_text:compose_verification",
    "LogCheckResult": "summary_text:compose_log_check",
    "LogMetrics": "metrics_text:compose_metrics",
    "DoctorReport": "session_text:compose_doctor",
    "FileOverview": "overview_tables:compose_overview",
    "NetworkBenchmark": "session_text:compose_benchmark",
    "PingReport": "session_text:compose_ping",
    "TopicDelays": "session_text:compose_topic_delays",
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

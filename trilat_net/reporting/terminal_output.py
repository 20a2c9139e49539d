"""Terminal output that commands share: consoles, progress bar, tables, warnings about a log that is opened.

Invariants: text from a file or a peer passes `sanitize`: no control characters, bounded length. Library code
knows nothing of the bar; it calls a function with (done, total). Imports only Rich at the top, so that
`trilat --help` stays fast.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

if TYPE_CHECKING:
    from ..log.log_reader import Log
    from .conclude import Conclusion
    from .text_table import TextTable


def sanitize(text: object, most: int = 300) -> str:
    """Returns a text of strangers as a terminal may have it: no control characters, and no endless one."""
    plain = "".join(letter if letter.isprintable() else "\ufffd" for letter in str(text)[: most + 1])
    return plain if len(plain) <= most else plain[:most] + "..."


def print_conclusion(conclusion: "Conclusion") -> None:
    """Prints what there is to say of a log."""
    print_table(conclusion.table)
    for note in conclusion.notes:
        out.print(escape(note), soft_wrap=True)
    for line in conclusion.lines:
        mark = "[green]ok[/green]  " if line.passed else "[red]FAIL[/red]"
        out.print(f"{mark} {escape(line.label)}: {escape(line.text)}", soft_wrap=True)
    for path in conclusion.paths:
        out.print(f"  {escape(str(path))}", soft_wrap=True)


PATIENCE_S = 1.0
"""How long nobody needs to be told that something goes on, s."""
_EVERY_S = 0.1


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yields a function to call with (done, total), as often as one likes; it draws when it is worth it.

    Args:
        label: what is going on, as in "reading run.mcap".
    """
    if not err.is_interactive:
        yield _ignore_progress
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    display = Progress(*columns, console=err, transient=True, auto_refresh=False)
    task = display.add_task(label, total=None)
    began_s = display.get_time()
    drawn_s = began_s

    def show(done: int, total: int) -> None:
        nonlocal drawn_s
        now_s = display.get_time()
        if now_s - began_s < PATIENCE_S or now_s - drawn_s < _EVERY_S:
            return
        drawn_s = now_s
        display.start()
        display.update(task, completed=done, total=total, refresh=True)

    try:
        yield show
    finally:
        display.stop()


def _ignore_progress(done: int, total: int) -> None:
    """Draws nothing, where nobody looks."""


_MAX_DAMAGED = 3
"""Damaged parts that are told one by one."""


def open_with_progress(first: Path, *more: Path) -> "Log":
    """Returns the log in a file, or in the files that are its parts.

    Raises:
        LogError: one is missing, is no MCAP file, or no log of trilat-net.
    """
    from ..log.log_reader import open_log

    with progress_bar(f"reading {first}") as progress:
        log = open_log(first, *more, progress=progress)
    for path in (first, *more):
        warn_if_unfinished(path)
    for problem in log.damaged[:_MAX_DAMAGED]:
        err.print(f"note: {escape(sanitize(problem))}", soft_wrap=True)
    if log.damaged:
        untold = len(log.damaged) - _MAX_DAMAGED
        rest = f"and {untold} more damaged parts; " if untold > 0 else ""
        err.print(
            f"note: {rest}all that can be read is made a whole file by: trilat log recover FILE",
            soft_wrap=True,
        )
    return log


def warn_user_laws(log: "Log", *, needed: bool = True) -> None:
    """Says which code a log names that it does not hold, and that executing the log runs it.

    Args:
        log: the log.
        needed: whether nothing can be done without that code.

    Raises:
        ScenarioError: the file of a law is not there, and needed.
    """
    from ..errors import ScenarioError
    from ..execution.verify import find_user_laws

    try:
        laws = find_user_laws(log.scenario, log.source)
    except ScenarioError:
        if needed:
            raise
        return
    for law in laws:
        err.print(f"note: executing this log runs code from outside: {escape(sanitize(law))}", soft_wrap=True)


def warn_if_unfinished(path: Path) -> None:
    """Says so where a file was not finished, and what mends it.

    Raises:
        LogError: it cannot be read.
    """
    from ..errors import LogError
    from ..log.mcap_records import RecordScanner

    try:
        with path.open("rb") as stream:
            whole = RecordScanner(stream).ends
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    if not whole:
        text = f"{path}: was not finished: its end and its index are missing; make it whole with: "
        err.print(f"note: {escape(text)}trilat log recover {escape(str(path))}", soft_wrap=True)


_PIPE_WIDTH = 160
"""Columns that output has at least where it is no terminal."""


def print_table(table: "TextTable", styles: Mapping[str, str] | None = None) -> None:
    """Prints a table; cells with a text of `styles` in that style."""
    wide = Console(file=out.file, width=max(out.width, _PIPE_WIDTH), highlight=False)
    (out if out.is_terminal else wide).print(table.rich(styles or {}))


out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def print_line(text: str) -> None:
    """Prints a line at once, as a process does that others watch."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()

"""Prints lines, tables, a progress bar and warnings to the terminal, for all commands.

Strings may come from files or from other computers on the network, and could contain control
characters that move the cursor or hide other text. Everything is therefore printed through this
module, which makes it safe (`untrusted_text`).

Invariant:
    - No control character reaches a terminal, whatever the origin of a string: `TextConsole`
      and `print_line` escape control characters.
    - Strings from a file or from another process are also passed through `sanitize`, which
      limits their length.
    - Code below the commands does not depend on the progress bar; it calls a function with
      (done, total).
    - At module level, only Rich is imported, so that `trilat --help` stays fast.
"""

import json
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from ..errors import count_nouns, format_wall_time
from .untrusted_text import CONTROLS, MAX_LETTERS, sanitize

if TYPE_CHECKING:
    from ..log import Log
    from ..results import Result
    from .result_text import TextTable


class TextConsole(Console):
    """Rich console that makes control characters visible.

    This prevents output from other programs from controlling the terminal, even inside a table.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """Converts a string to Rich text, replacing control characters with their names.

        Rich calls this for every string.

        Args:
            text: The string.
            **options: Options of Rich.
        """
        return super().render_str(_escape_controls(text), **options)


out = TextConsole(highlight=False)
err = TextConsole(stderr=True, highlight=False)

PATIENCE_S = 1.0
"""Time after which a progress bar appears, in s."""
_RUN_LINES = 10
"""Number of lines that show the progress of many runs if the output is not a terminal."""
_REDRAW_PERIOD_S = 0.1
"""Minimum time between two updates of a progress bar, in s."""
LINES_AFTER_S = 1.0
"""Time after which `progress_lines` names the current task, in s."""
LINES_PERIOD_S = 10.0
"""Time between two lines of `progress_lines`, in s."""
_MAX_DAMAGED = 3
"""Maximum number of damaged parts of a log to list."""
_PIPE_WIDTH = 160
"""Minimum width of tables, in characters, if the output is not a terminal."""


def print_text(text: object, console: Console = out, head: str = "") -> None:
    """Prints a string of unknown origin as one line, without harmful characters.

    Control characters are made visible, and Rich markup in the string is not interpreted.

    Args:
        text: The line.
        console: The console, for standard output or standard error.
        head: Text to print before the line. This text is not passed to `sanitize`.
    """
    console.print(head + sanitize(text, MAX_LETTERS), markup=False, soft_wrap=True)


def print_note(text: object) -> None:
    """Prints a remark for the user to standard error, to keep it separate from results.

    Args:
        text: The remark.
    """
    print_text(text, err, "note: ")


def print_error(text: object) -> None:
    """Prints an error message to standard error, to keep it separate from results.

    Args:
        text: The message.
    """
    print_text(text, err, "error: ")


def print_marked(mark: str, text: object) -> None:
    """Prints a mark, such as a green "ok" for a passed check, and a text on one line.

    Args:
        mark: The mark, which may contain colours in Rich markup.
        text: The text of the line. It is made safe for the terminal.
    """
    out.print(f"{mark} {escape(sanitize(text, MAX_LETTERS))}", soft_wrap=True)


def print_texts(texts: Iterable[object]) -> None:
    """Prints several strings of unknown origin, one per line, without harmful characters.

    Control characters are made visible, see `print_text`.

    Args:
        texts: The strings.
    """
    for text in texts:
        print_text(text)


def print_paths(paths: Iterable[Path]) -> None:
    """Prints the paths of files that a command has written, one path per line.

    Args:
        paths: The paths.
    """
    print_texts(f"  {path}" for path in paths)


def print_json(value: Any) -> None:
    """Prints a value as JSON to standard output, for use by other programs.

    Args:
        value: Plain values, possibly nested in lists and dictionaries.

    Raises:
        ValueError: The value contains NaN or an infinite number.
    """
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    print_line(CONTROLS.sub(lambda match: f"\\u{ord(match[0]):04x}", text))


def print_line(text: str) -> None:
    """Prints a line without buffering, so that a program reading the output does not wait.

    Args:
        text: The line.
    """
    sys.stdout.write(_escape_controls(text) + "\n")
    sys.stdout.flush()


def print_table(table: "TextTable") -> None:
    """Prints a table that fits the width of the terminal.

    If the output is not a terminal, the available width is at least `_PIPE_WIDTH` characters.

    Args:
        table: The table.
    """
    console = out
    if not out.is_terminal:
        width = max(out.width, _PIPE_WIDTH)
        console = TextConsole(file=out.file, width=width, highlight=False)
    console.print(table.rich())


def print_result(result: "Result", *, as_json: bool = False, brief: bool = False) -> None:
    """Prints the result of a command, as text for people or as JSON for programs.

    Every command that has a result ends by calling this function, so that all output is
    uniform.

    Args:
        result: The result of a command.
        as_json: True to print the values as JSON.
        brief: True to print only the ten most important lines of a certificate, of metrics or
            of a comparison of logs.
    """
    if as_json:
        print_json(result.to_dict())
        return

    from .result_text import TextTable, compose

    for block in compose(result, brief=brief):
        if isinstance(block, TextTable):
            print_table(block)
        elif block.mark:
            print_marked(block.mark, block.text)
        else:
            print_text(block.text, err if block.failed else out)


@contextmanager
def lines_aside(aside: bool) -> Iterator[None]:
    """Context manager that redirects standard output to standard error, if requested.

    Commands with the option --json use this to ensure that standard output contains only JSON.

    Args:
        aside: True to redirect the output. False to do nothing.
    """
    with redirect_stdout(sys.stderr) if aside else nullcontext():
        yield


@contextmanager
def progress_lines(label: str) -> Iterator[Callable[[int, int], None]]:
    """Context manager that prints progress lines to stderr if its block takes long.

    The first line names the task and appears after `LINES_AFTER_S`. Further lines with the
    elapsed time follow every `LINES_PERIOD_S`. They are printed from a thread, because some
    tasks cannot report their progress.

    Args:
        label: Phrase that describes the task, such as "judging run.mcap".

    Yields:
        A function that may be called with (done, total). The lines then include the percentage.
    """
    has_ended = threading.Event()
    percent = ""

    def show(done: int, total: int) -> None:
        """Stores the progress of a command, to be included in the next printed line."""
        nonlocal percent
        percent = f"{100 * done // total} %, " if total > 0 else ""

    def print_lines() -> None:
        """Prints progress lines at intervals until the task ends."""
        if has_ended.wait(LINES_AFTER_S):
            return
        err.print(f"{label} ...", markup=False, soft_wrap=True)
        elapsed_s = LINES_AFTER_S
        while not has_ended.wait(LINES_PERIOD_S):
            elapsed_s += LINES_PERIOD_S
            err.print(f"  {percent}{elapsed_s:.0f} s elapsed", markup=False, soft_wrap=True)

    printer = threading.Thread(target=print_lines, daemon=True)
    printer.start()
    try:
        yield show
    finally:
        has_ended.set()
        printer.join()


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Context manager that yields a function for updating a progress bar.

    The function is called with (done, total), as often as desired. The bar appears after
    `PATIENCE_S`, and only on a terminal. If the output is not a terminal, `progress_lines`
    prints a few lines instead.

    Args:
        label: Phrase that describes the task, such as "reading run.mcap".
    """
    if not err.is_interactive:
        with progress_lines(label) as show_lines:
            yield show_lines
        return

    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    display = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        auto_refresh=False,
    )
    task = display.add_task(label, total=None)
    start_s = display.get_time()
    drawn_s = start_s

    def show(done: int, total: int) -> None:
        """Updates the displayed progress of a command, for example to 12 of 50 runs.

        The bar appears only if the command takes longer than `PATIENCE_S`. Updates in quick
        succession are skipped, because they would slow down the work.

        Args:
            done: Number of finished items.
            total: Total number of items.
        """
        nonlocal drawn_s
        now_s = display.get_time()
        if now_s - start_s < PATIENCE_S:
            return
        if now_s - drawn_s < _REDRAW_PERIOD_S:
            return
        drawn_s = now_s
        display.start()
        display.update(task, completed=done, total=total, refresh=True)

    try:
        yield show
    finally:
        display.stop()


@contextmanager
def show_progress(
    label: str, print_line: Callable[[str], None], items: str = "runs"
) -> Iterator[Callable[[int, int], None]]:
    """Context manager that shows the progress of many runs, which may take hours.

    In a terminal, a bar is shown. If the output is a file or a pipe, at most `_RUN_LINES` lines
    with the remaining time are printed instead, and as many again whenever the total number of
    items grows, as in a sweep that is refined.

    Args:
        label: Label of the bar.
        print_line: Function that prints a line.
        items: What is being counted, as a plural noun.

    Yields:
        A function to call with the number of finished items and the total number of items.
    """
    if err.is_interactive:
        with progress_bar(label) as show:
            yield show
        return

    first_call_s: float | None = None  # time of the first call of `show_line`
    done_at_first_call = 0
    printed_tenths = 0  # tenths of the items that were finished at the last printed line
    last_total = 0

    def show_line(done: int, total: int) -> None:
        """Prints a line with the remaining time, about once per tenth of the items.

        The remaining time is estimated from the mean duration per item since the first call.
        The first call prints no line because this duration is not known yet, and no line is
        printed after the last item.

        Args:
            done: Number of finished items.
            total: Total number of items.
        """
        nonlocal first_call_s, done_at_first_call, printed_tenths, last_total
        now_s = err.get_time()
        if first_call_s is None:
            # The time before the first item is the start of the processes, which does not
            # count towards the duration of an item.
            first_call_s = now_s
            done_at_first_call = done
        finished_tenths = done * _RUN_LINES // total
        if total != last_total:
            last_total = total
            printed_tenths = finished_tenths
        has_no_remaining_time = done in (total, done_at_first_call)
        if has_no_remaining_time or finished_tenths <= printed_tenths:
            return

        printed_tenths = finished_tenths
        elapsed_s = now_s - first_call_s
        remaining_s = elapsed_s / (done - done_at_first_call) * (total - done)
        print_line(f"  {done} of {total} {items}, about {format_wall_time(remaining_s)} left")

    yield show_line


def open_with_progress(first: Path, *more: Path, **allowed: Any) -> "Log":
    """Opens a log with a progress bar in the terminal, and warns about damaged parts.

    Args:
        first: File of the log, or its first part.
        *more: The other parts.
        **allowed: Further options of `open_log`.

    Raises:
        LogError: A file is missing, is not an MCAP file, or is not a trilat-net log.
    """
    from ..log import open_log

    with progress_bar(f"reading {first}") as progress:
        log = open_log(first, *more, progress=progress, **allowed)
    warn_of_damage(log)
    return log


def warn_of_damage(log: "Log") -> None:
    """Warns the user about damaged parts of a log, and names the command that saves the rest.

    Nothing is printed for an intact log.

    Args:
        log: The log.
    """
    for path in log.sources:
        warn_if_unfinished(Path(path))
    for problem in (*log.damaged[:_MAX_DAMAGED], *log.unreadable[:_MAX_DAMAGED]):
        print_note(problem)
    if log.damaged:
        unlisted_count = len(log.damaged) - _MAX_DAMAGED
        unlisted_text = (
            f"and {unlisted_count} more damaged parts; " if unlisted_count > 0 else ""
        )
        advice = "write everything that can be read to a new file with: trilat log recover FILE"
        print_note(f"{unlisted_text}{advice}")


def warn_user_laws(log: "Log") -> None:
    """Tells the user which user-written control laws will run when a run is computed again.

    The warning also lists laws that cannot run because the user has not permitted them.

    Args:
        log: The log of the run.
    """
    for law in log.scenario.inspect_user_laws():
        if law.allowed:
            print_note(f"executing this log runs code from outside: {law}")
        else:
            print_note(law)


def warn_if_unfinished(path: Path) -> None:
    """Warns the user if a log file is truncated, and names the command that recovers it.

    Nothing is printed for a complete file.

    Args:
        path: The file.

    Raises:
        LogError: The file cannot be read.
    """
    from ..log import RecoverySurvey

    survey = RecoverySurvey.of_unfinished_file(path)
    if survey is None:
        return
    if survey.is_finished:
        trailing = count_nouns(survey.trailing_bytes, "byte follows", "bytes follow")
        print_note(
            f"{path}: was finished, and {trailing} its end mark, which other programs may "
            f"refuse; make a file without them with: trilat log recover {path}"
        )
    elif survey.why_empty:
        print_note(f"{path}: nothing in it can be recovered: {survey.why_empty}")
    else:
        print_note(
            f"{path}: was not finished: its end and its index are missing; repair it with: "
            f"trilat log recover {path}"
        )


def _escape_controls(text: str) -> str:
    """Replaces control characters in a string with their names, as in <U+001B>.

    Otherwise output from another program could control the terminal, for example by clearing
    it.

    Args:
        text: The string.
    """
    return CONTROLS.sub(lambda match: f"<U+{ord(match[0]):04X}>", text)

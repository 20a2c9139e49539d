"""Terminal output that commands share: consoles, lines, tables, progress bar, opening of a log
with warnings.

Invariants: no control characters reach a terminal, whoever wrote a text: `TextConsole` and
`print_line` escape them; text from a file or a peer passes `sanitize` besides, which bounds its
length. Library code knows nothing of the bar; it calls a function with (done, total). Imports
only Rich at the top, so that `trilat --help` stays fast.
"""

import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from ..errors import count_nouns
from ..process import join_arguments

if TYPE_CHECKING:
    from ..log.log_reader import Log
    from ..results import Result
    from .conclude import Conclusion
    from .result_text import TextTable

_CONTROLS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)
"""What moves a cursor, rings, colours, or turns the direction of writing; no line ends and
tabs.
"""


def escape_controls(text: str) -> str:
    """Returns a text whose control characters are written out, as in U+001B."""
    return _CONTROLS.sub(lambda found: f"<U+{ord(found[0]):04X}>", text)


class TextConsole(Console):
    """A console on which texts, also those of tables, have no effect but that of their letters."""

    def render_str(self, text: str, **how: Any) -> Text:
        """Returns a text as it is shown; its controls are written out."""
        return super().render_str(escape_controls(text), **how)


out = TextConsole(highlight=False)
err = TextConsole(stderr=True, highlight=False)

PATIENCE_S = 1.0
"""Time until a progress bar appears, s."""
_EVERY_S = 0.1
_MAX_DAMAGED = 3
"""Damaged parts that are listed."""
MAX_LETTERS = 4000
"""Of a line."""
_PIPE_WIDTH = 160
"""Columns that output has at least where it is no terminal."""


def sanitize(text: object, most: int = 300) -> str:
    """Returns a text for a terminal: no control characters, at most `most` letters."""
    plain = "".join(
        letter if letter.isprintable() else "\ufffd" for letter in str(text)[: most + 1]
    )
    return plain if len(plain) <= most else plain[:most] + "..."


def print_text(text: object, console: Console = out, head: str = "") -> None:
    """Prints a line as it is, sanitized, behind a head."""
    console.print(head + sanitize(text, MAX_LETTERS), markup=False, soft_wrap=True)


def print_note(text: object) -> None:
    """Prints a note to standard error."""
    print_text(text, err, "note: ")


def print_error(text: object) -> None:
    """Prints an error to standard error."""
    print_text(text, err, "error: ")


def print_marked(mark: str, text: object) -> None:
    """Prints a line behind a mark, which is of Rich's markup."""
    out.print(f"{mark} {escape(sanitize(text, MAX_LETTERS))}", soft_wrap=True)


def print_texts(texts: Iterable[object]) -> None:
    """Prints lines as `print_text` does."""
    for text in texts:
        print_text(text)


def print_paths(paths: Iterable[Path]) -> None:
    """Prints the files that were written, a line each."""
    print_texts(f"  {path}" for path in paths)


def print_json(value: Any) -> None:
    """Prints JSON; NaN is an error."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    print_line(_CONTROLS.sub(lambda found: f"\\u{ord(found[0]):04x}", text))


def print_line(text: str) -> None:
    """Prints a line at once, for programs that read the output."""
    sys.stdout.write(escape_controls(text) + "\n")
    sys.stdout.flush()


def print_table(table: "TextTable") -> None:
    """Prints a table."""
    wide = TextConsole(file=out.file, width=max(out.width, _PIPE_WIDTH), highlight=False)
    (out if out.is_terminal else wide).print(table.rich())


def print_result(found: "Result", *, as_json: bool = False) -> None:
    """Prints a result: its text, or its values as JSON."""
    if as_json:
        print_json(found.to_dict())
        return
    from .result_text import TextTable, compose

    for block in compose(found):
        if isinstance(block, TextTable):
            print_table(block)
        elif block.mark:
            print_marked(block.mark, block.text)
        else:
            print_text(block.text, err if block.failed else out)


@contextmanager
def lines_aside(aside: bool) -> Iterator[None]:
    """Prints what would go to standard output to standard error, where that is for JSON."""
    with redirect_stdout(sys.stderr) if aside else nullcontext():
        yield


def conclude_files(
    paths: Sequence[Path], folder: Path, *, as_json: bool = False, png: bool = False
) -> "tuple[Log, Conclusion]":
    """Checks a log that was just recorded, writes its report into a folder and prints the
    conclusion.

    Interrupted, it says how to do that later.
    """
    from .conclude import conclude

    if not as_json:
        out.print("checking the log and drawing ...")
    try:
        log = open_with_progress(*paths)
        with progress_bar("executing and drawing") as progress:
            conclusion = conclude(log, folder, progress, png=png)
    except KeyboardInterrupt:
        files = join_arguments(map(str, paths))
        later = f"trilat report {files} -o {join_arguments([str(folder)])} --force"
        print_note(f"the log is kept: {files}; its report can be drawn later: {later}")
        raise
    print_result(conclusion, as_json=as_json)
    return log, conclusion


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yields a function to call with (done, total) at any rate; it draws on a terminal, after a
    second.
    """
    if not err.is_interactive:
        yield lambda _done, _total: None
        return
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    name = TextColumn("{task.description}", markup=False)
    display = Progress(name, *columns, console=err, transient=True, auto_refresh=False)
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


def open_with_progress(first: Path, *more: Path, **allowed: Any) -> "Log":
    """Returns the log in a file, or in the files that are its parts, as `open_log`, and warns
    of damage.

    Raises:
        LogError: one is missing, is no MCAP file, or no log of trilat-net.
    """
    from ..log.log_reader import open_log

    with progress_bar(f"reading {first}") as progress:
        log = open_log(first, *more, progress=progress, **allowed)
    warn_of_damage(log)
    return log


def warn_of_damage(log: "Log") -> None:
    """Warns of what a log lacks, and says what to do."""
    for path in log.sources:
        warn_if_unfinished(Path(path))
    for problem in (*log.damaged[:_MAX_DAMAGED], *log.unreadable[:_MAX_DAMAGED]):
        print_note(problem)
    if log.damaged:
        rest = len(log.damaged) - _MAX_DAMAGED
        unlisted = f"and {rest} more damaged parts; " if rest > 0 else ""
        print_note(
            f"{unlisted}make a whole file of everything that can be read: trilat log recover FILE"
        )


def warn_user_laws(log: "Log") -> None:
    """Warns of code outside the log, which an execution of the log runs, or may not run."""
    from ..scenario.code_consent import find_user_laws

    for law in find_user_laws(log.scenario):
        print_note(
            f"executing this log runs code from outside: {law}" if law.allowed else str(law)
        )


def warn_if_unfinished(path: Path) -> None:
    """Warns of a file that does not end as a finished one does, with the command that mends it,
    if one can.

    Raises:
        LogError: it cannot be read.
    """
    from ..files import reading
    from ..log.mcap_records import RecordScanner
    from ..log.recovery_survey import RecoverySurvey

    with reading(path) as stream:
        scanner = RecordScanner(stream)
        if scanner.ends:
            return
        survey = RecoverySurvey(scanner)
    if scanner.finished:
        print_note(
            f"{path}: was finished, and "
            f"{count_nouns(scanner.trailing, 'byte follows', 'bytes follow')} its end mark, which other "
            f"programs may refuse; make a file without them with: trilat log recover {path}"
        )
    elif survey.why_empty:
        print_note(f"{path}: nothing in it can be recovered: {survey.why_empty}")
    else:
        print_note(
            f"{path}: was not finished: its end and its index are missing; make it whole with: "
            f"trilat log recover {path}"
        )

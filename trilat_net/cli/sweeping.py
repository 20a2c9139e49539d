"""Runs a sweep for the command line: says what and how long, runs, shows what came of it and what is next.

Law: results go to their folder, words to people; whatever ends a sweep, what is said names how to go on.
"""

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from .options import err, out, say
from .progress import bar

if TYPE_CHECKING:
    from ..sweep import Plan, Swept
    from ..sweep.cell import Entry
    from ..sweep.folder import Folder

_LINES = 10
"""So many lines say how far a sweep is, where there is no terminal for a bar."""


def sweep(asked: "Plan", output: Path | None, jobs: int | None, *, yes: bool) -> "Swept":
    """Runs a sweep, or goes on with it where its folder holds it."""
    from ..sweep.folder import PLAN, new_folder
    from ..sweep.running import estimate, refuse_enormous

    if output is not None and (output / PLAN).exists():
        return _go_on(new_folder(asked, output), jobs, yes=yes)
    _announce(asked)
    expected = estimate(asked, jobs=jobs)
    if not yes:
        refuse_enormous(asked, expected, jobs)
    return _run(new_folder(asked, output), jobs, expected.seconds, expected.entries)


def resume(path: Path, jobs: int | None, *, yes: bool) -> "Swept":
    """Goes on with a sweep that was interrupted."""
    from ..sweep import old_folder

    return _go_on(old_folder(path), jobs, yes=yes)


def _go_on(folder: "Folder", jobs: int | None, *, yes: bool) -> "Swept":
    """Runs what is left of a sweep."""
    from ..sweep.running import estimate, refuse_enormous

    with folder.journal() as journal:
        done = list(journal.done)
    _announce(folder.plan)
    out.print(f"  {len(done)} runs are done already", soft_wrap=True)
    expected = estimate(folder.plan, done, jobs)
    if not yes:
        refuse_enormous(folder.plan, expected, jobs)
    return _run(folder, jobs, expected.seconds, expected.entries)


def _announce(asked: "Plan") -> None:
    from ..sweep.report import opening

    for line in opening(asked):
        out.print(escape(line), soft_wrap=True)


def _run(folder: "Folder", jobs: int | None, seconds: float, known: "Sequence[Entry]") -> "Swept":
    """Runs a sweep in its folder and shows what came of it; Ctrl-C says how to go on."""
    from ..sweep import run
    from ..sweep.running import spoken

    if seconds:
        line = f"  about {spoken(seconds)}, by some of its cells; into {folder.path}"
        out.print(escape(line), soft_wrap=True)
    try:
        with _progress() as progress:
            swept = run(folder, jobs, progress, known)
    except KeyboardInterrupt:
        with folder.journal() as journal:
            done = len(journal.done)
        where = shlex.quote(str(folder.path))
        err.print(f"{done} runs are done and kept; go on with: trilat sweep --resume {where}", soft_wrap=True)
        raise
    if not (known or swept.speed.runs):
        out.print("nothing was left to run")
    _show(swept)
    return swept


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """Yields what is told how far a sweep is: a bar, or where there is no terminal a line now and then."""
    if err.is_interactive:
        with bar("sweeping") as show:
            yield show
        return
    from ..net.clock import SystemClock
    from ..sweep.running import spoken

    clock = SystemClock()
    began_ns, first, said = -1, 0, 0

    def line(done: int, total: int) -> None:
        nonlocal began_ns, first, said
        if began_ns < 0:  # not before: processes that begin take seconds, and none later
            began_ns, first = clock.monotonic_ns(), done
        if done in (total, first) or done * _LINES // total <= said:
            return
        said = done * _LINES // total
        left_s = (clock.monotonic_ns() - began_ns) * 1e-9 / (done - first) * (total - done)
        out.print(f"  {done} of {total} runs, about {spoken(left_s)} left", soft_wrap=True)

    yield line


def _show(swept: "Swept") -> None:
    from ..sweep.report import next_commands, speed_line, summary

    speed = [speed_line(swept.speed)] if swept.speed.runs else []
    for line in [*summary(swept.results), *speed, f"results: {swept.folder.results}"]:
        out.print(escape(line), soft_wrap=True)
    for line in next_commands(swept.folder.path):
        out.print(f"  {escape(line)}", soft_wrap=True)


def show_results(path: Path) -> None:
    """Prints what came of a sweep once more."""
    from ..sweep import read_results
    from ..sweep.report import next_commands, opening, summary

    results = read_results(path)
    for line in [*opening(results.plan), *summary(results)]:
        out.print(escape(line), soft_wrap=True)
    for line in next_commands(path):
        out.print(f"  {escape(line)}", soft_wrap=True)


def show_cell(path: Path, number: int) -> None:
    """Prints the commands that make logs of a cell, one per seed."""
    from ..sweep import read_results
    from ..sweep.again import again

    results = read_results(path)
    for row in results.of_cell(number):
        found = again(results, row, path if path.is_dir() else path.parent)
        if found.note:
            err.print(f"note: {escape(found.note)}", soft_wrap=True)
        say(found.command)

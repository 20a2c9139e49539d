"""Runs a fair comparison for the command line: says the time beforehand, searches, prints, writes."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from .beside import print_table
from .options import out, say
from .progress import bar

if TYPE_CHECKING:
    from ..tuning import Plan, Tuned
    from ..tuning.tables import Table as Cells

_SHOWN = 8
"""So many points of a front are printed; all stand in the files."""


def tune(asked: "Plan", folder: Path | None, jobs: int | None, *, force: bool, as_json: bool) -> None:
    """Runs a comparison, writes it into a folder, and prints it.

    Args:
        asked: the comparison.
        folder: where it goes; None for the next free one below runs.
        jobs: in how many processes; None for one per core.
        force: whether a folder that holds something may be used.
        as_json: whether to print it as JSON.
    """
    from ..results import results_folder
    from ..tuning.facts import facts
    from ..tuning.report import write

    chosen = results_folder(folder, f"tune-{asked.base.scenario.name}", force=force)
    if not as_json:
        _announce(asked, jobs)
    with bar("searching") as progress:
        found = asked.run(jobs, progress)
    paths = write(found, chosen)
    if as_json:
        say(json.dumps(facts(found), indent=2, ensure_ascii=False, allow_nan=False))
    else:
        _show(found)
        for path in paths:
            out.print(f"  {escape(str(path))}", soft_wrap=True)


def _announce(asked: "Plan", jobs: int | None) -> None:
    """Prints what is the same for all laws, and how long the search will take."""
    from ..tuning.tables import procedure
    from ..workers import cores

    laws = ", ".join(space.law for space in asked.spaces)
    out.print(escape(f"{asked.base.scenario.name}, laws {laws}; the same for all:"), soft_wrap=True)
    for line in procedure(asked):
        out.print(escape(f"  {line}"), soft_wrap=True)
    used = jobs or cores()
    time = _time(asked.estimate_s(jobs))
    on = "1 core" if used == 1 else f"{used} cores"
    out.print(
        f"{asked.runs} runs on {on}: about {time} at the speed that this machine has now", soft_wrap=True
    )


def _time(seconds: float) -> str:
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


def _show(found: "Tuned") -> None:
    """Prints the laws, every front, the gains as printed, and the commands of the best points."""
    from ..tuning.tables import front_of, laws, meanings, printed

    show_cells(laws(found))
    for line in meanings():
        out.print(escape(f"  {line}"), soft_wrap=True)
    for law in found.found:
        if law.front:
            show_cells(front_of(found, law, _SHOWN))
    out.print(f"  * no candidate of any law is better in both; of long fronts {_SHOWN} points are shown")
    show_cells(printed(found))
    for law in found.found:
        for gain in found.at_edge(law):
            out.print(
                f"note: {law.space.law} has its least at the edge of what is searched of {gain}; "
                "it may lie beyond",
                soft_wrap=True,
            )
    if not any(law.front for law in found.found):
        out.print("\nno candidate of any law settled: a longer --duration or a larger --budget may show more")
        return
    out.print("\nthe last of each front, to run; the others stand in front.md:")
    for law in found.found:
        for place in law.front[-1:]:
            out.print(f"  {escape(found.candidate(law, place).command)}", soft_wrap=True)


def show_cells(cells: "Cells") -> None:
    """Prints a table of texts: words to the left, numbers to the right."""
    from ..tuning.tables import WORDS

    table = Table(box=None, pad_edge=False, header_style="bold")
    for head in cells.heads:
        table.add_column(escape(head), justify="left" if head in WORDS else "right", no_wrap=True)
    for row in cells.rows:
        table.add_row(*map(escape, row))
    print_table(table)

"""Maps of a sweep for the command line: drawn, their edges searched, cells beside them run live.

Law: what is printed stands in the files, and the other way round.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from rich.table import Table

from .beside import print_table
from .options import err, out
from .progress import bar

if TYPE_CHECKING:
    from ..scenario import Scenario
    from ..sweep.confirmation import Session
    from ..sweep.grid import Grid
    from ..sweep.plan import Plan
    from ..sweep.table import Results


def draw(results: "Results", folder: Path, width_in: float, jobs: int | None) -> None:
    """Draws the map of a sweep into its folder: map.png, map.svg, map.md.

    Args:
        results: the sweep.
        folder: where to.
        width_in: 3.5 or 7, in.
        jobs: in how many processes; None for one per core.
    """
    from ..sweep.chart import chart, sweep_command
    from ..sweep.page import write

    width = [] if width_in == 3.5 else ["--width", f"{width_in:g}"]
    command = sweep_command(results.plan, "--map", *width)
    with bar("linear analysis") as progress:
        made = chart(results, (command,), jobs, progress)
    for path in write(made, folder, width_in):
        out.print(f"  {escape(str(path))}", soft_wrap=True)
    for line in made.remarks:
        out.print(escape(f"note: {line}"), soft_wrap=True)


def find_margins(asked: "Plan", within: str, tolerance: float, folder: Path | None, jobs: int | None) -> None:
    """Searches edges along one key, prints them beside theory, and writes them: margin.json and margin.md.

    Args:
        asked: the plan whose last axis is the two ends of the range.
        within: the range, as it was asked for.
        tolerance: how wide an edge may be, over its value.
        folder: where results go; None for the next free one below runs.
        jobs: in how many processes; None for one per core.
    """
    from ..results import results_folder
    from ..sweep.margin_page import facts, page, table
    from ..sweep.margins import margins, search_range

    wanted = search_range(within, tolerance)
    chosen = results_folder(folder, f"margin-{asked.base.name}", force=False)
    with bar("searching") as progress:
        found = margins(asked, wanted, jobs, progress)
    _show(table(asked, wanted, found))
    data, text = chosen / "margin.json", chosen / "margin.md"
    data.write_text(json.dumps(facts(asked, wanted, found), indent=2, allow_nan=False) + "\n", "utf-8")
    text.write_text(page(asked, wanted, found), "utf-8")
    for path in (data, text):
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def confirm_live(results: "Results", count: int, longest_s: float) -> None:
    """Runs cells beside the edges of a sweep over a network and compares verdicts.

    Args:
        results: the sweep.
        count: how many on each side.
        longest_s: cells that ran longer are passed over, s.

    Raises:
        UsageError: there is no edge, or no cell beside it.
        Exit: 1 where a verdict differs; 128 + n where signal n ended it.
    """
    from ..sweep.confirmation import beside_edges, confirm, confirmed_table

    keys = [one.key for one in results.plan.axes]
    rows = beside_edges(results.rows, keys, count, longest_s)
    run = _runner(results.plan.base.name)
    found = [confirm(row, run, longest_s) for row in rows]
    _show(confirmed_table(found, keys))
    differ = sum(not one.same for one in found)
    out.print(f"{len(found) - differ} of {len(found)} verdicts are the same")
    if differ:
        raise typer.Exit(1)


def _runner(name: str) -> "Callable[[Scenario, str], Session]":
    """Returns what runs a scenario over a network, in a folder of its own."""
    from sites.demo import run_demo
    from sites.display import Display

    from ..results import results_folder
    from ..sweep.confirmation import Session

    def run(scenario: "Scenario", cell: str) -> Session:
        folder = results_folder(None, f"confirm-{name}-{cell}", force=False)
        out.print(escape(f"{cell}: {scenario.duration_s:g} s live, into {folder}"), soft_wrap=True)
        with Display(scenario, out) as display:
            outcome = run_demo(scenario, folder, display)
        if outcome.interrupted:
            err.print("interrupted")
            raise typer.Exit(128 + outcome.interrupted)
        return Session(outcome.log, outcome.problems)

    return run


def _show(grid: "Grid") -> None:
    """Prints a table; where nobody looks at a terminal, as wide as it wants to be."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for head in grid.heads:
        table.add_column(escape(head), overflow="fold")
    for row in grid.rows:
        table.add_row(*map(escape, row))
    print_table(table)

"""Maps of a sweep for the command line: drawn, their edges searched, cells beside them run live.

Law: what is printed stands in the files as well, but for live runs, which have logs.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from ..errors import UsageError
from .beside import print_table
from .options import err, out
from .progress import bar

if TYPE_CHECKING:
    from ..scenario import Scenario
    from ..sweep.confirmation import Session
    from ..sweep.grid import Grid
    from ..sweep.plan import Plan
    from ..sweep.table import Results

_PANEL = "Maps and edges"
_WIDTH_IN = 3.5

MapOption = Annotated[
    bool,
    typer.Option("--map", help="Draw the map, and the lines of theory on it.", rich_help_panel=_PANEL),
]
WidthOption = Annotated[
    float | None,
    typer.Option(
        "--width", metavar="3.5|7", help="Of the map, in; default: one column.", rich_help_panel=_PANEL
    ),
]
MarginOption = Annotated[
    str | None,
    typer.Option(
        "--margin",
        metavar="KEY=FROM:TO",
        help="Search the edge along a key instead, at every place of the axes.",
        rich_help_panel=_PANEL,
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        "--tolerance",
        metavar="SHARE",
        help="How wide an edge may be, over its value; default: 0.005.",
        rich_help_panel=_PANEL,
    ),
]
ConfirmOption = Annotated[
    int | None,
    typer.Option(
        "--confirm",
        metavar="K",
        min=1,
        help="Of results: run so many cells on each side of the edge live.",
        rich_help_panel=_PANEL,
    ),
]


def refuse_contradictions(
    mapped: bool,
    width: float | None,
    margin: str | None,
    tolerance: float | None,
    confirm: int | None,
    cell: int | None,
) -> None:
    """Refuses options that ask for two things, or say how to do what was not asked for.

    Raises:
        UsageError: some do.
    """
    wanted = {
        "--map": mapped,
        "--margin": margin is not None,
        "--confirm": confirm is not None,
        "--cell": cell is not None,
    }
    asked = [name for name, is_asked in wanted.items() if is_asked]
    if len(asked) > 1:
        raise UsageError(f"{' and '.join(asked)} are two things: ask for one at a time")
    if width is not None and not mapped:
        raise UsageError("--width is of a map: use it with --map")
    if tolerance is not None and margin is None:
        raise UsageError("--tolerance is of an edge: use it with --margin")


def of_results(path: Path, width: float | None, confirm: int | None, jobs: int | None) -> None:
    """Draws the map of results, or confirms some of their cells.

    Args:
        path: their folder or file.
        width: of the map, in; None for one column.
        confirm: how many cells on each side of the edge are run live; None: the map is drawn.
        jobs: in how many processes; None for one per core.
    """
    from ..sweep import read_results

    results = read_results(path)
    if confirm is not None:
        confirm_live(results, confirm)
    else:
        draw_if(True, results, path if path.is_dir() else path.parent, width, jobs)


def draw_if(mapped: bool, results: "Results", folder: Path, width: float | None, jobs: int | None) -> None:
    """Draws the map of a sweep into its folder, if it is wanted: map.png, map.svg, map.md.

    Args:
        mapped: whether it is.
        results: the sweep.
        folder: where to.
        width: 3.5 or 7, in; None for one column.
        jobs: in how many processes; None for one per core.
    """
    if not mapped:
        return
    from ..analysis.form import printed
    from ..sweep.chart import chart, sweep_command
    from ..sweep.page import write

    form = printed(_WIDTH_IN if width is None else width)
    words = [] if width is None else ["--width", f"{width:g}"]
    with bar("linear analysis") as progress:
        made = chart(results, (sweep_command(results.plan, "--map", *words),), jobs, progress)
    for line in made.remarks:
        out.print(escape(f"note: {line}"), soft_wrap=True)
    for path in write(made, folder, form.width_in):
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def range_axis(margin: str) -> str:
    """Returns the range of a margin as an axis of its two ends, so that a plan checks both."""
    from ..sweep.margins import range_axis as axis
    from ..sweep.margins import search_range

    return axis(search_range(margin))


def find_margins(
    asked: "Plan", margin: str, tolerance: float | None, folder: Path | None, jobs: int | None
) -> None:
    """Searches edges along one key, prints them beside theory, and writes margin.json and margin.md.

    Args:
        asked: the plan whose last axis is the two ends of the range.
        margin: the range, as it was asked for.
        tolerance: how wide an edge may be, over its value; None for the usual one.
        folder: where results go; None for the next free one below runs.
        jobs: in how many processes; None for one per core.
    """
    from ..results import results_folder
    from ..sweep.margin import TOLERANCE
    from ..sweep.margin_page import facts, page, table
    from ..sweep.margins import margins, search_range

    within = search_range(margin, TOLERANCE if tolerance is None else tolerance)
    chosen = results_folder(folder, f"margin-{asked.base.name}", force=False)
    with bar("searching") as progress:
        found = margins(asked, within, jobs, progress)
    _show(table(asked, within, found))
    data, text = chosen / "margin.json", chosen / "margin.md"
    data.write_text(json.dumps(facts(asked, within, found), indent=2, allow_nan=False) + "\n", "utf-8")
    text.write_text(page(asked, within, found), "utf-8")
    for path in (data, text):
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def confirm_live(results: "Results", count: int) -> None:
    """Runs cells beside the edges of a sweep over a network and compares verdicts.

    Args:
        results: the sweep.
        count: how many on each side.

    Raises:
        UsageError: there is no edge, or no cell beside it.
        Exit: 1 where a verdict differs; 128 + n where signal n ended it.
    """
    from ..sweep.confirmation import beside_edges, confirm, confirmed_table

    keys = [one.key for one in results.plan.axes]
    rows = beside_edges(results.rows, keys, count)
    run = _runner(results.plan.base.name)
    found = [confirm(row, run) for row in rows]
    _show(confirmed_table(found, keys))
    same = sum(one.same for one in found)
    out.print(f"{same} of {len(found)} verdicts are the same")
    if same < len(found):
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

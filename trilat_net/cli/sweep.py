"""`trilat sweep`: runs a scenario over a grid of its keys, maps stability, finds edges, confirms cells live.

Invariant: everything printed is in the result files too, except live runs, which have logs. A sweep that is
interrupted prints the command that resumes it.
"""

import json
import shlex
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from ..errors import UsageError
from ..reporting.terminal_output import err, out, print_line, print_table, progress_bar
from .options import DurationOption, OnOption, SetOption
from .test import parse_seeds

if TYPE_CHECKING:
    from ..scenario import Scenario
    from ..studies.sweep import FinishedSweep
    from ..studies.sweep.live_confirmation import LiveSession
    from ..studies.sweep.sweep_folder import SweepFolder
    from ..studies.sweep.sweep_plan import SweepPlan
    from ..studies.sweep.sweep_results import SweepResults
    from ..studies.sweep.sweep_run import DurationEstimate


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


def check_map_options(
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


def map_results(
    path: Path, width: float | None, confirm: int | None, jobs: int | None, on: str | None = None
) -> None:
    """Draws the map of results, or confirms some of their cells.

    Args:
        path: their folder or file.
        width: of the map, in; None for one column.
        confirm: how many cells on each side of the edge are run live; None: the map is drawn.
        jobs: in how many processes; None for one per core.
        on: the address of a Dask scheduler; None for processes of this machine.
    """
    from ..studies.sweep import read_results

    results = read_results(path)
    if confirm is not None:
        confirm_cells_live(results, confirm)
    else:
        draw_sweep_map(True, results, path if path.is_dir() else path.parent, width, jobs, on)


def draw_sweep_map(
    mapped: bool,
    results: "SweepResults",
    folder: Path,
    width: float | None,
    jobs: int | None,
    on: str | None = None,
) -> None:
    """Draws the map of a sweep into its folder, if it is wanted: map.png, map.svg, map.md.

    Args:
        mapped: whether it is.
        results: the sweep.
        folder: where to.
        width: 3.5 or 7, in; None for one column.
        jobs: in how many processes; None for one per core.
        on: the address of a Dask scheduler; None for processes of this machine.
    """
    if not mapped:
        return
    from ..reporting.figure_size import make_print_size
    from ..studies.sweep.map_page import write_map
    from ..studies.sweep.stability_map import build_stability_map, build_sweep_command

    form = make_print_size(_WIDTH_IN if width is None else width)
    words = [] if width is None else ["--width", f"{width:g}"]
    with progress_bar("linear analysis") as progress:
        made = build_stability_map(
            results, (build_sweep_command(results.plan, "--map", *words),), jobs, progress, on=on
        )
    for line in made.remarks:
        out.print(escape(f"note: {line}"), soft_wrap=True)
    for path in write_map(made, folder, form.width_in):
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def margin_range_axis(margin: str) -> str:
    """Returns the range of a margin as an axis of its two ends, so that a plan checks both."""
    from ..studies.sweep.margin_search import format_range_axis as axis
    from ..studies.sweep.margin_search import parse_search_range

    return axis(parse_search_range(margin))


def print_margins(
    asked: "SweepPlan",
    margin: str,
    tolerance: float | None,
    folder: Path | None,
    jobs: int | None,
    on: str | None = None,
) -> None:
    """Searches edges along one key, prints them beside theory, and writes margin.json and margin.md.

    Args:
        asked: the plan whose last axis is the two ends of the range.
        margin: the range, as it was asked for.
        tolerance: how wide an edge may be, over its value; None for the usual one.
        folder: where results go; None for the next free one below runs.
        jobs: in how many processes; None for one per core.
        on: the address of a Dask scheduler; None for processes of this machine.
    """
    from ..files import make_results_folder, write_whole
    from ..studies.sweep.margin_search import (
        MARGIN_TOLERANCE,
        build_margin_page,
        margins_to_json,
        parse_search_range,
        search_margins,
        tabulate_margins,
    )

    within = parse_search_range(margin, MARGIN_TOLERANCE if tolerance is None else tolerance)
    chosen = make_results_folder(folder, f"margin-{asked.base.name}", force=False)
    with progress_bar("searching") as progress:
        found = search_margins(asked, within, jobs, progress, on)
    out.print()
    print_table(tabulate_margins(asked, within, found))
    data, text = chosen / "margin.json", chosen / "margin.md"
    write_whole(data, json.dumps(margins_to_json(asked, within, found), indent=2, allow_nan=False) + "\n")
    write_whole(text, build_margin_page(asked, within, found))
    for path in (data, text):
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def confirm_cells_live(results: "SweepResults", count: int) -> None:
    """Runs cells beside the edges of a sweep over a network and compares verdicts.

    Args:
        results: the sweep.
        count: how many on each side.

    Raises:
        UsageError: there is no edge, or no cell beside it.
        Exit: 1 where a verdict differs; 128 + n where signal n ended it.
    """
    from ..studies.sweep.live_confirmation import choose_cells_near_edges, confirm_cell
    from ..studies.sweep.map_page import tabulate_confirmations

    keys = [one.key for one in results.plan.axes]
    rows = choose_cells_near_edges(results.rows, keys, count)
    run = _live_runner(results.plan.base.name)
    found = [confirm_cell(row, run) for row in rows]
    out.print()
    print_table(tabulate_confirmations(found, keys))
    same = sum(one.same for one in found)
    out.print(f"{same} of {len(found)} verdicts are the same")
    if same < len(found):
        raise typer.Exit(1)


def _live_runner(name: str) -> "Callable[[Scenario, str], LiveSession]":
    """Returns what runs a scenario over a network, in a folder of its own."""
    from sites.demo_session import run_demo
    from sites.monitor import SessionDisplay

    from ..files import make_results_folder
    from ..studies.sweep.live_confirmation import LiveSession

    def run(scenario: "Scenario", cell: str) -> LiveSession:
        folder = make_results_folder(None, f"confirm-{name}-{cell}", force=False)
        out.print(escape(f"{cell}: {scenario.duration_s:g} s live, into {folder}"), soft_wrap=True)
        with SessionDisplay(scenario, out) as display:
            outcome = run_demo(scenario, folder, display)
        if outcome.interrupted:
            err.print("interrupted")
            raise typer.Exit(128 + outcome.interrupted)
        return LiveSession(outcome.log, outcome.problems)

    return run


_LINES = 10
"""So many lines say how far a sweep is, where there is no terminal for a bar."""


def start_sweep(
    asked: "SweepPlan", output: Path | None, jobs: int | None, *, yes: bool, on: str | None = None
) -> "FinishedSweep":
    """Runs a sweep, or goes on with it where its folder holds it."""
    from ..studies.executor import count_workers
    from ..studies.sweep.sweep_folder import PLAN_FILE, prepare_sweep_folder
    from ..studies.sweep.sweep_run import estimate_sweep, refuse_oversized_sweep

    if output is not None and (output / PLAN_FILE).exists():
        return _run_rest(prepare_sweep_folder(asked, output), jobs, on, yes=yes)
    _print_plan(asked)
    workers = count_workers(jobs, on)
    expected = estimate_sweep(asked, jobs=workers)
    if not yes:
        refuse_oversized_sweep(asked, expected, workers)
    return _run_in_folder(prepare_sweep_folder(asked, output), jobs, on, expected)


def resume_sweep(path: Path, jobs: int | None, *, yes: bool, on: str | None = None) -> "FinishedSweep":
    """Goes on with a sweep that was interrupted."""
    from ..studies.sweep import open_sweep_folder

    return _run_rest(open_sweep_folder(path), jobs, on, yes=yes)


def _run_rest(folder: "SweepFolder", jobs: int | None, on: str | None, *, yes: bool) -> "FinishedSweep":
    """Runs what is left of a sweep."""
    from ..studies.executor import count_workers
    from ..studies.sweep.sweep_run import estimate_sweep, refuse_oversized_sweep

    with folder.journal() as journal:
        done = list(journal.done)
    _print_plan(folder.plan)
    out.print(f"  {len(done)} runs are done already", soft_wrap=True)
    workers = count_workers(jobs, on)
    expected = estimate_sweep(folder.plan, done, workers)
    if not yes:
        refuse_oversized_sweep(folder.plan, expected, workers)
    return _run_in_folder(folder, jobs, on, expected)


def _print_plan(asked: "SweepPlan") -> None:
    from ..studies.sweep.sweep_report import describe_sweep_plan

    for line in describe_sweep_plan(asked):
        out.print(escape(line), soft_wrap=True)


def _run_in_folder(
    folder: "SweepFolder", jobs: int | None, on: str | None, expected: "DurationEstimate"
) -> "FinishedSweep":
    """Runs a sweep in its folder and shows what came of it; Ctrl-C says how to go on."""
    from ..studies.sweep import run_sweep
    from ..studies.sweep.sweep_run import format_wall_time

    if expected.seconds:
        line = f"  about {format_wall_time(expected.seconds)}, by some of its cells; into {folder.path}"
        out.print(escape(line), soft_wrap=True)
    try:
        with _sweep_progress() as progress:
            swept = run_sweep(folder, jobs, progress, expected.entries, on)
    except KeyboardInterrupt:
        with folder.journal() as journal:
            done = len(journal.done)
        where = shlex.quote(str(folder.path))
        err.print(f"{done} runs are done and kept; go on with: trilat sweep --resume {where}", soft_wrap=True)
        raise
    if not (expected.entries or swept.speed.runs):
        out.print("nothing was left to run")
    _print_swept(swept)
    return swept


@contextmanager
def _sweep_progress() -> Iterator[Callable[[int, int], None]]:
    """Yields what is told how far a sweep is: a bar, or where there is no terminal a line now and then."""
    if err.is_interactive:
        with progress_bar("sweeping") as show:
            yield show
        return
    from ..net.clock import SystemClock
    from ..studies.sweep.sweep_run import format_wall_time

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
        out.print(f"  {done} of {total} runs, about {format_wall_time(left_s)} left", soft_wrap=True)

    yield line


def _print_swept(swept: "FinishedSweep") -> None:
    from ..studies.sweep.sweep_report import describe_sweep_speed, list_next_commands, summarize_sweep

    speed = [describe_sweep_speed(swept.speed)] if swept.speed.runs else []
    for line in [*summarize_sweep(swept.results), *speed, f"results: {swept.folder.results}"]:
        out.print(escape(line), soft_wrap=True)
    for line in list_next_commands(swept.folder.path):
        out.print(f"  {escape(line)}", soft_wrap=True)


def print_sweep_results(path: Path) -> None:
    """Prints what came of a sweep once more."""
    from ..studies.sweep import read_results
    from ..studies.sweep.sweep_report import describe_sweep_plan, list_next_commands, summarize_sweep

    results = read_results(path)
    for line in [*describe_sweep_plan(results.plan), *summarize_sweep(results)]:
        out.print(escape(line), soft_wrap=True)
    for line in list_next_commands(path):
        out.print(f"  {escape(line)}", soft_wrap=True)


def print_cell_commands(path: Path, number: int) -> None:
    """Prints the commands that make logs of a cell, one per seed."""
    from ..studies.sweep import read_results
    from ..studies.sweep.sweep_report import build_reproduce_command

    results = read_results(path)
    for row in results.of_cell(number):
        found = build_reproduce_command(results, row, path if path.is_dir() else path.parent)
        if found.note:
            err.print(f"note: {escape(found.note)}", soft_wrap=True)
        print_line(found.command)


app = typer.Typer()


@app.command(
    "sweep",
    epilog="Example: trilat sweep p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1\n\n"
    "Example: trilat sweep p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3\n\n"
    "Example: trilat sweep runs/sweep-p_d_margin-001 --cell 17",
)
def sweep_command(
    scenario: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENARIO|RESULTS]",
            help="Name of a shipped scenario, or path of a TOML file; or of the results of a sweep.",
        ),
    ] = None,
    over: Annotated[
        list[str] | None,
        typer.Option(
            "--over",
            metavar="KEY=VALUES",
            help="An axis, as in link.delay_ms=0:1600:50 or link.order=newest,in_order; repeatable.",
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds", metavar="N|LIST", help="How many per cell, or which, as in 1..20; default: one."
        ),
    ] = None,
    law: Annotated[
        str | None,
        typer.Option("--law", metavar="LAW,LAW...", help="Sweep laws as well; default: the scenario's."),
    ] = None,
    duration: DurationOption = None,
    longest: Annotated[
        float | None,
        typer.Option(
            "--longest",
            metavar="S",
            help="How long an undecided cell may run, s; default: eight times the others.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="Where results go; one that holds this sweep is gone on with. Default: runs/sweep-NAME-N.",
        ),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="DIR", help="Go on with a sweep that was interrupted.")
    ] = None,
    cell: Annotated[
        int | None,
        typer.Option("--cell", metavar="N", help="Of results: print the command that makes a log of a cell."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", metavar="N", min=1, help="Processes; default: one per core.")
    ] = None,
    on: OnOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Run it though it is enormous.")] = False,
    overrides: SetOption = None,
    mapped: MapOption = False,
    width: WidthOption = None,
    margin: MarginOption = None,
    tolerance: ToleranceOption = None,
    confirm: ConfirmOption = None,
) -> None:
    """Runs a scenario over a plane of its keys, in virtual time on all cores, and says what is stable.

    What is done is kept, whatever ends the sweep: the same command with the same -o, or --resume, goes on.
    """
    from ..studies.sweep.sweep_results import require_polars

    require_polars()
    asking = {
        "--over": over,
        "--seeds": seeds,
        "--law": law,
        "--duration": duration,
        "--longest": longest,
        "--set": overrides,
    }
    check_map_options(mapped, width, margin, tolerance, confirm, cell)
    if cell is not None or resume is not None or _is_results(scenario):
        _refuse_given({**asking, "-o": output}.items(), "is of the sweep already: leave it out")
        _refuse_given([("--margin", margin)], "is of a scenario, and searches anew: name that")
    elif confirm is not None:
        raise UsageError("--confirm is of results: trilat sweep FOLDER --confirm 5")
    if resume is not None:
        if scenario is not None or cell is not None:
            raise UsageError("--resume goes on with the sweep of its folder: leave the rest out")
        swept = resume_sweep(resume, jobs, yes=yes, on=on)
        draw_sweep_map(mapped, swept.results, swept.folder.path, width, jobs, on)
    elif cell is not None:
        if scenario is None:
            raise UsageError("--cell is of results: trilat sweep FOLDER --cell N")
        print_cell_commands(Path(scenario), cell)
    elif scenario is not None and _is_results(scenario):
        if mapped or confirm is not None:
            map_results(Path(scenario), width, confirm, jobs, on)
        else:
            print_sweep_results(Path(scenario))
    elif scenario is None or not (over or law or seeds or margin):
        raise UsageError("name a scenario and what to sweep, as in: --over link.delay_ms=0:1600:50")
    else:
        axes = [*(over or []), *([] if margin is None else [margin_range_axis(margin)])]
        asked = _requested_plan(scenario, axes, seeds, law, duration, longest, overrides)
        if margin is not None:
            print_margins(asked, margin, tolerance, output, jobs, on)
            return
        swept = start_sweep(asked, output, jobs, yes=yes, on=on)
        draw_sweep_map(mapped, swept.results, swept.folder.path, width, jobs, on)


def _requested_plan(
    scenario: str,
    over: list[str] | None,
    seeds: str | None,
    law: str | None,
    duration: float | None,
    longest: float | None,
    overrides: list[str] | None,
) -> "SweepPlan":
    """Returns the sweep that options describe."""
    from ..studies.sweep import plan_sweep

    return plan_sweep(
        scenario,
        [*(overrides or []), *([] if duration is None else [f"duration_s={duration!r}"])],
        over=over or (),
        seeds=parse_seed_count(seeds),
        laws=[name.strip() for name in law.split(",")] if law is not None else (),
        longest_s=longest,
    )


def parse_seed_count(text: str | None) -> int | list[int]:
    """Returns how many seeds a text names, as in 10, or which, as in 1..20, 1,5,9 or 7,; one for None."""
    if text is None:
        return 1
    if text.strip().isdecimal() and len(text) < 19:
        return int(text)
    return parse_seeds(text.strip().removesuffix(","))


def _is_results(source: str | None) -> bool:
    """Returns whether a source is the results of a sweep; what is called as a shipped scenario is that."""
    from ..scenario import list_shipped
    from ..studies.sweep.sweep_folder import PLAN_FILE

    if source is None or source in list_shipped():
        return False
    return source.endswith(".parquet") or (Path(source) / PLAN_FILE).exists()


def _refuse_given(options: Iterable[tuple[str, object]], why: str) -> None:
    for name, value in options:
        if value is not None:
            raise UsageError(f"{name} {why}")

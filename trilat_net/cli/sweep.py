"""`trilat sweep`: runs a scenario over a grid of its keys, maps stability, finds edges,
confirms cells live.

Invariant: everything printed is in the result files too, except live runs, which have logs. A
sweep that is interrupted prints the command that resumes it.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import UsageError, count_nouns
from ..process import join_arguments
from ..reporting import terminal_output as terminal
from . import options
from .options import flag, value
from .studies import parse_seeds, run_apart, show_progress

if TYPE_CHECKING:
    from ..scenario import Scenario
    from ..studies.sweep import FinishedSweep
    from ..studies.sweep.margin_search import SearchRange
    from ..studies.sweep.sweep_plan import SweepPlan
    from ..studies.sweep.sweep_results import SweepResults
    from ..studies.sweep.sweep_run import DurationEstimate, SweepFolder


_option = partial(typer.Option, rich_help_panel="Maps and edges")


def _check_modes(given: Sequence[str]) -> Sequence[str]:
    chosen = [name for name in ("--map", "--margin", "--confirm", "--cell") if name in given]
    if len(chosen) > 1:
        raise UsageError(f"{' and '.join(chosen)} exclude each other: give one at a time")
    if "--width" in given and "--map" not in given:
        raise UsageError("--width is of a map: use it with --map")
    if "--tolerance" in given and "--margin" not in given:
        raise UsageError("--tolerance is of an edge: use it with --margin")
    for name in ("--judge", "--metric"):
        if name in given and "--margin" in given:
            raise UsageError(f"{name} is of a sweep and its map: leave --margin out")
    return given


def _draw_map(
    results: "SweepResults", folder: Path, width: float | None, jobs: int | None, on: str | None
) -> None:
    from ..reporting.appearance import COLUMN_IN, make_print_size
    from ..studies.sweep.fixed_gains import FAIR_COMPARISON
    from ..studies.sweep.map_page import write_map
    from ..studies.sweep.stability_map import build_stability_map
    from ..studies.sweep.sweep_plan import build_sweep_command

    form = make_print_size(COLUMN_IN if width is None else width)
    words = [] if width is None else ["--width", f"{width:g}"]
    command = build_sweep_command(results.plan, "--map", *words)
    terminal.print_text("map: the lines of theory ...")
    with show_progress(
        "linear analysis", terminal.print_text, "columns of the map"
    ) as progress:
        made = build_stability_map(results, (command,), jobs, progress, on=on)
    terminal.print_texts(f"note: {line}" for line in made.remarks)
    terminal.print_text("map: drawing ...")
    paths = write_map(made, folder, form.width_in)
    terminal.print_texts(f"not swept: {text}" for text in made.fixed)
    terminal.print_text(FAIR_COMPARISON)
    terminal.print_paths(paths)


def _search_margins(
    asked: "SweepPlan",
    within: "SearchRange",
    folder: Path | None,
    jobs: int | None,
    on: str | None,
    *,
    as_json: bool,
) -> None:
    """Searches edges along one key, prints them with theory, and writes margin.json and
    margin.md.

    The last axis of the plan is the two ends of the range.
    """
    from ..files import make_results_folder
    from ..studies.sweep.margin_search import SweepMargins, search_margins

    chosen = make_results_folder(folder, f"margin-{asked.base.name}", force=None)
    with (
        terminal.lines_aside(as_json),
        show_progress("searching", terminal.print_text, "places") as progress,
    ):
        found = SweepMargins(
            asked,
            within,
            search_margins(plan=asked, within=within, jobs=jobs, progress=progress, on=on),
        )
    paths = found.write(chosen)
    if not as_json:
        terminal.out.print()
    terminal.print_result(found, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


def _confirm_cells(results: "SweepResults", count: int) -> None:
    from ..studies.sweep.live_confirmation import (
        choose_cells_near_edges,
        confirm_cell,
        tabulate_confirmations,
    )

    keys = [one.key for one in results.plan.axes]
    rows = choose_cells_near_edges(results.rows, keys, count)
    name = f"confirm-{results.plan.base.name}"

    def run(scenario: "Scenario", cell: str) -> "tuple[Path, Sequence[str]]":
        outcome = run_apart(scenario, cell, f"{name}-{cell}")
        return outcome.log, outcome.problems

    found = [confirm_cell(row, run) for row in rows]
    terminal.out.print()
    terminal.print_table(tabulate_confirmations(found, keys))
    same = sum(one.same for one in found)
    terminal.out.print(f"{same} of {len(found)} verdicts are the same")
    if same < len(found):
        raise typer.Exit(1)


def _run_sweep(
    asked: "SweepPlan | None", path: Path | None, jobs: int | None, on: str | None, *, yes: bool
) -> "FinishedSweep":
    """Runs a sweep, or what is left of the one in a folder, and prints its summary.

    One that is too large is refused before it has a folder.
    """
    from ..studies.executor import count_workers
    from ..studies.sweep import sweep_results, sweep_run

    begun = None
    plan = asked
    done = []
    if path is not None and (plan is None or (path / sweep_results.PLAN_FILE).exists()):
        begun = sweep_run.open_sweep_folder(path, plan)
        plan = begun.plan
        done = begun.read_done()
    assert plan is not None
    terminal.print_texts(sweep_results.describe_sweep_plan(plan))
    if begun is not None:
        terminal.print_text(f"  {count_nouns(len(done), 'run is', 'runs are')} done already")
    workers = count_workers(jobs, on)
    expected = sweep_run.estimate_sweep(plan, done, workers)
    if not yes:
        sweep_run.refuse_oversized_sweep(plan, expected, workers)
    folder = begun or sweep_run.prepare_sweep_folder(plan, path)
    if expected.seconds:
        about = sweep_run.format_wall_time(expected.seconds)
        terminal.print_text(f"  about {about}, by some of its cells; into {folder.path}")
    swept = _run_in_folder(folder, jobs, on, expected)
    if not (expected.entries or swept.runs):
        terminal.out.print("nothing was left to run")
    speed = [sweep_run.describe_sweep_speed(swept)] if swept.runs else []
    _print_results(
        swept.results,
        [*speed, f"results: {folder.path / sweep_results.RESULTS_FILE}"],
        folder.path,
    )
    return swept


def _run_in_folder(
    folder: "SweepFolder", jobs: int | None, on: str | None, expected: "DurationEstimate"
) -> "FinishedSweep":
    """Runs a sweep in its folder; on Ctrl-C, prints the command that resumes it."""
    from ..studies.sweep import run_sweep

    try:
        with show_progress("sweeping", terminal.print_text) as progress:
            return run_sweep(
                folder=folder, jobs=jobs, progress=progress, known=expected.entries, on=on
            )
    except KeyboardInterrupt:
        resume = join_arguments(["trilat", "sweep", "--resume", str(folder.path)])
        kept = (
            f"{count_nouns(len(folder.read_done()), 'run is', 'runs are')} done and "
            f"kept; go on with: {resume}"
        )
        terminal.err.print(kept, markup=False, soft_wrap=True)
        raise


def _print_results(results: "SweepResults", more: list[str], path: Path) -> None:
    from ..studies.sweep.sweep_results import list_next_commands, summarize_sweep

    terminal.print_texts(
        [*summarize_sweep(results), *more, *(f"  {line}" for line in list_next_commands(path))]
    )


def _print_cell_commands(path: Path, number: int, *, as_json: bool) -> None:
    from ..studies.sweep import read_results
    from ..studies.sweep.sweep_results import build_reproduce_command

    results = read_results(path)
    if as_json:
        return terminal.print_json([dict(row) for row in results.of_cell(number)])
    for row in results.of_cell(number):
        command, note = build_reproduce_command(
            results, row, path if path.is_dir() else path.parent
        )
        if note:
            terminal.print_note(note)
        terminal.print_line(command)
    return None


@options.command(
    "p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1",
    "p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3",
    "runs/sweep-p_d_margin-001 --cell 17",
)
def sweep_command(
    context: typer.Context,
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="[SCENARIO|RESULTS]", autocompletion=options.complete_scenarios),
    ] = None,
    over: Annotated[list[str] | None, value("--over", "KEY=VALUES")] = None,
    seeds: Annotated[str | None, value("--seeds", "N|LIST")] = None,
    law: Annotated[str | None, value("--law", "LAW,LAW...")] = None,
    duration: options.DurationOption = None,
    longest: Annotated[float | None, value("--longest", "S")] = None,
    judge: Annotated[str, value("--judge", "verdict|twins")] = "verdict",
    metric: Annotated[list[str] | None, value("--metric", "KEY")] = None,
    output: Annotated[Path | None, value("-o --out", "DIR")] = None,
    resume: Annotated[
        Path | None, value("--resume", "DIR", "Continue an interrupted sweep.")
    ] = None,
    cell: Annotated[int | None, value("--cell", "N")] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    yes: Annotated[bool, flag("--yes", "Run an oversized sweep.")] = False,
    overrides: options.SetOption = None,
    mapped: Annotated[
        bool, _option("--map", help="Draw the stability map with theory lines.")
    ] = False,
    width: Annotated[float | None, _option("--width", metavar="3.5|7")] = None,
    margin: Annotated[str | None, _option("--margin", metavar="KEY=FROM:TO")] = None,
    tolerance: Annotated[float, _option("--tolerance", metavar="SHARE")] = 0.005,
    confirm: Annotated[int | None, _option("--confirm", metavar="K", min=1)] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Runs a scenario over a grid of its keys, in virtual time on all cores, and classifies
    stability.

    Finished runs are kept, however the sweep ends: --resume, or the same command with the same
    -o, continues.

    Options:
        scenario: Name of a shipped scenario, or path of a TOML file; or path of the results of
            a sweep.
        over: An axis, as in link.delay_ms=0:1600:50 or link.order=newest,in_order; repeatable.
        seeds: How many seeds, or a list, as in 1..20; default: one.
        law: Sweep laws as well; default: the scenario's.
        longest: Longest run of an undecided cell, s; default: eight times the duration.
        judge: What a map shows: classes, or growth exponents of pushed twins, for which short
            runs suffice.
        metric: Measure this of every run besides (docs/metrics.md); repeatable.
        output: Folder of the results; a sweep in it is continued. Default: runs/sweep-NAME-N.
        cell: With results: print the commands that make logs of a cell.
        width: Width of the map, in; default: one column.
        margin: Search the edge of stability along a key instead, at every point of the grid.
        tolerance: Width of an edge relative to its value.
        confirm: With results: run this many cells on each side of the edge live.
    """
    from ..studies.sweep import plan_sweep
    from ..studies.sweep.margin_search import format_range_axis, parse_search_range

    given = _check_modes(options.given_options(context))
    results = Path(scenario) if scenario is not None and _is_results(scenario) else None
    draw = partial(_draw_map, width=width, jobs=jobs, on=on)
    if cell is not None or resume is not None or results is not None:
        _refuse_beside_results(given)
    elif confirm is not None:
        raise UsageError("--confirm is of results: trilat sweep FOLDER --confirm 5")
    if resume is not None:
        if scenario is not None or cell is not None:
            raise UsageError(
                "--resume goes on with the sweep of its folder: leave the rest out"
            )
        with terminal.lines_aside(as_json):
            swept = _run_sweep(None, resume, jobs, on, yes=yes)
    elif cell is not None:
        if scenario is None:
            raise UsageError("--cell is of results: trilat sweep FOLDER --cell N")
        return _print_cell_commands(Path(scenario), cell, as_json=as_json)
    elif results is not None:
        return _show_results(results, confirm, draw if mapped else None, as_json=as_json)
    elif scenario is None or not (over or law or seeds or margin):
        raise UsageError(
            "name a scenario and what to sweep, as in: --over link.delay_ms=0:1600:50"
        )
    else:
        within = None if margin is None else parse_search_range(margin, tolerance)
        axes = [*(over or []), *([] if within is None else [format_range_axis(within)])]
        laws = options.split_names(law)
        texts = options.list_overrides(overrides, duration)
        more: dict[str, Any] = {"longest_s": longest, "judge": judge, "metrics": metric or ()}
        asked = plan_sweep(
            scenario, texts, over=axes, seeds=parse_seed_count(seeds), laws=laws, **more
        )
        if within is not None:
            return _search_margins(
                asked=asked, within=within, folder=output, jobs=jobs, on=on, as_json=as_json
            )
        with terminal.lines_aside(as_json):
            swept = _run_sweep(asked, output, jobs, on, yes=yes)
    if mapped:
        with terminal.lines_aside(as_json):
            draw(swept.results, swept.folder.path)
    if as_json:
        terminal.print_json(swept.results.to_dict())
    return None


def _show_results(
    path: Path,
    confirm: int | None,
    draw: "Callable[[SweepResults, Path], None] | None",
    *,
    as_json: bool,
) -> None:
    from ..studies.sweep.sweep_results import describe_sweep_plan, read_results

    results = read_results(path)
    with terminal.lines_aside(as_json):
        if confirm is not None:
            _confirm_cells(results, confirm)
        elif draw is not None:
            draw(results, path if path.is_dir() else path.parent)
        else:
            terminal.print_texts(describe_sweep_plan(results.plan))
            _print_results(results, [], path)
    if as_json:
        terminal.print_json(results.to_dict())


_OF_A_PLAN = (
    "--over",
    "--seeds",
    "--law",
    "-o",
    "--longest",
    "--judge",
    "--metric",
    "--set",
    "--duration",
)


def _refuse_beside_results(given: Sequence[str]) -> None:
    for name in _OF_A_PLAN:
        if name in given:
            raise UsageError(f"{name} is of the sweep already: leave it out")
    if "--margin" in given:
        raise UsageError("--margin is of a scenario, and searches anew: name that")


def parse_seed_count(text: str | None) -> int | list[int]:
    """Returns the number of seeds of a text such as 10, or the seeds of 1..20, 1,5,9 or 7,; 1
    for None.
    """
    if text is None:
        return 1
    if text.strip().isdecimal() and len(text) < 19:
        return int(text)
    return parse_seeds(text.strip().removesuffix(","))


def _is_results(source: str) -> bool:
    """True if a source names the results of a sweep; names of shipped scenarios never do."""
    from ..scenario import list_shipped
    from ..studies.sweep.sweep_results import PLAN_FILE

    return source not in list_shipped() and (
        source.endswith(".csv") or (Path(source) / PLAN_FILE).exists()
    )

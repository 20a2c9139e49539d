"""`trilat sweep`: runs a scenario over a grid of its keys, maps stability, and finds edges.

A cell of the grid is a combination of values of scenario keys, such as a gain or a delay. An
edge is the value of a key at which runs change from stable to not stable.

Invariant:
    - Everything that is printed is also written to the result files, except for live runs over
      a network, whose results are in their logs.
    - An interrupted sweep prints the command that resumes it.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilat_net.app import options, value
from trilat_net.errors import UsageError, count_nouns, format_wall_time, join_arguments
from trilat_net.presentation import terminal_output as terminal

from .study_commands import parse_seeds

if TYPE_CHECKING:
    from .sweep import FinishedSweep
    from .sweep.margin_search import SearchRange
    from .sweep.sweep_plan import SweepPlan
    from .sweep.sweep_results import SweepResults
    from .sweep.sweep_run import DurationEstimate, SweepFolder


_option = partial(typer.Option, rich_help_panel="Maps and stability limits")


def _check_modes(used_options: Sequence[str]) -> None:
    """Raises UsageError if the options on the command line cannot be combined.

    Args:
        used_options: The options that appear on the command line.

    Raises:
        UsageError: Two options exclude each other, or an option is missing the one it requires.
    """
    modes = [name for name in ("--map", "--margin", "--cell") if name in used_options]
    if len(modes) > 1:
        raise UsageError(f"{' and '.join(modes)} cannot be combined: give only one of them")
    if "--width" in used_options and "--map" not in used_options:
        raise UsageError("--width sets the width of a map: use --width with --map")
    if "--tolerance" in used_options and "--margin" not in used_options:
        raise UsageError(
            "--tolerance sets the tolerance of a stability limit: use --tolerance with --margin"
        )
    if "--beside" in used_options and "--map" not in used_options:
        raise UsageError("--beside draws the edge of another sweep: use --beside with --map")
    for name in ("--judge", "--metric", "--refine"):
        if name in used_options and "--margin" in used_options:
            raise UsageError(
                f"{name} applies only to a sweep and the map of a sweep: leave out --margin"
            )


def _draw_map(
    results: "SweepResults",
    folder: Path,
    width: float | None,
    jobs: int | None,
    on: str | None,
    beside: Path | None,
) -> None:
    """Draws the stability map of a sweep, together with the edges predicted by theory.

    Args:
        results: The finished sweep.
        folder: Folder for the files.
        width: Width of the map, in inches. If `None`, one column of a paper.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that computes the map instead.
        beside: Folder of another sweep whose edge is drawn as well. If `None`, no other edge is
            drawn.
    """
    from trilat_net.presentation import COLUMN_IN, FigureSize

    from .sweep import read_results
    from .sweep.fixed_gains import FAIR_COMPARISON
    from .sweep.map_page import MapReport
    from .sweep.stability_map import StabilityMap

    size = FigureSize.for_print(COLUMN_IN if width is None else width)
    width_option = [] if width is None else ["--width", f"{width:g}"]
    beside_option = [] if beside is None else ["--beside", str(beside)]
    command = results.plan.build_command("--map", *width_option, *beside_option)
    simulated = None if beside is None else read_results(beside)
    terminal.print_text("map: the lines of theory ...")
    with terminal.show_progress(
        "linear analysis", terminal.print_text, "columns of the map"
    ) as progress:
        stability_map = StabilityMap.of_sweep(
            results, (command,), jobs, progress, on=on, simulated=simulated
        )

    terminal.print_texts(f"note: {remark}" for remark in stability_map.remarks)
    terminal.print_text("map: drawing ...")
    paths = MapReport(stability_map).write(folder, size.width_in)
    terminal.print_texts(f"not swept: {text}" for text in stability_map.fixed)
    terminal.print_text(FAIR_COMPARISON)
    terminal.print_paths(paths)


def _search_margins(
    plan: "SweepPlan",
    search_range: "SearchRange",
    folder: Path | None,
    *,
    jobs: int | None,
    on: str | None,
    as_json: bool,
) -> None:
    """Searches for stability edges along one key, prints them, and writes the result files.

    The edges predicted by theory are printed next to the measured edges.

    Args:
        plan: The sweep. Its last axis consists of the two ends of the range.
        search_range: The key, and the range in which to search for edges.
        folder: Folder for margin.json and margin.md. If `None`, the next free folder is used.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.
        as_json: True to print the result as JSON.
    """
    from trilat_net.files import make_results_folder

    from .sweep.margin_search import SweepMargins

    results_folder = make_results_folder(folder, f"margin-{plan.base.name}", force=None)
    with (
        terminal.lines_aside(as_json),
        terminal.show_progress("searching", terminal.print_text, "places") as progress,
    ):
        margins = SweepMargins.search(
            plan=plan, within=search_range, jobs=jobs, progress=progress, on=on
        )

    paths = margins.write(results_folder)
    if not as_json:
        terminal.out.print()
    terminal.print_result(margins, as_json=as_json)
    terminal.print_paths([] if as_json else paths)


def _run_sweep(
    new_plan: "SweepPlan | None",
    path: Path | None,
    jobs: int | None,
    on: str | None,
    *,
    yes: bool,
) -> "FinishedSweep":
    """Runs a sweep, or the remaining runs of one, and prints its summary.

    A sweep that is too large is rejected before its folder is created.

    Args:
        new_plan: The sweep. If `None`, the sweep in the folder is continued.
        path: Folder of a sweep to continue, or of a new sweep. If `None`, the next free folder
            is used.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.
        yes: True to run a sweep even if it is too large.

    Returns:
        The finished sweep.
    """
    from trilat_net.work import WorkerPool

    from .side_by_side import describe_runs_alone
    from .sweep import sweep_results, sweep_run
    from .sweep.cell_groups import CellGroups

    existing_folder = None
    plan = new_plan
    finished_runs = []
    if path is not None and (plan is None or (path / sweep_results.PLAN_FILE).exists()):
        existing_folder = sweep_run.open_sweep_folder(path, plan)
        plan = existing_folder.plan
        finished_runs = existing_folder.read_done()
    assert plan is not None  # the caller gives a plan or a folder
    terminal.print_texts(plan.describe())
    if plan.judge != "linear":
        terminal.print_texts(filter(None, [f"  {CellGroups.of_plan(plan).sentence}".rstrip()]))
    if existing_folder is not None:
        done_text = count_nouns(len(finished_runs), "run is", "runs are")
        terminal.print_text(f"  {done_text} done already")

    workers = WorkerPool.count_workers(jobs, on)
    estimate = sweep_run.DurationEstimate.of_sweep(plan, finished_runs, workers)
    if not yes:
        estimate.refuse_oversized_sweep(plan, workers)

    folder = existing_folder or sweep_run.prepare_sweep_folder(plan, path)
    if estimate.seconds:
        duration = format_wall_time(estimate.seconds)
        terminal.print_text(f"  about {duration}, by some of its cells; into {folder.path}")
    finished = _run_in_folder(folder, jobs, on, estimate)
    was_complete = not (estimate.entries or finished.runs)
    if was_complete:
        terminal.out.print("nothing was left to run")
    remarks = [finished.describe_speed()] if finished.simulated_s else []
    run_count = len(finished.results.rows)
    remarks += filter(None, [describe_runs_alone(finished.alone, run_count)])
    remarks.append(f"results: {folder.path / sweep_results.RESULTS_FILE}")
    _print_results(finished.results, remarks, folder.path)
    return finished


def _run_in_folder(
    folder: "SweepFolder", jobs: int | None, on: str | None, estimate: "DurationEstimate"
) -> "FinishedSweep":
    """Runs a sweep in its folder. On Ctrl-C, prints the command that resumes it.

    Args:
        folder: Folder of the sweep.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler that executes the runs instead.
        estimate: Estimate of the duration. Runs that were made for the estimate are not
            repeated.
    """
    from .sweep import run_sweep

    try:
        with terminal.show_progress("sweeping", terminal.print_text) as progress:
            return run_sweep(
                folder=folder, jobs=jobs, progress=progress, known=estimate.entries, on=on
            )
    except KeyboardInterrupt:
        resume = join_arguments(["trilat", "sweep", "--resume", str(folder.path)])
        done_text = count_nouns(len(folder.read_done()), "run is", "runs are")
        terminal.err.print(
            f"{done_text} done and kept; continue with: {resume}", markup=False, soft_wrap=True
        )
        raise


def _print_results(results: "SweepResults", remarks: list[str], path: Path) -> None:
    """Prints the summary of a sweep, remarks, and commands for the next steps.

    Args:
        results: The finished sweep.
        remarks: Lines to print after the summary.
        path: Folder of the sweep.
    """
    from .run_commands import format_command

    terminal.print_texts(results.summarize())
    terminal.print_texts(remarks)
    command = format_command("sweep", str(path))
    terminal.print_texts(
        [
            f"  {command} --cell 0      # the command that makes a log of a cell",
            f"  {command} --map         # its map, with the lines of theory",
        ]
    )


def _print_cell_commands(path: Path, number: int, *, as_json: bool) -> None:
    """Prints the shell commands that record logs of one cell of a finished sweep.

    Args:
        path: Folder of the sweep, or its results table.
        number: Number of the cell.
        as_json: True to print the rows of the cell as JSON instead.
    """
    from .sweep import read_results

    results = read_results(path)
    if as_json:
        return terminal.print_json([dict(row) for row in results.of_cell(number)])
    folder = path if path.is_dir() else path.parent
    for row in results.of_cell(number):
        command, note = results.build_reproduce_command(row, folder)
        if note:
            terminal.print_note(note)
        terminal.print_line(command)
    return None


@options.command(
    "p_d_margin --over link.delay_ms=0:1600:50 --over control.d=0.2:3:0.1",
    "p_d_margin --over link.delay_ms=100,200,400 --margin control.d=0.2:3",
    "runs/sweep-p_d_margin-001 --cell 17",
    page="docs/studies/sweep.md",
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
    judge: Annotated[str, value("--judge", "verdict|twins|linear")] = "verdict",
    metric: Annotated[list[str] | None, value("--metric", "KEY")] = None,
    refine: Annotated[int, _option("--refine", metavar="N", min=0)] = 0,
    output: Annotated[Path | None, value("-o --out", "DIR")] = None,
    resume: Annotated[
        Path | None, value("--resume", "DIR", "Continue the interrupted sweep in this folder.")
    ] = None,
    cell: Annotated[int | None, value("--cell", "N")] = None,
    jobs: options.JobsOption = None,
    on: options.OnOption = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Run the sweep even if it is very large.")
    ] = False,
    overrides: options.SetOption = None,
    mapped: Annotated[
        bool,
        _option("--map", help="Draw the stability map, with the stability limits from theory."),
    ] = False,
    width: Annotated[float | None, _option("--width", metavar="3.5|7")] = None,
    beside: Annotated[Path | None, _option("--beside", metavar="FOLDER")] = None,
    margin: Annotated[str | None, _option("--margin", metavar="KEY=FROM:TO")] = None,
    tolerance: Annotated[float, _option("--tolerance", metavar="SHARE")] = 0.005,
    confirm: Annotated[int | None, typer.Option("--confirm", hidden=True)] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Maps where a scenario is stable, over a grid of settings.

    Every run is simulated in virtual time. All cores are used. Finished runs are kept even if
    the sweep is interrupted. To continue it, use --resume, or the same command with the same
    -o. A cell is one combination of values in the grid.

    Options:
        scenario: Name of a shipped scenario, path of a TOML file, or folder (or results.csv) of
            an earlier sweep.
        over: Axis of the grid: a scenario key with its values, for example
            link.delay_ms=0:1600:50 or link.order=newest,in_order; repeatable.
        seeds: Number of seeds, or a list of seeds, for example 1..20; default: one.
        law: Control laws, as a further axis of the grid; default: the law of the scenario.
        longest: Longest run of a cell whose stability is still undecided, in s; default: eight
            times the duration, or the duration with --judge twins.
        judge: Quantity in the map: stability classes (verdict), growth exponents of runs with
            a small push (twins), for which short runs suffice, or growth rates of the linear
            loop, without runs (linear).
        metric: Measure this metric of every run as well (docs/reference/metrics.md);
            repeatable.
        refine: Begin with every 2^N-th value of the first two numeric axes, then halve the
            steps N times, only along the stability edge; default 0: run all cells.
        output: Folder for the results; a sweep that the folder already contains is continued.
            Default: runs/sweep-NAME-N, or runs/margin-NAME-N with --margin.
        cell: For an earlier sweep: print the commands that write the logs of this cell.
        width: Width of the map in inches: one or two columns of a paper; default: one column.
        beside: With --map: draw also the edge of the finished sweep in this folder, over the
            same axes.
        margin: Instead of a full sweep, search for the stability limit in this range of a
            scenario key, at every point of the grid.
        tolerance: Largest uncertainty of a stability limit that --margin finds, relative to its
            value.
        confirm: Former option that ran cells live. Its error names the replacement.
    """
    from .sweep import plan_sweep
    from .sweep.margin_search import SearchRange

    used_options = options.list_used_options(context)
    if confirm is not None:
        raise UsageError(
            "--confirm no longer exists: trilat sweep FOLDER --cell N prints the command "
            "of a cell, which runs live with trilat live in place of trilat sim"
        )
    _check_modes(used_options)
    results = Path(scenario) if scenario is not None and _is_results(scenario) else None
    draw = partial(_draw_map, width=width, jobs=jobs, on=on, beside=beside)

    uses_finished_sweep = cell is not None or resume is not None or results is not None
    if uses_finished_sweep:
        _refuse_plan_options(used_options)

    if resume is not None:
        if scenario is not None or cell is not None:
            raise UsageError(
                "--resume continues the sweep that is stored in the folder: leave out the "
                "scenario and --cell"
            )
        with terminal.lines_aside(as_json):
            finished = _run_sweep(None, resume, jobs, on, yes=yes)
    elif cell is not None:
        if scenario is None:
            raise UsageError(
                "--cell needs the results of a sweep: use trilat sweep FOLDER --cell N"
            )
        return _print_cell_commands(Path(scenario), cell, as_json=as_json)
    elif results is not None:
        return _show_results(results, draw if mapped else None, as_json=as_json)
    elif scenario is None or not (over or law or seeds or margin):
        raise UsageError(
            "name a scenario and the keys to sweep, as in: --over link.delay_ms=0:1600:50"
        )
    else:
        axes = list(over or [])
        search_range = None
        if margin is not None:
            search_range = SearchRange.parse(margin, tolerance)
            axes.append(search_range.format_axis())
        plan = plan_sweep(
            scenario,
            options.list_overrides(overrides, duration),
            over=axes,
            seeds=parse_seed_count(seeds),
            laws=options.split_names(law),
            longest_s=longest,
            judge=judge,
            metrics=metric or (),
            refine=refine,
        )
        if search_range is not None:
            return _search_margins(
                plan, search_range, output, jobs=jobs, on=on, as_json=as_json
            )
        with terminal.lines_aside(as_json):
            finished = _run_sweep(plan, output, jobs, on, yes=yes)

    if mapped:
        with terminal.lines_aside(as_json):
            draw(finished.results, finished.folder.path)
    if as_json:
        terminal.print_json(finished.results.to_dict())
    return None


def _show_results(
    path: Path,
    draw: "Callable[[SweepResults, Path], None] | None",
    *,
    as_json: bool,
) -> None:
    """Draws the map of a finished sweep, or prints its summary.

    Args:
        path: Folder of the sweep, or its results table.
        draw: Draws the map. If `None`, no map is drawn.
        as_json: True to print the results as JSON in addition.
    """
    from .sweep.sweep_results import read_results

    results = read_results(path)
    with terminal.lines_aside(as_json):
        if draw is not None:
            draw(results, path if path.is_dir() else path.parent)
        else:
            terminal.print_texts(results.plan.describe())
            _print_results(results, [], path)
    if as_json:
        terminal.print_json(results.to_dict())


_PLAN_OPTIONS = (
    "--over",
    "--seeds",
    "--law",
    "-o",
    "--longest",
    "--judge",
    "--metric",
    "--refine",
    "--set",
    "--duration",
)
"""Options that define a sweep. They cannot be changed for a finished or interrupted sweep."""


def _refuse_plan_options(used_options: Sequence[str]) -> None:
    """Raises UsageError if an option would change a sweep that already exists.

    Args:
        used_options: The options that appear on the command line.

    Raises:
        UsageError: One of the options defines a sweep.
    """
    for name in _PLAN_OPTIONS:
        if name in used_options:
            raise UsageError(f"{name} is already set by the sweep: leave out {name}")
    if "--margin" in used_options:
        raise UsageError("--margin starts a new search in a scenario: name the scenario")


def parse_seed_count(text: str | None) -> int | list[int]:
    """Parses the option --seeds of a sweep.

    A single number such as "10" is the number of seeds. Forms such as "1..20" and "1,5,9" are
    lists of seeds, and so is a number followed by a comma, such as "7,".

    Args:
        text: The argument of the option, or `None` if the user did not use it.

    Returns:
        The number of seeds, or the list of seeds. 1 if the option was not used.
    """
    if text is None:
        return 1
    fits_64_bits = len(text) < 19
    if text.strip().isdecimal() and fits_64_bits:
        return int(text)
    return parse_seeds(text.strip().removesuffix(","))


def _is_results(source: str) -> bool:
    """Returns True if an argument of the command is the folder or results table of a sweep.

    The name of a shipped scenario is never interpreted as a folder, even if a folder of this
    name exists.

    Args:
        source: The argument: a scenario, the folder of a sweep, or its results table.
    """
    from trilat_net.scenario import list_shipped

    from .sweep.sweep_results import PLAN_FILE

    if source in list_shipped():
        return False
    return source.endswith(".csv") or (Path(source) / PLAN_FILE).exists()

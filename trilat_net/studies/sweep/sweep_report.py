"""A sweep in lines of text, and the command that reproduces one of its rows in a log.

Invariant: every run is counted under one class, and every command shown works. A reproduced run has the
scenario hash of its row; if the swept scenario has changed since, the row's own text is written out and
named instead.
"""

import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ...errors import ScenarioError
from ...files import write_whole
from ...scenario.scenario_reader import read_source
from ..commands import format_command
from .cell_result import CellClass
from .sweep_cell import SweepSource
from .sweep_plan import SweepPlan
from .sweep_results import GridPoint, ResultRow, SweepResults, collect_grid_points, reproduction_duration_s
from .sweep_run import SweepSpeed, format_wall_time

_MAX_DOUBTFUL_SHOWN = 8
"""Most doubtful grid points printed; all stand in the file."""


def describe_sweep_plan(plan: SweepPlan) -> list[str]:
    """Returns the plan in lines, before it runs."""
    sizes = " x ".join(str(len(one.texts)) for one in plan.axes) or "1"
    laws = f" x laws {', '.join(plan.laws)}" if plan.laws else ""
    count = len(plan.seeds)
    seeds = f"seed {plan.seeds[0]}" if count == 1 else f"{count} seeds each where anything is random"
    lines = [f"{plan.base.name}: {plan.cells} cells ({sizes}{laws}), {seeds}"]
    for one in plan.axes:
        texts = one.texts
        shown = [texts[0], texts[1], "...", texts[-1]] if len(texts) > 4 else texts
        lines.append(f"  over {one.asked}: {', '.join(shown)}")
    first_s, longest_s = plan.base.duration_s, plan.longest_s
    extended = f", one that is not plain by then up to {longest_s:g} s" if longest_s > first_s else ""
    return [*lines, f"  {first_s:g} s each{extended}"]


def summarize_sweep(results: SweepResults) -> Iterator[str]:
    """Yields a summary: verdicts, extensions, seeds."""
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    words = ", ".join(f"{counts[verdict.value]} {verdict.value}" for verdict in CellClass)
    yield f"{len(rows)} runs of {results.plan.cells} cells: {words}"
    extended = [row for row in rows if row["extended"]]
    if extended:
        longest_s = max(row["ran_s"] for row in extended)
        first_s = results.plan.base.duration_s
        went_on = f"and went on, the longest to {longest_s:g} s"
        yield f"{len(extended)} were not plain after {first_s:g} s {went_on}"
    if len(results.plan.seeds) > 1:
        yield from _of_seeds(results)


def _of_seeds(results: SweepResults) -> Iterator[str]:
    fixed = sum(not row["random"] for row in results.rows)
    if fixed:
        yield f"in {_cells(fixed)} nothing is random: one seed was run there, which stands for all"
    doubtful = [place for place in collect_grid_points(results) if place.doubtful]
    if doubtful:
        yield f"stable with some seeds and not with others, {_cells(len(doubtful))}:"
    for place in doubtful[:_MAX_DOUBTFUL_SHOWN]:
        yield f"  {_describe_grid_point(results.plan, place)}"
    if len(doubtful) > _MAX_DOUBTFUL_SHOWN:
        yield f"  and {len(doubtful) - _MAX_DOUBTFUL_SHOWN} more, all in places.parquet"


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _describe_grid_point(plan: SweepPlan, place: GridPoint) -> str:
    where = [f"{one.key} {value}" for one, value in zip(plan.axes, place.values, strict=True)]
    law = [place.law] if plan.laws else []
    low, high = (100.0 * end for end in place.interval)
    return (
        f"cell {place.cell} ({', '.join([*law, *where])}): {place.stable} of {place.decided} stable, "
        f"95 % interval {low:.0f} to {high:.0f} %"
    )


def describe_sweep_speed(speed: SweepSpeed) -> str:
    """Returns the speed in words."""
    on = "1 process" if speed.jobs == 1 else f"{speed.jobs} processes"
    return (
        f"{speed.runs} runs, {speed.simulated_s:.4g} s simulated, "
        f"in {format_wall_time(speed.wall_s)} by {on}: "
        f"{speed.times_real_time:.0f} times real time per process"
    )


def list_next_commands(folder: Path) -> list[str]:
    """Returns commands that use the results."""
    where = shlex.quote(str(folder))
    return [
        f"trilat sweep {where} --cell 0      # the command that makes a log of a cell",
        f"trilat sweep {where} --map         # its map, with the lines of theory",
    ]


def build_reproduce_command(results: SweepResults, row: ResultRow, folder: Path) -> tuple[str, str]:
    """Returns the command that repeats a row, and a note on it or ""."""
    source = results.plan.written.source
    if _source_unchanged(results.plan.written, results.plan.cell(row["cell"]).overrides, row):
        return row["command"], ""
    name = f"cell-{row['cell']}-seed-{row['seed']}"
    file = folder / f"{name}.toml"
    write_whole(file, row["scenario"])
    lasts_s = reproduction_duration_s(results.plan, results.outcome(row))
    command = format_command("sim", str(file), "--duration", f"{lasts_s:.12g}", "-o", f"{name}.mcap")
    return command, f"{source} is not what was swept any more, or not here; as it ran: {file}"


def _source_unchanged(written: SweepSource, overrides: tuple[str, ...], row: ResultRow) -> bool:
    """Returns True if the source that the row's command names is still the swept one."""
    try:
        text, folder = read_source(written.source)
        now = written._replace(text=text, folder=str(folder))
        return bool(now.scenario(*overrides, f"seed={row['seed']}").sha256 == row["scenario_sha256"])
    except ScenarioError:
        return False

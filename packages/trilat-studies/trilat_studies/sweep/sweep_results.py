"""Stores and summarises the results of a sweep.

A sweep runs one scenario, the description of an experiment, on a grid of parameters. A cell is
one combination of the swept parameters and the control law; it is run once per seed of the
random numbers. This module turns the finished runs into a table with one row per run and writes
it as CSV. It also combines the runs of a cell to a grid point, prints a summary, and finds the
command that repeats a run.

Invariant:
    - The results are a function of the plan. The bytes of the result files depend on the runs
      alone, and not on the time or the number of worker processes.
    - Reading the CSV table restores all numbers bit for bit.
    - Running the scenario of a row again reproduces the row.
    - A grid point counts each of its runs once. The stable share is the fraction of the decided
      runs that are stable. Its 95 % Wilson interval lies within [0, 1].
    - Every printed command reproduces the run, with the same hash of the scenario as its row.
      If the source of the scenario has changed since the sweep, the command names a file to
      which the scenario of the row was written.
"""

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.analysis.metrics.log_metrics import find_quantity
from trilat_net.errors import ScenarioError, UsageError, count_nouns
from trilat_net.files import write_whole
from trilat_net.results import Result
from trilat_net.scenario.scenario_reader import read_source
from trilat_net.work.intervals import MeanInterval, mean_interval, wilson_interval
from trilat_net.work.study_folder import encode_csv, format_command, set_options

from .sweep_cell import TOTAL_KEYS, CellClass, CellResult, CellRun, apply_diff, diff_lines
from .sweep_plan import SweepPlan, plan_from_json

RESULTS_FILE = "results.csv"
"""Name of the table of runs in the folder of a sweep."""
PLAN_FILE = "plan.json"
"""Name of the file with the plan of the sweep, which is needed to read `results.csv`."""


ResultRow = Mapping[str, Any]
"""One run, as a mapping with these keys: `cell`, the value of each axis under the key of the
axis, `law`, `seed`, `random`, the further metrics under their keys, all fields of `CellResult`,
`scenario_sha256`, `command` and `scenario`. The classes of the run are texts. `scenario` is the
canonical text of the scenario that was run.
"""


@dataclass(frozen=True, repr=False)
class SweepResults(Result):
    """Results of a finished sweep, as a table with one row per run.

    A run belongs to a cell, which is a combination of the values of all axes and of a control
    law. The runs of a cell differ in their seeds.

    Attributes:
        plan: The sweep: its scenario, axes, control laws and seeds.
        rows: One row per run, ordered by cell and then by seed.
    """

    plan: SweepPlan
    rows: Sequence[ResultRow]

    def blocks(self) -> Iterator[str]:
        """Yields the lines of the text that `trilat sweep` prints.

        The first lines describe the sweep, the others summarise its results.
        """
        yield from describe_sweep_plan(self.plan)
        yield from summarize_sweep(self)

    def to_rows(self) -> Sequence[ResultRow]:
        """Returns the table of all runs, one row per run, ordered by cell and then by seed.

        A cell is a combination of the values of all axes.
        """
        return self.rows

    def to_dict(self) -> dict[str, Any]:
        """Converts the results to plain values, as `trilat sweep --json` prints them.

        Returns:
            The facts of the plan, and a row per run with the columns of the CSV table.
        """
        runs = [dict(row) for row in self.rows]
        return {"plan": self.plan.facts(), "runs": runs}

    def of_cell(self, number: int) -> list[ResultRow]:
        """Returns the runs of one cell, one row per seed.

        A cell is a combination of the values of all axes and of a control law.

        Args:
            number: Number of the cell.

        Raises:
            UsageError: The sweep has no cell with this number.
        """
        self.plan.cell(number)
        return [row for row in self.rows if row["cell"] == number]

    def outcome(self, row: ResultRow) -> CellResult:
        """Converts the row of a run in the table to an object with named fields.

        Fields that are missing from the row, because an older version wrote it, have the
        default values of `CellResult`.

        Args:
            row: Row of the run.
        """
        return msgspec.convert(row, CellResult)


def build_result_rows(plan: SweepPlan, entries: Sequence[CellRun]) -> list[ResultRow]:
    """Builds the table of results from the finished runs of a sweep.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        entries: The runs, in any order.

    Returns:
        One row per run, ordered by cell and then by seed.
    """
    seed_rank = {seed: index for index, seed in enumerate(plan.seeds)}
    runs_of_cell = Counter(entry.cell for entry in entries)

    def rank(entry: CellRun) -> tuple[int, int]:
        """Returns the sort key of a run: its cell, then the position of its seed in the plan.

        Worker processes finish in any order, and the table must not depend on it.
        """
        return entry.cell, seed_rank[entry.seed]

    rows: list[ResultRow] = []
    for entry in sorted(entries, key=rank):
        # The log of a cell with a single run needs no seed in its name.
        has_several_runs = runs_of_cell[entry.cell] > 1
        suffix = f"-seed-{entry.seed}" if has_several_runs else ""
        log = f"cell-{entry.cell}{suffix}.mcap"
        rows.append(_build_row(plan, entry, log))
    return rows


def _build_row(plan: SweepPlan, entry: CellRun, log: str) -> ResultRow:
    """Returns the row of a finished run: cell, results, and the command that repeats it.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        entry: The run.
        log: Name of the log that the command in the row records.
    """
    cell = plan.cell(entry.cell)
    command = build_sim_command(
        plan=plan,
        overrides=cell.overrides,
        seed=entry.seed,
        duration_s=reproduction_duration_s(plan, entry.outcome),
        log=log,
    )
    axis_keys = [axis.key for axis in plan.axes]
    axis_values = dict(zip(axis_keys, cell.values, strict=True))
    scenario_text = apply_diff(entry.scenario, plan.base.text)
    return {
        "cell": cell.number,
        **axis_values,
        "law": entry.law,
        "seed": entry.seed,
        "random": entry.random,
        **entry.metrics,
        **msgspec.to_builtins(entry.outcome),
        "scenario_sha256": entry.sha256,
        "command": command,
        "scenario": scenario_text,
    }


def build_sim_command(
    plan: SweepPlan, overrides: Sequence[str], seed: int, duration_s: float, log: str
) -> str:
    """Returns the command that simulates a run again and records its log.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        overrides: Overrides KEY=VALUE that turn the swept scenario into that of the run.
        seed: Seed of the run.
        duration_s: Duration of the run, in s.
        log: Name of the log.
    """
    kept_overrides = list[str]()
    for override in (*plan.overrides, *overrides):
        key, _, _ = override.partition("=")
        # Seed and duration have their own options in the command.
        if key.strip() not in ("seed", "duration_s"):
            kept_overrides.append(override)
    source = plan.written.label
    set_arguments = set_options(kept_overrides)
    run_arguments = ["--seed", str(seed), "--duration", f"{duration_s:.12g}"]
    return format_command("sim", source, *set_arguments, *run_arguments, "-o", log)


def reproduction_duration_s(plan: SweepPlan, outcome: CellResult) -> float:
    """Returns the duration with which a run must be started to reproduce its row, in s.

    A run that diverged, that is, left the limits of its arms, ended before its planned
    duration. It is started with the planned duration, and will end early again. Every
    extension of an undecided run doubles the planned duration.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        outcome: Result of the run.
    """
    if outcome.diverged_s is None:
        return outcome.ran_s
    extended_s = plan.base.duration_s * 2.0**outcome.extended
    planned_s = min(plan.longest_s, extended_s)
    return max(outcome.ran_s, planned_s)


_SCENARIO_COLUMN = "scenario_changes"
"""Column of the CSV table with the scenario of the row. To save space it contains only the
differences from the swept scenario, as JSON.
"""

_LONGEST_CELL = 2**26
"""Largest number of characters in a cell of the CSV table. A scenario that contains a delay
trace exceeds the default limit of the csv module, 131 072 characters.
"""


def encode_results(plan: SweepPlan, rows: Sequence[ResultRow]) -> str:
    """Returns the results as CSV text, with one line per run.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        rows: The runs, one mapping from columns to values per run.
    """
    column_types = _list_result_columns(plan)
    lines = []
    for row in rows:
        line = {}
        for name, kind in column_types.items():
            value = row[name]
            line[name] = _format_cell(value, kind)
        changes = diff_lines(row["scenario"], plan.base.text)
        line[_SCENARIO_COLUMN] = json.dumps(changes, ensure_ascii=False)
        lines.append(line)
    return encode_csv(lines, [*column_types, _SCENARIO_COLUMN])


def _list_result_columns(plan: SweepPlan) -> dict[str, type]:
    """Returns the columns of the CSV table in their order, each with the type of its values.

    The column with the scenario is not listed, because it needs special treatment.
    """
    column_types = {**_list_axis_columns(plan), "seed": int, "random": bool}
    # All fields of a result are numbers, except those whose types are corrected below.
    number_columns = (*plan.metrics, *CellResult.__struct_fields__)
    column_types |= dict.fromkeys(number_columns, float)
    text_columns = ("verdict", "motion", "reasons", "stability", "rests_on", "scenario_sha256")
    column_types |= dict.fromkeys((*text_columns, "command"), str)
    return column_types | {"extended": int}


def _list_axis_columns(plan: SweepPlan) -> dict[str, type]:
    """Returns the columns that identify a cell, with their types: number, axes and law.

    The types serve to read the CSV table again.
    """
    column_types: dict[str, type] = {"cell": int}
    for axis in plan.axes:
        column_types[axis.key] = float if axis.numeric else str
    column_types["law"] = str
    return column_types


def _format_cell(value: Any, kind: type) -> str:
    """Returns the text of a cell of the CSV table, from which numbers parse back bit for bit.

    Args:
        value: The value. None becomes an empty text.
        kind: Type of the column.
    """
    if value is None:
        return ""
    if kind is bool:
        return "true" if value else "false"
    return repr(float(value)) if kind is float else str(value)


def _parse_cell(text: str, kind: type) -> Any:
    """Returns the value of a cell of the CSV table; the inverse of `_format_cell`.

    Args:
        text: Text of the cell.
        kind: Type of the column.

    Raises:
        ValueError: The text is not a number although the column contains numbers.
            It is neither "true" nor "false" although the column contains bools.
    """
    if kind is str:
        return text
    if kind is bool:
        if text not in ("true", "false"):
            raise ValueError(f"{text!r} is neither true nor false")
        return text == "true"
    return kind(text) if text else None


def read_results(path: Path) -> SweepResults:
    """Reads the results of a finished sweep.

    Args:
        path: Folder of the sweep, or its CSV table.

    Raises:
        UsageError: There are no results, they cannot be read, or the sweep has not finished.
    """
    is_folder = path.is_dir()
    file = path / RESULTS_FILE if is_folder else path
    if not file.is_file():
        hint = f"; continue it with: trilat sweep --resume {path}" if is_folder else ""
        raise UsageError(f"{file}: there are no results of a sweep{hint}")
    plan_file = file.with_name(PLAN_FILE)
    if not plan_file.is_file():
        raise UsageError(
            f"{file}: contains no results of a sweep: there is no {PLAN_FILE} next to this file"
        )
    try:
        plan_text = plan_file.read_text(encoding="utf-8")
        plan = plan_from_json(json.loads(plan_text))
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{plan_file}: cannot be read as the plan of a sweep") from None

    try:
        lines = _read_lines(file)
        rows = [_read_row(line, plan) for line in lines]
    except KeyError as error:
        raise UsageError(
            f"{file}: contains no results of a sweep: the column {error} is missing"
        ) from None
    except (OSError, ValueError, TypeError, IndexError, csv.Error) as error:
        raise UsageError(f"{file}: cannot be read as results of a sweep: {error}") from None
    return SweepResults(plan, rows)


def _read_lines(file: Path) -> list[dict[str, str]]:
    """Reads the CSV table of a sweep, whose cells may hold the whole text of a scenario.

    The limit of the csv module applies to the whole process. Therefore it is raised only here.
    """
    limit = csv.field_size_limit(_LONGEST_CELL)
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream, strict=True))
    finally:
        csv.field_size_limit(limit)


def _read_row(line: Mapping[str, str], plan: SweepPlan) -> ResultRow:
    """Returns the row of a line of the CSV table, with the complete text of its scenario.

    Args:
        line: Texts of the line, by column.
        plan: The sweep: its scenario, axes, control laws and seeds.
    """
    row = {}
    column_types = _list_result_columns(plan)
    for name, kind in column_types.items():
        text = line[name]
        row[name] = _parse_cell(text, kind)
    changes = json.loads(line[_SCENARIO_COLUMN])
    row["scenario"] = apply_diff(changes, plan.base.text)
    return row


GRID_POINTS_FILE = "places.csv"
"""Name of the table of grid points in the folder of a sweep."""


class GridPoint(NamedTuple):
    """The results of all runs of one cell of a sweep, which differ only in their seeds.

    Attributes:
        cell: Number of the cell, from 0.
        law: Control laws of the sites.
        values: Value of the cell on each axis.
        counts: Number of runs of each class, such as converged or diverged, in the order of
            `CellClass`.
        means: Mean, with its 95 % interval, of each quantity of `list_totals`, over the runs
            that stayed within the limits of their arms. None for fewer than two such runs.
    """

    cell: int
    law: str
    values: tuple[float | str, ...]
    counts: tuple[int, ...]
    means: tuple[MeanInterval | None, ...] = ()

    @property
    def decided(self) -> int:
        """Number of runs that were judged stable or not stable. Undecided runs are left out."""
        classes = zip(self.counts, CellClass, strict=True)
        return sum(count for count, verdict in classes if verdict.stable is not None)

    @property
    def stable(self) -> int:
        """Number of runs of the cell that were judged stable. It is at most `decided`."""
        classes = zip(self.counts, CellClass, strict=True)
        return sum(count for count, verdict in classes if verdict.stable)

    @property
    def doubtful(self) -> bool:
        """True if the cell is stable with some seeds and not stable with others.

        Chance then decides the result, and more seeds are needed to know how often.
        """
        return 0 < self.stable < self.decided

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the share of stable runs among the decided ones.

        The method is Wilson's. Also if 10 runs of 10 are stable, the lower end is below 1,
        because other seeds might give another result.
        """
        return wilson_interval(self.stable, self.decided)


def list_totals(plan: SweepPlan) -> list[str]:
    """Lists the keys of the quantities that are averaged over the seeds of a cell.

    These are the totals that every run computes, and the metrics that the sweep requested.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
    """
    keys = (*TOTAL_KEYS, *plan.metrics)
    return list(dict.fromkeys(keys))


def collect_grid_points(results: SweepResults) -> list[GridPoint]:
    """Combines the runs of a sweep that differ only in their random seeds.

    Args:
        results: Results of the sweep: its plan and one row per run.

    Returns:
        A summary for each combination of swept parameters and control law (a grid point). It
        has the number of runs with each result, and the means of the measured totals. The order
        is the order in which the combinations first occur in the results.
    """
    rows_of_cell: dict[tuple[int, str], list[ResultRow]] = {}
    for row in results.rows:
        cell_and_law = (row["cell"], row["law"])
        cell_rows = rows_of_cell.setdefault(cell_and_law, [])
        cell_rows.append(row)

    points = []
    totals = list_totals(results.plan)
    for (cell, law), rows in rows_of_cell.items():
        counts = Counter(row["verdict"] for row in rows)
        # The totals of a run that diverged describe a shorter time, so they are not averaged.
        rows_within_limits = [row for row in rows if row["diverged_s"] is None]
        means = []
        for key in totals:
            values = [row.get(key) for row in rows_within_limits]
            means.append(mean_interval(values))
        class_counts = [counts[verdict.value] for verdict in CellClass]
        point = GridPoint(
            cell=cell,
            law=law,
            values=results.plan.cell(cell).values,
            counts=tuple(class_counts),
            means=tuple(means),
        )
        points.append(point)
    return points


def encode_grid_points(plan: SweepPlan, points: Sequence[GridPoint]) -> str:
    """Encodes grid points as a CSV table, with one line per point.

    A line contains the number of the cell, its axis values and law, the number of runs of each
    class, the fraction of stable runs with its 95 % interval, and the means of the measured
    quantities with their intervals.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        points: The grid points, in the order of the lines.
    """
    column_types = _list_axis_columns(plan)
    column_types["runs"] = int
    column_types |= {verdict.value: int for verdict in CellClass}
    share_columns = ("stable_share", "stable_share_low", "stable_share_high")
    column_types |= dict.fromkeys(share_columns, float)
    for key in list_totals(plan):
        column_types |= {f"{key}_{field}": float for field in MeanInterval._fields}

    lines = []
    for point in points:
        decided = point.decided
        stable_share = point.stable / decided if decided else None
        # The values must stand in the order of the columns above.
        values: list[Any] = [point.cell, *point.values, point.law]
        values += [sum(point.counts), *point.counts]
        values += [stable_share, *point.interval]
        for mean in point.means:
            values += mean or (None, None)
        line = {}
        for (name, kind), value in zip(column_types.items(), values, strict=True):
            line[name] = _format_cell(value, kind)
        lines.append(line)
    return encode_csv(lines, list(column_types))


_TOTALS = {
    "rms_error_rad": ("RMS e", "rad"),
    "effort_nm": ("effort", "N m"),
    "force_peak_n": ("peak force", "N"),
    "walls_j": ("work of the walls", "J"),
}
"""Quantities whose range over the runs is printed: the key, the name and the unit."""


_MAX_DOUBTFUL_SHOWN = 8
"""Largest number of doubtful grid points in the summary. The CSV file has all of them."""


def describe_sweep_plan(plan: SweepPlan) -> list[str]:
    """Returns lines that tell the user how many runs a sweep has, and over which values.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
    """
    axis_sizes = [str(len(axis.texts)) for axis in plan.axes]
    sizes = " x ".join(axis_sizes) or "1"
    laws = f" x laws {', '.join(plan.laws)}" if plan.laws else ""
    seed_count = len(plan.seeds)
    if seed_count == 1:
        seeds = f"seed {plan.seeds[0]}"
    else:
        seeds = f"{count_nouns(seed_count, 'seed')} each where anything is random"
    cells = count_nouns(plan.cells, "cell")
    lines = [f"{plan.base.name}: {cells} ({sizes}{laws}), {seeds}"]

    for axis in plan.axes:
        texts = axis.texts
        count = len(texts)
        if count > 4:
            values = [texts[0], texts[1], "...", texts[-1]]
        else:
            values = [texts[n] for n in range(count)]
        lines.append(f"  over {axis.description}: {', '.join(values)}")

    first_s = plan.base.duration_s
    longest_s = plan.longest_s
    extended = f", an undecided one up to {longest_s:g} s" if longest_s > first_s else ""
    twins = ", judged by twins" if plan.judge == "twins" else ""
    return [*lines, f"  {first_s:g} s each{extended}{twins}"]


def summarize_sweep(results: SweepResults) -> Iterator[str]:
    """Yields the lines of the summary that is printed after a sweep.

    The lines state how many runs each class has, how many runs were extended, the ranges of the
    measured quantities, the growth exponents, and the differences between seeds. Lines about
    quantities that the sweep does not have are left out.

    Args:
        results: Results of the sweep: its plan and one row per run.
    """
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    verdict_texts = [f"{counts[verdict.value]} {verdict.value}" for verdict in CellClass]
    verdicts = ", ".join(verdict_texts)
    runs = count_nouns(len(rows), "run")
    cells = count_nouns(results.plan.cells, "cell")
    yield f"{runs} of {cells}: {verdicts}"

    extended = [row for row in rows if row["extended"]]
    if extended:
        longest_s = max(row["ran_s"] for row in extended)
        first_s = results.plan.base.duration_s
        yield (
            f"{len(extended)} were undecided after {first_s:g} s and continued, the longest to "
            f"{longest_s:g} s"
        )

    within_limits = [row for row in rows if row["diverged_s"] is None]
    ranges = _list_ranges(results.plan, within_limits)
    if ranges:
        yield f"within their limits {len(within_limits)}: {', '.join(ranges)}"

    rates = _list_values(rows, "exponent_per_s")
    if rates:
        growing = sum(rate > 0.0 for rate in rates)
        interval = f"{min(rates):+.3g} to {max(rates):+.3g} /s"
        yield f"growth exponents of small pushes {interval}: {growing} of {len(rates)} grow"

    if len(results.plan.seeds) > 1:
        yield from _summarize_seeds(results)


def _list_ranges(plan: SweepPlan, rows: Sequence[ResultRow]) -> list[str]:
    """Returns texts with the smallest and largest value of each quantity over some runs.

    Args:
        plan: The sweep, whose requested metrics come first.
        rows: The runs, one mapping from columns to values per run.

    Returns:
        Texts such as "RMS e 0.012 to 0.4 rad", without the quantities that no run has.
    """
    quantities = {}
    for metric in map(find_quantity, plan.metrics):
        quantities[metric.key] = (metric.name, metric.unit)
    quantities |= _TOTALS
    ranges = []
    for key, (name, unit) in quantities.items():
        values = _list_values(rows, key)
        if values:
            text = f"{name} {min(values):.3g} to {max(values):.3g} {unit}"
            ranges.append(text.rstrip())
    return ranges


def _list_values(rows: Sequence[ResultRow], key: str) -> list[float]:
    """Returns the numbers of one column of a table, without the rows that have none.

    Args:
        rows: Rows of the table.
        key: Name of the column.
    """
    values = [row.get(key) for row in rows]
    return [value for value in values if value is not None]


def _summarize_seeds(results: SweepResults) -> Iterator[str]:
    """Yields the lines of the summary that concern the seeds.

    The first line counts the cells in which nothing is random, which run only once. The others
    list the cells that are stable with some seeds and not stable with others.
    """
    not_random = sum(not row["random"] for row in results.rows)
    if not_random:
        cells = count_nouns(not_random, "cell")
        yield f"in {cells} nothing is random: one seed was run there, for all"

    doubtful = [point for point in collect_grid_points(results) if point.doubtful]
    if doubtful:
        cells = count_nouns(len(doubtful), "cell")
        yield f"stable with some seeds and not with others, {cells}:"
    for point in doubtful[:_MAX_DOUBTFUL_SHOWN]:
        setting = [point.law] if results.plan.laws else []
        for axis, value in zip(results.plan.axes, point.values, strict=True):
            setting.append(f"{axis.key} {value}")
        low, high = (100.0 * end for end in point.interval)
        yield (
            f"  cell {point.cell} ({', '.join(setting)}): "
            f"{point.stable} of {point.decided} stable, "
            f"95 % interval {low:.0f} to {high:.0f} %"
        )
    if len(doubtful) > _MAX_DOUBTFUL_SHOWN:
        hidden = len(doubtful) - _MAX_DOUBTFUL_SHOWN
        yield f"  and {hidden} more, all in {GRID_POINTS_FILE}"


def list_next_commands(folder: Path) -> list[str]:
    """Suggests commands with which a user can continue after a sweep.

    Args:
        folder: Folder of the sweep, which the commands name.
    """
    command = format_command("sweep", str(folder))
    return [
        f"{command} --cell 0      # the command that makes a log of a cell",
        f"{command} --map         # its map, with the lines of theory",
    ]


def build_reproduce_command(
    results: SweepResults, row: ResultRow, folder: Path
) -> tuple[str, str]:
    """Returns the command that repeats the run of a row.

    If the source of the scenario has changed since the sweep, the command in the row would run
    something else. In this case the scenario of the row is written to a file, and the command
    runs that file.

    Args:
        results: Results of the sweep: its plan and one row per run.
        row: The run.
        folder: Folder in which the file is written, if necessary.

    Returns:
        The command, and a note on a changed scenario. The note is empty if the scenario has
        not changed.
    """
    plan = results.plan
    source = plan.written.label
    overrides = plan.cell(row["cell"]).overrides
    try:
        text, source_folder = read_source(source)
        written = plan.written._replace(text=text, folder=source_folder)
        current_plan = plan._replace(written=written)
        seed = f"seed={row['seed']}"
        current_scenario = current_plan.scenario(*overrides, seed)
        digest = current_scenario.sha256
    except ScenarioError:
        digest = ""  # the source is missing or is no longer valid
    if digest == row["scenario_sha256"]:
        return row["command"], ""

    name = f"cell-{row['cell']}-seed-{row['seed']}"
    file = folder / f"{name}.toml"
    write_whole(file, row["scenario"])
    duration_s = reproduction_duration_s(plan, results.outcome(row))
    options = ["--duration", f"{duration_s:.12g}", "-o", f"{name}.mcap"]
    command = format_command("sim", str(file), *options)
    note = f"{source} has changed since the sweep, or is missing; as it ran: {file}"
    return command, note

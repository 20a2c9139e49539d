"""Holds the results of a sweep: a CSV table of runs, the grid points, and a summary of both.

Invariant:
    - Results are a function of the plan; the bytes of their files depend on the runs alone.
    - Reading the table restores all numbers bit for bit.
    - The scenario of a row, run again, reproduces the row.
    - A grid point counts each run once. Its stable share is taken over the decided runs and
      has a 95 % Wilson interval within [0, 1].
    - All commands that are shown work: a reproduced run has the scenario hash of its row. If
      the swept scenario has changed since, the command runs a file with the row's scenario.
"""

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...analysis.metrics.log_metrics import find_quantity
from ...errors import ScenarioError, UsageError, count_nouns
from ...execution.fused import RunTotals
from ...files import write_whole
from ...results import Result
from ...scenario.scenario_reader import read_source
from ..intervals import MeanInterval, mean_interval, wilson_interval
from ..study_folder import encode_csv, format_command, set_options
from .sweep_cell import CellClass, CellResult, CellRun, apply_diff, diff_lines
from .sweep_plan import SweepPlan, plan_from_json

RESULTS_FILE = "results.csv"
PLAN_FILE = "plan.json"
"""The plan of a sweep in its folder, which is needed to read `results.csv`."""


ResultRow = Mapping[str, Any]
"""A run: `cell`, the value of each axis by key, `law`, `seed`, `random`, the further metrics by
key, all fields of `CellResult`, `scenario_sha256`, `command` and `scenario`.
Verdict and motion are texts; `scenario` is the canonical text of the scenario.
"""


@dataclass(frozen=True, repr=False)
class SweepResults(Result):
    """Results of a sweep.

    Attributes:
        plan: the sweep.
        rows: a row per run, ordered by cell and then by seed.
    """

    plan: SweepPlan
    rows: Sequence[ResultRow]

    def blocks(self) -> Iterator[str]:
        """Yields the lines of the plan and of the summary."""
        yield from (*describe_sweep_plan(self.plan), *summarize_sweep(self))

    def to_rows(self) -> Sequence[ResultRow]:
        """Returns a row per run."""
        return self.rows

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat sweep --json`."""
        runs = [dict(row) for row in self.rows]
        return {"plan": self.plan.facts(), "runs": runs}

    def of_cell(self, number: int) -> list[ResultRow]:
        """Returns the runs of a cell, one per seed.

        Raises:
            UsageError: the sweep has no cell with this number.
        """
        self.plan.cell(number)
        return [row for row in self.rows if row["cell"] == number]

    def outcome(self, row: ResultRow) -> CellResult:
        """Returns the result of a run."""
        # the defaults of CellResult fill in fields that older files lack
        return msgspec.convert(row, CellResult)


def build_result_rows(plan: SweepPlan, entries: Sequence[CellRun]) -> list[ResultRow]:
    """Returns the rows of finished runs, ordered by cell and then by seed."""
    seed_rank = {seed: rank for rank, seed in enumerate(plan.seeds)}
    runs_of_cell = Counter(entry.cell for entry in entries)
    ordered = sorted(entries, key=lambda entry: (entry.cell, seed_rank[entry.seed]))
    rows: list[ResultRow] = []
    for entry in ordered:
        has_seeds = runs_of_cell[entry.cell] > 1
        suffix = f"-seed-{entry.seed}" if has_seeds else ""
        rows.append(_build_row(plan, entry, f"cell-{entry.cell}{suffix}.mcap"))
    return rows


def _build_row(plan: SweepPlan, entry: CellRun, log: str) -> ResultRow:
    """Returns the row of a finished run.

    Args:
        plan: the sweep.
        entry: the run.
        log: file name of the log that the row's command records.
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
    return {
        "cell": cell.number,
        **dict(zip(axis_keys, cell.values, strict=True)),
        "law": entry.law,
        "seed": entry.seed,
        "random": entry.random,
        **entry.metrics,
        **msgspec.to_builtins(entry.outcome),
        "scenario_sha256": entry.sha256,
        "command": command,
        "scenario": apply_diff(entry.scenario, plan.base.text),
    }


def build_sim_command(
    plan: SweepPlan, overrides: Sequence[str], seed: int, duration_s: float, log: str
) -> str:
    """Returns the command that records the log of a run."""
    kept_overrides = list[str]()
    for override in (*plan.overrides, *overrides):
        key = override.partition("=")[0].strip()
        if key not in ("seed", "duration_s"):  # these have options of their own
            kept_overrides.append(override)
    options = ["--seed", str(seed), "--duration", f"{duration_s:.12g}", "-o", log]
    return format_command("sim", plan.written.label, *set_options(kept_overrides), *options)


def reproduction_duration_s(plan: SweepPlan, outcome: CellResult) -> float:
    """Returns a duration that reproduces a run, in s.

    A run that diverged gets the duration it was planned for, and ends by diverging again.
    """
    if outcome.diverged_s is None:
        return outcome.ran_s
    extended_s = plan.base.duration_s * 2.0**outcome.extended
    planned_s = min(plan.longest_s, extended_s)
    return max(outcome.ran_s, planned_s)


_SCENARIO_COLUMN = "scenario_changes"
"""Column of the table with the row's scenario, as a JSON diff against the swept scenario."""

_LONGEST_CELL = 2**26
"""Largest number of characters in a table cell: a scenario with a trace exceeds the default
limit of the csv module, 131 072.
"""


def encode_results(plan: SweepPlan, rows: Sequence[ResultRow]) -> str:
    """Returns the results as CSV, with a line per run."""
    kinds = _list_result_columns(plan)
    lines = []
    for row in rows:
        line = {name: _format_cell(row[name], kind) for name, kind in kinds.items()}
        changes = diff_lines(row["scenario"], plan.base.text)
        line[_SCENARIO_COLUMN] = json.dumps(changes, ensure_ascii=False)
        lines.append(line)
    return encode_csv(lines, [*kinds, _SCENARIO_COLUMN])


def _list_result_columns(plan: SweepPlan) -> dict[str, type]:
    """Returns the type of each column of the table, except that of the scenarios."""
    kinds = {**_list_axis_columns(plan), "seed": int, "random": bool}
    kinds |= dict.fromkeys((*plan.metrics, *CellResult.__struct_fields__), float)
    kinds |= dict.fromkeys(("verdict", "motion", "reasons", "scenario_sha256", "command"), str)
    return kinds | {"extended": int}


def _list_axis_columns(plan: SweepPlan) -> dict[str, type]:
    """Returns the type of each column that locates a cell."""
    axes = {axis.key: float if axis.numeric else str for axis in plan.axes}
    return {"cell": int, **axes, "law": str}


def _format_cell(value: Any, kind: type) -> str:
    """Returns the text of a table cell, from which numbers parse back bit for bit.

    None becomes an empty text.
    """
    if value is None:
        return ""
    if kind is bool:
        return "true" if value else "false"
    return repr(float(value)) if kind is float else str(value)


def _parse_cell(text: str, kind: type) -> Any:
    """Returns the value of a table cell.

    Raises:
        ValueError: the text is not an integer or a float.
        KeyError: the text is not a bool.
    """
    if kind is str:
        return text
    if kind is bool:
        return {"true": True, "false": False}[text]
    return kind(text) if text else None


def read_results(path: Path) -> SweepResults:
    """Returns the results of a sweep.

    Args:
        path: the folder of the sweep, or its table.

    Raises:
        UsageError: there are no results, they cannot be read, or the sweep has not finished.
    """
    file = path / RESULTS_FILE if path.is_dir() else path
    if not file.is_file():
        hint = f"; continue it with: trilat sweep --resume {path}" if path.is_dir() else ""
        raise UsageError(f"{file}: there are no results of a sweep{hint}")
    plan_file = file.with_name(PLAN_FILE)
    if not plan_file.is_file():
        raise UsageError(
            f"{file}: holds no results of a sweep: there is no {PLAN_FILE} beside it"
        )
    try:
        plan = plan_from_json(json.loads(plan_file.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{plan_file}: cannot be read as the plan of a sweep") from None
    csv.field_size_limit(_LONGEST_CELL)
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            lines = list(csv.DictReader(stream, strict=True))
        rows = [_read_row(line, plan) for line in lines]
    except KeyError as error:
        raise UsageError(f"{file}: holds no results of a sweep: {error} is missing") from None
    except (OSError, ValueError, TypeError, IndexError, csv.Error) as error:
        raise UsageError(f"{file}: cannot be read as results of a sweep: {error}") from None
    return SweepResults(plan, rows)


def _read_row(line: Mapping[str, str], plan: SweepPlan) -> ResultRow:
    """Returns a line of the table as a row, with its scenario as text."""
    kinds = _list_result_columns(plan)
    row = {name: _parse_cell(line[name], kind) for name, kind in kinds.items()}
    changes = json.loads(line[_SCENARIO_COLUMN])
    return {**row, "scenario": apply_diff(changes, plan.base.text)}


GRID_POINTS_FILE = "places.csv"


class GridPoint(NamedTuple):
    """One cell with all its seeds.

    Attributes:
        cell: the number of the cell.
        law: the laws of its sites.
        values: the value on each axis.
        counts: number of runs of each class, in the order of `CellClass`.
        means: the mean of each quantity of `list_totals` over the runs that stayed within
            their limits; None for fewer than two runs.
    """

    cell: int
    law: str
    values: tuple[float | str, ...]
    counts: tuple[int, ...]
    means: tuple[MeanInterval | None, ...] = ()

    @property
    def decided(self) -> int:
        """Number of decided runs."""
        classes = zip(self.counts, CellClass, strict=True)
        return sum(count for count, verdict in classes if verdict.stable is not None)

    @property
    def stable(self) -> int:
        """Number of stable runs."""
        classes = zip(self.counts, CellClass, strict=True)
        return sum(count for count, verdict in classes if verdict.stable)

    @property
    def doubtful(self) -> bool:
        """True if some of the decided runs are stable and some are not."""
        return 0 < self.stable < self.decided

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the stable share of the decided runs."""
        return wilson_interval(self.stable, self.decided)


def list_totals(plan: SweepPlan) -> list[str]:
    """Returns the keys of the quantities that are averaged over the seeds of a cell."""
    return list(dict.fromkeys((*RunTotals._fields, *plan.metrics)))


def collect_grid_points(results: SweepResults) -> list[GridPoint]:
    """Returns the grid points of a sweep, in the order of the cells."""
    rows_of: dict[tuple[int, str], list[ResultRow]] = {}
    for row in results.rows:
        position = (row["cell"], row["law"])
        rows_of.setdefault(position, []).append(row)
    points = []
    totals = list_totals(results.plan)
    for (cell, law), rows in rows_of.items():
        counts = Counter(row["verdict"] for row in rows)
        within_limits = [row for row in rows if row["diverged_s"] is None]
        means = []
        for key in totals:
            values = [row.get(key) for row in within_limits]
            means.append(mean_interval(values))
        point = GridPoint(
            cell=cell,
            law=law,
            values=results.plan.cell(cell).values,
            counts=tuple(counts[verdict.value] for verdict in CellClass),
            means=tuple(means),
        )
        points.append(point)
    return points


def encode_grid_points(plan: SweepPlan, points: Sequence[GridPoint]) -> str:
    """Returns grid points as CSV: counts, stable share with its interval, and means."""
    kinds = _list_axis_columns(plan)
    kinds["runs"] = int
    kinds |= {verdict.value: int for verdict in CellClass}
    kinds |= dict.fromkeys(("stable_share", "stable_share_low", "stable_share_high"), float)
    for key in list_totals(plan):
        kinds |= {f"{key}_{field}": float for field in MeanInterval._fields}
    rows = []
    for point in points:
        share = point.stable / point.decided if point.decided else None
        cells: list[Any] = [point.cell, *point.values, point.law]
        cells += [sum(point.counts), *point.counts]
        cells += [share, *point.interval]
        for mean in point.means:
            cells += mean or (None, None)
        columns = zip(kinds.items(), cells, strict=True)
        rows.append({name: _format_cell(cell, kind) for (name, kind), cell in columns})
    return encode_csv(rows, list(kinds))


_TOTALS = {
    "rms_error_rad": ("RMS e", "rad"),
    "effort_nm": ("effort", "N m"),
    "force_peak_n": ("peak force", "N"),
    "walls_j": ("work of the walls", "J"),
}


_MAX_DOUBTFUL_SHOWN = 8
"""Largest number of doubtful grid points in the summary; the file has all of them."""


def describe_sweep_plan(plan: SweepPlan) -> list[str]:
    """Returns the lines that describe a sweep before it runs."""
    counts = [str(len(axis.texts)) for axis in plan.axes]
    sizes = " x ".join(counts) or "1"
    laws = f" x laws {', '.join(plan.laws)}" if plan.laws else ""
    if len(plan.seeds) == 1:
        seeds = f"seed {plan.seeds[0]}"
    else:
        seeds = f"{count_nouns(len(plan.seeds), 'seed')} each where anything is random"
    lines = [f"{plan.base.name}: {count_nouns(plan.cells, 'cell')} ({sizes}{laws}), {seeds}"]
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
    """Yields the lines of a summary: verdicts, extensions, ranges, exponents and seeds."""
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    verdicts = ", ".join(f"{counts[verdict.value]} {verdict.value}" for verdict in CellClass)
    runs = count_nouns(len(rows), "run")
    yield f"{runs} of {count_nouns(results.plan.cells, 'cell')}: {verdicts}"

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
    """Returns the range of each quantity over runs, as texts; metrics of the plan first."""
    metrics = map(find_quantity, plan.metrics)
    quantities = {metric.key: (metric.name, metric.unit) for metric in metrics}
    ranges = []
    for key, (name, unit) in {**quantities, **_TOTALS}.items():
        values = _list_values(rows, key)
        if values:
            text = f"{name} {min(values):.3g} to {max(values):.3g} {unit}"
            ranges.append(text.rstrip())
    return ranges


def _list_values(rows: Sequence[ResultRow], key: str) -> list[float]:
    """Returns the values of a column, without missing values."""
    return [row[key] for row in rows if row.get(key) is not None]


def _summarize_seeds(results: SweepResults) -> Iterator[str]:
    """Yields the lines on cells without random numbers, and on doubtful grid points."""
    fixed = sum(not row["random"] for row in results.rows)
    if fixed:
        yield f"in {_cells(fixed)} nothing is random: one seed was run there, for all"
    doubtful = [point for point in collect_grid_points(results) if point.doubtful]
    if doubtful:
        yield f"stable with some seeds and not with others, {_cells(len(doubtful))}:"
    for point in doubtful[:_MAX_DOUBTFUL_SHOWN]:
        position = [point.law] if results.plan.laws else []
        for axis, value in zip(results.plan.axes, point.values, strict=True):
            position.append(f"{axis.key} {value}")
        low, high = (100.0 * end for end in point.interval)
        yield (
            f"  cell {point.cell} ({', '.join(position)}): "
            f"{point.stable} of {point.decided} stable, "
            f"95 % interval {low:.0f} to {high:.0f} %"
        )
    if len(doubtful) > _MAX_DOUBTFUL_SHOWN:
        yield f"  and {len(doubtful) - _MAX_DOUBTFUL_SHOWN} more, all in {GRID_POINTS_FILE}"


def _cells(count: int) -> str:
    return count_nouns(count, "cell")


def list_next_commands(folder: Path) -> list[str]:
    """Returns commands that use the results."""
    command = format_command("sweep", str(folder))
    return [
        f"{command} --cell 0      # the command that makes a log of a cell",
        f"{command} --map         # its map, with the lines of theory",
    ]


def build_reproduce_command(
    results: SweepResults, row: ResultRow, folder: Path
) -> tuple[str, str]:
    """Returns the command that repeats the run of a row, and a note on the command, or "".

    If the scenario's source has changed since the sweep, the row's scenario is written to a
    file in `folder`, which the command names.
    """
    plan = results.plan
    source = plan.written.label
    overrides = plan.cell(row["cell"]).overrides
    try:
        text, source_folder = read_source(source)
        written = plan.written._replace(text=text, folder=source_folder)
        current_plan = plan._replace(written=written)
        digest = current_plan.scenario(*overrides, f"seed={row['seed']}").sha256
    except ScenarioError:
        digest = ""
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

"""Reads and summarises the results of a sweep over a grid of parameters.

The table of a finished sweep has one row per run, and each cell (a point of the grid) has one
run per random seed. This module reads the table, combines the runs of a cell, composes a
summary, and finds the command that repeats a run.

Invariant:
    - The bytes of the result files depend only on the runs, not on the time of day or the
      number of worker processes.
    - Reading the CSV table restores all numbers bit for bit.
    - Running the scenario of a row again reproduces the row.
    - Every printed command reproduces the run, with the same scenario hash as its row. If the
      source of the scenario has changed since the sweep, the command names a file to which the
      scenario of the row was written.
"""

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.analysis import LogMetrics
from trilat_net.errors import ScenarioError, UsageError, count_nouns
from trilat_net.files import write_whole
from trilat_net.results import Result
from trilat_net.scenario import ExperimentText
from trilat_net.work import MeanInterval, wilson_interval

from ..run_commands import format_command
from .result_table import ResultRow, ResultTable, StoredRows, encode_table
from .sweep_cell import RUN_CLASSES, CellClass, CellResult
from .sweep_plan import SweepPlan

RESULTS_FILE = "results.csv"
"""Name of the table of runs in the folder of a sweep."""
PLAN_FILE = "plan.json"
"""Name of the file with the plan of the sweep, which is needed to read `results.csv`."""


@dataclass(frozen=True, repr=False)
class SweepResults(Result):
    """Results of a finished sweep, as a table with one row per run.

    The runs of a cell differ in their seeds.

    Attributes:
        plan: The sweep.
        rows: One row per run, ordered by cell and then by seed. The rows of a large sweep stay
            on disk and are read on demand.
    """

    plan: SweepPlan
    rows: Sequence[ResultRow]

    def blocks(self) -> Iterator[str]:
        """Yields the lines that `trilat sweep` prints: the plan and a summary of results."""
        yield from self.plan.describe()
        yield from self.summarize()

    def to_rows(self) -> Sequence[ResultRow]:
        """Returns the table of all runs, one row per run, ordered by cell and then by seed."""
        return self.rows

    def to_dict(self) -> dict[str, Any]:
        """Converts the results to the plain values that `trilat sweep --json` prints.

        Returns:
            The facts of the plan, and one row per run with the columns of the CSV table.
        """
        runs = [dict(row) for row in self.rows]
        return {"plan": self.plan.facts(), "runs": runs}

    def of_cell(self, number: int) -> list[ResultRow]:
        """Returns the results of one cell, with one row per random seed.

        Args:
            number: Number of the cell.

        Raises:
            UsageError: The sweep has no cell with this number.
        """
        self.plan.cell(number)
        if isinstance(self.rows, StoredRows):
            return self.rows.find_cell(number)
        return [row for row in self.rows if row["cell"] == number]

    def outcome(self, row: ResultRow) -> CellResult:
        """Converts the table row of a run to an object with named fields.

        Fields that are missing from the row, because an older version wrote it, get the default
        values of `CellResult`.

        Args:
            row: Row of the run.
        """
        return msgspec.convert(row, CellResult)

    def iterate_grid_points(self) -> "Iterator[_GridPoint]":
        """Yields the summary of each grid point, as in `list_grid_points`."""
        totals = self.plan.list_totals()
        groups = groupby(self.rows, key=lambda row: (row["cell"], row["law"]))
        for (cell, law), group in groups:
            rows = list(group)
            counts = Counter(row["verdict"] for row in rows)
            # The totals of a run that diverged describe a shorter time, so they are not
            # averaged.
            rows_within_limits = [row for row in rows if row["diverged_s"] is None]
            means = []
            for key in totals:
                values = [row.get(key) for row in rows_within_limits]
                means.append(MeanInterval.of_values(values))
            class_counts = [counts[verdict.value] for verdict in RUN_CLASSES]
            yield _GridPoint(
                cell=cell,
                law=law,
                values=self.plan.cell(cell).values,
                counts=tuple(class_counts),
                means=tuple(means),
            )

    def list_grid_points(self) -> "list[_GridPoint]":
        """Summarises the runs at each grid point, which differ only in their random seeds.

        Returns:
            One summary per combination of swept parameters and control law (grid point), with
            the number of runs in each class and the means of the measured totals. Summaries are
            listed in the order in which their grid points first occur in the results.
        """
        return list(self.iterate_grid_points())

    def build_reproduce_command(self, row: ResultRow, folder: Path) -> tuple[str, str]:
        """Returns the command that repeats the run of a row.

        If the source of the scenario has changed since the sweep, the command in the row would
        run something else. In that case, the scenario of the row is written to a file, and the
        command runs that file.

        Args:
            row: The run.
            folder: Folder in which the file is written, if necessary.

        Returns:
            The command, and a note that the scenario has changed. The note is empty if the
            scenario is unchanged.
        """
        plan = self.plan
        source = plan.written.label
        overrides = plan.cell(row["cell"]).overrides

        try:
            current_plan = plan._replace(written=ExperimentText.read(source))
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
        duration_s = plan.reproduction_duration_s(self.outcome(row))
        options = ["--duration", f"{duration_s:.12g}", "-o", f"{name}.mcap"]
        command = format_command("sim", str(file), *options)
        note = f"{source} has changed since the sweep, or is missing; as it ran: {file}"
        return command, note

    def encode_grid_points(self) -> Iterator[str]:
        """Encodes the grid points as CSV text, with one line per point.

        A line contains the number of the cell, its axis values and law, the number of runs in
        each class, the fraction of stable runs with its 95 % interval, and the means of the
        measured quantities with their intervals.

        Yields:
            The header line, then one line per grid point.
        """
        plan = self.plan
        column_types = plan.list_axis_columns()
        column_types["runs"] = int
        column_types |= {verdict.value: int for verdict in RUN_CLASSES}
        share_columns = ("stable_share", "stable_share_low", "stable_share_high")
        column_types |= dict.fromkeys(share_columns, float)
        for key in plan.list_totals():
            column_types |= {f"{key}_{field}": float for field in MeanInterval._fields}

        def list_values(point: _GridPoint) -> dict[str, Any]:
            """Returns the line of a grid point as a mapping from column name to value."""
            decided = point.decided
            stable_share = point.stable / decided if decided else None
            # The values must be in the order of the columns above.
            values: list[Any] = [point.cell, *point.values, point.law]
            values += [sum(point.counts), *point.counts]
            values += [stable_share, *point.interval]
            for mean in point.means:
                values += mean or (None, None)
            return dict(zip(column_types, values, strict=True))

        yield from encode_table(map(list_values, self.iterate_grid_points()), column_types)

    def summarize(self) -> Iterator[str]:
        """Yields the lines of the summary that is printed after a sweep.

        The lines state how many runs are in each class, how many runs were extended, the ranges
        of the measured quantities, the growth exponents, and the differences between seeds.
        Lines that do not apply to the sweep are omitted.
        """
        plan = self.plan
        tally = _tally_rows(self)
        verdict_texts = []
        for verdict in CellClass:
            count = tally.counts[verdict.value]
            if count or verdict is not CellClass.REFUSED:
                verdict_texts.append(f"{count} {verdict.value}")
        runs = count_nouns(len(self.rows), "run")
        cells = count_nouns(plan.cells, "cell")
        yield f"{runs} of {cells}: {', '.join(verdict_texts)}"
        yield from tally.refusals

        if tally.extended:
            first_s = plan.base.duration_s
            yield (
                f"{tally.extended} were undecided after {first_s:g} s and continued, "
                f"the longest to {tally.longest_s:g} s"
            )

        ranges = []
        for key, (name, unit) in _list_quantities(plan).items():
            value_range = tally.ranges[key]
            if value_range.count:
                text = f"{name} {value_range.low:.3g} to {value_range.high:.3g} {unit}"
                ranges.append(text.rstrip())
        if ranges:
            yield f"within their limits {tally.within_limits}: {', '.join(ranges)}"

        rates = tally.exponents
        if rates.count:
            interval = f"{rates.low:+.3g} to {rates.high:+.3g} /s"
            is_linear = plan.judge == "linear"
            name = "growth rates of the linear loop" if is_linear else GROWTH_EXPONENTS
            yield f"{name} {interval}: {rates.positive} of {rates.count} grow"

        if len(plan.seeds) > 1:
            yield from _summarize_seeds(self, tally.not_random)


def read_results(path: Path) -> SweepResults:
    """Reads the results of a finished sweep from its folder.

    Args:
        path: Folder of the sweep, or its CSV table.

    Raises:
        UsageError: There are no results, they cannot be read, or the sweep has not finished.
    """
    is_folder = path.is_dir()
    file = path / RESULTS_FILE if is_folder else path
    if not file.is_file():
        hint = f"; continue it with: trilat sweep --resume {path}" if is_folder else ""
        raise UsageError(f"{file} does not exist: there are no results of a sweep{hint}")
    plan_file = file.with_name(PLAN_FILE)
    if not plan_file.is_file():
        raise UsageError(
            f"{file} contains no results of a sweep: there is no {PLAN_FILE} next to this file"
        )
    try:
        plan_text = plan_file.read_text(encoding="utf-8")
        plan = SweepPlan.from_facts(json.loads(plan_text))
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{plan_file} cannot be read as the plan of a sweep") from None

    return SweepResults(plan, ResultTable(plan).read_rows(file))


GRID_POINTS_FILE = "places.csv"
"""Name of the table of grid points in the folder of a sweep."""


class _GridPoint(NamedTuple):
    """Summary of all runs with the same parameter values, which differ only in their seeds.

    Attributes:
        cell: Number of the cell, from 0.
        law: Control laws of the sites.
        values: Value of the cell on each axis.
        counts: Number of runs in each class, such as converged or diverged, in the order of
            `RUN_CLASSES`.
        means: Mean, with its 95 % interval, of each quantity of `SweepPlan.list_totals`, over
            the runs that stayed within the limits of their arms. `None` for fewer than two such
            runs.
    """

    cell: int
    law: str
    values: tuple[float | str, ...]
    counts: tuple[int, ...]
    means: tuple[MeanInterval | None, ...] = ()

    @property
    def decided(self) -> int:
        """Number of runs that were judged stable or not stable, excluding undecided ones."""
        classes = zip(self.counts, RUN_CLASSES, strict=True)
        return sum(count for count, verdict in classes if verdict.stable is not None)

    @property
    def stable(self) -> int:
        """Number of runs that were judged stable."""
        classes = zip(self.counts, RUN_CLASSES, strict=True)
        return sum(count for count, verdict in classes if verdict.stable)

    @property
    def doubtful(self) -> bool:
        """True if the cell is stable with some seeds and not stable with others.

        The result then depends on chance, and more seeds are needed to estimate how probable a
        stable run is.
        """
        return 0 < self.stable < self.decided

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the probability that a run is stable.

        Undecided runs are left out. The interval is computed with Wilson's method. Even if 10
        of 10 runs are stable, its lower end is below 1, because other seeds might give another
        result.
        """
        return wilson_interval(self.stable, self.decided)


_TOTALS = {
    "rms_error_rad": ("RMS e", "rad"),
    "effort_nm": ("effort", "N m"),
    "force_peak_n": ("peak force", "N"),
    "walls_j": ("work of the walls", "J"),
}
"""Quantities whose range over the runs is printed, as key, name and unit."""


_MAX_CELLS_SHOWN = 8
"""Largest number of doubtful or rejected cells in the summary. The CSV files list all of them.
"""


GROWTH_EXPONENTS = "growth exponents of small pushes"
"""Name of the quantity that twins measure."""


def _list_quantities(plan: SweepPlan) -> dict[str, tuple[str, str]]:
    """Maps the keys of the quantities whose ranges are printed to their names and units.

    Args:
        plan: The sweep, whose requested metrics come first.
    """
    quantities = {}
    for metric in map(LogMetrics.find_quantity, plan.metrics):
        quantities[metric.key] = (metric.name, metric.unit)
    return quantities | _TOTALS


class _ValueRange:
    """Smallest and largest value of a quantity over the runs of a sweep.

    Attributes:
        count: Number of runs that have the quantity.
        positive: Number of runs in which it is positive.
        low: Smallest value.
        high: Largest value.
    """

    def __init__(self) -> None:
        self.count = 0
        self.positive = 0
        self.low = math.inf
        self.high = -math.inf

    def add(self, value: float | None) -> None:
        """Updates the smallest and the largest value with the value of one run.

        If the run lacks the quantity, the value is `None` and is ignored.
        """
        if value is None:
            return
        self.count += 1
        self.positive += value > 0.0
        self.low = min(self.low, value)
        self.high = max(self.high, value)


class _RowTally:
    """Contents of a sweep's summary, collected in one pass over its rows.

    Args:
        quantities: Keys of the quantities whose ranges are printed.

    Attributes:
        counts: Number of runs in each class.
        extended: Number of runs that were extended.
        longest_s: Duration of the longest extended run, in s.
        within_limits: Number of runs whose arms stayed within their limits.
        ranges: Range of each quantity over the runs within their limits.
        exponents: Range of the growth exponents of all runs.
        not_random: Number of runs in which nothing is random.
        refusals: Lines about the first cells that are not valid scenarios.
    """

    def __init__(self, quantities: Iterable[str]) -> None:
        self.counts: Counter[str] = Counter()
        self.extended = 0
        self.longest_s = 0.0
        self.within_limits = 0
        self.ranges = {key: _ValueRange() for key in quantities}
        self.exponents = _ValueRange()
        self.not_random = 0
        self.refusals: list[str] = []


def _tally_rows(results: SweepResults) -> _RowTally:
    """Collects the summary of a sweep in one pass over all of its runs.

    Args:
        results: Results of the sweep.
    """
    tally = _RowTally(_list_quantities(results.plan))
    for row in results.rows:
        tally.counts[row["verdict"]] += 1
        if row["verdict"] == CellClass.REFUSED:
            if len(tally.refusals) < _MAX_CELLS_SHOWN:
                tally.refusals.append(f"  {row['reasons']}")
            continue
        tally.not_random += not row["random"]
        if row["extended"]:
            tally.extended += 1
            tally.longest_s = max(tally.longest_s, row["ran_s"])
        if row["diverged_s"] is None:
            tally.within_limits += 1
            for key, value_range in tally.ranges.items():
                value_range.add(row.get(key))
        tally.exponents.add(row.get("exponent_per_s"))
    return tally


def _summarize_seeds(results: SweepResults, not_random: int) -> Iterator[str]:
    """Yields the lines of the summary that describe the effect of the seeds.

    The first line counts the cells in which nothing is random, which run only once. The others
    list the cells that are stable with some seeds and not stable with others.

    Args:
        results: Results of the sweep.
        not_random: Number of runs in which nothing is random.
    """
    if not_random:
        cells = count_nouns(not_random, "cell")
        yield f"nothing is random in {cells}: only one seed was run there"

    doubtful = []
    doubtful_count = 0
    for point in results.iterate_grid_points():
        if point.doubtful:
            doubtful_count += 1
            if doubtful_count <= _MAX_CELLS_SHOWN:
                doubtful.append(point)
    if doubtful:
        cells = count_nouns(doubtful_count, "cell")
        yield f"stable with some seeds and not with others, {cells}:"

    for point in doubtful:
        setting = [point.law] if results.plan.laws else []
        for axis, value in zip(results.plan.axes, point.values, strict=True):
            setting.append(f"{axis.key} {value}")
        low, high = (100.0 * end for end in point.interval)
        yield (
            f"  cell {point.cell} ({', '.join(setting)}): "
            f"{point.stable} of {point.decided} stable, "
            f"95 % interval {low:.0f} to {high:.0f} %"
        )

    if doubtful_count > _MAX_CELLS_SHOWN:
        hidden = doubtful_count - _MAX_CELLS_SHOWN
        yield f"  and {hidden} more, all in {GRID_POINTS_FILE}"

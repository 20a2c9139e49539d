"""The results of a sweep: its runs as a CSV table, grid points over seeds, and both in words.

Invariant:
- Results are a function of the plan, and their bytes of the runs alone.
- Reading the table gives every number back bit for bit.
- Each row's scenario, run again, reproduces the row.
- A grid point counts every run once; its stable share is taken over the decided runs and
  carries a 95 % Wilson interval within [0, 1].
- Every command shown works: a reproduced run has the scenario hash of its row; if the swept
  scenario has changed since, the row's own text is written out and named instead.
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
"""The request of a sweep, in its folder: what `results.csv` is read with."""


ResultRow = Mapping[str, Any]
"""A run: `cell`, a value per axis under its key, `law`, `seed`, `random`, the metrics that were
asked for under their keys, every field of `CellResult`, `scenario_sha256`, `command` and
`scenario`, its canonical text. Verdict and motion are their words.
"""


@dataclass(frozen=True, repr=False)
class SweepResults(Result):
    """Results of a sweep: its runs by cell, and then in the order of the seeds."""

    plan: SweepPlan
    rows: Sequence[ResultRow]

    def blocks(self) -> Iterator[str]:
        """Yields its text."""
        yield from (*describe_sweep_plan(self.plan), *summarize_sweep(self))

    def to_rows(self) -> Sequence[ResultRow]:
        """Returns a row per run."""
        return self.rows

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat sweep --json`."""
        return {"plan": self.plan.facts(), "runs": [dict(row) for row in self.rows]}

    def of_cell(self, number: int) -> list[ResultRow]:
        """Returns the runs of a cell, one per seed.

        Raises:
            UsageError: there is no such cell.
        """
        self.plan.cell(number)
        return [row for row in self.rows if row["cell"] == number]

    def outcome(self, row: ResultRow) -> CellResult:
        """Returns the result of a run."""
        # whose defaults stand for what older files lack
        return msgspec.convert(row, CellResult)


def build_result_rows(plan: SweepPlan, entries: Sequence[CellRun]) -> list[ResultRow]:
    """Returns the rows that runs make, in their order."""
    order = {seed: n for n, seed in enumerate(plan.seeds)}
    seeds = Counter(entry.cell for entry in entries)
    rows: list[ResultRow] = []
    for entry in sorted(entries, key=lambda one: (one.cell, order[one.seed])):
        cell = plan.cell(entry.cell)
        which = "" if seeds[entry.cell] == 1 else f"-seed-{entry.seed}"
        lasts_s = reproduction_duration_s(plan, entry.outcome)
        log = f"cell-{cell.number}{which}.mcap"
        rows.append(
            {
                "cell": cell.number,
                **{one.key: value for one, value in zip(plan.axes, cell.values, strict=True)},
                "law": entry.law,
                "seed": entry.seed,
                "random": entry.random,
                **entry.metrics,
                **msgspec.to_builtins(entry.outcome),
                "scenario_sha256": entry.sha256,
                "command": build_sim_command(
                    plan=plan,
                    overrides=cell.overrides,
                    seed=entry.seed,
                    duration_s=lasts_s,
                    log=log,
                ),
                "scenario": apply_diff(entry.scenario, plan.base.text),
            }
        )
    return rows


def build_sim_command(
    plan: SweepPlan, overrides: Sequence[str], seed: int, duration_s: float, log: str
) -> str:
    """Returns the command that makes a log of a run."""
    others = [
        text
        for text in (*plan.overrides, *overrides)
        if text.partition("=")[0].strip() not in ("seed", "duration_s")
    ]
    run = ["--seed", str(seed), "--duration", f"{duration_s:.12g}", "-o", log]
    return format_command("sim", plan.written.label, *set_options(others), *run)


def reproduction_duration_s(plan: SweepPlan, outcome: CellResult) -> float:
    """Returns a duration that makes a run again: as long as it ran, or until it diverges by
    itself, s.
    """
    if outcome.diverged_s is None:
        return outcome.ran_s
    return max(outcome.ran_s, min(plan.longest_s, plan.base.duration_s * 2.0**outcome.extended))


_SCENARIO_COLUMN = "scenario_changes"
"""The column of the table that holds a row's scenario: as JSON, by what it differs from the
swept one.
"""

_LONGEST_CELL = 2**26
"""Letters of a cell at most; the csv module reads 131 072, and a scenario with a trace has
more.
"""


def encode_results(plan: SweepPlan, rows: Sequence[ResultRow]) -> str:
    """Returns results as CSV, a line per run."""
    kinds = _kinds_of_results(plan)
    lines = []
    for row in rows:
        changes = diff_lines(row["scenario"], plan.base.text)
        cells = {name: _format_cell(row[name], kind) for name, kind in kinds.items()}
        lines.append({**cells, _SCENARIO_COLUMN: json.dumps(changes, ensure_ascii=False)})
    return encode_csv(lines, [*kinds, _SCENARIO_COLUMN])


def _kinds_of_results(plan: SweepPlan) -> dict[str, type]:
    """Returns the type of each column of the table, except that of the scenarios."""
    kinds = {**_kinds_of_axes(plan), "seed": int, "random": bool}
    kinds |= dict.fromkeys((*plan.metrics, *CellResult.__struct_fields__), float)
    kinds |= dict.fromkeys(("verdict", "motion", "reasons", "scenario_sha256", "command"), str)
    return kinds | {"extended": int}


def _kinds_of_axes(plan: SweepPlan) -> dict[str, type]:
    return {
        "cell": int,
        **{one.key: float if one.numeric else str for one in plan.axes},
        "law": str,
    }


def _format_cell(value: Any, kind: type) -> str:
    """Returns a value as the table has it: numbers so that they are read back bit for bit; None
    is empty.
    """
    if value is None:
        return ""
    if kind is bool:
        return "true" if value else "false"
    return repr(float(value)) if kind is float else str(value)


def _parse_cell(text: str, kind: type) -> Any:
    """Returns the value of a cell.

    Raises:
        ValueError: the text is no value of this type.
    """
    if kind is str:
        return text
    if kind is bool:
        return {"true": True, "false": False}[text]
    return kind(text) if text else None


def read_results(path: Path) -> SweepResults:
    """Returns the results of a sweep, by its folder or its table.

    Raises:
        UsageError: there are none, or the sweep has not come to its end.
    """
    file = path / RESULTS_FILE if path.is_dir() else path
    if not file.is_file():
        more = f"; go on with it: trilat sweep --resume {path}" if path.is_dir() else ""
        raise UsageError(f"{file}: there are no results of a sweep{more}")
    request = file.with_name(PLAN_FILE)
    if not request.is_file():
        raise UsageError(
            f"{file}: holds no results of a sweep: there is no {PLAN_FILE} beside it"
        )
    try:
        plan = plan_from_json(json.loads(request.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{request}: cannot be read as the plan of a sweep") from None
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
    row = {
        name: _parse_cell(line[name], kind) for name, kind in _kinds_of_results(plan).items()
    }
    changes = json.loads(line[_SCENARIO_COLUMN])
    return {**row, "scenario": apply_diff(changes, plan.base.text)}


GRID_POINTS_FILE = "places.csv"


class GridPoint(NamedTuple):
    """One cell with all its seeds.

    Attributes:
        cell, law, values: its place.
        counts: how many runs came to each class, in the order of `CellClass`.
        means: of each number of a run that `list_totals` names its mean over the runs that
            stayed within their limits; None of fewer than two runs.
    """

    cell: int
    law: str
    values: tuple[float | str, ...]
    counts: tuple[int, ...]
    means: tuple[MeanInterval | None, ...] = ()

    @property
    def decided(self) -> int:
        """How many runs showed whether they are stable."""
        return sum(
            n
            for n, verdict in zip(self.counts, CellClass, strict=True)
            if verdict.stable is not None
        )

    @property
    def stable(self) -> int:
        """How many runs are stable."""
        return sum(
            n for n, verdict in zip(self.counts, CellClass, strict=True) if verdict.stable
        )

    @property
    def doubtful(self) -> bool:
        """True where some runs are stable and some are not."""
        return 0 < self.stable < self.decided

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share of stable runs, among those that decide."""
        return wilson_interval(self.stable, self.decided)


def list_totals(plan: SweepPlan) -> list[str]:
    """Returns the keys of the numbers of a run that are averaged over its seeds."""
    return list(dict.fromkeys((*RunTotals._fields, *plan.metrics)))


def collect_grid_points(results: SweepResults) -> list[GridPoint]:
    """Returns every grid point of a sweep, in the order of the cells."""
    rows_of: dict[tuple[int, str], list[ResultRow]] = {}
    for row in results.rows:
        rows_of.setdefault((row["cell"], row["law"]), []).append(row)
    points = []
    totals = list_totals(results.plan)
    for (cell, law), rows in rows_of.items():
        counts = Counter(row["verdict"] for row in rows)
        kept = [row for row in rows if row["diverged_s"] is None]
        means = tuple(mean_interval([row.get(key) for row in kept]) for key in totals)
        values = results.plan.cell(cell).values
        points.append(
            GridPoint(
                cell=cell,
                law=law,
                values=values,
                counts=tuple(counts[one.value] for one in CellClass),
                means=means,
            )
        )
    return points


def encode_grid_points(plan: SweepPlan, found: Sequence[GridPoint]) -> str:
    """Returns grid points as CSV: counts, and the share of stable runs with its interval."""
    kinds = _kinds_of_axes(plan) | dict.fromkeys(
        ("runs", *(one.value for one in CellClass)), int
    )
    kinds |= dict.fromkeys(("stable_share", "stable_share_low", "stable_share_high"), float)
    kinds |= dict.fromkeys(
        (f"{key}_{word}" for key in list_totals(plan) for word in MeanInterval._fields), float
    )
    rows = []
    for one in found:
        low, high = one.interval
        numbers = [number for mean in one.means for number in mean or (None, None)]
        share = one.stable / one.decided if one.decided else None
        cells = (
            one.cell,
            *one.values,
            one.law,
            sum(one.counts),
            *one.counts,
            share,
            low,
            high,
            *numbers,
        )
        named = zip(kinds.items(), cells, strict=True)
        rows.append({name: _format_cell(cell, kind) for (name, kind), cell in named})
    return encode_csv(rows, list(kinds))


_TOTALS = {
    "rms_error_rad": ("RMS e", "rad"),
    "effort_nm": ("effort", "N m"),
    "force_peak_n": ("peak force", "N"),
    "walls_j": ("work of the walls", "J"),
}


_MAX_DOUBTFUL_SHOWN = 8
"""Most doubtful grid points printed; all stand in the file."""


def describe_sweep_plan(plan: SweepPlan) -> list[str]:
    """Returns the plan in lines, before it runs."""
    sizes = " x ".join(str(len(one.texts)) for one in plan.axes) or "1"
    laws = f" x laws {', '.join(plan.laws)}" if plan.laws else ""
    count = len(plan.seeds)
    seeds = (
        f"seed {plan.seeds[0]}"
        if count == 1
        else f"{count_nouns(count, 'seed')} each where anything is random"
    )
    lines = [f"{plan.base.name}: {count_nouns(plan.cells, 'cell')} ({sizes}{laws}), {seeds}"]
    for one in plan.axes:
        texts = one.texts
        count = len(texts)
        shown = (
            [texts[0], texts[1], "...", texts[-1]]
            if count > 4
            else [texts[n] for n in range(count)]
        )
        lines.append(f"  over {one.asked}: {', '.join(shown)}")
    first_s = plan.base.duration_s
    longest_s = plan.longest_s
    extended = f", an undecided one up to {longest_s:g} s" if longest_s > first_s else ""
    twins = ", judged by twins" if plan.judge == "twins" else ""
    return [*lines, f"  {first_s:g} s each{extended}{twins}"]


def summarize_sweep(results: SweepResults) -> Iterator[str]:
    """Yields a summary: verdicts, extensions, seeds."""
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    words = ", ".join(f"{counts[verdict.value]} {verdict.value}" for verdict in CellClass)
    yield f"{count_nouns(len(rows), 'run')} of {count_nouns(results.plan.cells, 'cell')}: {words}"
    extended = [row for row in rows if row["extended"]]
    if extended:
        longest_s = max(row["ran_s"] for row in extended)
        first_s = results.plan.base.duration_s
        continued = f"and continued, the longest to {longest_s:g} s"
        yield f"{len(extended)} were undecided after {first_s:g} s {continued}"
    kept = [row for row in rows if row["diverged_s"] is None]
    ranges = []
    asked = {one.key: (one.name, one.unit) for one in map(find_quantity, results.plan.metrics)}
    for key, (name, unit) in {**asked, **_TOTALS}.items():
        values = [row[key] for row in kept if row.get(key) is not None]
        ranges += (
            [f"{name} {min(values):.3g} to {max(values):.3g} {unit}".rstrip()] if values else []
        )
    if ranges:
        yield f"within their limits {len(kept)}: {', '.join(ranges)}"
    found = [row["exponent_per_s"] for row in rows if row.get("exponent_per_s") is not None]
    if found:
        grow = f"{sum(one > 0.0 for one in found)} of {len(found)} grow"
        yield f"growth exponents of small pushes {min(found):+.3g} to {max(found):+.3g} /s: {grow}"
    if len(results.plan.seeds) > 1:
        yield from _of_seeds(results)


def _of_seeds(results: SweepResults) -> Iterator[str]:
    fixed = sum(not row["random"] for row in results.rows)
    if fixed:
        yield f"in {_cells(fixed)} nothing is random: one seed was run there, for all"
    doubtful = [place for place in collect_grid_points(results) if place.doubtful]
    if doubtful:
        yield f"stable with some seeds and not with others, {_cells(len(doubtful))}:"
    for place in doubtful[:_MAX_DOUBTFUL_SHOWN]:
        axes = zip(results.plan.axes, place.values, strict=True)
        where = [
            *([place.law] if results.plan.laws else []),
            *(f"{one.key} {value}" for one, value in axes),
        ]
        low, high = (100.0 * end for end in place.interval)
        yield (
            f"  cell {place.cell} ({', '.join(where)}): {place.stable} of {place.decided} stable, "
            f"95 % interval {low:.0f} to {high:.0f} %"
        )
    if len(doubtful) > _MAX_DOUBTFUL_SHOWN:
        yield f"  and {len(doubtful) - _MAX_DOUBTFUL_SHOWN} more, all in {GRID_POINTS_FILE}"


def _cells(count: int) -> str:
    return count_nouns(count, "cell")


def list_next_commands(folder: Path) -> list[str]:
    """Returns commands that use the results."""
    where = format_command("sweep", str(folder))
    return [
        f"{where} --cell 0      # the command that makes a log of a cell",
        f"{where} --map         # its map, with the lines of theory",
    ]


def build_reproduce_command(
    results: SweepResults, row: ResultRow, folder: Path
) -> tuple[str, str]:
    """Returns the command that repeats a row, and a note on it or ""."""
    plan = results.plan
    source = plan.written.label
    try:  # is it still what was swept?
        text, home = read_source(source)
        now = plan._replace(written=plan.written._replace(text=text, folder=home))
        again = now.scenario(*plan.cell(row["cell"]).overrides, f"seed={row['seed']}").sha256
    except ScenarioError:
        again = ""
    if again == row["scenario_sha256"]:
        return row["command"], ""
    name = f"cell-{row['cell']}-seed-{row['seed']}"
    file = folder / f"{name}.toml"
    write_whole(file, row["scenario"])
    lasts_s = reproduction_duration_s(plan, results.outcome(row))
    command = format_command(
        "sim", str(file), "--duration", f"{lasts_s:.12g}", "-o", f"{name}.mcap"
    )
    return command, f"{source} is not what was swept any more, or not here; as it ran: {file}"

"""Plans a sweep: the runs of one scenario over a grid of parameters, control laws and seeds.

For example, the string "link.delay_ms=0:400:50" makes the network delay an axis of the grid,
with values from 0 to 400 ms. A cell combines one value of every axis with a control law, and is
run once per random seed. This module combines the axes, laws and seeds with the scenario, and
checks the result before anything runs. `SweepAxis` parses the axes.

Invariant:
    - A plan that cannot run is rejected before the first run.
    - Cells are numbered row by row. Any cell can be computed from the plan and its number, so a
      large grid need not be stored.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from trilat_net.analysis import LogMetrics
from trilat_net.errors import ScenarioError, UsageError, count_nouns, suggest_nearest
from trilat_net.own_code import allow_own_code, name_law_classes
from trilat_net.scenario import LAWS, ExperimentText, Scenario

from ..run_commands import format_command, format_override_value, set_options
from . import sweep_cell
from .sweep_axis import SweepAxis

MAX_SEEDS = 100_000
"""Largest number of seeds of a sweep."""
MAX_EXTENSION = 8.0
"""Default limit on the duration of an undecided run, as a multiple of the scenario's duration.
"""
MAX_SCENARIO_S = 86_400.0
"""Longest duration that a scenario may have, in s."""
JUDGES = ("verdict", "twins", "linear")
"""Ways to judge a cell. "verdict" classifies how its run ends. "twins" repeats the run with a
small push and measures the growth exponent, the rate at which the disturbance grows. "linear"
computes the characteristic roots of the linearised loop, without a run.
"""
_CHECKED_VALUES = 32
"""Largest number of values per axis that are checked before the first run."""


class SweepCell(NamedTuple):
    """One cell of a sweep: a combination of parameter values and a control law.

    Attributes:
        number: Number of the cell, counted row by row from 0. The law changes slowest, and the
            value of the last axis changes fastest.
        law: Control law of the cell. Empty if the sweep does not vary the law.
        values: Value of the cell on each axis: a float if it is a number, a string otherwise.
        overrides: Overrides KEY=VALUE that turn the scenario of the sweep into that of the
            cell.
    """

    number: int
    law: str
    values: tuple[float | str, ...]
    overrides: tuple[str, ...]


class SweepPlan(NamedTuple):
    """Everything that determines a sweep: scenario, axes, laws and seeds.

    `plan_sweep` creates and checks this object. A cell combines one value of every axis with a
    control law, and is run with one or more seeds.

    Attributes:
        written: Scenario as its author wrote it, without overrides and default values.
        overrides: Overrides KEY=VALUE that apply to all cells.
        base: Scenario with `overrides`, with all default values filled in.
        axes: Swept axes. The last one changes fastest from cell to cell.
        laws: For each swept control law, the overrides that select it. The law changes slowest.
            If no laws are swept, all cells have the laws of the scenario.
        seeds: Random seeds for each cell. A cell in which nothing is random is run with the
            first seed only, since all others would give the same run.
        longest_s: Longest duration to which a run is extended while it is undecided, in s.
        judge: How runs are judged, a name in `JUDGES`.
        metrics: Keys of further metrics from `docs/reference/metrics.md` to measure in each
            run.
        refine: Number of times that the boxes of the grid along the stability edge are halved,
            see `edge_refinement`. If 0, all cells are run.
    """

    written: ExperimentText
    overrides: tuple[str, ...]
    base: Scenario
    axes: tuple[SweepAxis, ...]
    laws: dict[str, tuple[str, ...]]
    seeds: tuple[int, ...]
    longest_s: float
    judge: str = "verdict"
    metrics: tuple[str, ...] = ()
    refine: int = 0

    @property
    def default_longest_s(self) -> float:
        """Default for the longest duration to which an undecided run is extended, in s.

        This is the duration of the scenario times `MAX_EXTENSION`, but at most
        `MAX_SCENARIO_S`. If cells are judged by how fast small disturbances grow, runs are
        never extended, and the default is the duration of the scenario.
        """
        extension = MAX_EXTENSION if self.judge == "verdict" else 1.0
        return min(MAX_SCENARIO_S, extension * self.base.duration_s)

    @property
    def shape(self) -> tuple[int, ...]:
        """Size of the grid: the number of laws, then the number of values on each axis.

        The number of laws is 1 if the sweep does not vary the law.
        """
        return (max(1, len(self.laws)), *(len(axis.texts) for axis in self.axes))

    @property
    def cells(self) -> int:
        """Number of cells in the grid."""
        return math.prod(self.shape)

    @property
    def refined_axes(self) -> list[int]:
        """Indices of the axes along which a refined sweep halves its steps.

        These are the first two axes whose values are numbers.
        """
        numeric = [
            index
            for index, axis in enumerate(self.axes)
            if axis.numeric and len(axis.texts) > 1
        ]
        return numeric[:_REFINED_AXES]

    def list_checked_indices(self, dimension: int) -> list[int]:
        """Returns the indices of the values that are checked before a sweep runs.

        A large grid cannot be checked completely. At most `_CHECKED_VALUES` indices, including
        the first and the last one, are spread evenly over the values of the dimension.

        Args:
            dimension: Dimension of the grid, see `shape`.
        """
        count = self.shape[dimension]
        checked = min(count, _CHECKED_VALUES)
        intervals = max(1, checked - 1)
        return [index * (count - 1) // intervals for index in range(checked)]

    def cell(self, number: int) -> SweepCell:
        """Returns the cell with a given number.

        Args:
            number: Number of the cell, counted row by row from 0.

        Raises:
            UsageError: The grid has no cell with this number.
        """
        if not 0 <= number < self.cells:
            raise UsageError(
                f"there is no cell {number}: cells are numbered from 0 to {self.cells - 1}"
            )

        # The number has one digit per dimension of the grid, and the last digit changes
        # fastest.
        remaining_number = number
        indices = list[int]()
        for count in reversed(self.shape):
            remaining_number, index = divmod(remaining_number, count)
            indices.insert(0, index)
        law_index, *axis_indices = indices

        law = ""
        overrides = list[str]()
        if self.laws:
            law = list(self.laws)[law_index]
            overrides.extend(self.laws[law])
        values = list[float | str]()
        for axis, index in zip(self.axes, axis_indices, strict=True):
            values.append(axis.value(index))
            overrides.append(axis.override(index))
        return SweepCell(number, law, tuple(values), tuple(overrides))

    def scenario(self, *more: str) -> Scenario:
        """Loads the scenario of the sweep with further overrides, such as a swept delay.

        Args:
            more: Further overrides KEY=VALUE.

        Raises:
            ScenarioError: The scenario is not valid with these overrides.
        """
        return self.written.load([*self.overrides, *more])

    def facts(self) -> dict[str, Any]:
        """Converts the plan to plain values for a JSON file.

        `from_facts` restores the plan. The keys "judge" (how runs are judged), "metrics" (which
        further metrics are measured) and "refine" (how often the stability edge is refined) are
        omitted if they have their defaults. A plan with these defaults is therefore encoded as
        by older versions, which did not have the keys.
        """
        plan: dict[str, Any] = {
            "source": self.written.label,
            "folder": None if self.written.folder is None else str(self.written.folder),
            "overrides": list(self.overrides),
            "over": [axis.description for axis in self.axes],
            "laws": list(self.laws),
            "seeds": list(self.seeds),
            "longest_s": self.longest_s,
            "name": self.base.name,
            "scenario_sha256": self.base.sha256,
            "text": self.written.text,
        }
        if self.judge != "verdict":
            plan["judge"] = self.judge
        if self.metrics:
            plan["metrics"] = list(self.metrics)
        if self.refine:
            plan["refine"] = self.refine
        return plan

    @classmethod
    def from_facts(cls, facts: dict[str, Any]) -> "SweepPlan":
        """Restores a plan from the plain values that `SweepPlan.facts` returned.

        The scenario is parsed from its stored text. Files named in the scenario are read again.

        Args:
            facts: The plain values, as read from the JSON file.

        Raises:
            ScenarioError: The plan cannot run on this machine.
        """
        folder = None if facts["folder"] is None else Path(facts["folder"])

        written = ExperimentText(facts["source"], facts["text"], folder)
        texts = tuple(facts["overrides"])
        axes = tuple(map(SweepAxis.parse, facts["over"]))
        loaded = _load_base(written, texts, axes, facts["laws"])
        base = allow_own_code(loaded.scenario)
        laws = {law: _list_law_overrides(written, texts, loaded, law) for law in facts["laws"]}

        return cls(
            written=written,
            overrides=texts,
            base=base,
            axes=axes,
            laws=laws,
            seeds=tuple(facts["seeds"]),
            longest_s=facts["longest_s"],
            judge=facts.get("judge", "verdict"),
            metrics=tuple(facts.get("metrics", ())),
            refine=facts.get("refine", 0),
        )

    def build_command(self, *more: str) -> str:
        """Returns the shell command that repeats the sweep, leaving out default options.

        Args:
            more: Further arguments of the command.
        """
        arguments = set_options(self.overrides)
        for axis in self.axes:
            arguments += ["--over", axis.description]

        count = len(self.seeds)
        first_seed = self.base.seed
        consecutive_seeds = tuple(range(first_seed, first_seed + count))
        if self.seeds != consecutive_seeds:
            seeds = ",".join(map(str, self.seeds))
            # A single seed needs a comma, because a number alone is the number of seeds.
            arguments += ["--seeds", f"{seeds}," if count == 1 else seeds]
        elif count > 1:
            arguments += ["--seeds", str(count)]

        if self.laws:
            arguments += ["--law", ",".join(self.laws)]
        if self.judge != "verdict":
            arguments += ["--judge", self.judge]
        if self.refine:
            arguments += ["--refine", str(self.refine)]
        for key in self.metrics:
            arguments += ["--metric", key]
        if self.longest_s != self.default_longest_s:
            arguments += ["--longest", format_override_value(self.longest_s)]
        return format_command("sweep", self.written.label, *arguments, *more)

    def list_totals(self) -> list[str]:
        """Lists the quantities that the sweep averages over the seeds.

        These are the totals of every run, such as the RMS error, and the metrics requested for
        this sweep.
        """
        keys = (*sweep_cell.TOTAL_KEYS, *self.metrics)
        return list(dict.fromkeys(keys))

    def reproduction_duration_s(self, outcome: sweep_cell.CellResult) -> float:
        """Returns the duration with which a run must be started to reproduce its row, in s.

        This is the duration of the run, unless the run diverged and therefore ended early. A
        run that diverged is started with its planned duration, including extensions (each
        doubles the duration), and will end early again.

        Args:
            outcome: Result of the run.
        """
        if outcome.diverged_s is None:
            return outcome.ran_s
        extended_s = self.base.duration_s * 2.0**outcome.extended
        planned_s = min(self.longest_s, extended_s)
        return max(outcome.ran_s, planned_s)

    def build_sim_command(
        self, overrides: Sequence[str], seed: int, duration_s: float, log: str
    ) -> str:
        """Returns the shell command that repeats one run of the sweep and records a log.

        Args:
            overrides: Overrides KEY=VALUE that turn the swept scenario into that of the run.
            seed: Random seed of the run.
            duration_s: Duration of the run, in s.
            log: Name of the log.
        """
        kept_overrides = list[str]()
        for override in (*self.overrides, *overrides):
            key, _, _ = override.partition("=")
            # Seed and duration have their own options in the command.
            if key.strip() not in ("seed", "duration_s"):
                kept_overrides.append(override)
        source = self.written.label
        set_arguments = set_options(kept_overrides)
        run_arguments = ["--seed", str(seed), "--duration", f"{duration_s:.12g}"]
        return format_command("sim", source, *set_arguments, *run_arguments, "-o", log)

    def describe(self) -> list[str]:
        """Returns lines that state the number of runs and the swept values."""
        axis_sizes = [str(len(axis.texts)) for axis in self.axes]
        sizes = " x ".join(axis_sizes) or "1"
        laws = f" x laws {', '.join(self.laws)}" if self.laws else ""
        seed_count = len(self.seeds)
        if seed_count == 1:
            seeds = f"seed {self.seeds[0]}"
        else:
            seeds = f"{count_nouns(seed_count, 'seed')} each where anything is random"
        cells = count_nouns(self.cells, "cell")
        lines = [f"{self.base.name}: {cells} ({sizes}{laws}), {seeds}"]

        for axis in self.axes:
            texts = axis.texts
            count = len(texts)
            if count > 4:
                values = [texts[0], texts[1], "...", texts[-1]]
            else:
                values = [texts[n] for n in range(count)]
            lines.append(f"  over {axis.description}: {', '.join(values)}")

        first_s = self.base.duration_s
        longest_s = self.longest_s
        extended = f", undecided runs up to {longest_s:g} s" if longest_s > first_s else ""
        if self.refine:
            steps = count_nouns(1 << self.refine, "cell")
            times = count_nouns(self.refine, "time")
            lines.append(f"  steps of {steps}, halved {times} along the stability edge")
        if self.judge == "linear":
            return [*lines, "  judged by the roots of the linear loop, without runs"]
        twins = ", judged by twins" if self.judge == "twins" else ""
        return [*lines, f"  {first_s:g} s each{extended}{twins}"]

    def list_axis_columns(self) -> dict[str, type]:
        """Returns the columns of the CSV table that identify a cell, with their types.

        These columns are the number of the cell, the value on each axis, and the control law.
        The types are used to parse the table.
        """
        column_types: dict[str, type] = {"cell": int}
        for axis in self.axes:
            column_types[axis.key] = float if axis.numeric else str
        column_types["law"] = str
        return column_types


def plan_sweep(
    source: str | Path | Mapping[str, Any] | Scenario,
    overrides: Sequence[str] = (),
    *,
    over: str | Sequence[str] | Mapping[str, Any] = (),
    seeds: int | Sequence[int] = 1,
    laws: Sequence[str | type] = (),
    longest_s: float | None = None,
    judge: str = "verdict",
    metrics: Sequence[str] = (),
    refine: int = 0,
) -> SweepPlan:
    """Plans a sweep and checks that it can run.

    Each law in `laws` is used at all sites. If all sites already use this law in the scenario,
    the gains of the scenario are kept. Otherwise the law gets its default gains. Gain overrides
    apply in both cases.

    The arguments are explained in `trilat_net.sweep`. Overrides are strings KEY=VALUE.

    Returns:
        The checked plan.

    Raises:
        ScenarioError: The scenario, an axis or a value of an axis is not valid or cannot run.
        UsageError: Another argument is not valid.
    """
    written = ExperimentText.read(source)
    texts = tuple(overrides)
    axes = tuple(map(SweepAxis.parse, SweepAxis.list_descriptions(over)))
    law_list = [laws] if isinstance(laws, str | type) else laws
    law_names = list(map(name_law_classes, law_list))
    for law in law_names:
        _check_law_name(law)
    loaded = _load_base(written, texts, axes, law_names)
    base = loaded.scenario

    keys = Counter(axis.key for axis in axes)
    for key, count in keys.items():
        if count > 1:
            raise ScenarioError("is swept twice: give one --over with all its values", path=key)
    if law_names and "control.law" in keys:
        raise ScenarioError(
            "is swept twice: give either --law or --over control.law", path="control.law"
        )
    law_overrides = {law: _list_law_overrides(written, texts, loaded, law) for law in law_names}
    if judge not in JUDGES:
        raise UsageError(f"--judge must be one of {', '.join(JUDGES)}, not {judge!r}")

    plan = SweepPlan(
        written=written,
        overrides=texts,
        base=base,
        axes=axes,
        laws=law_overrides,
        seeds=_resolve_seeds(seeds, base.seed),
        longest_s=0.0,  # set below, because the default depends on the plan
        judge=judge,
        metrics=_list_metrics(metrics),
        refine=refine,
    )
    _check_refinement(plan)
    if judge == "linear" and plan.metrics:
        raise UsageError(
            "metrics need a run, but --judge linear runs nothing: leave out one of them"
        )
    if longest_s is None:
        longest_s = plan.default_longest_s
    elif not base.duration_s <= longest_s <= MAX_SCENARIO_S:
        raise UsageError(
            "--longest, the maximum duration of an undecided cell, must be from "
            f"{base.duration_s:g} s to {MAX_SCENARIO_S:g} s, not {longest_s:g}"
        )
    plan = plan._replace(longest_s=longest_s)

    for law_index in range(plan.shape[0]):
        _check_axes(plan, law_index)
    return plan


MOST_HALVINGS = 16
"""Largest number of times that the boxes along the stability edge are halved."""
MOST_REFINED_CELLS = 100_000_000
"""Largest number of cells of a grid that can be refined. Each cell takes up 4 bytes."""
_REFINED_AXES = 2
"""Largest number of axes that are refined, equal to the number of axes of a map."""


def _check_refinement(plan: SweepPlan) -> None:
    """Raises UsageError if a sweep cannot be refined as often as its plan states.

    Raises:
        UsageError: The number is out of range, no axis can be refined, or the grid is too
            large.
    """
    if not 0 <= plan.refine <= MOST_HALVINGS:
        raise UsageError(f"--refine must be from 0 to {MOST_HALVINGS}, not {plan.refine}")
    if plan.refine and not plan.refined_axes:
        raise UsageError(
            "--refine needs an axis with several numbers, as in --over KEY=a:b:step"
        )
    if plan.refine and plan.cells > MOST_REFINED_CELLS:
        raise UsageError(
            f"--refine takes a grid of at most {MOST_REFINED_CELLS:.0e} cells, not "
            f"{plan.cells:.3g}: use larger steps"
        )


def _list_metrics(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the keys of the requested metrics, without duplicates.

    Args:
        names: Keys of metrics, or a single key.

    Raises:
        UsageError: A metric does not exist.
    """
    keys = [names] if isinstance(names, str) else names
    try:
        return tuple(dict.fromkeys(LogMetrics.find_quantity(key).key for key in keys))
    except KeyError as error:
        raise UsageError(f"--metric: {error.args[0]}") from None


def _resolve_seeds(seeds: int | Sequence[int], scenario_seed: int) -> tuple[int, ...]:
    """Returns the seeds of a sweep, without duplicates.

    Args:
        seeds: The seeds, or their number n, which means n consecutive seeds starting from that
            of the scenario.
        scenario_seed: Seed of the scenario. It is the only seed if `seeds` is empty.

    Raises:
        UsageError: A seed or the number of seeds is out of range.
    """
    if isinstance(seeds, int | str):
        if isinstance(seeds, str) or not 1 <= seeds <= MAX_SEEDS:
            raise UsageError(
                f"--seeds must be a number from 1 to {MAX_SEEDS}, "
                f"or a list as in 1..20, not {seeds}"
            )
        seeds = range(scenario_seed, scenario_seed + seeds)
    if len(seeds) > MAX_SEEDS:
        raise UsageError(
            f"--seeds has {count_nouns(len(seeds), 'seed')}, more than {MAX_SEEDS}"
        )
    for seed in seeds:
        if not 0 <= seed < 2**63:
            raise UsageError(f"a seed must be from 0 to 2^63 - 1, not {seed}")
    return tuple(dict.fromkeys(seeds)) or (scenario_seed,)


class _Base(NamedTuple):
    """Scenario of a sweep before any parameter is varied.

    Attributes:
        scenario: The scenario.
        forced: True if the scenario is valid only under a swept law. In this case, `scenario`
            has the first of the swept laws.
    """

    scenario: Scenario
    forced: bool


def _load_base(
    written: ExperimentText,
    overrides: Sequence[str],
    axes: Sequence[SweepAxis],
    laws: Sequence[str],
) -> _Base:
    """Loads the scenario of a sweep before its axes and laws are applied.

    The scenario may not be valid on its own. For example, a link may need the delay that an
    axis sets, or an override may set a gain that only a swept law has. It is therefore tried on
    its own, then with the first value on each axis, then with the first law, and then with
    both.

    Args:
        written: Scenario as its author wrote it.
        overrides: Overrides KEY=VALUE that apply to all cells.
        axes: Swept axes.
        laws: Names of the swept laws.

    Raises:
        ScenarioError: The scenario is not valid in any of these cases.
    """
    first_values = [axis.override(0) for axis in axes]
    problem: ScenarioError | None = None
    for law in ("", *laws[:1]):
        law_overrides = _force_law(written, overrides, law) if law else ()
        for axis_overrides in ((), first_values):
            try:
                scenario = written.load([*overrides, *law_overrides, *axis_overrides])
            except ScenarioError as error:
                problem = error
            else:
                return _Base(scenario, forced=bool(law))
        # If the scenario is not valid even without overrides, this call raises that error,
        # which helps the user more than an error of the overrides.
        written.load()
    assert problem is not None
    raise problem


def _check_law_name(law: str) -> None:
    """Raises UsageError if there is no law with a given name.

    Raises:
        UsageError: The name is neither a built-in law nor a class, as in mylaws:Law.
    """
    built_in = [name for name in LAWS if name != "own"]
    if law not in built_in and ":" not in law:
        hint = suggest_nearest(law, built_in)
        if not hint:
            hint = f"; laws are {', '.join(built_in)}, and your own, as in mylaws:Law"
        raise UsageError(f"--law: there is no law {law!r}{hint}")


def _force_law(written: ExperimentText, overrides: Sequence[str], law: str) -> tuple[str, ...]:
    """Returns the overrides that set the same control law for every arm.

    Args:
        written: Scenario as its author wrote it.
        overrides: Overrides that apply to all cells, which may contain a table of a site.
        law: Name of the law.
    """
    tables = written.read_tables(overrides)
    law_overrides = [f"control.law={law}"]
    for name, site in tables.get("sites", {}).items():
        # The table of a site takes precedence over the common one.
        if "control" in site:
            law_overrides.append(f"sites.{name}.control.law={law}")
    return tuple(law_overrides)


def _list_law_overrides(
    written: ExperimentText, overrides: Sequence[str], base: _Base, law: str
) -> tuple[str, ...]:
    """Returns the overrides that select a swept law.

    Returns:
        The overrides. Empty if all sites already use the law, in which case they keep its
        gains.
    """
    sites = base.scenario.sites.values()
    if not base.forced and all(spec.law_name == law for spec in sites):
        return ()
    return _force_law(written, overrides, law)


def _check_axes(plan: SweepPlan, law_index: int) -> None:
    """Raises ScenarioError if the cells of a sweep cannot be simulated with a control law.

    Checking every cell of a large grid would take too long. Instead, the corners of the grid
    are checked, and up to `_CHECKED_VALUES` evenly spread values of each axis, with the other
    axes at their first values. Single cells may be invalid: the sweep rejects only these cells.

    Args:
        plan: The sweep.
        law_index: Index of the law.

    Raises:
        ScenarioError: A value can run neither with the first nor with the last values of the
            other axes, no corner can run, or two values of an axis give the same scenario.
    """
    first_cell = [law_index] + [0] * len(plan.axes)
    last_cell = [law_index, *(len(axis.texts) - 1 for axis in plan.axes)]
    for dimension, axis in enumerate(plan.axes, 1):
        value_of_digest: dict[str, str] = {}
        for index in plan.list_checked_indices(dimension):
            indices = first_cell.copy()
            indices[dimension] = index
            try:
                digest = _load_cell(plan, indices).sha256
            except ScenarioError as error:
                # the value may be valid only with other values of the other axes
                opposite_cell = last_cell.copy()
                opposite_cell[dimension] = index
                if not _is_valid(plan, opposite_cell):
                    raise error from None
                continue
            text = axis.texts[index]
            if digest in value_of_digest:
                raise ScenarioError(
                    f"{value_of_digest[digest]} and {text} give the same experiment: "
                    "no site or link uses this key; perhaps each site or link has its own "
                    "value, as in sites.NAME.control or links.A->B",
                    path=axis.key,
                    source=plan.written.label,
                )
            value_of_digest[digest] = text

    axis_ends = [sorted({0, len(axis.texts) - 1}) for axis in plan.axes]
    corners = list(product([law_index], *axis_ends))
    if not any(_is_valid(plan, corner) for corner in corners):
        _load_cell(plan, corners[0])


def _is_valid(plan: SweepPlan, indices: Sequence[int]) -> bool:
    """Returns True if a cell of a sweep is a valid scenario.

    Args:
        plan: The sweep.
        indices: Index of the law and of the value on each axis.
    """
    try:
        _load_cell(plan, indices)
    except ScenarioError:
        return False
    return True


def _load_cell(plan: SweepPlan, indices: Sequence[int]) -> Scenario:
    """Loads the scenario of one cell.

    Args:
        plan: The sweep.
        indices: Index of the law and of the value on each axis.

    Raises:
        ScenarioError: The scenario is not valid or cannot run on this machine. If laws are
            swept, the message names the law.
    """
    # The number of a cell has one digit per dimension of the grid, see `SweepPlan.cell`.
    number = 0
    for dimension_size, index in zip(plan.shape, indices, strict=True):
        number = number * dimension_size + index
    cell = plan.cell(number)

    try:
        scenario = plan.scenario(*cell.overrides)
        sweep_cell.check_sweepable(scenario)
    except ScenarioError as error:
        problem = f"with law {cell.law}: {error.problem}" if cell.law else error.problem
        raise ScenarioError(problem, path=error.path, source=plan.written.label) from None
    return scenario

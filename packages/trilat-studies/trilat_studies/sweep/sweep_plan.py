"""Plans a sweep: the runs of one scenario over a grid of parameters, control laws and seeds.

For example, the text "link.delay_ms=0:400:50" makes the network delay an axis of the grid, with
the values 0 to 400 ms. One combination of the values of all axes and of a control law is called
a cell. Each cell is run once per random seed. This module parses the axes, laws and seeds,
combines them with the scenario, and checks the result before anything runs.

Invariant:
    - A plan that cannot run is rejected before the first run.
    - Cells are numbered row by row. A cell is computed from the plan and its number, so a large
      grid need not be stored.
    - The value of an axis is the text of an override, as a user would write it.
    - Ranges are counted in decimal numbers: 0.2:3:0.1 contains 0.3, not 0.30000000000000004.
"""

import math
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis import LogMetrics
from trilat_net.errors import ScenarioError, UsageError, count_nouns, suggest_nearest
from trilat_net.fields import split_unit
from trilat_net.own_code import allow_own_code, name_law_classes
from trilat_net.scenario import LAWS, ExperimentText, Scenario, is_number

from ..run_commands import format_command, format_toml_value, set_options
from . import sweep_cell

_ON_GRID = Decimal("1e-9")
"""Largest distance, in steps, at which a value counts as equal to the end of a range."""
_KEYS_WITH_OPTIONS = {
    "seed": "seeds have their own option, as in --seeds 1..20",
    "duration_s": "the duration of a cell depends on its verdict: --duration sets the first "
    "duration, --longest the limit",
}
"""Keys that cannot be swept, each with the option that sets the key instead."""
_MAX_AXIS_VALUES = 10**12
"""Largest number of values of an axis."""
_VALUES_EXAMPLE = "as in KEY=0:1600:50 (from, to, step) or KEY=1,2,5"
"""Example of an axis for error messages."""


class _Steps:
    """Sequence of equally spaced numbers, as texts.

    A text is created only when it is accessed, because a list of all values of a long range
    might not fit into memory.

    Args:
        first: First value.
        step: Difference between neighbouring values.
        count: Number of values.
    """

    def __init__(self, first: Decimal, step: Decimal, count: int) -> None:
        self._first = first
        self._step = step
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> str:
        n = range(self._count)[index]  # range checks the bounds and resolves negative indices
        return f"{self._first + n * self._step:f}"


class _SweepAxis(NamedTuple):
    """One swept scenario key with its values, as in "link.delay_ms=0:400:50".

    Attributes:
        description: The axis as the user wrote it, as "KEY=a:b:step" or "KEY=v1,v2,v3".
        key: Scenario key that the axis varies.
        texts: Values of the axis, as texts that follow "KEY=" in an override.
    """

    description: str
    key: str
    texts: tuple[str, ...] | _Steps

    def value(self, number: int) -> float | str:
        """Returns the value of the swept key at an index, such as 50.0 for a delay.

        Args:
            number: Index of the value, from 0.

        Returns:
            A float if the value is a number. Otherwise its text.
        """
        text = self.texts[number]
        value = _parse_value(text)
        return float(value) if is_number(value) else text

    @property
    def numeric(self) -> bool:
        """True if all values of a swept parameter are numbers, as an axis of a map needs."""
        if isinstance(self.texts, _Steps):
            return True
        return all(is_number(_parse_value(text)) for text in self.texts)

    def override(self, number: int) -> str:
        """Returns the text that sets one value of a swept parameter, as in "link.delay_ms=50".

        Args:
            number: Index of the value, from 0.
        """
        return f"{self.key}={self.texts[number]}"


def parse_axis(description: str) -> _SweepAxis:
    """Parses a swept parameter, as a user writes it, such as "link.delay_ms=0:200:10".

    Args:
        description: Either "KEY=a:b:step", a range that includes b if a whole number of steps
            leads to it; or "KEY=v1,v2,v3", a list of numbers, words or other TOML values.

    Raises:
        ScenarioError: The key or the values are missing, or the values are not valid.
    """
    key, equals, text = (part.strip() for part in str(description).partition("="))
    if not equals or not key:
        raise ScenarioError(
            f"--over must have the form KEY=VALUES, {_VALUES_EXAMPLE}, not {description!r}"
        )
    if key in _KEYS_WITH_OPTIONS:
        raise ScenarioError(f"cannot be an axis: {_KEYS_WITH_OPTIONS[key]}", path=key)

    parts = _split_outside_brackets(text, ":")
    if len(parts) not in (1, 3):
        example = _VALUES_EXAMPLE.removeprefix("as in ")
        raise ScenarioError(
            f"the values must have a form such as {example}, not {text!r}", path=key
        )

    texts: tuple[str, ...] | _Steps
    if len(parts) == 1:
        texts = _parse_list(key, text)
    else:
        first, last, step = (_parse_decimal(key, part) for part in parts)
        texts = _build_range(key, first, last, step)
    return _SweepAxis(f"{key}={text}", key, texts)


def list_axes(over: str | Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Converts swept parameters, as a Python program may give them, to texts KEY=VALUES.

    Args:
        over: One text, a list of texts, or a mapping from keys to values. The values are a
            list, an array, or the text after "KEY=".

    Returns:
        Texts for `parse_axis`.
    """
    if isinstance(over, Mapping):
        return [f"{key}={_join_values(values)}" for key, values in over.items()]
    return list(over) if isinstance(over, list | tuple) else [str(over)]


def _join_values(values: Any) -> str:
    """Returns the values of a swept parameter as the text after "KEY=" in a command.

    Args:
        values: Finished text, a list, an array or a single value. A string that is a word, such
            as in_order, stays without quotation marks.
    """
    if isinstance(values, str):
        return values
    entries = values if isinstance(values, list | tuple) else np.atleast_1d(values)
    texts = list[str]()
    for entry in entries:
        is_word = isinstance(entry, str) and entry.isidentifier()
        texts.append(entry if is_word else format_toml_value(entry))
    return ",".join(texts)


def _build_range(key: str, first: Decimal, last: Decimal, step: Decimal) -> _Steps:
    """Returns the values of a swept parameter that is written as "first:last:step".

    Args:
        key: Scenario key of the axis, for error messages.
        first: First value.
        last: Largest possible value, or the smallest value if the step is negative.
        step: Difference between neighbouring values.

    Raises:
        ScenarioError: The step is 0 or has the wrong sign, or there are too many values.
    """
    if step == 0:
        raise ScenarioError(f"a step of 0 does not lead from {first:f} to {last:f}", path=key)
    has_wrong_sign = (last - first) * step < 0
    if has_wrong_sign:
        suggestion = f"{min(first, last):f}:{max(first, last):f}:{abs(step):f}"
        problem = f"a step of {step:f} does not lead from {first:f} to {last:f}"
        raise ScenarioError(f"is empty: {problem}; did you mean {suggestion}?", path=key)
    count = int((last - first) / step + _ON_GRID) + 1
    if count > _MAX_AXIS_VALUES:
        raise ScenarioError(f"has {Decimal(count):.3g} values: take a larger step", path=key)
    return _Steps(first, step, count)


def _parse_decimal(key: str, text: str) -> Decimal:
    """Returns a number of a range as an exact decimal number.

    Args:
        key: Scenario key of the axis, for error messages.
        text: Text of the number.

    Raises:
        ScenarioError: The text is not a number, or the number is not finite or out of range.
    """
    text = text.strip()
    try:
        number = Decimal(text)
    except InvalidOperation:
        problem = (
            f"a range a:b:step must consist of numbers, and {text!r} is not a number; "
            "list words as in KEY=first,second"
        )
        raise ScenarioError(problem, path=key) from None

    if not number.is_finite():
        raise ScenarioError(f"a range must consist of finite numbers, not {text!r}", path=key)
    size = abs(number)
    if size > Decimal("1e18") or 0 < size < Decimal("1e-18"):
        raise ScenarioError(
            f"the magnitudes in a range must be from 1e-18 to 1e18, not {text}", path=key
        )
    return number


def _parse_list(key: str, text: str) -> tuple[str, ...]:
    """Splits the values of a swept parameter, written as "v1,v2,v3", into separate texts.

    Args:
        key: Scenario key of the axis, for error messages.
        text: Text of the list.

    Raises:
        ScenarioError: A value is empty, is not finite, or appears twice.
    """
    texts = tuple(part.strip() for part in _split_outside_brackets(text, ","))
    if "" in texts:
        raise ScenarioError(f"is empty: list the values, {_VALUES_EXAMPLE}", path=key)
    values = list[Any]()
    for value_text in texts:
        value = _parse_value(value_text)
        if value in values:
            raise ScenarioError(f"has {value_text} twice", path=key)
        if isinstance(value, float) and not math.isfinite(value):
            raise ScenarioError(f"must be finite numbers, not {value_text}", path=key)
        values.append(value)
    return texts


def _split_outside_brackets(text: str, separator: str) -> list[str]:
    """Splits a text at the separators that stand outside of brackets and quotation marks.

    A value of a list may itself be a list or a text that contains the separator.
    """
    parts = [""]
    open_brackets = 0
    open_quote = ""  # the quotation mark that is open; empty outside of quotation marks
    for letter in text:
        if open_quote:
            open_quote = "" if letter == open_quote else open_quote
        elif letter in "\"'":
            open_quote = letter
        if not open_quote:
            open_brackets += (letter in "[{") - (letter in "]}")

        is_separator = letter == separator and not open_brackets and not open_quote
        if is_separator:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parse_value(text: str) -> Any:
    """Returns the value that a text represents: 0.2 for "0.2", True for "true".

    A text that is not valid TOML, such as gamma without quotes, is returned unchanged.
    """
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


MAX_SEEDS = 100_000
"""Largest number of seeds of a sweep."""
MAX_EXTENSION = 8.0
"""Default limit of the duration of an undecided run, as a multiple of the scenario's duration.
"""
MAX_SCENARIO_S = 86_400.0
"""Longest duration that a scenario may have, in s."""
JUDGES = ("verdict", "twins", "linear")
"""Ways to judge a cell. "verdict" classifies the end of its run. "twins" repeats the run with a
small push and measures the growth exponent, the rate at which the disturbance grows. "linear"
computes the characteristic roots of the linear loop, without a run.
"""
_CHECKED_VALUES = 32
"""Largest number of values of an axis that are checked before the first run."""


class SweepCell(NamedTuple):
    """One combination of parameter values and a control law, as a sweep simulates it.

    Attributes:
        number: Number of the cell, counted row by row from 0. The law changes slowest, and the
            value of the last axis changes fastest.
        law: Control law of the cell. Empty if the sweep does not vary the law.
        values: Value of the cell on each axis: a float if it is a number, otherwise a text.
        overrides: Overrides KEY=VALUE that turn the scenario of the sweep into the scenario of
            the cell.
    """

    number: int
    law: str
    values: tuple[float | str, ...]
    overrides: tuple[str, ...]


class SweepPlan(NamedTuple):
    """Everything that determines a sweep: scenario, axes, laws and seeds.

    `plan_sweep` creates this object and checks it. A sweep runs a scenario for every
    combination of the values of its axes and of a control law, called a cell, with one or
    several seeds.

    Attributes:
        written: Scenario as its author wrote it, without overrides and default values.
        overrides: Overrides KEY=VALUE that apply to all cells.
        base: Scenario with `overrides`, with all default values filled in.
        axes: Swept axes. The last one changes fastest from cell to cell.
        laws: For each swept control law, the overrides that select it. The law changes slowest.
            If there are no swept laws, all cells have the laws of the scenario.
        seeds: Seeds with which each cell is run. A cell in which nothing is random is run with
            the first seed only, since all others would give the same run.
        longest_s: Longest duration to which a run is extended while its result is undecided, in
            s.
        judge: Method by which a run is judged, a name of `JUDGES`.
        metrics: Keys of further metrics from `docs/reference/metrics.md` that are measured in
            each run.
        refine: Number of times that the boxes along the stability edge are halved, see
            `edge_refinement`. 0 runs all cells.
    """

    written: ExperimentText
    overrides: tuple[str, ...]
    base: Scenario
    axes: tuple[_SweepAxis, ...]
    laws: dict[str, tuple[str, ...]]
    seeds: tuple[int, ...]
    longest_s: float
    judge: str = "verdict"
    metrics: tuple[str, ...] = ()
    refine: int = 0

    @property
    def default_longest_s(self) -> float:
        """Default of the longest duration to which an undecided run is extended, in s.

        It is the duration of the scenario times `MAX_EXTENSION`, but at most `MAX_SCENARIO_S`.
        If cells are judged by how fast small disturbances grow, runs are never extended, so it
        is the duration of the scenario.
        """
        extension = MAX_EXTENSION if self.judge == "verdict" else 1.0
        return min(MAX_SCENARIO_S, extension * self.base.duration_s)

    @property
    def shape(self) -> tuple[int, ...]:
        """Size of the grid: the number of laws, then the number of values of each axis.

        The number of laws is 1 if the sweep does not vary the law.
        """
        return (max(1, len(self.laws)), *(len(axis.texts) for axis in self.axes))

    @property
    def cells(self) -> int:
        """Number of combinations of all swept parameter values and control laws."""
        return math.prod(self.shape)

    def cell(self, number: int) -> SweepCell:
        """Returns a combination of parameter values and control law by its number.

        Args:
            number: Number of the combination, from 0, counted row by row in the grid of the
                sweep.

        Raises:
            UsageError: The grid has no combination with this number.
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
        """Loads the scenario of the sweep with further settings, such as a swept delay.

        Args:
            more: Further overrides KEY=VALUE.

        Raises:
            ScenarioError: The scenario is not valid with these overrides.
        """
        return self.written.load([*self.overrides, *more])

    def facts(self) -> dict[str, Any]:
        """Returns the plan of a parameter sweep as plain values, which a JSON file stores.

        `from_facts` restores the plan from them. The keys "judge" (how runs are judged),
        "metrics" (which further quantities are measured) and "refine" (how often the edge of
        stability is refined) are left out if they have their defaults, so that plans of older
        versions give the same file.
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

        The scenario is parsed from its stored text. Files that the scenario names are read
        again.

        Args:
            facts: The plain values, as read from the JSON file.

        Raises:
            ScenarioError: The plan cannot run on this machine.
        """
        folder = None if facts["folder"] is None else Path(facts["folder"])

        written = ExperimentText(facts["source"], facts["text"], folder)
        texts = tuple(facts["overrides"])
        axes = tuple(map(parse_axis, facts["over"]))
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
        """Returns the shell command that repeats a sweep. Default options are left out.

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
    """Plans a sweep, which runs a scenario with many parameters, and checks that it can run.

    Each law in `laws` is used at all sites, the processes that run one arm each. If all sites
    use the law in the scenario already, it keeps the gains of the scenario. Otherwise it gets
    its default gains. Overrides of gains apply in both cases.

    The arguments are explained in `trilat_net.sweep`. Overrides are texts KEY=VALUE.

    Returns:
        The checked plan.

    Raises:
        ScenarioError: The scenario, an axis or a value of an axis is not valid or cannot run.
        UsageError: Another argument is not valid.
    """
    written = ExperimentText.read(source)
    texts = tuple(overrides)
    axes = tuple(map(parse_axis, list_axes(over)))
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
"""Largest number of cells of a grid that is refined. Each cell takes 4 bytes."""
_REFINED_AXES = 2
"""Largest number of axes that are refined: a map has two axes."""


def list_refined_axes(axes: Sequence[_SweepAxis]) -> list[int]:
    """Returns the indices of the axes that are refined where the results of neighbours differ.

    These are the first two axes whose values are numbers.

    Args:
        axes: All axes of the sweep.
    """
    numeric = [n for n, axis in enumerate(axes) if axis.numeric and len(axis.texts) > 1]
    return numeric[:_REFINED_AXES]


def _check_refinement(plan: SweepPlan) -> None:
    """Checks that a sweep can be refined as often as its plan states.

    Raises:
        UsageError: The number is out of range, no axis can be refined, or the grid is too
            large.
    """
    if not 0 <= plan.refine <= MOST_HALVINGS:
        raise UsageError(f"--refine must be from 0 to {MOST_HALVINGS}, not {plan.refine}")
    if plan.refine and not list_refined_axes(plan.axes):
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
        seeds: The seeds, or their number. A number n means n consecutive seeds that start with
            the seed of the scenario.
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
        forced: True if the scenario is valid only under a swept law. In this case `scenario`
            has the first of the swept laws.
    """

    scenario: Scenario
    forced: bool


def _load_base(
    written: ExperimentText,
    overrides: Sequence[str],
    axes: Sequence[_SweepAxis],
    laws: Sequence[str],
) -> _Base:
    """Loads the scenario of a sweep before its axes and laws are applied.

    The scenario may not be valid by itself. For example, a link may need the delay that an axis
    sets, or an override may set a gain that only a swept law has. Therefore the scenario is
    tried alone, then with the first value of each axis, then with the first law, and then with
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
    """Rejects the name of a law that does not exist.

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
    """Returns the settings that give the same control law to every arm.

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
        The overrides. Empty if all sites already have the law, so that they keep its gains.
    """
    sites = base.scenario.sites.values()
    if not base.forced and all(spec.law_name == law for spec in sites):
        return ()
    return _force_law(written, overrides, law)


def _check_axes(plan: SweepPlan, law_index: int) -> None:
    """Checks that the parameter combinations of a sweep can be simulated with one control law.

    Checking all combinations (cells) of a large grid would take too long. The corners of the
    grid are checked, and up to `_CHECKED_VALUES` evenly spread values of each axis, with the
    other axes at their first values. A single combination may be invalid: the sweep then
    rejects only this cell.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        law_index: Index of the law.

    Raises:
        ScenarioError: A value can run neither with the first nor with the last values of the
            other axes, no corner can run, or two values of an axis give the same scenario.
    """
    first_cell = [law_index] + [0] * len(plan.axes)
    last_cell = [law_index, *(len(axis.texts) - 1 for axis in plan.axes)]
    for dimension, axis in enumerate(plan.axes, 1):
        value_of_digest: dict[str, str] = {}
        for index in spread_indices(len(axis.texts)):
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
    """Returns True if a parameter combination (cell) of a sweep is a valid scenario.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        indices: Index of the law and of the value on each axis.
    """
    try:
        _load_cell(plan, indices)
    except ScenarioError:
        return False
    return True


def spread_indices(count: int) -> list[int]:
    """Returns the indices of the values of an axis that are checked before a sweep runs.

    At most `_CHECKED_VALUES` indices, including the first and the last one, are spread evenly
    over `count` values. A grid may be too large to check every cell.

    Args:
        count: Number of values.
    """
    checked = min(count, _CHECKED_VALUES)
    intervals = max(1, checked - 1)
    return [index * (count - 1) // intervals for index in range(checked)]


def _load_cell(plan: SweepPlan, indices: Sequence[int]) -> Scenario:
    """Loads the scenario of one combination of swept parameters.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        indices: Index of the law and of the value on each axis.

    Raises:
        ScenarioError: The scenario is not valid or cannot run on this machine. The message
            names the law if laws are swept.
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


_GAINS = {
    "K": "N m/rad",
    "d": "N m s/rad",
    "Kp": "N m s/rad",
    "Kd": "N m s/rad",
    "Lambda": "1/s",
}
"""Units of the gains, whose keys do not end in a unit."""


def label_axis(key: str, scenario: Scenario | None = None) -> str:
    """Returns the label of an axis in a figure, such as "delay (ms)" for link.delay_ms.

    If links draw their delays at random, the delay is called stated, because the age of the
    samples in use is smaller: a newer sample may overtake an older one.

    Args:
        key: Scenario key of the axis.
        scenario: Scenario in which the names of operators and walls are looked up.
    """
    quantity, unit = _describe_key(key, scenario)
    if scenario is not None and key.startswith("link") and key.endswith("delay_ms"):
        _, *names, _ = key.split(".")
        links = [scenario.links[name] for name in names or scenario.links]
        if any(link.random and link.moments().deviation_ms > 0.0 for link in links):
            quantity = f"stated {quantity}"
    return f"{quantity} ({unit})" if unit else quantity


def label_setting(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a setting as a label with unit, such as "delay 200 ms" for link.delay_ms = 200.

    Args:
        key: Scenario key.
        value: Value of the key.
        scenario: Scenario in which the names of operators and walls are looked up.
    """
    quantity, unit = _describe_key(key, scenario)
    if isinstance(value, bool):
        text = str(value).lower()
    elif is_number(value):
        text = f"{value:g}"
    else:
        text = str(value).replace("_", " ")
    return " ".join(part for part in (quantity, text, unit) if part)


def _describe_key(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Splits the name of a setting, such as delay_ms, into a name and a unit for labels.

    Args:
        key: Scenario key, such as "sites.s.control.K" or "link.delay_ms".
        scenario: Scenario in which the names of operators and walls are looked up.

    Returns:
        The name in words, such as "K of s", and the unit, which is empty if the setting has no
        unit.
    """
    *tables, name = key.split(".")
    subscript = ""
    if name.isdigit() and tables:  # an element of a list over joints or parameters
        subscript = f"[{name}]"
        name = tables.pop()
    quantity, unit = split_unit(name)
    is_symbol = not unit and len(name) <= 3
    if is_symbol:
        quantity = name  # symbols such as Kp keep their capital letters
    owner = _describe_owner(tables, scenario)
    return f"{quantity}{subscript}{owner}", _GAINS.get(name) or unit.replace("^2", "²")


def _describe_owner(tables: list[str], scenario: Scenario | None) -> str:
    """Returns the phrase of a label that names the site, link or actor of a setting.

    Args:
        tables: Names of the tables that contain the key, from the outermost table.
        scenario: Scenario in which the kind of an operator or a wall is looked up.

    Returns:
        A string such as " of s". Empty if the key applies to all sites or links.
    """
    match tables:
        case ["sites", site, ("hands" | "environment") as group, number]:
            kind = "hand" if group == "hands" else "environment"
            if scenario is not None and site in scenario.sites and number.isdigit():
                actors = getattr(scenario.sites[site], group)
                if int(number) < len(actors):
                    tag = actors[int(number)].__struct_config__.tag
                    kind = str(tag).replace("_", " ")
            return f", {kind} of {site}"
        case ["sites", site, *_]:
            return f" of {site}"
        case ["links", link, *_]:
            return f" {link}"
        case ["dominance", site]:
            return f"'s share in {site}"
        case _:
            return ""


def format_override(key: str, value: Any) -> str:
    """Returns the text KEY=VALUE that changes one setting of a scenario.

    Args:
        key: Scenario key.
        value: A number, which parses back to exactly this number, or a text.
    """
    text = format_override_value(value) if is_number(value) else value
    return f"{key}={text}"


def format_override_value(value: float) -> str:
    """Returns the text of a number that parses back to exactly this number.

    Whole numbers have no decimal point.

    Args:
        value: The number.
    """
    return repr(value).removesuffix(".0")

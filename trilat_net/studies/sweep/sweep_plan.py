"""Plans a sweep: a grid of runs of one scenario over axes, control laws and seeds.

The axes, laws and seeds are parsed, combined with the scenario, and checked.

Invariant:
    - A plan that cannot run is refused before the first run.
    - Cells are numbered row by row; a cell is a function of the plan and its number.
    - The value of an axis is the text of an override.
    - Steps are counted in decimals: 0.2:3:0.1 contains 0.3, not 0.30000000000000004.
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

from ...analysis.metrics.log_metrics import find_quantity
from ...errors import ScenarioError, UsageError, count_nouns
from ...fields import is_number, split_unit, suggest_nearest
from ...scenario import Scenario, apply_overrides
from ...scenario.code_consent import allow_own_code
from ...scenario.imported_code import name_law_classes
from ...scenario.laws import LAWS, identify_law
from ...scenario.scenario_reader import ExperimentText, read_experiment
from ..study_folder import format_command, format_toml_value, set_options
from . import sweep_cell

_ON_GRID = Decimal("1e-9")
"""Largest distance from the grid, in steps, at which the end of a range is included."""
_KEYS_WITH_OPTIONS = {
    "seed": "seeds have their own option, as in --seeds 1..20",
    "duration_s": "the duration of a cell depends on its verdict: --duration sets the first "
    "one, --longest the limit",
}
"""Keys that cannot be swept, each with the option that sets the key instead."""
_MAX_AXIS_VALUES = 10**12
_VALUES_EXAMPLE = "as in KEY=0:1600:50 (from, to, step) or KEY=1,2,5"


class _Steps:
    """Sequence of the values `first` + n `step` as texts, each formatted on access."""

    def __init__(self, first: Decimal, step: Decimal, count: int) -> None:
        self._first = first
        self._step = step
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> str:
        n = range(self._count)[index]  # range checks the bounds and resolves negative indices
        return f"{self._first + n * self._step:f}"


class SweepAxis(NamedTuple):
    """One axis of a sweep.

    Attributes:
        description: the axis as a text: "KEY=a:b:step" or "KEY=v1,v2,v3".
        key: the scenario key that the axis varies.
        texts: the values of the axis, as texts of overrides.
    """

    description: str
    key: str
    texts: tuple[str, ...] | _Steps

    def value(self, number: int) -> float | str:
        """Returns value `number` of the axis: a float if it is a number, else its text."""
        text = self.texts[number]
        value = _parse_value(text)
        return float(value) if is_number(value) else text

    @property
    def numeric(self) -> bool:
        """True if all values of the axis are numbers."""
        if isinstance(self.texts, _Steps):
            return True
        return all(is_number(_parse_value(text)) for text in self.texts)

    def override(self, number: int) -> str:
        """Returns the override that sets value `number` of the axis."""
        return f"{self.key}={self.texts[number]}"


def parse_axis(description: str) -> SweepAxis:
    """Returns the axis that a text describes.

    Args:
        description: "KEY=a:b:step", where b is included if it lies on the grid, or
            "KEY=v1,v2,v3" with numbers, words or other TOML values.

    Raises:
        ScenarioError: the text has no key or no values, or its values form no grid.
    """
    key, equals, text = (part.strip() for part in str(description).partition("="))
    if not equals or not key:
        raise ScenarioError(f"--over reads KEY=VALUES, {_VALUES_EXAMPLE}, not {description!r}")
    if key in _KEYS_WITH_OPTIONS:
        raise ScenarioError(f"is no axis: {_KEYS_WITH_OPTIONS[key]}", path=key)
    parts = _split_outside_brackets(text, ":")
    if len(parts) not in (1, 3):
        example = _VALUES_EXAMPLE.removeprefix("as in ")
        raise ScenarioError(f"values read {example}, not {text!r}", path=key)
    texts: tuple[str, ...] | _Steps
    if len(parts) == 1:
        texts = _parse_list(key, text)
    else:
        first, last, step = (_parse_decimal(key, part) for part in parts)
        texts = _build_range(key, first, last, step)
    return SweepAxis(f"{key}={text}", key, texts)


def list_axes(over: str | Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Returns the descriptions of the axes, as texts for `parse_axis`.

    Args:
        over: one description, a list of descriptions, or a mapping from keys to values: a list,
            an array, or the text after "KEY=".
    """
    if isinstance(over, Mapping):
        return [f"{key}={_join_values(values)}" for key, values in over.items()]
    return list(over) if isinstance(over, list | tuple) else [str(over)]


def _join_values(values: Any) -> str:
    if isinstance(values, str):
        return values
    entries = values if isinstance(values, list | tuple) else np.atleast_1d(values)
    texts = list[str]()
    for entry in entries:
        is_word = isinstance(entry, str) and entry.isidentifier()
        texts.append(entry if is_word else format_toml_value(entry))
    return ",".join(texts)


def _build_range(key: str, first: Decimal, last: Decimal, step: Decimal) -> _Steps:
    if step == 0:
        raise ScenarioError(f"a step of 0 does not lead from {first:f} to {last:f}", path=key)
    if (last - first) * step < 0:
        right = f"{min(first, last):f}:{max(first, last):f}:{abs(step):f}"
        problem = f"a step of {step:f} does not lead from {first:f} to {last:f}"
        raise ScenarioError(f"is empty: {problem}; did you mean {right}?", path=key)
    count = int((last - first) / step + _ON_GRID) + 1
    if count > _MAX_AXIS_VALUES:
        raise ScenarioError(f"has {Decimal(count):.3g} values: take a larger step", path=key)
    return _Steps(first, step, count)


def _parse_decimal(key: str, text: str) -> Decimal:
    text = text.strip()
    try:
        number = Decimal(text)
    except InvalidOperation:
        problem = (
            f"a range is of numbers, a:b:step, and {text!r} is not a number; "
            "list words as in KEY=first,second"
        )
        raise ScenarioError(problem, path=key) from None
    if not number.is_finite():
        raise ScenarioError(f"a range is of finite numbers, not {text!r}", path=key)
    size = abs(number)
    if size > Decimal("1e18") or 0 < size < Decimal("1e-18"):
        raise ScenarioError(f"a range is of sizes from 1e-18 to 1e18, not {text}", path=key)
    return number


def _parse_list(key: str, text: str) -> tuple[str, ...]:
    """Returns the values of a list "v1,v2,v3" as texts.

    Raises:
        ScenarioError: a value is empty, not finite, or appears twice.
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


def _split_outside_brackets(text: str, mark: str) -> list[str]:
    """Returns the parts of a text between the marks that stand outside brackets and quotes."""
    parts = [""]
    depth = 0
    quote = ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        depth += (letter in "[{") - (letter in "]}") if not quote else 0
        if letter == mark and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parse_value(text: str) -> Any:
    """Returns the TOML value of a text, or the text itself if it is not valid TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


MAX_SEEDS = 100_000
MAX_EXTENSION = 8.0
"""Default limit of an undecided cell's duration, in durations of the scenario."""
MAX_SCENARIO_S = 86_400.0
"""Longest duration that a scenario may have, in s."""
JUDGES = ("verdict", "twins")
"""Quantities that can colour a map: the cells' classes, or the growth exponents of twins."""
_CHECKED_VALUES = 32
"""Largest number of values of an axis that are checked before the first run."""


class SweepCell(NamedTuple):
    """One point of a sweep's grid.

    Attributes:
        number: the number of the cell, row by row from 0; laws change slowest, the last axis
            fastest.
        law: the swept law of the cell, or "" if the sweep has no laws.
        values: the cell's value on each axis: a float if the value is a number, else a text.
        overrides: the overrides, as texts KEY=VALUE, that turn the experiment into the cell.
    """

    number: int
    law: str
    values: tuple[float | str, ...]
    overrides: tuple[str, ...]


class SweepPlan(NamedTuple):
    """A sweep, checked and ready to run.

    Attributes:
        written: the experiment as its author wrote it.
        overrides: the overrides of all cells, as texts KEY=VALUE.
        base: the experiment with `overrides`, resolved.
        axes: the swept axes; the last changes fastest.
        laws: the overrides that select each swept law, by the name of the law; laws change
            slowest. If empty, all cells keep the experiment's laws.
        seeds: the seeds of a cell that draws random numbers; other cells run with the first
            seed only.
        longest_s: longest duration to which an undecided cell is extended, in s.
        judge: a name of `JUDGES`.
        metrics: keys of `docs/metrics.md` that are measured in each run in addition.
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

    @property
    def default_longest_s(self) -> float:
        """Default of `longest_s`, in s: growth exponents need no extension."""
        extension = 1.0 if self.judge == "twins" else MAX_EXTENSION
        return min(MAX_SCENARIO_S, extension * self.base.duration_s)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of laws (1 if no laws are swept), then the number of values of each axis."""
        return (max(1, len(self.laws)), *(len(axis.texts) for axis in self.axes))

    @property
    def cells(self) -> int:
        """Number of cells of the grid."""
        return math.prod(self.shape)

    def cell(self, number: int) -> SweepCell:
        """Returns the cell with a number.

        Raises:
            UsageError: the grid has no cell with this number.
        """
        if not 0 <= number < self.cells:
            raise UsageError(
                f"there is no cell {number}: cells are numbered from 0 to {self.cells - 1}"
            )
        rest = number
        indices = list[int]()
        for count in reversed(self.shape):
            rest, index = divmod(rest, count)
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
        """Returns the experiment with further overrides.

        Args:
            more: the further overrides, as texts KEY=VALUE.

        Raises:
            ScenarioError: the experiment is not valid with these overrides.
        """
        return self.written.load([*self.overrides, *more])

    def facts(self) -> dict[str, Any]:
        """Returns the plan as plain JSON values, which `plan_from_json` reads."""
        return {
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
            **({} if self.judge == "verdict" else {"judge": self.judge}),
            **({"metrics": list(self.metrics)} if self.metrics else {}),
        }


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
) -> SweepPlan:
    """Returns the plan of a sweep, checked and ready to run.

    A swept law that all sites already have keeps the gains of the scenario. Any other swept law
    replaces the law of every site and has its default gains. Overrides of gains apply to both.

    The arguments are those of `trilat_net.sweep`; overrides are texts KEY=VALUE.

    Raises:
        ScenarioError: the scenario, an axis or a value of an axis is not valid or cannot run.
        UsageError: another argument is not valid.
    """
    written = read_experiment(source)
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
    law_overrides = {law: _law_overrides(written, texts, loaded, law) for law in law_names}
    if judge not in JUDGES:
        raise UsageError(f"--judge is one of {', '.join(JUDGES)}, not {judge!r}")
    plan = SweepPlan(
        written=written,
        overrides=texts,
        base=base,
        axes=axes,
        laws=law_overrides,
        seeds=_resolve_seeds(seeds, base.seed),
        longest_s=0.0,  # set below: the default depends on the plan
        judge=judge,
        metrics=_list_metrics(metrics),
    )
    if longest_s is None:
        longest_s = plan.default_longest_s
    elif not base.duration_s <= longest_s <= MAX_SCENARIO_S:
        raise UsageError(
            "--longest is the longest duration of an undecided cell, from "
            f"{base.duration_s:g} s to {MAX_SCENARIO_S:g} s, not {longest_s:g}"
        )
    plan = plan._replace(longest_s=longest_s)
    for law_index in range(plan.shape[0]):
        _check_axes(plan, law_index)
    return plan


def plan_from_json(facts: dict[str, Any]) -> SweepPlan:
    """Returns the plan that `SweepPlan.facts` stored as JSON values.

    The scenario is parsed from its stored text; files that the scenario names are read again.

    Raises:
        ScenarioError: the plan cannot run here.
    """
    folder = None if facts["folder"] is None else Path(facts["folder"])
    written = ExperimentText(facts["source"], facts["text"], folder)
    texts = tuple(facts["overrides"])
    axes = tuple(map(parse_axis, facts["over"]))
    loaded = _load_base(written, texts, axes, facts["laws"])
    base = allow_own_code(loaded.scenario)
    laws = {law: _law_overrides(written, texts, loaded, law) for law in facts["laws"]}
    return SweepPlan(
        written=written,
        overrides=texts,
        base=base,
        axes=axes,
        laws=laws,
        seeds=tuple(facts["seeds"]),
        longest_s=facts["longest_s"],
        judge=facts.get("judge", "verdict"),
        metrics=tuple(facts.get("metrics", ())),
    )


def _list_metrics(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the keys of the requested metrics, without duplicates.

    Raises:
        UsageError: a metric does not exist.
    """
    keys = [names] if isinstance(names, str) else names
    try:
        return tuple(dict.fromkeys(find_quantity(key).key for key in keys))
    except KeyError as error:
        raise UsageError(f"--metric: {error.args[0]}") from None


def _resolve_seeds(seeds: int | Sequence[int], scenario_seed: int) -> tuple[int, ...]:
    """Returns the seeds of a sweep, without duplicates.

    Args:
        seeds: the seeds, or their number: then they count up from the scenario's seed.
        scenario_seed: the scenario's seed; the only seed of the sweep if `seeds` is empty.

    Raises:
        UsageError: a seed or the number of seeds is out of range.
    """
    if isinstance(seeds, int | str):
        if isinstance(seeds, str) or not 1 <= seeds <= MAX_SEEDS:
            raise UsageError(
                f"--seeds is a number from 1 to {MAX_SEEDS}, or a list as in 1..20; not {seeds}"
            )
        seeds = range(scenario_seed, scenario_seed + seeds)
    if len(seeds) > MAX_SEEDS:
        raise UsageError(
            f"--seeds has {count_nouns(len(seeds), 'seed')}, more than {MAX_SEEDS}"
        )
    for seed in seeds:
        if not 0 <= seed < 2**63:
            raise UsageError(f"a seed is from 0 to 2^63 - 1, not {seed}")
    return tuple(dict.fromkeys(seeds)) or (scenario_seed,)


class _Base(NamedTuple):
    """The experiment without its swept axes and laws, as far as it is valid without them.

    Attributes:
        scenario: the experiment.
        forced: True if the experiment is valid only under a swept law; the scenario then has
            the first of the swept laws.
    """

    scenario: Scenario
    forced: bool


def _load_base(
    written: ExperimentText,
    overrides: Sequence[str],
    axes: Sequence[SweepAxis],
    laws: Sequence[str],
) -> _Base:
    """Returns the experiment without its swept axes and laws.

    Overrides may need a swept axis or law: a link of another model needs the delay that an axis
    sets, and a gain may belong to a swept law. In this case the experiment takes the first
    value of each axis, and the first law.

    Raises:
        ScenarioError: the experiment is not valid even with the first values and law.
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
        # An experiment that is not valid as written is refused with that error: it says more
        # than an error of the sweep's overrides.
        written.load()
    assert problem is not None
    raise problem


def _check_law_name(law: str) -> None:
    """Refuses a law that does not exist.

    Raises:
        UsageError: the name is neither a built-in law nor a class, as in mylaws:Law.
    """
    built_in = [name for name in LAWS if name != "own"]
    if law not in built_in and ":" not in law:
        hint = suggest_nearest(law, built_in)
        if not hint:
            hint = f"; laws are {', '.join(built_in)}, and your own, as in mylaws:Law"
        raise UsageError(f"--law: there is no law {law!r}{hint}")


def _force_law(written: ExperimentText, overrides: Sequence[str], law: str) -> tuple[str, ...]:
    """Returns the overrides that give a law to every site."""
    tables = tomllib.loads(written.text)
    apply_overrides(tables, overrides)
    law_overrides = [f"control.law={law}"]
    for name, site in tables.get("sites", {}).items():
        if "control" in site:  # the site's table would win over the common one
            law_overrides.append(f"sites.{name}.control.law={law}")
    return tuple(law_overrides)


def _law_overrides(
    written: ExperimentText, overrides: Sequence[str], base: _Base, law: str
) -> tuple[str, ...]:
    """Returns the overrides that select a swept law; empty if all sites already have it."""
    sites = base.scenario.sites.values()
    if not base.forced and all(identify_law(spec.control) == law for spec in sites):
        return ()
    return _force_law(written, overrides, law)


def _check_axes(plan: SweepPlan, law_index: int) -> None:
    """Refuses a plan if a sample of its cells under one law cannot run.

    The sample has up to `_CHECKED_VALUES` evenly spread values of each axis, the other axes at
    their first values, and the corners of the grid.

    Raises:
        ScenarioError: a cell cannot run, or two values of an axis give the same scenario.
    """
    origin = [law_index] + [0] * len(plan.axes)
    for dimension, axis in enumerate(plan.axes, 1):
        value_of_digest: dict[str, str] = {}
        for index in _spread_indices(len(axis.texts)):
            indices = origin.copy()
            indices[dimension] = index
            digest = _load_cell(plan, indices).sha256
            text = axis.texts[index]
            if digest in value_of_digest:
                raise ScenarioError(
                    f"{value_of_digest[digest]} and {text} are the same experiment: "
                    "no site or link uses this key; each may have its own value, as in "
                    "sites.NAME.control or links.A->B",
                    path=axis.key,
                    source=plan.written.label,
                )
            value_of_digest[digest] = text
    axis_ends = [sorted({0, len(axis.texts) - 1}) for axis in plan.axes]
    for corner in product([law_index], *axis_ends):
        _load_cell(plan, corner)


def _spread_indices(count: int) -> list[int]:
    """Returns indices of `count` values: the first, the last, and some between them."""
    checked = min(count, _CHECKED_VALUES)
    intervals = max(1, checked - 1)
    return [k * (count - 1) // intervals for k in range(checked)]


def _load_cell(plan: SweepPlan, indices: Sequence[int]) -> Scenario:
    """Returns the scenario of the cell with these indices of the law and of each axis.

    Raises:
        ScenarioError: the scenario is not valid or cannot run here; the message names the law
            if laws are swept.
    """
    number = 0
    for count, index in zip(plan.shape, indices, strict=True):
        number = number * count + index
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
    """Returns the label of an axis, as "delay (ms)" for link.delay_ms."""
    quantity, unit = describe_key(key, scenario)
    return f"{quantity} ({unit})" if unit else quantity


def label_setting(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a key with its value, as "delay 200 ms" for link.delay_ms = 200."""
    quantity, unit = describe_key(key, scenario)
    if isinstance(value, bool):
        text = str(value).lower()
    elif is_number(value):
        text = f"{value:g}"
    else:
        text = str(value).replace("_", " ")
    return " ".join(part for part in (quantity, text, unit) if part)


def describe_key(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Returns the name of a key's quantity, in words, and its unit, or "" without a unit."""
    *folders, last = key.split(".")
    number = ""
    if last.isdigit() and folders:  # an element of a list over joints or parameters
        number = f"[{last}]"
        last = folders.pop()
    quantity, unit = split_unit(last)
    if not unit and len(last) <= 3:  # a symbol
        quantity = last
    owner = _describe_owner(folders, scenario)
    return f"{quantity}{number}{owner}", _GAINS.get(last) or unit.replace("^2", "²")


def _describe_owner(folders: list[str], scenario: Scenario | None) -> str:
    """Returns the site, link or actor of a key, in words, or "" for a common key."""
    match folders:
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


def build_sweep_command(plan: SweepPlan, *more: str) -> str:
    """Returns the command that runs a sweep.

    Args:
        plan: the sweep.
        more: further arguments of the command.
    """
    arguments = set_options(plan.overrides)
    for axis in plan.axes:
        arguments += ["--over", axis.description]
    scenario_seed = plan.base.seed
    count = len(plan.seeds)
    if plan.seeds != tuple(range(scenario_seed, scenario_seed + count)):
        seeds = ",".join(map(str, plan.seeds))
        # a lone seed needs a comma: a number alone is a number of seeds
        arguments += ["--seeds", f"{seeds}," if count == 1 else seeds]
    elif count > 1:
        arguments += ["--seeds", str(count)]
    if plan.laws:
        arguments += ["--law", ",".join(plan.laws)]
    if plan.judge != "verdict":
        arguments += ["--judge", plan.judge]
    for key in plan.metrics:
        arguments += ["--metric", key]
    if plan.longest_s != plan.default_longest_s:
        arguments += ["--longest", format_override_value(plan.longest_s)]
    return format_command("sweep", plan.written.label, *arguments, *more)


def format_override(key: str, value: Any) -> str:
    """Returns the override that sets a key; whole numbers without a decimal point."""
    text = format_override_value(value) if is_number(value) else value
    return f"{key}={text}"


def format_override_value(value: float) -> str:
    """Returns the text of a number that parses back to exactly this number.

    Whole numbers have no decimal point.
    """
    return repr(value).removesuffix(".0")

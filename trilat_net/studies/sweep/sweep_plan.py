"""The plan of a sweep: the scenario, the axes with their values, the control laws and the
seeds.

Invariant: a plan that cannot run is refused before the first run. Cells are numbered row by
row, and a cell is a function of the plan and its number. An axis value is the text of an
override; steps are counted in decimals, so 0.2:3:0.1 contains 0.3 and not 0.30000000000000004.
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
"""An end that is no further than this from the grid, in steps, lies on it."""
_ELSEWHERE = {
    "seed": "seeds have an option of their own, as in --seeds 1..20",
    "duration_s": "how long a cell runs follows from its verdict: --duration says how long at first, "
    "--longest how long at most",
}
_MOST = 10**12
_HOW = "as in KEY=0:1600:50 (from, to, step) or KEY=1,2,5"


class _Steps:
    """The values a, a + step, ... as texts, made as they are asked for."""

    def __init__(self, first: Decimal, step: Decimal, count: int) -> None:
        self._first = first
        self._step = step
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, place: int) -> str:
        n = range(self._count)[place]
        return f"{self._first + n * self._step:f}"


class SweepAxis(NamedTuple):
    """One axis, asked for as "KEY=a:b:step" or "KEY=v1,v2,v3"; its values are texts of
    overrides.
    """

    asked: str
    key: str
    texts: tuple[str, ...] | _Steps

    def value(self, number: int) -> float | str:
        """Returns one value: a number where it is one, else its text."""
        value = _read(self.texts[number])
        return float(value) if is_number(value) else self.texts[number]

    @property
    def numeric(self) -> bool:
        """True where every value is a number."""
        return isinstance(self.texts, _Steps) or all(map(is_number, map(_read, self.texts)))

    def override(self, number: int) -> str:
        """Returns the override that sets one value."""
        return f"{self.key}={self.texts[number]}"


def parse_axis(asked: str) -> SweepAxis:
    """Returns the axis that a text describes.

    Args:
        asked: "KEY=a:b:step", with b where it lies on the grid, or "KEY=v1,v2,v3" with numbers,
            words or other TOML values.

    Raises:
        ScenarioError: it has no key, no values, or values that make no grid.
    """
    key, equals, text = (part.strip() for part in str(asked).partition("="))
    if not equals or not key:
        raise ScenarioError(f"--over reads KEY=VALUES, {_HOW}, not {asked!r}")
    if key in _ELSEWHERE:
        raise ScenarioError(f"is no axis: {_ELSEWHERE[key]}", path=key)
    parts = _split(text, ":")
    if len(parts) not in (1, 3):
        raise ScenarioError(
            f"values read {_HOW.removeprefix('as in ')}, not {text!r}", path=key
        )
    texts = (
        _listed(key, text)
        if len(parts) == 1
        else _steps(key, *(_decimal(key, part) for part in parts))
    )
    return SweepAxis(f"{key}={text}", key, texts)


def list_axes(over: str | Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Returns axes as texts, as of `parse_axis`; by their keys they may be lists or arrays of
    values.
    """
    if isinstance(over, Mapping):
        return [f"{key}={_join_values(values)}" for key, values in over.items()]
    return list(over) if isinstance(over, list | tuple) else [str(over)]


def _join_values(values: Any) -> str:
    if isinstance(values, str):
        return values
    entries = values if isinstance(values, list | tuple) else np.atleast_1d(values)
    is_word = (isinstance(one, str) and one.isidentifier() for one in entries)
    return ",".join(
        one if word else format_toml_value(one)
        for one, word in zip(entries, is_word, strict=True)
    )


def _steps(key: str, first: Decimal, last: Decimal, step: Decimal) -> _Steps:
    if step == 0:
        raise ScenarioError(f"a step of 0 never comes from {first:f} to {last:f}", path=key)
    if (last - first) * step < 0:
        right = f"{min(first, last):f}:{max(first, last):f}:{abs(step):f}"
        problem = f"a step of {step:f} does not lead from {first:f} to {last:f}"
        raise ScenarioError(f"is empty: {problem}; did you mean {right}?", path=key)
    count = int((last - first) / step + _ON_GRID) + 1
    if count > _MOST:
        raise ScenarioError(f"has {Decimal(count):.3g} values: take a larger step", path=key)
    return _Steps(first, step, count)


def _decimal(key: str, text: str) -> Decimal:
    text = text.strip()
    try:
        number = Decimal(text)
    except InvalidOperation:
        problem = f"a range is of numbers, a:b:step, and {text!r} is none; words go as in KEY=first,second"
        raise ScenarioError(problem, path=key) from None
    if not number.is_finite():
        raise ScenarioError(f"a range is of finite numbers, and {text!r} is none", path=key)
    if abs(number) > Decimal("1e18") or (number and abs(number) < Decimal("1e-18")):
        raise ScenarioError(
            f"{text} is beyond what a range is for: from 1e-18 to 1e18", path=key
        )
    return number


def _listed(key: str, text: str) -> tuple[str, ...]:
    texts = tuple(part.strip() for part in _split(text, ","))
    if "" in texts:
        raise ScenarioError(f"is empty: say which values, {_HOW}", path=key)
    values = list(map(_read, texts))
    for n, (one, value) in enumerate(zip(texts, values, strict=True)):
        if value in values[:n]:
            raise ScenarioError(f"has {one} twice", path=key)
        if isinstance(value, float) and not math.isfinite(value):
            raise ScenarioError(f"must be finite numbers, one is {one}", path=key)
    return texts


def _split(text: str, mark: str) -> list[str]:
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


def _read(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


MAX_SEEDS = 100_000
MAX_EXTENSION = 8.0
"""Default limit of an undecided cell's duration, in durations of the scenario."""
MAX_SCENARIO_S = 86_400.0
"""No scenario is longer, s."""
JUDGES = ("verdict", "twins")
"""What colours a map: the classes of the cells, or the growth exponents of their twins."""
_CHECKED_VALUES = 32
"""Values of an axis that are tried before anything runs."""


class SweepCell(NamedTuple):
    """One place of a sweep.

    Attributes:
        number: row by row, from 0: laws change slowest, the last axis fastest.
        law: which of the swept laws, or "".
        values: along every axis, numbers as numbers.
        overrides: what makes it of the experiment, as texts KEY=VALUE.
    """

    number: int
    law: str
    values: tuple[float | str, ...]
    overrides: tuple[str, ...]


class SweepPlan(NamedTuple):
    """A sweep.

    Attributes:
        written: the experiment, as its author wrote it.
        overrides: what is changed of it everywhere, as texts KEY=VALUE.
        base: the same, resolved.
        axes: what is swept; the last changes fastest.
        laws: what puts each law into force; swept around the axes, slowest; none: the
            experiment's own.
        seeds: of the runs of a cell in which anything is random; in others the first alone is
            run.
        longest_s: how long a cell may be extended, s.
        judge: of `JUDGES`.
        metrics: keys of `docs/metrics.md` that are measured of every run besides.
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
        """How long a cell may be extended unless asked for, s: an exponent needs no extension."""
        return min(
            MAX_SCENARIO_S,
            (1.0 if self.judge == "twins" else MAX_EXTENSION) * self.base.duration_s,
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """How many laws (1 where none is swept), and how many values along every axis."""
        return (max(1, len(self.laws)), *(len(one.texts) for one in self.axes))

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return math.prod(self.shape)

    def cell(self, number: int) -> SweepCell:
        """Returns a cell by its number.

        Raises:
            UsageError: there is none of that number.
        """
        if not 0 <= number < self.cells:
            raise UsageError(
                f"there is no cell {number}: they are numbered from 0 to {self.cells - 1}"
            )
        rest = number
        places = list[int]()
        for count in reversed(self.shape):
            rest, place = divmod(rest, count)
            places.insert(0, place)
        place, *others = places  # of the law, 0 where none is swept
        law, fixed = list(self.laws.items())[place] if self.laws else ("", ())
        along = list(zip(self.axes, others, strict=True))
        values = tuple(axis.value(n) for axis, n in along)
        return SweepCell(
            number, law, values, (*fixed, *(axis.override(n) for axis, n in along))
        )

    def scenario(self, *more: str) -> Scenario:
        """Returns the experiment, with some more overrides.

        Raises:
            ScenarioError: it is not valid with them.
        """
        return self.written.load([*self.overrides, *more])

    def facts(self) -> dict[str, Any]:
        """Returns all that names it, as plain values; `plan_from_json` reads them."""
        return {
            "source": self.written.label,
            "folder": None if self.written.folder is None else str(self.written.folder),
            "overrides": list(self.overrides),
            "over": [one.asked for one in self.axes],
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
    """Returns a sweep, checked and ready to run; overrides are texts KEY=VALUE.

    The other arguments are those of `trilat_net.sweep`. A law that all sites have stays with
    the gains of the scenario; another one replaces the law of every site, with its default
    gains. Overrides of gains count for either.

    Raises:
        ScenarioError: the scenario, an axis or one of its values cannot be right, or cannot
            run.
        UsageError: another argument cannot be right.
    """
    written = read_experiment(source)
    texts = tuple(overrides)
    axes = tuple(map(parse_axis, list_axes(over)))
    named = [laws] if isinstance(laws, str | type) else laws
    chosen = list(map(name_law_classes, named))
    for law in chosen:
        _check_law_name(law)
    before = _load_base(written, texts, axes, chosen)
    base = before.scenario
    keys = Counter(one.key for one in axes)
    for key, count in keys.items():
        if count > 1:
            raise ScenarioError("is swept twice: give one --over with all its values", path=key)
    if chosen and "control.law" in keys:
        raise ScenarioError(
            "is swept twice: give either --law or --over control.law", path="control.law"
        )
    forced = {law: _law_overrides(written, texts, before, law) for law in chosen}
    if judge not in JUDGES:
        raise UsageError(f"--judge is one of {', '.join(JUDGES)}, not {judge!r}")
    plan = SweepPlan(
        written=written,
        overrides=texts,
        base=base,
        axes=axes,
        laws=forced,
        seeds=_seeds(seeds, base.seed),
        longest_s=0.0,
        judge=judge,
        metrics=_list_metrics(metrics),
    )
    if longest_s is None:
        longest_s = plan.default_longest_s
    elif not base.duration_s <= longest_s <= MAX_SCENARIO_S:
        raise UsageError(
            f"--longest is how long an undecided cell may run, from its {base.duration_s:g} s to "
            f"{MAX_SCENARIO_S:g} s, not {longest_s:g}"
        )
    plan = plan._replace(longest_s=longest_s)
    for law in range(plan.shape[0]):
        _refuse_unfit(plan, law)
    return plan


def plan_from_json(facts: dict[str, Any]) -> SweepPlan:
    """Returns the plan that was kept as facts, from its own text; files that it names are read
    again.

    Raises:
        ScenarioError: it cannot run here.
    """
    folder = None if facts["folder"] is None else Path(facts["folder"])
    written = ExperimentText(facts["source"], facts["text"], folder)
    texts = tuple(facts["overrides"])
    axes = tuple(map(parse_axis, facts["over"]))
    before = _load_base(written, texts, axes, facts["laws"])
    base = allow_own_code(before.scenario)
    forced = {law: _law_overrides(written, texts, before, law) for law in facts["laws"]}
    more = (facts["longest_s"], facts.get("judge", "verdict"), tuple(facts.get("metrics", ())))
    return SweepPlan(written, texts, base, axes, forced, tuple(facts["seeds"]), *more)


def _list_metrics(asked: Sequence[str]) -> tuple[str, ...]:
    """Returns the metrics that are asked for, each once.

    Raises:
        UsageError: there is no such metric.
    """
    keys = [asked] if isinstance(asked, str) else asked
    try:
        return tuple(dict.fromkeys(find_quantity(key).key for key in keys))
    except KeyError as error:
        raise UsageError(f"--metric: {error.args[0]}") from None


def _seeds(asked: int | Sequence[int], own: int) -> tuple[int, ...]:
    if isinstance(asked, int | str):
        if isinstance(asked, str) or not 1 <= asked <= MAX_SEEDS:
            raise UsageError(
                f"--seeds is how many, 1 to {MAX_SEEDS}, or which, as in 1..20; not {asked}"
            )
        asked = range(own, own + asked)
    if len(asked) > MAX_SEEDS:
        raise UsageError(
            f"{count_nouns(len(asked), 'seed is', 'seeds are')} more than {MAX_SEEDS}"
        )
    for seed in asked:
        if not 0 <= seed < 2**63:
            raise UsageError(f"a seed is from 0 to 2^63 - 1, not {seed}")
    return tuple(dict.fromkeys(asked)) or (own,)


class _Base(NamedTuple):
    """The experiment without what is swept.

    Attributes:
        scenario: the experiment.
        forced: whether it is valid under a swept law only, and has the first of them.
    """

    scenario: Scenario
    forced: bool


def _load_base(
    written: ExperimentText,
    overrides: Sequence[str],
    axes: Sequence[SweepAxis],
    laws: Sequence[str],
) -> _Base:
    """Returns the experiment without its axes and swept laws.

    Overrides may need them: a link of another model needs the delay that an axis gives, and a
    gain belongs to a law that is swept. The experiment is then that at the first value of each
    axis, and under the first law.

    Raises:
        ScenarioError: the experiment is not valid even there.
    """
    first = [axis.override(0) for axis in axes]
    problem: ScenarioError | None = None
    for law in ("", *laws[:1]):
        of_law = _force_law(written, overrides, law) if law else ()
        for of_axes in ((), first):
            try:
                scenario = written.load([*overrides, *of_law, *of_axes])
            except ScenarioError as error:
                problem = error
            else:
                return _Base(scenario, forced=bool(law))
        written.load()  # an experiment that is not valid as written is refused for that
    assert problem is not None
    raise problem


def _check_law_name(law: str) -> None:
    """Refuses a law that does not exist.

    Raises:
        UsageError: no built-in law has this name, and it names no class.
    """
    ours = [name for name in LAWS if name != "own"]
    if law not in ours and ":" not in law:
        hint = (
            suggest_nearest(law, ours)
            or f"; laws are {', '.join(ours)}, and your own, as in mylaws:Law"
        )
        raise UsageError(f"--law: there is no law {law!r}{hint}")


def _force_law(written: ExperimentText, overrides: Sequence[str], law: str) -> tuple[str, ...]:
    """Returns overrides that put a law into force at every site."""
    tables = tomllib.loads(written.text)
    apply_overrides(tables, overrides)
    own = [name for name, site in tables.get("sites", {}).items() if "control" in site]
    return (f"control.law={law}", *(f"sites.{name}.control.law={law}" for name in own))


def _law_overrides(
    written: ExperimentText, overrides: Sequence[str], base: _Base, law: str
) -> tuple[str, ...]:
    sites = base.scenario.sites.values()
    if not base.forced and all(identify_law(spec.control) == law for spec in sites):
        return ()
    return _force_law(written, overrides, law)


def _refuse_unfit(plan: SweepPlan, law: int) -> None:
    origin = [law] + [0] * len(plan.axes)
    for n, one in enumerate(plan.axes, 1):
        seen: dict[str, str] = {}
        count = len(one.texts)
        few = min(count, _CHECKED_VALUES)  # the first, the last, and some between them
        for place in (k * (count - 1) // max(1, few - 1) for k in range(few)):
            scenario = _checked(plan, [*origin[:n], place, *origin[n + 1 :]])
            text = one.texts[place]
            if scenario.sha256 in seen:
                raise ScenarioError(
                    f"{seen[scenario.sha256]} and {text} are the same experiment: nothing here follows this "
                    "key; a site or link may have one of its own, as in sites.NAME.control or links.A->B",
                    path=one.key,
                    source=plan.written.label,
                )
            seen[scenario.sha256] = text
    ends = [(law,), *(sorted({0, len(one.texts) - 1}) for one in plan.axes)]
    for places in product(*ends):
        _checked(plan, places)


def _checked(plan: SweepPlan, places: Sequence[int]) -> Scenario:
    """Returns the scenario of a cell.

    Raises:
        ScenarioError: there is none, or it cannot run here; says with which law where several
            are swept.
    """
    number = 0
    for count, place in zip(plan.shape, places, strict=True):
        number = number * count + place
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


def label_axis(key: str, scenario: Scenario | None = None) -> str:
    """Returns the label of an axis, as "delay (ms)" for link.delay_ms."""
    words, unit = describe_key(key, scenario)
    return f"{words} ({unit})" if unit else words


def label_setting(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a key with its value, as "delay 200 ms" for link.delay_ms = 200."""
    words, unit = describe_key(key, scenario)
    if isinstance(value, bool):
        value = str(value).lower()
    number = f"{value:g}" if is_number(value) else str(value).replace("_", " ")
    return " ".join(word for word in (words, number, unit) if word)


def describe_key(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Returns what a key sets, in words, and its unit, "" where it has none."""
    *folders, last = key.split(".")
    number = ""
    if last.isdigit() and folders:  # one of several joints or parameters
        *folders, last, number = *folders, f"[{last}]"
    words, unit = split_unit(last)
    if not unit and len(last) <= 3:  # a symbol
        words = last
    owner = _describe_owner(folders, scenario)
    return f"{words}{number}{owner}", _GAINS.get(last) or unit.replace("^2", "²")


def _describe_owner(folders: list[str], scenario: Scenario | None) -> str:
    """Returns whose key it is, in words; "" for a group's."""
    match folders:
        case ["sites", site, ("hands" | "environment") as group, number]:
            kind = "hand" if group == "hands" else "environment"
            if scenario is not None and site in scenario.sites and number.isdigit():
                some = getattr(scenario.sites[site], group)
                if int(number) < len(some):
                    kind = str(some[int(number)].__struct_config__.tag).replace("_", " ")
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
    """Returns the command that makes a sweep."""
    words = set_options(plan.overrides)
    words += [word for one in plan.axes for word in ("--over", one.asked)]
    own = plan.base.seed
    count = len(plan.seeds)
    if plan.seeds == tuple(range(own, own + count)):
        words += ["--seeds", str(count)] if count > 1 else []
    else:
        words += ["--seeds", ",".join(map(str, plan.seeds)) + ("," if count == 1 else "")]
    words += ["--law", ",".join(plan.laws)] if plan.laws else []
    words += ["--judge", plan.judge] if plan.judge != "verdict" else []
    words += [word for key in plan.metrics for word in ("--metric", key)]
    if plan.longest_s != plan.default_longest_s:
        words += ["--longest", format_override_value(plan.longest_s)]
    return format_command("sweep", plan.written.label, *words, *more)


def format_override(key: str, value: Any) -> str:
    """Returns an override that sets a value: a whole number as one, a word as it is."""
    return f"{key}={format_override_value(value) if is_number(value) else value}"


def format_override_value(value: float) -> str:
    """Returns a number as an override's text, which reads as just that number; whole ones
    without a point.
    """
    return repr(value).removesuffix(".0")

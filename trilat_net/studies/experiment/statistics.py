"""Statistics of experiments with people: means, comparisons, a mixed model, power, a methods
paragraph.

Rows are tidy: a mapping per trial with `participant`, `pair`, `condition` and the measures by
their names, as `trials.csv` has them. A trial without a number, None or "", does not count.

Invariant: trials are averaged per participant and condition before anything is tested, so that
more trials are not more participants. A measure of a pair, which both of its users share, is
tested with `unit="pair"`. What the numbers cannot tell is None. Equal rows and seeds give equal
numbers.
"""

import math
import re
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ...core.vectors import Array
from ...errors import UsageError, count_nouns
from ...fields import split_unit
from ...files import import_extra
from ..intervals import mean_interval, wilson_interval

Row = Mapping[str, Any]
"""A trial: its keys, and its measures by name."""
CONFIDENCE = 0.95
RESAMPLES = 5000
"""Of the bootstrap."""
_ROUNDING = 1e-12
"""Of the largest value: a smaller spread is none."""


def import_scipy_stats() -> Any:
    """Returns the statistics of SciPy."""
    from scipy import stats  # takes half a second, which most commands can do without

    return stats


# --- means -----------------------------------------------------------------------------------------------


def average_trials(
    rows: Sequence[Row], measure: str, unit: str = "participant"
) -> dict[str, dict[str, float]]:
    """Returns the mean of a measure over the trials of every condition and unit, in the order
    of the rows.

    Args:
        rows: trials.
        measure: the name of the measure.
        unit: the key of what is sampled independently: "participant" or "pair".

    Raises:
        UsageError: no row has the measure, a row lacks a key, or a value is not a finite
            number.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if missing := [key for key in (unit, "condition") if key not in row]:
            raise UsageError(
                f"a row without {' and '.join(missing)}: tidy rows have a key for each"
            )
        each = found.setdefault(str(row["condition"]), {})
        if (value := row.get(measure)) not in (None, ""):
            each.setdefault(str(row[unit]), []).append(read_number(value, measure, row))
    means = {
        name: {u: math.fsum(v) / len(v) for u, v in each.items()}
        for name, each in found.items()
    }
    if not any(means.values()):
        names = sorted(
            {key for row in rows for key in row} - {"participant", "pair", "condition"}
        )
        raise UsageError(
            f"no trial has a number for {measure}; the rows have {', '.join(names) or 'nothing'}"
        )
    return means


def read_number(value: Any, measure: str, row: Row) -> float:
    """Returns the value of a measure in a row, which may be the text of a CSV file.

    Raises:
        UsageError: the value is no finite number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        where = ", ".join(
            f"{key} {row[key]}" for key in ("participant", "condition", "trial") if key in row
        )
        raise UsageError(f"{measure} = {value!r} ({where}): give a finite number, or nothing")
    return number


class ConditionMean(NamedTuple):
    """What a measure came to under a condition, over units.

    Args:
        condition: its name.
        number: of units with at least one trial.
        mean: over the means of the units.
        deviation: their standard deviation; None for fewer than two.
        interval: of 95 % by Student's t; None likewise.
        bootstrap: of 95 % by the bias-corrected and accelerated bootstrap (BCa); None likewise.
        missing: how many trials, or questionnaires, have no number; they are counted and not
            averaged.
    """

    condition: str
    number: int
    mean: float
    deviation: float | None
    interval: tuple[float, float] | None
    bootstrap: tuple[float, float] | None
    missing: int = 0


def summarise_conditions(
    rows: Sequence[Row], measure: str, *, unit: str = "participant", seed: int = 0
) -> list[ConditionMean]:
    """Returns mean, spread and intervals of every condition with a number, in the order of the
    rows.
    """
    means = average_trials(rows, measure, unit)
    lacking = Counter(str(row["condition"]) for row in rows if row.get(measure) in (None, ""))
    return [
        _summarise(name, list(each.values()), seed)._replace(missing=lacking[name])
        for name, each in means.items()
        if each
    ]


def _summarise(condition: str, values: list[float], seed: int) -> ConditionMean:
    mean = mean_interval(values)
    if mean is None:
        return ConditionMean(
            condition=condition,
            number=len(values),
            mean=values[0],
            deviation=None,
            interval=None,
            bootstrap=None,
        )
    low_high = (mean.mean - mean.half, mean.mean + mean.half)
    deviation = float(np.std(values, ddof=1))
    boot = bootstrap_interval(values, seed)
    return ConditionMean(
        condition=condition,
        number=len(values),
        mean=mean.mean,
        deviation=deviation,
        interval=low_high,
        bootstrap=boot,
    )


def bootstrap_interval(values: Sequence[float], seed: int = 0) -> tuple[float, float] | None:
    """Returns the 95 % interval of a mean by the BCa bootstrap; None of fewer than two values.

    Source: Efron, "Better bootstrap confidence intervals", J. American Statistical Association
    82 (1987).
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.size < 2:
        return None
    if np.ptp(sample) <= _ROUNDING * np.abs(sample).max():
        return float(sample.mean()), float(sample.mean())
    generator = np.random.default_rng(seed)
    found = import_scipy_stats().bootstrap(
        (sample,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="BCa",
        rng=generator,
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


# --- paired comparisons ----------------------------------------------------------------------------------


class Comparison(NamedTuple):
    """Two conditions of a measure, compared within units; what fewer than two units cannot tell
    is None.

    Args:
        measure: its name.
        first: a condition.
        second: the other one.
        number: of units that have both.
        difference: mean of second minus first.
        interval: of the difference, 95 % by Student's t.
        t: of the paired test, with number - 1 degrees of freedom; None if all differences are
            the same.
        p: two-sided.
        p_holm: p corrected for all comparisons of the measure.
        d_z: difference over the standard deviation of the differences.
        d_av: difference over the mean of the standard deviations of both conditions.
        p_wilcoxon: of the signed-rank test, two-sided, not corrected; zero differences are left
            out.
    """

    measure: str
    first: str
    second: str
    number: int
    difference: float | None = None
    interval: tuple[float, float] | None = None
    t: float | None = None
    p: float | None = None
    p_holm: float | None = None
    d_z: float | None = None
    d_av: float | None = None
    p_wilcoxon: float | None = None


def compare_conditions(
    rows: Sequence[Row], measure: str, *, unit: str = "participant"
) -> list[Comparison]:
    """Returns the comparison of every two conditions, in the order of the rows.

    Sources: Holm, "A simple sequentially rejective multiple test procedure", Scandinavian J.
    Statistics 6 (1979); Lakens, "Calculating and reporting effect sizes to facilitate
    cumulative science", Frontiers in Psychology 4:863 (2013), for d_z and d_av.
    """
    means = average_trials(rows, measure, unit)
    found = [
        _compare(measure, first, second, means) for first, second in combinations(means, 2)
    ]
    corrected = correct_holm([one.p for one in found])
    return [one._replace(p_holm=p) for one, p in zip(found, corrected, strict=True)]


def _compare(
    measure: str, first: str, second: str, means: Mapping[str, Mapping[str, float]]
) -> Comparison:
    both = [unit for unit in means[first] if unit in means[second]]
    one, other = (np.array([means[name][unit] for unit in both]) for name in (first, second))
    differences = other - one
    empty = Comparison(measure, first, second, len(both))
    if len(both) < 2:
        return empty._replace(difference=float(differences[0])) if both else empty
    mean = float(differences.mean())
    spread = float(differences.std(ddof=1))
    if spread <= _ROUNDING * max(np.abs(one).max(), np.abs(other).max()):
        return empty._replace(difference=mean, interval=(mean, mean))
    stats = import_scipy_stats()
    test = stats.ttest_rel(other, one)
    low, high = test.confidence_interval(CONFIDENCE)
    average = float(one.std(ddof=1) + other.std(ddof=1)) / 2.0
    return empty._replace(
        difference=mean,
        interval=(float(low), float(high)),
        t=float(test.statistic),
        p=float(test.pvalue),
        d_z=mean / spread,
        d_av=mean / average,
        p_wilcoxon=float(stats.wilcoxon(differences).pvalue),
    )


def correct_holm(p: Sequence[float | None]) -> list[float | None]:
    """Returns p values corrected for their number, in their order; those that are None do not
    count.
    """
    order = sorted((value, n) for n, value in enumerate(p) if value is not None)
    corrected: list[float | None] = [None] * len(p)
    least = 0.0
    for rank, (value, n) in enumerate(order):
        least = max(least, min(1.0, (len(order) - rank) * value))
        corrected[n] = least
    return corrected


# --- mixed model -----------------------------------------------------------------------------------------


class MixedEffect(NamedTuple):
    """A condition against the first: estimate, its standard error and 95 % interval, t and
    two-sided p.
    """

    condition: str
    estimate: float
    error: float
    interval: tuple[float, float]
    t: float
    p: float


class MixedModel(NamedTuple):
    """`measure ~ condition + (1 | pair/participant)`, fitted to the means of participants by
    REML.

    Args:
        measure: its name.
        reference: the first condition, which the others are held against.
        effects: of every other condition.
        freedom: degrees of freedom of t: observations less participants less effects, as in the
            analysis of variance if everybody has all conditions.
        variances: of "pair", of "participant" within it, and "residual".
        notes: what the fit complains of, as a variance at 0.
    """

    measure: str
    reference: str
    effects: list[MixedEffect]
    freedom: int
    variances: dict[str, float]
    notes: list[str]


def fit_mixed_model(rows: Sequence[Row], measure: str) -> MixedModel:
    """Returns the mixed model of a measure, of users within pairs.

    What both users of a pair share in a trial is no part of it: such a measure has
    `unit="pair"` in `compare_conditions`. Needs `pip install 'trilat-net[stats]'`.

    Raises:
        UsageError: statsmodels is not installed, a participant has two pairs, or nothing is
            left to compare.
    """
    formulas = import_extra("statsmodels.formula.api", "stats", "mixed models")
    frames = import_extra("pandas", "stats", "mixed models")
    means = {name: each for name, each in average_trials(rows, measure).items() if each}
    pairs = _find_pairs(rows)
    records = [
        (pairs[u], u, name, mean) for name, each in means.items() for u, mean in each.items()
    ]
    people = {u for _, u, *_ in records}
    freedom = len(records) - len(people) - len(means) + 1
    if len(means) < 2 or freedom < 1:
        raise UsageError(
            f"{measure}: {len(records)} means of {count_nouns(len(people), 'participant')}; "
            "two conditions need more"
        )
    frame = frames.DataFrame(records, columns=["pair", "participant", "condition", "measure"])
    frame["condition"] = frames.Categorical(frame["condition"], categories=list(means))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = _fit(formulas, frame, measure)
    effects = [_read_effect(fit, name, freedom) for name in list(means)[1:]]
    parts = {"pair": fit.cov_re.iloc[0, 0], "participant": fit.vcomp[0], "residual": fit.scale}
    variances = {name: float(value) for name, value in parts.items()}
    notes = list(dict.fromkeys(str(one.message) for one in caught))
    return MixedModel(
        measure=measure,
        reference=next(iter(means)),
        effects=effects,
        freedom=freedom,
        variances=variances,
        notes=notes,
    )


def _fit(formulas: Any, frame: Any, measure: str) -> Any:
    """Returns the likelier of two fits: by the gradient alone it may end before a variance that
    is at 0.
    """
    parts = {"participant": "0 + C(participant)"}
    model = formulas.mixedlm(
        "measure ~ condition", frame, groups="pair", re_formula="1", vc_formula=parts
    )
    fits = []
    for method in ("powell", "lbfgs"):
        with suppress(np.linalg.LinAlgError):
            fits.append(model.fit(reml=True, method=method))
    fits = [fit for fit in fits if np.isfinite([fit.llf, *fit.bse_fe]).all()]
    if not fits:
        raise UsageError(
            f"{measure}: a mixed model cannot be fitted to it; compare conditions instead"
        )
    return max(fits, key=lambda fit: float(fit.llf))


def _find_pairs(rows: Sequence[Row]) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for row in rows:
        user = str(row["participant"])
        pair = "" if row.get("pair") is None else str(row["pair"])
        if pairs.setdefault(user, pair) != pair:
            raise UsageError(
                f"participant {user} is in pairs {pairs[user]} and {pair}: one pair each"
            )
    if "" in pairs.values() or len(set(pairs.values())) == len(pairs):
        raise UsageError("no pair has two participants: a mixed model is of users within pairs")
    return pairs


def _read_effect(fit: Any, condition: str, freedom: int) -> MixedEffect:
    stats = import_scipy_stats()
    name = f"condition[T.{condition}]"
    estimate = float(fit.fe_params[name])
    error = float(fit.bse_fe[name])
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, freedom)) * error
    p = 2.0 * float(stats.t.sf(abs(estimate / error), freedom))
    return MixedEffect(
        condition=condition,
        estimate=estimate,
        error=error,
        interval=(estimate - half, estimate + half),
        t=estimate / error,
        p=p,
    )


# --- power -----------------------------------------------------------------------------------------------


def power(d_z: float, number: int, *, alpha: float = 0.05) -> float:
    """Returns the chance that a paired t test, two-sided, finds an effect of a size d_z with so
    many units.

    Source: Cohen, "Statistical power analysis for the behavioral sciences" (1988); by the
    noncentral t.
    """
    if number < 2 or not 0.0 < alpha < 1.0:
        raise UsageError(
            f"{number} units, alpha {alpha}: give two units or more, and alpha between 0 and 1"
        )
    stats = import_scipy_stats()
    shift = abs(d_z) * math.sqrt(number)
    freedom = number - 1
    critical = stats.t.ppf(1.0 - alpha / 2.0, freedom)
    # the lower tail by its mirror image: of small ones `nct.cdf` returns NaN
    return float(sum(stats.nct.sf(critical, freedom, sign * shift) for sign in (1.0, -1.0)))


def find_least_number(
    d_z: float, *, wanted: float = 0.8, alpha: float = 0.05, most: int = 10_000
) -> int:
    """Returns the least number of units with which `power` is at least what is wanted.

    Raises:
        UsageError: more than `most` are needed.
    """
    if not 0.0 < wanted < 1.0 or power(d_z, most, alpha=alpha) < wanted:
        raise UsageError(
            f"power {wanted} at d_z = {d_z}: not with {most} units; give a larger effect, or less power"
        )
    return bisect_left(
        range(most), wanted, lo=2, key=lambda number: power(d_z, number, alpha=alpha)
    )


class SimulatedPower(NamedTuple):
    """How often two conditions were found to differ in experiments that were drawn.

    Args:
        first: a condition.
        second: the other one.
        d_z: the size of the effect that was drawn.
        found: share of the experiments with p below alpha.
        interval: of that share, 95 %.
        found_holm: share of those with the corrected p below alpha.
    """

    first: str
    second: str
    d_z: float
    found: float
    interval: tuple[float, float]
    found_holm: float


def simulate_power(
    means: Mapping[str, float],
    number: int,
    *,
    trial_deviation: float,
    trials: int = 1,
    effect_deviation: float = 0.0,
    alpha: float = 0.05,
    repetitions: int = 500,
    seed: int = 0,
) -> list[SimulatedPower]:
    """Returns how often each two conditions are found to differ, by drawing trials and
    comparing them.

    Args:
        means: the expected mean of a measure by condition.
        number: of participants.
        trial_deviation: standard deviation from trial to trial.
        trials: of a participant under a condition.
        effect_deviation: standard deviation, over participants, of what a condition does to
            them.
        alpha: of the tests.
        repetitions: experiments that are drawn.
        seed: of what is drawn.
    """
    generator = np.random.default_rng(seed)
    runs = []
    for _ in range(repetitions):
        own = generator.normal(0.0, effect_deviation, (number, len(means), 1))
        values = own + generator.normal(0.0, trial_deviation, (number, len(means), trials))
        runs.append(compare_conditions(_list_rows(values, means), "measure"))
    deviation = math.sqrt(
        2.0 * (float(effect_deviation) ** 2 + float(trial_deviation) ** 2 / trials)
    )
    return [
        _count_found(
            each, float(means[each[0].second] - means[each[0].first]) / deviation, alpha
        )
        for each in zip(*runs, strict=True)
    ]


def _list_rows(values: Array, means: Mapping[str, float]) -> list[Row]:
    return [
        {"participant": user, "condition": name, "measure": mean + value}
        for n, (name, mean) in enumerate(means.items())
        for user, drawn in enumerate(values[:, n])
        for value in drawn.tolist()
    ]


def _count_found(runs: Sequence[Comparison], d_z: float, alpha: float) -> SimulatedPower:
    found = sum(run.p is not None and run.p < alpha for run in runs)
    holm = sum(run.p_holm is not None and run.p_holm < alpha for run in runs)
    interval = wilson_interval(found, len(runs))
    return SimulatedPower(
        first=runs[0].first,
        second=runs[0].second,
        d_z=d_z,
        found=found / len(runs),
        interval=interval,
        found_holm=holm / len(runs),
    )


# --- methods paragraph -----------------------------------------------------------------------------------

_METHODS = (
    ("participants", "The data of {} participants"),
    ("pairs", " in {} pairs"),
    ("excluded", " were analysed; {} more were excluded"),
    ("exclusions", " ({})"),
    ("design", ". The design was {},"),
    ("blocks", " in {} blocks"),
    ("trials", " with {} trials of every participant under a condition."),
    ("training", " {}."),
    ("staircase", " {}."),
    ("conditions", " Conditions, with delays as measured, were: {}."),
    ("law", " The arms ran the control law {}"),
    ("rate_hz", " at {}"),
    ("gains", " with the gains {};"),
    ("seeds", " random numbers had the seeds {}"),
    ("program", "; the program was {}"),
    ("digest", "; the digest of the protocol is {}"),
    ("measures", ". Measures were {}, averaged"),
    ("unit", " per {}"),
)  # fmt: skip
"""Facts, in the order of the paragraph, and what is said of each."""
COMPUTED = (
    "t tests", "wilcoxon", "effect sizes", "intervals", "bootstrap", "sign tests", "mixed models",
)  # fmt: skip
"""Analyses that the paragraph describes if they were computed."""
_ENDING = ("correction", "alpha", "completion", "answers", "computed")
"""Facts of the last sentences."""
_WELCOME = (
    "pairs", "exclusions", "blocks", "training", "staircase", "rate_hz", "program", "digest", "unit", "alpha",
    "completion", "answers", "computed",
)  # fmt: skip


def write_methods(facts: Mapping[str, Any]) -> str:
    """Returns the paragraph on methods of a paper, with every number that is given.

    Args:
        facts: `participants`, whose data count; `excluded`, how many more; `exclusions`, why;
            `pairs`; `design`; `blocks`; `trials` of a participant under a condition; `training`
            or `staircase`, what they were; `conditions`, by name what each was, with its delay
            as measured (`delay_ms`); `law`; `gains`; `rate_hz`; `seeds`; `measures`;
            `correction` of p; `unit`; `alpha`; `program`, its version; `digest` of the
            protocol; `computed`, which of `COMPUTED` were, by default none; `completion` and
            `answers`, sentences on trials that were not completed and on missing answers. Keys
            end in their unit.

    Raises:
        UsageError: a fact is missing or unknown, or a condition has no delay.
    """
    known = [*(key for key, _ in _METHODS), *_ENDING]
    if missing := [key for key in known if key not in facts and key not in _WELCOME]:
        raise UsageError(f"a methods paragraph needs {', '.join(missing)}")
    if unknown := [key for key in facts if key not in known]:
        raise UsageError(f"{', '.join(unknown)}: facts are {', '.join(known)}")
    if odd := [name for name in facts.get("computed", ()) if name not in COMPUTED]:
        raise UsageError(f"{', '.join(odd)}: analyses are {', '.join(COMPUTED)}")
    for name, condition in facts["conditions"].items():
        if not any(key.startswith("delay") for key in condition):
            raise UsageError(
                f"condition {name} has no delay: give delay_ms, as measured, 0 if there was none"
            )
    told = {key: _tell(value, key) for key, value in facts.items()}
    told["conditions"] = "; ".join(
        f"{name} ({_tell(each)})" for name, each in facts["conditions"].items()
    )
    told["measures"] = ", ".join(
        " in ".join(filter(None, split_unit(name))) for name in facts["measures"]
    )
    first = "".join(text.format(told[key]) for key, text in _METHODS if told.get(key))
    sentences = [
        f"{first} over the trials of a condition",
        told.get("completion"),
        told.get("answers"),
    ]
    sentences += _describe_computed(frozenset(facts.get("computed", ())), told)
    text = " ".join(f"{_capitalise(sentence)}." for sentence in sentences if sentence)
    singular = re.sub(r"(?<![\w.])1 (participant|pair|block|trial)s\b", r"1 \1", text)
    return singular.replace("; 1 more were excluded", "; 1 more was excluded")


def _describe_computed(computed: Collection[str], told: Mapping[str, str]) -> Iterator[str]:
    """Yields a sentence for each analysis that was computed, or that conditions were not
    compared.
    """
    correction = f"with p corrected by {told['correction']} over all comparisons of a measure"
    level = f", at alpha = {told['alpha']}" if told.get("alpha") else ""
    if "t tests" in computed:
        wilcoxon = (
            " and by Wilcoxon's signed-rank test beside them" if "wilcoxon" in computed else ""
        )
        yield f"conditions were compared by two-sided paired t tests, {correction}{level}{wilcoxon}"
    if "sign tests" in computed:
        rule = "in which one that was not reached is longer than any that was"
        by_sign = f"by exact two-sided sign tests on the medians, {rule}"
        yield f"completion times were compared {by_sign}, {correction}{level}"
    if "mixed models" in computed:
        yield "forces of users were compared by mixed models, with pair and user as random effects (REML)"
    if not {"t tests", "sign tests", "mixed models"} & {*computed}:
        yield "conditions were not compared by tests"
    if "effect sizes" in computed:
        yield "effect sizes are Cohen's d_z and d_av"
    if "intervals" in computed:
        bootstrap = (
            f" and by the bootstrap (BCa, {RESAMPLES} resamples)"
            if "bootstrap" in computed
            else ""
        )
        yield f"intervals are of {100 * CONFIDENCE:g} %, by Student's t{bootstrap}"


def _capitalise(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]


def _tell(value: Any, key: str = "") -> str:
    """Returns numbers with all their digits and the unit of their key, and what holds numbers
    in words.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping):
        return ", ".join(
            f"{split_unit(name)[0]} {_tell(one, name)}" for name, one in value.items()
        )
    if isinstance(value, Sequence):
        return ", ".join(_tell(one, key) for one in value)
    number = str(value) if isinstance(value, int) else repr(float(value)).removesuffix(".0")
    return f"{number} {split_unit(key)[1]}".strip()

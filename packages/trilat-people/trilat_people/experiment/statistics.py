"""Statistics for experiments with people: means, tests and power.

All functions take tidy rows as in `trials.csv`: each trial is a mapping with `participant`,
`pair`, `condition` and one key per measure. A trial in which a measure is `None` or "" is
excluded from the statistics of that measure. A unit is a participant, or a pair of participants
who take part together, whichever is sampled independently.

Invariant:
    - Trials are averaged per unit and condition before any test, so more trials do not count as
      more participants.
    - A measure shared by both users of a pair is tested with `unit="pair"`.
    - A statistic that is undefined for the data is `None`.
    - Equal rows and seeds give equal results.
"""

import math
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from trilat_net.core import Array
from trilat_net.errors import UsageError, count_nouns
from trilat_net.files import Extra
from trilat_net.work import MeanInterval, wilson_interval

Row = Mapping[str, Any]
"""A trial: its participant, pair and condition, and one key per measure."""
CONFIDENCE = 0.95
"""Confidence level of all intervals."""
RESAMPLES = 5000
"""Number of resamples of the bootstrap."""
_ROUNDING = 1e-12
"""Spread, relative to the largest value, below which values are considered equal."""


def import_scipy_stats() -> Any:
    """Imports `scipy.stats` on demand and returns the module.

    The import takes longer than all other imports of an experiment together, and is not needed
    to run trials.
    """
    # The import takes half a second, and most commands do not need it.
    from scipy import stats

    return stats


# --- means ------------------------------------------------------------------------------------


def average_trials(
    rows: Sequence[Row], measure: str, unit: str = "participant"
) -> dict[str, dict[str, float]]:
    """Averages a measure over the trials of each participant or pair under each condition.

    The statistics are computed from these means because trials of the same participant are not
    independent.

    Args:
        rows: Trials, each a mapping from column name to value.
        measure: Name of the measure.
        unit: Key of the independently sampled unit, "participant" or "pair".

    Returns:
        The means by condition and then by participant or pair, in the order of the rows.

    Raises:
        UsageError: No row has the measure, a row lacks a key, or a value is not a finite
            number.
    """
    values_by_condition: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        missing_keys = [key for key in (unit, "condition") if key not in row]
        if missing_keys:
            raise UsageError(
                f"a row lacks {' and '.join(missing_keys)}: "
                f"every row must have the keys {unit} and condition"
            )

        values_by_unit = values_by_condition.setdefault(str(row["condition"]), {})
        value = row.get(measure)
        if value not in (None, ""):
            number = read_number(value, measure, row)
            values_by_unit.setdefault(str(row[unit]), []).append(number)

    means: dict[str, dict[str, float]] = {}
    for condition, values_by_unit in values_by_condition.items():
        means[condition] = {
            name: math.fsum(numbers) / len(numbers) for name, numbers in values_by_unit.items()
        }

    if not any(means.values()):
        keys: set[str] = set()
        for row in rows:
            keys |= row.keys()
        measure_names = sorted(keys - {"participant", "pair", "condition"})
        names_text = ", ".join(measure_names) or "no measures"
        raise UsageError(f"no trial has a number for {measure}; the rows contain {names_text}")
    return means


def read_number(value: Any, measure: str, row: Row) -> float:
    """Converts an entry of a result table to a number.

    Args:
        value: A number, or a string from a CSV file.
        measure: Name of the measure, for the error message.
        row: The trial, for the error message.

    Raises:
        UsageError: The value is not a finite number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        keys = ("participant", "condition", "trial")
        trial_text = ", ".join(f"{key} {row[key]}" for key in keys if key in row)
        raise UsageError(
            f"{measure} = {value!r} ({trial_text}): give a finite number, "
            "or leave the value empty"
        )
    return number


class ConditionMean(NamedTuple):
    """Mean and spread of a measure under one condition, over participants or pairs.

    A unit is a participant, or a pair of participants who take part together. The standard
    deviation and the intervals are `None` if there are fewer than two units.

    Args:
        condition: Name of the condition.
        number: Number of units with at least one trial.
        mean: Mean of the unit means.
        deviation: Standard deviation of the unit means.
        interval: 95 % confidence interval of the mean from Student's t distribution.
        bootstrap: 95 % confidence interval of the mean from the bias-corrected and accelerated
            (BCa) bootstrap.
        missing: Number of trials or questionnaires with no value, which are excluded from the
            mean.
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
    """Computes the mean of a measure under each condition, with its spread and intervals.

    The trials of each participant (or pair) are averaged first. Conditions in which no trial
    has a value are omitted.

    Args:
        rows: Trials, as for `average_trials`.
        measure: Name of the measure.
        unit: "participant" if participants are independent of each other; "pair" if two
            participants did the trials together, so that only pairs are independent.
        seed: Random seed of the bootstrap.

    Returns:
        One summary per condition, in the order in which the conditions first occur.
    """
    means = average_trials(rows, measure, unit)
    rows_without_value = [row for row in rows if row.get(measure) in (None, "")]
    missing_by_condition = Counter(str(row["condition"]) for row in rows_without_value)
    summaries: list[ConditionMean] = []
    for condition, means_by_unit in means.items():
        if means_by_unit:
            summary = _summarise(condition, list(means_by_unit.values()), seed)
            summaries.append(summary._replace(missing=missing_by_condition[condition]))
    return summaries


def _summarise(condition: str, values: list[float], seed: int) -> ConditionMean:
    """Computes the mean, deviation and confidence intervals for one condition.

    Args:
        condition: Name of the condition.
        values: Mean over trials of each participant or pair, at least one.
        seed: Random seed of the bootstrap, which resamples the participants.

    Returns:
        The summary, with no deviation or intervals for a single participant.
    """
    mean = MeanInterval.of_values(values)
    if mean is None:  # a single value
        return ConditionMean(
            condition=condition,
            number=len(values),
            mean=values[0],
            deviation=None,
            interval=None,
            bootstrap=None,
        )

    return ConditionMean(
        condition=condition,
        number=len(values),
        mean=mean.mean,
        deviation=float(np.std(values, ddof=1)),
        interval=(mean.mean - mean.half, mean.mean + mean.half),
        bootstrap=bootstrap_interval(values, seed),
    )


def bootstrap_interval(values: Sequence[float], seed: int = 0) -> tuple[float, float] | None:
    """Computes the 95 % confidence interval of a mean with the BCa bootstrap.

    The bias-corrected and accelerated (BCa) bootstrap resamples the values with replacement and
    does not assume a normal distribution.

    Source: Efron, "Better bootstrap confidence intervals", J. American Statistical Association
    82 (1987).

    Args:
        values: The values, one per participant or pair.
        seed: Random seed of the resampling.

    Returns:
        Lower and upper end, or `None` for fewer than two values.
    """
    sample = np.asarray(values, dtype=np.float64)
    if sample.size < 2:
        return None

    # BCa divides by the spread of the sample, and returns NaN for equal values.
    are_equal = np.ptp(sample) <= _ROUNDING * np.abs(sample).max()
    if are_equal:
        mean = float(sample.mean())
        return mean, mean

    result = import_scipy_stats().bootstrap(
        (sample,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="BCa",
        rng=np.random.default_rng(seed),
    )
    interval = result.confidence_interval
    return float(interval.low), float(interval.high)


# --- paired comparisons -----------------------------------------------------------------------


class Comparison(NamedTuple):
    """Comparison of a measure between two conditions, within participants or pairs.

    The values are compared within each unit, which is a participant or a pair. The interval,
    tests and effect sizes are `None` for fewer than two units.

    Args:
        measure: Name of the measure.
        first: Name of the first condition.
        second: Name of the second condition.
        number: Number of units with values under both conditions.
        difference: Mean of the difference second minus first.
        interval: 95 % confidence interval of the difference from Student's t distribution.
        t: Statistic of the paired test, with number - 1 degrees of freedom. `None` if all
            differences are equal.
        p: Two-sided p value of the paired t test.
        p_holm: p value corrected for all comparisons of the measure.
        d_z: Effect size: difference divided by the standard deviation of the differences.
        d_av: Effect size: difference divided by the mean of the two conditions' standard
            deviations.
        p_wilcoxon: Two-sided, uncorrected p value of the Wilcoxon signed-rank test, excluding
            zero differences.
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
    """Compares a measure between each pair of conditions, within participants or pairs.

    Sources: Holm, "A simple sequentially rejective multiple test procedure", Scandinavian J.
    Statistics 6 (1979); Lakens, "Calculating and reporting effect sizes to facilitate
    cumulative science", Frontiers in Psychology 4:863 (2013), for d_z and d_av.

    Args:
        rows: Trials, as for `average_trials`.
        measure: Name of the measure.
        unit: The independently sampled unit, "participant" or "pair".

    Returns:
        One comparison per pair of conditions, in the order of the rows.
    """
    means = average_trials(rows, measure, unit)
    comparisons: list[Comparison] = []
    for first, second in combinations(means, 2):
        comparisons.append(_compare(measure, first, second, means))

    # Many tests find a difference by chance. Holm's method corrects the p values.
    corrected_p = correct_holm([comparison.p for comparison in comparisons])
    return [
        comparison._replace(p_holm=p)
        for comparison, p in zip(comparisons, corrected_p, strict=True)
    ]


def _compare(
    measure: str, first: str, second: str, means: Mapping[str, Mapping[str, float]]
) -> Comparison:
    """Compares two conditions with paired tests over the units that have values for both.

    A unit is a participant or a pair. A test requires at least two units whose differences are
    not all equal up to rounding.

    Args:
        measure: Name of the measure.
        first: Name of the first condition.
        second: Name of the second condition.
        means: Means over trials by condition and unit.

    Returns:
        The difference second minus first, with its interval and those tests that are possible.
    """
    common_units = [unit for unit in means[first] if unit in means[second]]
    first_means = np.array([means[first][unit] for unit in common_units])
    second_means = np.array([means[second][unit] for unit in common_units])
    differences = second_means - first_means
    untested = Comparison(measure, first, second, len(common_units))
    if not common_units:
        return untested
    if len(common_units) < 2:
        return untested._replace(difference=float(differences[0]))

    mean = float(differences.mean())
    deviation = float(differences.std(ddof=1))
    largest_mean = max(np.abs(first_means).max(), np.abs(second_means).max())
    are_equal = deviation <= _ROUNDING * largest_mean
    if are_equal:
        return untested._replace(difference=mean, interval=(mean, mean))

    stats = import_scipy_stats()
    t_test = stats.ttest_rel(second_means, first_means)
    low, high = t_test.confidence_interval(CONFIDENCE)

    sum_of_deviations = float(first_means.std(ddof=1) + second_means.std(ddof=1))
    mean_deviation = sum_of_deviations / 2.0
    return untested._replace(
        difference=mean,
        interval=(float(low), float(high)),
        t=float(t_test.statistic),
        p=float(t_test.pvalue),
        d_z=mean / deviation,
        d_av=mean / mean_deviation,
        p_wilcoxon=float(stats.wilcoxon(differences).pvalue),
    )


def correct_holm(p: Sequence[float | None]) -> list[float | None]:
    """Corrects the p values of several tests with Holm's method.

    Without correction, the number of results that are significant by chance grows with the
    number of tests. The smallest of n p values is multiplied by n, the next by n - 1, and so
    on.

    Args:
        p: p values. `None` does not count as a test.

    Returns:
        The corrected values in the same order, with `None` unchanged.
    """
    ascending = sorted((value, index) for index, value in enumerate(p) if value is not None)
    corrected: list[float | None] = [None] * len(p)
    largest_so_far = 0.0
    for rank, (value, index) in enumerate(ascending):
        remaining_tests = len(ascending) - rank
        # A corrected value is never below the corrected value of a smaller p.
        corrected_value = min(1.0, remaining_tests * value)
        largest_so_far = max(largest_so_far, corrected_value)
        corrected[index] = largest_so_far
    return corrected


# --- mixed model ------------------------------------------------------------------------------


class MixedEffect(NamedTuple):
    """Effect of one condition on a measure in a mixed model.

    The effect is relative to the first condition.

    Args:
        condition: Name of the condition.
        estimate: Estimated difference from the first condition.
        error: Standard error of the estimate.
        interval: 95 % confidence interval of the estimate.
        t: Estimate divided by its standard error.
        p: Two-sided p value of t.
    """

    condition: str
    estimate: float
    error: float
    interval: tuple[float, float]
    t: float
    p: float


class MixedModel(NamedTuple):
    """Mixed model of a measure, fitted to the participants' means.

    The model is `measure ~ condition + (1 | pair/participant)`, with random effects of pairs
    and of participants within pairs, fitted by restricted maximum likelihood (REML).

    Args:
        measure: Name of the measure.
        reference: The first condition, to which the others are compared.
        effects: Effect of each other condition.
        freedom: Degrees of freedom of t: number of observations minus number of participants
            minus number of effects. Equal to those of an analysis of variance if every
            participant has a mean under every condition.
        variances: Variances of "pair", of "participant" (within a pair) and of "residual".
        notes: Warnings from the fit, for example about a variance of 0.
    """

    measure: str
    reference: str
    effects: list[MixedEffect]
    freedom: int
    variances: dict[str, float]
    notes: list[str]


def fit_mixed_model(rows: Sequence[Row], measure: str) -> MixedModel:
    """Fits a mixed model of a measure, with participants nested within pairs.

    The model compares conditions while accounting for the correlation between values of the
    same participant and of the same pair. Use it for measures of individual users. For a
    measure shared by both users of a pair, use `compare_conditions` with `unit="pair"`.
    Requires `pip install 'trilat-net[stats]'`.

    Args:
        rows: Trials, as for `average_trials`, with the keys "pair" and "participant".
        measure: Name of the measure.

    Raises:
        UsageError: statsmodels is not installed, a participant is in two pairs, or there are
            too few means to compare.
    """
    extra = Extra("stats", "mixed models")
    formulas = extra.import_module("statsmodels.formula.api")
    frames = extra.import_module("pandas")

    means = {
        condition: means_by_user
        for condition, means_by_user in average_trials(rows, measure).items()
        if means_by_user
    }

    pairs = _find_pairs(rows)
    records = []
    for condition, means_by_user in means.items():
        for user, mean in means_by_user.items():
            records.append((pairs[user], user, condition, mean))

    # Each participant and each condition uses up a degree of freedom.
    users = {user for _, user, _, _ in records}
    freedom = len(records) - len(users) - len(means) + 1
    if len(means) < 2 or freedom < 1:
        mean_count = count_nouns(len(records), "mean")
        user_count = count_nouns(len(users), "participant")
        condition_count = count_nouns(len(means), "condition")
        raise UsageError(
            f"{measure}: {mean_count} of {user_count} under {condition_count}, "
            "which is too few to compare two conditions"
        )

    # The first condition is the reference, with which the others are compared.
    frame = frames.DataFrame(records, columns=["pair", "participant", "condition", "measure"])
    frame["condition"] = frames.Categorical(frame["condition"], categories=list(means))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fitted_model = _fit(formulas, frame, measure)

    effects = [_read_effect(fitted_model, name, freedom) for name in list(means)[1:]]
    variances = {
        "pair": float(fitted_model.cov_re.iloc[0, 0]),
        "participant": float(fitted_model.vcomp[0]),
        "residual": float(fitted_model.scale),
    }

    notes = list(dict.fromkeys(str(warning.message) for warning in caught))
    return MixedModel(
        measure=measure,
        reference=next(iter(means)),
        effects=effects,
        freedom=freedom,
        variances=variances,
        notes=notes,
    )


def _fit(formulas: Any, frame: Any, measure: str) -> Any:
    """Fits a mixed model with two optimizers and returns the fit with the higher likelihood.

    Args:
        formulas: The module `statsmodels.formula.api`.
        frame: Data frame with one row per mean.
        measure: Name of the measure, for the error message.

    Raises:
        UsageError: Neither optimizer returns finite values.
    """
    variance_components = {"participant": "0 + C(participant)"}
    model = formulas.mixedlm(
        "measure ~ condition",
        frame,
        groups="pair",
        re_formula="1",
        vc_formula=variance_components,
    )

    fitted_models = []
    # The gradient method alone may stop before it reaches a variance of 0. Powell's method does
    # not use the gradient.
    for method in ("powell", "lbfgs"):
        with suppress(np.linalg.LinAlgError):
            fitted_models.append(model.fit(reml=True, method=method))

    finite_models = [
        fitted for fitted in fitted_models if np.isfinite([fitted.llf, *fitted.bse_fe]).all()
    ]
    if not finite_models:
        raise UsageError(
            f"{measure}: no mixed model can be fitted to the means of this measure; "
            "compare conditions instead"
        )
    return max(finite_models, key=lambda fitted: float(fitted.llf))


def _find_pairs(rows: Sequence[Row]) -> dict[str, str]:
    """Returns a mapping from each participant to their pair.

    A mixed model requires participants who are nested in pairs: each belongs to exactly one
    pair.

    Raises:
        UsageError: A participant is in two pairs, or no pair has two participants.
    """
    pairs: dict[str, str] = {}
    for row in rows:
        user = str(row["participant"])
        pair = "" if row.get("pair") is None else str(row["pair"])
        if pairs.setdefault(user, pair) != pair:
            raise UsageError(
                f"participant {user} is in pairs {pairs[user]} and {pair}: "
                "a participant must belong to exactly one pair"
            )

    has_single_user = "" in pairs.values()
    has_only_single_users = len(set(pairs.values())) == len(pairs)
    if has_single_user or has_only_single_users:
        raise UsageError(
            "no pair has two participants: a mixed model needs users nested within pairs"
        )
    return pairs


def _read_effect(fit: Any, condition: str, freedom: int) -> MixedEffect:
    """Extracts the effect of a condition from a fitted mixed model, with interval and test.

    The effect is the difference from the reference condition.

    Args:
        fit: Fit returned by statsmodels.
        condition: Name of the condition.
        freedom: Degrees of freedom of the t statistic.
    """
    stats = import_scipy_stats()
    name = f"condition[T.{condition}]"  # of the effect, in statsmodels
    estimate = float(fit.fe_params[name])
    error = float(fit.bse_fe[name])

    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, freedom))
    half_width = quantile * error

    t_statistic = estimate / error
    p_value = 2.0 * float(stats.t.sf(abs(t_statistic), freedom))
    return MixedEffect(
        condition=condition,
        estimate=estimate,
        error=error,
        interval=(estimate - half_width, estimate + half_width),
        t=t_statistic,
        p=p_value,
    )


# --- power ------------------------------------------------------------------------------------


def power(d_z: float, number: int, *, alpha: float = 0.05) -> float:
    """Computes the power of a two-sided paired t test from the noncentral t distribution.

    The power is the probability that the test finds an effect of a given size.

    Source: Cohen, "Statistical power analysis for the behavioral sciences" (1988).

    Args:
        d_z: Effect size: mean of the differences divided by their standard deviation.
        number: Number of participants (or pairs).
        alpha: Significance level.

    Returns:
        The power, between 0 and 1.

    Raises:
        UsageError: `number` is less than two, or `alpha` is not between 0 and 1.
    """
    if number < 2 or not 0.0 < alpha < 1.0:
        raise UsageError(
            f"the number of units is {number} and alpha is {alpha}: "
            "give at least two units, and an alpha between 0 and 1"
        )

    stats = import_scipy_stats()
    shift = abs(d_z) * math.sqrt(number)  # noncentrality of the t statistic
    freedom = number - 1
    critical_t = stats.t.ppf(1.0 - alpha / 2.0, freedom)
    upper_tail = stats.nct.sf(critical_t, freedom, shift)
    # The lower tail is computed from its mirror image: `nct.cdf` returns NaN for small tails.
    lower_tail = stats.nct.sf(critical_t, freedom, -shift)
    return float(upper_tail + lower_tail)


def find_least_number(
    d_z: float, *, wanted: float = 0.8, alpha: float = 0.05, most: int = 10_000
) -> int:
    """Returns the smallest number of participants (or pairs) for a desired power.

    The power is the probability that the test detects an effect that exists.

    Args:
        d_z: Effect size: mean of the differences divided by their standard deviation.
        wanted: Desired power, between 0 and 1.
        alpha: Significance level.
        most: Largest number of participants (or pairs) to try.

    Raises:
        UsageError: More than `most` participants (or pairs) are needed, or `wanted` is not
            between 0 and 1.
    """
    if not 0.0 < wanted < 1.0 or power(d_z, most, alpha=alpha) < wanted:
        raise UsageError(
            f"a power of {wanted} at d_z = {d_z} cannot be reached with {most} units; "
            "give a larger effect or a lower power"
        )

    # The power grows with the number of units, so the number can be found by bisection.
    return bisect_left(
        range(most), wanted, lo=2, key=lambda number: power(d_z, number, alpha=alpha)
    )


class SimulatedPower(NamedTuple):
    """Estimated power: fraction of simulated experiments with a significant difference.

    Args:
        first: Name of the first condition.
        second: Name of the second condition.
        d_z: Effect size in the simulation.
        found: Fraction of experiments with p below alpha.
        interval: 95 % confidence interval of `found`.
        found_holm: Fraction of experiments with the corrected p below alpha.
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
    """Estimates the power for each pair of conditions from simulated experiments.

    Trials are drawn from normal distributions and compared with `compare_conditions`.

    Args:
        means: Mapping from condition to the expected mean of the measure.
        number: Number of participants.
        trial_deviation: Standard deviation between trials.
        trials: Number of trials per participant and condition.
        effect_deviation: Standard deviation of a condition's effect across participants.
        alpha: Significance level of the tests.
        repetitions: Number of simulated experiments.
        seed: Random seed.
    """
    generator = np.random.default_rng(seed)
    experiments: list[list[Comparison]] = []
    for _ in range(repetitions):
        effects = generator.normal(0.0, effect_deviation, (number, len(means), 1))
        noise = generator.normal(0.0, trial_deviation, (number, len(means), trials))
        rows = _list_rows(effects + noise, means)
        experiments.append(compare_conditions(rows, "measure"))
    # Variance of the difference between two means, each of which varies with effect and trial.
    effect_variance = float(effect_deviation) ** 2
    trial_variance = float(trial_deviation) ** 2
    difference_variance = 2.0 * (effect_variance + trial_variance / trials)
    difference_deviation = math.sqrt(difference_variance)

    powers: list[SimulatedPower] = []
    for comparisons in zip(*experiments, strict=True):
        conditions = comparisons[0]  # the same two conditions in all experiments
        difference = float(means[conditions.second] - means[conditions.first])
        d_z = difference / difference_deviation
        powers.append(_count_significant(comparisons, d_z, alpha))
    return powers


def _list_rows(values: Array, means: Mapping[str, float]) -> list[Row]:
    """Converts simulated measurements to table rows like those of a real experiment.

    Args:
        values: Deviations from the means, by participant, condition and trial.
        means: Mapping from condition to expected mean.
    """
    rows: list[Row] = []
    for index, (condition, mean) in enumerate(means.items()):
        for user, deviations in enumerate(values[:, index]):
            for deviation in deviations.tolist():
                measure = mean + deviation
                rows.append({"participant": user, "condition": condition, "measure": measure})
    return rows


def _count_significant(runs: Sequence[Comparison], d_z: float, alpha: float) -> SimulatedPower:
    """Estimates the power: the fraction of simulated experiments that find a difference.

    Args:
        runs: Comparison of the same two conditions in each simulated experiment.
        d_z: Effect size in the simulation: mean difference divided by its standard deviation.
        alpha: Significance level. A difference counts as found if its p (or corrected p) is
            smaller.
    """
    significant_count = sum(run.p is not None and run.p < alpha for run in runs)
    significant_count_holm = sum(run.p_holm is not None and run.p_holm < alpha for run in runs)
    return SimulatedPower(
        first=runs[0].first,
        second=runs[0].second,
        d_z=d_z,
        found=significant_count / len(runs),
        interval=wilson_interval(significant_count, len(runs)),
        found_holm=significant_count_holm / len(runs),
    )

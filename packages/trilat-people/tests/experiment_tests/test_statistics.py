"""Statistics of experiments with people, against published numbers, and what is drawn with a known truth."""

import io
import re
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy import stats
from trilat_people.experiment.condition_figures import draw_conditions
from trilat_people.experiment.statistics import (
    Row,
    average_trials,
    bootstrap_interval,
    compare_conditions,
    correct_holm,
    find_least_number,
    fit_mixed_model,
    power,
    simulate_power,
    summarise_conditions,
)

from trilat_net.errors import UsageError
from trilat_net.files import Extra

# Student (1908), extra hours of sleep under two drugs; the documentation of R's t.test has
# t = -4.0621, df = 9, p-value = 0.002833, 95 percent confidence interval -2.4598858 -0.7001142.
SLEEP = {
    "first": [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
    "second": [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
}


def tidy(values: Mapping[str, Any], trials: int = 1) -> list[Row]:
    """Returns rows of values by condition; two participants make a pair."""
    return [
        {"participant": n, "pair": n // 2, "condition": name, "trial": trial, "time_s": value}
        for name, column in values.items()
        for n, value in enumerate(column)
        for trial in range(trials)
    ]


def draw_rows(
    seed: int,
    number: int,
    effects: list[float],
    *,
    pair_deviation: float = 0.0,
    user_deviation: float = 1.0,
) -> list[Row]:
    """Returns rows of participants in pairs, with drawn deviations of pairs, users and trials."""
    rng = np.random.default_rng(seed)
    of_pairs = np.repeat(rng.normal(0.0, pair_deviation, number // 2), 2)
    of_users = rng.normal(0.0, user_deviation, number)
    values = {}
    for n, effect in enumerate(effects):
        values[f"c{n}"] = of_pairs + of_users + effect + rng.normal(0.0, 1.0, number)
    return tidy(values)


def test_paired_comparison_has_the_published_numbers() -> None:
    (comparison,) = compare_conditions(tidy(SLEEP), "time_s")
    assert (comparison.number, comparison.difference) == (10, pytest.approx(1.58))
    assert comparison.t == pytest.approx(4.0621, abs=5e-5)
    assert comparison.p == pytest.approx(0.002833, abs=5e-7) == comparison.p_holm
    assert comparison.interval == pytest.approx((0.7001142, 2.4598858), abs=5e-8)
    assert comparison.d_z == pytest.approx(4.0621 / np.sqrt(10.0), abs=2e-5)
    spreads = [np.std(SLEEP[name], ddof=1) for name in SLEEP]
    assert comparison.d_av == pytest.approx(1.58 / np.mean(spreads))


def test_signed_ranks_have_the_published_probability() -> None:
    """Of Darwin's plants, in Wilcoxon, "Individual comparisons by ranking methods" (1945)."""
    higher = [6, 8, 14, 16, 23, 24, 28, 29, 41, -48, 49, 56, 60, -67, 75]
    (comparison,) = compare_conditions(tidy({"self": [0] * 15, "cross": higher}), "time_s")
    assert comparison.p_wilcoxon == pytest.approx(0.041259765625)


def test_holm_corrects_as_r_does() -> None:
    """R: p.adjust(c(0.01, 0.04, 0.03, 0.02), "holm") is 0.04 0.06 0.06 0.06."""
    assert correct_holm([0.01, 0.04, None, 0.03, 0.02]) == pytest.approx(
        [0.04, 0.06, None, 0.06, 0.06]
    )
    assert correct_holm([0.9, 0.8]) == [1.0, 1.0]
    assert correct_holm([]) == []


def test_more_trials_are_not_more_participants() -> None:
    (single,) = compare_conditions(tidy(SLEEP, trials=1), "time_s")
    (repeated,) = compare_conditions(tidy(SLEEP, trials=20), "time_s")
    assert single.number == repeated.number
    assert single.p == pytest.approx(repeated.p)


def test_shared_variance_of_pairs_counts_once() -> None:
    rows = [{**row, "pair": row["participant"] // 2} for row in draw_rows(1, 12, [0.0, 1.0])]
    (users,) = compare_conditions(rows, "time_s", unit="participant")
    (pairs,) = compare_conditions(rows, "time_s", unit="pair")
    assert users.number == 12
    assert pairs.number == 6
    assert users.difference == pytest.approx(pairs.difference)


def test_incomplete_participants_are_left_out() -> None:
    rows = draw_rows(2, 8, [0.0, 1.0, 2.0])
    kept = [row for row in rows if row["condition"] != "c2" or row["participant"] != 3]
    empty = [{**row, "time_s": ""} if row not in kept else row for row in rows]
    comparisons = compare_conditions(kept, "time_s")
    numbers = {(pair.first, pair.second): pair.number for pair in comparisons}
    assert numbers == {("c0", "c1"): 8, ("c0", "c2"): 7, ("c1", "c2"): 7}
    assert comparisons == compare_conditions(empty, "time_s")
    texts = [{key: str(value) for key, value in row.items()} for row in kept]
    assert comparisons == compare_conditions(texts, "time_s")


def test_undecidable_numbers_are_none() -> None:
    """One participant, equal differences or no common participant leave tests without numbers."""
    (single,) = compare_conditions(tidy({"a": [1.0], "b": [3.0]}), "time_s")
    assert single.difference == 2.0
    assert single.p is single.interval is single.d_z is None

    equal = tidy({"a": [0.1, 0.2, 0.3], "b": [0.4, 0.5, 0.6]})
    (same,) = compare_conditions(equal, "time_s")
    assert same.t is same.p is same.p_holm is same.p_wilcoxon is None
    assert same.interval == pytest.approx((0.3, 0.3))

    other_participant = {**tidy({"b": [2.0]})[0], "participant": 9}
    (disjoint,) = compare_conditions([*tidy({"a": [1.0]}), other_participant], "time_s")
    assert disjoint.number == 0
    assert disjoint.difference is None


def test_untidy_rows_name_what_is_missing() -> None:
    with pytest.raises(UsageError, match="a row lacks condition"):
        average_trials([{"participant": 1, "time_s": 2.0}], "time_s")
    with pytest.raises(
        UsageError, match="no trial has a number for error_m; the rows contain time_s, trial"
    ):
        average_trials(tidy(SLEEP), "error_m")
    with pytest.raises(
        UsageError, match=r"time_s = 'fast' \(participant 0, condition a, trial 0\)"
    ):
        average_trials(tidy({"a": ["fast"]}), "time_s")
    with pytest.raises(UsageError, match="give a finite number"):
        average_trials(tidy({"a": [np.inf]}), "time_s")


# --- intervals -------------------------------------------------------------------------------------------


def test_condition_intervals_are_student_and_bootstrap() -> None:
    first, second = summarise_conditions(tidy(SLEEP), "time_s")
    assert (first.condition, first.number, first.mean) == ("first", 10, pytest.approx(0.75))
    expected = stats.t.interval(0.95, 9, loc=0.75, scale=stats.sem(SLEEP["first"]))
    assert first.interval == pytest.approx(expected)
    assert second.bootstrap[0] < second.mean < second.bootstrap[1]
    assert (second.mean - second.bootstrap[0]) == pytest.approx(
        second.mean - second.interval[0], rel=0.25
    )
    (alone,) = summarise_conditions(tidy({"a": [2.0]}), "time_s")
    assert alone == ("a", 1, 2.0, None, None, None, 0)


def test_bootstrap_follows_seed_and_asymmetry() -> None:
    times_s = np.exp(np.random.default_rng(5).normal(0.0, 1.0, 25)).tolist()
    low, high = bootstrap_interval(times_s, 7)
    assert (low, high) == bootstrap_interval(times_s, 7) != bootstrap_interval(times_s, 8)
    assert high - np.mean(times_s) > 1.2 * (np.mean(times_s) - low)
    assert bootstrap_interval([2.0, 2.0, 2.0]) == (2.0, 2.0)
    assert bootstrap_interval([2.0]) is None


def test_bootstrap_covers_the_truth_as_stated() -> None:
    draws = np.random.default_rng(11).normal(3.0, 1.0, (120, 20))
    intervals = [bootstrap_interval(row.tolist()) for row in draws]
    assert np.mean([low <= 3.0 <= high for low, high in intervals]) > 0.87


# --- mixed model -----------------------------------------------------------------------------------------


@pytest.fixture
def statsmodels() -> None:
    pytest.importorskip("statsmodels", reason="the extra stats")


@pytest.mark.usefixtures("statsmodels")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("pair_deviation", [0.0, 1.0])
def test_balanced_mixed_model_is_the_paired_t_test(seed: int, pair_deviation: float) -> None:
    """Also where the variance of pairs is estimated as 0."""
    rows = draw_rows(seed, 16, [0.0, 0.8], pair_deviation=pair_deviation, user_deviation=1.5)
    model = fit_mixed_model(rows, "time_s")
    (paired,) = compare_conditions(rows, "time_s")
    (effect,) = model.effects
    assert effect.estimate == pytest.approx(paired.difference, rel=1e-9)
    assert model.variances["participant"] > 0.0
    assert (effect.t, effect.p) == pytest.approx((paired.t, paired.p), rel=2e-3)
    assert effect.interval == pytest.approx(paired.interval, rel=2e-3)


@pytest.mark.usefixtures("statsmodels")
def test_mixed_model_of_three_equals_anova() -> None:
    rows = draw_rows(4, 16, [0.0, 0.5, 1.0], pair_deviation=1.5)
    model = fit_mixed_model(rows, "time_s")
    means = average_trials(rows, "time_s")
    table = np.array([list(means_of_units.values()) for means_of_units in means.values()])
    rest = table - table.mean(axis=0) - table.mean(axis=1, keepdims=True) + table.mean()
    assert model.freedom == 15 * 2
    error = np.sqrt(2.0 * (rest**2).sum() / model.freedom / 16)
    assert [effect.error for effect in model.effects] == pytest.approx([error] * 2, rel=1e-3)
    assert model.variances["residual"] == pytest.approx(
        (rest**2).sum() / model.freedom, rel=1e-3
    )
    assert model.reference == "c0"


@pytest.mark.usefixtures("statsmodels")
def test_mixed_model_finds_the_variances_that_were_drawn() -> None:
    model = fit_mixed_model(
        draw_rows(5, 240, [0.0, 0.2], pair_deviation=2.0, user_deviation=1.5), "time_s"
    )
    variances = [model.variances[name] for name in ("pair", "participant", "residual")]
    assert variances == pytest.approx([4.0, 2.25, 1.0], rel=0.3)


@pytest.mark.usefixtures("statsmodels")
def test_mixed_model_takes_participants_who_lack_a_condition() -> None:
    rows = [
        row
        for row in draw_rows(6, 24, [0.0, 2.0], pair_deviation=1.0)
        if row["participant"] or row["condition"] == "c0"
    ]
    model = fit_mixed_model(rows, "time_s")
    assert model.freedom == 22
    assert model.effects[0].interval[0] < 2.0 < model.effects[0].interval[1]


@pytest.mark.usefixtures("statsmodels")
def test_mixed_model_refuses_rows_without_one_pair_each() -> None:
    with pytest.raises(UsageError, match="participant 0 is in pairs 0 and 7"):
        fit_mixed_model([*tidy(SLEEP), {**tidy(SLEEP)[0], "pair": 7}], "time_s")
    for pairs in ({"pair": ""}, {"pair": None}):
        with pytest.raises(UsageError, match="no pair has two participants"):
            fit_mixed_model([{**row, **pairs} for row in tidy(SLEEP)], "time_s")
    with pytest.raises(UsageError, match="no pair has two participants"):
        fit_mixed_model([{**row, "pair": row["participant"]} for row in tidy(SLEEP)], "time_s")
    with pytest.raises(UsageError, match="no mixed model can be fitted"):
        fit_mixed_model(tidy({"a": [1.0] * 6, "b": [1.0] * 6}), "time_s")
    with pytest.raises(UsageError, match="2 means of 2 participants under"):
        fit_mixed_model(tidy({"a": [1.0, 2.0]}), "time_s")


def test_mixed_model_without_its_package_names_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "statsmodels.formula.api", None)
    hint = f"mixed models need statsmodels: {Extra('stats').install_command}"
    with pytest.raises(UsageError, match=re.escape(hint)):
        fit_mixed_model(tidy(SLEEP), "time_s")


# --- power -----------------------------------------------------------------------------------------------


def test_power_has_the_published_values() -> None:
    """The first is the example of G*Power's guide, the second of pwr.t.test in R."""
    assert power(0.421637, 50) == pytest.approx(0.832114, abs=5e-7)
    assert power(0.5, 34) == pytest.approx(0.8077775, abs=5e-8)
    assert power(-0.5, 34) == power(0.5, 34)
    assert power(0.0, 12) == pytest.approx(0.05)


@pytest.mark.parametrize(("d_z", "number"), [(20.0, 2), (0.3, 100), (0.2, 1000), (0.5, 5000)])
def test_power_is_the_chance_over_drawn_spreads(d_z: float, number: int) -> None:
    """The integral of a normal over the chi distribution of the standard deviation."""
    spread = stats.chi(number - 1).ppf((np.arange(20_000) + 0.5) / 20_000) / np.sqrt(number - 1)
    critical = stats.t.ppf(0.975, number - 1) * spread
    shift = d_z * np.sqrt(number)
    chance = stats.norm.cdf(shift - critical) + stats.norm.cdf(-shift - critical)
    assert power(d_z, number) == pytest.approx(chance.mean(), abs=1e-5)


def test_least_number_is_the_first_with_enough_power() -> None:
    for d_z, wanted in ((0.5, 0.8), (0.8, 0.9), (1.6, 0.95)):
        number = find_least_number(d_z, wanted=wanted)
        assert power(d_z, number) >= wanted > power(d_z, number - 1)
    assert find_least_number(0.5) == 34
    with pytest.raises(UsageError, match="cannot be reached with 100 units"):
        find_least_number(0.1, most=100)


@pytest.mark.parametrize(
    ("number", "effect", "trials", "effect_deviation"), [(34, 0.5, 1, 0.0), (12, 0.8, 4, 0.6)]
)
def test_simulated_power_agrees_with_the_formula(
    number: int, effect: float, trials: int, effect_deviation: float
) -> None:
    (comparison,) = simulate_power(
        {"near": 0.0, "far": effect},
        number,
        trial_deviation=np.sqrt(0.5),
        trials=trials,
        effect_deviation=effect_deviation,
        repetitions=400,
        seed=2,
    )
    assert comparison.d_z == pytest.approx(
        effect / np.sqrt(1.0 / trials + 2.0 * effect_deviation**2)
    )
    assert comparison.interval[0] <= power(comparison.d_z, number) <= comparison.interval[1]
    assert comparison.found_holm == comparison.found


def test_correction_costs_power_and_keeps_its_order() -> None:
    comparisons = simulate_power(
        {"a": 0.0, "b": 0.0, "c": 1.0}, 12, trial_deviation=0.8, repetitions=150, seed=3
    )
    assert [(pair.first, pair.second) for pair in comparisons] == [
        ("a", "b"),
        ("a", "c"),
        ("b", "c"),
    ]
    assert all(pair.found_holm <= pair.found for pair in comparisons)
    assert comparisons[0].found_holm < 0.1 < 0.5 < comparisons[1].found_holm


def test_without_effect_families_keep_alpha() -> None:
    runs = [
        compare_conditions(draw_rows(seed, 10, [0.0, 0.0, 0.0]), "time_s")
        for seed in range(300)
    ]
    for n in range(3):
        assert stats.kstest([run[n].p for run in runs], "uniform").pvalue > 0.01
    families = sum(min(pair.p_holm for pair in run) < 0.05 for run in runs)
    assert families <= stats.binom.ppf(0.999, 300, 0.05)


# --- figure ------------------------------------------------------------


ROWS_WITH_A_GAP = [
    row
    for row in draw_rows(9, 6, [0.0, 1.0, 2.0])
    if row["participant"] != 4 or row["condition"] != "c1"
]
"""Rows of six participants, one of whom lacks a condition."""


def test_every_participant_is_drawn_under_every_condition() -> None:
    """The figure has each participant's mean, and each condition's mean with its interval."""
    rows = ROWS_WITH_A_GAP
    figure = draw_conditions(rows, "time_s")
    (axes,) = figure.axes
    drawn_points = set()
    for line in axes.lines:
        for x, y in zip(*line.get_data(), strict=True):
            drawn_points.add((float(x), float(y)))
    for n, (name, means) in enumerate(average_trials(rows, "time_s").items()):
        assert axes.get_xticklabels()[n].get_text() == f"{name}\nn = {len(means)}"
        assert {(float(n), mean) for mean in means.values()} <= drawn_points
    for n, summary in enumerate(summarise_conditions(rows, "time_s")):
        low, high = summary.interval
        assert {(float(n), value) for value in (low, summary.mean, high)} <= drawn_points
    assert axes.get_ylabel() == "time, s"


def test_equal_rows_give_equal_pictures() -> None:
    pictures = []
    for _ in range(2):
        file = io.BytesIO()
        draw_conditions(ROWS_WITH_A_GAP, "time_s").savefig(file, format="png")
        pictures.append(file.getvalue())
    assert pictures[0] == pictures[1]

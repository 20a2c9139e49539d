"""Completion times that a limit cuts off: medians by Kaplan and Meier, intervals, sign tests."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from trilat_people.experiment.completion_times import (
    compare_times,
    find_median,
    find_unit_medians,
    is_completed,
    summarise_times,
)
from trilat_people.experiment.condition_figures import draw_learning, draw_times
from trilat_people.experiment.statistics import Row

LIMIT_S = 20.0
Times = dict[str, dict[str, list[float]]]


def make_time_rows(times_s: Times) -> list[Row]:
    """Returns rows of trials from their times by condition and participant.

    Trials of the limit or longer were not completed.
    """
    rows = []
    for condition, times_of_participants_s in times_s.items():
        for participant, times_of_trials_s in times_of_participants_s.items():
            for trial, time_s in enumerate(times_of_trials_s, 1):
                row = {
                    "condition": condition,
                    "participant": participant,
                    "trial": trial,
                    "completion_s": min(time_s, LIMIT_S),
                    "succeeded": int(time_s < LIMIT_S),
                }
                rows.append(row)
    return rows


@given(st.lists(st.floats(0.1, 40.0), min_size=1, max_size=15, unique=True))
def test_a_median_is_that_of_kaplan_and_meier(times_s: list[float]) -> None:
    """SciPy's estimate of the survival function falls to one half at it."""
    median = find_unit_medians(make_time_rows({"c": {"P1": times_s}}))["c"]["P1"]
    completed = [time_s for time_s in times_s if time_s < LIMIT_S]
    if 2 * len(completed) <= len(times_s):
        assert math.isinf(median)
        return
    sample = stats.CensoredData(
        uncensored=completed, right=[LIMIT_S] * (len(times_s) - len(completed))
    )
    survival = stats.ecdf(sample).sf
    at_median = survival.quantiles[np.searchsorted(-survival.probabilities, -0.5 - 1e-12)]
    if len(times_s) % 2:
        assert median == pytest.approx(at_median)
    else:  # half of the trials are over from there to the next time: the median lies in the middle
        assert at_median <= median


def test_the_limit_is_never_averaged() -> None:
    """Whatever the limit was, medians and signs are the same."""
    rows = make_time_rows({"near": {"P1": [5, 6, 7]}, "far": {"P1": [9.0, 30.0, 40.0]}})
    other = [
        {**row, "completion_s": row["completion_s"] if row["succeeded"] else 99.0}
        for row in rows
    ]
    assert find_unit_medians(rows) == find_unit_medians(other)
    near, far = summarise_times(rows, LIMIT_S)
    assert near.median == 6.0
    assert near.censored == 0
    assert far.median is None
    assert far.trials == 3
    assert far.censored == far.timed_out == 2


def test_failing_before_the_limit_is_counted_apart() -> None:
    """A trial that left its corridor is censored as one that took too long, but not timed out."""
    rows = make_time_rows({"c": {"P1": [3.0, 4.0, 5.0, 30.0]}})
    rows[1] = {**rows[1], "succeeded": 0}
    (summary,) = summarise_times(rows, LIMIT_S)
    assert summary.trials == 4
    assert summary.censored == 2
    assert summary.timed_out == 1
    assert summary.median is None


def test_rows_of_a_csv_file_say_the_same() -> None:
    rows = make_time_rows({"a": {"P1": [3.0, 30.0, 5.0]}})
    texts = [{key: str(value) for key, value in row.items()} for row in rows]
    assert summarise_times(texts, LIMIT_S) == summarise_times(rows, LIMIT_S)
    assert is_completed({"completion_s": 1.0})


def find_interval(medians_s: list[float]) -> tuple[float, float | None] | None:
    """Returns the interval of the median of participants with one trial each."""
    times_s = {f"P{n}": [median_s] for n, median_s in enumerate(medians_s)}
    (summary,) = summarise_times(make_time_rows({"c": times_s}), LIMIT_S)
    return summary.interval


@given(st.lists(st.floats(0.1, 19.9), min_size=6, max_size=30))
def test_median_intervals_are_those_of_scipy(times_s: list[float]) -> None:
    expected = stats.quantile_test(times_s, q=1.0, p=0.5).confidence_interval(0.95)
    interval = find_interval(times_s)
    assert interval == pytest.approx((float(expected.low), float(expected.high)))


def test_an_interval_may_be_open_above() -> None:
    """A trial of 40 s did not end before the limit of 20 s."""
    assert find_interval([1.0] * 5) is None  # five cannot enclose a median with 95 %
    assert find_interval([1.0, 2.0, 3.0, 4.0, 5.0, 40.0]) == (1.0, None)
    assert find_interval([40.0] * 8) is None
    assert find_median([2.0, math.inf]) == math.inf


def test_signs_use_censored_times_and_no_more() -> None:
    slow = {f"P{n}": [15.0 + n, 40.0, 40.0] for n in range(8)}
    rows = make_time_rows(
        {"fast": {f"P{n}": [8.0 + n, 9.0 + n, 30.0] for n in range(8)}, "slow": slow}
    )
    (comparison,) = compare_times(rows)
    assert comparison.number == comparison.longer == 8
    assert comparison.shorter == 0
    assert comparison.p == pytest.approx(2.0 * 0.5**8)
    assert comparison.difference is None  # the limit hides it


def test_ties_and_the_difference_of_measured_medians() -> None:
    """One of five was not reached under both conditions; the median of the others' differences stands."""
    first = {f"P{n}": [float(5 + n)] for n in range(5)} | {"P4": [50.0]}
    second = {f"P{n}": [float(7 + n)] for n in range(5)} | {"P4": [50.0]}
    (comparison,) = compare_times(make_time_rows({"a": first, "b": second}))
    assert comparison.number == 5
    assert comparison.longer == 4
    assert comparison.shorter == 0
    assert comparison.difference == 2.0
    assert comparison.p == pytest.approx(2.0 * 0.5**4)


def test_all_comparisons_are_corrected_together() -> None:
    """Each of three equally clear comparisons has three times its probability."""
    times_s = {
        condition: {f"P{n}": [base_s + n] for n in range(8)}
        for condition, base_s in (("a", 1.0), ("b", 2.0), ("c", 3.0))
    }
    comparisons = compare_times(make_time_rows(times_s))
    pairs = [(comparison.first, comparison.second) for comparison in comparisons]
    assert pairs == [*combinations("abc", 2)]
    for comparison in comparisons:
        assert comparison.p is not None
        assert comparison.p_holm == 3.0 * comparison.p


def test_open_markers_stand_on_the_limit() -> None:
    rows = make_time_rows({"near": {"P1": [5.0, 6.0]}, "far": {"P1": [9.0, 30.0]}})
    for figure in (
        draw_times(rows, LIMIT_S),
        draw_learning(rows, "completion_s", limit_s=LIMIT_S),
    ):
        (axes,) = figure.axes
        hollow = [
            line
            for line in axes.lines
            if line.get_markerfacecolor() == "white" and len(line.get_xdata())
        ]
        assert hollow
        assert {float(y) for line in hollow for y in np.asarray(line.get_ydata())} == {LIMIT_S}

"""Intervals of shares: published values, and how often they hold the truth, counted exactly."""

import math

import numpy as np
import pytest

from trilat_net.studies.sweep.sweep_results import wilson_interval


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_intervals_are_those_of_a_published_table(successes: int, runs: int, low: float, high: float) -> None:
    """Newcombe, Statistics in Medicine 17 (1998), table I, the score method without continuity correction."""
    assert wilson_interval(successes, runs) == pytest.approx((low, high), abs=5.1e-5)


@pytest.mark.parametrize("runs", [10, 20, 100])
def test_the_truth_lies_inside_95_times_of_100_on_the_average_over_shares(runs: int) -> None:
    """Coverage by the binomial sums, over even shares: 0.95 within 0.01; nowhere below 0.83."""
    shares = np.linspace(0.0005, 0.9995, 1000)
    held = np.zeros(len(shares))
    for seen in range(runs + 1):
        weight = math.comb(runs, seen) * shares**seen * (1.0 - shares) ** (runs - seen)
        low, high = wilson_interval(seen, runs)
        held += np.where((low <= shares) & (shares <= high), weight, 0.0)
    assert held.mean() == pytest.approx(0.95, abs=0.01)
    assert held.min() > 0.83


def test_without_runs_nothing_is_known() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)

"""Virtual runs against the delay-differential equations, solved by another method.

Eq. (6), (8)-(10), (13), (15) in continuous time; what is sampled must converge to them.
"""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from tests.theory.delay_equations import DelayEquations, equations
from tests.virtual_runs import sampled
from trilat_net.scenario import load_scenario

DURATION_S = 20.0
TIMES_S = np.arange(0.01, DURATION_S, 0.01)


@cache
def exact(name: str) -> DelayEquations:
    return equations(load_scenario(name)).solve(DURATION_S)


@cache
def distance(name: str, scheme: str, rate_hz: int) -> float:
    """max abs(dq) over 20 s, every site and joint, a tick every 10 ms."""
    made = sampled(load_scenario(name, {"scheme": scheme, "rate_hz": rate_hz}), TIMES_S)
    return float(np.abs(made[..., :2] - exact(name).at(TIMES_S - 1.0 / rate_hz)[..., :2]).max())


def order(name: str, scheme: str) -> list[float]:
    errors = [distance(name, scheme, rate_hz) for rate_hz in (500, 1000, 2000)]
    return [float(np.log2(coarse / fine)) for coarse, fine in pairwise(errors)]


def test_the_reference_solution_holds_more_digits_than_it_is_asked_for() -> None:
    """The hands-free start of Section IV: with theta_hat(0) = 0 both joints fall with (-g, +g)."""
    paper = exact("paper")
    first = paper.rate(0.0, paper.past(-1.0).ravel()).reshape(3, 9)
    assert np.allclose(first[:, 2:4], [-9.81, 9.81], atol=1e-12)
    halves = equations(load_scenario("paper"))
    halves.edges_s += [float(t) for t in np.arange(0.1, 5.0, 0.2)]  # other pieces, other steps
    times = np.linspace(0.0, 5.0, 501)
    assert np.abs(halves.solve(5.0).at(times) - paper.at(times)).max() < 1e-8


@pytest.mark.parametrize(
    ("name", "bound"),
    [("paper", 1e-5), pytest.param("paper_rods", 1e-5, marks=pytest.mark.long), ("free", 1.1e-5)],
)
def test_second_order_is_within_1e_5_rad_of_the_exact_solution(name: str, bound: float) -> None:
    assert distance(name, "second_order", 1000) <= bound


def test_a_delay_one_tick_off_is_not_what_this_comparison_can_show() -> None:
    """It moves q by some 5e-4 rad, below what `digital` is off: the bookkeeping has tests of its own."""
    early, right, late = (
        sampled(load_scenario("paper", {"link.delay_ms": delay_ms}), TIMES_S)[..., :2]
        for delay_ms in (199.0, 200.0, 201.0)
    )
    for slipped in (early, late):
        assert np.abs(slipped - right).max() == pytest.approx(4.9e-4, rel=0.1)


@pytest.mark.parametrize("name", ["paper", pytest.param("free", marks=pytest.mark.long)])
def test_second_order_converges_with_order_two(name: str) -> None:
    assert order(name, "second_order") == pytest.approx([2.0, 2.0], abs=0.1)


def test_digital_is_some_milliradians_off() -> None:
    assert distance("paper", "digital", 1000) == pytest.approx(3.0e-3, rel=0.1)


def test_digital_converges_with_order_one() -> None:
    assert order("paper", "digital") == pytest.approx([1.0, 1.0], abs=0.1)

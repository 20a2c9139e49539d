"""Virtual runs against the delay-differential equations, solved by another method.

Eq. (6), (8)-(10), (13), (15) in continuous time, to which the sampled runs must converge.
"""

import numpy as np
import pytest

from tests.execution.builders import sample_records
from tests.theory.delay_equations import (
    TIMES_S,
    make_equations,
    measure_distance,
    measure_orders,
    solve_exactly,
)
from trilat_net.scenario import load_scenario


@pytest.mark.long
def test_reference_solution_has_digits_to_spare() -> None:
    """The hands-free start of Section IV: with theta_hat(0) = 0 both joints fall with (-g, +g)."""
    paper = solve_exactly("paper")
    first = paper.rate(0.0, paper.past(-1.0).ravel()).reshape(3, 9)
    assert np.allclose(first[:, 2:4], [-9.81, 9.81], atol=1e-12)
    halves = make_equations(load_scenario("paper"))
    halves.edges_s += [float(t) for t in np.arange(0.1, 5.0, 0.2)]  # other pieces, other steps
    times = np.linspace(0.0, 5.0, 501)
    assert np.abs(halves.solve(5.0).at(times) - paper.at(times)).max() < 1e-8


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("paper", 1e-5),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("paper_rods", 1e-5), ("free", 1.1e-5))
        ),
    ],
)
def test_second_order_is_within_1e_5_rad(name: str, bound: float) -> None:
    assert measure_distance(name, "second_order", 1000) <= bound


def test_the_comparison_detects_delays_one_tick_off() -> None:
    """One tick moves q by some 5e-4 rad, less than the error of `digital`: the delays have
    tests of their own.
    """
    early, right, late = (
        sample_records(load_scenario("paper", {"link.delay_ms": delay_ms}), TIMES_S)[..., :2]
        for delay_ms in (199.0, 200.0, 201.0)
    )
    for slipped in (early, late):
        assert np.abs(slipped - right).max() == pytest.approx(4.9e-4, rel=0.1)


@pytest.mark.parametrize("name", ["paper", pytest.param("free", marks=pytest.mark.long)])
def test_second_order_converges_with_order_two(name: str) -> None:
    assert measure_orders(name, "second_order") == pytest.approx([2.0, 2.0], abs=0.1)


def test_digital_is_some_milliradians_off() -> None:
    assert measure_distance("paper", "digital", 1000) == pytest.approx(3.0e-3, rel=0.1)


def test_digital_converges_with_order_one() -> None:
    assert measure_orders("paper", "digital") == pytest.approx([1.0, 1.0], abs=0.1)

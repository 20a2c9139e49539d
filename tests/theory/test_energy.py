"""The energy balance of the corrected Lyapunov functional, Eq. (16)-(22), along virtual runs."""

import numpy as np
import pytest

from tests.theory.energy import DURATION_S, balance, booked, left_null_vector, order
from tests.virtual_runs import run

RATES = pytest.mark.parametrize("rate_hz", [1000, pytest.param(2000, marks=pytest.mark.long)])


@pytest.mark.parametrize("name", ["paper", pytest.param("asymmetric", marks=pytest.mark.long)])
def test_the_balance_closes_to_2e_5_of_the_largest_v(name: str) -> None:
    assert booked(name).residual <= 2e-5


@RATES
@pytest.mark.parametrize("name", [pytest.param("paper", marks=pytest.mark.long), "asymmetric"])
def test_its_error_is_of_second_order(name: str, rate_hz: int) -> None:
    assert order(name, "second_order", rate_hz) == pytest.approx(2.0, abs=0.1)


@pytest.mark.long
@RATES
def test_digital_closes_it_to_some_percent_with_order_one(rate_hz: int) -> None:
    assert booked("paper", "digital").residual == pytest.approx(1.5e-2, rel=0.2)
    assert order("paper", "digital", rate_hz) == pytest.approx(1.0, abs=0.1)


def test_the_hands_do_work_that_the_balance_needs() -> None:
    b = booked("paper")
    assert np.abs(b.given).max() > 0.01 * b.V.max()


@pytest.mark.long
def test_beta_of_ones_fails_unless_columns_sum_to_one() -> None:
    """The paper sets beta = (1, 1, 1) after Eq. (20): that is the right null vector, not the left one."""
    made = run("asymmetric", {"duration_s": DURATION_S})
    assert balance(made, np.full(3, 1 / 3)).residual > 1e-2


@pytest.mark.parametrize("name", ["free", "paper"])
def test_v_never_rises_while_nobody_pushes(name: str) -> None:
    """The theorem, in free motion; `paper` is free before its first pulse and after its last one."""
    b = booked(name)
    free = np.diff(b.given) == 0.0
    assert free.sum() > 8000
    rise = np.diff(b.V)[free]
    assert rise.max() <= 5e-8 * b.V.max()


@pytest.mark.long
def test_v_rises_while_a_hand_pushes() -> None:
    b = booked("paper_rods")
    assert np.diff(b.V).max() > 1e-5


@pytest.mark.long
def test_sites_may_scale_kd_if_beta_is_divided_by_scale() -> None:
    """Kd_i = c_i Kbar needs beta_i = pi_i / c_i; the paper's ones let V rise by a third of itself."""
    scale = {"m1": 10.0, "m2": 3.0, "s": 0.3}
    rows = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.8, "s": 0.2}, "s": {"m1": 0.8, "m2": 0.2}}
    made = run(
        "free",
        {
            **{f"dominance.{i}.{j}": share for i, row in rows.items() for j, share in row.items()},
            **{f"sites.{name}.control.Kd": c for name, c in scale.items()},
            "control.Kp": 0.1,
            "duration_s": DURATION_S,
        },
    )
    right = balance(made, left_null_vector(made.scenario) / list(scale.values()))
    assert np.diff(right.V).max() <= 5e-8 * right.V.max()
    assert right.residual <= 5e-5
    ones = balance(made, np.ones(3)).V
    assert (ones - np.minimum.accumulate(ones)).max() == pytest.approx(12.3, abs=0.2)
    assert ones[0] == pytest.approx(32.8, abs=0.1)

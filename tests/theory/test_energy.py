"""The energy balance of the corrected Lyapunov functional, Eq. (16)-(22), along virtual runs."""

import numpy as np
import pytest

from tests.theory.energy import Balance, balance, left_null_vector
from tests.virtual_runs import run

DURATION_S = 20.0


def booked(name: str, scheme: str = "second_order", rate_hz: int = 1000) -> Balance:
    made = run(name, {"scheme": scheme, "rate_hz": rate_hz, "duration_s": DURATION_S})
    return balance(made, left_null_vector(made.scenario))


def order(name: str, scheme: str) -> list[float]:
    residuals = [booked(name, scheme, rate_hz).residual for rate_hz in (500, 1000, 2000)]
    return [float(np.log2(coarse / fine)) for coarse, fine in zip(residuals, residuals[1:], strict=False)]


@pytest.mark.parametrize("name", ["paper", "asymmetric"])
def test_the_balance_closes_to_2e_5_of_the_largest_v(name: str) -> None:
    assert booked(name).residual <= 2e-5


@pytest.mark.parametrize("name", ["paper", "asymmetric"])
def test_its_error_is_of_second_order(name: str) -> None:
    assert order(name, "second_order") == pytest.approx([2.0, 2.0], abs=0.1)


def test_digital_closes_it_to_some_percent_with_order_one() -> None:
    assert booked("paper", "digital").residual == pytest.approx(1.5e-2, rel=0.2)
    assert order("paper", "digital") == pytest.approx([1.0, 1.0], abs=0.1)


def test_the_hands_do_work_that_the_balance_needs() -> None:
    b = booked("paper")
    assert np.abs(b.given).max() > 0.01 * b.V.max()


def test_beta_of_ones_does_not_close_it_where_the_columns_do_not_sum_to_one() -> None:
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
    assert rise.max() <= 1e-9 * b.V.max()


def test_v_rises_while_a_hand_pushes() -> None:
    b = booked("paper_rods")
    assert np.diff(b.V).max() > 1e-5


def test_with_beta_of_ones_v_rises_in_free_motion_of_unequal_shares() -> None:
    """Kd = 10 makes it plain, and the left null vector of the same run never lets V rise."""
    shares = {
        "dominance.m1.m2": 0.1,
        "dominance.m1.s": 0.9,
        "dominance.m2.m1": 0.8,
        "dominance.m2.s": 0.2,
        "dominance.s.m1": 0.8,
        "dominance.s.m2": 0.2,
    }
    made = run("free", {**shares, "control.Kd": 10.0, "control.Kp": 0.1, "duration_s": DURATION_S})
    beta = left_null_vector(made.scenario)
    assert np.diff(balance(made, beta).V).max() <= 1e-6
    assert np.diff(balance(made, np.full(3, 1 / 3)).V).max() > 1e-3

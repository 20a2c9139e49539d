"""The adaptive law, Eq. (9)-(13), (15), (18), leaf by leaf."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core import physical_arms as physics
from tests.core.physical_arms import Array, angles, links, speeds
from trilat_net.core.arms.two_link_arm import ArmLinks, regressor
from trilat_net.core.step import control

gains = physics.vectors(st.floats(0.1, 20.0))
NO_LIMIT = 1e300


@given(q=angles, qd=speeds, q_des=angles, qd_des=speeds, Lambda=gains)
def test_errors(q: Array, qd: Array, q_des: Array, qd_des: Array, Lambda: Array) -> None:
    """Eq. (9), (18), (10)."""
    e, ed, r = control.control_errors(q, qd, q_des, qd_des, Lambda)
    assert list(e) == (q - q_des).tolist()
    assert list(ed) == (qd - qd_des).tolist()
    assert r == pytest.approx(qd + Lambda * (q - q_des), rel=1e-14)


@given(a=links, q=angles, qd=speeds, e=angles, ed=speeds, Lambda=gains, Kp=gains, Kd=gains)
def test_torque(
    a: ArmLinks, q: Array, qd: Array, e: Array, ed: Array, Lambda: Array, Kp: Array, Kd: Array
) -> None:
    """Eq.

    (11) equals Eq. (13): estimated M, C and G of a wrong arm, and the two damping terms.
    """
    r = qd + Lambda * e
    Y = regressor(9.81, q, qd, -Lambda * e, -Lambda * ed)
    tau = np.array(control.adaptive_torque(Y, a.theta(), Kp, Kd, r, ed, NO_LIMIT))
    wanted = (
        -physics.inertia(a, q) @ (Lambda * ed)
        - physics.coriolis(a, q, qd) @ (Lambda * e)
        + physics.gravity(a, 9.81, q)
        - Kp * r
        - Kd * ed
    )
    assert np.abs(tau - wanted).max() <= 1e-12 * (
        1 + np.abs(wanted).max() + 1e4 * a.theta().sum()
    )


@given(limit=st.floats(0.1, 100.0), ed=speeds)
def test_torque_is_held_within_its_limit(limit: float, ed: Array) -> None:
    ones = np.ones(2)
    none = np.zeros(2)
    tau = control.adaptive_torque(
        ((0.0,) * 5,) * 2, np.zeros(5), ones, 7.0 * ones, none, ed, limit
    )
    assert list(tau) == np.clip(-7.0 * ed, -limit, limit).tolist()


@given(q=angles, qd=speeds, v=speeds, a=speeds, r=speeds, gain_s=st.floats(0, 0.1))
def test_the_estimate_descends_gamma_y_transpose_r(
    q: Array, qd: Array, v: Array, a: Array, r: Array, gain_s: float
) -> None:
    """Eq. (15)."""
    Y = regressor(9.81, q, qd, v, a)
    Yr = control.regressor_transpose_times(Y, r)
    wanted = np.array(Y).T @ r
    assert Yr == pytest.approx(wanted, abs=1e-11)
    Gamma = np.array([1.0, 0.5, 0.0, 2.0, 3.0])
    theta_hat = control.update_estimate(np.arange(5.0), gain_s, Gamma, Yr)
    assert theta_hat == pytest.approx(np.arange(5.0) - gain_s * Gamma * wanted, abs=1e-9)
    assert theta_hat[2] == 2.0

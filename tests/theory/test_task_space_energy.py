"""V of task space falls as documented: along a closed loop of textbook equations that SciPy
integrates.

One two-link arm of point masses follows the delayed place of a peer that moves freely. Its
equations are written here, its reference acceleration is a complex step, and no code of the
program is used. The corrected Lyapunov functional, Eq. (16)-(22), along virtual runs; its
balance closes in `tests/analysis/certificate/test_energy_balance.py`.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.theory.energy import compute_shipped_balance

Vector = NDArray[np.float64]
T = 0.3
G = 9.81
LAMBDA = np.array([1.5, 0.7])
KP = np.array([3.0, 2.0])
KD = np.array([8.0, 5.0])
GAMMA = 0.4
THETA = np.array([3.0, 1.0, 1.0, 2.0, 1.0])
STEP = 1e-30


def move_peer(t: float) -> tuple[Vector, Vector, Vector]:
    """Returns place, velocity and acceleration of the peer."""
    turn = np.array([1.3, 0.9]) * t + np.array([0.2, 1.0])
    rate = np.array([1.3, 0.9])
    size = np.array([0.15, 0.2])
    middle = np.array([0.9, 0.8])
    return (
        middle + size * np.sin(turn),
        size * rate * np.cos(turn),
        -size * rate**2 * np.sin(turn),
    )


def tip_place(q: Vector) -> Vector:
    both = q[0] + q[1]
    return np.array([np.cos(q[0]) + np.cos(both), np.sin(q[0]) + np.sin(both)])


def jacobian(q: Vector) -> Vector:
    both = q[0] + q[1]
    return np.array(
        [
            [-np.sin(q[0]) - np.sin(both), -np.sin(both)],
            [np.cos(q[0]) + np.cos(both), np.cos(both)],
        ]
    )


def regressor(q: Vector, qd: Vector, v: Vector, a: Vector) -> Vector:
    """Returns M a + C v + G of the textbook, C of Christoffel's symbols, as a matrix of its parameters."""
    c = np.cos(q[1])
    s = np.sin(q[1])
    single = G * np.cos(q[0])
    both = G * np.cos(q[0] + q[1])
    first = 2 * c * a[0] + c * a[1] - s * (qd[1] * v[0] + (qd[0] + qd[1]) * v[1])
    return np.array(
        [
            [a[0], first, a[1], single, both],
            [0.0, c * a[0] + s * qd[0] * v[0], a[0] + a[1], 0.0, both],
        ]
    )


def inertia(q: Vector) -> Vector:
    bend = THETA[1] * np.cos(q[1])
    return np.array([[THETA[0] + 2 * bend, THETA[2] + bend], [THETA[2] + bend, THETA[2]]])


def reference(q: Vector, x_des: Vector) -> Vector:
    return np.linalg.solve(jacobian(q), -LAMBDA * (tip_place(q) - x_des))


def evaluate_loop(
    t: float, q: Vector, qd: Vector, theta_hat: Vector
) -> tuple[Vector, Vector, Vector, Vector]:
    """Returns the sliding variable, the error's derivative, qdd and the estimate's derivative."""
    x_des, xd_des, _ = move_peer(t - T)
    J = jacobian(q)
    v = reference(q, x_des)
    a = np.imag(reference(q + 1j * STEP * qd, x_des + 1j * STEP * xd_des)) / STEP
    r = qd - v
    ed = J @ qd - xd_des
    Y = regressor(q, qd, v, a)
    tau = Y @ theta_hat - KP * r - J.T @ (KD * ed)
    bias = regressor(q, qd, qd, np.zeros(2)) @ THETA
    return r, ed, np.linalg.solve(inertia(q), tau - bias), -GAMMA * Y.T @ r


def differentiate_v(moves: Callable[[float], Vector], t: float, h: float) -> float:
    """Returns the derivative of V at a time by a difference of fourth order."""

    def V(t: float) -> float:
        state = moves(t)
        q = state[:2]
        qd = state[2:4]
        theta_hat = state[4:9]
        stored = state[9]
        x_des = move_peer(t - T)[0]
        r = qd - reference(q, x_des)
        e = tip_place(q) - x_des
        off = theta_hat - THETA
        return float(
            0.5 * r @ inertia(q) @ r
            + 0.5 * off @ off / GAMMA
            + 0.5 * e @ (LAMBDA * KD * e)
            + 0.5 * stored
        )

    return (8 * (V(t + h) - V(t - h)) - V(t + 2 * h) + V(t - 2 * h)) / (12 * h)


def test_vs_derivative_is_dissipation_and_passed_energy() -> None:
    def field(t: float, state: Vector) -> Vector:
        q = state[:2]
        qd = state[2:4]
        _, _, qdd, rate = evaluate_loop(t, q, qd, state[4:9])
        now = move_peer(t)[1]
        then = move_peer(t - T)[1]
        return np.concatenate([qd, qdd, rate, [now @ (KD * now) - then @ (KD * then)]])

    begin = np.array([0.1, 1.3, 0.0, 0.0, *(0.5 * THETA), 0.0])
    run = solve_ivp(
        field, (0.0, 4.0), begin, method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True
    )
    for t in np.linspace(0.2, 3.8, 25):
        state = run.sol(t)
        q = state[:2]
        qd = state[2:4]
        r, ed, _, _ = evaluate_loop(t, q, qd, state[4:9])
        xd = jacobian(q) @ qd
        now = move_peer(t)[1]
        passed_on = 0.5 * xd @ (KD * xd) - 0.5 * now @ (KD * now)
        wanted = -r @ (KP * r) - 0.5 * ed @ (KD * ed) - passed_on
        assert abs(differentiate_v(run.sol, t, 1e-3) - wanted) <= 1e-7 * (1.0 + abs(wanted)), t


@pytest.mark.parametrize("name", ["free", "paper"])
def test_v_never_rises_while_nobody_pushes(name: str) -> None:
    """The theorem, in free motion; `paper` is free before its first pulse and after its last one."""
    b = compute_shipped_balance(name)
    free = np.diff(b.given) == 0.0
    assert free.sum() > 8000
    rise = np.diff(b.V)[free]
    assert rise.max() <= 5e-8 * b.V.max()


@pytest.mark.long
def test_v_rises_while_a_hand_pushes() -> None:
    b = compute_shipped_balance("paper_rods")
    assert np.diff(b.V).max() > 1e-5

"""The corrections of docs/theory/errata-proof.md, continued: weights, hands, convergence, and
the meaning of dominance.
"""

from typing import Any

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import linprog

from tests.execution.builders import make_shipped_trajectories
from tests.theory.energy import compute_balance
from trilat_net.analysis.dominance_history import compute_lyapunov_weights
from trilat_net.core.arms.exogenous import (
    TorqueKind,
    TorqueSource,
    torque_on_arm,
    torque_source_rows,
)
from trilat_net.core.links.dominance import DominanceMatrix

A12, A21, A31 = sp.symbols("alpha12 alpha21 alpha31", positive=True)
ALPHA = sp.Matrix([[0, A12, 1 - A12], [A21, 0, 1 - A21], [A31, 1 - A31, 0]])  # Eq. (7)
UPSILON = ALPHA - sp.eye(3)  # Eq. (20)
ONES = sp.ones(1, 3)
PI = sp.Matrix([[1 - ALPHA[1, 2] * ALPHA[2, 1], 1 - ALPHA[0, 2] * ALPHA[2, 0], 1 - A12 * A21]])
SQUARES = sp.Matrix(sp.symbols("Q1:4", positive=True))


def draw_shares(rng: np.random.Generator, size: int) -> Any:
    """Draws a dominance matrix for a number of sites."""
    alpha = rng.uniform(0.05, 1.0, (size, size)) * (1 - np.eye(size))
    return alpha / alpha.sum(axis=1, keepdims=True)


def find_perron_vector(alpha: Any) -> Any:
    """Returns the left eigenvector of eigenvalue 1, from NumPy, sum 1."""
    values, vectors = np.linalg.eig(alpha.T)
    vector = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    return vector / vector.sum()


# --- 6: beta --------------------------------------------------------------------------------------------


def test_beta_is_the_left_null_vector() -> None:
    """Errata 6, after Eq. (20)."""
    assert (PI * UPSILON).expand() == sp.zeros(1, 3)
    assert (UPSILON * ONES.T).expand() == sp.zeros(3, 1)
    assert (ONES * UPSILON).expand() != sp.zeros(1, 3)


def test_ones_fit_one_of_three_parameters() -> None:
    """Errata 6: alpha12 = alpha31 = 1 - alpha21, the circulant matrices."""
    (solution,) = sp.solve(list(ONES * UPSILON), [A12, A31], dict=True)
    assert solution == {A12: 1 - A21, A31: 1 - A21}


def test_eq_22_has_the_opposite_sign() -> None:
    """Errata 6, Eq.

    (21)-(23): the sign goes unnoticed because the term is zero, if beta is right.
    """
    beta = sp.Matrix([sp.symbols("b1:4", positive=True)])
    ends = sum(beta[i] * (SQUARES[i] - (ALPHA * SQUARES)[i]) for i in range(3))
    assert sp.expand(ends + (beta * UPSILON * SQUARES)[0]) == 0
    assert sp.expand(ends - (beta * UPSILON * SQUARES)[0]) != 0
    printed = sp.Matrix([SQUARES[0]] * 3)  # Eq. (23) has the velocity of site 1 three times
    assert sp.expand(ends + (beta * UPSILON * printed)[0]) != 0


def test_with_ones_v_can_rise() -> None:
    """Errata 6: one arm moves, and its peers used its motion before; r = 0, and its column sums
    to more than one.
    """
    alpha = np.array([[0.0, 0.9, 0.1], [0.5, 0.0, 0.5], [0.2, 0.8, 0.0]])
    qd = np.array([0.0, 1.0, 0.0])
    # of every peer what makes the disagreement zero
    seen = np.repeat(qd[:, np.newaxis], 3, axis=1)

    def rate(beta: Any) -> float:
        each = (
            -0.5 * (alpha * (qd[:, np.newaxis] - seen) ** 2).sum(1)
            - 0.5 * qd**2
            + 0.5 * alpha @ qd**2
        )
        return float(beta @ each)

    assert rate(np.ones(3)) == pytest.approx(0.5 * (0.9 + 0.8 - 1))
    assert rate(find_perron_vector(alpha)) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("size", [2, 3, 4, 6])
def test_weights_are_left_eigenvectors_for_all_n(size: int) -> None:
    """Errata 6, N sites."""
    alpha = draw_shares(np.random.default_rng(size), size)
    assert DominanceMatrix(alpha).find_pi() == pytest.approx(
        find_perron_vector(alpha), rel=1e-9
    )
    c = np.linspace(0.3, 10.0, size)
    beta = compute_lyapunov_weights(alpha, c[:, np.newaxis] * [3.0, 1.0]).beta
    assert beta * c / (beta @ c) == pytest.approx(find_perron_vector(alpha), rel=1e-9)


# --- 7: Kd ----------------------------------------------------------------------------------------------


def passed_on(alpha: Any, Kd: Any) -> Any:
    """Returns rows: the terms in |qd_j|^2 that beta has to cancel, per joint; shape (joints *
    N, N), times beta.
    """
    rows = [(alpha - np.eye(len(alpha))).T * Kd[:, joint] for joint in range(Kd.shape[1])]
    return np.concatenate(rows)


def is_feasible(alpha: Any, Kd: Any) -> bool:
    """True if nonnegative weights beta, not all zero, make every term of V' nonpositive."""
    rows = passed_on(alpha, Kd)
    n = len(alpha)
    solution = linprog(np.zeros(n), rows, np.full(len(rows), 1e-9), np.ones((1, n)), [1.0])
    return bool(solution.status == 0)


def test_kd_may_differ_by_scalars_only() -> None:
    """Errata 7: beta_i = pi_i / c_i; of another shape there is no beta, not even for V' <= 0."""
    alpha = draw_shares(np.random.default_rng(3), 3)
    c = np.array([10.0, 3.0, 0.3])
    common = c[:, np.newaxis] * [2.0, 5.0]
    assert passed_on(alpha, common) @ (find_perron_vector(alpha) / c) == pytest.approx(
        np.zeros(6), abs=1e-14
    )
    assert np.abs(passed_on(alpha, common) @ find_perron_vector(alpha)).max() > 0.1
    assert is_feasible(alpha, common)
    assert not is_feasible(alpha, np.array([[0.1, 30.0], [30.0, 0.1], [3.0, 3.0]]))


def test_no_weights_of_the_integrals_leave_slack() -> None:
    """Errata 7: with w_ij in the integral the remainder sums to alpha_ij (k_i - w_ij)^2 / (2 w_ij) >= 0."""
    k, w = sp.symbols("k w", positive=True)
    own_share, seen = sp.symbols("own seen", real=True)
    (best,) = sp.solve(sp.diff(k * own_share * seen - w * seen**2 / 2, seen), seen)
    # over what the peer may have done
    most = (k * own_share * seen - w * seen**2 / 2).subs(seen, best)
    assert sp.simplify(most - k**2 * own_share**2 / (2 * w)) == 0
    assert sp.simplify(-k + k**2 / (2 * w) + w / 2 - (k - w) ** 2 / (2 * w)) == 0


# --- 9: hands -------------------------------------------------------------------------------------------


def test_a_passive_wall_gives_energy_to_v() -> None:
    """Errata 9: at rest in a wall, held there by its peers, qd'tau_h = 0 and r'tau_h = Lambda
    e'tau_h > 0.
    """
    wall = TorqueSource(TorqueKind.WALL, a=(1.1, 0.0), b=(-1.0, 0.0), K=(2000.0, 0.0))
    rows, table = torque_source_rows((wall,))

    def push(q: Any) -> Any:
        return np.array(torque_on_arm(0.0, q, np.zeros(2), np.ones(2), rows, table, 0)[:2])

    turns = np.linspace(0.0, 2 * np.pi, 4001)
    path = np.array([-0.5, 1.85]) + 0.2 * np.stack([np.cos(turns), np.sin(2 * turns)], axis=1)
    steps = np.diff(path, axis=0)
    middles = 0.5 * (path[1:] + path[:-1])
    work_done = np.array([step @ push(q) for step, q in zip(steps, middles, strict=True)])
    assert np.abs(work_done).sum() > 10.0
    assert (work_done == 0.0).any()  # part of the way is free
    # once around: the wall gives back what it took
    assert work_done.sum() == pytest.approx(0.0, abs=0.01)
    # its peers are deeper in the wall
    rests = np.array([-0.5, 1.75])
    desired = np.array([-0.45, 1.6])
    assert push(rests) @ (rests - desired) > 10.0


# --- 10: convergence ------------------------------------------------------------------------------------


def test_a_vanishing_rate_implies_no_limit() -> None:
    """Errata 10: e = sin(ln(1 + t)): its rate is square integrable and goes to zero, and e
    never settles.
    """
    t = sp.Symbol("t", positive=True)
    e = sp.sin(sp.log(1 + t))
    rate = sp.diff(e, t)
    assert sp.limit(sp.Abs(rate), t, sp.oo) == 0
    # at most 1 / (1 + t)^2
    assert sp.simplify(rate**2 * (1 + t) ** 2 - sp.cos(sp.log(1 + t)) ** 2) == 0
    late = [sp.exp(sp.pi * (n + sp.Rational(1, 2))) - 1 for n in (10, 11)]
    assert [e.subs(t, when) for when in late] == [1, -1]


def test_weighted_errors_equal_motion_under_way() -> None:
    """Errata 10.4: sum pi_i e_i = sum pi_i alpha_ij (q_j(t) - q_j(t - T_ij)); the step to 3c omits it."""
    q = sp.Matrix(sp.symbols("q1:4"))
    seen = sp.Matrix(3, 3, lambda i, j: sp.Symbol(f"q{j + 1}_at_{i + 1}"))
    e = [q[i] - sum(ALPHA[i, j] * seen[i, j] for j in range(3)) for i in range(3)]
    moved = sum(PI[i] * ALPHA[i, j] * (q[j] - seen[i, j]) for i in range(3) for j in range(3))
    assert sp.expand(sum(PI[i] * e[i] for i in range(3)) - moved) == 0
    assert sp.expand(sum(PI[i] * e[i] for i in range(3))) != 0
    c, t, T = sp.symbols("c t T")
    steady = {q[j]: c * t for j in range(3)} | {
        seen[i, j]: c * (t - T) for i in range(3) for j in range(3)
    }
    assert [sp.expand(x.subs(steady)) for x in e] == [
        c * T
    ] * 3  # arms that drift together have e = c T


def test_only_rest_remains() -> None:
    """Errata 10.4: the factor of w, sum pi_i / Lambda_i + sum pi_i alpha_ij T_ij, is positive."""
    rng = np.random.default_rng(4)
    for _ in range(50):
        alpha = draw_shares(rng, 4)
        pi = find_perron_vector(alpha)
        Lambda = rng.uniform(0.1, 5.0, 4)
        T = rng.uniform(0.0, 2.0, (4, 4))
        assert (
            (pi / Lambda).sum() + (pi[:, np.newaxis] * alpha * T).sum()
            >= (pi / Lambda).sum()
            > 0.0
        )


# --- 11: reducible matrices -----------------------------------------------------------------------------

LOCKED = {"m1": {"s": 1.0, "m2": 0.0}, "m2": {"m1": 0.5, "s": 0.5}, "s": {"m1": 1.0, "m2": 0.0}}
"""Expert and slave follow each other; the trainee follows both."""


def test_locked_pairs_leave_a_zero_weight() -> None:
    """Errata 11: 1 - alpha_ij alpha_ji = 0 with shares of at most one."""
    assert list(PI.subs({A12: 0, A31: 1})) == [1, 0, 1]
    for share in (0.2, 0.7, 0.999):
        assert min(PI.subs({A12: 1 - share, A31: 1, A21: 0.5})) > 0


def test_sites_that_nobody_follows_still_settle() -> None:
    """Errata 11: V with beta = (1, 0, 1) never rises; V_2 alone may; e goes to zero at every site."""
    rows = {
        f"dominance.{i}.{j}": share for i, row in LOCKED.items() for j, share in row.items()
    }
    trajectory_of_run = make_shipped_trajectories(
        "free", {**rows, "rate_hz": 200, "duration_s": 25.0}
    )
    locked = compute_balance(trajectory_of_run, np.array([0.5, 0.0, 0.5])).V
    assert np.diff(locked).max() <= 1e-6 * locked.max()
    alone = compute_balance(trajectory_of_run, np.array([0.0, 1.0, 0.0])).V
    assert np.diff(alone).max() > 1e-6 * alone.max()
    e = np.abs(trajectory_of_run.stack("q") - trajectory_of_run.stack("q_des")).max(axis=(0, 2))
    assert e[-200:].max() < 0.02 < 0.5 < e.max()


def test_two_closed_groups_have_several_betas() -> None:
    """Errata 11, N >= 4."""
    alpha = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]])
    assert np.linalg.matrix_rank(alpha - np.eye(4)) == 2
    assert DominanceMatrix(alpha).closed_groups == ((0, 1), (2, 3))


# --- 12: what is not an error but follows ---------------------------------------------------------------


def test_learning_gravity_is_a_spring() -> None:
    """Errata 12: theta_4_hat + Gamma g sin q1 changes by -Gamma g cos(q1) Lambda e1 alone: qd integrates."""
    t, gain, g, Lambda = sp.symbols("t Gamma g Lambda", positive=True)
    q = sp.Function("q")(t)
    e = sp.Function("e")(t)
    learnt = -gain * g * sp.cos(q) * (q.diff(t) + Lambda * e)  # Eq. (15), fourth column of Y
    assert (
        sp.simplify(learnt + (gain * g * sp.sin(q)).diff(t) + gain * g * sp.cos(q) * Lambda * e)
        == 0
    )


def test_dominance_decides_who_feels_whom() -> None:
    """Errata 12: at rest sum beta_i tau_h,i = 0, so that a hand at i feels tau_s beta_s / beta_i."""
    alpha = np.array([[0.0, 0.1, 0.9], [0.8, 0.0, 0.2], [0.8, 0.2, 0.0]])
    beta = find_perron_vector(alpha)
    stiffness = 40.0
    for holding, felt in ((0, 4.79), (1, 16.4)):
        free = np.array([i for i in range(3) if i != holding])
        load = np.array([0.0, 0.0, 5.0])
        # Kp Lambda e = tau_h, with the holding site's q = 0
        stiff = stiffness * (np.eye(3) - alpha)
        q = np.zeros(3)
        q[free] = np.linalg.solve(stiff[np.ix_(free, free)], load[free])
        hand = (stiff @ q - load)[holding]
        assert -hand == pytest.approx(5.0 * beta[2] / beta[holding])
        assert -hand == pytest.approx(felt, rel=5e-3)

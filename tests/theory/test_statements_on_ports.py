"""Errata 14 to 16 and 9: shares that a port allows, what force reflection needs, a box, coupled hands."""

from typing import Any

import numpy as np
import pytest
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from tests.theory.analysed_ports import find_failing_frequencies
from tests.theory.networks import Network, Wire
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.frequency_search import build_frequency_grid
from trilat_net.analysis.theory.port_passivity import EIGENVALUE_ROUNDING, find_best_weights
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.core.step.control import project_estimate
from trilat_net.laws.conditions import COMMON_MOTION_SHARE
from trilat_net.scenario import load_scenario


def one_factor(a: float) -> Any:
    """Returns dominance by one factor: the first user's share in the slave is a, in the second
    user 1 - a.
    """
    return np.array([[0.0, 1.0 - a, a], [a, 0.0, 1.0 - a], [a, 1.0 - a, 0.0]])


def position_exchange(
    alpha: Any, d: float, masses: Any = (1.0, 1.5, 0.7), delay_s: float = 0.2
) -> Network:
    wires = tuple(
        Wire(i, j, 10.0 * alpha[i][j], 0.0, delay_s)
        for i in range(3)
        for j in range(3)
        if alpha[i][j]
    )
    return Network(tuple(masses), (d,) * 3, (0.0,) * 3, wires)


def least_margin(network: Network) -> float:
    """Returns the least eigenvalue under the best weights from 0.001 to 10 Hz."""
    Y = build_admittance(network.loop)
    grid = build_frequency_grid(1e-3, 10.0, 0.2)
    return float(find_best_weights(Y(grid), np.arange(len(network.m))).margin.min())


def test_one_factor_is_reversible_at_three_places() -> None:
    """Errata 14: a (1 - a)^2 along the circle and a^2 (1 - a) back."""
    a = sp.Symbol("a")
    alpha = sp.Matrix([[0, 1 - a, a], [a, 0, 1 - a], [a, 1 - a, 0]])
    circle = alpha[0, 1] * alpha[1, 2] * alpha[2, 0] - alpha[0, 2] * alpha[2, 1] * alpha[1, 0]
    assert sorted(sp.solve(circle, a)) == [0, sp.Rational(1, 2), 1]
    assert {
        a: DominanceMatrix(one_factor(a)).find_balancing_weights() is not None
        for a in (0.0, 0.25, 0.5, 0.75, 1.0)
    } == {
        0.0: True,
        0.25: False,
        0.5: True,
        0.75: False,
        1.0: True,
    }


@pytest.mark.parametrize("d", [3.0, 30.0])
def test_irreversible_shares_defeat_any_damping(d: float) -> None:
    """Errata 14: three times and thirty times what reversible shares need."""
    assert least_margin(position_exchange(one_factor(0.5), d)) > -EIGENVALUE_ROUNDING
    assert least_margin(position_exchange(one_factor(0.25), d)) < -1e-4 / d


@pytest.mark.parametrize("count", [3, 5, 7])
def test_reversible_shares_are_passive_once_damped_to_stability(count: int) -> None:
    """Errata 14: D Z + Z^H D of masses that are free has the sign of d + K S sin(w T) / w; any masses."""
    rng = np.random.default_rng(count)
    weights = rng.uniform(0.0, 1.0, (count, count)) * (1.0 - np.eye(count))
    alpha = (weights + weights.T) / (weights + weights.T).sum(axis=1, keepdims=True)
    D = DominanceMatrix(alpha).find_balancing_weights()
    assert D is not None
    K = 10.0
    T = 0.2
    w = np.linspace(1e-3, 60.0, 4000)
    line = K * T * max(COMMON_MOTION_SHARE, -np.linalg.eigvals(alpha).real.min())
    for d, passive in ((0.99 * line, False), (1.01 * line, True)):
        s = 1j * w[:, None, None]
        Z = np.diag(rng.uniform(0.1, 10.0, count)) * s + d * np.eye(count)
        Z = D[:, None] * (Z + K * (np.eye(count) - alpha * np.exp(-s * T)) / s)
        least = np.linalg.eigvalsh(Z + np.conj(np.swapaxes(Z, 1, 2))).min()
        assert bool(least > -1e-9) is passive


@pytest.mark.parametrize("d", [3.0, 30.0])
def test_added_mass_makes_irreversible_shares_unstable(d: float) -> None:
    """Errata 14: with w_i w_j a_ij a_ji alike, w = 1 / m, diag(w) alpha has complex eigenvalues."""
    alpha = one_factor(0.25)
    p = alpha * alpha.T
    w = np.array([p[1, 2], p[0, 2], p[0, 1]])
    assert np.ptp([w[i] * w[j] * p[i, j] for i, j in ((0, 1), (0, 2), (1, 2))]) < 1e-15
    assert np.abs(np.linalg.eigvals(w[:, None] * alpha).imag).max() > 0.01
    heavy = 1e5 / w
    springs = tuple(20.0 * w.max() / w - 10.0)  # w (K + k) is one number
    network = position_exchange(alpha, d, heavy, 0.0)._replace(k=springs)
    assert Spectrum.of_loop(network.loop, 1).verdict == "unstable"


def test_scenarios_of_irreversible_shares_say_so() -> None:
    rows: dict[str, Any] = {
        "dominance.m1": {"m2": 0.75, "s": 0.25},
        "dominance.m2": {"m1": 0.25, "s": 0.75},
        "dominance.s": {"m1": 0.25, "m2": 0.75},
    }
    known = {"control.Gamma": 0.0, "control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]}
    assert load_scenario("p_d_margin", rows).has_irreversible_shares
    assert load_scenario("free", {**rows, **known}).has_irreversible_shares
    assert not load_scenario("free", rows).has_irreversible_shares  # gravity is learnt
    assert not load_scenario("p_d_margin").has_irreversible_shares


def make_reflecting_network(d_m: float, delay_s: float, slave_kg: float = 1.5) -> Network:
    """Returns a master that feels the forces on its slave: K = 100, d_s = 40, k_f = 1."""
    wires = (Wire(0, 1, 0.0, 0.0, delay_s, 1.0), Wire(1, 0, 100.0, 0.0, delay_s))
    return Network((1.0, slave_kg), (d_m, 40.0), (0.0, 0.0), wires)


@pytest.mark.parametrize(("delay_s", "least"), [(0.02, 12.1), (0.2, 40.0), (1.0, 360.0)])
def test_force_reflection_needs_damping_growing_with_delay(
    delay_s: float, least: float
) -> None:
    """Errata 15: d_m >= k_f (2 K T + d_s)^2 / (4 d_s), K = 100 and d_s = 40; its edge within 1 %."""
    assert (2.0 * 100.0 * delay_s + 40.0) ** 2 / 160.0 == pytest.approx(least)
    assert find_failing_frequencies(make_reflecting_network(0.99 * least, delay_s)).below
    assert not find_failing_frequencies(make_reflecting_network(1.01 * least, delay_s)).below


def test_the_slaves_best_damping_is_2_kt() -> None:
    """Errata 15: 2 k_f K T, at d_s = 2 K T; and a slave of much mass asks for k_f K M / d_s."""
    K, T, d_s = sp.symbols("K T d_s", positive=True)
    bound = (2 * K * T + d_s) ** 2 / (4 * d_s)
    (best,) = sp.solve(sp.diff(bound, d_s), d_s)
    assert (best, sp.simplify(bound.subs(d_s, best))) == (2 * K * T, 2 * K * T)
    assert not find_failing_frequencies(make_reflecting_network(1.02 * 40.0, 0.2)).below
    assert find_failing_frequencies(
        make_reflecting_network(1.02 * 40.0, 0.2, slave_kg=40.0)
    ).below


def reflection_damping(w: Any, K: float, M_s: float, d_s: float, T: float) -> Any:
    """Returns the damping d_m / k_f that Llewellyn's condition needs at the frequencies w, errata 15."""
    psi = np.arctan2(w * d_s, K - M_s * w**2)
    return K * np.sin(0.5 * psi + w * T) ** 2 / (w * np.sin(psi))


def reflection_frequencies(K: float, d_s: float, T: float) -> Any:
    slow = min(1.0 / T, K / d_s)
    fast = max(1.0 / T, K / d_s)
    return np.geomspace(1e-3 * slow, 1e3 * fast, 20001)


def test_heavy_slaves_exceed_both_frequency_limits() -> None:
    """Errata 15: the edge is 1.943, 11 % more than the formula of w = 0, and within the
    sufficient bound.
    """
    K = 142.0
    M_s = 0.0512
    d_s = 4.3
    T = 4.16e-3
    w = reflection_frequencies(K, d_s, T)
    damping = reflection_damping(w, K, M_s, d_s, T)
    edge = float(damping.max())
    slow = (2.0 * K * T + d_s) ** 2 / (4.0 * d_s)
    fast = K * M_s / d_s
    enough = K * (2.0 * M_s + T * d_s) ** 2 / (4.0 * M_s * d_s)
    assert (edge, slow, fast, enough) == pytest.approx((1.943, 1.747, 1.691, 2.333), abs=5e-4)
    assert w[damping.argmax()] == pytest.approx(69.0, abs=0.1)
    for k_f in (1.0, 0.3):
        wires = (Wire(0, 1, 0.0, 0.0, T, k_f), Wire(1, 0, K, 0.0, T))
        for part, fails in ((0.99, True), (1.01, False)):
            network = Network((0.08, M_s), (part * edge * k_f, d_s), (0.0, 0.0), wires)
            assert bool(find_failing_frequencies(network).below) is fails


@pytest.mark.parametrize(
    ("K", "M_s", "d_s", "T"),
    [(60.0, 0.2, 6.0, 0.01), (300.0, 0.1, 9.0, 3e-3), (90.0, 0.6, 12.0, 0.02)],
)
def test_heavy_slaves_need_the_largest_frequency_value(
    K: float, M_s: float, d_s: float, T: float
) -> None:
    """Errata 15: at least 5 % more than both limits, and no more than the sufficient bound."""
    assert d_s**2 < 4.0 * K * M_s
    edge = float(reflection_damping(reflection_frequencies(K, d_s, T), K, M_s, d_s, T).max())
    slow = (2.0 * K * T + d_s) ** 2 / (4.0 * d_s)
    fast = K * M_s / d_s
    assert edge > 1.05 * max(slow, fast)
    assert edge <= max(slow, K * (2.0 * M_s + T * d_s) ** 2 / (4.0 * M_s * d_s))
    wires = (Wire(0, 1, 0.0, 0.0, T, 1.0), Wire(1, 0, K, 0.0, T))
    for part, fails in ((0.99, True), (1.01, False)):
        network = Network((0.5 * M_s, M_s), (part * edge, d_s), (0.0, 0.0), wires)
        assert bool(find_failing_frequencies(network).below) is fails


def test_light_slaves_follow_the_low_frequency_formula() -> None:
    """Errata 15: d_s^2 >= 4 K M_s.

    A heavy slave stays within the larger one of two formulas.
    """
    rng = np.random.default_rng(15)
    for _ in range(300):
        K, d_s, T = 10.0 ** rng.uniform((0.0, -1.0, -3.0), (3.0, 2.5, 0.5))
        w = reflection_frequencies(K, d_s, T)
        slow = (2.0 * K * T + d_s) ** 2 / (4.0 * d_s)
        critical = d_s**2 / (4.0 * K)
        light = critical * rng.uniform(0.0, 1.0)
        assert reflection_damping(w, K, light, d_s, T).max() <= slow * (1.0 + 1e-9)
        heavy = critical * 10.0 ** rng.uniform(0.0, 3.0)
        enough = max(slow, K * (2.0 * heavy + T * d_s) ** 2 / (4.0 * heavy * d_s))
        assert reflection_damping(w, K, heavy, d_s, T).max() <= enough * (1.0 + 1e-9)


def test_coupled_hands_differ_from_independent_ones() -> None:
    """Errata 9: K1 = 100, K2 = 1, 4 d1 d2 = 1.2 (2 T)^2 K1 K2 withstand any two operators, but
    not one who holds both handles with a spring between one and the mirror image of the other.
    """
    d = float(np.sqrt(1.2 * 0.2**2 * 100.0))
    wires = (Wire(0, 1, 100.0, 0.0, 0.2), Wire(1, 0, 1.0, 0.0, 0.2))
    network = Network((1.0, 1.5), (d, d), (0.0, 0.0), wires)
    assert not find_failing_frequencies(network).below
    # -50 (q1 + q2) on each, with the springs below
    mirrored = (
        *wires,
        Wire(0, 1, -50.0),
        Wire(1, 0, -50.0),
    )
    heavy = Network((1e4, 1e4 * 51.0 / 150.0), (d, d), (100.0, 100.0), mirrored)
    assert Spectrum.of_loop(heavy.loop, 1).verdict == "unstable"


@given(st.tuples(*[st.floats(-10.0, 10.0)] * 4))
def test_clips_never_move_estimates_off_truth(some: Any) -> None:
    """Errata 16: V of the estimates does not rise."""
    estimate = some[0]
    low, theta, high = sorted(some[1:])
    for truth in (low, theta, high):
        after = project_estimate((estimate,) * 5, (low,) * 5, (high,) * 5)[0]
        assert abs(after - truth) <= abs(estimate - truth)

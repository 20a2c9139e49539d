"""`adaptive_kinematics`: with known lengths the law of task space; with unknown ones V falls,
and arms meet.
"""

import numpy as np
import pytest

import trilat_net
from trilat_net.analysis.arm_rows import PlanarArmRows
from trilat_net.log.log_reader import Log
from trilat_net.scenario import parse_scenario

SCENARIO = """
name = "places"
duration_s = {duration_s}
[arm]
g_m_s2 = {gravity}
[control]
{control}
[link]
delay_ms = 60
[sites.m]
q0_rad = [0.3, {elbow_rad}]
{hands}
[sites.s]
role = "slave"
q0_rad = [0.3, 1.5]
[sites.s.arm]
l2_m = {slave_m}
[dominance]
m = {{ s = 1.0 }}
s = {{ m = 1.0 }}
"""
GAINS = "Lambda = 1.5\nKp = [6, 4]\nGamma = {Gamma}\n"
UNKNOWN = """law = "adaptive_kinematics"
Kd = [8, 5]
length_gain_m_n = {gain}
lengths0_m = [{first_m}, {second_m}]
"""
KNOWN = 'law = "adaptive"\nKd = [8, 5, 1]\n[task]\nspace = "position"\naxes = ["x", "y"]\n'
PUSH = 'hands = [{ kind = "pulse", start_s = 0.5, end_s = 1.5, peak_nm = [6.0, -4.0] }]'


def simulate_law(
    law: str,
    *,
    Gamma: float,
    gravity: float = 9.81,
    elbow_rad: float = 1.2,
    hands: str = "",
    **more: float,
) -> Log:
    keys = {
        "duration_s": 10.0,
        "gain": 0.0,
        "first_m": 1.0,
        "second_m": 1.0,
        "slave_m": 1.0,
        **more,
    }
    control = (GAINS + law).format(Gamma=Gamma, **keys)
    text = SCENARIO.format(
        control=control, gravity=gravity, elbow_rad=elbow_rad, hands=hands, **keys
    )
    return trilat_net.simulate(parse_scenario(text))


def compute_tip_places(log: Log, site: str) -> np.ndarray:
    lengths_m = log.scenario.arms[site].lengths_m
    inner = log[site].q[:, 0]
    outer = log[site].q.sum(axis=1)
    return np.stack(
        [
            lengths_m[0] * np.cos(inner) + lengths_m[1] * np.cos(outer),
            lengths_m[0] * np.sin(inner) + lengths_m[1] * np.sin(outer),
        ],
        axis=1,
    )


@pytest.mark.long
def test_known_lengths_give_the_task_space_law() -> None:
    pushed = {"Gamma": 0.0, "gravity": 0.0, "elbow_rad": 1.5, "hands": PUSH, "duration_s": 3.0}
    unknown = simulate_law(UNKNOWN, **pushed)
    chain = simulate_law(KNOWN, **pushed)
    for site in unknown.sites:
        np.testing.assert_allclose(unknown[site].q, chain[site].q, rtol=0.0, atol=1e-9)
    assert np.ptp(unknown["s"].q[:, 0]) > 0.1


def compute_jacobians(lengths_m: np.ndarray, q: np.ndarray) -> np.ndarray:
    inner = q[:, 0]
    outer = q.sum(axis=1)
    reach = lengths_m[:, [1]] * np.stack([-np.sin(outer), np.cos(outer)], axis=1)
    elbow = lengths_m[:, [0]] * np.stack([-np.sin(inner), np.cos(inner)], axis=1)
    return np.stack([elbow + reach, reach], axis=2)


def compute_tip_speeds(log: Log, site: str) -> np.ndarray:
    lengths_m = np.tile(log.scenario.arms[site].lengths_m, (len(log[site]), 1))
    return np.einsum("kij,kj->ki", compute_jacobians(lengths_m, log[site].q), log[site].qd)


def integrate(power: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(0.5e-3 * (power[1:] + power[:-1]))])


DELAY = 60  # ticks


def compute_functional(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Returns V and the integral of sum_i (r'Kp r + 1/2 |xd_i - xd_j(t - T)|^2), from the
    second tick with samples.

    V = 1/2 sum_i (r'M r + theta~^2 / Gamma + l~^2 / Gamma_l + e'Lambda Kd e + int over T of
    xd_j'Kd xd_j).
    """
    Lambda = 1.5
    Kp = np.array([6.0, 4.0])
    Kd = np.array([8.0, 5.0])
    V = np.zeros(len(log["m"]) - DELAY)
    lost = np.zeros(len(log["m"]) - DELAY)
    for site, peer in (("m", "s"), ("s", "m")):
        records = log[site]
        arm = log.scenario.arms[site]
        lengths_m = np.array([state.mem[-4:-2] for state in records.states])[DELAY:]
        q = records.q[DELAY:]
        e = compute_tip_places(log, site)[DELAY:] - compute_tip_places(log, peer)[:-DELAY]
        r = (
            records.qd[DELAY:]
            + np.linalg.solve(compute_jacobians(lengths_m, q), Lambda * e[..., None])[..., 0]
        )
        speed = compute_tip_speeds(log, peer)
        stored = integrate((Kd * speed**2).sum(axis=1))
        V += 0.5 * (
            (r * PlanarArmRows(arm.theta, 0.0, (1.0, 1.0)).multiply_inertia(q, r)).sum(axis=1)
            + ((records.theta_hat[DELAY:] - arm.theta) ** 2).sum(axis=1)
            + ((lengths_m - arm.lengths_m) ** 2).sum(axis=1) / LENGTH_GAIN
            + Lambda * (Kd * e**2).sum(axis=1)
            + (stored[DELAY:] - stored[:-DELAY])
        )
        ed = compute_tip_speeds(log, site)[DELAY:] - speed[:-DELAY]
        lost += integrate((Kp * r**2).sum(axis=1) + 0.5 * (Kd * ed**2).sum(axis=1))
    return V[2:], lost[2:] - lost[2]  # the torque is extrapolated over the jump of e


LENGTH_GAIN = 0.02
WRONG = {"Gamma": 1.0, "first_m": 0.7, "second_m": 1.4, "slave_m": 1.2, "duration_s": 10.0}


@pytest.mark.long
def test_with_unknown_lengths_v_falls_by_dissipation() -> None:
    log = simulate_law(UNKNOWN, gain=LENGTH_GAIN, **WRONG)
    V, lost = compute_functional(log)
    assert np.abs(V + lost - V[0]).max() <= 1e-5 * V[0]
    assert (V - np.minimum.accumulate(V)).max() <= 1e-9 * V[0]
    apart_m = np.abs(compute_tip_places(log, "m") - compute_tip_places(log, "s")).max(axis=1)
    assert apart_m[-1] <= 0.1 * apart_m[0]


@pytest.mark.long
def test_without_learning_lengths_v_changes_otherwise() -> None:
    V, lost = compute_functional(simulate_law(UNKNOWN, gain=0.0, **WRONG))
    assert np.abs(V + lost - V[0]).max() > 1e-3 * V[0]


def estimated_over_true(lengths: tuple[float, float], q: tuple[float, float]) -> np.ndarray:
    """Returns J_hat J^-1 of an arm of two links of 1 m, which relates estimated to true velocities."""
    pose = np.array([q])
    estimated = compute_jacobians(np.array([lengths]), pose)[0]
    true = compute_jacobians(np.array([[1.0, 1.0]]), pose)[0]
    return np.asarray(estimated @ np.linalg.inv(true))


def test_errata_10_weight_may_be_asymmetric_and_singular() -> None:
    """With Lambda = 1 and one common delay, the weight is the sum of J_hat J^-1 over the arms plus T I."""
    ratio = estimated_over_true((0.2, 3.0), (0.0, 0.2))
    assert np.linalg.eigvalsh(0.5 * (ratio + ratio.T)) == pytest.approx(
        [-5.447, 8.647], abs=1e-3
    )
    # Its own eigenvalues are the ratios of the lengths, as a similar matrix shows.
    assert np.sort(np.linalg.eigvals(ratio).real) == pytest.approx([0.2, 3.0])
    mirrored = estimated_over_true((0.2, 3.0), (0.5 * np.pi, -0.2))
    weight = 0.5 * (ratio + mirrored)
    assert np.linalg.det(weight) < 0.0
    delay_s = -np.linalg.eigvals(weight).real.min()
    assert delay_s > 0.0
    assert abs(np.linalg.det(weight + delay_s * np.eye(2))) < 1e-9


@pytest.mark.parametrize(
    ("lengths", "pose"),
    [((0.3, 2.0), (0.4, 0.3)), ((2.5, 0.4), (-1.0, 0.25)), ((1.6, 0.5), (2.0, -0.2))],
)
def test_wrong_lengths_make_straight_elbow_weight_indefinite(
    lengths: tuple[float, float], pose: tuple[float, float]
) -> None:
    """A motion exists that the weight counts as negative; with true lengths the weight is the identity."""
    weight = estimated_over_true(lengths, pose)
    assert np.abs(weight - weight.T).max() > 0.1
    assert np.linalg.eigvalsh(0.5 * (weight + weight.T)).min() < 0.0
    assert estimated_over_true((1.0, 1.0), pose) == pytest.approx(np.eye(2))


@pytest.mark.long
def test_errors_vanish_despite_indefinite_errata_10_weight() -> None:
    """An end effector of finite reach cannot move at one velocity for ever: e and qd go to zero."""
    log = simulate_law(UNKNOWN, gain=LENGTH_GAIN, **{**WRONG, "duration_s": 60.0})
    apart_m = np.abs(compute_tip_places(log, "m") - compute_tip_places(log, "s")).max(axis=1)
    assert apart_m[-1] <= 0.01 * apart_m[0]
    for site in log.sites:
        elbow = np.abs(np.sin(log[site].q[:, 1]))
        assert elbow.min() > 0.1
        assert np.abs(log[site].qd[-1000:]).max() < 1e-2
        # x_hat(t + s) - x_hat(t) + s Lambda e(t) over s = 0.5 s goes to zero with t.
        lengths_m = np.array([state.mem[-4:-2] for state in log[site].states])
        inner = log[site].q[:, 0]
        outer = log[site].q.sum(axis=1)
        estimate = lengths_m[:, [0]] * np.stack([np.cos(inner), np.sin(inner)], axis=1)
        estimate += lengths_m[:, [1]] * np.stack([np.cos(outer), np.sin(outer)], axis=1)
        peer = "s" if site == "m" else "m"
        e = compute_tip_places(log, site)[DELAY:] - compute_tip_places(log, peer)[:-DELAY]
        rest = estimate[DELAY + 500 :] - estimate[DELAY:-500] + 0.5 * 1.5 * e[:-500]
        size = np.abs(rest).max(axis=1)
        assert size[-5000:].max() < 0.02 * size[:5000].max()

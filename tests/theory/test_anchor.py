"""The gravity anchor: learning gravity under the paper's gains ties the arms to a pose.

The part of Eq. (15) with qd integrates exactly: d/dt (theta_4 + Gamma g sin q1) = -Gamma g cos(q1) Lambda e1,
and the same for theta_5 with q1 + q2. From equal starts, with one delay T,

    sin q1(inf) = sin q1(0) - (theta_4 - theta_hat_4(0)) / (Gamma g (1 + Lambda T)).
"""

import numpy as np
import pytest

from tests.theory.delay_equations import theta_of
from tests.virtual_runs import Run, run, trajectories
from trilat_net.scenario import load_scenario

G = 9.81
PERIOD_S = 1e-3


def alone(name: str, **overrides: float) -> Run:
    """A scenario with nobody at the arms."""
    return trajectories(load_scenario(name, overrides).without_hands())


def angles(made: Run, k: int) -> np.ndarray:
    """q1 and q1 + q2 of the slave at a tick."""
    q = made.sites["s"].q[k]
    return np.array([q[0], q.sum()])


def predicted(name: str, delay_s: float) -> np.ndarray:
    """sin q1 and sin (q1 + q2) in the end, from level arms and estimates of zero, with Gamma = Lambda = 1."""
    return -theta_of(load_scenario(name).sites["s"].arm)[3:] / (G * (1.0 + delay_s))


@pytest.mark.parametrize("name", ["paper", "paper_rods"])
def test_the_final_pose_follows_from_the_first_estimates_within_2_percent(name: str) -> None:
    made = run(name, {"duration_s": 20.0})
    assert np.sin(angles(made, -1)) == pytest.approx(predicted(name, 0.2), rel=0.02)


def test_without_delay_it_does_to_four_digits() -> None:
    """The least delay is one period; rods, whose common motion dies out within the run."""
    made = alone("paper_rods", **{"duration_s": 30.0, "link.delay_ms": 0.0})
    assert np.sin(angles(made, -1)) == pytest.approx(predicted("paper_rods", PERIOD_S), abs=1e-4)


@pytest.mark.parametrize("name", ["paper", "paper_rods"])
def test_what_the_derivation_integrates_is_conserved(name: str) -> None:
    """theta_hat_4 + Gamma g (sin q1 + int cos(q1) Lambda e1 dt), whatever the hands do; so with q1 + q2."""
    made = run(name, {"duration_s": 20.0})
    for site in made.sites.values():
        e = site.q - site.q_des
        turned = np.stack([site.q[:, 0], site.q.sum(axis=1)], axis=1)
        power = G * np.cos(turned) * np.stack([e[:, 0], e.sum(axis=1)], axis=1)
        summed = np.zeros_like(power)
        summed[1:] = np.cumsum(0.5 * PERIOD_S * (power[1:] + power[:-1]), axis=0)
        kept = site.theta_hat[:, 3:] + G * np.sin(turned) + summed
        assert np.abs(kept - kept[0]).max() < 1e-4


def test_a_hand_sees_a_spring_of_115_nm_per_rad_and_arm() -> None:
    """Gamma g^2 cos^2 (1 + Lambda T), 115.5 N m/rad level; a push at one site moves all three by a third."""
    push_nm = 15.0
    hands = [{"kind": "recorded", "points": [[0.0, push_nm, push_nm], [60.0, push_nm, push_nm]]}]
    rest = alone("paper_rods", duration_s=20.0)
    pushed = trajectories(
        load_scenario("paper_rods", {"duration_s": 20.0, "sites.m1.hands": hands, "sites.m2.hands": []})
    )
    there, from_where = angles(pushed, -1), angles(rest, -1)
    assert there[0] == pytest.approx(from_where[0], abs=2e-3)  # equal torques act on q1 + q2 alone
    assert np.abs(pushed.stack("q") - pushed.stack("q_des"))[:, -1].max() < 1e-4  # no error: nothing is felt
    middle = 0.5 * (there[1] + from_where[1])
    stiffness = push_nm / 3.0 / (there[1] - from_where[1])
    level = G**2 * 1.2
    assert level == pytest.approx(115.5, abs=0.1)
    assert stiffness == pytest.approx(level * np.cos(middle) ** 2, rel=0.01)


def test_a_small_gain_has_no_such_pose_and_the_arms_hang() -> None:
    """Gamma = 0.1: |sin q1(inf)| would have to be 1.7."""
    made = alone("paper", **{"duration_s": 30.0, "control.Gamma": 0.1})
    assert predicted("paper", 0.2)[0] / 0.1 < -1.0
    assert made.sites["s"].q[-10_000:, 0].mean() == pytest.approx(-np.pi / 2, abs=0.1)

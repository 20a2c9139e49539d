"""The gravity anchor: learning gravity under the paper's gains ties the arms to a pose.

The part of Eq. (15) with qd integrates exactly: d/dt (theta_4 + Gamma g sin q1) = -Gamma g cos(q1) Lambda e1,
and the same for theta_5 with q1 + q2. From equal starts, with one delay T,

    sin q1(inf) = sin q1(0) - (theta_4 - theta_hat_4(0)) / (Gamma g (1 + Lambda T)).

Dominance is force sharing: at rest, with equal Kp Lambda and known gravity, sum_i beta_i tau_i = 0.
"""

import numpy as np
import pytest

from tests.execution.builders import make_shipped_trajectories, sample_records
from tests.theory.delay_equations import theta_of
from tests.theory.energy import left_null_vector
from tests.theory.figures_of_runs import find_value, measure_run
from trilat_net.scenario import load_scenario

G = 9.81
PERIOD_S = 1e-3


def read_last_angles(records: np.ndarray) -> np.ndarray:
    """Returns q1 and q1 + q2 of the slave in the last of some records."""
    q = records[2, -1, :2]
    return np.array([q[0], q.sum()])


def predict_sines(name: str, delay_s: float) -> np.ndarray:
    """Returns sin q1 and sin (q1 + q2) in the end, from level arms and estimates of zero, with
    Gamma = Lambda = 1.
    """
    return -theta_of(load_scenario(name).sites["s"].arm)[3:] / (G * (1.0 + delay_s))


@pytest.mark.parametrize(
    ("name", "delay_s", "end_s", "bar"),
    [
        ("paper", 0.2, 20.0, {"rel": 0.02}),
        ("paper", 0.2, 60.0, {"abs": 3e-3}),
        ("paper", 0.0, 60.0, {"abs": 2e-3}),
        ("paper_rods", 0.2, 20.0, {"rel": 0.02}),
        ("paper_rods", 0.0, 30.0, {"abs": 1e-4}),  # their common motion dies out within the run
    ],
)
def test_the_final_pose_follows_from_the_first_estimates(
    name: str, delay_s: float, end_s: float, bar: dict[str, float]
) -> None:
    """The least delay is one period."""
    end = sample_records(load_scenario(name, {"link.delay_ms": 1e3 * delay_s}), (end_s,))
    assert np.sin(read_last_angles(end)) == pytest.approx(
        predict_sines(name, max(delay_s, PERIOD_S)), **bar
    )


def test_gravity_alone_is_learnt() -> None:
    theta_hat = sample_records(load_scenario("paper"), (60.0,))[0, -1, 12:]
    assert theta_hat[3:] == pytest.approx([2.0, 1.0], abs=0.02)
    assert theta_hat[2] < 0.0  # inertial estimates are free to be anything


@pytest.mark.parametrize("name", ["paper", pytest.param("paper_rods", marks=pytest.mark.long)])
def test_the_derivations_integral_is_conserved(name: str) -> None:
    """theta_hat_4 + Gamma g (sin q1 + int cos(q1) Lambda e1 dt), whatever the hands do; the
    same with q1 + q2.
    """
    trajectory_of_run = make_shipped_trajectories(name, {"duration_s": 20.0})
    for site in trajectory_of_run.sites.values():
        e = site.q - site.q_des
        turned = np.stack([site.q[:, 0], site.q.sum(axis=1)], axis=1)
        power = G * np.cos(turned) * np.stack([e[:, 0], e.sum(axis=1)], axis=1)
        summed = np.zeros_like(power)
        summed[1:] = np.cumsum(0.5 * PERIOD_S * (power[1:] + power[:-1]), axis=0)
        kept = site.theta_hat[:, 3:] + G * np.sin(turned) + summed
        assert np.abs(kept - kept[0]).max() < 1e-4


def test_hands_see_115_nm_per_rad() -> None:
    """Gamma g^2 cos^2 (1 + Lambda T), 115.5 N m/rad level; a push at one site moves all three
    by a third.
    """
    push_nm = 15.0
    hands = [
        {"kind": "recorded", "points": [[0.0, push_nm, push_nm], [60.0, push_nm, push_nm]]}
    ]
    rest = sample_records(load_scenario("paper_rods").without_hands(), (20.0,))
    pushed = sample_records(
        load_scenario("paper_rods", {"sites.m1.hands": hands, "sites.m2.hands": []}), (20.0,)
    )
    pushed_angles = read_last_angles(pushed)
    from_where = read_last_angles(rest)
    # equal torques act on q1 + q2 alone
    assert pushed_angles[0] == pytest.approx(from_where[0], abs=2e-3)
    # no error: nothing is felt
    assert np.abs(pushed[:, -1, :2] - pushed[:, -1, 4:6]).max() < 1e-4
    middle = 0.5 * (pushed_angles[1] + from_where[1])
    stiffness = push_nm / 3.0 / (pushed_angles[1] - from_where[1])
    level = G**2 * 1.2
    assert level == pytest.approx(115.5, abs=0.1)
    assert stiffness == pytest.approx(level * np.cos(middle) ** 2, rel=0.01)


def test_small_gains_let_arms_hang() -> None:
    """Gamma = 0.1: |sin q1(inf)| would have to be 1.7."""
    hanging = load_scenario("paper", {"control.Gamma": 0.1}).without_hands()
    assert predict_sines("paper", 0.2)[0] / 0.1 < -1.0
    assert sample_records(hanging, np.arange(20.0, 30.0, 0.01))[
        2, :, 0
    ].mean() == pytest.approx(-np.pi / 2, abs=0.1)


LOAD_NM = 5.0
HELD = ((13.0, 15.0, "m1"), (38.0, 40.0, "m2"), (52.0, 54.0, "m2"))
"""The expert holds; the trainee holds; the trainee, all shares 1/2."""


@pytest.mark.long
def test_hands_feel_loads_by_ratios_of_beta() -> None:
    """A load of 5 N m on the slave is felt as 4.79 at the expert, 16.4 at the trainee, and 5.00 with all shares 1/2."""
    b1, b2, bs = left_null_vector(load_scenario("force_sharing"))
    windows = measure_run("force_sharing", {}, *HELD)
    felt = [-find_value(windows, "push1_mean_nm", n) for n in range(len(HELD))]
    assert felt == pytest.approx([4.79, 16.4, 5.00], rel=0.02)
    assert felt == pytest.approx([LOAD_NM * bs / b1, LOAD_NM * bs / b2, LOAD_NM], rel=0.02)
    assert felt[::2] == pytest.approx([LOAD_NM * bs / b1, LOAD_NM], rel=1e-3)  # both at rest

"""The goal q* against the rest of linear systems.

A score against the plain sums over a trajectory, and against cases that must score zero.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from study_builders import FIRM_GAINS, make_trio_scenario
from trilat_studies.tuning.candidate import (
    CandidateClass,
    CandidateScore,
    build_twin,
    check_comparable,
    compute_consensus_pose,
)

from tests.execution.builders import make_trajectories
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario

PULSE = 'sites.m1.hands=[{kind = "pulse", start_s = 0.2, end_s = 0.8, peak_nm = [3.0, 0.0]}]'
WALL = 'sites.s.environment=[{kind = "wall", point_m = [1.5, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 99.0}]'


def write_spring(
    site: str,
    to: tuple[float, float],
    K: tuple[float, float],
    start: float = 0.0,
    end: float = 9.0,
) -> str:
    """Returns the override that lets an operator pull an arm to a pose by springs."""
    return (
        f'sites.{site}.hands=[{{kind = "spring", to_rad = {list(to)}, stiffness_nm_rad = {list(K)}, '
        f"start_s = {start}, end_s = {end}}}]"
    )


def find_final_pose(scenario: Scenario) -> np.ndarray:
    """Returns the pose at which the arms should rest at the end of a scenario."""
    return compute_consensus_pose(scenario, np.array([0.0, scenario.duration_s]))[-1]


@given(a=st.floats(0.05, 0.95), b=st.floats(0.05, 0.95), c=st.floats(0.05, 0.95))
def test_without_hands_the_goal_is_linear_consensus(a: float, b: float, c: float) -> None:
    """The arms rest at the limit of x' = (alpha - I) x, by the matrix exponential."""
    scenario = make_trio_scenario(
        f"dominance.m1={{m2 = {a!r}, s = {1 - a!r}}}",
        f"dominance.m2={{m1 = {b!r}, s = {1 - b!r}}}",
        f"dominance.s={{m1 = {c!r}, m2 = {1 - c!r}}}",
    )
    start = np.array([spec.q0_rad for spec in scenario.sites.values()])
    rest = expm((scenario.alpha - np.eye(3)) * 1e4) @ start
    assert find_final_pose(scenario) == pytest.approx(rest[0], abs=1e-9)
    assert find_final_pose(scenario) == pytest.approx(rest[2], abs=1e-9)


@settings(max_examples=20)
@given(K1=st.floats(1.0, 300.0), K2=st.floats(1.0, 300.0), x=st.floats(-1.0, 1.0))
def test_hands_put_the_goal_where_stiff_arms_rest(K1: float, K2: float, x: float) -> None:
    """K_i (x_i - q_i) = k (q_i - sum_j alpha_ij q_j) with k far above K, solved directly."""
    # alike enough to be no conflict
    scenario = make_trio_scenario(
        write_spring("m1", (x, 0.0), (K1, K1)), write_spring("m2", (x + 0.01, 0.0), (K2, K2))
    )
    K = np.diag([K1, K2, 0.0])
    matrix = K + 1e7 * (np.eye(3) - scenario.alpha)
    rest = np.linalg.solve(matrix, K @ [x, x + 0.01, 0.0])
    assert find_final_pose(scenario)[0] == pytest.approx(rest.mean(), abs=1e-4)


def test_a_joint_without_hand_stays() -> None:
    """A spring moves the goal of its joint while it acts and after, and not that of the other."""
    scenario = make_trio_scenario(
        write_spring("m1", (0.5, 0.7), (100.0, 0.0), start=0.5, end=1.0)
    )
    before, held, after = compute_consensus_pose(scenario, np.array([0.2, 0.7, 1.9]))
    free = compute_consensus_pose(make_trio_scenario(), np.array([0.0]))[0]
    assert before == pytest.approx(free)
    assert held == pytest.approx([0.5, free[1]])
    assert after == pytest.approx([0.5, free[1]])


def test_hands_move_goals_along_minimum_jerk_paths() -> None:
    """Half way in the middle; the spring's target in `box`-like moves is checked in the core."""
    scenario = make_trio_scenario(
        'sites.m1.hands=[{kind = "spring", from_rad = [0.0, 0.0], to_rad = [1.0, 2.0], '
        "move_start_s = 0.5, move_end_s = 1.5, stiffness_nm_rad = 50.0}]".replace(
            "50.0", "[50.0, 50.0]"
        )
    )
    path = compute_consensus_pose(scenario, np.array([0.4, 0.75, 1.0, 1.6]))
    quarter = 10 * 0.25**3 - 15 * 0.25**4 + 6 * 0.25**5
    assert path[:, 0] == pytest.approx([0.0, quarter, 0.5, 1.0])
    assert path[:, 1] == pytest.approx(2.0 * path[:, 0])


def test_twins_have_no_torque_and_no_wall() -> None:
    assert build_twin(make_trio_scenario()) is None
    assert build_twin(make_trio_scenario(write_spring("m1", (0.3, -0.2), (9.0, 9.0)))) is None
    for setting in (PULSE, WALL):
        twin = build_twin(make_trio_scenario(setting))
        assert twin is not None
        assert twin.sites == make_trio_scenario().sites


def test_contradicting_hands_are_refused_with_their_site() -> None:
    with pytest.raises(
        ScenarioError,
        match=r"training: sites\.m1\.hands: at 0 s .* keep only one of the operators",
    ):
        check_comparable(load_scenario("training"))


@pytest.mark.parametrize(
    ("setting", "word"),
    [
        (
            "link.model=measured",
            "links.m2->m1.model: is 'measured', the delay of a real network",
        ),
        (
            "task.space=position",
            "task.space: laws are compared by the distance between joint angles",
        ),
        (
            "sites.m2.plant=external",
            "sites.m2.plant: is external: a scenario with an external arm can only run live",
        ),
    ],
)
def test_a_scenario_without_common_angles_is_refused(setting: str, word: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        check_comparable(
            load_scenario("free", [setting, 'task.axes=["x", "y"]'][: 1 + ("task" in setting)])
        )
    assert word in str(refused.value)


def test_two_closed_groups_have_no_common_pose() -> None:
    pairs = {
        "name": "pairs",
        "link": {"delay_ms": 9.0},
        "sites": {name: {"role": "master"} for name in "abcd"},
        "dominance": {"a": {"b": 1.0}, "b": {"a": 1.0}, "c": {"d": 1.0}, "d": {"c": 1.0}},
    }
    with pytest.raises(ScenarioError, match="a, b and c, d"):
        check_comparable(load_scenario(pairs))


FIRM = (*FIRM_GAINS, "duration_s=4.0")


def measure_score(scenario: Scenario, twin: Scenario | None = None) -> CandidateScore:
    """Returns the score of a scenario, compared with its copy without disturbances if given."""
    return CandidateScore.measure(scenario.text, None if twin is None else twin.text)


def test_error_and_effort_are_the_documented_sums() -> None:
    """Errors refer to the weighted mean of the starts, and the effort leaves out gravity."""
    scenario = make_trio_scenario(*FIRM)
    score = measure_score(scenario)
    run = make_trajectories(scenario)
    q = run.stack("q")
    tau = run.stack("tau")

    # the share of its first peer at each site; beta has the paper's minors
    a = 0.2
    b = 0.5
    c = 0.6
    beta = np.array([1.0 - (1.0 - b) * (1.0 - c), 1.0 - (1.0 - a) * c, 1.0 - a * b])
    pose = beta @ q[:, 0] / beta.sum()

    upper_nm = 2.0 * 9.81 * np.cos(q[..., 0])
    fore_nm = 9.81 * np.cos(q[..., 0] + q[..., 1])
    gravity = np.stack([upper_nm + fore_nm, fore_nm], axis=-1)

    assert score.error_rad == pytest.approx(np.sqrt(np.mean((q - pose) ** 2)), rel=1e-9)
    assert score.effort_nm == pytest.approx(np.sqrt(np.mean((tau - gravity) ** 2)), rel=1e-9)
    assert score.spread_rad == pytest.approx(np.sqrt(np.mean(q.var(axis=0))), rel=1e-9)
    assert score.pose_rad == pytest.approx(
        np.sqrt(np.mean((q.mean(axis=0) - pose) ** 2)), rel=1e-9
    )
    e = np.abs(q - run.stack("q_des")).max(axis=(0, 2))
    assert score.settled_s == pytest.approx(0.01 * np.flatnonzero(e >= 0.01)[-1])


def test_arms_that_start_at_the_goal_do_nothing() -> None:
    still = make_trio_scenario(
        "control.law=p_d", *(f"sites.{name}.q0_rad=[0.2, 0.3]" for name in ("m1", "m2", "s"))
    )
    score = measure_score(still)
    assert score.outcome is CandidateClass.SETTLED
    assert score.error_rad == pytest.approx(0.0, abs=1e-12)
    assert score.effort_nm == pytest.approx(0.0, abs=1e-12)
    assert score.settled_s == 0.0


def test_hanging_arms_are_scored_by_their_fall() -> None:
    """The arms end in step with e = 0 and no torque at all, which must not improve their score."""
    hanging = measure_score(make_trio_scenario(*FIRM, "control.gravity=0.0", "duration_s=20.0"))
    standing = measure_score(make_trio_scenario(*FIRM, "duration_s=20.0"))
    assert hanging.settled_s is not None  # all that e says
    assert hanging.outcome is CandidateClass.STRAYED
    assert standing.outcome is CandidateClass.SETTLED
    assert (hanging.error_rad or 0.0) > 10.0 * (standing.error_rad or np.inf)
    assert (hanging.pose_rad or 0.0) > 1.0


def test_arms_that_sink_slowly_drift_before_they_hang() -> None:
    """Damping slows the fall: 5 % of gravity, some 1.5 N m, against 100 N m s/rad."""
    sinking = (
        *FIRM,
        "rate_hz=1000",
        "control.d=100.0",
        "control.K=400.0",
        "control.gravity=0.95",
    )
    score = measure_score(make_trio_scenario(*sinking, "duration_s=15.0"))
    assert 0.02 < (score.pose_rad or 0.0) < 0.15
    assert score.outcome is CandidateClass.OSCILLATED


def test_diverged_runs_have_no_error() -> None:
    score = measure_score(make_trio_scenario(*FIRM, "limits.qd_limit_rad_s=0.2"))
    assert score.outcome is CandidateClass.DIVERGED
    assert score.error_rad is None
    assert score.effort_nm is None
    assert score.diverged_s is not None


def test_sites_of_different_rates_are_compared_simultaneously() -> None:
    """A slave at a quarter of the rate changes the score only by its coarser steps."""
    alike = measure_score(make_trio_scenario(*FIRM, "rate_hz=400"))
    mixed = measure_score(make_trio_scenario(*FIRM, "rate_hz=400", "sites.s.rate_hz=100"))
    assert mixed.spread_rad == pytest.approx(alike.spread_rad, rel=0.1)
    assert mixed.effort_nm == pytest.approx(alike.effort_nm, rel=0.2)


def test_with_a_twin_the_goal_is_its_pose() -> None:
    """With a push, the pose of the run without the push is the goal, and so is its error."""
    push = (
        'sites.m1.hands=[{kind = "pulse", start_s = 0.2, end_s = 1.2, peak_nm = [20.0, 0.0]}]'
    )
    pushed = make_trio_scenario(*FIRM, push)
    twin = make_trio_scenario(*FIRM)
    score = measure_score(pushed, twin)
    assert score.pose_rad == measure_score(twin).pose_rad
    assert score.spread_rad == measure_score(pushed).spread_rad
    assert score.error_rad == pytest.approx(
        np.hypot(score.spread_rad or 0.0, score.pose_rad or 0.0)
    )

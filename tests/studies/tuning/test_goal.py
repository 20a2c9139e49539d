"""q*, against the linear systems whose rest it is said to be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.studies.tuning.candidate import build_twin, check_comparable, compute_consensus_pose

from .experiments import trio

PULSE = 'sites.m1.hands=[{kind = "pulse", start_s = 0.2, end_s = 0.8, peak_nm = [3.0, 0.0]}]'
WALL = (
    'sites.s.environment=[{kind = "wall", point_m = [1.5, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 99.0}]'
)


def hand(
    site: str, to: tuple[float, float], K: tuple[float, float], start: float = 0.0, end: float = 9.0
) -> str:
    return (
        f'sites.{site}.hands=[{{kind = "spring", to_rad = {list(to)}, stiffness_nm_rad = {list(K)}, '
        f"start_s = {start}, end_s = {end}}}]"
    )


def at_end(scenario: Scenario) -> np.ndarray:
    return compute_consensus_pose(scenario, np.array([0.0, scenario.duration_s]))[-1]


@given(a=st.floats(0.05, 0.95), b=st.floats(0.05, 0.95), c=st.floats(0.05, 0.95))
def test_without_hands_it_is_where_linear_consensus_comes_to(a: float, b: float, c: float) -> None:
    """x' = (alpha - I) x, by the matrix exponential."""
    rows = [
        f"dominance={{m1 = {{m2 = {a!r}, s = {1 - a!r}}}, m2 = {{m1 = {b!r}, s = {1 - b!r}}}, "
        f"s = {{m1 = {c!r}, m2 = {1 - c!r}}}}}"
    ]
    scenario = trio(*rows)
    start = np.array([spec.q0_rad for spec in scenario.sites.values()])
    rest = expm((scenario.alpha - np.eye(3)) * 1e4) @ start
    assert at_end(scenario) == pytest.approx(rest[0], abs=1e-9)
    assert at_end(scenario) == pytest.approx(rest[2], abs=1e-9)


@settings(max_examples=20)
@given(K1=st.floats(1.0, 300.0), K2=st.floats(1.0, 300.0), x=st.floats(-1.0, 1.0))
def test_hands_take_it_where_stiff_arms_rest(K1: float, K2: float, x: float) -> None:
    """K_i (x_i - q_i) = k (q_i - sum_j alpha_ij q_j) with k far above K, solved as it stands."""
    scenario = trio(
        hand("m1", (x, 0.0), (K1, K1)), hand("m2", (x + 0.01, 0.0), (K2, K2))
    )  # alike enough to be no conflict
    K = np.diag([K1, K2, 0.0])
    matrix = K + 1e7 * (np.eye(3) - scenario.alpha)
    rest = np.linalg.solve(matrix, K @ [x, x + 0.01, 0.0])
    assert at_end(scenario)[0] == pytest.approx(rest.mean(), abs=1e-4)


def test_a_joint_that_nobody_holds_stays() -> None:
    scenario = trio(hand("m1", (0.5, 0.7), (100.0, 0.0), start=0.5, end=1.0))
    before, held, after = compute_consensus_pose(scenario, np.array([0.2, 0.7, 1.9]))
    free = compute_consensus_pose(trio(), np.array([0.0]))[0]
    assert before == pytest.approx(free)
    assert held == pytest.approx([0.5, free[1]])
    assert after == pytest.approx([0.5, free[1]])


def test_a_hand_moves_it_along_a_minimum_jerk_path() -> None:
    """Half way in the middle; the spring's target in `box`-like moves is checked in the core."""
    scenario = trio(
        'sites.m1.hands=[{kind = "spring", from_rad = [0.0, 0.0], to_rad = [1.0, 2.0], '
        "move_start_s = 0.5, move_end_s = 1.5, stiffness_nm_rad = 50.0}]".replace("50.0", "[50.0, 50.0]")
    )
    path = compute_consensus_pose(scenario, np.array([0.4, 0.75, 1.0, 1.6]))
    quarter = 10 * 0.25**3 - 15 * 0.25**4 + 6 * 0.25**5
    assert path[:, 0] == pytest.approx([0.0, quarter, 0.5, 1.0])
    assert path[:, 1] == pytest.approx(2.0 * path[:, 0])


def test_twin_has_no_torque_without_target_and_no_wall() -> None:
    assert build_twin(trio()) is None
    assert build_twin(trio(hand("m1", (0.3, -0.2), (9.0, 9.0)))) is None
    for setting in (PULSE, WALL):
        alone = build_twin(trio(setting))
        assert alone is not None
        assert alone.sites == trio().sites


def test_two_hands_that_disagree_are_refused_with_the_site() -> None:
    with pytest.raises(
        ScenarioError, match=r"training: sites\.m1\.hands: at 0 s .* keep one of the operators"
    ):
        check_comparable(load_scenario("training"))


@pytest.mark.parametrize(
    ("setting", "word"),
    [
        ("link.model=measured", "links.m2->m1.model: is measured: that is the delay of a real network"),
        ("task.space=position", "task.space: laws are compared by the distance of joint angles"),
        ("sites.m2.plant=external", "sites.m2.plant: is external: that arm is outside of the program"),
    ],
)
def test_a_scenario_without_common_angles_is_refused(setting: str, word: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        check_comparable(load_scenario("free", [setting, 'task.axes=["x", "y"]'][: 1 + ("task" in setting)]))
    assert word in str(refused.value)


def test_two_closed_groups_have_no_common_pose() -> None:
    text = "\n".join(
        [
            'name = "pairs"',
            "[link]",
            "delay_ms = 9.0",
            *(f'[sites.{n}]\nrole = "master"' for n in "abcd"),
            "[dominance]",
        ]
        + [f"{i} = {{ {j} = 1.0 }}" for i, j in ("ab", "ba", "cd", "dc")]
    )
    with pytest.raises(ScenarioError, match="a, b and c, d"):
        check_comparable(parse_scenario(text))

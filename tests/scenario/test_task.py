"""Mistakes of sites in task space, and keys without effect: each is refused at its own key."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from tests.scenario.builders import planar_task_text
from trilat_net.errors import ScenarioError
from trilat_net.execution import simulate_scenario
from trilat_net.scenario import load_scenario, parse_scenario
from trilat_net.scenario.describe import describe_scenario
from trilat_net.scenario.laws import LAWS

TEXT = planar_task_text()


@pytest.mark.parametrize(
    ("changes", "path", "phrase"),
    [
        (
            {"sites.s.q0_rad": [0.1, 0.0]},
            "sites.s.q0_rad",
            "singular pose: the end effector cannot move along",
        ),
        (
            {"task.axes": ["x", "y", "z"]},
            "sites.m.task.axes",
            "has z, along which no joint moves",
        ),
        ({"task.axes": []}, "sites.m.task.axes", "has z, along which no joint moves"),
        ({"task.axes": ["x", "rx"]}, "sites.m.task.axes", "rx, which belongs to a pose"),
        ({"task.axes": ["q"]}, "task.axes[0]", "is 'q', but must be 'x' or 'y'"),
        ({"task.space": "place"}, "task.space", "must be 'joints' or 'position'"),
        ({"task.scale": 0}, "task.scale", "> 0"),
        (
            {"task.posture_rad": [0, 0]},
            "sites.m.task.posture_rad",
            "while posture_rate_1_s is 0",
        ),
        (
            {"task.posture_rad": [0, 0, 0], "task.posture_rate_1_s": 1},
            "sites.m.task.posture_rad",
            "has 3 numbers, and the arm has 2 joints",
        ),
        (
            {"task.space": "joints"},
            "sites.m.task.axes",
            "has no effect while sites share joint angles",
        ),
        ({"sites.m.arm.base_xyz_m": [0, 0]}, "sites.m.arm.base_xyz_m", "length"),
    ],
)
def test_task_mistakes_are_refused_at_their_key(
    changes: dict[str, Any], path: str, phrase: str
) -> None:
    with pytest.raises(ScenarioError) as refused:
        parse_scenario(TEXT, overrides=changes)
    assert (refused.value.path, phrase in refused.value.problem) == (path, True), refused.value


@pytest.mark.parametrize(
    ("name", "key", "value", "phrase"),
    [
        ("free", "arm.base_xyz_m", [1, 0, 0], "all arms are planar"),
        ("free", "arm.base_rpy_rad", [1, 0, 0], "all arms are planar"),
        ("free", "task.scale", 0.3, "sites share joint angles"),
        ("free", "task.singular_value", 0.3, "sites share joint angles"),
    ],
)
def test_a_key_without_effect_is_refused(name: str, key: str, value: Any, phrase: str) -> None:
    with pytest.raises(ScenarioError, match=phrase) as refused:
        load_scenario(name, {key: value})
    assert refused.value.path == f"sites.m1.{key}"


def test_arms_unturned_by_gravity_are_accepted() -> None:
    """The first axis is along gravity: gravity makes no torque about it, and nothing is learnt there."""
    scenario = load_scenario("unlike_arms", {"sites.s.arm.down": [0.0, 0.0, 5.0]})
    chain = scenario.arms["s"].chain
    assert chain is not None
    assert np.linalg.norm(chain.gravity_m_s2) == pytest.approx(9.81)


@pytest.mark.parametrize(("elbow_rad", "damped"), [(0.01, True), (1.7, False)])
def test_start_near_a_singular_pose_is_reported(elbow_rad: float, damped: bool) -> None:
    """The least singular value of a two-link arm of equal lengths, from its determinant sin q2."""
    lines = describe_scenario(parse_scenario(planar_task_text(elbow_rad=elbow_rad)))
    (line,) = [line for line in lines if line.startswith("s follows along x, y")]
    c = np.cos(elbow_rad)
    s = np.sin(elbow_rad)
    squares = 3.0 + 2.0 * c  # of all entries of J
    least = np.sqrt(0.5 * (squares - np.sqrt(squares**2 - 4.0 * s * s)))
    assert f"start pose {least:.3g}," in line
    assert ("its inverse is damped" in line) == damped


@pytest.mark.parametrize("name", ["unlike_arms", "wall_in_space"])
@pytest.mark.parametrize("law", sorted(LAWS))
def test_every_law_runs_or_is_refused(law: str, name: str) -> None:
    """Gains per joint and per shared coordinate differ in number if arms share positions."""
    changes = {"control": {"law": law}, "scheme": "digital", "duration_s": 0.01}
    with suppress(ScenarioError):
        log = simulate_scenario(load_scenario(name, changes))
        assert all(np.isfinite(log[site].tau).all() for site in log.sites)


def test_damping_from_stiffness_needs_joint_space() -> None:
    with pytest.raises(ScenarioError, match="choose p_d or pd_d") as refused:
        load_scenario("unlike_arms", {"control": {"law": "lee_spong"}})
    assert refused.value.path == "sites.m1.control.law"

"""Sites that share positions or poses: keys with an effect, and every law."""

from contextlib import suppress

import numpy as np
import pytest

from tests.scenario.builders import planar_task_text
from trilat_net.errors import ScenarioError
from trilat_net.execution import SimulatedLog
from trilat_net.scenario import load_scenario, parse_scenario
from trilat_net.scenario.describe import describe_scenario
from trilat_net.scenario.laws import LAWS


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
        log = SimulatedLog(load_scenario(name, changes))
        assert all(np.isfinite(log[site].tau).all() for site in log.sites)

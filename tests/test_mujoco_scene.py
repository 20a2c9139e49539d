"""examples/mujoco: the scenario's arm moves in MuJoCo as in the program, and pushes other bodies."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.errors import ScenarioError

FOLDER = Path(__file__).parents[1] / "examples" / "mujoco"


@pytest.fixture(autouse=True)
def _beside_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FOLDER)


def apart_rad(name: str, rate_hz: int, **more: Any) -> float:
    """Returns the largest distance of the slave from its motion under the program's dynamics,
    in free motion.
    """
    overrides = {"rate_hz": rate_hz, "link.delay_ms": 50, **more}
    plant = {"sites.s.plant": {"class": "scene:Scene", "thing": "nothing"}}
    ours, theirs = (
        tn.simulate(name, {**overrides, **plant_keys}, duration_s=1.5)
        for plant_keys in ({}, plant)
    )
    return float(np.abs(ours["s"].q - theirs["s"].q).max())


def test_free_motion_differs_by_the_periods_order() -> None:
    """The torque of a tick acts from that tick on, the program's is extrapolated to the middle:
    of first order in h.
    """
    coarse = apart_rad("paper", 500)
    fine = apart_rad("paper", 1000)
    assert 0.0 < fine < 0.004
    assert 1.8 < coarse / fine < 2.2


@pytest.mark.long
def test_urdf_arms_are_the_same_arm() -> None:
    coarse = apart_rad("unlike_arms", 500)
    fine = apart_rad("unlike_arms", 1000)
    assert 0.0 < fine < 0.02
    assert 1.5 < coarse / fine < 2.5


def test_pushed_boxes_are_felt_by_the_users() -> None:
    nothing = {"sites.s.plant.thing": "nothing", "sites.s.plant.bodies": {}}
    free, box = (tn.simulate("push.toml", thing, duration_s=6) for thing in (nothing, {}))
    place_m = box["s"].bodies[:, :3]
    assert place_m[-1, 0] - place_m[0, 0] > 0.1
    assert np.abs(free["s"].tau_x).max() == 0.0
    assert np.abs(box["s"].tau_x).max() > 5.0
    assert np.abs(box["m1"].q[-1] - free["m1"].q[-1]).max() > 0.01
    assert tn.verify(box).passed


def test_runs_on_one_machine_have_the_same_bits() -> None:
    logs = [tn.simulate("push.toml", duration_s=2) for _ in range(2)]
    assert np.array_equal(logs[0]["s"].q, logs[1]["s"].q)


def test_a_missing_body_is_named() -> None:
    with pytest.raises(
        ScenarioError, match="thing is one of nothing, box, door, slot, not 'cup'"
    ):
        tn.simulate("push.toml", {"sites.s.plant.thing": "cup"})

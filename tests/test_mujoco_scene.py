"""examples/mujoco: the scenario's arm in MuJoCo moves as our own does, and pushes what stands there."""

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
    """How far the slave gets from where our own dynamics take it, in free motion."""
    overrides = {"rate_hz": rate_hz, "link.delay_ms": 50, **more}
    plant = {"sites.s.plant": {"class": "scene:Scene", "thing": "nothing"}}
    ours, theirs = (
        tn.simulate(name, {**overrides, **one}, duration_s=1.5) for one in ({}, plant)
    )
    return float(np.abs(ours["s"].q - theirs["s"].q).max())


def test_free_motion_differs_by_the_order_of_the_period() -> None:
    """The torque of a tick acts from it on, ours is extrapolated to its middle: of first order in h."""
    coarse, fine = apart_rad("paper", 500), apart_rad("paper", 1000)
    assert 0.0 < fine < 0.004
    assert 1.8 < coarse / fine < 2.2


@pytest.mark.long
def test_an_arm_of_a_urdf_is_the_same_arm() -> None:
    coarse, fine = apart_rad("unlike_arms", 500), apart_rad("unlike_arms", 1000)
    assert 0.0 < fine < 0.02
    assert 1.5 < coarse / fine < 2.5


def test_the_box_is_pushed_and_the_users_feel_it() -> None:
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


def test_a_thing_that_it_has_not_is_named() -> None:
    with pytest.raises(
        ScenarioError, match="thing is one of nothing, box, door, slot, not 'cup'"
    ):
        tn.simulate("push.toml", {"sites.s.plant.thing": "cup"})

"""A session in which a policy moves m2 and a person moves m1 through the plugins, and its
expected results.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from trilat_net.log.log_reader import Log

from .lerobot_stub import make_device

ROBOT = "lerobot_robot_trilat"
TELEOPERATOR = "lerobot_teleoperator_trilat"


def drive(
    plugins: dict[str, ModuleType], running: Any, wait_s: Callable[[float], Any], **reach: Any
) -> dict[str, Any]:
    """Moves both arms through the plugins for two seconds and returns the reported observations."""
    robot = make_device(plugins[ROBOT].TrilatRobotConfig(**reach))
    teleoperator = make_device(plugins[TELEOPERATOR].TrilatTeleoperatorConfig(**reach))
    robot.connect()
    teleoperator.connect()
    first = robot.get_observation()
    before = teleoperator.get_teleop_events()
    goal = {"x.pos": first["x.pos"] + 0.1, "y.pos": first["y.pos"]}
    for n in range(60):
        assert robot.send_action(goal) == goal
        if n == 30:
            felt = robot.get_observation()["x.felt"]
            running.set_dominance("s", {"m1": 0.9, "m2": 0.1}, 0.5)
            teleoperator.enable_torque()
        teleoperator.send_feedback(goal)
        wait_s(1.0 / 30.0)
    observations = {
        "before": before,
        "after": teleoperator.get_teleop_events(),
        "observed": robot.get_observation(),
        "features": robot.observation_features,
        "goal": goal,
        "first": first,
        "felt": felt,
        "led": teleoperator.get_action(),
    }
    teleoperator.disable_torque()
    teleoperator.disconnect()
    robot.disconnect()
    assert not robot.is_connected
    return observations


def assert_taken_over(seen: dict[str, Any], log: Log) -> None:
    """Asserts that the person's arm leads after the takeover, and that the policy's arm is held."""
    before = {key.value: value for key, value in seen["before"].items()}
    after = {key.value: value for key, value in seen["after"].items()}
    assert not before["is_intervention"]
    assert after["is_intervention"]
    assert not before["terminate_episode"]
    assert not after["terminate_episode"]
    assert list(seen["observed"]) == list(seen["features"])
    assert seen["felt"] < -0.1  # the arm hangs back from where the policy pulls it
    assert seen["observed"]["x.pos"] > seen["first"]["x.pos"] + 0.02
    assert seen["observed"]["s.q1.pos"] != seen["first"]["s.q1.pos"]
    assert seen["led"]["x.pos"] > seen["first"]["x.pos"] + 0.02
    held = log["m2"].hand[np.flatnonzero(log["m2"].hand[:, 2])]
    assert held[-1, 3:5] == pytest.approx(list(seen["goal"].values()))
    assert log["m1"].hand[:, 0].max() == 1.0

"""A LeRobot robot that lets a policy drive one of the two masters of a trilat-net session.

In such a session, a slave arm follows two master arms, one driven by the policy and the other
by another user. An action of the policy moves its master as an operator would (a "live hand" of
the scenario). An observation consists of the newest states of the slave and of that master, and
of the position and force of the operator.

`python -m lerobot_robot_trilat FOLDER` runs a trained policy in a session. `lerobot-rollout` of
LeRobot 0.6.1 cannot do this, because it omits torques, forces and
`observation.environment_state`.

Invariant:
    - The scenario limits the force and speed with which an action moves the arm.
    - The slave follows all of its users, weighted by their dominance factors.
    - The keys of actions and observations depend only on the scenario.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import trilat_net as tn

_HAND_COMMANDS = {
    "tip": ("move", "pos"),
    "joint": ("turn", "pos"),
    "force": ("push", "force"),
}
"""Commands of a hand (operator) in each mode.

Maps each mode to the method of `tn.hand` and the suffix of the keys of a command.
"""


@RobotConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatRobotConfig(RobotConfig):
    """Settings of a `TrilatRobot`: the session, and the master that the policy drives.

    Attributes:
        session: Name of the session.
        scenario: Name or path of the scenario of the session. Empty if it has the same name as
            the session.
        site: Name of the master that the policy drives.
        slave: Name of the slave, which the policy also observes.
        connect: Network endpoints of the session. Empty for the default endpoints on this
            machine.
        keys: Folder of the operator's keys. Empty for a session without keys.
        timeout_s: Maximum time to wait for the session, in s.
    """

    session: str = "play"
    scenario: str = ""
    site: str = "m2"
    slave: str = "s"
    connect: list[str] = field(default_factory=list)
    keys: str = ""
    timeout_s: float = 5.0


class TrilatRobot(Robot):
    """LeRobot robot that consists of the slave and one master of a trilat-net session.

    A policy observes both arms and drives the master, which the slave follows. LeRobot creates
    the object from a `TrilatRobotConfig`, and calls its methods in a loop.

    Args:
        config: The session and the sites.
    """

    config_class = TrilatRobotConfig
    name = "trilat"

    def __init__(self, config: TrilatRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, Any] = {}  # lerobot-record reads the number of cameras
        scenario = tn.load_scenario(config.scenario or config.session)
        mode = _find_hand_mode(scenario, config.site)
        self._command, quantity = _HAND_COMMANDS[mode]
        axes = _list_hand_axes(scenario, config.site, mode)
        self._action_keys = [f"{axis}.{quantity}" for axis in axes]
        self._position_keys = [f"{axis}.pos" for axis in axes]
        self._felt_keys = [f"{axis}.felt" for axis in axes]
        # Without repetitions, because both names may be the same.
        self._sites = tuple(dict.fromkeys((config.slave, config.site)))
        self._joint_keys: list[str] = []
        for site in self._sites:
            joint_names = scenario.arms[site].joint_names
            for joint_quantity in ("pos", "vel", "tau_x"):
                keys = [f"{site}.{joint}.{joint_quantity}" for joint in joint_names]
                self._joint_keys += keys
        # The hand exists while the robot is connected.
        self._hand: Any = None
        self._records: dict[str, Any] = {}
        self._stack = ExitStack()

    @property
    def observation_features(self) -> dict[str, type]:
        """Names and types of the values that LeRobot receives as an observation of the robot.

        An observation contains the angle in rad, the velocity in rad/s and the external torque
        in N m of each joint of both arms. It also contains the position of the master's end
        effector in m, and the force in N that the master exerts on the operator (the program
        that moves the master). In mode `joint`, the angles of the master in rad and torques in
        N m take the place of this position and force.
        """
        keys = [*self._joint_keys, *self._position_keys, *self._felt_keys]
        return dict.fromkeys(keys, float)

    @property
    def action_features(self) -> dict[str, type]:
        """Keys of an action, which is a command that moves the master arm.

        Depending on the mode in the scenario, the command is a position in m (mode `tip`),
        angles in rad (`joint`) or a force in N (`force`).
        """
        return dict.fromkeys(self._action_keys, float)

    @property
    def is_connected(self) -> bool:
        """True between `connect` and `disconnect`.

        Stays True when the session ends. LeRobot calls `disconnect` only on connected devices,
        and the process stays alive until `disconnect` has been called.
        """
        return self._hand is not None

    @property
    def is_calibrated(self) -> bool:
        """Always True. No calibration is needed, because the scenario describes the arms."""
        return True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Joins the teleoperation session, and waits for the first state of both arms.

        Args:
            calibrate: Ignored, because there is nothing to calibrate.

        Raises:
            DeviceAlreadyConnectedError: The robot is already connected.
            DeviceNotConnectedError: A site does not publish its state in time.
        """
        if self._hand is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        config = self.config
        connection = {
            "connect": config.connect or None,
            "keys": config.keys or None,
        }
        with ExitStack() as stack:
            hand_context = tn.hand(
                config.session,
                config.site,
                source="policy",
                timeout_s=config.timeout_s,
                **connection,
            )
            hand = stack.enter_context(hand_context)
            session = tn.session(config.session, **connection)
            records_context = session.records(*self._sites)
            self._receive_records = stack.enter_context(records_context)
            self._await_records(config.timeout_s)
            self._hand = hand
            self._stack = stack.pop_all()

    def _await_records(self, timeout_s: float) -> None:
        """Waits until both sites have published their state.

        Raises:
            DeviceNotConnectedError: A site has published no record for `timeout_s` seconds.
        """
        deadline_s = time.monotonic() + timeout_s
        while set(self._sites) - self._records.keys():
            if time.monotonic() > deadline_s:
                sites_text = " and ".join(self._sites)
                raise DeviceNotConnectedError(
                    f"the records of both {sites_text} did not arrive within {timeout_s:g} s"
                )
            time.sleep(0.002)
            self._receive_newest()

    def _receive_newest(self) -> None:
        """Receives all new records, and keeps the newest of each site."""
        for record in self._receive_records():
            self._records[record.site] = record

    def get_observation(self) -> dict[str, float]:
        """Returns the newest states of the slave and of the driven master, for the policy.

        The values are the angles, velocities and external torques of the joints of each arm,
        followed by the position of the master and the force that the master exerts on the
        operator.

        Returns:
            Values with the keys of `observation_features`.
        """
        hand = self._require_running_hand()
        self._receive_newest()
        values: list[float] = []
        for site in self._sites:
            record = self._records[site]
            values += [*record.q, *record.qd, *record.tau_x]
        values += hand.pose
        # The hand feels the reaction of the force that it applies to the arm.
        values += [-force for force in hand.force]
        return dict(zip(self.observation_features, values, strict=True))

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Moves the master arm as an action of the policy commands.

        The command is sent to the site of the arm. The site enforces the limits on force and
        speed.

        Args:
            action: A command, with the keys of `action_features`.

        Returns:
            The command that was sent.
        """
        goal = {key: float(action[key]) for key in self._action_keys}
        command = getattr(self._require_running_hand(), self._command)
        command(*goal.values())
        return goal

    def disconnect(self) -> None:
        """Releases the master arm, and leaves the teleoperation session.

        The session continues for its other users.
        """
        self._require_hand()
        self._hand = None
        self._stack.close()

    def _require_running_hand(self) -> Any:
        """Returns the connection of the operator, if the session is running.

        After the end of the session, the newest record would be observed over and over.

        Raises:
            DeviceNotConnectedError: The robot is not connected, or the session has ended.
        """
        hand = self._require_hand()
        if hand.over:
            raise DeviceNotConnectedError(
                f"the session {self.config.session} has ended: start it again, for longer"
            )
        return hand

    def _require_hand(self) -> Any:
        """Returns the connection through which the policy acts as an operator.

        Raises:
            DeviceNotConnectedError: The robot is not connected; call `connect` first.
        """
        if self._hand is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._hand


def _find_hand_mode(scenario: Any, site: str) -> str:
    """Returns the mode in which a program may move a site's arm, such as "tip" or "force".

    The scenario determines the mode in its entry for a live operator (hand), whose commands
    come from another program.

    Args:
        scenario: The scenario of the session.
        site: Name of the site.

    Returns:
        A key of `_HAND_COMMANDS`.

    Raises:
        ValueError: The scenario allows no live hand at the site.
    """
    for hand in scenario.sites[site].hands:
        mode: str = getattr(hand, "mode", "")
        if mode in _HAND_COMMANDS:
            return mode
    raise ValueError(f"the scenario has no operator of kind 'live' at {site}")


def _list_hand_axes(scenario: Any, site: str, mode: str) -> list[str]:
    """Returns the names of the directions or joints in which a policy moves the arm.

    The names of the robot's actions in LeRobot data sets are derived from these names.

    Args:
        scenario: The scenario of the session.
        site: Name of the site.
        mode: Mode of the operator. In mode `joint` the axes are the joints of the arm. In other
            modes they are x, y and, in space, z of the end effector.
    """
    arm = scenario.arms[site]
    if mode == "joint":
        return list(arm.joint_names)
    initial_q = scenario.sites[site].q0_rad
    end_effector = arm.end_effector(initial_q)
    axis_count = len(end_effector)
    return ["x", "y", "z"][:axis_count]


def run_policy(
    robot: Any,
    decide: Callable[[dict[str, list[float]]], list[float]],
    duration_s: float,
    fps: int,
) -> int:
    """Runs a trained policy at a fixed rate, to move the arm of a robot.

    Args:
        robot: The connected robot.
        decide: The policy, as a function. Its argument has the keys of an exported dataset,
            `observation.state` and `observation.environment_state`. The function returns one
            number for each key of `action_features`.
        duration_s: Time for which the policy runs, in s.
        fps: Number of decisions per second, as in the training dataset.

    Returns:
        The number of decisions.
    """
    start_s = time.monotonic()
    count = 0
    while count < duration_s * fps:
        observation = robot.get_observation()
        numbers = [float(observation[key]) for key in robot.observation_features]
        state = {
            "observation.state": numbers,
            "observation.environment_state": numbers,
        }
        action = dict(zip(robot.action_features, decide(state), strict=True))
        robot.send_action(action)
        count += 1
        wait_s = start_s + count / fps - time.monotonic()
        time.sleep(max(wait_s, 0.0))
    return count


def _load_policy(folder: str) -> Callable[[dict[str, list[float]]], list[float]]:
    """Loads a trained policy that `lerobot-train` has stored in a folder.

    Args:
        folder: Folder of the policy, whose path ends in `pretrained_model`.

    Returns:
        The policy as a function, which is the argument `decide` of `run_policy`.
    """
    # Imported here, because the import takes seconds and the robot does not need it.
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    policy_config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(policy_config.type).from_pretrained(folder)
    policy.eval()
    device = {"device_processor": {"device": str(policy.config.device)}}
    prepare, restore = make_pre_post_processors(
        policy.config, pretrained_path=folder, preprocessor_overrides=device
    )
    policy.reset()

    def decide(state: dict[str, list[float]]) -> list[float]:
        """Returns the action of the trained policy for an observation, as a list of numbers.

        Args:
            state: Maps each feature of the observation to its values. Features that the policy
                was not trained on are ignored.
        """
        tensors = {
            key: torch.tensor([numbers], dtype=torch.float32)
            for key, numbers in state.items()
            if key in policy.config.input_features
        }
        with torch.inference_mode():
            action = restore(policy.select_action(prepare(tensors)))
        return [float(number) for number in action[0]]

    return decide


def _main() -> None:
    """Runs a trained policy that moves an arm of a running teleoperation session.

    This is the command `python -m lerobot_robot_trilat`.
    """
    parser = argparse.ArgumentParser(prog="python -m lerobot_robot_trilat")
    parser.add_argument("folder", help="folder of the policy, which ends in pretrained_model")
    parser.add_argument("--site", default="m2", help="master that the policy drives")
    parser.add_argument("--slave", default="s", help="slave that the policy observes")
    parser.add_argument("--session", default="play", help="name of the session")
    parser.add_argument(
        "--scenario", default="", help="scenario; default: the name of the session"
    )
    parser.add_argument("--connect", action="append", default=[], help="endpoint; repeatable")
    parser.add_argument("--keys", default="", help="folder of the operator's keys")
    parser.add_argument("--duration", type=float, default=30.0, help="duration, s")
    parser.add_argument("--fps", type=int, default=30, help="decisions per second")
    options = parser.parse_args()
    decide = _load_policy(options.folder)
    config = TrilatRobotConfig(
        session=options.session,
        scenario=options.scenario,
        site=options.site,
        slave=options.slave,
        connect=options.connect,
        keys=options.keys,
    )
    robot = TrilatRobot(config)
    robot.connect()
    try:
        count = run_policy(robot, decide, options.duration, options.fps)
    finally:
        robot.disconnect()
    print(f"{options.site}: {count} decisions in {options.duration:g} s")


if __name__ == "__main__":
    _main()

"""Drives one master arm of a trilat-net session from a LeRobot policy.

LeRobot is a library for robot learning. A policy is a trained program that commands a robot. In
a session, two master arms lead one slave arm. The policy drives one master, and another user,
usually a person, drives the other one. Each action of the policy commands its master, if the
scenario allows this. Each observation has the newest records of the slave and of that master,
and the state of the hand, which is the connection through which a program holds an arm.

Invariant:
    - An action moves the arm within the limits of force and speed that the scenario sets.
    - The slave follows all of its users, weighted by their dominance factors.
    - The features of actions and observations follow from the scenario alone.
"""

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import trilat_net as tn

_HAND_COMMANDS = {"tip": ("move", "pos"), "joint": ("turn", "pos"), "force": ("push", "force")}
"""How a hand of each mode is commanded: the method of `tn.hand`, and the suffix of the keys."""


@RobotConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatRobotConfig(RobotConfig):
    """The session and the site that the policy drives. A site is a process that runs one arm.

    Attributes:
        session: Name of the session.
        scenario: Name or path of the session's scenario. Empty for the session's name.
        site: Name of the master that the policy drives.
        slave: Name of the site that the policy also observes.
        connect: Network addresses of the session. By default those on this machine.
        keys: Folder of the operator's keys. Empty for a session without keys.
        timeout_s: Longest wait for the session, in s.
    """

    session: str = "play"
    scenario: str = ""
    site: str = "m2"
    slave: str = "s"
    connect: list[str] = field(default_factory=list)
    keys: str = ""
    timeout_s: float = 5.0


class TrilatRobot(Robot):
    """A robot for LeRobot that consists of the slave and one master of a session.

    The policy observes both arms and drives the master.

    Args:
        config: The session and the site.
    """

    config_class = TrilatRobotConfig
    name = "trilat"

    def __init__(self, config: TrilatRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        scenario = tn.load_scenario(config.scenario or config.session)
        mode = _find_hand_mode(scenario, config.site)
        self._command, quantity = _HAND_COMMANDS[mode]
        axes = _list_hand_axes(scenario, config.site, mode)
        self._action_keys = [f"{axis}.{quantity}" for axis in axes]
        self._position_keys = [f"{axis}.pos" for axis in axes]
        self._felt_keys = [f"{axis}.felt" for axis in axes]
        self._sites = (config.slave, config.site)
        self._joint_keys: list[str] = []
        for site in dict.fromkeys(self._sites):
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
        """Names and types of the numbers of an observation.

        These are the joint states of the slave and of the master, and the position and force of
        the hand. A joint has angle in rad, speed in rad/s and external torque in N m. The hand
        has its position in m and the force that it feels in N. A hand in mode `joint` has
        angles in rad and torques in N m.
        """
        return dict.fromkeys([*self._joint_keys, *self._position_keys, *self._felt_keys], float)

    @property
    def action_features(self) -> dict[str, type]:
        """Names and types of the numbers of an action, which commands the hand.

        The command is a position in m (mode `tip`), angles in rad (`joint`) or a force in N
        (`force`). The scenario determines the mode.
        """
        return dict.fromkeys(self._action_keys, float)

    @property
    def is_connected(self) -> bool:
        """True while the robot takes part in the session."""
        return self._hand is not None and not self._hand.over

    @property
    def is_calibrated(self) -> bool:
        """True: the arms need no calibration."""
        return True

    def calibrate(self) -> None:
        """Does nothing: the arms need no calibration."""

    def configure(self) -> None:
        """Does nothing: the scenario has all settings."""

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Joins the session, and waits for the first record of both sites.

        Raises:
            DeviceAlreadyConnectedError: The robot is connected already.
            DeviceNotConnectedError: A site publishes no record in time.
        """
        if self._hand is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        config = self.config
        connection = {"connect": config.connect or None, "keys": config.keys or None}
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
            self._receive_records = stack.enter_context(session.records(*self._sites))
            self._await_records(config.timeout_s)
            self._hand = hand
            self._stack = stack.pop_all()

    def _await_records(self, timeout_s: float) -> None:
        """Waits until both sites have published a record.

        Raises:
            DeviceNotConnectedError: A site has not published a record within `timeout_s`
                seconds.
        """
        deadline_s = time.monotonic() + timeout_s
        while set(self._sites) - self._records.keys():
            if time.monotonic() > deadline_s:
                sites = " and ".join(self._sites)
                raise DeviceNotConnectedError(f"no records of both {sites}")
            time.sleep(0.002)
            self._receive_newest()

    def _receive_newest(self) -> None:
        """Receives the new records, and keeps the newest record of each site."""
        for record in self._receive_records():
            self._records[record.site] = record

    def get_observation(self) -> dict[str, float]:
        """Returns the joint states of slave and master, and the state of the hand."""
        hand = self._require_hand()
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
        """Commands the hand. The site enforces the limits of force and speed.

        Args:
            action: Numbers with the names of `action_features`.

        Returns:
            The numbers that were sent.
        """
        goal = {key: float(action[key]) for key in self._action_keys}
        command = getattr(self._require_hand(), self._command)
        command(*goal.values())
        return goal

    def disconnect(self) -> None:
        """Releases the arm and leaves the session, which continues."""
        self._require_hand()
        self._hand = None
        self._stack.close()

    def _require_hand(self) -> Any:
        """Returns the hand.

        Raises:
            DeviceNotConnectedError: The robot is not connected.
        """
        if self._hand is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._hand


def _find_hand_mode(scenario: Any, site: str) -> str:
    """Returns the mode in which a program may hold the arm of a site.

    Raises:
        ValueError: The scenario does not allow programs to hold this arm.
    """
    for hand in scenario.sites[site].hands:
        mode: str = getattr(hand, "mode", "")
        if mode in _HAND_COMMANDS:
            return mode
    raise ValueError(f"the scenario has no operator of kind 'live' at {site}")


def _list_hand_axes(scenario: Any, site: str, mode: str) -> list[str]:
    """Returns the names of the axes along which a hand moves the arm.

    A hand in mode `joint` turns the joints. A hand in another mode moves the end effector.
    """
    arm = scenario.arms[site]
    if mode == "joint":
        return list(arm.joint_names)
    end_effector = arm.end_effector(scenario.sites[site].q0_rad)
    return ["x", "y", "z"][: len(end_effector)]

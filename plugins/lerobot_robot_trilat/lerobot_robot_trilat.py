"""A LeRobot robot that lets a policy drive one master of a trilat-net session.

The policy shares the slave with another user, who drives another master. Each action of the
policy commands the live hand that the scenario allows at the policy's master. Each observation
holds the newest records of the slave and of that master, and the state of the hand.

Invariant:
    - An action moves the arm within the hand's limits of force and speed.
    - The slave follows all of its users by their dominance factors.
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
    """The session and the site of the policy.

    Attributes:
        session: name of the session.
        scenario: name or path of the session's scenario; "": the session's name.
        site: the master that the policy drives.
        slave: the site that the policy also observes.
        connect: endpoints of the session; by default the endpoints on this machine.
        keys: folder of the operator's keys; "" for a session without keys.
        timeout_s: longest wait for the session, in s.
    """

    session: str = "play"
    scenario: str = ""
    site: str = "m2"
    slave: str = "s"
    connect: list[str] = field(default_factory=list)
    keys: str = ""
    timeout_s: float = 5.0


class TrilatRobot(Robot):
    """The slave and one master of a session; the policy observes both and drives the master."""

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
        """Joint states of the slave and the master, and position and force of the hand.

        A joint has angle in rad, speed in rad/s and external torque in N m. The hand has its
        position in m and the force that it feels in N; a hand in mode `joint` has angles in rad
        and torques in N m.
        """
        return dict.fromkeys([*self._joint_keys, *self._position_keys, *self._felt_keys], float)

    @property
    def action_features(self) -> dict[str, type]:
        """Command of the hand, by its mode in the scenario.

        The command is a position in m (mode `tip`), angles in rad (`joint`) or a force in N
        (`force`).
        """
        return dict.fromkeys(self._action_keys, float)

    @property
    def is_connected(self) -> bool:
        return self._hand is not None and not self._hand.over

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Joins the session and waits for the first record of both sites."""
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
            DeviceNotConnectedError: a site has published none for `timeout_s` seconds.
        """
        deadline_s = time.monotonic() + timeout_s
        while set(self._sites) - self._records.keys():
            if time.monotonic() > deadline_s:
                sites = " and ".join(self._sites)
                raise DeviceNotConnectedError(f"no records of both {sites}")
            time.sleep(0.002)
            self._receive_newest()

    def _receive_newest(self) -> None:
        """Receives the new records and keeps the newest record of each site."""
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
        """Commands the hand; the site enforces the limits of force and speed."""
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
        """Returns the hand; raises DeviceNotConnectedError before `connect`."""
        if self._hand is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._hand


def _find_hand_mode(scenario: Any, site: str) -> str:
    """Returns the mode of the live hand at a site.

    Raises:
        ValueError: the scenario allows no live hand at the site.
    """
    for hand in scenario.sites[site].hands:
        mode: str = getattr(hand, "mode", "")
        if mode in _HAND_COMMANDS:
            return mode
    raise ValueError(f"the scenario has no operator of kind 'live' at {site}")


def _list_hand_axes(scenario: Any, site: str, mode: str) -> list[str]:
    """Returns the names of the axes along which a hand of this mode moves the arm.

    A hand in mode `joint` turns the joints; a hand in another mode moves the end effector.
    """
    arm = scenario.arms[site]
    if mode == "joint":
        return list(arm.joint_names)
    end_effector = arm.end_effector(scenario.sites[site].q0_rad)
    return ["x", "y", "z"][: len(end_effector)]

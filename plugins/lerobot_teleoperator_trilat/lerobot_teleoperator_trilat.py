"""Lets LeRobot read and move the master arm of a person in a trilat-net session.

LeRobot is a library for robot learning. In a session, two master arms lead one slave arm. A
person drives one master, and a policy, a trained program, drives the other one. An action of
the person is the position of the person's arm. Feedback lets LeRobot move this arm, for example
to the policy's position before the person intervenes.

Invariant:
    - The slave follows both users, weighted by their dominance factors, also while the person
      intervenes.
    - The person intervenes if the person's dominance factor is greater than the policy's.
    - Feedback moves the arm only while torque is enabled and no other user holds the arm.
    - Feedback pulls the arm with the spring and within the limits that the scenario sets.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import trilat_net as tn

_HAND_COMMANDS = {"tip": ("move", "pos"), "joint": ("turn", "pos"), "force": ("push", "force")}
"""How a hand of each mode is commanded: the method of `tn.hand`, and the suffix of the keys."""


@TeleoperatorConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatTeleoperatorConfig(TeleoperatorConfig):
    """The session, and the sites of person and policy. A site is a process with one arm.

    Attributes:
        session: Name of the session.
        scenario: Name or path of the session's scenario. Empty for the session's name.
        site: Name of the person's master.
        program: Name of the policy's master.
        slave: Name of the site that both masters lead.
        connect: Network addresses of the session. By default those on this machine.
        keys: Folder of the operator's keys. Empty for a session without keys.
        timeout_s: Longest wait for the session, in s.
    """

    session: str = "play"
    scenario: str = ""
    site: str = "m1"
    program: str = "m2"
    slave: str = "s"
    connect: list[str] = field(default_factory=list)
    keys: str = ""
    timeout_s: float = 5.0


class TrilatTeleoperator(Teleoperator):
    """A teleoperator for LeRobot that consists of the person's master in a session.

    Args:
        config: The session and the sites.
    """

    config_class = TrilatTeleoperatorConfig
    name = "trilat"

    def __init__(self, config: TrilatTeleoperatorConfig) -> None:
        super().__init__(config)
        self.config = config
        scenario = tn.load_scenario(config.scenario or config.session)
        mode = _find_hand_mode(scenario, config.site)
        self._command, quantity = _HAND_COMMANDS[mode]
        axes = _list_hand_axes(scenario, config.site, mode)
        self._position_keys = [f"{axis}.pos" for axis in axes]
        self._feedback_keys = [f"{axis}.{quantity}" for axis in axes]
        self._torque_enabled = False
        # The hand exists while the teleoperator is connected.
        self._hand: Any = None
        self._stack = ExitStack()

    @property
    def action_features(self) -> dict[str, type]:
        """Names and types of the numbers of an action: the position of the arm in m.

        A hand in mode `joint` has angles in rad. The names are those of the actions of
        `TrilatRobot`.
        """
        return dict.fromkeys(self._position_keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Names and types of the numbers of feedback, which commands the hand at the arm.

        The command is a position in m (mode `tip`), angles in rad (`joint`) or a force in N
        (`force`). The scenario determines the mode.
        """
        return dict.fromkeys(self._feedback_keys, float)

    @property
    def is_connected(self) -> bool:
        """True while the teleoperator takes part in the session."""
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
        """Joins the session without holding the arm.

        Raises:
            DeviceAlreadyConnectedError: The teleoperator is connected already.
        """
        if self._hand is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        config = self.config
        connection = {"connect": config.connect or None, "keys": config.keys or None}
        with ExitStack() as stack:
            hand_context = tn.hand(
                config.session,
                config.site,
                source="teleoperator",
                timeout_s=config.timeout_s,
                **connection,
            )
            hand = stack.enter_context(hand_context)
            session = tn.session(config.session, **connection)
            self._get_shares = stack.enter_context(session.shares(config.slave))
            self._hand = hand
            self._stack = stack.pop_all()

    def get_action(self) -> dict[str, float]:
        """Returns the position of the arm, with the keys of `action_features`."""
        position = self._require_hand().pose
        return dict(zip(self._position_keys, position, strict=True))

    def get_felt(self) -> dict[str, float]:
        """Returns the force that the arm exerts on the hand that holds it, in N.

        A hand in mode `joint` feels torques in N m.
        """
        # The hand feels the reaction of the force that it applies to the arm.
        felt_forces = [-force for force in self._require_hand().force]
        felt_keys = [key.replace(".pos", ".felt") for key in self._position_keys]
        return dict(zip(felt_keys, felt_forces, strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Pulls or pushes the arm if torque is enabled.

        Args:
            feedback: Numbers with the names of `feedback_features`. Unknown names are ignored.
                If a name is missing, nothing moves.
        """
        hand = self._require_hand()
        is_complete = all(key in feedback for key in self._feedback_keys)
        if self._torque_enabled and is_complete:
            goal = [float(feedback[key]) for key in self._feedback_keys]
            command = getattr(hand, self._command)
            command(*goal)

    def enable_torque(self) -> None:
        """Allows feedback to move the arm."""
        self._torque_enabled = True

    def disable_torque(self) -> None:
        """Releases the arm, which the person then moves alone."""
        self._torque_enabled = False
        self._require_hand().release()

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        """Returns whether the person intervenes, and whether the session is over."""
        hand = self._require_hand()
        shares = self._get_shares()
        person_leads = shares[self.config.site] > shares[self.config.program]
        return {
            TeleopEvents.IS_INTERVENTION: person_leads,
            TeleopEvents.TERMINATE_EPISODE: bool(hand.over),
            TeleopEvents.SUCCESS: False,
            TeleopEvents.RERECORD_EPISODE: False,
        }

    def disconnect(self) -> None:
        """Releases the arm and leaves the session, which continues."""
        self._require_hand()
        self._hand = None
        self._stack.close()

    def _require_hand(self) -> Any:
        """Returns the hand, which is the connection through which a program holds an arm.

        Raises:
            DeviceNotConnectedError: The teleoperator is not connected.
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

"""A LeRobot teleoperator for the master that a person moves in a trilat-net session.

In such a session, a slave arm follows two master arms, one moved by the person and the other
driven by a policy. An action is the position of the master arm that the person holds. Through
feedback, LeRobot can move this arm, for example to the position of the policy's master arm
before the person intervenes.

Invariant:
    - The slave follows both users, weighted by their dominance factors, even while the person
      intervenes.
    - The person counts as intervening if the person's dominance factor is greater than that of
      the policy.
    - Feedback moves the arm only while torque is enabled and no other user holds the arm.
    - Feedback acts through the spring and the limits of the arm's live hand, an operator that
      the scenario must allow.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.teleoperators.utils import TeleopEvents
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


@TeleoperatorConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatTeleoperatorConfig(TeleoperatorConfig):
    """Settings of a `TrilatTeleoperator`: the session, and the sites of the person and policy.

    The person and the policy each hold a master arm, and the slave arm follows both.

    Attributes:
        session: Name of the session.
        scenario: Name or path of the scenario of the session. Empty if it has the same name as
            the session.
        site: Name of the person's master.
        program: Name of the policy's master.
        slave: Name of the slave, which follows both masters.
        connect: Network endpoints of the session. Empty for the default endpoints on this
            machine.
        keys: Folder of the operator's keys. Empty for a session without keys.
        timeout_s: Maximum time to wait for the session, in s.
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
    """LeRobot teleoperator for the master arm that a person moves in a trilat-net session.

    LeRobot creates the object from a `TrilatTeleoperatorConfig`, and calls its methods in a
    loop.

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
        """Keys of an action: the position of the arm in m, or angles in rad in mode `joint`.

        The robot `TrilatRobot` uses the same keys for positions.
        """
        return dict.fromkeys(self._position_keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Keys of the feedback, which is a command that moves the arm held by the person.

        Depending on the mode in the scenario, the command is a position in m (mode `tip`),
        angles in rad (`joint`) or a force in N (`force`).
        """
        return dict.fromkeys(self._feedback_keys, float)

    @property
    def is_connected(self) -> bool:
        """True between `connect` and `disconnect`.

        Stays True when the session ends. LeRobot calls `disconnect` only on connected devices,
        and the process stays alive until `disconnect` has been called.
        """
        return self._hand is not None

    @property
    def is_calibrated(self) -> bool:
        """Always True. No calibration is needed, because the scenario describes the arm."""
        return True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def connect(self, calibrate: bool = True) -> None:  # noqa: ARG002 - there is nothing to calibrate
        """Joins the session, so that the position of the arm that the person holds can be read.

        `send_feedback` does not move the arm until `enable_torque` is called.

        Args:
            calibrate: Ignored, because there is nothing to calibrate.

        Raises:
            DeviceAlreadyConnectedError: The teleoperator is already connected.
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
                source="teleoperator",
                timeout_s=config.timeout_s,
                **connection,
            )
            hand = stack.enter_context(hand_context)
            session = tn.session(config.session, **connection)
            shares_context = session.shares(config.slave)
            self._get_shares = stack.enter_context(shares_context)
            self._hand = hand
            self._stack = stack.pop_all()

    def get_action(self) -> dict[str, float]:
        """Returns the current position of the arm that the person holds, as an action.

        Returns:
            The newest position, with the keys of `action_features`.
        """
        position = self._require_hand().pose
        return dict(zip(self._position_keys, position, strict=True))

    def get_felt(self) -> dict[str, float]:
        """Returns the force that the arm exerts on the person or program that holds it.

        Returns:
            The force along each axis in N, or the torque of each joint in N m in mode `joint`.
            The keys end in `.felt`, as in the observations of `TrilatRobot`.
        """
        # The hand feels the reaction of the force that it applies to the arm.
        felt_forces = [-force for force in self._require_hand().force]
        felt_keys = [key.replace(".pos", ".felt") for key in self._position_keys]
        return dict(zip(felt_keys, felt_forces, strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Moves the arm that the person holds, as the policy commands, if torque is enabled.

        The person feels this as a pull or a push.

        Args:
            feedback: A command, with the keys of `feedback_features`. Other keys are ignored.
                If a key is missing, the arm is not moved.
        """
        hand = self._require_hand()
        is_complete = all(key in feedback for key in self._feedback_keys)
        if self._torque_enabled and is_complete:
            goal = [float(feedback[key]) for key in self._feedback_keys]
            command = getattr(hand, self._command)
            command(*goal)

    def enable_torque(self) -> None:
        """Allows `send_feedback` to move the arm, until `disable_torque` is called.

        This lets the arm follow a policy before the person intervenes.
        """
        self._torque_enabled = True

    def disable_torque(self) -> None:
        """Releases the arm: the person can move it freely, and `send_feedback` has no effect.

        Call `enable_torque` to allow feedback again.
        """
        self._torque_enabled = False
        self._require_hand().release()

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        """Returns whether the person is intervening, and whether the session is over.

        The events for success and for re-recording an episode are never set.
        """
        hand = self._require_hand()
        shares = self._get_shares()
        person_share = shares[self.config.site]
        policy_share = shares[self.config.program]
        person_leads = person_share > policy_share
        return {
            TeleopEvents.IS_INTERVENTION: person_leads,
            TeleopEvents.TERMINATE_EPISODE: bool(hand.over),
            TeleopEvents.SUCCESS: False,
            TeleopEvents.RERECORD_EPISODE: False,
        }

    def disconnect(self) -> None:
        """Releases the arm, and leaves the teleoperation session.

        The session continues for its other users.
        """
        self._require_hand()
        self._hand = None
        self._stack.close()

    def _require_hand(self) -> Any:
        """Returns the connection through which feedback moves the arm that the person holds.

        Raises:
            DeviceNotConnectedError: The teleoperator is not connected; call `connect` first.
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
    """Returns the names of the directions or joints in which a person moves the arm.

    The names of the actions in LeRobot data sets are derived from these names.

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

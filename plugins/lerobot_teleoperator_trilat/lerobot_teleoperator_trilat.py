"""A master of a session of trilat-net as a teleoperator of LeRobot: the person's arm, beside a
policy's.

Invariant: nothing is replaced when a person intervenes: the slave follows both users by their
dominance factors, and an intervention is that the person's factor is above the program's.
Feedback pulls the arm with the spring and the limits of its live hand, while torque is enabled
and nobody else holds it.
"""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import trilat_net as tn

_ACTS = {"tip": ("move", "pos"), "joint": ("turn", "pos"), "force": ("push", "force")}
"""By the mode of a live hand what it does, and what its numbers are."""


@TeleoperatorConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatTeleoperatorConfig(TeleoperatorConfig):
    """Whose arm it is.

    Attributes:
        session: name of the session.
        scenario: name or path of its scenario; "": as the session.
        site: the person's master.
        program: the policy's master.
        slave: the site that both lead.
        connect: endpoints of the session; by default those on this machine.
        keys: folder of the operator's keys; "": none.
        timeout_s: longest wait for the session.
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
    """The person's master in a session."""

    config_class = TrilatTeleoperatorConfig
    name = "trilat"

    def __init__(self, config: TrilatTeleoperatorConfig) -> None:
        super().__init__(config)
        self.config = config
        scenario = tn.load_scenario(config.scenario or config.session)
        live = [
            hand
            for hand in scenario.sites[config.site].hands
            if getattr(hand, "mode", "") in _ACTS
        ]
        if not live:
            raise ValueError(f"the scenario has no operator of kind 'live' at {config.site}")
        self._act, what = _ACTS[live[0].mode]
        arm = scenario.arms[config.site]
        axes = ["x", "y", "z"][: len(arm.end_effector(scenario.sites[config.site].q0_rad))]
        axes = list(arm.joint_names) if live[0].mode == "joint" else axes
        self._places = [f"{axis}.pos" for axis in axes]
        self._feedback = [f"{axis}.{what}" for axis in axes]
        self._pulls = False
        self._hand: Any = None
        self._stack = ExitStack()

    @property
    def action_features(self) -> dict[str, type]:
        """Where the arm is, m (of a hand at the joints: angles, rad): the keys of the policy's
        robot.
        """
        return dict.fromkeys(self._places, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Where the arm is pulled, or what pushes it, N, by the mode of its hand in the
        scenario.
        """
        return dict.fromkeys(self._feedback, float)

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
        """Joins the session; nobody holds the arm by that."""
        if self._hand is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        own = self.config
        reach = {"connect": self.config.connect or None, "keys": self.config.keys or None}
        with ExitStack() as stack:
            hand = tn.hand(
                own.session, own.site, source="teleoperator", timeout_s=own.timeout_s, **reach
            )
            entered = stack.enter_context(hand)
            self._find_shares = stack.enter_context(
                tn.session(own.session, **reach).shares(own.slave)
            )
            self._hand = entered
            self._stack = stack.pop_all()

    def get_action(self) -> dict[str, float]:
        """Returns where the arm is."""
        return dict(zip(self._places, self._held().pose, strict=True))

    def get_felt(self) -> dict[str, float]:
        """Returns the force of the arm on whoever holds it, N (of a hand at the joints:
        torques, N m).
        """
        felt = (-one for one in self._held().force)
        return {
            key.replace(".pos", ".felt"): one
            for key, one in zip(self._places, felt, strict=True)
        }

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Pulls or pushes the arm, if torque is enabled; other keys mean nothing."""
        hand = self._held()
        if self._pulls and all(key in feedback for key in self._feedback):
            getattr(hand, self._act)(*(float(feedback[key]) for key in self._feedback))

    def enable_torque(self) -> None:
        """Lets feedback act on the arm."""
        self._pulls = True

    def disable_torque(self) -> None:
        """Lets go of the arm: it is the person's alone."""
        self._pulls = False
        self._held().release()

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        """Says whether the person leads the slave, and whether the session is over."""
        hand = self._held()
        shares = self._find_shares()
        return {
            TeleopEvents.IS_INTERVENTION: shares[self.config.site]
            > shares[self.config.program],
            TeleopEvents.TERMINATE_EPISODE: bool(hand.over),
            TeleopEvents.SUCCESS: False,
            TeleopEvents.RERECORD_EPISODE: False,
        }

    def disconnect(self) -> None:
        """Lets go of the arm and leaves the session, which goes on."""
        self._held()
        self._hand = None
        self._stack.close()

    def _held(self) -> Any:
        if self._hand is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._hand

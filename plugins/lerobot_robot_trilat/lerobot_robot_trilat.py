"""A master of a session of trilat-net as a robot of LeRobot: a policy is one of two users of
the slave.

Invariant: an action moves the hand that the scenario allows at the master, within its force and
speed limits; the slave follows all of its users by their dominance factors. The features follow
from the scenario alone.
"""

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

import trilat_net as tn

_ACTS = {"tip": ("move", "pos"), "joint": ("turn", "pos"), "force": ("push", "force")}
"""By the mode of a live hand what it does, and what its numbers are."""


@RobotConfig.register_subclass("trilat")
@dataclass(kw_only=True)
class TrilatRobotConfig(RobotConfig):
    """Where the policy takes part.

    Attributes:
        session: name of the session.
        scenario: name or path of its scenario; "": as the session.
        site: the master that the policy holds.
        slave: the site that it observes besides.
        connect: endpoints of the session; by default those on this machine.
        keys: folder of the operator's keys; "": none.
        timeout_s: longest wait for the session.
    """

    session: str = "play"
    scenario: str = ""
    site: str = "m2"
    slave: str = "s"
    connect: list[str] = field(default_factory=list)
    keys: str = ""
    timeout_s: float = 5.0


class TrilatRobot(Robot):
    """The slave and one master of a session, of which the policy holds the master."""

    config_class = TrilatRobotConfig
    name = "trilat"

    def __init__(self, config: TrilatRobotConfig) -> None:
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
        arms = scenario.arms
        q0 = scenario.sites[config.site].q0_rad
        axes = ["x", "y", "z"][: len(arms[config.site].end_effector(q0))]
        axes = list(arms[config.site].joint_names) if live[0].mode == "joint" else axes
        self._actions = [f"{axis}.{what}" for axis in axes]
        self._places = [f"{axis}.pos" for axis in axes]
        self._felt = [f"{axis}.felt" for axis in axes]
        self._sites = (config.slave, config.site)
        whats = ("pos", "vel", "tau_x")
        names = {site: arms[site].joint_names for site in self._sites}
        self._joints = [
            f"{site}.{one}.{what}" for site in names for what in whats for one in names[site]
        ]
        self._hand: Any = None
        self._records: dict[str, Any] = {}
        self._stack = ExitStack()

    @property
    def observation_features(self) -> dict[str, type]:
        """Per joint of the slave and of the own arm its angle, rad, speed, rad/s, external
        torque, N m.

        Of the own hand its place, m (or angles, rad), and what it feels, N (or N m).
        """
        return dict.fromkeys([*self._joints, *self._places, *self._felt], float)

    @property
    def action_features(self) -> dict[str, type]:
        """Where the hand goes, m (angles, rad), or what it pushes with, N, by its mode in the
        scenario.
        """
        return dict.fromkeys(self._actions, float)

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
        """Joins the session, and waits for the first record of both sites."""
        if self._hand is not None:
            raise DeviceAlreadyConnectedError(f"{self} is already connected.")
        own = self.config
        reach = {"connect": self.config.connect or None, "keys": self.config.keys or None}
        with ExitStack() as stack:
            hand = tn.hand(
                own.session, own.site, source="policy", timeout_s=own.timeout_s, **reach
            )
            entered = stack.enter_context(hand)
            self._take = stack.enter_context(
                tn.session(own.session, **reach).records(*self._sites)
            )
            give_up_s = time.monotonic() + own.timeout_s
            while set(self._sites) - self._records.keys():
                if time.monotonic() > give_up_s:
                    raise DeviceNotConnectedError(
                        f"no records of both {' and '.join(self._sites)}"
                    )
                time.sleep(0.002)
                self._update()
            self._hand = entered
            self._stack = stack.pop_all()

    def _update(self) -> None:
        self._records.update({record.site: record for record in self._take()})

    def get_observation(self) -> dict[str, float]:
        """Returns the newest record of the slave and of the own arm."""
        hand = self._held()
        self._update()
        records = [self._records[site] for site in self._sites]
        found = [
            value
            for one in records
            for vector in (one.q, one.qd, one.tau_x)
            for value in vector
        ]
        felt = [-one for one in hand.force]
        return dict(zip(self.observation_features, [*found, *hand.pose, *felt], strict=True))

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Moves the hand; the site keeps its limits of force and speed."""
        goal = {key: float(action[key]) for key in self._actions}
        getattr(self._held(), self._act)(*goal.values())
        return goal

    def disconnect(self) -> None:
        """Lets go of the arm and leaves the session, which goes on."""
        self._held()
        self._hand = None
        self._stack.close()

    def _held(self) -> Any:
        if self._hand is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._hand

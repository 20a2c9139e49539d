"""Types that describe one site of a scenario: its arm, law, limits and operators.

Invariant:
    - The name of a key ends in its unit. Symbols are those of the paper on which the project is
      based.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core import Array, MotionLimits, StaleRule, TorqueSource
from ..fields import Frozen, Joints, KeyProblem, Positive, PositiveJoints, RateHz, Real
from ..files import find_page
from ..own_code import ImportedLaw
from ..records import MAX_JOINTS
from .arms import Arm, ArmModel, Task
from .delay_models import Link
from .laws import ChosenLaw
from .operators import Environment, Operator
from .operators.kernel_operators import LiveHand
from .operators.program_hand import ProgramHand
from .own_plant import OwnPlant
from .value_text import describe_value

_OUTSIDE_LIMITS = ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad")
"""Optional limits that become mandatory for a real robot."""
_ASSUMED_LIMITS = {
    "tau_limit_nm": ("efforts", "effort", "tau_limit_nm = 60.0"),
    "qd_limit_rad_s": ("speeds", "velocity", "qd_limit_rad_s = 6.0"),
}
"""Limits that every scenario has, since a simulated arm has defaults for them.

The entry for each key contains the attribute of the arm with the limits of its URDF file, the
attribute of the `<limit>` element in that file, and an example.
"""


class OnStale(Frozen, frozen=True, omit_defaults=True):
    """Stale rule: how a site reacts if the samples of a peer are too old or missing.

    Attributes:
        action: "use" to continue with the old sample, "hold" to keep the last reference,
            "brake" to hold the current position of the arm, or "glide". With "glide", the site
            waits for all peers at the start. If no new sample of a peer is used for
            `silence_ms`, the reference decelerates to rest; later, the site realigns with its
            peers without a jump.
        age_ms: Age beyond which a sample is too old, in ms. Not used by "glide".
        return_s: Duration of the return to the reference once a fresh sample is used, in s. Not
            used by "glide".
        silence_ms: For "glide": time without a new sample after which a peer counts as silent,
            in ms.
        align_speed_rad_s: For "glide": speed at which the site moves towards its peers, in
            rad/s (m/s if the sites share positions).
        align_limit_rad: For "glide": longest distance that the site moves on its own, in rad (m
            if the sites share positions).
        on_lost: For "glide": reaction to a silent peer: "hold" to wait for the peer, or
            "degrade" to continue without a silent master as long as the remaining sites can all
            reach each other.
    """

    action: Literal["use", "hold", "brake", "glide"] = "use"
    age_ms: Annotated[float, Meta(gt=0.0, le=1e6)] = 350.0
    return_s: Annotated[float, Meta(gt=0.0, le=1e3)] = 1.0
    silence_ms: Annotated[float, Meta(gt=0.0, le=1e4)] = 20.0
    align_speed_rad_s: Annotated[float, Meta(gt=0.0, le=1e3)] = 0.5
    align_limit_rad: Annotated[float, Meta(gt=0.0, le=1e3)] = 1.0
    on_lost: Literal["hold", "degrade"] = "hold"

    @property
    def rule(self) -> StaleRule:
        """The reaction to old or missing samples, in the form read by the control loop.

        Times are converted from ms to integers in ns, since the compiled code computes with
        integers.
        """
        if self.action == "glide":
            return StaleRule.glide(
                age_ns=round(self.silence_ms * 1e6),
                align_speed=self.align_speed_rad_s,
                align_limit=self.align_limit_rad,
                degrades=self.on_lost == "degrade",
            )
        return StaleRule.by_age(
            self.action,
            age_ns=round(self.age_ms * 1e6),
            return_ns=round(self.return_s * 1e9),
        )


SpeedLimit = Annotated[float, Meta(gt=0.0, le=10_000.0)]
JointSpeedLimits = Annotated[
    tuple[SpeedLimit, ...],
    Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "joints"}),
]
SharedSpeedLimits = Annotated[
    tuple[SpeedLimit, ...],
    Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "shared"}),
]


GLIDE_TAU_RATE_NM_S = 1000.0
"""Default limit on the torque's rate of change under the stale rule "glide", in N m/s.

This is the limit of Franka arms, 1 N m per millisecond.
"""


def _or_infinity(limit: Any) -> Any:
    """Returns a limit, or infinity if there is none."""
    return math.inf if limit is None else limit


class Limits(Frozen, frozen=True):
    """Limits of one arm, such as its largest torque, given per joint or for all joints.

    The control torque, its rate of change and the speed of the reference are kept within their
    limits. A joint that exceeds its speed limit ends the run or, under the stale rule "glide",
    only brings this arm to rest.

    Attributes:
        tau_limit_nm: Largest control torque of a joint, in N m. The torque is clipped to this
            value. By default, the effort limits in the URDF file of a chain.
        qd_limit_rad_s: Joint speed beyond which a run is considered diverged and ends, in
            rad/s. Under the stale rule "glide", the site stops with a fault and the run
            continues. By default, the velocity limits in the URDF file of a chain.
        tau_rate_limit_nm_s: Largest rate of change of a joint's control torque, in N m/s.
            Unlimited by default, except under the stale rule "glide", where the default is
            `GLIDE_TAU_RATE_NM_S`.
        qd_des_limit_rad_s: Largest speed of the reference, in rad/s (m/s if the sites share
            positions).
        q_min_rad: Smallest angle of a joint, in rad. The site stops with a fault below it.
            Allowed only under the stale rule "glide".
        q_max_rad: Largest angle of a joint, in rad, analogous to `q_min_rad`.
    """

    tau_limit_nm: Positive | PositiveJoints = 200.0
    qd_limit_rad_s: SpeedLimit | JointSpeedLimits = 100.0
    tau_rate_limit_nm_s: Positive | PositiveJoints | None = None
    qd_des_limit_rad_s: SpeedLimit | SharedSpeedLimits | None = None
    q_min_rad: Real | Joints | None = None
    q_max_rad: Real | Joints | None = None

    @property
    def motion(self) -> MotionLimits:
        """Limits on angles, reference speed and torque rate, as read by the control loop.

        Limits that the author left out are infinite, so the loop needs no special case.
        """
        return MotionLimits(
            q_min=-math.inf if self.q_min_rad is None else self.q_min_rad,
            q_max=_or_infinity(self.q_max_rad),
            qd_des_limit=_or_infinity(self.qd_des_limit_rad_s),
            tau_rate=_or_infinity(self.tau_rate_limit_nm_s),
        )

    def find_unlimited_rows(self, qd_des: Array) -> NDArray[np.bool_]:
        """Marks the records in which the speed limit does not restrict the reference.

        Args:
            qd_des: Velocity of the reference in rad/s, shape (K, n) for K records or (n,) for a
                single record.

        Returns:
            True for each record in which every coordinate is slower than its limit, shape (K,)
            or ().
        """
        is_slower = np.abs(qd_des) < self.motion.qd_des_limit
        return np.asarray(is_slower.all(axis=-1))


class SiteSpec(Frozen, frozen=True):
    """Description of a site in a scenario: an arm and its control loop.

    Attributes:
        role: Role of the site, shown in figures and used if `on_lost` is "degrade" (see
            `OnStale`). Does not enter any formula.
        rate_hz: Tick rate of the control loop, in Hz.
        q0_rad: Start pose, in rad.
        qd0_rad_s: Start velocity, in rad/s.
        arm: Arm of the site.
        control: Control law and its gains.
        limits: Limits on torques, speeds and positions.
        on_stale: Reaction if the samples of a peer are too old or missing.
        task: Coordinates that the site shares with its peers: its joint angles, or the pose of
            its end effector.
        hands: Operators: people or programs that move the arm.
        environment: Walls and other bodies that act on the arm.
        plant: "simulated" for the built-in simulation, "external" for a real robot whose state
            is measured, or a user's class that computes the motion.
        view: Delay, loss and order of the picture in which the user of the site sees the other
            arms. Has the keys of a link. None if the user sees the samples that the controller
            uses. Does not enter any formula.
    """

    role: Literal["master", "slave"]
    rate_hz: RateHz
    q0_rad: Joints
    qd0_rad_s: Joints
    arm: Arm
    control: ChosenLaw
    limits: Limits
    on_stale: OnStale = OnStale()
    task: Task = Task()
    hands: tuple[Operator, ...] = ()
    environment: tuple[Environment, ...] = ()
    plant: Literal["simulated", "external"] | OwnPlant = "simulated"
    view: Link | None = None

    @property
    def law_name(self) -> str:
        """Name by which a scenario file selects the control law of the site.

        For a user's law, this is the module and class, for example "package.module:Law".
        """
        return str(self.control.tag) if self.user_law is None else self.user_law.code

    @property
    def user_law(self) -> ImportedLaw | None:
        """Control law of the site if it is a user's Python class; None if it is built in."""
        return self.control if isinstance(self.control, ImportedLaw) else None

    def describe_gains(self, *, with_defaults: bool = False) -> dict[str, str]:
        """Returns the gains of the control law as short strings for users, such as "10" for K.

        The gains of a user's law are the arguments of its class.

        Args:
            with_defaults: If True, arguments of a user's law that the scenario omits are
                included, with their default values.
        """
        gains = msgspec.structs.asdict(self.control)
        if self.user_law is not None:
            gains = self.user_law.settings
            if with_defaults:
                gains = self.user_law.read_default_settings() | gains
        return {key: describe_value(value) for key, value in gains.items()}

    @property
    def actors(self) -> tuple[TorqueSource, ...]:
        """Operators and environments of the arm, in the form read by the control loop."""
        return tuple(source.actor for source in (*self.hands, *self.environment))

    @property
    def has_program_hand(self) -> bool:
        """True if a user's program operates the arm (a hand of kind "own").

        Such a program may react to the motion of the arm. Unlike the reaction of an operator
        described in the scenario, this reaction is not part of the linearised loop.
        """
        return any(isinstance(hand, ProgramHand) for hand in self.hands)

    @property
    def needs_hand_process(self) -> bool:
        """True if, in a live session, a user's program operates the arm from its own process.

        A slow program then does not delay the control loop of the site.
        """
        return any(isinstance(hand, ProgramHand) and hand.process for hand in self.hands)

    def find_live_hand(self, *, is_open: bool = False) -> LiveHand | None:
        """Returns the live operator: the person or program that may move the arm in a session.

        Args:
            is_open: If True, only consider an operator whose role any member of the session may
                take.

        Returns:
            The operator, or None if the site has no such operator.
        """
        for hand in self.hands:
            if isinstance(hand, LiveHand) and (hand.is_open or not is_open):
                return hand
        return None

    def with_live_hand_only(self, mode: str = "") -> "SiteSpec":
        """Returns a copy of the site whose only operator is an open live operator.

        An open operator is one whose role any member of the session may take. The settings are
        those of the site's open live operator if there is one, and the defaults otherwise.

        Args:
            mode: Mode of the operator, one of `HAND_MODES`. If empty, the mode is kept.
        """
        hand = self.find_live_hand(is_open=True) or LiveHand()
        if mode:
            hand = msgspec.structs.replace(hand, mode=mode)
        return msgspec.structs.replace(self, hands=(hand,))

    def list_stop_notes(self, name: str, arm: ArmModel, urdf: Mapping[str, str]) -> list[str]:
        """Returns sentences about joints that start beyond a stop of the URDF file.

        A real arm at rest can stand slightly beyond the nominal position of a stop.

        Args:
            name: Name of the site.
            arm: Model of the arm.
            urdf: Mapping from file name to content of the URDF files of the scenario.
        """
        units = arm.joint_units("rad")
        joints = self.arm.read_chain(urdf).joints
        notes = []
        for joint, start, unit in zip(joints, self.q0_rad, units, strict=True):
            excess = max(joint.lower - start, start - joint.upper)
            if excess > 0.0:
                notes.append(
                    f"{name} starts {excess:.3g} {unit} beyond a stop of joint {joint.name}: "
                    "the stop lies where the arm starts"
                )
        return notes

    def list_limit_notes(self, name: str, arm: ArmModel, in_force: MotionLimits) -> list[str]:
        """Returns sentences about joints that start beyond a position limit.

        The limit is moved for the run, so that the arm does not stop immediately.

        Args:
            name: Name of the site.
            arm: Model of the arm.
            in_force: Limits of the run.
        """
        units = arm.joint_units("rad")
        stated = self.limits.motion
        limits = (
            ("q_min_rad", stated.q_min, in_force.q_min),
            ("q_max_rad", stated.q_max, in_force.q_max),
        )
        joints = len(self.q0_rad)
        notes = []
        for key, stated_limit, limit_in_force in limits:
            before = np.broadcast_to(stated_limit, joints)
            after = np.broadcast_to(limit_in_force, joints)
            notes += [
                f"{name} starts beyond {key} of joint {arm.joint_names[n]}: the limit lies at "
                f"{float(after[n]):.4g} {units[n]} in this run"
                for n in np.flatnonzero(before != after).tolist()
            ]
        return notes

    def find_outside_problem(self, arm: ArmModel) -> KeyProblem | None:
        """Finds a missing limit of a real robot, or a reason why its reference could jump.

        Args:
            arm: Model of the robot.

        Returns:
            The first problem found and the key that it concerns, or None.
        """
        for key in _OUTSIDE_LIMITS:
            if getattr(self.limits, key) is None:
                return KeyProblem(
                    f"limits.{key}",
                    "is missing: an external arm needs limits on its position (q_min_rad, "
                    "q_max_rad), its reference speed (qd_des_limit_rad_s) and its torque rate "
                    "(tau_rate_limit_nm_s), in addition to tau_limit_nm and qd_limit_rad_s",
                )
        for key in _ASSUMED_LIMITS:
            problem = self._find_assumed_limit(arm, key)
            if problem is not None:
                return problem
        if self.on_stale.action != "glide":
            return self.describe_jump()
        return None

    def _find_assumed_limit(self, arm: ArmModel, key: str) -> KeyProblem | None:
        """Returns the problem that a limit of a real robot comes from a default, if it does.

        A complete scenario does not distinguish defaults from values written by its author, so
        a limit is treated as assumed if it equals the default. For the planar arm, the default
        is a single number. For a chain, it appears at those joints for which the URDF file has
        no limit.

        Args:
            arm: Model of the robot.
            key: Key of the limit.
        """
        attribute, file_attribute, example = _ASSUMED_LIMITS[key]
        default = getattr(Limits(), key)
        limit = getattr(self.limits, key)
        assumed: Any = default
        if arm.chain is not None:
            stated = getattr(arm, attribute)
            assumed = [number if 0.0 < number < math.inf else default for number in stated]
            if assumed == list(stated):
                return None
        if not np.array_equal(limit, assumed):
            return None
        alternative = f", or as <limit {file_attribute}=...> in its URDF file"
        return KeyProblem(
            f"limits.{key}",
            f"is missing: {default:g} is the default of simulated arms, but an external arm "
            f"needs a limit of its own: write one, as in {example}"
            f"{alternative if arm.chain is not None else ''}",
        )

    def describe_jump(self) -> KeyProblem:
        """Returns why the reference of a real robot may jump when a peer falls silent.

        A jump would move the robot suddenly, so `on_stale.action` must be "glide". Call this
        method only if it is not.

        Returns:
            The key `on_stale.action`, and the problem.
        """
        return KeyProblem(
            "on_stale.action",
            f"is {self.on_stale.action!r}, but an external arm needs 'glide', so that its site "
            f"waits, holds and stops without a jump ({find_page('silent-peers.md')})",
        )


SITE_GROUPS: dict[str, type[Frozen]] = {
    "arm": Arm,
    "limits": Limits,
    "on_stale": OnStale,
    "task": Task,
}
"""Groups of keys that may be set for all sites and overridden for individual ones, by table."""

"""Types that describe one site of a scenario: its arm, law, limits and operators.

Invariant:
    - The name of a key ends in its unit. Symbols are those of the paper on which the project is
      based.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core import SCRIPTED_KINDS, Array, MotionLimits, StaleRule, TorqueKind
from ..fields import Frozen, Joints, Positive, PositiveJoints, RateHz, Real
from ..laws import ArmLoad
from ..own_code import ImportedLaw
from ..records import MAX_JOINTS
from .arms import Arm, Task
from .delay_models import Link
from .laws import ChosenLaw
from .operators import Environment, Operator
from .operators.kernel_operators import LiveHand
from .operators.program_hand import ProgramHand
from .own_plant import OwnPlant


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
        """The stale rule in the form read by the control loop.

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

    Exceeding a limit ends the run or, under the stale rule "glide", only brings this arm to
    rest.

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
        role: Role of the site, shown in figures and used by the stale rule "degrade". Does not
            enter any formula.
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

    @property
    def has_program_hand(self) -> bool:
        """True if a user's program operates the arm (a hand of kind "own").

        Such a program may react to the motion of the arm. Unlike the reaction of an operator
        described in the scenario, this reaction is not part of the linearised loop.
        """
        return any(isinstance(hand, ProgramHand) for hand in self.hands)

    def find_hand_impedances(self) -> tuple[ArmLoad, ...] | None:
        """Returns the impedances of all operators and environments that react to motion.

        Excludes operators whose torque depends on time alone.

        Returns:
            The spring and the damper of each. None if the reaction depends on the pose (because
            an operator acts on the end effector), or is unknown (for a live operator or a
            program).
        """
        impedances = []
        for actor in (*self.hands, *self.environment):
            source = actor.actor
            if source.kind in SCRIPTED_KINDS:
                continue
            # A sampled torque lags behind the motion, so it is not that of a spring and damper.
            if source.kind not in (TorqueKind.HAND, TorqueKind.VISCOUS) or source.sampled:
                return None
            joints = len(self.q0_rad)
            stiffness = source.K or (0.0,)
            impedance = ArmLoad(
                stiffness_nm_rad=tuple(np.broadcast_to(stiffness, joints).tolist()),
                damping_nm_s_rad=tuple(np.broadcast_to(source.B, joints).tolist()),
            )
            impedances.append(impedance)
        return tuple(impedances)

    def find_live_hand(self, *, is_open: bool = False) -> LiveHand | None:
        """Returns the operator who may move the arm while the session runs.

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


SITE_GROUPS: dict[str, type[Frozen]] = {
    "arm": Arm,
    "limits": Limits,
    "on_stale": OnStale,
    "task": Task,
}
"""Groups of keys that may be set for all sites and overridden for individual ones, by table."""

"""Defines the types that describe one site of a scenario: its arm, law, limits and operators.

A scenario describes an experiment. A site is the process that runs one of its arms.

Invariant:
    - The name of a key ends in its unit. Symbols are those of the paper on which the project is
      based.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from ..core import SCRIPTED_KINDS, Array, MotionLimits, StaleAction, StaleRule, TorqueKind
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
    """What an arm does if the messages of another arm are too old or missing.

    Every arm's process (site) sends its state, a sample, in each period of its control loop.

    Attributes:
        action: What the site does. "use": The site continues with the old sample. "hold": The
            site keeps its last reference. "brake": The site holds the present position of its
            arm. "glide": At the start, the site waits for all peers. If no sample of a peer has
            come into use for `silence_ms`, its reference decelerates to rest. Later it aligns
            with its peers without a jump.
        age_ms: Age of a sample beyond which it is too old, in ms. Not used by "glide".
        return_s: Duration of the return to the reference after a fresh sample has come into
            use, in s. Not used by "glide".
        silence_ms: For "glide": time without a new sample in use after which a peer counts as
            silent, in ms.
        align_speed_rad_s: For "glide": speed with which the site moves to its peers, in rad/s,
            or in m/s if the sites share a position.
        align_limit_rad: For "glide": longest path that the site moves by itself, in rad, or in
            m if the sites share a position.
        on_lost: For "glide": reaction to a silent peer. "hold": The site waits for the peer.
            "degrade": The site continues without a silent master, as long as the remaining
            sites all reach each other.
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
        """What to do if messages of another arm are missing, as the control loop reads it.

        Times are converted from ms to whole ns, because the compiled code computes with
        integers.
        """
        if self.action == "glide":
            return StaleRule(
                action=StaleAction.GLIDE,
                age_ns=round(self.silence_ms * 1e6),
                align_speed=self.align_speed_rad_s,
                align_limit=self.align_limit_rad,
                degrades=self.on_lost == "degrade",
            )
        return StaleRule(
            action=StaleAction[self.action.upper()],
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
"""Default limit of the torque's rate of change under the stale rule "glide", in N m/s.

It is the limit of Franka's arms, 1 N m per millisecond.
"""


def _or_infinity(limit: Any) -> Any:
    """Returns a limit, or infinity if there is none."""
    return math.inf if limit is None else limit


class Limits(Frozen, frozen=True):
    """Limits of one arm, such as its largest torque, for all joints together or for each.

    If a limit is exceeded, the run ends. Under the rule "glide" for silent arms, only this arm
    is brought to rest instead.

    Attributes:
        tau_limit_nm: Largest control torque of a joint, in N m. A larger torque is cut off. By
            default, the efforts in the URDF file of a chain.
        qd_limit_rad_s: Joint speed beyond which a run counts as diverged and ends, in rad/s.
            Under the stale rule "glide", only the site stops with a fault, and the run
            continues. By default, the speeds in the URDF file of a chain.
        tau_rate_limit_nm_s: Largest rate of change of a joint's control torque, in N m/s. By
            default, there is no limit, except under the stale rule "glide", where it is
            `GLIDE_TAU_RATE_NM_S`.
        qd_des_limit_rad_s: Largest speed of the reference, in rad/s, or in m/s if the sites
            share a position.
        q_min_rad: Smallest angle of a joint, in rad. Beyond it, the site stops with a fault.
            Allowed only under the stale rule "glide".
        q_max_rad: Largest angle of a joint, in rad. Like `q_min_rad`.
    """

    tau_limit_nm: Positive | PositiveJoints = 200.0
    qd_limit_rad_s: SpeedLimit | JointSpeedLimits = 100.0
    tau_rate_limit_nm_s: Positive | PositiveJoints | None = None
    qd_des_limit_rad_s: SpeedLimit | SharedSpeedLimits | None = None
    q_min_rad: Real | Joints | None = None
    q_max_rad: Real | Joints | None = None

    @property
    def motion(self) -> MotionLimits:
        """Limits of angles, reference speed and torque rate, as the control loop reads them.

        A limit that the author left out is infinite, so the loop needs no special case.
        """
        return MotionLimits(
            q_min=-math.inf if self.q_min_rad is None else self.q_min_rad,
            q_max=_or_infinity(self.q_max_rad),
            qd_des_limit=_or_infinity(self.qd_des_limit_rad_s),
            tau_rate=_or_infinity(self.tau_rate_limit_nm_s),
        )

    def find_unlimited_rows(self, qd_des: Array) -> NDArray[np.bool_]:
        """Marks the records in which no speed limit restricts the motion that the arm follows.

        The motion that an arm follows is called its reference. Its velocity is limited in each
        of the n coordinates.

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
    """Description of a site in a scenario: an arm with its control loop.

    A site is a process that runs one arm. Its peers are the other sites whose states it
    receives.

    Attributes:
        role: Role of the site for people who read figures, and for the stale rule "degrade". It
            enters no formula.
        rate_hz: Tick rate of the control loop, in Hz.
        q0_rad: Start pose, in rad.
        qd0_rad_s: Start velocity, in rad/s.
        arm: Arm of the site.
        control: Control law and its gains.
        limits: Limits of torques, speeds and positions.
        on_stale: Reaction if the samples of a peer are too old or missing.
        task: Coordinates that the site shares with its peers: its joint angles, or the pose of
            its end effector.
        hands: Operators: persons or programs who move the arm.
        environment: Walls and other bodies that act on the arm.
        plant: Who moves the arm. "simulated": The program. "external": A real robot, whose
            state is measured. Otherwise a user's class, which computes the motion.
        view: Delay, loss and order of the picture in which the user of the site sees the other
            arms. It has the keys of a link. None if the user sees the samples that the
            controller uses. The view enters no formula.
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

        The name of a user's law consists of its module and class, for example
        "package.module:Law".
        """
        return str(self.control.tag) if self.user_law is None else self.user_law.code

    @property
    def user_law(self) -> ImportedLaw | None:
        """Control law of the site if it is a user's Python class. None if it is built in."""
        return self.control if isinstance(self.control, ImportedLaw) else None

    @property
    def has_program_hand(self) -> bool:
        """True if a program of the user operates the arm (a hand of kind "own").

        Such a program may react to the motion of the arm. A linearised loop does not contain
        this reaction, unlike that of an operator whom the scenario describes.
        """
        return any(isinstance(hand, ProgramHand) for hand in self.hands)

    def find_hand_impedances(self) -> tuple[ArmLoad, ...] | None:
        """Returns the operators and environments that react to the motion of the arm.

        Operators whose torque depends on time alone are left out.

        Returns:
            The spring and the damper of each. None if the reaction of an operator depends on
            the pose, because the operator acts on the end effector, or if the reaction is not
            known, because the operator is a live operator or a program.
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
        """Finds the operator of the site who may move the arm while the session runs.

        An operator is a person or program that moves the arm.

        Args:
            is_open: If True, an operator counts only if any member of the session may take the
                role.

        Returns:
            The operator. None if the site has no such operator.
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
"""Groups of keys that may be written once for all sites and again for one site, by table."""

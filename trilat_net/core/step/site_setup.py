"""Defines the setup of a site: everything needed to run the control loop of its arm.

The setup is derived from a scenario. Unlike the scenario, it has no missing values, and it
refers to other arms by index instead of by name.

Invariant:
    - Everything that a site computes depends only on its setup and on the inputs of its control
      periods.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ...records import Layout as Layout
from ..arms.chain import LINK_PARAMETERS, ChainJoint, Matrix, Three
from ..arms.exogenous import LIVE_KINDS, TorqueKind, TorqueSource
from ..arms.two_link_arm import JOINTS
from ..life.live_hand import HandInForce
from ..links.delay import LinkModel
from ..plug.law_channel import LawChannel, SentVector
from ..plug.user_law import LawContext, UserLawFactory
from .ticks import DominanceRamp
from .vectors import Array, Points, Vector


class Law(IntEnum):
    """Type of control law used by an arm.

    ADAPTIVE estimates the dynamic parameters of the arm, optionally within bounds. KNOWN
    compensates for the known gravity torque:

        tau = G(q) - K e - d qd - Kd ed + k_f felt

    Here q and qd are the joint angles and velocities, G is the gravity torque, e and ed are the
    position and velocity errors, and felt is the torque ON the other arms. The gains are the
    stiffness K, the damping d, the derivative gain Kd and the force gain k_f. Depending on the
    gains, the law is P+d, PD+d or direct force reflection. USER is a law in Python, either
    written by a user or taken from `trilat_net.laws`.
    """

    ADAPTIVE = 0
    KNOWN = 1
    USER = 2


LEAST_STOP_S = 0.1
"""Shortest time in which the reference of an arm comes to rest, s."""


class StaleAction(IntEnum):
    """What a site does when a peer has been silent for too long.

    USE follows the last known state of the peer. HOLD freezes the reference at its last value.
    BRAKE keeps the pose that the arm had when the peer fell silent. GLIDE brings the arm
    smoothly to rest; with GLIDE, the arm also waits at the start until samples from all peers
    arrive, see `session_life`.
    """

    USE = 0
    HOLD = 1
    BRAKE = 2
    GLIDE = 3


class StaleRule(NamedTuple):
    """What a site does when a peer is stale: no new sample has arrived from it for too long.

    Attributes:
        action: Reaction of the site while a peer is stale.
        age_ns: Largest age of the newest sample, ns. For GLIDE, the longest time since a new
            sample could be used.
        return_ns: Duration of the return to the reference computed from the peers, ns. Not used
            for GLIDE.
        align_speed: For GLIDE: largest speed at which the arm returns to its peers, rad/s or
            m/s.
        align_limit: For GLIDE: largest distance over which the arm may return, rad or m.
        degrades: For GLIDE: True if the site continues without a lost peer, see `lost_peers`.
    """

    action: StaleAction = StaleAction.USE
    age_ns: int = 0
    return_ns: int = 1
    align_speed: float = 1.0
    align_limit: float = math.inf
    degrades: bool = False

    @property
    def glides(self) -> bool:
        """True if the arm comes smoothly to rest while a peer is silent for too long."""
        return self.action is StaleAction.GLIDE

    @property
    def is_active(self) -> bool:
        """True if the site reacts in any way to a peer that is silent for too long."""
        return self.action is not StaleAction.USE

    @classmethod
    def by_age(cls, action: str, age_ns: int, return_ns: int) -> "StaleRule":
        """Returns a rule under which a peer is stale if its newest sample is too old.

        Args:
            action: "use", "hold" or "brake", see `StaleAction`.
            age_ns: Largest age of the newest sample, ns.
            return_ns: Duration of the return to the reference computed from the peers, ns.
        """
        return cls(StaleAction[action.upper()], age_ns, return_ns)

    @classmethod
    def glide(
        cls, age_ns: int, align_speed: float, align_limit: float, *, degrades: bool
    ) -> "StaleRule":
        """Returns a rule under which the arm comes smoothly to rest while a peer is stale.

        Args:
            age_ns: Longest time since a new sample could be used, ns.
            align_speed: Largest speed at which the arm returns to its peers, rad/s or m/s.
            align_limit: Largest distance over which the arm may return, rad or m.
            degrades: True if the site continues without a lost peer, see `lost_peers`.
        """
        return cls(
            StaleAction.GLIDE,
            age_ns,
            align_speed=align_speed,
            align_limit=align_limit,
            degrades=degrades,
        )


class MotionLimits(NamedTuple):
    """Limits of an arm's joint angles, and of how fast its reference and torque may change.

    Each limit has either a single entry for all joints or coordinates, or one entry for each of
    them.

    Attributes:
        q_min: Smallest joint angles, rad.
        q_max: Largest joint angles, rad.
        qd_des_limit: Largest speed of the reference, rad/s; in task space m/s.
        tau_rate: Largest rate of change of the control torque, N m/s.
    """

    q_min: Vector = (-math.inf,)
    q_max: Vector = (math.inf,)
    qd_des_limit: Vector = (math.inf,)
    tau_rate: Vector = (math.inf,)


class RestGains(NamedTuple):
    """Gains of the controller that brings an arm to rest and holds it, see `resting`.

    This controller is active, for example, while another arm is silent. Each vector has a
    single entry for all joints, or one entry per joint.

    Attributes:
        damping: Joint damping B, N m s/rad.
        time_s: Time constant with which damping alone stops a joint, s, assuming the inertia
            for which B was chosen.
        deceleration: Deceleration of the reference that the joints follow while coming to rest,
            rad/s^2.
    """

    damping: Vector = (0.0,)
    time_s: float = 1.0
    deceleration: Vector = (math.inf,)

    def vectors(self) -> dict[str, Vector]:
        """Returns the gains, keyed by field name in the state of an arm.

        The keys are "damping", "integral" and "deceleration". The integral gain is the damping
        divided by 4 `time_s`, in N m/rad.
        """
        integral = tuple(float(B) / (4.0 * self.time_s) for B in self.damping)
        return {
            "damping": self.damping,
            "integral": integral,
            "deceleration": self.deceleration,
        }

    def stop_s(self, qd: Array) -> Array:
        """Returns how long it takes to bring an arm to rest from given joint velocities, s.

        The arm is considered to be at rest when the reference of all its joints has stopped.
        The calculation assumes that nothing else slows the joints down.

        Args:
            qd: Joint velocities of one or several arms, shape (..., n), rad/s.

        Returns:
            The time for each set of n velocities, shape (...), s.
        """
        stop_times_s = np.abs(qd) / self.deceleration
        slowest_s = stop_times_s.max(axis=-1)  # of the joints of an arm
        duration_s: Array = np.maximum(LEAST_STOP_S, slowest_s)
        return duration_s


class LinkSetup(NamedTuple):
    """Settings of the network link over which an arm receives the states of another arm.

    Attributes:
        peer: Name of the peer.
        alpha: Dominance factor of the peer (its weight in this site's reference), Eq. (6).
        rate_hz: Tick rate of the peer, Hz.
        q0: Start pose of the peer, in rad, or of its end effector. Used until the first sample
            is due (L7).
        key: Key that determines the random numbers of the link, see `link_key`.
        models: Delay models, ordered by the first time stamp to which they apply. The first
            model applies from stamp 0.
        traces: For each model, the points of its trace (a table of delays by time), shape (n,
            2), see `Points`. None for a model without a trace.
        outages: Interruptions of the link, as pairs of first stamp and end, ns.
        channel: Values that the peer's law sends in addition to the motion of the peer.
        index_at_peer: Index of this site among the peers of the peer, in scenario order.
        speed_limit: Joint speeds of the peer above which its samples are dropped, rad/s. () for
            no limit.
        bit: The peer's bit in sets of sites, which are integers with one bit per site.
        followed: Set of the sites that the peer follows.
        dispensable: True if the site may continue without the peer after the peer is lost.
    """

    peer: str
    alpha: float
    rate_hz: int
    q0: tuple[float, ...]
    key: int = 0
    models: tuple[LinkModel, ...] = (LinkModel(),)
    traces: tuple[Points | None, ...] = (None,)
    outages: tuple[tuple[int, int], ...] = ()
    channel: LawChannel = LawChannel()
    index_at_peer: int = 0
    speed_limit: tuple[float, ...] = ()
    bit: int = 0
    followed: int = 0
    dispensable: bool = False


class TaskSetup(NamedTuple):
    """Settings of an arm whose end effector follows other end effectors (task space).

    For example, it may follow their x and y positions only, while z is free.

    Attributes:
        axes: For each coordinate of the end effector, 1 if it follows the other arms, otherwise
            0. Three coordinates are a position, and six are a pose.
        scale: Size of the shared coordinates relative to this arm: with a scale of 2, moving
            this arm by 1 m counts as 2 m.
        posture: Preferred joint angles, which the arm approaches as far as the motion of the
            end effector allows, rad.
        posture_rate: Rate at which the arm approaches these angles, 1/s.
        singular_value: Threshold for damping the Jacobian near a singular pose, m/rad. The
            Jacobian is damped where its smallest singular value may fall below this threshold.
    """

    axes: tuple[float, ...]
    scale: float = 1.0
    posture: tuple[float, ...] = ()
    posture_rate: float = 0.0
    singular_value: float = 0.05


class ChainSetup(NamedTuple):
    """Settings of an arm that is a chain of joints, as read from a URDF file.

    Attributes:
        joints: The joints, starting at the base.
        gravity_m_s2: Gravitational acceleration in the base frame, m/s^2.
        tip_m: Position of the end effector in the frame of the last link, m.
        tip_rotation: Orientation of the end effector in that frame.
        task: Task-space settings. None if the arm follows joint by joint.
    """

    joints: tuple[ChainJoint, ...]
    gravity_m_s2: Three = (0.0, 0.0, -9.81)
    tip_m: Three = (0.0, 0.0, 0.0)
    tip_rotation: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    task: TaskSetup | None = None


class Gains(NamedTuple):
    """Control law of an arm and its gains, in a form suitable for compiled code.

    Gains of other laws have no effect. Diagonal matrices are stored as vectors. A vector with a
    single entry uses that value for all its entries.

    Attributes:
        law: The type of law.
        Lambda: Rate at which errors decay, shape (n,), 1/s.
        Kp: Damping of the filtered error, shape (n,), N m s/rad.
        Kd: Damping of the error velocity, shape (n,), N m s/rad.
        Gamma: Adaptation gain per parameter, shape (P,).
        theta_hat0: Initial estimate, shape (P,).
        low: Lower bound of each estimate, shape (P,).
        high: Upper bound of each estimate, shape (P,).
        known: Arm parameters assumed by KNOWN, shape (P,).
        K: Stiffness of KNOWN, shape (n,), N m/rad.
        d: Damping of KNOWN, shape (n,), N m s/rad.
        k_f: Gain of the reflected force of KNOWN, shape (n,), dimensionless.
        rho: Largest robust torque of ADAPTIVE, shape (n,), N m.
        width: Speed r at which the robust torque is 0.71 rho, shape (n,), rad/s.
        friction: Fraction of a chain's joint friction for which ADAPTIVE compensates, shape
            (n,).
        absolute: True if r of ADAPTIVE is qd + Lambda q, and Kp couples it to r of the peers.
            Used only by the linear analysis.
    """

    law: Law
    Lambda: Vector = (1.0,)
    Kp: Vector = (0.0,)
    Kd: Vector = (0.0,)
    Gamma: Vector = (0.0,)
    theta_hat0: Vector = (0.0,)
    low: Vector = (-math.inf,)
    high: Vector = (math.inf,)
    known: Vector = (0.0,)
    K: Vector = (0.0,)
    d: Vector = (0.0,)
    k_f: Vector = (0.0,)
    rho: Vector = (0.0,)
    width: Vector = (1.0,)
    friction: Vector = (1.0,)
    absolute: bool = False

    @property
    def is_adaptive(self) -> bool:
        """True if the law estimates the dynamic parameters of the arm."""
        return self.law is Law.ADAPTIVE

    @property
    def is_known(self) -> bool:
        """True if the law is the built-in law that uses a known gravity torque."""
        return self.law is Law.KNOWN

    @property
    def is_user(self) -> bool:
        """True if the torque is computed by a Python class, such as a law written by a user."""
        return self.law is Law.USER


class SiteSetup(NamedTuple):
    """All settings of an arm and its controller, in numerical form.

    They also determine the state before the first control period.

    Attributes:
        name: Name of the site.
        rate_hz: Tick rate, Hz.
        digital: True if the law is discretised with a zero-order hold and the forward Euler
            method, like a plain digital controller. False if the torque is extrapolated to the
            middle of the control period, and the parameter estimate is updated with the
            trapezoidal rule.
        gains: The control law and its gains.
        theta: True parameters of the arm, shape (P,).
        g_m_s2: Gravitational acceleration, m/s^2. A chain uses the value in its `ChainSetup`
            instead.
        lengths_m: Lengths of the two links, m; ignored for a chain.
        tau_limit_nm: Largest control torque of a joint, N m. A single value, or one per joint.
        qd_limit_rad_s: Joint speed above which the run counts as diverged, rad/s.
        q0: Start pose, rad.
        qd0: Initial velocity, rad/s.
        actors: Operators and environments of the arm, one row each.
        links: Links from the peers, in scenario order.
        ramps: Scripted changes of the dominance factors, ordered by start time.
        on_stale: How to react to a stale peer.
        external: True if the arm is outside the program, in which case its motion is measured
            instead of simulated.
        law_factory: Creates the user's law. None if the kernel computes the law.
        theta_known: False if `theta` does not describe the arm, because the arm is external and
            was not identified.
        chain: Settings of the arm if it is a chain. None for the planar two-link arm.
        channel: Values that the site's law sends to its peers.
        limits: Limits on the motion.
        rest: Gains used to bring the arm to rest.
        bit: The site's bit in sets of sites, which are integers with one bit per site.
        bodies: Number of bodies in the simulated scene whose poses are recorded.
    """

    name: str
    rate_hz: int
    digital: bool
    gains: Gains
    theta: Array
    g_m_s2: float
    lengths_m: tuple[float, float]
    tau_limit_nm: Vector
    qd_limit_rad_s: Vector
    q0: tuple[float, ...]
    qd0: tuple[float, ...]
    actors: tuple[TorqueSource, ...]
    links: tuple[LinkSetup, ...]
    ramps: tuple[DominanceRamp, ...] = ()
    on_stale: StaleRule = StaleRule()
    external: bool = False
    law_factory: UserLawFactory | None = None
    theta_known: bool = True
    chain: ChainSetup | None = None
    channel: LawChannel = LawChannel()
    limits: MotionLimits = MotionLimits()
    rest: RestGains = RestGains()
    bit: int = 0
    bodies: int = 0

    @staticmethod
    def make_layout(
        chain: ChainSetup | None, sent: int = 0, actors: Sequence[TorqueSource] = ()
    ) -> Layout:
        """Returns the lengths of all vectors of an arm, such as joint angles and torques.

        Args:
            chain: Settings of the arm if it is a chain of joints. None for the planar two-link
                arm.
            sent: Number of values that the control law sends to other arms in each period.
            actors: Operators and environments of the arm, with at most one live operator.
        """
        joints = JOINTS if chain is None else len(chain.joints)

        # A person or program that moves the arm (live hand) pulls at its joints, or at its end
        # effector in the plane or in space.
        hand_numbers = 0
        for actor in actors:
            if actor.kind not in LIVE_KINDS:
                continue
            coordinates = 2 if chain is None else 3
            if actor.kind is TorqueKind.LIVE_JOINT:
                coordinates = joints
            hand_numbers = HandInForce.count_numbers(coordinates)
            break

        if chain is None:
            return Layout(sent=sent, hand=hand_numbers)
        task = chain.task
        return Layout(
            joints=joints,
            shared=joints if task is None else len(task.axes),
            parameters=LINK_PARAMETERS * joints,
            chain=True,
            task=task is not None,
            sent=sent,
            hand=hand_numbers,
        )

    @property
    def layout(self) -> Layout:
        """Lengths of the vectors in the state of this arm, for example the number of joints.

        Each body in the simulated scene adds seven values for its pose.
        """
        layout = self.make_layout(self.chain, self.channel.record_size, self.actors)
        return layout._replace(bodies=7 * self.bodies)

    @property
    def live_actor(self) -> int:
        """Index of the live operator among the operators and environments, -1 if there is none.

        A live operator is a person or program that moves the arm during the run.
        """
        for index, source in enumerate(self.actors):
            if source.kind in LIVE_KINDS:
                return index
        return -1

    @property
    def received_vectors(self) -> tuple[SentVector, ...]:
        """Vectors that the control law of this site reads from each of its peers.

        A control law may send vectors to other sites in addition to the motion of its arm. A
        vector that a peer does not send reads as zero.

        Returns:
            A description of each vector, in the order in which the law receives them.
        """
        channels = [link.channel for link in self.links]
        return LawChannel.join_received([*channels, self.channel])

    def law_context(self) -> LawContext:
        """Returns the information about the arm and its peers needed to create a user's law.

        The dynamic parameters theta are empty for an external arm that was not identified.
        """
        layout = self.layout
        theta: tuple[float, ...] = ()
        if self.theta_known:
            theta = tuple(float(parameter) for parameter in self.theta)
        return LawContext(
            site=self.name,
            rate_hz=self.rate_hz,
            g_m_s2=self.g_m_s2,
            lengths_m=self.lengths_m,
            theta=theta,
            tau_limit_nm=self.tau_limit_nm,
            joints=layout.joints,
            coordinates=layout.shared,
            peers=tuple(link.peer for link in self.links),
        )

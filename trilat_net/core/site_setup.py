"""The setup of a site: resolved numbers and names.

Invariant: nothing else influences a site's numbers.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from .chain import LINK_PARAMETERS, ChainJoint, Matrix, Three
from .delay import LinkModel
from .exogenous import LIVE_KINDS, TorqueKind, TorqueSource
from .law_channel import LawChannel, SentVector, join_received
from .live_hand import count_hand_numbers
from .ticks import DominanceRamp
from .two_link_arm import JOINTS, PARAMETERS
from .user_law import LawContext, UserLawFactory
from .vectors import Array, Points, Vector


class Scheme(IntEnum):
    """How the continuous law is sampled.

    SECOND_ORDER extrapolates the torque to mid-period and updates the estimate by the trapezoid
    rule; DIGITAL is zero-order hold and forward Euler, as in a plain digital controller.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class Law(IntEnum):
    """The control law of a site.

    ADAPTIVE is the paper's, Eq. (13) and (15), with its estimate in a box if one is given.
    KNOWN knows
    gravity: tau = G(q) - K e - d qd - Kd ed + k_f felt, which is P+d, PD+d, or direct force
    reflection. USER is a user's law, in Python.
    """

    ADAPTIVE = 0
    KNOWN = 1
    USER = 2


LEAST_STOP_S = 0.1
"""The least time in which the reference of an arm that is to rest comes to rest."""


class StaleAction(IntEnum):
    """The action of a site while a peer that it follows is stale.

    USE goes on with the last sample; HOLD stays at the reference that was in force; BRAKE stays
    where the arm was. GLIDE lets the reference come to rest, and begins by waiting for all
    peers, see `session_life`.
    """

    USE = 0
    HOLD = 1
    BRAKE = 2
    GLIDE = 3


class StaleRule(NamedTuple):
    """When a peer counts as stale, and the consequence.

    Attributes:
        action: the site's action then.
        age_ns: a peer whose sample in use is older is stale, ns; of GLIDE one of which none
            came into use for so long.
        return_ns: duration of the return to the peers, ns.
        align_speed: of GLIDE, the largest speed of the way to the peers, rad/s (of a place
            m/s).
        align_limit: of GLIDE, the longest way that it goes by itself, rad (of a place m).
        degrades: of GLIDE, true: it goes on without a peer that is lost, see `lost_peers`.
    """

    action: StaleAction = StaleAction.USE
    age_ns: int = 0
    return_ns: int = 1
    align_speed: float = 1.0
    align_limit: float = math.inf
    degrades: bool = False


class MotionLimits(NamedTuple):
    """How far an arm may go, and how fast its reference and its torque may change; one number,
    or one each.

    Attributes:
        q_min: least joint angles, rad.
        q_max: largest joint angles, rad.
        qd_des_limit: largest speed of the reference, rad/s; in task space m/s.
        tau_rate: largest rate of the control torque, N m/s.
    """

    q_min: Vector = (-math.inf,)
    q_max: Vector = (math.inf,)
    qd_des_limit: Vector = (math.inf,)
    tau_rate: Vector = (math.inf,)


class RestGains(NamedTuple):
    """How an arm comes to rest and stays there, see `resting`; one number, or one per joint.

    Attributes:
        damping: B, N m s/rad.
        time_s: time in which B alone brings the joint to rest whose inertia it was made for, s.
        deceleration: of the reference, rad/s^2.
    """

    damping: Vector = (0.0,)
    time_s: float = 1.0
    deceleration: Vector = (math.inf,)

    def vectors(self) -> dict[str, Vector]:
        """Returns the gains that the core has: k B besides, k one quarter of 1 / time_s."""
        integral = tuple(float(B) / (4.0 * self.time_s) for B in self.damping)
        return {
            "damping": self.damping,
            "integral": integral,
            "deceleration": self.deceleration,
        }

    def stop_s(self, qd: Array) -> Array:
        """Returns the time in which the reference comes to rest from velocities of shape (...,
        n), rad/s.
        """
        found: Array = np.maximum(LEAST_STOP_S, (np.abs(qd) / self.deceleration).max(axis=-1))
        return found


class LinkSetup(NamedTuple):
    """One peer as a site sees it.

    Attributes:
        peer: the peer's name.
        alpha: its dominance factor in this site's reference, Eq. (6), dimensionless.
        rate_hz: the peer's tick rate, Hz.
        q0: the peer's start pose, rad, or its end effector's, in use until its first sample is
            due (L7).
        key: the key of the link's draws, see `link_key`.
        models: in the order of their first stamps; the first applies from stamp 0.
        traces: per model the points of its trace, shape (n, 2), see `Points`, or None.
        outages: when the link is cut: pairs of first stamp and end, ns.
        channel: what the peer's law sends besides its motion.
        index_at_peer: the site's place among the peers of its peer, in scenario order.
        speed_limit: largest speed of the peer's joints, rad/s, for who drops samples beyond; ()
            for no one.
        bit: of the peer in sets of sites.
        followed: the set of sites that the peer follows.
        dispensable: true: a site that degrades may go on without it.
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


class Layout(NamedTuple):
    """How many numbers the vectors of a site have.

    Attributes:
        joints: one per joint of the arm.
        shared: one per coordinate that sites exchange.
        parameters: one per dynamic parameter of the arm.
        chain: true: the arm is a chain of joints, else the planar two-link arm.
        task: true: the coordinates are those of the end effector, else the joint angles.
        sent: numbers that the law sends in a record, see `LawChannel.record_size`.
        hand: numbers that a live hand has in a record, see `live_hand`; 0: the site has none.
        bodies: numbers of the poses of its plant's bodies, see `TickRecord.bodies`.
    """

    joints: int = JOINTS
    shared: int = JOINTS
    parameters: int = PARAMETERS
    chain: bool = False
    task: bool = False
    sent: int = 0
    hand: int = 0
    bodies: int = 0

    @classmethod
    def of_arm(
        cls, chain: "ChainSetup | None", sent: int = 0, actors: Sequence[TorqueSource] = ()
    ) -> "Layout":
        """Returns the layout of a chain, or without one of the planar two-link arm; its law
        sends so much.
        """
        n = JOINTS if chain is None else len(chain.joints)
        live = next((actor.kind for actor in actors if actor.kind in LIVE_KINDS), None)
        size = n if live is TorqueKind.LIVE_JOINT else 2 if chain is None else 3
        hand = 0 if live is None else count_hand_numbers(size)
        if chain is None:
            return cls(sent=sent, hand=hand)
        task = chain.task
        shared = n if task is None else len(task.axes)
        return cls(
            joints=n,
            shared=shared,
            parameters=LINK_PARAMETERS * n,
            chain=True,
            task=task is not None,
            sent=sent,
            hand=hand,
        )

    def axes(self) -> dict[str, int]:
        """Returns the lengths of the axes that the fields of rows name, see `row_fields`."""
        return {"joints": self.joints, "shared": self.shared, "parameters": self.parameters}

    def lengths(self) -> dict[str, int]:
        """Returns how many numbers the vectors of a record have, in their order."""
        n = self.joints
        m = self.shared
        vectors = {"q": n, "qd": n, "q_des": m, "qd_des": m, "tau": n, "tau_x": n}
        shared = {"x": m, "xd": m, "wrench": m} if self.task else {}
        others = {"ch": self.sent, "hand": self.hand, "bodies": self.bodies}
        given = {name: count for name, count in others.items() if count}
        return {**vectors, "theta_hat": self.parameters, **shared, **given}

    def columns(self) -> dict[str, slice]:
        """Returns where the vectors that a tick computes stand in its row of floats, in their
        order.
        """
        lengths = {
            name: n for name, n in self.lengths().items() if name not in ("hand", "bodies")
        }
        ends = accumulate(lengths.values())
        return {
            name: slice(end - length, end)
            for (name, length), end in zip(lengths.items(), ends, strict=True)
        }

    def count_life_memory(self, peers: int, *, degrades: bool = False) -> int:
        """Returns how many numbers a site that glides, with so many peers, has in a record's
        `mem`.

        In task space there are the pose and the velocities of `rest_columns`. Of one that
        degrades the last of them are `gone` of its peers.
        """
        end: int = self.rest_columns(peers).stop
        return end + peers * degrades

    def rest_columns(self, peers: int) -> slice:
        """Returns where `mem` has the joint pose and the velocities from which an arm in task
        space rests.
        """
        first = 2 * (self.shared + 1) + peers + self.joints
        return slice(first, first + 2 * self.joints * self.task)

    def list_lost_peers(self, mem: Sequence[float], peers: Sequence[str]) -> list[str]:
        """Returns the peers without which a site that degrades goes on, by a record's `mem`."""
        end = self.count_life_memory(len(peers), degrades=True)
        return [
            peer for peer, gone in zip(peers, mem[end - len(peers) : end], strict=False) if gone
        ]

    @property
    def floats(self) -> int:
        """Length of a record's row of floats."""
        return (
            4 * self.joints
            + (5 if self.task else 2) * self.shared
            + self.parameters
            + self.sent
        )


class TaskSetup(NamedTuple):
    """How a site follows with its end effector.

    Attributes:
        axes: per coordinate 1: the site follows along it, 0: not. Three of them: a place; six:
            a pose.
        scale: metres of the task per metre of this arm.
        posture: joint angles that it moves towards as far as the task leaves it free, rad.
        posture_rate: by how much of the way in a second, 1/s.
        singular_value: least singular value of the Jacobian that needs no damping, m/rad.
    """

    axes: tuple[float, ...]
    scale: float = 1.0
    posture: tuple[float, ...] = ()
    posture_rate: float = 0.0
    singular_value: float = 0.05


class ChainSetup(NamedTuple):
    """An arm that is a chain of joints.

    Attributes:
        joints: its joints, from the base on.
        gravity_m_s2: gravitational acceleration in the base's frame.
        tip_m: the end effector in the last link's frame.
        tip_rotation: its orientation there.
        task: how it follows with its end effector; None: it follows joint by joint.
    """

    joints: tuple[ChainJoint, ...]
    gravity_m_s2: Three = (0.0, 0.0, -9.81)
    tip_m: Three = (0.0, 0.0, 0.0)
    tip_rotation: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    task: TaskSetup | None = None


class Gains(NamedTuple):
    """A control law and its gains, diagonal ones as vectors; those of other laws have no
    effect.

    A vector of one number stands for one whose entries are all that number.

    Attributes:
        law: the law.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (P,).
        theta_hat0: the first estimate, shape (P,).
        low: lower bound of each estimate, shape (P,).
        high: upper bound, shape (P,).
        known: the parameters that KNOWN takes the arm to have, shape (P,).
        K: stiffness of KNOWN, shape (n,), N m/rad.
        d: damping of KNOWN, shape (n,), N m s/rad.
        k_f: gain of the reflected force of KNOWN, shape (n,), dimensionless.
        rho: largest robust torque of ADAPTIVE, shape (n,), N m.
        width: speed r at which it is 0.71 of that, shape (n,), rad/s.
        friction: share of a chain's joint friction that ADAPTIVE compensates, shape (n,).
        absolute: true: r of ADAPTIVE is qd + Lambda q, and Kp takes it to that of the peers;
            only linearised.
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


class SiteSetup(NamedTuple):
    """All that a site is built from.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        gains: the law and its gains.
        theta: true parameters of the arm, shape (P,).
        g_m_s2: gravitational acceleration, m/s^2; of a chain its setup says it.
        lengths_m: of the two links; of a chain without effect.
        tau_limit_nm: largest control torque of a joint, N m; one number, or one per joint.
        qd_limit_rad_s: joint speed beyond which the run counts as diverged, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        actors: operators and environments.
        links: the peers in scenario order.
        ramps: scripted changes of the dominance factors, in the order of their starts.
        on_stale: the rule for a stale peer.
        external: true: the arm is outside of the program; it is measured, and nothing is
            integrated.
        law_factory: makes the user's law, if it is one.
        theta_known: false: `theta` is not that of the arm, which is outside of the program and
            unidentified.
        chain: the arm, if it is a chain; None: it is the planar two-link arm.
        channel: what the site's law sends to its peers.
        limits: further limits.
        rest: how its arm comes to rest.
        bit: of the site in sets of sites.
    """

    name: str
    rate_hz: int
    scheme: Scheme
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

    @property
    def layout(self) -> Layout:
        """How many numbers its vectors have."""
        return Layout.of_arm(self.chain, self.channel.record_size, self.actors)._replace(
            bodies=7 * self.bodies
        )

    @property
    def received_vectors(self) -> tuple[SentVector, ...]:
        """The vectors that its law finds of each peer; one that a peer does not send is zero."""
        return join_received([*(link.channel for link in self.links), self.channel])

    def law_context(self) -> LawContext:
        """Returns what a plugged law may know before it begins."""
        return LawContext(
            site=self.name,
            rate_hz=self.rate_hz,
            g_m_s2=self.g_m_s2,
            lengths_m=self.lengths_m,
            theta=tuple(map(float, self.theta)) if self.theta_known else (),
            tau_limit_nm=self.tau_limit_nm,
            joints=self.layout.joints,
            coordinates=self.layout.shared,
            peers=tuple(link.peer for link in self.links),
        )

"""The setup of a site: resolved numbers and names.

Invariant: nothing else influences a site's numbers.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from .delay import LinkModel
from .exogenous import TorqueSource
from .ticks import DominanceRamp
from .two_link_arm import JOINTS, PARAMETERS
from .user_law import UserLawFactory
from .vectors import Array, Points


class Scheme(IntEnum):
    """How the continuous law is sampled.

    SECOND_ORDER extrapolates the torque to mid-period and updates the estimate by the trapezoid rule;
    DIGITAL is zero-order hold and forward Euler, what a plain digital controller does.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class Law(IntEnum):
    """The control law of a site.

    ADAPTIVE is the paper's, Eq. (13) and (15), with its estimate held in a box where one is given. KNOWN
    knows gravity: tau = G(q) - K e - d qd - Kd ed + k_f felt, which is P+d, PD+d, or direct force reflection.
    OWN is somebody's own, in Python.
    """

    ADAPTIVE = 0
    KNOWN = 1
    OWN = 2


class StaleAction(IntEnum):
    """What a site does while a peer that it follows is stale.

    USE goes on with the last sample; HOLD stays at the reference that was in force; BRAKE stays where the
    arm was.
    """

    USE = 0
    HOLD = 1
    BRAKE = 2


class StaleRule(NamedTuple):
    """When a peer counts as stale, and what follows.

    Attributes:
        action: what the site does then.
        age_ns: a sample in use that is older makes its peer stale, ns.
        return_ns: how long the way back to the peers takes, ns.
    """

    action: StaleAction = StaleAction.USE
    age_ns: int = 0
    return_ns: int = 1


class LinkSetup(NamedTuple):
    """One peer as a site sees it.

    Attributes:
        peer: the peer's name.
        alpha: its share in this site's reference, Eq. (6), dimensionless.
        rate_hz: the peer's tick rate, Hz.
        q0: the peer's start pose, rad, in use until its first sample is due (L7).
        key: what the link's draws are a function of, see `draw.link_key`.
        models: what the link does, in the order of their first stamps; the first applies from stamp 0.
        traces: per model the points of its trace, shape (n, 2), see `delay.Points`; None where it has none.
        outages: when the link is cut: pairs of first stamp and end, ns.
    """

    peer: str
    alpha: float
    rate_hz: int
    q0: tuple[float, ...]
    key: int = 0
    models: tuple[LinkModel, ...] = (LinkModel(),)
    traces: tuple[Points | None, ...] = (None,)
    outages: tuple[tuple[int, int], ...] = ()


class Gains(NamedTuple):
    """A law and its numbers, diagonal gains as vectors; those of other laws are without effect.

    Attributes:
        law: which law.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (5,).
        theta_hat0: the first estimate, shape (5,).
        low: least that each estimate may be, shape (5,).
        high: most that it may be, shape (5,).
        known: the parameters that KNOWN takes the arm to have, shape (5,).
        K: stiffness of KNOWN, shape (n,), N m/rad.
        d: damping of KNOWN, shape (n,), N m s/rad.
        k_f: share of what the peers feel, of KNOWN, shape (n,).
    """

    law: Law
    Lambda: Sequence[float] = (1.0,) * JOINTS
    Kp: Sequence[float] = (0.0,) * JOINTS
    Kd: Sequence[float] = (0.0,) * JOINTS
    Gamma: Sequence[float] = (0.0,) * PARAMETERS
    theta_hat0: Sequence[float] = (0.0,) * PARAMETERS
    low: Sequence[float] = (-math.inf,) * PARAMETERS
    high: Sequence[float] = (math.inf,) * PARAMETERS
    known: Sequence[float] = (0.0,) * PARAMETERS
    K: Sequence[float] = (0.0,) * JOINTS
    d: Sequence[float] = (0.0,) * JOINTS
    k_f: Sequence[float] = (0.0,) * JOINTS


class SiteSetup(NamedTuple):
    """All that a site is built from; nothing else influences its numbers.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        gains: the law and its numbers.
        theta: true parameters of the arm, shape (5,).
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        tau_limit_nm: largest control torque of a joint, N m.
        qd_limit_rad_s: joint speed beyond which the run has left the physics, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        actors: operators and environments.
        links: the peers in scenario order.
        ramps: scripted changes of the shares, in the order of their starts.
        on_stale: what to do about a stale peer.
        external: whether the arm is outside of the program; then it is measured, and nothing is integrated.
        own: makes the law where it is somebody's own.
        theta_known: whether `theta` is the arm's; of an arm outside of the program nobody may know it.
    """

    name: str
    rate_hz: int
    scheme: Scheme
    gains: Gains
    theta: Array
    g_m_s2: float
    lengths_m: tuple[float, float]
    tau_limit_nm: float
    qd_limit_rad_s: float
    q0: tuple[float, ...]
    qd0: tuple[float, ...]
    actors: tuple[TorqueSource, ...]
    links: tuple[LinkSetup, ...]
    ramps: tuple[DominanceRamp, ...] = ()
    on_stale: StaleRule = StaleRule()
    external: bool = False
    own: UserLawFactory | None = None
    theta_known: bool = True

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
    DIGITAL is zero-order hold and forward Euler, as in a plain digital controller.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class Law(IntEnum):
    """The control law of a site.

    ADAPTIVE is the paper's, Eq. (13) and (15), with its estimate in a box if one is given. KNOWN knows
    gravity: tau = G(q) - K e - d qd - Kd ed + k_f felt, which is P+d, PD+d, or direct force reflection. OWN
    is a user's law, in Python.
    """

    ADAPTIVE = 0
    KNOWN = 1
    OWN = 2


class StaleAction(IntEnum):
    """The action of a site while a peer that it follows is stale.

    USE goes on with the last sample; HOLD stays at the reference that was in force; BRAKE stays where the
    arm was.
    """

    USE = 0
    HOLD = 1
    BRAKE = 2


class StaleRule(NamedTuple):
    """When a peer counts as stale, and the consequence.

    Attributes:
        action: the site's action then.
        age_ns: a peer whose sample in use is older is stale, ns.
        return_ns: duration of the return to the peers, ns.
    """

    action: StaleAction = StaleAction.USE
    age_ns: int = 0
    return_ns: int = 1


class LinkSetup(NamedTuple):
    """One peer as a site sees it.

    Attributes:
        peer: the peer's name.
        alpha: its dominance factor in this site's reference, Eq. (6), dimensionless.
        rate_hz: the peer's tick rate, Hz.
        q0: the peer's start pose, rad, in use until its first sample is due (L7).
        key: the key of the link's draws, see `link_key`.
        models: in the order of their first stamps; the first applies from stamp 0.
        traces: per model the points of its trace, shape (n, 2), see `Points`, or None.
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
    """A control law and its gains, diagonal ones as vectors; those of other laws have no effect.

    Attributes:
        law: the law.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (5,).
        theta_hat0: the first estimate, shape (5,).
        low: lower bound of each estimate, shape (5,).
        high: upper bound, shape (5,).
        known: the parameters that KNOWN takes the arm to have, shape (5,).
        K: stiffness of KNOWN, shape (n,), N m/rad.
        d: damping of KNOWN, shape (n,), N m s/rad.
        k_f: gain of the reflected force of KNOWN, shape (n,), dimensionless.
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
    """All that a site is built from.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        gains: the law and its gains.
        theta: true parameters of the arm, shape (5,).
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        tau_limit_nm: largest control torque of a joint, N m.
        qd_limit_rad_s: joint speed beyond which the run counts as diverged, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        actors: operators and environments.
        links: the peers in scenario order.
        ramps: scripted changes of the dominance factors, in the order of their starts.
        on_stale: the rule for a stale peer.
        external: true: the arm is outside of the program; it is measured, and nothing is integrated.
        own: makes the user's law, if it is one.
        theta_known: false: `theta` is not that of the arm, which is outside of the program and unidentified.
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

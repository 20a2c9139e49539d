"""What a site is built from: numbers and names, resolved.

Law: nothing else influences a site's numbers.
"""

from enum import IntEnum
from typing import NamedTuple

from .arm import Array
from .delay import Model, Points
from .tick import Ramp


class Scheme(IntEnum):
    """How the continuous law is sampled.

    SECOND_ORDER extrapolates the torque to mid-period and updates the estimate by the trapezoid rule;
    DIGITAL is zero-order hold and forward Euler, what a plain digital controller does.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class Law(IntEnum):
    """The control law of a site.

    ADAPTIVE is the paper's, Eq. (13) and (15). P_D knows gravity: tau = G(q) - K e - d qd.
    """

    ADAPTIVE = 0
    P_D = 1


class Stale(IntEnum):
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

    action: Stale = Stale.USE
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
    models: tuple[Model, ...] = (Model(),)
    traces: tuple[Points | None, ...] = (None,)
    outages: tuple[tuple[int, int], ...] = ()


class SiteSetup(NamedTuple):
    """All that a site is built from; nothing else influences its numbers.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        law: which law; the gains of the others are without effect.
        theta: true parameters of the arm, shape (5,).
        g_m_s2: gravitational acceleration, m/s^2.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (5,).
        theta_hat0: the first estimate, shape (5,).
        K: stiffness of P_D, shape (n,), N m/rad.
        d: damping of P_D, shape (n,), N m s/rad.
        tau_limit_nm: largest control torque of a joint, N m.
        qd_limit_rad_s: joint speed beyond which the run has left the physics, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        pulses: the operator's torque pulses, shape (P, 2 + n), see `exogenous`.
        links: the peers in scenario order.
        ramps: scripted changes of the shares, in the order of their starts.
        on_stale: what to do about a stale peer.
    """

    name: str
    rate_hz: int
    scheme: Scheme
    law: Law
    theta: Array
    g_m_s2: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    theta_hat0: Array
    K: Array
    d: Array
    tau_limit_nm: float
    qd_limit_rad_s: float
    q0: tuple[float, ...]
    qd0: tuple[float, ...]
    pulses: Array
    links: tuple[LinkSetup, ...]
    ramps: tuple[Ramp, ...] = ()
    on_stale: StaleRule = StaleRule()

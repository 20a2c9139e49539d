"""What a site is built from: numbers and names, resolved.

Law: nothing else influences a site's numbers.
"""

from enum import IntEnum
from typing import NamedTuple

from .arm import Array


class Scheme(IntEnum):
    """How the continuous law is sampled.

    SECOND_ORDER extrapolates the torque to mid-period and updates the estimate by the trapezoid rule;
    DIGITAL is zero-order hold and forward Euler, what a plain digital controller does.
    """

    SECOND_ORDER = 0
    DIGITAL = 1


class LinkSetup(NamedTuple):
    """One peer as a site sees it.

    Attributes:
        peer: the peer's name.
        alpha: its share in this site's reference, Eq. (6), dimensionless.
        delay_ns: delay of the link from it, ns.
        rate_hz: the peer's tick rate, Hz.
        q0: the peer's start pose, rad, in use until its first sample is due (L7).
    """

    peer: str
    alpha: float
    delay_ns: int
    rate_hz: int
    q0: tuple[float, ...]


class SiteSetup(NamedTuple):
    """All that a site is built from; nothing else influences its numbers.

    Attributes:
        name: the site's name.
        rate_hz: tick rate, Hz.
        scheme: how the law is sampled.
        theta: true parameters of the arm, shape (5,).
        g_m_s2: gravitational acceleration, m/s^2.
        Lambda: shape (n,), 1/s.
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        Gamma: adaptation gain per parameter, shape (5,).
        theta_hat0: the first estimate, shape (5,).
        tau_limit_nm: largest control torque of a joint, N m.
        qd_limit_rad_s: joint speed beyond which the run has left the physics, rad/s.
        q0: start pose, rad.
        qd0: start velocity, rad/s.
        pulses: the operator's torque pulses, shape (P, 2 + n), see `exogenous`.
        links: the peers in scenario order.
    """

    name: str
    rate_hz: int
    scheme: Scheme
    theta: Array
    g_m_s2: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    theta_hat0: Array
    tau_limit_nm: float
    qd_limit_rad_s: float
    q0: tuple[float, ...]
    qd0: tuple[float, ...]
    pulses: Array
    links: tuple[LinkSetup, ...]

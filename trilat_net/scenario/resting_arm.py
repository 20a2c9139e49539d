"""How fast an arm may come to rest, and which estimates of it are credible: both follow from what is stated.

Invariant: the same numbers on every machine, so what linear algebra gives is rounded up to a millisecond.
"""

import math

import numpy as np

from ..core.site_setup import Gains, Law, RestGains
from ..core.vectors import Array, Vector
from .arms import ArmModel

BRAKE_S = 0.03
"""Least time in which damping alone brings a joint to rest."""
BRAKE_TICKS = 4
"""So many ticks are the least time constant that damping gives any motion of the arm."""
UNKNOWN_BRAKE_S = 0.1
"""The time of an arm whose inertia is not known."""


def find_rest_gains(
    arm: ArmModel, q0: Vector, own_damping: Array, limit_nm: Vector, rate_hz: int, *, known: bool
) -> RestGains:
    """Returns how an arm comes to rest.

    A joint of inertia M_ii gets B = M_ii / T. The fastest motion of all joints together then has the largest
    eigenvalue of diag(M) M^-1 / T, which T keeps to the tick rate. Of an arm whose inertia is not known B is
    the damping of its law, `own_damping`, N m s/rad, where that has any.

    Args:
        arm: the arm.
        q0: its start pose, in which the inertia of a chain counts; of a planar arm that of the stretched one.
        own_damping: of its law, per joint, shape (n,).
        limit_nm: its largest torque.
        rate_hz: its tick rate, Hz.
        known: false: its parameters are not those of the arm.
    """
    if arm.chain is None:
        a, b, c = arm.theta[:3].tolist()
        M = np.array([[a + 2.0 * b, c + b], [c + b, c]])
    else:
        M = arm.inertia(np.array(q0))
    inertia = np.diag(M)
    scaled = np.sqrt(inertia)
    fastest = np.linalg.eigvalsh(scaled * np.linalg.inv(M) * scaled[:, None])[-1]
    time_s = max(BRAKE_S, math.ceil(1e3 * BRAKE_TICKS * fastest / rate_hz) * 1e-3)
    if not known:
        time_s = UNKNOWN_BRAKE_S
        inertia = np.where(own_damping > 0.0, own_damping * time_s, inertia)
    deceleration = 0.5 * np.broadcast_to(limit_nm, inertia.shape) / inertia
    return RestGains(tuple((inertia / time_s).tolist()), time_s, tuple(deceleration.tolist()))


def add_credible_box(gains: Gains, arm: ArmModel, limit_nm: Vector, g_m_s2: float) -> Gains:
    """Returns the gains of an adaptive law with a box for its estimates, if it has none of its own.

    What moves an arm can hold it: with T the largest torque of its joints, g the gravitational acceleration
    and l the reach of a link, a first moment is at most T / g and a second one l T / g; masses and second
    moments about an axis are not negative. The first estimate is always in the box.
    """
    T, g = np.max(limit_nm), g_m_s2
    if gains.law is not Law.ADAPTIVE or np.isfinite(gains.low).any() or g == 0.0:
        return gains
    if arm.chain is None:
        T_1, T_2 = np.broadcast_to(limit_nm, 2)
        outer, inner = min(T_1, T_2) / g, T_1 / g
        l1, l2 = arm.lengths_m
        high = np.array([l1 * inner + l2 * outer, l1 * outer, l2 * outer, inner, outer])
        low = np.zeros(5)
    else:
        reach = sum(float(np.linalg.norm(joint.origin_m)) for joint in arm.chain.joints)
        reach += float(np.linalg.norm(arm.chain.tip_m))
        link, first, second = reach / arm.counts.joints, T / g, reach * T / g
        high = np.tile([first / link, *[first] * 3, *[second] * 6], arm.counts.joints)
        low = np.tile([0.0, *[-first] * 3, 0.0, -second, 0.0, -second, -second, 0.0], arm.counts.joints)
    first_estimate = np.broadcast_to(gains.theta_hat0, high.shape)
    return gains._replace(
        low=tuple(np.minimum(low, first_estimate).tolist()),
        high=tuple(np.maximum(high, first_estimate).tolist()),
    )

"""One site as a continuous system: derivatives of arm, control law and estimates, and their Jacobian.

Invariant: plain NumPy on `textbook_arm`, nothing of the compiled core. Where a law has branches (a wall,
the bounds of an estimate) the real part decides, so that a complex step yields the Jacobian of the branch
in force.

Complex step: f'(x) = Im f(x + i h) / h with h = 1e-30, exact to rounding because nothing is subtracted.
Squire and Trapp, "Using complex variables to estimate derivatives of real functions", SIAM Review 40 (1998).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..core.exogenous import SCRIPTED_KINDS, TorqueKind, TorqueSource
from ..core.site_setup import Law, SiteSetup
from ..core.two_link_arm import JOINTS, PARAMETERS
from ..core.vectors import Array
from . import textbook_arm
from .textbook_arm import Numbers, multiply_columns

_STEP = 1e-30
SWITCHING_TOLERANCE = 1e-9
"""A wall this near, m, or an estimate this near to an end of its box, is at its switching point."""

Q = slice(0, JOINTS)
QD = slice(JOINTS, 2 * JOINTS)
ESTIMATE = slice(2 * JOINTS, 2 * JOINTS + PARAMETERS)
STATE_SIZE = ESTIMATE.stop
"""Length of a site's state: q, qd and theta_hat."""
Q_DES = slice(STATE_SIZE, STATE_SIZE + JOINTS)
QD_DES = slice(STATE_SIZE + JOINTS, STATE_SIZE + 2 * JOINTS)
PEER_TORQUE = slice(STATE_SIZE + 2 * JOINTS, STATE_SIZE + 3 * JOINTS)
EXTERNAL_TORQUE = slice(STATE_SIZE + 3 * JOINTS, STATE_SIZE + 4 * JOINTS)
ARGUMENT_COUNT = EXTERNAL_TORQUE.stop
"""Length of the argument of a site's rates: the state, q_id, its derivative, peer torque, external torque."""


class SiteRates(NamedTuple):
    """Rates and torques of a site; as a Jacobian each has ARGUMENT_COUNT columns.

    Attributes:
        qdd: joint accelerations, shape (2, ...), rad/s^2.
        estimate: the derivative of theta_hat, shape (5, ...).
        tau: the torque of the control law, unclamped, shape (2, ...), N m.
        external: the torque of operators and environments that act continuously, shape (2, ...), N m.
        held: the torque of those that are sampled and held, shape (2, ...), N m.
    """

    qdd: Numbers
    estimate: Numbers
    tau: Numbers
    external: Numbers
    held: Numbers


def evaluate_site_rates(site: SiteSetup, x: Numbers) -> SiteRates:
    """Returns the rates of a site, with the actors in force: Eq. (8)-(13), (15), or those of known gravity.

    x is q, qd, theta_hat, q_id, its derivative, peer torque, external torque, shape (ARGUMENT_COUNT, ...).
    """
    q, qd = x[Q], x[QD]
    tau, estimate = _evaluate_law(site, x)
    external = x[EXTERNAL_TORQUE] + _sum_actors(site, q, qd, sampled=False)
    held = _sum_actors(site, q, qd, sampled=True)
    theta = _as_columns(site.theta, q)
    qdd = textbook_arm.joint_acceleration(theta, site.g_m_s2, q, qd, tau + external + held)
    return SiteRates(qdd, estimate, tau, external, held)


def differentiate_site_rates(site: SiteSetup, x: Array) -> SiteRates:
    """Returns the derivatives of the rates at x by a complex step, each of shape (n, ARGUMENT_COUNT)."""
    stepped = x[:, np.newaxis] + 1j * _STEP * np.eye(ARGUMENT_COUNT)
    return SiteRates(*(rate.imag / _STEP for rate in evaluate_site_rates(site, stepped)))


def has_estimate(site: SiteSetup) -> bool:
    """True if the site's state includes an estimate."""
    return site.gains.law is Law.ADAPTIVE


def _as_columns(values: object, like: Numbers) -> Numbers:
    """Returns a vector repeated in as many columns as `like` has."""
    column = np.asarray(values, dtype=np.float64)
    return column.reshape(column.shape + (1,) * (like.ndim - 1)) + np.zeros(like.shape[1:])


def _evaluate_law(site: SiteSetup, x: Numbers) -> tuple[Numbers, Numbers]:
    """Returns the torque of the law, unclamped, and the rate of its estimate."""
    gains, g, q, qd = site.gains, site.g_m_s2, x[Q], x[QD]
    e, ed = q - x[Q_DES], qd - x[QD_DES]
    Kd = _as_columns(gains.Kd, q)
    if not has_estimate(site):
        K, d, k_f = (_as_columns(gain, q) for gain in (gains.K, gains.d, gains.k_f))
        G = textbook_arm.gravity_torque(_as_columns(gains.known, q), g, q)
        return G - K * e - d * qd - Kd * ed + k_f * x[PEER_TORQUE], 0.0 * x[ESTIMATE]
    Lambda, Kp = _as_columns(gains.Lambda, q), _as_columns(gains.Kp, q)
    v, a, r = -Lambda * e, -Lambda * ed, qd + Lambda * e
    tau = textbook_arm.required_torque(x[ESTIMATE], g, q, qd, v, a) - Kp * r - Kd * ed
    Y = textbook_arm.regressor_matrix(g, q, qd, v, a)
    rate = -_as_columns(gains.Gamma, q) * multiply_columns(np.swapaxes(Y, 0, 1), r)
    return tau, np.where(_is_at_bound(site, x[ESTIMATE], rate), 0.0, rate)


def _is_at_bound(site: SiteSetup, estimate: Numbers, rate: Numbers) -> Numbers:
    """True where an estimate is at an end of its box and its rate points outward."""
    low, high = _as_columns(site.gains.low, estimate), _as_columns(site.gains.high, estimate)
    down = (estimate.real <= low + SWITCHING_TOLERANCE) & (rate.real < -SWITCHING_TOLERANCE)
    up = (estimate.real >= high - SWITCHING_TOLERANCE) & (rate.real > SWITCHING_TOLERANCE)
    return down | up


def _sum_actors(site: SiteSetup, q: Numbers, qd: Numbers, *, sampled: bool) -> Numbers:
    """Returns the torque of the actors in force on the arm, shape (2, ...), N m."""
    total: Numbers = 0.0 * q
    for actor in site.actors:
        if actor.sampled == sampled:
            total = total + _actor_torque(site, actor, q, qd)
    return total


def _actor_torque(site: SiteSetup, actor: TorqueSource, q: Numbers, qd: Numbers) -> Numbers:
    """Returns the torque of one actor: an operator's motion has ended, a scripted torque is constant, `a`."""
    if actor.acts in SCRIPTED_KINDS:
        return _as_columns(actor.a, q)
    stiffness, damping = _as_columns(actor.K, q), _as_columns(actor.B, q)
    if actor.acts is TorqueKind.VISCOUS:
        return -damping * qd
    if actor.acts is TorqueKind.HAND:
        torque: Numbers = stiffness * (_as_columns(actor.b, q) - q) - damping * qd
        return torque
    J = textbook_arm.position_jacobian(site.lengths_m, q)
    position = textbook_arm.end_effector_position(site.lengths_m, q)
    velocity = multiply_columns(J, qd)
    if actor.acts is TorqueKind.TASK_HAND:
        force = stiffness * (_as_columns(actor.b, q) - position) - damping * velocity
    else:
        normal = _as_columns(actor.b, q)
        depth = np.sum((_as_columns(actor.a, q) - position) * normal, axis=0)
        push = stiffness[0] * depth - damping[0] * np.sum(velocity * normal, axis=0)
        force = np.where((depth.real > 0.0) & (push.real > 0.0), push, 0.0) * normal
    return multiply_columns(np.swapaxes(J, 0, 1), force)


def describe_switching_points(site: SiteSetup, x: Array) -> Iterator[str]:
    """Yields the switching points at x, shape (ARGUMENT_COUNT,), where the Jacobian is one-sided."""
    for n, actor in enumerate(actor for actor in site.actors if actor.acts is TorqueKind.WALL):
        position = textbook_arm.end_effector_position(site.lengths_m, x[Q])
        depth_m = float((np.array(actor.a) - position) @ np.array(actor.b))
        if abs(depth_m) < SWITCHING_TOLERANCE:
            yield f"{site.name} rests exactly on the surface of its wall {n + 1}: it counts as not touching"
    if has_estimate(site):
        rate = evaluate_site_rates(site, x).estimate
        unbounded = site.gains._replace(low=(-np.inf,) * PARAMETERS, high=(np.inf,) * PARAMETERS)
        free_rate = evaluate_site_rates(site._replace(gains=unbounded), x).estimate
        ends = np.stack(np.broadcast_arrays(site.gains.low, site.gains.high, x[ESTIMATE])[:2])
        near = (np.abs(ends - x[ESTIMATE]) < SWITCHING_TOLERANCE).any(axis=0)
        near &= np.abs(rate) <= SWITCHING_TOLERANCE
        near &= ~_is_at_bound(site, x[ESTIMATE], free_rate) & (np.asarray(site.gains.Gamma) > 0)
        for p in np.flatnonzero(near):
            yield f"theta{p + 1} of {site.name} rests exactly on the edge of its box: it counts as free"

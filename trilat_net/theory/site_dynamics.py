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

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.site_setup import Law, SiteSetup
from ..core.two_link_arm import JOINTS, PARAMETERS
from ..core.vectors import Array
from . import textbook_arm
from .textbook_arm import Numbers, multiply_columns

_STEP = 1e-30
SWITCHING_TOLERANCE = 1e-9
"""A wall that is so near, m, or an estimate so near to an end of its box, is on the edge."""

Q = slice(0, JOINTS)
QD = slice(JOINTS, 2 * JOINTS)
ESTIMATE = slice(2 * JOINTS, 2 * JOINTS + PARAMETERS)
STATE_SIZE = ESTIMATE.stop
"""How many numbers the state of a site has: q, qd and theta_hat."""
Q_DES = slice(STATE_SIZE, STATE_SIZE + JOINTS)
QD_DES = slice(STATE_SIZE + JOINTS, STATE_SIZE + 2 * JOINTS)
PEER_TORQUE = slice(STATE_SIZE + 2 * JOINTS, STATE_SIZE + 3 * JOINTS)
EXTERNAL_TORQUE = slice(STATE_SIZE + 3 * JOINTS, STATE_SIZE + 4 * JOINTS)
ARGUMENT_COUNT = EXTERNAL_TORQUE.stop
"""How many numbers `rates` depends on: the state, q_id, its derivative, felt, and the push of a hand."""


class SiteRates(NamedTuple):
    """What follows from a site's state and inputs; as a Jacobian each has ARGUMENTS columns.

    Attributes:
        qdd: joint accelerations, shape (2, ...), rad/s^2.
        estimate: the derivative of theta_hat, shape (5, ...).
        tau: the torque of the law, unclamped, shape (2, ...), N m.
        acted: the torque of hands and environments that act at every instant, and the push, shape (2, ...).
        held: the torque of those that are sampled and held, shape (2, ...), N m.
    """

    qdd: Numbers
    estimate: Numbers
    tau: Numbers
    acted: Numbers
    held: Numbers


def evaluate_site_rates(site: SiteSetup, x: Numbers) -> SiteRates:
    """Returns the rates of a site: Eq. (8)-(13), (15), or those of the laws that know gravity.

    Args:
        site: what it is built from; its actors are those in force.
        x: q, qd, theta_hat, q_id, its derivative, felt, push: shape (ARGUMENTS, ...).
    """
    q, qd = x[Q], x[QD]
    tau, estimate = _law(site, x)
    acted = x[EXTERNAL_TORQUE] + _torque_of(site, q, qd, sampled=False)
    held = _torque_of(site, q, qd, sampled=True)
    theta = _column(site.theta, q)
    qdd = textbook_arm.joint_acceleration(theta, site.g_m_s2, q, qd, tau + acted + held)
    return SiteRates(qdd, estimate, tau, acted, held)


def differentiate_site_rates(site: SiteSetup, x: Array) -> SiteRates:
    """Returns the derivatives of the rates by a complex step, each of shape (n, ARGUMENTS).

    Args:
        site: what it is built from.
        x: where, shape (ARGUMENTS,).
    """
    stepped = x[:, np.newaxis] + 1j * _STEP * np.eye(ARGUMENT_COUNT)
    return SiteRates(*(rate.imag / _STEP for rate in evaluate_site_rates(site, stepped)))


def has_estimate(site: SiteSetup) -> bool:
    """True where the site's state has an estimate in it."""
    return site.gains.law is Law.ADAPTIVE


def _column(values: object, like: Numbers) -> Numbers:
    """Returns numbers with as many columns as a vector has."""
    column = np.asarray(values, dtype=np.float64)
    return column.reshape(column.shape + (1,) * (like.ndim - 1)) + np.zeros(like.shape[1:])


def _law(site: SiteSetup, x: Numbers) -> tuple[Numbers, Numbers]:
    """Returns the torque of the law, unclamped, and the rate of its estimate."""
    gains, g, q, qd = site.gains, site.g_m_s2, x[Q], x[QD]
    e, ed = q - x[Q_DES], qd - x[QD_DES]
    Kd = _column(gains.Kd, q)
    if not has_estimate(site):
        K, d, k_f = (_column(gain, q) for gain in (gains.K, gains.d, gains.k_f))
        G = textbook_arm.gravity_torque(_column(gains.known, q), g, q)
        return G - K * e - d * qd - Kd * ed + k_f * x[PEER_TORQUE], 0.0 * x[ESTIMATE]
    Lambda, Kp = _column(gains.Lambda, q), _column(gains.Kp, q)
    v, a, r = -Lambda * e, -Lambda * ed, qd + Lambda * e
    tau = textbook_arm.required_torque(x[ESTIMATE], g, q, qd, v, a) - Kp * r - Kd * ed
    Y = textbook_arm.regressor_matrix(g, q, qd, v, a)
    rate = -_column(gains.Gamma, q) * multiply_columns(np.swapaxes(Y, 0, 1), r)
    return tau, np.where(_frozen(site, x[ESTIMATE], rate), 0.0, rate)


def _frozen(site: SiteSetup, estimate: Numbers, rate: Numbers) -> Numbers:
    """True where an estimate is at an end of its box and would leave it."""
    low, high = _column(site.gains.low, estimate), _column(site.gains.high, estimate)
    down = (estimate.real <= low + SWITCHING_TOLERANCE) & (rate.real < -SWITCHING_TOLERANCE)
    up = (estimate.real >= high - SWITCHING_TOLERANCE) & (rate.real > SWITCHING_TOLERANCE)
    return down | up


def _torque_of(site: SiteSetup, q: Numbers, qd: Numbers, *, sampled: bool) -> Numbers:
    """Returns what the actors in force do to the arm, shape (2, ...), N m."""
    total: Numbers = 0.0 * q
    for actor in site.actors:
        if actor.sampled == sampled:
            total = total + _torque(site, actor, q, qd)
    return total


def _torque(site: SiteSetup, actor: TorqueSource, q: Numbers, qd: Numbers) -> Numbers:
    """Returns the torque of one actor; a hand has moved, a scripted torque is what its `a` says."""
    if actor.acts in (TorqueKind.PULSE, TorqueKind.RECORDED):
        return _column(actor.a, q)
    stiffness, damping = _column(actor.K, q), _column(actor.B, q)
    if actor.acts is TorqueKind.VISCOUS:
        return -damping * qd
    if actor.acts is TorqueKind.HAND:
        hand: Numbers = stiffness * (_column(actor.b, q) - q) - damping * qd
        return hand
    J = textbook_arm.position_jacobian(site.lengths_m, q)
    at, speed = textbook_arm.end_effector_position(site.lengths_m, q), multiply_columns(J, qd)
    if actor.acts is TorqueKind.TASK_HAND:
        force = stiffness * (_column(actor.b, q) - at) - damping * speed
    else:
        normal = _column(actor.b, q)
        depth = np.sum((_column(actor.a, q) - at) * normal, axis=0)
        push = stiffness[0] * depth - damping[0] * np.sum(speed * normal, axis=0)
        force = np.where((depth.real > 0.0) & (push.real > 0.0), push, 0.0) * normal
    return multiply_columns(np.swapaxes(J, 0, 1), force)


def describe_switching_points(site: SiteSetup, x: Array) -> Iterator[str]:
    """Yields what a site is exactly on the edge of at a state: there its Jacobian is that of one side only.

    Args:
        site: what it is built from.
        x: where, shape (ARGUMENTS,).
    """
    for n, actor in enumerate(actor for actor in site.actors if actor.acts is TorqueKind.WALL):
        at = textbook_arm.end_effector_position(site.lengths_m, x[Q])
        depth_m = float((np.array(actor.a) - at) @ np.array(actor.b))
        if abs(depth_m) < SWITCHING_TOLERANCE:
            yield f"{site.name} rests exactly on the surface of its wall {n + 1}: it counts as not touching"
    if has_estimate(site):
        rate = evaluate_site_rates(site, x).estimate
        ends = np.stack([site.gains.low, site.gains.high])
        near = (np.abs(ends - x[ESTIMATE]) < SWITCHING_TOLERANCE).any(axis=0) & (
            np.abs(rate) <= SWITCHING_TOLERANCE
        )
        pressed = near & ~_frozen(site, x[ESTIMATE], _free_rate(site, x)) & (np.asarray(site.gains.Gamma) > 0)
        for p in np.flatnonzero(pressed):
            yield f"theta{p + 1} of {site.name} rests exactly on the edge of its box: it counts as free"


def _free_rate(site: SiteSetup, x: Array) -> Numbers:
    """Returns the rate that the estimate would have without its box."""
    gains = site.gains._replace(low=(-np.inf,) * PARAMETERS, high=(np.inf,) * PARAMETERS)
    return evaluate_site_rates(site._replace(gains=gains), x).estimate

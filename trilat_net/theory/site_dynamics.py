"""One site as a continuous system: derivatives of arm, control law and estimates, and their
Jacobian.

Invariant: plain NumPy on `textbook_arm`, nothing of the compiled core. Where a law has branches
(a wall, the bounds of an estimate) the real part decides, so that a complex step yields the
Jacobian of the branch in force.

Complex step: f'(x) = Im f(x + i h) / h with h = 1e-30, exact to rounding because nothing is
subtracted. Squire and Trapp, "Using complex variables to estimate derivatives of real
functions", SIAM Review 40 (1998).
"""

from collections.abc import Iterator
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from ..analysis.arm_rows import Numbers, PlacedArm, multiply_columns
from ..core.exogenous import OWN_KINDS, SCRIPTED_KINDS, TorqueKind, TorqueSource
from ..core.site_setup import Law, SiteSetup
from ..core.vectors import Array
from .numeric_law import NumericLaw
from .textbook_arm import Following, PlacedChain, follow_in_task, follow_joints, share_pose

COMPLEX_STEP = 1e-30
SWITCHING_TOLERANCE = 1e-9
"""A wall this near, m, or an estimate this near to an end of its box, is at its switching
point.
"""


class ArgumentLayout:
    """Where the parts of a site's argument stand, in their order: state, reference, torques.

    Args:
        joints: length of each part but the estimate and what comes from peers.
        parameters: length of the estimate.
        shared: length of what comes from peers, of each of its three parts; 0: as many as there
            are joints.
        peers: of a law of one's own, which sees each peer by itself too, how many there are.

    Attributes:
        q, qd: joint positions, and velocities.
        estimate: the estimate, theta_hat. q_des, qd_des: the reference, q_id, in task space a
        pose, see `textbook_arm`; and its derivative.
        peer_torque: the exogenous torque of the peers; in task space their force.
        external_torque: torque that an operator adds ON the joints.
        inputs: what comes from peers: the reference, its derivative, and their torque; then
            that of each.
        coordinates: length of each part that comes from peers.
        states: length of a site's state: q, qd and theta_hat.
        arguments: length of the whole argument.
    """

    def __init__(self, joints: int, parameters: int, shared: int = 0, peers: int = 0) -> None:
        self.joints = joints
        self.parameters = parameters
        self.shared = shared
        self.peers = peers
        self.coordinates = m = shared or joints
        lengths = (joints, joints, parameters, m, m, m, 3 * m * peers, joints)
        parts = [slice(*ends) for ends in pairwise(accumulate(lengths, initial=0))]
        self.q, self.qd, self.estimate, self.q_des, self.qd_des, self.peer_torque, *_ = parts
        self.external_torque = parts[-1]
        self.states = self.estimate.stop
        self.arguments = self.external_torque.stop
        self.inputs = slice(self.states, self.external_torque.start)

    def of_peer(self, place: int) -> slice:
        """What came from one peer: its x, the velocity, and its exogenous torque."""
        first = self.peer_torque.stop + 3 * self.coordinates * place
        return slice(first, first + 3 * self.coordinates)


def lay_out_arguments(site: SiteSetup) -> ArgumentLayout:
    """Returns the layout of the arguments of a site's rates; memory of a law of one's own is
    its estimate.
    """
    if isinstance(site.own, NumericLaw):
        return ArgumentLayout(site.layout.joints, len(site.own.memory), 0, len(site.links))
    return ArgumentLayout(site.layout.joints, site.layout.parameters, site.layout.shared)


def place_arm(site: SiteSetup, q: Numbers) -> PlacedArm | PlacedChain:
    """Returns the arm of a site in the poses q, shape (n, ...)."""
    return (
        PlacedArm(site.g_m_s2, site.lengths_m, q)
        if site.chain is None
        else PlacedChain(site.chain, q)
    )


class SiteRates(NamedTuple):
    """Rates and torques of a site; as a Jacobian each has a column per entry of the argument.

    Attributes:
        qdd: joint accelerations, shape (n, ...), rad/s^2.
        estimate: the derivative of theta_hat, shape (P, ...).
        tau: the torque of the control law, unclamped, shape (n, ...), N m.
        external: the torque of operators and environments that act continuously, shape (n,
            ...), N m.
        held: the torque of those that are sampled and held, shape (n, ...), N m.
        x: what peers get of the pose, shape (m, ...): the angles, or place and orientation, see
            `textbook_arm.Following`.
        xd: its velocity.
        reflected: the external and held torque as peers get it, a force in task space.
    """

    qdd: Numbers
    estimate: Numbers
    tau: Numbers
    external: Numbers
    held: Numbers
    x: Numbers
    xd: Numbers
    reflected: Numbers


def follow_peers(site: SiteSetup, arm: PlacedArm | PlacedChain, x: Numbers) -> Following:
    """Returns how a site follows what came from its peers, in its space."""
    at = lay_out_arguments(site)
    Lambda = _as_columns(site.gains.Lambda, x)
    motion = (Lambda, x[at.q], x[at.qd], x[at.q_des], x[at.qd_des])
    if site.layout.task and isinstance(arm, PlacedChain):
        return follow_in_task(site, arm, *motion)
    return follow_joints(*motion)


def share_own_pose(site: SiteSetup, q: Numbers) -> Numbers:
    """Returns what a site shares of its poses q, shape (n, ...): them, or its end effector's."""
    arm = place_arm(site, q)
    if isinstance(arm, PlacedChain) and site.chain is not None and site.chain.task is not None:
        return share_pose(site.chain.task, arm)
    return q


def evaluate_site_rates(site: SiteSetup, x: Numbers) -> SiteRates:
    """Returns the rates of a site, with the actors in force: Eq. (8)-(13), (15), or those of
    known gravity.

    x is laid out as `lay_out_arguments` says, shape (arguments, ...).
    """
    at = lay_out_arguments(site)
    arm = place_arm(site, x[at.q])
    qd = x[at.qd]
    following = follow_peers(site, arm, x)
    external = x[at.external_torque] + _sum_actors(site, arm, x, sampled=False)
    held = _sum_actors(site, arm, x, sampled=True)
    if isinstance(site.own, NumericLaw):
        tau, estimate = site.own.evaluate(
            np.concatenate([x[: at.inputs.stop], external + held])
        )
    else:
        tau, estimate = _evaluate_law(site, arm, following, x)
    qdd = arm.joint_acceleration(_as_columns(site.theta, qd), qd, tau + external + held)
    reflected = following.from_joints(external + held)
    return SiteRates(
        qdd=qdd,
        estimate=estimate,
        tau=tau,
        external=external,
        held=held,
        x=following.x,
        xd=following.xd,
        reflected=reflected,
    )


def differentiate_site_rates(site: SiteSetup, x: Array) -> SiteRates:
    """Returns the derivatives of the rates at x by a complex step, a column per entry of x
    each.
    """
    stepped = x[:, np.newaxis] + 1j * COMPLEX_STEP * np.eye(len(x))
    return SiteRates(*(rate.imag / COMPLEX_STEP for rate in evaluate_site_rates(site, stepped)))


def has_estimate(site: SiteSetup) -> bool:
    """True if the site's state includes an estimate, or the memory of a law of one's own."""
    if isinstance(site.own, NumericLaw):
        return len(site.own.memory) > 0
    return site.gains.law is Law.ADAPTIVE


def _as_columns(values: object, like: Numbers) -> Numbers:
    column = np.asarray(values, dtype=np.float64)
    return column.reshape(column.shape + (1,) * (like.ndim - 1)) + np.zeros(like.shape[1:])


def _evaluate_law(
    site: SiteSetup, arm: PlacedArm | PlacedChain, following: Following, x: Numbers
) -> tuple[Numbers, Numbers]:
    at = lay_out_arguments(site)
    gains = site.gains
    q = x[at.q]
    qd = x[at.qd]
    estimate = x[at.estimate]
    _, _, e, ed, v, a, *_ = following
    pull = _as_columns(gains.Kd, q) * ed
    if not has_estimate(site):
        K, d, k_f = (_as_columns(gain, q) for gain in (gains.K, gains.d, gains.k_f))
        G = arm.gravity_torque(_as_columns(np.broadcast_to(gains.known, site.theta.shape), q))
        pull = pull + K * e - k_f * x[at.peer_torque]
        return G - d * qd - following.to_joints(pull), 0.0 * estimate
    r = qd - v
    if gains.absolute:
        Lambda = _as_columns(gains.Lambda, q)
        v = -Lambda * q
        a = -Lambda * qd
        r = qd + Lambda * q
        led = _as_columns(gains.Kp, q) * (x[at.qd_des] + Lambda * x[at.q_des])
        pull = pull - led
    tau = (
        arm.required_torque(estimate, qd, v, a)
        - _as_columns(gains.Kp, q) * r
        - following.to_joints(pull)
    )
    rho, width, known = (
        _as_columns(gain, q) for gain in (gains.rho, gains.width, gains.friction)
    )
    tau = (
        tau - rho * r / np.sqrt(r * r + width * width) - (1.0 - known) * arm.friction_torque(v)
    )
    Y = arm.regressor_matrix(qd, v, a)
    rate = -_as_columns(gains.Gamma, q) * multiply_columns(np.swapaxes(Y, 0, 1), r)
    return tau, np.where(_is_at_bound(site, estimate, rate), 0.0, rate)


def _is_at_bound(site: SiteSetup, estimate: Numbers, rate: Numbers) -> Numbers:
    low = _as_columns(site.gains.low, estimate)
    high = _as_columns(site.gains.high, estimate)
    down = (estimate.real <= low + SWITCHING_TOLERANCE) & (rate.real < -SWITCHING_TOLERANCE)
    up = (estimate.real >= high - SWITCHING_TOLERANCE) & (rate.real > SWITCHING_TOLERANCE)
    return down | up


def _sum_actors(
    site: SiteSetup, arm: PlacedArm | PlacedChain, x: Numbers, *, sampled: bool
) -> Numbers:
    """Returns the torque of the actors in force on the arm, shape (n, ...), N m."""
    at = lay_out_arguments(site)
    q = x[at.q]
    qd = x[at.qd]
    total: Numbers = 0.0 * q
    for actor in site.actors:
        if actor.sampled == sampled:
            total = total + _actor_torque(arm, actor, q, qd)
    return total


def _actor_torque(
    arm: PlacedArm | PlacedChain, actor: TorqueSource, q: Numbers, qd: Numbers
) -> Numbers:
    """Returns the torque of one actor: an operator's motion has ended, a scripted torque is
    constant, `a`.

    One of an own kind stays as it is at `move_end_s`.
    """
    if actor.acts in SCRIPTED_KINDS:
        return _as_columns(actor.a, q)
    stiffness = _as_columns(actor.K, q)
    damping = _as_columns(actor.B, q)
    if actor.acts is TorqueKind.VISCOUS:
        return -damping * qd
    if actor.acts is TorqueKind.HAND:
        torque: Numbers = stiffness * (_as_columns(actor.b, q) - q) - damping * qd
        return torque
    J = arm.position_jacobian()
    position = arm.end_effector_position()
    velocity = multiply_columns(J, qd)
    if actor.acts in OWN_KINDS:
        at_tip = actor.acts is TorqueKind.OWN_TIP
        seen = (
            np.moveaxis(one, 0, -1) for one in ((position, velocity) if at_tip else (q, qd))
        )
        effort = np.moveaxis(actor.model.effort(np.array(actor.move_end_s), *seen), -1, 0)
        return multiply_columns(np.swapaxes(J, 0, 1), effort) if at_tip else effort
    if actor.acts is TorqueKind.TASK_HAND:
        force = stiffness * (_as_columns(actor.b, q) - position) - damping * velocity
    else:
        normal = _as_columns(actor.b, q)
        depth = np.sum((_as_columns(actor.a, q) - position) * normal, axis=0)
        push = stiffness[0] * depth - damping[0] * np.sum(velocity * normal, axis=0)
        force = np.where((depth.real > 0.0) & (push.real > 0.0), push, 0.0) * normal
    return multiply_columns(np.swapaxes(J, 0, 1), force)


def describe_switching_points(site: SiteSetup, x: Array) -> Iterator[str]:
    """Yields the switching points at an argument x where the Jacobian is one-sided."""
    at = lay_out_arguments(site)
    position = place_arm(site, x[at.q]).end_effector_position()
    for n, actor in enumerate(actor for actor in site.actors if actor.acts is TorqueKind.WALL):
        depth_m = float((np.array(actor.a) - position) @ np.array(actor.b))
        if abs(depth_m) < SWITCHING_TOLERANCE:
            yield f"{site.name} rests exactly on the surface of its wall {n + 1}: it counts as not touching"
    if site.gains.law is Law.ADAPTIVE:
        rate = evaluate_site_rates(site, x).estimate
        unbounded = site.gains._replace(low=-np.inf, high=np.inf)
        free_rate = evaluate_site_rates(site._replace(gains=unbounded), x).estimate
        estimate = x[at.estimate]
        ends = np.stack(
            [np.broadcast_to(end, estimate.shape) for end in (site.gains.low, site.gains.high)]
        )
        near = (np.abs(ends - estimate) < SWITCHING_TOLERANCE).any(axis=0)
        near &= np.abs(rate) <= SWITCHING_TOLERANCE
        near &= ~_is_at_bound(site, estimate, free_rate) & (np.asarray(site.gains.Gamma) > 0)
        for p in np.flatnonzero(near):
            yield f"theta{p + 1} of {site.name} rests exactly on the edge of its box: it counts as free"

"""Computes rates of change of the states of an arm and its controller, and their derivatives.

The linear analysis needs the derivatives of the rates of change with respect to the state: the
joint angles, the joint velocities, and the parameter estimates of the control law. The
derivatives are computed with a complex step: the derivative of a function f at x is Im f(x + i
h) / h, where i is the imaginary unit and h = 1e-30. Since the formula contains no subtraction,
the result is exact up to rounding (Squire and Trapp, "Using complex variables to estimate
derivatives of real functions", SIAM Review 40, 1998).

Invariant:
    - All arithmetic is plain NumPy on `textbook_arm`, without the compiled simulation kernel.
      The two implementations thus verify each other.
    - If a law has branches, for example at a wall or at the bounds of an estimate, the real
      part of the argument selects the branch whose derivatives are returned.
"""

from collections.abc import Iterator
from functools import cache
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import SCRIPTED_KINDS, Array, SiteSetup, TorqueKind, TorqueSource
from ..arm_rows import Numbers, PlacedArm, multiply_columns
from .numeric_law import NumericLaw
from .textbook_arm import Following, PlacedChain, share_pose

COMPLEX_STEP = 1e-30
"""Imaginary step h of the derivatives."""
SWITCHING_TOLERANCE = 1e-9
"""Largest distance from a switching point: from a wall, in m, or from the limit of an estimate.
"""


class ArgumentLayout:
    """Positions of quantities in the argument vector of one arm's equations of motion.

    The vector contains the state of the arm, the inputs from other arms, and the torque of its
    operator. Numerical derivatives are taken with respect to this vector.

    Args:
        joints: Number of joints n, the length of q, qd and the external torque.
        parameters: Length of the estimate.
        shared: Length m of each quantity that comes from peers. If 0, m is the number of
            joints.
        peers: Number of peers whose samples an imported law also reads individually.

    Attributes:
        q, qd: Joint angles and velocities.
        estimate: The estimate theta_hat, or the memory of an imported law.
        q_des, qd_des: The reference q_id and its derivative. In task space the reference is a
            pose (see `textbook_arm`).
        peer_torque: External torque of the peers, or their force in task space.
        external_torque: Torque that an operator adds at the joints.
        inputs: All values from peers: the reference, its derivative, their torque, and then the
            samples of the individual peers.
        coordinates: Length m of each quantity that comes from peers.
        states: Length of the site's state: q, qd and theta_hat.
        arguments: Length of the complete vector.
    """

    def __init__(
        self,
        joints: int,
        parameters: int,
        shared: int = 0,
        peers: int = 0,
    ) -> None:
        self.joints = joints
        self.parameters = parameters
        self.shared = shared
        self.peers = peers
        self.coordinates = m = shared or joints
        # in the order of the attributes; index 6 contains the samples of the individual peers
        lengths = (joints, joints, parameters, m, m, m, 3 * m * peers, joints)
        ends = accumulate(lengths, initial=0)
        slices = [slice(start, stop) for start, stop in pairwise(ends)]
        self.q = slices[0]
        self.qd = slices[1]
        self.estimate = slices[2]
        self.q_des = slices[3]
        self.qd_des = slices[4]
        self.peer_torque = slices[5]
        self.external_torque = slices[7]

        self.states = self.estimate.stop
        self.arguments = self.external_torque.stop
        self.inputs = slice(self.states, self.external_torque.start)

    def peer_sample(self, index: int) -> slice:
        """Returns the slice of the argument vector that contains the values from one peer.

        The values are the pose of the peer, the velocity of the pose, and the external torque,
        in this order.

        Args:
            index: Index of the peer, not counting the site itself.
        """
        length = 3 * self.coordinates
        first = self.peer_torque.stop + length * index
        return slice(first, first + length)

    @classmethod
    def of_site(cls, site: SiteSetup) -> "ArgumentLayout":
        """Returns where each state and input of a site is stored in one vector.

        The vector is the argument of the functions that compute how fast the states change. For
        a control law written by a user, the values that the law stores take the place of the
        parameter estimates.

        Args:
            site: Setup of the site.
        """
        layout = site.layout
        if isinstance(site.law_factory, NumericLaw):
            memories = len(site.law_factory.memory)
            return _make_layout(layout.joints, memories, 0, len(site.links))
        return _make_layout(layout.joints, layout.parameters, layout.shared, 0)


# An analysis evaluates the same few sites hundreds of times.
_make_layout = cache(ArgumentLayout)


def place_arm(site: SiteSetup, q: Numbers) -> PlacedArm | PlacedChain:
    """Returns the model of an arm at given poses, with functions of the angles precomputed.

    Its methods, such as the one for the inertia matrix, therefore need no joint angles.

    Args:
        site: Setup of the site.
        q: Joint angles, shape (n, ...), in rad.
    """
    if site.chain is None:
        return PlacedArm(site.g_m_s2, site.lengths_m, q)
    return PlacedChain(site.chain, q)


class SiteRates(NamedTuple):
    """Rates of change of an arm's states, along with its torques and the values that it sends.

    The trailing axes "..." enumerate several evaluations. In derivatives, they have one column
    per entry of the argument vector.

    Attributes:
        qdd: Joint accelerations, shape (n, ...), in rad/s^2.
        estimate: Time derivative of the parameter estimates theta_hat, shape (P, ...).
        tau: Torque of the control law before it is limited, shape (n, ...), in N m.
        external: Torque of operators and environments that act continuously, shape (n, ...), in
            N m.
        held: Torque of operators and environments that act once per tick and hold their torque,
            shape (n, ...), in N m.
        x: Pose that peers receive, shape (m, ...): joint angles, or position and orientation,
            see `textbook_arm.Following`.
        xd: Velocity of x.
        reflected: Sum of external and held torque, as peers receive it. In task space a force.
    """

    qdd: Numbers
    estimate: Numbers
    tau: Numbers
    external: Numbers
    held: Numbers
    x: Numbers
    xd: Numbers
    reflected: Numbers

    @classmethod
    def evaluate(cls, site: SiteSetup, x: Numbers) -> "SiteRates":
        """Computes how fast the states of a site change, and the torques that act on its arm.

        The states are joint angles, joint velocities and parameter estimates. Operators and
        environments, such as walls, act as defined in the setup. The equations are those of the
        site's control law and of the dynamics of its arm (docs/reference/laws.md).

        Args:
            site: Setup of the site.
            x: States and inputs in the order of `ArgumentLayout.of_site`, shape (arguments,
                ...).
        """
        layout = ArgumentLayout.of_site(site)
        arm = place_arm(site, x[layout.q])
        qd = x[layout.qd]
        following = _follow(site, arm, x, layout)

        continuous = _sum_actors(site, arm, x, layout, sampled=False)
        external = x[layout.external_torque] + continuous
        held = _sum_actors(site, arm, x, layout, sampled=True)

        if isinstance(site.law_factory, NumericLaw):
            state_and_inputs = x[: layout.inputs.stop]
            law_arguments = np.concatenate([state_and_inputs, external + held])
            tau, estimate_rate = site.law_factory.evaluate(law_arguments)
        elif has_estimate(site):
            tau, estimate_rate = _evaluate_adaptive_law(site, arm, following, x, layout)
        else:
            tau = _evaluate_known_gravity_law(site, arm, following, x, layout)
            estimate_rate = 0.0 * x[layout.estimate]

        torque = tau + external + held
        theta = _as_columns(site.theta, qd)
        qdd = arm.joint_acceleration(theta, qd, torque)
        return cls(
            qdd=qdd,
            estimate=estimate_rate,
            tau=tau,
            external=external,
            held=held,
            x=following.x,
            xd=following.xd,
            reflected=following.from_joints(external + held),
        )

    @classmethod
    def differentiate(cls, site: SiteSetup, x: Array) -> "SiteRates":
        """Computes derivatives of a site's rates of change, for the linear model of its arm.

        The rates are differentiated with respect to each of the site's states and inputs with a
        complex step, which is exact up to rounding.

        Args:
            site: Setup of the site.
            x: States and inputs in the order of `ArgumentLayout.of_site`, shape (arguments,).

        Returns:
            The derivatives of each rate, torque and output, with one column per entry of x.
        """
        steps = 1j * COMPLEX_STEP * np.eye(len(x))
        stepped = x[:, np.newaxis] + steps
        rates = SiteRates.evaluate(site, stepped)
        derivatives = [rate.imag / COMPLEX_STEP for rate in rates]
        return cls(*derivatives)


def compute_following(site: SiteSetup, arm: PlacedArm | PlacedChain, x: Numbers) -> Following:
    """Computes the errors and the reference motion with which a site follows other sites.

    Either its joints or its end effector follow the desired motion that is part of x.

    Args:
        site: Setup of the site.
        arm: Model of the arm in the pose of x.
        x: States and inputs of the site, in the order of `ArgumentLayout`, shape (arguments,
            ...).

    Returns:
        The errors of position and velocity, the reference velocity and acceleration of the
        joints, and the related Jacobian.
    """
    return _follow(site, arm, x, ArgumentLayout.of_site(site))


def _follow(
    site: SiteSetup, arm: PlacedArm | PlacedChain, x: Numbers, layout: ArgumentLayout
) -> Following:
    """Computes errors and reference motion, see `compute_following`, with a given layout."""
    Lambda = _as_columns(site.gains.Lambda, x)
    q = x[layout.q]
    qd = x[layout.qd]
    reference = x[layout.q_des]
    reference_rate = x[layout.qd_des]

    has_task = site.chain is not None and site.chain.task is not None
    if has_task and isinstance(arm, PlacedChain):
        return Following.in_task(
            site=site,
            arm=arm,
            Lambda=Lambda,
            q=q,
            qd=qd,
            x_des=reference,
            xd_des=reference_rate,
        )
    return Following.in_joints(
        Lambda=Lambda,
        q=q,
        qd=qd,
        q_des=reference,
        qd_des=reference_rate,
    )


def compute_shared_pose(site: SiteSetup, q: Numbers) -> Numbers:
    """Returns the pose that an arm sends to the other arms.

    The pose of an arm is given by its joint angles, or in task space by its end effector.

    Args:
        site: Setup of the site.
        q: Joint angles, shape (n, ...).
    """
    arm = place_arm(site, q)
    if isinstance(arm, PlacedChain) and site.chain is not None and site.chain.task is not None:
        return share_pose(site.chain.task, arm)
    return q


def compute_reflected_torque(site: SiteSetup, x: Numbers) -> Numbers:
    """Computes the torque of operators and walls that an arm sends to the other arms.

    This torque lets a user feel what another arm touches. The result equals `reflected` in the
    result of `SiteRates.evaluate`, but the other quantities are not computed.

    Args:
        site: Setup of the site.
        x: States and inputs in the order of `ArgumentLayout.of_site`, shape (arguments, ...).
    """
    layout = ArgumentLayout.of_site(site)
    arm = place_arm(site, x[layout.q])
    following = _follow(site, arm, x, layout)
    continuous = _sum_actors(site, arm, x, layout, sampled=False)
    external = x[layout.external_torque] + continuous
    held = _sum_actors(site, arm, x, layout, sampled=True)
    return following.from_joints(external + held)


def has_estimate(site: SiteSetup) -> bool:
    """Returns True if the control law of a site has a state that changes from tick to tick.

    This state consists of the parameter estimates of the adaptive law, or of the memory of a
    law written by a user. It belongs to the site's state, in addition to angles and velocities.

    Args:
        site: Setup of the site.
    """
    if isinstance(site.law_factory, NumericLaw):
        return len(site.law_factory.memory) > 0
    return site.gains.is_adaptive


def _as_columns(values: object, like: Numbers) -> Numbers:
    """Adds axes to constants such as gains, so that NumPy repeats them for all columns.

    Args:
        values: The constants, of any shape.
        like: Array whose trailing axes are the columns.

    Returns:
        The constants, with the trailing axes of `like` behind their own axes.
    """
    column = np.asarray(values, dtype=np.float64)
    columns = like.shape[1:]
    column_axes = (1,) * len(columns)
    reshaped = column.reshape(column.shape + column_axes)
    return reshaped + np.zeros(columns)


def _evaluate_known_gravity_law(
    site: SiteSetup,
    arm: PlacedArm | PlacedChain,
    following: Following,
    x: Numbers,
    layout: ArgumentLayout,
) -> Numbers:
    """Returns the torque of a law with known gravity, shape (n, ...), in N m.

    The law is tau = G(q) - d qd - J' (Kd ed + K e - k_f tau_peers), with J = 1 in joint space.
    """
    gains = site.gains
    q = x[layout.q]
    qd = x[layout.qd]
    K = _as_columns(gains.K, q)
    Kd = _as_columns(gains.Kd, q)
    d = _as_columns(gains.d, q)
    k_f = _as_columns(gains.k_f, q)

    known_parameters = np.broadcast_to(gains.known, site.theta.shape)
    theta = _as_columns(known_parameters, q)
    G = arm.gravity_torque(theta)

    error_damper = Kd * following.ed
    spring = K * following.e
    reflected = k_f * x[layout.peer_torque]
    pull = error_damper + spring - reflected
    pull_torque = following.to_joints(pull)

    damper = d * qd
    torque: Array = G - damper - pull_torque
    return torque


def _evaluate_adaptive_law(
    site: SiteSetup,
    arm: PlacedArm | PlacedChain,
    following: Following,
    x: Numbers,
    layout: ArgumentLayout,
) -> tuple[Numbers, Numbers]:
    """Returns the torque of an adaptive law, in N m, and the rate of its estimate.

    With the reference velocity v and acceleration a, r = qd - v, and the projection of the rate
    that keeps the estimate in its box, the law is Eq. (10)-(13):

        tau = Y(q, qd, v, a) theta_hat - Kp r - J' Kd ed - rho r / sqrt(r^2 + w^2)
              - (1 - known) friction(v)
        theta_hat' = -Gamma Y' r
    """
    gains = site.gains
    q = x[layout.q]
    qd = x[layout.qd]
    estimate = x[layout.estimate]
    Kp = _as_columns(gains.Kp, q)
    Kd = _as_columns(gains.Kd, q)
    Gamma = _as_columns(gains.Gamma, q)
    rho = _as_columns(gains.rho, q)
    width = _as_columns(gains.width, q)
    known = _as_columns(gains.friction, q)
    pull = Kd * following.ed
    v = following.v
    a = following.a
    r = qd - v
    if gains.absolute:
        # the sliding variable is absolute: the reference enters through Kp alone
        Lambda = _as_columns(gains.Lambda, q)
        v = -Lambda * q
        a = -Lambda * qd
        r = qd + Lambda * q
        position_part = Lambda * x[layout.q_des]
        reference_r = x[layout.qd_des] + position_part
        pull = pull - Kp * reference_r

    model_torque = arm.required_torque(estimate, qd, v, a)
    damper = Kp * r
    pull_torque = following.to_joints(pull)
    tau = model_torque - damper - pull_torque
    magnitude = np.sqrt(r * r + width * width)
    robust_torque = rho * r / magnitude
    friction = arm.friction_torque(v)
    unknown_friction = (1.0 - known) * friction
    tau = tau - robust_torque - unknown_friction

    Y = arm.regressor_matrix(qd, v, a)
    Y_transposed = np.swapaxes(Y, 0, 1)
    gradient = multiply_columns(Y_transposed, r)
    rate = -Gamma * gradient
    is_blocked = _is_at_bound(site, estimate, rate)
    return tau, np.where(is_blocked, 0.0, rate)


def _is_at_bound(site: SiteSetup, estimate: Numbers, rate: Numbers) -> Numbers:
    """Returns True where a parameter estimate is at its limit and would leave its range.

    The adaptive law then holds the estimate (projection).
    """
    low = _as_columns(site.gains.low, estimate)
    high = _as_columns(site.gains.high, estimate)
    is_low = estimate.real <= low + SWITCHING_TOLERANCE
    is_high = estimate.real >= high - SWITCHING_TOLERANCE
    falls = rate.real < -SWITCHING_TOLERANCE
    rises = rate.real > SWITCHING_TOLERANCE
    leaves_low = is_low & falls
    leaves_high = is_high & rises
    return leaves_low | leaves_high


def _sum_actors(
    site: SiteSetup,
    arm: PlacedArm | PlacedChain,
    x: Numbers,
    layout: ArgumentLayout,
    *,
    sampled: bool,
) -> Numbers:
    """Returns the total torque with which operators and walls push on an arm.

    Args:
        site: Setup of the site, with the operators and environments in force.
        arm: The arm in the pose of x.
        x: Arguments of the site's rates, shape (arguments, ...).
        layout: Positions of the angles and velocities in x.
        sampled: True for the sources that act once per tick, False for the sources that act
            continuously.

    Returns:
        Torque on the joints, shape (n, ...), in N m.
    """
    q = x[layout.q]
    qd = x[layout.qd]
    total: Numbers = 0.0 * q
    for actor in site.actors:
        if actor.sampled == sampled:
            total = total + _evaluate_actor(arm, actor, q, qd)
    return total


def _evaluate_actor(
    arm: PlacedArm | PlacedChain,
    actor: TorqueSource,
    q: Numbers,
    qd: Numbers,
) -> Numbers:
    """Returns the torque of one operator or environment in force, shape (n, ...), in N m.

    An operator's motion has ended, and a scripted torque has the constant value `a`. A model
    that a user wrote keeps the parameters that it has at the time `move_end_s`.
    """
    if actor.kind in SCRIPTED_KINDS:
        return _as_columns(actor.a, q)
    stiffness = _as_columns(actor.K, q)
    damping = _as_columns(actor.B, q)
    if actor.kind is TorqueKind.VISCOUS:
        return -damping * qd
    if actor.kind is TorqueKind.HAND:
        target = _as_columns(actor.b, q)
        torque: Numbers = stiffness * (target - q) - damping * qd
        return torque
    if actor.kind is TorqueKind.OWN_JOINTS:
        return _evaluate_model(actor, q, qd)

    # the other actors are at the end effector
    J = arm.position_jacobian()
    position = arm.end_effector_position()
    velocity = multiply_columns(J, qd)
    if actor.kind is TorqueKind.OWN_TIP:
        force = _evaluate_model(actor, position, velocity)
    elif actor.kind is TorqueKind.TASK_HAND:
        target = _as_columns(actor.b, q)
        force = stiffness * (target - position) - damping * velocity
    else:
        surface_point = _as_columns(actor.a, q)
        normal = _as_columns(actor.b, q)
        offset = surface_point - position
        depth = np.sum(offset * normal, axis=0)
        outward_speed = np.sum(velocity * normal, axis=0)
        wall_spring = stiffness[0] * depth
        wall_damper = damping[0] * outward_speed
        push = wall_spring - wall_damper
        # a wall pushes and never pulls
        is_inside = depth.real > 0.0
        touches = is_inside & (push.real > 0.0)
        force = np.where(touches, push, 0.0) * normal
    J_transposed = np.swapaxes(J, 0, 1)
    return multiply_columns(J_transposed, force)


def _evaluate_model(actor: TorqueSource, position: Numbers, velocity: Numbers) -> Numbers:
    """Returns the torque or force of an operator or environment that a user wrote.

    The components are on the first axis, as in this module.
    """
    # models expect the components on the last axis
    positions = np.moveaxis(position, 0, -1)
    velocities = np.moveaxis(velocity, 0, -1)
    time_s = np.array(actor.move_end_s)
    effort = actor.model.effort(time_s, positions, velocities)
    return np.moveaxis(effort, -1, 0)


def describe_switching_points(site: SiteSetup, x: Array) -> Iterator[str]:
    """Yields a sentence for each point at which the linear model of a site is one-sided.

    Where the arm barely touches a wall, or an estimate just reaches its limit, the derivatives
    on the two sides differ. The linear model contains only one of them.

    Args:
        site: Setup of the site.
        x: States and inputs of the site in the order of `ArgumentLayout.of_site`, shape
            (arguments,).
    """
    layout = ArgumentLayout.of_site(site)
    arm = place_arm(site, x[layout.q])
    position = arm.end_effector_position()

    walls = [actor for actor in site.actors if actor.kind is TorqueKind.WALL]
    for n, wall in enumerate(walls):
        from_surface = np.array(wall.a) - position
        depth_m = float(from_surface @ np.array(wall.b))
        if abs(depth_m) < SWITCHING_TOLERANCE:
            yield (
                f"{site.name} rests exactly on the surface of its wall {n + 1}: "
                "it counts as not touching"
            )

    if not site.gains.is_adaptive:
        return
    for p in np.flatnonzero(_find_switching_estimates(site, x)):
        yield (
            f"theta{p + 1} of {site.name} rests exactly on the edge of its box: "
            "it counts as free"
        )


def _find_switching_estimates(site: SiteSetup, x: Array) -> NDArray[np.bool_]:
    """Finds parameter estimates at which the control law has no two-sided derivative.

    These estimates are exactly at a limit, and the law does not hold them there. The result is
    True for each of them, shape (P,).
    """
    layout = ArgumentLayout.of_site(site)
    gains = site.gains
    estimate = x[layout.estimate]
    low = np.broadcast_to(gains.low, estimate.shape)
    high = np.broadcast_to(gains.high, estimate.shape)
    is_near_low = np.abs(low - estimate) < SWITCHING_TOLERANCE
    is_near_high = np.abs(high - estimate) < SWITCHING_TOLERANCE
    rate = SiteRates.evaluate(site, x).estimate
    is_still = np.abs(rate) <= SWITCHING_TOLERANCE
    # an estimate that would leave its range without limits is held by its limit
    unlimited_gains = gains._replace(low=-np.inf, high=np.inf)
    unlimited_site = site._replace(gains=unlimited_gains)
    free_rate = SiteRates.evaluate(unlimited_site, x).estimate
    is_held = _is_at_bound(site, estimate, free_rate)
    adapts = np.asarray(gains.Gamma) > 0
    switching: NDArray[np.bool_] = (is_near_low | is_near_high) & is_still & ~is_held & adapts
    return switching

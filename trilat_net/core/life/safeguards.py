"""Limits the speed of the reference, and prevents jumps of the torque.

A network fault or a sudden motion of another arm must not make an arm jump.

- `limit_reference` limits the speed of the reference that the control law follows.
- `return_to_law` is used when a resting arm begins to move. It blends from the torque that held
  the arm to the torque of the control law.

Invariant:

- The reference never moves faster than its speed limit, whatever the other arms do.
- A reference without a speed limit is not modified.
"""

from math import inf, isfinite

from ..arms.chain import put_three, read_three, scale_vector
from ..arms.rotation import compose_rotations, relative_rotation, rotation_matrix
from ..arms.task_space import count_linear_coordinates, has_orientation
from ..step.jit import leaf
from ..step.row_fields import SiteRow

BLEND_S = 0.1
"""Duration of the blend from the rest torque to the torque of the law, s."""


@leaf
def limit_reference(k: int, site: SiteRow) -> None:
    """Limits the speed of the reference, the position that the arm follows.

    Starting from its value in the previous tick, the reference moves by at most the permitted
    step. A reference that the limit has delayed catches up later. In the first tick, the
    reference starts at the pose of the arm.

    Args:
        k: Number of the tick.
        site: State of the site, whose reference is modified.
    """
    if k == site.first:
        for i in range(site.shared):
            site.q_followed[i] = site.x[i] if site.task else site.q[i]
    if has_orientation(site) and site.qd_des_limit[3] < inf:
        _limit_turn(site)
    count = min(site.shared, count_linear_coordinates(site))
    for i in range(count):
        limit = site.qd_des_limit[i]
        if limit == inf:
            continue
        q_before = site.q_followed[i]
        step = site.q_des[i] - q_before
        largest_step = limit / site.rate_hz
        if abs(step) > largest_step:
            sign = 1.0 if step > 0.0 else -1.0
            site.q_des[i] = q_before + sign * largest_step
            site.qd_des[i] = sign * limit
        else:
            rate = site.qd_des[i]
            site.qd_des[i] = min(max(rate, -limit), limit)


@leaf
def _limit_turn(site: SiteRow) -> None:
    """Limits how fast the orientation of the reference turns, about each axis of the base.

    In one tick, the reference may turn about each axis by at most the limit times the control
    period. If the turn is too large, its rotation vector is scaled down, which preserves the
    direction of the axis. The velocity of the reference is then that of the reduced turn.

    Args:
        site: State of the site. Its coordinates 0 to 2 are a position, and 3 to 5 a rotation
            vector in rad. `q_followed` is the reference in the previous tick. `q_des` and
            `qd_des`, the new reference and its velocity, are limited. `qd_des_limit` contains
            the limits of the velocity, rad/s.
    """
    vector_before = read_three(site.q_followed[3:])
    orientation_before = rotation_matrix(vector_before)
    desired_orientation = rotation_matrix(read_three(site.q_des[3:]))
    turn = relative_rotation(desired_orientation, orientation_before)
    # The largest factor with which the turn is within the limits of all three axes.
    factor = 1.0
    for axis in range(3):
        angle = abs(turn[axis])
        largest_angle = site.qd_des_limit[3 + axis] / site.rate_hz
        if angle * factor > largest_angle:
            factor = largest_angle / angle
    if factor < 1.0:
        limited_turn = scale_vector(factor, turn)
        velocity = scale_vector(factor * site.rate_hz, turn)
        # The previous orientation, followed by the limited turn.
        put_three(site.q_des[3:], compose_rotations(limited_turn, vector_before))
        put_three(site.qd_des[3:], velocity)
    # The velocity of a turn that was not shortened comes from the peers, and may exceed the
    # limit even if the turn does not. For a shortened turn, this only removes rounding errors.
    for i in range(3, 6):
        limit = site.qd_des_limit[i]
        rate = site.qd_des[i]
        site.qd_des[i] = min(max(rate, -limit), limit)


@leaf
def is_torque_finite(site: SiteRow) -> bool:
    """Returns True if the control law wrote a finite torque for every joint.

    The torque is set to NaN before the law is called, so a law that writes no torque is also
    detected.
    """
    finite = True
    for i in range(site.joints):
        finite = finite and isfinite(site.tau[i])
    return finite


@leaf
def return_to_law(t_ns: int, site: SiteRow) -> None:
    """Blends from the torque that held an arm at rest to the torque of its control law.

    The blend is linear and takes BLEND_S. A sudden change of torque would make the arm jerk.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site, whose torque `tau` is modified.
    """
    elapsed_s = (t_ns - site.return_from_ns) * 1e-9
    progress = min(elapsed_s / BLEND_S, 1.0)
    for i in range(site.joints):
        at_rest = site.tau_held[i]
        site.tau[i] = at_rest + progress * (site.tau[i] - at_rest)

"""Following in task space: end effectors agree on a place, or on a place and an orientation, of
unlike arms.

Invariant: all vectors of the task are in the frame that the sites share, `shared` of them: 3 of
a place, m, and 3 more of an orientation as `rotation_vector`. An axis that a site does not
follow has no effect on it.

With J the Jacobian of the followed axes, x the end effector's pose and e = x - x_des, the
reference velocity of the joints and its derivative are

    v = psi + J' y,    J J' y = -Lambda e - J psi            (v = J+ (-Lambda e) + (I - J+ J)
    psi) a = v' ,           J J' y' = -Lambda e' - J' psi - J psi' - (J' J^T + J J'^T) y

with psi = -k (q - q_posture) in the null space, so that r = qd - v gives J r = x' + Lambda e.

J J' gets a damping that is zero while 1 / trace((J J')^-1), a lower bound of the square of the
least singular value, is above that of `singular_value`.

Source: Y.-C. Liu and N. Chopra, "Controlled synchronization of heterogeneous robotic
manipulators in the task space", IEEE Trans. Robotics 28 (2012); damping after Y. Nakamura and
H. Hanafusa, "Inverse kinematic solutions with singularity robustness", J. Dynamic Systems,
Measurement, and Control 108 (1986).
"""

from .chain import Three, add, cross, place_end_effector, put_three, scale, subtract, three
from .jit import leaf
from .rotation import compose_rotations, relative_rotation, rotation_matrix
from .vectors import Array, Row, RowArray

POSITION = 3
POSE = 6
"""Numbers of a task without and with an orientation."""
TINY = 1e-12
"""A pivot of J J' below this is of an axis along which the end effector cannot move at all."""


@leaf
def has_orientation(s: Row) -> bool:
    """True if sites agree on an orientation besides the place."""
    found: bool = s.task != 0 and s.shared == POSE
    return found


@leaf
def count_linear_coordinates(s: Row) -> int:
    """Returns how many of the first coordinates have differences: all but those of an
    orientation.
    """
    return POSITION if has_orientation(s) else s.q_des.shape[0]


@leaf
def update_pose(s: Row, chain: RowArray) -> None:
    """Writes x, xd, J and its derivative from q and qd, after `place_joints`."""
    place = place_end_effector(chain, s.tip)
    put_three(s.x[:3], scale(s.scale, place))
    if s.shared == POSE:
        put_three(s.x[3:], relative_rotation(chain[chain.shape[0] - 1].R_base, s.tip_back))
    for j in range(s.shared):
        s.xd[j] = 0.0
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        for j in range(3):
            s.J[j, i] = s.scale * row.J_lin[j]
            s.xd[j] += s.J[j, i] * s.qd[i]
            if s.shared == POSE:
                s.J[3 + j, i] = row.J_ang[j]
                s.xd[3 + j] += row.J_ang[j] * s.qd[i]
    _update_jacobian_rate(s, chain, place)


@leaf
def _update_jacobian_rate(s: Row, chain: RowArray, tip: Three) -> None:
    """Writes the derivative of J along qd: axes turn with their links, and origins move."""
    still = (0.0, 0.0, 0.0)
    turning = speed = tip_speed = before = still
    for i in range(chain.shape[0]):
        tip_speed = add(tip_speed, scale(s.qd[i], three(chain[i].J_lin)))
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        axis = three(row.axis_base)
        place = three(row.p_base)
        speed = add(speed, cross(turning, subtract(place, before)))
        before = place
        if row.prismatic == 0:
            turning = add(turning, scale(s.qd[i], axis))
            angular = cross(turning, axis)
            away = cross(axis, subtract(tip_speed, speed))
            linear = add(cross(angular, subtract(tip, place)), away)
        else:
            speed = add(speed, scale(s.qd[i], axis))
            angular = still
            linear = cross(turning, axis)
        for j in range(3):
            s.Jd[j, i] = s.scale * linear[j]
            if s.shared == POSE:
                s.Jd[3 + j, i] = angular[j]


@leaf
def update_orientation_reference(s: Row, links: RowArray) -> None:
    """Writes the orientation of the reference: the own one less the sum of alpha_ij Log(R_i
    R_j').

    Its derivative is the sum of alpha_ij w_j, which is exact only for orientations that agree.
    """
    own = rotation_matrix(three(s.x[3:]))
    apart = rate = (0.0, 0.0, 0.0)
    for j in range(links.shape[0]):
        link: Row = links[j]
        turn = relative_rotation(own, rotation_matrix(three(link.q[3:])))
        apart = add(apart, scale(link.alpha, turn))
        rate = add(
            rate, add(scale(link.alpha, three(link.qd[3:])), scale(-link.alpha_rate, turn))
        )
    put_three(s.q_des[3:], compose_rotations(scale(-1.0, apart), three(s.x[3:])))
    put_three(s.qd_des[3:], rate)


@leaf
def _factor(s: Row, damping: float) -> None:
    """Writes the factors L D L' of J J' + damping, for the axes that are followed, into s.A
    (lower part).
    """
    for j in range(s.shared):
        for k in range(j + 1):
            total = damping + 1.0 - s.axes[j] if j == k else 0.0
            for i in range(s.joints):
                total += s.J[j, i] * s.J[k, i]
            for p in range(k):
                total -= s.A[j, p] * s.A[k, p] * s.A[p, p]
            if k < j:
                total = total / s.A[k, k] if s.A[k, k] > TINY else 0.0
            s.A[j, k] = total


@leaf
def _solve(s: Row, b: Array, y: Array) -> None:
    """Writes the solution of L D L' y = b."""
    for j in range(s.shared):
        y[j] = b[j]
        for k in range(j):
            y[j] -= s.A[j, k] * y[k]
    for j in range(s.shared - 1, -1, -1):
        y[j] = y[j] / s.A[j, j] if s.A[j, j] > TINY else 0.0
        for k in range(j + 1, s.shared):
            y[j] -= s.A[k, j] * y[k]


@leaf
def _factor_damped(s: Row) -> None:
    """Factors J J' with the damping that its nearness to a singular pose asks for."""
    for j in range(s.shared):
        for i in range(s.joints):
            s.J[j, i] *= s.axes[j]
            s.Jd[j, i] *= s.axes[j]
    _factor(s, 0.0)
    limit = s.singular_value * s.singular_value
    trace = 0.0
    for j in range(s.shared):
        if not s.A[j, j] > TINY:
            trace = 1.0 / TINY
        for k in range(s.shared):
            s.b[k] = 1.0 if k == j else 0.0
        _solve(s, s.b, s.y)
        trace += s.y[j] * s.axes[j]
    least = 1.0 / trace if trace > 0.0 else limit
    if least < limit:
        _factor(s, limit - least)


@leaf
def update_task_errors(s: Row) -> None:
    """Writes e and ed of the followed axes, v and a of the joints, and r."""
    n = s.joints
    m = s.shared
    for j in range(m):
        s.e[j] = s.x[j] - s.q_des[j]
        s.ed[j] = s.xd[j] - s.qd_des[j]
    if m == POSE:
        reference = rotation_matrix(three(s.q_des[3:]))
        put_three(s.e[3:], relative_rotation(rotation_matrix(three(s.x[3:])), reference))
    for j in range(m):
        s.e[j] *= s.axes[j]
        s.ed[j] *= s.axes[j]
    _factor_damped(s)
    k = s.posture_rate
    for j in range(m):
        s.b[j] = -s.Lambda[j] * s.e[j]
        for i in range(n):
            s.b[j] += s.J[j, i] * k * (s.q[i] - s.posture[i])
    for i in range(n):
        s.v[i] = -k * (s.q[i] - s.posture[i])
        s.a[i] = -k * s.qd[i]
    _solve(s, s.b, s.y)
    for i in range(n):
        s.stage_q[i] = s.stage_qd[i] = 0.0  # J'^T y and J^T y
        for j in range(m):
            s.stage_q[i] += s.Jd[j, i] * s.y[j]
            s.stage_qd[i] += s.J[j, i] * s.y[j]
    for j in range(m):
        s.b[j] = -s.Lambda[j] * s.ed[j]
        for i in range(n):
            s.b[j] -= s.Jd[j, i] * (s.v[i] + s.stage_qd[i]) + s.J[j, i] * (
                s.a[i] + s.stage_q[i]
            )
    _solve(s, s.b, s.y)
    for i in range(n):
        s.v[i] += s.stage_qd[i]
        s.a[i] += s.stage_q[i]
        for j in range(m):
            s.a[i] += s.J[j, i] * s.y[j]
        s.r[i] = s.qd[i] - s.v[i]


@leaf
def add_task_torque(s: Row, gains: Array, values: Array, factor: float, torque: Array) -> None:
    """Adds factor J' (gains * values) to a torque of the joints: a force in the task."""
    for i in range(s.joints):
        for j in range(s.shared):
            torque[i] += factor * s.J[j, i] * (gains[j] * values[j])


@leaf
def update_wrench(s: Row) -> None:
    """Writes what tau_x amounts to at the end effector, along the followed axes: (J J')^-1 J
    tau_x.
    """
    for j in range(s.shared):
        s.b[j] = 0.0
        for i in range(s.joints):
            s.b[j] -= s.J[j, i] * s.on_arm[i]
    _solve(s, s.b, s.wrench)

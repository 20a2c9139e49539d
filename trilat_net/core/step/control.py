"""Computes the joint torques of the built-in control laws for the planar two-link arm.

There are two kinds of law. The adaptive law estimates the dynamic parameters of its arm, such
as masses, while controlling the arm. The other laws know the gravity torque of the arm and
compensate for it. They add damping (P+d), damping and a derivative term (PD+d), or the force
felt by a remote arm. `chain_stages` implements the same laws for chains of joints.

Gains are diagonal matrices, stored as vectors with one entry per joint (N m s/rad; 1/s for the
convergence rate Lambda) or per dynamic parameter. Angles are in rad, speeds in rad/s and
torques in N m. The regressor is the matrix that yields the torque of the arm's dynamics when
multiplied by the dynamic parameters.

Invariant:
    - The errors and the regressor are computed before the estimate is updated, and do not
      depend on the new estimate. The second-order update of the estimate therefore does not
      require solving an equation.

Source: Eq. (9)-(13) and (15) of the paper on which this project is based
(docs/reference/references.md); P+d and PD+d after Nuno, Basanez, Ortega and Spong, "Position
Tracking for Non-linear Teleoperators with Variable Time Delay", Int. J. Robotics Research 28
(2009); direct force reflection after Lawrence, "Stability and transparency in bilateral
teleoperation", IEEE Trans. Robotics and Automation 9 (1993).
"""

from math import sqrt

from ..arms.two_link_arm import gravity
from .jit import leaf
from .vectors import Five, Pair, Vector

ROBUST_RESIDUE = ((5.0**0.5 - 1.0) / 2.0) ** 2.5
"""Maximum of x - x^2 / sqrt(1 + x^2) for x >= 0."""


@leaf
def control_errors(
    q: Vector, qd: Vector, q_des: Vector, qd_des: Vector, Lambda: Vector
) -> tuple[Pair, Pair, Pair]:
    """Computes the errors that a control law acts on, for each joint of the planar arm.

        e = q - q_des,  ed = qd - qd_des,  r = qd + Lambda e        Eq. (9), (18), (10)

    Here q_des is the reference (the position to follow), and r is the filtered error.

    Args:
        q: Joint angles, shape (2,), rad.
        qd: Joint velocities, shape (2,), rad/s.
        q_des: Reference of the joints, shape (2,), rad.
        qd_des: Derivative of the reference, shape (2,), rad/s.
        Lambda: Rate at which errors decay, per joint, 1/s.

    Returns:
        The error e, its derivative ed, and the filtered error r.
    """
    e_1 = q[0] - q_des[0]
    e_2 = q[1] - q_des[1]
    ed_1 = qd[0] - qd_des[0]
    ed_2 = qd[1] - qd_des[1]
    r_1 = qd[0] + Lambda[0] * e_1
    r_2 = qd[1] + Lambda[1] * e_2
    return (e_1, e_2), (ed_1, ed_2), (r_1, r_2)


@leaf
def regressor_transpose_times(Y: tuple[Five, Five], r: Vector) -> Five:
    """Computes Y' r, which drives the parameter estimate of the adaptive control law.

    Args:
        Y: Regressor of the planar arm, two rows with five entries each. Y theta is the joint
            torque of an arm with dynamic parameters theta.
        r: Filtered tracking error, shape (2,), rad/s.

    Returns:
        One entry per parameter.
    """
    first, second = Y
    r_1 = r[0]
    r_2 = r[1]
    return (
        first[0] * r_1 + second[0] * r_2,
        first[1] * r_1 + second[1] * r_2,
        first[2] * r_1 + second[2] * r_2,
        first[3] * r_1 + second[3] * r_2,
        first[4] * r_1 + second[4] * r_2,
    )


@leaf
def update_estimate(theta_hat: Vector, gain_s: float, Gamma: Vector, Yr: Vector) -> Five:
    """Advances the adaptive law's estimate of the arm's parameters by one step, Eq. (15).

        theta_hat - gain_s Gamma Y' r

    Gamma is the adaptation gain, Y the regressor and r the filtered tracking error.

    Args:
        theta_hat: Parameter estimate before the step, shape (5,).
        gain_s: Duration of the step, s.
        Gamma: Adaptation gain per parameter, shape (5,).
        Yr: Product Y' r of the regressor and the filtered error, shape (5,).
    """
    return (
        theta_hat[0] - gain_s * Gamma[0] * Yr[0],
        theta_hat[1] - gain_s * Gamma[1] * Yr[1],
        theta_hat[2] - gain_s * Gamma[2] * Yr[2],
        theta_hat[3] - gain_s * Gamma[3] * Yr[3],
        theta_hat[4] - gain_s * Gamma[4] * Yr[4],
    )


@leaf
def limit_torque(torque: float, limit: float) -> float:
    """Clips a torque to the range that a motor can exert, from -limit to limit."""
    return min(max(torque, -limit), limit)


@leaf
def adaptive_torque(
    Y: tuple[Five, Five],
    theta_hat: Vector,
    Kp: Vector,
    Kd: Vector,
    r: Vector,
    ed: Vector,
    limit: float,
) -> Pair:
    """Returns the torque of the adaptive law for the planar arm, Eq. (13), within the limit.

        tau = Y theta_hat - Kp r - Kd ed

    The first term is the torque that the arm needs according to the estimated parameters
    theta_hat. The other terms damp the errors.

    Args:
        Y: Regressor Y(q, qd, -Lambda e, -Lambda ed), two rows with five entries each.
        theta_hat: Parameter estimate, shape (5,).
        Kp: Damping of the filtered error, per joint, N m s/rad.
        Kd: Damping of the error velocity, per joint, N m s/rad.
        r: Filtered error, rad/s, see `control_errors`.
        ed: Derivative of the error, rad/s.
        limit: Largest torque of a joint, N m.
    """
    first, second = Y
    torque_1 = 0.0
    torque_2 = 0.0
    for p in range(5):
        torque_1 += first[p] * theta_hat[p]
        torque_2 += second[p] * theta_hat[p]
    torque_1 -= Kp[0] * r[0] + Kd[0] * ed[0]
    torque_2 -= Kp[1] * r[1] + Kd[1] * ed[1]
    return limit_torque(torque_1, limit), limit_torque(torque_2, limit)


@leaf
def robust_torque(rho: float, width: float, r: float) -> float:
    """Returns rho r / sqrt(r^2 + width^2), a torque that opposes a bounded disturbance.

    The robust torque is a smooth version of rho sign(r), which the control law subtracts. If
    the disturbance d of the joint is at most rho in magnitude, the remaining power (d - robust
    torque) r is at most ROBUST_RESIDUE rho width.

    Args:
        rho: Largest robust torque, N m.
        width: Value of r at which the torque is 0.71 rho, rad/s.
        r: Filtered error of a joint, rad/s.
    """
    smooth_sign = r / sqrt(r * r + width * width)
    return rho * smooth_sign


@leaf
def _clip(value: float, low: float, high: float) -> float:
    """Clips a value to the range from low to high. NaN stays NaN."""
    if value < low:
        return low
    return high if value > high else value


@leaf
def project_estimate(theta_hat: Vector, low: Vector, high: Vector) -> Five:
    """Clips an estimate of the arm's parameters, limiting each parameter to its range.

    The stability proof still holds with this projection. If the adaptation gain Gamma is
    diagonal and the true parameters theta are within the bounds, the projection never increases
    (theta_hat - theta)' Gamma^-1 (theta_hat - theta). The energy function V of the proof
    contains this term, so V still never increases.

    Args:
        theta_hat: Parameter estimate, shape (5,).
        low: Lower bound of each parameter.
        high: Upper bound of each parameter.
    """
    return (
        _clip(theta_hat[0], low[0], high[0]),
        _clip(theta_hat[1], low[1], high[1]),
        _clip(theta_hat[2], low[2], high[2]),
        _clip(theta_hat[3], low[3], high[3]),
        _clip(theta_hat[4], low[4], high[4]),
    )


@leaf
def damped_torque(
    theta: Vector,
    g: float,
    K: Vector,
    d: Vector,
    Kd: Vector,
    k_f: Vector,
    q: Vector,
    qd: Vector,
    e: Vector,
    ed: Vector,
    felt: Vector,
    limit: float,
) -> Pair:
    """Returns the torque of the laws that assume known gravity, within the limit.

        tau = G(q) - K e - d qd - Kd ed + k_f felt

    G is the gravity torque and e = q - q_des the position error. The law depends on which gains
    are nonzero:

    - P+d: Kd = k_f = 0. For N sites with reversible dominance factors, the same K and d at
      every site, and the same constant delay T on every link, the linearised loop is stable for
      all masses if d >= max(abs(lambda_min(alpha)), 0.2172) K T. Two sites are stable if 4 d_1
      d_2 > (T_1 + T_2)^2 K_1 K_2. No bound of this form exists for other dominance factors.
    - PD+d: k_f = 0.
    - Direct force reflection: Kd = 0, with K and d at the slave, d and k_f at the master.

    Args:
        theta: Arm parameters assumed by the law, shape (5,).
        g: Gravitational acceleration, m/s^2.
        K: Stiffness, per joint, N m/rad.
        d: Damping of the arm's own velocity, per joint, N m s/rad.
        Kd: Damping of the error velocity, per joint, N m s/rad.
        k_f: Gain of the reflected force, per joint, dimensionless.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        e: Position error, rad.
        ed: Derivative of the position error, rad/s.
        felt: Torque on the peers' arms as received, weighted by the dominance factors, N m.
        limit: Largest torque of a joint, N m.
    """
    G_1, G_2 = gravity(theta, g, q)
    torque_1 = G_1 - K[0] * e[0]
    torque_1 -= d[0] * qd[0]
    torque_1 -= Kd[0] * ed[0]
    torque_1 += k_f[0] * felt[0]
    torque_2 = G_2 - K[1] * e[1]
    torque_2 -= d[1] * qd[1]
    torque_2 -= Kd[1] * ed[1]
    torque_2 += k_f[1] * felt[1]
    return limit_torque(torque_1, limit), limit_torque(torque_2, limit)

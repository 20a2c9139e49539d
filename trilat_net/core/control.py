"""The control laws: the paper's adaptive one, split where its equations are, and the classics beside it.

Law: errors and regressor of tick k never depend on the estimate of tick k, which keeps the second-order
update explicit.

Source: Eq. (9)-(13), (15) of the paper; P+d and PD+d after Nuno, Basanez, Ortega and Spong, "Position
Tracking for Non-linear Teleoperators with Variable Time Delay", Int. J. Robotics Research 28 (2009); direct
force reflection after Lawrence, "Stability and transparency in bilateral teleoperation", IEEE Trans. Robotics
and Automation 9 (1993). Gains are diagonal and stand as vectors.
"""

from .arm import Array, gravity
from .jit import leaf


@leaf
def errors(
    q: Array, qd: Array, q_des: Array, qd_des: Array, Lambda: Array, e: Array, ed: Array, r: Array
) -> None:
    """Writes e, its derivative and r: Eq. (9), (18), (10).

    Args:
        q: joint angles, shape (n,), rad.
        qd: joint velocities, shape (n,), rad/s.
        q_des: reference q_id of Eq. (6), shape (n,), rad.
        qd_des: its derivative, shape (n,), rad/s.
        Lambda: shape (n,), 1/s.
        e: position error, shape (n,), rad; written.
        ed: its derivative, shape (n,), rad/s; written.
        r: qd + Lambda e, shape (n,), rad/s; written.
    """
    for i in range(q.shape[0]):
        e[i] = q[i] - q_des[i]
        ed[i] = qd[i] - qd_des[i]
        r[i] = qd[i] + Lambda[i] * e[i]


@leaf
def regressor_transpose_times(Y: Array, r: Array, Yr: Array) -> None:
    """Writes Y' r, shape (p,), what drives the estimate in Eq. (15), for Y of shape (n, p)."""
    for p in range(Y.shape[1]):
        total = 0.0
        for i in range(Y.shape[0]):
            total += Y[i, p] * r[i]
        Yr[p] = total


@leaf
def estimate(theta_hat: Array, gain_s: float, Gamma: Array, Yr: Array) -> None:
    """Advances theta_hat by -gain Gamma Y' r, Eq. (15) over a time `gain_s`.

    Args:
        theta_hat: estimate, shape (p,), units of theta; changed in place.
        gain_s: the time over which this value of Y' r counts, s.
        Gamma: adaptation gain of each parameter, shape (p,).
        Yr: Y' r, shape (p,).
    """
    for p in range(theta_hat.shape[0]):
        theta_hat[p] -= gain_s * Gamma[p] * Yr[p]


@leaf
def torque(
    Y: Array, theta_hat: Array, Kp: Array, Kd: Array, r: Array, ed: Array, limit: float, tau: Array
) -> None:
    """Writes tau = Y theta_hat - Kp r - Kd ed, Eq. (13), held within +-limit.

    Args:
        Y: regressor Y(q, qd, -Lambda e, -Lambda ed), shape (n, p).
        theta_hat: estimate, shape (p,).
        Kp: shape (n,), N m s/rad.
        Kd: shape (n,), N m s/rad.
        r: shape (n,), rad/s.
        ed: shape (n,), rad/s.
        limit: largest torque of a joint, N m.
        tau: control torque, shape (n,), N m; written.
    """
    for i in range(tau.shape[0]):
        total = 0.0
        for p in range(theta_hat.shape[0]):
            total += Y[i, p] * theta_hat[p]
        total -= Kp[i] * r[i] + Kd[i] * ed[i]
        tau[i] = min(max(total, -limit), limit)


@leaf
def project(theta_hat: Array, low: Array, high: Array) -> None:
    """Holds every parameter within its box, shape (p,) each, in place.

    For a diagonal Gamma and a truth inside the box this never lets (theta_hat - theta)' Gamma^-1 (theta_hat -
    theta) rise, so that V' <= 0 stands.
    """
    for p in range(theta_hat.shape[0]):
        if theta_hat[p] < low[p]:
            theta_hat[p] = low[p]
        elif theta_hat[p] > high[p]:
            theta_hat[p] = high[p]


@leaf
def damped_torque(
    theta: Array,
    g: float,
    K: Array,
    d: Array,
    Kd: Array,
    k_f: Array,
    q: Array,
    qd: Array,
    e: Array,
    ed: Array,
    felt: Array,
    limit: float,
    tau: Array,
) -> None:
    """Writes tau = G(q) - K e - d qd - Kd ed + k_f felt, held within +-limit: the laws that know gravity.

    P+d has Kd = k_f = 0. For N sites with equal K and d per joint and one constant delay T its linearised
    loop is stable from d = abs(lambda_min(alpha)) K T on, for two sites with 4 d_1 d_2 > (T_1 + T_2)^2 K_1
    K_2. PD+d has k_f = 0. Direct force reflection has Kd = 0: K and d at the slave, d and k_f at the master.

    Args:
        theta: the parameters that the law takes the arm to have, shape (5,).
        g: gravitational acceleration, m/s^2.
        K: stiffness, shape (n,), N m/rad.
        d: damping of the arm's own velocity, shape (n,), N m s/rad.
        Kd: damping of the error's velocity, shape (n,), N m s/rad.
        k_f: share of what the peers feel, shape (n,).
        q: joint angles, shape (n,), rad.
        qd: joint velocities, shape (n,), rad/s.
        e: position error, shape (n,), rad.
        ed: its derivative, shape (n,), rad/s.
        felt: the torque on the peers' arms as it came, weighted by dominance, shape (n,), N m.
        limit: largest torque of a joint, N m.
        tau: control torque, shape (n,), N m; written.
    """
    gravity(theta, g, q, tau)
    for i in range(tau.shape[0]):
        total = tau[i] - K[i] * e[i] - d[i] * qd[i]
        if Kd[i] != 0.0:
            total -= Kd[i] * ed[i]
        if k_f[i] != 0.0:
            total += k_f[i] * felt[i]
        tau[i] = min(max(total, -limit), limit)

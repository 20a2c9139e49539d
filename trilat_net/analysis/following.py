"""Computes the reference motion with which an arm follows other arms, for many records.

Arms follow each other either joint by joint (`JointFollowing`), or with their end effectors
(`TaskFollowing`). Both classes compute the error e (the difference between the position of the
arm and its reference), and the joint velocities that reduce e. The simulation computes the same
motion in compiled code. This module is an independent implementation in NumPy, from the
equations of docs/reference/task-space.md, so the stability certificate does not depend on the
simulation.

Invariant:
    - Directions of space in which the end effector does not follow have no effect.
    - Near a singular pose of the arm, the inverse of the Jacobian J is damped. The end effector
      then does not reach the velocity -Lambda e, where Lambda is a gain in 1/s. The joint
      velocity v satisfies J v = -Lambda e - d y, where d is the damping, y solves (J J' + d) y
      = -Lambda e - J p, and p is the joint velocity towards a preferred posture.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..core import Array
from ..log import Ints
from .arm_rows import ArmRows, Numbers, PlanarArmRows, multiply_columns

Rows = slice | Ints
_LEAST_EIGENVALUE = 1e-12
"""Lower bound of the eigenvalues of J J', so that the inverse stays finite."""


def find_task_reference(
    J: Numbers,
    Jd: Numbers,
    solve: Callable[[Numbers], Numbers],
    posture: tuple[Numbers, Numbers],
    error: tuple[Numbers, Numbers],
) -> tuple[Numbers, Numbers]:
    """Returns the reference velocity v of the joints and its derivative a, shape (n, ...) each.

        v = psi + J' y,               A y  = -Lambda e - J psi
        a = psi' + Jd' y + J' y',     A y' = -Lambda ed - Jd v - J (psi' + Jd' y)

    psi is a velocity towards a preferred posture, e the error of the end effector and ed its
    derivative. J' and Jd' are transposed matrices, psi' and y' time derivatives.

    Args:
        J: Jacobian of the followed axes, shape (m, n, ...).
        Jd: Time derivative of the Jacobian.
        solve: Function that solves A y = b for y, shape (m, ...), with A = J J' + damping, plus
            1 for each axis that is not followed.
        posture: psi and its derivative, shape (n, ...).
        error: Lambda e and Lambda ed, shape (m, ...).
    """
    psi, psi_rate = posture
    scaled_e, scaled_ed = error
    J_transposed = J.swapaxes(0, 1)
    Jd_transposed = Jd.swapaxes(0, 1)
    y = solve(-scaled_e - multiply_columns(J, psi))
    v = psi + multiply_columns(J_transposed, y)
    # psi' + Jd' y
    a_without_y_rate = psi_rate + multiply_columns(Jd_transposed, y)
    Jd_v = multiply_columns(Jd, v)
    J_a = multiply_columns(J, a_without_y_rate)
    y_rate = solve(-scaled_ed - Jd_v - J_a)
    a = a_without_y_rate + multiply_columns(J_transposed, y_rate)
    return v, a


class JointFollowing(NamedTuple):
    """Computes reference motion and torque of a site that follows others joint by joint.

    The followed coordinates are the joint angles, so no Jacobian is needed. `TaskFollowing` has
    the same methods for sites that follow with the end effector. In all methods, `rows` selects
    the K rows of the records to evaluate.

    Attributes:
        Lambda: Gain of the synchronisation error e, shape (n,), in 1/s.
    """

    Lambda: Array

    def compute_reference(
        self,
        rows: Rows,  # noqa: ARG002
        e: Array,
        ed: Array,
    ) -> tuple[Array, Array]:
        """Returns the joint velocity that should reduce the errors, and its derivative.

        The velocity is -Lambda e, with the joint error e and the gain Lambda in 1/s.

        Args:
            rows: Rows of the records. Ignored, because the result does not depend on the pose.
            e: Differences between the joint angles and their reference, shape (K, n), in rad.
            ed: Derivatives of the errors, shape (K, n), in rad/s.

        Returns:
            Reference velocity, shape (K, n), in rad/s.
            Its derivative, shape (K, n), in rad/s^2.
        """
        return -self.Lambda * e, -self.Lambda * ed

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:  # noqa: ARG002
        """Returns the jump of the filtered error r when a new sample of a peer comes into use.

        The error e jumps by de. Since r = qd + Lambda e, the jump of r is Lambda de, shape (K,
        n).

        Args:
            rows: Rows of the records. Ignored, because the result does not depend on the pose.
            de: Jumps of e, shape (K, n), in rad.
        """
        return self.Lambda * de

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:  # noqa: ARG002
        """Returns the joint torque for a force along the shared coordinates, shape (K, n).

        Here the shared coordinates are the joint angles, so the force is the torque.

        Args:
            rows: Rows of the records. Ignored, because the result does not depend on the pose.
            force: Generalised force, shape (K, n), in N m.
        """
        return force

    def without_posture(self) -> "JointFollowing":
        """Returns this object unchanged.

        `TaskFollowing` uses this method to exclude the motion towards a preferred posture. An
        arm that follows joint by joint has no free joints, and therefore no preferred posture.
        """
        return self

    def compute_damping_deviation(
        self,
        rows: Rows,  # noqa: ARG002
        e: Array,
    ) -> tuple[Array, Array]:
        """Returns two arrays of zeros, because following joint by joint inverts no Jacobian.

        Arms that follow with their end effectors use an inverse of the Jacobian, which is
        damped near singular poses (see `TaskFollowing`).

        Args:
            rows: Rows of the records. Ignored.
            e: Synchronisation errors of the joints, shape (K, n), in rad.

        Returns:
            Two arrays of zeros, shape (K, n).
        """
        zeros = np.zeros_like(e)
        return zeros, zeros


@dataclass(frozen=True)
class TaskFollowing:
    """Computes reference motion and torque of a site that follows with its end effector.

    The arm has n joints, and its end effector follows along some of the m task coordinates.
    Joints that the task leaves free move towards a preferred posture. Near singular poses,
    where the end effector cannot move in some direction, the inverse of the Jacobian is damped.
    Arrays have one row for each of the K records.

    Attributes:
        Lambda: Gain of the error, shape (m,), in 1/s. 0 along an axis that the site does not
            follow.
        J: Jacobian of the followed axes, shape (K, m, n).
        Jd: Time derivative of the Jacobian, shape (K, m, n).
        psi: Velocity of the joints towards the preferred posture, shape (K, n), in rad/s.
        psi_rate: Derivative of psi, shape (K, n), in rad/s^2.
        inverse: Inverse of J J' + damping, shape (K, m, m).
        damping: Damping near singular poses, shape (K,), in m^2.
        damping_rate: Derivative of the damping, shape (K,), in m^2/s.
        least: Lower bound on the smallest singular value of J, from which the damping is
            computed, shape (K,), in m.
    """

    Lambda: Array
    J: Array
    Jd: Array
    psi: Array
    psi_rate: Array
    inverse: Array
    damping: Array
    damping_rate: Array
    least: Array

    def _solve(self, rows: Rows, b: Array) -> Array:
        """Returns the solution y of (J J' + damping) y = b, shape (K, m)."""
        y: Array = np.einsum("kij,kj->ki", self.inverse[rows], b)
        return y

    def compute_reference(self, rows: Rows, e: Array, ed: Array) -> tuple[Array, Array]:
        """Returns the joint velocity that should reduce the errors, and its derivative.

        Args:
            rows: Rows of the records whose pose is used.
            e: Differences between the position of the end effector and its reference, shape (K,
                m) for m coordinates.
            ed: Derivatives of the errors, shape (K, m).

        Returns:
            Reference velocity of the n joints, shape (K, n), in rad/s.
            Its derivative as the control law computes it, shape (K, n), in rad/s^2.
        """
        # `find_task_reference` has the rows on the last axis
        inverse = np.moveaxis(self.inverse[rows], 0, -1)
        psi = self.psi[rows]
        psi_rate = self.psi_rate[rows]
        scaled_e = self.Lambda * e
        scaled_ed = self.Lambda * ed
        v, a = find_task_reference(
            J=np.moveaxis(self.J[rows], 0, -1),
            Jd=np.moveaxis(self.Jd[rows], 0, -1),
            solve=partial(multiply_columns, inverse),
            posture=(psi.T, psi_rate.T),
            error=(scaled_e.T, scaled_ed.T),
        )
        return v.T, a.T

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:
        """Returns the jump of the filtered error r when the error of the end effector jumps.

        Errors jump when a new sample of a peer arrives. The filtered error r is the joint
        velocity minus its reference. Its jump is the damped inverse of the Jacobian, times the
        gain Lambda in 1/s, times the jump of the error.

        Args:
            rows: Rows of the records whose pose is used.
            de: Jumps of the error, shape (K, m) for m coordinates of the end effector.

        Returns:
            Jumps of r, shape (K, n) for n joints, in rad/s.
        """
        y = self._solve(rows, self.Lambda * de)
        return self.compute_joint_torque(rows, y)

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:
        """Returns the joint torque J'f equivalent to a force f at the end effector, in N m.

        J is the Jacobian, which maps joint velocities to the velocity of the end effector. The
        shape is (K, n).

        Args:
            rows: Rows of the records whose pose is used.
            force: Force along the followed axes, shape (K, m), in N.
        """
        torque: Array = np.einsum("kij,ki->kj", self.J[rows], force)
        return torque

    def project_torque(self, torque: Array) -> Array:
        """Returns the force at the end effector that corresponds to a joint torque, in N.

        `compute_joint_torque` is the reverse conversion.

        Args:
            torque: Joint torque, shape (K, n), in N m.

        Returns:
            Force along the followed axes, shape (K, m).
        """
        along_axes = np.einsum("kij,kj->ki", self.J, torque)
        return self._solve(slice(None), along_axes)

    def without_posture(self) -> "TaskFollowing":
        """Returns a copy in which the arm does not move its free joints to a preferred posture.

        An arm may have more joints than the task needs. In the copy, the reference velocity is
        linear in the error of the end effector.
        """
        still = np.zeros_like(self.psi)
        return replace(self, psi=still, psi_rate=still)

    def compute_damping_deviation(self, rows: Rows, e: Array) -> tuple[Array, Array]:
        """Returns the errors that damping of the inverse causes in two equations of the proof.

        The inverse of the Jacobian J is damped near singular poses. Without damping, the
        equations J r = xd + Lambda e and a = dv/dt hold exactly. Here r is the filtered error,
        xd the velocity of the end effector, e its error, Lambda a gain, v the reference
        velocity of the joints, and a the acceleration that the control law uses for dv/dt. Away
        from singular poses, both results are zero.

        Args:
            rows: Rows of the records whose pose is used.
            e: Errors of the end effector, shape (K, m) for m coordinates.

        Returns:
            J r - xd - Lambda e, shape (K, m).
            a - dv/dt, shape (K, n) for n joints.
        """
        damping = self.damping[rows, np.newaxis]
        rate = self.damping_rate[rows, np.newaxis]
        psi = self.psi[rows]
        if not (damping.any() or rate.any()):
            return np.zeros_like(e), np.zeros_like(psi)
        posture_velocity = np.einsum("kij,kj->ki", self.J[rows], psi)
        y = self._solve(rows, -self.Lambda * e - posture_velocity)
        y_of_rate = self._solve(rows, rate * y)
        acceleration = self.compute_joint_torque(rows, y_of_rate)
        return damping * y, acceleration


Following = JointFollowing | TaskFollowing


def _transpose(matrices: Array) -> Array:
    """Returns the transpose of the matrix of every row, with shape (K, b, a) from (K, a, b)."""
    return matrices.transpose(0, 2, 1)


def build_following(
    arm: ArmRows,
    q: Array,
    qd: Array,
    Lambda: Array,
) -> Following:
    """Returns the object that computes how an arm moves its joints to follow other arms.

    Args:
        arm: The arm. If it has a task for its end effector, it follows with the end effector,
            and otherwise joint by joint.
        q: Joint angles in K records, shape (K, n) for n joints, in rad.
        qd: Joint velocities, shape (K, n), in rad/s.
        Lambda: Gain of the error in 1/s, shape (n,). If the arm follows with its end effector,
            the shape is (m,) for m coordinates, with 0 for coordinates that are not followed.
    """
    task = arm.task
    if isinstance(arm, PlanarArmRows) or task is None:
        return JointFollowing(Lambda)

    end_effector = arm.place_end_effector(q, qd)
    axes = np.array(task.axes)[:, np.newaxis]
    axis_scale = axes * task.scale
    J = axis_scale * end_effector.J
    Jd = axis_scale * arm.jacobian_rate(q, qd)
    # ones on the diagonal of the axes that are not followed keep A regular
    free_axes = np.diag(1.0 - axes[:, 0])
    A = J @ _transpose(J) + free_axes
    eigenvalues, eigenvectors = np.linalg.eigh(A)
    bounded_eigenvalues = np.maximum(eigenvalues, _LEAST_EIGENVALUE)
    scaled_eigenvectors = eigenvectors / bounded_eigenvalues[:, np.newaxis]
    inverse = scaled_eigenvectors @ _transpose(eigenvectors)

    # 1 / trace(A^-1) is a smooth lower bound of the least eigenvalue of A
    inverse_trace = np.trace(axes * inverse, axis1=1, axis2=2)
    least_eigenvalue = 1.0 / inverse_trace

    # derivative of that bound: d(A^-1)/dt = -A^-1 (dA/dt) A^-1
    damping = np.maximum(task.singular_value**2 - least_eigenvalue, 0.0)
    half_A_rate = J @ _transpose(Jd)
    A_rate = half_A_rate + _transpose(half_A_rate)
    inverse_rate = inverse @ A_rate @ inverse
    inverse_trace_rate = -np.trace(inverse_rate, axis1=1, axis2=2)
    bound_rate = inverse_trace_rate / inverse_trace**2
    damping_rate = np.where(damping > 0.0, bound_rate, 0.0)
    if damping.any():
        damping_matrix = damping[:, np.newaxis, np.newaxis] * np.eye(len(axes))
        inverse = np.linalg.inv(A + damping_matrix)

    from_posture = np.array(task.posture) - q
    return TaskFollowing(
        Lambda=Lambda,
        J=J,
        Jd=Jd,
        psi=task.posture_rate * from_posture,
        psi_rate=-task.posture_rate * qd,
        inverse=inverse,
        damping=damping,
        damping_rate=damping_rate,
        least=np.sqrt(least_eigenvalue),
    )

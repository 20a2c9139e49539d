"""Maps errors of the reference to motion and torque of the joints, over rows.

A site follows joint by joint, or in task space with its end effector.

Invariant:
    - Everything is written with NumPy from the equations of `docs/laws.md`, independently of
      the core.
    - Only the rows of J and J' of the followed axes count; axes that are not followed have no
      effect.
    - With the reference of `find_task_reference`, J v = -Lambda e - damping y: where the pose
      is nearly singular, the second term is missing from the desired velocity.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..core.vectors import Array
from ..log.record_columns import Ints
from .arm_rows import ArmRows, Numbers, PlanarArmRows, multiply_columns

Rows = slice | Ints
_LEAST_EIGENVALUE = 1e-12
"""Smallest eigenvalue of J J' of an axis along which the end effector can move at all."""


def find_task_reference(
    J: Numbers,
    Jd: Numbers,
    solve: Callable[[Numbers], Numbers],
    posture: tuple[Numbers, Numbers],
    error: tuple[Numbers, Numbers],
) -> tuple[Numbers, Numbers]:
    """Returns the reference velocity v of the joints and its derivative a, shape (n, ...).

        v = psi + J' y,               A y  = -Lambda e - J psi
        a = psi' + Jd' y + J' y',     A y' = -Lambda ed - Jd v - J (psi' + Jd' y)

    Args:
        J: Jacobian of the followed axes, shape (m, n, ...).
        Jd: its derivative.
        solve: solves A y = b for y, shape (m, ...), with A = J J' + damping, plus 1 for each
            axis that is not followed.
        posture: psi and psi', shape (n, ...).
        error: Lambda e and Lambda ed, shape (m, ...).
    """
    psi, psi_rate = posture
    e, ed = error
    J_transposed = J.swapaxes(0, 1)
    y = solve(-e - multiply_columns(J, psi))
    v = psi + multiply_columns(J_transposed, y)
    a = psi_rate + multiply_columns(Jd.swapaxes(0, 1), y)
    y_rate = solve(-ed - multiply_columns(Jd, v) - multiply_columns(J, a))
    return v, a + multiply_columns(J_transposed, y_rate)


class JointFollowing(NamedTuple):
    """The maps of a site that follows joint by joint; `TaskFollowing` has the same methods."""

    Lambda: Array

    def compute_reference(
        self,
        rows: Rows,  # noqa: ARG002
        e: Array,
        ed: Array,
    ) -> tuple[Array, Array]:
        """Returns the reference velocity -Lambda e and its derivative, shape (K, n)."""
        return -self.Lambda * e, -self.Lambda * ed

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:  # noqa: ARG002
        """Returns the jump of r due to a jump of e, shape (K, n)."""
        return self.Lambda * de

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:  # noqa: ARG002
        """Returns the joint torque of a force along the shared coordinates, shape (K, n)."""
        return force

    def without_posture(self) -> "JointFollowing":
        """Returns the same maps without the motion towards a posture, which is none here."""
        return self

    def compute_damping_deviation(
        self,
        rows: Rows,  # noqa: ARG002
        e: Array,
    ) -> tuple[Array, Array]:
        """Returns zeros: there are no singular poses near which motion would be damped."""
        return np.zeros_like(e), np.zeros_like(e)


@dataclass(frozen=True)
class TaskFollowing:
    """The maps of a site that follows with its end effector, over K rows.

    Attributes:
        Lambda: gain of the error, 0 along an axis that the site does not follow, shape (m,).
        J: Jacobian of the followed axes, shape (K, m, n).
        Jd: its derivative, shape (K, m, n).
        psi: velocity towards the posture, shape (K, n), rad/s.
        psi_rate: its derivative, shape (K, n).
        inverse: inverse of J J' with its damping, shape (K, m, m).
        damping: damping, shape (K,), m^2.
        damping_rate: its derivative, shape (K,), m^2/s.
        least: lower bound of the least singular value, from which the damping is computed,
            shape (K,), m.
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
        """Returns the reference velocity v of the joints and its derivative a, shape (K, n)."""
        # `find_task_reference` has the rows on the last axis
        inverse = np.moveaxis(self.inverse[rows], 0, -1)
        v, a = find_task_reference(
            J=np.moveaxis(self.J[rows], 0, -1),
            Jd=np.moveaxis(self.Jd[rows], 0, -1),
            solve=partial(multiply_columns, inverse),
            posture=(self.psi[rows].T, self.psi_rate[rows].T),
            error=((self.Lambda * e).T, (self.Lambda * ed).T),
        )
        return v.T, a.T

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:
        """Returns the jump J+ Lambda de of r due to a jump de of e, shape (K, n)."""
        return self.compute_joint_torque(rows, self._solve(rows, self.Lambda * de))

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:
        """Returns the joint torque J'f of a force f at the end effector, shape (K, n)."""
        torque: Array = np.einsum("kij,ki->kj", self.J[rows], force)
        return torque

    def project_torque(self, torque: Array) -> Array:
        """Returns the force at the end effector of a joint torque, shape (K, m), N."""
        return self._solve(slice(None), np.einsum("kij,kj->ki", self.J, torque))

    def without_posture(self) -> "TaskFollowing":
        """Returns the same maps without the motion towards the posture: linear in e and ed."""
        still = np.zeros_like(self.psi)
        return replace(self, psi=still, psi_rate=still)

    def compute_damping_deviation(self, rows: Rows, e: Array) -> tuple[Array, Array]:
        """Returns the effect of the damping near singular poses; zero where no pose is damped.

        Returns:
            J r - x' - Lambda e, shape (K, m).
            a - v', shape (K, n).
        """
        damping = self.damping[rows, np.newaxis]
        rate = self.damping_rate[rows, np.newaxis]
        if not (damping.any() or rate.any()):
            return np.zeros_like(e), np.zeros_like(self.psi[rows])
        posture_velocity = np.einsum("kij,kj->ki", self.J[rows], self.psi[rows])
        y = self._solve(rows, -self.Lambda * e - posture_velocity)
        acceleration = self.compute_joint_torque(rows, self._solve(rows, rate * y))
        return damping * y, acceleration


Following = JointFollowing | TaskFollowing


def build_following(arm: ArmRows, q: Array, qd: Array, Lambda: Array) -> Following:
    """Returns the maps of a site over rows of its joint motion.

    Args:
        arm: arm of the site.
        q: joint angles, shape (K, n), rad.
        qd: joint velocities, shape (K, n), rad/s.
        Lambda: gain of the error, 0 along axes that are not followed, shape (n,) or (m,).
    """
    task = arm.task
    if isinstance(arm, PlanarArmRows) or task is None:
        return JointFollowing(Lambda)
    end_effector = arm.place_end_effector(q, qd)
    axes = np.array(task.axes)[:, np.newaxis]
    J = axes * task.scale * end_effector.J
    Jd = axes * task.scale * arm.jacobian_rate(q, qd)
    A = J @ J.transpose(0, 2, 1) + np.diag(1.0 - axes[:, 0])
    eigenvalues, basis = np.linalg.eigh(A)
    bounded = np.maximum(eigenvalues, _LEAST_EIGENVALUE)[:, np.newaxis]
    inverse = (basis / bounded) @ basis.transpose(0, 2, 1)
    # 1 / trace(A^-1) is a smooth lower bound of the least eigenvalue of A
    trace = np.trace(axes * inverse, axis1=1, axis2=2)
    least_eigenvalue = 1.0 / trace
    damping = np.maximum(task.singular_value**2 - least_eigenvalue, 0.0)
    half_A_rate = J @ Jd.transpose(0, 2, 1)
    A_rate = half_A_rate + half_A_rate.transpose(0, 2, 1)
    trace_rate = -np.trace(inverse @ A_rate @ inverse, axis1=1, axis2=2)
    damping_rate = np.where(damping > 0.0, trace_rate / trace**2, 0.0)
    if damping.any():
        inverse = np.linalg.inv(A + damping[:, np.newaxis, np.newaxis] * np.eye(len(axes)))
    return TaskFollowing(
        Lambda=Lambda,
        J=J,
        Jd=Jd,
        psi=task.posture_rate * (np.array(task.posture) - q),
        psi_rate=-task.posture_rate * qd,
        inverse=inverse,
        damping=damping,
        damping_rate=damping_rate,
        least=np.sqrt(least_eigenvalue),
    )

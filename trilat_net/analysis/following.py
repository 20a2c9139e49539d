"""How the law turns errors into motion and torque of the joints, over rows: joint by joint, or
in task space.

Invariant: written with NumPy from the equations of `docs/laws.md`, independently of the core; J
and J' of the followed axes alone count, and those that are not followed have no effect. Of
`find_task_reference` follows J v = -Lambda e - damping y: what is missed where the pose is
nearly singular.
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
"""Below this an eigenvalue of J J' is of an axis along which the end effector cannot move at
all.
"""


def find_task_reference(
    J: Numbers,
    Jd: Numbers,
    solve: Callable[[Numbers], Numbers],
    posture: tuple[Numbers, Numbers],
    error: tuple[Numbers, Numbers],
) -> tuple[Numbers, Numbers]:
    """Returns the reference velocity of the joints and its derivative, shape (n, ...).

        v = psi + J' y,               A y  = -Lambda e - J psi
        a = psi' + Jd' y + J' y',     A y' = -Lambda ed - Jd v - J (psi' + Jd' y)

    Args:
        J: Jacobian of the followed axes, shape (m, n, ...).
        Jd: its derivative.
        solve: A y = b for y, shape (m, ...), A being J J' + 1 of each axis that is not followed
            + damping.
        posture: psi and psi', shape (n, ...).
        error: Lambda e and Lambda ed, shape (m, ...).
    """
    psi, psi_rate = posture
    e, ed = error
    y = solve(-e - multiply_columns(J, psi))
    v = psi + multiply_columns(J.swapaxes(0, 1), y)
    a = psi_rate + multiply_columns(Jd.swapaxes(0, 1), y)
    y_rate = solve(-ed - multiply_columns(Jd, v) - multiply_columns(J, a))
    return v, a + multiply_columns(J.swapaxes(0, 1), y_rate)


class JointFollowing(NamedTuple):
    """A site that follows joint by joint; `TaskFollowing` has the same functions."""

    Lambda: Array

    def compute_reference(self, rows: Rows, e: Array, ed: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Returns the reference velocity -Lambda e and its derivative, shape (K, n)."""
        return -self.Lambda * e, -self.Lambda * ed

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:  # noqa: ARG002
        """Returns what a change of e adds to r, shape (K, n)."""
        return self.Lambda * de

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:  # noqa: ARG002
        """Returns the torque of a force along what sites share, shape (K, n)."""
        return force

    def without_posture(self) -> "JointFollowing":
        """Returns the same without a motion that no error asks for."""
        return self

    def compute_damping_deviation(self, rows: Rows, e: Array) -> tuple[Array, Array]:  # noqa: ARG002
        """Returns what damping near singular poses leaves of J r and of the reference
        acceleration: 0.
        """
        return np.zeros_like(e), np.zeros_like(e)


@dataclass(frozen=True)
class TaskFollowing:
    """A site that follows with its end effector, over K rows.

    Attributes:
        Lambda: 0 along an axis that it does not follow, shape (m,).
        J, Jd: Jacobian of the followed axes and its derivative, shape (K, m, n).
        psi, psi_rate: velocity towards the posture, and its derivative, shape (K, n).
        inverse: of J J' with its damping, shape (K, m, m).
        damping, damping_rate: shape (K,), m^2 and m^2/s.
        least: the lower bound of the least singular value that damping goes by, shape (K,), m.
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
        found: Array = np.einsum("kij,kj->ki", self.inverse[rows], b)
        return found

    def compute_reference(self, rows: Rows, e: Array, ed: Array) -> tuple[Array, Array]:
        """Returns v and a of the joints, shape (K, n)."""
        J, Jd, inverse = (np.moveaxis(x[rows], 0, -1) for x in (self.J, self.Jd, self.inverse))
        posture = self.psi[rows].T, self.psi_rate[rows].T
        error = (self.Lambda * e).T, (self.Lambda * ed).T
        v, a = find_task_reference(
            J=J, Jd=Jd, solve=partial(multiply_columns, inverse), posture=posture, error=error
        )
        return v.T, a.T

    def compute_jump_of_r(self, rows: Rows, de: Array) -> Array:
        """Returns what a change of e adds to r: J+ Lambda de, shape (K, n)."""
        return self.compute_joint_torque(rows, self._solve(rows, self.Lambda * de))

    def compute_joint_torque(self, rows: Rows, force: Array) -> Array:
        """Returns the torque of a force along what sites share: J'f, shape (K, n)."""
        torque: Array = np.einsum("kij,ki->kj", self.J[rows], force)
        return torque

    def project_torque(self, torque: Array) -> Array:
        """Returns what a torque of every row amounts to at the end effector, shape (K, m), N."""
        return self._solve(slice(None), np.einsum("kij,kj->ki", self.J, torque))

    def without_posture(self) -> "TaskFollowing":
        """Returns the same without a motion that no error asks for: linear in e and ed."""
        still = np.zeros_like(self.psi)
        return replace(self, psi=still, psi_rate=still)

    def compute_damping_deviation(self, rows: Rows, e: Array) -> tuple[Array, Array]:
        """Returns J r - x' - Lambda e, shape (K, m), and a - v', shape (K, n): 0 where nothing
        is damped.
        """
        damping = self.damping[rows, np.newaxis]
        rate = self.damping_rate[rows, np.newaxis]
        if not (damping.any() or rate.any()):
            return np.zeros_like(e), np.zeros_like(self.psi[rows])
        y = self._solve(
            rows, -self.Lambda * e - np.einsum("kij,kj->ki", self.J[rows], self.psi[rows])
        )
        return damping * y, self.compute_joint_torque(rows, self._solve(rows, rate * y))


Following = JointFollowing | TaskFollowing


def build_following(arm: ArmRows, q: Array, qd: Array, Lambda: Array) -> Following:
    """Returns how a site follows along rows of its joints, shape (K, n)."""
    task = arm.task
    if isinstance(arm, PlanarArmRows) or task is None:
        return JointFollowing(Lambda)
    place = arm.place_end_effector(q, qd)
    axes = np.array(task.axes)[:, np.newaxis]
    J, Jd = (axes * task.scale * x for x in (place.J, arm.jacobian_rate(q, qd)))
    A = J @ J.transpose(0, 2, 1) + np.diag(1.0 - axes[:, 0])
    turn, basis = np.linalg.eigh(A)
    inverse = (basis / np.maximum(turn, _LEAST_EIGENVALUE)[:, np.newaxis]) @ basis.transpose(
        0, 2, 1
    )
    trace = np.trace(axes * inverse, axis1=1, axis2=2)
    limit = task.singular_value**2
    least = 1.0 / trace
    damping = np.maximum(limit - least, 0.0)
    half = J @ Jd.transpose(0, 2, 1)
    bent = -np.trace(inverse @ (half + half.transpose(0, 2, 1)) @ inverse, axis1=1, axis2=2)
    if damping.any():
        inverse = np.linalg.inv(A + damping[:, np.newaxis, np.newaxis] * np.eye(len(axes)))
    damping_rate = np.where(damping > 0.0, bent / trace**2, 0.0)
    psi = task.posture_rate * (np.array(task.posture) - q)
    psi_rate = -task.posture_rate * qd
    return TaskFollowing(
        Lambda=Lambda,
        J=J,
        Jd=Jd,
        psi=psi,
        psi_rate=psi_rate,
        inverse=inverse,
        damping=damping,
        damping_rate=damping_rate,
        least=np.sqrt(least),
    )

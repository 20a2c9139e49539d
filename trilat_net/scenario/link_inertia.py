"""Corrects the masses and inertias of a robot's links.

Some URDF files contain inertias that are physically impossible, for example because one
principal moment exceeds the sum of the other two. A scenario can either specify other values,
or let the program balance the inertia, which replaces it with the nearest possible one. In this
module, a link is a rigid body of a robot arm.

Invariant:
    - A key in the scenario overrides the value in the file. Without the key, the file applies.
    - Balancing uses only sums, products, quotients and square roots in a fixed order, so the
      result has the same bits on every machine.
    - Balancing leaves a possible inertia unchanged.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from .. import fields
from ..core import Matrix
from .key_checks import field_names

JACOBI_SWEEPS = 12
"""Number of sweeps of Jacobi's method.

A symmetric 3 x 3 matrix is diagonal up to rounding errors after six or seven sweeps.
"""

ThreeReals = Annotated[tuple[fields.Real, ...], Meta(min_length=3, max_length=3)]
TensorEntries = Annotated[tuple[fields.Real, ...], Meta(min_length=6, max_length=6)]


class LinkInertia(fields.Frozen, frozen=True, omit_defaults=True):
    """Mass and inertia of a robot link that override those in its URDF file.

    Many URDF files contain wrong inertias or none at all.

    Attributes:
        mass_kg: Mass, in kg. 0 removes the body of the link. By default, the mass in the file.
        com_m: Centre of mass in the link frame, in m. By default, taken from the file, or the
            origin of the link frame if the file has none.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the centre of mass, in the axes of the
            link's frame. By default, taken from the file, or zero (a point mass) if the file
            has none.
    """

    mass_kg: fields.NotNegative | None = None
    com_m: ThreeReals | None = None
    inertia_kg_m2: TensorEntries | None = None

    def list_given_keys(self) -> list[str]:
        """Returns the names of the inertial parameters that the scenario specifies.

        The remaining parameters are taken from the URDF file of the arm.
        """
        keys = field_names(LinkInertia)
        return [key for key in keys if getattr(self, key) is not None]


def fill_tensor(entries: Sequence[float]) -> Matrix:
    """Returns the symmetric 3 x 3 inertia tensor with the given six entries, in kg m^2.

    Args:
        entries: The entries xx, xy, yy, xz, yz, zz, in kg m^2.
    """
    xx, xy, yy, xz, yz, zz = entries
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def balance_tensor(tensor: Matrix) -> Matrix:
    """Returns the physically possible inertia tensor nearest to a given one, in kg m^2.

    A tensor from a URDF file may be impossible, for example because of rounding. Let I_1, I_2
    and I_3 be its principal moments of inertia. The second moments of the mass along the
    principal axes are

        s_k = (I_1 + I_2 + I_3) / 2 - I_k.

    The tensor is possible if no s_k is negative. Otherwise negative s_k are set to zero, which
    projects the tensor onto the set of possible mass distributions. The moments are then
    recomputed:

        I_k = s_1 + s_2 + s_3 - s_k.

    The principal axes are unchanged. If only the triangle inequality was violated, the largest
    moment is also unchanged, and the two smaller moments increase by the same amount.

    Args:
        tensor: Symmetric inertia tensor about the centre of mass, in kg m^2.
    """
    moments, axes = _diagonalise(tensor)
    half_sum = 0.5 * (moments[0] + moments[1] + moments[2])
    if all(half_sum - moment >= 0.0 for moment in moments):
        return tensor
    second_moments = [max(half_sum - moment, 0.0) for moment in moments]
    total = second_moments[0] + second_moments[1] + second_moments[2]
    balanced = [total - second for second in second_moments]

    def compute_entry(i: int, j: int) -> float:
        """Returns one entry of the corrected inertia tensor, in kg m^2.

        The tensor is R diag(m) R', where the columns of R are the principal axes and m contains
        the corrected principal moments of inertia.

        Args:
            i: Row index, from 0 to 2.
            j: Column index, from 0 to 2.
        """
        first = axes[i][0] * balanced[0] * axes[j][0]
        second = axes[i][1] * balanced[1] * axes[j][1]
        third = axes[i][2] * balanced[2] * axes[j][2]
        return first + second + third

    lower_triangle = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return fill_tensor([compute_entry(i, j) for i, j in lower_triangle])


def _diagonalise(tensor: Matrix) -> tuple[list[float], list[list[float]]]:
    """Returns the principal moments of a symmetric tensor, and the principal axes as columns.

    Uses Jacobi's method in plain Python arithmetic, since results of LAPACK differ between
    machines in the last bits.
    """
    a = [list(row) for row in tensor]
    axes = [[float(i == j) for j in range(3)] for i in range(3)]
    for _ in range(JACOBI_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p][q] == 0.0:
                continue
            # The rotation that makes a[p][q] zero, with the smaller of the two possible angles.
            theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q])
            root = math.sqrt(theta * theta + 1.0)
            tangent = math.copysign(1.0, theta) / (abs(theta) + root)
            cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            _rotate_columns(matrix=a, p=p, q=q, cosine=cosine, sine=sine)
            _rotate_rows(matrix=a, p=p, q=q, cosine=cosine, sine=sine)
            _rotate_columns(matrix=axes, p=p, q=q, cosine=cosine, sine=sine)
    return [a[0][0], a[1][1], a[2][2]], axes


def _rotate_rows(matrix: list[list[float]], p: int, q: int, cosine: float, sine: float) -> None:
    """Applies a Jacobi rotation to two rows of a matrix, in place."""
    for column in range(3):
        upper = matrix[p][column]
        lower = matrix[q][column]
        matrix[p][column] = cosine * upper - sine * lower
        matrix[q][column] = sine * upper + cosine * lower


def _rotate_columns(
    matrix: list[list[float]], p: int, q: int, cosine: float, sine: float
) -> None:
    """Applies a Jacobi rotation to two columns of a matrix, in place."""
    for row in matrix:
        left = row[p]
        right = row[q]
        row[p] = cosine * left - sine * right
        row[q] = sine * left + cosine * right

"""Masses and inertias that a scenario sets for the links of a URDF, and their balancing.

Some files state inertias that no body can have. Balancing replaces such an inertia by the
nearest possible one.

Invariant:
    - A key in the scenario replaces the file's value. Without the key, the file's value stays.
    - Balancing uses sums, products, quotients and square roots in a fixed order, so that a
      balanced tensor has the same bits on every machine.
    - Balancing does not change a tensor that a body can have.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from .. import fields
from ..core.chain import Matrix

JACOBI_SWEEPS = 12
"""Sweeps of Jacobi's method.

A symmetric 3 x 3 matrix is diagonal to rounding after six or seven sweeps.
"""

ThreeReals = Annotated[tuple[fields.Real, ...], Meta(min_length=3, max_length=3)]
TensorEntries = Annotated[tuple[fields.Real, ...], Meta(min_length=6, max_length=6)]


class LinkInertia(fields.Frozen, frozen=True, omit_defaults=True):
    """The mass and inertia of a link, in place of the values in its file.

    Attributes:
        mass_kg: the mass; 0 removes the body of the link. Left out: as in the file.
        com_m: the centre of mass in the link's frame. Left out: as in the file, or the origin
            of the link's frame if the file does not state it.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the centre of mass in the axes of the
            link's frame. Left out: as in the file, or zero, the inertia of a point, if the file
            does not state it.
    """

    mass_kg: fields.NotNegative | None = None
    com_m: ThreeReals | None = None
    inertia_kg_m2: TensorEntries | None = None

    def list_given_keys(self) -> list[str]:
        """Returns the keys that the scenario gives."""
        keys = fields.field_names(LinkInertia)
        return [key for key in keys if getattr(self, key) is not None]


def fill_tensor(entries: Sequence[float]) -> Matrix:
    """Returns the symmetric tensor with the entries xx, xy, yy, xz, yz, zz."""
    xx, xy, yy, xz, yz, zz = entries
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def balance_tensor(tensor: Matrix) -> Matrix:
    """Returns the inertia tensor of the nearest mass distribution that a body can have.

    With the principal moments I_1, I_2, I_3, the second moments of the mass along the principal
    axes are

        s_k = (I_1 + I_2 + I_3) / 2 - I_k.

    A body can have the tensor if no s_k is negative. Negative s_k are set to zero, which is the
    projection onto the cone of possible distributions, and the moments are composed again:

        I_k = s_1 + s_2 + s_3 - s_k.

    The principal axes do not change. If only the triangle inequality failed, the largest moment
    does not change either, and the two smaller moments grow equally.

    Args:
        tensor: symmetric, kg m^2.
    """
    moments, axes = _diagonalise(tensor)
    half_sum = 0.5 * (moments[0] + moments[1] + moments[2])
    if all(half_sum - moment >= 0.0 for moment in moments):
        return tensor
    second_moments = [max(half_sum - moment, 0.0) for moment in moments]
    total = second_moments[0] + second_moments[1] + second_moments[2]
    balanced = [total - second for second in second_moments]

    def compute_entry(i: int, j: int) -> float:
        """Returns the entry (i, j) of axes diag(balanced) axes'."""
        first = axes[i][0] * balanced[0] * axes[j][0]
        second = axes[i][1] * balanced[1] * axes[j][1]
        third = axes[i][2] * balanced[2] * axes[j][2]
        return first + second + third

    lower_triangle = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return fill_tensor([compute_entry(i, j) for i, j in lower_triangle])


def _diagonalise(tensor: Matrix) -> tuple[list[float], list[list[float]]]:
    """Returns the principal moments of a symmetric tensor, and the principal axes as columns.

    This is Jacobi's method in plain arithmetic, because LAPACK's routines differ in the last
    bit between machines.
    """
    a = [list(row) for row in tensor]
    axes = [[float(i == j) for j in range(3)] for i in range(3)]
    for _ in range(JACOBI_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if a[p][q] == 0.0:
                continue
            # The rotation by which a[p][q] becomes zero; the smaller of the two angles.
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
    """Rotates the rows `p` and `q` of a matrix into each other, in place."""
    for column in range(3):
        upper = matrix[p][column]
        lower = matrix[q][column]
        matrix[p][column] = cosine * upper - sine * lower
        matrix[q][column] = sine * upper + cosine * lower


def _rotate_columns(
    matrix: list[list[float]], p: int, q: int, cosine: float, sine: float
) -> None:
    """Rotates the columns `p` and `q` of a matrix into each other, in place."""
    for row in matrix:
        left = row[p]
        right = row[q]
        row[p] = cosine * left - sine * right
        row[q] = sine * left + cosine * right

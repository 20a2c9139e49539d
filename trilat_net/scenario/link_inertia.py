"""Replaces the masses and inertias of a robot's bodies by stated or physically possible ones.

Some URDF files (XML descriptions of robots) contain inertias that no body can have, for example
because one principal moment exceeds the sum of the other two. The author of an experiment can
state other values in the scenario, or let the program balance the inertia, which replaces it by
the nearest possible one. A link is one body of a robot arm here.

Invariant:
    - A key in the scenario replaces the value in the file. Without the key, the file applies.
    - Balancing uses only sums, products, quotients and square roots in a fixed order, so that
      the result has the same bits on every machine.
    - Balancing does not change a possible inertia.
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
    """Mass and inertia of a robot's link that replace those in its URDF file.

    Many such files contain inertias that are wrong or missing.

    Attributes:
        mass_kg: Mass, in kg. 0 removes the body of the link. By default, the mass in the file.
        com_m: Centre of mass in the frame of the link, in m. By default, the centre of mass in
            the file, or the origin of the frame if the file states none.
        inertia_kg_m2: Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the centre of mass, in the axes of the
            link's frame. By default, the inertia in the file, or zero (a point mass) if the
            file states none.
    """

    mass_kg: fields.NotNegative | None = None
    com_m: ThreeReals | None = None
    inertia_kg_m2: TensorEntries | None = None

    def list_given_keys(self) -> list[str]:
        """Returns the names of the inertial parameters that the scenario states for the link.

        The others are taken from the URDF file of the arm.
        """
        keys = field_names(LinkInertia)
        return [key for key in keys if getattr(self, key) is not None]


def fill_tensor(entries: Sequence[float]) -> Matrix:
    """Returns the symmetric 3 x 3 inertia tensor of a body from its six different entries.

    Args:
        entries: The entries xx, xy, yy, xz, yz, zz, in this order, in kg m^2.
    """
    xx, xy, yy, xz, yz, zz = entries
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def balance_tensor(tensor: Matrix) -> Matrix:
    """Returns the inertia tensor nearest to a given one that a real body can have.

    The tensor in a URDF file may be impossible, for example because of rounding. Let I_1, I_2
    and I_3 be the principal moments of inertia. The second moments of the mass along the
    principal axes are

        s_k = (I_1 + I_2 + I_3) / 2 - I_k.

    A body can have the tensor if no s_k is negative. Otherwise the negative s_k are set to
    zero. This is the projection onto the set of possible mass distributions. The moments are
    then composed again:

        I_k = s_1 + s_2 + s_3 - s_k.

    The principal axes do not change. If only the triangle inequality was violated, the largest
    moment does not change either, and the two smaller ones grow by the same amount.

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
        """Returns an entry of the corrected inertia tensor, in kg m^2.

        The tensor is R diag(m) R', where the columns of R are the principal axes and m contains
        the corrected principal moments of inertia.

        Args:
            i: Row of the entry, from 0 to 2.
            j: Column of the entry, from 0 to 2.
        """
        first = axes[i][0] * balanced[0] * axes[j][0]
        second = axes[i][1] * balanced[1] * axes[j][1]
        third = axes[i][2] * balanced[2] * axes[j][2]
        return first + second + third

    lower_triangle = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    return fill_tensor([compute_entry(i, j) for i, j in lower_triangle])


def _diagonalise(tensor: Matrix) -> tuple[list[float], list[list[float]]]:
    """Returns the principal moments of a symmetric tensor, and the principal axes as columns.

    The method is Jacobi's, in plain Python arithmetic. The routines of LAPACK differ between
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
    """Rotates two rows of a matrix into each other by an angle, in place (Jacobi)."""
    for column in range(3):
        upper = matrix[p][column]
        lower = matrix[q][column]
        matrix[p][column] = cosine * upper - sine * lower
        matrix[q][column] = sine * upper + cosine * lower


def _rotate_columns(
    matrix: list[list[float]], p: int, q: int, cosine: float, sine: float
) -> None:
    """Rotates two columns of a matrix into each other by an angle, in place (Jacobi)."""
    for row in matrix:
        left = row[p]
        right = row[q]
        row[p] = cosine * left - sine * right
        row[q] = sine * left + cosine * right

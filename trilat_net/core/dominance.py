"""The dominance matrix: who follows whom, and by how much.

Law: rows sum to one, the diagonal is zero, and beta is the LEFT null vector of Upsilon.

Source: Eq. (6), (7), (20) of the paper. The paper takes beta = (1, 1, 1); that is the right null vector,
and a left one only where the columns sum to one as well. The left one of an irreducible matrix is its
Perron vector, positive and unique up to its length.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROW_SUM_TOLERANCE = 1e-9


def row_fault(row: Array, own: int) -> str | None:
    """Says what is wrong with one row of alpha, or None: Eq. (7) for N sites.

    Args:
        row: shares of the peers in a site's reference, shape (N,), dimensionless.
        own: the site's own index, whose share must be zero.
    """
    if not np.isfinite(row).all():
        return "shares must be finite numbers"
    if row[own] != 0.0:
        return f"a site does not follow itself, yet its own share is {row[own]:g}"
    if (row < 0.0).any() or (row > 1.0).any():
        return "shares must lie between 0 and 1"
    if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
        return f"shares must sum to 1, Eq. (7), and sum to {row.sum():.12g}"
    return None


def upsilon(alpha: Array) -> Array:
    """Returns Upsilon = alpha - I of Eq. (20), shape (N, N), for alpha of shape (N, N)."""
    return alpha - np.eye(len(alpha))


def irreducible(alpha: Array) -> bool:
    """True where every site reaches every other along the links that carry a share, alpha shape (N, N)."""
    reach = (alpha > 0.0) | np.eye(len(alpha), dtype=bool)
    for _ in range(len(alpha).bit_length()):
        reach = reach @ reach
    return bool(reach.all())


def perron(alpha: Array) -> Array:
    """Returns beta > 0 with beta' Upsilon = 0 and sum 1, shape (N,), for an irreducible alpha.

    By the elimination of Grassmann, Taksar and Heyman (1985): no subtraction occurs, so every entry is
    right to a few units in its last place, also where shares differ by many orders of magnitude.

    Args:
        alpha: the dominance matrix, shape (N, N).

    Raises:
        ValueError: alpha is reducible; then some site's weight would be zero, or beta not unique.
    """
    if not irreducible(alpha):
        raise ValueError("alpha is reducible: beta has a zero entry or is not unique")
    a = alpha.copy()
    size = len(a)
    for last in range(size - 1, 0, -1):
        a[:last, last] /= a[last, :last].sum()
        a[:last, :last] += np.outer(a[:last, last], a[last, :last])
    beta = np.zeros(size)
    beta[0] = 1.0
    for site in range(1, size):
        beta[site] = beta[:site] @ a[:site, site]
    normalised: Array = beta / beta.sum()
    return normalised

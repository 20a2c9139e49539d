"""The matrix exponential, and what a held input does over a period.

Law: exact to rounding for any matrix, by scaling and squaring of a diagonal Pade approximant. Higham, "The
scaling and squaring method for the matrix exponential revisited", SIAM J. Matrix Analysis and Applications 26
(2005); order 13.
"""

import math

import numpy as np

from ..core.arm import Array

_ORDER = 13
_LARGEST = 5.371920351148152
"""Up to this 1-norm the approximant of order 13 is exact to rounding."""


def exponential(matrix: Array) -> Array:
    """Returns exp(matrix), shape (n, n)."""
    size = float(np.abs(matrix).sum(axis=0).max()) if matrix.size else 0.0
    halvings = max(0, math.ceil(math.log2(size / _LARGEST))) if size > _LARGEST else 0
    scaled = matrix / 2.0**halvings
    above, below = np.zeros_like(scaled), np.zeros_like(scaled)
    power: Array = np.eye(len(scaled), dtype=np.float64)
    for k in range(_ORDER + 1):
        weight = math.comb(_ORDER, k) * math.factorial(2 * _ORDER - k) / math.factorial(2 * _ORDER)
        above += weight * power
        below += (-1.0) ** k * weight * power
        power = (power @ scaled).astype(np.float64)
    found = np.linalg.solve(below, above)
    for _ in range(halvings):
        found = found @ found
    return found.astype(np.float64)


def over_period(A: Array, B: Array, h_s: float) -> tuple[Array, Array]:
    """Returns exp(A h) and int_0^h exp(A s) ds B: what x' = A x + B u comes to under a held u.

    Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).

    Args:
        A: shape (n, n), 1/s.
        B: shape (n, m).
        h_s: the period, s.
    """
    n, m = B.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:] = A * h_s, B * h_s
    found = exponential(whole)
    return found[:n, :n], found[:n, n:]

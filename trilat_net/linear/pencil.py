"""A nonlinear eigenproblem Delta(s) v = 0 of a linear loop, whatever its Delta is, and Newton's method on it.

Law: a root is what solves the equation to rounding, never what a discretisation says; where it came from has
no influence on it.

Newton's method in the form of successive linear problems: Delta(s) v = mu Delta'(s) v is solved, and s - mu
of the smallest mu is the next s. It converges quadratically for simple roots and for multiple ones that have
as many vectors, which loops of identical sites have. Ruhe, "Algorithms for the nonlinear eigenvalue
problem", SIAM J. Numerical Analysis 10 (1973).
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array

Complex = NDArray[np.complex128]

STEPS = 30
CLOSE = 1e-9
"""A step so small, of 1 + abs(s), leaves an error of about its square."""
TOLERANCE = 1e-12
"""A root's residual, as a share of the size of Delta's terms."""
_TOGETHER = 1e-9
"""Singular values so small, of that size, belong to one root."""
_FAR = 1e6
"""A guess that leads so far away led nowhere, 1/s."""
_NULL = 1e-9
"""A singular value so small beside the largest is zero."""
_LONGEST_CHAIN = 4


class Pencil(Protocol):
    """What has characteristic roots."""

    def at(self, s: complex) -> tuple[Complex, Complex]:
        """Returns Delta(s) and its derivative, shape (n, n) each."""

    def size(self, s: complex) -> float:
        """Returns the sum of the norms of the terms of Delta(s): what rounding is a share of."""

    def taylor(self, power: int) -> Array:
        """Returns the coefficient of s^power of Delta about 0, shape (n, n)."""


class Solution(NamedTuple):
    """A root of a pencil.

    Attributes:
        s: the root, 1/s.
        multiplicity: how many vectors belong to it.
        taking_part: how much each state takes part in it, shape (n,): abs of the diagonal of the residue of
            Delta(s)^-1, which does not depend on units.
        residual: abs(Delta(s) v) over the size of Delta's terms.
    """

    s: complex
    multiplicity: int
    taking_part: Array
    residual: float


def solve(pencil: Pencil, first: complex) -> Solution | None:
    """Returns the root that Newton's method finds from a first guess, or None where it finds none.

    Args:
        pencil: the problem.
        first: the guess, 1/s.
    """
    s = complex(first)
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            try:
                mu = _step(pencil, s)
            except np.linalg.LinAlgError:
                return None
            s -= mu
            if not np.isfinite(s) or abs(s - first) > _FAR:
                return None
            if abs(mu) <= CLOSE * (1.0 + abs(s)):
                break
        return _solution(pencil, s)


def _step(pencil: Pencil, s: complex) -> complex:
    """Returns the smallest mu of Delta(s) v = mu Delta'(s) v."""
    delta, derivative = pencil.at(s)
    mu = np.linalg.eigvals(np.linalg.solve(derivative, delta))
    return complex(mu[np.argmin(np.abs(mu))])


def _solution(pencil: Pencil, s: complex) -> Solution | None:
    delta, derivative = pencil.at(s)
    if not np.isfinite(delta).all():
        return None
    left, values, right = np.linalg.svd(delta)
    size = pencil.size(s)
    residual = float(values[-1]) / size
    if not residual <= TOLERANCE:
        return None
    count = int(np.sum(values <= _TOGETHER * size))
    W, V = left[:, -count:], right[-count:].conj().T
    try:
        residue = V @ np.linalg.solve(W.conj().T @ derivative @ V, W.conj().T)
    except np.linalg.LinAlgError:
        return None
    return Solution(s, count, np.abs(np.diag(residue)), residual)


def moving_states(links: Array) -> list[int]:
    """Returns the places of the states that move and move others; each of the rest has a root at zero.

    Args:
        links: abs of what acts on the rate of each state, shape (n, n): row i, column j for j acts on i.
    """
    kept = list(range(len(links)))
    while True:
        inner = links[np.ix_(kept, kept)]
        idle = [place for n, place in enumerate(kept) if not inner[n].any() or not inner[:, n].any()]
        if not idle:
            return kept
        kept.remove(idle[0])


def zero_chains(pencil: Pencil) -> tuple[int, int]:
    """Returns how many roots are zero by structure, and how many of them only drift.

    With Delta(s) = D_0 + s D_1 + s^2 D_2 + ..., the block Toeplitz matrix of D_0 ... D_(m-1) has as many
    null vectors as there are roots at zero, each chain of them counted up to length m. Where that stops to
    rise with m all are counted; those of chains longer than 1 grow as t does.

    Args:
        pencil: the characteristic equation.
    """
    counts = [0]
    for length in range(1, _LONGEST_CHAIN + 1):
        terms = [pencil.taylor(power) for power in range(length)]
        n = len(terms[0])
        if not n:
            return 0, 0
        whole = np.zeros((n * length, n * length))
        for row in range(length):
            for column in range(row + 1):
                whole[row * n : (row + 1) * n, column * n : (column + 1) * n] = terms[row - column]
        values = np.linalg.svd(whole, compute_uv=False)
        counts.append(int(np.sum(values <= _NULL * values[0])))
        if counts[-1] == counts[-2]:
            break
    return counts[-1], counts[-1] - counts[1]

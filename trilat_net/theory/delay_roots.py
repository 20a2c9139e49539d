"""The rightmost characteristic roots of the continuous loop with delays.

Invariant: a discretisation whose order doubles until the wanted roots agree supplies guesses only; each
result solves det(s I - A - sum_k A_k exp(-s T_k)) = 0 to rounding.

The discretisation is the Chebyshev pseudospectral one of the infinitesimal generator. Breda, Maset and
Vermiglio, "Pseudospectral differencing methods for characteristic roots of delay differential equations",
SIAM J. Scientific Computing 27 (2005); differentiation matrix after Trefethen, "Spectral Methods in MATLAB"
(2000), barycentric weights after Berrut and Trefethen, "Barycentric Lagrange interpolation", SIAM Review 46
(2004).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from .characteristic_roots import (
    CharacteristicRoot,
    Complex,
    Spectrum,
    count_zero_roots,
    limit_blas_threads,
    refine_roots,
    select_moving_states,
    sort_root_guesses,
)
from .linear_loop import LinearLoop

INITIAL_ORDER = 12
MAX_GENERATOR_SIZE = 1600
"""The largest discretisation: its eigenvalues take some seconds."""
ROOT_AGREEMENT = 1e-9


class DelayPencil(NamedTuple):
    """Delta(s) = s I - A - sum_k A_k exp(-s T_k).

    Attributes:
        A: shape (n, n).
        delays_s: shape (K,), s.
        Ad: shape (K, n, n).
    """

    A: Array
    delays_s: Array
    Ad: Array

    def at(self, s: complex) -> tuple[Complex, Complex]:
        """See `pencil.Pencil`."""
        eye = np.eye(len(self.A))
        factors = np.exp(-s * self.delays_s)[:, np.newaxis, np.newaxis]
        late = factors * self.Ad
        delta = s * eye - self.A - late.sum(axis=0)
        derivative = eye + (self.delays_s[:, np.newaxis, np.newaxis] * late).sum(axis=0)
        return delta.astype(np.complex128), derivative.astype(np.complex128)

    def size(self, s: complex) -> float:
        """See `pencil.Pencil`."""
        late = np.exp(-s.real * self.delays_s) @ np.linalg.norm(self.Ad, axis=(1, 2))
        return float(abs(s) + np.linalg.norm(self.A) + late)

    def taylor(self, power: int) -> Array:
        """See `pencil.Pencil`."""
        factors = (-self.delays_s) ** power / math.factorial(power)
        own = {0: -self.A, 1: np.eye(len(self.A))}.get(power, np.zeros_like(self.A))
        found: Array = own - np.einsum("k,kab->ab", factors, self.Ad)
        return found

    @property
    def late(self) -> NDArray[np.intp]:
        """Places of the states that come into the loop after a delay."""
        return np.flatnonzero(np.abs(self.Ad).sum(axis=(0, 1)))


class MovingPart(NamedTuple):
    """The part of a loop that moves: a state that nothing changes, or that changes nothing, is left out.

    Attributes:
        pencil: its characteristic equation.
        names: of its states.
        constant: how many states were left out, each with a root at zero.
    """

    pencil: DelayPencil
    names: tuple[str, ...]
    constant: int


def extract_moving_part(loop: LinearLoop) -> MovingPart:
    """Returns the part of a loop that moves."""
    n = len(loop.A)
    Ad = np.array([delayed.A for delayed in loop.delayed]).reshape(-1, n, n)
    delays_s = np.array([delayed.delay_s for delayed in loop.delayed])
    kept = select_moving_states(np.abs(loop.A) + np.abs(Ad).sum(axis=0))
    rows, columns = np.ix_(kept, kept)
    inner = Ad[:, rows, columns]
    acts = np.array([bool(matrix.any()) for matrix in inner], dtype=bool)
    pencil = DelayPencil(loop.A[rows, columns], delays_s[acts], inner[acts])
    return MovingPart(pencil, tuple(loop.names[place] for place in kept), n - len(kept))


def compute_delay_spectrum(loop: LinearLoop, wanted: int = 6) -> Spectrum:
    """Returns the rightmost roots of a loop.

    Args:
        loop: the loop.
        wanted: how many, conjugate ones and multiple ones counted once.
    """
    with limit_blas_threads():
        return _spectrum(extract_moving_part(loop), wanted)


def _spectrum(kept: MovingPart, wanted: int) -> Spectrum:
    pencil, names, _ = kept
    zeros, drifting = count_zero_roots(pencil)
    total = kept.constant + zeros
    if not len(names):
        return Spectrum((), total, drifting, 0, 0)
    if not len(pencil.delays_s):
        guesses = sort_root_guesses(np.linalg.eigvals(pencil.A).astype(np.complex128), zeros)
        roots, dropped = refine_roots(pencil, guesses, names, wanted)
        return Spectrum(tuple(roots), total, drifting, dropped, 0)
    order, before = INITIAL_ORDER, None
    while True:
        guesses = sort_root_guesses(
            np.linalg.eigvals(discretise_generator(pencil, order)).astype(np.complex128), zeros
        )
        roots, dropped = refine_roots(pencil, guesses, names, wanted)
        if before is not None and _agree(before, roots):
            break
        if len(names) + 2 * order * len(pencil.late) > MAX_GENERATOR_SIZE:
            break
        before, order = roots, 2 * order
    return Spectrum(tuple(roots), total, drifting, dropped, order)


def _agree(before: list[CharacteristicRoot], now: list[CharacteristicRoot]) -> bool:
    return len(now) >= len(before) and all(
        any(abs(a.s - b.s) <= ROOT_AGREEMENT * (1.0 + abs(a.s)) for b in before) for a in now
    )


def discretise_generator(pencil: DelayPencil, order: int) -> Array:
    """Returns the discretised generator: the state, and the history of its delayed part at Chebyshev nodes.

    Args:
        pencil: the characteristic equation, with at least one delay.
        order: the degree M of the polynomial.
    """
    late, longest_s, n = pencil.late, float(pencil.delays_s.max()), len(pencil.A)
    nodes, derive = chebyshev_differentiation(order)
    theta_s = 0.5 * longest_s * (nodes - 1.0)  # from 0 down to the longest delay
    c = len(late)
    whole = np.zeros((n + order * c, n + order * c))
    whole[:n, :n] = pencil.A
    for delay_s, Ad in zip(pencil.delays_s, pencil.Ad, strict=True):
        weights = barycentric_row(theta_s, -float(delay_s))
        whole[:n, late] += weights[0] * Ad[:, late]
        whole[:n, n:] += np.kron(weights[1:], Ad[:, late])
    transport = derive[1:] * (2.0 / longest_s)
    whole[n:, n:] = np.kron(transport[:, 1:], np.eye(c))
    for place, state in enumerate(late):
        whole[n + place :: c, state] = transport[:, 0]
    return whole


def chebyshev_differentiation(order: int) -> tuple[Array, Array]:
    """Returns Chebyshev's extremal nodes from 1 to -1, shape (M + 1,), and their differentiation matrix."""
    places = np.arange(order + 1)
    nodes = np.cos(np.pi * places / order)
    scale = np.where((places == 0) | (places == order), 2.0, 1.0) * (-1.0) ** places
    apart = nodes[:, np.newaxis] - nodes + np.eye(order + 1)
    derive = np.outer(scale, 1.0 / scale) / apart
    derive -= np.diag(derive.sum(axis=1))
    return nodes, derive


def barycentric_row(nodes: Array, at: float) -> Array:
    """Returns by what the values at Chebyshev's nodes are multiplied to give the polynomial's value there."""
    apart = at - nodes
    hit: Array = (np.abs(apart) <= 1e-15 * np.abs(nodes).max()).astype(np.float64)
    if hit.any():
        return hit
    places = np.arange(len(nodes))
    weights = (-1.0) ** places * np.where((places == 0) | (places == len(nodes) - 1), 0.5, 1.0)
    terms = weights / apart
    shares: Array = terms / terms.sum()
    return shares

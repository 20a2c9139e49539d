"""The rightmost characteristic roots of the continuous loop with delays.

Invariant: a discretisation whose order doubles until the wanted roots agree supplies guesses only; each
result solves det(s I - A - sum_k A_k exp(-s T_k)) = 0 to rounding.

The discretisation is the Chebyshev pseudospectral one of the infinitesimal generator. Breda, Maset and
Vermiglio, "Pseudospectral differencing methods for characteristic roots of delay differential equations",
SIAM J. Scientific Computing 27 (2005); nodes after Trefethen, "Spectral Methods in MATLAB" (2000).
"""

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebvander

from ..core.vectors import Array
from .characteristic_roots import (
    CharacteristicRoot,
    MovingPart,
    Pencil,
    Spectrum,
    count_zero_roots,
    extract_moving_part,
    limit_blas_threads,
    refine_roots,
    sort_root_guesses,
)
from .linear_loop import LinearLoop

_INITIAL_ORDER = 12
MAX_GENERATOR_SIZE = 1600
"""The largest discretisation: its eigenvalues take some seconds."""
_ROOT_AGREEMENT = 1e-9


def find_moving_part(loop: LinearLoop) -> MovingPart:
    """Returns the part of a loop that moves."""
    Ad = np.array([term.A for term in loop.delayed]).reshape(-1, *loop.A.shape)
    delays_s = np.array([term.delay_s for term in loop.delayed])
    return extract_moving_part(Pencil(loop.A, delays_s, Ad), loop.names)


def compute_delay_spectrum(loop: LinearLoop, wanted: int = 6) -> Spectrum:
    """Returns the rightmost roots of a loop; conjugate ones and multiple ones count once in `wanted`."""
    with limit_blas_threads():
        pencil, names, constant = find_moving_part(loop)
        zeros, drifting = count_zero_roots(pencil)
        if not len(names):
            return Spectrum((), constant + zeros, drifting, 0, 0)
        has_delays = len(pencil.delays) > 0
        order, before = _INITIAL_ORDER if has_delays else 0, None
        while True:
            matrix = discretise_generator(pencil, order) if has_delays else pencil.A
            guesses = sort_root_guesses(np.linalg.eigvals(matrix).astype(np.complex128), zeros)
            roots, dropped = refine_roots(pencil, guesses, names, wanted)
            too_large = len(names) + 2 * order * len(pencil.delayed_states) > MAX_GENERATOR_SIZE
            if not has_delays or too_large or (before is not None and _agree(before, roots)):
                return Spectrum(tuple(roots), constant + zeros, drifting, dropped, order)
            before, order = roots, 2 * order


def _agree(before: list[CharacteristicRoot], now: list[CharacteristicRoot]) -> bool:
    return len(now) >= len(before) and all(
        any(abs(a.s - b.s) <= _ROOT_AGREEMENT * (1.0 + abs(a.s)) for b in before) for a in now
    )


def discretise_generator(pencil: Pencil, order: int) -> Array:
    """Returns the discretised generator of a pencil with delays, by polynomials of degree `order`.

    Its states are the loop's, and the history of their delayed part at Chebyshev nodes.
    """
    delayed, longest_s, n = pencil.delayed_states, float(pencil.delays.max()), len(pencil.A)
    c = len(delayed)
    whole = np.zeros((n + order * c, n + order * c))
    whole[:n, :n] = pencil.A
    # history over [-longest, 0] as a polynomial of x in [-1, 1]
    for weights, Ad in zip(
        chebyshev_interpolation(order, 1.0 - 2.0 * pencil.delays / longest_s), pencil.Ad, strict=True
    ):
        whole[:n, delayed] += weights[0] * Ad[:, delayed]
        whole[:n, n:] += np.kron(weights[1:], Ad[:, delayed])
    transport = chebyshev_differentiation(order)[1:] * (2.0 / longest_s)
    whole[n:, n:] = np.kron(transport[:, 1:], np.eye(c))
    for place, state in enumerate(delayed):
        whole[n + place :: c, state] = transport[:, 0]
    return whole


def chebyshev_nodes(order: int) -> Array:
    """Returns Chebyshev's extremal nodes from 1 to -1, shape (M + 1,)."""
    return np.cos(np.pi * np.arange(order + 1) / order)


def chebyshev_interpolation(order: int, x: Array) -> Array:
    """Returns the matrix from values at the nodes to the polynomial's values at x, shape (K, M + 1)."""
    at_nodes = chebvander(chebyshev_nodes(order), order)
    weights: Array = np.linalg.solve(at_nodes.T, chebvander(x, order).T).T.astype(np.float64)
    return weights


def chebyshev_differentiation(order: int) -> Array:
    """Returns the matrix from values at the nodes to the polynomial's derivatives there."""
    nodes = chebyshev_nodes(order)
    slopes = chebvander(nodes, order - 1) @ chebder(np.eye(order + 1))
    matrix: Array = np.linalg.solve(chebvander(nodes, order).T, slopes.T).T.astype(np.float64)
    return matrix

"""Characteristic roots of a nonlinear eigenproblem Delta(s) v = 0: of loops with delays, and
those at zero.

Invariant: a root solves the equation to rounding, whatever discretisation its first guess came
from. Roots at zero that are there for every delay (shared poses, estimates without excitation)
are counted, and never called the rightmost.

Newton's method in the form of successive linear problems: solve Delta(s) v = mu Delta'(s) v and
subtract the smallest mu from s. It converges quadratically for simple roots, and for multiple
ones with as many vectors, which loops of identical sites have. Ruhe, "Algorithms for the
nonlinear eigenvalue problem", SIAM J. Numerical Analysis 10 (1973).

Guesses for the continuous loop come from the Chebyshev pseudospectral discretisation of the
infinitesimal generator, whose order doubles until the wanted roots agree. Breda, Maset and
Vermiglio, "Pseudospectral differencing methods for characteristic roots of delay differential
equations", SIAM J. Scientific Computing 27 (2005); nodes after Trefethen, "Spectral Methods in
MATLAB" (2000).

`limit_blas_threads` keeps OpenBLAS on one thread for these small matrices: it shares products
of a hundred rows out to all cores and busy-waits, which takes a hundred times as long if
another process has a core.
"""

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.linalg
from numpy.polynomial.chebyshev import chebder, chebvander
from numpy.typing import NDArray
from scipy.linalg import eigvals

from ..core.vectors import Array
from .linear_loop import LinearLoop

Complex = NDArray[np.complex128]

SAME_ROOT_TOLERANCE = 1e-8
"""Roots that differ by less, relative to 1 + abs(s), are one."""
STABILITY_EDGE_PER_S = 1e-6
"""A rightmost root within this of the imaginary axis is on it."""
ROOT_RESIDUAL_TOLERANCE = 1e-12
"""Largest residual of a root, relative to the size of Delta's terms."""
_MAX_NEWTON_STEPS = 30
_STEP_TOLERANCE = 1e-9
"""A step this small, relative to 1 + abs(s), leaves an error of about its square."""
_SAME_VALUE = 1e-11
"""Singular values this small, relative to Delta's terms, belong to one root."""
_MAX_DISTANCE_PER_S = 1e6
"""Newton's method has failed if it is this far from its guess, 1/s."""
ZERO_SHARE = 1e-12
"""A singular value this small, relative to the largest, is zero."""
_LONGEST_CHAIN = 4
NAMED_SHARE = 0.3
"""States with at least this share of the largest participation are named."""
_INITIAL_ORDER = 12
MAX_GENERATOR_SIZE = 1600
"""The largest discretisation: its eigenvalues take some seconds."""
_ROOT_AGREEMENT = 1e-9
_BLAS_SYMBOLS = (
    "scipy_openblas_{}_num_threads64_",
    "openblas_{}_num_threads64_",
    "openblas_{}_num_threads",
)


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Limits NumPy's linear algebra to one thread."""
    functions = _find_blas_functions()
    if functions is None:
        yield
        return
    get_threads, set_threads = functions
    before = get_threads()
    set_threads(1)
    try:
        yield
    finally:
        set_threads(before)


@cache
def _find_blas_functions() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Returns the functions that read and set OpenBLAS's number of threads, or None."""
    module = getattr(numpy.linalg, "_umath_linalg", None)
    try:
        library = ctypes.CDLL(module.__file__)  # type: ignore[union-attr]
    except (AttributeError, OSError, TypeError):
        return None
    for name in _BLAS_SYMBOLS:
        try:
            return getattr(library, name.format("get")), getattr(library, name.format("set"))
        except AttributeError:
            continue
    return None


class Pencil(NamedTuple):
    """Delta(s) = s E - A - sum_k A_k exp(-s T_k).

    Attributes:
        A: shape (n, n).
        delays: T_k, s, shape (K,).
        Ad: A_k, shape (K, n, n).
        E: 1 of each state that has a rate, 0 of one that the others give at once; None: all
            have one.
    """

    A: Array
    delays: NDArray[Any]
    Ad: Array
    E: Array | None = None

    @property
    def rates(self) -> Array:
        """The matrix of s in Delta(s): the unit matrix, with zeros for states without a rate."""
        return np.eye(len(self.A)) if self.E is None else np.diag(self.E)

    def evaluate(self, s: complex) -> tuple[Complex, Complex]:
        """Returns Delta(s) and its derivative, shape (n, n) each."""
        delayed = np.exp(-s * self.delays)[:, np.newaxis, np.newaxis] * self.Ad
        delta = s * self.rates - self.A - delayed.sum(axis=0)
        derivative = self.rates + (self.delays[:, np.newaxis, np.newaxis] * delayed).sum(axis=0)
        return delta.astype(np.complex128), derivative.astype(np.complex128)

    def size(self, s: complex) -> float:
        """Returns the sum of the norms of the terms of Delta(s): residuals are relative to it."""
        delayed = np.exp(-s.real * self.delays) @ np.linalg.norm(self.Ad, axis=(1, 2))
        return float(abs(s) + np.linalg.norm(self.A) + delayed)

    def taylor(self, power: int) -> Array:
        """Returns the coefficient of s^power of Delta about 0, shape (n, n)."""
        own = {0: -self.A, 1: self.rates}.get(power, 0.0)
        late = np.einsum("k,kab->ab", (-self.delays) ** power, self.Ad) / math.factorial(power)
        coefficient: Array = own - late
        return coefficient

    @property
    def delayed_states(self) -> NDArray[np.intp]:
        """Places of the states that act after a delay."""
        return np.flatnonzero(np.abs(self.Ad).sum(axis=(0, 1)))


MovingPart = tuple[Pencil, tuple[str, ...], int]
"""A loop without the states that nothing changes, or that change nothing: its characteristic
equation, the names of its states, and the number of states left out, each with a root at
zero.
"""


def extract_moving_part(pencil: Pencil, names: Sequence[str]) -> MovingPart:
    """Returns the part of a loop that moves."""
    # of state j on the rate of state i
    effects = np.abs(pencil.A) + np.abs(pencil.Ad).sum(axis=0)
    kept = list(range(len(names)))
    while True:
        inner = effects[np.ix_(kept, kept)]
        idle = [
            place for n, place in enumerate(kept) if not inner[n].any() or not inner[:, n].any()
        ]
        if not idle:
            break
        kept.remove(idle[0])
    rows, columns = np.ix_(kept, kept)
    Ad = pencil.Ad[:, rows, columns]
    acts = Ad.any(axis=(1, 2))
    E = None if pencil.E is None else pencil.E[kept]
    moving = pencil._replace(
        A=pencil.A[rows, columns], delays=pencil.delays[acts], Ad=Ad[acts], E=E
    )
    return moving, tuple(names[place] for place in kept), len(names) - len(kept)


class CharacteristicRoot(NamedTuple):
    """One characteristic root, or a pair of conjugate ones.

    Attributes:
        s: the root, with an imaginary part that is not negative, 1/s.
        multiplicity: number of modes that share it.
        states: names of the states that participate most, the largest first.
    """

    s: complex
    multiplicity: int
    states: tuple[str, ...]

    @property
    def damping(self) -> float:
        """Damping ratio, -re / abs(s)."""
        return -self.s.real / abs(self.s)

    @property
    def description(self) -> str:
        """The states that participate most, grouped by name, as in "q2 of m1, m2, s"."""
        sites: dict[str, list[str]] = {}
        for state in self.states:
            site, _, name = state.partition(".")
            sites.setdefault(name, []).append(site)
        return "; ".join(
            f"{name} of {', '.join(sorted(names))}" for name, names in sites.items()
        )


class Spectrum(NamedTuple):
    """Roots of a loop.

    Attributes:
        roots: the rightmost ones that are not zero by structure, by falling real part.
        zeros: number of roots that are zero by structure.
        drifting: number of those without a vector of their own, which grow with t.
        dropped: number of candidates that led to no root.
        order: of the discretisation that gave the candidates; 0 if none was needed.
        span_s: the period of delays and tick rates over which they are computed, or the span of
            delays that do not repeat, s; None if each tick is like the one before.
        deviation_per_s: of the rightmost root, if delays do not repeat, by the parts of the
            span, 1/s.
    """

    roots: tuple[CharacteristicRoot, ...]
    zeros: int
    drifting: int
    dropped: int
    order: int
    span_s: float | None = None
    deviation_per_s: float | None = None

    @property
    def basis(self) -> str:
        """What it is computed over, in words; "" if each tick is like the one before."""
        if self.span_s is None:
            return ""
        if self.deviation_per_s is None:
            return f", over the period of {self.span_s:.6g} s"
        return (
            f", over {self.span_s:.4g} s of the delays in use, +- {self.deviation_per_s:.1g} /s"
        )

    @property
    def rightmost(self) -> CharacteristicRoot | None:
        """The rightmost root that is not zero by structure."""
        return self.roots[0] if self.roots else None

    @property
    def verdict(self) -> str:
        """stable, unstable, or at the edge."""
        re = self.roots[0].s.real if self.roots else -math.inf
        edge_per_s = max(STABILITY_EDGE_PER_S, self.deviation_per_s or 0.0)
        if re > edge_per_s:
            return "unstable"
        return "at the edge" if re >= -edge_per_s or self.drifting else "stable"


def _solve_for_root(
    pencil: Pencil, first: complex, names: Sequence[str]
) -> CharacteristicRoot | None:
    """Returns the root that Newton's method finds from a first guess, 1/s, or None if it finds
    none.
    """
    s = complex(first)
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            delta, derivative = pencil.evaluate(s)
            # exp(-s T) far to the left
            if not (np.isfinite(delta).all() and np.isfinite(derivative).all()):
                return None
            try:
                if pencil.E is None:
                    mu = np.linalg.eigvals(np.linalg.solve(derivative, delta))
                else:  # states without a rate make infinite ones
                    mu = eigvals(delta, derivative)
                    mu = mu[np.isfinite(mu)]
            except np.linalg.LinAlgError:
                return None
            if not len(mu):
                return None
            step = complex(mu[np.argmin(np.abs(mu))])
            s -= step
            if not np.isfinite(s) or abs(s - first) > _MAX_DISTANCE_PER_S:
                return None
            if abs(step) <= _STEP_TOLERANCE * (1.0 + abs(s)):
                break
        shares = _measure_participation(pencil, s)
    if shares is None:
        return None
    states = np.round(shares[1] / shares[1].max(), 6)  # equal ones stay in their order
    order = [int(n) for n in np.argsort(-states, kind="stable") if states[n] >= NAMED_SHARE]
    rounded = complex(s.real, abs(s.imag) if abs(s.imag) > SAME_ROOT_TOLERANCE else 0.0)
    return CharacteristicRoot(rounded, shares[0], tuple(names[n] for n in order))


def _measure_participation(pencil: Pencil, s: complex) -> tuple[int, Array] | None:
    """Returns the number of vectors of a root at s, and each state's participation; None if it
    is no root.

    Participation is the abs of the diagonal of the residue of Delta(s)^-1, which does not
    depend on units.
    """
    delta, derivative = pencil.evaluate(s)
    if not np.isfinite(delta).all():
        return None
    left, values, right = np.linalg.svd(delta)
    size = pencil.size(s)
    if not float(values[-1]) / size <= ROOT_RESIDUAL_TOLERANCE:
        return None
    count = int(np.sum(values <= _SAME_VALUE * size))
    W = left[:, -count:]
    V = right[-count:].conj().T
    try:
        residue = V @ np.linalg.solve(W.conj().T @ derivative @ V, W.conj().T)
    except np.linalg.LinAlgError:
        return None
    return count, np.abs(np.diag(residue))


def count_zero_roots(pencil: Pencil) -> tuple[int, int]:
    """Returns the numbers of roots that are zero by structure, and of those among them that
    drift.

    With Delta(s) = D_0 + s D_1 + s^2 D_2 + ..., the block Toeplitz matrix of D_0 ... D_(m-1)
    has as many null vectors as there are roots at zero, each chain of them counted up to length
    m. When that number stops rising with m all are counted; those of chains longer than 1 grow
    as t does.
    """
    counts = [0]
    for length in range(1, _LONGEST_CHAIN + 1):
        terms = [pencil.taylor(power) for power in range(length)]
        if not len(terms[0]):
            return 0, 0
        toeplitz = np.sum(
            [np.kron(np.eye(length, k=-power), D) for power, D in enumerate(terms)], axis=0
        )
        values = np.linalg.svd(toeplitz, compute_uv=False)
        counts.append(int(np.sum(values <= ZERO_SHARE * values[0])))
        if counts[-1] == counts[-2]:
            break
    return counts[-1], counts[-1] - counts[1]


def refine_roots(
    pencil: Pencil, candidates: Complex, names: Sequence[str], wanted: int
) -> tuple[list[CharacteristicRoot], int]:
    """Returns the rightmost `wanted` roots near some candidates, and the number of candidates
    dropped.

    Candidates are guesses of nonzero roots, shape (K,), by falling real part; after two more
    than wanted the others are skipped, because Newton's method may change their order.
    """
    found: list[CharacteristicRoot] = []
    dropped = 0
    for guess in candidates:
        if guess.imag < -SAME_ROOT_TOLERANCE * (1.0 + abs(guess)):
            continue
        if len(found) >= wanted + 2:
            break
        root = _solve_for_root(pencil, complex(guess), names)
        if root is None or abs(root.s) < SAME_ROOT_TOLERANCE:
            dropped += 1
        elif all(
            abs(root.s - one.s) >= SAME_ROOT_TOLERANCE * (1.0 + abs(root.s)) for one in found
        ):
            found.append(root)
    return sorted(found, key=lambda one: (-round(one.s.real, 9), one.s.imag))[:wanted], dropped


def find_moving_part(loop: LinearLoop) -> MovingPart:
    """Returns the part of a loop that moves."""
    Ad = np.array([term.A for term in loop.delayed]).reshape(-1, *loop.A.shape)
    delays_s = np.array([term.delay_s for term in loop.delayed])
    moving, names, constant = extract_moving_part(
        Pencil(loop.A, delays_s, Ad, E=loop.E), loop.names
    )
    return moving, names, constant + loop.omitted_states


def compute_delay_spectrum(loop: LinearLoop, wanted: int = 6) -> Spectrum:
    """Returns the rightmost roots of a loop; conjugate ones and multiple ones count once in
    `wanted`.
    """
    with limit_blas_threads():
        pencil, names, constant = find_moving_part(loop)
        zeros, drifting = count_zero_roots(pencil)
        if not len(names):
            return Spectrum(
                roots=(), zeros=constant + zeros, drifting=drifting, dropped=0, order=0
            )
        has_delays = len(pencil.delays) > 0
        order = _INITIAL_ORDER if has_delays else 0
        before = None
        while True:
            matrix = discretise_generator(pencil, order) if has_delays else pencil.A
            if pencil.E is not None:
                matrix = _eliminate_states(matrix, pencil.E)
            values = np.linalg.eigvals(matrix).astype(np.complex128)
            # the smallest stand for zeros
            values = values[np.argsort(np.abs(values), kind="stable")][zeros:]
            falling = np.lexsort((np.abs(values.imag), -np.round(values.real, 9)))
            roots, dropped = refine_roots(pencil, values[falling], names, wanted)
            too_large = len(names) + 2 * order * len(pencil.delayed_states) > MAX_GENERATOR_SIZE
            if not has_delays or too_large or (before is not None and _agree(before, roots)):
                return Spectrum(
                    roots=tuple(roots),
                    zeros=constant + zeros,
                    drifting=drifting,
                    dropped=dropped,
                    order=order,
                )
            before = roots
            order = 2 * order


def _eliminate_states(matrix: Array, E: Array) -> Array:
    given = np.flatnonzero(E == 0.0)
    kept = np.setdiff1d(np.arange(len(matrix)), given)
    ours = np.linalg.solve(matrix[np.ix_(given, given)], matrix[np.ix_(given, kept)])
    return matrix[np.ix_(kept, kept)] - matrix[np.ix_(kept, given)] @ ours


def _agree(before: list[CharacteristicRoot], now: list[CharacteristicRoot]) -> bool:
    return len(now) >= len(before) and all(
        any(abs(a.s - b.s) <= _ROOT_AGREEMENT * (1.0 + abs(a.s)) for b in before) for a in now
    )


def discretise_generator(pencil: Pencil, order: int) -> Array:
    """Returns the discretised generator of a pencil with delays, by polynomials of degree
    `order`.

    Its states are the loop's, and the history of their delayed part at Chebyshev nodes.
    """
    delayed = pencil.delayed_states
    longest_s = float(pencil.delays.max())
    n = len(pencil.A)
    c = len(delayed)
    whole = np.zeros((n + order * c, n + order * c))
    whole[:n, :n] = pencil.A
    # history over [-longest, 0] as a polynomial of x in [-1, 1]
    for weights, Ad in zip(
        chebyshev_interpolation(order, 1.0 - 2.0 * pencil.delays / longest_s),
        pencil.Ad,
        strict=True,
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
    """Returns the matrix from values at the nodes to the polynomial's values at x, shape (K, M
    + 1).
    """
    at_nodes = chebvander(chebyshev_nodes(order), order)
    return np.linalg.solve(at_nodes.T, chebvander(x, order).T).T.astype(np.float64)


def chebyshev_differentiation(order: int) -> Array:
    """Returns the matrix from values at the nodes to the polynomial's derivatives there."""
    nodes = chebyshev_nodes(order)
    slopes = chebvander(nodes, order - 1) @ chebder(np.eye(order + 1))
    return np.linalg.solve(chebvander(nodes, order).T, slopes.T).T.astype(np.float64)

"""Characteristic roots of a nonlinear eigenproblem Delta(s) v = 0.

Newton's method, root types, roots at zero.

Invariant: a root solves the equation to rounding, whatever discretisation its first guess came from.
Roots at zero that are there for every delay (shared poses, estimates without excitation) are counted, and
never called the rightmost.

Newton's method in the form of successive linear problems: solve Delta(s) v = mu Delta'(s) v and subtract
the smallest mu from s. It converges quadratically for simple roots, and for multiple ones with as many
vectors, which loops of identical sites have. Ruhe, "Algorithms for the nonlinear eigenvalue problem",
SIAM J. Numerical Analysis 10 (1973).

`limit_blas_threads` keeps OpenBLAS on one thread for these small matrices: it shares products of a
hundred rows out to all cores and busy-waits, which takes a hundred times as long if another process has a
core.
"""

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
import numpy.linalg
from numpy.typing import NDArray

from ..core.vectors import Array

_BLAS_SYMBOLS = ("scipy_openblas_{}_num_threads64_", "openblas_{}_num_threads64_", "openblas_{}_num_threads")


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Lets NumPy's linear algebra use one thread for a while."""
    found = _find_blas_functions()
    if found is None:
        yield
        return
    get, put = found
    before = get()
    put(1)
    try:
        yield
    finally:
        put(before)


@cache
def _find_blas_functions() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Returns how the number of threads is read and written, or None."""
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


Complex = NDArray[np.complex128]

MAX_NEWTON_STEPS = 30
ROOT_STEP_TOLERANCE = 1e-9
"""A step so small, of 1 + abs(s), leaves an error of about its square."""
ROOT_RESIDUAL_TOLERANCE = 1e-12
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


class PencilRoot(NamedTuple):
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


def solve_for_root(pencil: Pencil, first: complex) -> PencilRoot | None:
    """Returns the root that Newton's method finds from a first guess, or None where it finds none.

    Args:
        pencil: the problem.
        first: the guess, 1/s.
    """
    s = complex(first)
    with np.errstate(all="ignore"):
        for _ in range(MAX_NEWTON_STEPS):
            try:
                mu = _step(pencil, s)
            except np.linalg.LinAlgError:
                return None
            s -= mu
            if not np.isfinite(s) or abs(s - first) > _FAR:
                return None
            if abs(mu) <= ROOT_STEP_TOLERANCE * (1.0 + abs(s)):
                break
        return _solution(pencil, s)


def _step(pencil: Pencil, s: complex) -> complex:
    """Returns the smallest mu of Delta(s) v = mu Delta'(s) v."""
    delta, derivative = pencil.at(s)
    mu = np.linalg.eigvals(np.linalg.solve(derivative, delta))
    return complex(mu[np.argmin(np.abs(mu))])


def _solution(pencil: Pencil, s: complex) -> PencilRoot | None:
    delta, derivative = pencil.at(s)
    if not np.isfinite(delta).all():
        return None
    left, values, right = np.linalg.svd(delta)
    size = pencil.size(s)
    residual = float(values[-1]) / size
    if not residual <= ROOT_RESIDUAL_TOLERANCE:
        return None
    count = int(np.sum(values <= _TOGETHER * size))
    W, V = left[:, -count:], right[-count:].conj().T
    try:
        residue = V @ np.linalg.solve(W.conj().T @ derivative @ V, W.conj().T)
    except np.linalg.LinAlgError:
        return None
    return PencilRoot(s, count, np.abs(np.diag(residue)), residual)


def select_moving_states(links: Array) -> list[int]:
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


def count_zero_roots(pencil: Pencil) -> tuple[int, int]:
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


SAME_ROOT_TOLERANCE = 1e-8
"""Roots that differ by less, of 1 + abs(s), are one."""
STABILITY_EDGE_PER_S = 1e-6
"""A rightmost root within this of the imaginary axis is on it."""
_PART = 0.3
"""A state whose part is at least this share of the largest is named."""


class CharacteristicRoot(NamedTuple):
    """One characteristic root, or a pair of conjugate ones.

    Attributes:
        s: the root, with an imaginary part that is not negative, 1/s.
        multiplicity: how many modes share it.
        states: the names of the states that take part in it most, the largest first.
    """

    s: complex
    multiplicity: int
    states: tuple[str, ...]

    @property
    def re_per_s(self) -> float:
        """Its real part: the mode goes as exp of this times t."""
        return self.s.real

    @property
    def im_rad_s(self) -> float:
        """Its imaginary part: the frequency of the mode."""
        return self.s.imag

    @property
    def damping(self) -> float:
        """Its damping ratio, -re / abs(s)."""
        return -self.s.real / abs(self.s)

    @property
    def words(self) -> str:
        """The states that take part most, those of one name together, as in "q2 of m1, m2, s"."""
        sites: dict[str, list[str]] = {}
        for state in self.states:
            site, _, name = state.partition(".")
            sites.setdefault(name, []).append(site)
        return "; ".join(f"{name} of {', '.join(sorted(who))}" for name, who in sites.items())


class Spectrum(NamedTuple):
    """Roots of a loop.

    Attributes:
        roots: the rightmost ones that are not zero by structure, by falling real part.
        zeros: how many roots are zero by structure.
        drifting: how many of those only drift: they have no vector of their own, and grow with t.
        dropped: how many candidates were no roots.
        order: of the discretisation that gave the candidates; 0 where none was needed.
    """

    roots: tuple[CharacteristicRoot, ...]
    zeros: int
    drifting: int
    dropped: int
    order: int

    @property
    def rightmost(self) -> CharacteristicRoot | None:
        """The rightmost root that is not zero by structure."""
        return self.roots[0] if self.roots else None

    @property
    def verdict(self) -> str:
        """stable, unstable, or at the edge."""
        re = self.roots[0].s.real if self.roots else -math.inf
        if re > STABILITY_EDGE_PER_S:
            return "unstable"
        return "at the edge" if re >= -STABILITY_EDGE_PER_S or self.drifting else "stable"


def refine_roots(
    pencil: Pencil,
    candidates: Complex,
    names: Sequence[str],
    wanted: int,
    tries: int | None = None,
    period_rad_s: float = math.inf,
) -> tuple[list[CharacteristicRoot], int]:
    """Returns the rightmost roots near some candidates, and how many candidates were dropped.

    Args:
        pencil: the problem.
        candidates: guesses of nonzero roots, shape (K,), by falling real part.
        names: of the states.
        wanted: how many roots.
        tries: after how many roots the rest of the candidates is left; by default two more than wanted,
            because Newton may change their order.
        period_rad_s: imaginary parts that differ by it are the same, as those of sampled loops are.
    """
    found: list[PencilRoot] = []
    dropped = 0
    for guess in candidates:
        if guess.imag < -SAME_ROOT_TOLERANCE * (1.0 + abs(guess)):
            continue
        if len(found) >= (tries or wanted + 2):
            break
        solution = solve_for_root(pencil, complex(guess))
        if solution is None or abs(solution.s) < SAME_ROOT_TOLERANCE:
            dropped += 1
            continue
        solution = solution._replace(s=_folded(solution.s, period_rad_s))
        if not any(_same(solution.s, other.s) for other in found):
            found.append(solution)
    found.sort(key=lambda one: -one.s.real)
    return [_root(one, names) for one in found[:wanted]], dropped


def _folded(s: complex, period_rad_s: float) -> complex:
    if math.isinf(period_rad_s):
        return s
    return complex(s.real, math.remainder(s.imag, period_rad_s))


def _same(a: complex, b: complex) -> bool:
    return min(abs(a - b), abs(a - b.conjugate())) < SAME_ROOT_TOLERANCE * (1.0 + abs(a))


def _root(found: PencilRoot, names: Sequence[str]) -> CharacteristicRoot:
    s = complex(found.s.real, abs(found.s.imag) if abs(found.s.imag) > SAME_ROOT_TOLERANCE else 0.0)
    part = found.taking_part
    order = [int(n) for n in np.argsort(-part, kind="stable") if part[n] >= _PART * part.max()]
    return CharacteristicRoot(s, found.multiplicity, tuple(names[n] for n in order))


def sort_root_guesses(values: NDArray[np.complex128], zeros: int) -> Complex:
    """Returns eigenvalues without the smallest ones, which stand for zeros, by falling real part."""
    kept = values[np.argsort(np.abs(values), kind="stable")][zeros:]
    return kept[np.lexsort((np.abs(kept.imag), -kept.real))]

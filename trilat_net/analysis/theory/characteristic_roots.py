"""Computes the characteristic roots of a linear control loop with delays.

A motion v exp(s t) with a constant vector v is possible in the loop if Delta(s) v = 0, where
Delta(s) is the characteristic matrix of the loop. The values of s for which such a v exists are
the roots. The loop is stable if all roots have a negative real part. A loop with delays has
infinitely many roots; this module computes the rightmost ones, in two steps:

1. Initial guesses for the continuous loop are eigenvalues of a matrix that approximates the
   loop together with its stored past (the Chebyshev pseudospectral discretisation of the
   infinitesimal generator). The order of the approximation is doubled until the wanted roots
   agree. Breda, Maset and Vermiglio, "Pseudospectral differencing methods for characteristic
   roots of delay differential equations", SIAM J. Scientific Computing 27 (2005); nodes from
   Trefethen, "Spectral Methods in MATLAB" (2000).
2. Newton's method refines each guess by a sequence of linear problems: solve Delta(s) v = mu
   Delta'(s) v, where Delta' is the derivative of Delta, and subtract the smallest eigenvalue mu
   from s. The method converges quadratically for simple roots, and also for multiple roots that
   have as many vectors v, as in loops of identical arms. Ruhe, "Algorithms for the nonlinear
   eigenvalue problem", SIAM J. Numerical Analysis 10 (1973).

Invariant:
    - A root solves the equation up to rounding errors, whichever discretisation supplied its
      guess.
    - Some roots are zero for every delay, because the equations do not change if all arms are
      shifted, or if a parameter estimate that affects no motion changes. Such roots are
      counted, and never called the rightmost.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebvander
from numpy.typing import NDArray
from scipy.linalg import eigvals

from ...core import Array
from ..blas_threads import limit_blas_threads
from .linear_loop import LinearLoop

Complex = NDArray[np.complex128]

SAME_ROOT_TOLERANCE = 1e-8
"""Largest difference between two guesses of the same root, relative to 1 + abs(s)."""
STABILITY_EDGE_PER_S = 1e-6
"""Largest distance from the imaginary axis of a root that counts as on the axis, in 1/s."""
EDGE_DEVIATIONS = 2.0
"""Number of standard deviations within which a root for random delays counts as zero."""
ROOT_RESIDUAL_TOLERANCE = 1e-12
"""Largest residual of a root, relative to the norms of the terms of Delta."""
_MAX_NEWTON_STEPS = 30
"""Largest number of Newton steps from one guess."""
_STEP_TOLERANCE = 1e-9
"""Size of a step after which Newton's method stops, relative to 1 + abs(s).

The remaining error is about the square of the step.
"""
_SAME_VALUE = 1e-11
"""Largest singular value of Delta at a root, relative to the norms of the terms of Delta.

The number of singular values below this limit is the multiplicity of the root.
"""
_MAX_DISTANCE_PER_S = 1e6
"""Distance from the guess at which Newton's method has failed, in 1/s."""
ZERO_SHARE = 1e-12
"""Largest singular value that counts as zero, relative to the largest one."""
_LONGEST_CHAIN = 4
"""Length of the longest Jordan chain of roots at zero that is considered."""
NAMED_SHARE = 0.3
"""Smallest participation at which a state is named with a root, relative to the largest one."""
_INITIAL_ORDER = 12
"""Degree of the polynomials in the first discretisation."""
MAX_GENERATOR_SIZE = 1600
"""Number of rows of the largest discretisation, whose eigenvalues take some seconds."""
_ROOT_AGREEMENT = 1e-9
"""Largest difference at which the roots of two orders agree, relative to 1 + abs(s)."""


class Pencil(NamedTuple):
    """The matrices of a linear loop with delays, which determine its stability.

    The loop is E x' = A x + sum_k A_k x(t - T_k) with the state x. Its characteristic matrix is
    Delta(s) = s E - A - sum_k A_k exp(-s T_k). The characteristic roots s, at which Delta(s) is
    singular, are the rates and frequencies of the loop's modes.

    Attributes:
        A: Matrix of the undelayed terms, shape (n, n).
        delays: Delays T_k, in s, shape (K,).
        Ad: Matrices A_k of the delayed terms, shape (K, n, n).
        E: Diagonal of E, shape (n,): 1 for a differential state, 0 for a state determined by an
            algebraic equation. `None` if every state is differential.
    """

    A: Array
    delays: NDArray[Any]
    Ad: Array
    E: Array | None = None

    @property
    def rate_matrix(self) -> Array:
        """Matrix E of the loop equation E x' = A x + sum_k A_k x(t - T_k), shape (n, n).

        x is the state of all arms, with n entries, and T_k are the network delays. E is
        diagonal, with 1 for a differential state and 0 for a state determined by an algebraic
        equation.
        """
        if self.E is None:
            return np.eye(len(self.A))
        return np.diag(self.E)

    def evaluate(self, s: complex) -> tuple[Complex, Complex]:
        """Evaluates the characteristic matrix Delta(s) of the control loop and its derivative.

        Delta(s) is singular at a root of the loop. Newton's method needs both matrices to
        refine a root.

        Args:
            s: Complex frequency, in 1/s.

        Returns:
            Delta(s), shape (n, n).
            Its derivative with respect to s, shape (n, n).
        """
        E = self.rate_matrix
        exponentials = np.exp(-s * self.delays)
        delayed = exponentials[:, np.newaxis, np.newaxis] * self.Ad
        delta = s * E - self.A - delayed.sum(axis=0)
        delays = self.delays[:, np.newaxis, np.newaxis]
        weighted = delays * delayed
        derivative = E + weighted.sum(axis=0)
        return delta.astype(np.complex128), derivative.astype(np.complex128)

    def sum_term_norms(self, s: complex) -> float:
        """Returns the sum of the norms of the terms in the characteristic matrix Delta(s).

        A residual of Delta(s) counts as zero if it is small compared with this sum.

        Args:
            s: Complex frequency, in 1/s.
        """
        growth = np.exp(-s.real * self.delays)
        delayed = growth @ np.linalg.norm(self.Ad, axis=(1, 2))
        undelayed = np.linalg.norm(self.A)
        return float(abs(s) + undelayed + delayed)

    def compute_taylor_coefficient(self, power: int) -> Array:
        """Returns a coefficient of the Taylor series of the characteristic matrix about s = 0.

        The characteristic matrix is Delta(s) = s E - A - sum_k A_k exp(-s T_k), with the
        matrices E, A and A_k and the delays T_k of the loop.

        Args:
            power: Power of s to which the coefficient belongs, starting from 0.

        Returns:
            The coefficient, shape (n, n) for n states.
        """
        undelayed: Array | float = 0.0
        if power == 0:
            undelayed = -self.A
        elif power == 1:
            undelayed = self.rate_matrix
        moments = (-self.delays) ** power
        derivative = np.einsum("k,kab->ab", moments, self.Ad)
        delayed = derivative / math.factorial(power)
        coefficient: Array = undelayed - delayed
        return coefficient

    @property
    def delayed_states(self) -> NDArray[np.intp]:
        """Indices of the states that act on the arms with a delay.

        For example, an arm follows the angles that another arm had some time ago. Only these
        few states are discretised over the delay, which keeps the matrices small.
        """
        effects = np.abs(self.Ad).sum(axis=(0, 1))
        return np.flatnonzero(effects)

    def extract_moving_part(self, names: Sequence[str]) -> "MovingPart":
        """Removes states of a linear loop that never change or that act on no other state.

        An example is a parameter estimate that affects no motion. These states do not influence
        the other modes of the loop. Each of them only adds a characteristic root at zero.

        Args:
            names: Names of the states.

        Returns:
            The matrices of the remaining states, the names of these states, and the number of
            removed states.
        """
        # entry (i, j): effect of state j on the rate of state i
        delayed_effects = np.abs(self.Ad).sum(axis=0)
        effects = np.abs(self.A) + delayed_effects

        kept = list(range(len(names)))
        while True:
            inner = effects[np.ix_(kept, kept)]
            is_constant = ~inner.any(axis=1)
            has_no_effect = ~inner.any(axis=0)
            idle = np.flatnonzero(is_constant | has_no_effect)
            if not len(idle):
                break
            # one state at a time: its removal may leave others without an effect
            del kept[int(idle[0])]

        rows, columns = np.ix_(kept, kept)
        Ad = self.Ad[:, rows, columns]
        is_used = Ad.any(axis=(1, 2))
        moving = self._replace(
            A=self.A[rows, columns],
            delays=self.delays[is_used],
            Ad=Ad[is_used],
            E=None if self.E is None else self.E[kept],
        )
        kept_names = tuple(names[n] for n in kept)
        omitted = len(names) - len(kept)
        return moving, kept_names, omitted

    def refine_roots(
        self,
        candidates: Complex,
        names: Sequence[str],
        wanted: int,
    ) -> "tuple[list[CharacteristicRoot], int]":
        """Refines guesses of the rightmost roots with Newton's method.

        Two more roots than wanted are refined, because the refinement may change their order.
        The remaining guesses are skipped.

        Args:
            candidates: Guesses of nonzero roots, shape (K,), in descending order of real part.
            names: Names of the states.
            wanted: Number of roots. A conjugate pair counts once.

        Returns:
            The `wanted` rightmost roots, or fewer if the loop has fewer.
            The number of guesses that led to no root.
        """
        roots: list[CharacteristicRoot] = []
        dropped = 0
        for guess in candidates:
            # the conjugate of another guess
            if guess.imag < -SAME_ROOT_TOLERANCE * (1.0 + abs(guess)):
                continue

            if len(roots) >= wanted + 2:
                break
            root = _solve_for_root(self, complex(guess), names)
            if root is None or abs(root.s) < SAME_ROOT_TOLERANCE:
                dropped += 1
                continue

            tolerance = SAME_ROOT_TOLERANCE * (1.0 + abs(root.s))
            distances = [abs(root.s - known.s) for known in roots]
            if min(distances, default=math.inf) >= tolerance:
                roots.append(root)

        def rank(root: CharacteristicRoot) -> tuple[float, float]:
            return -round(root.s.real, 9), root.s.imag

        roots.sort(key=rank)
        return roots[:wanted], dropped


MovingPart = tuple[Pencil, tuple[str, ...], int]
"""A loop without its constant states and without its states that have no effect.

The entries are the matrices of the loop, the names of its states, and the number of omitted
states, each of which has a root at zero.
"""


class CharacteristicRoot(NamedTuple):
    """A characteristic root s of the control loop: small motions may evolve as exp(s t).

    The motions grow if the real part of s is positive. The conjugate of a complex root is also
    a root, but is not listed.

    Attributes:
        s: The root with a non-negative imaginary part, in 1/s. Its real part is the growth
            rate.
        multiplicity: Number of modes that share the root.
        states: Names of the states that participate most, such as "m1.q2", in descending order
            of participation.
    """

    s: complex
    multiplicity: int
    states: tuple[str, ...]

    @property
    def damping(self) -> float:
        """Damping ratio, from -1 to 1, of the motion exp(s t) that belongs to the root.

        It is -re(s) / abs(s): 1 for a decay without oscillation, 0 for a lasting oscillation,
        and negative if the motion grows.
        """
        return -self.s.real / abs(self.s)


class Spectrum(NamedTuple):
    """The rightmost characteristic roots of a loop, which determine its stability.

    Some roots are zero because of the structure of the loop, for example because all arms can
    also rest in other poses, or because nothing excites a parameter estimate. These structural
    zeros say nothing about stability.

    Attributes:
        roots: The rightmost roots other than structural zeros, in descending order of real
            part.
        zeros: Number of structural zeros.
        drifting: Number of structural zeros without an eigenvector of their own. Their modes
            grow with time.
        dropped: Number of guesses from which Newton's method did not converge to a root.
        order: Order of the discretisation that supplied the guesses. 0 if none was needed.
        span_s: Time over which the roots are computed, in s: the period after which delays and
            tick rates repeat, or the analysed span of delays that do not repeat. `None` if all
            ticks are alike.
        deviation_per_s: Standard deviation of the rightmost root between parts of the span, in
            1/s. `None` if delays repeat.
        is_exact: False if the delays of the loop do not repeat exactly after the span.
    """

    roots: tuple[CharacteristicRoot, ...]
    zeros: int
    drifting: int
    dropped: int
    order: int
    span_s: float | None = None
    deviation_per_s: float | None = None
    is_exact: bool = True

    @property
    def rightmost(self) -> CharacteristicRoot | None:
        """The characteristic root with the largest real part, which determines stability.

        The real part is the growth rate of a small motion. Roots that are zero because of the
        structure of the loop, for example because all arms can also rest in other poses, are
        not considered. `None` if there are no other roots.
        """
        return self.roots[0] if self.roots else None

    @property
    def verdict(self) -> str:
        """The stability according to the rightmost root: "stable", "unstable" or "at the edge".

        A root is at the edge if its distance from the imaginary axis is less than
        `STABILITY_EDGE_PER_S`, or less than twice its standard deviation in the case of random
        delays. A loop is also at the edge if it has a zero root whose motion drifts.
        """
        rightmost_per_s = -math.inf
        if self.roots:
            rightmost_per_s = self.roots[0].s.real
        uncertainty_per_s = EDGE_DEVIATIONS * (self.deviation_per_s or 0.0)
        edge_per_s = max(STABILITY_EDGE_PER_S, uncertainty_per_s)
        if rightmost_per_s > edge_per_s:
            return "unstable"
        if rightmost_per_s >= -edge_per_s or self.drifting:
            return "at the edge"
        return "stable"

    @classmethod
    def of_loop(cls, loop: LinearLoop, wanted: int = 6) -> "Spectrum":
        """Computes the rightmost roots of a loop with delays, in continuous time.

        The loop is stable if all roots have a negative real part. The order of the
        discretisation that supplies the guesses is doubled until the roots of two orders agree
        or the matrix becomes too large.

        Args:
            loop: The loop.
            wanted: Number of roots. A conjugate pair or a multiple root counts once.
        """
        with limit_blas_threads():
            pencil, names, idle_count = find_moving_part(loop)
            zeros, drifting = _count_zero_roots(pencil)
            if not len(names):
                return cls(
                    roots=(),
                    zeros=idle_count + zeros,
                    drifting=drifting,
                    dropped=0,
                    order=0,
                )

            has_delays = len(pencil.delays) > 0
            order = _INITIAL_ORDER if has_delays else 0
            previous_roots = None
            while True:
                guesses = _guess_roots(pencil, order, zeros)
                roots, dropped = pencil.refine_roots(guesses, names, wanted)
                next_size = len(names) + 2 * order * len(pencil.delayed_states)
                is_converged = previous_roots is not None and _agree(previous_roots, roots)
                if not has_delays or next_size > MAX_GENERATOR_SIZE or is_converged:
                    return cls(
                        roots=tuple(roots),
                        zeros=idle_count + zeros,
                        drifting=drifting,
                        dropped=dropped,
                        order=order,
                    )
                previous_roots = roots
                order = 2 * order


def _solve_for_root(
    pencil: Pencil,
    guess: complex,
    names: Sequence[str],
) -> CharacteristicRoot | None:
    """Refines an approximate root of the control loop by Newton's method.

    A root is a complex growth rate of small motions. A negative real part means decay.

    Args:
        pencil: Matrices of the loop.
        guess: First guess of the root, in 1/s.
        names: Names of the states.

    Returns:
        The root, with its multiplicity and its states. `None` if the method does not converge.
    """
    s = complex(guess)
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            step = _compute_newton_step(pencil, s)
            if step is None:
                return None
            s -= step
            distance = abs(s - guess)
            if not np.isfinite(s) or distance > _MAX_DISTANCE_PER_S:
                return None
            if abs(step) <= _STEP_TOLERANCE * (1.0 + abs(s)):
                break
        measured = _measure_participation(pencil, s)

    if measured is None:
        return None
    multiplicity, participation = measured
    relative = participation / participation.max()
    # rounded, so that equal shares stay in their order
    shares = np.round(relative, 6)
    falling = np.argsort(-shares, kind="stable")
    states = tuple(names[n] for n in falling if shares[n] >= NAMED_SHARE)

    imaginary_part = abs(s.imag)
    if imaginary_part <= SAME_ROOT_TOLERANCE:
        imaginary_part = 0.0
    root = complex(s.real, imaginary_part)
    return CharacteristicRoot(root, multiplicity, states)


def _compute_newton_step(pencil: Pencil, s: complex) -> complex | None:
    """Computes the step by which Newton's method changes a guess s of a root.

    The step is the eigenvalue mu of smallest modulus of Delta(s) v = mu Delta'(s) v. The next
    guess is s - mu.

    Args:
        pencil: Matrices of the loop.
        s: The guess, in 1/s.

    Returns:
        The step. `None` if there is no finite mu.
    """
    delta, derivative = pencil.evaluate(s)
    # far to the left, exp(-s T) overflows
    if not np.isfinite(delta).all() or not np.isfinite(derivative).all():
        return None

    try:
        if pencil.E is None:
            matrix = np.linalg.solve(derivative, delta)
            mu = np.linalg.eigvals(matrix)
        else:
            # algebraic states make the derivative singular, with infinite eigenvalues
            mu = eigvals(delta, derivative)
            mu = mu[np.isfinite(mu)]
    except np.linalg.LinAlgError:
        return None

    if not len(mu):
        return None
    smallest = np.argmin(np.abs(mu))
    return complex(mu[smallest])


def _measure_participation(pencil: Pencil, s: complex) -> tuple[int, Array] | None:
    """Returns the multiplicity of a root, and the participation of each state in its mode.

    Participation is the modulus of the diagonal of the residue of Delta(s)^-1, which is V (W'
    Delta'(s) V)^-1 W' with the null vectors V and W of Delta(s). It does not depend on the
    units of the states.

    Args:
        pencil: Matrices of the loop.
        s: The root, in 1/s.

    Returns:
        The number of null vectors, and the participation, shape (n,). `None` if s is not a
        root.
    """
    delta, derivative = pencil.evaluate(s)
    if not np.isfinite(delta).all():
        return None
    left, values, right = np.linalg.svd(delta)
    scale = pencil.sum_term_norms(s)
    residual = float(values[-1]) / scale
    if not residual <= ROOT_RESIDUAL_TOLERANCE:
        return None

    is_null = values <= _SAME_VALUE * scale
    count = int(np.sum(is_null))
    W = left[:, -count:]
    W_transposed = W.conj().T
    V = right[-count:].conj().T
    inner = W_transposed @ derivative @ V
    try:
        residue = V @ np.linalg.solve(inner, W_transposed)
    except np.linalg.LinAlgError:
        return None
    return count, np.abs(np.diag(residue))


def _count_zero_roots(pencil: Pencil) -> tuple[int, int]:
    """Counts the roots that are zero by structure, and how many of them drift.

    The characteristic matrix has the Taylor series Delta(s) = D_0 + s D_1 + s^2 D_2 + .... A
    root at zero can belong to a Jordan chain, a sequence of modes in which each mode drives the
    next. The number of null vectors of the block Toeplitz matrix of D_0 ... D_(m-1) is the
    number of roots at zero, where each chain counts up to length m. When this number no longer
    rises with m, all roots are counted. Roots in chains longer than 1 drift: their modes grow
    with time.

    Args:
        pencil: Matrices of the loop.

    Returns:
        The number of roots at zero.
        The number of those roots that drift.
    """
    counts = [0]
    for length in range(1, _LONGEST_CHAIN + 1):
        blocks = []
        for power in range(length):
            D = pencil.compute_taylor_coefficient(power)
            if not len(D):
                return 0, 0
            # D_k stands on the k-th diagonal below the main diagonal
            diagonal = np.eye(length, k=-power)
            blocks.append(np.kron(diagonal, D))

        toeplitz = np.sum(blocks, axis=0)
        values = np.linalg.svd(toeplitz, compute_uv=False)
        is_zero = values <= ZERO_SHARE * values[0]
        counts.append(int(np.sum(is_zero)))
        if counts[-1] == counts[-2]:
            break

    zeros = counts[-1]
    vectors = counts[1]
    return zeros, zeros - vectors


def find_moving_part(loop: LinearLoop) -> MovingPart:
    """Reduces a linear loop to the states that can influence its stability.

    States that are constant or act on no other state are left out. Each of them only adds a
    characteristic root at zero.

    Args:
        loop: Linear model of the coupled arms.

    Returns:
        The matrices of the remaining states, the names of these states, and the number of
        omitted states.
    """
    delayed_matrices = np.array([term.A for term in loop.delayed])
    # without delays, an empty array of the right shape
    Ad = delayed_matrices.reshape(-1, *loop.A.shape)
    delays_s = np.array([term.delay_s for term in loop.delayed])
    pencil = Pencil(loop.A, delays_s, Ad, E=loop.E)
    moving, names, idle_count = pencil.extract_moving_part(loop.names)
    return moving, names, idle_count + loop.omitted_states


def _guess_roots(pencil: Pencil, order: int, zeros: int) -> Complex:
    """Returns approximations of the roots of the control loop, by falling real part.

    The approximations are eigenvalues of the discretised loop. The smallest eigenvalues are
    left out, because they approximate the roots that are zero by structure.

    Args:
        pencil: Matrices of the loop.
        order: Order of the discretisation. 0 for a loop without delays.
        zeros: Number of roots at zero.
    """
    matrix = _discretise_generator(pencil, order) if order else pencil.A
    if pencil.E is not None:
        matrix = _eliminate_states(matrix, pencil.E)
    values = np.linalg.eigvals(matrix).astype(np.complex128)
    # the eigenvalues of smallest modulus approximate the roots at zero
    by_modulus = np.argsort(np.abs(values), kind="stable")
    nonzero = values[by_modulus][zeros:]
    rounded_real_part = np.round(nonzero.real, 9)
    falling = np.lexsort((np.abs(nonzero.imag), -rounded_real_part))
    return nonzero[falling]


def _eliminate_states(matrix: Array, E: Array) -> Array:
    """Eliminates the states that algebraic equations determine from a matrix of the loop.

    From 0 = M_aa x_a + M_ar x_r follows the Schur complement M_rr - M_ra M_aa^-1 M_ar, where a
    stands for the algebraic states and r for those with a rate.

    Args:
        matrix: Matrix M of all states. The discretised history follows the loop's states.
        E: 1 for a state with a rate, 0 for an algebraic state, of the loop's states.
    """
    algebraic = np.flatnonzero(E == 0.0)
    kept = np.setdiff1d(np.arange(len(matrix)), algebraic)
    M_aa = matrix[np.ix_(algebraic, algebraic)]
    M_ar = matrix[np.ix_(algebraic, kept)]
    M_ra = matrix[np.ix_(kept, algebraic)]
    M_rr = matrix[np.ix_(kept, kept)]
    algebraic_by_kept = np.linalg.solve(M_aa, M_ar)
    return M_rr - M_ra @ algebraic_by_kept


def _agree(previous: list[CharacteristicRoot], roots: list[CharacteristicRoot]) -> bool:
    """Returns True if two successive approximations of the roots agree.

    The order of the approximation is doubled until the roots agree.

    Args:
        previous: Roots from the previous order.
        roots: Roots from this order.
    """
    if len(roots) < len(previous):
        return False
    for root in roots:
        tolerance = _ROOT_AGREEMENT * (1.0 + abs(root.s))
        distances = [abs(root.s - known.s) for known in previous]
        if not min(distances, default=math.inf) <= tolerance:
            return False
    return True


def _discretise_generator(pencil: Pencil, order: int) -> Array:
    """Approximates a loop with delays by a system of ordinary differential equations.

    The state of a loop with delays includes its history over the longest delay T_max. The
    history of the delayed states is represented by its values at Chebyshev nodes in the time
    from -T_max to 0. The eigenvalues of the resulting matrix approximate the rightmost
    characteristic roots.

    Args:
        pencil: Matrices of the loop, with at least one delay.
        order: Degree of the interpolating polynomials.

    Returns:
        The matrix. Its states are the states of the loop, and then the history.
    """
    delayed = pencil.delayed_states
    longest_s = float(pencil.delays.max())
    n = len(pencil.A)
    c = len(delayed)

    size = n + order * c
    generator = np.zeros((size, size))
    generator[:n, :n] = pencil.A

    # x in [-1, 1] stands for the time from -T_max to 0
    x = 1.0 - 2.0 * pencil.delays / longest_s
    grid = ChebyshevGrid(order)
    interpolation = grid.build_interpolation(x)
    for weights, Ad in zip(interpolation, pencil.Ad, strict=True):
        delayed_columns = Ad[:, delayed]
        generator[:n, delayed] += weights[0] * delayed_columns
        generator[:n, n:] += np.kron(weights[1:], delayed_columns)

    # the history moves along the nodes: its rate is its derivative by time
    differentiation = grid.build_differentiation()
    transport = differentiation[1:] * (2.0 / longest_s)
    generator[n:, n:] = np.kron(transport[:, 1:], np.eye(c))
    for column, state in enumerate(delayed):
        generator[n + column :: c, state] = transport[:, 0]
    return generator


class ChebyshevGrid(NamedTuple):
    """The points in [-1, 1] at which delayed states are evaluated.

    These Chebyshev nodes are cos(pi k / order) for k = 0, ..., order, in descending order from
    1 to -1. A polynomial through the points approximates the delayed motion.

    Attributes:
        order: Degree of the polynomial.
    """

    order: int

    @property
    def nodes(self) -> Array:
        """The nodes, shape (order + 1,)."""
        angles = np.pi * np.arange(self.order + 1) / self.order
        return np.cos(angles)

    def build_interpolation(self, x: Array) -> Array:
        """Returns the matrix that interpolates a polynomial between the nodes.

        It maps the values at the nodes to the values at the points x.

        Args:
            x: Points in [-1, 1], shape (K,).

        Returns:
            Matrix of shape (K, order + 1).
        """
        basis_at_nodes = chebvander(self.nodes, self.order)
        basis_at_x = chebvander(x, self.order)
        transposed = np.linalg.solve(basis_at_nodes.T, basis_at_x.T)
        return transposed.T.astype(np.float64)

    def build_differentiation(self) -> Array:
        """Returns the matrix that differentiates a polynomial given at the nodes.

        It maps the values at the nodes to the derivatives there.

        Returns:
            Matrix of shape (order + 1, order + 1).
        """
        nodes = self.nodes
        basis_at_nodes = chebvander(nodes, self.order)
        derivatives = chebder(np.eye(self.order + 1))
        slopes = chebvander(nodes, self.order - 1) @ derivatives
        transposed = np.linalg.solve(basis_at_nodes.T, slopes.T)
        return transposed.T.astype(np.float64)

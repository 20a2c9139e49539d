"""The sampled loop, linearised tick by tick, and its roots s = ln(z) / h.

    X_{k+1} = S X_k + sum_d S_d X_{k-d},    z = exp(s h)

Invariant: the arm is exact between ticks under a held torque (zero-order hold); the controller runs its
stages in their order; a sample of tick m is in use d = max(1, ceil(T / h)) ticks later.

`second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the estimate, and the torque
on the arm is 1.5 tau_k - 0.5 tau_{k-1}. With eta_k = theta_{k-1} + h/2 f_{k-1} that is
theta_k = eta_k + h/2 f_k and eta_{k+1} = eta_k + h f_k. `digital`: theta_k = eta_k,
eta_{k+1} = eta_k + h f_k, and the torque on the arm is tau_k.
"""

import cmath
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.site_setup import Scheme, SiteSetup
from ..core.two_link_arm import JOINTS, PARAMETERS
from ..core.vectors import Array
from .characteristic_roots import (
    Complex,
    Spectrum,
    count_zero_roots,
    limit_blas_threads,
    refine_roots,
    select_moving_states,
    sort_root_guesses,
)
from .linear_loop import linearise_sites
from .operating_point import Equilibrium, OperatingConditions
from .site_dynamics import (
    ARGUMENT_COUNT,
    ESTIMATE,
    EXTERNAL_TORQUE,
    PEER_TORQUE,
    Q_DES,
    QD,
    Q,
    SiteRates,
    has_estimate,
)

_ORDER = 13
_LARGEST = 5.371920351148152
"""Up to this 1-norm the approximant of order 13 is exact to rounding."""


def matrix_exponential(matrix: Array) -> Array:
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


def discretise_zero_order_hold(A: Array, B: Array, h_s: float) -> tuple[Array, Array]:
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
    found = matrix_exponential(whole)
    return found[:n, :n], found[:n, n:]


ARM_STATE = slice(Q.start, QD.stop)
"""Angles and velocities, in a site's arguments and in its X alike."""
PEER_INPUT = slice(Q_DES.start, PEER_TORQUE.stop)
"""What a site hears of its peers, among its arguments: q_id, its derivative, felt."""
PEER_INPUT_SIZE = PEER_INPUT.stop - PEER_INPUT.start


class SiteTickMap(NamedTuple):
    """One site over a period: X' = P X + Q w, where w is what it hears of its peers.

    Attributes:
        P: shape (n, n); X is q, qd, eta of its estimate, and, of `second_order`, the torque before.
        Q: shape (n, 6).
        sent: what its peers hear of it, shape (6, n): q, qd, and the torque on its arm.
        names: of its states.
    """

    P: Array
    Q: Array
    sent: Array
    names: tuple[str, ...]


class _Made(NamedTuple):
    """What a controller makes of its arguments: torque on the arm, what it learns, the torque of its law."""

    u: Array
    learnt: Array
    tau: Array


def linearise_site_tick(site: SiteSetup, rates: SiteRates, h_s: float) -> SiteTickMap:
    """Returns one site over a period.

    Args:
        site: what it is built from.
        rates: the derivatives of its rates, see `field.jacobian`.
        h_s: the period, s.
    """
    second = site.scheme is Scheme.SECOND_ORDER
    memory = slice(QD.stop, QD.stop + (PARAMETERS if has_estimate(site) else 0))
    n = memory.stop + (JOINTS if second else 0)
    own, heard = np.zeros((ARGUMENT_COUNT, n)), np.zeros((ARGUMENT_COUNT, PEER_INPUT_SIZE))
    own[ARM_STATE, ARM_STATE] = np.eye(QD.stop)
    own[ESTIMATE, memory] = np.eye(PARAMETERS)[:, : memory.stop - memory.start]
    heard[PEER_INPUT] = np.eye(PEER_INPUT_SIZE)
    Phi, Gamma = _arm(rates, h_s)
    P, Q = (
        _stacked(_made(rates, by, h_s, second=second), Gamma, memory, second=second) for by in (own, heard)
    )
    P[ARM_STATE, ARM_STATE] += Phi
    P[memory, memory] += np.eye(memory.stop - memory.start)
    if second:
        P[ARM_STATE, memory.stop :] -= 0.5 * Gamma
    sent = np.zeros((PEER_INPUT_SIZE, n))
    sent[: QD.stop, ARM_STATE] = np.eye(QD.stop)
    sent[QD.stop :, ARM_STATE] = (rates.acted + rates.held)[:, ARM_STATE]
    states = ["q1", "q2", "qd1", "qd2", "theta1", "theta2", "theta3", "theta4", "theta5"][: memory.stop]
    states += ["tau1", "tau2"] if second else []
    return SiteTickMap(P, Q, sent, tuple(f"{site.name}.{state}" for state in states))


def _arm(rates: SiteRates, h_s: float) -> tuple[Array, Array]:
    """Returns what a period does to (q, qd), and what a torque held over it adds."""
    inverse = rates.qdd[:, EXTERNAL_TORQUE]  # of M
    still = np.zeros((JOINTS, JOINTS))
    own = rates.qdd[:, ARM_STATE] - inverse @ (rates.tau + rates.held)[:, ARM_STATE]
    A = np.block([[still, np.eye(JOINTS)], [own]])
    return discretise_zero_order_hold(A, np.vstack([still, inverse]), h_s)


def _made(rates: SiteRates, by: Array, h_s: float, *, second: bool) -> _Made:
    """Returns what the controller makes of its arguments at a tick, which are `by` times something."""
    f = rates.estimate @ by
    if not second:
        tau = rates.tau @ by
        return _Made(tau + rates.held @ by, h_s * f, tau)
    tau = rates.tau @ by + 0.5 * h_s * rates.tau[:, ESTIMATE] @ f
    return _Made(1.5 * tau + rates.held @ by, h_s * f, tau)


def _stacked(made: _Made, Gamma: Array, memory: slice, *, second: bool) -> Array:
    """Returns what the controller adds to X."""
    learnt = made.learnt[: memory.stop - memory.start]
    return np.vstack([Gamma @ made.u, learnt, *([made.tau] if second else [])])


MAX_COMPANION_SIZE = 600
"""The largest companion matrix whose eigenvalues are computed; beyond it Newton begins from the continuous
roots."""


class TickPencil(NamedTuple):
    """Delta(s) = (z I - S - sum_d S_d z^-d) / h with z = exp(s h).

    Attributes:
        h_s: the period, s.
        S: shape (n, n).
        ticks: the delays d, shape (K,).
        Sd: shape (K, n, n).
    """

    h_s: float
    S: Array
    ticks: NDArray[np.int64]
    Sd: Array

    def at(self, s: complex) -> tuple[Complex, Complex]:
        """See `pencil.Pencil`."""
        z = cmath.exp(s * self.h_s)
        eye = z * np.eye(len(self.S))
        late = np.exp(-s * self.h_s * self.ticks)[:, np.newaxis, np.newaxis] * self.Sd
        delta = (eye - self.S - late.sum(axis=0)) / self.h_s
        return delta, eye + (self.ticks[:, np.newaxis, np.newaxis] * late).sum(axis=0)

    def size(self, s: complex) -> float:
        """See `pencil.Pencil`."""
        late = np.exp(-s.real * self.h_s * self.ticks) @ np.linalg.norm(self.Sd, axis=(1, 2))
        return float((math.exp(s.real * self.h_s) + np.linalg.norm(self.S) + late) / self.h_s)

    def taylor(self, power: int) -> Array:
        """See `pencil.Pencil`."""
        factors = (-self.ticks.astype(np.float64)) ** power
        own = np.eye(len(self.S)) - (self.S if power == 0 else 0.0)
        scale = self.h_s ** (power - 1) / math.factorial(power)
        found: Array = scale * (own - np.einsum("k,kab->ab", factors, self.Sd))
        return found

    @property
    def late(self) -> NDArray[np.intp]:
        """Places of the states that come into the loop after a delay."""
        return np.flatnonzero(np.abs(self.Sd).sum(axis=(0, 1)))


def find_common_rate_hz(now: OperatingConditions) -> int | None:
    """Returns the tick rate that all sites have, Hz; None where they have several."""
    rates = {site.rate_hz for site in now.sites}
    return rates.pop() if len(rates) == 1 else None


def compute_sampled_spectrum(
    now: OperatingConditions, rest: Equilibrium, near: Complex, wanted: int = 6
) -> Spectrum | None:
    """Returns the rightmost roots s = ln(z) / h of the loop as it is computed.

    Args:
        now: what holds.
        rest: where it rests.
        near: roots of the continuous loop, which Newton begins from where the delays are long.
        wanted: how many roots.

    Returns:
        The roots; None where the sites have different rates, because then no one period is there.
    """
    if find_common_rate_hz(now) is None:
        return None
    pencil, names, constant = build_tick_pencil(now, rest)
    with limit_blas_threads():
        zeros, drifting = count_zero_roots(pencil)
        numbers = len(names) + int(pencil.ticks.max(initial=0)) * len(pencil.late)
        if numbers <= MAX_COMPANION_SIZE:
            z = _eigenvalues(build_companion_matrix(pencil))
            guesses = sort_root_guesses(_logarithm(z, pencil.h_s), zeros)
            tries = wanted + 2
        else:
            local = [_eigenvalues(matrix) for matrix in (pencil.S, pencil.S + pencil.Sd.sum(axis=0))]
            guesses = np.concatenate([near, *(_logarithm(z, pencil.h_s) for z in local)])
            guesses = sort_root_guesses(guesses[np.abs(guesses) > 1e-6], 0)
            tries = len(guesses)
        roots, dropped = refine_roots(pencil, guesses, names, wanted, tries, 2.0 * math.pi / pencil.h_s)
    return Spectrum(tuple(roots), constant + zeros, drifting, dropped, 0)


def _eigenvalues(matrix: Array) -> Complex:
    return np.linalg.eigvals(matrix).astype(np.complex128)


def _logarithm(z: Complex, h_s: float) -> Complex:
    """Returns ln(z) / h of what is not next to zero, 1/s."""
    kept = z[np.abs(z) > 1e-8]
    return (np.log(kept) / h_s).astype(np.complex128)


def build_companion_matrix(pencil: TickPencil) -> Array:
    """Returns the matrix that carries the state, and the past of its delayed part, from tick to tick."""
    n, late = len(pencil.S), pencil.late
    depth, c = int(pencil.ticks.max(initial=0)), len(pencil.late)
    whole = np.zeros((n + depth * c, n + depth * c))
    whole[:n, :n] = pencil.S
    for d, Sd in zip(pencil.ticks, pencil.Sd, strict=True):
        whole[:n, n + (d - 1) * c : n + d * c] += Sd[:, late]
    if depth:
        whole[n + np.arange(c), late] = 1.0
        whole[n + c :, n : n + (depth - 1) * c] = np.eye((depth - 1) * c)
    return whole


def build_tick_pencil(now: OperatingConditions, rest: Equilibrium) -> tuple[TickPencil, tuple[str, ...], int]:
    """Returns the characteristic equation of the moving part, its names, and how many states do not move.

    Args:
        now: what holds; all sites have one rate.
        rest: where it rests.
    """
    h_s = 1.0 / now.sites[0].rate_hz
    sites = [
        linearise_site_tick(site, row.rates, h_s)
        for site, row in zip(now.sites, linearise_sites(now, rest), strict=True)
    ]
    ends = np.cumsum([0, *(len(site.P) for site in sites)])
    at = [slice(a, b) for a, b in itertools.pairwise(ends)]
    S = np.zeros((ends[-1], ends[-1]))
    Sd: dict[int, Array] = {}
    for i, site in enumerate(sites):
        S[at[i], at[i]] = site.P
    for i, j in zip(*np.nonzero(now.alpha), strict=True):
        d = max(1, round(float(now.age_s[i, j]) / h_s))
        S_d = Sd.setdefault(d, np.zeros_like(S))
        S_d[at[i], at[j]] += now.alpha[i, j] * sites[i].Q @ sites[j].sent
    ticks = np.array(sorted(Sd), dtype=np.int64)
    late = np.array([Sd[int(d)] for d in ticks]).reshape(-1, *S.shape)
    kept = select_moving_states(np.abs(S - np.eye(len(S))) + np.abs(late).sum(axis=0))
    rows, columns = np.ix_(kept, kept)
    names = [name for site in sites for name in site.names]
    pencil = TickPencil(h_s, S[rows, columns], ticks, late[:, rows, columns])
    return pencil, tuple(names[place] for place in kept), len(S) - len(kept)

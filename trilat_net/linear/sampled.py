"""The loop as it is really computed: tick by tick, linearised.

    X_{k+1} = S X_k + sum_d S_d X_{k-d},    z = exp(s h)

Law: a sample of tick m is in use d = max(1, ceil(T / h)) ticks later; what a site makes of a period stands in
`period`. Roots are told as s = ln(z) / h, so that they stand beside those of the continuous loop.
"""

import cmath
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array
from .conditions import Conditions
from .loop import Rest, rows_of
from .pencil import Complex, moving_states, zero_chains
from .period import period_of
from .spectrum import Spectrum, refined, sorted_guesses
from .threads import one_thread

MOST_NUMBERS = 600
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


def rate_of(now: Conditions) -> int | None:
    """Returns the tick rate that all sites have, Hz; None where they have several."""
    rates = {site.rate_hz for site in now.sites}
    return rates.pop() if len(rates) == 1 else None


def sampled_spectrum(now: Conditions, rest: Rest, near: Complex, wanted: int = 6) -> Spectrum | None:
    """Returns the rightmost roots s = ln(z) / h of the loop as it is computed.

    Args:
        now: what holds.
        rest: where it rests.
        near: roots of the continuous loop, which Newton begins from where the delays are long.
        wanted: how many roots.

    Returns:
        The roots; None where the sites have different rates, because then no one period is there.
    """
    if rate_of(now) is None:
        return None
    pencil, names, constant = tick_pencil(now, rest)
    with one_thread():
        zeros, drifting = zero_chains(pencil)
        numbers = len(names) + int(pencil.ticks.max(initial=0)) * len(pencil.late)
        if numbers <= MOST_NUMBERS:
            z = _eigenvalues(companion(pencil))
            guesses = sorted_guesses(_logarithm(z, pencil.h_s), zeros)
            tries = wanted + 2
        else:
            local = [_eigenvalues(matrix) for matrix in (pencil.S, pencil.S + pencil.Sd.sum(axis=0))]
            guesses = np.concatenate([near, *(_logarithm(z, pencil.h_s) for z in local)])
            guesses = sorted_guesses(guesses[np.abs(guesses) > 1e-6], 0)
            tries = len(guesses)
        roots, dropped = refined(pencil, guesses, names, wanted, tries, 2.0 * math.pi / pencil.h_s)
    return Spectrum(tuple(roots), constant + zeros, drifting, dropped, 0)


def _eigenvalues(matrix: Array) -> Complex:
    return np.linalg.eigvals(matrix).astype(np.complex128)


def _logarithm(z: Complex, h_s: float) -> Complex:
    """Returns ln(z) / h of what is not next to zero, 1/s."""
    kept = z[np.abs(z) > 1e-8]
    return (np.log(kept) / h_s).astype(np.complex128)


def companion(pencil: TickPencil) -> Array:
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


def tick_pencil(now: Conditions, rest: Rest) -> tuple[TickPencil, tuple[str, ...], int]:
    """Returns the characteristic equation of the moving part, its names, and how many states do not move.

    Args:
        now: what holds; all sites have one rate.
        rest: where it rests.
    """
    h_s = 1.0 / now.sites[0].rate_hz
    sites = [period_of(site, row.rates, h_s) for site, row in zip(now.sites, rows_of(now, rest), strict=True)]
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
    kept = moving_states(np.abs(S - np.eye(len(S))) + np.abs(late).sum(axis=0))
    rows, columns = np.ix_(kept, kept)
    names = [name for site in sites for name in site.names]
    pencil = TickPencil(h_s, S[rows, columns], ticks, late[:, rows, columns])
    return pencil, tuple(names[place] for place in kept), len(S) - len(kept)

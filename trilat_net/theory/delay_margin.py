"""The delay margin: the common delays of all links for which the continuous loop is stable.

Invariant: crossings of the imaginary axis are searched over frequency and not over delay, so
that none hides between two delays.

With one delay T on all links the loop has a root at j w where det(I - exp(-j w T) G(j w)) = 0,
with G(j w) = the delayed rows of (j w I - A)^-1 A_d: an eigenvalue of G has modulus 1, and its
phase is w T modulo 2 pi. A pair of roots moves to the right with rising T where that modulus
falls with w, to the left where it rises. Chen, Gu and Nett, "A new method for computing delay
margins for stability of linear delay systems", Systems & Control Letters 26 (1995); Cooke and
van den Driessche, "On zeroes of some transcendental equations", Funkcialaj Ekvacioj 29 (1986).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from ..errors import count_nouns
from . import characteristic_roots
from .linear_loop import DelayedTerm, LinearLoop

MAX_COMMON_DELAY_S = 10.0
"""The longest common delay that is searched."""
_SHOWN = 3
"""Intervals that the text lists one by one."""
_POINTS = 600
_LOWEST = 1e-4
"""The lowest frequency, relative to the highest at which a crossing is possible."""
_BISECTIONS = 60
_OUTSIDE = 1.0 + 1e-9
"""A modulus below this may be 1 but for rounding, as that of a line without losses is at every
frequency.
"""


class AxisCrossing(NamedTuple):
    """A pair of roots that crosses the imaginary axis.

    Attributes:
        delay_s: the common delay, s.
        omega_rad_s: the frequency, rad/s.
        pairs: number of pairs that go to the right with rising delay; negative if they go to
            the left.
    """

    delay_s: float
    omega_rad_s: float
    pairs: int


class DelayInterval(NamedTuple):
    """Delays for which a loop is stable.

    Attributes:
        low_s: its beginning, s; 0 if the loop is stable without delay.
        high_s: its end, s; `MAX_COMMON_DELAY_S` if nothing crosses before.
        low: the crossing at its beginning, or None.
        high: the crossing at its end, or None.
    """

    low_s: float
    high_s: float
    low: AxisCrossing | None
    high: AxisCrossing | None

    @property
    def description(self) -> str:
        """Its ends and the frequency at its end; "" if it has no ends."""
        if self.low is None and self.high is None:
            return ""
        low = "" if self.low is None else f"from {1e3 * self.low_s:.4g} ms "
        if self.high is None:
            return f"{low}on"
        return f"{low}up to {1e3 * self.high_s:.4g} ms (crosses at {self.high.omega_rad_s:.4g} rad/s)"


class DelayMargin(NamedTuple):
    """The common delays for which a loop is stable.

    Attributes:
        intervals: by rising delay; none if it is unstable for every delay.
        crossings: all up to `MAX_COMMON_DELAY_S`, by rising delay.
        lossless: True if waves run without losses: roots are on the axis for every delay.
    """

    intervals: tuple[DelayInterval, ...]
    crossings: tuple[AxisCrossing, ...]
    lossless: bool = False

    @property
    def description(self) -> str:
        """The delays for which the loop is stable, in words."""
        if self.lossless:
            return "none: waves run along lines without losses, and roots are on the axis for every delay"
        if not self.intervals:
            return f"unstable for every common delay up to {MAX_COMMON_DELAY_S:g} s"
        texts = [interval.description for interval in self.intervals]
        if texts == [""]:
            return f"stable for every common delay up to {MAX_COMMON_DELAY_S:g} s"
        more = (
            f", and in {count_nouns(len(texts) - _SHOWN, 'more range')}"
            if len(texts) > _SHOWN
            else ""
        )
        return f"stable for common delays {', '.join(texts[:_SHOWN])}{more}"


def set_common_delay(loop: LinearLoop, delay_s: float) -> LinearLoop:
    """Returns a loop with one delay on all of its links."""
    if not loop.delayed:
        return loop
    A = np.sum([term.A for term in loop.delayed], axis=0)
    B = np.sum([term.B for term in loop.delayed], axis=0)
    if delay_s == 0.0:
        return loop._replace(A=loop.A + A, B=loop.B + B, delayed=())
    return loop._replace(delayed=(DelayedTerm(delay_s, A, B),))


def find_delay_margin(loop: LinearLoop) -> DelayMargin:
    """Returns the common delays for which a loop is stable; its own delays do not count."""
    crossings, lossless = find_axis_crossings(loop)
    if lossless:
        return DelayMargin((), (), lossless)
    first_s = min((crossing.delay_s for crossing in crossings), default=0.2)
    count = _count_unstable_roots(set_common_delay(loop, 0.5 * min(first_s, 0.2)))
    intervals: list[DelayInterval] = []
    low: AxisCrossing | None = None
    stable = count == 0
    for crossing in crossings:
        count += 2 * crossing.pairs if crossing.omega_rad_s else crossing.pairs
        if stable and count > 0:
            intervals.append(
                DelayInterval(low.delay_s if low else 0.0, crossing.delay_s, low, crossing)
            )
            stable = False
        elif not stable and count == 0:
            low = crossing
            stable = True
    if stable:
        intervals.append(
            DelayInterval(low.delay_s if low else 0.0, MAX_COMMON_DELAY_S, low, None)
        )
    return DelayMargin(tuple(intervals), tuple(crossings))


def _count_unstable_roots(loop: LinearLoop) -> int:
    wanted = 8
    while True:
        roots = characteristic_roots.compute_delay_spectrum(loop, wanted).roots
        right = [root for root in roots if root.s.real > 0.0]
        if len(right) < len(roots) or len(roots) < wanted:
            return sum(root.multiplicity * (2 if root.s.imag else 1) for root in right)
        wanted *= 2


def find_axis_crossings(loop: LinearLoop) -> tuple[list[AxisCrossing], bool]:
    """Returns all crossings of the imaginary axis for a common delay up to
    `MAX_COMMON_DELAY_S`.

    And whether roots are on it for every delay, as G has an eigenvalue of modulus 1 at every
    frequency.
    """
    pencil, *_ = characteristic_roots.find_moving_part(set_common_delay(loop, 1.0))
    if not len(pencil.delays):
        return [], False
    with characteristic_roots.limit_blas_threads():
        sweep = _FrequencySweep(pencil)
        grid = sweep.grid()
        crossings = []
        moduli = np.abs(sweep.eigenvalues(grid))
        if ((moduli <= _OUTSIDE) & (moduli >= 2.0 - _OUTSIDE)).any(axis=1).all():
            return [], True
        for place in np.flatnonzero(np.diff((moduli > _OUTSIDE).sum(axis=1))):
            crossings += sweep.search(float(grid[place]), float(grid[place + 1]))
    return _merge(crossings), False


def _merge(crossings: Sequence[AxisCrossing]) -> list[AxisCrossing]:
    merged: list[AxisCrossing] = []
    for one in sorted(crossings):
        last = merged[-1] if merged else None
        if (
            last
            and abs(one.delay_s - last.delay_s) <= 1e-7 * (1e-3 + one.delay_s)
            and (abs(one.omega_rad_s - last.omega_rad_s) <= 1e-7 * one.omega_rad_s)
        ):
            merged[-1] = last._replace(pairs=last.pairs + one.pairs)
        else:
            merged.append(one)
    return sorted(merged)


class _FrequencySweep:
    """The eigenvalues of G(j w) over frequency."""

    def __init__(self, pencil: characteristic_roots.Pencil) -> None:
        self._A = pencil.A
        self._delayed = pencil.delayed_states
        self._rates = pencil.rates
        self._Ad = pencil.Ad[0][:, self._delayed]
        self._highest = float(np.linalg.norm(pencil.A, 2) + np.linalg.norm(pencil.Ad[0], 2))
        self._modes: characteristic_roots.Complex = np.concatenate(
            [np.linalg.eigvals(pencil.A), np.linalg.eigvals(pencil.A + pencil.Ad[0])]
        ).astype(np.complex128)

    def grid(self) -> Array:
        """Returns frequencies to evaluate, rad/s, denser about the loop's own modes."""
        even = np.geomspace(_LOWEST * self._highest, self._highest, _POINTS)
        modes = self._modes[np.abs(self._modes.imag) > 0.0]
        about = np.abs(modes.imag)[:, np.newaxis] + np.abs(modes.real)[
            :, np.newaxis
        ] * np.linspace(-3, 3, 13)
        both = np.unique(np.concatenate([even, about.ravel()]))
        kept: Array = both[(both >= even[0]) & (both <= even[-1])]
        return kept

    def eigenvalues(self, omega: Array) -> characteristic_roots.Complex:
        """Returns the eigenvalues of G(j w), shape (K, c)."""
        inner = 1j * omega[:, np.newaxis, np.newaxis] * self._rates - self._A
        G = np.linalg.solve(inner, np.broadcast_to(self._Ad, (len(omega), *self._Ad.shape)))
        return np.linalg.eigvals(G[:, self._delayed, :]).astype(np.complex128)

    def count_outside(self, omega: Array) -> NDArray[np.int64]:
        """Returns the number of eigenvalues with a modulus above 1, shape (K,)."""
        counts: NDArray[np.int64] = (np.abs(self.eigenvalues(omega)) > _OUTSIDE).sum(axis=1)
        return counts

    def search(self, low: float, high: float) -> list[AxisCrossing]:
        ends = self.count_outside(np.array([low, high]))
        if ends[0] == ends[1]:
            return []
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            count = self.count_outside(np.array([middle]))[0]
            if count not in ends:
                return self.search(low, middle) + self.search(middle, high)
            low, high = (middle, high) if count == ends[0] else (low, middle)
            if high - low <= 1e-13 * high:
                break
        omega = 0.5 * (low + high)
        pairs = int(ends[0] - ends[1])
        values = self.eigenvalues(np.array([omega]))[0]
        nearest = np.argsort(np.abs(np.abs(values) - 1.0), kind="stable")[: abs(pairs)]
        crossings = []
        for value in values[nearest]:
            phase = math.atan2(value.imag, value.real) % (2.0 * math.pi)
            turns = range(int(MAX_COMMON_DELAY_S * omega / (2.0 * math.pi)) + 2)
            delays_s = [(phase + 2.0 * math.pi * turn) / omega for turn in turns]
            sign = 1 if pairs > 0 else -1
            crossings += [
                AxisCrossing(d, omega, sign) for d in delays_s if 0.0 < d <= MAX_COMMON_DELAY_S
            ]
        return crossings

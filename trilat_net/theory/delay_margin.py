"""The delay margin: the common delays of all links for which the continuous loop is stable.

Invariant: crossings of the imaginary axis are searched over frequency and not over delay, so that none
hides between two delays.

With one delay T on all links the loop has a root at j w where det(I - exp(-j w T) G(j w)) = 0, with
G(j w) = the delayed rows of (j w I - A)^-1 A_d: an eigenvalue of G has modulus 1, and its phase is w T
modulo 2 pi. A pair of roots moves to the right with rising T where that modulus falls with w, to the left
where it rises. Chen, Gu and Nett, "A new method for computing delay margins for stability of linear delay
systems", Systems & Control Letters 26 (1995); Cooke and van den Driessche, "On zeroes of some transcendental
equations", Funkcialaj Ekvacioj 29 (1986).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from .characteristic_roots import Complex, limit_blas_threads
from .delay_roots import DelayPencil, compute_delay_spectrum, extract_moving_part
from .linear_loop import DelayedTerm, LinearLoop

MAX_COMMON_DELAY_S = 10.0
"""Longer delays no link has."""
_SHOWN = 3
"""Ranges of delays that are told one by one."""
_POINTS = 600
_LOWEST = 1e-4
"""The lowest frequency, as a share of the highest at which anything can cross."""
_BISECTIONS = 60
_NEAR_ONE = 1e-6


class AxisCrossing(NamedTuple):
    """A pair of roots that crosses the imaginary axis.

    Attributes:
        delay_s: the common delay, s.
        omega_rad_s: the frequency, rad/s.
        pairs: how many pairs go to the right with rising delay; negative where they go to the left.
    """

    delay_s: float
    omega_rad_s: float
    pairs: int


class DelayInterval(NamedTuple):
    """Delays for which a loop is stable.

    Attributes:
        low_s: from here on, s; 0 where it is stable without delay.
        high_s: up to here, s; `MOST_S` where nothing crosses before.
        low: what crosses at its beginning, or None.
        high: what crosses at its end, or None.
    """

    low_s: float
    high_s: float
    low: AxisCrossing | None
    high: AxisCrossing | None


class DelayMargin(NamedTuple):
    """For which common delay a loop is stable.

    Attributes:
        spans: where, by rising delay; none where it is unstable for every delay.
        crossings: all that cross up to `MOST_S`, by rising delay.
    """

    spans: tuple[DelayInterval, ...]
    crossings: tuple[AxisCrossing, ...]

    @property
    def words(self) -> str:
        """For which delays it is stable, in words."""
        if not self.spans:
            return f"unstable for every common delay up to {MAX_COMMON_DELAY_S:g} s"
        texts = [_span_words(span) for span in self.spans]
        if texts == [""]:
            return f"stable for every common delay up to {MAX_COMMON_DELAY_S:g} s"
        more = f", and in {len(texts) - _SHOWN} more ranges" if len(texts) > _SHOWN else ""
        return f"stable for common delays {', '.join(texts[:_SHOWN])}{more}"


def _span_words(span: DelayInterval) -> str:
    if span.low is None and span.high is None:
        return ""
    low = "" if span.low is None else f"from {1e3 * span.low_s:.4g} ms "
    if span.high is None:
        return f"{low}on"
    return f"{low}up to {1e3 * span.high_s:.4g} ms (crosses at {span.high.omega_rad_s:.4g} rad/s)"


def set_common_delay(loop: LinearLoop, delay_s: float) -> LinearLoop:
    """Returns a loop with one delay on all of its links."""
    if not loop.delayed:
        return loop
    A = np.sum([delayed.A for delayed in loop.delayed], axis=0)
    B = np.sum([delayed.B for delayed in loop.delayed], axis=0)
    if delay_s == 0.0:
        return loop._replace(A=loop.A + A, B=loop.B + B, delayed=())
    return loop._replace(delayed=(DelayedTerm(delay_s, A, B),))


def find_delay_margin(loop: LinearLoop) -> DelayMargin:
    """Returns for which common delay a loop is stable.

    Args:
        loop: the loop; its own delays do not count.
    """
    found = find_axis_crossings(loop)
    first_s = min((crossing.delay_s for crossing in found), default=0.2)
    unstable = _unstable_pairs(set_common_delay(loop, 0.5 * min(first_s, 0.2)))
    spans: list[DelayInterval] = []
    low: AxisCrossing | None = None
    count, open_ = unstable, unstable == 0
    for crossing in found:
        count += 2 * crossing.pairs if crossing.omega_rad_s else crossing.pairs
        if open_ and count > 0:
            spans.append(DelayInterval(low.delay_s if low else 0.0, crossing.delay_s, low, crossing))
            open_ = False
        elif not open_ and count == 0:
            low, open_ = crossing, True
    if open_:
        spans.append(DelayInterval(low.delay_s if low else 0.0, MAX_COMMON_DELAY_S, low, None))
    return DelayMargin(tuple(spans), tuple(found))


def _unstable_pairs(loop: LinearLoop) -> int:
    """Returns how many roots are to the right of the imaginary axis, conjugate ones and multiple ones too."""
    wanted = 8
    while True:
        found = compute_delay_spectrum(loop, wanted)
        right = [root for root in found.roots if root.s.real > 0.0]
        if len(right) < len(found.roots) or len(found.roots) < wanted:
            return sum(root.multiplicity * (2 if root.s.imag else 1) for root in right)
        wanted *= 2


def find_axis_crossings(loop: LinearLoop) -> list[AxisCrossing]:
    """Returns all pairs of roots that cross the imaginary axis for a common delay up to `MOST_S`.

    Args:
        loop: the loop; its own delays do not count.
    """
    pencil = extract_moving_part(set_common_delay(loop, 1.0)).pencil
    if not len(pencil.delays_s):
        return []
    with limit_blas_threads():
        sweep = _Sweep(pencil)
        grid = sweep.grid()
        counts = sweep.outside(grid)
        found = []
        for place in np.flatnonzero(np.diff(counts)):
            found += sweep.between(float(grid[place]), float(grid[place + 1]))
    return sorted(_merged(found))


def _merged(found: Sequence[AxisCrossing]) -> list[AxisCrossing]:
    """Returns crossings with those of one frequency and delay counted together."""
    merged: list[AxisCrossing] = []
    for one in sorted(found):
        last = merged[-1] if merged else None
        if (
            last
            and abs(one.delay_s - last.delay_s) <= 1e-7 * (1e-3 + one.delay_s)
            and (abs(one.omega_rad_s - last.omega_rad_s) <= 1e-7 * one.omega_rad_s)
        ):
            merged[-1] = last._replace(pairs=last.pairs + one.pairs)
        else:
            merged.append(one)
    return merged


class _Sweep:
    """The eigenvalues of G(j w) over frequency."""

    def __init__(self, pencil: DelayPencil) -> None:
        self._A, self._late = pencil.A, pencil.late
        self._Ad = pencil.Ad[0][:, pencil.late]
        self._highest = float(np.linalg.norm(pencil.A, 2) + np.linalg.norm(pencil.Ad[0], 2))
        self._modes: Complex = np.concatenate(
            [np.linalg.eigvals(pencil.A), np.linalg.eigvals(pencil.A + pencil.Ad[0])]
        ).astype(np.complex128)

    def grid(self) -> Array:
        """Returns frequencies to look at, rad/s: more of them where the loop's own modes are."""
        plain = np.geomspace(_LOWEST * self._highest, self._highest, _POINTS)
        near = self._modes[np.abs(self._modes.imag) > 0.0]
        about = np.abs(near.imag)[:, np.newaxis] + np.abs(near.real)[:, np.newaxis] * np.linspace(-3, 3, 13)
        both = np.unique(np.concatenate([plain, about.ravel()]))
        kept: Array = both[(both >= plain[0]) & (both <= plain[-1])]
        return kept

    def values(self, omega: Array) -> Complex:
        """Returns the eigenvalues of G(j w), shape (K, c)."""
        n = len(self._A)
        inner = 1j * omega[:, np.newaxis, np.newaxis] * np.eye(n) - self._A
        G = np.linalg.solve(inner, np.broadcast_to(self._Ad, (len(omega), *self._Ad.shape)))
        return np.linalg.eigvals(G[:, self._late, :]).astype(np.complex128)

    def outside(self, omega: Array) -> NDArray[np.int64]:
        """Returns how many of them have a modulus above 1, shape (K,)."""
        counts: NDArray[np.int64] = (np.abs(self.values(omega)) > 1.0).sum(axis=1)
        return counts

    def between(self, low: float, high: float) -> list[AxisCrossing]:
        """Returns the crossings between two frequencies whose counts differ."""
        ends = self.outside(np.array([low, high]))
        if ends[0] == ends[1]:
            return []
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            count = self.outside(np.array([middle]))[0]
            if count not in ends:
                return self.between(low, middle) + self.between(middle, high)
            low, high = (middle, high) if count == ends[0] else (low, middle)
            if high - low <= 1e-13 * high:
                break
        omega = 0.5 * (low + high)
        values = self.values(np.array([omega]))[0]
        order = np.argsort(np.abs(np.abs(values) - 1.0), kind="stable")
        pairs = int(ends[0] - ends[1])
        found = []
        for value in values[order[: abs(pairs)]]:
            phase = math.atan2(value.imag, value.real) % (2.0 * math.pi)
            turns = range(int(MAX_COMMON_DELAY_S * omega / (2.0 * math.pi)) + 2)
            delays_s = [(phase + 2.0 * math.pi * turn) / omega for turn in turns]
            sign = 1 if pairs > 0 else -1
            found += [AxisCrossing(d, omega, sign) for d in delays_s if 0.0 < d <= MAX_COMMON_DELAY_S]
        return found

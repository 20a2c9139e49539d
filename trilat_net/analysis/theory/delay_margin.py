"""Computes the delay margin: the network delays for which the control loop is stable.

The linearised control loop is x' = A x + A_d x(t - T), with the state x, constant matrices A
and A_d, and the same delay T on all links. Only some components of x act with a delay. A
characteristic root of the loop lies on the imaginary axis at j w, where j is the imaginary unit
and w an angular frequency, if

    det(I - exp(-j w T) G(j w)) = 0.

G(j w) consists of those rows of (j w I - A)^-1 A_d that belong to the delayed components. Such
a root exists if and only if G(j w) has an eigenvalue of modulus 1 whose phase is w T modulo 2
pi. As T increases, a pair of roots moves into the unstable half plane if the modulus of this
eigenvalue falls with w, and out of it if the modulus rises. Starting from a small delay, the
crossings are counted, which gives the number of unstable roots for every delay.

Sources:
    - Chen, Gu and Nett, "A new method for computing delay margins for stability of linear delay
      systems", Systems & Control Letters 26 (1995).
    - Cooke and van den Driessche, "On zeroes of some transcendental equations", Funkcialaj
      Ekvacioj 29 (1986).

Invariant:
    - Crossings of the imaginary axis are searched for over frequency, not over delay. No
      crossing between two delays can therefore be missed.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import Array
from ...errors import count_nouns
from ..blas_threads import limit_blas_threads
from . import characteristic_roots
from .linear_loop import LinearLoop

MAX_COMMON_DELAY_S = 10.0
"""Longest common delay that is examined, in s."""
_LISTED_INTERVALS = 3
"""Largest number of intervals that the description lists one by one."""
_POINTS = 600
"""Number of frequencies of the grid, in addition to those near the loop's modes."""
_LOWEST = 1e-4
"""Lowest frequency of the grid, relative to the highest one at which a crossing is possible."""
_LEAST_WIDTH = 1e-6
"""Least distance of grid points near a mode, relative to its frequency."""
_BISECTIONS = 60
"""Largest number of bisections that locate a crossing."""
_OUTSIDE = 1.0 + 1e-9
"""Largest modulus of an eigenvalue that does not lie outside the unit circle.

The difference from 1 allows for rounding: the modulus of a line without losses is 1 at every
frequency.
"""


class _AxisCrossing(NamedTuple):
    """Network delay at which roots of the loop cross the imaginary axis, as the delay grows.

    The loop becomes stable or unstable there.

    Attributes:
        delay_s: The common delay, in s.
        omega_rad_s: Frequency of the crossing, in rad/s.
        pairs: Number of pairs that cross to the right. Negative for crossings to the left.
    """

    delay_s: float
    omega_rad_s: float
    pairs: int


class _DelayInterval(NamedTuple):
    """Interval of network delays, equal on all links, for which a control loop is stable.

    A crossing is a delay at which a root of the loop reaches the imaginary axis.

    Attributes:
        low_s: Lower end, in s. 0 if the loop is stable without delay.
        high_s: Upper end, in s. `MAX_COMMON_DELAY_S` if no root crosses at a smaller delay.
        low: Crossing at the lower end. `None` if no root crosses there.
        high: Crossing at the upper end. `None` if no root crosses there.
    """

    low_s: float
    high_s: float
    low: _AxisCrossing | None
    high: _AxisCrossing | None

    @property
    def description(self) -> str:
        """A phrase for the user, such as "from 2 ms up to 9.5 ms (crosses at 31 rad/s)".

        It names the ends of the interval of stable delays, and the frequency at which
        characteristic roots cross the imaginary axis at the upper end. It is empty if no roots
        cross at either end, because the loop is then stable for all examined delays.
        """
        if self.low is None and self.high is None:
            return ""

        low_ms = 1e3 * self.low_s
        high_ms = 1e3 * self.high_s
        start = "" if self.low is None else f"from {low_ms:.4g} ms "
        if self.high is None:
            return f"{start}on"
        frequency = f"(crosses at {self.high.omega_rad_s:.4g} rad/s)"
        return f"{start}up to {high_ms:.4g} ms {frequency}"


class DelayMargin(NamedTuple):
    """Network delays, equal on all links, for which the coupled arms are stable.

    As the delay grows, characteristic roots of the loop may cross the imaginary axis. The arms
    become unstable if roots cross to the right, and may become stable if they return.

    Attributes:
        intervals: Intervals of stable delays, in ascending order. Empty if the loop is unstable
            for every delay.
        crossings: All crossings of the imaginary axis for delays up to `MAX_COMMON_DELAY_S`, in
            ascending order of delay.
        lossless: True if the links carry waves without losses. Some roots are then on the
            imaginary axis for every delay.
    """

    intervals: tuple[_DelayInterval, ...]
    crossings: tuple[_AxisCrossing, ...]
    lossless: bool = False

    @property
    def description(self) -> str:
        """A phrase that states for which network delays the arms are stable.

        The delay is assumed to be the same on all links between the arms.
        """
        if self.lossless:
            return (
                "none: waves run along lines without losses, "
                "and roots are on the axis for every delay"
            )
        if not self.intervals:
            return f"unstable for every common delay up to {MAX_COMMON_DELAY_S:g} s"
        texts = [interval.description for interval in self.intervals]
        if texts == [""]:
            return f"stable for every common delay up to {MAX_COMMON_DELAY_S:g} s"

        listed = ", ".join(texts[:_LISTED_INTERVALS])
        more = ""
        if len(texts) > _LISTED_INTERVALS:
            count = count_nouns(len(texts) - _LISTED_INTERVALS, "more range")
            more = f", and in {count}"
        return f"stable for common delays {listed}{more}"

    @classmethod
    def of_loop(cls, loop: LinearLoop) -> "DelayMargin":
        """Finds the network delays, equal on all links, for which a control loop is stable.

        The common delay replaces the delays of the loop itself. The unstable characteristic
        roots are counted for a small delay, below the first delay at which roots cross the
        imaginary axis. For larger delays, every crossing changes the count by the number of
        roots that cross.

        Args:
            loop: Linear model of the coupled arms.

        Returns:
            The intervals of stable delays, and the crossings that bound them.
        """
        crossings, lossless = _find_axis_crossings(loop)
        if lossless:
            return cls((), (), lossless)

        delays_s = [crossing.delay_s for crossing in crossings]
        first_s = min(delays_s, default=0.2)
        start_s = 0.5 * min(first_s, 0.2)
        start_loop = loop.set_common_delay(start_s)
        unstable_roots = _count_unstable_roots(start_loop)

        # Walk through the crossings. Each one may end or begin a stable interval.
        intervals: list[_DelayInterval] = []
        low: _AxisCrossing | None = None
        low_s = 0.0
        stable = unstable_roots == 0
        for crossing in crossings:
            roots_per_pair = 2 if crossing.omega_rad_s else 1
            unstable_roots += roots_per_pair * crossing.pairs
            if stable and unstable_roots > 0:
                interval = _DelayInterval(low_s, crossing.delay_s, low, crossing)
                intervals.append(interval)
                stable = False
            elif not stable and unstable_roots == 0:
                low = crossing
                low_s = crossing.delay_s
                stable = True

        if stable:
            last_interval = _DelayInterval(low_s, MAX_COMMON_DELAY_S, low, None)
            intervals.append(last_interval)
        return cls(tuple(intervals), tuple(crossings))


def _count_unstable_roots(loop: LinearLoop) -> int:
    """Returns the number of roots with a positive real part, which belong to growing motions.

    An increasing number of the rightmost roots is computed, until one of them is stable.
    """
    requested_roots = 8
    while True:
        roots = characteristic_roots.Spectrum.of_loop(loop, requested_roots).roots
        unstable = [root for root in roots if root.s.real > 0.0]
        has_stable_root = len(unstable) < len(roots)
        if has_stable_root or len(roots) < requested_roots:
            break
        requested_roots *= 2

    count = 0
    for root in unstable:
        # a root with an imaginary part stands for a conjugate pair
        roots_per_entry = 2 if root.s.imag else 1
        count += root.multiplicity * roots_per_entry
    return count


def _find_axis_crossings(loop: LinearLoop) -> tuple[list[_AxisCrossing], bool]:
    """Finds the network delays, equal on all links, at which stability can change.

    At such a delay, a root of the loop crosses the imaginary axis.

    Args:
        loop: The loop. Its own delays are ignored.

    Returns:
        The crossings for delays up to `MAX_COMMON_DELAY_S`.
        True if the loop is lossless: its open-loop response G has an eigenvalue of modulus 1 at
        every frequency. Roots are then on the axis for every delay, and there are no crossings.
    """
    common_loop = loop.set_common_delay(1.0)
    pencil, *_ = characteristic_roots.find_moving_part(common_loop)
    if not len(pencil.delays):
        return [], False

    with limit_blas_threads():
        sweep = _FrequencySweep(pencil)
        grid = sweep.build_grid()
        moduli = np.abs(sweep.compute_eigenvalues(grid))
        is_not_outside = moduli <= _OUTSIDE
        is_not_inside = moduli >= 2.0 - _OUTSIDE
        is_on_circle = is_not_outside & is_not_inside
        if is_on_circle.any(axis=1).all():
            return [], True

        is_outside = moduli > _OUTSIDE
        counts = is_outside.sum(axis=1)
        crossings = []
        changes = np.diff(counts)
        for n in np.flatnonzero(changes):
            low = float(grid[n])
            high = float(grid[n + 1])
            crossings += sweep.find_crossings(low, high)
    return _merge_crossings(crossings), False


def _merge_crossings(crossings: Sequence[_AxisCrossing]) -> list[_AxisCrossing]:
    """Sorts crossings, and merges those that differ in delay and frequency by rounding only.

    Several pairs of roots may cross together, as in loops of equal arms. The sweep lists them
    one by one, and a merged crossing counts all of them.

    Args:
        crossings: Crossings of the imaginary axis, each by one pair of roots.
    """
    merged: list[_AxisCrossing] = []
    for crossing in sorted(crossings):
        if merged and _is_same_crossing(merged[-1], crossing):
            last = merged[-1]
            pairs = last.pairs + crossing.pairs
            merged[-1] = last._replace(pairs=pairs)
        else:
            merged.append(crossing)
    return sorted(merged)


def _is_same_crossing(last: _AxisCrossing, crossing: _AxisCrossing) -> bool:
    """Returns True if two crossings differ in delay and frequency by rounding only."""
    delay_difference_s = abs(crossing.delay_s - last.delay_s)
    delay_tolerance_s = 1e-7 * (1e-3 + crossing.delay_s)
    if delay_difference_s > delay_tolerance_s:
        return False
    difference_rad_s = abs(crossing.omega_rad_s - last.omega_rad_s)
    return difference_rad_s <= 1e-7 * crossing.omega_rad_s


class _FrequencySweep:
    """Eigenvalues of the open-loop frequency response G(j w) over the frequency w.

    `_find_axis_crossings` searches them for the frequencies at which a modulus is 1, because
    the loop can become unstable only at these frequencies.

    Args:
        pencil: Matrices of the loop, with a single delay.
    """

    def __init__(self, pencil: characteristic_roots.Pencil) -> None:
        A = pencil.A
        Ad = pencil.Ad[0]
        self._A = A
        self._delayed = pencil.delayed_states
        self._rate_matrix = pencil.rate_matrix
        self._Ad = Ad[:, self._delayed]

        norm = np.linalg.norm(A, 2)
        delayed_norm = np.linalg.norm(Ad, 2)
        self._highest = float(norm + delayed_norm)

        modes_without_links = np.linalg.eigvals(A)
        modes_without_delay = np.linalg.eigvals(A + Ad)
        modes = np.concatenate([modes_without_links, modes_without_delay])
        self._modes: characteristic_roots.Complex = modes.astype(np.complex128)

    def build_grid(self) -> Array:
        """Returns the frequencies to evaluate, in ascending order, in rad/s.

        The frequencies are evenly spaced on a logarithmic scale. Near the frequency of each
        oscillating mode, 13 more points are added within three times the decay rate of the
        mode, because sharp resonances would fall between the evenly spaced points. If a mode
        does not decay, the response is infinite at its frequency, and the points are placed on
        either side of it.
        """
        lowest = _LOWEST * self._highest
        even = np.geomspace(lowest, self._highest, _POINTS)

        oscillates = np.abs(self._modes.imag) > 0.0
        modes = self._modes[oscillates]
        centres = np.abs(modes.imag)[:, np.newaxis]
        decay_rates = np.abs(modes.real)[:, np.newaxis]
        least_widths = _LEAST_WIDTH * centres
        is_undamped = decay_rates < least_widths
        widths = np.maximum(decay_rates, least_widths)
        # half a step, so that no point is the frequency of an undamped mode
        offsets = np.linspace(-3, 3, 13) + 0.25 * is_undamped
        near_modes = centres + widths * offsets

        candidates = np.concatenate([even, near_modes.ravel()])
        points = np.unique(candidates)
        is_above = points >= even[0]
        is_below = points <= even[-1]
        is_within = is_above & is_below
        grid: Array = points[is_within]
        return grid

    def compute_eigenvalues(self, omega: Array) -> characteristic_roots.Complex:
        """Computes the eigenvalues of the open-loop frequency response G(j w).

        The loop becomes unstable at a delay for which an eigenvalue, rotated by the delay,
        equals 1.

        Args:
            omega: Frequencies w, shape (K,), in rad/s.

        Returns:
            Eigenvalues, shape (K, c), where c is the number of states that act after a delay.
        """
        s = 1j * omega[:, np.newaxis, np.newaxis]
        delta = s * self._rate_matrix - self._A
        shape = (len(omega), *self._Ad.shape)
        Ad = np.broadcast_to(self._Ad, shape)
        G = np.linalg.solve(delta, Ad)
        delayed_rows = G[:, self._delayed, :]
        return np.linalg.eigvals(delayed_rows).astype(np.complex128)

    def count_outside(self, omega: Array) -> NDArray[np.int64]:
        """Counts the eigenvalues of the open-loop frequency response outside the unit circle.

        G(j w) is the open-loop frequency response: the response of the states that act with a
        delay to their own delayed values, excluding the delay itself.

        Args:
            omega: Frequencies w, shape (K,), in rad/s.

        Returns:
            The number of eigenvalues of G(j w) outside the unit circle, shape (K,).
        """
        moduli = np.abs(self.compute_eigenvalues(omega))
        is_outside = moduli > _OUTSIDE
        counts: NDArray[np.int64] = is_outside.sum(axis=1)
        return counts

    def find_crossings(self, low: float, high: float) -> list[_AxisCrossing]:
        """Finds where eigenvalues of the open-loop frequency response cross the unit circle.

        At the frequency w of a crossing, an eigenvalue of the response G(j w) has modulus one.
        A delay can then place a characteristic root of the loop on the imaginary axis, at j w.
        Crossings are located by bisection, because the number of eigenvalues outside the circle
        changes there.

        Args:
            low: Lower end of the frequency range, in rad/s.
            high: Upper end of the frequency range, in rad/s.

        Returns:
            The crossings of the imaginary axis by roots, for all delays that cause them. Empty
            if the number of eigenvalues outside the circle is equal at both ends.
        """
        ends = self.count_outside(np.array([low, high]))
        if ends[0] == ends[1]:
            return []

        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            count = self.count_outside(np.array([middle]))[0]
            if count not in ends:
                # several eigenvalues cross here: search both halves
                lower_half = self.find_crossings(low, middle)
                upper_half = self.find_crossings(middle, high)
                return lower_half + upper_half
            if count == ends[0]:
                low = middle
            else:
                high = middle
            if high - low <= 1e-13 * high:
                break

        omega = 0.5 * (low + high)
        pairs = int(ends[0] - ends[1])
        return self._list_delays(omega, pairs)

    def _list_delays(self, omega: float, pairs: int) -> list[_AxisCrossing]:
        """Lists the delays at which roots of the loop lie on the imaginary axis at s = j w.

        For each eigenvalue of modulus 1 these are the delays T with w T = phase + 2 pi k.

        Args:
            omega: The frequency w, in rad/s.
            pairs: Number of these eigenvalues. Positive if roots move to the right.
        """
        (values,) = self.compute_eigenvalues(np.array([omega]))
        distances = np.abs(np.abs(values) - 1.0)
        by_distance = np.argsort(distances, kind="stable")
        nearest = values[by_distance[: abs(pairs)]]

        sign = 1 if pairs > 0 else -1
        full_turn = 2.0 * math.pi
        most_turns = int(MAX_COMMON_DELAY_S * omega / full_turn)
        crossings = []
        for value in nearest:
            phase = math.atan2(value.imag, value.real) % full_turn
            for turn in range(most_turns + 2):
                angle = phase + full_turn * turn
                delay_s = angle / omega
                if 0.0 < delay_s <= MAX_COMMON_DELAY_S:
                    crossing = _AxisCrossing(delay_s, omega, sign)
                    crossings.append(crossing)
        return crossings

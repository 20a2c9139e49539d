"""Adaptive frequency grids, the minima of curves over frequency, and the bands below a level.

Invariant: values on a grid are evidence and no proof. A grid is refined where the response changes by more
than a tenth, and about every minimum until the deepest changes by less than 1 %; features narrower than its
steps stay hidden.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from .port_response import PortResponse

FrequencyCurve = Callable[[Array], Array]
"""Values, shape (F,), for frequencies of shape (F,), rad/s."""

LOW_HZ, HIGH_HZ = 1e-3, 100.0
"""The band that is looked at unless another one is asked for."""

_PER_DECADE = 40
_PER_TURN = 16
"""Points for one turn of the phase of a round trip."""
_MOST = 6000
_CHANGE = 0.1
_CLOSEST = 1e-6
_ROUNDS = 20
_SETTLED = 0.01


class FrequencyBand(NamedTuple):
    """A range of frequencies.

    Attributes:
        from_hz: where it begins, Hz.
        to_hz: where it ends, Hz.
    """

    from_hz: float
    to_hz: float


class Minima(NamedTuple):
    """A curve whose dips are resolved.

    Attributes:
        w_rad_s: frequencies, shape (F,).
        values: shape (F,).
        below: where it lies below its level.
    """

    w_rad_s: Array
    values: Array
    below: tuple[FrequencyBand, ...]

    @property
    def least(self) -> float:
        """Its least value."""
        return float(self.values.min())

    @property
    def least_hz(self) -> float:
        """Where that is, Hz."""
        return float(self.w_rad_s[self.values.argmin()] / (2.0 * np.pi))


def build_frequency_grid(low_hz: float, high_hz: float, delay_s: float) -> Array:
    """Returns frequencies, rad/s, even on a logarithmic axis and close enough for the phase of a delay.

    Args:
        low_hz: the lowest, Hz.
        high_hz: the highest, Hz.
        delay_s: the longest delay: a round trip turns the phase once in pi / T rad/s.
    """
    low, high = 2.0 * np.pi * low_hz, 2.0 * np.pi * high_hz
    count = max(2, round(_PER_DECADE * np.log10(high / low)) + 1)
    points = np.geomspace(low, high, count)
    if delay_s > 0.0:
        step = max(np.pi / (delay_s * _PER_TURN), (high - low) / _MOST)
        points = np.union1d(points, np.arange(low, high, step))
    return points


def find_resolved_hz(low_hz: float, high_hz: float, delay_s: float) -> float:
    """Returns up to where `grid` has at least four points in a turn of a round trip, Hz."""
    even_hz = (high_hz - low_hz) / _MOST
    if 8.0 * even_hz * delay_s <= 1.0:
        return high_hz
    return 1.0 / (8.0 * delay_s * float(10.0 ** (1.0 / _PER_DECADE) - 1.0))


def refine_frequencies(response: PortResponse, w_rad_s: Array) -> Array:
    """Returns frequencies between which the answer changes by at most a tenth of itself, if points allow.

    At a pole on the axis it stops where two points differ by a millionth.

    Args:
        response: the answer.
        w_rad_s: where to begin, shape (F,).
    """
    Y = response(w_rad_s)
    for _ in range(_ROUNDS):
        size = np.linalg.norm(Y, axis=(1, 2))
        change = np.linalg.norm(np.diff(Y, axis=0), axis=(1, 2))
        wide = change > _CHANGE * np.maximum(np.maximum(size[1:], size[:-1]), 1e-300)
        wide &= w_rad_s[1:] > w_rad_s[:-1] * (1.0 + _CLOSEST)
        if not wide.any() or len(w_rad_s) > 2 * _MOST:
            break
        between = np.sqrt(w_rad_s[:-1] * w_rad_s[1:])[wide]
        place = np.flatnonzero(wide) + 1
        w_rad_s, Y = np.insert(w_rad_s, place, between), np.insert(Y, place, response(between), axis=0)
    return w_rad_s


def cache_response(response: PortResponse, w_rad_s: Array) -> PortResponse:
    """Returns the same answer, which for these very frequencies is computed once.

    Args:
        response: the answer.
        w_rad_s: the frequencies, shape (F,).
    """
    known = response(w_rad_s)
    return lambda w: known if w is w_rad_s else response(w)


def find_minima(
    curve: FrequencyCurve, w_rad_s: Array, level: float = 0.0, tolerance: FrequencyCurve | None = None
) -> Minima:
    """Returns the curve with its dips resolved, and where it lies below a level.

    Args:
        curve: the curve.
        w_rad_s: where to begin, shape (F,).
        level: the level.
        tolerance: by how much it must be below, and dips must be deeper than what is beside them; None: by
            nothing.
    """
    allowed = tolerance or _nothing
    values, rounding = curve(w_rad_s), allowed(w_rad_s)
    for _ in range(_ROUNDS):
        beside = _beside_dips(values, rounding) & (w_rad_s[1:] > w_rad_s[:-1] * (1.0 + _CLOSEST))
        if not beside.any() or len(w_rad_s) > 2 * _MOST:
            break
        between = np.sqrt(w_rad_s[:-1] * w_rad_s[1:])[beside]
        place = np.flatnonzero(beside) + 1
        w_rad_s, values = np.insert(w_rad_s, place, between), np.insert(values, place, curve(between))
        rounding = np.insert(rounding, place, allowed(between))
    return Minima(w_rad_s, values, _below(lambda w: curve(w) + allowed(w), w_rad_s, values + rounding, level))


def _nothing(w_rad_s: Array) -> Array:
    return np.zeros(len(w_rad_s))


def _beside_dips(values: Array, rounding: Array) -> NDArray[np.bool_]:
    """Returns which steps lie beside a dip that is not settled: its neighbours are more than 1 % above it.

    Of its depth, or of that of the deepest where that is more; and more than rounding.
    """
    middle, rise = values[1:-1], np.maximum(values[:-2], values[2:]) - values[1:-1]
    low = (middle <= values[:-2]) & (middle <= values[2:])
    low &= rise > np.maximum(_SETTLED * np.maximum(np.abs(middle), abs(values.min())), rounding[1:-1])
    dip = np.r_[False, low, False]
    beside: NDArray[np.bool_] = dip[1:] | dip[:-1]
    return beside


def _below(curve: FrequencyCurve, w_rad_s: Array, values: Array, level: float) -> tuple[FrequencyBand, ...]:
    """Returns where a curve lies below a level; edges by bisection, together for all of them."""
    found = values < level
    turns = np.flatnonzero(found[1:] != found[:-1])
    low, high, was = w_rad_s[turns], w_rad_s[turns + 1], found[turns]
    for _ in range(30 if len(turns) else 0):
        middle = np.sqrt(low * high)
        same = (curve(middle) < level) == was
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    edges = np.sqrt(low * high).tolist()
    if found[0]:
        edges.insert(0, float(w_rad_s[0]))
    if found[-1]:
        edges.append(float(w_rad_s[-1]))
    hz = [edge / (2.0 * np.pi) for edge in edges]
    return tuple(FrequencyBand(a, b) for a, b in zip(hz[::2], hz[1::2], strict=True))

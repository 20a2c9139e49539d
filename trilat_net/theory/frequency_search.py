"""Adaptive frequency grids, the minima of curves over frequency, and the bands below a level.

Invariant: values on a grid are evidence and no proof. A grid is refined where the response
changes by more than a tenth, and about every minimum until the deepest changes by less than 1
%; features narrower than its steps stay hidden.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from .characteristic_roots import Complex
from .port_response import PortResponse

FrequencyCurve = Callable[[Array], Array]
"""Values, shape (F,), for frequencies of shape (F,), rad/s."""

LOW_HZ = 1e-3
HIGH_HZ = 100.0
"""The default band."""

_PER_DECADE = 40
_PER_TURN = 16
"""Points for one turn of the phase of a round trip."""
_MAX_POINTS = 6000
_CHANGE = 0.1
_CLOSEST = 1e-6
_ROUNDS = 20
_SETTLED = 0.01


class FrequencyBand(NamedTuple):
    """A range of frequencies, Hz."""

    from_hz: float
    to_hz: float


class Minima(NamedTuple):
    """A curve with resolved minima.

    Attributes:
        w_rad_s: frequencies, shape (F,).
        values: shape (F,).
        below: the bands in which it lies below its level.
    """

    w_rad_s: Array
    values: Array
    below: tuple[FrequencyBand, ...]

    @property
    def least(self) -> float:
        """The least value."""
        return float(self.values.min())

    @property
    def least_hz(self) -> float:
        """The frequency of the least value, Hz."""
        return float(self.w_rad_s[self.values.argmin()] / (2.0 * np.pi))


def build_frequency_grid(low_hz: float, high_hz: float, delay_s: float) -> Array:
    """Returns frequencies, rad/s, even on a logarithmic axis and close enough for the phase of
    a delay.

    A round trip over the longest delay, T, turns the phase once in pi / T rad/s.
    """
    low = 2.0 * np.pi * low_hz
    high = 2.0 * np.pi * high_hz
    count = max(2, round(_PER_DECADE * np.log10(high / low)) + 1)
    points = np.geomspace(low, high, count)
    if delay_s > 0.0:
        step = max(np.pi / (delay_s * _PER_TURN), (high - low) / _MAX_POINTS)
        points = np.union1d(points, np.arange(low, high, step))
    return points


def find_resolved_hz(low_hz: float, high_hz: float, delay_s: float) -> float:
    """Returns the frequency up to which the grid has at least four points in a turn of a round
    trip, Hz.
    """
    step_hz = (high_hz - low_hz) / _MAX_POINTS
    if 8.0 * step_hz * delay_s <= 1.0:
        return high_hz
    return 1.0 / (8.0 * delay_s * float(10.0 ** (1.0 / _PER_DECADE) - 1.0))


def refine_frequencies(response: PortResponse, w_rad_s: Array) -> Array:
    """Returns frequencies between which the response changes by at most a tenth, within a limit
    of points.

    At a pole on the axis refinement stops when two points differ by a millionth.
    """

    def find_wide(Y: Complex) -> NDArray[np.bool_]:
        size = np.linalg.norm(Y, axis=(1, 2))
        change = np.linalg.norm(np.diff(Y, axis=0), axis=(1, 2))
        wide: NDArray[np.bool_] = change > _CHANGE * np.maximum(
            np.maximum(size[1:], size[:-1]), 1e-300
        )
        return wide

    return _refine(response, w_rad_s, find_wide)[0]


def _refine(
    function: Callable[[Array], NDArray[Any]],
    w_rad_s: Array,
    find_wide: Callable[[NDArray[Any]], NDArray[np.bool_]],
) -> tuple[Array, NDArray[Any]]:
    values = function(w_rad_s)
    for _ in range(_ROUNDS):
        wide = find_wide(values) & (w_rad_s[1:] > w_rad_s[:-1] * (1.0 + _CLOSEST))
        if not wide.any() or len(w_rad_s) > 2 * _MAX_POINTS:
            break
        between = np.sqrt(w_rad_s[:-1] * w_rad_s[1:])[wide]
        place = np.flatnonzero(wide) + 1
        w_rad_s = np.insert(w_rad_s, place, between)
        values = np.insert(values, place, function(between), axis=0)
    return w_rad_s, values


def cache_response(response: PortResponse, w_rad_s: Array) -> PortResponse:
    """Returns the same response, computed only once for this very array of frequencies."""
    known = response(w_rad_s)
    return lambda w: known if w is w_rad_s else response(w)


def find_minima(
    curve: FrequencyCurve,
    w_rad_s: Array,
    level: float = 0.0,
    tolerance: FrequencyCurve | None = None,
) -> Minima:
    """Returns the curve with its minima resolved, and the bands below a level, from first
    frequencies on.

    `tolerance` is the least depth below the level, and of a minimum below its neighbours; None:
    zero.
    """
    allowed = tolerance or (lambda w: np.zeros(len(w)))
    w_rad_s, both = _refine(
        lambda w: np.stack([curve(w), allowed(w)], axis=1), w_rad_s, _find_steps_at_minima
    )
    values, rounding = both.T
    below = _find_bands_below(
        lambda w: curve(w) + allowed(w), w_rad_s, values + rounding, level
    )
    return Minima(w_rad_s, values, below)


def _find_steps_at_minima(curve_and_rounding: Array) -> NDArray[np.bool_]:
    """Returns the steps at minima that are not settled: a neighbour is more than 1 % above
    them.

    1 % of their depth, or of that of the deepest if that is more; and more than rounding.
    """
    values, rounding = curve_and_rounding.T
    middle = values[1:-1]
    rise = np.maximum(values[:-2], values[2:]) - values[1:-1]
    low = (middle <= values[:-2]) & (middle <= values[2:])
    low &= rise > np.maximum(
        _SETTLED * np.maximum(np.abs(middle), abs(values.min())), rounding[1:-1]
    )
    minimum = np.r_[False, low, False]
    steps: NDArray[np.bool_] = minimum[1:] | minimum[:-1]
    return steps


def _find_bands_below(
    curve: FrequencyCurve, w_rad_s: Array, values: Array, level: float
) -> tuple[FrequencyBand, ...]:
    """Returns the bands below a level; all edges are found by bisection together."""
    below = values < level
    turns = np.flatnonzero(below[1:] != below[:-1])
    low = w_rad_s[turns]
    high = w_rad_s[turns + 1]
    was = below[turns]
    for _ in range(30 if len(turns) else 0):
        middle = np.sqrt(low * high)
        same = (curve(middle) < level) == was
        low = np.where(same, middle, low)
        high = np.where(same, high, middle)
    edges = np.sqrt(low * high).tolist()
    if below[0]:
        edges.insert(0, float(w_rad_s[0]))
    if below[-1]:
        edges.append(float(w_rad_s[-1]))
    hz = [edge / (2.0 * np.pi) for edge in edges]
    return tuple(FrequencyBand(a, b) for a, b in zip(hz[::2], hz[1::2], strict=True))

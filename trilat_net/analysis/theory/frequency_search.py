"""Finds minima of curves over frequency, and the bands in which a curve is below a level.

The curves, such as eigenvalues of a frequency response, can only be evaluated at discrete
frequencies, and a coarse grid would miss narrow minima. The grid is therefore refined where the
response changes by more than a tenth between two points, and around each minimum until its
neighbours are less than 1 % higher.

Invariant:
    - Values on a grid are evidence, not a proof: features narrower than the grid spacing remain
      hidden.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import Array
from .characteristic_roots import Complex
from .port_response import PortResponse

FrequencyCurve = Callable[[Array], Array]
"""Values, shape (F,), for frequencies of shape (F,), rad/s."""

LOW_HZ = 1e-3
"""Lower end of the default band."""
HIGH_HZ = 100.0
"""Upper end of the default band."""

_PER_DECADE = 40
"""Points per decade."""
_PER_TURN = 16
"""Points per turn of the phase of a round trip."""
_MAX_POINTS = 6000
"""Largest number of points of a grid on a linear axis."""
_CHANGE = 0.1
"""Largest relative change of the response between two points."""
_CLOSEST = 1e-6
"""Smallest relative distance of two points."""
_ROUNDS = 20
"""Largest number of refinements."""
_SETTLED = 0.01
"""A minimum is resolved if its neighbours lie above it by at most this share of its depth."""


class _FrequencyBand(NamedTuple):
    """A range of frequencies, in Hz, for example the range in which a system is not passive."""

    from_hz: float
    to_hz: float


class Minima(NamedTuple):
    """A curve over frequency, sampled finely enough to resolve its minima.

    An example is the smallest eigenvalue of a frequency response: a condition such as passivity
    is violated where the eigenvalue is negative.

    Attributes:
        w_rad_s: Frequencies, shape (F,), in rad/s.
        values: Values of the curve, shape (F,).
        below: Bands of frequencies in which the curve is below a given level.
    """

    w_rad_s: Array
    values: Array
    below: tuple[_FrequencyBand, ...]

    @property
    def least(self) -> float:
        """Lowest value of the curve over all frequencies.

        For a curve that must be positive, such as an eigenvalue, this is the margin. A negative
        value is a violation.
        """
        return float(self.values.min())

    @property
    def least_hz(self) -> float:
        """Frequency in Hz at which the curve has its lowest value."""
        least_index = self.values.argmin()
        w_rad_s = self.w_rad_s[least_index]
        return float(w_rad_s / (2.0 * np.pi))

    @classmethod
    def find(
        cls,
        curve: FrequencyCurve,
        w_rad_s: Array,
        level: float = 0.0,
        tolerance: FrequencyCurve | None = None,
    ) -> "Minima":
        """Evaluates a curve over frequency, adding frequencies until its minima are resolved.

        A fixed grid would miss a narrow minimum between two of its frequencies.

        Args:
            curve: Function that returns the values of the curve at given frequencies.
            w_rad_s: Initial frequencies in ascending order, shape (F,), in rad/s.
            level: Value of the curve below which frequency bands are reported.
            tolerance: Function that returns the rounding error of the curve at given
                frequencies. Smaller differences from the level, or between neighbouring values,
                are ignored. `None` if there is no rounding error.

        Returns:
            The frequencies and values, and the bands in which the curve is below the level.
        """

        def find_rounding(w: Array) -> Array:
            return tolerance(w) if tolerance is not None else np.zeros(len(w))

        def evaluate(w: Array) -> Array:
            """Returns the curve and its rounding error at given frequencies, shape (F, 2)."""
            values = curve(w)
            rounding = find_rounding(w)
            return np.stack([values, rounding], axis=1)

        def evaluate_upper(w: Array) -> Array:
            return curve(w) + find_rounding(w)

        w_rad_s, refined = _refine(evaluate, w_rad_s, _find_steps_at_minima)
        values, rounding = refined.T
        upper_values = values + rounding
        below = _find_bands_below(evaluate_upper, w_rad_s, upper_values, level)
        return cls(w_rad_s, values, below)


def build_frequency_grid(low_hz: float, high_hz: float, delay_s: float) -> Array:
    """Returns frequencies that resolve the phase of a delay, in rad/s, shape (F,).

    The frequencies are evenly spaced on a logarithmic axis. More frequencies are added with
    even spacing on a linear axis, because a round trip with one-way delay T shifts the phase by
    a full turn every pi / T rad/s.

    Args:
        low_hz: Lower end of the band, in Hz.
        high_hz: Upper end of the band, in Hz.
        delay_s: The longest delay T, in s.
    """
    low = 2.0 * np.pi * low_hz
    high = 2.0 * np.pi * high_hz
    decades = np.log10(high / low)
    steps = round(_PER_DECADE * decades)
    count = max(2, steps + 1)
    points = np.geomspace(low, high, count)

    if delay_s > 0.0:
        phase_step = np.pi / (delay_s * _PER_TURN)
        least_step = (high - low) / _MAX_POINTS
        step = max(phase_step, least_step)
        linear_points = np.arange(low, high, step)
        points = np.union1d(points, linear_points)
    return points


def find_resolved_hz(low_hz: float, high_hz: float, delay_s: float) -> float:
    """Returns the frequency up to which a frequency grid resolves the phase of a delay, in Hz.

    For a signal that travels there and back with delay T each way, the phase makes a full turn
    every 1 / (2 T) Hz. Up to the returned frequency, the grid of `build_frequency_grid` has at
    least four points per turn. Above it, the points are farther apart.

    Args:
        low_hz: Lowest frequency of the grid, in Hz.
        high_hz: Highest frequency of the grid, in Hz.
        delay_s: The longest delay T, in s.
    """
    step_hz = (high_hz - low_hz) / _MAX_POINTS
    turns_per_step = 8.0 * step_hz * delay_s
    if turns_per_step <= 1.0:
        return high_hz
    # relative step of the logarithmic axis
    ratio = 10.0 ** (1.0 / _PER_DECADE)
    relative_step = float(ratio - 1.0)
    return 1.0 / (8.0 * delay_s * relative_step)


def refine_response(response: PortResponse, w_rad_s: Array) -> tuple[Array, PortResponse]:
    """Adds frequencies until a response changes little from one frequency to the next.

    The relative change from point to point is at most a tenth, unless the number of points
    reaches a limit. At a pole on the imaginary axis, refinement stops when two neighbouring
    frequencies differ by only a millionth.

    Several analyses evaluate the response at the refined frequencies. The returned response
    therefore has cached values there. The cached values are used only if the response is called
    with the returned array of frequencies itself, not with a copy.

    Args:
        response: The response as a function of frequency.
        w_rad_s: Initial frequencies in ascending order, shape (F,), in rad/s.

    Returns:
        All frequencies in ascending order, in rad/s.
        The response with cached values at these frequencies.
    """

    def find_large_changes(Y: Complex) -> NDArray[np.bool_]:
        """Marks the grid steps over which the response changes too much.

        These steps are then halved.
        """
        size = np.linalg.norm(Y, axis=(1, 2))
        larger_size = np.maximum(size[1:], size[:-1])
        reference = np.maximum(larger_size, 1e-300)
        differences = np.diff(Y, axis=0)
        change = np.linalg.norm(differences, axis=(1, 2))
        is_large: NDArray[np.bool_] = change > _CHANGE * reference
        return is_large

    refined, values = _refine(response, w_rad_s, find_large_changes)

    def evaluate(w: Array) -> Complex:
        return values if w is refined else response(w)

    return refined, evaluate


def _refine(
    function: Callable[[Array], NDArray[Any]],
    w_rad_s: Array,
    find_coarse: Callable[[NDArray[Any]], NDArray[np.bool_]],
) -> tuple[Array, NDArray[Any]]:
    """Adds frequencies to a grid where the values of a function require a finer step.

    Resonances need a fine step, and a fine step everywhere would take too long.

    Args:
        function: Function that returns values, shape (F, ...), for frequencies, shape (F,).
        w_rad_s: First frequencies, rising, shape (F,).
        find_coarse: Function that returns the steps of the grid to halve, shape (F - 1,), for
            the values.

    Returns:
        The refined frequencies.
        The values of the function at these frequencies.
    """
    values = function(w_rad_s)
    for _ in range(_ROUNDS):
        left = w_rad_s[:-1]
        right = w_rad_s[1:]
        closest_right = left * (1.0 + _CLOSEST)
        is_divisible = right > closest_right
        is_halved = find_coarse(values) & is_divisible
        has_too_many_points = len(w_rad_s) > 2 * _MAX_POINTS
        if has_too_many_points or not is_halved.any():
            break
        # geometric means, because the grid is logarithmic
        all_middles = np.sqrt(left * right)
        middles = all_middles[is_halved]
        indices = np.flatnonzero(is_halved) + 1
        w_rad_s = np.insert(w_rad_s, indices, middles)
        middle_values = function(middles)
        values = np.insert(values, indices, middle_values, axis=0)
    return w_rad_s, values


def _find_steps_at_minima(curve_and_rounding: Array) -> NDArray[np.bool_]:
    """Returns the steps of a grid at minima that are not resolved yet, shape (F - 1,).

    A minimum is not resolved if a neighbour lies above it by more than the rounding error, by
    more than 1 % of the minimum's depth, and by more than 1 % of the least value.

    Args:
        curve_and_rounding: Values of the curve and their rounding errors, shape (F, 2).
    """
    values, rounding = curve_and_rounding.T
    middle = values[1:-1]
    left = values[:-2]
    right = values[2:]
    is_minimum = (middle <= left) & (middle <= right)
    rise = np.maximum(left, right) - middle

    depth = abs(values.min())
    size = np.maximum(np.abs(middle), depth)
    settled_rise = _SETTLED * size
    limit = np.maximum(settled_rise, rounding[1:-1])
    is_coarse = is_minimum & (rise > limit)
    # the steps on both sides of such a point; the ends of the grid are not minima
    at_points = np.concatenate([[False], is_coarse, [False]])
    steps: NDArray[np.bool_] = at_points[1:] | at_points[:-1]
    return steps


def _find_bands_below(
    curve: FrequencyCurve,
    w_rad_s: Array,
    values: Array,
    level: float,
) -> tuple[_FrequencyBand, ...]:
    """Returns the frequency bands in which a curve is below a level, such as zero.

    The edges of the bands are located by bisection.

    Args:
        curve: The curve.
        w_rad_s: Frequencies, rising, shape (F,), in rad/s.
        values: Values of the curve, shape (F,).
        level: The level.
    """
    is_below = values < level
    crosses_level = is_below[1:] != is_below[:-1]
    edge_steps = np.flatnonzero(crosses_level)
    lower_ends = w_rad_s[edge_steps]
    upper_ends = w_rad_s[edge_steps + 1]
    is_low_below = is_below[edge_steps]
    if len(edge_steps):
        for _ in range(30):
            middle = np.sqrt(lower_ends * upper_ends)
            is_middle_below = curve(middle) < level
            is_like_low = is_middle_below == is_low_below
            lower_ends = np.where(is_like_low, middle, lower_ends)
            upper_ends = np.where(is_like_low, upper_ends, middle)
    band_edges = np.sqrt(lower_ends * upper_ends).tolist()
    # a band may extend beyond the grid
    if is_below[0]:
        band_edges.insert(0, float(w_rad_s[0]))
    if is_below[-1]:
        band_edges.append(float(w_rad_s[-1]))
    edges_hz = [edge / (2.0 * np.pi) for edge in band_edges]
    pairs = zip(edges_hz[::2], edges_hz[1::2], strict=True)
    return tuple(_FrequencyBand(from_hz, to_hz) for from_hz, to_hz in pairs)

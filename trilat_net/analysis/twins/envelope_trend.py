"""Decides whether an oscillation grows, decays or persists, over the second half of a run.

The envelope of a signal is its largest magnitude in each short time interval. The second half
of the run is divided into 16 equal windows, or into 8 if 16 show no clear trend. The maximum
of each window, at least `FLOOR_RAD`, is taken, and a straight line is fitted to the logarithms
of these maxima. Its slope has one-sided confidence bounds of 99.5 % (Student's t).

The classes use the four quarters of the second half, and the three steps between the maxima of
consecutive quarters:

- GROWS: the lower bound of the slope is positive, and each step is a rise of 1 % or more. The
  rise does not slow down: in logarithms, the last step is at least 3/4 of the first. If the
  maxima rise by more than a factor of 8/5 in total, 0.45 of the first step is sufficient,
  because no saturating response that starts at zero rises so much. Growth does not count if the
  first half of the run falls by 1 % or more from each quarter to the next.
- DECAYS: the upper bound of the slope is negative, and the line falls by a factor of two or
  more. The last step is a fall of at least half the size that it has in a steady fall by a
  factor of two. An envelope whose last quarter does not exceed `FLOOR_RAD` also decays.
- HARDLY: the upper bound is negative, and the line falls by 4 % or more, but the conditions of
  DECAYS do not hold.
- STEADY: the bounds show that the envelope neither doubles nor halves within the half.
- UNDECIDED: no other class applies, or the last step is more than a doubling without growth.

A class describes the record and predicts nothing. No finite record can rule out growth that
starts later. A beat that is longer than the run looks like growth while it rises.
"""

import math
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from ...core import Array

FLOOR_RAD = 1e-12
"""Envelopes below this value are rounding errors, in rad, or in rad/s for speeds."""

_T_QUANTILES = {16: 2.977, 8: 3.707}
"""99.5 % quantiles of Student's t with n - 2 degrees of freedom, by the number n of windows.

No further digits are used, because the classes of published runs were computed with these
values.
"""

_LEAST_STEP = math.log(1.01)
"""Smallest rise of the maxima from quarter to quarter in an envelope that grows: 1 %."""
_DOUBLE = math.log(2.0)
"""Logarithm of a doubling."""
_LARGEST_CALM_RISE = math.log(1.25)
"""Largest rise within the half that the upper bound of a calm envelope may permit."""
_LARGEST_CALM_STEP = math.log(1.5)
"""Largest rise of a calm envelope from the third quarter to the last quarter."""
_LARGEST_RISE_FROM_ZERO = math.log(8.0 / 5.0)
"""Largest rise over the quarters of a response that starts at zero and saturates."""


class EnvelopeTrend(Enum):
    """Trend of the magnitude of an oscillation in the second half of a run.

    The docstring of the module defines each member.
    """

    DECAYS = auto()
    HARDLY = auto()
    STEADY = auto()
    GROWS = auto()
    UNDECIDED = auto()


class EnvelopeFit(NamedTuple):
    """Trend of an oscillation's amplitude: growing, decaying or constant (see `fit_columns`).

    The envelope is the largest magnitude of a signal in each short time interval.

    Attributes:
        trend: Class of the trend, such as growing or decaying.
        rate_per_s: Growth rate, in 1/s, of the exponential exp(rate t) that is fitted to the
            envelope. NaN if the record is too short.
        calm: True if the envelope is not about to grow. Two conditions must hold. First, the
            envelope falls, or its rise within the second half of the run is certainly less than
            a quarter. Second, its maximum in the last quarter of this half is at most 1.5 times
            its maximum in the previous quarter.
    """

    trend: EnvelopeTrend
    rate_per_s: float
    calm: bool = False

    @classmethod
    def fit_columns(
        cls,
        t_s: Array,
        values: Array,
        floor: float = FLOOR_RAD,
        *,
        falls_first: bool = False,
    ) -> "list[EnvelopeFit]":
        """Determines whether oscillations grow, decay or persist in the second half of a run.

        The docstring of the module defines the possible trends.

        Args:
            t_s: Times in ascending order, shape (K,), in s.
            values: The C envelopes, shape (K, C). Each value is the largest magnitude of a
                signal in the interval that ends at the time of its row.
            floor: Value below which an envelope counts as zero, in the unit of `values`.
            falls_first: True if an envelope that first falls and then rises counts as growing.
                By default, the trend of such an envelope is undecided.

        Returns:
            The trend of each of the C envelopes.
        """
        envelopes = values.shape[1]
        no_fit = cls(EnvelopeTrend.UNDECIDED, math.nan)
        fits = [no_fit] * envelopes
        undecided = list(range(envelopes))
        for windows in _T_QUANTILES:
            maxima = _find_window_maxima(t_s, values[:, undecided], windows, floor)
            if maxima is None:
                continue
            half_s = 0.5 * (t_s[-1] - t_s[0])
            window_fits = _fit_maxima(maxima, half_s / windows, math.log(floor))
            for index, fit in zip(undecided, window_fits, strict=True):
                fits[index] = fit
            undecided = [
                index for index in undecided if fits[index].trend is EnvelopeTrend.UNDECIDED
            ]
        growing = [index for index, fit in enumerate(fits) if fit.trend is EnvelopeTrend.GROWS]
        if falls_first or not growing:
            return fits

        # growth after a fall in the first half is a V shape, in reversed time a rise
        reversed_t_s = -t_s[::-1]
        reversed_values = values[::-1, growing]
        first_half = _find_window_maxima(reversed_t_s, reversed_values, 4, floor)
        if first_half is None:
            return fits
        steps = np.diff(np.log(first_half), axis=0)
        least_steps = steps.min(axis=0)
        for index, least_step in zip(growing, least_steps, strict=True):
            if least_step >= _LEAST_STEP:
                fits[index] = fits[index]._replace(trend=EnvelopeTrend.UNDECIDED)
        return fits


def _find_window_maxima(
    t_s: Array,
    values: Array,
    windows: int,
    floor: float,
) -> Array | None:
    """Returns the maximum amplitude in each of several equal windows of time.

    Maxima of windows remove the oscillation. Only the second half of the run is considered,
    after the first transients.

    Args:
        t_s: Ascending times, shape (K,), in s.
        values: The C envelopes, shape (K, C).
        windows: Number of windows.
        floor: Smaller maxima are replaced by this value.

    Returns:
        The maxima, shape (windows, C). `None` if some window has fewer than two points.
    """
    if not len(t_s):
        return None
    end_s = t_s[-1]
    middle_s = 0.5 * (t_s[0] + end_s)
    edges = np.linspace(middle_s, end_s, windows + 1)
    starts = np.searchsorted(t_s, edges[:-1])
    counts = np.diff(np.append(starts, len(t_s)))
    if np.any(counts < 2):
        return None
    maxima = np.maximum.reduceat(values, starts, axis=0)
    return np.maximum(maxima, floor)


def _fit_maxima(maxima: Array, window_s: float, log_floor: float) -> list[EnvelopeFit]:
    """Fits a line to the logarithm of a motion's amplitude, and classifies its trend.

    An amplitude that falls exponentially gives a straight line with a negative slope.

    Args:
        maxima: Maxima of n equal windows of C envelopes, shape (n, C).
        window_s: Length of a window, in s.
        log_floor: Logarithm of the floor. An envelope below the floor counts as zero.
    """
    windows = len(maxima)
    log_maxima = np.log(maxima)
    centred_index = np.arange(windows) - 0.5 * (windows - 1)
    x_squares = float(centred_index @ centred_index)
    index_column = centred_index[:, np.newaxis]
    # least squares; a sum, because the last bits of a matrix product may vary between machines
    products = (index_column * log_maxima).sum(axis=0)
    slopes = products / x_squares
    residual = log_maxima - log_maxima.mean(axis=0) - index_column * slopes
    residual_squares = (residual**2).sum(axis=0)
    slope_variance = residual_squares / (windows - 2) / x_squares
    slope_bounds = _T_QUANTILES[windows] * np.sqrt(slope_variance)

    windows_by_quarter = maxima.reshape(4, windows // 4, -1)
    log_quarters = np.log(windows_by_quarter.max(axis=1))

    fits = []
    lines = zip(slopes.tolist(), slope_bounds.tolist(), log_quarters.T, strict=True)
    for slope, slope_bound, log_quarter in lines:
        steps = np.diff(log_quarter)
        is_dead = float(log_quarter[-1]) <= log_floor
        trend = _classify_trend(slope * windows, slope_bound * windows, steps, dead=is_dead)
        falls = trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
        largest_rise = (slope + slope_bound) * windows
        may_stay = falls or largest_rise <= _LARGEST_CALM_RISE
        last_step = float(steps[-1])
        calm = may_stay and last_step <= _LARGEST_CALM_STEP
        rate_per_s = float(slope / window_s)
        fits.append(EnvelopeFit(trend, rate_per_s, bool(calm)))
    return fits


def _classify_trend(
    change: float,
    bound: float,
    steps: Array,
    *,
    dead: bool,
) -> EnvelopeTrend:
    """Returns whether an amplitude grows, decays or persists, from a fitted line and its error.

    The docstring of the module defines the possible trends.

    Args:
        change: Change of the envelope's logarithm over the half, according to the line.
        bound: Bound of the error of this change.
        steps: Steps of the log maxima from quarter to quarter of the half, shape (3,).
        dead: True if the last quarter is at the floor.
    """
    if dead:
        return EnvelopeTrend.DECAYS
    first_step = steps[0]
    last_step = steps[-1]
    rises_far = steps.sum() > _LARGEST_RISE_FROM_ZERO
    is_not_saturating = rises_far and last_step >= 0.45 * first_step
    keeps_rising = last_step >= 0.75 * first_step or is_not_saturating
    if change > bound and steps.min() >= _LEAST_STEP and keeps_rising:
        return EnvelopeTrend.GROWS

    if last_step > _DOUBLE:
        return EnvelopeTrend.UNDECIDED

    if change + bound < 0.0 and change <= -4.0 * _LEAST_STEP:
        halves = change <= -_DOUBLE
        # in a steady fall to one half, each step is a quarter of the fall
        still_falls = last_step <= -_DOUBLE / 8.0
        is_clear = halves and still_falls
        return EnvelopeTrend.DECAYS if is_clear else EnvelopeTrend.HARDLY

    if abs(change) + bound <= _DOUBLE:
        return EnvelopeTrend.STEADY
    return EnvelopeTrend.UNDECIDED

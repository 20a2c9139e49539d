"""Whether an error grows: the trend of its envelope in a run that ended.

Law: a finite run shows a trend or it does not; what it does not show is called undecided, never guessed.

The second half of the run is parted into n equal windows, n = 16 and, where those do not decide, n = 8. A
window counts with its largest |e|, not less than `FLOOR_RAD`. A straight line is fitted to the logarithms of
these maxima, with the one-sided 99.5 % bounds of its slope (Student's t, n - 2 degrees of freedom).

GROWS: the lower bound is positive; the maxima of the four quarters of the half rise, each by 1 % or more;
and the rise does not die away: the last of the three steps, in logarithms, is at least 3/4 of the first; or
at least 0.45 of it where the maxima rise to more than 8/5 in all, as nothing does that begins at zero with
the run and rises ever more slowly. (A disturbance late in the run jumps and falls, a slow step response dies
away: neither is growth. A steady drift is, as long as one looks.) And the maxima of the four quarters of the
first half do not fall, each by 1 % or more: what falls through one half and rises through the other is a V,
and only a longer record tells what runs away from a swing slower than the run.

DECAYS: the upper bound is negative and the line falls by 4 % or more over the half, or nothing in the half
exceeds `FLOOR_RAD`. STEADY: the upper bound excludes that the envelope doubles within the half. Both need
that the last quarter of the half does not exceed twice the one before. A sustained oscillation of whatever
size is steady: bounded, and no more.

UNDECIDED: everything else: too short, too irregular, growing but ever more slowly, a V.

Two things no finite record excludes: growth that begins later, and a beat longer than the run, whose rising
flank is growth as long as one looks.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..core.arm import Array

FLOOR_RAD = 1e-6
"""An envelope below this has converged, rad."""

_T_QUANTILES = {16: 2.977, 8: 3.707}
"""Number of windows, and the 99.5 % quantile of Student's t with two degrees of freedom less."""

_RISE = math.log(1.01)
_DOUBLE = math.log(2.0)
_FROM_ZERO = math.log(8.0 / 5.0)


class Trend(StrEnum):
    """What an envelope does at the end of a run; the text is the word for people."""

    DECAYS = "decays"
    STEADY = "steady"
    GROWS = "grows"
    UNDECIDED = "undecided (record longer)"


class Envelope(NamedTuple):
    """The trend of an envelope over the second half of a run.

    Attributes:
        trend: what it does.
        rate_per_s: slope of the logarithm of the maxima, 1/s: the envelope goes as exp(rate t). NaN where
            there are too few points for one.
    """

    trend: Trend
    rate_per_s: float

    @property
    def grows(self) -> bool | None:
        """True or False where the run decides it, else None."""
        return None if self.trend is Trend.UNDECIDED else self.trend is Trend.GROWS


def envelope(t_s: Array, error_rad: Array) -> Envelope:
    """Returns the trend of an error's envelope; see the module for its definition.

    Args:
        t_s: when, ascending, shape (K,), s.
        error_rad: the largest |e| at that time, or since the time before, shape (K,), rad.
    """
    found = Envelope(Trend.UNDECIDED, math.nan)
    for windows in _T_QUANTILES:
        maxima = _window_maxima(t_s, error_rad, windows)
        if maxima is None:
            continue
        found = _judged(maxima, 0.5 * (t_s[-1] - t_s[0]) / windows)
        if found.trend is not Trend.UNDECIDED:
            break
    if found.trend is Trend.GROWS and _falls_first(t_s, error_rad):
        return found._replace(trend=Trend.UNDECIDED)
    return found


def _falls_first(t_s: Array, error_rad: Array) -> bool:
    """True where the maxima of the first half's quarters fall throughout: read backwards they rise."""
    maxima = _window_maxima(-t_s[::-1], error_rad[::-1], 4)
    return maxima is not None and bool(np.diff(np.log(maxima)).min() >= _RISE)


def _window_maxima(t_s: Array, error_rad: Array, windows: int) -> Array | None:
    """Returns the maxima of equal windows of the second half; None where one has fewer than two points."""
    if not len(t_s):
        return None
    edges = np.linspace(0.5 * (t_s[0] + t_s[-1]), t_s[-1], windows + 1)
    starts = np.searchsorted(t_s, edges[:-1])
    if np.any(np.diff(np.append(starts, len(t_s))) < 2):
        return None
    return np.maximum(np.maximum.reduceat(error_rad, starts), FLOOR_RAD)


def _judged(maxima: Array, window_s: float) -> Envelope:
    n = len(maxima)
    logs = np.log(maxima)
    slope, bound = _line(logs)
    quarters = np.log(maxima.reshape(4, -1).max(axis=1))
    steps = np.diff(quarters)
    if maxima.max() <= FLOOR_RAD:
        trend = Trend.DECAYS
    elif slope - bound > 0.0 and steps.min() >= _RISE and _lasts(steps):
        trend = Trend.GROWS
    elif steps[-1] > _DOUBLE:
        trend = Trend.UNDECIDED
    elif slope + bound < 0.0 and slope * n <= -4.0 * _RISE:
        trend = Trend.DECAYS
    elif (slope + bound) * n <= _DOUBLE:
        trend = Trend.STEADY
    else:
        trend = Trend.UNDECIDED
    return Envelope(trend, float(slope / window_s))


def _lasts(steps: Array) -> bool:
    """True where a rise, in three steps, is no dying one."""
    if steps[-1] >= 0.75 * steps[0]:
        return True
    return bool(steps.sum() > _FROM_ZERO and steps[-1] >= 0.45 * steps[0])


def _line(values: Array) -> tuple[float, float]:
    """Returns the slope of a straight line through equidistant values, per step, and its uncertainty."""
    n = len(values)
    x = np.arange(n) - 0.5 * (n - 1)
    spread = float(x @ x)
    slope = float(x @ values) / spread
    residual = values - values.mean() - slope * x
    deviation = math.sqrt(float(residual @ residual) / (n - 2) / spread)
    return slope, _T_QUANTILES[n] * deviation

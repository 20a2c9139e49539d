"""The trend of an envelope over the second half of a record: decays, hardly, steady, grows, or
undecided.

Invariant: a word states what the record shows and predicts nothing; docs/definitions.md,
"Stable".

The half is divided into n equal windows, n = 16 and, if those do not decide, n = 8. A window
counts with its largest value, at least `FLOOR_RAD`. A straight line is fitted to the logarithms
of these maxima, with the one-sided 99.5 % bounds of its slope (Student's t, n - 2 degrees of
freedom).

GROWS: the lower bound is positive; the maxima of the four quarters of the half rise by 1 % or
more each; and the rise does not die away: the last of the three steps, in logarithms, is at
least 3/4 of the first, or at least 0.45 of it if the maxima rise to more than 8/5 in all (no
response that starts at zero and saturates does that). The maxima of the four quarters of the
first half must not fall by 1 % or more each: a fall followed by a rise is a V, and needs a
longer record.

DECAYS: the upper bound is negative, the line falls by a factor of two or more over the half,
and the last quarter still takes half of its share in that; or nothing in the last quarter
exceeds `FLOOR_RAD`. HARDLY: the line falls, by 4 % or more, and that is all. STEADY: the bounds
exclude that the envelope doubles or halves within the half. All require that the last quarter
of the half is at most twice the one before.

UNDECIDED: everything else: too short, too irregular, growing ever more slowly, a V. No finite
record excludes growth that begins later, or a beat longer than the run, whose rising flank
looks like growth.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..core.vectors import Array

FLOOR_RAD = 1e-12
"""An envelope below this is the rounding of the numbers, rad; of speeds, rad/s."""

_T_QUANTILES = {16: 2.977, 8: 3.707}
"""Number of windows, and the 99.5 % quantile of Student's t with two degrees of freedom less:
to these digits, with which the classes of published runs were made.
"""

_RISE = math.log(1.01)
_DOUBLE = math.log(2.0)
_CALM = math.log(1.25)
_CALM_STEP = math.log(1.5)
_FROM_ZERO = math.log(8.0 / 5.0)


class EnvelopeTrend(StrEnum):
    """Trend of an envelope at the end of a run; the text is the word for people."""

    DECAYS = "decays"
    HARDLY = "hardly decays"
    STEADY = "steady"
    GROWS = "grows"
    UNDECIDED = "undecided (record longer)"


class EnvelopeFit(NamedTuple):
    """Trend of an envelope over the second half of a run.

    Attributes:
        rate_per_s: slope of the logarithm of the maxima, 1/s: the envelope goes as exp(rate t).
            NaN if there are too few points.
        calm: True if it falls, or the upper bound excludes a rise by a quarter within the half;
            and the last quarter is no more than half as high again as the one before.
    """

    trend: EnvelopeTrend
    rate_per_s: float
    calm: bool = False

    @property
    def text(self) -> str:
        """The trend as a verb."""
        return "shows no trend" if self.trend is EnvelopeTrend.UNDECIDED else self.trend.value

    @property
    def rate_text(self) -> str:
        """The rate of what grows or decays; else the trend as a verb."""
        still = self.trend in (EnvelopeTrend.STEADY, EnvelopeTrend.UNDECIDED)
        return self.text if still else f"{self.rate_per_s:+.3g}/s"


def fit_envelopes(
    t_s: Array, values: Array, floor: float = FLOOR_RAD, *, falls_first: bool = False
) -> list[EnvelopeFit]:
    """Returns the trends of several envelopes; the module's docstring defines them.

    Args:
        t_s: ascending times, shape (K,), s.
        values: the largest |e| at each time, or since the time before, shape (K, C).
        floor: takes the place of `FLOOR_RAD`.
        falls_first: what rises after a fall grows as well: the fall is known to be that of
            other modes.
    """
    fits = [EnvelopeFit(EnvelopeTrend.UNDECIDED, math.nan)] * values.shape[1]
    pending = list(range(values.shape[1]))
    for windows in _T_QUANTILES:
        maxima = _window_maxima(t_s, values[:, pending], windows, floor)
        if maxima is None:
            continue
        found = _fit_maxima(maxima, 0.5 * (t_s[-1] - t_s[0]) / windows, math.log(floor))
        for n, fit in zip(pending, found, strict=True):
            fits[n] = fit
        pending = [n for n in pending if fits[n].trend is EnvelopeTrend.UNDECIDED]
    growing = [
        n for n, fit in enumerate(fits) if fit.trend is EnvelopeTrend.GROWS and not falls_first
    ]
    first_half = (
        _window_maxima(-t_s[::-1], values[::-1, growing], 4, floor) if growing else None
    )
    if first_half is not None:  # a fall, then a rise: a V
        for n, fell in zip(
            growing, np.diff(np.log(first_half), axis=0).min(axis=0) >= _RISE, strict=True
        ):
            fits[n] = fits[n]._replace(trend=EnvelopeTrend.UNDECIDED) if fell else fits[n]
    return fits


def _window_maxima(t_s: Array, values: Array, windows: int, floor: float) -> Array | None:
    """Returns the maxima of equal windows of the second half; None if one has fewer than two
    points.
    """
    if not len(t_s):
        return None
    edges = np.linspace(0.5 * (t_s[0] + t_s[-1]), t_s[-1], windows + 1)
    starts = np.searchsorted(t_s, edges[:-1])
    if np.any(np.diff(np.append(starts, len(t_s))) < 2):
        return None
    return np.maximum(np.maximum.reduceat(values, starts, axis=0), floor)


def _fit_maxima(maxima: Array, window_s: float, dead: float) -> list[EnvelopeFit]:
    """Returns the classes of the maxima of equal windows, shape (n, C), by lines through their
    logarithms.

    `dead` is the logarithm below which nothing moves.
    """
    n = len(maxima)
    values = np.log(maxima)
    x = np.arange(n) - 0.5 * (n - 1)
    spread = float(x @ x)
    slopes = (x[:, np.newaxis] * values).sum(
        axis=0
    ) / spread  # a matrix product's last bits may vary
    residual = values - values.mean(axis=0) - x[:, np.newaxis] * slopes
    bounds = _T_QUANTILES[n] * np.sqrt((residual**2).sum(axis=0) / (n - 2) / spread)
    quarters = np.log(maxima.reshape(4, n // 4, -1).max(axis=1))
    fits = []
    for slope, bound, quarter in zip(slopes.tolist(), bounds.tolist(), quarters.T, strict=True):
        steps = np.diff(quarter)
        last = float(quarter[-1])
        trend = _name_trend(slope * n, bound * n, steps, dead=last <= dead)
        falls = trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
        calm = (falls or (slope + bound) * n <= _CALM) and float(steps[-1]) <= _CALM_STEP
        fits.append(EnvelopeFit(trend, float(slope / window_s), bool(calm)))
    return fits


def _name_trend(change: float, bound: float, steps: Array, *, dead: bool) -> EnvelopeTrend:
    """Returns the class of an envelope.

    Args:
        change: of its logarithm over the half, by the line.
        bound: of the error of that.
        steps: of the logarithm of the maxima from quarter to quarter of the half.
        dead: True if the last quarter is at the floor.
    """
    lasts = steps[-1] >= 0.75 * steps[0] or (
        steps.sum() > _FROM_ZERO and steps[-1] >= 0.45 * steps[0]
    )
    if dead:
        return EnvelopeTrend.DECAYS
    if change > bound and steps.min() >= _RISE and lasts:
        return EnvelopeTrend.GROWS
    if steps[-1] > _DOUBLE:
        return EnvelopeTrend.UNDECIDED
    if change + bound < 0.0 and change <= -4.0 * _RISE:
        clear = change <= -_DOUBLE and steps[-1] <= -_DOUBLE / 8.0
        return EnvelopeTrend.DECAYS if clear else EnvelopeTrend.HARDLY
    return EnvelopeTrend.STEADY if abs(change) + bound <= _DOUBLE else EnvelopeTrend.UNDECIDED

"""Classification of the end of a run: converged, decaying, bounded, growing, diverged or undecided.

Invariant: a class states what the record shows and predicts nothing; without a clear trend it is
undecided. Diverged passed a limit, growing has not yet; converged is at rest, decaying is not yet. Every
other word for how a run ended (the class of a cell of a sweep, `stable` of [expect], the growth in a
certificate) is a view of `RunEnd` or of its trends.

The second half of the run is divided into n equal windows, n = 16 and, if those do not decide, n = 8. A
window counts with its largest value, at least `FLOOR_RAD`. A straight line is fitted to the logarithms of
these maxima, with the one-sided 99.5 % bounds of its slope (Student's t, n - 2 degrees of freedom).

GROWS: the lower bound is positive; the maxima of the four quarters of the half rise by 1 % or more each;
and the rise does not die away: the last of the three steps, in logarithms, is at least 3/4 of the first,
or at least 0.45 of it if the maxima rise to more than 8/5 in all (no response that starts at zero and
saturates does that). The maxima of the four quarters of the first half must not fall by 1 % or more each:
a fall followed by a rise is a V, and needs a longer record.

DECAYS: the upper bound is negative and the line falls by 4 % or more over the half, or nothing in the
half exceeds `FLOOR_RAD`. STEADY: the upper bound excludes that the envelope doubles within the half. Both
require that the last quarter of the half is at most twice the one before. A sustained oscillation of any
size is steady.

UNDECIDED: everything else: too short, too irregular, growing ever more slowly, a V. No finite record
excludes growth that begins later, or a beat longer than the run, whose rising flank looks like growth.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from .site_signals import SETTLED_ERROR_RAD
from .timeline import diverged_at_s

SETTLED_SPEED_RAD_S = 1e-2
"""The largest speed of the last second of a converged run, rad/s: the arms have come to rest."""

STATIC_SPEED_RAD_S = 2e-3
"""The largest speed in a static window of a log, rad/s: the torques on an arm balance each other."""

EQUILIBRIUM_SPEED_RAD_S = 1e-5
"""The largest speed of the last second of a run whose end is an equilibrium, rad/s: the loop can be
linearised there."""

FLOOR_RAD = 1e-6
"""An envelope below this has converged, rad; of speeds, rad/s."""

MIN_SIGN_CHANGES = 6
"""Fewer changes of sign in the second half of a run show no period."""

_T_QUANTILES = {16: 2.977, 8: 3.707}
"""Number of windows, and the 99.5 % quantile of Student's t with two degrees of freedom less: to these
digits, with which the classes of published runs were made."""

_RISE = math.log(1.01)
_DOUBLE = math.log(2.0)
_FROM_ZERO = math.log(8.0 / 5.0)


class EnvelopeTrend(StrEnum):
    """Trend of an envelope at the end of a run; the text is the word for people."""

    DECAYS = "decays"
    STEADY = "steady"
    GROWS = "grows"
    UNDECIDED = "undecided (record longer)"

    @property
    def grows(self) -> bool | None:
        """True or False if the run decides it, else None."""
        return None if self is EnvelopeTrend.UNDECIDED else self is EnvelopeTrend.GROWS


class EndBehaviour(StrEnum):
    """Behaviour of a run at its end; the text is the word for people."""

    CONVERGED = "converged"
    DECAYS = "decaying"
    BOUNDED = "bounded oscillation"
    GROWS = "growing"
    DIVERGED = "diverged"
    UNDECIDED = "undecided (record longer)"

    @property
    def grows(self) -> bool | None:
        """True if the motion grows or diverged, False if it stays bounded, None if undecided."""
        if self is EndBehaviour.UNDECIDED:
            return None
        return self in (EndBehaviour.GROWS, EndBehaviour.DIVERGED)


class EnvelopeFit(NamedTuple):
    """Trend of an envelope over the second half of a run.

    Attributes:
        rate_per_s: slope of the logarithm of the maxima, 1/s: the envelope goes as exp(rate t). NaN if there
            are too few points.
    """

    trend: EnvelopeTrend
    rate_per_s: float

    @property
    def text(self) -> str:
        """The trend as a verb."""
        return "shows no trend" if self.trend is EnvelopeTrend.UNDECIDED else self.trend.value

    @property
    def rate_text(self) -> str:
        """The rate of what grows or decays; else the trend as a verb."""
        changes = self.trend in (EnvelopeTrend.GROWS, EnvelopeTrend.DECAYS)
        return f"{self.rate_per_s:+.3g}/s" if changes else self.text


class RunEnd(NamedTuple):
    """End of a run, of all of its sites or of some.

    Attributes:
        behaviour: the class.
        error, speed: trends of the largest |e| and |qd|.
        end_error_rad, end_speed_rad_s: largest |e| and |qd| of the last second.
        diverged_at_s: when the first site left its limits, or None.
        frequency_hz: frequency of a bounded oscillation; None without one.
        missing_sites: sites without any record, which leave the run undecided.
    """

    behaviour: EndBehaviour
    error: EnvelopeFit
    speed: EnvelopeFit
    end_error_rad: float
    end_speed_rad_s: float
    diverged_at_s: float | None = None
    frequency_hz: float | None = None
    missing_sites: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The class with its numbers; part of the certificate's JSON."""
        behaviour, error, speed = self.behaviour, self.error, self.speed
        end = f"|e| {self.end_error_rad:.3g} rad and |qd| {self.end_speed_rad_s:.3g} rad/s in the last second"
        if self.diverged_at_s is not None:
            return f"diverged at {self.diverged_at_s:.4g} s: a joint passed its qd_limit_rad_s"
        if self.missing_sites:
            return f"undecided: no record of {', '.join(self.missing_sites)}"
        if behaviour is EndBehaviour.CONVERGED:
            apart = self.end_error_rad > SETTLED_ERROR_RAD
            return f"{'at rest, and the sites do not agree' if apart else 'converged'}: {end}"
        if behaviour is EndBehaviour.BOUNDED:
            hertz = self.frequency_hz
            word = "bounded motion" if hertz is None else f"bounded oscillation at {hertz:.3g} Hz"
            slowly = f" (|qd| {speed.rate_text})" if speed.trend is EnvelopeTrend.DECAYS else ""
            return f"{word}{slowly}: {end}"
        if behaviour is EndBehaviour.UNDECIDED:
            return f"undecided, record longer: |e| {error.text}, |qd| {speed.text}; {end}"
        return f"{behaviour.value} (|e| {error.rate_text}, |qd| {speed.rate_text}): {end}"


def classify_log_end(log: Log) -> RunEnd:
    """Returns the end of a log's run; torn and empty logs are undecided."""
    parts = [log[site] for site in log.sites]
    recorded = [part for part in parts if len(part)]
    span_s = max((float(part.tick[-1] - part.tick[0]) / part.rate_hz for part in recorded), default=0.0)
    diverged = min((at_s for part in parts if (at_s := diverged_at_s(part)) is not None), default=None)
    end = classify_run_end(list(map(_bucket_maxima, parts)), span_s, diverged)
    return end._replace(
        frequency_hz=_frequency_hz(recorded) if end.behaviour is EndBehaviour.BOUNDED else None,
        missing_sites=tuple(part.name for part in parts if not len(part)),
    )


def classify_run_end(maxima: Sequence[Array], span_s: float, diverged_at_s: float | None = None) -> RunEnd:
    """Returns the end of a run of `span_s` from the maxima of the buckets of all of its sites, or of some.

    The maxima are per site the largest |e|, rad, and |qd|, rad/s, of every bucket since the epoch, shape
    (K, 2); -1 if a bucket has no record. A site's last one may be incomplete: it enters no trend. The first
    site left its limits at `diverged_at_s`.
    """
    end_error_rad, end_speed_rad_s = find_end_maxima(maxima)
    count = max(min(map(len, maxima)) - 1, 0)
    columns = np.array([values[:count] for values in maxima])
    kept = np.flatnonzero((columns >= 0.0).all(axis=(0, 2)))
    t_s: Array = kept / BUCKETS_PER_S
    largest = columns[:, kept].max(axis=0)
    error, speed = fit_envelope(t_s, largest[:, 0]), fit_envelope(t_s, largest[:, 1])
    end = RunEnd(EndBehaviour.DIVERGED, error, speed, end_error_rad, end_speed_rad_s, diverged_at_s)
    return end if diverged_at_s is not None else end._replace(behaviour=_classify(end, 0.5 * span_s))


def find_end_maxima(maxima: Sequence[Array]) -> tuple[float, float]:
    """Returns the largest |e|, rad, and |qd|, rad/s, of the last second; maxima as in `classify_run_end`."""
    last = [values[-BUCKETS_PER_S:].max(axis=0, initial=0.0) for values in maxima]
    error_rad, speed_rad_s = np.max(last, axis=0, initial=0.0).tolist() if last else (0.0, 0.0)
    return error_rad, speed_rad_s


def _classify(end: RunEnd, half_s: float) -> EndBehaviour:
    """Returns the class that the two trends have together, over the second half of a run.

    Errors that grow while no arm grows faster may start a drift, or follow from what an operator has just
    done: undecided. The reverse is growth: arms that swing in unison have no error.
    """
    error, speed = end.error.trend, end.speed.trend
    if end.end_speed_rad_s <= FLOOR_RAD and speed is not EnvelopeTrend.GROWS:  # too slow for a trend
        speed = EnvelopeTrend.DECAYS
    if speed is EnvelopeTrend.GROWS:
        return EndBehaviour.GROWS
    if error is EnvelopeTrend.GROWS or EnvelopeTrend.UNDECIDED in (error, speed):
        return EndBehaviour.UNDECIDED
    if speed is EnvelopeTrend.STEADY:
        return EndBehaviour.BOUNDED
    slow = end.end_speed_rad_s <= SETTLED_SPEED_RAD_S
    if error is EnvelopeTrend.STEADY and not slow:  # motion that hardly decays counts as a limit cycle
        halves = end.speed.rate_per_s * half_s <= -_DOUBLE
        return EndBehaviour.DECAYS if halves else EndBehaviour.BOUNDED
    settled = slow and (error is EnvelopeTrend.STEADY or end.end_error_rad <= SETTLED_ERROR_RAD)
    return EndBehaviour.CONVERGED if settled else EndBehaviour.DECAYS


def _bucket_maxima(part: SiteLog) -> Array:
    """Returns the largest |e| and |qd| of every bucket; -1 if a bucket has no record."""
    if not len(part):
        return np.zeros((0, 2))
    bucket = part.tick * BUCKETS_PER_S // part.rate_hz
    maxima = np.full((int(bucket[-1]) + 1, 2), -1.0)
    for column, values in enumerate((part.e, part.qd)):
        np.maximum.at(maxima[:, column], bucket, np.abs(values).max(axis=1))
    return maxima


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or None."""
    halves = [part.qd[len(part) // 2 :] for part in parts if len(part) > 1]
    part, half = max(zip(parts, halves, strict=False), key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    signs = np.sign(column - column.mean())
    crossings = int(np.count_nonzero(np.diff(signs[signs != 0.0])))
    span_s = float(part.tick[-1] - part.tick[len(part) // 2]) / part.rate_hz
    return None if crossings < MIN_SIGN_CHANGES else 0.5 * crossings / span_s


def fit_envelope(t_s: Array, error_rad: Array) -> EnvelopeFit:
    """Returns the trend of an envelope; the module's docstring defines it.

    Times ascend, shape (K,), s; the largest |e| is that at each time, or since the time before.
    """
    fit = EnvelopeFit(EnvelopeTrend.UNDECIDED, math.nan)
    for windows in _T_QUANTILES:
        maxima = _window_maxima(t_s, error_rad, windows)
        if maxima is None:
            continue
        fit = _fit_maxima(maxima, 0.5 * (t_s[-1] - t_s[0]) / windows)
        if fit.trend is not EnvelopeTrend.UNDECIDED:
            break
    if fit.trend is EnvelopeTrend.GROWS:
        first_half = _window_maxima(-t_s[::-1], error_rad[::-1], 4)
        if first_half is not None and np.diff(np.log(first_half)).min() >= _RISE:  # a fall, then a rise: a V
            return fit._replace(trend=EnvelopeTrend.UNDECIDED)
    return fit


def _window_maxima(t_s: Array, error_rad: Array, windows: int) -> Array | None:
    """Returns the maxima of equal windows of the second half; None if one has fewer than two points."""
    if not len(t_s):
        return None
    edges = np.linspace(0.5 * (t_s[0] + t_s[-1]), t_s[-1], windows + 1)
    starts = np.searchsorted(t_s, edges[:-1])
    if np.any(np.diff(np.append(starts, len(t_s))) < 2):
        return None
    return np.maximum(np.maximum.reduceat(error_rad, starts), FLOOR_RAD)


def _fit_maxima(maxima: Array, window_s: float) -> EnvelopeFit:
    """Returns the class of the maxima of equal windows, by a line through their logarithms."""
    n, values = len(maxima), np.log(maxima)
    x = np.arange(n) - 0.5 * (n - 1)
    spread = float(x @ x)
    slope = float(x @ values) / spread
    residual = values - values.mean() - slope * x
    bound = _T_QUANTILES[n] * math.sqrt(float(residual @ residual) / (n - 2) / spread)
    steps = np.diff(np.log(maxima.reshape(4, -1).max(axis=1)))
    lasts = steps[-1] >= 0.75 * steps[0] or (steps.sum() > _FROM_ZERO and steps[-1] >= 0.45 * steps[0])
    if maxima.max() <= FLOOR_RAD:
        trend = EnvelopeTrend.DECAYS
    elif slope - bound > 0.0 and steps.min() >= _RISE and lasts:
        trend = EnvelopeTrend.GROWS
    elif steps[-1] > _DOUBLE:
        trend = EnvelopeTrend.UNDECIDED
    elif slope + bound < 0.0 and slope * n <= -4.0 * _RISE:
        trend = EnvelopeTrend.DECAYS
    elif (slope + bound) * n <= _DOUBLE:
        trend = EnvelopeTrend.STEADY
    else:
        trend = EnvelopeTrend.UNDECIDED
    return EnvelopeFit(trend, float(slope / window_s))

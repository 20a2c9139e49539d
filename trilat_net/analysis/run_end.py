"""Classification of the end of a run: converged, decaying, bounded, growing, diverged or undecided.

Invariant: a class states what the record shows and predicts nothing; without a clear trend it is
undecided. Diverged passed a limit, growing has not yet; converged is at rest, decaying is not yet.

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

FLOOR_RAD = 1e-6
"""An envelope below this has converged, rad."""

_T_QUANTILES = {16: 2.977, 8: 3.707}
"""Number of windows, and the 99.5 % quantile of Student's t with two degrees of freedom less."""

_RISE = math.log(1.01)
_DOUBLE = math.log(2.0)
_FROM_ZERO = math.log(8.0 / 5.0)


class EnvelopeTrend(StrEnum):
    """What an envelope does at the end of a run; the text is the word for people."""

    DECAYS = "decays"
    STEADY = "steady"
    GROWS = "grows"
    UNDECIDED = "undecided (record longer)"


class EnvelopeFit(NamedTuple):
    """The trend of an envelope over the second half of a run.

    Attributes:
        trend: what it does.
        rate_per_s: slope of the logarithm of the maxima, 1/s: the envelope goes as exp(rate t). NaN where
            there are too few points for one.
    """

    trend: EnvelopeTrend
    rate_per_s: float

    @property
    def grows(self) -> bool | None:
        """True or False where the run decides it, else None."""
        return None if self.trend is EnvelopeTrend.UNDECIDED else self.trend is EnvelopeTrend.GROWS


def fit_envelope(t_s: Array, error_rad: Array) -> EnvelopeFit:
    """Returns the trend of an error's envelope; see the module for its definition.

    Args:
        t_s: when, ascending, shape (K,), s.
        error_rad: the largest |e| at that time, or since the time before, shape (K,), rad.
    """
    found = EnvelopeFit(EnvelopeTrend.UNDECIDED, math.nan)
    for windows in _T_QUANTILES:
        maxima = _window_maxima(t_s, error_rad, windows)
        if maxima is None:
            continue
        found = _judged(maxima, 0.5 * (t_s[-1] - t_s[0]) / windows)
        if found.trend is not EnvelopeTrend.UNDECIDED:
            break
    if found.trend is EnvelopeTrend.GROWS and _falls_first(t_s, error_rad):
        return found._replace(trend=EnvelopeTrend.UNDECIDED)
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


def _judged(maxima: Array, window_s: float) -> EnvelopeFit:
    n = len(maxima)
    logs = np.log(maxima)
    slope, bound = _line(logs)
    quarters = np.log(maxima.reshape(4, -1).max(axis=1))
    steps = np.diff(quarters)
    if maxima.max() <= FLOOR_RAD:
        trend = EnvelopeTrend.DECAYS
    elif slope - bound > 0.0 and steps.min() >= _RISE and _lasts(steps):
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


SETTLED_SPEED_RAD_S = 0.01
"""Arms at whose end nothing is faster are at rest, rad/s."""


class EndBehaviour(StrEnum):
    """What a run does at its end; the text is the word for people."""

    CONVERGED = "converged"
    DECAYS = "decaying"
    BOUNDED = "bounded oscillation"
    GROWS = "growing"
    DIVERGED = "diverged"
    UNDECIDED = "undecided (record longer)"


class RunEnd(NamedTuple):
    """The end of a run, of which nobody says that it diverged.

    Attributes:
        motion: what it does.
        error: the trend of the largest |e|.
        speed: the trend of the largest |qd|.
        end_error_rad: the largest |e| of the last second.
        end_speed_rad_s: the largest |qd| of the last second.
    """

    motion: EndBehaviour
    error: EnvelopeFit
    speed: EnvelopeFit
    end_error_rad: float
    end_speed_rad_s: float


def classify_run_end(maxima: Sequence[Array], span_s: float) -> RunEnd:
    """Returns what a run does at its end.

    Args:
        maxima: per site the largest |e|, rad, and |qd|, rad/s, of every bucket since the epoch, shape (K, 2);
            -1 where a bucket has no record. A site's last one may be incomplete: it enters no trend.
        span_s: how long the run was, s.
    """
    last = [values[-BUCKETS_PER_S:].max(axis=0, initial=0.0) for values in maxima]
    end_error_rad, end_speed_rad_s = np.max(last, axis=0, initial=0.0).tolist() if last else (0.0, 0.0)
    count = max(min(map(len, maxima)) - 1, 0)
    columns = np.array([values[:count] for values in maxima])
    kept = np.flatnonzero((columns >= 0.0).all(axis=(0, 2)))
    t_s: Array = kept / BUCKETS_PER_S
    largest = columns[:, kept].max(axis=0)
    error, speed = fit_envelope(t_s, largest[:, 0]), fit_envelope(t_s, largest[:, 1])
    found = RunEnd(EndBehaviour.UNDECIDED, error, speed, end_error_rad, end_speed_rad_s)
    return found._replace(motion=_motion(found, 0.5 * span_s))


def _motion(found: RunEnd, half_s: float) -> EndBehaviour:
    """Returns what the two trends make together, seen over the second half of a run of twice `half_s`.

    Errors that grow while no arm grows faster may be the start of a drift as well as what a hand has just
    done: undecided. The other way round is growth: arms that swing in unison have no error.
    """
    error, speed = found.error.trend, found.speed.trend
    if found.end_speed_rad_s <= FLOOR_RAD and speed is not EnvelopeTrend.GROWS:  # too still for a trend
        speed = EnvelopeTrend.DECAYS
    if speed is EnvelopeTrend.GROWS:
        return EndBehaviour.GROWS
    if error is EnvelopeTrend.GROWS or EnvelopeTrend.UNDECIDED in (error, speed):
        return EndBehaviour.UNDECIDED
    if speed is EnvelopeTrend.STEADY:
        return EndBehaviour.BOUNDED
    slow = found.end_speed_rad_s <= SETTLED_SPEED_RAD_S
    if (
        error is EnvelopeTrend.STEADY
    ):  # apart as before; what moves and hardly dies is a limit cycle, or as good as one
        halves = found.speed.rate_per_s * half_s <= -math.log(2.0)
        return EndBehaviour.CONVERGED if slow else EndBehaviour.DECAYS if halves else EndBehaviour.BOUNDED
    return (
        EndBehaviour.CONVERGED if slow and found.end_error_rad <= SETTLED_ERROR_RAD else EndBehaviour.DECAYS
    )


MIN_SIGN_CHANGES = 6
"""Fewer changes of sign in the second half of a run show no period."""


class LogEnd(NamedTuple):
    """The end of a log's run.

    Attributes:
        end: what it does.
        text: the same with its numbers.
    """

    end: RunEnd
    text: str

    @property
    def motion(self) -> EndBehaviour:
        """What it does, in a word."""
        return self.end.motion

    @property
    def grows(self) -> bool | None:
        """True or False where the run decides it, else None."""
        if self.motion is EndBehaviour.UNDECIDED:
            return None
        return self.motion in (EndBehaviour.GROWS, EndBehaviour.DIVERGED)


def classify_log_end(log: Log) -> LogEnd:
    """Returns what e and qd of a log's sites do; torn and empty logs are undecided."""
    parts = [log[site] for site in log.sites]
    absent = ", ".join(part.name for part in parts if not len(part))
    end = classify_run_end([_maxima(part) for part in parts], _span_s(parts))
    stops = [at_s for part in parts if (at_s := diverged_at_s(part)) is not None]
    if stops:
        text = f"diverged at {min(stops):.4g} s: a joint passed its qd_limit_rad_s"
        return LogEnd(end._replace(motion=EndBehaviour.DIVERGED), text)
    return LogEnd(end, f"undecided: no record of {absent}" if absent else _text(parts, end))


def _maxima(part: SiteLog) -> Array:
    """Returns the largest |e| and |qd| of every bucket; -1 where a bucket has no record."""
    if not len(part):
        return np.zeros((0, 2))
    bucket = part.tick * BUCKETS_PER_S // part.rate_hz
    maxima = np.full((int(bucket[-1]) + 1, 2), -1.0)
    for column, values in enumerate((part.e, part.qd)):
        np.maximum.at(maxima[:, column], bucket, np.abs(values).max(axis=1))
    return maxima


def _text(parts: list[SiteLog], found: RunEnd) -> str:
    motion, error, speed = found.motion, found.error, found.speed
    ends = f"|e| {found.end_error_rad:.3g} rad and |qd| {found.end_speed_rad_s:.3g} rad/s in the last second"
    if motion is EndBehaviour.CONVERGED and found.end_error_rad > SETTLED_ERROR_RAD:
        return f"at rest, and the sites do not agree: {ends}"
    if motion is EndBehaviour.CONVERGED:
        return f"converged: {ends}"
    if motion is EndBehaviour.BOUNDED:
        hertz = _frequency_hz(parts)
        word = "bounded motion" if hertz is None else f"bounded oscillation at {hertz:.3g} Hz"
        slowly = f" (|qd| {_rate(speed)})" if speed.trend is EnvelopeTrend.DECAYS else ""
        return f"{word}{slowly}: {ends}"
    if motion is EndBehaviour.UNDECIDED:
        return f"undecided, record longer: |e| {_trend(error)}, |qd| {_trend(speed)}; {ends}"
    return f"{motion.value} (|e| {_rate(error)}, |qd| {_rate(speed)}): {ends}"


def _trend(found: EnvelopeFit) -> str:
    return "shows no trend" if found.trend is EnvelopeTrend.UNDECIDED else found.trend.value


def _rate(found: EnvelopeFit) -> str:
    if found.trend in (EnvelopeTrend.STEADY, EnvelopeTrend.UNDECIDED):
        return _trend(found)
    return f"{found.rate_per_s:+.3g}/s"


def _span_s(parts: list[SiteLog]) -> float:
    """Returns the longest time of which a site has records."""
    return max((float(p.tick[-1] - p.tick[0]) / p.rate_hz for p in parts if len(p)), default=0.0)


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or None."""
    halves = [part.qd[len(part) // 2 :] for part in parts if len(part) > 1]
    part, half = max(zip(parts, halves, strict=False), key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    signs = np.sign(column - column.mean())
    crossings = int(np.count_nonzero(np.diff(signs[signs != 0.0])))
    span_s = float(part.tick[-1] - part.tick[len(part) // 2]) / part.rate_hz
    return None if crossings < MIN_SIGN_CHANGES else 0.5 * crossings / span_s


EQUILIBRIUM_SPEED_RAD_S = 1e-5
"""Nothing that moved faster within the last second is at rest."""

STATIC_SPEED_RAD_S = 2e-3
"""Slower joints rest, rad/s."""

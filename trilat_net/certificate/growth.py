"""What e and qd do at the end of a run, where no theorem speaks.

Law: `analysis.envelope` decides, on the largest |e| and |qd| of every 50 ms, as `trilat test` does on e. A
word says what the record shows and nothing of what follows: diverged is what passed a limit, growing what had
not yet; converged is what has come to rest, decaying what had not yet; what shows no trend is undecided.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..analysis.envelope import Envelope, Trend, envelope
from ..analysis.happenings import diverged_at_s
from ..analysis.quantities import SETTLED_RAD
from ..core.arm import Array
from ..log.reader import Log, SiteLog

BUCKET_S = 0.05
"""One largest value per so many seconds."""
REST_RAD_S = 0.01
"""Arms at whose end nothing is faster are at rest, rad/s."""
LEAST_CROSSINGS = 6
"""Fewer changes of sign in the second half of a run show no period."""


class Motion(StrEnum):
    """What a run does at its end; the text is the word for people."""

    CONVERGED = "converged"
    DECAYS = "decaying"
    BOUNDED = "bounded oscillation"
    GROWS = "growing"
    DIVERGED = "diverged"
    UNDECIDED = "undecided (record longer)"


class Growth(NamedTuple):
    """The end of a run.

    Attributes:
        motion: what it does.
        text: the same with its numbers.
        error: the trend of the largest |e|.
        speed: the trend of the largest |qd|.
        end_error_rad: the largest |e| of the last second.
        end_speed_rad_s: the largest |qd| of the last second.
    """

    motion: Motion
    text: str
    error: Envelope
    speed: Envelope
    end_error_rad: float
    end_speed_rad_s: float

    @property
    def grows(self) -> bool | None:
        """True or False where the run decides it, else None."""
        if self.motion is Motion.UNDECIDED:
            return None
        return self.motion in (Motion.GROWS, Motion.DIVERGED)


def growth(log: Log) -> Growth:
    """Returns what e and qd of a log's sites do; torn and empty logs are undecided."""
    parts = [log[site] for site in log.sites]
    absent = ", ".join(part.name for part in parts if not len(part))
    error, speed = (_envelope(parts, field) for field in ("e", "qd"))
    found = Growth(Motion.UNDECIDED, "", error, speed, _at_end(parts, "e"), _at_end(parts, "qd"))
    stops = [at_s for part in parts if (at_s := diverged_at_s(part)) is not None]
    if stops:
        text = f"diverged at {min(stops):.4g} s: a joint passed its qd_limit_rad_s"
        return found._replace(motion=Motion.DIVERGED, text=text)
    found = found._replace(motion=_motion(found, 0.5 * _span_s(parts)))
    return found._replace(text=f"undecided: no record of {absent}" if absent else _text(parts, found))


def _motion(found: Growth, half_s: float) -> Motion:
    """Returns what the two trends make together, seen over the second half of a run of twice `half_s`.

    Errors that grow while no arm grows faster may be the start of a drift as well as what a hand has just
    done: undecided. The other way round is growth: arms that swing in unison have no error.
    """
    error, speed = found.error.trend, found.speed.trend
    if speed is Trend.GROWS:
        return Motion.GROWS
    if error is Trend.GROWS or Trend.UNDECIDED in (error, speed):
        return Motion.UNDECIDED
    if speed is Trend.STEADY:
        return Motion.BOUNDED
    slow = found.end_speed_rad_s <= REST_RAD_S
    if (
        error is Trend.STEADY
    ):  # apart as before; what moves and hardly dies is a limit cycle, or as good as one
        halves = found.speed.rate_per_s * half_s <= -math.log(2.0)
        return Motion.CONVERGED if slow else Motion.DECAYS if halves else Motion.BOUNDED
    return Motion.CONVERGED if slow and found.end_error_rad <= SETTLED_RAD else Motion.DECAYS


def _envelope(parts: list[SiteLog], field: str) -> Envelope:
    """Returns the trend of the largest value of all sites, over the buckets of which all have a record."""
    maxima = [_maxima(part, getattr(part, field)) for part in parts]
    count = min(map(len, maxima))
    columns = np.array([values[:count] for values in maxima])
    kept = np.flatnonzero((columns >= 0.0).all(axis=0))
    t_s: Array = kept.astype(np.float64) * BUCKET_S
    return envelope(t_s, columns[:, kept].max(axis=0))


def _maxima(part: SiteLog, values: Array) -> Array:
    """Returns the largest value of every bucket that is complete; -1 where a bucket has no record."""
    if not len(part):
        return np.zeros(0)
    bucket = np.floor(part.tick / (part.rate_hz * BUCKET_S) + 1e-6).astype(np.int64)
    maxima = np.full(int(bucket[-1]) + 1, -1.0)
    np.maximum.at(maxima, bucket, np.abs(values).max(axis=1))
    return maxima[:-1]


def _text(parts: list[SiteLog], found: Growth) -> str:
    motion, error, speed = found.motion, found.error, found.speed
    ends = f"|e| {found.end_error_rad:.3g} rad and |qd| {found.end_speed_rad_s:.3g} rad/s in the last second"
    if motion is Motion.CONVERGED and found.end_error_rad > SETTLED_RAD:
        return f"at rest, and the sites do not agree: {ends}"
    if motion is Motion.CONVERGED:
        return f"converged: {ends}"
    if motion is Motion.BOUNDED:
        hertz = _frequency_hz(parts)
        word = "bounded motion" if hertz is None else f"bounded oscillation at {hertz:.3g} Hz"
        slowly = f" (|qd| {_rate(speed)})" if speed.trend is Trend.DECAYS else ""
        return f"{word}{slowly}: {ends}"
    if motion is Motion.UNDECIDED:
        return f"undecided, record longer: |e| {_trend(error)}, |qd| {_trend(speed)}; {ends}"
    return f"{motion.value} (|e| {_rate(error)}, |qd| {_rate(speed)}): {ends}"


def _trend(found: Envelope) -> str:
    return "shows no trend" if found.trend is Trend.UNDECIDED else found.trend.value


def _rate(found: Envelope) -> str:
    if found.trend in (Trend.STEADY, Trend.UNDECIDED):
        return _trend(found)
    return f"{found.rate_per_s:+.3g}/s"


def _span_s(parts: list[SiteLog]) -> float:
    """Returns the longest time of which a site has records."""
    return max((float(p.tick[-1] - p.tick[0]) / p.rate_hz for p in parts if len(p)), default=0.0)


def _at_end(parts: list[SiteLog], field: str) -> float:
    """Returns the largest value of the last second."""
    ends = [
        np.abs(getattr(part, field)[part.tick > part.tick[-1] - part.rate_hz]) for part in parts if len(part)
    ]
    return max((float(end.max(initial=0.0)) for end in ends), default=0.0)


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or None."""
    halves = [part.qd[len(part) // 2 :] for part in parts if len(part) > 1]
    part, half = max(zip(parts, halves, strict=False), key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    signs = np.sign(column - column.mean())
    crossings = int(np.count_nonzero(np.diff(signs[signs != 0.0])))
    span_s = float(part.tick[-1] - part.tick[len(part) // 2]) / part.rate_hz
    return None if crossings < LEAST_CROSSINGS else 0.5 * crossings / span_s

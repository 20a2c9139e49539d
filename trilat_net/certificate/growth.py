"""What e and qd of a log do at its end, where no theorem speaks.

Law: `ending` decides; what passed a limit has diverged, whatever else it does.
"""

from typing import NamedTuple

import numpy as np

from ..analysis.envelope import Envelope, Trend
from ..analysis.happenings import diverged_at_s
from ..analysis.quantities import SETTLED_RAD
from ..core.arm import Array
from ..core.grid import BUCKETS_PER_S
from ..log.reader import Log, SiteLog
from .ending import Ending, Motion, ending

LEAST_CROSSINGS = 6
"""Fewer changes of sign in the second half of a run show no period."""


class Growth(NamedTuple):
    """The end of a log's run.

    Attributes:
        end: what it does.
        text: the same with its numbers.
    """

    end: Ending
    text: str

    @property
    def motion(self) -> Motion:
        """What it does, in a word."""
        return self.end.motion

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
    end = ending([_maxima(part) for part in parts], _span_s(parts))
    stops = [at_s for part in parts if (at_s := diverged_at_s(part)) is not None]
    if stops:
        text = f"diverged at {min(stops):.4g} s: a joint passed its qd_limit_rad_s"
        return Growth(end._replace(motion=Motion.DIVERGED), text)
    return Growth(end, f"undecided: no record of {absent}" if absent else _text(parts, end))


def _maxima(part: SiteLog) -> Array:
    """Returns the largest |e| and |qd| of every bucket; -1 where a bucket has no record."""
    if not len(part):
        return np.zeros((0, 2))
    bucket = part.tick * BUCKETS_PER_S // part.rate_hz
    maxima = np.full((int(bucket[-1]) + 1, 2), -1.0)
    for column, values in enumerate((part.e, part.qd)):
        np.maximum.at(maxima[:, column], bucket, np.abs(values).max(axis=1))
    return maxima


def _text(parts: list[SiteLog], found: Ending) -> str:
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


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or None."""
    halves = [part.qd[len(part) // 2 :] for part in parts if len(part) > 1]
    part, half = max(zip(parts, halves, strict=False), key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    signs = np.sign(column - column.mean())
    crossings = int(np.count_nonzero(np.diff(signs[signs != 0.0])))
    span_s = float(part.tick[-1] - part.tick[len(part) // 2]) / part.rate_hz
    return None if crossings < LEAST_CROSSINGS else 0.5 * crossings / span_s

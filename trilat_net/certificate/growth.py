"""What e and qd do at the end of a run, where no theorem speaks: converged, bounded, diverged, or undecided.

Law: `analysis.envelope` decides, on the largest |e| and |qd| of every 50 ms, as `trilat test` does on e; what
it cannot tell is called undecided, never guessed.
"""

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
LEAST_CROSSINGS = 6
"""Fewer changes of sign in the second half of a run show no period."""


class Motion(StrEnum):
    """What a run does at its end; the text is the word for people."""

    CONVERGED = "converged"
    BOUNDED = "bounded oscillation"
    DIVERGED = "diverged"
    UNDECIDED = "undecided (record longer)"


class Growth(NamedTuple):
    """The end of a run.

    Attributes:
        motion: what it does.
        text: the same with its numbers.
        error: the trend of the largest |e|.
        speed: the trend of the largest |qd|.
    """

    motion: Motion
    text: str
    error: Envelope
    speed: Envelope

    @property
    def grows(self) -> bool | None:
        """True or False where the run decides it, else None."""
        return None if self.motion is Motion.UNDECIDED else self.motion is Motion.DIVERGED


def growth(log: Log) -> Growth:
    """Returns what e and qd of a log's sites do; torn and empty logs are undecided."""
    parts = [log[site] for site in log.sites]
    error, speed = (_envelope(parts, field) for field in ("e", "qd"))
    stops = [at_s for part in parts if (at_s := diverged_at_s(part)) is not None]
    if stops:
        text = f"diverged at {min(stops):.4g} s: a joint passed its qd_limit_rad_s"
        return Growth(Motion.DIVERGED, text, error, speed)
    motion = _motion(error.trend, speed.trend)
    return Growth(motion, _text(parts, motion, error, speed), error, speed)


def _motion(error: Trend, speed: Trend) -> Motion:
    """Returns what two trends make together."""
    if Trend.GROWS in (error, speed):
        return Motion.DIVERGED
    if Trend.UNDECIDED in (error, speed):
        return Motion.UNDECIDED
    return Motion.CONVERGED if speed is Trend.DECAYS else Motion.BOUNDED


def _envelope(parts: list[SiteLog], field: str) -> Envelope:
    maxima = [_maxima(part, getattr(part, field)) for part in parts if len(part)]
    count = min((len(values) for values in maxima), default=0)
    largest: Array = np.max([values[:count] for values in maxima], axis=0) if count else np.zeros(0)
    kept = np.flatnonzero(largest >= 0.0)
    t_s: Array = kept.astype(np.float64) * BUCKET_S
    return envelope(t_s, largest[kept])


def _maxima(part: SiteLog, values: Array) -> Array:
    """Returns the largest value of every bucket that is complete; -1 where a bucket has no record."""
    bucket = np.floor(part.t_s / BUCKET_S + 1e-6).astype(np.int64)
    maxima = np.full(int(bucket[-1]) + 1, -1.0)
    np.maximum.at(maxima, bucket, np.abs(values).max(axis=1))
    return maxima[:-1]


def _text(parts: list[SiteLog], motion: Motion, error: Envelope, speed: Envelope) -> str:
    e, qd = (_at_end(parts, field) for field in ("e", "qd"))
    ends = f"|e| {e:.3g} rad and |qd| {qd:.3g} rad/s in the last second"
    if motion is Motion.CONVERGED and error.trend is Trend.STEADY and e > SETTLED_RAD:
        return f"at rest, and the sites do not agree: {ends}"
    if motion is Motion.CONVERGED:
        done = "converged" if e <= SETTLED_RAD else "converging"
        return f"{done}: {ends}, {_rate(error)}"
    if motion is Motion.DIVERGED:
        what, trend = ("|e|", error) if error.trend is Trend.GROWS else ("|qd|", speed)
        return f"{what} grows by {_rate(trend)}: {ends}"
    if motion is Motion.BOUNDED:
        hertz = _frequency_hz(parts)
        word = "bounded motion" if hertz is None else f"bounded oscillation at {hertz:.3g} Hz"
        return f"{word}: {ends}"
    return f"{motion.value}: |e| {error.trend.value}, |qd| {speed.trend.value}"


def _rate(trend: Envelope) -> str:
    return f"{trend.rate_per_s:+.3g}/s"


def _at_end(parts: list[SiteLog], field: str) -> float:
    """Returns the largest value of the last second."""
    ends = [np.abs(getattr(part, field)[part.t_s > part.t_s[-1] - 1.0]) for part in parts if len(part)]
    return max((float(end.max(initial=0.0)) for end in ends), default=0.0)


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or None."""
    halves = [part.qd[len(part) // 2 :] for part in parts if len(part) > 1]
    part, half = max(zip(parts, halves, strict=False), key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    signs = np.sign(column - column.mean())
    crossings = int(np.count_nonzero(np.diff(signs[signs != 0.0])))
    span_s = float(part.t_s[-1] - part.t_s[len(part) // 2])
    return None if crossings < LEAST_CROSSINGS else 0.5 * crossings / span_s

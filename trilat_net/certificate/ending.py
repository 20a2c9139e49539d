"""What the largest |e| and |qd| of every 50 ms of a run say of its end.

Law: `analysis.envelope` decides, as `trilat test` does on e. A word says what the record shows and nothing of
what follows: diverged is what passed a limit, growing what had not yet; converged is what has come to rest,
decaying what had not yet; what shows no trend is undecided.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ..analysis.envelope import FLOOR_RAD, Envelope, Trend, envelope
from ..analysis.quantities import SETTLED_RAD
from ..core.arm import Array
from ..core.grid import BUCKETS_PER_S

REST_RAD_S = 0.01
"""Arms at whose end nothing is faster are at rest, rad/s."""


class Motion(StrEnum):
    """What a run does at its end; the text is the word for people."""

    CONVERGED = "converged"
    DECAYS = "decaying"
    BOUNDED = "bounded oscillation"
    GROWS = "growing"
    DIVERGED = "diverged"
    UNDECIDED = "undecided (record longer)"


class Ending(NamedTuple):
    """The end of a run, of which nobody says that it diverged.

    Attributes:
        motion: what it does.
        error: the trend of the largest |e|.
        speed: the trend of the largest |qd|.
        end_error_rad: the largest |e| of the last second.
        end_speed_rad_s: the largest |qd| of the last second.
    """

    motion: Motion
    error: Envelope
    speed: Envelope
    end_error_rad: float
    end_speed_rad_s: float


def ending(maxima: Sequence[Array], span_s: float) -> Ending:
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
    error, speed = envelope(t_s, largest[:, 0]), envelope(t_s, largest[:, 1])
    found = Ending(Motion.UNDECIDED, error, speed, end_error_rad, end_speed_rad_s)
    return found._replace(motion=_motion(found, 0.5 * span_s))


def _motion(found: Ending, half_s: float) -> Motion:
    """Returns what the two trends make together, seen over the second half of a run of twice `half_s`.

    Errors that grow while no arm grows faster may be the start of a drift as well as what a hand has just
    done: undecided. The other way round is growth: arms that swing in unison have no error.
    """
    error, speed = found.error.trend, found.speed.trend
    if found.end_speed_rad_s <= FLOOR_RAD and speed is not Trend.GROWS:  # too still for a trend
        speed = Trend.DECAYS
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

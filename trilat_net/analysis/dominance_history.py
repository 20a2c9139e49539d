"""Dominance factors of a site over time: alpha of Eq. (6), ramps and steps included.

Invariant: alpha is a function of time and of the applied changes alone; a ramp starts from the value that the
ramp before it has at that time.
"""

from typing import NamedTuple

import numpy as np

from ..core.ticks import DominanceRamp
from ..core.vectors import Array
from ..log.log_reader import Log
from .aligned import AlignedRecords

RAMP_TIME_TOLERANCE_S = 5e-10
"""Times are whole nanoseconds where they are made."""


class DominanceHistory(NamedTuple):
    """Shares in the peers, in scenario order.

    Attributes:
        alpha: at every row, shape (K, P).
        rate: their derivative as the controller takes it into account, shape (K, P), 1/s.
        before: what they are at the end of every period, before a sudden change there, shape (K - 1, P).
    """

    alpha: Array
    rate: Array
    before: Array

    @property
    def constant(self) -> bool:
        """True where nothing changes."""
        return bool(np.all(self.alpha == self.alpha[0]) and not self.rate.any())


def trace_dominance(log: Log, track: AlignedRecords) -> DominanceHistory:
    """Returns the shares of a site.

    Raises:
        LogError: a record names a change that is none.
    """
    row = log.scenario.dominance[track.site]
    start = np.array([row.get(peer, 0.0) for peer in track.used])
    return evaluate_ramps(start, list_dominance_ramps(log, track.site), track.t_s, track.h_s)


def list_dominance_ramps(log: Log, site: str) -> list[DominanceRamp]:
    """Returns the changes of the shares of a site: those of the scenario, then those in its records.

    Raises:
        LogError: a record names a change that is none.
    """
    scripted = [
        log.scenario.ramp(site, change.shares, change.start_ns, change.ramp_s)
        for change in log.scenario.timeline
        if change.dominance == site
    ]
    ordered = [c.ramp for batch in log.commands(site).values() for c in batch if c.ramp is not None]
    return [*scripted, *ordered]


def evaluate_ramps(start: Array, ramps: list[DominanceRamp], t_s: Array, h_s: float) -> DominanceHistory:
    """Returns shares at times.

    Args:
        start: at the epoch, shape (P,).
        ramps: what changes them.
        t_s: the times, ascending, shape (K,), s.
        h_s: the period between them, s.
    """
    alpha, rate = np.tile(start, (len(t_s), 1)), np.zeros((len(t_s), len(start)))
    value, current = start, None
    for ramp in sorted(ramps, key=lambda ramp: ramp.start_ns):
        if current is not None:
            value = _value(value, current, ramp.start_ns * 1e-9)
        current = ramp
        later = t_s >= ramp.start_ns * 1e-9 - RAMP_TIME_TOLERANCE_S
        climbs = later & (t_s < ramp.end_ns * 1e-9 - RAMP_TIME_TOLERANCE_S)
        alpha[later], rate[later] = ramp.alpha, 0.0
        if climbs.any():
            slope = (np.array(ramp.alpha) - value) / ((ramp.end_ns - ramp.start_ns) * 1e-9)
            alpha[climbs] = value + slope * (t_s[climbs, np.newaxis] - ramp.start_ns * 1e-9)
            rate[climbs] = slope
    return DominanceHistory(alpha, rate, alpha[:-1] + h_s * rate[:-1])


def _value(before: Array, ramp: DominanceRamp, at_s: float) -> Array:
    """Returns the shares at a time of one ramp."""
    begin_s, end_s = ramp.start_ns * 1e-9, ramp.end_ns * 1e-9
    after = np.array(ramp.alpha)
    if at_s >= end_s:
        return after
    value: Array = before + (after - before) * ((at_s - begin_s) / (end_s - begin_s))
    return value

"""What a site sees of its peers at every tick, and what it would see had the ages stayed as they were.

Law: between two ticks a stamp moves at rate one, as with the constant delay of the theorem; what is in use at
the next tick is set against that, and the difference is a jump of its link.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .track import Bools, Moment, Past, Track


class View(NamedTuple):
    """One peer of a site.

    Attributes:
        now: the peer at the site's ticks, K rows.
        seen: the peer at the stamp of the sample in use, K rows.
        kept: the peer where that stamp goes within a period at rate one, K - 1 rows.
        stamp_s: the stamp of the sample in use, shape (K,), s; NaN before the first.
    """

    now: Moment
    seen: Moment
    kept: Moment
    stamp_s: Array

    @property
    def known(self) -> Bools:
        """Whether all of a period rests on records, shape (K - 1,)."""
        ends = (self.now.known[:-1], self.now.known[1:], self.seen.known[:-1], self.seen.known[1:])
        known: Bools = np.logical_and.reduce([*ends, self.kept.known])
        return known


_BEFORE_S = -1.0
"""Any time before the epoch: the start pose, at rest (L7)."""


def view(track: Track, peer: Track, past: Past) -> View:
    """Returns what a site sees of a peer.

    Args:
        track: the site's records.
        peer: the peer's records.
        past: the same as a function of time.
    """
    used = track.used[peer.site]
    began = used >= 0
    stamp_s = np.where(began, used / peer.rate_hz, _BEFORE_S)
    kept_s = np.where(began, stamp_s + track.h_s, _BEFORE_S)[:-1]
    return View(past.at(track.t_s), past.at(stamp_s), past.at(kept_s), np.where(began, stamp_s, np.nan))

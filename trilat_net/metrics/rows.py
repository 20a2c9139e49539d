"""The sites' records as columns on their whole grids of ticks, each to its own last one.

Law: what a gap has taken is filled in so that times stay times, and is marked; no number comes from it.
"""

import numpy as np

from ..certificate.track import Bools, Track, on_grid
from ..log.reader import Log, SiteLog

END_S = 1.0
"""Length of the end of a run, where a quantity speaks of it: its last second."""


def tracks(log: Log) -> dict[str, Track]:
    """Returns the sites' records, of those that have any.

    The record that says `diverged` is left out: it may hold zeros for what is no number any more.
    """
    found = {site: _track(log[site]) for site in log.sites}
    return {site: track for site, track in found.items() if track is not None}


def _track(part: SiteLog) -> Track | None:
    if not len(part):
        return None
    ticks, rows = np.unique(part.tick, return_index=True)
    healthy = part.mode[rows] != "diverged"
    ticks, rows = ticks[healthy], rows[healthy]
    return on_grid(part, rows, int(ticks[-1])) if len(rows) else None


def steps(track: Track) -> Bools:
    """Returns which periods have the records of both of their ends, shape (K - 1,)."""
    both: Bools = track.known[:-1] & track.known[1:]
    return both


def at_end(track: Track, end_s: float, length_s: float = END_S) -> Bools:
    """Returns which rows are recorded and lie in the last stretch before a time, shape (K,)."""
    here: Bools = track.known & (track.t_s > end_s - length_s)
    return here

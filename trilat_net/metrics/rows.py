"""The sites' records as columns on their whole grids of ticks, each to its own last one.

Law: what a gap has taken is filled in so that times stay times, and is marked; no number comes from it.
"""

import numpy as np

from ..certificate.track import COLUMNS, Bools, Track
from ..core.arm import Array
from ..log.reader import Ints, Log, SiteLog

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
    part.prepare(*COLUMNS)
    mode = part.mode
    ticks, rows = np.unique(part.tick, return_index=True)
    healthy = mode[rows] != "diverged"
    ticks, rows = ticks[healthy], rows[healthy]
    if not len(rows):
        return None
    grid = np.arange(int(ticks[0]), int(ticks[-1]) + 1)
    before = np.searchsorted(ticks, grid, side="right") - 1
    known: Bools = ticks[before] == grid
    columns = {name: _filled(getattr(part, name)[rows], ticks, grid, known) for name in COLUMNS}
    used = {peer: part.used[peer][rows][before] for peer in part.peers}
    follows: Bools = (mode[rows] == "run")[before]
    return Track(part.name, part.rate_hz, int(grid[0]), known, follows, used=used, **columns)


def _filled(values: Array, tick: Ints, grid: Ints, known: Bools) -> Array:
    """Returns values on the grid; what is missing is interpolated."""
    if known.all():
        return values
    return np.stack([np.interp(grid, tick, column) for column in values.T], axis=1)


def steps(track: Track) -> Bools:
    """Returns which periods have the records of both of their ends, shape (K - 1,)."""
    both: Bools = track.known[:-1] & track.known[1:]
    return both


def at_end(track: Track, end_s: float, length_s: float = END_S) -> Bools:
    """Returns which rows are recorded and lie in the last stretch before a time, shape (K,)."""
    here: Bools = track.known & (track.t_s > end_s - length_s)
    return here

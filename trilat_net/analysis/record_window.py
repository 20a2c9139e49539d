"""The newest records of a site on its tick grid, while a session runs.

Invariant: bounded; a record may come late, out of order or twice. What is not there is not known, as in
`AlignedRecords`, so that whatever is computed from a log can be computed from a window of it.
"""

from collections.abc import Iterable
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from ..net.messages import TASK_VECTORS, State
from ..scenario import Scenario
from .aligned import RECORD_COLUMNS, RESTING_MODES, RESUMING_S, AlignedRecords, find_unlimited

KEPT_S = 12.0
"""Records that are kept at least: the largest age of a sample, and the time in which a gap is filled."""


class RecordWindow:
    """The records of one site, from `first` on; `newest` is the last one's tick, -1 before the first.

    Args:
        scenario: the session's scenario.
        site: whose records these are.
        kept_s: how far back they reach at least, s.
    """

    def __init__(self, scenario: Scenario, site: str, kept_s: float = KEPT_S) -> None:
        self.site, self.rate_hz = site, scenario.sites[site].rate_hz
        self.peers, self._axes = scenario.peers(site), scenario.arms[site].axes
        layout = scenario.layout(site)
        names = (*RECORD_COLUMNS, *(TASK_VECTORS if layout.task else ()), *(("hand",) if layout.hand else ()))
        lengths = layout.lengths()
        ends = list(accumulate(lengths[name] for name in names))
        self._columns = {name: slice(*span) for name, span in zip(names, pairwise([0, *ends]), strict=True)}
        self._kept = max(8, round(kept_s * self.rate_hz))
        self._floats = np.zeros((2 * self._kept, ends[-1]))
        self._used = np.full((2 * self._kept, len(self.peers)), -1, dtype=np.int64)
        self._known = np.zeros(2 * self._kept, dtype=np.bool_)
        self._follows, self._rests = np.zeros((2, 2 * self._kept), dtype=np.bool_)
        self._limits = scenario.sites[site].limits
        self.first, self.newest = 0, -1
        self._glides, self._rested_at = scenario.sites[site].on_stale.action == "glide", -(2**40)

    def take(self, record: State) -> bool:
        """Adds a record; false if it is older than the window, or says that the site diverged."""
        if record.tick < self.first or record.mode == "diverged":
            return False
        if self.newest < 0:
            self.first = max(0, record.tick - self._kept)
        if record.tick - self.first >= 2 * self._kept:
            self._move(record.tick - self._kept + 1)
        row = record.tick - self.first
        for name, columns in self._columns.items():
            self._floats[row, columns] = getattr(record, name)
        self._used[row] = [record.used.get(peer, -1) for peer in self.peers]
        if self._glides and record.mode in RESTING_MODES:
            self._rested_at = max(self._rested_at, record.tick)
        since = record.tick - self._rested_at
        self._known[row], self._rests[row] = True, 0 <= since <= RESUMING_S * self.rate_hz
        free = self._limits.qd_des_limit_rad_s is None or find_unlimited(
            self._limits, np.array(record.qd_des)
        )
        self._follows[row] = record.mode == "run" and free
        self.newest = max(self.newest, record.tick)
        return True

    def _move(self, first: int) -> None:
        """Forgets the records before a tick."""
        left = max(0, self.newest + 1 - first)
        for column in (self._floats, self._used, self._known, self._follows, self._rests):
            column[:left] = column[first - self.first :][:left].copy()
        self._known[left:] = False
        self.first = first

    def knows(self, tick: int) -> bool:
        """True if there is a record of a tick."""
        return self.first <= tick <= self.newest and bool(self._known[tick - self.first])

    def rows(self, first: int, last: int) -> AlignedRecords:
        """Returns the records of ticks in the window, both ends included; a missing one is interpolated."""
        part = slice(first - self.first, last + 1 - self.first)
        known, floats, used = self._known[part].copy(), self._floats[part], self._used[part]
        follows, rests = self._follows[part].copy(), self._rests[part].copy()
        if not known.all() and known.any():
            floats, there = floats.copy(), np.flatnonzero(known)
            for column in floats.T:
                column[:] = np.interp(np.arange(len(known)), there, column[there])
            before = there[np.maximum(np.searchsorted(there, np.arange(len(known)), side="right") - 1, 0)]
            used, follows, rests = used[before], follows[before], rests[before]
        columns: dict[str, Any] = {name: floats[:, where] for name, where in self._columns.items()}
        return AlignedRecords(
            *(self.site, self.rate_hz, first, known, follows),
            **columns,
            used={peer: used[:, n] for n, peer in enumerate(self.peers)},
            axes=self._axes,
            rests=rests,
        )


def make_windows(scenario: Scenario, sites: Iterable[str], kept_s: float = KEPT_S) -> dict[str, RecordWindow]:
    """Returns an empty window for each of some sites."""
    return {site: RecordWindow(scenario, site, kept_s) for site in sites}

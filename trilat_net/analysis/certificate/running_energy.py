"""V of a session while it runs, and the work of operator and environment, from the newest
records.

Invariant: V is that of `certify` at the same instants, to rounding: the same functions over the
records of a window that reaches back to the oldest sample in use. Nothing is estimated: a time
whose records are not all there yet waits for them, and is passed over if they cannot be had. A
window is bounded; a record may come late, out of order or twice, and what is not there is not
known, as in `AlignedRecords`.
"""

from collections.abc import Iterable, Mapping
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np

from ...core.ticks import CoreChange
from ...core.vectors import Array
from ...net.messages import RESTING_MODES, TASK_VECTORS, State
from ...scenario import Scenario
from ..aligned import (
    RECORD_COLUMNS,
    RESUMING_S,
    AlignedRecords,
    PeerTrajectory,
    find_unlimited_rows,
)
from ..dominance_history import (
    DominanceHistory,
    drop_finished_ramps,
    evaluate_ramps,
    find_closed_groups,
    list_scripted_ramps,
)
from .energy_balance import (
    compute_energy_balance,
    derive_site_energies,
    find_common_times,
    find_dominance_matrices,
)
from .premises import describe_closed_groups, explain_no_functional

STEP_S = 0.25
"""The least time that is computed at once, s."""
LONGEST_STEP_S = 2.0
"""The longest, s: what is behind by more catches up in several steps."""
KEPT_S = 12.0
"""Records that are kept at least: the largest age of a sample, and the time in which a gap is
filled.
"""


class RecordWindow:
    """The records of one site, from `first` on; `newest` is the last one's tick, -1 before the
    first.

    Args:
        scenario: the session's scenario.
        site: whose records these are.
        kept_s: how far back they reach at least, s.
    """

    def __init__(self, scenario: Scenario, site: str, kept_s: float = KEPT_S) -> None:
        self.site = site
        self.rate_hz = scenario.sites[site].rate_hz
        self.peers = scenario.peers(site)
        self._axes = scenario.arms[site].axes
        layout = scenario.layout(site)
        names = (
            *RECORD_COLUMNS,
            *(TASK_VECTORS if layout.task else ()),
            *(("hand",) if layout.hand else ()),
        )
        lengths = layout.lengths()
        ends = list(accumulate(lengths[name] for name in names))
        self._columns = {
            name: slice(*span) for name, span in zip(names, pairwise([0, *ends]), strict=True)
        }
        self._kept = max(8, round(kept_s * self.rate_hz))
        self._floats = np.zeros((2 * self._kept, ends[-1]))
        self._used = np.full((2 * self._kept, len(self.peers)), -1, dtype=np.int64)
        self._known = np.zeros(2 * self._kept, dtype=np.bool_)
        self._follows, self._rests = np.zeros((2, 2 * self._kept), dtype=np.bool_)
        self._limits = scenario.sites[site].limits
        self.first = 0
        self.newest = -1
        self._glides = scenario.sites[site].on_stale.action == "glide"
        self._rested_at = -(2**40)

    def receive(self, record: State) -> bool:
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
        self._known[row] = True
        self._rests[row] = 0 <= since <= RESUMING_S * self.rate_hz
        free = self._limits.qd_des_limit_rad_s is None or find_unlimited_rows(
            self._limits, np.array(record.qd_des)
        )
        self._follows[row] = record.mode == "run" and free
        self.newest = max(self.newest, record.tick)
        return True

    def _move(self, first: int) -> None:
        left = max(0, self.newest + 1 - first)
        for column in (self._floats, self._used, self._known, self._follows, self._rests):
            column[:left] = column[first - self.first :][:left].copy()
        self._known[left:] = False
        self.first = first

    def has_record(self, tick: int) -> bool:
        """True if there is a record of a tick."""
        return self.first <= tick <= self.newest and bool(self._known[tick - self.first])

    def rows(self, first: int, last: int) -> AlignedRecords:
        """Returns the records of ticks in the window, both ends included; a missing one is
        interpolated.
        """
        part = slice(first - self.first, last + 1 - self.first)
        known = self._known[part].copy()
        floats = self._floats[part]
        used = self._used[part]
        follows = self._follows[part].copy()
        rests = self._rests[part].copy()
        if not known.all() and known.any():
            floats = floats.copy()
            there = np.flatnonzero(known)
            for column in floats.T:
                column[:] = np.interp(np.arange(len(known)), there, column[there])
            before = there[
                np.maximum(np.searchsorted(there, np.arange(len(known)), side="right") - 1, 0)
            ]
            used = used[before]
            follows = follows[before]
            rests = rests[before]
        columns: dict[str, Any] = {
            name: floats[:, where] for name, where in self._columns.items()
        }
        return AlignedRecords(
            *(self.site, self.rate_hz, first, known, follows),
            **columns,
            used={peer: used[:, n] for n, peer in enumerate(self.peers)},
            axes=self._axes,
            rests=rests,
        )


class EnergyCourse(NamedTuple):
    """V over some instants.

    Attributes:
        t_s: instants, ticks of the fastest site, s.
        V: the functional, J.
        supplied: work of operator and environment since the first instant of all, J.
    """

    t_s: Array
    V: Array
    supplied: Array


class RunningEnergy:
    """V of a running session; `reason` says why there is none, "" if there is.

    Args:
        scenario: the session's scenario.
        windows: the records of every site, as they come in.
    """

    def __init__(self, scenario: Scenario, windows: Mapping[str, RecordWindow]) -> None:
        self.reason = explain_no_functional(scenario)
        if any(spec.on_stale.rule.degrades for spec in scenario.sites.values()):
            self.reason = (
                self.reason or "shares change when a peer is lost: trilat certify tells V"
            )
        self._scenario = scenario
        self._windows = windows
        self._dominance = {site: list_scripted_ramps(scenario, site) for site in windows}
        self._done_s: float | None = None
        self._supplied = 0.0

    def add_changes(self, site: str, changes: Iterable[CoreChange]) -> None:
        """Notes changes that a site took in; those of its dominance factors count."""
        self._dominance[site][1].extend(
            change.ramp for change in changes if change.ramp is not None
        )

    def compute_next(self, complete: Mapping[str, int]) -> EnergyCourse | None:
        """Returns V since the last call; None if it is not known yet.

        `complete` has of every site the last tick up to which all records are there or cannot
        be had.
        """
        if self.reason or min(complete.values()) < 1:
            return None
        windows = self._windows
        end_s = min(complete[site] / windows[site].rate_hz for site in windows)
        oldest_s = max(window.first / window.rate_hz for window in windows.values())
        if self._done_s is None:
            self._done_s = oldest_s
        if end_s - self._done_s < STEP_S:
            return None
        begin_s = max(self._done_s, oldest_s)
        end_s = min(end_s, begin_s + LONGEST_STEP_S)
        self._done_s = end_s
        return self._compute(begin_s, end_s)

    def _compute(self, begin_s: float, end_s: float) -> EnergyCourse | None:
        """Returns V between two times; the first of them was there at the call before."""
        spans = {
            site: (
                int(np.ceil(begin_s * w.rate_hz - 1e-6)),
                int(np.floor(end_s * w.rate_hz + 1e-6)),
            )
            for site, w in self._windows.items()
        }
        if any(last - first < 1 for first, last in spans.values()):
            return None
        records = {site: self._windows[site].rows(*span) for site, span in spans.items()}
        reach = {site: first for site, (first, _) in spans.items()}
        for own in records.values():
            for peer, used in own.used.items():
                reach[peer] = min(reach[peer], max(int(used.min()) - 2, 0))
        pasts = {}
        for site, window in self._windows.items():
            from_tick = max(reach[site], window.first)
            pasts[site] = PeerTrajectory(window.rows(from_tick, spans[site][1]))
        energies = derive_site_energies(self._scenario, records, pasts, self._trace)
        for alpha in find_dominance_matrices(energies):
            if len(groups := find_closed_groups(alpha)) > 1:
                names = list(records)
                self.reason = describe_closed_groups(
                    [[names[n] for n in group] for group in groups[:2]]
                )
                return None
        balance = (
            compute_energy_balance(energies) if len(find_common_times(energies)) > 1 else None
        )
        for site, known in self._dominance.items():
            self._dominance[site] = drop_finished_ramps(*known, begin_s - 1.0)
        # a session that was joined late: what was under way then is not known
        if balance is None:
            return None
        supplied = self._supplied + balance.external_work
        self._supplied = float(supplied[-1])
        return EnergyCourse(balance.t_s, balance.V, supplied)

    def _trace(self, site: str, t_s: Array) -> DominanceHistory:
        return evaluate_ramps(*self._dominance[site], t_s, 1.0 / self._windows[site].rate_hz)

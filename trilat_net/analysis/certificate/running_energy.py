"""Computes the energy function V of all arms while a session runs.

This lets a person who watches a running session see whether the energy of the arms falls, as
the stability proof demands (`energy_terms` defines V). After the session, `trilat certify`
computes V from the entire log. `RunningEnergy` uses the same functions, but receives the
records one at a time and keeps only the newest ones of each arm, in a `RecordWindow`.

Invariant:
    - V equals the result of `trilat certify` at the same times, up to rounding. The windows are
      therefore long enough to contain all delayed states that the arms use.
    - Nothing is extrapolated. V at a given time is computed once all records up to that time
      have arrived, and is left out if records are lost.
    - The size of a window is bounded.
    - A record may arrive late, out of order or twice.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...core import Array, CoreChange, DominanceMatrix
from ...net import RESTING_MODES, TASK_VECTORS, State
from ...scenario import Scenario
from ..aligned import RECORD_COLUMNS, RESUMING_S, AlignedRecords, PeerTrajectory
from ..dominance_history import DominanceHistory, DominancePlan
from .energy_balance import (
    EnergyBalance,
    SiteEnergy,
    find_common_times,
    find_dominance_matrices,
)
from .premise_quantities import MissingFunctional

STEP_S = 0.25
"""Shortest span of time over which V is computed in one call, in s."""
LONGEST_STEP_S = 2.0
"""Longest span of time over which V is computed in one call, in s.

If more records are waiting, several calls are needed.
"""
KEPT_S = 12.0
"""Least time that a window reaches back, in s.

It covers the largest age of a sample, and the time within which a gap is filled.
"""
_NEVER_TICK = -(2**40)
"""Value of the last resting tick for a site that has never rested."""
_RAMP_MARGIN_S = 1.0
"""Time for which a ramp is kept after a later ramp has replaced it, in s."""


class RecordWindow:
    """The newest records of one arm during a session, in arrays of fixed size.

    A new record overwrites the oldest one, so a long session needs only bounded memory. The
    energy function of the session is computed from these records.

    Args:
        scenario: The scenario of the session.
        site: Name of the site.
        kept_s: Minimum time span that the window covers, in s.

    Attributes:
        site: Name of the site.
        rate_hz: Tick rate of the site, in Hz.
        peers: Names of the site's peers.
        first: Oldest tick of the window.
        newest: Newest recorded tick, or -1 before the first record.
    """

    def __init__(self, scenario: Scenario, site: str, kept_s: float = KEPT_S) -> None:
        spec = scenario.sites[site]
        self.site = site
        self.rate_hz = spec.rate_hz
        self.peers = scenario.peers(site)
        self.first = 0
        self.newest = -1
        self._axes = scenario.arms[site].axes
        self._limits = spec.limits
        self._kept = max(8, round(kept_s * self.rate_hz))

        # twice the needed rows, so records move to the front only after as many new ones have
        # arrived
        capacity = 2 * self._kept
        layout = scenario.layout(site)
        names = [*RECORD_COLUMNS]
        if layout.task:
            names += TASK_VECTORS
        if layout.hand:
            names.append("hand")
        lengths = layout.lengths()

        self._columns: dict[str, slice] = {}
        width = 0
        for name in names:
            end = width + lengths[name]
            self._columns[name] = slice(width, end)
            width = end

        self._floats = np.zeros((capacity, width))
        shape = (capacity, len(self.peers))
        self._used = np.full(shape, -1, dtype=np.int64)
        self._known = np.zeros(capacity, dtype=np.bool_)
        self._follows = np.zeros(capacity, dtype=np.bool_)
        self._rests = np.zeros(capacity, dtype=np.bool_)
        self._glides = spec.on_stale.action == "glide"
        self._last_resting_tick = _NEVER_TICK

    def receive(self, record: State) -> bool:
        """Stores a record in the row of its tick.

        Records arrive over the network, possibly out of order.

        Args:
            record: The record.

        Returns:
            False if the record was not stored, because it is older than the window or belongs
            to an arm that exceeded its limits (mode "diverged").
        """
        tick = record.tick
        if tick < self.first or record.mode == "diverged":
            return False

        if self.newest < 0:
            self.first = max(0, tick - self._kept)
        if tick - self.first >= len(self._floats):
            self._shift_to(tick - self._kept + 1)

        row = tick - self.first
        for name, columns in self._columns.items():
            self._floats[row, columns] = getattr(record, name)
        used = record.used
        self._used[row] = [used.get(peer, -1) for peer in self.peers]
        if self._glides and record.mode in RESTING_MODES:
            self._last_resting_tick = max(self._last_resting_tick, tick)

        ticks_since_rest = tick - self._last_resting_tick
        self._known[row] = True
        resuming_ticks = RESUMING_S * self.rate_hz
        self._rests[row] = 0 <= ticks_since_rest <= resuming_ticks
        self._follows[row] = record.mode == "run" and self._is_unlimited(record)
        self.newest = max(self.newest, tick)
        return True

    def _is_unlimited(self, record: State) -> bool:
        """Returns True if the reference of a record moves slower than its limit."""
        if self._limits.qd_des_limit_rad_s is None:
            return True
        qd_des = np.array(record.qd_des)
        return bool(self._limits.find_unlimited_rows(qd_des))

    def _shift_to(self, first: int) -> None:
        """Makes room for newer records: drops those before tick `first`, and moves the rest."""
        remaining_count = max(0, self.newest + 1 - first)
        dropped_count = first - self.first
        for rows in (self._floats, self._used, self._known, self._follows, self._rests):
            kept_rows = rows[dropped_count:]
            # a copy, because source and destination overlap
            rows[:remaining_count] = kept_rows[:remaining_count].copy()
        self._known[remaining_count:] = False
        self.first = first

    def has_record(self, tick: int) -> bool:
        """Returns True if the record of a tick has arrived and is stored.

        Args:
            tick: Number of the tick.
        """
        if not self.first <= tick <= self.newest:
            return False
        return bool(self._known[tick - self.first])

    def rows(self, first: int, last: int) -> AlignedRecords:
        """Returns the records of a range of ticks as arrays.

        Missing records are interpolated.

        Args:
            first: First tick.
            last: Last tick, included.

        Returns:
            The records. `known` is False in the rows of missing records.
        """
        first_row = first - self.first
        end_row = last + 1 - self.first
        window_rows = slice(first_row, end_row)
        known = self._known[window_rows].copy()
        values = self._floats[window_rows]
        used = self._used[window_rows]
        follows = self._follows[window_rows].copy()
        rests = self._rests[window_rows].copy()

        if not known.all() and known.any():
            values = values.copy()
            ticks = np.arange(len(known))
            known_rows = np.flatnonzero(known)
            for column in values.T:
                known_values = column[known_rows]
                column[:] = np.interp(ticks, known_rows, known_values)
            # values that are not numbers are those of the last record before the gap
            next_known = np.searchsorted(known_rows, ticks, side="right")
            preceding = np.maximum(next_known - 1, 0)
            last_known = known_rows[preceding]
            used = used[last_known]
            follows = follows[last_known]
            rests = rests[last_known]

        columns: dict[str, Any] = {}
        for name, span in self._columns.items():
            columns[name] = values[:, span]
        used_by_peer = {}
        for n, peer in enumerate(self.peers):
            used_by_peer[peer] = used[:, n]
        return AlignedRecords(
            site=self.site,
            rate_hz=self.rate_hz,
            first=first,
            known=known,
            follows=follows,
            used=used_by_peer,
            axes=self._axes,
            rests=rests,
            **columns,
        )


class EnergyCourse(NamedTuple):
    """The energy function V of the stability proof over one time span of a running session.

    V may rise by no more than the supplied energy, so a live display plots the two together.

    Attributes:
        t_s: Times of the ticks of the site with the highest tick rate, shape (T,), in s.
        V: The energy function, shape (T,), in J.
        supplied: Work of operators and environments since the first computed time, shape (T,),
            in J.
    """

    t_s: Array
    V: Array
    supplied: Array


class RunningEnergy:
    """Computes the energy function V of the stability proof while a session is running.

    A rise of V is an early warning of instability. V is computed for one time span after
    another, as soon as all records of a span have arrived.

    Args:
        scenario: The scenario of the session.
        kept_s: Minimum time span that the windows cover, in s.

    Attributes:
        windows: The newest records of every site, keyed by site name. The receiver of the
            records stores them here during the session.
        missing: Sites whose law or arm has no energy function, grouped by reason. If there are
            any, V cannot be computed.
        degrades: True if some site changes its dominance factors when it loses a peer, in which
            case V is not computed.
        closed_groups: Names of the sites in two closed groups. The sites of a closed group
            follow no site outside the group. If there are two of these groups, V is not
            defined. Empty until they are found.
    """

    def __init__(self, scenario: Scenario, kept_s: float = KEPT_S) -> None:
        names = scenario.names
        self.windows = {site: RecordWindow(scenario, site, kept_s) for site in names}
        self.missing = MissingFunctional.list_of_scenario(scenario)
        rules = [spec.on_stale.rule for spec in scenario.sites.values()]
        self.degrades = any(rule.degrades for rule in rules)
        self.closed_groups: list[list[str]] = []

        self._scenario = scenario
        self._dominance = {site: DominancePlan.of_scenario(scenario, site) for site in names}
        self._computed_until_s: float | None = None
        self._supplied = 0.0

    def add_changes(self, site: str, changes: Iterable[CoreChange]) -> None:
        """Applies commands that changed the dominance factors of a site.

        Other changes are ignored, because they have no effect on the energy.

        Args:
            site: Name of the site.
            changes: The changes that the site carried out.
        """
        ramps = self._dominance[site].ramps
        ramps.extend(change.ramp for change in changes if change.ramp is not None)

    def compute_next(self, complete: Mapping[str, int]) -> EnergyCourse | None:
        """Computes the energy V over the time since the last call, if all records have arrived.

        V is the energy function of the stability proof for all arms together. The result shows
        during a session whether V rises.

        Args:
            complete: For every site, the number of the last complete tick: every record up to
                this tick has either arrived or is known to be lost.

        Returns:
            V over the new time span, or `None` if the span is still too short or V cannot be
            computed in it.
        """
        has_no_energy = bool(self.missing or self.degrades or self.closed_groups)
        if has_no_energy or min(complete.values()) < 1:
            return None

        complete_times_s = []
        oldest_times_s = []
        for site, window in self.windows.items():
            complete_times_s.append(complete[site] / window.rate_hz)
            oldest_times_s.append(window.first / window.rate_hz)
        complete_s = min(complete_times_s)
        oldest_s = max(oldest_times_s)

        if self._computed_until_s is None:
            self._computed_until_s = oldest_s
        if complete_s - self._computed_until_s < STEP_S:
            return None

        begin_s = max(self._computed_until_s, oldest_s)
        end_s = min(complete_s, begin_s + LONGEST_STEP_S)
        self._computed_until_s = end_s
        return self._compute_span(begin_s, end_s)

    def _compute_span(self, begin_s: float, end_s: float) -> EnergyCourse | None:
        """Returns the energy function V over a span of time. `None` if V is not known.

        Changes of the dominance factors that ended long before the span are removed, so that a
        long session needs bounded memory.

        Args:
            begin_s: Start of the span, in s.
            end_s: End of the span, in s.
        """
        tick_spans = {}
        for site, window in self.windows.items():
            begin_ticks = begin_s * window.rate_hz
            end_ticks = end_s * window.rate_hz
            first = int(np.ceil(begin_ticks - 1e-6))
            last = int(np.floor(end_ticks + 1e-6))
            if last - first < 1:
                return None
            tick_spans[site] = (first, last)

        energies = self._derive_energies(tick_spans)
        for alpha in find_dominance_matrices(energies):
            groups = DominanceMatrix(alpha).closed_groups
            if len(groups) > 1:
                sites = list(energies)
                self.closed_groups = [[sites[n] for n in group] for group in groups[:2]]
                return None

        is_known = len(find_common_times(energies)) > 1
        balance = EnergyBalance.of_energies(energies) if is_known else None

        ramps_from_s = begin_s - _RAMP_MARGIN_S
        for site, plan in self._dominance.items():
            self._dominance[site] = plan.drop_finished(ramps_from_s)
        # in a session that was joined late, the oldest samples in use are unknown at first
        if balance is None:
            return None

        supplied = self._supplied + balance.external_work
        self._supplied = float(supplied[-1])
        return EnergyCourse(balance.t_s, balance.V, supplied)

    def _derive_energies(
        self, tick_spans: Mapping[str, tuple[int, int]]
    ) -> dict[str, SiteEnergy]:
        """Computes the energies of all sites over a span of ticks, as the records arrive.

        A site uses samples that its peers sent earlier. Therefore the records of each peer are
        needed from the oldest sample in use, with two additional ticks, because the motion
        between samples is interpolated.

        Args:
            tick_spans: First and last tick of the span, by site.

        Returns:
            The energies, by site.
        """
        records = {}
        # for each site, the first tick whose sample a peer may still use
        oldest_used = {}
        for site, (first, last) in tick_spans.items():
            window = self.windows[site]
            records[site] = window.rows(first, last)
            oldest_used[site] = first

        for site_records in records.values():
            for peer, used in site_records.used.items():
                least_used = int(used.min())
                oldest = max(least_used - 2, 0)
                oldest_used[peer] = min(oldest_used[peer], oldest)

        pasts = {}
        for site, window in self.windows.items():
            first = max(oldest_used[site], window.first)
            _, last = tick_spans[site]
            past_records = window.rows(first, last)
            pasts[site] = PeerTrajectory(past_records)
        return SiteEnergy.derive_all(self._scenario, records, pasts, self._trace_dominance)

    def _trace_dominance(self, site: str, t_s: Array) -> DominanceHistory:
        """Returns the dominance factors with which a site follows its peers, over time."""
        return self._dominance[site].evaluate(t_s)

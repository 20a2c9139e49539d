"""Aligned records.

A site's log as columns on its full tick grid, and its peers as it sees them after their links.

Invariant: a gap is filled in, so that sums have all their terms and times stay times, and is marked in
`known`; no metric uses a row that is not known. A peer's motion is a cubic through angles and velocities
between its records, and rest before them (L7). Between two ticks a stamp moves at rate one, as under the
constant delay of the theorem; the difference from the sample in use at the next tick is a jump of that
link.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.ticks import NS_PER_S
from ..core.two_link_arm import JOINTS
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog

Bools = NDArray[np.bool_]
RECORD_COLUMNS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")


class AlignedRecords(NamedTuple):
    """A site from its first record to the last time that all sites have records of; rows are ticks.

    Attributes:
        site: its name.
        rate_hz: its tick rate, Hz.
        first: the tick of row 0.
        known: whether there is a record of that tick, shape (K,).
        follows: whether it followed its peers then: no hold, no brake, no return, shape (K,).
        q: joint angles, shape (K, 2), rad.
        qd: joint velocities, shape (K, 2), rad/s.
        q_des: reference, shape (K, 2), rad.
        qd_des: its derivative, shape (K, 2), rad/s.
        tau: control torque, shape (K, 2), N m.
        tau_x: exogenous torque in the sign of Eq. (8), shape (K, 2), N m.
        theta_hat: estimate, shape (K, 5).
        used: per peer the tick of the sample in use, shape (K,); -1 before the first.
    """

    site: str
    rate_hz: int
    first: int
    known: Bools
    follows: Bools
    q: Array
    qd: Array
    q_des: Array
    qd_des: Array
    tau: Array
    tau_x: Array
    theta_hat: Array
    used: dict[str, Ints]

    @property
    def h_s(self) -> float:
        """The period, s."""
        return 1.0 / self.rate_hz

    @property
    def t_s(self) -> Array:
        """Nominal time of every row, shape (K,), s."""
        times: Array = np.arange(self.first, self.first + len(self.known)) / self.rate_hz
        return times

    @property
    def nominal_s(self) -> Array:
        """The same as the core has it, of whole nanoseconds: where actors begin and end, shape (K,), s."""
        tick = np.arange(self.first, self.first + len(self.known), dtype=np.int64)
        times: Array = (tick * NS_PER_S // self.rate_hz).astype(np.float64) * 1e-9
        return times

    @property
    def e(self) -> Array:
        """Position error, Eq. (9), shape (K, 2), rad."""
        return self.q - self.q_des


def align_common_records(log: Log) -> dict[str, AlignedRecords]:
    """Returns the sites' tracks to the end of the time that all of them have records of; {} without any.

    The record that says `diverged` is left out: it may hold zeros for what is no number any more.
    """
    rows = {site: _healthy(log, site) for site in log.sites}
    if min(map(len, rows.values())) < 2:
        return {}
    begin_s = max(log[site].tick[row[0]] / log[site].rate_hz for site, row in rows.items())
    end_s = min(log[site].tick[row[-1]] / log[site].rate_hz for site, row in rows.items())
    found = {site: _align_until(log, site, row, end_s) for site, row in rows.items() if end_s > begin_s}
    return found if min((len(track.known) for track in found.values()), default=0) > 1 else {}


def _healthy(log: Log, site: str) -> Ints:
    part = log[site]
    first: Ints = np.unique(part.tick, return_index=True)[1]
    healthy: Ints = first[part.mode[first] != "diverged"]
    return healthy


def _align_until(log: Log, site: str, rows: Ints, end_s: float) -> AlignedRecords:
    part = log[site]
    last = int(np.floor(end_s * part.rate_hz + 1e-6))
    return fill_tick_grid(part, rows, min(last, int(part.tick[rows[-1]])))


def fill_tick_grid(part: SiteLog, rows: Ints, last: int) -> AlignedRecords:
    """Returns records on every tick from the first of them on, those that are missing filled in and marked.

    Args:
        part: the site's records.
        rows: which of them, one for a tick, in order, at least one.
        last: the last tick; not after that of the last row.
    """
    part.prepare(*RECORD_COLUMNS)
    tick = part.tick[rows]
    first = int(tick[0])
    grid = np.arange(first, max(last, first) + 1)
    before = np.searchsorted(tick, grid, side="right") - 1
    known: Bools = tick[before] == grid
    follows: Bools = (part.mode[rows] == "run")[before]
    columns = {name: _filled(getattr(part, name)[rows], tick, grid, known) for name in RECORD_COLUMNS}
    used = {peer: part.used[peer][rows][before] for peer in part.peers}
    return AlignedRecords(part.name, part.rate_hz, first, known, follows, used=used, **columns)


def _filled(values: Array, tick: Ints, grid: Ints, known: Bools) -> Array:
    """Returns values on the grid; what is missing is interpolated."""
    if known.all():
        return values[: len(grid)]
    return np.stack([np.interp(grid, tick, column) for column in values.T], axis=1)


class PeerMotion(NamedTuple):
    """A peer at given times: what its link would carry of it.

    Attributes:
        q: shape (K, 2), rad.
        qd: shape (K, 2), rad/s.
        squares: integral of qd squared since row 0, per joint, shape (K, 2), rad^2/s.
        known: whether it rests on records, shape (K,).
    """

    q: Array
    qd: Array
    squares: Array
    known: Bools


class PeerTrajectory:
    """A site's motion as a function of time: its records, between them polynomials, before them rest (L7).

    Args:
        track: the site's records.
    """

    def __init__(self, track: AlignedRecords) -> None:
        self._track = track
        squares = track.qd**2
        steps = 0.5 * track.h_s * (squares[1:] + squares[:-1])
        self._squares: Array = np.vstack([np.zeros(JOINTS), np.cumsum(steps, axis=0)])

    def at(self, t_s: Array) -> PeerMotion:
        """Returns the site at times, s since the epoch; on its ticks these are its records.

        q is the cubic through angles and velocities, qd runs straight from record to record, and the
        integral is the exact one of the trapezoid rule.
        """
        track, h = self._track, self._track.h_s
        place = t_s * track.rate_hz - track.first
        nearest = np.round(place)
        place = np.where(np.abs(place - nearest) < 1e-5, nearest, place)
        low = np.clip(np.floor(place), 0, len(track.known) - 2).astype(np.int64)
        x = np.clip(place - low, 0.0, 1.0)[:, np.newaxis]
        qa, qb, va, vb = track.q[low], track.q[low + 1], track.qd[low], track.qd[low + 1]
        q = qa + x * (h * va + x * (3 * (qb - qa) - h * (2 * va + vb) + x * (2 * (qa - qb) + h * (va + vb))))
        qd = va + x * (vb - va)
        sa, sb = va**2, vb**2
        squares = self._squares[low] + h * x * (sa + 0.5 * x * (sb - sa))
        x0 = x[:, 0]
        known = (track.known[low] | (x0 == 1.0)) & (track.known[low + 1] | (x0 == 0.0))
        known &= (place >= 0.0) | (track.first == 0)
        rest = place < 0.0
        q = np.where((x == 1.0), qb, q)
        qd[rest], squares[rest] = 0.0, 0.0
        return PeerMotion(q, qd, squares, known)


METRIC_END_S = 1.0
"""Length of the end of a run, where a quantity speaks of it: its last second."""


def align_records(log: Log) -> dict[str, AlignedRecords]:
    """Returns the sites' records, of those that have any.

    The record that says `diverged` is left out: it may hold zeros for what is no number any more.
    """
    found = {site: _align_site(log[site]) for site in log.sites}
    return {site: track for site, track in found.items() if track is not None}


def _align_site(part: SiteLog) -> AlignedRecords | None:
    if not len(part):
        return None
    ticks, rows = np.unique(part.tick, return_index=True)
    healthy = part.mode[rows] != "diverged"
    ticks, rows = ticks[healthy], rows[healthy]
    return fill_tick_grid(part, rows, int(ticks[-1])) if len(rows) else None


def mask_recorded_periods(track: AlignedRecords) -> Bools:
    """Returns which periods have the records of both of their ends, shape (K - 1,)."""
    both: Bools = track.known[:-1] & track.known[1:]
    return both


def mask_end_window(track: AlignedRecords, end_s: float, length_s: float = METRIC_END_S) -> Bools:
    """Returns which rows are recorded and lie in the last stretch before a time, shape (K,)."""
    here: Bools = track.known & (track.t_s > end_s - length_s)
    return here


class DelayedPeer(NamedTuple):
    """One peer of a site.

    Attributes:
        now: the peer at the site's ticks, K rows.
        seen: the peer at the stamp of the sample in use, K rows.
        kept: the peer where that stamp goes within a period at rate one, K - 1 rows.
        stamp_s: the stamp of the sample in use, shape (K,), s; NaN before the first.
    """

    now: PeerMotion
    seen: PeerMotion
    kept: PeerMotion
    stamp_s: Array

    @property
    def known(self) -> Bools:
        """Whether all of a period rests on records, shape (K - 1,)."""
        ends = (self.now.known[:-1], self.now.known[1:], self.seen.known[:-1], self.seen.known[1:])
        known: Bools = np.logical_and.reduce([*ends, self.kept.known])
        return known


_BEFORE_S = -1.0
"""Any time before the epoch: the start pose, at rest (L7)."""


def view_delayed_peer(track: AlignedRecords, peer: AlignedRecords, past: PeerTrajectory) -> DelayedPeer:
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
    return DelayedPeer(
        past.at(track.t_s), past.at(stamp_s), past.at(kept_s), np.where(began, stamp_s, np.nan)
    )


def find_latest_rows(track: AlignedRecords, t_s: Array) -> tuple[Ints, Bools]:
    """Returns the rows of a site's latest ticks at some times, and whether these are recorded, shape (K,)."""
    row = np.floor(t_s * track.rate_hz + 1e-6).astype(np.int64) - track.first
    inside = (row >= 0) & (row < len(track.known))
    row = np.clip(row, 0, len(track.known) - 1)
    there: Bools = inside & track.known[row]
    return row, there

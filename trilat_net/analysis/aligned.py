"""Aligned records.

A site's log as columns on its full tick grid, and its peers as it sees them after their links.

Invariant: a gap is filled in, so that sums have all their terms and times stay times, and is
marked in `known`; no metric uses a row that is not known. A peer's motion is a cubic through
angles and velocities between its records, and rest before them (L7). Between two ticks a stamp
moves at rate one, as under the constant delay of the theorem; the difference from the sample in
use at the next tick is a jump of that link.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.safeguards import BLEND_S
from ..core.task_space import POSE, POSITION
from ..core.ticks import NS_PER_S
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.orientations import choose_nearest_vectors
from ..log.record_columns import Ints
from ..log.site_log import SiteLog, compute_task_errors
from ..net.messages import RESTING_MODES, TASK_VECTORS
from ..scenario import Scenario
from ..scenario.scenario_types import Limits

Bools = NDArray[np.bool_]
RECORD_COLUMNS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
_NONE: Array = np.zeros((0, 0))
_NO_ROWS: Bools = np.zeros(0, dtype=np.bool_)
RESUMING_S = 2.0 * BLEND_S
"""For so long after one of the `RESTING_MODES` the torque may not be that of the law alone
either.
"""


class AlignedRecords(NamedTuple):
    """A site's records on every tick from its first to its last; K rows, one per tick.

    Attributes:
        site: its name.
        rate_hz: its tick rate, Hz.
        first: the tick of row 0.
        known: True if there is a record of that tick.
        follows: True if the site followed its peers then: no hold, no brake, no return, and no
            reference as fast as it may move.
        q, qd: joint angles, shape (K, n), rad, and velocities, rad/s.
        q_des, qd_des: the same of the reference.
        tau: control torque, shape (K, n), N m.
        tau_x: exogenous torque in the sign of Eq. (8), shape (K, n), N m.
        theta_hat: estimate, shape (K, P).
        used: per peer the tick of the sample in use; -1 before the first. x, xd: in task space
        the end effector's place or pose and its derivative, shape (K, m); else empty.
        wrench: what tau_x amounts to there, likewise.
        axes: see `SiteLog`.
        hand: what somebody who holds the arm does, shape (K, h), see `HandInForce`; else empty.
        rests: True in one of the `RESTING_MODES`, and for `RESUMING_S` afterwards; empty:
            never.
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
    x: Array = _NONE
    xd: Array = _NONE
    wrench: Array = _NONE
    axes: tuple[float, ...] = ()
    hand: Array = _NONE
    rests: Bools = _NO_ROWS

    @property
    def shared(self) -> Array:
        """What peers get: q, or x in task space, shape (K, m)."""
        return self.x if self.x.size else self.q

    @property
    def shared_rate(self) -> Array:
        """Its derivative: qd, or xd in task space, shape (K, m)."""
        return self.xd if self.x.size else self.qd

    @property
    def h_s(self) -> float:
        """The period, s."""
        return 1.0 / self.rate_hz

    @property
    def t_s(self) -> Array:
        """Nominal time of every row, shape (K,), s."""
        return np.arange(self.first, self.first + len(self.known)) / self.rate_hz

    @property
    def nominal_s(self) -> Array:
        """The same of whole nanoseconds, as the core compares them with begin and end of a
        torque, s.
        """
        tick = np.arange(self.first, self.first + len(self.known), dtype=np.int64)
        return (tick * NS_PER_S // self.rate_hz).astype(np.float64) * 1e-9

    @property
    def e(self) -> Array:
        """Position error, Eq. (9), shape (K, n), rad; in task space (K, m), see `SiteLog.e`."""
        return (
            compute_task_errors(self.x, self.q_des, self.axes)
            if self.x.size
            else self.q - self.q_des
        )

    @property
    def ed(self) -> Array:
        """Its derivative, shape (K, n), rad/s; in task space (K, m)."""
        return self.shared_rate - self.qd_des

    @property
    def known_periods(self) -> Bools:
        """True if both ends of a period are recorded, shape (K - 1,)."""
        return self.known[:-1] & self.known[1:]

    def known_at_end(self, length_s: float) -> Bools:
        """Returns the recorded rows of the last seconds, shape (K,)."""
        rows: Bools = self.known & (self.t_s > self.t_s[-1] - length_s)
        return rows


def hold_torque(tau: Array, limit_nm: Array | float, *, digital: bool) -> Array:
    """Returns the torque that a controller holds from every tick to the next, shape (K, n), N
    m.

    tau_k of `digital`; of `second_order` the extrapolated 1.5 tau_k - 0.5 tau_(k-1) within the
    limit.
    """
    held = tau.copy()
    if not digital:
        held[1:] = np.clip(1.5 * tau[1:] - 0.5 * tau[:-1], -limit_nm, limit_nm)
    return held


def align_records(log: Log, *, common: bool = False) -> dict[str, AlignedRecords]:
    """Returns the records of the sites that have any, in scenario order.

    The record that says `diverged` is left out: it may hold zeros in place of numbers that are
    not finite. With `common` all end where the first site ends, as sums over all sites need it:
    then {} unless every site has two ticks until there.
    """
    rows: dict[str, Ints] = {}
    for site in log.sites:
        first = np.unique(log[site].tick, return_index=True)[1]
        rows[site] = first[log[site].mode[first] != "diverged"]
    if not common:
        return {
            site: _fill_tick_grid(log.scenario, log[site], kept)
            for site, kept in rows.items()
            if len(kept)
        }
    if min(map(len, rows.values())) < 2:
        return {}
    begin_s = max(log[site].tick[kept[0]] / log[site].rate_hz for site, kept in rows.items())
    end_s = min(log[site].tick[kept[-1]] / log[site].rate_hz for site, kept in rows.items())
    if end_s <= begin_s:
        return {}
    last = {site: int(np.floor(end_s * log[site].rate_hz + 1e-6)) for site in rows}
    found = {
        site: _fill_tick_grid(log.scenario, log[site], kept, last[site])
        for site, kept in rows.items()
    }
    return found if min(len(records.known) for records in found.values()) > 1 else {}


def find_unlimited_rows(limits: Limits, qd_des: Array) -> Bools:
    """Returns the rows in which no coordinate of a reference is as fast as it may be; of one
    row, if so.
    """
    return np.asarray((np.abs(qd_des) < limits.motion.qd_des_limit).all(axis=-1))


def _find_rests(modes: NDArray[Any], tick: Ints, rate_hz: int) -> Bools:
    """Returns the records in one of the `RESTING_MODES`, or within `RESUMING_S` after one."""
    rests = np.isin(modes, RESTING_MODES)
    if not rests.any():
        return rests
    last = np.maximum.accumulate(np.where(rests, tick, np.iinfo(np.int64).min // 2))
    return tick - last <= RESUMING_S * rate_hz


def _fill_tick_grid(
    scenario: Scenario, part: SiteLog, rows: Ints, last: int | None = None
) -> AlignedRecords:
    """Returns some records, one for a tick, on every tick up to `last`; missing ones are
    interpolated.
    """
    names = (*RECORD_COLUMNS, *(TASK_VECTORS if part.layout.task else ()))
    names += ("hand",) if part.layout.hand else ()
    part.prepare(*names)
    tick = part.tick[rows]
    first = int(tick[0])
    end = int(tick[-1]) if last is None else max(first, min(last, int(tick[-1])))
    grid = np.arange(first, end + 1)
    before = np.searchsorted(tick, grid, side="right") - 1
    known: Bools = tick[before] == grid
    follows: Bools = (part.mode[rows] == "run")[before]
    glides = scenario.sites[part.name].on_stale.action == "glide"
    rests = _find_rests(part.mode[rows], tick, part.rate_hz)[before] if glides else _NO_ROWS
    follows &= find_unlimited_rows(scenario.sites[part.name].limits, part.qd_des[rows])[before]
    columns = {name: getattr(part, name)[rows] for name in names}
    for name, values in columns.items():
        columns[name] = (
            values[: len(grid)]
            if known.all()
            else np.stack([np.interp(grid, tick, column) for column in values.T], axis=1)
        )
    used = {peer: part.used[peer][rows][before] for peer in part.peers}
    return AlignedRecords(
        part.name,
        part.rate_hz,
        first,
        known,
        follows,
        used=used,
        axes=part.axes,
        rests=rests if rests.any() else _NO_ROWS,
        **columns,
    )


class PeerMotion(NamedTuple):
    """Motion of a peer at K times: of its joints, or of its end effector in task space.

    Attributes:
        q, qd: what it shares, shape (K, n), rad and rad/s; in task space (K, m), m and m/s.
        squares: integral of qd squared since row 0, per joint, shape (K, n), rad^2/s.
        known: True if it follows from records.
    """

    q: Array
    qd: Array
    squares: Array
    known: Bools


class PeerTrajectory:
    """A site's motion as a function of time: its records, polynomials between them, rest before
    them (L7).
    """

    def __init__(self, records: AlignedRecords) -> None:
        self.records = records
        squares = records.shared_rate**2
        steps = 0.5 * records.h_s * (squares[1:] + squares[:-1])
        self._squares: Array = np.vstack(
            [np.zeros((1, squares.shape[1])), np.cumsum(steps, axis=0)]
        )

    def evaluate(self, t_s: Array) -> PeerMotion:
        """Returns the site at times, s since the epoch; on its ticks these are its records.

        q is the cubic through angles and velocities, qd runs straight from record to record,
        and the integral is the exact one of the trapezoid rule.
        """
        records = self.records
        h = self.records.h_s
        place = t_s * records.rate_hz - records.first
        nearest = np.round(place)
        place = np.where(np.abs(place - nearest) < 1e-5, nearest, place)
        low = np.clip(np.floor(place), 0, len(records.known) - 2).astype(np.int64)
        x = np.clip(place - low, 0.0, 1.0)[:, np.newaxis]
        at = records.shared
        rate = records.shared_rate
        qa = at[low]
        qb = at[low + 1].copy()
        va = rate[low]
        vb = rate[low + 1]
        # between two rotation vectors of different branches lies nothing
        if self.records.x.shape[1] == POSE:
            qb[:, POSITION:] = choose_nearest_vectors(qb[:, POSITION:], qa[:, POSITION:])
        q = qa + x * (
            h * va
            + x * (3 * (qb - qa) - h * (2 * va + vb) + x * (2 * (qa - qb) + h * (va + vb)))
        )
        qd = va + x * (vb - va)
        sa = va**2
        sb = vb**2
        squares = self._squares[low] + h * x * (sa + 0.5 * x * (sb - sa))
        x0 = x[:, 0]
        known = (records.known[low] | (x0 == 1.0)) & (records.known[low + 1] | (x0 == 0.0))
        known &= (place >= 0.0) | (records.first == 0)
        q = np.where(x == 1.0, qb, q)
        at_rest = place < 0.0
        qd[at_rest] = 0.0
        squares[at_rest] = 0.0
        return PeerMotion(q, qd, squares, known)


class DelayedPeer(NamedTuple):
    """A peer as a site sees it after its link.

    Attributes:
        now, delayed: the peer at the site's ticks, and at the stamps of the samples in use, K rows
        each.
        delayed_end: the peer at the end of a period if that stamp moves at rate one, K - 1 rows.
        stamp_s: the stamp of the sample in use, shape (K,), s; NaN before the first.
    """

    now: PeerMotion
    delayed: PeerMotion
    delayed_end: PeerMotion
    stamp_s: Array

    @property
    def known(self) -> Bools:
        """True if all of a period follows from records, shape (K - 1,)."""
        ends = (
            self.now.known[:-1],
            self.now.known[1:],
            self.delayed.known[:-1],
            self.delayed.known[1:],
        )
        known: Bools = np.logical_and.reduce([*ends, self.delayed_end.known])
        return known


_BEFORE_EPOCH_S = -1.0
"""Any time before the epoch: the start pose, at rest (L7)."""


def view_delayed_peer(records: AlignedRecords, past: PeerTrajectory) -> DelayedPeer:
    """Returns what a site sees of a peer whose motion is given, by the site's records."""
    used = records.used[past.records.site]
    began = used >= 0
    stamp_s = np.where(began, used / past.records.rate_hz, _BEFORE_EPOCH_S)
    kept_s = np.where(began, stamp_s + records.h_s, _BEFORE_EPOCH_S)[:-1]
    stamps = np.where(began, stamp_s, np.nan)
    return DelayedPeer(
        past.evaluate(records.t_s), past.evaluate(stamp_s), past.evaluate(kept_s), stamps
    )


def find_latest_rows(records: AlignedRecords, t_s: Array) -> tuple[Ints, Bools]:
    """Returns the rows of a site's latest ticks at given times, and True where recorded, shape
    (K,).
    """
    row = np.floor(t_s * records.rate_hz + 1e-6).astype(np.int64) - records.first
    inside = (row >= 0) & (row < len(records.known))
    row = np.clip(row, 0, len(records.known) - 1)
    recorded: Bools = inside & records.known[row]
    return row, recorded


def find_common_rows(sites: Sequence[AlignedRecords]) -> tuple[list[Ints], Bools]:
    """Returns per site the rows of its latest ticks at those of the first one, and where all
    are recorded.
    """
    found = [find_latest_rows(records, sites[0].t_s) for records in sites]
    return [row for row, _ in found], np.logical_and.reduce([recorded for _, recorded in found])

"""Aligns the recorded motion of an arm with the delayed motion of its peers.

A controller uses the state that a peer sent some time ago. Energy sums therefore need the
motion of the peer at the time of sending, which usually lies between two of its records. They
also need every tick, although a log may lack some records. `AlignedRecords.by_site` returns
arrays with one row per tick of an arm. `PeerTrajectory` interpolates the motion of an arm at
any time, and `DelayedPeer` holds the motion that another arm used.

Invariant:
    - Missing records are interpolated to keep the sums complete. Interpolated rows are not
      marked as `known`, and no metric uses them.
    - Between two records, an arm moves along a cubic polynomial that matches the recorded
      angles and velocities. Before its first record it is at rest.
    - Within a tick, the delay of the used state is constant, as the stability theorem assumes.
      The difference from the next state is a jump at the end of the tick.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import BLEND_S, POSE, POSITION, Array
from ..log import Ints, Log, RotationVectors, SiteLog, compute_task_errors
from ..net import RESTING_MODES, TASK_VECTORS
from ..records import NS_PER_S
from ..scenario import Scenario

Bools = NDArray[np.bool_]
RECORD_COLUMNS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
_NO_COLUMNS: Array = np.zeros((0, 0))
_NO_ROWS: Bools = np.zeros(0, dtype=np.bool_)
RESUMING_S = 2.0 * BLEND_S
"""Time after a resting mode in which the torque may differ from that of the law, in s."""
_TICK_TOLERANCE = 1e-5
"""Largest distance from a tick at which a time counts as the tick, as a fraction of a period.
"""


class AlignedRecords(NamedTuple):
    """The records of one site over K consecutive ticks, with one row per tick.

    Rows of ticks without a record are interpolated, so all arrays are complete. The arm has n
    joints. In task space the sites share the m coordinates of their end effectors instead of
    their joint angles.

    Attributes:
        site: Name of the site.
        rate_hz: Tick rate, in Hz.
        first: Number of the tick in row 0.
        known: True if the tick has a record, False if the row is interpolated, shape (K,).
        follows: True if the site followed its peers, shape (K,). In these rows the site did not
            hold, brake or return, and its reference was slower than its limit.
        q: Joint angles, shape (K, n), in rad.
        qd: Joint velocities, shape (K, n), in rad/s.
        q_des: Reference of the shared coordinates, shape (K, n) in rad, or (K, m) in task
            space.
        qd_des: Time derivative of the reference, with the same shape.
        tau: Control torque, shape (K, n), in N m.
        tau_x: External torque with the sign of Eq. (8), the negative of the torque that acts on
            the arm, shape (K, n), in N m.
        theta_hat: Estimates of the P dynamic parameters of the arm, shape (K, P).
        used: For each peer, the number of the peer's tick whose state was in use, shape (K,).
            It is -1 before the first state arrived.
        x: Position or pose of the end effector in task space, shape (K, m). Empty in joint
            space.
        xd: Time derivative of x.
        wrench: Force at the end effector that corresponds to `tau_x`, shape (K, m). Empty in
            joint space.
        axes: For each coordinate of the task, whether the site follows along it, see `SiteLog`.
        hand: Recorded action of the live operator, shape (K, h), see `HandInForce`. Empty if
            the site has no live operator.
        rests: True while the site comes to rest, in one of the `RESTING_MODES`, and for
            `RESUMING_S` afterwards, shape (K,). Empty if the site never rests.
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
    x: Array = _NO_COLUMNS
    xd: Array = _NO_COLUMNS
    wrench: Array = _NO_COLUMNS
    axes: tuple[float, ...] = ()
    hand: Array = _NO_COLUMNS
    rests: Bools = _NO_ROWS

    @property
    def shared(self) -> Array:
        """The coordinates that the site sends to its peers, one row per tick.

        These are the joint angles q, shape (K, n), in rad, or in task space the pose x of the
        end effector, shape (K, m).
        """
        return self.x if self.x.size else self.q

    @property
    def shared_rate(self) -> Array:
        """The time derivative of the shared coordinates, one row per tick.

        In joint space this is qd, shape (K, n), in rad/s, and in task space xd, shape (K, m).
        """
        return self.xd if self.x.size else self.qd

    @property
    def h_s(self) -> float:
        """Tick period, in s: 0.001 at a rate of 1 kHz."""
        return 1.0 / self.rate_hz

    @property
    def t_s(self) -> Array:
        """Nominal time of every row, tick / rate_hz, shape (K,), in s.

        A tick that was computed late keeps its nominal time.
        """
        return self._ticks / self.rate_hz

    @property
    def _ticks(self) -> Ints:
        """Tick of every row, shape (K,)."""
        end = self.first + len(self.known)
        return np.arange(self.first, end, dtype=np.int64)

    @property
    def nominal_s(self) -> Array:
        """Scheduled time of the tick in every row, rounded down to whole nanoseconds.

        The shape is (K,), in s. The simulation compares exactly these times with the start and
        end of an external torque. The times in `t_s` are not rounded and may differ in the last
        digit.
        """
        time_ns = self._ticks * NS_PER_S // self.rate_hz
        return time_ns.astype(np.float64) * 1e-9

    @property
    def e(self) -> Array:
        """Synchronisation error of the site: its position minus its reference.

        The shape is (K, n) in joint space, in rad, and (K, m) in task space.
        """
        if self.x.size:
            return compute_task_errors(self.x, self.q_des, self.axes)
        return self.q - self.q_des

    @property
    def ed(self) -> Array:
        """Time derivative of the synchronisation error: site velocity minus reference velocity.

        The shape is (K, n) in joint space, in rad/s, and (K, m) in task space.
        """
        return self.shared_rate - self.qd_des

    @property
    def known_periods(self) -> Bools:
        """Marks the tick periods whose start and end ticks both have a record.

        A change of energy between two ticks is computed from the records of both. If a record
        was lost, the changes in the periods before and after its tick are therefore unknown. K
        ticks bound K - 1 periods, so the shape is (K - 1,).
        """
        is_known_at_start = self.known[:-1]
        is_known_at_end = self.known[1:]
        return is_known_at_start & is_known_at_end

    def known_at_end(self, length_s: float) -> Bools:
        """Marks the recorded (not interpolated) rows in the last seconds of a run.

        Metrics of the end of a run, such as the final error, use only these rows.

        Args:
            length_s: Length of the interval at the end of the records, in s.

        Returns:
            True for each row in the interval that has a record, shape (K,).
        """
        t_s = self.t_s
        start_s = t_s[-1] - length_s
        rows: Bools = self.known & (t_s > start_s)
        return rows

    @classmethod
    def by_site(cls, log: Log, *, common: bool = False) -> "dict[str, AlignedRecords]":
        """Arranges the records of all sites into arrays with one row per tick.

        Ticks without a record are interpolated. A final record with the mode "diverged" is left
        out, because it may contain zeros in place of values that are not finite.

        Args:
            log: The log of the run.
            common: True to cut off the records of all sites where the shortest records end, as
                sums over all sites require.

        Returns:
            A mapping from site name to records, in scenario order. Sites without records are
            missing. With `common`, the mapping is empty if any site has fewer than two ticks.
        """
        rows_by_site: dict[str, Ints] = {}
        for site in log.sites:
            site_log = log[site]
            _, first_of_tick = np.unique(site_log.tick, return_index=True)
            modes = site_log.mode[first_of_tick]
            rows_by_site[site] = first_of_tick[modes != "diverged"]

        aligned = {}
        if not common:
            for site, rows in rows_by_site.items():
                if len(rows):
                    aligned[site] = _fill_tick_grid(log.scenario, log[site], rows)
            return aligned
        row_counts = [len(rows) for rows in rows_by_site.values()]
        if min(row_counts) < 2:
            return {}

        first_times_s = []
        last_times_s = []
        for site, rows in rows_by_site.items():
            site_log = log[site]
            first_times_s.append(site_log.tick[rows[0]] / site_log.rate_hz)
            last_times_s.append(site_log.tick[rows[-1]] / site_log.rate_hz)
        end_s = min(last_times_s)
        if end_s <= max(first_times_s):
            return {}
        for site, rows in rows_by_site.items():
            site_log = log[site]
            end_tick = end_s * site_log.rate_hz
            last_tick = int(np.floor(end_tick + 1e-6))
            records = _fill_tick_grid(log.scenario, site_log, rows, last_tick)
            if len(records.known) < 2:
                return {}
            aligned[site] = records
        return aligned

    def view_delayed_peer(self, past: "PeerTrajectory") -> "DelayedPeer":
        """Returns the motion of a peer as this arm received it, including the network delay.

        The records of this arm tell which sample was used in each tick, and the trajectory of
        the peer gives the state in that sample.

        Args:
            past: Trajectory of the peer.
        """
        used = self.used[past.records.site]
        has_sample = used >= 0
        sample_s = used / past.records.rate_hz
        stamp_s = np.where(has_sample, sample_s, _BEFORE_EPOCH_S)
        # the stamp moves at rate one over the period after a tick
        moved_stamp_s = stamp_s + self.h_s
        next_stamp_s = np.where(has_sample, moved_stamp_s, _BEFORE_EPOCH_S)
        return DelayedPeer(
            now=past.evaluate(self.t_s),
            delayed=past.evaluate(stamp_s),
            delayed_end=past.evaluate(next_stamp_s[:-1]),
            stamp_s=np.where(has_sample, stamp_s, np.nan),
        )

    def find_latest_rows(self, t_s: Array) -> tuple[Ints, Bools]:
        """Finds the latest row of this arm at or before each of the given times.

        Used to compare arms with different tick rates.

        Args:
            t_s: Times since the start of the session, shape (K,), in s.

        Returns:
            For each time, the row of the latest tick, shape (K,). For a time outside the
            records, this is the nearest row.
            For each time, True if that tick was recorded, and False if its row is interpolated
            or outside the records, shape (K,).
        """
        position = t_s * self.rate_hz
        tick = np.floor(position + 1e-6).astype(np.int64)
        row = tick - self.first
        row_count = len(self.known)
        is_inside = (row >= 0) & (row < row_count)
        nearest_row = np.clip(row, 0, row_count - 1)
        recorded: Bools = is_inside & self.known[nearest_row]
        return nearest_row, recorded


def hold_torque(tau: Array, limit_nm: Array | float, *, digital: bool) -> Array:
    """Converts recorded torques to the torque that acts during each tick period.

    The torque is constant between two ticks. The scheme `digital` holds the torque tau_k of
    tick k. The scheme `second_order` holds 1.5 tau_k - 0.5 tau_{k-1}, clipped to the limit,
    which approximates the torque in the middle of the period.

    Args:
        tau: Recorded torque, shape (K, n), in N m.
        limit_nm: Largest magnitude of the torque, in N m.
        digital: True for the scheme `digital`, False for `second_order`.

    Returns:
        Torque in each period, shape (K, n), in N m.
    """
    held = tau.copy()
    if not digital:
        previous_tau = tau[:-1]
        extrapolated = 1.5 * tau[1:] - 0.5 * previous_tau
        held[1:] = np.clip(extrapolated, -limit_nm, limit_nm)
    return held


def _find_resting_rows(modes: NDArray[Any], tick: Ints, rate_hz: int) -> Bools:
    """Marks the records in which an arm is brought to rest, and those of a short time after it.

    The recorded torque may differ there from the torque of the control law. The arm is in one
    of the `RESTING_MODES`, or was in one of these modes within the last `RESUMING_S` seconds.

    Args:
        modes: Mode of each record.
        tick: Tick of each record.
        rate_hz: Tick rate of the site.
    """
    rests = np.isin(modes, RESTING_MODES)
    if not rests.any():
        return rests
    never = np.iinfo(np.int64).min // 2
    resting_tick = np.where(rests, tick, never)
    last_resting_tick = np.maximum.accumulate(resting_tick)
    return tick - last_resting_tick <= RESUMING_S * rate_hz


def _fill_tick_grid(
    scenario: Scenario,
    site_log: SiteLog,
    rows: Ints,
    last: int | None = None,
) -> AlignedRecords:
    """Returns a site's records with one row for every tick. Missing records are interpolated.

    Values that cannot be interpolated, such as modes, are those of the previous record.

    Args:
        scenario: Scenario of the run.
        site_log: The site's part of the log.
        rows: Rows of the records to use, one per tick, in ascending order of ticks.
        last: Last tick. If `None`, the tick of the last record.
    """
    names = [*RECORD_COLUMNS]
    if site_log.layout.task:
        names += TASK_VECTORS
    if site_log.layout.hand:
        names.append("hand")
    site_log.prepare(*names)

    tick = site_log.tick[rows]
    first = int(tick[0])
    end = int(tick[-1])
    if last is not None:
        end = max(first, min(last, end))
    grid = np.arange(first, end + 1)
    # index of the last record at or before each tick
    next_row = np.searchsorted(tick, grid, side="right")
    previous_row = next_row - 1
    has_record: Bools = tick[previous_row] == grid

    spec = scenario.sites[site_log.name]
    modes = site_log.mode[rows]
    is_running = modes == "run"
    is_unlimited = spec.limits.find_unlimited_rows(site_log.qd_des[rows])
    follows: Bools = (is_running & is_unlimited)[previous_row]
    rests = _NO_ROWS
    if spec.on_stale.action == "glide":
        resting = _find_resting_rows(modes, tick, site_log.rate_hz)
        resting_in_grid = resting[previous_row]
        if resting_in_grid.any():
            rests = resting_in_grid

    columns = {}
    for name in names:
        values = getattr(site_log, name)[rows]
        if has_record.all():
            columns[name] = values[: len(grid)]
        else:
            interpolated = [np.interp(grid, tick, column) for column in values.T]
            columns[name] = np.stack(interpolated, axis=1)

    used = {}
    for peer in site_log.peers:
        recorded = site_log.used[peer][rows]
        used[peer] = recorded[previous_row]
    return AlignedRecords(
        site=site_log.name,
        rate_hz=site_log.rate_hz,
        first=first,
        known=has_record,
        follows=follows,
        used=used,
        axes=site_log.axes,
        rests=rests,
        **columns,
    )


class _PeerMotion(NamedTuple):
    """Motion of another arm (a peer) at K times, computed from its records.

    If arms follow joint by joint, the motion has n coordinates, in rad. In task space it has
    the m coordinates of the end effector, in m. Units below are for joints.

    Attributes:
        q: Positions, shape (K, n) or (K, m), in rad.
        qd: Velocities, with the same shape, in rad/s.
        squares: Integral over time of the squared velocity, from the peer's first record on,
            with the same shape, in rad^2/s.
        known: True at each time at which no interpolated record was needed, shape (K,).
    """

    q: Array
    qd: Array
    squares: Array
    known: Bools


class PeerTrajectory:
    """The motion of a site as a function of continuous time, interpolated from its records.

    Used to evaluate the position of a site between two ticks, for example when it sent a
    sample. The motion is a polynomial between two records. Before the first record the arm is
    at rest (assumption L7).

    Args:
        records: Records of the site.
    """

    def __init__(self, records: AlignedRecords) -> None:
        self.records = records
        squared_rate = records.shared_rate**2
        sums = squared_rate[1:] + squared_rate[:-1]
        steps = 0.5 * records.h_s * sums
        columns = squared_rate.shape[1]
        start = np.zeros((1, columns))
        running_sums = np.cumsum(steps, axis=0)
        self._squares: Array = np.vstack([start, running_sums])

    def evaluate(self, t_s: Array) -> _PeerMotion:
        """Returns the site's motion at the given times, interpolated between its records.

        At the site's ticks, the motion equals the records. Between two records, q is the cubic
        polynomial that matches the recorded angles and velocities at both ends (Hermite
        interpolation), and qd is linear. The integral of qd squared is computed with the
        trapezoidal rule.

        Args:
            t_s: Times after the start of the session, shape (K,), in s.
        """
        records = self.records
        position = t_s * records.rate_hz - records.first
        nearest = np.round(position)
        is_at_tick = np.abs(position - nearest) < _TICK_TOLERANCE
        position = np.where(is_at_tick, nearest, position)
        last_period = len(records.known) - 2
        period = np.floor(position)
        known_period = np.clip(period, 0, last_period)
        row = known_period.astype(np.int64)
        fraction = np.clip(position - row, 0.0, 1.0)

        q = records.shared[row]
        qd = records.shared_rate[row]
        squares = self._squares[row]
        # If the sites have the same tick rate, nearly all times are ticks of this site.
        between = np.flatnonzero(fraction)
        if len(between):
            interpolated = self._interpolate(row[between], fraction[between])
            q[between], qd[between], squares[between] = interpolated

        known_a = records.known[row] | (fraction == 1.0)
        known_b = records.known[row + 1] | (fraction == 0.0)
        # the arm rests before a session whose start is recorded
        is_after_start = (position >= 0.0) | (records.first == 0)
        known = known_a & known_b & is_after_start

        is_before = position < 0.0
        qd[is_before] = 0.0
        squares[is_before] = 0.0
        return _PeerMotion(q, qd, squares, known)

    def _interpolate(self, row: Ints, fraction: Array) -> tuple[Array, Array, Array]:
        """Interpolates the recorded motion of another arm between two control periods (ticks).

        Args:
            row: Row of the record before each of K times, shape (K,).
            fraction: Fraction of the period, 0 to 1, that has passed at each time, shape (K,).

        Returns:
            Joint angles q, in rad, joint velocities qd, in rad/s, and the integral of qd
            squared over time, at each of the K times.
        """
        records = self.records
        h = records.h_s
        x = fraction[:, np.newaxis]
        # records a and b are the two ends of the period that contains each time
        qa = records.shared[row]
        qb = records.shared[row + 1].copy()
        va = records.shared_rate[row]
        vb = records.shared_rate[row + 1]
        # rotation vectors of different branches must not be interpolated
        if records.x.shape[1] == POSE:
            vectors_a = qa[:, POSITION:]
            vectors_b = RotationVectors(qb[:, POSITION:])
            qb[:, POSITION:] = vectors_b.nearest_to(vectors_a)

        # coefficients of the cubic Hermite polynomial in the fraction of the period
        quadratic = 3 * (qb - qa) - h * (2 * va + vb)
        cubic = 2 * (qa - qb) + h * (va + vb)
        q = qa + x * (h * va + x * (quadratic + x * cubic))
        q = np.where(x == 1.0, qb, q)  # exactly the record, which the polynomial rounds
        qd = va + x * (vb - va)

        squared_a = va**2
        squared_b = vb**2
        mean_square = squared_a + 0.5 * x * (squared_b - squared_a)
        squares = self._squares[row] + h * x * mean_square
        return q, qd, squares


class DelayedPeer(NamedTuple):
    """The motion of a peer, both its actual motion and the delayed one that this arm receives.

    In each of its K ticks, this arm uses one sample, which the peer sent earlier.

    Attributes:
        now: Motion of the peer at the site's ticks, K rows.
        delayed: Motion of the peer when the samples in use were sent, K rows.
        delayed_end: Delayed motion of the peer at the end of every tick period, assuming that
            the age of the sample did not change within the period, K - 1 rows.
        stamp_s: Time at which the sample in use was sent, shape (K,), in s. NaN before the
            first sample.
    """

    now: _PeerMotion
    delayed: _PeerMotion
    delayed_end: _PeerMotion
    stamp_s: Array

    @property
    def known(self) -> Bools:
        """Marks the tick periods in which the peer's motion comes from records alone.

        Both its present and its delayed motion must be known. The other periods contain
        interpolated records, so energies that depend on the peer are not evaluated there. K
        ticks bound K - 1 periods, so the shape is (K - 1,).
        """
        now = self.now.known
        delayed = self.delayed.known
        now_known = now[:-1] & now[1:]
        delayed_known = delayed[:-1] & delayed[1:]
        known: Bools = now_known & delayed_known & self.delayed_end.known
        return known


_BEFORE_EPOCH_S = -1.0
"""A time before the start of the session, at which a peer rests in its start pose (L7)."""


def find_common_rows(sites: Sequence[AlignedRecords]) -> tuple[list[Ints], Bools]:
    """Finds the rows of several arms that belong to the same times, to compare the arms.

    The times are the ticks of the first arm. For every other arm, the row of its latest tick at
    each of these times is returned, since the rates may differ.

    Args:
        sites: Records of the sites.

    Returns:
        The rows of each site, in the order of `sites`, shape (K,) each.
        True where these ticks are recorded for all sites, shape (K,).
    """
    rows = []
    recorded_by_site = []
    for records in sites:
        row, recorded = records.find_latest_rows(sites[0].t_s)
        rows.append(row)
        recorded_by_site.append(recorded)
    return rows, np.logical_and.reduce(recorded_by_site)

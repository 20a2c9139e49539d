"""Bounded running statistics of one site: over the whole run and within the windows of [expect].

Invariant: statistics are a function of the records alone, so a run in progress and its log measure alike.
Batches hold records in time order and are dropped once taken in; how a run is cut into batches changes only
the last bits of a mean. Kept are extrema, sums, the last second, and the largest |e| of every `BUCKET_NS`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...analysis.arm_rows import compute_end_effector
from ...analysis.torque_sources import wall_force
from ...core.ticks import NS_PER_S
from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...log.record_columns import Ints
from ...scenario import SiteSpec
from ...scenario.expect import END_WINDOW_S, ExpectWindow
from ...scenario.operators import Wall
from ..record_batches import RecordBatch, join_batches


class Range(NamedTuple):
    """Smallest and largest value that a quantity had; twice the same where it has one value."""

    least: float
    most: float


class WindowStats:
    """Statistics of one site within a window, so far."""

    def __init__(self, window: ExpectWindow, spec: SiteSpec) -> None:
        self._from_ns, self._to_ns = (round(t_s * NS_PER_S) for t_s in (window.from_s, window.to_s))
        self._period_ns = NS_PER_S // spec.rate_hz + 1
        self._spec = spec
        self._walls = [one.actor for one in spec.environment if isinstance(one, Wall)]
        self._seen_ns = -1
        self._records = 0
        self._peaks = {"error_peak_rad": 0.0, "speed_peak_rad_s": 0.0, "torque_peak_nm": 0.0}
        self._q_least, self._q_most = np.full(JOINTS, math.inf), np.full(JOINTS, -math.inf)
        self._push_sum = np.zeros(JOINTS)
        self._force_sum = self._force_squares = self._force_peak = 0.0
        self._touched: bool | None = None
        self._hits = 0

    def add(self, rows: RecordBatch) -> None:
        """Takes in the next records of the site; those outside of the window leave no trace."""
        self._seen_ns = int(rows.t_ns[-1])
        inside = rows.between(self._from_ns, self._to_ns)
        if not len(inside.t_ns):
            return
        self._records += len(inside.t_ns)
        for key, values in zip(self._peaks, (inside.q - inside.q_des, inside.qd, inside.tau), strict=True):
            self._peaks[key] = max(self._peaks[key], float(np.abs(values).max()))
        self._q_least = np.minimum(self._q_least, inside.q.min(axis=0))
        self._q_most = np.maximum(self._q_most, inside.q.max(axis=0))
        self._push_sum -= inside.tau_x.sum(axis=0)
        if self._walls:
            tip = compute_end_effector((self._spec.arm.l1_m, self._spec.arm.l2_m), inside.q, inside.qd)
            t_s = inside.t_ns / NS_PER_S
            self._add_force(np.sum([wall_force(wall, t_s, tip) for wall in self._walls], axis=0))

    def _add_force(self, force: Array) -> None:
        touching = force > 0.0
        before = np.append(touching[0] if self._touched is None else self._touched, touching[:-1])
        self._hits += int((touching & ~before).sum())
        self._touched = bool(touching[-1])
        self._force_sum += float(force.sum())
        self._force_squares += float((force * force).sum())
        self._force_peak = max(self._force_peak, float(force.max()))

    def figures(self) -> dict[str, Range]:
        """Returns every quantity by its key in `Window`; none where the records end before the window."""
        if not self._records or self._seen_ns < self._to_ns - self._period_ns:
            return {}
        mean_n = self._force_sum / self._records
        push_nm = self._push_sum / self._records
        single = {
            **self._peaks,
            "push1_mean_nm": float(push_nm[0]),
            "push2_mean_nm": float(push_nm[1]),
            "wall_mean_n": mean_n,
            "wall_deviation_n": math.sqrt(max(0.0, self._force_squares / self._records - mean_n * mean_n)),
            "wall_peak_n": self._force_peak,
            "wall_hits": float(self._hits),
        }
        angles = zip(("q1_rad", "q2_rad"), self._q_least.tolist(), self._q_most.tolist(), strict=True)
        spans = {key: Range(least, most) for key, least, most in angles}
        return {**spans, **{key: Range(value, value) for key, value in single.items()}}


BUCKET_NS = 50_000_000
"""The envelope of |e| is kept as one largest value per so many nanoseconds."""

_NO_RECORD = -1.0
_END_NS = round(END_WINDOW_S * NS_PER_S)


class SiteStats:
    """One site's figures, so far.

    Args:
        peer_rates: tick rate of every peer, Hz, in scenario order.
        synchronised_rad: the |e| below which the site counts as synchronised, rad.
        stretches: what is kept of the site within each window of [expect]; None where a window is another's.

    Attributes:
        records: how many records were taken in.
        peak_error_rad: largest |e|.
        peak_torque_nm: largest |tau|.
        peak_speed_rad_s: largest |qd|.
        apart_ns: time of the last record whose |e| was not below `synchronised_rad`; -1 before one was.
        age_max_ms: per peer the largest age of the sample in use, shape (P,).
        stretches: as given.
    """

    def __init__(
        self, peer_rates: Sequence[int], synchronised_rad: float, stretches: Sequence[WindowStats | None] = ()
    ) -> None:
        self._peer_rates = np.array(peer_rates, dtype=np.int64)
        self._synchronised_rad = synchronised_rad
        self.stretches = tuple(stretches)
        self.records = 0
        self.peak_error_rad = self.peak_torque_nm = self.peak_speed_rad_s = 0.0
        self.apart_ns = -1
        self.age_max_ms = np.zeros(len(peer_rates))
        self._age_sum_ms = np.zeros(len(peer_rates))
        self._age_records = np.zeros(len(peer_rates), dtype=np.int64)
        self._squares = np.zeros(JOINTS)
        self._peaks = np.zeros(0)
        self._tail: list[RecordBatch] = []

    def add(self, rows: RecordBatch) -> None:
        """Takes in the next records."""
        if not len(rows.t_ns):
            return
        error = np.abs(rows.q - rows.q_des)
        largest = error.max(axis=1)
        self.records += len(largest)
        self.peak_error_rad = max(self.peak_error_rad, float(largest.max()))
        self.peak_torque_nm = max(self.peak_torque_nm, float(np.abs(rows.tau).max()))
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, float(np.abs(rows.qd).max()))
        self._squares += (error * error).sum(axis=0)
        apart = np.flatnonzero(largest >= self._synchronised_rad)
        if len(apart):
            self.apart_ns = int(rows.t_ns[apart[-1]])
        self._add_ages(rows)
        self._add_peaks(rows.t_ns // BUCKET_NS, largest)
        for stretch in filter(None, self.stretches):
            stretch.add(rows)
        self._tail.append(rows)
        while len(self._tail) > 1 and self._tail[1].t_ns[0] < rows.t_ns[-1] - _END_NS:
            del self._tail[0]

    def _add_ages(self, rows: RecordBatch) -> None:
        known = rows.used >= 0
        age_ms = (rows.t_ns[:, None] - rows.used * NS_PER_S // self._peer_rates) * 1e-6
        age_ms[~known] = 0.0
        self.age_max_ms = np.maximum(self.age_max_ms, age_ms.max(axis=0))
        self._age_sum_ms += age_ms.sum(axis=0)
        self._age_records += known.sum(axis=0)

    def _add_peaks(self, buckets: Ints, largest: Array) -> None:
        lacking = int(buckets[-1]) + 1 - len(self._peaks)
        if lacking > 0:  # by half as much again: a long run is not copied for every block
            self._peaks = np.append(self._peaks, np.full(lacking + len(self._peaks) // 2, _NO_RECORD))
        np.maximum.at(self._peaks, buckets, largest)

    @property
    def last_ns(self) -> int:
        """Nominal time of the last record, ns; -1 before the first."""
        return int(self._tail[-1].t_ns[-1]) if self._tail else -1

    @property
    def rms_error_rad(self) -> float:
        """Root mean square of e of the worse joint, rad."""
        return float(np.sqrt(self._squares.max() / max(1, self.records)))

    @property
    def mean_age_ms(self) -> list[float | None]:
        """Per peer the mean age of the sample in use, ms; None where there never was one."""
        return [
            float(total / records) if records else None
            for total, records in zip(self._age_sum_ms, self._age_records, strict=True)
        ]

    def end(self, end_ns: int) -> RecordBatch:
        """Returns the records of the last second before `end_ns`, which is not before the last record."""
        return join_batches(self._tail).since(end_ns - _END_NS)

    def peaks(self) -> Array:
        """Returns the largest |e| of every bucket that ended, from the first on; -1 where it has none."""
        return self._peaks[: self.last_ns // BUCKET_NS]

"""Running statistics of the records of one site, from which the metrics of a run follow.

Invariant:
    - Memory use is bounded, however long the run is. Only extrema, sums, the last second of
      records, and a summary of the motion are kept.
    - How a run is divided into batches affects only the last bits of a mean.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np

from trilat_net.analysis import NO_BUCKETS, VirtualWall, build_arm_rows
from trilat_net.core import BUCKETS_PER_S, Array
from trilat_net.records import NS_PER_S
from trilat_net.scenario import END_WINDOW_S, Scenario

from .record_batches import RecordBatch


class Range(NamedTuple):
    """Smallest and largest value of a quantity in part of a run, for comparison with limits.

    For a quantity with a single value, such as a mean, `least` and `most` are equal.
    """

    least: float
    most: float


class WindowStats:
    """Statistics of one arm over a window, a part of the run with limits of its own.

    Windows are defined in the table [expect] of the scenario. The statistics are updated batch
    by batch, so records need not be kept.

    Args:
        from_s: Start of the window, in s.
        to_s: End of the window, in s.
        scenario: Scenario of the run.
        site: Name of the site to evaluate.
    """

    def __init__(self, from_s: float, to_s: float, scenario: Scenario, site: str) -> None:
        spec = scenario.sites[site]
        self._from_ns = round(from_s * NS_PER_S)
        self._to_ns = round(to_s * NS_PER_S)
        self._period_ns = NS_PER_S // spec.rate_hz + 1
        self._arm = build_arm_rows(scenario, site)
        self._walls = VirtualWall.list_of_site(scenario, site)

        self._last_ns = -1
        self._records = 0
        self._peaks = {"error_peak_rad": 0.0, "speed_peak_rad_s": 0.0, "torque_peak_nm": 0.0}

        joints = len(spec.q0_rad)
        self._q_least = np.full(joints, math.inf)
        self._q_most = np.full(joints, -math.inf)
        self._push_sum = np.zeros(joints)

        self._force_sum = 0.0
        self._force_squares = 0.0
        self._force_peak = 0.0

        self._was_touching: bool | None = None
        self._hits = 0

    def add(self, rows: RecordBatch) -> None:
        """Updates the statistics with the next records of the arm.

        Records outside the window are ignored.

        Args:
            rows: The records, at least one. They must follow those of the previous call.
        """
        self._last_ns = int(rows.t_ns[-1])
        rows_inside = rows.between(self._from_ns, self._to_ns)
        if not len(rows_inside.t_ns):
            return
        self._records += len(rows_inside.t_ns)
        self._raise_peak("error_peak_rad", rows_inside.e)
        self._raise_peak("speed_peak_rad_s", rows_inside.qd)
        self._raise_peak("torque_peak_nm", rows_inside.tau)

        q_least = rows_inside.q.min(axis=0)
        q_most = rows_inside.q.max(axis=0)
        self._q_least = np.minimum(self._q_least, q_least)
        self._q_most = np.maximum(self._q_most, q_most)
        self._push_sum -= rows_inside.tau_x.sum(axis=0)

        if self._walls:
            tip = self._arm.place_end_effector(rows_inside.q, rows_inside.qd)
            t_s = rows_inside.t_ns / NS_PER_S
            forces = [wall.find_force(t_s, tip) for wall in self._walls]
            total_force = np.sum(forces, axis=0)
            self._add_wall_force(total_force)

    def _raise_peak(self, key: str, values: Array) -> None:
        """Updates the largest absolute value of a quantity with new records.

        Args:
            key: Name of the peak.
            values: New values, of any shape, not empty.
        """
        previous = self._peaks[key]
        largest = float(np.abs(values).max())
        self._peaks[key] = max(previous, largest)

    def _add_wall_force(self, force: Array) -> None:
        """Updates the statistics of the wall force on the arm within the window.

        A hit is a record with contact that follows a record without contact.

        Args:
            force: Sum of the forces of all walls in the next records, shape (K,), in N.
        """
        touches = force > 0.0
        # A contact that exists in the first record of the window is not a hit.
        was_touching = self._was_touching
        if was_touching is None:
            was_touching = touches[0]
        previous = np.append(was_touching, touches[:-1])
        begins_contact = touches & ~previous

        squares = force * force
        peak = float(force.max())
        self._hits += int(begins_contact.sum())
        self._was_touching = bool(touches[-1])
        self._force_sum += float(force.sum())
        self._force_squares += float(squares.sum())
        self._force_peak = max(self._force_peak, peak)

    def compute_ranges(self) -> dict[str, Range]:
        """Returns the smallest and largest value of each quantity within the window.

        For a joint angle, the two values are its extremes. Every other quantity, such as a mean
        or a peak, has a single value, which is returned as both the smallest and the largest.

        Returns:
            The ranges, keyed as in the table [expect]. Empty if the records end before the
            window does.
        """
        ends_early = self._last_ns < self._to_ns - self._period_ns
        if not self._records or ends_early:
            return {}

        ranges = {}
        least_rad = self._q_least.tolist()
        most_rad = self._q_most.tolist()
        angles = zip(least_rad, most_rad, strict=True)
        for n, (least, most) in enumerate(angles, 1):
            ranges[f"q{n}_rad"] = Range(least, most)

        single_values = dict(self._peaks)
        mean_push = self._push_sum / self._records
        pushes_nm = mean_push.tolist()
        for n, push_nm in enumerate(pushes_nm, 1):
            single_values[f"push{n}_mean_nm"] = push_nm
        mean_n = self._force_sum / self._records
        mean_square = self._force_squares / self._records
        variance = max(0.0, mean_square - mean_n * mean_n)  # rounding can make it negative
        single_values["wall_mean_n"] = mean_n
        single_values["wall_deviation_n"] = math.sqrt(variance)
        single_values["wall_peak_n"] = self._force_peak
        single_values["wall_hits"] = float(self._hits)

        for key, value in single_values.items():
            ranges[key] = Range(value, value)
        return ranges


_BUCKET_NS = NS_PER_S // BUCKETS_PER_S
"""Duration of a bucket, in ns."""
_END_NS = round(END_WINDOW_S * NS_PER_S)
"""Duration of the end of a run, the last second, in ns."""


class LinkAge(msgspec.Struct, frozen=True):
    """Age of the samples in use on one link.

    The age is the time since the tick in which the sample was sent. Ticks before the first
    sample are not counted.

    Attributes:
        mean_ms: Mean age, in ms. `None` if the link never delivered a sample.
        max_ms: Largest age, in ms. `None` if the link never delivered a sample.
    """

    mean_ms: float | None
    max_ms: float | None


class SiteStats:
    """Running statistics of one site, updated batch by batch.

    The metrics of a run are computed from the statistics of all sites, so records need not be
    kept. Below, e is the error of the site against its reference, and |e| its magnitude.

    Args:
        scenario: Scenario of the run.
        site: Name of the site to evaluate.

    Attributes:
        windows: Statistics within each window of [expect]. `None` for windows of other sites.
        records: Number of records.
        peak_error_rad: Largest |e| of any joint, in rad.
        peak_torque_nm: Largest absolute control torque of any joint, in N m.
        peak_speed_rad_s: Largest absolute velocity of any joint, in rad/s.
        unsynchronised_ns: Time of the last record in which |e| was not below the limit
            `synchronised_rad` of [expect], in ns. -1 if there is no such record yet.
        age_max_ms: Largest age of each peer's sample in use, shape (P,), in ms.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        peer_rates = []
        for peer in scenario.peers(site):
            peer_spec = scenario.sites[peer]
            peer_rates.append(peer_spec.rate_hz)
        peer_count = len(peer_rates)
        self._peer_rates = np.array(peer_rates, dtype=np.int64)

        expect = scenario.expect
        self._synchronised_rad = expect.synchronised_rad
        self.windows: list[WindowStats | None] = []
        for window in expect.windows:
            applies = window.site in ("", site)
            stats: WindowStats | None = None
            if applies:
                stats = WindowStats(window.from_s, window.to_s, scenario, site)
            self.windows.append(stats)

        self.records = 0
        self.peak_error_rad = 0.0
        self.peak_torque_nm = 0.0
        self.peak_speed_rad_s = 0.0
        self.unsynchronised_ns = -1

        self.age_max_ms = np.zeros(peer_count)
        self._age_sum_ms = np.zeros(peer_count)
        self._age_records = np.zeros(peer_count, dtype=np.int64)

        self._squares = np.zeros(1)
        self._buckets = NO_BUCKETS
        self._tail: list[RecordBatch] = []

    def add(self, rows: RecordBatch) -> None:
        """Updates the errors, torques, sample ages and other statistics with further records.

        Args:
            rows: The next records of the arm. They must follow those of the previous call.
        """
        if not len(rows.t_ns):
            return

        error = np.abs(rows.e)
        largest_error = error.max(axis=1)
        torque_nm = np.abs(rows.tau)
        speed_rad_s = np.abs(rows.qd)
        batch_error_rad = float(largest_error.max())
        batch_torque_nm = float(torque_nm.max())
        batch_speed_rad_s = float(speed_rad_s.max())
        squares = error * error

        self.records += len(largest_error)
        self.peak_error_rad = max(self.peak_error_rad, batch_error_rad)
        self.peak_torque_nm = max(self.peak_torque_nm, batch_torque_nm)
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, batch_speed_rad_s)
        self._squares = self._squares + squares.sum(axis=0)

        unsynchronised = np.flatnonzero(largest_error >= self._synchronised_rad)
        if len(unsynchronised):
            last = unsynchronised[-1]
            self.unsynchronised_ns = int(rows.t_ns[last])

        self._add_ages(rows)
        self._buckets = rows.reduce(self._buckets)
        for window in filter(None, self.windows):
            window.add(rows)

        # Only the last second is kept: a batch is dropped once the next batch covers this
        # second.
        self._tail.append(rows)
        last_second_ns = rows.t_ns[-1] - _END_NS
        while len(self._tail) > 1 and self._tail[1].t_ns[0] < last_second_ns:
            del self._tail[0]

    def _add_ages(self, rows: RecordBatch) -> None:
        """Updates the statistics of the ages of the samples in use.

        The age of a sample is the time since its peer sent it. Records from before a peer's
        first sample are not counted.

        Args:
            rows: The next records of the arm.
        """
        is_known = rows.used >= 0
        sent_ns = rows.used * NS_PER_S // self._peer_rates
        age_ns = rows.t_ns[:, None] - sent_ns
        age_ms = age_ns * 1e-6
        age_ms[~is_known] = 0.0
        batch_max_ms = age_ms.max(axis=0)
        self.age_max_ms = np.maximum(self.age_max_ms, batch_max_ms)
        self._age_sum_ms += age_ms.sum(axis=0)
        self._age_records += is_known.sum(axis=0)

    @property
    def last_ns(self) -> int:
        """Nominal time of the last record, in ns since the epoch. -1 if there is none yet."""
        if not self._tail:
            return -1
        last_batch = self._tail[-1]
        return int(last_batch.t_ns[-1])

    @property
    def rms_error_rad(self) -> float:
        """Root mean square of the error e of the worst joint over all records, in rad."""
        records = max(1, self.records)
        mean_square = self._squares.max() / records
        return float(np.sqrt(mean_square))

    @property
    def link_ages(self) -> list[LinkAge]:
        """Ages of the samples in use, with one entry per peer in the order of the peers."""
        sums_ms = self._age_sum_ms.tolist()
        record_counts = self._age_records.tolist()
        largest_ms = self.age_max_ms.tolist()
        ages = []
        statistics = zip(sums_ms, record_counts, largest_ms, strict=True)
        for sum_ms, count, most_ms in statistics:
            if count:
                age = LinkAge(mean_ms=sum_ms / count, max_ms=most_ms)
            else:
                age = LinkAge(mean_ms=None, max_ms=None)
            ages.append(age)
        return ages

    def end(self, end_ns: int) -> RecordBatch:
        """Returns the records of the last second of the run, for the metrics `end_...`.

        Args:
            end_ns: Time of the run's last record, in ns. Fewer records are returned if the
                records of this arm end earlier than those of others.
        """
        rows = RecordBatch.join(self._tail)
        start_ns = end_ns - _END_NS
        return rows.since(start_ns)

    @property
    def buckets(self) -> Array:
        """Summary of the arm's motion, used to judge the end of the run.

        Each row contains the extreme values of a short time interval, see `RecordBatch.reduce`.
        """
        last_bucket = self.last_ns // _BUCKET_NS
        return self._buckets[: last_bucket + 1]

    @property
    def tau_x(self) -> Array:
        """Torque of the operator and the environment in the last record, in N m, shape (n,).

        It shows whether an operator still acts on the arm when the run ends. Before the first
        record, the array is a single zero.
        """
        if not self._tail:
            return np.zeros(1)
        last_batch = self._tail[-1]
        last_tau_x: Array = last_batch.tau_x[-1]
        return last_tau_x

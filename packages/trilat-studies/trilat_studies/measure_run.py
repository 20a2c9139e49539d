"""Measures a run, for example its largest error, and checks the result against expectations.

A scenario may contain a table [expect] with limits on its runs. For example,
`peak_error_max_rad` limits the largest error. This module computes the metrics that the table
can limit, from a simulation or from a log.

Invariant:
    - Each metric has one definition. Simulations and logs pass their records in batches, in
      chronological order, to the same running statistics (`SiteStats`).
    - A metric that cannot be computed for a run is `None`, never a guess.
    - Memory use is bounded, however long the run is. Only extrema, sums, the last second of
      records, and a summary of the motion are kept.
    - How a run is divided into batches affects only the last bits of a mean.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from trilat_net import process
from trilat_net.analysis import (
    NO_BUCKETS,
    LogMetrics,
    Metric,
    RunEnd,
    Stability,
    VirtualWall,
    build_arm_rows,
)
from trilat_net.core import BUCKETS_PER_S, Array, Site, compute_fingerprint
from trilat_net.errors import ScenarioError
from trilat_net.execution import (
    FusedRun,
    SimulatedLog,
    execute_virtual,
    find_absent_samples,
)
from trilat_net.fields import split_unit
from trilat_net.log import Ints, Log, collect_provenance, compute_task_errors
from trilat_net.records import NS_PER_S, Mode, TickRecord
from trilat_net.scenario import (
    ALL_SITES_QUANTITIES,
    END_WINDOW_S,
    Expect,
    Scenario,
)

BATCH_RECORDS = 1000
"""Number of records per batch of a site."""
_VECTORS = ("q", "qd", "q_des", "tau", "tau_x", "x")
"""Vectors of a record that `_build_batch` takes, in the order of its arguments."""


class RecordBatch(NamedTuple):
    """Records of consecutive ticks of one arm, with one array per quantity.

    Metrics are computed from batches because statistics over arrays are much faster than over
    individual records. In the shapes below, K is the number of records, n the number of joints,
    m the number of coordinates that the sites agree on, and P the number of peers.

    Attributes:
        t_ns: Nominal times, shape (K,), in ns.
        q: Joint angles, shape (K, n), in rad.
        qd: Joint velocities, shape (K, n), in rad/s.
        e: Error against the reference, Eq. (9), shape (K, m), in rad, or in the units of the
            task space.
        tau: Control torque, shape (K, n), in N m.
        tau_x: Exogenous torque with the sign of Eq. (8), shape (K, n), in N m.
        used: Tick in which each peer sent the sample in use, shape (K, P). -1 before the first
            sample.
    """

    t_ns: Ints
    q: Array
    qd: Array
    e: Array
    tau: Array
    tau_x: Array
    used: Ints

    def since(self, t_ns: int) -> "RecordBatch":
        """Returns the records after a given time, which is itself excluded.

        Args:
            t_ns: The time, in ns.
        """
        first = int(np.searchsorted(self.t_ns, t_ns, side="right"))
        return self.slice(first, None)

    def between(self, from_ns: int, to_ns: int) -> "RecordBatch":
        """Returns the records within a time interval.

        Args:
            from_ns: Start of the interval, in ns, inclusive.
            to_ns: End of the interval, in ns, exclusive.
        """
        first = int(np.searchsorted(self.t_ns, from_ns))
        stop = int(np.searchsorted(self.t_ns, to_ns))
        return self.slice(first, stop)

    def reduce(self, into: Array = NO_BUCKETS) -> Array:
        """Adds these records to a compact summary, which is used to judge the end of the run.

        The summary divides the time axis into buckets and stores only a few extreme values for
        each, so a long run can be judged without keeping all of its records.

        Args:
            into: Summary of all earlier records, which may be modified in place. By default
                there are no earlier records.

        Returns:
            The updated summary, see `RunEnd.reduce_records`.
        """
        bucket = self.t_ns * BUCKETS_PER_S // NS_PER_S
        return RunEnd.reduce_records(
            bucket=bucket,
            e=self.e,
            qd=self.qd,
            q=self.q,
            into=into,
        )

    def slice(self, first: int, stop: int | None) -> "RecordBatch":
        """Returns the records with indices from `first` up to, but not including, `stop`.

        Args:
            first: First index.
            stop: End of the range. If `None`, all remaining records are returned.
        """
        columns = [column[first:stop] for column in self]
        return RecordBatch._make(columns)

    @classmethod
    def join(cls, batches: "Sequence[RecordBatch]") -> "RecordBatch":
        """Concatenates consecutive batches of one arm into a single batch.

        Args:
            batches: Batches in chronological order, at least one.
        """
        columns = []
        for parts in zip(*batches, strict=True):
            column = np.concatenate(parts)
            columns.append(column)
        return RecordBatch._make(columns)


def _build_batch(axes: Sequence[float], t_ns: Ints, used: Ints, *vectors: Array) -> RecordBatch:
    """Builds a batch and computes the error e against the reference of the site.

    In task space, the error is the difference between the pose of the end effector and its
    reference. Otherwise it is the difference between the joint angles and their reference.

    Args:
        axes: For each task coordinate, 1 if the site follows its peers along it, 0 otherwise.
        t_ns: Nominal times, shape (K,), in ns.
        used: Samples in use, shape (K, P), as in `RecordBatch`.
        vectors: The arrays q, qd, q_des, tau, tau_x and x, each of shape (K, ...). The pose x
            of the end effector is empty if the sites agree on joint angles.
    """
    q, qd, q_des, tau, tau_x, x = vectors
    in_task_space = x.size > 0
    e = compute_task_errors(x, q_des, axes) if in_task_space else q - q_des
    return RecordBatch(
        t_ns=t_ns,
        q=q,
        qd=qd,
        e=e,
        tau=tau,
        tau_x=tau_x,
        used=used,
    )


def run_in_batches(
    scenario: Scenario, receivers: Mapping[str, Callable[[RecordBatch], None]]
) -> tuple[float | None, int]:
    """Runs a scenario in virtual time and passes its records to the receivers in batches.

    Since records are not kept, long runs need little memory.

    Args:
        scenario: Scenario to run.
        receivers: For each site, the function that receives its batches.

    Returns:
        The time at which the first site left the limits of its arm, in s, or `None` if none
        did; and the number of samples that arrived too late to be used as planned.
    """
    pending: dict[str, list[TickRecord]] = {name: [] for name in receivers}
    sites: dict[str, Site] = {}
    diverged_at_s: float | None = None

    def flush(name: str) -> None:
        """Passes the collected records of a site on as arrays and clears the collection.

        Does nothing if no records were collected.

        Args:
            name: Name of the site.
        """
        records = pending[name]
        if not records:
            return

        times_ns = [record.t_ns for record in records]
        samples_in_use = [record.used for record in records]
        t_ns = np.array(times_ns, dtype=np.int64)
        used = np.array(samples_in_use, dtype=np.int64)
        vectors = []
        for key in _VECTORS:
            rows = [getattr(record, key) for record in records]
            vectors.append(np.array(rows))

        axes = scenario.arms[name].axes
        batch = _build_batch(axes, t_ns, used, *vectors)
        receive = receivers[name]
        receive(batch)
        records.clear()

    with process.pause_gc():
        for site, _, output in execute_virtual(scenario):
            sites[site.name] = site
            site_records = pending[site.name]
            site_records.append(output)
            if len(site_records) == BATCH_RECORDS:
                flush(site.name)
            has_diverged = output.mode is Mode.DIVERGED
            if has_diverged and diverged_at_s is None:
                diverged_at_s = output.t_ns / NS_PER_S
    for name in pending:
        flush(name)

    late_samples = 0
    for site in sites.values():
        for count in site.counts():
            late_samples += count.late
    return diverged_at_s, late_samples


def run_compiled_in_batches(
    scenario: Scenario, receivers: Mapping[str, Callable[[RecordBatch], None]]
) -> FusedRun:
    """Runs a scenario in the compiled loop and passes its records to the receivers in batches.

    The compiled loop runs the controllers of all sites without returning to Python, which makes
    it much faster than `run_in_batches`.

    Args:
        scenario: Scenario to run.
        receivers: For each site, the function that receives its batches.

    Returns:
        The finished run, with its final state and the time at which a site left its limits.
    """
    compiled = _CompiledRun(scenario, receivers)
    compiled.finish()
    return compiled.run


class _CompiledRun:
    """A run in the compiled loop that passes on its records in batches.

    Args:
        scenario: Scenario to run.
        receivers: For each site, the function that receives its batches.

    Attributes:
        run: The run.
    """

    def __init__(
        self, scenario: Scenario, receivers: Mapping[str, Callable[[RecordBatch], None]]
    ) -> None:
        self.run = FusedRun(scenario, keep=BATCH_RECORDS + 1)
        self._scenario = scenario
        self._receivers = receivers
        self._columns = {name: scenario.layout(name).columns() for name in scenario.names}
        self._axes = {name: arm.axes for name, arm in scenario.arms.items()}

    def finish(self) -> None:
        """Simulates the run to its end and passes on its records."""
        for batch in self.run.iterate_batches():
            self.pass_records(batch)

    def pass_records(self, batch: Sequence[tuple[Ints, Array]]) -> None:
        """Passes the records of each site to its receiver.

        Args:
            batch: The latest records of each site, see `FusedRun.pop_records`.
        """
        no_columns = slice(0, 0)  # for vectors that the site does not have
        pairs = zip(self._scenario.names, batch, strict=True)
        for i, (name, site_records) in enumerate(pairs):
            t_ns, rows = site_records
            if not len(t_ns):
                continue
            columns = self._columns[name]
            vectors = []
            for key in _VECTORS:
                vector_columns = columns.get(key, no_columns)
                vectors.append(rows[:, vector_columns])
            used = self.run.read_samples_in_use(i, len(t_ns))
            receive = self._receivers[name]
            receive(_build_batch(self._axes[name], t_ns, used, *vectors))


class WholeRun(NamedTuple):
    """A simulated run with all of its records in memory.

    Attributes:
        records: Records of each site, by its name.
        end: Analysis of the end of the run, for example whether the arms came to rest.
        run: The simulation, which contains the final state.
    """

    records: dict[str, RecordBatch]
    end: RunEnd
    run: FusedRun

    @classmethod
    def simulate(cls, scenario: Scenario) -> "WholeRun":
        """Simulates a scenario in the compiled loop and keeps all records in memory.

        This is needed for quantities such as an impedance, which cannot be computed in batches.

        Args:
            scenario: Scenario to run.
        """
        batches: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
        receivers = {name: batches[name].append for name in batches}
        run = run_compiled_in_batches(scenario, receivers)
        return _join_run(scenario, run, batches)

    @classmethod
    def simulate_together(
        cls,
        scenarios: Sequence[Scenario],
    ) -> "Iterator[tuple[int, WholeRun, str]]":
        """Simulates several scenarios, as many at once as possible, and keeps their records.

        Scenarios that have the same structure and differ only in numerical parameters are
        computed together with vector instructions. Each run is identical to that of `simulate`,
        bit for bit.

        Args:
            scenarios: The scenarios.

        Yields:
            The index of a scenario, its run, and the reason why it was computed alone (an empty
            string if it was not). Runs are ordered by group, and only one group is in memory at
            a time.
        """
        batches: list[dict[str, list[RecordBatch]]] = []
        compiled = []
        for scenario in scenarios:
            batches.append({name: [] for name in scenario.names})
            receivers = {name: records.append for name, records in batches[-1].items()}
            compiled.append(_CompiledRun(scenario, receivers))
        for index, obstacle in _finish_together(compiled):
            yield (
                index,
                _join_run(scenarios[index], compiled[index].run, batches[index]),
                obstacle,
            )
            batches[index].clear()


_RECORD_ROWS = 1 << BATCH_RECORDS.bit_length()
"""Number of records kept by runs side by side, a power of two above `BATCH_RECORDS`."""


def _finish_together(compiled: Sequence[_CompiledRun]) -> Iterator[tuple[int, str]]:
    """Simulates several runs to their ends, as many at once as possible.

    Args:
        compiled: The runs.

    Yields:
        The index of a finished run, and the reason why it was computed alone (an empty string
        if it was not).
    """
    # A single run must not load the code of lanes.
    from trilat_net.core import RunGroup

    for group in RunGroup.divide([member.run for member in compiled], _RECORD_ROWS):
        members = [compiled[index] for index in group.members]
        while running := [member for member in members if not member.run.is_finished]:
            # Runs of a group have the same duration, and advance together.
            group.advance_to(running[0].run.find_batch_end())
            for member in running:
                member.pass_records(member.run.pop_records())
        for index in group.members:
            yield index, group.obstacle


def _join_run(
    scenario: Scenario, run: FusedRun, batches: Mapping[str, Sequence[RecordBatch]]
) -> WholeRun:
    """Joins the batches of records of a finished run and judges how the run ends.

    Args:
        scenario: Its scenario.
        run: The run.
        batches: Batches of records of each site.
    """
    records = {}
    buckets = []
    last_tau_x = []
    for name, site_batches in batches.items():
        site_records = RecordBatch.join(site_batches)
        records[name] = site_records
        buckets.append(site_records.reduce())
        last_tau_x.append(site_records.tau_x[-1])
    end = RunEnd.of_reduced_records(scenario, buckets, last_tau_x, run.diverged_s)
    return WholeRun(records, end, run)


class Range(NamedTuple):
    """Smallest and largest value of a quantity in part of a run, for comparison with limits.

    For a single-valued quantity, such as a mean, both ends are the same.
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

        Joint angles have distinct extremes. All other quantities, such as a mean or a peak,
        have a single value, which is used as both ends of the range.

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
        """Root mean square of the error e over all records, in rad, of the worst joint."""
        records = max(1, self.records)
        mean_square = self._squares.max() / records
        return float(np.sqrt(mean_square))

    @property
    def link_ages(self) -> list["LinkAge"]:
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
        """Torque of operator and environment in the last record, in N m, shape (n,).

        It shows whether an operator still acts on the arm when the run ends. Before the first
        record, the array is a single zero.
        """
        if not self._tail:
            return np.zeros(1)
        last_batch = self._tail[-1]
        last_tau_x: Array = last_batch.tau_x[-1]
        return last_tau_x


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


class RunMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """Metrics of one run, for comparison with the expectations of its scenario.

    The docstring of `Expect` defines each metric. A metric is `None` if it cannot be computed
    because the run is too short or an event did not happen. The metrics `end_...` describe the
    last second of the run. A link "j->i" leads from site j to site i.

    Attributes:
        simulated_s: Duration of the run in its own time, in s.
        end: Analysis of the end of the run, for example whether the arms came to rest.
        ages: Ages of the samples in use, by link "j->i".
        late_samples: Number of samples that arrived after the time at which they were due.
        missing: Number of ticks without a record, over all sites.
        windows: Ranges of the quantities within each window, a part of the run with limits of
            its own. Empty for a window that ends after the run.
        metrics: Those metrics of `docs/reference/metrics.md` for which the scenario states a
            limit.
    """

    simulated_s: float
    end: RunEnd
    synchronised_at_s: float | None
    peak_error_rad: float | None
    rms_error_rad: float | None
    end_error_rad: float | None
    end_spread_rad: float | None
    end_pose_rad: dict[str, tuple[float, ...]]
    peak_torque_nm: float | None
    peak_speed_rad_s: float | None
    ages: dict[str, LinkAge]
    late_samples: int
    missing: int
    windows: tuple[dict[str, Range], ...] = ()
    metrics: dict[str, Metric] = {}

    @classmethod
    def of_virtual_run(cls, scenario: Scenario) -> "RunMetrics":
        """Runs a scenario in virtual time and measures the run.

        Records are discarded as soon as they have been added to the statistics, so long runs
        need little memory. The exception is a scenario that limits a metric of
        `docs/reference/metrics.md`, since these metrics require a complete log.

        Args:
            scenario: Scenario to run.
        """
        if scenario.expect.metrics:
            return RunMetrics.of_log(SimulatedLog(scenario))
        measured = _MeasuredRun(scenario)
        if measured.compiled is None:
            return measured.measure_ticks()
        measured.compiled.finish()
        return measured.measure_compiled(measured.compiled.run)

    @classmethod
    def of_virtual_runs(
        cls,
        scenarios: Sequence[Scenario],
    ) -> "Iterator[tuple[int, RunMetrics, str]]":
        """Runs and measures several scenarios in virtual time, as many at once as possible.

        Scenarios that have the same structure and differ only in numerical parameters are
        computed together with vector instructions. The metrics are identical to those of
        `of_virtual_run`, bit for bit.

        Args:
            scenarios: The scenarios.

        Yields:
            The index of a scenario, the metrics of its run, and the reason why it was computed
            alone (an empty string if it was not).
        """
        indices = []
        measured_runs = []
        compiled_runs = []
        for index, scenario in enumerate(scenarios):
            measured = None if scenario.expect.metrics else _MeasuredRun(scenario)
            if measured is None:
                yield index, RunMetrics.of_virtual_run(scenario), NEEDS_LOG
            elif measured.compiled is None:
                yield index, measured.measure_ticks(), measured.obstacle
            else:
                indices.append(index)
                measured_runs.append(measured)
                compiled_runs.append(measured.compiled)
        for position, obstacle in _finish_together(compiled_runs):
            run = compiled_runs[position].run
            yield indices[position], measured_runs[position].measure_compiled(run), obstacle

    @classmethod
    def of_log(cls, log: Log, expect: Expect | None = None) -> "RunMetrics":
        """Measures a recorded run from its log.

        Args:
            log: Log of the run.
            expect: Expectations to use in place of those in the log's scenario. If `None`, the
                scenario's expectations are used.

        Raises:
            LogError: A record cannot be read.
        """
        scenario = log.scenario
        if expect is not None:
            scenario = msgspec.structs.replace(scenario, expect=expect)
        ticks_at_end = {}
        for event in log.events:
            if event.kind == "end":
                ticks_at_end[event.member] = event.ticks
        diverged_at_s = log.diverged_s
        site_stats = {name: SiteStats(scenario, name) for name in log.sites}
        missing = 0
        for name, stats in site_stats.items():
            site_log = log[name]
            used_by_peer = [site_log.used[peer] for peer in site_log.peers]
            batch = RecordBatch(
                t_ns=site_log.t_ns,
                q=site_log.q,
                qd=site_log.qd,
                e=site_log.e,
                tau=site_log.tau,
                tau_x=site_log.tau_x,
                used=np.array(used_by_peer).T,
            )
            stats.add(batch)
            expected = scenario.ticks(name)
            if diverged_at_s is not None:
                # A run that diverged ends early, at the tick that its sites announced.
                expected = ticks_at_end.get(name, 0)
            missing += max(0, expected - len(site_log))

        late_samples = 0
        for sample in find_absent_samples(log):
            if sample.arrived_tick is not None:
                late_samples += 1
        metrics = _compute_run_metrics(
            scenario,
            site_stats,
            diverged_at_s=diverged_at_s,
            late_samples=late_samples,
            missing=missing,
        )
        expected_metrics = LogMetrics.measure_run(log, scenario.expect.metrics)
        return msgspec.structs.replace(metrics, metrics=expected_metrics)

    def compare_with(self, expect: Expect) -> "list[ExpectationResult]":
        """Compares the metrics of the run with the expectations of its scenario.

        If the run diverged (an arm left its limits), the expectation `stable` is always
        reported, even if the scenario does not state it.

        Args:
            expect: Expectations of the scenario, for example the largest permitted error.

        Returns:
            For each expectation, whether the run met it, and the measured value. The results
            are in the order of the attributes of `Expect`.
        """
        outcomes = list(_evaluate_stability(expect, self))
        for key in _LIMITS:
            limit = getattr(expect, key)
            if limit is not None:
                measured = _read_metric(key, self)
                outcomes.append(_compare_with_limit(key, measured, limit))

        outcomes += _evaluate_poses(expect, self)
        if expect.no_gaps:
            gaps = ExpectationResult(
                key="no_gaps",
                held=self.missing == 0,
                measured=f"{self.missing} missing",
                limit="0 missing",
            )
            outcomes.append(gaps)
        outcomes += _evaluate_windows(expect, self)
        outcomes += _evaluate_metrics(expect, self)
        return outcomes


def _compute_run_metrics(
    scenario: Scenario,
    site_stats: Mapping[str, SiteStats],
    *,
    diverged_at_s: float | None,
    late_samples: int,
    missing: int,
) -> RunMetrics:
    """Computes the metrics of a complete run from the statistics of its sites.

    Args:
        scenario: Scenario of the run.
        site_stats: Statistics of each site, in the order of the scenario.
        diverged_at_s: Time at which the first site left the limits of its arm, in s. `None` if
            no site did.
        late_samples: Number of samples that arrived too late.
        missing: Number of ticks without a record.

    Returns:
        The metrics of the run. A metric that cannot be computed is `None`.
    """
    with_records = {}
    buckets = []
    last_tau_x = []
    for name, stats in site_stats.items():
        if stats.records:
            with_records[name] = stats
        buckets.append(stats.buckets)
        last_tau_x.append(stats.tau_x)
    all_ran = len(with_records) == len(site_stats)

    synchronised_at_s = None
    if all_ran:
        all_stats = list(with_records.values())
        synchronised_at_s = _find_synchronisation_s(all_stats)
    last_times_ns = [stats.last_ns for stats in with_records.values()]
    end_ns = max(last_times_ns, default=0)
    durations_s = []
    ends = []
    end_errors_rad = []
    for name, stats in with_records.items():
        # The run lasts until the end of the period after the last tick.
        period_s = 1.0 / scenario.sites[name].rate_hz
        durations_s.append(stats.last_ns / NS_PER_S + period_s)
        end = stats.end(end_ns)
        ends.append(end)
        end_error_rad = np.abs(end.e).max(initial=0.0)
        end_errors_rad.append(float(end_error_rad))
    windows_by_site = [stats.windows for stats in site_stats.values()]
    sites_by_window = zip(*windows_by_site, strict=True)

    def find_largest(name: str) -> float | None:
        """Returns the largest value of a statistic, such as the peak torque, over all arms.

        Args:
            name: Name of the statistic, an attribute of `SiteStats`.

        Returns:
            The largest value, or `None` if no site has recorded anything.
        """
        values = [getattr(stats, name) for stats in with_records.values()]
        return max(values, default=None)

    return RunMetrics(
        simulated_s=max(durations_s, default=0.0),
        end=RunEnd.of_reduced_records(scenario, buckets, last_tau_x, diverged_at_s),
        synchronised_at_s=synchronised_at_s,
        peak_error_rad=find_largest("peak_error_rad"),
        rms_error_rad=find_largest("rms_error_rad"),
        end_error_rad=max(end_errors_rad, default=None),
        end_spread_rad=_compute_end_spread_rad(ends) if all_ran else None,
        end_pose_rad=_list_end_poses(with_records),
        peak_torque_nm=find_largest("peak_torque_nm"),
        peak_speed_rad_s=find_largest("peak_speed_rad_s"),
        ages=_list_link_ages(scenario, site_stats),
        late_samples=late_samples,
        missing=missing,
        windows=tuple(map(_merge_windows, sites_by_window)),
    )


def _list_end_poses(site_stats: Mapping[str, SiteStats]) -> dict[str, tuple[float, ...]]:
    """Returns the last joint angles of each arm, in rad, by site name.

    Args:
        site_stats: Statistics of the sites, each of which has records.
    """
    poses_rad = {}
    for name, stats in site_stats.items():
        last_second = stats.end(stats.last_ns)
        last_pose_rad = last_second.q[-1]
        poses_rad[name] = tuple(last_pose_rad.tolist())
    return poses_rad


def _list_link_ages(
    scenario: Scenario, site_stats: Mapping[str, SiteStats]
) -> dict[str, LinkAge]:
    """Returns the ages of the samples in use on each link, by link name.

    Args:
        scenario: Scenario of the run.
        site_stats: Statistics of each site.
    """
    ages = {}
    for name, stats in site_stats.items():
        peers = scenario.peers(name)
        for peer, age in zip(peers, stats.link_ages, strict=True):
            ages[f"{peer}->{name}"] = age
    return ages


def _find_synchronisation_s(site_stats: Sequence[SiteStats]) -> float | None:
    """Returns the time from which all sites stay synchronised until the end, in s.

    A site is synchronised while its error |e| is below the limit in [expect].

    Args:
        site_stats: Statistics of all sites, each of which has records.

    Returns:
        The time, or `None` if a site is not synchronised in its last record.
    """
    if any(stats.unsynchronised_ns == stats.last_ns for stats in site_stats):
        return None
    last_ns = max(stats.unsynchronised_ns for stats in site_stats)
    return max(0, last_ns) / NS_PER_S


def _merge_windows(windows: Sequence[WindowStats | None]) -> dict[str, Range]:
    """Combines the statistics of a window over all sites to which the window applies.

    If this is a single site, its ranges are returned. Otherwise only quantities that can be
    compared between sites are kept, each with its largest value.

    Args:
        windows: Statistics of each site within the window. `None` for a site to which the
            window does not apply.

    Returns:
        Ranges, by the keys of a window of [expect].
    """
    site_ranges = []
    for window in windows:
        if window is not None:
            ranges = window.compute_ranges()
            site_ranges.append(ranges)
    if len(site_ranges) == 1:
        return site_ranges[0]
    merged = {}
    for key in ALL_SITES_QUANTITIES:
        if all(key in ranges for ranges in site_ranges):
            key_ranges = [ranges[key] for ranges in site_ranges]
            least = max(key_range.least for key_range in key_ranges)
            most = max(key_range.most for key_range in key_ranges)
            merged[key] = Range(least, most)
    return merged


def _compute_end_spread_rad(ends: Sequence[RecordBatch]) -> float | None:
    """Returns the largest difference of a joint angle between sites in the last second, in rad.

    Since tick rates may differ between sites, each record of the first site is compared with
    the latest record of every other site at that time.

    Args:
        ends: Records of the last second, one batch per site.

    Returns:
        The difference, or `None` if a site has no records in the last second or the arms have
        different numbers of joints.
    """
    if not all(len(end.t_ns) for end in ends):
        return None
    joint_counts = {end.q.shape[1] for end in ends}
    if len(joint_counts) > 1:
        return None

    first_common_ns = max(end.t_ns[0] for end in ends)
    first_site_ns = ends[0].t_ns
    times_ns = first_site_ns[first_site_ns >= first_common_ns]

    poses = []
    for end in ends:
        next_indices = np.searchsorted(end.t_ns, times_ns, side="right")
        latest = next_indices - 1
        poses.append(end.q[latest])

    largest = np.max(poses, axis=0)
    smallest = np.min(poses, axis=0)
    spread: Array = largest - smallest
    return float(spread.max(initial=0.0))


NEEDS_LOG = "metrics that need a log"
"""Reason why a run cannot be computed together with others: its metrics need a complete log."""


class _EvenBatches:
    """Regroups records from batches of any size into batches of `BATCH_RECORDS`.

    The last bits of a mean depend on the batch size, and sites with different tick rates
    produce batches of different lengths.

    Args:
        receive: Called with each batch.
    """

    def __init__(self, receive: Callable[[RecordBatch], None]) -> None:
        self._receive = receive
        self._waiting: list[RecordBatch] = []
        self._count = 0

    def add(self, batch: RecordBatch) -> None:
        """Adds the next records of a site and passes on every batch that is complete."""
        if not self._waiting and len(batch.t_ns) == BATCH_RECORDS:
            self._receive(batch)
            return
        self._waiting.append(batch)
        self._count += len(batch.t_ns)
        if self._count < BATCH_RECORDS:
            return
        joined = RecordBatch.join(self._waiting)
        whole = self._count - self._count % BATCH_RECORDS
        for first in range(0, whole, BATCH_RECORDS):
            self._receive(joined.slice(first, first + BATCH_RECORDS))
        rest = joined.slice(whole, None)
        self._count = len(rest.t_ns)
        self._waiting = [rest] if self._count else []

    def flush(self) -> None:
        """Passes on the remaining records, which do not fill a batch."""
        if self._waiting:
            self._receive(RecordBatch.join(self._waiting))
            self._waiting.clear()


class _MeasuredRun:
    """A run whose metrics are computed while it is simulated.

    Args:
        scenario: Scenario to run.

    Attributes:
        compiled: The run in the compiled loop. `None` if the loop cannot simulate it.
        obstacle: Reason why the compiled loop cannot simulate the run. Empty if it can.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._stats = {name: SiteStats(scenario, name) for name in scenario.names}
        self._batches = {name: _EvenBatches(stats.add) for name, stats in self._stats.items()}
        receivers = {name: batches.add for name, batches in self._batches.items()}
        self.obstacle = ""
        self.compiled: _CompiledRun | None = None
        scenario.refuse_external_arms()
        try:
            FusedRun.check_scenario(scenario)
        except ScenarioError:
            self.obstacle = "tick rates that differ too much"
        else:
            self.compiled = _CompiledRun(scenario, receivers)

    def measure_ticks(self) -> RunMetrics:
        """Simulates the run tick by tick and returns its metrics."""
        receivers = {name: stats.add for name, stats in self._stats.items()}
        diverged_at_s, late_samples = run_in_batches(self._scenario, receivers)
        return self._measure(diverged_at_s, late_samples)

    def measure_compiled(self, run: FusedRun) -> RunMetrics:
        """Returns the metrics of a run that the compiled loop has finished.

        Args:
            run: The run.
        """
        for batches in self._batches.values():
            batches.flush()
        late_samples = int(run.memory.tables.links["late"].sum())
        return self._measure(run.diverged_s, late_samples)

    def _measure(self, diverged_at_s: float | None, late_samples: int) -> RunMetrics:
        """Returns the metrics of the run.

        Args:
            diverged_at_s: Time at which the first site left the limits of its arm, in s.
            late_samples: Number of samples that arrived too late.
        """
        scenario = self._scenario
        missing = 0
        if diverged_at_s is None:
            expected = sum(scenario.ticks(name) for name in scenario.names)
            recorded = sum(stats.records for stats in self._stats.values())
            missing = expected - recorded
        return _compute_run_metrics(
            scenario,
            self._stats,
            diverged_at_s=diverged_at_s,
            late_samples=late_samples,
            missing=missing,
        )


class ExpectationResult(msgspec.Struct, frozen=True):
    """Result of comparing one metric of a run with its limit in the table [expect].

    Attributes:
        key: Key in the table [expect], or the name of a requirement that every run must meet.
        held: True if the run met the expectation.
        measured: Measured value as a string with its unit.
        limit: Limit as a string with its unit.
        margin: Distance of the measured value from the limit as a fraction of the limit,
            negative beyond the limit. `None` if the expectation is not numerical.
        value: Measured value in the unit of the limit. `None` if the expectation is not
            numerical.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields whether the run is as stable as the scenario's key `stable` requires.

    A run that diverged is also reported if the scenario does not state the key. Since a single
    run cannot prove stability, "settled" is the best possible verdict and counts as stable.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    expects_stable = expect.stable is not False
    end = metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        # A single run proves nothing: "settled" is the best judgement of its end.
        expected = Stability.SETTLED if expects_stable else Stability.NOT_STABLE
        measured = f"{end.stability}: {end.text}"
        limit = str(expects_stable).lower()
        held = end.stability is expected
        yield ExpectationResult("stable", held, measured, limit)


_LIMITS = tuple(key for key in Expect.__struct_fields__ if re.search("_(max|min|by)(_|$)", key))
"""Keys of [expect] that are a smallest or largest value of a metric."""


def _read_metric(key: str, metrics: RunMetrics) -> float | None:
    """Returns the metric that a key of [expect] limits.

    The key contains the name of the metric: "peak_error_max_rad" limits `peak_error_rad`, and
    "synchronised_by_s" limits `synchronised_at_s`. Keys in ms limit the sample ages on the
    worst link.

    Returns:
        The metric, or `None` if the run does not have it or a link never delivered a sample.
    """
    is_age = key.endswith("_ms")
    if not is_age:
        without_bound = re.sub("_(max|min)", "", key)
        name = without_bound.replace("_by_", "_at_")
        value: float | None = getattr(metrics, name)
        return value

    is_mean = key.startswith("mean")
    ages_ms = []
    for age in metrics.ages.values():
        age_ms = age.mean_ms if is_mean else age.max_ms
        if age_ms is None:
            return None
        ages_ms.append(age_ms)
    if not ages_ms:
        return None
    return min(ages_ms) if "_min_" in key else max(ages_ms)


def _compare_with_limit(key: str, measured: float | None, limit: float) -> ExpectationResult:
    """Compares a metric with the smallest or largest value that the scenario permits.

    Args:
        key: Key of [expect]. It contains "_min_" for a smallest value, and ends in the unit.
        measured: The metric. `None` if the run does not have it, which fails the expectation.
        limit: The limit, in the same unit.
    """
    is_minimum = "_min_" in key
    relation = "≥" if is_minimum else "≤"
    _, unit = split_unit(key)
    limit_text = f"{relation} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", limit_text)

    distance = measured - limit if is_minimum else limit - measured
    return ExpectationResult(
        key=key,
        held=distance >= 0.0,
        measured=f"{measured:.4g} {unit}".rstrip(),
        limit=limit_text,
        margin=distance / limit if limit else None,
        value=measured,
    )


def _evaluate_poses(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Compares the final pose of each arm with the pose that the scenario expects.

    Yields:
        One result per site with an expected pose, for the joint with the largest error.
    """
    tolerance_rad = expect.end_pose_within_rad
    for site, expected in expect.end_pose_rad.items():
        key = f"end_pose_rad.{site}"
        expected_angles = ", ".join(f"{angle:g}" for angle in expected)
        limit = f"({expected_angles}) ± {tolerance_rad:g} rad"

        reached = metrics.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(key, False, "never", limit)
            continue
        distances_rad = []
        for angle, expected_angle in zip(reached, expected, strict=True):
            distances_rad.append(abs(angle - expected_angle))
        error_rad = max(distances_rad)
        margin_rad = tolerance_rad - error_rad

        angles = ", ".join(f"{angle:.4f}" for angle in reached)
        yield ExpectationResult(
            key=key,
            held=error_rad <= tolerance_rad,
            measured=f"({angles}) rad",
            limit=limit,
            margin=margin_rad / tolerance_rad,
        )


def _evaluate_windows(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the result for each quantity limited by a window of the table [expect].

    A window is a period of the run, such as 9 s to 15 s, with limits of its own.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    for window, ranges in zip(expect.windows, metrics.windows, strict=True):
        site = f" {window.site}" if window.site else ""
        period = f"{window.from_s:g}-{window.to_s:g} s"
        for key, limits in window.limits:
            name = f"{key}{site} {period}"  # as in "wall_mean_n s 9-15 s"
            _, unit = split_unit(key)
            measured = ranges.get(key)
            yield _compare_with_range(name, measured, limits, unit)


def _evaluate_metrics(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the result for each metric limited by the table [expect], such as "path_m".

    A metric that cannot be computed fails its limit, and the reason is reported in place of a
    value.

    Args:
        expect: Table [expect] of the scenario.
        metrics: Metrics of the run.
    """
    for key, limits in expect.metrics.items():
        value, reason, _ = metrics.metrics[key]
        measured = None if value is None else Range(value, value)
        quantity = LogMetrics.find_quantity(key)
        yield _compare_with_range(
            name=f"metrics.{key}",
            measured=measured,
            limits=limits,
            unit=quantity.unit,
            missing_text=reason,
        )


def _compare_with_range(
    name: str,
    measured: Range | None,
    limits: Sequence[float],
    unit: str,
    missing_text: str = "never",
) -> ExpectationResult:
    """Compares a quantity with the range within which it must stay.

    Args:
        name: Name of the expectation.
        measured: Smallest and largest value of the quantity. `None` if the run does not have
            it, which fails the expectation.
        limits: Lower and upper limit.
        unit: Unit of the quantity.
        missing_text: Text to show in place of a missing value.

    Returns:
        The result. Its margin is relative to half the width of the permitted range.
    """
    least, most = limits
    limit_text = f"{least:g} to {most:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(name, False, missing_text, limit_text)

    distinct_values = dict.fromkeys(measured)  # a single value is printed once
    text = " to ".join(f"{value:.4g}" for value in distinct_values)

    distance_to_lower = measured.least - least
    distance_to_upper = most - measured.most
    distance = min(distance_to_lower, distance_to_upper)
    half_width = 0.5 * (most - least)
    is_single_value = measured.least == measured.most
    return ExpectationResult(
        key=name,
        held=distance >= 0.0,
        measured=f"{text} {unit}".rstrip(),
        limit=limit_text,
        margin=distance / half_width if half_width else None,
        value=measured.most if is_single_value else None,
    )


# Packages that compute the results, by their keys in the provenance of a log.
_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")


def describe_program() -> tuple[str, dict[str, str]]:
    """Returns the properties of this program and machine that can affect numerical results.

    Results of a study are combined only if these properties are the same.

    Returns:
        A fingerprint of how the machine rounds floating-point numbers; and the versions of the
        program and of the packages that compute the results.
    """
    provenance = collect_provenance()
    versions = {name: provenance[name] for name in _VERSIONS}
    return compute_fingerprint(), versions

"""Metrics of a run for the table [expect], and their outcomes.

The run is simulated in virtual time or read from a log.

Invariant:
    - Each metric has one definition: both sources feed the same running statistics of the sites
      with the same records, batch by batch in time order.
    - A metric that a run cannot give is None, and never a guess.
    - Memory is bounded: extrema, sums, the last second, and the buckets for the verdict are
      kept.
    - The division of a run into batches changes only the last bits of a mean.
    - An outcome states value, limit and margin.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from .. import process
from ..analysis.arm_rows import build_arm_rows
from ..analysis.metrics.log_metrics import find_quantity, measure_run
from ..analysis.metrics.measures import Metric
from ..analysis.run_end import (
    NO_BUCKETS,
    RunEnd,
    RunTrace,
    Stability,
    classify_run_end,
    reduce_to_buckets,
)
from ..analysis.torque_sources import list_walls, wall_force
from ..core.site_step import Site
from ..core.ticks import BUCKETS_PER_S, NS_PER_S, Mode, TickRecord
from ..core.vectors import Array
from ..execution import virtual
from ..execution.fused import FusedRun
from ..execution.virtual import simulate_scenario
from ..execution.virtual_comparison import find_absent_samples
from ..fields import field_names, split_unit
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import compute_task_errors
from ..scenario import Expect, Scenario
from ..scenario.expect import ALL_SITES_QUANTITIES, END_WINDOW_S, ExpectWindow

BATCH_RECORDS = 1000
"""Number of records of a site in a batch."""
_VECTORS = ("q", "qd", "q_des", "tau", "tau_x", "x")
"""Fields of a record from which `_build_batch` builds a batch."""


class RecordBatch(NamedTuple):
    """Consecutive records of one site.

    Attributes:
        t_ns: nominal time, shape (K,), ns.
        q: joint angles, shape (K, n), rad.
        qd: joint velocities, shape (K, n), rad/s.
        e: error against the reference, Eq. (9), shape (K, m), rad; m in task space.
        tau: control torque, shape (K, n), N m.
        tau_x: exogenous torque in the sign of Eq. (8), shape (K, n), N m.
        used: tick of each peer's sample in use, -1 before the first, shape (K, P); (K, 0) for a
            compiled run, which does not report samples.
    """

    t_ns: Ints
    q: Array
    qd: Array
    e: Array
    tau: Array
    tau_x: Array
    used: Ints

    def since(self, t_ns: int) -> "RecordBatch":
        """Returns the records after a time, ns."""
        first = np.searchsorted(self.t_ns, t_ns, side="right")
        return self._slice(int(first), None)

    def between(self, from_ns: int, to_ns: int) -> "RecordBatch":
        """Returns the records from `from_ns` until before `to_ns`."""
        first = np.searchsorted(self.t_ns, from_ns)
        stop = np.searchsorted(self.t_ns, to_ns)
        return self._slice(int(first), int(stop))

    def reduce(self, into: Array = NO_BUCKETS) -> Array:
        """Returns the buckets of a verdict with these records, see `reduce_to_buckets`."""
        bucket = self.t_ns * BUCKETS_PER_S // NS_PER_S
        return reduce_to_buckets(bucket=bucket, e=self.e, qd=self.qd, q=self.q, into=into)

    def _slice(self, first: int, stop: int | None) -> "RecordBatch":
        """Returns the records from index `first` until before index `stop`."""
        return RecordBatch._make(column[first:stop] for column in self)


def join_batches(batches: Sequence[RecordBatch]) -> RecordBatch:
    """Returns consecutive batches as one."""
    columns = zip(*batches, strict=True)
    return RecordBatch._make(np.concatenate(parts) for parts in columns)


def _build_batch(axes: Sequence[float], t_ns: Ints, used: Ints, *vectors: Array) -> RecordBatch:
    """Returns a batch with the error against the reference.

    Args:
        axes: which coordinates of the task a site follows.
        t_ns: nominal times, shape (K,), ns.
        used: samples in use, shape (K, P).
        vectors: q, qd, q_des, tau, tau_x and x, shape (K, ...) each.
    """
    q, qd, q_des, tau, tau_x, x = vectors
    e = compute_task_errors(x, q_des, axes) if x.size else q - q_des
    return RecordBatch(t_ns=t_ns, q=q, qd=qd, e=e, tau=tau, tau_x=tau_x, used=used)


def run_in_batches(
    scenario: Scenario, receivers: Mapping[str, Callable[[RecordBatch], None]]
) -> tuple[float | None, int]:
    """Runs a scenario in virtual time and passes the records on, batch by batch.

    Args:
        scenario: the scenario.
        receivers: function that receives the batches of each site.

    Returns:
        The time at which the first site left its limits, s, or None; and the number of late
        samples.
    """
    pending: dict[str, list[TickRecord]] = {name: [] for name in receivers}
    sites: dict[str, Site] = {}
    diverged_at_s: float | None = None

    def flush(name: str) -> None:
        records = pending[name]
        if not records:
            return
        t_ns = np.array([record.t_ns for record in records], dtype=np.int64)
        used = np.array([record.used for record in records], dtype=np.int64)
        vectors = []
        for key in _VECTORS:
            rows = [getattr(record, key) for record in records]
            vectors.append(np.array(rows))
        axes = scenario.arms[name].axes
        receivers[name](_build_batch(axes, t_ns, used, *vectors))
        records.clear()

    with process.pause_gc():
        for site, _, output in virtual.execute_virtual(scenario):
            sites[site.name] = site
            pending[site.name].append(output)
            if len(pending[site.name]) == BATCH_RECORDS:
                flush(site.name)
            if output.mode is Mode.DIVERGED and diverged_at_s is None:
                diverged_at_s = output.t_ns / NS_PER_S
    for name in pending:
        flush(name)
    late_samples = 0
    for site in sites.values():
        late_samples += sum(count.late for count in site.counts())
    return diverged_at_s, late_samples


def run_compiled_in_batches(
    scenario: Scenario, receivers: Mapping[str, Callable[[RecordBatch], None]]
) -> float | None:
    """Runs a scenario in the compiled loop and passes the records on, batch by batch.

    The compiled loop does not report the samples in use.

    Args:
        scenario: the scenario.
        receivers: function that receives the batches of each site.

    Returns:
        The time at which the first site left its limits, s, or None.
    """
    run = FusedRun(scenario, keep=BATCH_RECORDS + 1)
    columns = {name: scenario.layout(name).columns() for name in scenario.names}
    fastest_hz = max(spec.rate_hz for spec in scenario.sites.values())
    period_s = BATCH_RECORDS / fastest_hz
    empty = slice(0, 0)
    while run.ran_s < scenario.duration_s and run.diverged_s is None:
        run.advance_to(min(run.ran_s + period_s, scenario.duration_s))
        for name, (t_ns, rows) in zip(scenario.names, run.pop_records(), strict=True):
            if not len(t_ns):
                continue
            vectors = [rows[:, columns[name].get(key, empty)] for key in _VECTORS]
            used = np.zeros((len(t_ns), 0), np.int64)
            axes = scenario.arms[name].axes
            receivers[name](_build_batch(axes, t_ns, used, *vectors))
    return run.diverged_s


def run_whole(scenario: Scenario) -> tuple[dict[str, RecordBatch], RunEnd]:
    """Runs a scenario in the compiled loop; returns all records, and how the run ended."""
    batches: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    receivers = {name: batches[name].append for name in batches}
    diverged_s = run_compiled_in_batches(scenario, receivers)
    records = {name: join_batches(site_batches) for name, site_batches in batches.items()}
    buckets = [batch.reduce() for batch in records.values()]
    last_tau_x = [batch.tau_x[-1] for batch in records.values()]
    trace = RunTrace(buckets, last_tau_x, diverged_s)
    return records, classify_run_end(scenario, trace)


class Range(NamedTuple):
    """Smallest and largest value of a quantity; both are the same for a single value."""

    least: float
    most: float


class WindowStats:
    """Running statistics of one site within a window of [expect]."""

    def __init__(self, window: ExpectWindow, scenario: Scenario, site: str) -> None:
        spec = scenario.sites[site]
        self._from_ns = round(window.from_s * NS_PER_S)
        self._to_ns = round(window.to_s * NS_PER_S)
        self._period_ns = NS_PER_S // spec.rate_hz + 1
        self._arm = build_arm_rows(scenario, site)
        self._walls = list_walls(spec)
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
        """Adds the next records of the site; records outside of the window are ignored."""
        self._last_ns = int(rows.t_ns[-1])
        inside = rows.between(self._from_ns, self._to_ns)
        if not len(inside.t_ns):
            return
        self._records += len(inside.t_ns)
        self._raise_peak("error_peak_rad", inside.e)
        self._raise_peak("speed_peak_rad_s", inside.qd)
        self._raise_peak("torque_peak_nm", inside.tau)
        q_least = inside.q.min(axis=0)
        q_most = inside.q.max(axis=0)
        self._q_least = np.minimum(self._q_least, q_least)
        self._q_most = np.maximum(self._q_most, q_most)
        self._push_sum -= inside.tau_x.sum(axis=0)
        if self._walls:
            tip = self._arm.place_end_effector(inside.q, inside.qd)
            t_s = inside.t_ns / NS_PER_S
            forces = [wall_force(wall, t_s, tip) for wall in self._walls]
            self._add_wall_force(np.sum(forces, axis=0))

    def _raise_peak(self, key: str, values: Array) -> None:
        """Raises a peak to the largest absolute value."""
        largest = float(np.abs(values).max())
        self._peaks[key] = max(self._peaks[key], largest)

    def _add_wall_force(self, force: Array) -> None:
        """Adds the force of the walls at the next records, shape (K,), N."""
        touches = force > 0.0
        was_touching = touches[0] if self._was_touching is None else self._was_touching
        previous = np.append(was_touching, touches[:-1])
        self._hits += int((touches & ~previous).sum())
        self._was_touching = bool(touches[-1])
        self._force_sum += float(force.sum())
        self._force_squares += float((force * force).sum())
        self._force_peak = max(self._force_peak, float(force.max()))

    def compute_ranges(self) -> dict[str, Range]:
        """Returns the range of each quantity, by its key in the window of [expect].

        There are no quantities if the records end before the window.
        """
        if not self._records or self._last_ns < self._to_ns - self._period_ns:
            return {}
        ranges = {}
        angles = zip(self._q_least.tolist(), self._q_most.tolist(), strict=True)
        for n, (least, most) in enumerate(angles, 1):
            ranges[f"q{n}_rad"] = Range(least, most)

        single_values = dict(self._peaks)
        pushes_nm = (self._push_sum / self._records).tolist()
        for n, push_nm in enumerate(pushes_nm, 1):
            single_values[f"push{n}_mean_nm"] = push_nm
        mean_n = self._force_sum / self._records
        mean_square = self._force_squares / self._records
        variance = max(0.0, mean_square - mean_n * mean_n)
        single_values["wall_mean_n"] = mean_n
        single_values["wall_deviation_n"] = math.sqrt(variance)
        single_values["wall_peak_n"] = self._force_peak
        single_values["wall_hits"] = float(self._hits)

        for key, value in single_values.items():
            ranges[key] = Range(value, value)
        return ranges


_BUCKET_NS = NS_PER_S // BUCKETS_PER_S
_END_NS = round(END_WINDOW_S * NS_PER_S)


class SiteStats:
    """Running statistics of one site.

    Attributes:
        windows: statistics within each window of [expect]; None for windows of other sites.
        unsynchronised_ns: time of the last record whose |e| was not below `synchronised_rad`;
            -1 before the first such record.
        age_max_ms: largest age of each peer's sample in use, shape (P,), ms.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        peer_rates = [scenario.sites[peer].rate_hz for peer in scenario.peers(site)]
        self._peer_rates = np.array(peer_rates, dtype=np.int64)
        self._synchronised_rad = scenario.expect.synchronised_rad
        self.windows = [
            WindowStats(window, scenario, site) if window.site in ("", site) else None
            for window in scenario.expect.windows
        ]
        self.records = 0
        self.peak_error_rad = 0.0
        self.peak_torque_nm = 0.0
        self.peak_speed_rad_s = 0.0
        self.unsynchronised_ns = -1
        self.age_max_ms = np.zeros(len(peer_rates))
        self._age_sum_ms = np.zeros(len(peer_rates))
        self._age_records = np.zeros(len(peer_rates), dtype=np.int64)
        self._squares = np.zeros(1)
        self._buckets = NO_BUCKETS
        self._tail: list[RecordBatch] = []

    def add(self, rows: RecordBatch) -> None:
        """Adds the next records."""
        if not len(rows.t_ns):
            return
        error = np.abs(rows.e)
        largest = error.max(axis=1)
        torque_nm = np.abs(rows.tau)
        speed_rad_s = np.abs(rows.qd)
        self.records += len(largest)
        self.peak_error_rad = max(self.peak_error_rad, float(largest.max()))
        self.peak_torque_nm = max(self.peak_torque_nm, float(torque_nm.max()))
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, float(speed_rad_s.max()))
        self._squares = self._squares + (error * error).sum(axis=0)
        unsynchronised = np.flatnonzero(largest >= self._synchronised_rad)
        if len(unsynchronised):
            self.unsynchronised_ns = int(rows.t_ns[unsynchronised[-1]])

        known = rows.used >= 0
        sent_ns = rows.used * NS_PER_S // self._peer_rates
        age_ms = (rows.t_ns[:, None] - sent_ns) * 1e-6
        age_ms[~known] = 0.0
        self.age_max_ms = np.maximum(self.age_max_ms, age_ms.max(axis=0))
        self._age_sum_ms += age_ms.sum(axis=0)
        self._age_records += known.sum(axis=0)

        self._buckets = rows.reduce(self._buckets)
        for window in filter(None, self.windows):
            window.add(rows)

        # a batch is dropped once the batch after it covers the last second
        self._tail.append(rows)
        last_second_ns = rows.t_ns[-1] - _END_NS
        while len(self._tail) > 1 and self._tail[1].t_ns[0] < last_second_ns:
            del self._tail[0]

    @property
    def last_ns(self) -> int:
        """Nominal time of the last record, ns; -1 before the first."""
        if not self._tail:
            return -1
        return int(self._tail[-1].t_ns[-1])

    @property
    def rms_error_rad(self) -> float:
        """Root mean square of e of the worst joint, rad."""
        mean_square = self._squares.max() / max(1, self.records)
        return float(np.sqrt(mean_square))

    @property
    def link_ages(self) -> list["LinkAge"]:
        """Age of each peer's sample in use; None for a peer without samples."""
        sums_ms = self._age_sum_ms.tolist()
        record_counts = self._age_records.tolist()
        largest_ms = self.age_max_ms.tolist()
        ages = []
        for sum_ms, count, most_ms in zip(sums_ms, record_counts, largest_ms, strict=True):
            if count:
                ages.append(LinkAge(mean_ms=sum_ms / count, max_ms=most_ms))
            else:
                ages.append(LinkAge(mean_ms=None, max_ms=None))
        return ages

    def end(self, end_ns: int) -> RecordBatch:
        """Returns the records of the last second before `end_ns`.

        `end_ns` is not before the last record.
        """
        return join_batches(self._tail).since(end_ns - _END_NS)

    @property
    def buckets(self) -> Array:
        """The buckets of the site for `RunTrace.buckets`."""
        return self._buckets[: self.last_ns // _BUCKET_NS + 1]

    @property
    def tau_x(self) -> Array:
        """The torque of operator and environment at the last record, shape (n,), N m."""
        if not self._tail:
            return np.zeros(1)
        last_tau_x: Array = self._tail[-1].tau_x[-1]
        return last_tau_x


class LinkAge(msgspec.Struct, frozen=True):
    """Age of the sample in use on one link, over the ticks from the first sample on.

    Attributes:
        mean_ms: the mean age; None without a sample.
        max_ms: the largest age; None without a sample.
    """

    mean_ms: float | None
    max_ms: float | None


class RunMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """The metrics of one run; the docstring of `Expect` defines each of them.

    None stands for a metric that the run cannot give, because it is too short or the event did
    not happen. Metrics `end_...` concern the last second.

    Attributes:
        end: the verdict on the run.
        ages: ages of the samples in use, by link "j->i".
        late_samples: number of samples that arrived too late for the use that their link
            planned.
        missing: number of ticks without a record.
        windows: ranges of the quantities of each window; empty if the run ended before the
            window.
        metrics: the expected metrics of `docs/metrics.md`.
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


def compute_run_metrics(
    scenario: Scenario,
    tallies: Mapping[str, SiteStats],
    *,
    diverged_at_s: float | None,
    late_samples: int,
    missing: int,
) -> RunMetrics:
    """Returns the metrics of a run from the statistics of its sites.

    Args:
        scenario: the scenario.
        tallies: statistics of the sites, in scenario order.
        diverged_at_s: time at which the first site left its limits, s; None: never.
        late_samples: number of late samples.
        missing: number of ticks without a record.
    """
    with_records = {name: tally for name, tally in tallies.items() if tally.records}
    all_ran = len(with_records) == len(tallies)
    buckets = [tally.buckets for tally in tallies.values()]
    last_tau_x = [tally.tau_x for tally in tallies.values()]
    trace = RunTrace(buckets, last_tau_x, diverged_at_s)

    synchronised_at_s = None
    if all_ran:
        synchronised_at_s = _find_synchronisation_s(list(with_records.values()))
    end_ns = max((tally.last_ns for tally in with_records.values()), default=0)
    durations_s = []
    ends = []
    end_errors_rad = []
    end_poses_rad = {}
    for name, tally in with_records.items():
        # to the end of the period after the last tick
        period_s = 1.0 / scenario.sites[name].rate_hz
        durations_s.append(tally.last_ns / NS_PER_S + period_s)
        end = tally.end(end_ns)
        ends.append(end)
        end_errors_rad.append(float(np.abs(end.e).max(initial=0.0)))
        last_pose_rad = tally.end(tally.last_ns).q[-1]
        end_poses_rad[name] = tuple(last_pose_rad.tolist())

    ages = {}
    for name, tally in tallies.items():
        peers = scenario.peers(name)
        for peer, age in zip(peers, tally.link_ages, strict=True):
            ages[f"{peer}->{name}"] = age
    windows_by_site = [tally.windows for tally in tallies.values()]
    windows = zip(*windows_by_site, strict=True)

    def find_largest(name: str) -> float | None:
        values = [getattr(tally, name) for tally in with_records.values()]
        return max(values, default=None)

    return RunMetrics(
        simulated_s=max(durations_s, default=0.0),
        end=classify_run_end(scenario, trace),
        synchronised_at_s=synchronised_at_s,
        peak_error_rad=find_largest("peak_error_rad"),
        rms_error_rad=find_largest("rms_error_rad"),
        end_error_rad=max(end_errors_rad, default=None),
        end_spread_rad=_compute_end_spread_rad(ends) if all_ran else None,
        end_pose_rad=end_poses_rad,
        peak_torque_nm=find_largest("peak_torque_nm"),
        peak_speed_rad_s=find_largest("peak_speed_rad_s"),
        ages=ages,
        late_samples=late_samples,
        missing=missing,
        windows=tuple(map(_merge_windows, windows)),
    )


def _find_synchronisation_s(tallies: Sequence[SiteStats]) -> float | None:
    """Returns the time from which all sites stay synchronised, in s.

    None if a site is not synchronised at its last record.

    Args:
        tallies: statistics of all sites, each with records.
    """
    if any(tally.unsynchronised_ns == tally.last_ns for tally in tallies):
        return None
    last_ns = max(tally.unsynchronised_ns for tally in tallies)
    return max(0, last_ns) / NS_PER_S


def _merge_windows(windows: Sequence[WindowStats | None]) -> dict[str, Range]:
    """Returns the ranges of a window over all of its sites.

    Args:
        windows: statistics of each site within the window; None for a site that it excludes.
    """
    site_ranges = [window.compute_ranges() for window in windows if window is not None]
    if len(site_ranges) == 1:
        return site_ranges[0]
    merged = {}
    for key in ALL_SITES_QUANTITIES:
        if all(key in ranges for ranges in site_ranges):
            merged[key] = Range(
                least=max(ranges[key].least for ranges in site_ranges),
                most=max(ranges[key].most for ranges in site_ranges),
            )
    return merged


def _compute_end_spread_rad(ends: Sequence[RecordBatch]) -> float | None:
    """Returns the largest difference of a joint's angles between sites in the last second.

    None: a site has no records there, or the arms have different numbers of joints.
    """
    if not all(len(end.t_ns) for end in ends):
        return None
    joint_counts = {end.q.shape[1] for end in ends}
    if len(joint_counts) > 1:
        return None
    first_common_ns = max(end.t_ns[0] for end in ends)
    times_ns = ends[0].t_ns[ends[0].t_ns >= first_common_ns]
    poses = []
    for end in ends:
        latest = np.searchsorted(end.t_ns, times_ns, side="right") - 1
        poses.append(end.q[latest])
    spread: Array = np.max(poses, axis=0) - np.min(poses, axis=0)
    return float(spread.max(initial=0.0))


def measure_virtual_run(scenario: Scenario) -> RunMetrics:
    """Runs a scenario in virtual time and returns its metrics."""
    if scenario.expect.metrics:
        return measure_log(simulate_scenario(scenario))
    tallies = {name: SiteStats(scenario, name) for name in scenario.names}
    receivers = {name: tally.add for name, tally in tallies.items()}
    diverged_at_s, late_samples = run_in_batches(scenario, receivers)
    missing = 0
    if diverged_at_s is None:
        expected = sum(scenario.ticks(name) for name in scenario.names)
        missing = expected - sum(tally.records for tally in tallies.values())
    return compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=late_samples,
        missing=missing,
    )


def measure_log(log: Log, expect: Expect | None = None) -> RunMetrics:
    """Returns the metrics of a log.

    Args:
        log: the log.
        expect: expectations instead of those of the log's scenario.

    Raises:
        LogError: a record cannot be read.
    """
    scenario = log.scenario
    if expect is not None:
        scenario = msgspec.structs.replace(scenario, expect=expect)
    ticks_at_end = {event.member: event.ticks for event in log.events if event.kind == "end"}
    diverged_at_s = log.diverged_s
    tallies = {name: SiteStats(scenario, name) for name in log.sites}
    missing = 0
    for name, tally in tallies.items():
        part = log[name]
        batch = RecordBatch(
            t_ns=part.t_ns,
            q=part.q,
            qd=part.qd,
            e=part.e,
            tau=part.tau,
            tau_x=part.tau_x,
            used=np.array([part.used[peer] for peer in part.peers]).T,
        )
        tally.add(batch)
        expected = scenario.ticks(name)
        if diverged_at_s is not None:
            expected = ticks_at_end.get(name, 0)
        missing += max(0, expected - len(part))
    late_samples = sum(sample.arrived_tick is not None for sample in find_absent_samples(log))
    metrics = compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=late_samples,
        missing=missing,
    )
    expected_metrics = measure_run(log, scenario.expect.metrics)
    return msgspec.structs.replace(metrics, metrics=expected_metrics)


class ExpectationResult(msgspec.Struct, frozen=True):
    """The outcome of one expectation of one run.

    Attributes:
        key: the key of [expect], or a word for a requirement on every run.
        held: True if the expectation is met.
        measured: the measured value as a text with its unit.
        limit: the limit as a text with its unit.
        margin: distance to the limit as a fraction of the limit, negative beyond the limit;
            None if there is no such number.
        value: the measured number in the unit of the limit; None if there is none.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None


def evaluate_expectations(expect: Expect, metrics: RunMetrics) -> list[ExpectationResult]:
    """Returns an outcome for each expectation of a run, in the order of the keys of `Expect`.

    A run that diverged has an outcome `stable` even if that key is absent, see `Expect`.
    """
    outcomes = list(_evaluate_stability(expect, metrics))
    for key in _LIMITS:
        limit = getattr(expect, key)
        if limit is not None:
            outcomes.append(_compare_with_limit(key, _read_metric(key, metrics), limit))
    outcomes += _evaluate_poses(expect, metrics)
    if expect.no_gaps:
        gaps = ExpectationResult(
            key="no_gaps",
            held=metrics.missing == 0,
            measured=f"{metrics.missing} missing",
            limit="0 missing",
        )
        outcomes.append(gaps)
    outcomes += _evaluate_windows(expect, metrics)
    outcomes += _evaluate_metrics(expect, metrics)
    return outcomes


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the outcome of `stable`, if it is expected or the run diverged."""
    expects_stable = expect.stable is not False
    end = metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        expected = Stability.STABLE if expects_stable else Stability.NOT_STABLE
        measured = f"{end.stability}: {end.text}"
        limit = str(expects_stable).lower()
        yield ExpectationResult("stable", end.stability is expected, measured, limit)


_LIMITS = tuple(key for key in field_names(Expect) if re.search("_(max|min|by)(_|$)", key))
"""Keys of [expect] that limit a metric."""


def _read_metric(key: str, metrics: RunMetrics) -> float | None:
    """Returns the metric that a key of [expect] limits.

    For ages it is that of the worst link, and None if a link never had a sample.
    """
    if not key.endswith("_ms"):
        name = re.sub("_(max|min)", "", key).replace("_by_", "_at_")
        value: float | None = getattr(metrics, name)
        return value
    is_mean = key.startswith("mean")
    ages_ms = []
    for age in metrics.ages.values():
        age_ms = age.mean_ms if is_mean else age.max_ms
        if age_ms is None:
            return None
        ages_ms.append(age_ms)
    choose = min if "_min_" in key else max
    return choose(ages_ms) if ages_ms else None


def _compare_with_limit(key: str, measured: float | None, limit: float) -> ExpectationResult:
    """Returns the outcome of a smallest or a largest value.

    Args:
        key: the key of [expect].
        measured: the measured value; None: the run has none.
        limit: the limit, in the same unit.
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
    """Yields the outcome of each expected end pose."""
    tolerance_rad = expect.end_pose_within_rad
    for site, expected in expect.end_pose_rad.items():
        key = f"end_pose_rad.{site}"
        expected_angles = ", ".join(f"{angle:g}" for angle in expected)
        limit = f"({expected_angles}) ± {tolerance_rad:g} rad"
        reached = metrics.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(key, False, "never", limit)
            continue
        distances_rad = [abs(a - b) for a, b in zip(reached, expected, strict=True)]
        error_rad = max(distances_rad)
        angles = ", ".join(f"{angle:.4f}" for angle in reached)
        yield ExpectationResult(
            key=key,
            held=error_rad <= tolerance_rad,
            measured=f"({angles}) rad",
            limit=limit,
            margin=(tolerance_rad - error_rad) / tolerance_rad,
        )


def _evaluate_windows(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the outcome of each quantity of each window."""
    for window, ranges in zip(expect.windows, metrics.windows, strict=True):
        site = f" {window.site}" if window.site else ""
        period = f"{window.from_s:g}-{window.to_s:g} s"
        for key, limits in window.limits:
            name = f"{key}{site} {period}"  # as in "wall_mean_n s 9-15 s"
            _, unit = split_unit(key)
            yield _compare_with_range(name, ranges.get(key), limits, unit)


def _evaluate_metrics(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    """Yields the outcome of each expected metric of docs/metrics.md."""
    for key, limits in expect.metrics.items():
        value, reason, _ = metrics.metrics[key]
        yield _compare_with_range(
            name=f"metrics.{key}",
            measured=None if value is None else Range(value, value),
            limits=limits,
            unit=find_quantity(key).unit,
            missing_text=reason,
        )


def _compare_with_range(
    name: str,
    measured: Range | None,
    limits: Sequence[float],
    unit: str,
    missing_text: str = "never",
) -> ExpectationResult:
    """Returns the outcome of a quantity that must stay within a range.

    Args:
        name: name of the expectation.
        measured: smallest and largest value; None: the run has none.
        limits: lower and upper limit.
        unit: unit of the quantity.
        missing_text: text for a missing value.
    """
    least, most = limits
    limit_text = f"{least:g} to {most:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(name, False, missing_text, limit_text)
    text = " to ".join(f"{value:.4g}" for value in dict.fromkeys(measured))
    distance = min(measured.least - least, most - measured.most)
    half_width = 0.5 * (most - least)
    return ExpectationResult(
        key=name,
        held=distance >= 0.0,
        measured=f"{text} {unit}".rstrip(),
        limit=limit_text,
        margin=distance / half_width if half_width else None,
        value=measured.most if measured.least == measured.most else None,
    )

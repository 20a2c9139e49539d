"""Measures a run, for example its largest error.

A scenario may contain a table [expect] with limits on its runs. For example,
`peak_error_max_rad` limits the largest error. This module computes the metrics that the table
can limit, from a simulation or from a log. The module `expectations` compares them with the
limits.

Invariant:
    - Each metric has one definition. Simulations and logs pass their records in batches, in
      chronological order, to the same running statistics (`SiteStats`).
    - A metric that cannot be computed for a run is `None`, never a guess.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

import msgspec
import numpy as np

from trilat_net.analysis import LogMetrics, Metric, RunEnd
from trilat_net.core import Array, compute_fingerprint
from trilat_net.errors import ScenarioError
from trilat_net.execution import FusedRun, SimulatedLog, find_absent_samples
from trilat_net.log import Log, collect_provenance
from trilat_net.records import NS_PER_S
from trilat_net.scenario import ALL_SITES_QUANTITIES, Expect, Scenario

from .record_batches import BATCH_RECORDS, BatchedRun, RecordBatch, run_in_batches
from .run_statistics import LinkAge, Range, SiteStats, WindowStats


class RunMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """Metrics of one run, for comparison with the expectations of its scenario.

    The docstring of `Expect` defines each metric. A metric is `None` if it cannot be computed
    because the run is too short or an event did not happen. The metrics `end_...` describe the
    last second of the run. A link "j->i" leads from site j to site i.

    Attributes:
        simulated_s: Time from the start of the run to the end of its last control period, in s.
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
        for position, obstacle in BatchedRun.finish_together(compiled_runs):
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
        diverged_at_s: Time at which an arm first exceeded its limits, in s. `None` if no arm
            did.
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
        self.compiled: BatchedRun | None = None
        scenario.refuse_external_arms()
        try:
            FusedRun.check_scenario(scenario)
        except ScenarioError:
            self.obstacle = "tick rates that differ too much"
        else:
            self.compiled = BatchedRun(scenario, receivers)

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
            diverged_at_s: Time at which an arm first exceeded its limits, in s.
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

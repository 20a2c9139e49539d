"""The metrics of a run that [expect] can ask for, of a run in virtual time or of a log, and
their outcomes.

Invariant: every metric has one definition: both sources feed the same running statistics of
their sites with the same records, batch by batch in time order; a metric that a run cannot give
is None, never a guess. Memory is bounded: kept are extrema, sums, the last second, and the
buckets on which the judgement rests. How a run is cut into batches changes only the last bits
of a mean. An outcome states value, limit and margin.
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
"""Records of a site that are collected before they are passed on."""


class RecordBatch(NamedTuple):
    """Some records of one site, one after the other.

    Attributes:
        t_ns: nominal time, shape (K,), ns.
        q: joint angles, shape (K, n), rad.
        qd: joint velocities, shape (K, n), rad/s.
        e: its error against the reference, Eq. (9), shape (K, m), rad; m in task space.
        tau: control torque, shape (K, n), N m.
        tau_x: exogenous torque in the sign of Eq. (8), shape (K, n), N m.
        used: tick of the sample in use, -1 before the first, shape (K, P); of a compiled run
            none, (K, 0).
    """

    t_ns: Ints
    q: Array
    qd: Array
    e: Array
    tau: Array
    tau_x: Array
    used: Ints

    def since(self, t_ns: int) -> "RecordBatch":
        """Returns the records that are later than a time."""
        return self._part(int(np.searchsorted(self.t_ns, t_ns, side="right")), None)

    def between(self, from_ns: int, to_ns: int) -> "RecordBatch":
        """Returns the records from one time to another, which is no longer of them."""
        return self._part(*np.searchsorted(self.t_ns, (from_ns, to_ns)).tolist())

    def reduce(self, into: Array = NO_BUCKETS) -> Array:
        """Returns the buckets of a judgement with these records added, see `reduce_to_buckets`."""
        bucket = self.t_ns * BUCKETS_PER_S // NS_PER_S
        return reduce_to_buckets(bucket=bucket, e=self.e, qd=self.qd, q=self.q, into=into)

    def _part(self, first: int, last: int | None) -> "RecordBatch":
        return RecordBatch._make(column[first:last] for column in self)


def join_batches(blocks: Sequence[RecordBatch]) -> RecordBatch:
    """Returns blocks that follow each other as one."""
    return RecordBatch._make(map(np.concatenate, zip(*blocks, strict=True)))


def _make_batch(axes: Sequence[float], t_ns: Ints, used: Ints, *vectors: Array) -> RecordBatch:
    q, qd, q_des, tau, tau_x, x = vectors
    e = compute_task_errors(x, q_des, axes) if x.size else q - q_des
    return RecordBatch(t_ns=t_ns, q=q, qd=qd, e=e, tau=tau, tau_x=tau_x, used=used)


def run_in_batches(
    scenario: Scenario, take: Mapping[str, Callable[[RecordBatch], None]]
) -> tuple[float | None, int]:
    """Runs a scenario in virtual time and passes every site's records on, batch by batch.

    Returns:
        when the first site left its limits, s, or None; and how many samples came late.
    """
    pending: dict[str, list[TickRecord]] = {name: [] for name in take}
    sites: dict[str, Site] = {}
    diverged_at_s: float | None = None

    def flush(name: str) -> None:
        if records := pending[name]:
            rows = [(one.q, one.qd, one.q_des, one.tau, one.tau_x, one.x) for one in records]
            t_ns = np.array([one.t_ns for one in records], dtype=np.int64)
            used = np.array([one.used for one in records], dtype=np.int64)
            vectors = map(np.array, zip(*rows, strict=True))
            take[name](_make_batch(scenario.arms[name].axes, t_ns, used, *vectors))
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
    return diverged_at_s, sum(count.late for site in sites.values() for count in site.counts())


def run_compiled_in_batches(
    scenario: Scenario, take: Mapping[str, Callable[[RecordBatch], None]]
) -> float | None:
    """Does as `run_in_batches`, in the compiled loop, which does not say which samples are in
    use.

    Returns:
        when the first site left its limits, s, or None.
    """
    run = FusedRun(scenario, keep=BATCH_RECORDS + 1)
    columns = [scenario.layout(name).columns() for name in scenario.names]
    period_s = BATCH_RECORDS / max(spec.rate_hz for spec in scenario.sites.values())
    while run.ran_s < scenario.duration_s and run.diverged_s is None:
        run.advance_to(min(run.ran_s + period_s, scenario.duration_s))
        for name, place, (t_ns, rows) in zip(
            scenario.names, columns, run.pop_records(), strict=True
        ):
            if not len(t_ns):
                continue
            keys = ("q", "qd", "q_des", "tau", "tau_x", "x")
            vectors = (rows[:, place.get(key, slice(0, 0))] for key in keys)
            used = np.zeros((len(t_ns), 0), np.int64)
            take[name](_make_batch(scenario.arms[name].axes, t_ns, used, *vectors))
    return run.diverged_s


def run_whole(scenario: Scenario) -> tuple[dict[str, RecordBatch], RunEnd]:
    """Runs a scenario in the compiled loop; returns all records of each site, and how the run
    ended.
    """
    kept: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_s = run_compiled_in_batches(scenario, {name: kept[name].append for name in kept})
    records = {name: join_batches(blocks) for name, blocks in kept.items()}
    found = records.values()
    trace = RunTrace(
        [one.reduce() for one in found], [one.tau_x[-1] for one in found], diverged_s
    )
    return records, classify_run_end(scenario, trace)


class Range(NamedTuple):
    """Smallest and largest value that a quantity had; twice the same where it has one value."""

    least: float
    most: float


class WindowStats:
    """Statistics of one site within a window, so far."""

    def __init__(self, window: ExpectWindow, scenario: Scenario, site: str) -> None:
        spec = scenario.sites[site]
        self._from_ns, self._to_ns = (
            round(t_s * NS_PER_S) for t_s in (window.from_s, window.to_s)
        )
        self._period_ns = NS_PER_S // spec.rate_hz + 1
        self._arm = build_arm_rows(scenario, site)
        self._walls = list_walls(spec)
        self._seen_ns = -1
        self._records = 0
        self._peaks = {"error_peak_rad": 0.0, "speed_peak_rad_s": 0.0, "torque_peak_nm": 0.0}
        joints = len(spec.q0_rad)
        self._q_least = np.full(joints, math.inf)
        self._q_most = np.full(joints, -math.inf)
        self._push_sum = np.zeros(joints)
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
        for key, values in zip(self._peaks, (inside.e, inside.qd, inside.tau), strict=True):
            self._peaks[key] = max(self._peaks[key], float(np.abs(values).max()))
        self._q_least = np.minimum(self._q_least, inside.q.min(axis=0))
        self._q_most = np.maximum(self._q_most, inside.q.max(axis=0))
        self._push_sum -= inside.tau_x.sum(axis=0)
        if self._walls:
            tip = self._arm.place_end_effector(inside.q, inside.qd)
            t_s = inside.t_ns / NS_PER_S
            self._add_force(
                np.sum([wall_force(wall, t_s, tip) for wall in self._walls], axis=0)
            )

    def _add_force(self, force: Array) -> None:
        touching = force > 0.0
        before = np.append(
            touching[0] if self._touched is None else self._touched, touching[:-1]
        )
        self._hits += int((touching & ~before).sum())
        self._touched = bool(touching[-1])
        self._force_sum += float(force.sum())
        self._force_squares += float((force * force).sum())
        self._force_peak = max(self._force_peak, float(force.max()))

    def figures(self) -> dict[str, Range]:
        """Returns every quantity by its key in `Window`; none where the records end before the
        window.
        """
        if not self._records or self._seen_ns < self._to_ns - self._period_ns:
            return {}
        mean_n = self._force_sum / self._records
        push_nm = (self._push_sum / self._records).tolist()
        single = {
            **self._peaks,
            **{f"push{n}_mean_nm": push for n, push in enumerate(push_nm, 1)},
            "wall_mean_n": mean_n,
            "wall_deviation_n": math.sqrt(
                max(0.0, self._force_squares / self._records - mean_n * mean_n)
            ),
            "wall_peak_n": self._force_peak,
            "wall_hits": float(self._hits),
        }
        angles = zip(self._q_least.tolist(), self._q_most.tolist(), strict=True)
        spans = {f"q{n}_rad": Range(*ends) for n, ends in enumerate(angles, 1)}
        return {**spans, **{key: Range(value, value) for key, value in single.items()}}


_BUCKET_NS = NS_PER_S // BUCKETS_PER_S
_END_NS = round(END_WINDOW_S * NS_PER_S)


class SiteStats:
    """Statistics of one site, so far.

    Attributes:
        stretches: per window of [expect] the statistics within it; None where a window is
            another site's.
        apart_ns: time of the last record whose |e| was not below `synchronised_rad`; -1 before
            one was.
        age_max_ms: per peer the largest age of the sample in use, shape (P,).
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        peer_rates = [scenario.sites[peer].rate_hz for peer in scenario.peers(site)]
        self._peer_rates = np.array(peer_rates, dtype=np.int64)
        self._synchronised_rad = scenario.expect.synchronised_rad
        self.stretches = [
            WindowStats(window, scenario, site) if window.site in ("", site) else None
            for window in scenario.expect.windows
        ]
        self.records = 0
        self.peak_error_rad = self.peak_torque_nm = self.peak_speed_rad_s = 0.0
        self.apart_ns = -1
        self.age_max_ms = np.zeros(len(peer_rates))
        self._age_sum_ms = np.zeros(len(peer_rates))
        self._age_records = np.zeros(len(peer_rates), dtype=np.int64)
        self._squares = np.zeros(1)
        self._buckets = NO_BUCKETS
        self._tail: list[RecordBatch] = []

    def add(self, rows: RecordBatch) -> None:
        """Takes in the next records."""
        if not len(rows.t_ns):
            return
        error = np.abs(rows.e)
        largest = error.max(axis=1)
        self.records += len(largest)
        self.peak_error_rad = max(self.peak_error_rad, float(largest.max()))
        self.peak_torque_nm = max(self.peak_torque_nm, float(np.abs(rows.tau).max()))
        self.peak_speed_rad_s = max(self.peak_speed_rad_s, float(np.abs(rows.qd).max()))
        self._squares = self._squares + (error * error).sum(axis=0)
        apart = np.flatnonzero(largest >= self._synchronised_rad)
        if len(apart):
            self.apart_ns = int(rows.t_ns[apart[-1]])
        known = rows.used >= 0
        age_ms = (rows.t_ns[:, None] - rows.used * NS_PER_S // self._peer_rates) * 1e-6
        age_ms[~known] = 0.0
        self.age_max_ms = np.maximum(self.age_max_ms, age_ms.max(axis=0))
        self._age_sum_ms += age_ms.sum(axis=0)
        self._age_records += known.sum(axis=0)
        self._buckets = rows.reduce(self._buckets)
        for stretch in filter(None, self.stretches):
            stretch.add(rows)
        self._tail.append(rows)
        while len(self._tail) > 1 and self._tail[1].t_ns[0] < rows.t_ns[-1] - _END_NS:
            del self._tail[0]

    @property
    def last_ns(self) -> int:
        """Nominal time of the last record, ns; -1 before the first."""
        return int(self._tail[-1].t_ns[-1]) if self._tail else -1

    @property
    def rms_error_rad(self) -> float:
        """Root mean square of e of the worst joint, rad."""
        return float(np.sqrt(self._squares.max() / max(1, self.records)))

    @property
    def link_ages(self) -> list["LinkAge"]:
        """Per peer the age of the sample in use; None where there never was one."""
        rows = zip(
            self._age_sum_ms.tolist(),
            self._age_records.tolist(),
            self.age_max_ms.tolist(),
            strict=True,
        )
        return [
            LinkAge(total / records, most) if records else LinkAge(None, None)
            for total, records, most in rows
        ]

    def end(self, end_ns: int) -> RecordBatch:
        """Returns the records of the last second before `end_ns`, which is not before the last
        record.
        """
        return join_batches(self._tail).since(end_ns - _END_NS)

    @property
    def buckets(self) -> Array:
        """What `RunTrace.buckets` asks of a site."""
        return self._buckets[: self.last_ns // _BUCKET_NS + 1]

    @property
    def tau_x(self) -> Array:
        """The torque of operator and environment at the last record, shape (n,), N m."""
        return self._tail[-1].tau_x[-1] if self._tail else np.zeros(1)


class LinkAge(msgspec.Struct, frozen=True):
    """Age of the sample in use on one link, over the receiver's ticks from the first one on;
    else None.
    """

    mean_ms: float | None
    max_ms: float | None


class RunMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """One run, measured; the docstring of `Expect` defines every metric.

    `end` is its judgement. None stands for what the run cannot give: too short, or it did not
    come to it. `end_...` is of the last second, `ages` has links "j->i", `late_samples` came
    too late for what their link meant to do with them, `missing` counts ticks without a record,
    and a window has no quantities where the run ended before it did. `metrics` has those of
    `docs/metrics.md` that are expected.
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
    """Returns the metrics of a run from the statistics of its sites, in scenario order."""
    ran = {name: tally for name, tally in tallies.items() if tally.records}
    whole = len(ran) == len(tallies)
    end_ns = max((tally.last_ns for tally in ran.values()), default=0)
    found = tallies.values()
    trace = RunTrace(
        [one.buckets for one in found], [one.tau_x for one in found], diverged_at_s
    )
    span_s = [
        tally.last_ns / NS_PER_S + 1.0 / scenario.sites[name].rate_hz
        for name, tally in ran.items()
    ]
    apart_ns = [tally.apart_ns for tally in ran.values()]
    synchronised = whole and not any(tally.apart_ns == tally.last_ns for tally in ran.values())
    ends = {name: tally.end(end_ns) for name, tally in ran.items()}

    def largest(name: str) -> float | None:
        return max((getattr(tally, name) for tally in ran.values()), default=None)

    return RunMetrics(
        simulated_s=max(
            span_s, default=0.0
        ),  # to the end of the period that follows the last tick
        end=classify_run_end(scenario, trace),
        synchronised_at_s=max(0, *apart_ns) / NS_PER_S if synchronised else None,
        peak_error_rad=largest("peak_error_rad"),
        rms_error_rad=largest("rms_error_rad"),
        end_error_rad=max(
            (float(np.abs(end.e).max(initial=0.0)) for end in ends.values()), default=None
        ),
        end_spread_rad=_end_spread_rad(list(ends.values())) if whole else None,
        end_pose_rad={
            name: tuple(tally.end(tally.last_ns).q[-1].tolist()) for name, tally in ran.items()
        },
        peak_torque_nm=largest("peak_torque_nm"),
        peak_speed_rad_s=largest("peak_speed_rad_s"),
        ages={
            f"{peer}->{name}": age
            for name, tally in tallies.items()
            for peer, age in zip(scenario.peers(name), tally.link_ages, strict=True)
        },
        late_samples=late_samples,
        missing=missing,
        windows=tuple(
            map(_window_ranges, zip(*(tally.stretches for tally in found), strict=True))
        ),
    )


def _window_ranges(stretches: Sequence[WindowStats | None]) -> dict[str, Range]:
    parts = [stretch.figures() for stretch in stretches if stretch is not None]
    if len(parts) == 1:
        return parts[0]
    return {
        key: Range(*(max(part[key][n] for part in parts) for n in (0, 1)))
        for key in ALL_SITES_QUANTITIES
        if all(key in part for part in parts)
    }


def _end_spread_rad(ends: Sequence[RecordBatch]) -> float | None:
    if not all(len(end.t_ns) for end in ends):  # a site's part ends long before the others'
        return None
    if len({end.q.shape[1] for end in ends}) > 1:  # unlike arms have no angle in common
        return None
    at_ns = ends[0].t_ns[ends[0].t_ns >= max(end.t_ns[0] for end in ends)]
    poses: Array = np.array(
        [end.q[np.searchsorted(end.t_ns, at_ns, side="right") - 1] for end in ends]
    )
    return float((poses.max(axis=0) - poses.min(axis=0)).max(initial=0.0))


def measure_virtual_run(scenario: Scenario) -> RunMetrics:
    """Runs a scenario in virtual time and returns its metrics."""
    if scenario.expect.metrics:
        return measure_log(simulate_scenario(scenario))
    tallies = {name: SiteStats(scenario, name) for name in scenario.names}
    diverged_at_s, late_samples = run_in_batches(
        scenario, {name: tally.add for name, tally in tallies.items()}
    )
    made = sum(tally.records for tally in tallies.values())
    return compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=late_samples,
        missing=0
        if diverged_at_s is not None
        else sum(map(scenario.ticks, scenario.names)) - made,
    )


def measure_log(log: Log, expect: Expect | None = None) -> RunMetrics:
    """Returns the metrics of a log.

    Raises:
        LogError: a record cannot be read.
    """
    scenario = (
        log.scenario if expect is None else msgspec.structs.replace(log.scenario, expect=expect)
    )
    made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    diverged_at_s = log.diverged_s
    tallies = {name: SiteStats(scenario, name) for name in log.sites}
    missing = 0
    for name, tally in tallies.items():
        part = log[name]
        used = np.array([part.used[peer] for peer in part.peers]).T
        tally.add(
            RecordBatch(
                t_ns=part.t_ns,
                q=part.q,
                qd=part.qd,
                e=part.e,
                tau=part.tau,
                tau_x=part.tau_x,
                used=used,
            )
        )
        wanted = scenario.ticks(name) if diverged_at_s is None else made.get(name, 0)
        missing += max(0, wanted - len(part))
    found = compute_run_metrics(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=sum(
            sample.arrived_tick is not None for sample in find_absent_samples(log)
        ),
        missing=missing,
    )
    return msgspec.structs.replace(found, metrics=measure_run(log, scenario.expect.metrics))


class ExpectationResult(msgspec.Struct, frozen=True):
    """One thing that was expected of one run; values in words with their units.

    Attributes:
        key: the key of [expect] that asked, or a word for what every run must do.
        margin: how far within the limit, as a fraction of the limit: 0.1 is 10 % to spare,
            negative is beyond it. None where there is no such number.
        value: the measured number, in the unit of the limit; None where it is none.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None


def evaluate_expectations(expect: Expect, metrics: RunMetrics) -> list[ExpectationResult]:
    """Returns an outcome for everything that is asked of a run, in the order of the keys of
    `Expect`.

    A run that diverged has an outcome `stable` even where that key is absent, see `Expect`.
    """
    limits = [
        _compare_with_limit(key, _read_metric(key, metrics), limit)
        for key in _LIMITS
        if (limit := getattr(expect, key)) is not None
    ]
    missing = f"{metrics.missing} missing"
    gaps = ExpectationResult("no_gaps", metrics.missing == 0, missing, "0 missing")
    return [
        *_evaluate_stability(expect, metrics),
        *limits,
        *_evaluate_poses(expect, metrics),
        *([gaps] if expect.no_gaps else []),
        *_evaluate_windows(expect, metrics),
        *_evaluate_metrics(expect, metrics),
    ]


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    wanted = expect.stable is not False
    end = metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        held = end.stability is (Stability.STABLE if wanted else Stability.NOT_STABLE)
        yield ExpectationResult(
            "stable", held, f"{end.stability}: {end.text}", str(wanted).lower()
        )


_LIMITS = tuple(key for key in field_names(Expect) if re.search("_(max|min|by)(_|$)", key))


def _read_metric(key: str, metrics: RunMetrics) -> float | None:
    """Returns what a limit is of; of ages that of the worst link, None if one never had a
    sample.
    """
    if not key.endswith("_ms"):
        found: float | None = getattr(
            metrics, re.sub("_(max|min)", "", key).replace("_by_", "_at_")
        )
        return found
    ages = [
        age.mean_ms if key.startswith("mean") else age.max_ms for age in metrics.ages.values()
    ]
    known = [age for age in ages if age is not None]
    choose = min if "_min_" in key else max
    return choose(known) if known and len(known) == len(ages) else None


def _compare_with_limit(key: str, measured: float | None, limit: float) -> ExpectationResult:
    least = "_min_" in key
    unit = split_unit(key)[1]
    wanted = f"{'≥' if least else '≤'} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", wanted)
    spare = measured - limit if least else limit - measured
    text = f"{measured:.4g} {unit}".rstrip()
    return ExpectationResult(
        key, spare >= 0.0, text, wanted, spare / limit if limit else None, measured
    )


def _evaluate_poses(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    within = expect.end_pose_within_rad
    for site, wanted in expect.end_pose_rad.items():
        key = f"end_pose_rad.{site}"
        limit = f"({', '.join(f'{angle:g}' for angle in wanted)}) ± {within:g} rad"
        reached = metrics.end_pose_rad.get(site)
        if reached is None:
            yield ExpectationResult(key, False, "never", limit)
            continue
        off = max(abs(a - b) for a, b in zip(reached, wanted, strict=True))
        text = f"({', '.join(f'{angle:.4f}' for angle in reached)}) rad"
        yield ExpectationResult(key, off <= within, text, limit, (within - off) / within)


def _evaluate_windows(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    for window, ranges in zip(expect.windows, metrics.windows, strict=True):
        for key, limits in window.limits:
            site = f" {window.site}" if window.site else ""
            name = (
                f"{key}{site} {window.from_s:g}-{window.to_s:g} s"  # as in wall_mean_n s 9-15 s
            )
            yield _compare_with_range(name, ranges.get(key), limits, split_unit(key)[1])


def _evaluate_metrics(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    for key, limits in expect.metrics.items():
        value, why, _ = metrics.metrics[key]
        found = None if value is None else Range(value, value)
        yield _compare_with_range(
            name=f"metrics.{key}",
            found=found,
            limits=limits,
            unit=find_quantity(key).unit,
            why=why,
        )


def _compare_with_range(
    name: str, found: Range | None, limits: Sequence[float], unit: str, why: str = "never"
) -> ExpectationResult:
    least, most = limits
    wanted = f"{least:g} to {most:g} {unit}".rstrip()
    if found is None:
        return ExpectationResult(name, False, why, wanted)
    text = " to ".join(f"{value:.4g}" for value in dict.fromkeys(found))
    spare = min(found.least - least, most - found.most)
    half = 0.5 * (most - least)
    margin = spare / half if half else None
    value = found.most if found.least == found.most else None
    return ExpectationResult(
        name, spare >= 0.0, f"{text} {unit}".rstrip(), wanted, margin, value
    )

"""A run in virtual time as batches of records, site by site.

Invariant: batches of a site follow each other without a gap, however long the run is; what takes them keeps
what it needs, so that the memory of a run is its taker's.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .. import process
from ..analysis.run_end import NO_BUCKETS, RunEnd, RunTrace, classify_run_end, reduce_to_buckets
from ..core.site_step import Site
from ..core.ticks import BUCKETS_PER_S, NS_PER_S, Mode, TickRecord
from ..core.vectors import Array
from ..execution import virtual
from ..execution.fused import FusedRun
from ..log.record_columns import Ints
from ..log.site_log import find_task_errors
from ..scenario import Scenario

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
        used: tick of the sample in use, -1 before the first, shape (K, P); of a compiled run none, (K, 0).
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
        return reduce_to_buckets(bucket, self.e, self.qd, self.q, into)

    def _part(self, first: int, last: int | None) -> "RecordBatch":
        return RecordBatch._make(column[first:last] for column in self)


def join_batches(blocks: Sequence[RecordBatch]) -> RecordBatch:
    """Returns blocks that follow each other as one."""
    return RecordBatch._make(map(np.concatenate, zip(*blocks, strict=True)))


class BatchedRun(NamedTuple):
    """A run that was passed on: when its first site left its limits, s, or None; samples that came late."""

    diverged_at_s: float | None
    late_samples: int


def _make_batch(axes: Sequence[float], t_ns: Ints, used: Ints, *vectors: Array) -> RecordBatch:
    q, qd, q_des, tau, tau_x, x = vectors
    e = find_task_errors(x, q_des, axes) if x.size else q - q_des
    return RecordBatch(t_ns, q, qd, e, tau, tau_x, used)


def _pack_records(axes: Sequence[float], records: Sequence[TickRecord]) -> RecordBatch:
    rows = [(one.q, one.qd, one.q_des, one.tau, one.tau_x, one.x) for one in records]
    t_ns = np.array([one.t_ns for one in records], dtype=np.int64)
    used = np.array([one.used for one in records], dtype=np.int64)
    return _make_batch(axes, t_ns, used, *map(np.array, zip(*rows, strict=True)))


def run_in_batches(scenario: Scenario, take: Mapping[str, Callable[[RecordBatch], None]]) -> BatchedRun:
    """Runs a scenario in virtual time and passes every site's records on, batch by batch."""
    pending: dict[str, list[TickRecord]] = {name: [] for name in take}
    sites: dict[str, Site] = {}
    diverged_at_s: float | None = None

    def flush(name: str) -> None:
        if pending[name]:
            take[name](_pack_records(scenario.arms[name].axes, pending[name]))
            pending[name].clear()

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
    return BatchedRun(diverged_at_s, sum(count.late for site in sites.values() for count in site.counts()))


def run_compiled_in_batches(
    scenario: Scenario, take: Mapping[str, Callable[[RecordBatch], None]]
) -> float | None:
    """Does as `run_in_batches`, in the compiled loop, which does not say which samples are in use.

    Returns:
        when the first site left its limits, s, or None.
    """
    run = FusedRun(scenario, keep=BATCH_RECORDS + 1)
    columns = [scenario.layout(name).columns() for name in scenario.names]
    period_s = BATCH_RECORDS / max(spec.rate_hz for spec in scenario.sites.values())
    while run.ran_s < scenario.duration_s and run.diverged_s is None:
        run.advance(min(run.ran_s + period_s, scenario.duration_s))
        for name, place, (t_ns, rows) in zip(scenario.names, columns, run.take_records(), strict=True):
            if not len(t_ns):
                continue
            keys = ("q", "qd", "q_des", "tau", "tau_x", "x")
            vectors = (rows[:, place.get(key, slice(0, 0))] for key in keys)
            used = np.zeros((len(t_ns), 0), np.int64)
            take[name](_make_batch(scenario.arms[name].axes, t_ns, used, *vectors))
    return run.diverged_s


def run_whole(scenario: Scenario) -> tuple[dict[str, RecordBatch], RunEnd]:
    """Runs a scenario in the compiled loop; returns all records of each site, and how the run ended."""
    kept: dict[str, list[RecordBatch]] = {name: [] for name in scenario.names}
    diverged_s = run_compiled_in_batches(scenario, {name: kept[name].append for name in kept})
    records = {name: join_batches(blocks) for name, blocks in kept.items()}
    found = records.values()
    trace = RunTrace([one.reduce() for one in found], [one.tau_x[-1] for one in found], diverged_s)
    return records, classify_run_end(scenario, trace)

"""Runs scenarios in virtual time and passes on their records in batches.

Invariant:
    - Runs that are computed side by side have the records of the same runs computed alone, bit
      for bit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trilat_net import process
from trilat_net.analysis import NO_BUCKETS, RunEnd
from trilat_net.core import BUCKETS_PER_S, Array, Site
from trilat_net.execution import FusedRun, execute_virtual
from trilat_net.log import Ints, compute_task_errors
from trilat_net.records import NS_PER_S, Mode, TickRecord
from trilat_net.scenario import Scenario

BATCH_RECORDS = 1000
"""Number of records per batch of a site."""
_RECORD_ROWS = 1 << BATCH_RECORDS.bit_length()
"""Number of records kept by runs side by side, a power of two above `BATCH_RECORDS`."""
_VECTORS = ("q", "qd", "q_des", "tau", "tau_x", "x")
"""Vectors of a record that `_build_batch` takes, in the order of its arguments."""


class RecordBatch(NamedTuple):
    """Records of consecutive ticks of one arm, with one array per quantity.

    Metrics are computed from batches because statistics over arrays are much faster than over
    individual records. In the shapes below, K is the number of records, n the number of joints,
    m the number of coordinates that the sites exchange, and P the number of peers.

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
            of the end effector is empty if the sites exchange joint angles.
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
        The time at which an arm first exceeded its limits, in s, or `None` if no arm did; and
        the number of samples that arrived too late to be used as planned.
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


class BatchedRun:
    """A run in the compiled loop that passes on its records in batches.

    The compiled loop runs the controllers of all sites without returning to Python, which makes
    it much faster than `run_in_batches`.

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

    @staticmethod
    def finish_together(compiled: "Sequence[BatchedRun]") -> Iterator[tuple[int, str]]:
        """Simulates several runs to their ends, as many at once as possible.

        Args:
            compiled: The runs.

        Yields:
            The index of a finished run, and the reason why it was computed alone (an empty
            string if it was not).
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
        compiled = BatchedRun(scenario, receivers)
        compiled.finish()
        return _join_run(scenario, compiled.run, batches)

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
            compiled.append(BatchedRun(scenario, receivers))
        for index, obstacle in BatchedRun.finish_together(compiled):
            yield (
                index,
                _join_run(scenarios[index], compiled[index].run, batches[index]),
                obstacle,
            )
            batches[index].clear()


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

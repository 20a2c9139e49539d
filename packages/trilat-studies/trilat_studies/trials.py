"""Tests whether a scenario behaves as expected with several random seeds.

The table [expect] of a scenario states requirements on its runs, such as the largest permitted
error. A trial is a run of the scenario with one seed, whose metrics are compared with this
table. The command is `trilat test`.

With pytest, one test per seed:

    import pytest
    import trilat_net

    TRIALS = trilat_net.trials("jitter", seeds=range(1, 6))

    @pytest.mark.parametrize("trial", TRIALS, ids=str)
    def test_jitter(trial):
        trial.check()

All seeds in one test, on all cores: `trilat_net.check("jitter", seeds=range(1, 21))`.

Invariant:
    - Every trial can be repeated with one command, which is included in its result.
    - The evaluation of an expectation depends only on the measured value and the limit. Its
      result contains both, and the margin, whether or not the expectation is met.
    - Results are in the order of the trials, whichever process ran them.
    - A trial that repeatedly kills its worker process affects no other trial.
"""

import re
import xml.etree.ElementTree as Xml
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import asdict

from trilat_net.analysis import LogMetrics
from trilat_net.core import is_core_cached
from trilat_net.errors import LawFailed, LogError, ScenarioError, TrilatError, count_nouns
from trilat_net.execution import SimulatedLog, execute_virtual, verify_log
from trilat_net.log import open_log
from trilat_net.net import SystemClock
from trilat_net.presentation import Block, MarkedText, TextTable
from trilat_net.results import Result
from trilat_net.scenario import ExperimentText, Scenario, load_scenario
from trilat_net.work import MAX_LOSSES, MeanInterval, WorkerPool, Workers

from .expectations import ExpectationResult
from .measure_run import RunMetrics
from .run_commands import format_command, list_assignments, set_options
from .side_by_side import RunKind, describe_runs_alone, prepare_kinds


class TrialResult(NamedTuple):
    """Result of running a scenario and comparing the run with its expectations.

    An expectation is a limit on a metric, stated in the scenario's table [expect].

    Attributes:
        trial: The trial.
        outcomes: Outcome of each expectation.
        simulated_s: Duration of the run according to the times of its ticks, in s.
        wall_s: Duration of the run in real time, in s.
        error: Reason why the run has no result. Empty if it has a result.
        log: Log of a live trial, if it exists.
        alone: Reason why the run was computed alone, among trials that are computed side by
            side. Empty if it was not computed alone.
    """

    trial: "Trial"
    outcomes: Sequence[ExpectationResult] = ()
    simulated_s: float = 0.0
    wall_s: float = 0.0
    error: str = ""
    log: Path | None = None
    alone: str = ""

    @property
    def held(self) -> bool:
        """True if the run was completed and met every expectation of its scenario."""
        return not self.error and all(outcome.held for outcome in self.outcomes)

    @property
    def failures(self) -> list[str]:
        """One sentence per unmet expectation, or the reason why the run has no result.

        Empty if the run met all expectations.
        """
        sentences = [f"no result: {self.error}"] if self.error else []
        sentences += [
            f"{outcome.key}: {outcome.measured}, expected {outcome.limit}"
            for outcome in self.outcomes
            if not outcome.held
        ]
        return sentences


class Trial(NamedTuple):
    """A scenario with one seed, which can be run and compared with its expectations.

    `trials` creates these objects, for example as parameters of a test.

    Attributes:
        scenario: The scenario.
        source: Name or path of the scenario, as in a command.
        overrides: Overrides KEY=VALUE of the scenario, as in a command.
        live: True if the trial runs over a network instead of in virtual time.
    """

    scenario: Scenario
    source: str
    overrides: tuple[str, ...] = ()
    live: bool = False

    def __str__(self) -> str:
        return f"{self.scenario.name}-seed{self.scenario.seed}"

    @property
    def again(self) -> str:
        """Shell command that repeats this trial with the same seed.

        Example: "trilat test jitter --seeds 3".
        """
        live = ["--live"] if self.live else []
        seeds = ["--seeds", str(self.scenario.seed)]
        return format_command("test", self.source, *live, *seeds, *set_options(self.overrides))

    @property
    def look(self) -> str:
        """Shell command that simulates this trial and records a log, to inspect a failure."""
        arguments = ["--seed", str(self.scenario.seed), "-o", f"{self}.mcap"]
        return format_command("sim", self.source, *arguments, *set_options(self.overrides))

    def evaluate(self, metrics: RunMetrics, wall_s: float) -> TrialResult:
        """Compares the metrics of a run with the expectations of its scenario.

        Args:
            metrics: Metrics of the run.
            wall_s: Duration of the run in real time, in s.

        Returns:
            The result of the trial.
        """
        outcomes = ExpectationResult.list_of_run(metrics, self.scenario.expect)
        return TrialResult(self, outcomes, metrics.simulated_s, wall_s)

    def run(self) -> TrialResult:
        """Runs the trial in virtual time, in this process.

        If a user's control law fails, the result contains the error instead of outcomes.
        """
        clock = SystemClock()
        start_ns = clock.monotonic_ns()
        try:
            metrics = RunMetrics.of_virtual_run(self.scenario)
        except LawFailed as failed:
            wall_s = (clock.monotonic_ns() - start_ns) * 1e-9
            return TrialResult(self, wall_s=wall_s, error=str(failed))
        wall_s = (clock.monotonic_ns() - start_ns) * 1e-9
        return self.evaluate(metrics, wall_s)

    def check(self) -> TrialResult:
        """Runs the trial and returns its result, or raises AssertionError if it failed.

        Raises:
            AssertionError: An expectation is not met. The message contains the reasons, and the
                commands that repeat the run and record it.
        """
        __tracebackhide__ = True  # pytest shows the reason instead of this line
        result = self.run()
        if not result.held:
            reasons = "; ".join(result.failures)
            raise AssertionError("\n  ".join([f"{self}: {reasons}", self.again, self.look]))
        return result

    def evaluate_live_log(
        self, log_file: Path, problems: Sequence[str], wall_s: float
    ) -> TrialResult:
        """Compares the run of a live session with the expectations of its scenario.

        Two expectations are added to those of the scenario: the session must have ended
        normally, and recomputing the run must reproduce all records bit for bit.

        Args:
            log_file: Log of the session, which may be missing.
            problems: Problems of the session, as sentences. Empty if the session ended
                normally.
            wall_s: Duration of the session in real time, in s.

        Returns:
            The result. If the log cannot be read, it contains the reason instead of outcomes.
        """
        existing_log = log_file if log_file.exists() else None
        try:
            log = open_log(log_file)
            if not any(len(log[name]) for name in log.sites):
                raise LogError(f"{log_file}: no records")
            result = self.evaluate(RunMetrics.of_log(log, self.scenario.expect), wall_s)
            verdict = verify_log(log)
        except LogError as error:
            text = "; ".join([*problems, str(error)])
            return TrialResult(self, wall_s=wall_s, error=text, log=existing_log)

        session = ExpectationResult(
            key="session",
            held=not problems,
            measured="; ".join(problems) or "ended in order",
            limit="ends in order",
        )
        coverage = "" if verdict.coverage.share == 1.0 else f"; judged {verdict.coverage}"
        execution = ExpectationResult(
            key="executed again",
            held=verdict.passed,
            measured=f"{verdict.identical} identical{coverage}",
            limit=count_nouns(verdict.records, "record"),
        )
        return result._replace(
            outcomes=[*result.outcomes, session, execution], log=existing_log
        )


def trials(
    source: str | Path | Mapping[str, Any] | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    live: bool = False,
) -> list[Trial]:
    """Returns the trials of a scenario, one per seed, for example as parameters of a test.

    >>> [str(trial) for trial in tn.trials("jitter", seeds=[1, 2])]
    ['jitter-seed1', 'jitter-seed2']

    In virtual time, a scenario in which nothing is random has a single trial, with the first
    seed, because all other seeds would give the same run.

    Args:
        source: Name of a shipped scenario, a path, a TOML string, its tables, or a `Scenario`.
        seeds: Random seeds. If empty, the scenario's own seed is used.
        set: Overrides, such as `{"link.delay_ms": 400}` or `["link.delay_ms=400"]`.
        live: True if the trials will run over a network.

    Raises:
        ScenarioError: The scenario, a seed or an override is not valid, or the scenario has no
            expectations.
    """
    scenario = load_scenario(source, set)
    label = ExperimentText.read(source).label
    _check_expectations_reachable(scenario, label)
    if not live:
        SimulatedLog.check_scenario(scenario)

    distinct_seeds = list(dict.fromkeys(seeds)) or [scenario.seed]
    for seed in distinct_seeds:
        if not 0 <= seed < 2**63:
            raise ScenarioError(
                f"must be from 0 to 2^63 - 1, not {seed}", path="seed", source=label
            )
    if not scenario.random and not live:
        del distinct_seeds[1:]

    overrides = tuple(list_assignments(set) if isinstance(set, Mapping) else set)
    return [
        Trial(load_scenario(scenario, seed=seed), label, overrides, live)
        for seed in distinct_seeds
    ]


def _check_expectations_reachable(scenario: Scenario, source: str) -> None:
    """Raises ScenarioError if no run of a scenario can meet its expectations.

    Args:
        scenario: The scenario.
        source: Name or path of the scenario, for error messages.

    Raises:
        ScenarioError: The scenario has no expectations, a metric is unknown, or a time lies
            after the end of the run.
    """
    expect = scenario.expect
    end_s = scenario.duration_s
    if not expect.has_expectations:
        raise ScenarioError(
            "the scenario has no expectations: add a table [expect] with keys such as "
            "stable = true or synchronised_by_s = 12.0; the template of `trilat scenario new` "
            "lists all keys",
            source=source,
        )

    for key in expect.metrics:
        try:
            LogMetrics.find_quantity(key)
        except KeyError as error:
            raise ScenarioError(
                error.args[0], path=f"expect.metrics.{key}", source=source
            ) from None

    by_s = expect.synchronised_by_s
    if by_s is not None and by_s >= end_s:
        problem = f"must be before the end of the run at {end_s:g} s, not {by_s:g}"
        raise ScenarioError(problem, path="expect.synchronised_by_s", source=source)
    for n, window in enumerate(expect.windows):
        if window.to_s > end_s:
            problem = (
                f"must not be after the end of the run at {end_s:g} s, not {window.to_s:g}"
            )
            raise ScenarioError(problem, path=f"expect.windows[{n}].to_s", source=source)


MAX_FAILURES_SHOWN = 5
"""Largest number of failed runs per scenario that are printed in full. Only the seeds of
further ones are printed.
"""

TRIAL_COLUMNS = ("", "scenario", "expected", "limit", "worst", "margin", "held")
"""Column headers of the table of expectations."""


class _ExpectationRow(NamedTuple):
    """One expectation of a scenario, with the results of all runs of this scenario.

    The runs differ in their seeds. This object is one row in the table of a `TrialReport`.

    Attributes:
        scenario: Name or path of the scenario, as in a command.
        key: Key of the expectation.
        worst: Outcome of the run that came closest to its limit, or exceeded it most.
        held: Number of runs that met the expectation.
        runs: Number of all runs.
        mean: Mean of the measured values, with its interval. `None` if it cannot be computed.
    """

    scenario: str
    key: str
    worst: ExpectationResult
    held: int
    runs: int
    mean: MeanInterval | None = None

    def cells(self) -> tuple[str, ...]:
        """Returns the cells of this row of the printed table, one for each of `TRIAL_COLUMNS`.

        They include the limit, the worst measured value, and the number of runs that met the
        expectation.
        """
        mark = "ok" if self.held == self.runs else "FAIL"
        worst = self.worst
        margin = _format_margin(self.worst.margin)
        held = f"{self.held}/{self.runs}"
        return mark, self.scenario, self.key, worst.limit, worst.measured, margin, held


@dataclass(frozen=True, repr=False)
class TrialReport(Result):
    """Results of several trials, each compared with the expectations of its scenario.

    Attributes:
        results: The results, in the order of scenarios and seeds.
        wall_s: Duration of all trials together in real time, in s.
    """

    results: list[TrialResult]
    wall_s: float

    @property
    def held(self) -> bool:
        """True if all trials met all expectations, in which case `trilat test` exits with 0."""
        return all(result.held for result in self.results)

    @property
    def scenarios(self) -> dict[str, list[TrialResult]]:
        """Maps the name or path of each scenario to the results of its trials, in order."""
        groups: dict[str, list[TrialResult]] = {}
        for result in self.results:
            groups.setdefault(result.trial.source, []).append(result)
        return groups

    def rows(self) -> list[_ExpectationRow]:
        """Combines the results of each scenario into one row per expectation.

        If some trials of a scenario have no result, an additional row states their number.
        """
        rows = []
        for name, results in self.scenarios.items():
            outcomes_by_key: dict[str, list[ExpectationResult]] = {}
            for result in results:
                for outcome in result.outcomes:
                    outcomes_by_key.setdefault(outcome.key, []).append(outcome)
            for key, outcomes in outcomes_by_key.items():
                # An unmet expectation is worse than a met one. Otherwise, the margin decides.
                worst = min(outcomes, key=lambda outcome: (outcome.held, outcome.margin or 0.0))
                row = _ExpectationRow(
                    scenario=name,
                    key=key,
                    worst=worst,
                    held=sum(outcome.held for outcome in outcomes),
                    runs=len(outcomes),
                    mean=MeanInterval.of_values([outcome.value for outcome in outcomes]),
                )
                rows.append(row)

            errors = [result.error for result in results if result.error]
            if errors:
                row = _ExpectationRow(
                    scenario=name,
                    key="a result",
                    worst=ExpectationResult("a result", False, errors[0], ""),
                    held=len(results) - len(errors),
                    runs=len(results),
                )
                rows.append(row)
        return rows

    def failures(self) -> list[str]:
        """Returns lines about each failed trial, with the commands to repeat and inspect it.

        At most `MAX_FAILURES_SHOWN` trials per scenario are explained. Empty if no trial
        failed.
        """
        lines = []
        for results in self.scenarios.values():
            failed = [result for result in results if not result.held]
            for result in failed[:MAX_FAILURES_SHOWN]:
                trial = result.trial
                reasons = "; ".join(result.failures)
                lines.append(f"{trial.source}, seed {trial.scenario.seed}: {reasons}")
                lines += [f"  {line}" for line in _list_repeat_commands(result)]

            further = failed[MAX_FAILURES_SHOWN:]
            if further:
                seeds = ", ".join(str(result.trial.scenario.seed) for result in further)
                lines.append(f"  and {len(further)} more, seeds {seeds}")
        return lines

    def remarks(self) -> list[str]:
        """Returns lines that help to interpret the results of the trials.

        They list the overrides that applied to all trials, the scenarios that ran only once
        because nothing in them is random, the duration and speed of all runs, and the reasons
        why some of them were not computed side by side.
        """
        remarks = []
        overrides = self.results[0].trial.overrides if self.results else ()
        if overrides:
            remarks.append(f"changed in all: {', '.join(overrides)}")

        first_trials = {name: results[0].trial for name, results in self.scenarios.items()}
        run_once = [
            name
            for name, trial in first_trials.items()
            if not (trial.scenario.random or trial.live)
        ]
        if run_once:
            remarks.append(f"run once, nothing in it is random: {', '.join(run_once)}")

        simulated_s = sum(result.simulated_s for result in self.results)
        is_live = any(result.trial.live for result in self.results)
        kind = "ran live" if is_live else "simulated"
        speed = f": {simulated_s / self.wall_s:.3g}x" if self.wall_s > 0.0 else ""
        runs = count_nouns(len(self.results), "run")
        remarks.append(f"{runs}, {simulated_s:.6g} s {kind} in {self.wall_s:.1f} s{speed}")
        reasons = Counter(result.alone for result in self.results if result.alone)
        remarks += filter(None, [describe_runs_alone(reasons, len(self.results))])
        return remarks

    def table(self) -> list[str]:
        """Returns the table of expectations as aligned lines, starting with the header.

        The table has one row per expectation. If there are means over the runs, they form an
        additional column.
        """
        rows = self.rows()
        cells = [row.cells() for row in rows]
        if not any(row.mean for row in rows):
            return TextTable(TRIAL_COLUMNS, cells, align="lllllrr").lines()
        means = [str(row.mean) if row.mean else "" for row in rows]
        cells = [(*texts, mean) for texts, mean in zip(cells, means, strict=True)]
        return TextTable((*TRIAL_COLUMNS, "mean, 95 %"), cells, align="lllllrrr").lines()

    def blocks(self) -> Iterator[Block]:
        """Yields the sections of the report that `trilat test` prints.

        The report consists of a table of the expectations and how well the runs met them, the
        failures, and remarks such as the duration of all runs.
        """
        header, *lines = self.table()
        yield header
        for line in lines:
            mark, _, other_columns = line.partition(" ")
            colour = "green" if mark == "ok" else "red"
            yield MarkedText(f"[{colour}]{mark}[/]", other_columns)
        yield from [*self.failures(), *self.remarks()]

    def headline(self) -> str:
        """Returns a sentence with the number of trials that met all expectations.

        Example: "19 of 20 runs as expected".
        """
        held = sum(result.held for result in self.results)
        return f"{held} of {count_nouns(len(self.results), 'run')} as expected"

    def to_dict(self) -> dict[str, Any]:
        """Converts the results to the plain values that `trilat test --json` prints.

        "again" is the command that repeats a run, and "log" the path of its log or null.
        """
        runs = [
            {
                "scenario": result.trial.source,
                "seed": result.trial.scenario.seed,
                "held": result.held,
                "error": result.error or None,
                "log": str(result.log) if result.log else None,
                "again": result.trial.again,
                "expected": [asdict(outcome) for outcome in result.outcomes],
            }
            for result in self.results
        ]
        return {"held": self.held, "wall_s": self.wall_s, "runs": runs}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of plain values, with one row for each expectation of each run.

        Loaded into a data frame, the rows show how close the runs came to their limits.
        """
        return [
            {
                "scenario": result.trial.source,
                "seed": result.trial.scenario.seed,
                **asdict(outcome),
            }
            for result in self.results
            for outcome in result.outcomes
        ]

    def encode_junit_xml(self, began_unix_ns: int, host: str) -> bytes:
        """Encodes the results as a JUnit XML document, which build servers can display.

        The document follows Jenkins' `junit-10.xsd`, with one suite per scenario and one case
        per run. A case has one `failure` that lists all unmet expectations, or an `error` if
        the run has no result.

        Args:
            began_unix_ns: Start of the trials in Unix time, in ns.
            host: Name of this machine.

        Returns:
            The document.
        """
        root = Xml.Element(
            "testsuites", _build_count_attributes(self.results), name="trilat test"
        )
        began = datetime.fromtimestamp(began_unix_ns // 10**9, UTC)
        for name, results in self.scenarios.items():
            suite = Xml.SubElement(
                root,
                "testsuite",
                _build_count_attributes(results),
                name=_replace_forbidden(name),
                skipped="0",
                timestamp=f"{began:%Y-%m-%dT%H:%M:%S}",
                hostname=_replace_forbidden(host),
            )
            _add_properties(suite, results)
            for result in results:
                _add_case(suite, result)
        Xml.indent(root)
        document: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
        return document + b"\n"


LANE_RUNS = 32
"""Number of trials that a worker gets at once, to compute them side by side."""
_RUN_ERRORS = (TrilatError, ArithmeticError, ValueError, MemoryError)
"""Errors that affect a single trial only."""


class _TrialItem(NamedTuple):
    """A trial to be run by a worker.

    Attributes:
        trial: The trial.
        is_side_by_side: True to compute it together with others, if possible.
    """

    trial: Trial
    is_side_by_side: bool

    def __str__(self) -> str:
        return str(self.trial)


def _run_trial_here(item: _TrialItem) -> TrialResult:
    """Runs a trial in this process."""
    return item.trial.run()


def _run_trial(item: _TrialItem) -> TrialResult:
    """Runs a trial in a worker process.

    An error that affects only this trial becomes its result, so the other trials of the worker
    still run.
    """
    try:
        return item.trial.run()
    except _RUN_ERRORS as error:
        return TrialResult(item.trial, error=f"{type(error).__name__}: {error}")


def _run_trials_here(items: Sequence[_TrialItem]) -> Iterator[TrialResult]:
    """Runs several trials in this process, side by side where possible."""
    return _run_side_by_side(items, _run_trial_here)


def _run_trials(items: Sequence[_TrialItem]) -> Iterator[TrialResult]:
    """Runs several trials in a worker process, side by side where possible."""
    return _run_side_by_side(items, _run_trial)


def _run_side_by_side(
    items: Sequence[_TrialItem], run_alone: Callable[[_TrialItem], TrialResult]
) -> Iterator[TrialResult]:
    """Runs several trials, side by side where possible.

    Args:
        items: The trials.
        run_alone: Runs one trial.

    Yields:
        The results in the order of the trials, equal to those of `run_alone`.
    """
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    chosen = [n for n, item in enumerate(items) if item.is_side_by_side]
    scenarios = [items[n].trial.scenario for n in chosen]
    measured: dict[int, tuple[RunMetrics, str]] = {}
    try:
        for index, metrics, obstacle in RunMetrics.of_virtual_runs(scenarios):
            measured[chosen[index]] = metrics, obstacle
    except _RUN_ERRORS:
        # One by one, only the trial whose run fails has no result.
        measured.clear()
    wall_s = (clock.monotonic_ns() - start_ns) * 1e-9 / max(len(chosen), 1)
    for n, item in enumerate(items):
        if n in measured:
            metrics, obstacle = measured[n]
            yield item.trial.evaluate(metrics, wall_s)._replace(alone=obstacle)
        else:
            yield run_alone(item)


def run_trials(
    batch: Sequence[Trial],
    jobs: int | None = None,
    done: Callable[[TrialResult], None] = lambda _: None,
    on: Workers = None,
) -> TrialReport:
    """Runs trials in virtual time and collects their results.

    No worker process is started for a single trial, or if `jobs` is 1.

    Args:
        batch: The trials.
        jobs: Number of worker processes. If `None`, one per core.
        done: Called with each result as it arrives.
        on: Address of a Dask scheduler, or an executor, whose workers run the trials. If
            `None`, they run in processes on this machine.

    Returns:
        The results, in the order of the trials.
    """
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    laws = list(dict.fromkeys(code for trial in batch for code in trial.scenario.imported_code))
    results: dict[int, TrialResult] = {}
    with WorkerPool.open(jobs, on, most=len(batch), laws=laws) as pool:
        for index, result in _iterate_results(pool, batch):
            # The result names the trial of the batch, and not the copy that a worker received.
            results[index] = result._replace(trial=batch[index])
            done(results[index])
    ordered_results = [results[index] for index in range(len(batch))]
    return TrialReport(ordered_results, (clock.monotonic_ns() - start_ns) * 1e-9)


def _iterate_results(
    pool: WorkerPool, batch: Sequence[Trial]
) -> Iterator[tuple[int, TrialResult]]:
    """Yields the index and the result of each trial, in order of completion.

    Args:
        pool: Workers that run the trials.
        batch: The trials.
    """
    if not pool.is_local and not is_core_cached():
        # The first step compiles the simulation kernel, once for all processes.
        next(execute_virtual(batch[0].scenario))
    keys = [(trial.source, trial.overrides) for trial in batch]
    counts = Counter(keys)
    kinds = {
        key: RunKind(trial.scenario, counts[key])
        for key, trial in zip(keys, batch, strict=True)
    }
    side_by_side = prepare_kinds(kinds)
    if pool.is_local and not side_by_side:
        for n, trial in enumerate(batch):
            yield n, trial.run()
        return
    items = [
        _TrialItem(trial, key in side_by_side) for key, trial in zip(keys, batch, strict=True)
    ]
    if pool.is_local:
        yield from pool.iterate_results(
            _run_trial_here, items, together=_run_trials_here, together_count=LANE_RUNS
        )
        return

    # The longest trials run first, so that no worker is left with a long trial at the end.
    longest_first = sorted(range(len(batch)), key=lambda n: -batch[n].scenario.duration_s)
    error = f"its worker process ended, {MAX_LOSSES} times"
    for index, result in pool.iterate_results(
        _run_trial,
        [items[n] for n in longest_first],
        lambda item: TrialResult(item.trial, error=error),
        len(batch),
        together=_run_trials if side_by_side else None,
        together_count=LANE_RUNS if side_by_side else 1,
    ):
        yield longest_first[index], result


def check(
    source: str | Path | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    jobs: int | None = None,
    on: Workers = None,
) -> TrialReport:
    """Runs a scenario in virtual time, once per seed, and checks its expectations.

    The command `trilat test` does the same.

    >>> tn.check("free", jobs=1).held
    True

    Args:
        source: Name of a shipped scenario, a path, or a `Scenario`.
        seeds: Random seeds. If empty, the scenario's own seed is used.
        set: Overrides, such as `{"link.delay_ms": 400}`.
        jobs: Number of worker processes. If `None`, one per core.
        on: Workers to use instead of processes on this machine: the address of a Dask
            scheduler, such as "tcp://10.0.0.5:8786", or an executor.

    Returns:
        The results, if all expectations are met.

    Raises:
        ScenarioError: The scenario or an override is not valid, or the scenario has no
            expectations.
        UsageError: The cluster cannot be reached, or a worker does not meet the requirements.
        AssertionError: An expectation is not met. The message contains the margin and the
            command that repeats the run.
    """
    __tracebackhide__ = True  # pytest shows the reason instead of this line
    report = run_trials(trials(source, seeds, set), jobs, on=on)
    for result in report.results:
        if not result.held:
            reasons = "; ".join(result.failures)
            raise AssertionError(
                f"not as expected: {result.trial}: {reasons}\n{report.summary()}"
            )
    return report


def _format_margin(margin: float | None) -> str:
    """Formats a margin in percent, with a sign.

    Margins below 10 % have one decimal place.

    Args:
        margin: Distance from a limit as a fraction of the limit. `None` becomes an empty
            string.
    """
    if margin is None:
        return ""
    digits = 0 if abs(margin) >= 0.1 else 1
    return f"{100.0 * margin:+,.{digits}f} %"


def _list_repeat_commands(result: TrialResult) -> list[str]:
    """Returns two lines with the commands that repeat a failed run and show its motion.

    A live run already has a log, so a report on this log shows the motion.
    """
    look = f"trilat report {result.log}" if result.log else result.trial.look
    return [f"again: {result.trial.again}", f"look:  {look}"]


# Characters that XML 1.0 forbids, even as character references.
_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _add_properties(suite: Xml.Element, results: Sequence[TrialResult]) -> None:
    """Adds the properties that all runs of a scenario share to its JUnit suite.

    Examples are the driver (live or virtual), the overrides and the duration.

    Args:
        suite: Suite of the scenario.
        results: Results of the scenario, at least one.
    """
    properties = Xml.SubElement(suite, "properties")
    trial = results[0].trial
    property_values = {
        "driver": "live" if trial.live else "virtual",
        "source": trial.source,
        "overrides": " ".join(trial.overrides),
        "duration_s": f"{trial.scenario.duration_s:g}",
        "simulated_s": f"{sum(result.simulated_s for result in results):.6g}",
        "random": str(trial.scenario.random).lower(),
    }
    for key, value in property_values.items():
        Xml.SubElement(properties, "property", name=key, value=_replace_forbidden(value))


def _build_count_attributes(results: Sequence[TrialResult]) -> dict[str, str]:
    """Returns the attributes of a JUnit element: tests, failures, errors and time.

    A run without a result counts as an error, and a run with an unmet expectation as a failure.
    """
    errors = sum(bool(result.error) for result in results)
    failures = sum(not result.held for result in results) - errors
    return {
        "tests": str(len(results)),
        "failures": str(failures),
        "errors": str(errors),
        "time": f"{sum(result.wall_s for result in results):.3f}",
    }


def _add_case(suite: Xml.Element, result: TrialResult) -> None:
    """Adds a run to its JUnit suite as a test case.

    A run without a result is an error. All unmet expectations of a run form one failure, whose
    text contains the commands that repeat the run.

    Args:
        suite: Suite of the scenario.
        result: Result of the run.
    """
    trial = result.trial
    case = Xml.SubElement(
        suite,
        "testcase",
        name=f"seed {trial.scenario.seed}",
        classname=f"trilat.{trial.scenario.name}",
        time=f"{result.wall_s:.3f}",
    )

    if not result.held:
        tag = "error" if result.error else "failure"
        problem_type = "error" if result.error else "expectation"
        message = _replace_forbidden("; ".join(result.failures))
        problem = Xml.SubElement(case, tag, type=problem_type, message=message)
        lines = [*result.failures, *_list_repeat_commands(result)]
        problem.text = _replace_forbidden("\n".join(lines))

    output = [_describe_outcome(outcome) for outcome in result.outcomes]
    Xml.SubElement(case, "system-out").text = _replace_forbidden("\n".join(output))


def _describe_outcome(outcome: ExpectationResult) -> str:
    """Returns a line on an expectation, with the measured value, the limit and the margin.

    Example: "FAIL error_rad: 0.031 rad, expected at most 0.02 rad".
    """
    mark = "ok" if outcome.held else "FAIL"
    margin = "" if outcome.margin is None else f" ({_format_margin(outcome.margin)})"
    return f"{mark} {outcome.key}: {outcome.measured}, expected {outcome.limit}{margin}"


def _replace_forbidden(text: str) -> str:
    """Replaces characters that XML does not allow by U+FFFD.

    The error message of a user's code may contain any character, and a build server would
    reject the complete report.
    """
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)

"""A trial: one scenario with one seed, run in virtual time or live, and evaluated.

Invariant: one command repeats a trial, and its result carries that command. A live trial is evaluated
from its log by the same code; in addition its session must end in order and its records must re-execute
bit for bit.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...errors import LawFailed, LogError, ScenarioError
from ...execution import virtual
from ...execution.verify import verify
from ...log.log_reader import open_log
from ...net.clock import SystemClock
from ...scenario import Scenario, load_scenario
from ...scenario.fields import is_distribution
from ...scenario.scenario_reader import read_experiment, reseed_scenario
from ..commands import format_command, format_toml_value, set_options
from .expectations import ExpectationResult, evaluate_expectations
from .measure_run import RunMetrics, measure_log, measure_virtual_run


class TrialResult(NamedTuple):
    """Result of a trial: an outcome per expectation, or why it came to no end; a live one has a log."""

    trial: "Trial"
    outcomes: Sequence[ExpectationResult] = ()
    simulated_s: float = 0.0
    wall_s: float = 0.0
    error: str = ""
    log: Path | None = None

    @property
    def held(self) -> bool:
        """True if the run reached its end and met all expectations."""
        return not self.error and all(outcome.held for outcome in self.outcomes)

    @property
    def failures(self) -> list[str]:
        """Unmet expectations, a sentence each."""
        missed = [outcome for outcome in self.outcomes if not outcome.held]
        words = [f"{outcome.key}: {outcome.measured}, asked {outcome.limit}" for outcome in missed]
        return [f"no result: {self.error}", *words] if self.error else words


class Trial(NamedTuple):
    """One scenario with one seed; a command calls it by its source and overrides KEY=VALUE."""

    scenario: Scenario
    source: str
    overrides: tuple[str, ...] = ()
    live: bool = False

    def __str__(self) -> str:
        return f"{self.scenario.name}-seed{self.scenario.seed}"

    @property
    def again(self) -> str:
        """The command that repeats the trial."""
        live = ["--live"] if self.live else []
        seeds = ["--seeds", str(self.scenario.seed)]
        return format_command("test", self.source, *live, *seeds, *set_options(self.overrides))

    @property
    def look(self) -> str:
        """The command that makes a log of the same run, to look at."""
        words = ["--seed", str(self.scenario.seed), "-o", f"{self}.mcap"]
        return format_command("sim", self.source, *words, *set_options(self.overrides))

    def evaluate(self, metrics: RunMetrics, wall_s: float) -> TrialResult:
        """Returns the result that metrics of this trial mean."""
        outcomes = evaluate_expectations(self.scenario.expect, metrics)
        return TrialResult(self, outcomes, metrics.simulated_s, wall_s)

    def run(self) -> TrialResult:
        """Runs the trial in virtual time, in this process."""
        clock = SystemClock()
        start_ns = clock.monotonic_ns()
        try:
            metrics = measure_virtual_run(self.scenario)
        except LawFailed as failed:
            wall_s = (clock.monotonic_ns() - start_ns) * 1e-9
            return TrialResult(self, wall_s=wall_s, error=str(failed))
        return self.evaluate(metrics, (clock.monotonic_ns() - start_ns) * 1e-9)

    def check(self) -> TrialResult:
        """Runs the trial in virtual time.

        Raises:
            AssertionError: something that is expected did not hold; it says what, and how to repeat it.
        """
        __tracebackhide__ = True  # pytest shows the reason, not this line
        result = self.run()
        if not result.held:
            reasons = "; ".join(result.failures)
            raise AssertionError("\n  ".join([f"{self}: {reasons}", self.again, self.look]))
        return result


def trials(
    source: str | Path | Mapping[str, Any] | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    live: bool = False,
) -> list[Trial]:
    """Returns the trials of a scenario, one per seed, ready to run, as for parameters of a test.

    >>> [str(trial) for trial in tn.trials("jitter", seeds=[1, 2])]
    ['jitter-seed1', 'jitter-seed2']

    In virtual time a scenario in which nothing is random has one trial, with the first of the seeds: the
    others would be the same run.

    Args:
        source: the name of a shipped scenario, a path, a TOML text, its tables, or a scenario.
        seeds: which seeds; none means the scenario's own.
        set: overrides, as in `{"link.delay_ms": 400}` or `["link.delay_ms=400"]`.
        live: whether they are to run over a network.

    Raises:
        ScenarioError: the scenario or an override is not valid, or there is no [expect] in it.
    """
    scenario = load_scenario(source, set)
    called = read_experiment(source).called
    _check_expectations_reachable(scenario, called)
    if not live:
        virtual.check_virtual(scenario)
    chosen = list(dict.fromkeys(seeds)) or [scenario.seed]
    for seed in chosen:
        if not 0 <= seed < 2**63:
            raise ScenarioError(f"must be from 0 to 2^63 - 1, is {seed}", path="seed", source=called)
    if not scenario.random and not live:
        del chosen[1:]
    texts = tuple(list_assignments(set) if isinstance(set, Mapping) else set)
    return [Trial(reseed_scenario(scenario, seed), called, texts, live) for seed in chosen]


def _check_expectations_reachable(scenario: Scenario, source: str) -> None:
    """Refuses a scenario that expects nothing, or something of a time that it does not reach."""
    expect, end_s = scenario.expect, scenario.duration_s
    if not expect.asks:
        raise ScenarioError(
            "nothing is expected of it: add a table [expect] with keys such as stable = true or "
            "synchronised_by_s = 12.0; the template of `trilat scenario new` lists them all",
            source=source,
        )
    by_s = expect.synchronised_by_s
    if by_s is not None and by_s >= end_s:
        problem = f"must be before the end of the run at {end_s:g} s, is {by_s:g}"
        raise ScenarioError(problem, path="expect.synchronised_by_s", source=source)
    for n, window in enumerate(expect.windows):
        if window.to_s > end_s:
            problem = f"must not be after the end of the run at {end_s:g} s, is {window.to_s:g}"
            raise ScenarioError(problem, path=f"expect.windows[{n}].to_s", source=source)


def list_assignments(overrides: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields overrides as the command line takes them."""
    for key, value in overrides.items():
        if isinstance(value, Mapping) and not is_distribution(value):
            yield from list_assignments(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={format_toml_value(value)}"


def evaluate_live_log(trial: Trial, log_file: Path, problems: Sequence[str], wall_s: float) -> TrialResult:
    """Returns the result of a live trial."""
    kept = log_file if log_file.exists() else None
    try:
        log = open_log(log_file)
        if not any(len(log[name]) for name in log.sites):
            raise LogError(f"{log_file}: no records")
        result = trial.evaluate(measure_log(log, trial.scenario.expect), wall_s)
        verdict = verify(log)
    except LogError as error:
        return TrialResult(trial, wall_s=wall_s, error="; ".join([*problems, str(error)]), log=kept)
    ended = "; ".join(problems) or "ended in order"
    session = ExpectationResult("session", not problems, ended, "ends in order")
    judged = "" if verdict.coverage.share == 1.0 else f"; judged {verdict.coverage}"
    identical, records = f"{verdict.identical} identical{judged}", f"{verdict.records} records"
    again = ExpectationResult("executed again", verdict.passed, identical, records)
    return result._replace(outcomes=[*result.outcomes, session, again], log=kept)

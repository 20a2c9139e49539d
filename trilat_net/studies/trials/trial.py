"""A trial: one scenario with one seed, run in virtual time or live, and evaluated.

Invariant: one command repeats a trial, and its result carries that command. A live trial is evaluated
from its log by the same code; in addition its session must end in order and its records must re-execute
bit for bit.
"""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import tomli_w

from ...errors import LawFailed, LogError, ScenarioError
from ...execution import virtual
from ...execution.verify import verify
from ...log.log_reader import open_log
from ...net.clock import SystemClock
from ...scenario import Scenario, load_scenario
from .expectations import ExpectationResult, evaluate_expectations
from .measure_run import RunMetrics, measure_log, measure_virtual_run


class TrialResult(NamedTuple):
    """Result of a trial.

    Attributes:
        trial: what was run.
        outcomes: what was expected of it, and whether it held.
        simulated_s: how much time of the experiment ran.
        wall_s: how long that took.
        error: why it did not come to an end, or "".
        log: the log of a live trial.
    """

    trial: "Trial"
    outcomes: list[ExpectationResult]
    simulated_s: float
    wall_s: float
    error: str = ""
    log: Path | None = None

    @property
    def held(self) -> bool:
        """True if the run reached its end and met all expectations."""
        return not self.error and all(outcome.held for outcome in self.outcomes)

    @property
    def failures(self) -> list[str]:
        """Unmet expectations, a sentence each."""
        words = [
            f"{outcome.key}: {outcome.measured}, asked {outcome.limit}"
            for outcome in self.outcomes
            if not outcome.held
        ]
        return [f"no result: {self.error}", *words] if self.error else words


class Trial(NamedTuple):
    """One scenario with one seed.

    Attributes:
        scenario: the experiment, with that seed.
        source: what a command calls the scenario: a shipped name or a path.
        overrides: what was changed of it, as texts KEY=VALUE.
        live: whether it runs over a network.
    """

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
        return self._command("test", self.source, *live, "--seeds", str(self.scenario.seed))

    @property
    def look(self) -> str:
        """The command that makes a log of the same run, to look at."""
        file = f"{self}.mcap"
        return self._command("sim", self.source, "--seed", str(self.scenario.seed), "-o", file)

    def _command(self, *words: str) -> str:
        sets = [word for text in self.overrides for word in ("--set", text)]
        return shlex.join(["trilat", *words, *sets])

    def evaluate(self, figures: RunMetrics, wall_s: float) -> TrialResult:
        """Returns the result that figures of this trial mean."""
        return TrialResult(
            self, evaluate_expectations(self.scenario.expect, figures), figures.simulated_s, wall_s
        )

    def run(self) -> TrialResult:
        """Runs the trial in virtual time, in this process."""
        clock = SystemClock()
        start_ns = clock.monotonic_ns()
        try:
            figures = measure_virtual_run(self.scenario)
        except LawFailed as failed:
            return TrialResult(self, [], 0.0, (clock.monotonic_ns() - start_ns) * 1e-9, str(failed))
        return self.evaluate(figures, (clock.monotonic_ns() - start_ns) * 1e-9)

    def check(self) -> TrialResult:
        """Runs the trial in virtual time.

        Raises:
            AssertionError: something that is expected did not hold; it says what, and how to repeat it.
        """
        result = self.run()
        if not result.held:
            raise AssertionError("\n  ".join([f"{self}:", *result.failures, self.again, self.look]))
        return result


def trials(
    source: str | Path | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    live: bool = False,
) -> list[Trial]:
    """Returns the trials of a scenario, one per seed, ready to run.

    In virtual time a scenario in which nothing is random has one trial, with the first of the seeds: the
    others would be the same run.

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        seeds: which seeds; none means the scenario's own.
        set: overrides, as in `{"link.delay_ms": 400}` or `["link.delay_ms=400"]`.
        live: whether they are to run over a network.

    Raises:
        ScenarioError: the scenario or an override is not valid, or there is no [expect] in it.
    """
    scenario = load_scenario(source, set)
    called = f"./{scenario.name}.toml" if isinstance(source, Scenario) else str(source)
    _check_expectations_reachable(scenario, called)
    if not live:
        virtual.check_virtual(scenario)
    chosen = list(dict.fromkeys(seeds)) or [scenario.seed]
    for seed in chosen:
        if not 0 <= seed < 2**63:
            raise ScenarioError(f"must be from 0 to 2^63 - 1, is {seed}", path="seed", source=called)
    if not scenario.random and not live:
        del chosen[1:]
    texts = tuple(_texts(set))
    return [Trial(msgspec.structs.replace(scenario, seed=seed), called, texts, live=live) for seed in chosen]


def _check_expectations_reachable(scenario: Scenario, source: str) -> None:
    """Refuses a scenario that expects nothing, or something of a time that it does not reach."""
    if not scenario.expect.asks:
        raise ScenarioError(
            "nothing is expected of it: add a table [expect] with keys such as stable = true or "
            "synchronised_by_s = 12.0; the template of `trilat scenario new` lists them all",
            source=source,
        )
    by_s = scenario.expect.synchronised_by_s
    if by_s is not None and by_s >= scenario.duration_s:
        raise ScenarioError(
            f"must be before the end of the run at {scenario.duration_s:g} s, is {by_s:g}",
            path="expect.synchronised_by_s",
            source=source,
        )
    for n, window in enumerate(scenario.expect.windows):
        if window.to_s > scenario.duration_s:
            raise ScenarioError(
                f"must not be after the end of the run at {scenario.duration_s:g} s, is {window.to_s:g}",
                path=f"expect.windows[{n}].to_s",
                source=source,
            )


def _texts(overrides: Mapping[str, Any] | Sequence[str]) -> list[str]:
    """Returns overrides as the command line takes them."""
    if not isinstance(overrides, Mapping):
        return list(overrides)
    return [text for key, value in overrides.items() for text in _assignments(key, value)]


def _assignments(key: str, value: Any) -> list[str]:
    if isinstance(value, Mapping):
        return [text for inner, entry in value.items() for text in _assignments(f"{key}.{inner}", entry)]
    return [f"{key}={_one_line(value)}"]


def _one_line(value: Any) -> str:
    """Returns a value as TOML on one line."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_one_line, value))}]"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")


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
        return TrialResult(trial, [], 0.0, wall_s, "; ".join([*problems, str(error)]), kept)
    outcomes = [
        *result.outcomes,
        ExpectationResult("session", not problems, "; ".join(problems) or "ended in order", "ends in order"),
        ExpectationResult(
            "executed again", verdict.passed, f"{verdict.identical} identical", f"{verdict.records} records"
        ),
    ]
    return result._replace(outcomes=outcomes, log=kept)

"""A trial: one scenario with one seed, run in virtual time or live, and evaluated by its [expect].

Invariant: one command repeats a trial, and its result carries that command. An evaluation is a pure function
of metrics and expectation; it states the measured value, the limit and the margin, held or not. A live trial
is evaluated from its log by the same code; in addition its session must end in order and its records must
re-execute bit for bit.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...analysis.run_end import Stability
from ...errors import LawFailed, LogError, ScenarioError
from ...execution import virtual
from ...execution.verify import verify
from ...fields import field_names, is_distribution
from ...log.log_reader import open_log
from ...net.clock import SystemClock
from ...scenario import Expect, Scenario, load_scenario
from ...scenario.scenario_reader import read_experiment, reseed_scenario
from ..commands import format_command, format_toml_value, set_options
from .measure_run import RunMetrics, measure_log, measure_virtual_run


class ExpectationResult(msgspec.Struct, frozen=True):
    """One thing that was expected of one run; values in words with their units.

    Attributes:
        key: the key of [expect] that asked, or a word for what every run must do.
        margin: how far within the limit, as a fraction of the limit: 0.1 is 10 % to spare, negative is
            beyond it. None where there is no such number.
        value: the measured number, in the unit of the limit; None where it is none.
    """

    key: str
    held: bool
    measured: str
    limit: str
    margin: float | None = None
    value: float | None = None


def evaluate_expectations(expect: Expect, metrics: RunMetrics) -> list[ExpectationResult]:
    """Returns an outcome for everything that is asked of a run, in the order of the keys of `Expect`.

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
    ]


def _evaluate_stability(expect: Expect, metrics: RunMetrics) -> Iterator[ExpectationResult]:
    wanted, end = expect.stable is not False, metrics.end
    if expect.stable is not None or end.diverged_at_s is not None:
        held = end.stability is (Stability.STABLE if wanted else Stability.NOT_STABLE)
        yield ExpectationResult("stable", held, f"{end.stability}: {end.text}", str(wanted).lower())


_UNITS = {"_rad_s": "rad/s", "_rad": "rad", "_nm": "N m", "_n": "N", "_ms": "ms", "_s": "s"}
"""Per ending of a key its unit, for people."""
_LIMITS = tuple(key for key in field_names(Expect) if re.search("_(max|min|by)(_|$)", key))


def _find_unit(key: str) -> str:
    return next((unit for ending, unit in _UNITS.items() if key.endswith(ending)), "")


def _read_metric(key: str, metrics: RunMetrics) -> float | None:
    """Returns what a limit is of; of ages that of the worst link, None if one never had a sample."""
    if not key.endswith("_ms"):
        found: float | None = getattr(metrics, re.sub("_(max|min)", "", key).replace("_by_", "_at_"))
        return found
    ages = [age.mean_ms if key.startswith("mean") else age.max_ms for age in metrics.ages.values()]
    known = [age for age in ages if age is not None]
    choose = min if "_min_" in key else max
    return choose(known) if known and len(known) == len(ages) else None


def _compare_with_limit(key: str, measured: float | None, limit: float) -> ExpectationResult:
    least, unit = "_min_" in key, _find_unit(key)
    wanted = f"{'≥' if least else '≤'} {limit:g} {unit}".rstrip()
    if measured is None:
        return ExpectationResult(key, False, "never", wanted)
    spare = measured - limit if least else limit - measured
    text = f"{measured:.4g} {unit}".rstrip()
    return ExpectationResult(key, spare >= 0.0, text, wanted, spare / limit if limit else None, measured)


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
        for key, (least, most) in window.asked:
            site = f" {window.site}" if window.site else ""
            name = f"{key}{site} {window.from_s:g}-{window.to_s:g} s"  # as in wall_mean_n s 9-15 s
            unit = _find_unit(key)
            wanted = f"{least:g} to {most:g} {unit}".rstrip()
            found = ranges.get(key)
            if found is None:
                yield ExpectationResult(name, False, "never", wanted)
                continue
            text = " to ".join(f"{value:.4g}" for value in dict.fromkeys(found))
            spare, half = min(found.least - least, most - found.most), 0.5 * (most - least)
            margin = spare / half if half else None
            value = found.most if found.least == found.most else None
            yield ExpectationResult(name, spare >= 0.0, f"{text} {unit}".rstrip(), wanted, margin, value)


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

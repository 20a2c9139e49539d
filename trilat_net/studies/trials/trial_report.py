"""Runs many trials, and shows them as a text table and as JUnit XML for GitLab, Jenkins and GitHub Actions.

Invariant: results come in the order of the trials, whatever ran them; a trial that ends its worker process
again and again costs itself and no other. A row shows the worst of its runs; every failed run appears with
the command that repeats it.
The XML follows Jenkins' `junit-10.xsd`: a suite per scenario, a case per run, one `failure` with
everything that did not hold, an `error` for a run without a result.
"""

import re
import xml.etree.ElementTree as Xml
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import asdict

from ...core.jit import is_core_cached
from ...errors import TrilatError
from ...execution import virtual
from ...net.clock import SystemClock
from ...reporting.result_text import Block, MarkedText
from ...reporting.text_table import TextTable
from ...results import Result
from ...scenario import Scenario
from ...scenario.law_consent import list_imported_laws
from ..executor import MAX_LOSSES, Workers, open_worker_pool
from ..intervals import MeanInterval, mean_interval
from .trial import ExpectationResult, Trial, TrialResult, trials

MAX_FAILURES_SHOWN = 5
"""Failed runs of a scenario that are printed in full; of the others the seeds."""

TRIAL_COLUMNS = ("", "scenario", "expected", "limit", "worst", "margin", "held")


class ExpectationRow(NamedTuple):
    """One expectation of one scenario: its worst outcome, in how many of its runs it held, and the mean."""

    scenario: str
    key: str
    worst: ExpectationResult
    held: int
    runs: int
    mean: MeanInterval | None = None

    def cells(self) -> tuple[str, ...]:
        """Returns the row's texts, under `TRIAL_COLUMNS`."""
        mark = "ok" if self.held == self.runs else "FAIL"
        worst, margin = self.worst, format_margin(self.worst.margin)
        held = f"{self.held}/{self.runs}"
        return mark, self.scenario, self.key, worst.limit, worst.measured, margin, held


@dataclass(frozen=True, repr=False)
class TrialReport(Result):
    """All results, in the order of scenarios and seeds, and how long all of them took, s."""

    results: list[TrialResult]
    wall_s: float

    @property
    def held(self) -> bool:
        """True where everything held."""
        return all(result.held for result in self.results)

    @property
    def scenarios(self) -> dict[str, list[TrialResult]]:
        """The results by scenario, as a command calls it."""
        groups: dict[str, list[TrialResult]] = {}
        for result in self.results:
            groups.setdefault(result.trial.source, []).append(result)
        return groups

    def rows(self) -> list[ExpectationRow]:
        """Returns the table: a row per scenario and expectation."""
        rows = []
        for name, results in self.scenarios.items():
            by_key: dict[str, list[ExpectationResult]] = {}
            for outcome in (outcome for result in results for outcome in result.outcomes):
                by_key.setdefault(outcome.key, []).append(outcome)
            for key, outcomes in by_key.items():  # the worst is the first that failed, then by margin
                worst = min(outcomes, key=lambda one: (one.held, one.margin or 0.0))
                held, mean = sum(one.held for one in outcomes), mean_interval([one.value for one in outcomes])
                rows.append(ExpectationRow(name, key, worst, held, len(outcomes), mean))
            if broken := [result.error for result in results if result.error]:
                worst = ExpectationResult("a result", False, broken[0], "")
                whole = len(results) - len(broken)
                rows.append(ExpectationRow(name, worst.key, worst, whole, len(results)))
        return rows

    def failures(self) -> list[str]:
        """Returns what failed and the commands that repeat it, line by line."""
        lines = []
        for results in self.scenarios.values():
            failed = [result for result in results if not result.held]
            for result in failed[:MAX_FAILURES_SHOWN]:
                trial = result.trial
                lines.append(f"{trial.source}, seed {trial.scenario.seed}: {'; '.join(result.failures)}")
                lines += [f"  {line}" for line in _repeat_lines(result)]
            if more := failed[MAX_FAILURES_SHOWN:]:
                seeds = ", ".join(str(result.trial.scenario.seed) for result in more)
                lines.append(f"  and {len(more)} more, seeds {seeds}")
        return lines

    def remarks(self) -> list[str]:
        """Returns what else there is to know: what ran once, and how fast it went."""
        first = {name: results[0].trial for name, results in self.scenarios.items()}
        once = [name for name, trial in first.items() if not (trial.scenario.random or trial.live)]
        changed = self.results[0].trial.overrides if self.results else ()
        remarks = [f"changed in all: {', '.join(changed)}"] if changed else []
        if once:
            remarks.append(f"run once, nothing in it is random: {', '.join(once)}")
        simulated_s = sum(result.simulated_s for result in self.results)
        how = "ran live" if any(result.trial.live for result in self.results) else "simulated"
        runs = "run" if len(self.results) == 1 else "runs"
        speed = f": {simulated_s / self.wall_s:.3g}x" if self.wall_s > 0.0 else ""
        took = f"{simulated_s:.6g} s {how} in {self.wall_s:.1f} s{speed}"
        return [*remarks, f"{len(self.results)} {runs}, {took}"]

    def table(self) -> list[str]:
        """Returns the table as aligned lines; the first holds the heads."""
        rows = self.rows()
        if not any(row.mean for row in rows):
            return TextTable(TRIAL_COLUMNS, [row.cells() for row in rows], align="lllllrr").lines()
        cells = [(*row.cells(), str(row.mean) if row.mean else "") for row in rows]
        return TextTable((*TRIAL_COLUMNS, "mean, 95 %"), cells, align="lllllrrr").lines()

    def blocks(self) -> Iterator[Block]:
        """Yields its text."""
        heads, *rows = self.table()
        yield heads
        for line in rows:
            mark, _, rest = line.partition(" ")
            yield MarkedText(f"[{'green' if mark == 'ok' else 'red'}]{mark}[/]", rest)
        yield from [*self.failures(), *self.remarks()]

    def headline(self) -> str:
        """Returns how many runs held."""
        return f"{sum(result.held for result in self.results)} of {len(self.results)} runs as expected"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat test --json`."""
        runs = [
            {
                "scenario": one.trial.source,
                "seed": one.trial.scenario.seed,
                "held": one.held,
                "error": one.error or None,
                "log": str(one.log) if one.log else None,
                "again": one.trial.again,
                "expected": [asdict(outcome) for outcome in one.outcomes],
            }
            for one in self.results
        ]
        return {"held": self.held, "wall_s": self.wall_s, "runs": runs}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per run and expectation."""
        return [
            {"scenario": one.trial.source, "seed": one.trial.scenario.seed, **asdict(outcome)}
            for one in self.results
            for outcome in one.outcomes
        ]


def _run_trial(trial: Trial) -> TrialResult:
    """Runs a trial in a worker; an error that no other trial would have is its result."""
    try:
        return trial.run()
    except (TrilatError, ArithmeticError, ValueError, MemoryError) as error:
        return TrialResult(trial, error=f"{type(error).__name__}: {error}")


def run_trials(
    batch: Sequence[Trial],
    jobs: int | None = None,
    done: Callable[[TrialResult], None] = lambda _: None,
    on: Workers = None,
) -> TrialReport:
    """Runs trials in virtual time and returns their results.

    Args:
        batch: the trials.
        jobs: how many processes; None for one per core. One trial, or one job, runs in this process.
        done: called with every result as it comes.
        on: what runs them instead: a Dask scheduler's address or an executor.
    """
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    laws = list_imported_laws(trial.scenario for trial in batch)
    longest_first = sorted(range(len(batch)), key=lambda n: -batch[n].scenario.duration_s)
    results: dict[int, TrialResult] = {}
    with open_worker_pool(jobs, on, most=len(batch), laws=laws) as pool:
        if pool.is_local:
            replies = ((n, trial.run()) for n, trial in enumerate(batch))
        else:
            if not is_core_cached():
                next(virtual.execute_virtual(batch[0].scenario))  # compiles, once for all processes
            queue = [batch[n] for n in longest_first]
            lost = partial(TrialResult, error=f"its worker process ended, {MAX_LOSSES} times")
            replies = (
                (longest_first[place], result)
                for place, result in pool.each(_run_trial, queue, lost, len(queue))
            )
        for n, result in replies:
            results[n] = result._replace(trial=batch[n])
            done(results[n])
    return TrialReport([results[n] for n in range(len(batch))], (clock.monotonic_ns() - start_ns) * 1e-9)


def check(
    source: str | Path | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    jobs: int | None = None,
    on: Workers = None,
) -> TrialReport:
    """Runs a scenario in virtual time, once per seed, and returns the results if all of [expect] held.

    The command is `trilat test`.

    >>> tn.check("free", jobs=1).held
    True

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        seeds: which seeds; none means the scenario's own.
        set: overrides, as in `{"link.delay_ms": 400}`.
        jobs: how many processes; None for one per core.
        on: what runs them instead: a Dask scheduler's address, as in "tcp://10.0.0.5:8786", or an executor.

    Raises:
        ScenarioError: the scenario or an override is not valid, or there is no [expect] in it.
        UsageError: the cluster cannot be reached, or one of its workers is not fit.
        AssertionError: something did not hold; it says what, by how much, and how to repeat it.
    """
    __tracebackhide__ = True  # pytest shows the reason, not this line
    report = run_trials(trials(source, seeds, set), jobs, on=on)
    if not report.held:
        first = next(f"{one.trial}: {'; '.join(one.failures)}" for one in report.results if not one.held)
        raise AssertionError(f"not as expected: {first}\n{report.summary()}")
    return report


def format_margin(margin: float | None) -> str:
    """Returns a margin in percent; "" where there is none."""
    return "" if margin is None else f"{100.0 * margin:+,.{0 if abs(margin) >= 0.1 else 1}f} %"


def _repeat_lines(result: TrialResult) -> list[str]:
    look = f"trilat report {result.log}" if result.log else result.trial.look
    return [f"again: {result.trial.again}", f"look:  {look}"]


_NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def encode_junit_xml(report: TrialReport, began_unix_ns: int, host: str) -> bytes:
    """Returns the results as an XML document."""
    root = Xml.Element("testsuites", _counts(report.results), name="trilat test")
    began = datetime.fromtimestamp(began_unix_ns // 10**9, UTC)
    for name, results in report.scenarios.items():
        suite = Xml.SubElement(
            root,
            "testsuite",
            _counts(results),
            name=_clean(name),
            skipped="0",
            timestamp=f"{began:%Y-%m-%dT%H:%M:%S}",
            hostname=_clean(host),
        )
        properties = Xml.SubElement(suite, "properties")
        trial = results[0].trial
        told = {
            "driver": "live" if trial.live else "virtual",
            "source": trial.source,
            "overrides": " ".join(trial.overrides),
            "duration_s": f"{trial.scenario.duration_s:g}",
            "simulated_s": f"{sum(result.simulated_s for result in results):.6g}",
            "random": str(trial.scenario.random).lower(),
        }
        for key, value in told.items():
            Xml.SubElement(properties, "property", name=key, value=_clean(value))
        for result in results:
            _add_case(suite, result)
    Xml.indent(root)
    document: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return document + b"\n"


def _counts(results: Sequence[TrialResult]) -> dict[str, str]:
    errors = sum(bool(result.error) for result in results)
    failures = sum(not result.held for result in results) - errors
    return {
        "tests": str(len(results)),
        "failures": str(failures),
        "errors": str(errors),
        "time": f"{sum(result.wall_s for result in results):.3f}",
    }


def _add_case(suite: Xml.Element, result: TrialResult) -> None:
    trial = result.trial
    case = Xml.SubElement(
        suite,
        "testcase",
        name=f"seed {trial.scenario.seed}",
        classname=f"trilat.{trial.scenario.name}",
        time=f"{result.wall_s:.3f}",
    )
    if not result.held:
        kind, why = ("error", "error") if result.error else ("failure", "expectation")
        found = Xml.SubElement(case, kind, type=why, message=_clean("; ".join(result.failures)))
        found.text = _clean("\n".join([*result.failures, *_repeat_lines(result)]))
    lines = [
        f"{'ok' if o.held else 'FAIL'} {o.key}: {o.measured}, asked {o.limit}"
        + (f" ({format_margin(o.margin)})" if o.margin is not None else "")
        for o in result.outcomes
    ]
    Xml.SubElement(case, "system-out").text = _clean("\n".join(lines))


def _clean(text: str) -> str:
    """Returns text without the characters that no XML document may hold, not even escaped."""
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)

"""The results of many trials as a text table and as JUnit XML for GitLab, Jenkins and GitHub Actions.

Invariant: a row shows the worst of its runs; every failed run appears with the command that repeats it.
The XML follows Jenkins' `junit-10.xsd`: a suite per scenario, a case per run, one `failure` with
everything that did not hold, an `error` for a run without a result.
"""

import re
import xml.etree.ElementTree as Xml
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from msgspec.structs import asdict

from ...reporting.result_text import Block, MarkedText
from ...reporting.text_table import TextTable
from ...results import Result
from ..intervals import MeanInterval, mean_interval
from .expectations import ExpectationResult
from .trial import TrialResult

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
        return [row for name, results in self.scenarios.items() for row in _rows(name, results)]

    def failures(self) -> list[str]:
        """Returns what failed and the commands that repeat it, line by line."""
        return [line for results in self.scenarios.values() for line in _failure_lines(results)]

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


def format_margin(margin: float | None) -> str:
    """Returns a margin in percent; "" where there is none."""
    return "" if margin is None else f"{100.0 * margin:+,.{0 if abs(margin) >= 0.1 else 1}f} %"


def _rows(name: str, results: Sequence[TrialResult]) -> list[ExpectationRow]:
    by_key: dict[str, list[ExpectationResult]] = {}
    for result in results:
        for outcome in result.outcomes:
            by_key.setdefault(outcome.key, []).append(outcome)

    def order(outcome: ExpectationResult) -> tuple[bool, float]:
        return outcome.held, outcome.margin or 0.0  # the failed first, then by margin

    rows = [
        ExpectationRow(
            name,
            key,
            min(outcomes, key=order),
            sum(outcome.held for outcome in outcomes),
            len(outcomes),
            mean_interval([outcome.value for outcome in outcomes]),
        )
        for key, outcomes in by_key.items()
    ]
    if broken := [result.error for result in results if result.error]:
        outcome = ExpectationResult("a result", False, broken[0], "")
        rows.append(ExpectationRow(name, outcome.key, outcome, len(results) - len(broken), len(results)))
    return rows


def _failure_lines(results: Sequence[TrialResult]) -> list[str]:
    failed = [result for result in results if not result.held]
    lines = []
    for result in failed[:MAX_FAILURES_SHOWN]:
        trial = result.trial
        lines.append(f"{trial.source}, seed {trial.scenario.seed}: {'; '.join(result.failures)}")
        lines += [f"  {line}" for line in _repeat_lines(result)]
    if more := failed[MAX_FAILURES_SHOWN:]:
        seeds = ", ".join(str(result.trial.scenario.seed) for result in more)
        lines.append(f"  and {len(more)} more, seeds {seeds}")
    return lines


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
        for key, value in _properties(results):
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


def _properties(results: Sequence[TrialResult]) -> list[tuple[str, str]]:
    trial = results[0].trial
    return [
        ("driver", "live" if trial.live else "virtual"),
        ("source", trial.source),
        ("overrides", " ".join(trial.overrides)),
        ("duration_s", f"{trial.scenario.duration_s:g}"),
        ("simulated_s", f"{sum(result.simulated_s for result in results):.6g}"),
        ("random", str(trial.scenario.random).lower()),
    ]


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

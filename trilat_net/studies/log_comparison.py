"""Logs side by side: the differences of their experiments, their metrics, and remarks on each.

Invariant: numbers are given and nothing is ranked.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from ..analysis.metrics.log_metrics import MetricComparison, compare_metrics, comparison_to_json
from ..errors import UsageError, count_nouns
from ..log.log_reader import Log, open_log
from ..reporting.certificate_text import describe_judgement
from ..reporting.result_text import Block, MarkedText, TextTable, format_number
from ..results import Result
from ..scenario.describe import ScenarioDifference, compare_scenarios
from ..scenario.scenario_reader import reseed_scenario
from ..theory.linear_analysis import certify_run
from .intervals import MeanInterval, mean_interval
from .tuning.candidate import check_final_posture

_MOST_REASONS = 6


@dataclass(frozen=True, repr=False)
class LogComparison(Result):
    """Logs side by side.

    Attributes:
        logs: the logs.
        metrics: a row per quantity, a column per log.
        differences: of the experiments; none if it is one and the same.
        means: of each row, over logs that differ in their seeds alone; () of other logs.
        remarks: per column the judgement of the run, and what is to be known of its end.
    """

    logs: tuple[Log, ...]
    metrics: MetricComparison
    differences: list[ScenarioDifference]
    means: Sequence[MeanInterval | None]
    remarks: dict[str, list[str]]

    def headline(self) -> str:
        """Returns what is compared."""
        return f"{', '.join(self.metrics.columns)}: {count_nouns(len(self.metrics.rows), 'quantity')}"

    def blocks(self) -> Iterator[Block]:
        """Yields the differences of the experiments, the quantities of the logs, and remarks
        per log.
        """
        names = {log.scenario.name for log in self.logs}
        if len(names) > 1:
            yield f"logs of different scenarios: {', '.join(sorted(names))}"
        if self.differences:
            rows = [(str(one), *one.values) for one in self.differences]
            yield from ("", TextTable(("differs", *self.metrics.columns), rows))
        else:
            yield "one and the same experiment"
        yield from ("", _tabulate_quantities(self.metrics, self.means), "")
        for name, lines in self.remarks.items():
            yield from (MarkedText("[bold]note[/bold]", f"{name}: {line}") for line in lines)
        reasons = [
            f"{name}: no {row.quantity.name}: {entry.why}"
            for row in self.metrics.rows
            for name, entry in zip(self.metrics.columns, row.entries, strict=True)
            if entry.value is None and entry.applies
        ]
        yield from reasons[:_MOST_REASONS]
        if len(reasons) > _MOST_REASONS:
            yield f"and {len(reasons) - _MOST_REASONS} more, which --json names"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat compare --json`."""
        logs = [
            {
                "name": name,
                "file": log.source,
                "scenario": log.scenario.name,
                "sha256": log.scenario.sha256,
            }
            for name, log in zip(self.metrics.columns, self.logs, strict=True)
        ]
        facts: dict[str, Any] = {
            "logs": logs,
            "differences": [one._asdict() for one in self.differences],
        }
        facts |= {"remarks": self.remarks, **comparison_to_json(self.metrics)}
        if self.means:
            pairs = zip(self.metrics.rows, self.means, strict=True)
            facts["means"] = {row.quantity.key: mean._asdict() for row, mean in pairs if mean}
        return facts

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per quantity."""
        return [
            {
                "key": row.quantity.key,
                "unit": row.quantity.unit,
                **dict(zip(self.metrics.columns, row.values, strict=True)),
            }
            for row in self.metrics.rows
        ]


def compare(*logs: str | Path | Log) -> LogComparison:
    """Compares logs side by side, with the differences of their experiments; the command is
    `trilat compare`.

    >>> logs = [tn.simulate("two_sites", {"control.Kd": Kd}, duration_s=0.1) for Kd in (3, 5)]
    >>> len(tn.compare(*logs).metrics.row("rms_error_rad").values)
    2

    Raises:
        UsageError: there are fewer than two logs.
        LogError: a log cannot be read.
    """
    opened = [log if isinstance(log, Log) else open_log(log) for log in logs]
    if len(opened) < 2:
        raise UsageError(
            "name two logs or more; or a scenario, as in: trilat compare --tune free"
        )
    names = name_columns([Path(log.sources[0]) for log in opened])
    remarks = {
        name: [describe_judgement(certify_run(log)), *check_final_posture(log)]
        for name, log in zip(names, opened, strict=True)
    }
    found = compare_metrics(opened, names)
    differences = list(compare_scenarios([log.scenario for log in opened]))
    return LogComparison(
        tuple(opened), found, differences, average_repeats(opened, found), remarks
    )


def name_columns(files: Sequence[Path]) -> list[str]:
    """Returns a column name per log: the file's name, with as much of its path as tells them
    apart.
    """
    for depth in range(1, max(len(file.parts) for file in files) + 1):
        names = ["/".join(file.with_suffix("").parts[-depth:]) for file in files]
        if len(set(names)) == len(names):
            return names
    return [f"{n}: {file}" for n, file in enumerate(files, 1)]


def average_repeats(logs: Sequence[Log], found: MetricComparison) -> list[MeanInterval | None]:
    """Returns the mean of each quantity over logs that differ in their seeds alone; [] of other
    logs.
    """
    first = logs[0].scenario
    if len({log.scenario.seed for log in logs}) < len(logs):
        return []
    if any(reseed_scenario(log.scenario, first.seed) != first for log in logs):
        return []
    return [mean_interval(row.values) for row in found.rows]


def _tabulate_quantities(
    found: MetricComparison, means: Sequence[MeanInterval | None]
) -> TextTable:
    """Returns a row per quantity and a column per log; and one of the means where the logs are
    repeats.
    """
    rows: list[list[str]] = []
    of_row = dict(zip(found.rows, means, strict=True)) if means else {}
    for group, members in groupby(found.rows, key=lambda row: row.quantity.group):
        rows.append([group])
        for row in members:
            values = [format_number(value, 4) for value in row.values]
            values += [str(of_row[row] or "-")] if means else []
            rows.append([f"  {row.quantity.name}", row.quantity.unit or "-", *values])
    heads = ("", "unit", *found.columns, *(["mean, 95 %"] if means else []))
    return TextTable(heads, rows, align="llr")

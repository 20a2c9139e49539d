"""Compares logs of runs: differences between their scenarios, their metrics, and remarks.

Invariant:
    - The comparison states measured values and does not rank the runs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from trilat_net.analysis import LogMetrics, Metric, Quantity, certify_run
from trilat_net.errors import UsageError, count_nouns, join_words
from trilat_net.log import Log, open_log
from trilat_net.presentation import (
    Block,
    MarkedText,
    TextTable,
    describe_judgement,
    format_number,
)
from trilat_net.results import Result
from trilat_net.scenario import ScenarioDifference, load_scenario
from trilat_net.work import MeanInterval

from .tuning.candidate import check_final_posture

_MOST_REASONS = 6
"""Largest number of reasons for missing metrics that the report lists."""
MOST_METRICS = 10
"""Largest number of metrics in the short report."""
_ROUNDING_KEYS = ("unaccounted_j",)
"""Keys of metrics that consist only of rounding errors."""
_NEGLIGIBLE = {
    "": 0.01,
    "s": 0.1,
    "1/s": 0.01,
    "ms": 1.0,
    "us": 100.0,
    "rad": 1e-3,
    "m": 1e-3,
    "N": 0.1,
    "N m": 0.1,
    "N²m²s": 1.0,
    "J": 0.1,
}
"""For each unit, the magnitude below which a value is negligible for a person moving an arm.

A force of 0.1 N and a distance of 1 mm can hardly be felt or seen. Without such a scale, a
change from 0 to 0.06 N m would count as much as a change from 0 to 10 N m.
"""
_UNDELAYED_KEYS = ("undelayed_max_rad", "undelayed_max_m")
"""Keys of the metrics for the largest distance from the peers' positions at the same time."""
_SUBJECTS = {
    "max": "largest of {}s",
    "sum": "sum of {}s",
}
"""Describes how the value of a run is computed from those of its parts, by `reduction`."""


class _ComparisonRow(NamedTuple):
    """One measured quantity, such as a mean error, in several runs, as a row of a table.

    Attributes:
        quantity: The quantity.
        entries: The metric of the quantity in each run, in the order of the columns.
    """

    quantity: Quantity
    entries: tuple[Metric, ...]

    @property
    def values(self) -> tuple[float | None, ...]:
        """Value of the quantity in each of the compared logs. `None` where it is missing."""
        return tuple(entry.value for entry in self.entries)


class MetricComparison(NamedTuple):
    """Metrics of several runs side by side, as a table.

    Attributes:
        columns: Names of the runs.
        rows: All quantities that apply to at least one of the runs, in display order.
    """

    columns: tuple[str, ...]
    rows: tuple[_ComparisonRow, ...]

    def row(self, key: str) -> _ComparisonRow:
        """Looks up one quantity, such as a mean error, in all compared logs.

        Args:
            key: Key of the quantity, such as "sharing_off".

        Raises:
            KeyError: No row has this key.
        """
        row_by_key = {row.quantity.key: row for row in self.rows}
        return row_by_key[key]

    @classmethod
    def of_logs(cls, logs: Sequence[Log], names: Sequence[str] = ()) -> "MetricComparison":
        """Computes the same quantities from several logs for one table.

        Args:
            logs: The logs, which may be truncated, short or empty.
            names: Names of the columns. Default: the file names of the logs.

        Raises:
            LogError: A record cannot be read, or contains an invalid change of a setting.
        """
        measured = [LogMetrics.of_log(log) for log in logs]
        rows = []
        for quantity in Quantity.list_all():
            entries = tuple(metrics.run_value(quantity) for metrics in measured)
            if any(entry.applies for entry in entries):
                rows.append(_ComparisonRow(quantity, entries))
        columns = list(names)
        if not columns:
            columns = [Path(log.source).stem for log in logs]
        return cls(tuple(columns), tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """Converts the comparison to plain values for JSON.

        A missing value is `None`, and a separate entry states the reason.
        """
        rows = []
        for row in self.rows:
            quantity = row.quantity
            content = {
                "key": quantity.key,
                "name": quantity.name,
                "unit": quantity.unit,
                "group": quantity.group,
                "values": list(row.values),
                "unknown": [entry.why or None for entry in row.entries],
            }
            rows.append(content)
        return {"columns": list(self.columns), "rows": rows}


@dataclass(frozen=True, repr=False)
class LogComparison(Result):
    """Differences between several logs, in their metrics and in their scenarios.

    `compare` creates this object.

    Attributes:
        logs: The logs.
        metrics: The metrics, with one row per quantity and one column per log.
        differences: Differences between the scenarios. Empty if all scenarios are the same.
        means: Mean of each row, if the logs differ only in their random seeds. Empty otherwise.
        remarks: For each column, the verdict on the run and remarks on its end.
    """

    logs: tuple[Log, ...]
    metrics: MetricComparison
    differences: list[ScenarioDifference]
    means: Sequence[MeanInterval | None]
    remarks: dict[str, list[str]]

    @property
    def links_differ(self) -> bool:
        """True if the network links of the compared runs differ, for example in their delay."""
        return any(difference.concerns_link for difference in self.differences)

    def headline(self) -> str:
        """Returns the names of the compared logs and the number of quantities.

        Example: "a, b: 14 quantities".
        """
        quantities = count_nouns(len(self.metrics.rows), "quantity")
        return f"{', '.join(self.metrics.columns)}: {quantities}"

    def blocks(self) -> Iterator[Block]:
        """Yields the sections of the full report that `trilat compare --all` prints.

        The report lists the differences between the scenarios, a table of all metrics, notes on
        how each run ended, and the reasons for missing values.
        """
        yield from self._compose_differences()
        yield ""
        yield _tabulate_quantities(self.metrics.rows, self.metrics.columns, self.means)
        yield ""
        for name, lines in self.remarks.items():
            for line in lines:
                yield MarkedText("[bold]note[/bold]", f"{name}: {line}")

        reasons = list(self._explain_missing_values())
        yield from reasons[:_MOST_REASONS]
        hidden = len(reasons) - _MOST_REASONS
        if hidden > 0:
            yield f"and {hidden} more, which --json names"

    def brief_blocks(self) -> Iterator[Block]:
        """Yields the sections of the short report that `trilat compare` prints without --all.

        The report lists the differences between the scenarios, the verdict on each run, the
        metrics that differ most, and a one-sentence summary.
        """
        yield from self._compose_differences()
        yield ""
        for name, lines in self.remarks.items():
            for line in lines:
                yield MarkedText("[bold]note[/bold]", f"{name}: {line}")

        shown_keys = _UNDELAYED_KEYS if self.links_differ else ()
        rows = _select_most_different(self.metrics.rows, shown_keys)
        if rows:
            shown_rows = set(rows)
            means = [
                mean
                for row, mean in zip(self.metrics.rows, self.means, strict=False)
                if row in shown_rows
            ]
            yield ""
            yield _tabulate_quantities(rows, self.metrics.columns, means)
        yield ""
        yield self._sum_up(rows)
        count = count_nouns(len(self.metrics.rows), "metric")
        yield f"--all prints all {count}, and why numbers are missing"

        first, *others = (log.source for log in self.logs)
        if others:
            files = " ".join(f"--with {file}" for file in others)
            yield f"to see the runs together: trilat figure {first} {files}"

    def _compose_differences(self) -> Iterator[Block]:
        """Yields a table with one row per difference between the scenarios.

        If the names of the scenarios differ, a sentence states this. If nothing differs, a
        sentence replaces the table.
        """
        names = {log.scenario.name for log in self.logs}
        if len(names) > 1:
            sorted_names = ", ".join(sorted(names))
            yield f"logs of different scenarios: {sorted_names}"

        if self.differences:
            header = ("differs", *self.metrics.columns)
            rows = [(str(difference), *difference.values) for difference in self.differences]
            yield ""
            yield TextTable(header, rows)
        else:
            yield "the same experiment"

    def _describe_undelayed_errors(self) -> str:
        """Returns a phrase with each arm's largest distance from its peers' true positions.

        The ordinary errors compare an arm with the delayed states that it has received from its
        peers, and therefore hardly change with a longer delay.
        """
        texts = []
        for row in self.metrics.rows:
            if row.quantity.key not in _UNDELAYED_KEYS:
                continue
            for name, value in zip(self.metrics.columns, row.values, strict=True):
                texts.append(f"{format_number(value, 3)} {row.quantity.unit} in {name}")
        if not texts:
            return ""
        return (
            f"; with the delay included, a site is at most {join_words(texts)} from where its "
            "peers are at the same time, which e does not show: e compares with what the site "
            "had received of them"
        )

    def _sum_up(self, rows: Sequence[_ComparisonRow]) -> str:
        """Returns a sentence with the verdict on each run and the quantity that differs most.

        Args:
            rows: The metrics that differ most.
        """
        verdicts = []
        for name, lines in self.remarks.items():
            verdict = lines[0].partition("; rests on")[0].partition(":")[0]
            verdicts.append(f"{name} is {verdict}")

        text = f"in short: {join_words(verdicts)}"
        if not rows:
            return f"{text}; no metric differs"
        widest = max(rows, key=_measure_difference)
        if _measure_difference(widest) == 0.0:
            return f"{text}; no metric differs by more than a negligible amount"

        values = [format_number(value, 4) for value in widest.values]
        unit = f" {widest.quantity.unit}" if widest.quantity.unit else ""
        name = widest.quantity.name
        text += f"; the largest difference: {name}, {join_words(values)}{unit}"
        if self.links_differ:
            text += self._describe_undelayed_errors()
        return text

    def _explain_missing_values(self) -> Iterator[str]:
        """Yields one sentence per metric that applies to a log but has no value there.

        Example: "b: no settling time: the arms were still moving". Metrics that do not apply,
        such as those of a wall in a run without one, need no explanation.
        """
        for row in self.metrics.rows:
            for name, entry in zip(self.metrics.columns, row.entries, strict=True):
                is_missing = entry.value is None
                if is_missing and entry.applies:
                    yield f"{name}: no {row.quantity.name}: {entry.why}"

    def to_dict(self) -> dict[str, Any]:
        """Converts the comparison to plain values for `trilat compare --json`."""
        logs = []
        for name, log in zip(self.metrics.columns, self.logs, strict=True):
            entry = {
                "name": name,
                "file": log.source,
                "scenario": log.scenario.name,
                "sha256": log.scenario.sha256,
            }
            logs.append(entry)

        comparison: dict[str, Any] = {
            "logs": logs,
            "differences": [difference._asdict() for difference in self.differences],
            "remarks": self.remarks,
            **self.metrics.to_dict(),
        }
        if self.means:
            means = {}
            for row, mean in zip(self.metrics.rows, self.means, strict=True):
                if mean is not None:
                    means[row.quantity.key] = mean._asdict()
            comparison["means"] = means
        return comparison

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one row per metric, with the value of each log keyed by its column name."""
        rows = []
        for row in self.metrics.rows:
            quantity = row.quantity
            values = dict(zip(self.metrics.columns, row.values, strict=True))
            cells = {"key": quantity.key, "unit": quantity.unit, **values}
            rows.append(cells)
        return rows


def compare(*logs: str | Path | Log) -> LogComparison:
    """Compares logs: their metrics, and the scenarios that they were recorded from.

    The command `trilat compare` does the same.

    >>> logs = [tn.simulate("two_sites", {"control.Kd": Kd}, duration_s=0.1) for Kd in (3, 5)]
    >>> len(tn.compare(*logs).metrics.row("rms_error_rad").values)
    2

    Args:
        logs: Logs or their paths, at least two.

    Raises:
        UsageError: There are fewer than two logs.
        LogError: A log cannot be read.
    """
    opened = [log if isinstance(log, Log) else open_log(log) for log in logs]
    if len(opened) < 2:
        raise UsageError(
            "name at least two logs; or a scenario, as in: trilat compare --tune free"
        )

    files = [Path(log.sources[0]) for log in opened]
    names = _name_columns(files)

    remarks = {}
    for name, log in zip(names, opened, strict=True):
        judgement = certify_run(log, own_laws=log.may_run_user_laws)
        verdict = describe_judgement(judgement)
        remarks[name] = [verdict, *check_final_posture(log)]

    metrics = MetricComparison.of_logs(opened, names)
    scenarios = [log.scenario for log in opened]

    return LogComparison(
        logs=tuple(opened),
        metrics=metrics,
        differences=ScenarioDifference.list_between(scenarios),
        means=_average_repeats(opened, metrics),
        remarks=remarks,
    )


def _measure_difference(row: _ComparisonRow) -> float:
    """Returns the spread of the values of a metric, relative to their magnitude.

    The negligible magnitude m of the unit is part of the scale:

        (largest value - smallest value) / (m + largest absolute value)

    Args:
        row: The metric in each run.

    Returns:
        The relative difference, or 0 if fewer than two values are known or all are negligible.
    """
    known_values = [value for value in row.values if value is not None]
    largest = max(map(abs, known_values), default=0.0)
    negligible = _NEGLIGIBLE[row.quantity.unit]
    if largest < negligible:
        return 0.0
    return (max(known_values) - min(known_values)) / (negligible + largest)


def _select_most_different(
    rows: Sequence[_ComparisonRow], shown_keys: Sequence[str]
) -> list[_ComparisonRow]:
    """Selects the metrics that differ most between runs, and returns them in table order.

    Metrics that consist of rounding errors are excluded, because they differ in every run.
    Metrics whose values are all negligible come last.

    Args:
        rows: The metrics of the runs.
        shown_keys: Keys of metrics that are included even if they differ little.
    """
    differences = {}
    for index, row in enumerate(rows):
        known_values = {value for value in row.values if value is not None}
        is_notable = len(known_values) > 1 and row.quantity.key not in _ROUNDING_KEYS
        if is_notable or row.quantity.key in shown_keys:
            differences[index] = _measure_difference(row)

    def rank(index: int) -> tuple[bool, float, int]:
        """Returns a sort key that puts `shown_keys` first, then the largest differences."""
        return rows[index].quantity.key not in shown_keys, -differences[index], index

    ranked_rows = sorted(differences, key=rank)
    return [rows[index] for index in sorted(ranked_rows[:MOST_METRICS])]


def _name_columns(files: Sequence[Path]) -> list[str]:
    """Returns a short and distinct column name for each log.

    Each name is the file name without its suffix, preceded by as many of its folders as are
    needed to distinguish all files.

    Args:
        files: Paths of the logs.
    """
    most_parts = max(len(file.parts) for file in files)
    for depth in range(1, most_parts + 1):
        names = []
        for file in files:
            parts = file.with_suffix("").parts
            name = "/".join(parts[-depth:])
            names.append(name)
        if len(set(names)) == len(names):
            return names
    # Some paths are equal, or differ only in their suffix.
    return [f"{n}: {file}" for n, file in enumerate(files, 1)]


def _average_repeats(
    logs: Sequence[Log], metrics: MetricComparison
) -> list[MeanInterval | None]:
    """Averages each quantity over logs that repeat one experiment with different seeds.

    Args:
        logs: The logs.
        metrics: Their metrics.

    Returns:
        The mean of each row, or `None` where it cannot be computed. Empty if the logs differ in
        more than their seeds.
    """
    first = logs[0].scenario
    seeds = {log.scenario.seed for log in logs}
    if len(seeds) < len(logs):
        return []
    if any(load_scenario(log.scenario, seed=first.seed) != first for log in logs):
        return []
    return [MeanInterval.of_values(row.values) for row in metrics.rows]


def _tabulate_quantities(
    metrics: Sequence[_ComparisonRow],
    columns: Sequence[str],
    means: Sequence[MeanInterval | None],
) -> TextTable:
    """Returns a table with one row per quantity and one column per log, in groups.

    Args:
        metrics: The metrics.
        columns: Names of the logs.
        means: Mean of each row, for an additional column. May be empty.
    """
    rows: list[list[str]] = []
    mean_by_row = dict(zip(metrics, means, strict=True)) if means else {}
    for group, members in groupby(metrics, key=lambda row: row.quantity.group):
        rows.append([group])
        for row in members:
            quantity = row.quantity
            subject = ""
            if quantity.of != "run":
                subject = _SUBJECTS[quantity.reduction].format(quantity.of)
            cells = [f"  {quantity.name}", quantity.unit or "-", subject]
            cells += [format_number(value, 4) for value in row.values]
            if means:
                cells.append(str(mean_by_row[row] or "-"))
            rows.append(cells)
    header = ["", "unit", "over", *columns]
    if means:
        header.append("mean, 95 %")
    return TextTable(tuple(header), rows, align="lllr")

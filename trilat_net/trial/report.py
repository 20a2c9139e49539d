"""The results of many trials: the table of what held, and how to repeat what did not.

Law: a row shows the worst of its runs; every failed run is named with the command that repeats it.
"""

from collections.abc import Sequence
from typing import NamedTuple

from .judgement import Outcome
from .trial import Result

SHOWN = 5
"""So many failed runs of a scenario are told in full; of the others the seeds."""

COLUMNS = ("", "scenario", "expected", "limit", "worst", "margin", "held")
_NUMBERS = ("margin", "held")


class Row(NamedTuple):
    """One expectation of one scenario, over all its runs.

    Attributes:
        scenario: which.
        key: what was expected.
        worst: the outcome with the least margin; a failed one where there is one.
        held: in how many runs it held.
        runs: of how many.
    """

    scenario: str
    key: str
    worst: Outcome
    held: int
    runs: int

    def cells(self) -> tuple[str, ...]:
        """Returns the row's texts, under `COLUMNS`."""
        mark = "ok" if self.held == self.runs else "FAIL"
        worst = self.worst
        return (
            mark,
            self.scenario,
            self.key,
            worst.limit,
            worst.measured,
            margin_text(worst.margin),
            f"{self.held}/{self.runs}",
        )


class Report(NamedTuple):
    """All results, in the order of scenarios and seeds.

    Attributes:
        results: one per run.
        wall_s: how long all of them took.
    """

    results: list[Result]
    wall_s: float

    @property
    def held(self) -> bool:
        """True where everything held."""
        return all(result.held for result in self.results)

    @property
    def scenarios(self) -> dict[str, list[Result]]:
        """The results by scenario, as a command calls it."""
        groups: dict[str, list[Result]] = {}
        for result in self.results:
            groups.setdefault(result.trial.source, []).append(result)
        return groups

    def rows(self) -> list[Row]:
        """Returns the table: a row per scenario and expectation."""
        return [row for name, results in self.scenarios.items() for row in _rows(name, results)]

    def failures(self) -> list[str]:
        """Returns what failed and the commands that repeat it, line by line."""
        return [line for results in self.scenarios.values() for line in _failure_lines(results)]

    def remarks(self) -> list[str]:
        """Returns what else there is to know: what ran once, and how fast it went."""
        once = [
            name
            for name, results in self.scenarios.items()
            if not (results[0].trial.scenario.random or results[0].trial.live)
        ]
        changed = self.results[0].trial.overrides if self.results else ()
        remarks = [f"changed in all: {', '.join(changed)}"] if changed else []
        if once:
            remarks.append(f"run once, nothing in it is random: {', '.join(once)}")
        simulated_s = sum(result.simulated_s for result in self.results)
        how = "ran live" if any(result.trial.live for result in self.results) else "simulated"
        runs = "run" if len(self.results) == 1 else "runs"
        speed = f": {simulated_s / self.wall_s:.3g}x" if self.wall_s > 0.0 else ""
        return [
            *remarks,
            f"{len(self.results)} {runs}, {simulated_s:.6g} s {how} in {self.wall_s:.1f} s{speed}",
        ]

    def table(self) -> list[str]:
        """Returns the table as aligned lines; the first holds the heads."""
        table = [COLUMNS, *(row.cells() for row in self.rows())]
        widths = [max(len(cells[n]) for cells in table) for n in range(len(COLUMNS))]
        return [
            "  ".join(
                cell.rjust(width) if column in _NUMBERS else cell.ljust(width)
                for cell, width, column in zip(cells, widths, COLUMNS, strict=True)
            ).rstrip()
            for cells in table
        ]

    def text(self) -> str:
        """Returns all of it as plain text."""
        return "\n".join([*self.table(), *self.failures(), *self.remarks()])


def margin_text(margin: float | None) -> str:
    """Returns a margin in percent; "" where there is none."""
    return "" if margin is None else f"{100.0 * margin:+,.{0 if abs(margin) >= 0.1 else 1}f} %"


def _rows(name: str, results: Sequence[Result]) -> list[Row]:
    by_key: dict[str, list[Outcome]] = {}
    for result in results:
        for outcome in result.outcomes:
            by_key.setdefault(outcome.key, []).append(outcome)
    rows = [
        Row(name, key, min(outcomes, key=_order), sum(o.held for o in outcomes), len(outcomes))
        for key, outcomes in by_key.items()
    ]
    broken = [result.error for result in results if result.error]
    if broken:
        outcome = Outcome("a result", False, broken[0], "")
        rows.append(Row(name, outcome.key, outcome, len(results) - len(broken), len(results)))
    return rows


def _order(outcome: Outcome) -> tuple[bool, float]:
    """Sorts failed outcomes before others, then by margin."""
    return outcome.held, outcome.margin if outcome.margin is not None else 0.0


def _failure_lines(results: Sequence[Result]) -> list[str]:
    failed = [result for result in results if not result.held]
    lines = []
    for result in failed[:SHOWN]:
        trial = result.trial
        lines.append(f"{trial.source}, seed {trial.scenario.seed}: {'; '.join(result.failures)}")
        lines.append(f"  again: {trial.again}")
        lines.append(f"  look:  trilat report {result.log}" if result.log else f"  look:  {trial.look}")
    if len(failed) > SHOWN:
        seeds = ", ".join(str(result.trial.scenario.seed) for result in failed[SHOWN:])
        lines.append(f"  and {len(failed) - SHOWN} more, seeds {seeds}")
    return lines

"""One cell of a sweep: its overrides, its runs, and the command that repeats a run.

Invariant: a cell's scenario is loaded through the same settings that its command names. A run keeps its
scenario as a line diff against the base text: `apply_diff(diff_lines(text, base), base) == text` for every
two texts.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import msgspec

from ...errors import ScenarioError
from ...scenario import Scenario
from ...scenario.laws import identify_law
from ...scenario.scenario_reader import ExperimentText
from ..commands import format_command, set_options
from . import cell_result
from .cell_result import CellResult

LineDiff = tuple[str | tuple[int, int], ...]
"""In order: lines of the base, as first and last number, and lines that it has not."""


def diff_lines(text: str, base: str) -> LineDiff:
    """Returns a text as lines of another one and lines of its own."""
    there = base.split("\n")
    first = {line: number for number, line in reversed(list(enumerate(there)))}
    parts: list[str | tuple[int, int]] = []
    expected = 0  # where the text goes on if it has as many lines as the base up to here
    for line in text.split("\n"):
        place = expected if there[expected : expected + 1] == [line] else first.get(line)
        before = parts[-1] if parts else None
        if place is None:
            parts.append(line)
        elif isinstance(before, tuple) and before[1] + 1 == place:
            parts[-1] = (before[0], place)
        else:
            parts.append((place, place))
        expected = (expected if place is None else place) + 1
    return tuple(parts)


def apply_diff(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Returns the text again."""
    there = base.split("\n")
    lines = ([part] if isinstance(part, str) else there[part[0] : part[1] + 1] for part in parts)
    return "\n".join(chain.from_iterable(lines))


class SweepSource(NamedTuple):
    """The experiment that is swept, as its author wrote it, see `ExperimentText`.

    Attributes:
        source: what a command calls it: a shipped name or a path.
        text: its TOML text.
        folder: where the files lie that it names; None: it is resolved.
        overrides: what is changed of it everywhere, as texts KEY=VALUE.
    """

    source: str
    text: str
    folder: str | None
    overrides: tuple[str, ...]

    def scenario(self, *more: str) -> Scenario:
        """Returns it, with some more overrides.

        Raises:
            ScenarioError: it is not valid with them.
        """
        folder = None if self.folder is None else Path(self.folder)
        return ExperimentText(self.source, self.text, folder).load([*self.overrides, *more])


class SweepCell(NamedTuple):
    """One place of a sweep.

    Attributes:
        number: row by row, from 0: laws change slowest, the last axis fastest.
        law: which of the swept laws, or "".
        values: along every axis, numbers as numbers.
        overrides: what makes it of the experiment, as texts KEY=VALUE.
    """

    number: int
    law: str
    values: tuple[float | str, ...]
    overrides: tuple[str, ...]


class CellTask(NamedTuple):
    """One run of a cell, to be made: picklable, with all that a worker needs."""

    written: SweepSource
    number: int
    overrides: tuple[str, ...]
    seed: int
    longest_s: float
    judge: str = "verdict"

    def __str__(self) -> str:
        return f"cell {self.number} ({', '.join(self.overrides)}), seed {self.seed}"


class CellRun(msgspec.Struct, frozen=True):
    """One finished run.

    Attributes:
        random: whether another seed would be another run.
        law: the laws of its sites, each once.
        scenario: its canonical text, as what differs from that of the experiment.
    """

    cell: int
    seed: int
    random: bool
    law: str
    sha256: str
    scenario: LineDiff
    outcome: CellResult


def run_cell(task: CellTask) -> CellRun:
    """Runs one task, in whatever process.

    Raises:
        ScenarioError: there is no such experiment; says of which cell.
    """
    try:
        scenario = task.written.scenario(*task.overrides, f"seed={task.seed}")
        cell_result.check_sweepable(scenario)
    except ScenarioError as error:
        raise ScenarioError(f"cell {task.number} ({', '.join(task.overrides)}): {error}") from None
    outcome = cell_result.classify_cell(scenario.text, max(task.longest_s, scenario.duration_s))
    if task.judge == "twins":
        outcome = msgspec.structs.replace(outcome, exponent_per_s=cell_result.measure_exponent(scenario))
    return CellRun(
        task.number,
        task.seed,
        scenario.random,
        join_law_names(scenario),
        scenario.sha256,
        diff_lines(scenario.text, _base_text(task.written)),
        outcome,
    )


@lru_cache(maxsize=4)
def _base_text(written: SweepSource) -> str:
    return written.scenario().text


def join_law_names(scenario: Scenario) -> str:
    """Returns the laws of a scenario's sites, each once."""
    return ", ".join(dict.fromkeys(identify_law(site.control) for site in scenario.sites.values()))


def build_sim_command(
    written: SweepSource, overrides: Sequence[str], seed: int, duration_s: float, log: str
) -> str:
    """Returns the command that makes a log of a run."""
    others = [
        text
        for text in (*written.overrides, *overrides)
        if text.partition("=")[0].strip() not in ("seed", "duration_s")
    ]
    run = ["--seed", str(seed), "--duration", f"{duration_s:.12g}", "-o", log]
    return format_command("sim", written.source, *set_options(others), *run)

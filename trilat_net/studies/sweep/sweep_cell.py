"""One cell of a sweep: its overrides, its runs, and the command that repeats a run.

Invariant: a cell's scenario is loaded through the same settings that its command names. A run keeps its
scenario as a line diff against the base text: `apply_diff(diff_lines(text, base), base) == text` for every
two texts.
"""

import shlex
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from ...errors import ScenarioError
from ...scenario import Scenario, parse_scenario
from . import cell_result
from .cell_result import CellResult

LineDiff = tuple[str | tuple[int, int], ...]
"""In order: lines of the base, as first and last number, and lines that it has not."""


def diff_lines(text: str, base: str) -> LineDiff:
    """Returns a text as lines of another one and lines of its own."""
    places: dict[str, int] = {}
    there = base.split("\n")
    for number, line in enumerate(there):
        places.setdefault(line, number)
    found: list[str | tuple[int, int]] = []
    for line in text.split("\n"):
        before = found[-1] if found else None
        if isinstance(before, tuple) and before[1] + 1 < len(there) and there[before[1] + 1] == line:
            found[-1] = (before[0], before[1] + 1)
        elif (place := _place(line, there, places, _after(found))) is not None:
            found.append((place, place))
        else:
            found.append(line)
    return tuple(found)


def apply_diff(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Returns the text again."""
    there = base.split("\n")
    lines: list[str] = []
    for part in parts:
        if isinstance(part, str):
            lines.append(part)
        else:
            lines.extend(there[part[0] : part[1] + 1])
    return "\n".join(lines)


def _after(found: Sequence[str | tuple[int, int]]) -> int:
    """Returns where the text would go on if it had as many lines as the base up to here."""
    own = 0
    for part in reversed(found):
        if isinstance(part, tuple):
            return part[1] + 1 + own
        own += 1
    return own


def _place(line: str, there: Sequence[str], places: dict[str, int], expected: int) -> int | None:
    """Returns a place of a line in the base: where it is expected if it is there, else the first."""
    if expected < len(there) and there[expected] == line:
        return expected
    return places.get(line)


class SweepSource(NamedTuple):
    """The experiment that is swept, as its author wrote it.

    Attributes:
        source: what a command calls it: a shipped name or a path.
        text: its TOML text.
        folder: where the files lie that it names.
        overrides: what is changed of it everywhere, as texts KEY=VALUE.
    """

    source: str
    text: str
    folder: str
    overrides: tuple[str, ...]

    def scenario(self, *more: str) -> Scenario:
        """Returns it, with some more overrides.

        Raises:
            ScenarioError: it is not valid with them.
        """
        return parse_scenario(self.text, self.source, [*self.overrides, *more], Path(self.folder))


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
    """One run to be made: picklable, with all that a worker needs.

    Attributes:
        written: the experiment.
        number: of the cell.
        overrides: of the cell.
        seed: of the run.
        longest_s: how long it may be extended, s.
    """

    written: SweepSource
    number: int
    overrides: tuple[str, ...]
    seed: int
    longest_s: float

    def __str__(self) -> str:
        return f"cell {self.number} ({', '.join(self.overrides)}), seed {self.seed}"


class CellRun(msgspec.Struct, frozen=True):
    """One finished run.

    Attributes:
        cell: its number.
        seed: of its chance.
        random: whether another seed would be another run.
        law: the laws of its sites, each once.
        sha256: names its scenario.
        scenario: its canonical text, as what differs from that of the experiment.
        outcome: its result.
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
        where = ", ".join(task.overrides)
        raise ScenarioError(f"cell {task.number} ({where}): {error}") from None
    outcome = cell_result.classify_cell(scenario.text, max(task.longest_s, scenario.duration_s))
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
    return ", ".join(dict.fromkeys(str(s.control.__struct_config__.tag) for s in scenario.sites.values()))


def build_sim_command(
    written: SweepSource, overrides: Sequence[str], seed: int, duration_s: float, log: str
) -> str:
    """Returns the command that makes a log of a run."""
    words = [
        word
        for text in (*written.overrides, *overrides)
        if text.partition("=")[0].strip() not in ("seed", "duration_s")
        for word in ("--set", text)
    ]
    lasts = ["--seed", str(seed), "--duration", f"{duration_s:.12g}", "-o", log]
    return shlex.join(["trilat", "sim", written.source, *words, *lasts])

"""One cell of a sweep: where it lies, and what is run there.

Law: a cell's scenario is loaded through the very settings that its command names, so that the command runs
what was judged.
"""

import shlex
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from ..errors import ScenarioError
from ..scenario import Scenario, parse
from . import judging
from .delta import Delta, delta
from .outcome import Outcome


class Written(NamedTuple):
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
        return parse(self.text, self.source, [*self.overrides, *more], Path(self.folder))


class Cell(NamedTuple):
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


class Task(NamedTuple):
    """One run to be made: picklable, and all that a process needs.

    Attributes:
        written: the experiment.
        number: of the cell.
        overrides: of the cell.
        seed: of the run.
        longest_s: how long it may be extended, s.
    """

    written: Written
    number: int
    overrides: tuple[str, ...]
    seed: int
    longest_s: float


class Entry(msgspec.Struct, frozen=True):
    """One run that was made.

    Attributes:
        cell: its number.
        seed: of its chance.
        random: whether another seed would be another run.
        law: the laws of its sites, each once.
        sha256: names its scenario.
        scenario: its canonical text, as what differs from that of the experiment.
        outcome: what became of it.
    """

    cell: int
    seed: int
    random: bool
    law: str
    sha256: str
    scenario: Delta
    outcome: Outcome


def run_cell(task: Task) -> Entry:
    """Runs one task, in whatever process.

    Raises:
        ScenarioError: there is no such experiment; says of which cell.
    """
    try:
        scenario = task.written.scenario(*task.overrides, f"seed={task.seed}")
        judging.check_sweepable(scenario)
    except ScenarioError as error:
        where = ", ".join(task.overrides)
        raise ScenarioError(f"cell {task.number} ({where}): {error}") from None
    outcome = judging.judge(scenario.text, max(task.longest_s, scenario.duration_s))
    return Entry(
        task.number,
        task.seed,
        scenario.random,
        laws_of(scenario),
        scenario.sha256,
        delta(scenario.text, _base_text(task.written)),
        outcome,
    )


@lru_cache(maxsize=4)
def _base_text(written: Written) -> str:
    return written.scenario().text


def laws_of(scenario: Scenario) -> str:
    """Returns the laws of a scenario's sites, each once."""
    return ", ".join(dict.fromkeys(str(s.control.__struct_config__.tag) for s in scenario.sites.values()))


def command(written: Written, overrides: Sequence[str], seed: int, duration_s: float, log: str) -> str:
    """Returns the command that makes a log of a run.

    Args:
        written: the experiment.
        overrides: of the cell.
        seed: of the run.
        duration_s: how long it runs, s.
        log: the name of the file.
    """
    settings = [text for text in (*written.overrides, *overrides) if _key(text) not in ("seed", "duration_s")]
    words = [word for text in settings for word in ("--set", text)]
    lasts = ["--seed", str(seed), "--duration", f"{duration_s:.12g}", "-o", log]
    return shlex.join(["trilat", "sim", written.source, *words, *lasts])


def _key(text: str) -> str:
    return text.partition("=")[0].strip()

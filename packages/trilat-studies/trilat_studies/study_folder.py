"""The folder of a sweep or a benchmark, from which an interrupted study continues."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from trilat_net.work import RunJournal

P = TypeVar("P")
J = TypeVar("J", bound=RunJournal[Any])


class StudyFolder(NamedTuple, Generic[P, J]):
    """The folder of a study, such as a sweep, with its plan, finished runs and results.

    It contains everything that a command needs to continue an interrupted study.

    Attributes:
        path: Path of the folder.
        plan: Plan of the study.
        facts: Plain values that must be the same when the study is continued: the
            floating-point arithmetic of the machine, the package versions and, for a sweep, the
            plan.
        remedy: Advice for the error message if the disk is full.
        journal: Function that opens the journal.
    """

    path: Path
    plan: P
    facts: Mapping[str, Any]
    remedy: str
    journal: Callable[[], J]

    def read_done(self) -> list[tuple[Any, int]]:
        """Reads from the journal which runs of the study have finished.

        An interrupted study continues with the remaining runs.

        Returns:
            The cell (the part of the study) and the seed of each finished run. Empty if no run
            has finished.
        """
        with self.journal() as journal:
            return list(journal.done)

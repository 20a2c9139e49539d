"""Findings of checks: what was looked at, the result in one line, and every problem with its
place.

Invariant: a finding with a problem has not passed; problems beyond `MAX_LISTED_PROBLEMS` are
counted only.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..errors import CodeWithheld
from ..results import Result

MAX_LISTED_PROBLEMS = 1000
"""Problems that a finding keeps; more are counted."""


class ProblemPlace(NamedTuple):
    """A problem of a file, at a byte or in the chunk that begins there; None if the whole file
    is meant.
    """

    file: str
    offset: int | None
    text: str

    def __str__(self) -> str:
        return self.text if self.offset is None else f"byte {self.offset}: {self.text}"


@dataclass(slots=True)
class Finding:
    """Result of one check.

    Attributes:
        check: its name: of a file "whole", "checksums", "records", "index"; of a trilat-net log
            also "sequence", "accounts", "chain", "schema", "times", "rates", "scenario"; of an
            execution its subject.
        text: the result in one line.
        passed: True if it passed.
        judged: False if it needs code from outside that nobody allowed to run; then it did not
            pass.
        places: problems, at most `MAX_LISTED_PROBLEMS`.
        wrong: number of problems.
    """

    check: str
    text: str = ""
    passed: bool = True
    judged: bool = True
    places: list[ProblemPlace] = field(default_factory=list)
    wrong: int = 0

    def add(self, file: str, offset: int | None, text: str) -> None:
        """Adds a problem."""
        self.passed = False
        self.wrong += 1
        if len(self.places) < MAX_LISTED_PROBLEMS:
            self.places.append(ProblemPlace(file, offset, text))

    def summary(self) -> str:
        """Returns the first problem, and the number of others."""
        return (
            f"{self.places[0]}; and {self.wrong - 1} more"
            if self.wrong > 1
            else str(self.places[0])
        )

    def conclude(self, sound: str) -> "Finding":
        """Takes `sound` as its text if there is no problem, else their summary; returns itself."""
        self.text = self.summary() if self.wrong else sound
        return self

    def to_row(self) -> dict[str, Any]:
        """Returns it as a line, ready for JSON."""
        return {
            "label": self.check,
            "text": self.text,
            "passed": self.passed,
            "judged": self.judged,
        }


class Findings(dict[str, Finding]):
    """The findings of some checks by name; each begins with its first use."""

    def __missing__(self, check: str) -> Finding:
        self[check] = finding = Finding(check)
        return finding


class CheckReport(Result):
    """A result that rests on checks: `findings` has one of each."""

    findings: list[Finding]

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return all(finding.passed for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """1 if a check failed, else that of `CodeWithheld` if one was not judged, else 0."""
        failed = any(finding.judged and not finding.passed for finding in self.findings)
        return 1 if failed else 0 if self.passed else CodeWithheld.exit_code

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per check."""
        return [finding.to_row() for finding in self.findings]

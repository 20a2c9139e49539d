"""Hold the findings of checks: the name of the check, its result, and every problem.

Invariant:
    - A finding with a problem has not passed.
    - Problems beyond `MAX_LISTED_PROBLEMS` are only counted.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..errors import CodeWithheld
from ..results import Result

MAX_LISTED_PROBLEMS = 1000
"""Largest number of problems that a finding keeps; further problems are only counted."""


class ProblemPlace(NamedTuple):
    """A problem of a file.

    Attributes:
        file: name of the file.
        offset: byte of the problem, or first byte of its chunk; None: the whole file.
        text: description of the problem.
    """

    file: str
    offset: int | None
    text: str

    def __str__(self) -> str:
        return self.text if self.offset is None else f"byte {self.offset}: {self.text}"


@dataclass(slots=True)
class Finding:
    """The result of one check.

    Attributes:
        check: name of the check: for a file "whole", "checksums", "records" or "index"; for a
            trilat-net log also "sequence", "accounts", "chain", "schema", "times", "rates" or
            "scenario"; for an execution its subject.
        text: the result in one line.
        passed: True if the check passed.
        judged: False if the check needs code from outside that may not run; the check then did
            not pass.
        places: the problems, at most `MAX_LISTED_PROBLEMS`.
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
        """Returns the first problem, and the number of further problems."""
        first = str(self.places[0])
        return f"{first}; and {self.wrong - 1} more" if self.wrong > 1 else first

    def conclude(self, sound: str) -> "Finding":
        """Sets the text of the finding and returns the finding.

        Args:
            sound: the text if there is no problem; else the text is the summary of problems.
        """
        self.text = self.summary() if self.wrong else sound
        return self

    def to_row(self) -> dict[str, Any]:
        """Returns the finding as plain values for JSON."""
        return {
            "label": self.check,
            "text": self.text,
            "passed": self.passed,
            "judged": self.judged,
        }


class Findings(dict[str, Finding]):
    """The findings of checks by name; a finding is created when it is first used."""

    def __missing__(self, check: str) -> Finding:
        self[check] = finding = Finding(check)
        return finding


class CheckReport(Result):
    """A result of several checks.

    Attributes:
        findings: one finding per check.
    """

    findings: list[Finding]

    @property
    def passed(self) -> bool:
        """True if every check passed."""
        return all(finding.passed for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """1 if a check failed; that of `CodeWithheld` if a check was not judged; else 0."""
        if any(finding.judged and not finding.passed for finding in self.findings):
            return 1
        return 0 if self.passed else CodeWithheld.exit_code

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per check."""
        return [finding.to_row() for finding in self.findings]

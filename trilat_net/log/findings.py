"""Defines the results of checks: whether each check passed, and the problems that it found.

A check examines one property of a log, the file with the messages of a session, for example
that no message is missing. Its result is a `Finding`. `trilat log check` prints one line per
finding.

Invariant:
    - A check with a problem has not passed.
    - At most `_MAX_LISTED_PROBLEMS` problems of a check are stored. Further problems are only
      counted.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..errors import CodeWithheld
from ..results import Result

_MAX_LISTED_PROBLEMS = 1000
"""Largest number of problems that a finding stores. Further problems are only counted."""


class _ProblemPlace(NamedTuple):
    """A problem that a check has found in a file, with its place in this file.

    Attributes:
        file: Name of the file.
        offset: Offset of the problem in the file, or of the chunk that contains it, in bytes.
            None if the problem concerns the whole file.
        text: Description of the problem.
    """

    file: str
    offset: int | None
    text: str

    def __str__(self) -> str:
        return self.text if self.offset is None else f"byte {self.offset}: {self.text}"


@dataclass(slots=True)
class Finding:
    """Result of one check of a log or a run, such as the check for missing records.

    It contains the problems that the check found.

    Attributes:
        check: Name of the check. Every file is checked for "whole", "checksums", "records" and
            "index", and a log of trilat-net also for "sequence", "accounts", "chain", "schema",
            "times", "rates" and "scenario". When a run is executed again and compared, the name
            is the subject of the comparison.
        text: The result in one line.
        passed: True if the check passed.
        judged: True if the check could be carried out. It is False if the check would run code
            from outside that the user has not permitted. In this case, the check has not
            passed.
        places: The problems, at most `_MAX_LISTED_PROBLEMS`.
        wrong: Number of problems, including those that are not stored.
    """

    check: str
    text: str = ""
    passed: bool = True
    judged: bool = True
    places: list[_ProblemPlace] = field(default_factory=list)
    wrong: int = 0

    def add(self, file: str, offset: int | None, text: str) -> None:
        """Adds a problem to the check, which has therefore not passed.

        Only the first `_MAX_LISTED_PROBLEMS` problems are stored. All are counted.

        Args:
            file: Name of the file in which the problem was found.
            offset: Offset of the problem in the file, in bytes. None if it concerns the whole
                file.
            text: Description of the problem.
        """
        self.passed = False
        self.wrong += 1
        if len(self.places) < _MAX_LISTED_PROBLEMS:
            self.places.append(_ProblemPlace(file, offset, text))

    def summary(self) -> str:
        """Summarises the problems that one check of a log has found, in one line.

        The line has the first problem and the number of further problems. There must be at
        least one.

        Returns:
            The first problem and the number of further problems.
        """
        first = str(self.places[0])
        return f"{first}; and {self.wrong - 1} more" if self.wrong > 1 else first

    def conclude(self, sound: str) -> "Finding":
        """Completes the finding with a text, after all problems were added.

        If there are problems, the text summarises them.

        Args:
            sound: Text of the finding if there is no problem.

        Returns:
            The finding itself, so that the caller can pass it on directly.
        """
        self.text = self.summary() if self.wrong else sound
        return self

    def to_row(self) -> dict[str, Any]:
        """Returns the result of one check of a log as plain values: its name, text and outcome.

        "judged" is False if the check could not be carried out. The individual problems are
        left out, because the text summarises them.
        """
        return {
            "label": self.check,
            "text": self.text,
            "passed": self.passed,
            "judged": self.judged,
        }


class Findings(dict[str, Finding]):
    """Results of several checks of a log, by name of the check, in the order of first use.

    If a name that does not exist yet is read, a result without problems is created for it. Thus
    a check can add a problem by `findings["records"]` at any point.
    """

    def __missing__(self, check: str) -> Finding:
        self[check] = finding = Finding(check)
        return finding


class CheckReport(Result):
    """Base class of the results of commands that check a log in several respects.

    From the results of the individual checks, it determines whether the log passed, and the
    exit code of the command.

    Attributes:
        findings: The result of each check.
    """

    findings: list[Finding]

    @property
    def passed(self) -> bool:
        """True if every check of the log passed."""
        return all(finding.passed for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """Exit code with which a command that reports these checks ends.

        - 1 if a check failed.
        - The exit code of `CodeWithheld` if no check failed, but a check could not be carried
          out. Such a check would run code from outside that the user has not permitted.
        - 0 if every check passed.
        """
        if any(finding.judged and not finding.passed for finding in self.findings):
            return 1
        return 0 if self.passed else CodeWithheld.exit_code

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one dictionary per check of the log, for a table or for JSON.

        The keys are "label", "text", "passed" and "judged".
        """
        return [finding.to_row() for finding in self.findings]

"""Defines the results of checks: whether each check passed, and the problems it found.

A check examines one property of a log, for example that no message is missing. Its result is a
`Finding`. `trilat log check` prints one line per finding.

Invariant:
    - A check that found a problem has not passed.
    - At most `_MAX_LISTED_PROBLEMS` problems of a check are stored. Any more are only counted.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..errors import CodeWithheld
from ..results import Result

_MAX_LISTED_PROBLEMS = 1000
"""Maximum number of problems that a finding stores. Any more are only counted."""


class _ProblemPlace(NamedTuple):
    """A problem that a check found in a file, with its position in the file.

    Attributes:
        file: Name of the file.
        offset: Offset of the problem in the file, or of the chunk that contains it, in bytes.
            None if the problem affects the file as a whole.
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

    Holds the problems that the check found.

    Attributes:
        check: Name of the check. The checks of every file are "whole", "checksums", "records"
            and "index". Further checks of a log of trilat-net are "sequence", "accounts",
            "chain", "schema", "times", "rates" and "scenario". When a run is repeated and
            compared, the name states what is compared.
        text: The result in one line.
        passed: True if the check passed.
        judged: True if the check could be carried out. False if it would have run third-party
            code that the user has not permitted, in which case the check has not passed.
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
        """Adds a problem, which means that the check has not passed.

        Only the first `_MAX_LISTED_PROBLEMS` problems are stored, but all are counted.

        Args:
            file: Name of the file in which the problem was found.
            offset: Position of the problem in the file, in bytes. None if the problem affects
                the file as a whole.
            text: Description of the problem.
        """
        self.passed = False
        self.wrong += 1
        if len(self.places) < _MAX_LISTED_PROBLEMS:
            self.places.append(_ProblemPlace(file, offset, text))

    def summary(self) -> str:
        """Summarises the problems found by one check of a log, in one line.

        The line consists of the first problem and the number of further problems. There must be
        at least one problem.
        """
        first = str(self.places[0])
        return f"{first}; and {self.wrong - 1} more" if self.wrong > 1 else first

    def conclude(self, sound: str) -> "Finding":
        """Sets the text of the finding once all problems have been added.

        If there are problems, the text summarises them.

        Args:
            sound: Text to use if there is no problem.

        Returns:
            The finding itself, for chaining.
        """
        self.text = self.summary() if self.wrong else sound
        return self

    def to_row(self) -> dict[str, Any]:
        """Returns the name, text and outcome of one check of a log as plain values.

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
    """Mapping from the name of a check of a log to its result, in order of first use.

    Looking up a name for the first time creates a result with no problems, so any code can add
    a problem with `findings["records"].add(...)`.
    """

    def __missing__(self, check: str) -> Finding:
        self[check] = finding = Finding(check)
        return finding


@dataclass(frozen=True, repr=False)
class CheckReport(Result):
    """Results of several checks on a log. Base class for results that include such checks.

    Derives from the individual findings whether the log passed, and the exit code of the
    command.

    Attributes:
        findings: The result of each check.
    """

    findings: list[Finding]

    @property
    def passed(self) -> bool:
        """True if every check of the log passed."""
        return all(finding.passed for finding in self.findings)

    @property
    def failed(self) -> list[str]:
        """Names of the checks that were carried out and did not pass."""
        return [
            finding.check for finding in self.findings if finding.judged and not finding.passed
        ]

    @property
    def exit_code(self) -> int:
        """Exit code of a command that reports these checks.

        - 1 if a check failed.
        - The exit code of `CodeWithheld` if no check failed but one could not be carried out,
          because it would have run third-party code that the user has not permitted.
        - 0 if every check passed.
        """
        if self.failed:
            return 1
        return 0 if self.passed else CodeWithheld.exit_code

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one dictionary per check of the log, for output as a table or as JSON.

        The keys are "label", "text", "passed" and "judged".
        """
        return [finding.to_row() for finding in self.findings]

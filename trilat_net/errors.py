"""The error classes, and helpers for the wording of messages.

The classes distinguish who has to act: the author of a scenario, the caller, a peer, the owner
of a file, or the developers.

Invariant:
    - An error carries its data and one sentence that names the problem, its location and the
      remedy. The command line prints that sentence and nothing else.
    - `exit_code` is the exit code of a command that the error ends.
    - Messages name options of the command line. In Python, they name the arguments instead.
    - Each text that counts things uses `count_nouns`, as in "1 record" and "2 records"
      (`tests/test_wording.py`).
"""

import re
from functools import partial
from typing import ClassVar

_OPTION = re.compile(
    r"(trilat [a-z][^;:,)]*)|(?<![\w-])(--[a-z][a-z-]*|-o\b)( [\d*'\[{]\S*| [A-Z]{2,}\b)?"
)
_IRREGULAR = {"axis": "axes", "datum": "data", "is": "are", "was": "were", "has": "have"}
_SWITCHES = ("--force", "--insecure", "--full", "--closed-loop")
_ARGUMENTS = {
    "-o": "out",
    "--resume": "the same out",
    "--duration": "duration_s",
    "--longest": "longest_s",
    "--law": "laws",
    "--metric": "metrics",
    "--margin": "along",
    "--gravity": "gravity_percent",
    "--at": "at_s",
}
"""Arguments in Python whose names differ from their options."""


def _name_argument(match: re.Match[str]) -> str:
    """Returns an option as a Python argument; a whole command is not changed."""
    command, option, value = match.groups()
    if command:
        return str(command)
    name = _ARGUMENTS.get(option) or option.lstrip("-").replace("-", "_")
    value = " True" if option in _SWITCHES else value
    return f"{name}={value.strip()}" if value else name


class TrilatError(Exception):
    """Base of all errors that a user can act on; a command ends with `exit_code`."""

    exit_code = 1
    in_command: ClassVar[bool] = False
    """True in a process that runs a command."""

    def __str__(self) -> str:
        # KeyError.__str__ would quote the text.
        text = Exception.__str__(self)
        return text if TrilatError.in_command else _OPTION.sub(_name_argument, text)


class UnknownName(TrilatError, KeyError):  # noqa: N818 - it names an outcome
    """A name that a mapping of results lacks, for instance a site that is not in a log."""

    exit_code = 2


class ScenarioError(TrilatError):
    """An invalid scenario, override or argument, which its author must correct.

    Args:
        problem: the problem and its remedy.
        path: the dotted key, or "".
        source: the file or the name of the scenario, or "".
    """

    exit_code = 2

    def __init__(self, problem: str, *, path: str = "", source: str = "") -> None:
        super().__init__(": ".join(part for part in (source, path, problem) if part))
        self.problem = problem
        self.path = path
        self.source = source


class CodeWithheld(ScenarioError):  # noqa: N818 - it names an outcome
    """A law, hand or plant that a log names, but that has not been allowed to run here."""

    exit_code = 4


class UsageError(TrilatError):
    """Arguments that contradict each other or the machine (a busy port, an existing file)."""

    exit_code = 2


class WireError(TrilatError):
    """A payload from a peer that is not a message of this program.

    Args:
        reason: the category under which such payloads are counted.
        detail: the problem of this payload.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class SessionError(TrilatError):
    """A session that cannot start: a missing peer, another scenario, or a running session."""

    exit_code = 2


class LogError(TrilatError):
    """A log that is missing, incomplete, or not written by this program."""

    exit_code = 2


class LogRefused(LogError):  # noqa: N818 - it names an outcome
    """A log that the machine cannot continue, as on a full disk; earlier records are kept."""

    exit_code = 5


class NotRepeatable(LogError):  # noqa: N818 - it names an outcome
    """A run that cannot be executed again from its log; the message says why."""


class NothingSaved(LogError):  # noqa: N818 - it names an outcome
    """A file without anything that could be recovered."""

    exit_code = 1


class RunFailed(TrilatError):  # noqa: N818 - it names an outcome, as the exit summary does
    """A run or a comparison that failed: divergence, a dead site, records that differ."""


class PeerLeft(RunFailed):
    """A run that another site left before the end, without rejoining."""

    exit_code = 3


class CodeFailed(RunFailed):
    """A user's code that raised an exception, was too slow, or returned unusable results.

    Args:
        problem: the failure.
        site: the site of the code.
        code: the class, as in "package.module:Law".
        tick: the tick of the failure; None if the code failed while it was resumed.
    """

    kind: ClassVar[str] = "code"

    def __init__(self, problem: str, *, site: str, code: str, tick: int | None) -> None:
        when = "as it was resumed" if tick is None else f"at tick {tick}"
        super().__init__(f"the {self.kind} {code} of {site} failed {when}: {problem}")
        self.problem = problem
        self.site = site
        self.code = code
        self.tick = tick

    def __reduce__(self) -> tuple[object, ...]:
        """Returns how to rebuild the error in another process."""
        rebuild = partial(type(self), site=self.site, code=self.code, tick=self.tick)
        return rebuild, (self.problem,)


class LawFailed(CodeFailed):
    """A user's control law that failed."""

    kind = "law"


class PlantFailed(CodeFailed):
    """A user's plant that failed."""

    kind = "plant"


class RuntimeFault(TrilatError):  # noqa: N818 - a fault of ours, by its name in docs/design.md
    """A state that the program must never reach: a bug."""


def count_nouns(count: object, singular: str, plural: str = "") -> str:
    """Returns a number with the noun that it counts, in the singular for 1.

    >>> count_nouns(1, "record"), count_nouns(2, "record")
    ('1 record', '2 records')
    >>> count_nouns(1, "mark waits", "marks wait")
    '1 mark waits'

    Args:
        count: the number, or its text, as in "1,000".
        singular: the noun, possibly with words before it, as in "late sample".
        plural: the noun for other numbers; by default `pluralise(singular)`.
    """
    if str(count) == "1":
        return f"{count} {singular}"
    return f"{count} {plural or pluralise(singular)}"


def pluralise(singular: str) -> str:
    """Returns the plural of a noun, which is the last word of `singular`."""
    *before, noun = singular.split(" ")
    if noun in _IRREGULAR:
        plural = _IRREGULAR[noun]
    elif noun.endswith("y") and noun[-2:-1] not in "aeiou":
        plural = f"{noun[:-1]}ies"
    elif noun.endswith(("s", "x", "ch", "sh")):
        plural = f"{noun}es"
    else:
        plural = f"{noun}s"
    return " ".join([*before, plural])

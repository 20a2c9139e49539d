"""Error classes of the program, and helpers for the wording of messages.

The classes distinguish who has to act: the author of a scenario, the caller of a function, the
operator of another machine, the owner of a file, or the developers of this program.

Invariant:
    - An error contains its data and one sentence that states the problem, its location and the
      remedy. The command line prints only that sentence.
    - Each class has an `exit_code`, which is the exit code of a command after this error.
    - Messages are written for the command line and refer to its options. Outside a command, the
      same messages refer to the arguments of the Python functions instead.
    - Every message that contains a count uses `count_nouns`, for example "1 record" and "2
      records" (`tests/test_wording.py`).
"""

import os
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

_PROGRAM = Path(__file__).parents[1]
_OTHER_CODE = (
    *(_PROGRAM / package for package in ("trilat_net", "sites", "recorder", "live")),
    _PROGRAM / "packages",
    Path(os.__file__).parent,
)
"""Folders that contain this program and Python's standard library."""
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
"""Python arguments whose names cannot be derived from the option names."""


def _name_argument(match: re.Match[str]) -> str:
    """Returns the Python argument that corresponds to an option in a message.

    For example, "--min-coverage 0.9" becomes "min_coverage=0.9", and "--force" becomes
    "force=True". A complete command such as "trilat log recover run.mcap" is left unchanged.

    Args:
        match: A match of `_OPTION`.
    """
    command, option, value = match.groups()
    if command:
        return str(command)
    name = _ARGUMENTS.get(option) or option.lstrip("-").replace("-", "_")
    if option == "--law" and value == " FILE":  # the file of a user's law, not names of laws
        name = "law"
    if option in _SWITCHES:
        return f"{name}=True"
    return f"{name}={value.strip()}" if value else name


class TrilatError(Exception):
    """Base class for errors that a user can correct, such as an invalid argument.

    The command line prints the message without a traceback and exits with the class's
    `exit_code`. Any other exception is a bug in the program.
    """

    exit_code = 1
    in_command: ClassVar[bool] = False
    """True in a process that runs a command, where messages refer to options rather than
    arguments.
    """

    def __str__(self) -> str:
        # KeyError.__str__ would quote the text.
        text = Exception.__str__(self)
        return text if TrilatError.in_command else _OPTION.sub(_name_argument, text)


class UnknownName(TrilatError, KeyError):  # noqa: N818 - it names an outcome
    """A name that does not exist in a result, for example of an arm that is not in a log.

    This error is also a KeyError, so that a result behaves like a dictionary.
    """

    exit_code = 2


class ScenarioError(TrilatError):
    """An invalid value in a scenario, override or argument.

    The author has to correct the value, and the message suggests how.

    Args:
        problem: The problem and its remedy.
        path: Dotted path of the invalid key, for example "sites.m1.control.Kd". Empty if no
            single key is at fault.
        source: File or name of the scenario. Empty if unknown.
    """

    exit_code = 2

    def __init__(self, problem: str, *, path: str = "", source: str = "") -> None:
        known_parts = [part for part in (source, path, problem) if part]
        super().__init__(": ".join(known_parts))
        self.problem = problem
        self.path = path
        self.source = source


class CodeWithheld(ScenarioError):  # noqa: N818 - it names an outcome
    """User code that a log names, but that is not allowed to run on this machine.

    The code is a control law, an operator (a program that moves an arm) or a plant (a
    simulation of an arm). The user of this machine must allow the code first, because a log
    from another person may name harmful code.
    """

    exit_code = 4


class UsageError(TrilatError):
    """Arguments that are contradictory, or that cannot work on this machine.

    Examples are a port that is in use and an output file that already exists.
    """

    exit_code = 2


class WireError(TrilatError):
    """A network message from another machine that is not a valid message of this program.

    The receiver drops the message and counts it. The sender may be another program, or another
    version of this program.

    Args:
        reason: Category under which the rejected payload is counted.
        detail: Description of the problem, for the error message.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class SessionError(TrilatError):
    """A live session that cannot start.

    For example, a process is missing or runs a different scenario, or the session is already
    running.
    """

    exit_code = 2


class LogError(TrilatError):
    """A log (the MCAP file of a run) that is missing, incomplete, or not from this program."""

    exit_code = 2


class LogRefused(LogError):  # noqa: N818 - it names an outcome
    """Output that could not be written, for example because the disk is full.

    Log data written before the failure is kept and remains readable.
    """

    exit_code = 5


class NotRepeatable(LogError):  # noqa: N818 - it names an outcome
    """A run that cannot be recomputed from its log.

    The message states the reason, for example that the data received by an arm are missing from
    the log.
    """


class NothingSaved(LogError):  # noqa: N818 - it names an outcome
    """A damaged log file from which no data could be recovered."""

    exit_code = 1


class RunFailed(TrilatError):  # noqa: N818 - it names an outcome, as the exit summary does
    """A run, or a comparison of runs, that completed with a bad outcome.

    For example, an arm became unstable, a process died, or two runs that should be equal
    differ.
    """


class PeerLeft(RunFailed):
    """A live run that ended early because another site left and did not come back."""

    exit_code = 3


class CodeFailed(RunFailed):
    """A user's class that raised an exception, was too slow, or returned unusable results.

    The class is a control law, or a model of an arm.

    Args:
        problem: The failure.
        site: Name of the site that ran the code.
        code: The class, for example "package.module:Law".
        tick: Tick in which the code failed. None if the code failed before any tick, while its
            state was being restored.
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
        """Returns the data from which pickle rebuilds the error with all its attributes.

        Worker processes use pickle to report errors to the process that started them.
        """
        rebuild = partial(type(self), site=self.site, code=self.code, tick=self.tick)
        return rebuild, (self.problem,)


class LawFailed(CodeFailed):
    """A user's control law that raised an exception, was too slow, or returned bad results."""

    kind = "law"


class PlantFailed(CodeFailed):
    """A user's arm model that raised an exception, was too slow, or returned bad results."""

    kind = "plant"


class RuntimeFault(TrilatError):  # noqa: N818 - programs catch it by this name
    """A state that the program must never reach, which indicates a bug in the program.

    Users cannot correct the problem themselves, and should report it.
    """


def count_nouns(count: object, singular: str, plural: str = "") -> str:
    """Returns a number followed by a noun in the singular or plural form.

    >>> count_nouns(1, "record"), count_nouns(2, "record")
    ('1 record', '2 records')
    >>> count_nouns(1, "mark waits", "marks wait")
    '1 mark waits'

    Args:
        count: The number, or its formatted string, for example "1,000".
        singular: The noun, possibly preceded by other words, for example "late sample".
        plural: The plural form. Defaults to the regular plural of `singular`.
    """
    if str(count) == "1":
        return f"{count} {singular}"
    return f"{count} {plural or _pluralise(singular)}"


def format_wall_time(seconds: float) -> str:
    """Formats a duration in s with a readable unit, for example "2.5 h".

    Durations of at least 1.5 min, 1.5 h or 2 days are expressed in minutes, hours or days.

    Args:
        seconds: The duration, in s.
    """
    units = (("days", 86_400.0, 172_800.0), ("h", 3600.0, 5400.0), ("min", 60.0, 90.0))
    for unit, unit_s, smallest_s in units:
        if seconds >= smallest_s:
            return f"{seconds / unit_s:.3g} {unit}"
    return f"{max(1, round(seconds))} s"


def _pluralise(singular: str) -> str:
    """Returns the plural of an English noun, for example "axes" for "axis".

    Args:
        singular: The noun, possibly preceded by other words, for example "late sample".

    Returns:
        The same words, with the last word in the plural.
    """
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


MOST_LETTERS = 80
"""Length of the longest word that `suggest_nearest` compares with valid words."""
MOST_COMPARED = 500
"""Largest number of words that `suggest_nearest` compares.

The computing time grows faster than the number of words times their length.
"""


_UNIT_ENDINGS = ("deg", "hz", "kg", "m", "ms", "n", "nm", "ns", "rad", "s", "us")
"""Units with which a key may end, in lower case."""


def suggest_nearest(word: str, valid: Sequence[str], elsewhere: Sequence[str] = ()) -> str:
    """Suggests the valid word that is most similar to an unknown word.

    >>> suggest_nearest("kd", ["Kp", "Kd"])
    "; did you mean 'Kd'?"
    >>> suggest_nearest("delay_ms", ["name", "seed"], ["link.delay_ms", "control.Kd"])
    "; did you mean 'link.delay_ms'?"

    Args:
        word: The unknown word.
        valid: The valid words.
        elsewhere: Dotted paths of words that are valid in other places. The last component of a
            path is compared with the word, and the complete path is suggested.

    Returns:
        The end of an error message, for example "; did you mean 'delay_ms'?". Empty if no valid
        word is similar, or if the word is too long to compare.
    """
    nearest = find_nearest(word, valid, elsewhere)
    return f"; did you mean {nearest!r}?" if nearest else ""


def find_nearest(word: str, valid: Sequence[str], elsewhere: Sequence[str] = ()) -> str:
    """Returns the valid word that a user probably meant instead of an unknown word.

    Takes the same arguments as `suggest_nearest`. The comparison ignores case. Words that
    differ only in case have priority, first those in `valid`, then those in `elsewhere`.
    Returns "" if no word is similar.
    """
    if len(word) > MOST_LETTERS:
        return ""
    # Imported here, because `trilat stop` imports this module and needs no suggestions.
    from difflib import get_close_matches

    valid_by_word = {path: path for path in valid[:MOST_COMPARED]}
    elsewhere_by_word: dict[str, str] = {}
    for path in elsewhere[:MOST_COMPARED]:
        last_part = path.rpartition(".")[2]
        elsewhere_by_word.setdefault(last_part, path)
    choices = [_prepare_choices(valid_by_word), _prepare_choices(elsewhere_by_word)]

    sought = word.casefold()
    for choice in choices:
        if sought in choice:
            return choice[sought]

    # `elsewhere` has many words, so a weak similarity to one of them means nothing.
    least_similarities = (0.5, 0.7)
    for choice, least_similarity in zip(choices, least_similarities, strict=True):
        matches = get_close_matches(sought, list(choice), n=1, cutoff=least_similarity)
        if matches:
            return choice[matches[0]]
    return ""


def _prepare_choices(suggestions: Mapping[str, str]) -> dict[str, str]:
    """Returns a mapping from the words to compare with a misspelt word to the suggestions.

    The comparison ignores case. Users also tend to forget the unit at the end of a key ("delay"
    or "dely" for "delay_ms"), so each key is listed with and without its unit.

    Args:
        suggestions: Mapping from valid word to the string to suggest.
    """
    choices: dict[str, str] = {}
    for word, suggestion in suggestions.items():
        if len(word) <= MOST_LETTERS:
            choices.setdefault(word.casefold(), suggestion)
    for word, suggestion in list(choices.items()):
        name, _, unit = word.rpartition("_")
        if name and unit in _UNIT_ENDINGS:
            choices.setdefault(name, suggestion)
    return choices


def join_words(words: Iterable[str]) -> str:
    """Joins words into a list for a sentence, for example "m1, m2 and s" or "m1 and s".

    Returns "" if there are no words.
    """
    texts = list(words)
    if len(texts) < 2:
        return "".join(texts)
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def join_arguments(arguments: Iterable[str]) -> str:
    """Returns a command line that users can copy, quoted where a shell requires it.

    Quoting follows the rules of the current operating system. For example, "links.m1->s.loss=0"
    is quoted because a shell would interpret ">" as output redirection.

    Args:
        arguments: Name of the program and its arguments.
    """
    if os.name != "nt":
        return shlex.join(arguments)
    # Both cmd and PowerShell accept this form.
    texts = []
    for argument in arguments:
        escaped = argument.replace('"', '\\"')
        needs_quotes = not re.fullmatch(r"[\w.:/\\=+-]+", escaped)
        texts.append(f'"{escaped}"' if needs_quotes else escaped)
    return " ".join(texts)


def describe_exception(error: BaseException) -> str:
    """Describes an exception in user code in one line, including where it was raised.

    The location is the innermost line that belongs neither to this program nor to a library.
    For example: "NameError: name 'nw' is not defined (mylaw.py, line 14)".

    Args:
        error: The exception.
    """
    kind = type(error).__name__
    lines = str(error).strip().splitlines()
    text = f"{kind}: {lines[0]}" if lines else kind
    # The message of a syntax error already states the location.
    if isinstance(error, SyntaxError):
        return text
    # Imported here, because `trilat stop` imports this module and describes no exception.
    import traceback

    frames = traceback.extract_tb(error.__traceback__)
    user_frames = [frame for frame in frames if _is_users_file(frame.filename)]
    if not user_frames:
        return text
    innermost = user_frames[-1]
    file_name = Path(innermost.filename).name
    return f"{text} ({file_name}, line {innermost.lineno})"


def _is_users_file(name: str) -> bool:
    """Returns True if a source file belongs to a user rather than to this program or a library.

    Errors are reported at a location in the user's file, where they can be corrected.

    Args:
        name: File name from a traceback, which is "<string>" for code without a file.
    """
    file = Path(name)
    if name.startswith("<") or "site-packages" in file.parts:
        return False
    return not any(file.is_relative_to(folder) for folder in _OTHER_CODE)

"""Errors, by who has to act: the author of a scenario, the caller, a peer, a file, the program.

Invariant: an error carries its data and one sentence that names the problem, its place and the remedy. The
command line prints that sentence and nothing else; `exit_code` is the code that a command ends with.
"""


class TrilatError(Exception):
    """Base of all errors that a person can act on; `exit_code` is what a command ends with."""

    exit_code = 1


class ScenarioError(TrilatError):
    """The author's: a scenario, an override or an argument that cannot be right.

    Args:
        problem: what is wrong and what would be right.
        path: the key, dotted, or "".
        source: the file or the name of the scenario, or "".
    """

    exit_code = 2

    def __init__(self, problem: str, *, path: str = "", source: str = "") -> None:
        super().__init__(": ".join(part for part in (source, path, problem) if part))
        self.problem = problem
        self.path = path
        self.source = source


class UsageError(TrilatError):
    """The caller's: arguments that contradict each other or the machine (a busy port, an existing file)."""

    exit_code = 2


class WireError(TrilatError):
    """A peer's: a payload that is no message of ours. `reason` is the word it is counted under."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class SessionError(TrilatError):
    """A session that cannot begin: a peer that never came, another scenario, a session that is running."""

    exit_code = 2


class LogError(TrilatError):
    """The file's: a log that is missing, torn, or not one of ours."""

    exit_code = 2


class LogRefused(LogError):  # noqa: N818 - it names an outcome
    """The machine's: a log that could not be written on, as on a full disk; what was before is kept."""

    exit_code = 5


class NothingSaved(LogError):  # noqa: N818 - it names an outcome
    """The file's: there is nothing in it that could be recovered."""

    exit_code = 1


class RunFailed(TrilatError):  # noqa: N818 - it names an outcome, as the exit summary does
    """A run or a comparison that ended badly: diverged, a site died, records that differ."""


class LawFailed(RunFailed):
    """A control law of somebody's own that raised, was too slow, or returned what is no torque.

    Args:
        problem: what it did.
        site: whose law it is.
        law: the law, as in "package.module:Law".
        tick: at which tick; None where it was resumed.
    """

    def __init__(self, problem: str, *, site: str, law: str, tick: int | None) -> None:
        when = "as it was resumed" if tick is None else f"at tick {tick}"
        super().__init__(f"the law {law} of {site} failed {when}: {problem}")
        self.problem, self.site, self.law, self.tick = problem, site, law, tick

    def __reduce__(self) -> tuple[object, ...]:
        """Makes it again where another process raised it."""
        return _law_failed, (self.problem, self.site, self.law, self.tick)


def _law_failed(problem: str, site: str, law: str, tick: int | None) -> LawFailed:
    return LawFailed(problem, site=site, law=law, tick=tick)


class RuntimeFault(TrilatError):  # noqa: N818 - a fault of ours, by its name in docs/design.md
    """Ours: a state that the program itself must never reach."""

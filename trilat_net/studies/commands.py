"""The commands that studies show, so that a person can repeat a run."""

import shlex
from collections.abc import Iterable


def format_command(*words: str) -> str:
    """Returns a command of the program, quoted for a shell."""
    return shlex.join(["trilat", *words])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns overrides, as texts KEY=VALUE, as options of a command."""
    return [word for text in overrides for word in ("--set", text)]

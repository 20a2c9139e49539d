"""Composes the shell command with which a user can repeat one run of a study.

A sweep or a trial reports, for example, "trilat sim paper --set link.delay_ms=200". The
functions in this module convert values to KEY=VALUE strings for the option --set and quote them
for a shell.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import tomli_w

from trilat_net.errors import ScenarioError, join_arguments
from trilat_net.own_code import name_law_classes
from trilat_net.scenario import is_distribution


def format_command(*arguments: str) -> str:
    """Returns a command that can be pasted into a shell, such as "trilat sim 'my run.toml'".

    Starts the command with "trilat", and quotes arguments that contain spaces or special
    characters.
    """
    return join_arguments(["trilat", *arguments])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns the --set options for a list of scenario overrides.

    Args:
        overrides: Strings KEY=VALUE, such as "link.delay_ms=100".

    Returns:
        The arguments "--set" and KEY=VALUE, alternating.
    """
    arguments = []
    for text in overrides:
        arguments += ["--set", text]
    return arguments


def format_toml_value(value: Any) -> str:
    """Formats a value as TOML on one line, for commands and overrides.

    A number is written with as few digits as possible while still parsing back to exactly the
    same number.

    Args:
        value: A number, string, list or table.

    Raises:
        ScenarioError: TOML cannot express the value.
    """
    value = name_law_classes(value)
    if isinstance(value, Mapping):
        entries = []
        for key, entry in value.items():
            entry_text = format_toml_value(entry)
            entries.append(f"{key} = {entry_text}")
        return f"{{{', '.join(entries)}}}"
    if isinstance(value, list | tuple):
        items = map(format_toml_value, value)
        return f"[{', '.join(items)}]"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    try:
        assignment = tomli_w.dumps({"v": value})
        return assignment.removeprefix("v = ").removesuffix("\n")
    except TypeError:
        raise ScenarioError(
            f"{value!r:.80} cannot be a value in a scenario: scenarios contain TOML values only"
        ) from None


def format_override_value(value: Any) -> str:
    """Formats the value of an override KEY=VALUE.

    Args:
        value: A number is formatted so that it parses back to exactly the same number, with no
            decimal point if it is an integer. Any other value, such as a word, is converted to
            a string.
    """
    return repr(value).removesuffix(".0") if isinstance(value, int | float) else str(value)


def format_override(key: str, value: Any) -> str:
    """Returns the override that sets a key to a value, such as "control.d=1.5".

    Args:
        key: Dotted path of the scenario key.
        value: The value, see `format_override_value`.
    """
    return f"{key}={format_override_value(value)}"


def list_assignments(overrides: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yields the overrides in nested tables as KEY=VALUE strings for the command line.

    Args:
        overrides: Mapping from key to value. A value may be a nested table.
        prefix: Keys of the enclosing tables, each followed by a dot.
    """
    for key, value in overrides.items():
        if isinstance(value, Mapping) and not is_distribution(value):
            yield from list_assignments(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={format_toml_value(value)}"

"""Names the settings in which the scenarios of two members of a session differ.

A session starts only if all of its members have the same scenario. Each member's identity
contains the text of its scenario, so an error message can say which setting was forgotten on
one machine.

Invariant:
    - The text of another member may come from any program on the network. Whatever it contains,
      the result is one short line with no control characters.
"""

import hashlib
import json
from collections.abc import Iterator
from typing import Any

from ..errors import ScenarioError, count_nouns
from ..toml_text import parse_toml

LISTED_SETTINGS = 3
"""Maximum number of settings whose values are stated. The rest are only counted."""
_VALUE_LENGTH = 40
"""Maximum length of a value, in characters."""
_NAME_LENGTH = 80
"""Maximum length of the name of a setting, in characters."""
_ABSENT = "absent"
_DESCRIPTIONS = ("title", "about", "assumed")
"""Settings that have no effect. They are named last."""


def describe_scenario_difference(
    first_text: str, second_text: str, first_member: str, second_member: str
) -> str:
    """Returns a phrase that names the settings in which two scenarios differ.

    For example: "link.delay_ms is 150.0 at s and 100.0 at m1".

    Args:
        first_text: Text of the first member's scenario, in TOML.
        second_text: Text of the second member's scenario.
        first_member: Name of the first member.
        second_member: Name of the second member.

    Returns:
        The phrase, or an empty string if a text cannot be read or no setting differs.
    """
    first = _read_settings(first_text)
    second = _read_settings(second_text)
    if first is None or second is None:
        return ""
    # Values are compared whole, and cut only where they are printed.
    names = [name for name in (second | first) if first.get(name) != second.get(name)]
    names.sort(key=_DESCRIPTIONS.__contains__)
    phrases = []
    for name in names[:LISTED_SETTINGS]:
        first_value = _shorten(first.get(name, _ABSENT))
        second_value = _shorten(second.get(name, _ABSENT))
        phrases.append(
            f"{_shorten(name, _NAME_LENGTH)} is {first_value} at {first_member} "
            f"and {second_value} at {second_member}"
        )
    more = len(names) - LISTED_SETTINGS
    if more > 0:
        phrases.append(count_nouns(more, "more setting differs", "more settings differ"))
    return "; ".join(phrases)


def _read_settings(text: str) -> dict[str, str] | None:
    """Returns the settings of a scenario: a mapping from dotted name to value as JSON.

    Args:
        text: The scenario, in TOML.

    Returns:
        None if the text is not TOML, or is nested too deeply.
    """
    try:
        return dict(_list_settings(parse_toml(text)))
    except (ScenarioError, RecursionError):
        return None


def _list_settings(table: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yields the dotted name and the value of each setting in a table and its subtables."""
    for key, value in table.items():
        name = prefix + _bound_key(key)
        if isinstance(value, dict):
            yield from _list_settings(value, f"{name}.")
        else:
            yield name, json.dumps(value, default=str)


def _bound_key(key: str) -> str:
    """Returns a key, or a short unique string in place of a long key.

    The name of a table is part of the names of all its settings. If it is long, these would
    need far more memory than the scenario itself.
    """
    if len(key) <= _NAME_LENGTH:
        return key
    digest = hashlib.sha256(key.encode()).hexdigest()
    return f"{key[: _NAME_LENGTH // 4]}...{digest}"


def _shorten(text: str, length: int = _VALUE_LENGTH) -> str:
    """Removes control characters from a string, and cuts it to a maximum length."""
    printable = "".join(c if c.isprintable() else "?" for c in text)
    if len(printable) <= length:
        return printable
    return printable[: length - 3] + "..."

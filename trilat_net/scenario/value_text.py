"""Formats the values of a scenario as short strings for users."""

from collections.abc import Sequence
from typing import Any

_MAX_VALUE_LENGTH = 80
"""Maximum length of the string form of a value."""
_HASH_DIGITS = 8
"""Number of digits of a SHA-256 hash shown in the string form of a value."""


def _join_leading(entries: Sequence[str], separator: str) -> str:
    """Joins as many leading entries as fit into `_MAX_VALUE_LENGTH` characters.

    The first entry is always included. Omitted entries are replaced with "...".

    Args:
        entries: Strings to join.
        separator: Separator between two entries.
    """
    text = ""
    for entry in entries:
        longer = f"{text}{separator}{entry}" if text else entry
        if text and len(longer) > _MAX_VALUE_LENGTH:
            return f"{text}{separator}..."
        text = longer
    return text


def describe_value(value: Any) -> str:
    """Formats a scenario value as a short string for users.

    A list of equal numbers is written as a single number, file hashes are shortened, and long
    tables or lists are truncated.

    Args:
        value: Any value that a scenario may contain.
    """
    if value is None or value == [] or value == ():
        return "none"
    if isinstance(value, dict):
        texts = []
        for key, entry in value.items():
            text = describe_value(entry)
            if key.endswith("sha256"):
                text = text[:_HASH_DIGITS]
            texts.append(text if key == "kind" else f"{key} {text}")
        return _join_leading(texts, " ")
    if isinstance(value, list | tuple):
        entries = [describe_value(entry) for entry in value]
        is_uniform = isinstance(value[0], int | float) and len(set(entries)) == 1
        return entries[0] if is_uniform else f"[{_join_leading(entries, ', ')}]"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    if len(text) > _MAX_VALUE_LENGTH:
        text = f"{text[: _MAX_VALUE_LENGTH - 3]}..."
    return text

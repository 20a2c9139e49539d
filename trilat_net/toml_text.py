"""Parses TOML from untrusted sources, such as logs and other computers.

Invariant:
    - The parsing time is at most proportional to the length of the text times the depth of its
      tables.
"""

import re
import tomllib
from typing import Any

from .errors import ScenarioError

_MAX_KEY_PARTS = 32
"""Largest number of parts of a dotted key. Scenarios need four, for example sites.m1.arm.l1_m.
"""

_KEY_PART = re.compile(
    r"""(?P<word>[\w-]+|"[^"]*"|'[^']*')|(?P<dot>\s{0,9}\.\s{0,9})|(?P<other>.)"""
)
"""Matches the next token of a line: a part of a key, a dot, or another character."""


def parse_toml(text: str) -> dict[str, Any]:
    """Parses a TOML document, and returns its tables.

    Raises:
        ScenarioError: The text is not valid TOML, or a key has too many parts.
        RecursionError: The tables are nested too deeply.
    """
    _refuse_long_keys(text)
    try:
        return tomllib.loads(text)
    # TOMLDecodeError is a ValueError. A number of 5000 digits raises a plain ValueError.
    except ValueError as error:
        raise ScenarioError(f"is not TOML: {error}") from None


def _refuse_long_keys(text: str) -> None:
    """Raises ScenarioError if a dotted key in the text has too many parts.

    The running time of a TOML parser grows faster than the square of the number of parts, so a
    short text from an untrusted source could block the program.

    Raises:
        ScenarioError: A key has too many parts. The error contains its line number.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") < _MAX_KEY_PARTS:
            continue
        dots = 0
        previous_kind = ""
        for part in _KEY_PART.finditer(line):
            kind = part.lastgroup or ""
            # In a key, words and dots alternate. Any other pair of pieces ends the key.
            is_inside_key = {kind, previous_kind} == {"word", "dot"}
            if not is_inside_key:
                dots = 0
            elif kind == "dot":
                dots += 1
            previous_kind = kind
            if dots >= _MAX_KEY_PARTS:
                raise ScenarioError(
                    f"line {number}: a key has more than {_MAX_KEY_PARTS} parts"
                )

"""Makes strings from files and from other computers safe to print.

Such strings could contain control characters that move the cursor or hide other text.
"""

import re

CONTROLS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u00ad\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ud800-\udfff]"
)
"""Characters that move the cursor, ring the bell, set colours, or change the text direction.

Line feeds and tabs are not included.
"""
HASH = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])[0-9a-f]{12,64}\b")
"""Matches a hexadecimal hash, or at least the first 12 digits of one.

Hashes are kept on one line so that they can be copied.
"""
MAX_LETTERS = 4000
"""Maximum length of a printed line."""


def sanitize(text: object, most: int = 300) -> str:
    """Replaces harmful characters in a string of unknown origin, and truncates long strings.

    Without this, control characters could manipulate the terminal.

    Args:
        text: The string, or an object that is converted to a string.
        most: Maximum number of characters.
    """
    # One character more than the limit shows whether the text is too long.
    beginning = str(text)[: most + 1]
    plain = "".join(letter if letter.isprintable() else "\ufffd" for letter in beginning)
    if len(plain) <= most:
        return plain
    return plain[:most] + "..."

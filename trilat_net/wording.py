"""Words for people: a number with its noun, as in "1 record" and "2 records".

Invariant: every text of the program that counts things goes through `count_nouns` (`tests/test_wording.py`).
"""

_IRREGULAR = {"axis": "axes", "datum": "data", "is": "are", "was": "were", "has": "have"}


def count_nouns(count: object, singular: str, plural: str = "") -> str:
    """Returns a number and what it counts, in the singular for 1.

    >>> count_nouns(1, "record"), count_nouns(2, "record"), count_nouns(1, "mark waits", "marks wait")
    ('1 record', '2 records', '1 mark waits')

    Args:
        count: the number, or its text, as in "1,000".
        singular: the noun, with words before it if there are any, as in "late sample".
        plural: the same for other numbers; by default `pluralise` of the singular.
    """
    words = singular if str(count) == "1" else plural or pluralise(singular)
    return f"{count} {words}"


def pluralise(singular: str) -> str:
    """Returns the plural of a noun, of which the last word is that noun."""
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

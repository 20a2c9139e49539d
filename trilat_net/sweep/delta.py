"""A text as what differs from another one, line by line: ten thousand scenarios differ in a few lines each.

Law: `whole(delta(text, base), base) == text` for every two texts.
"""

from collections.abc import Iterable, Sequence

Delta = tuple[str | tuple[int, int], ...]
"""In order: lines of the base, as first and last number, and lines that it has not."""


def delta(text: str, base: str) -> Delta:
    """Returns a text as lines of another one and lines of its own.

    Args:
        text: the text.
        base: one that is like it.
    """
    places: dict[str, int] = {}
    there = base.split("\n")
    for number, line in enumerate(there):
        places.setdefault(line, number)
    found: list[str | tuple[int, int]] = []
    for line in text.split("\n"):
        before = found[-1] if found else None
        if isinstance(before, tuple) and before[1] + 1 < len(there) and there[before[1] + 1] == line:
            found[-1] = (before[0], before[1] + 1)
        elif (place := _place(line, there, places, _after(found))) is not None:
            found.append((place, place))
        else:
            found.append(line)
    return tuple(found)


def whole(parts: Iterable[str | Sequence[int]], base: str) -> str:
    """Returns the text again.

    Args:
        parts: what `delta` made of it.
        base: the text that it was compared with.
    """
    there = base.split("\n")
    lines: list[str] = []
    for part in parts:
        if isinstance(part, str):
            lines.append(part)
        else:
            lines.extend(there[part[0] : part[1] + 1])
    return "\n".join(lines)


def _after(found: Sequence[str | tuple[int, int]]) -> int:
    """Returns where the text would go on if it had as many lines as the base up to here."""
    own = 0
    for part in reversed(found):
        if isinstance(part, tuple):
            return part[1] + 1 + own
        own += 1
    return own


def _place(line: str, there: Sequence[str], places: dict[str, int], expected: int) -> int | None:
    """Returns a place of a line in the base: where it is expected if it is there, else the first."""
    if expected < len(there) and there[expected] == line:
        return expected
    return places.get(line)

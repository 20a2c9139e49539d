"""Names of a log's files: finished or not, whole or in parts."""

import re
from pathlib import Path

ACTIVE = ".active"
"""What a file's name ends with until it is whole."""
_NUMBER = re.compile(r"(.+)-(\d{3,})")


def active(path: Path) -> Path:
    """Returns where a log is while it is written."""
    return path.with_name(path.name + ACTIVE) if path.name else path  # "." is a folder, and refused as one


def unfinished(path: Path) -> str:
    """Returns what to say besides where a log is not there, but one that was not finished is; else ""."""
    if path.exists() or not active(path).exists():
        return ""
    torn = active(path)
    return f"; {torn} is there, which was not finished; make it whole with: trilat log recover {torn}"


def part_path(path: Path, number: int) -> Path:
    """Returns the name of a part: that of the log with a number, or the log's own for part 0."""
    return path.with_name(f"{path.stem}-{number:03}{path.suffix}") if number else path


def existing(path: Path) -> dict[int, Path]:
    """Returns the files of a log that are there, finished or not, by number; one without number is part 1."""
    found: dict[int, Path] = {}
    for name in (path, active(path)):
        if name.exists():
            found.setdefault(1, name)
    for name in sorted(path.parent.glob(f"{_literal(path.stem)}-*")):
        bare = name.with_name(name.name.removesuffix(ACTIVE))
        number = _NUMBER.fullmatch(bare.stem)
        if number and number[1] == path.stem and bare.suffix == path.suffix:
            found.setdefault(int(number[2]), name)
    return found


def _literal(text: str) -> str:
    """Returns a text as a glob that matches nothing else."""
    return re.sub(r"([*?\[])", r"[\1]", text)

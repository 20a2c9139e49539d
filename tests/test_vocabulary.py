"""docs/vocabulary.md: one meaning a word, and names that keep to it."""

import re
from itertools import chain

import pytest

from . import house

PAGE = (house.ROOT / "docs" / "vocabulary.md").read_text(encoding="utf-8")
HEADS = ("word", "not")
USED, UNUSED = (
    [
        row
        for row in re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", part, re.MULTILINE)
        if row[0] not in HEADS
    ]
    for part in PAGE.split("## Words that are not used")
)


def _words(name: str) -> set[str]:
    return {
        word.lower()
        for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name.rpartition(".")[2])
    }


def _names() -> list[str]:
    """Of modules, classes and public functions."""
    names = chain.from_iterable([path.stem, *house.definitions(path)] for path in house.files())
    return [name for name in names if not name.rpartition(".")[2].startswith("_")]


def test_word_has_one_meaning_and_there_are_sixty_at_most() -> None:
    words = [word for cell, _ in USED for word in cell.split(", ")]
    assert 30 < len(words) == len(set(words)) <= 60


@pytest.mark.parametrize("cell", [cell for cell, _ in UNUSED])
def test_no_name_has_a_word_that_is_not_used(cell: str) -> None:
    banned = {word for word in cell.split(", ") if " " not in word}
    assert not [name for name in _names() if _words(name) & banned]

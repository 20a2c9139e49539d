"""docs/vocabulary.md: one meaning a word, and names that keep to it."""

import re
from itertools import chain

import pytest

from . import house

PAGE = (house.ROOT / "docs" / "vocabulary.md").read_text(encoding="utf-8")
USED = re.findall(r"^- \*\*([^*]+)\*\*: (.+)$", PAGE, re.MULTILINE)
UNUSED = {
    "node, broker": "member, router",
    "neighbour": "peer",
    "manipulator": "arm",
    "human, person": "operator, hand",
    "telemetry, packet, datagram": "sample, record",
    "latency, lag": "delay, age",
    "cycle, iteration": "tick",
    "bag": "log",
    "replica, clone": "twin",
    "skew": "offset",
    "checksum": "digest",
    "helper, manager, misc, util, utils": "what the thing does",
}
"""Words that no name has, and what to write in their place.

Functions are named by verbs, one for one thing:

- receive, accept, refuse, drop: what comes in from the network or from a queue; pop: what leaves a queue.
- publish, announce, report, notify: what goes out; request, query, reply: a question over the network.
- connect, admit, join, rejoin, leave, release: sessions, their members, and arms that are held.
- schedule, apply, cancel: changes during a run.
- start, stop, end, pause, resume, reset, restore: processes, runs and their states.
- evaluate, compute, estimate, integrate, interpolate, solve, project: numbers.
- find, select, choose, classify, count, list: what data hold. `find_` returns one thing or None.
- parse, decode, validate, resolve, expand: inputs.
- render, format, describe, compose, draw, write: outputs.
- advance: only with what it advances, as in `advance_to`.

A property or field is a noun with its unit, a predicate begins with `is_`, `has_` or `can_`.
"""


def _words(name: str) -> set[str]:
    return {
        word.lower()
        for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name.rpartition(".")[2])
    }


def _names() -> list[str]:
    """Yields the names of modules, classes and public functions."""
    names = chain.from_iterable([path.stem, *house.definitions(path)] for path in house.files())
    return [name for name in names if not name.rpartition(".")[2].startswith("_")]


def test_at_most_sixty_words_have_one_meaning() -> None:
    terms = [word for cell, _ in USED for word in cell.split(", ")]
    assert 30 < len(terms) == len(set(terms)) <= 60


@pytest.mark.parametrize("cell", UNUSED)
def test_no_name_has_an_unused_word(cell: str) -> None:
    banned = {word for word in cell.split(", ") if " " not in word}
    assert not [name for name in _names() if _words(name) & banned]

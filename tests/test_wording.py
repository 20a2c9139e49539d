"""Nouns are counted by one function: no text of the program says "1 records"."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import house
from trilat_net.errors import count_nouns

NOUNS = " ".join(
    [
        "answers arrivals axes bodies boots bytes candidates cells changes channels chunks",
        "conditions coordinates cores days edges energies episodes events files frames gaps",
        "joints jumps keys letters lines links marks messages numbers pages pairs panels",
        "participants parts peers places points positions processes quantities ranges records",
        "rounds rows runs samples seeds segments sessions settings sites starts stretches",
        "switches ticks trials velocities views",
    ]
).split()
"""What texts of the program count."""
NOT_A_COUNT = re.compile(
    r"[A-Z_][A-Z_.0-9]*$|place$|name|owner$|record\.id$|site$|_link\(|rate_hz$|session$|wanted$|endpoint$"
)
"""Values before a word such as "changes" that are no numbers, and constants, which are above 1."""


@pytest.mark.parametrize(
    ("count", "noun", "text"),
    [
        (0, "record", "0 records"),
        (1, "record", "1 record"),
        (2, "late sample", "2 late samples"),
        ("1,000", "byte", "1,000 bytes"),
        (1, "axis", "1 axis"),
        (3, "axis", "3 axes"),
        (2, "body", "2 bodies"),
        (2, "day", "2 days"),
        (2, "process", "2 processes"),
        (2, "stretch", "2 stretches"),
    ],
)
def test_a_noun_agrees_with_its_number(count: object, noun: str, text: str) -> None:
    assert count_nouns(count, noun) == text


def test_a_verb_agrees_as_well() -> None:
    assert [count_nouns(n, "mark waits", "marks wait") for n in (1, 2)] == [
        "1 mark waits",
        "2 marks wait",
    ]


def test_every_counted_noun_is_a_plural_of_itself() -> None:
    singular = {"axes": "axis", "bodies": "body", "energies": "energy", "processes": "process"}
    singular |= {
        "quantities": "quantity",
        "velocities": "velocity",
        "stretches": "stretch",
        "switches": "switch",
    }
    for noun in NOUNS:
        assert count_nouns(2, singular.get(noun, noun[:-1])) == f"2 {noun}"


def find_bare_plurals(path: Path) -> Iterator[str]:
    """Yields the places of f-strings in which a value stands before a plural."""
    pattern = re.compile(rf" (?:other |late |more |finite )?({'|'.join(NOUNS)})\b")
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.JoinedStr):
            continue
        for value, text in zip(node.values, node.values[1:], strict=False):
            if not isinstance(value, ast.FormattedValue) or not isinstance(text, ast.Constant):
                continue
            if value.format_spec is not None:
                continue  # a measured number, as in "2.5 stretches"
            source = ast.unparse(value.value)
            if (match := pattern.match(str(text.value))) and not NOT_A_COUNT.search(source):
                yield f"{path}:{node.lineno}: {{{source}}} {match[1]}"


def test_no_text_counts_by_a_bare_plural() -> None:
    bare_plurals = [
        bare_plural for path in house.files() for bare_plural in find_bare_plurals(path)
    ]
    assert not bare_plurals, "\n".join(
        ["use count_nouns of trilat_net/errors.py:", *bare_plurals]
    )


PRINT_ONE_LINE = {
    "print_text",
    "print_note",
    "print_error",
    "print_marked",
    "print_texts",
    "UsageError",
    "ScenarioError",
}
"""What they print is a line: a newline in it would become a replacement character."""


def find_broken_lines(tree: ast.Module) -> Iterator[int]:
    """Yields the lines of calls that print one line, and have a text with a newline."""
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        called = getattr(call.func, "attr", getattr(call.func, "id", ""))
        if called not in PRINT_ONE_LINE:
            continue
        for part in ast.walk(call):
            if isinstance(part, ast.Constant) and "\n" in str(part.value):
                yield call.lineno


def test_no_text_of_one_line_has_a_newline() -> None:
    assert list(find_broken_lines(ast.parse("print_text(f'{x}: run\\n  y')"))) == [1]
    broken = {
        str(path.relative_to(house.ROOT)): lines
        for path in house.files()
        if (lines := list(find_broken_lines(house.tree(path))))
    }
    assert not broken

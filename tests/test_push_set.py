"""The tests that a push leaves to the long run: only dear ones, never a whole file, and no missing ones."""

import re
from pathlib import Path

from .push_set import DEAR_S, MOST_S, ROOT, choose_long_tests, read_long_tests

FILE = "tests/cli/test_a.py"


def test_the_cheapest_test_of_every_file_stays() -> None:
    times_s = {f"{FILE}::test_{n}": MOST_S - 0.1 * n for n in range(9)}
    assert choose_long_tests(times_s) == [f"{FILE}::test_{n}" for n in range(8)]


def test_slow_tests_are_left() -> None:
    dear = f"{FILE}::test_dear"
    cheap = f"{FILE}::test_cheap"
    assert choose_long_tests({dear: 1.01 * MOST_S, cheap: 0.5 * DEAR_S}) == [dear]


def test_every_listed_test_exists() -> None:
    for name in read_long_tests():
        path, _, case = name.partition("::")
        text = Path(ROOT, path).read_text(encoding="utf-8")
        assert re.search(rf"^def {re.escape(case.partition('[')[0])}\(", text, re.MULTILINE), (
            name
        )


def test_names_are_the_same_in_every_copy() -> None:
    """A case that contains the folder of one copy of the program is not found in another."""
    assert [name for name in read_long_tests() if re.search(r"[\[ ]/\w+/", name)] == []

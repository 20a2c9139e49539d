"""The settings in which two scenarios differ, named in a line that any text may go into."""

import tracemalloc

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.net.scenario_difference import LISTED_SETTINGS, describe_scenario_difference
from trilat_net.scenario import load_scenario

PAPER = load_scenario("paper").text


def describe(first: str, second: str) -> str:
    return describe_scenario_difference(first, second, "s", "m1")


def test_changed_settings_are_named() -> None:
    other = load_scenario("paper", {"links.s->m1.delay_ms": 150.0, "seed": 2}).text
    assert describe(other, PAPER) == (
        "seed is 2 at s and 1 at m1; links.s->m1.delay_ms is 150.0 at s and 200.0 at m1"
    )


def test_descriptions_are_named_last() -> None:
    other = PAPER.replace("about = ", "about = 'other'\nwas = ").replace("seed = 1", "seed = 2")
    assert describe(other, PAPER).startswith("seed is 2")


def test_a_setting_of_one_scenario_is_absent() -> None:
    assert describe("a = 1", "a = 1\n[b]\nc = 2") == "b.c is absent at s and 2 at m1"


@pytest.mark.parametrize(("count", "end"), [(1, "setting differs"), (2, "settings differ")])
def test_further_settings_are_counted(count: int, end: str) -> None:
    first = "".join(f"k{n} = 1\n" for n in range(LISTED_SETTINGS + count))
    assert describe(first, first.replace("= 1", "= 2")).endswith(f"; {count} more {end}")


@pytest.mark.parametrize("text", ["= no", "a = " + 5000 * "["])
def test_unreadable_scenarios_name_nothing(text: str) -> None:
    assert describe(text, PAPER) == ""


def test_long_values_differ_beyond_their_printed_part() -> None:
    """A value is cut only where it is printed."""
    first = f"a = {list(range(99))}"
    assert describe(first, first.replace("98", "0")).startswith("a is [0, 1, 2")


def test_equal_scenarios_name_nothing() -> None:
    assert describe(PAPER, PAPER) == ""


@given(st.dictionaries(st.text(max_size=60), st.text(max_size=200), max_size=6))
def test_any_names_and_values_give_a_line(settings: dict[str, str]) -> None:
    phrase = describe(tomli_w.dumps(settings), "")
    assert phrase.isprintable()
    assert len(phrase) <= 120 * (LISTED_SETTINGS + 1)


def test_long_table_names_need_little_memory() -> None:
    """The name of a table, which all its settings repeat, may have the size of the scenario."""
    name = 200_000 * "t"
    first = f"[{name}]\n" + "".join(f"k{n} = 1\n" for n in range(2000))
    tracemalloc.start()
    phrase = describe(first, first.replace("k7 = 1", "k7 = 2"))
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert phrase.endswith(" is 1 at s and 2 at m1")
    assert peak_bytes < 50 * len(first)


def test_long_names_differ_beyond_their_printed_part() -> None:
    first = f"{300 * 'a'}b = 1"
    assert describe(first, first.replace("b", "c")).count("absent at") == 2


def test_keys_of_very_many_parts_name_nothing() -> None:
    """A parser would need minutes for such a key."""
    assert describe("a" + 50_000 * ".a" + " = 1", PAPER) == ""

"""Axes: values are the texts that a person would write, and what makes no grid is refused."""

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import ScenarioError
from trilat_net.studies.sweep.sweep_plan import parse_axis

decimals = st.decimals(-1000, 1000, places=4)
steps = st.decimals(Decimal("0.0001"), 50, places=4)


def refused(text: str) -> str:
    with pytest.raises(ScenarioError) as error:
        parse_axis(text)
    assert error.value.exit_code == 2
    return str(error.value)


@given(first=decimals, step=steps, count=st.integers(1, 300), beyond=st.decimals(0, Decimal("0.9"), places=2))
def test_a_range_is_its_first_value_and_whole_steps_up_to_its_end(
    first: Decimal, step: Decimal, count: int, beyond: Decimal
) -> None:
    last = first + (count - 1 + beyond) * step
    found = parse_axis(f"control.d={first}:{last}:{step}")
    assert len(found.texts) == count
    assert found.numeric
    values = [Decimal(text) for text in found.texts]
    assert values == [first + n * step for n in range(count)]
    assert [found.value(n) for n in range(count)] == [float(value) for value in values]
    downwards = parse_axis(f"control.d={values[-1]}:{first}:{-step}")
    assert [Decimal(text) for text in downwards.texts] == values[::-1]


def test_an_end_on_the_grid_within_rounding_counts() -> None:
    assert list(parse_axis("a=0:1:0.3333333333").texts)[-1] == "0.9999999999"
    assert list(parse_axis("a=0:0.9999999999:0.25").texts)[-1] == "1.00"


def test_exponents_are_written_out_so_that_whole_numbers_stay_whole() -> None:
    assert list(parse_axis("rate_hz=1e2:3e2:1e2").texts) == ["100", "200", "300"]
    assert list(parse_axis("a=1e-7:2e-7:1e-7").texts) == ["0.0000001", "0.0000002"]


def test_a_list_has_words_numbers_and_tables() -> None:
    found = parse_axis(" link.order = newest, in_order ")
    assert (found.asked, found.key, found.texts) == (
        "link.order=newest, in_order",
        "link.order",
        ("newest", "in_order"),
    )
    assert (found.numeric, found.value(1)) == (False, "in_order")
    assert parse_axis("a=1,2.5,1e3").numeric
    assert parse_axis("a=true,false").value(0) == "true"
    assert parse_axis("q0_rad=[0.1,0.2],[0.3,0.4]").texts == ("[0.1,0.2]", "[0.3,0.4]")
    assert parse_axis('a="x:y,z",{b="]:,"}').texts == ('"x:y,z"', '{b="]:,"}')


def test_a_range_of_very_many_values_takes_no_room() -> None:
    found = parse_axis("a=0:1e8:0.001")
    assert len(found.texts) == 10**11 + 1
    assert found.texts[10**11] == "100000000.000"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("link.delay_ms", ("KEY=VALUES", "'link.delay_ms'")),
        ("=1,2", ("KEY=VALUES",)),
        ("", ("KEY=VALUES",)),
        ("a=", ("a: is empty", "KEY=1,2,5")),
        ("a=1,,2", ("a: is empty",)),
        ("a=1:2", ("KEY=0:1600:50", "'1:2'")),
        ("a=1:2:3:4", ("'1:2:3:4'",)),
        ("a=x:y:z", ("a range is of numbers", "'x'")),
        ("a=0:nan:1", ("finite", "'nan'")),
        ("a=0:inf:1", ("finite", "'inf'")),
        ("a=1,nan", ("finite", "nan")),
        ("a=1,-inf", ("finite", "-inf")),
        ("a=0:10:0", ("a step of 0",)),
        ("a=3:0.2:0.1", ("is empty", "did you mean 0.2:3:0.1?")),
        ("a=0.2:3:-0.1", ("is empty", "did you mean 0.2:3:0.1?")),
        ("a=0:1e18:1e-18", ("values", "a larger step")),
        ("a=0:1e19:1", ("1e19", "from 1e-18 to 1e18")),
        ("a=1,2,1", ("has 1 twice",)),
        ("a=1,1.0", ("has 1.0 twice",)),
        ("seed=1:9:1", ("--seeds 1..20",)),
        ("duration_s=1,2", ("--longest",)),
    ],
)
def test_what_makes_no_axis_is_refused_with_what_would_be_right(text: str, words: tuple[str, ...]) -> None:
    problem = refused(text)
    for word in words:
        assert word in problem

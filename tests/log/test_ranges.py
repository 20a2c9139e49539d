"""Ranges against the set of numbers that they stand for."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.log.accounting import RangeSet

APPENDED = st.lists(st.tuples(st.integers(0, 3), st.integers(1, 5)), max_size=12)
"""Distance from the range before, and how many numbers."""


def filled(parts: list[tuple[int, int]], most: int = 1000) -> tuple[RangeSet, set[int]]:
    ranges, numbers, end = RangeSet(most), set[int](), 0
    for apart, count in parts:
        first = end + apart
        end = first + count
        ranges.append(first, end - 1)
        numbers |= set(range(first, end))
    return ranges, numbers


def inside(ranges: RangeSet) -> set[int]:
    return {number for first, last in ranges for number in range(first, last + 1)}


@given(APPENDED, st.lists(st.integers(-2, 80), max_size=40))
def test_ranges_are_the_set_of_what_was_added_and_not_removed(
    parts: list[tuple[int, int]], removed: list[int]
) -> None:
    ranges, numbers = filled(parts)
    for number in removed:
        assert ranges.remove(number) == (number in numbers)
        numbers.discard(number)
        assert inside(ranges) == numbers
        assert ranges.count == len(numbers)
    pairs = list(ranges)
    assert len(ranges) == len(pairs)
    assert all(a[1] + 1 < b[0] for a, b in pairwise(pairs))
    assert ranges.longest() == max((last - first + 1 for first, last in pairs), default=0)


@given(APPENDED, st.lists(st.integers(0, 60), max_size=9), st.integers(0, 70))
def test_from_a_number_on_the_first_range_begins_at_the_next_one_that_is_in(
    parts: list[tuple[int, int]], removed: list[int], start: int
) -> None:
    ranges, numbers = filled(parts)
    for number in removed:
        ranges.remove(number)
        numbers.discard(number)
    found = ranges.from_(start)
    behind = sorted(number for number in numbers if number >= start)
    assert (found is None) == (not behind)
    if found is not None:
        first, last = found
        assert first == behind[0]
        assert set(range(first, last + 1)) <= numbers
        assert last + 1 not in numbers


@given(APPENDED, st.lists(st.integers(0, 60), max_size=9), st.integers(1, 4))
def test_of_more_ranges_than_are_kept_the_lowest_are_forgotten(
    parts: list[tuple[int, int]], removed: list[int], most: int
) -> None:
    ranges, numbers = filled(parts, most)
    for number in removed:
        ranges.remove(number)
        numbers.discard(number)
    assert len(ranges) <= most
    assert ranges.count == len(inside(ranges))
    left = inside(ranges)
    assert left == {number for number in numbers if left and number >= min(left)}

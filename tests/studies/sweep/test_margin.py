"""The edge along one key: what is found encloses what is there, and nothing is made up."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.studies.sweep.margin_search import SCAN_POINTS, search_key_margin


@given(st.floats(0.25, 2.95), st.booleans(), st.sampled_from([0.05, 0.005, 1e-4]))
def test_an_edge_is_enclosed_to_the_tolerance(edge: float, above: bool, tolerance: float) -> None:
    asked = []

    def stable(value: float) -> bool:
        asked.append(value)
        return (value > edge) is above

    found = search_key_margin(stable, 0.2, 3.0, tolerance)
    (span,) = found.spans
    assert span.low <= edge <= span.high
    assert span.high - span.low <= tolerance * span.high
    assert span.stable_below is not above
    assert span.sharp
    assert found.runs == len(asked) == len(set(asked))
    assert found.runs <= SCAN_POINTS + 1 + math.log2(2.8 / (SCAN_POINTS - 1) / (0.2 * tolerance))


@given(st.floats(0.35, 2.8), st.floats(0.001, 0.1), st.booleans())
def test_what_stays_undecided_is_the_interval_that_is_given(edge: float, width: float, above: bool) -> None:
    def stable(value: float) -> bool | None:
        return None if abs(value - edge) < width else (value > edge) is above

    found = search_key_margin(stable, 0.2, 3.0, 0.01)
    (span,) = found.spans
    assert span.low <= edge - width + 1e-9
    assert edge + width - 1e-9 <= span.high
    if span.sharp:
        assert span.high - span.low <= 0.01 * span.high
    else:
        assert found.undecided > 0
        assert (edge - width) - span.low <= 0.01 * span.high
        assert span.high - (edge + width) <= 0.01 * span.high


@pytest.mark.parametrize("side", [True, False, None])
def test_without_a_change_there_is_no_edge_and_the_side_is_told(side: bool | None) -> None:
    found = search_key_margin(lambda _: side, 0.2, 3.0)
    assert (found.spans, found.stable, found.runs) == ((), side, SCAN_POINTS)


def test_an_island_has_both_its_shores() -> None:
    found = search_key_margin(lambda value: not 1.0 < value < 1.9, 0.0, 4.0)
    first, second = found.spans
    assert first.low <= 1.0 <= first.high
    assert second.low <= 1.9 <= second.high
    assert (first.stable_below, second.stable_below) == (True, False)
    assert found.stable is None


@given(st.floats(20.2, 299.8))
def test_whole_numbers_are_narrowed_to_neighbours_and_nothing_else_is_run(edge: float) -> None:
    def stable(value: float) -> bool:
        assert value == round(value)
        return value > edge

    (span,) = search_key_margin(stable, 20.0, 300.0, 1e-9, whole=True).spans
    assert (span.low, span.high) == (math.floor(edge), math.floor(edge) + 1) or edge == round(edge)


def test_an_edge_near_nothing_ends_all_the_same() -> None:
    """A tolerance relative to 0 is never met."""
    (span,) = search_key_margin(lambda value: value > 1e-300, 0.0, 1.0).spans
    assert span.low <= 1e-300 <= span.high
    (span,) = search_key_margin(lambda value: value > 0.0, -1.0, 1.0).spans
    assert span.low <= 0.0 <= span.high

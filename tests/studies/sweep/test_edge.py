"""Edges of a measured map: between two decided places that differ, and nowhere else."""

import itertools

import pytest

from trilat_net.studies.sweep.cell_result import CellClass
from trilat_net.studies.sweep.map_plane import StableInterval, find_map_edges

from .maps import DAMPINGS, DELAYS_MS, by_the_line, drawn

YES, NO, UNKNOWN = CellClass.CONVERGED, CellClass.DIVERGED, CellClass.UNDECIDED


def up(column: tuple[CellClass, ...]) -> list[StableInterval]:
    """The edges of the first column of a map in which all are like this one."""
    found = drawn(lambda _, d, *__: column[DAMPINGS.index(d)])
    return [edge for x, edge in find_map_edges(found, found.panels[0]) if x == DELAYS_MS[0]]


def test_the_condition_lies_in_the_edges_that_it_makes() -> None:
    found = drawn()
    measured = find_map_edges(found, found.panels[0])
    assert [x for x, _ in measured] == [100, 200, 300, 400]
    for x, edge in measured:
        assert edge.low <= 5e-3 * x <= edge.high
        assert not edge.stable_below


@pytest.mark.parametrize("column", list(itertools.product((YES, NO, UNKNOWN), repeat=5))[::7])
def test_edges_separate_all_that_was_decided(column: tuple[CellClass, ...]) -> None:
    """From below, the side changes at every edge and nowhere else."""
    found = up(column)
    side = [verdict.stable for verdict in column]
    decided = [(d, one) for d, one in zip(DAMPINGS, side, strict=True) if one is not None]
    changes = [(a, b) for (a, one), (b, other) in itertools.pairwise(decided) if one is not other]
    assert [(edge.low, edge.high) for edge in found] == changes
    for edge in found:
        assert edge.stable_below is (side[DAMPINGS.index(edge.low)])


def test_what_is_undecided_widens_an_edge() -> None:
    (edge,) = up((NO, UNKNOWN, UNKNOWN, YES, YES))
    assert (edge.low, edge.high, edge.middle) == (0.2, 1.7, pytest.approx(0.95))


def test_of_several_runs_the_majority_decides_and_a_draw_nothing() -> None:
    """Per place seeds 1 and 2 as the line says; below, seed 3 another way: a majority of two of three."""
    three = drawn(lambda x, y, seed: by_the_line(x, y) if seed < 3 else YES, seeds=3)
    assert find_map_edges(three, three.panels[0]) == find_map_edges(drawn(), drawn().panels[0])
    draw = drawn(lambda x, y, seed: by_the_line(x, y) if seed < 2 or y > 1.0 else YES, seeds=2)
    assert all(edge.low > 1.0 or edge.high > 1.0 for _, edge in find_map_edges(draw, draw.panels[0]))

"""Lines of theory: found column by column, without any run."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.studies.sweep.map_plane import PlaneAxis
from trilat_net.studies.sweep.stability_map import (
    StabilityCriterion,
    find_criterion_edge,
    trace_closed_form,
    trace_linear_analysis,
)

DELAY = PlaneAxis("link.delay_ms", (0.0, 100.0, 200.0, 300.0, 400.0, 800.0), "delay (ms)")
DAMPING = PlaneAxis("control.d", (0.2, 0.7, 1.2, 1.7, 2.2), "d (N m s/rad)")
P_D = load_scenario("p_d_margin")


def at(x: float, y: float) -> Scenario:
    return load_scenario(P_D, {"link.delay_ms": x, "control.d": y})


def spare(excess: float) -> StabilityCriterion:
    return StabilityCriterion("", "", "", excess)


def test_the_line_of_p_d_is_half_of_stiffness_times_delay() -> None:
    """No d of the map is little enough for no delay, or enough for 800 ms."""
    line = trace_closed_form(at, DELAY, DAMPING)
    assert line is not None
    found = [line.crossings(column, DAMPING) for column in range(6)]
    assert [len(some) for some in found] == [0, 1, 1, 1, 1, 0]
    assert np.allclose([some[0] for some in found[1:5]], [0.5, 1.0, 1.5, 2.0], rtol=1e-9)
    assert (line.spare > 0.0)[-1, 0]
    assert not (line.spare > 0.0)[0, -1]


def test_a_law_without_a_condition_has_no_line() -> None:
    assert trace_closed_form(lambda x, _: load_scenario("free", {"link.delay_ms": x}), DELAY, DAMPING) is None


def test_a_condition_that_nothing_of_the_map_changes_has_no_line() -> None:
    assert (
        trace_closed_form(
            lambda x, _: load_scenario(P_D, {"link.delay_ms": x, "control.d": 9.0}), DELAY, DAMPING
        )
        is None
    )


@given(st.floats(-50.0, 50.0), st.floats(1.0, 3.0), st.sampled_from([-1.0, 1.0]))
def test_a_condition_is_met_where_it_has_nothing_to_spare(root: float, power: float, sign: float) -> None:
    def condition(value: float) -> StabilityCriterion:
        gap = value - root
        return spare(sign * float(np.sign(gap)) * abs(gap) ** power)

    found = find_criterion_edge(condition, -60.0, 60.0)
    assert found is not None
    assert abs(condition(found).excess) <= 1e-5 * 120.0**power


def test_a_key_of_whole_numbers_has_no_point_between_them() -> None:
    def condition(value: float) -> StabilityCriterion:
        if value != round(value):
            raise ScenarioError("is a whole number")
        return spare(value - 2.5)

    assert find_criterion_edge(condition, 0.0, 7.0) is None


def test_the_linear_line_is_where_nothing_grows() -> None:
    """Real parts that are zero along y = 0.4 x: positive below, negative above."""
    columns = [([0.4 * x - y for y in (0.0, 1.0, 2.0)], []) for x in (0.0, 1.0, 2.0, 3.0)]
    line, remarks = trace_linear_analysis(columns)
    assert line is not None
    assert not remarks
    side = PlaneAxis("y", (0.0, 1.0, 2.0), "y")
    assert np.allclose([line.crossings(n, side)[0] for n in (1, 2, 3)], [0.4, 0.8, 1.2])


def test_a_column_may_be_crossed_again_and_again() -> None:
    side = PlaneAxis("y", (0.0, 1.0, 2.0, 3.0), "y")
    line, _ = trace_linear_analysis([([-1.0, 1.0, 3.0, -1.0], [])] * 2)
    assert line is not None
    assert line.crossings(0, side) == [0.5, 2.75]


def test_nothing_that_moves_is_not_infinitely_stable_and_no_crossing() -> None:
    side = PlaneAxis("y", (0.0, 1.0, 2.0), "y")
    line, _ = trace_linear_analysis([([-np.inf, 1.0, -1.0], []), ([np.nan, 1.0, -1.0], [])])
    assert line is not None
    assert line.crossings(0, side) == line.crossings(1, side) == [1.5]


def test_where_nothing_changes_there_is_no_line_and_reasons_are_told_once() -> None:
    why = ["nobody knows the delay"]
    line, remarks = trace_linear_analysis([([np.nan, np.nan], why), ([np.nan, np.nan], why)])
    assert line is None
    assert remarks == why
    assert trace_linear_analysis([([-1.0, -2.0], []), ([-1.0, -3.0], [])]) == (None, [])

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.studies.tuning.candidate import CandidateScore
from trilat_net.studies.tuning.final_posture import CandidateClass
from trilat_net.studies.tuning.pareto_search import Objective, compute_crowding, dominates, find_pareto_front

NUMBERS = st.floats(0.0, 10.0).map(lambda x: round(x, 1))
POINTS = st.lists(st.none() | st.tuples(NUMBERS, NUMBERS), max_size=30)


def score(outcome: CandidateClass, error_rad: float, effort_nm: float) -> CandidateScore:
    return CandidateScore(outcome, error_rad, error_rad, 0.0, effort_nm, error_rad, 0.0)


SCORES = st.lists(st.builds(score, st.sampled_from(list(CandidateClass)), NUMBERS, NUMBERS), max_size=30)


@given(points=POINTS)
def test_nothing_that_competes_is_better_than_a_point_of_the_front(
    points: list[tuple[float, float] | None],
) -> None:
    competing = [point for point in points if point is not None]
    kept = [points[n] for n in find_pareto_front(points)]
    assert None not in kept
    assert not any(dominates(a, b) for a in competing for b in kept if b is not None)


@given(points=POINTS)
def test_what_is_left_out_is_dominated_or_a_double(points: list[tuple[float, float] | None]) -> None:
    kept = set(find_pareto_front(points))
    held = [points[n] for n in kept]
    for n, point in enumerate(points):
        if point is not None and n not in kept:
            assert point in held or any(dominates(a, point) for a in held if a is not None)


@given(points=POINTS)
def test_a_front_is_in_the_order_of_effort_and_its_objective_falls(
    points: list[tuple[float, float] | None],
) -> None:
    kept = [point for n in find_pareto_front(points) if (point := points[n]) is not None]
    assert [p[1] for p in kept] == sorted(p[1] for p in kept)
    assert [p[0] for p in kept] == sorted((p[0] for p in kept), reverse=True)


@given(scores=SCORES)
def test_only_runs_that_settled_compete(scores: list[CandidateScore]) -> None:
    """Arms that hang have strayed: whatever their error and effort, they dominate nothing."""
    for objective in Objective:
        for n in find_pareto_front([objective.point(one) for one in scores]):
            assert scores[n].outcome is CandidateClass.SETTLED


def test_the_ends_of_a_front_are_loneliest_and_equal_gaps_are_equal() -> None:
    assert compute_crowding([(4.0, 0.0), (3.0, 1.0), (2.0, 2.0), (0.0, 4.0)]) == [
        float("inf"),
        1.0,
        1.5,
        float("inf"),
    ]
    assert compute_crowding([(1.0, 1.0)]) == [float("inf")]

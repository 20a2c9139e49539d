"""The search that every law gets, and its front."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from study_builders import dominates, make_candidate_score
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore
from trilat_studies.tuning.search_space import SEARCH_SPACES
from trilat_studies.tuning.tuning_plan import (
    CandidateSearch,
    Objective,
    compute_crowding,
    find_pareto_front,
)

BUDGETS = st.integers(1, 40)
SEEDS = st.integers(0, 2**63 - 1)
LAWS = st.sampled_from(sorted(SEARCH_SPACES))


def score_distance_to_one(gains: dict[str, float]) -> CandidateScore:
    """Returns a score whose error is least at gains of 1, and whose effort is the sum of the gains."""
    error = sum(math.log(value) ** 2 for value in gains.values())
    return make_candidate_score(error_rad=error, effort_nm=sum(gains.values()))


def score_divergence(_: dict[str, float]) -> CandidateScore:
    """Returns the score of a run that diverged."""
    return make_candidate_score(
        CandidateClass.DIVERGED, None, None, pose_rad=None, diverged_s=0.1
    )


def run_search(
    law: str,
    budget: int,
    seed: int,
    score: Callable[[dict[str, float]], CandidateScore] = score_distance_to_one,
) -> CandidateSearch:
    """Returns a finished search in which a function gives the scores of all candidates."""
    search = CandidateSearch(SEARCH_SPACES[law], budget, seed, Objective.ERROR)
    for number in range(len(search.rounds)):
        candidates = search.propose_candidates(number)
        search.record_scores(candidates, [score(gains) for gains in candidates])
    return search


SCORE_FUNCTIONS = st.sampled_from([score_distance_to_one, score_divergence])


@settings(max_examples=40)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS, score=SCORE_FUNCTIONS)
def test_every_law_gets_its_budget_within_its_ranges(
    law: str, budget: int, seed: int, score: Callable[[dict[str, float]], CandidateScore]
) -> None:
    search = run_search(law, budget, seed, score)
    assert len(search.tried) == len(search.scores) == budget
    for gains in search.tried:
        assert list(gains) == [knob.name for knob in SEARCH_SPACES[law].knobs]
        assert all(
            knob.low <= gains[knob.name] <= knob.high for knob in SEARCH_SPACES[law].knobs
        )


@settings(max_examples=20)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS)
def test_the_seed_decides_all(law: str, budget: int, seed: int) -> None:
    assert run_search(law, budget, seed).tried == run_search(law, budget, seed).tried
    assert run_search(law, budget, seed).tried != run_search(law, budget, seed ^ 1).tried


@settings(max_examples=20)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS)
def test_first_half_samples_every_slice_of_ranges(law: str, budget: int, seed: int) -> None:
    """This is the property of a Latin hypercube (McKay, Beckman and Conover 1979)."""
    first = CandidateSearch(
        SEARCH_SPACES[law], budget, seed, Objective.ERROR
    ).propose_candidates(0)
    for knob in SEARCH_SPACES[law].knobs:
        share = np.log([gains[knob.name] / knob.low for gains in first]) / math.log(
            knob.high / knob.low
        )
        counts, _ = np.histogram(share, bins=len(first), range=(0.0, 1.0))
        assert np.abs(counts - 1).sum() <= 2  # four digits may carry one across an edge


def test_laws_with_equal_gains_begin_at_equal_places() -> None:
    adaptive, boxed = (
        CandidateSearch(SEARCH_SPACES[law], 16, 3, Objective.ERROR).propose_candidates(0)
        for law in ("adaptive", "adaptive_box")
    )
    assert adaptive == boxed


@pytest.mark.parametrize("law", ["p_d", "adaptive"])
def test_refinement_beats_the_hypercube(law: str) -> None:
    """Refinement comes closer to a known minimum, at gains of 1, than twice as many samples."""
    refined = [
        min(s.error_rad or 0.0 for s in run_search(law, 64, seed).scores) for seed in range(10)
    ]
    spread = [
        min(
            score_distance_to_one(gains).error_rad or 0.0
            for gains in CandidateSearch(
                SEARCH_SPACES[law], 128, seed, Objective.ERROR
            ).propose_candidates(0)
        )
        for seed in range(10)
    ]
    assert np.median(refined) < 0.5 * np.median(spread)


NUMBERS = st.floats(0.0, 10.0).map(lambda x: round(x, 1))
POINTS = st.lists(st.none() | st.tuples(NUMBERS, NUMBERS), max_size=30)


SCORES = st.lists(
    st.builds(make_candidate_score, st.sampled_from(list(CandidateClass)), NUMBERS, NUMBERS),
    max_size=30,
)


@given(points=POINTS)
def test_no_candidate_dominates_a_point_of_front(
    points: list[tuple[float, float] | None],
) -> None:
    competing = [point for point in points if point is not None]
    kept = [points[n] for n in find_pareto_front(points)]
    assert None not in kept
    assert not any(dominates(a, b) for a in competing for b in kept if b is not None)


@given(points=POINTS)
def test_every_omitted_candidate_is_dominated_or_double(
    points: list[tuple[float, float] | None],
) -> None:
    """A candidate beside the front is worse than one on it, or equal to one on it."""
    kept = set(find_pareto_front(points))
    held = [points[n] for n in kept]
    for n, point in enumerate(points):
        if point is not None and n not in kept:
            assert point in held or any(dominates(a, point) for a in held if a is not None)


@given(points=POINTS)
def test_front_is_ordered_by_effort_against_objective(
    points: list[tuple[float, float] | None],
) -> None:
    kept = [point for n in find_pareto_front(points) if (point := points[n]) is not None]
    assert [p[1] for p in kept] == sorted(p[1] for p in kept)
    assert [p[0] for p in kept] == sorted((p[0] for p in kept), reverse=True)


@given(scores=SCORES)
def test_only_settled_runs_compete(scores: list[CandidateScore]) -> None:
    """Hanging arms have strayed: whatever their error and effort, they dominate nothing."""
    for objective in Objective:
        for n in find_pareto_front([objective.point(score) for score in scores]):
            assert scores[n].outcome is CandidateClass.SETTLED


def test_front_spacing_treats_ends_and_equal_gaps_alike() -> None:
    assert compute_crowding([(4.0, 0.0), (3.0, 1.0), (2.0, 2.0), (0.0, 4.0)]) == [
        float("inf"),
        1.0,
        1.5,
        float("inf"),
    ]
    assert compute_crowding([(1.0, 1.0)]) == [float("inf")]

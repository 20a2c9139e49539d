"""The search that every law gets, and its front."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trilat_studies.tuning.candidate import CandidateClass, CandidateScore
from trilat_studies.tuning.search_space import SEARCH_SPACES
from trilat_studies.tuning.tuning_plan import (
    CandidateSearch,
    Objective,
    compute_crowding,
    find_pareto_front,
)

from .experiments import dominates

BUDGETS = st.integers(1, 40)
SEEDS = st.integers(0, 2**63 - 1)
LAWS = st.sampled_from(sorted(SEARCH_SPACES))


def bowl(gains: dict[str, float]) -> CandidateScore:
    """Returns a score with the least error at the middle of every range; effort rises with the gains."""
    log = sum(math.log(value) ** 2 for value in gains.values())
    return CandidateScore(CandidateClass.SETTLED, log, log, 0.0, sum(gains.values()), log, 0.0)


def lost(_: dict[str, float]) -> CandidateScore:
    """Returns the score of a run that diverged."""
    return CandidateScore(CandidateClass.DIVERGED, None, None, None, None, None, 0.0, 0.1)


def searched(law: str, budget: int, seed: int, score: object = bowl) -> CandidateSearch:
    """Returns a finished search in which a function gives the scores of all candidates."""
    search = CandidateSearch(SEARCH_SPACES[law], budget, seed, Objective.ERROR)
    for number in range(len(search.rounds)):
        candidates = search.propose_candidates(number)
        search.record_scores(candidates, [score(gains) for gains in candidates])  # type: ignore[operator]
    return search


@settings(max_examples=40)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS, score=st.sampled_from([bowl, lost]))
def test_every_law_gets_its_budget_within_its_ranges(
    law: str, budget: int, seed: int, score: object
) -> None:
    search = searched(law, budget, seed, score)
    assert len(search.tried) == len(search.scores) == budget
    for gains in search.tried:
        assert list(gains) == [knob.name for knob in SEARCH_SPACES[law].knobs]
        assert all(
            knob.low <= gains[knob.name] <= knob.high for knob in SEARCH_SPACES[law].knobs
        )


@settings(max_examples=20)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS)
def test_the_seed_decides_all(law: str, budget: int, seed: int) -> None:
    assert searched(law, budget, seed).tried == searched(law, budget, seed).tried
    assert searched(law, budget, seed).tried != searched(law, budget, seed ^ 1).tried


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
    firsts = [
        CandidateSearch(SEARCH_SPACES[law], 16, 3, Objective.ERROR).propose_candidates(0)
        for law in ("adaptive", "adaptive_box")
    ]
    assert firsts[0] == firsts[1]


@pytest.mark.parametrize("law", ["p_d", "adaptive"])
def test_refinement_beats_the_hypercube(law: str) -> None:
    """Refinement comes closer to a known minimum, at gains of 1, than twice as many samples."""
    refined = [
        min(s.error_rad or 0.0 for s in searched(law, 64, seed).scores) for seed in range(10)
    ]
    spread = [
        min(
            bowl(gains).error_rad or 0.0
            for gains in CandidateSearch(
                SEARCH_SPACES[law], 128, seed, Objective.ERROR
            ).propose_candidates(0)
        )
        for seed in range(10)
    ]
    assert np.median(refined) < 0.5 * np.median(spread)


NUMBERS = st.floats(0.0, 10.0).map(lambda x: round(x, 1))
POINTS = st.lists(st.none() | st.tuples(NUMBERS, NUMBERS), max_size=30)


def score(outcome: CandidateClass, error_rad: float, effort_nm: float) -> CandidateScore:
    """Returns a score with this outcome, error and effort."""
    return CandidateScore(outcome, error_rad, error_rad, 0.0, effort_nm, error_rad, 0.0)


SCORES = st.lists(
    st.builds(score, st.sampled_from(list(CandidateClass)), NUMBERS, NUMBERS), max_size=30
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
        for n in find_pareto_front([objective.point(one) for one in scores]):
            assert scores[n].outcome is CandidateClass.SETTLED


def test_front_spacing_treats_ends_and_equal_gaps_alike() -> None:
    assert compute_crowding([(4.0, 0.0), (3.0, 1.0), (2.0, 2.0), (0.0, 4.0)]) == [
        float("inf"),
        1.0,
        1.5,
        float("inf"),
    ]
    assert compute_crowding([(1.0, 1.0)]) == [float("inf")]

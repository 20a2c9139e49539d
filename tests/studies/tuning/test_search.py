import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.studies.tuning.candidate import CandidateScore
from trilat_net.studies.tuning.final_posture import CandidateClass
from trilat_net.studies.tuning.pareto_search import CandidateSearch, Objective
from trilat_net.studies.tuning.search_space import SEARCH_SPACES

BUDGETS = st.integers(1, 40)
SEEDS = st.integers(0, 2**63 - 1)
LAWS = st.sampled_from(sorted(SEARCH_SPACES))


def bowl(gains: dict[str, float]) -> CandidateScore:
    """Least error at the middle of every range; effort rises with the gains."""
    log = sum(math.log(value) ** 2 for value in gains.values())
    return CandidateScore(CandidateClass.SETTLED, log, log, 0.0, sum(gains.values()), log, 0.0)


def lost(_: dict[str, float]) -> CandidateScore:
    return CandidateScore(CandidateClass.DIVERGED, None, None, None, None, None, 0.0, 0.1)


def searched(law: str, budget: int, seed: int, score: object = bowl) -> CandidateSearch:
    search = CandidateSearch(SEARCH_SPACES[law], budget, seed, Objective.ERROR)
    for number in range(len(search.rounds)):
        asked = search.ask(number)
        search.tell(asked, [score(gains) for gains in asked])  # type: ignore[operator]
    return search


@settings(max_examples=40)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS, score=st.sampled_from([bowl, lost]))
def test_every_law_gets_its_budget_within_its_ranges(law: str, budget: int, seed: int, score: object) -> None:
    search = searched(law, budget, seed, score)
    assert len(search.tried) == len(search.scores) == budget
    for gains in search.tried:
        assert list(gains) == [knob.name for knob in SEARCH_SPACES[law].knobs]
        assert all(knob.low <= gains[knob.name] <= knob.high for knob in SEARCH_SPACES[law].knobs)


@settings(max_examples=20)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS)
def test_the_seed_decides_all(law: str, budget: int, seed: int) -> None:
    assert searched(law, budget, seed).tried == searched(law, budget, seed).tried
    assert searched(law, budget, seed).tried != searched(law, budget, seed ^ 1).tried


@settings(max_examples=20)
@given(law=LAWS, budget=BUDGETS, seed=SEEDS)
def test_the_first_half_has_one_candidate_in_every_slice_of_every_range(
    law: str, budget: int, seed: int
) -> None:
    """What makes a Latin hypercube of it (McKay, Beckman and Conover 1979)."""
    first = CandidateSearch(SEARCH_SPACES[law], budget, seed, Objective.ERROR).ask(0)
    for knob in SEARCH_SPACES[law].knobs:
        share = np.log([gains[knob.name] / knob.low for gains in first]) / math.log(knob.high / knob.low)
        counts, _ = np.histogram(share, bins=len(first), range=(0.0, 1.0))
        assert np.abs(counts - 1).sum() <= 2  # four digits may carry one across an edge


def test_laws_with_as_many_gains_begin_at_the_same_places() -> None:
    firsts = [
        CandidateSearch(SEARCH_SPACES[law], 16, 3, Objective.ERROR).ask(0)
        for law in ("adaptive", "adaptive_box")
    ]
    assert firsts[0] == firsts[1]


@pytest.mark.parametrize("law", ["p_d", "adaptive"])
def test_refinement_comes_nearer_than_the_hypercube_of_all(law: str) -> None:
    """On a bowl whose bottom is known: 0 at gains of 1."""
    refined = [min(s.error_rad or 0.0 for s in searched(law, 64, seed).scores) for seed in range(10)]
    spread = [
        min(
            bowl(gains).error_rad or 0.0
            for gains in CandidateSearch(SEARCH_SPACES[law], 128, seed, Objective.ERROR).ask(0)
        )
        for seed in range(10)
    ]
    assert np.median(refined) < 0.5 * np.median(spread)

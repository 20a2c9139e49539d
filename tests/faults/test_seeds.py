"""Whole sessions with faults drawn from a seed, in virtual time, over the code that runs live."""

from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .fault_schedule import KINDS, SHORT, SITES, WHOLE, Fault, draw_faults
from .judged_seed import Judged, judge_faults, judge_seed
from .planted_bugs import PLANTED

ON_PUSH = 6
FINDS_WITHIN = 200


@pytest.mark.parametrize("first", range(0, ON_PUSH, 3))
def test_invariants_hold_in_short_faulty_sessions(first: int) -> None:
    """Six seeds on a push, in short sessions that no member leaves, one of them twice.

    Kills and returns are covered by tests/sites/test_leaving.py, and by the long seeds.
    """
    for seed in range(first, first + 3):
        assert_holds(judge_seed(seed, again=seed == 0, timetable=SHORT))


@pytest.mark.long
def test_invariants_hold_in_a_hundred_whole_sessions() -> None:
    """`make faults` judges two thousand, in hours of processor time."""
    visited: Counter[str] = Counter()
    for seed in range(100):
        judged_seed = judge_seed(seed)
        assert_holds(judged_seed)
        visited += judged_seed.visited
    assert not set(SOMETIMES) - set(visited)


def test_sites_report_a_cut_off_peer() -> None:
    cut = Fault("cut", 0.571, 1.2286, ("m2", "m1"), 0.0)
    end = Fault("end", 1.453, 0.01, ("m2",), 0.0)
    assert_holds(judge_faults((cut, end)))


def assert_holds(judged: Judged) -> None:
    assert not judged.violations, f"\n{judged}"


SOMETIMES = (
    *(f"mode {mode}" for mode in ("waiting", "return", "run", "hold")),
    *(f"event {kind}" for kind in ("mode", "change", "lost", "left", "join", "end")),
    *(f"fault {kind}" for kind in KINDS),
    "dropped stranger",
    "dropped missing",
)
"""What a hundred seeds must have come by, or they try too little."""


@pytest.mark.long
@pytest.mark.parametrize(("bug", "breaks"), PLANTED, ids=[bug.__name__ for bug, _ in PLANTED])
def test_a_planted_bug_is_found(bug, breaks: str) -> None:  # type: ignore[no-untyped-def]
    judge_faults(())  # what is undisturbed is measured before
    with bug():
        for seed in range(FINDS_WITHIN):
            if breaks in judge_seed(seed, again=breaks.startswith("I11")).violations:
                return
    pytest.fail(f"{FINDS_WITHIN} seeds do not find it")


def faults_of(kind: str) -> st.SearchStrategy[Fault]:
    least, most = KINDS[kind].sizes
    at_s = st.floats(*WHOLE.trouble_s).map(lambda x: round(x, 3))
    of = {
        0: st.just(()),
        1: st.tuples(st.sampled_from(SITES)),
        2: st.permutations([*SITES, "recorder"]).map(lambda names: tuple(names[:2])),
    }[len(draw_of(kind))]
    for_s = st.floats(0.001, WHOLE.healed_s - WHOLE.trouble_s[1]).map(lambda x: round(x, 3))
    return st.builds(Fault, st.just(kind), at_s, for_s, of, st.floats(least, most))


def draw_of(kind: str) -> tuple[str, ...]:
    """Returns the sites that a kind of fault befalls, once."""
    return next(
        fault.of for seed in range(10_000) for fault in draw_faults(seed) if fault.kind == kind
    )


@pytest.mark.long
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.sampled_from(sorted(KINDS)).flatmap(faults_of), max_size=5))
def test_any_drawn_faults_keep_the_invariants(faults: Sequence[Fault]) -> None:
    """Hypothesis shrinks failing faults."""
    assert_holds(judge_faults(sorted(faults, key=lambda fault: fault.at_s)))

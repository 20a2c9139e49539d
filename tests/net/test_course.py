"""The offset in force never steps, and its bound is honest on the way to every new estimate."""

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.net.offset import SLEW_NS, OffsetEstimate, OffsetEstimator, SlewedOffset, exact_offset

from .crossing import Other, S, queueing, second

estimates = st.builds(
    lambda offset_ns, drift, below, above: OffsetEstimate(
        0, offset_ns, drift, offset_ns - below, offset_ns + above, drift - 1000, drift + 1000
    ),
    st.integers(-(10**15), 10**15),
    st.floats(-200_000, 200_000),
    st.integers(0, 10**6),
    st.integers(0, 10**6),
)


@given(st.lists(st.tuples(estimates, st.integers(1, 3 * S)), min_size=1, max_size=6))
def test_it_is_continuous_whatever_estimates_come_and_when(bends: list[tuple[OffsetEstimate, int]]) -> None:
    course, now_ns = SlewedOffset(exact_offset(5)), 0
    for estimate, passed_ns in bends:
        now_ns += passed_ns
        before = course.at(now_ns)
        course.slew_to(now_ns, estimate._replace(at_ns=now_ns))
        assert abs(course.at(now_ns) - before) <= 1 + abs(estimate.offset_ns - before) * 1e-12
        for at_ns in (now_ns, now_ns + SLEW_NS // 3, now_ns + SLEW_NS, now_ns + 2 * SLEW_NS):
            steps = [course.at(at_ns + n) for n in range(3)]
            assert max(steps) - min(steps) <= 3 + 3 * abs(estimate.offset_ns - before) / SLEW_NS


@given(estimates)
def test_it_reaches_an_estimate_in_its_time_and_follows_it(estimate: OffsetEstimate) -> None:
    course = SlewedOffset(exact_offset(0))
    course.slew_to(0, estimate)
    for at_ns in (SLEW_NS, 2 * SLEW_NS, 10 * SLEW_NS):
        assert abs(course.at(at_ns) - estimate.offset_at(at_ns)) <= 2


@given(st.integers(0, 2**32), st.integers(-(10**12), 10**12), st.floats(-150_000, 150_000))
@settings(max_examples=30, deadline=None)
def test_the_truth_is_inside_its_bound_at_every_instant(seed: int, offset_ns: int, drift_ppb: float) -> None:
    """From the first exchange on, with estimates that come late, and through a silence of a minute."""
    other, rnd, estimator = Other(offset_ns, drift_ppb), random.Random(seed), OffsetEstimator()
    estimator.add(*second(other, 0, queueing(300, 1000), queueing(50, 1000), rnd, 3))
    first = estimator.estimate(S)
    assert first is not None
    course, now_ns = SlewedOffset(first), S
    for silence in (False,) * 8 + (True,):
        for _ in range(20):
            at_ns = now_ns + rnd.randrange(60 * S if silence else 3 * S)
            assert abs(course.at(at_ns) - other.offset(at_ns)) <= course.bound_at(at_ns) + 3
        estimator.add(*second(other, now_ns, queueing(100, 300), queueing(50, 100), rnd, 10))
        now_ns += S + rnd.randrange(S)
        estimate = estimator.estimate(now_ns)
        assert estimate is not None
        bent_ns = now_ns + rnd.randrange(1_000_000)
        course.slew_to(bent_ns, estimate)
        assert course.bound_at(bent_ns + SLEW_NS) == course.bound_ns
        now_ns = bent_ns


def test_of_one_clock_it_is_exact_for_ever() -> None:
    course = SlewedOffset(exact_offset(0))
    assert [course.at(at_ns) for at_ns in (-S, 0, 10**16)] == [0, 0, 0]
    assert [course.bound_at(at_ns) for at_ns in (0, 10**16)] == [0, 0]

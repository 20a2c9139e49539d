"""Estimated offsets lie within their bounds for any delays, and the offset in use never steps."""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.net.crossing import exchange_second, make_ceiling, make_floor, make_queueing_delay
from trilat_net.net.offset import (
    SLEW_NS,
    WINDOWS_KEPT,
    OffsetEstimate,
    OffsetEstimator,
    OffsetLimit,
    SlewedOffset,
    format_offset,
)

from .crossing import Other, S

DAY = 86_400 * S

others = st.builds(Other, st.integers(-3 * DAY, 3 * DAY), st.floats(-200_000, 200_000))
delays = st.one_of(st.integers(0, 2_000_000), st.integers(0, 3 * S))
# (pause before it, whether it goes there, how long it takes)
messages = st.lists(
    st.tuples(st.integers(0, 5 * S), st.booleans(), delays), min_size=1, max_size=80
)


@given(others, messages, st.integers(0, 100 * S))
@settings(max_examples=100)
def test_true_offset_and_drift_stay_inside_bounds(
    other: Other, crossings: list[tuple[int, bool, int]], silence_ns: int
) -> None:
    """Delays as unequal as possible, pauses, ways without messages, and a silence afterwards."""
    estimator = OffsetEstimator()
    now_ns = latest_ns = 0
    for pause_ns, there_ns, delay_ns in crossings:
        now_ns += pause_ns
        if there_ns:
            estimator.add(make_ceiling(other, now_ns, delay_ns), None)
        else:
            estimator.add(None, make_floor(other, now_ns, delay_ns))
        latest_ns = max(latest_ns, now_ns + delay_ns)
    estimate = estimator.estimate(latest_ns)
    assert estimator.broken == 0
    if estimate is None:
        assert len({there_ns for _, there_ns, _ in crossings}) == 1
        return
    for later_ns in (0, silence_ns):
        at_ns = latest_ns + later_ns
        truth = other.offset(at_ns)
        for value in (estimate.extrapolate_ns(at_ns), estimate.offset_ns + 5_000_000):
            assert abs(truth - value) <= estimate.error_bound_ns(at_ns, value) + 2
    assert estimate.low_ns - 2 <= estimate.offset_ns <= estimate.high_ns + 2
    assert estimate.drift_low <= other.drift_ppb <= estimate.drift_high


@given(others, delays, delays)
def test_one_exchange_gives_the_classical_offset(
    other: Other, there_ns: int, back_ns: int
) -> None:
    """Four stamps of one instant: (t1 + t2 - t3 - t4)/2 within (t4 - t1 - (t3 - t2))/2, and
    drift besides.
    """
    sent = make_ceiling(other, 0, there_ns)
    bound = make_floor(other, there_ns, back_ns)
    estimator = OffsetEstimator()
    estimator.add(sent, bound)
    estimate = estimator.estimate(there_ns + back_ns)
    assert estimate is not None
    trip_ns = there_ns + back_ns
    classical = (sent.offset_ns + bound.offset_ns) / 2
    spread_ns = 600e-6 * trip_ns + 2
    assert abs(estimate.offset_ns - classical) <= spread_ns
    bound_ns = estimate.error_bound_ns(estimate.local_ns, estimate.offset_ns)
    assert trip_ns / 2 - spread_ns <= bound_ns <= trip_ns / 2 + spread_ns


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.long) for n in range(1, 5))]
)
@pytest.mark.parametrize(
    ("offset_ns", "drift_ppb"), [(3 * S, 100_000), (-2 * DAY, -100_000), (5, 0)]
)
def test_offset_and_drift_are_recovered(seed: int, offset_ns: int, drift_ppb: int) -> None:
    """Within 100 us and 20 ppm after 10 s, 5 ppm after 60 s, for the ways of one busy machine."""
    other = Other(offset_ns, drift_ppb)
    rnd = random.Random(seed)
    estimator = OffsetEstimator()
    for n in range(60):
        estimator.add(
            *exchange_second(
                other, n * S, make_queueing_delay(90, 200), make_queueing_delay(120, 300), rnd
            )
        )
        at_ns = (n + 1) * S
        estimate = estimator.estimate(at_ns)
        assert estimate is not None
        if n >= 9:
            assert abs(estimate.offset_ns - other.offset(at_ns)) <= 40_000
            assert abs(estimate.drift - drift_ppb) <= 20_000
            assert estimate.error_bound_ns(at_ns, estimate.offset_ns) <= 200_000
    assert abs(estimate.drift - drift_ppb) <= 5_000
    assert estimate.drift_high - estimate.drift_low <= 20_000


def test_unequal_ways_bias_estimates_within_bounds() -> None:
    other = Other(S, 20_000)
    rnd = random.Random(1)
    estimator = OffsetEstimator()
    for n in range(20):
        estimator.add(
            *exchange_second(
                other, n * S, make_queueing_delay(500, 50), make_queueing_delay(100, 50), rnd
            )
        )
    estimate = estimator.estimate(20 * S)
    assert estimate is not None
    error_ns = estimate.offset_ns - other.offset(20 * S)
    assert error_ns == pytest.approx(200_000, abs=20_000)  # half of what the ways differ by
    assert abs(error_ns) <= estimate.error_bound_ns(20 * S, estimate.offset_ns) <= 350_000


def test_bounds_follow_the_quickest_messages() -> None:
    other = Other(7, 0)
    estimator = OffsetEstimator()
    estimator.add(make_ceiling(other, 0, 10_000), make_floor(other, 1_000_000, 900_000))
    estimator.add(make_ceiling(other, 2_000_000, 900_000), make_floor(other, 3_000_000, 20_000))
    estimate = estimator.estimate(4_000_000)
    assert estimate is not None
    assert estimate.error_bound_ns(4_000_000, estimate.offset_ns) <= 15_000 + 3_000


def test_bad_minutes_do_not_move_the_drift() -> None:
    other = Other(S, 50_000)
    rnd = random.Random(2)
    estimator = OffsetEstimator()
    for n in range(40):
        bad = 15 <= n < 25
        way_back = make_queueing_delay(5_000, 5_000) if bad else make_queueing_delay(100, 50)
        estimator.add(
            *exchange_second(other, n * S, way_back, make_queueing_delay(100, 50), rnd)
        )
    estimate = estimator.estimate(40 * S)
    assert estimate is not None
    assert estimate.drift == pytest.approx(50_000, abs=1_000)
    assert abs(estimate.offset_ns - other.offset(40 * S)) < 30_000


@given(st.floats(1.0, 100.0), st.floats(0.0, 2 * math.pi), st.integers(0, 2**32))
@settings(max_examples=12, deadline=None)
def test_wandering_drift_stays_inside(period_s: float, phase: float, seed: int) -> None:
    """The offset's rate swings by a quarter of a part per million, so over any stretch within WANDER."""
    size = 250.0 * period_s / (2 * math.pi)

    def wander(own_ns: int) -> float:
        return size * math.sin(2 * math.pi * own_ns / S / period_s + phase)

    other = Other(S, 40_000, wander)
    rnd = random.Random(seed)
    estimator = OffsetEstimator()
    for n in range(70):
        estimator.add(
            *exchange_second(
                other, n * S, make_queueing_delay(1, 1), make_queueing_delay(1, 1), rnd, 10
            )
        )
        estimate = estimator.estimate((n + 1) * S)
        assert estimate is not None
        assert estimate.low_ns - 2 <= other.offset((n + 1) * S) <= estimate.high_ns + 2
    assert estimator.broken == 0


@pytest.mark.parametrize("step_ns", [S, -S, 2_000_000, -2_000_000])
def test_stepped_clocks_are_noticed_and_found_again(step_ns: int) -> None:
    rnd = random.Random(3)
    estimator = OffsetEstimator()
    before = Other(S, 30_000)
    after = Other(S + step_ns, 30_000)
    for n in range(30):
        estimator.add(
            *exchange_second(
                before, n * S, make_queueing_delay(100, 50), make_queueing_delay(100, 50), rnd
            )
        )
        assert estimator.estimate((n + 1) * S) is not None
    assert estimator.broken == 0
    for n in range(30, 34):
        estimator.add(
            *exchange_second(
                after, n * S, make_queueing_delay(100, 50), make_queueing_delay(100, 50), rnd
            )
        )
        estimate = estimator.estimate((n + 1) * S)
    assert estimator.broken > 0
    assert estimate is not None
    assert estimate.low_ns <= after.offset(34 * S) <= estimate.high_ns


def test_only_contradicting_limits_leave_nothing() -> None:
    estimator = OffsetEstimator()
    estimator.add(OffsetLimit(0, 10), OffsetLimit(0, 20_000_000))
    assert estimator.estimate(S) is None
    assert estimator.broken == 1
    estimator.add(OffsetLimit(S, 30), OffsetLimit(S, 10))
    assert estimator.estimate(S) is not None


def test_memory_is_bounded_to_the_newest() -> None:
    other = Other(S, 0)
    estimator = OffsetEstimator()
    for n in range(3 * WINDOWS_KEPT):
        estimator.add(make_ceiling(other, n * S, 1000), make_floor(other, n * S, 1000))
    assert {len(limits) for limits in (estimator._ceilings, estimator._floors)} == {
        WINDOWS_KEPT
    }
    assert estimator._ceilings[0].local_ns == 2 * WINDOWS_KEPT * S


def test_one_clock_needs_no_estimate() -> None:
    offset = OffsetEstimate.exact(0)
    course = SlewedOffset(offset)
    for at_ns in (-S, 0, 10**16):
        assert offset.extrapolate_ns(at_ns) == course.evaluate_ns(at_ns) == 0
        assert offset.error_bound_ns(at_ns, 0) == course.error_bound_ns(at_ns) == 0
        assert offset.error_bound_ns(at_ns, 7) == 7


def test_contradictions_widen_an_estimate() -> None:
    offset = OffsetEstimate.exact(5)
    wider = offset.widen(OffsetLimit(0, -100), None)
    assert (wider.low_ns, wider.high_ns, wider.offset_ns) == (-100, 5, 5)
    assert offset.widen(None, None) == offset


def test_offsets_are_printed_in_seconds_and_microseconds() -> None:
    assert format_offset(3_000_012_345, 84_001) == "offset 3.000012 s +- 85 us"


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
def test_the_used_offset_is_always_continuous(
    bends: list[tuple[OffsetEstimate, int]],
) -> None:
    course = SlewedOffset(OffsetEstimate.exact(5))
    now_ns = 0
    for estimate, passed_ns in bends:
        now_ns += passed_ns
        before = course.evaluate_ns(now_ns)
        course.slew_to(now_ns, estimate._replace(local_ns=now_ns))
        assert (
            abs(course.evaluate_ns(now_ns) - before)
            <= 1 + abs(estimate.offset_ns - before) * 1e-12
        )
        for at_ns in (now_ns, now_ns + SLEW_NS // 3, now_ns + SLEW_NS, now_ns + 2 * SLEW_NS):
            steps = [course.evaluate_ns(at_ns + n) for n in range(3)]
            assert max(steps) - min(steps) <= 3 + 3 * abs(estimate.offset_ns - before) / SLEW_NS


@given(estimates)
def test_used_offset_reaches_and_follows_its_estimate(estimate: OffsetEstimate) -> None:
    course = SlewedOffset(OffsetEstimate.exact(0))
    course.slew_to(0, estimate)
    for at_ns in (SLEW_NS, 2 * SLEW_NS, 10 * SLEW_NS):
        assert abs(course.evaluate_ns(at_ns) - estimate.extrapolate_ns(at_ns)) <= 2


@given(st.integers(0, 2**32), st.integers(-(10**12), 10**12), st.floats(-150_000, 150_000))
@settings(max_examples=12, deadline=None)
def test_bounds_hold_the_truth_at_every_instant(
    seed: int, offset_ns: int, drift_ppb: float
) -> None:
    """The bounds hold from the first exchange on, with late estimates, and through a silence of a minute."""
    other = Other(offset_ns, drift_ppb)
    rnd = random.Random(seed)
    estimator = OffsetEstimator()
    estimator.add(
        *exchange_second(
            other, 0, make_queueing_delay(300, 1000), make_queueing_delay(50, 1000), rnd, 3
        )
    )
    first = estimator.estimate(S)
    assert first is not None
    course = SlewedOffset(first)
    now_ns = S
    for silence in (False,) * 8 + (True,):
        for _ in range(20):
            at_ns = now_ns + rnd.randrange(60 * S if silence else 3 * S)
            assert (
                abs(course.evaluate_ns(at_ns) - other.offset(at_ns))
                <= course.error_bound_ns(at_ns) + 3
            )
        estimator.add(
            *exchange_second(
                other,
                now_ns,
                make_queueing_delay(100, 300),
                make_queueing_delay(50, 100),
                rnd,
                10,
            )
        )
        now_ns += S + rnd.randrange(S)
        estimate = estimator.estimate(now_ns)
        assert estimate is not None
        bent_ns = now_ns + rnd.randrange(1_000_000)
        course.slew_to(bent_ns, estimate)
        assert course.error_bound_ns(bent_ns + SLEW_NS) == course.bound_ns
        now_ns = bent_ns

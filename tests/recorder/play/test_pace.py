"""The due times of messages, as a function of their times."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.app.play.player import (
    LATENESS_LIMIT_US,
    SPIN_NS,
    LatenessHistogram,
    Pace,
    wait_until,
)
from trilat_net.errors import UsageError

from .clocks import LookedAt

times = st.integers(-(10**12), 10**14)
rates = st.one_of(st.floats(1e-3, 1e3), st.just(math.inf))
paces = st.builds(Pace, st.integers(0, 10**15), times, rates)


@given(paces, times, times)
def test_later_messages_are_never_due_earlier(pace: Pace, first: int, other: int) -> None:
    assert (pace.due_ns(min(first, other))) <= pace.due_ns(max(first, other))


@given(paces, times)
def test_deadlines_follow_origin_and_rate(pace: Pace, t_ns: int) -> None:
    assert pace.due_ns(pace.start_ns) == pace.origin_ns
    passed_ns = pace.due_ns(t_ns) - pace.origin_ns
    if math.isinf(pace.rate):
        assert passed_ns == 0
    else:
        assert passed_ns * pace.rate == pytest.approx(
            t_ns - pace.start_ns, rel=1e-9, abs=pace.rate
        )


@given(paces, st.integers(0, 10**13), times)
def test_rounds_are_shifted_by_their_length(pace: Pace, length_ns: int, t_ns: int) -> None:
    later_ns = pace.due_ns(pace.start_ns + length_ns) - pace.origin_ns
    assert pace.later(length_ns).due_ns(t_ns) == pace.due_ns(t_ns) + later_ns


@given(
    st.integers(0, 10**6),
    st.integers(0, 10**6),
    st.sampled_from([0, SPIN_NS]),
    st.integers(0, 200_000),
)
def test_waiting_ends_at_the_deadline_or_at_once(
    now_ns: int, due_ns: int, spin_ns: int, oversleep_ns: int
) -> None:
    clock = LookedAt(now_ns, oversleep_ns)
    read_ns = wait_until(clock, due_ns, spin_ns)
    assert read_ns == clock.now_ns
    assert read_ns >= due_ns
    if now_ns >= due_ns:
        assert read_ns == now_ns + 1_000
    elif spin_ns:
        assert read_ns <= due_ns + 1_000 + max(0, oversleep_ns - spin_ns)
    else:
        assert read_ns == due_ns + oversleep_ns + 1_000


@pytest.mark.parametrize(
    ("text", "rate"),
    [("1", 1.0), ("0.5", 0.5), ("1e3", 1000.0), ("0", math.inf), ("max", math.inf)],
)
def test_rates(text: str, rate: float) -> None:
    assert Pace.parse_rate(text) == rate


@pytest.mark.parametrize("text", ["-1", "nan", "inf", "", "fast", "1e-4", "1001", "1e-300"])
def test_invalid_rates_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(
        UsageError,
        match=r"rate, the speed relative to the recorded run, must be from 0\.001 to 1000, or",
    ):
        Pace.parse_rate(text)


@given(st.lists(st.integers(0, (LATENESS_LIMIT_US - 1) * 1000), min_size=1, max_size=50))
def test_quantiles_are_those_of_the_whole_microseconds(late_ns: list[int]) -> None:
    counted = LatenessHistogram()
    for late in late_ns:
        counted.add(late)
    whole = [late // 1000 for late in late_ns]
    summary = counted.summary()
    assert summary is not None
    quantiles = np.percentile(whole, (50, 99), method="inverted_cdf").tolist()
    assert [summary.p50_us, summary.p99_us] == quantiles
    assert summary.max_us == counted.max_us == max(whole)


def test_extreme_lateness_keeps_its_maximum() -> None:
    counted = LatenessHistogram()
    for late_us in (5, 3 * LATENESS_LIMIT_US, 2 * LATENESS_LIMIT_US):
        counted.add(late_us * 1000)
    summary = counted.summary()
    assert summary is not None
    assert (summary.p50_us, summary.p99_us, summary.max_us) == (3 * LATENESS_LIMIT_US,) * 3

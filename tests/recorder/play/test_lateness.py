"""Quantiles out of a bounded histogram."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recorder.play.pace import LATENESS_LIMIT_US, LatenessHistogram


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


def test_what_is_very_late_is_still_known_at_its_worst() -> None:
    counted = LatenessHistogram()
    for late_us in (5, 3 * LATENESS_LIMIT_US, 2 * LATENESS_LIMIT_US):
        counted.add(late_us * 1000)
    summary = counted.summary()
    assert summary is not None
    assert (summary.p50_us, summary.p99_us, summary.max_us) == (
        3 * LATENESS_LIMIT_US,
        3 * LATENESS_LIMIT_US,
        3 * LATENESS_LIMIT_US,
    )


def test_where_nothing_was_published_nothing_was_late() -> None:
    assert LatenessHistogram().summary() is None

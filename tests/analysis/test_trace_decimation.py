import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trilat_net.presentation.plot_signals import decimate, extreme_rows

numbers = st.one_of(st.floats(-1e6, 1e6), st.just(np.nan))
columns = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 400), st.integers(1, 4)), elements=numbers
)


@settings(max_examples=40)
@given(columns, st.integers(1, 30))
def test_every_bucket_keeps_its_extremes(values, buckets):
    keep = extreme_rows(values, buckets)
    size = max(1, -(-len(values) // buckets))
    for first in range(0, len(values), size):
        bucket = values[first : first + size]
        inside = values[keep[(keep >= first) & (keep < first + size)]]
        assert len(inside)
        for whole, thinned in zip(bucket.T, inside.T, strict=True):
            if np.isnan(whole).all():
                assert np.isnan(thinned).all()
            else:
                assert np.nanmin(thinned) == np.nanmin(whole)
                assert np.nanmax(thinned) == np.nanmax(whole)


@settings(max_examples=40)
@given(columns, st.integers(1, 30))
def test_the_ends_stay_and_the_rest_is_bounded(values, buckets):
    keep = extreme_rows(values, buckets)
    assert keep[0] == 0
    assert keep[-1] == len(values) - 1
    assert (np.diff(keep) > 0).all()
    assert len(keep) <= max(2 * buckets, 2 * values.shape[1] * buckets + 2)


def test_a_spike_of_one_tick_survives():
    values = np.zeros((1_000_000, 1))
    values[654_321] = -3.0
    tick = np.arange(1_000_000)
    trace = decimate(tick, tick * 1e-3, values, 500)
    assert len(trace.tick) < 1100
    assert trace.values.min() == -3.0
    assert trace.t_s[trace.values[:, 0].argmin()] == 654.321


def test_visible_gaps_break_the_line():
    tick = np.concatenate([np.arange(100), np.arange(900, 1000)])
    trace = decimate(tick, tick * 1e-3, np.ones((200, 2)), 50)
    (gap,) = np.flatnonzero(np.isnan(trace.values).any(axis=1))
    assert trace.tick[gap - 1] == 99
    assert trace.tick[gap] == 100
    assert trace.tick[gap + 1] == 900
    assert 0.099 < trace.t_s[gap] < 0.9


def test_gaps_narrower_than_a_bucket_break_nothing():
    tick = np.arange(0, 20_000, 2)
    trace = decimate(tick, tick * 1e-3, np.ones((10_000, 1)), 100)
    assert np.isfinite(trace.values).all()


def test_an_empty_trace_stays_empty():
    trace = decimate(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)), 10)
    assert trace.values.shape == (0, 2)

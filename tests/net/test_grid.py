"""Ticks lie on the leader's grid: exactly on an own clock, by slow slewing on another one."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.net.timing import SLEW_LIMIT, TickSchedule

from .crossing import Other, S

EPOCH_NS = 5_000_000_123


@given(st.integers(0, 10**9), st.integers(1, 4000))
def test_without_steering_it_is_the_absolute_grid_to_the_nanosecond(k: int, rate_hz: int) -> None:
    assert TickSchedule(EPOCH_NS, rate_hz).deadline(k) == EPOCH_NS + k * S // rate_hz


@given(
    st.lists(
        st.tuples(st.integers(1, 2000), st.integers(-(10**10), 10**10), st.floats(-1e6, 1e6)), max_size=20
    ),
    st.sampled_from([333, 1000, 4000]),
)
def test_it_never_steps_and_never_slews_beyond_the_limit(
    steers: list[tuple[int, int, float]], rate_hz: int
) -> None:
    grid, k = TickSchedule(EPOCH_NS, rate_hz), 0
    for ticks, error_ns, drift in steers:
        k += ticks
        before = grid.deadline(k)
        grid.steer(k, error_ns, drift)
        assert grid.deadline(k) == before
        assert abs(grid.slew) <= SLEW_LIMIT == 200_000.0
        nominal_ns = grid.nominal(k + rate_hz) - grid.nominal(k)
        assert abs(grid.deadline(k + rate_hz) - before - nominal_ns) <= nominal_ns * 200e-6 + 1
        for n in range(k, k + 5):
            assert grid.deadline(n + 1) > grid.deadline(n)


@pytest.mark.parametrize("drift_ppb", [-150_000, -100_000, 0, 37_000, 150_000])
@pytest.mark.parametrize("begin_ns", [-400_000, 0, 400_000])
def test_it_follows_the_leaders_grid_on_a_clock_that_drifts(drift_ppb: int, begin_ns: int) -> None:
    """From an epoch that was converted wrong by begin_ns, steered ten times a second by the true offset."""
    leader = Other(0, drift_ppb)
    grid = TickSchedule(begin_ns, 1000)
    errors = []
    for k in range(0, 60_000, 100):
        due_ns = grid.deadline(k)
        error_ns = leader.reads(due_ns) - grid.nominal(k)
        errors.append(error_ns)
        grid.steer(k, error_ns, drift_ppb)
        assert grid.error_ns == error_ns
    assert abs(errors[0] - begin_ns) <= 1000
    assert max(map(abs, errors)) <= abs(begin_ns) + 1000
    assert max(map(abs, errors[300:])) <= 200  # after 30 s it is there, to 0.2 us

"""The grid of ticks (L1): integers, exact."""

from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.core.step.ticks import first_tick_at, tick_ns

rates = st.integers(1, 20_000)
DAY_NS = 86_400 * 10**9


@given(rate_hz=rates, tick=st.integers(0, 86_400 * 20_000))
def test_ticks_are_periods_rounded_down_to_nanoseconds(rate_hz: int, tick: int) -> None:
    tick = min(tick, 86_400 * rate_hz)
    assert tick_ns(tick, rate_hz) == int(Fraction(tick, rate_hz) * 10**9)


@given(rate_hz=rates, due_ns=st.integers(-(10**10), DAY_NS))
def test_the_first_tick_at_a_time_is_first(rate_hz: int, due_ns: int) -> None:
    tick = first_tick_at(due_ns, rate_hz)
    assert Fraction(tick, rate_hz) * 10**9 >= due_ns > Fraction(tick - 1, rate_hz) * 10**9
    assert tick_ns(tick, rate_hz) >= due_ns > tick_ns(tick - 1, rate_hz)

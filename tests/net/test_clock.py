"""One contract for the machine's clocks, a test's manual clock, and a skewed clock."""

import os
import signal
import subprocess
import sys
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.manual_clock import ManualClock
from trilat_net.net.clock import Clock, SkewedClock, SystemClock

CLOCKS = {
    "system": SystemClock,
    "manual": lambda: ManualClock(5, 1_700_000_000_000_000_000),
    "skewed system": lambda: SkewedClock(SystemClock(), 3_000_000_000, 100_000),
    "skewed manual": lambda: SkewedClock(
        ManualClock(5, 1_700_000_000_000_000_000), -7, -100_000
    ),
}


@pytest.fixture(params=list(CLOCKS))
def clock(request: pytest.FixtureRequest) -> Clock:
    return CLOCKS[request.param]()


def test_clocks_never_go_back_and_agree(clock: Clock) -> None:
    readings = [clock.monotonic_ns() for _ in range(100)]
    assert readings == sorted(readings)
    unix_ns = clock.unix_ns()
    # it has passed: no sleep, and no step back
    clock.sleep_until(readings[-1] - 10_000_000_000)
    assert clock.monotonic_ns() >= readings[-1]
    clock.sleep_until(readings[-1] + 5_000_000)
    assert clock.unix_ns() > unix_ns


@pytest.mark.parametrize("ahead_ns", [1, 1_000_000])
def test_sleeping_never_ends_early(clock: Clock, ahead_ns: int) -> None:
    deadline_ns = clock.monotonic_ns() + ahead_ns
    clock.sleep_until(deadline_ns)
    assert clock.monotonic_ns() >= deadline_ns


def test_identity_is_the_same_every_time(clock: Clock) -> None:
    assert clock.identity()
    assert clock.identity() == clock.identity()


def test_a_manual_clock_moves_only_by_sleeping() -> None:
    clock = ManualClock(start_ns=7, epoch_unix_ns=100)
    assert (clock.monotonic_ns(), clock.unix_ns()) == (7, 107)
    clock.sleep_until(50)
    assert (clock.monotonic_ns(), clock.unix_ns()) == (50, 150)


def test_a_signal_does_not_shorten_a_sleep() -> None:
    clock = SystemClock()
    caught: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: caught.append(number))
    try:
        deadline_ns = clock.monotonic_ns() + 40_000_000
        signal.setitimer(signal.ITIMER_REAL, 0.005)
        clock.sleep_until(deadline_ns)
        assert clock.monotonic_ns() >= deadline_ns
        assert caught == [signal.SIGALRM]
    finally:
        signal.signal(signal.SIGALRM, before)


def test_windows_clocks_have_fine_resolution() -> None:
    """Python 3.12 reads GetTickCount64 for `monotonic` on Windows, which goes in steps of 16 ms."""
    fine = time.get_clock_info("perf_counter")
    coarse = time.get_clock_info("monotonic")
    assert SystemClock.monotonic_ns is time.perf_counter_ns
    if os.name == "posix":
        assert fine == coarse


def test_processes_of_one_machine_share_their_clock() -> None:
    program = "from trilat_net.net.clock import SystemClock; print(SystemClock().identity())"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == SystemClock().identity()


skews = st.tuples(st.integers(-(10**16), 10**16), st.integers(-200_000, 200_000))


@given(st.integers(0, 10**16), skews, st.integers(0, 10**13))
def test_a_skewed_clock_has_its_offset_and_drift(
    start_ns: int, skew: tuple[int, int], passed_ns: int
) -> None:
    true = ManualClock(start_ns)
    clock = SkewedClock(true, *skew)
    assert clock.monotonic_ns() == start_ns + skew[0]
    true.sleep_until(start_ns + passed_ns)
    ahead_ns = clock.monotonic_ns() - true.monotonic_ns()
    assert abs(ahead_ns - skew[0] - passed_ns * skew[1] / 1e9) <= 2


@given(skews, st.integers(1, 10**12))
def test_sleeping_on_skewed_clocks_ends_exactly(skew: tuple[int, int], ahead_ns: int) -> None:
    true = ManualClock(10**9)
    clock = SkewedClock(true, *skew)
    deadline_ns = clock.monotonic_ns() + ahead_ns
    clock.sleep_until(deadline_ns)
    assert 0 <= clock.monotonic_ns() - deadline_ns <= 1


def test_skewed_clocks_state_their_skew() -> None:
    true = ManualClock(40)
    clocks = [SkewedClock(true, 0, 0), SkewedClock(true, 1, 0), SkewedClock(true, 0, 1)]
    true.sleep_until(41)
    clocks.append(SkewedClock(true, 0, 0))
    assert len({true.identity(), *(clock.identity() for clock in clocks)}) == 5
    assert clocks[1].identity() == "manual, skewed by 1 ns and 0 ns/s since 40 ns"
    assert {clock.unix_ns() for clock in clocks} == {true.unix_ns()}


def test_machine_clocks_are_skewed_only_on_request() -> None:
    assert type(SystemClock.with_error(0.0, 0.0)) is SystemClock
    clock = SystemClock.with_error(1.5, -20.5)
    assert "skewed by 1500000000 ns and -20500 ns/s since" in clock.identity()

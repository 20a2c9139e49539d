"""One contract for the machine's clocks and for the one that a test moves."""

import signal
import subprocess
import sys

import pytest

from trilat_net.net.clock import Clock, ManualClock, SystemClock

CLOCKS = {"system": SystemClock, "manual": lambda: ManualClock(5, 1_700_000_000_000_000_000)}


@pytest.fixture(params=list(CLOCKS))
def clock(request: pytest.FixtureRequest) -> Clock:
    return CLOCKS[request.param]()


def test_it_never_goes_back(clock: Clock) -> None:
    readings = [clock.monotonic_ns() for _ in range(100)]
    assert readings == sorted(readings)


def test_readings_are_whole_nanoseconds(clock: Clock) -> None:
    assert type(clock.monotonic_ns()) is int
    assert type(clock.unix_ns()) is int


@pytest.mark.parametrize("ahead_ns", [1, 1_000, 1_000_000, 20_000_000])
def test_sleeping_never_ends_early(clock: Clock, ahead_ns: int) -> None:
    deadline_ns = clock.monotonic_ns() + ahead_ns
    clock.sleep_until(deadline_ns)
    assert clock.monotonic_ns() >= deadline_ns


def test_a_deadline_that_has_passed_is_no_sleep_and_no_step_back(clock: Clock) -> None:
    now_ns = clock.monotonic_ns()
    clock.sleep_until(now_ns - 10_000_000_000)
    assert clock.monotonic_ns() >= now_ns


def test_both_clocks_move_together(clock: Clock) -> None:
    mono_ns, unix_ns = clock.monotonic_ns(), clock.unix_ns()
    clock.sleep_until(mono_ns + 5_000_000)
    assert clock.unix_ns() > unix_ns


def test_the_wall_clock_shows_the_present(clock: Clock) -> None:
    assert clock.unix_ns() > 1_600_000_000_000_000_000  # after September 2020


def test_identity_is_the_same_every_time(clock: Clock) -> None:
    assert clock.identity()
    assert clock.identity() == type(clock)().identity()


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


def test_processes_of_one_machine_share_their_clock() -> None:
    program = "from trilat_net.net.clock import SystemClock; print(SystemClock().identity())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == SystemClock().identity()

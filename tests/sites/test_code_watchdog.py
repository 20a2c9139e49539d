"""Code counts as too slow by its own computing time, never by the machine's lateness; one
hiccup ends nothing.
"""

import signal
from collections.abc import Callable

import pytest

from sites.code_watchdog import (
    CHECKS,
    FIRST_CHECKS,
    HICCUP_NS,
    OVERTIME_LIMIT_NS,
    SHARE,
    CodeWatchdog,
    WatchedCode,
)
from tests.core.builders import make_site_setup
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.errors import LawFailed
from trilat_net.net.clock import SystemClock

PERIOD_NS = 1_000_000
TICKS = 3000


class Steps:
    """A site whose step takes a time chosen by the test, of which its thread computes a part."""

    name = "s"
    rate_hz = 1000

    def __init__(
        self, takes_ns: Callable[[int], int], computes: float = 1.0, evicts: int = 0
    ) -> None:
        self.clock = ManualClock()
        self.computed_ns = self.evicted = 0
        self._takes_ns = takes_ns
        self._computes = computes
        self._evicts = evicts

    def step(self, tick: TickInput) -> TickInput:
        took_ns = self._takes_ns(tick.k)
        sleep_for_ns(self.clock, took_ns)
        self.computed_ns += int(self._computes * took_ns)
        self.evicted += self._evicts
        return tick

    def overtime(self) -> WatchedCode:
        about = ("the law laws:Law", self.rate_hz, fail_of("s", "laws:Law"), self.clock)
        return WatchedCode(*about, lambda: (self.computed_ns, self.evicted))


def fail_of(site: str, law: str) -> Callable[[int, str], Exception]:
    return lambda k, problem: LawFailed(problem, site=site, code=law, tick=k)


def run_steps(steps: Steps, overtime: WatchedCode | None = None) -> int | None:
    overtime = overtime or steps.overtime()
    for k in range(TICKS):
        try:
            overtime.run(k, lambda k=k: steps.step(TickInput(k)))
        except LawFailed as failed:
            return failed.tick
    return None


@pytest.mark.parametrize("share", [0.5, 0.74, 0.8, 1.0, 2.0, 20.0, 100.0])
def test_a_laws_overtime_adds_up_to_500_ms(share: float) -> None:
    took_ns = int(share * PERIOD_NS)
    over_ns = min(took_ns, HICCUP_NS) - int(SHARE * PERIOD_NS)
    k = run_steps(Steps(lambda _: took_ns))
    if over_ns <= 0 or OVERTIME_LIMIT_NS / over_ns > TICKS:
        assert k is None
    else:
        assert k == OVERTIME_LIMIT_NS // over_ns


def test_alternately_slow_laws_are_found() -> None:
    """2.5 periods and nothing, by turns: 1.25 on average, and never twice in a row."""
    k = run_steps(Steps(lambda k: 2_500_000 * (k % 2)))
    assert k == pytest.approx(OVERTIME_LIMIT_NS / (0.5 * PERIOD_NS), abs=3)


@pytest.mark.parametrize("hiccup_ns", [5_000_000, 300_000_000, 3_000_000_000])
def test_single_hiccups_are_only_counted(hiccup_ns: int) -> None:
    steps = Steps(lambda k: hiccup_ns if k == 700 else 200_000)
    overtime = steps.overtime()
    assert run_steps(steps, overtime) is None
    assert (overtime.hiccups, overtime.longest_tick, overtime.longest_ns) == (1, 700, hiccup_ns)
    assert "in 1 call;" in overtime.describe_hiccups()


def test_a_busy_machine_is_no_laws_fault() -> None:
    assert run_steps(Steps(lambda _: 5_000_000, computes=0.05, evicts=1)) is None


def test_laws_that_wait_are_slow() -> None:
    assert run_steps(Steps(lambda _: 5_000_000, computes=0.0)) is not None


def test_punctual_laws_get_no_report() -> None:
    steps = Steps(lambda _: 700_000)
    overtime = steps.overtime()
    assert run_steps(steps, overtime) is None
    assert overtime.describe_hiccups() == ""


class Hanging:
    """A law that never returns, and keeps the interpreter."""

    def __init__(self, _facts: object) -> None:
        self.caught = 0

    def torque(self, _now: object) -> list[float]:
        while True:
            try:
                signal.raise_signal(signal.SIGALRM)  # as the timer does every second
            except ValueError:
                self.caught += 1


def test_a_hanging_law_is_stopped() -> None:
    site = Site(make_site_setup("s", "two_sites")._replace(law_factory=Hanging))
    before = signal.getsignal(signal.SIGALRM)
    watched = WatchedCode(
        "the law laws:Hanging", 1000, fail_of("s", "laws:Hanging"), SystemClock()
    )
    with CodeWatchdog(watched):
        with pytest.raises(
            LawFailed, match=r"laws:Hanging of s failed at tick 0: the code did not return"
        ):
            watched.run(0, lambda: site.step(TickInput(0)))
        signal.raise_signal(signal.SIGALRM)  # between two ticks: nobody hangs
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_every_call_of_a_first_tick_may_compile() -> None:
    """In its first tick a plant returns the places of its bodies, and then moves."""
    watched = WatchedCode(
        "the plant mine:Scene", 1000, fail_of("s", "mine:Scene"), SystemClock()
    )
    for _ in ("poses", "step"):
        watched.run(0, lambda: [watched.check() for _ in range(FIRST_CHECKS - 1)])
    with pytest.raises(LawFailed, match="failed at tick 1: the code did not return within 2 s"):
        watched.run(1, lambda: [watched.check() for _ in range(CHECKS)])

"""Deadlines follow the leader's grid by slewing; stamps give true delays and offsets within
their bounds.
"""

import heapq
import random
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.net.crossing import make_queueing_delay
from tests.net.manual_clock import ManualClock
from trilat_net.core.step.ticks import tick_ns
from trilat_net.net.clock import SkewedClock
from trilat_net.net.messages import VERSION, LinkStats, PeerSample
from trilat_net.net.offset import OffsetEstimate, OffsetEstimator
from trilat_net.net.timing import (
    FAULT_EVERY_NS,
    FIRST_WINDOW_NS,
    FIRST_WINDOWS,
    SLEW_LIMIT,
    ClockNotice,
    LinkTimingMonitor,
    PeerClock,
    SentStamps,
    SiteTiming,
    TickSchedule,
    find_turn_ns,
)

from .crossing import Delay, Other, S

RATE_HZ = 200
NAMES = ("a", "b")


def make_sample(tick: int, sent_ns: int, echo: list[list[int]] | None = None) -> PeerSample:
    rest = {"q": [0, 0], "qd": [0, 0], "tau_x": [0, 0]}
    return PeerSample(
        v=VERSION, site="x", boot=1, tick=tick, sent_ns=sent_ns, echo=echo or [], **rest
    )


@dataclass
class Site:
    clock: SkewedClock
    timing: SiteTiming
    errors_ns: list[tuple[int, int, int]] = field(default_factory=list)
    news: list[ClockNotice] = field(default_factory=list)
    stats: list[dict[str, object]] = field(default_factory=list)
    ticked_ns: list[int] = field(default_factory=list)


class Session:
    """Two sites, led by a; messages travel as the ways say, in true time."""

    def __init__(
        self, skews: tuple[tuple[int, int], tuple[int, int]], ways: tuple[Delay, Delay]
    ) -> None:
        self.true = ManualClock(10**12)
        self.ways = ways
        self.rnd = random.Random(5)
        clocks = [SkewedClock(self.true, *skew) for skew in skews]
        epochs = [clock.monotonic_ns() + S for clock in clocks]
        epochs[1] += 300_000  # b converted it wrong by so much
        self.step_at: dict[int, tuple[int, int]] = {}
        self.step = {0: 0, 1: 0}
        self.sites = []
        for side, other in ((0, 1), (1, 0)):
            ahead = clocks[other].monotonic_ns() - clocks[side].monotonic_ns()
            now_ns = clocks[side].monotonic_ns()
            first = OffsetEstimate(
                now_ns, ahead + 150_000, 0.0, ahead - 400_000, ahead + 400_000, -5e5, 5e5
            )
            peer = PeerClock(NAMES[other], epochs[other], 0, first, OffsetEstimator())
            self.sites.append(
                Site(clocks[side], SiteTiming(epochs[side], RATE_HZ, [peer], "a"))
            )
            self.sites[-1].news += self.sites[-1].timing.list_initial_notices()

    def run(self, seconds: float, cut: range = range(0)) -> None:
        queue: list[tuple[int, int, int, int, PeerSample | None]] = []
        order = iter(range(10**9))
        for n in (0, 1):
            heapq.heappush(queue, (self._due(n, 0), next(order), n, 0, None))
        while queue:
            true_ns, _, n, k, message = heapq.heappop(queue)
            self.true.sleep_until(true_ns)
            if message is not None:
                self._take(n, message, true_ns)
                continue
            sent = self._tick(n, k)
            if k not in cut:
                at_ns = true_ns + self.ways[n](self.rnd)
                heapq.heappush(queue, (at_ns, next(order), 1 - n, k, sent))
            if k + 1 < seconds * RATE_HZ:
                heapq.heappush(queue, (self._due(n, k + 1), next(order), n, k + 1, None))

    def _due(self, n: int, k: int) -> int:
        site = self.sites[n]
        ahead_ns = site.timing.schedule.due_ns(k) - site.clock.monotonic_ns()
        return self.true.monotonic_ns() + round(ahead_ns / (1 + site.clock._drift_ppb / S)) + 1

    def _tick(self, n: int, k: int) -> PeerSample:
        site = self.sites[n]
        site.ticked_ns.append(self.true.monotonic_ns())
        if n in self.step_at and k == self.step_at[n][0]:
            self.step[n] = self.step_at[n][1]
        now_ns = site.clock.monotonic_ns() + self.step[n]
        echo = [list(entry) for entry in site.timing.pop_echo()]
        sent = make_sample(k, site.timing.record_sent(k, now_ns), echo)
        if k % (RATE_HZ // 10) == 0:
            site.stats.append(site.timing.pop_measurements(now_ns))
            site.news += site.timing.update_clocks(k + 1, now_ns)
        return sent

    def _take(self, n: int, message: PeerSample, true_ns: int) -> None:
        site = self.sites[n]
        other = self.sites[1 - n]
        arrived_ns = site.clock.monotonic_ns() + self.step[n]
        (meter,) = site.timing.monitors
        bound_ns = meter.offset.error_bound_ns(arrived_ns)
        delay_ns = meter.receive(message, arrived_ns)
        true_delay_ns = true_ns - other.ticked_ns[message.tick]
        site.errors_ns.append((message.tick, delay_ns - true_delay_ns, bound_ns))


LAN = make_queueing_delay(80, 60)


@pytest.mark.parametrize("skew", [(-2 * S, -100_000), (86_400 * S, 30_000)])
def test_delays_stay_inside_bounds_and_grid_follows(skew: tuple[int, int]) -> None:
    session = Session(((0, 0), skew), (LAN, make_queueing_delay(140, 90)))
    session.run(20.0)
    for site in session.sites:
        assert len(site.errors_ns) == 20 * RATE_HZ
        assert all(abs(error_ns) <= bound_ns + 50 for _, error_ns, bound_ns in site.errors_ns)
        assert sorted(bound for _, _, bound in site.errors_ns)[2000] <= 200_000
        assert (
            max(abs(error) for tick, error, _ in site.errors_ns if tick > 10 * RATE_HZ)
            <= 100_000
        )
    leader, follower = session.sites
    late_ns = [b - a for a, b in zip(leader.ticked_ns, follower.ticked_ns, strict=True)]
    assert abs(late_ns[0] - 300_000) <= 101_000
    assert max(map(abs, late_ns[10 * RATE_HZ :])) <= 60_000  # the ways are unlike by 60 us
    assert leader.timing.schedule.slew == 0.0
    assert abs(follower.timing.schedule.slew - skew[1]) <= 10_000
    assert all(abs(stats["slew_ppb"]) <= SLEW_LIMIT for stats in follower.stats)


def test_logged_figures_are_true() -> None:
    session = Session(((0, 0), (3 * S, 100_000)), (LAN, LAN))
    session.run(12.0)
    site = session.sites[0]
    start_ns = 10**12
    clock_events = [news for news in site.news if news["kind"] == "clock"]
    assert len(clock_events) >= 12
    for news in clock_events:
        assert news["about"] == "b"
        at_ns = start_ns + S + news["ticks"] * S // RATE_HZ
        truth = 3 * S + (at_ns - start_ns) // 10_000
        assert abs(news["offset_ns"] - truth) <= news["bound_ns"] + 50
        assert abs(news["drift_ppb"] - 100_000) <= news["drift_bound_ppb"]
    last = clock_events[-1]
    assert abs(last["drift_ppb"] - 100_000) <= 5_000
    assert "offset 3.00" in last["text"]
    assert "ppm" in last["text"]
    (stats,) = site.stats[-1:]
    assert 80 <= stats["delay_us"]["b"] <= stats["delay_max_us"]["b"] <= 1000
    assert 160 <= stats["rtt_us"]["b"] <= 600
    assert stats["clock_faults"] == {"b": 0}
    assert set(stats) <= set(LinkStats.__struct_fields__)


Pair = tuple[float, float]
skews = st.tuples(st.integers(-10 * S, 10 * S), st.integers(-100_000, 100_000))
ways = st.tuples(st.floats(0, 5000), st.floats(1, 5000))


@given(skews, skews, ways, ways, st.integers(0, 600), st.integers(0, 600))
@settings(max_examples=8, deadline=None)
def test_bounds_hold_for_any_clocks_and_ways(
    first_clock: Pair, two: Pair, way: Pair, back: Pair, begin: int, ticks: int
) -> None:
    session = Session(
        (first_clock, two), (make_queueing_delay(*way), make_queueing_delay(*back))
    )
    session.run(4.0, range(begin, begin + ticks))
    for site in session.sites:
        for _, error_ns, bound_ns in site.errors_ns:
            assert abs(error_ns) <= bound_ns + 100


@pytest.mark.parametrize("step_ns", [S, -3_000_000])
def test_stepping_clocks_are_faults_and_found_again(step_ns: int) -> None:
    session = Session(((0, 0), (3 * S, 0)), (LAN, LAN))
    session.step_at = {1: (4 * RATE_HZ, step_ns)}
    session.run(10.0)
    for site, sign in zip(session.sites, (1, -1), strict=True):
        faults = [news for news in site.news if news["kind"] == "clock fault"]
        assert 1 <= len(faults) <= 4 * S // FAULT_EVERY_NS
        assert "one of the two clocks has stepped" in faults[0]["text"]
        assert max(site.stats[-1]["clock_faults"].values()) > 0
        last = [news for news in site.news if news["kind"] == "clock"][-1]
        assert abs(last["offset_ns"] - sign * (3 * S + step_ns)) <= last["bound_ns"]


def make_meter(
    estimator: OffsetEstimator | None = None,
) -> tuple[LinkTimingMonitor, SentStamps]:
    sent_stamps = SentStamps(8)
    return LinkTimingMonitor(
        PeerClock("b", 1000, 3, OffsetEstimate.exact(0), estimator), sent_stamps
    ), sent_stamps


def read_figures(link: LinkTimingMonitor) -> tuple[int, ...]:
    measured = link.pop_measurements(0)
    return tuple(
        measured[name] for name in ("delay_us", "delay_max_us", "rtt_us", "clock_faults")
    )


def test_on_one_clock_delays_are_exact() -> None:
    link, sent = make_meter()
    sent.record(7, 5_000)
    assert link.receive(make_sample(2, 9_000, [[0, 7, 1], [3, 7, 7_500]]), 12_000) == 2_000
    assert read_figures(link) == (2, 2, 5, 0)  # round trip (8 500 - 5 000) + 2 000 ns
    assert link.close_window(10**12, 10**12) is None
    assert link.offset.bound_ns == 0


def test_echoes_of_forgotten_stamps_are_ignored() -> None:
    link, sent = make_meter()
    for tick in range(20):
        sent.record(tick, tick)
    link.receive(make_sample(0, 0, [[3, 11, 5], [3, 99, 5], [3, -5, 5]]), 2_000)
    assert link.pop_measurements(0)["rtt_us"] == -1
    assert sent.find_ns(12) == 12
    assert sent.find_ns(11) is None


def test_figures_cover_windows_and_faults_cover_everything() -> None:
    link, _ = make_meter()
    for n, delay_ns in enumerate((3_000, 1_000, 900_000, -5_000)):
        link.receive(make_sample(n, 0), 1000 + delay_ns)
    assert read_figures(link) == (3, 900, -1, 1)
    assert read_figures(link) == (-1, -1, -1, 1)
    assert link.worst_ns == 5_000


def test_the_newest_sample_is_echoed_once() -> None:
    peers = [PeerClock(name, 0, 0, OffsetEstimate.exact(0), None) for name in ("b", "c")]
    timing = SiteTiming(0, 1000, peers, "a")
    first, two = timing.monitors
    for tick, at_ns in ((4, 50), (6, 60), (5, 70)):
        first.receive(make_sample(tick, 0), at_ns)
    two.receive(make_sample(9, 0), 80)
    assert timing.pop_echo() == [(0, 6, 60), (1, 9, 80)]
    assert timing.pop_echo() == []


def test_the_first_windows_are_short() -> None:
    estimator = OffsetEstimator()
    link, sent = make_meter(estimator)
    closed = []
    for n in range(400):
        now_ns = n * 10_000_000
        sent.record(n, now_ns)
        link.receive(make_sample(n, now_ns - 1000, [[3, n, now_ns - 1000 + 500]]), now_ns + 500)
        if link.close_window(now_ns + 600, now_ns + 600):
            closed.append(now_ns)
    assert closed[:FIRST_WINDOWS] == [FIRST_WINDOW_NS * (n + 1) for n in range(FIRST_WINDOWS)]
    assert closed[FIRST_WINDOWS] - closed[FIRST_WINDOWS - 1] == S


def test_members_on_the_leaders_clock_need_no_steering() -> None:
    timing = SiteTiming(5, 1000, [PeerClock("a", 5, 0, OffsetEstimate.exact(0), None)], "a")
    for k in range(0, 5000, 100):
        timing.monitors[0].receive(make_sample(k, k * 1_000_000), 5 + k * 1_000_000 + 300_000)
        assert timing.update_clocks(k + 1, 5 + k * 1_000_000 + 400_000) == []
    assert timing.schedule.due_ns(10_000) == 5 + 10 * S
    assert timing.schedule.slew == 0.0


@given(st.integers(1, 30), st.integers(1, 4000))
def test_turns_lie_within_half_a_period(sites: int, rate_hz: int) -> None:
    turns = [find_turn_ns(index, sites, rate_hz) for index in range(sites)]
    assert turns[0] == 0
    assert 2 * turns[-1] * rate_hz < S
    intervals = [later - turn for turn, later in pairwise(turns)]
    assert max(intervals, default=0) - min(intervals, default=0) <= 1


EPOCH_NS = 5_000_000_123


@given(st.integers(0, 10**9), st.integers(1, 4000))
def test_unsteered_grids_are_absolute_to_the_nanosecond(k: int, rate_hz: int) -> None:
    assert TickSchedule(EPOCH_NS, rate_hz).due_ns(k) == EPOCH_NS + k * S // rate_hz


@given(
    st.lists(
        st.tuples(st.integers(1, 2000), st.integers(-(10**10), 10**10), st.floats(-1e6, 1e6)),
        max_size=20,
    ),
    st.sampled_from([333, 1000, 4000]),
)
def test_steering_never_steps_or_exceeds_its_slew(
    steers: list[tuple[int, int, float]], rate_hz: int
) -> None:
    grid = TickSchedule(EPOCH_NS, rate_hz)
    k = 0
    for ticks, error_ns, drift in steers:
        k += ticks
        before = grid.due_ns(k)
        grid.adjust_rate(k, error_ns, drift)
        assert grid.due_ns(k) == before
        assert abs(grid.slew) <= SLEW_LIMIT == 200_000.0
        nominal_ns = tick_ns(k + rate_hz, rate_hz) - tick_ns(k, rate_hz)
        assert abs(grid.due_ns(k + rate_hz) - before - nominal_ns) <= nominal_ns * 200e-6 + 1
        for n in range(k, k + 5):
            assert grid.due_ns(n + 1) > grid.due_ns(n)


@pytest.mark.parametrize("drift_ppb", [-150_000, -100_000, 0, 37_000, 150_000])
@pytest.mark.parametrize("begin_ns", [-400_000, 0, 400_000])
def test_steered_grids_follow_the_leaders_drifting_clock(drift_ppb: int, begin_ns: int) -> None:
    """The epoch is wrong by begin_ns at first, and the true offset steers the grid ten times a second."""
    leader = Other(0, drift_ppb)
    grid = TickSchedule(begin_ns, 1000)
    errors = []
    for k in range(0, 60_000, 100):
        due_ns = grid.due_ns(k)
        error_ns = leader.reads(due_ns) - tick_ns(k, 1000)
        errors.append(error_ns)
        grid.adjust_rate(k, error_ns, drift_ppb)
        assert grid.error_ns == error_ns
    assert abs(errors[0] - begin_ns) <= 1000
    assert max(map(abs, errors)) <= abs(begin_ns) + 1000
    assert max(map(abs, errors[300:])) <= 200  # after 30 s it is there, to 0.2 us

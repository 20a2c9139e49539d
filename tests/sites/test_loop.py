"""The live loop: an absolute grid, lateness that enters no formula, and the numbers of virtual time."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import pytest

from sites.site_loop import PeerInbox, StateBlock, run_loop
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from tests.sites.sessions import execute_packed, pack_log
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, Mode, TickInput, TickRecord
from trilat_net.errors import RunFailed, SessionError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.messages import LinkStats, PeerSample, State
from trilat_net.net.timing import LoopStats, SiteTiming
from trilat_net.net.wire import decode
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

EPOCH_NS = 5_000_000_123


class LateClock(ManualClock):
    """A clock that wakes late at chosen times, and remembers the requested deadlines."""

    def __init__(self, oversleep: dict[int, int] | None = None) -> None:
        super().__init__()
        self.deadlines: list[int] = []
        self._oversleep = oversleep or {}

    def sleep_until(self, deadline_ns: int) -> None:
        late_ns = self._oversleep.get(len(self.deadlines), 0)
        self.deadlines.append(deadline_ns)
        super().sleep_until(deadline_ns + late_ns)


class Alone:
    """One site's loop with silent peers."""

    def __init__(self, clock: ManualClock, overrides: dict[str, object] | None = None) -> None:
        scenario = load_scenario("two_sites", {"duration_s": 2.0, **(overrides or {})})
        self.site = Site(scenario.setup("m"))
        self.stats = LoopStats(self.site, 1)
        self.states: list[State] = []
        self.samples: list[PeerSample] = []
        self.links: list[LinkStats] = []
        self.slack: list[tuple[int, int]] = []
        self.stopped: Callable[[], bool] = lambda: False
        self._clock = clock
        self._ticks = scenario.ticks("m")

    def run(self, turn_ns: int = 0, *, catches_up: bool = True) -> object:
        inbox = PeerInbox((), (), (), (), self.stats.dropped)
        timing = SiteTiming(EPOCH_NS, self.site.rate_hz, (), "s", turn_ns)
        states = StateBlock(self.site, 1, self.publish_states, 0, single=True)
        timed = (self._clock, inbox, timing, self.stats, states, self)
        return run_loop(self.site, 1, self._ticks, *timed, catches_up=catches_up)

    def should_stop(self) -> bool:
        return self.stopped()

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord:
        return self.site.step(TickInput(k, arrivals))

    def publish_sample(self, payload: bytes) -> None:
        self.samples.append(decode(payload, PeerSample))

    def publish_states(self, payloads: list[bytes]) -> None:
        self.states += [decode(payload, State) for payload in payloads]

    def publish_link(self, payload: bytes) -> None:
        self.links.append(decode(payload, LinkStats))

    def run_housekeeping(self, output: TickRecord) -> None:
        self.slack.append((output.tick, output.t_ns))

    def report_tick(self, output: TickRecord) -> None: ...

    def use_slack(self) -> None: ...


@pytest.mark.parametrize("rate_hz", [100, 333, 1000, 1024, 3000])
def test_ticks_lie_on_an_absolute_grid(rate_hz: int) -> None:
    clock = LateClock()
    Alone(clock, {"rate_hz": rate_hz}).run()
    assert clock.deadlines == [
        EPOCH_NS + k * 1_000_000_000 // rate_hz for k in range(2 * rate_hz)
    ]


def test_missed_ticks_run_back_to_back() -> None:
    alone = Alone(LateClock({5: 7_300_000}))
    alone.run()
    late = [state.late_us for state in alone.states]
    assert late[:14] == [0] * 5 + [7300, 6300, 5300, 4300, 3300, 2300, 1300, 300, 0]
    assert not any(late[14:])
    assert [state.tick for state in alone.states] == list(range(2000))
    assert alone.stats.overruns == 7
    assert [link.late_max_us for link in alone.links[:3]] == [0, 7300, 0]


def test_lateness_enters_no_formula() -> None:
    prompt = Alone(LateClock())
    late = Alone(LateClock({5: 7_300_000, 900: 400_000_000}))
    prompt.run()
    late.run()
    on_time = [
        msgspec.structs.replace(state, late_us=0, sent_ns=state.t_ns) for state in late.states
    ]
    assert on_time == prompt.states
    assert max(state.late_us for state in late.states) == 400_000


def test_turns_shift_only_wake_ups() -> None:
    clock = LateClock()
    prompt = Alone(LateClock())
    in_turn = Alone(clock)
    prompt.run()
    in_turn.run(turn_ns=333_000)
    assert clock.deadlines == [EPOCH_NS + k * 1_000_000 + 333_000 for k in range(2000)]
    assert [
        msgspec.structs.replace(state, sent_ns=state.t_ns) for state in in_turn.states
    ] == prompt.states


def test_statistics_and_slack_come_at_10_hz() -> None:
    alone = Alone(LateClock())
    alone.run()
    assert [link.tick for link in alone.links] == list(range(0, 2000, 100))
    assert alone.slack == [(link.tick, link.t_ns) for link in alone.links]


def test_stopped_loops_make_no_further_tick() -> None:
    alone = Alone(LateClock())
    alone.stopped = lambda: len(alone.states) >= 30
    output = alone.run()
    assert [state.tick for state in alone.states] == list(range(30))
    assert output.tick == 29
    none = Alone(LateClock())
    none.stopped = lambda: True
    assert none.run() is None
    assert none.states == []


def test_diverged_records_end_runs_beyond_limits() -> None:
    alone = Alone(LateClock(), {"limits.qd_limit_rad_s": 0.05, "sites.m.q0_rad": [0.4, -0.2]})
    output = alone.run()
    assert output.mode is Mode.DIVERGED
    assert [state.mode for state in alone.states] == ["run"] * (len(alone.states) - 1) + [
        "diverged"
    ]
    assert 0 < len(alone.states) < 2000


TIMELINE = [
    {"at_s": 0.1, "link": "m1->s", "to": {"delay_ms": 50.0, "loss": 0.1}},
    {"at_s": 0.2, "dominance": "s", "to": {"m1": 0.9, "m2": 0.1}, "ramp_s": 0.2},
    {
        "at_s": 0.3,
        "link": "s->m1",
        "to": {"model": "gamma", "delay_ms": 40.0, "deviation_ms": 4.0, "playout_ms": 30.0},
    },
    {
        "at_s": 0.4,
        "link": "m2->m1",
        "to": {"model": "ar1", "delay_ms": 40.0, "deviation_ms": 2.0, "correlation": 0.99},
    },
    {"at_s": 0.5, "dominance": "m1", "to": {"m2": 0.2, "s": 0.8}, "ramp_s": 0.1},
    {"at_s": 0.54, "dominance": "m1", "to": {"m2": 1.0}},
    {
        "at_s": 0.6,
        "link": "m1->s",
        "to": {"loss": 0.2, "loss_burst": 50.0, "loss_bad": 0.99},
    },
    {
        "at_s": 0.7,
        "link": "s->m2",
        "to": {"model": "sine", "delay_ms": 60.0, "amplitude_ms": 20.0, "period_s": 0.1},
    },
    {"at_s": 0.8, "link": "m1->m2", "to": {"duplicate": 0.5, "order": "in_order"}},
    {
        "at_s": 0.9,
        "link": "m1->s",
        "to": {"model": "constant", "delay_ms": 40.0, "loss": 1.0},
    },
]
"""At the end the slave hears no more of m1, and holds."""


def test_ten_timed_changes_have_live_bits(tmp_path: Path) -> None:
    rule = {"on_stale.action": "hold", "on_stale.age_ms": 100.0}
    changes = {"link.delay_ms": 40.0, "timeline": TIMELINE, **rule}
    scenario = load_scenario("paper", {"duration_s": 1.2, **changes})
    log = Session.whole(scenario, tmp_path).run()
    assert len(log.scenario.timeline) == 10
    assert pack_log(log) == execute_packed(scenario)
    assert verify_log(log).passed
    assert set(log["s"].mode) == {"run", "hold"}


SCENARIOS = {
    "paper": {"duration_s": 1.2},
    "asymmetric": {"duration_s": 1.2},
    "two_sites": {"duration_s": 1.0, "sites.m.rate_hz": 333, "sites.s.rate_hz": 500},
    "paper_rods": {"duration_s": 1.0, "scheme": "digital", "link.delay_ms": 0},
    "six_joints": {"duration_s": 0.3},
    "unlike_arms": {"duration_s": 0.3},
}


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.push
def test_live_loops_equal_virtual_time_bitwise(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name, SCENARIOS[name])
    log = Session.whole(scenario, tmp_path).run()
    assert log.complete
    assert [len(log[site]) for site in log.sites] == [
        scenario.ticks(site) for site in scenario.names
    ]
    assert pack_log(log) == execute_packed(scenario)
    assert verify_log(log).passed


def test_a_site_beyond_limits_ends_its_session(tmp_path: Path) -> None:
    limit = {"sites.m2.limits.qd_limit_rad_s": 0.3, "duration_s": 10.0}
    session = Session.whole(load_scenario("paper", limit), tmp_path, ends={})
    log = session.run()
    assert session.ends is not None
    for name in log.sites:
        failed = session.ends[name]
        assert isinstance(failed, RunFailed)
        assert failed.exit_code == 1
        assert "m2 diverged at t = " in str(failed)
    assert log.complete
    assert verify_log(log).passed
    assert {event.member for event in log.events if event.kind == "diverged"} == {"m2"}
    assert {name: log[name].mode[-1] for name in log.sites} == {
        "m1": "run",
        "m2": "diverged",
        "s": "run",
    }


def test_a_stall_within_the_delay_changes_no_bit(tmp_path: Path) -> None:
    scenario = load_scenario("paper", {"duration_s": 1.0})
    session = Session.whole(scenario, tmp_path)
    session.clocks["m2"].stall(2_000_000_000, 190_000_000)
    log = session.run()
    assert max(log["m2"].late_us) > 150_000
    assert pack_log(log) == execute_packed(scenario)


def test_stalls_matter_only_from_late_samples(tmp_path: Path) -> None:
    scenario = load_scenario("paper", {"duration_s": 1.0})
    session = Session.whole(scenario, tmp_path)
    session.clocks["m2"].stall(2_000_000_000, 300_000_000)
    log = session.run()
    twins = compare_with_virtual(log)
    assert twins.fed.first is None
    assert twins.fed.identical == twins.fed.records == 3000
    assert twins.late
    first = twins.late[0]
    assert first.peer == "m2"
    live = pack_log(log)
    plain = execute_packed(scenario)
    for site in log.sites:
        assert live[site][: first.due_tick] == plain[site][: first.due_tick]
    assert live != plain
    assert verify_log(log).passed


def publish_garbage(bus: Bus, clock: RelayClock) -> None:
    """Publishes invalid messages on every key of a session, while the session runs."""
    targets = [
        bus.publisher(topics.key(SESSION, member, channel))
        for member in ("m1", "m2", "s", "recorder", "nobody")
        for channel in (topics.SAMPLE, topics.STATE, topics.EVENT, topics.LINK, "more")
    ]
    for n in range(100):
        for publish in targets:
            publish((b"", b"\xc1", b"garbage", bytes(70_000), b"\x91" * 9000)[n % 5])
        sleep_for_ns(clock, 17_000_000)


def come_and_go(bus: Bus, clock: RelayClock) -> None:
    """Publishes a token that is no number of a start."""
    bus.announce(f"trilat/{SESSION}/m1/alive/no-number")
    sleep_for_ns(clock, 300_000_000)
    bus.close()


def test_strangers_and_their_garbage_change_no_bit(tmp_path: Path) -> None:
    scenario = load_scenario("paper", {"duration_s": 1.0})
    session = Session.whole(scenario, tmp_path)
    session.stranger(publish_garbage)
    session.stranger(come_and_go, at_ns=2_000_000_000)
    log = session.run()
    assert pack_log(log) == execute_packed(scenario)
    dropped = log.link_stats("m1")[-1].dropped
    assert dropped["malformed"] > 0
    assert dropped["oversized"] > 0
    assert int(log.accounts["dropped: malformed"]) > 0
    assert int(log.accounts["dropped: oversized"]) > 0


def test_a_site_ends_in_order_on_request(tmp_path: Path) -> None:
    scenario = load_scenario("two_sites", {"duration_s": 1.0})
    session = Session.whole(scenario, tmp_path)

    def interrupt(_bus: Bus, _clock: RelayClock) -> None:
        session.interrupts["s"].number = 2

    session.stranger(interrupt, at_ns=2_100_000_000)
    log = session.run()
    assert (session.relay.results["m"], session.relay.results["s"]) == (0, 130)
    assert len(log["m"]) == 1000
    ticks = len(log["s"])
    assert 0 < ticks < 1000
    assert [e.ticks for e in log.events if e.kind == "end" and e.member == "s"] == [ticks]
    assert log.complete
    assert verify_log(log).passed


def test_latecomers_learn_the_sessions_progress(tmp_path: Path) -> None:
    session = Session.whole(load_scenario("two_sites", {"duration_s": 1.0}), tmp_path)
    refused: list[str] = []

    def come_late(_bus: Bus, clock: RelayClock) -> None:
        member = Session(
            session.scenario, tmp_path / "other.mcap", session.relay, session.network
        )
        with pytest.raises(SessionError) as caught:
            member.live("m", clock)
        refused.append(str(caught.value))

    session.stranger(come_late, at_ns=2_000_000_000)
    assert session.run().complete
    assert len(refused) == 1
    match = re.search(r"session 't' is running; (m|s) is at tick (\d+)", refused[0])
    assert match, refused
    assert 200 < int(match[2]) < 1000


@pytest.mark.parametrize("late_ms", [0.9, 1.0, 7.5, 300.0, 1000.0, 3000.0])
def test_slow_loops_skip_missed_ticks(late_ms: float) -> None:
    """Late by n periods at tick 500, the next tick is 500 + n, or the last one of the run."""
    clock = LateClock({500: int(late_ms * 1e6)})
    alone = Alone(clock)
    alone.run(catches_up=False)
    missed = min(int(late_ms), 2000 - 1 - 500)
    ticks = [state.tick for state in alone.states]
    assert ticks == [*range(500), *range(500 + missed, 2000)]
    assert [state.t_ns for state in alone.states] == [tick * 1_000_000 for tick in ticks]
    assert alone.stats.overruns == missed + (late_ms == 3000.0)  # it woke when the run was over
    numbers = [stats.tick // 100 for stats in alone.links]
    assert numbers == [n for n in range(20) if n < 5 or n >= (500 + missed) // 100]

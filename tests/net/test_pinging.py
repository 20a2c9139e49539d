"""Pinged members answer at once; the asker learns the offset of the other clock, to half a round trip."""

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import SkewedClock
from trilat_net.net.messages import VERSION
from trilat_net.net.offset import OffsetEstimate
from trilat_net.net.pinging import (
    GLANCE_NS,
    PING_PACE_NS,
    PING_REST_NS,
    PINGS,
    PINGS_PER_WINDOW,
    QUERIES_KEPT,
    Pinger,
    RepeatedQuery,
    RoundTrips,
    answer_pings,
)
from trilat_net.net.requests import Pong
from trilat_net.net.wire import encode

from .local_bus import LocalNetwork
from .parties import SESSION, answer_info

S = 1_000_000_000
STEP_NS = 1_000_000


class Slow:
    """A bus whose questions reach the responders later, and whose answers return later still."""

    def __init__(self, bus: Bus, clock: ManualClock, there_ns: int, back_ns: int) -> None:
        self._bus = bus
        self._clock = clock
        self._there_ns = there_ns
        self._back_ns = back_ns
        self.asked = 0

    def query(self, key: str, payload: bytes = b"") -> "Slow.Late":
        self.asked += 1
        return Slow.Late(self, key, payload, self._clock.monotonic_ns())

    class Late:
        """Answers on their way."""

        def __init__(self, slow: "Slow", key: str, payload: bytes, asked_ns: int) -> None:
            self._slow = slow
            self._key = key
            self._payload = payload
            self._asked_ns = asked_ns
            self._replies = None
            self._answered_ns = 0

        def poll(self) -> tuple[str, bytes] | None:
            now_ns = self._slow._clock.monotonic_ns()
            if self._replies is None and now_ns >= self._asked_ns + self._slow._there_ns:
                self._replies = self._slow._bus.query(self._key, self._payload)
                self._answered_ns = now_ns
            if self._replies is None or now_ns < self._answered_ns + self._slow._back_ns:
                return None
            return self._replies.poll()


class World:
    """An asker, and members on clocks of their own."""

    def __init__(self, there_ns: int = 0, back_ns: int = 0) -> None:
        self.clock = ManualClock(10 * S)
        self.network = LocalNetwork()
        self.bus = Slow(self.network.join(), self.clock, there_ns, back_ns)
        self.pinger = Pinger(self.bus, self.clock, SESSION)

    def member(
        self, name: str, boot: int, offset_ns: int = 0, drift_ppb: int = 0
    ) -> SkewedClock:
        clock = SkewedClock(self.clock, offset_ns, drift_ppb)
        answer_pings(
            self.network.join(), clock, SESSION, answer_info(name, boot, clock=clock.identity())
        )
        return clock

    def wait(self, passed_ns: int, *wanted: int) -> None:
        for _ in range(passed_ns // STEP_NS):
            self.pinger.poll(wanted)
            sleep_for_ns(self.clock, STEP_NS)


@given(
    st.integers(-(10**15), 10**15),
    st.integers(-200_000, 200_000),
    st.integers(0, 40),
    st.integers(0, 40),
    st.integers(0, 5 * S),
)
@settings(max_examples=25, deadline=None)
def test_clocks_are_known_to_half_round_trips(
    offset_ns: int, drift_ppb: int, there_ms: int, back_ms: int, later_ns: int
) -> None:
    world = World(there_ms * STEP_NS, back_ms * STEP_NS)
    clock = world.member("s", 7, offset_ns, drift_ppb)
    world.wait(400_000_000, 7)
    assert world.pinger.knows_clocks([7])
    estimate = world.pinger.estimate(7)
    sleep_for_ns(world.clock, later_ns)
    now_ns = world.clock.monotonic_ns()
    truth = clock.monotonic_ns() - now_ns
    value = estimate.extrapolate_ns(now_ns)
    assert abs(truth - value) <= estimate.error_bound_ns(now_ns, value) + 2
    trip_ns = world.pinger.trips[7].shortest_ns
    assert trip_ns // STEP_NS in (
        there_ms + back_ms,
        there_ms + back_ms + 1,
        there_ms + back_ms + 2,
    )
    assert (
        estimate.error_bound_ns(estimate.local_ns, estimate.offset_ns)
        <= trip_ns / 2 + 0.4 * S * 600e-6
    )


def test_pings_slow_down_once_all_are_known() -> None:
    world = World()
    world.member("m2", 5, S)
    world.member("s", 7, 2 * S)
    world.wait(100_000_000, 5)
    assert world.bus.asked == 100_000_000 // PING_PACE_NS
    assert not world.pinger.knows_clocks([5])
    world.wait(200_000_000, 5, 7)
    assert world.pinger.knows_clocks([5, 7])
    requests = world.bus.asked
    world.wait(5 * S, 5, 7)
    assert world.bus.asked - requests == pytest.approx(5 * S / PING_REST_NS, abs=1)


def test_without_other_clocks_nobody_is_asked() -> None:
    world = World()
    world.wait(S)
    assert world.bus.asked == 0
    assert world.pinger.knows_clocks([])
    assert world.pinger.estimate(99) == OffsetEstimate.exact(0)
    assert world.pinger.estimator(99) is None


def test_polls_hurry_only_while_answers_travel() -> None:
    world = World()
    world.member("s", 7)
    assert world.pinger.pause_ns(5_000_000) == 5_000_000
    world.pinger.poll([7])
    assert world.pinger.pause_ns(5_000_000) == GLANCE_NS
    assert world.pinger.pause_ns(10) == 10
    sleep_for_ns(world.clock, S)
    assert world.pinger.pause_ns(5_000_000) == 5_000_000


def make_pong(**facts: object) -> Pong:
    return Pong(**{"member": "s", "boot": 7, "clock": "c", "came_ns": 0, "left_ns": 0, **facts})


STRANGERS = {
    "garbage": b"\xc1",
    "of another boot": encode(make_pong(boot=8)),
    "of another member": encode(make_pong(member="m2")),
    "of another version": encode(make_pong(v=VERSION + 1)),
    "left before it came": encode(make_pong(came_ns=5, left_ns=4)),
    "held longer than it was away": encode(make_pong(came_ns=0, left_ns=10**15)),
    "beyond any clock": msgspec.msgpack.encode(
        {**msgspec.structs.asdict(make_pong()), "came_ns": 2**62}
    ),
}


@pytest.mark.parametrize("payload", STRANGERS.values(), ids=STRANGERS.keys())
def test_impossible_answers_are_ignored(payload: bytes) -> None:
    world = World()
    world.network.join().respond(topics.key(SESSION, "s", topics.PING), lambda _: payload)
    world.wait(S, 7)
    assert not world.pinger.knows_clocks([7])
    assert all(not trips.rtts_ns for trips in world.pinger.trips.values())


def test_stepping_clocks_are_unknown_until_messages_agree() -> None:
    trips = RoundTrips(PINGS)
    for n in range(PINGS):
        trips.receive(
            n * STEP_NS,
            make_pong(came_ns=n * STEP_NS + 50, left_ns=n * STEP_NS + 50),
            n * STEP_NS + 100,
        )
    assert trips.is_known
    before = trips.latest
    far_ns = 10 * S
    for n in range(PINGS, PINGS + PINGS_PER_WINDOW):
        at_ns = n * STEP_NS
        came_ns = at_ns + 50 + far_ns * (n % 2)
        trips.receive(at_ns, make_pong(came_ns=came_ns, left_ns=came_ns), at_ns + 100)
    assert not trips.is_known
    assert trips.latest == before


def test_answers_count_for_their_own_question() -> None:
    clock = ManualClock(S)
    network = LocalNetwork()
    questions = network.join().query_inbox("t/a")
    asking = RepeatedQuery(network.join(), clock, "t/*")
    asked_ticks = []
    for _ in range(3):
        asking.repeat(0)
        asked_ticks.append(clock.monotonic_ns())
        sleep_for_ns(clock, S)
    waiting = [questions.poll() for _ in asked_ticks]
    for n in (2, 0, 1):
        waiting[n].reply(bytes([n]))
    answers = [asking.poll() for _ in asked_ticks]
    assert sorted(answers) == [(asked_ticks[n], "t/a", bytes([n])) for n in range(3)]
    assert asking.poll() is None


def test_old_questions_are_forgotten() -> None:
    network = LocalNetwork()
    questions = network.join().query_inbox("t/a")
    asking = RepeatedQuery(network.join(), ManualClock(), "t/a")
    for _ in range(QUERIES_KEPT + 1):
        asking.repeat(0)
    questions.poll().reply(b"late")
    assert asking.poll() is None

"""Under any loss, duplication and delay, the log has every message that arrived or was available, once."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recorder.backfill import ANSWER_NS, GIVE_UP_NS, MAX_VAIN_REQUESTS, SILENT_NS
from tests.net.manual_clock import ManualClock
from tests.recorder.desk import encode_event, encode_states, encode_statistics
from trilat_net.net import topics
from trilat_net.net.messages import Event, RecorderStats, State
from trilat_net.net.requests import BACKFILL_MESSAGES, Backfill
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import load_scenario

from .desk import BOOTS, MONO_NS, MS, SESSION, UNIX_NS, Desk, Memory, S

SLOW = load_scenario("two_sites", {"duration_s": 2.0, "rate_hz": 100})
TICKS = SLOW.ticks("m")
EVERY = 10
MADE = {
    "state": encode_states("m", scenario=SLOW),
    "link": [encode_statistics("m", k, SLOW) for k in range(0, TICKS, EVERY)],
    "event": [
        *(encode_event("m", n, "mode") for n in range(8)),
        encode_event("m", 8, "end", ticks=TICKS, t_ns=2 * S),
    ],
}
SENT = sorted(
    [(k * 10 * MS, "state", k) for k in range(TICKS)]
    + [(k * EVERY * 10 * MS + 1, "link", k) for k in range(TICKS // EVERY)]
    + [(n * 240 * MS + 2, "event", n) for n in range(8)]
    + [(2 * S, "event", 8)]
)
"""When a site sends which message of which channel, ns since the epoch."""


@dataclass
class Way:
    """The fate of the messages on their way, by their place in SENT; and of the answers, in turn."""

    lost: set[int] = field(default_factory=set)
    twice: set[int] = field(default_factory=set)
    late_ms: dict[int, int] = field(default_factory=dict)
    oldest: dict[str, int] = field(default_factory=dict)
    answers: list[str] = field(default_factory=list)
    chunk: int = 64

    def deliveries(self) -> list[tuple[int, str, int]]:
        """Yields arrivals: (when since the epoch, channel, number)."""
        arrivals = []
        for index, (sent_ns, channel, number) in enumerate(SENT):
            if index not in self.lost:
                at_ns = sent_ns + 137_000 + self.late_ms.get(index, 0) * MS
                arrivals += [(at_ns, channel, number)] * (2 if index in self.twice else 1)
        return sorted(arrivals)


ARRIVES: dict[str, Callable[[bytes], Sequence[bytes]]] = {
    "lost": lambda _: [],
    "twice": lambda payload: [payload, payload],
    "garbage": lambda _: [b"", b"\xc1", bytes(70_000)],
    "garbage first": lambda payload: [b"junk", payload],
}
WRONG: dict[str, Callable[[Backfill], dict[str, Any]]] = {
    "wrong boot": lambda _: {"boot": 99},
    "wrong member": lambda _: {"member": "s"},
    "wrong channel": lambda past: {"channel": "link" if past.channel != "link" else "event"},
    "wrong numbers": lambda past: {"payloads": past.payloads[::-1]},
    "too many": lambda past: {"payloads": past.payloads * 2},
    "undecodable": lambda past: {"payloads": [b"\xc1" for _ in past.payloads]},
    "another's": lambda past: {
        "payloads": [p.replace(b"\xa1m", b"\xa1s") for p in past.payloads]
    },
    "a hole": lambda past: {
        "payloads": [b"" if n == 1 else p for n, p in enumerate(past.payloads)]
    },
    "more gone than made": lambda past: {"first": past.made + 70, "payloads": []},
    "far too many made": lambda past: (
        {"made": 2**39} if past.channel != "event" else {"boot": 0}
    ),
}


def make_false_answer(how: str, payload: bytes) -> Sequence[bytes]:
    """Returns the arriving part of an answer."""
    if how in ARRIVES:
        return ARRIVES[how](payload)
    past = decode(payload, Backfill)
    return [encode(msgspec.structs.replace(past, **WRONG[how](past)))]


@st.composite
def draw_ways(draw: st.DrawFn) -> Way:
    places = st.integers(0, len(SENT) - 1)
    runs = draw(st.lists(st.tuples(places, st.integers(1, len(SENT))), max_size=4))
    lost = draw(st.sets(places, max_size=30)) | {
        index for first, count in runs for index in range(first, min(first + count, len(SENT)))
    }
    return Way(
        lost,
        draw(st.sets(places, max_size=10)),
        draw(st.dictionaries(places, st.integers(1, 400), max_size=10)),
        draw(st.fixed_dictionaries({c: st.integers(0, len(MADE[c]) - 1) for c in MADE})),
        draw(st.lists(st.sampled_from([*ARRIVES, *WRONG]), max_size=12)),
        draw(st.sampled_from([1, 3, 64])),
    )


class Run:
    """A session in which one site sends all its messages, and the other is gone."""

    def __init__(self, way: Way, clock: ManualClock | None = None) -> None:
        self.way = way
        self.desk = Desk(SLOW, clock)
        self.site = Memory(self.desk.network, "m", way.chunk)
        self.site.oldest |= way.oldest
        self.site.replies = self._reply
        self._asked = 0

    def _reply(self, payload: bytes) -> Sequence[bytes]:
        """Delivers at least every fourth answer unchanged, because requests end after some attempts."""
        self._asked += 1
        turn = self._asked - self._asked // 4 - 1
        if self._asked % 4 == 0 or turn >= len(self.way.answers):
            return [payload]
        return make_false_answer(self.way.answers[turn], payload)

    def live(self, until_ns: int) -> None:
        """Lets the site make and send until an instant; the recorder works every 10 ms."""
        desk = self.desk
        deliveries = self.way.deliveries()
        now_ns = desk.clock.monotonic_ns()
        while now_ns < until_ns + MONO_NS:
            begun_ns = now_ns
            now_ns = now_ns + 10 * MS
            for at_ns, channel, number in SENT:
                if begun_ns <= at_ns + MONO_NS < now_ns:
                    self.site.made[channel] = MADE[channel][: number + 1]
            for at_ns, channel, number in deliveries:
                if begun_ns <= at_ns + MONO_NS < now_ns:
                    desk.clock.sleep_until(at_ns + MONO_NS)
                    desk.tap.receive(topics.key(SESSION, "m", channel), MADE[channel][number])
            desk.clock.sleep_until(now_ns)
            desk.write()
            self.site.answer()

    def until_stored(self) -> Event:
        """Continues until the recorder has every message."""
        for _ in range(400):
            stored = [event for event in self.desk.said() if event.kind == "stored"]
            if stored:
                return stored[0]
            self.desk.rounds(10, self.site)
        raise AssertionError("never stored")


@given(draw_ways())
@settings(max_examples=40, deadline=None)
def test_logs_have_all_obtainable_messages(way: Way) -> None:
    run = Run(way)
    run.live(2600 * MS)
    stored = run.until_stored()
    file: dict[str, list[tuple[int, int]]] = {}
    for topic, message in run.desk.messages():
        site, channel = topic.split("/")
        if site == "m":
            number = MADE[channel].index(message.data)
            file.setdefault(channel, []).append((number, message.log_time - UNIX_NS))
    for channel, payloads in MADE.items():
        account = run.desk.recording.accounts[topics.key(SESSION, "m", channel)]
        arrivals = [(at_ns, number) for at_ns, c, number in way.deliveries() if c == channel]
        numbers = [number for number, _ in file.get(channel, [])]
        truth = {number for _, number in arrivals} | set(
            range(way.oldest[channel], len(payloads))
        )
        assert sorted(numbers) == sorted(truth)
        live = [(at_ns, number) for number, at_ns in file.get(channel, []) if at_ns % MS]
        assert set(live) <= set(arrivals)
        assert (account.expected, account.received) == (len(payloads), len(truth))
        assert account.missing == len(payloads) - len(truth)
        assert account.refilled == len(truth) - len(live)
        assert account.duplicate == len(arrivals) - len(live)
        passed = [
            number < max(n for _, n in arrivals[: arrivals.index((at_ns, number)) + 1])
            for at_ns, number in live
        ]
        assert account.reordered == sum(passed)
        assert {n for first, last in account.gaps for n in range(first, last + 1)} == (
            set(range(len(payloads))) - truth
        )
        stamps = sorted(at_ns for at_ns, _ in arrivals)
        silence = max((b - a for a, b in pairwise(stamps)), default=0)
        assert account.silence_ns == silence
    missing = sum(account.missing for account in run.desk.recording.accounts.values())
    assert ("missing for good" in stored.text) == (missing > 0)
    assert stored.ticks == TICKS


@pytest.mark.parametrize("late_ms", [{}, dict.fromkeys(range(0, len(SENT), 3), 25)])
def test_complete_recorders_ask_for_nothing(late_ms: dict[int, int]) -> None:
    run = Run(Way(late_ms=late_ms))
    run.live(2100 * MS)
    run.until_stored()
    assert run.site.asked == []
    assert run.desk.recording.dropped == Counter()


def test_requests_cover_one_chunk_at_a_time() -> None:
    run = Run(Way(lost=set(range(20, 180))))
    most = 0
    answer = run.site.answer

    def counted() -> None:
        nonlocal most
        before = len(run.site.asked)
        answer()
        most = max(most, len(run.site.asked) - before)

    run.site.answer = counted  # type: ignore[method-assign]
    run.live(2600 * MS)
    run.until_stored()
    assert most == 1
    assert all(wanted.last - wanted.first < BACKFILL_MESSAGES for wanted in run.site.asked)


def test_many_small_gaps_share_a_request() -> None:
    """Every second record is lost: one request for each would not catch up on a busy machine."""
    lost = {index for index, (_, channel, n) in enumerate(SENT) if channel == "state" and n % 2}
    run = Run(Way(lost=lost))
    answer = run.site.answer
    run.site.answer = lambda: None  # type: ignore[method-assign]
    run.live(2100 * MS)
    run.site.answer = answer  # type: ignore[method-assign]
    run.until_stored()
    assert len(run.site.asked) <= len(lost) // 4
    assert "missing 0" in run.desk.log().account("m")


def test_single_gaps_are_requested_alone() -> None:
    """At low loss no message arrives twice."""
    lost = {
        index for index, (_, channel, n) in enumerate(SENT) if channel == "state" and n == 50
    }
    run = Run(Way(lost=lost))
    run.live(2600 * MS)
    run.until_stored()
    assert [(wanted.first, wanted.last) for wanted in run.site.asked] == [(50, 50)]


def test_silent_sites_are_asked_for_lost_ends() -> None:
    run = Run(Way(lost={n for n, (at_ns, _, _) in enumerate(SENT) if at_ns >= S}))
    run.live(3100 * MS)
    assert run.until_stored().text == "every record of m is stored"
    assert run.desk.recording.describe_problem() == "s disappeared after 0 records"


def test_hushed_sites_are_asked_thrice_a_second() -> None:
    """A site that hangs: it has sent nothing since its start, and has nothing to give."""
    run = Run(Way(lost=set(range(len(SENT)))))
    run.site.answer()
    for _ in range(500):
        run.desk.wait(10 * MS)
        run.desk.write()
        run.site.answer()
    assert 0 < len(run.site.asked) <= 3 * 5 * S // SILENT_NS


@pytest.mark.parametrize("how", ["lost", "garbage", "wrong boot"])
def test_unanswering_sites_are_asked_ever_less(how: str) -> None:
    run = Run(Way(lost=set(range(30, 60))))
    run.site.replies = lambda payload: make_false_answer(how, payload)
    run.live(2100 * MS)
    run.desk.rounds(150, run.site, step_ns=100 * MS)
    assert len(run.site.asked) <= 5 + 15 * S // ANSWER_NS[1]
    (stored,) = [event for event in run.desk.said() if event.kind == "stored"]
    assert "missing for good" in stored.text
    assert stored.t_ns - 2 * S > GIVE_UP_NS
    log = run.desk.log()
    assert f"missing {TICKS - len(log['m'])}" in log.account("m")


def test_sites_answering_in_vain_are_left_alone() -> None:
    run = Run(Way(lost=set(range(30, 60))))
    run.site.replies = lambda payload: make_false_answer("undecodable", payload)
    run.live(20 * S)
    assert len(run.site.asked) <= 3 * MAX_VAIN_REQUESTS + 3
    assert "missing for good" in run.until_stored().text


def test_forgotten_messages_are_asked_for_once() -> None:
    run = Run(Way(lost=set(range(200)), oldest={"state": TICKS, "link": 20, "event": 9}))
    run.live(2600 * MS)
    stored = run.until_stored()
    assert "missing for good" in stored.text
    first = [(wanted.channel, wanted.first) for wanted in run.site.asked]
    assert len(first) == len(set(first))


def test_late_messages_are_stored_after_giving_up() -> None:
    run = Run(Way(lost={0}, oldest={"state": 5}))
    run.live(2100 * MS)
    run.until_stored()
    run.desk.take("m", "state", MADE["state"][0])
    log = run.desk.log()
    assert len(log["m"]) == TICKS
    assert "missing 0" in log.account("m")


def remove_site(run: Run) -> None:
    for name in ("m", "s"):
        run.desk.recording.note_presence(
            topics.key(SESSION, name, topics.ALIVE) + f"/{BOOTS[name]}", False
        )


def test_departed_sites_are_not_asked() -> None:
    run = Run(Way(lost=set(range(30, 60))))
    run.live(25 * MS)
    remove_site(run)
    assert not run.desk.over()
    run.desk.rounds(90, run.site, step_ns=100 * MS)
    assert run.site.asked == []
    assert run.desk.over()


def test_tokens_do_not_end_a_sending_site() -> None:
    """A reconnection may report the departure and the return of a token in the wrong order."""
    run = Run(Way(lost=set(range(30, 60))))
    remove_site(run)
    run.live(2100 * MS)
    run.until_stored()
    assert run.site.asked
    assert "missing 0" in run.desk.log().account("m")


def test_sites_dying_after_a_return_end_recording() -> None:
    """The token of such a site disappeared before, and its absence is not reported again."""
    run = Run(Way(lost=set(range(30, 60))))
    remove_site(run)
    run.live(25 * MS)
    run.desk.rounds(5, run.site, step_ns=40 * MS)
    run.desk.take("m", "state", MADE["state"][25])
    run.desk.rounds(5, run.site, step_ns=40 * MS)
    assert not run.desk.over()
    run.desk.rounds(90, run.site, step_ns=100 * MS)
    assert run.desk.over()


def test_oversized_answers_become_smaller() -> None:
    run = Run(Way(lost=set(range(20, 180))))
    run.site.replies = lambda payload: [payload] if len(payload) < 5_000 else []
    run.live(2100 * MS)
    assert run.until_stored().text == "every record of m is stored"


def test_unanswered_channels_delay_no_other() -> None:
    run = Run(Way(lost={n for n in range(20, 180) if n % 3}))
    run.site.replies = lambda payload: (
        [] if decode(payload, Backfill).channel == "state" else [payload]
    )
    run.live(2600 * MS)
    run.desk.rounds(700, run.site)
    accounts = run.desk.recording.accounts
    assert accounts[topics.key(SESSION, "m", "state")].missing > 0
    assert accounts[topics.key(SESSION, "m", "link")].missing == 0
    assert accounts[topics.key(SESSION, "m", "event")].missing == 0
    assert run.desk.said() == []


def test_times_come_from_the_monotonic_clock() -> None:
    class Stepping(ManualClock):
        def unix_ns(self) -> int:
            return super().unix_ns() + (-3600 * S if self.monotonic_ns() > MONO_NS + S else 0)

    run = Run(Way(lost=set(range(50, 80))), Stepping(MONO_NS, UNIX_NS - MONO_NS))
    run.live(S // 2)
    run.desk.report.publish()
    run.live(2100 * MS)
    run.desk.report.publish()
    run.until_stored()
    messages = list(run.desk.messages())
    times = [message.log_time for _, message in messages]
    assert times == sorted(times)
    assert times[0] > UNIX_NS
    assert times[-1] < UNIX_NS + 4 * S
    records = [message for topic, message in messages if topic == "m/state"]
    assert len(records) == TICKS
    assert all(m.publish_time - UNIX_NS == decode(m.data, State).t_ns for m in records)
    seen = [decode(message[1], RecorderStats) for message in iter(run.desk.reports.poll, None)]
    early, late = (stats.unix_ns - stats.mono_ns for stats in seen)
    assert late - early == -3600 * S

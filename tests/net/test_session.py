"""One epoch for any order of starts; no member starts without `start`; strangers change nothing."""

import re
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.errors import SessionError
from trilat_net.net import topics
from trilat_net.net.bus import Inbox
from trilat_net.net.membership import new_boot
from trilat_net.net.messages import VERSION, Event, Info
from trilat_net.net.session import DECIDE_NS, EPOCH_AHEAD_NS
from trilat_net.net.wire import encode

from .local_bus import LocalNetwork
from .parties import SESSION, STEP_NS, Member, Party, answer_info

SITES = ("m1", "m2", "s")
RECORDER = topics.RECORDER


def make_party(*names: str) -> Party:
    session_party = Party(SITES)
    session_party.start(*names)
    return session_party


@st.composite
def draw_lives(draw: st.DrawFn) -> tuple[list[str], list[tuple[str, str]]]:
    """The members of a session, and their events in any order before all are present."""
    sites = [f"site{n}" for n in range(draw(st.integers(2, 5)))]
    members = [*sites, RECORDER] if draw(st.booleans()) else sites
    happenings = st.tuples(
        st.sampled_from(["start", "kill", "poll", "poll", "poll"]), st.sampled_from(members)
    )
    return members, draw(st.lists(happenings, max_size=80))


@given(draw_lives())
@settings(max_examples=50)
def test_all_orders_of_starts_give_one_epoch(
    life: tuple[list[str], list[tuple[str, str]]],
) -> None:
    members, happenings = life
    session = Party([name for name in members if name != RECORDER])
    for what, name in happenings:
        begun = "start" in session.kinds()
        if what == "start" and name not in session.members and not (begun and name == RECORDER):
            session.start(name)
        elif what == "kill" and name in session.members and not begun:
            session.kill(name)
        elif what == "poll" and name in session.members:
            session.round(name)
    begun = "start" in session.kinds()
    for name in members:
        if name not in session.members and not (begun and name == RECORDER):
            session.start(name)
    epoch = session.agreed()
    started = [event for event in session.listen() if event.kind == "start"]
    assert len(started) == 1
    (announced,) = (
        e
        for e in session.said
        if e.kind == "epoch" and e.attempt == started[0].attempt and e.boot == started[0].boot
    )
    assert (announced.epoch_mono_ns, announced.epoch_unix_ns) == (epoch.mono_ns, epoch.unix_ns)
    assert announced.boots == epoch.boots


def test_the_epoch_lies_ahead_of_all_members() -> None:
    session = make_party(*SITES)
    epoch = session.agreed()
    assert epoch.mono_ns - session.clock.monotonic_ns() >= DECIDE_NS - STEP_NS


def test_no_member_starts_without_start() -> None:
    session = make_party(*SITES)
    leader = session.members["m1"]
    for _ in range(200):  # the leader does not poll: nothing is announced
        session.round("m2", "s")
    assert not session.kinds()
    while "epoch" not in session.kinds():
        session.round("m1")
        session.round("s")
        session.members["m2"].publisher.answer_queries()
    session.round("m2", "s")  # all are ready, and the leader says nothing
    assert session.kinds().count("ready") == 2
    for _ in range(10):
        session.round("m2", "s")
    assert [session.members[name].epoch for name in SITES] == [None] * 3
    session.round("m1")
    assert leader.epoch is not None
    assert session.agreed() == leader.epoch


def test_slow_members_get_another_attempt() -> None:
    session = make_party(*SITES)
    while "epoch" not in session.kinds():
        session.round("m1", "m2")
        session.members["s"].publisher.answer_queries()  # s is there, and then hangs
    for _ in range(EPOCH_AHEAD_NS // STEP_NS):
        session.round("m1", "m2")
    assert session.members["m1"].epoch is None
    session.agreed()
    attempts = [event.attempt for event in session.listen() if event.kind == "epoch"]
    assert attempts == sorted(set(attempts))
    assert len(attempts) >= 2


def test_a_leader_that_comes_last_leads() -> None:
    session = make_party("s", "m2", RECORDER)
    session.rounds(50)
    session.start("m1")
    session.agreed()
    assert {event.member for event in session.listen() if event.kind in ("epoch", "start")} == {
        "m1"
    }


def test_members_lost_before_starts_are_awaited() -> None:
    session = make_party(*SITES)
    while "epoch" not in session.kinds():
        session.round()
    session.kill("s")
    session.rounds(100)
    assert [member.epoch for member in session.members.values()] == [None, None]
    assert session.members["m1"].joining.membership.list_missing() == ["s"]
    session.start("s")
    session.agreed()


def test_leaders_lost_before_starts_are_replaced() -> None:
    session = make_party(*SITES)
    while session.kinds().count("ready") < 2:
        session.round("m1")
        session.round("m2", "s")
    session.kill("m1")
    session.start("m1")
    assert session.agreed().boots["m1"] == session.members["m1"].info.boot


def test_announced_recorders_are_awaited() -> None:
    session = make_party(*SITES)
    # there, and not joining yet
    session.stranger.announce(f"trilat/{SESSION}/{RECORDER}/alive/7")
    session.rounds(100)
    assert session.kinds() == []
    assert session.members["m1"].joining.membership.list_missing() == [RECORDER]
    session.stranger.close()
    session.agreed()


@pytest.mark.parametrize("who", SITES)
def test_recorders_needed_by_any_site_are_awaited(who: str) -> None:
    session = Party(SITES)
    for name in SITES:
        session.start(name, needs_recorder=name == who)
    session.rounds(100)
    assert session.kinds() == []
    session.start(RECORDER)
    assert RECORDER in session.agreed().boots


def test_missing_members_are_named() -> None:
    session = make_party("m2")
    assert session.members["m2"].joining.membership.list_missing() == ["m1", "s"]
    session.start("s")
    session.rounds(30)
    assert session.members["m2"].joining.membership.list_missing() == ["m1"]


def test_other_scenarios_are_refused_by_both_hashes() -> None:
    other = "a1" * 32
    session = make_party("m1", "m2")
    session.start("s", scenario_sha256=other)
    both = re.compile(f"(?=.*{other[:16]})(?=.*{'5c' * 8})")
    with pytest.raises(SessionError, match=both):
        session.rounds(30)
    session.round("m1", "m2")
    (refusal,) = [event for event in session.listen() if event.kind == "refused"]
    assert (refusal.member, refusal.about) == ("m1", "s")
    assert both.search(refusal.text)
    session.kill("s")
    session.start("s")
    session.agreed()


def test_refusals_are_reported_once_per_start() -> None:
    session = make_party("m1", "m2")
    stubborn = session.member("s", scenario_sha256="a1" * 32)
    for _ in range(100):
        session.round()
        stubborn.publisher.answer_queries()
    assert session.kinds() == ["refused"]


def polled_until_refused(*members: Member, clock: ManualClock) -> list[str]:
    left: dict[int, str] = {}
    for _ in range(100):
        for member in members:
            if member.info.boot not in left:
                try:
                    member.poll()
                except SessionError as error:
                    left[member.info.boot] = str(error)
                    member.bus.close()
        sleep_for_ns(clock, STEP_NS)
    return list(left.values())


@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("boots", [(7, 9), (9, 7)])
def test_of_two_starts_one_leaves(name: str, boots: tuple[int, int]) -> None:
    session = Party(SITES)
    twins = [session.member(name, boot=boot) for boot in boots]
    others = [session.member(other) for other in SITES if other != name]
    reasons = polled_until_refused(*twins, *others, clock=session.clock)
    assert len(reasons) == 1
    assert f"already has a member named {name}" in reasons[0]
    epochs = {str(member.epoch) for member in (*twins, *others) if member.epoch}
    assert len(epochs) == 1
    assert sum(member.epoch is not None for member in (*twins, *others)) == 3


def test_split_leaders_cannot_split_a_session() -> None:
    """Two starts of m1 whose answers do not reach each other; the others hear both."""
    session = Party(SITES)
    twins = [session.member("m1", boot=boot) for boot in (7, 9)]
    others = [session.member(name) for name in ("m2", "s")]
    for twin in twins:
        take = twin.joining.membership.receive_identity
        twin.joining.membership.receive_identity = lambda info, may_have_started, take=take: (
            None if info.member == "m1" else take(info, may_have_started=may_have_started)
        )
    reasons = polled_until_refused(*twins, *others, clock=session.clock)
    assert len(reasons) == 1
    assert "is running" in reasons[0]
    epochs = [member.epoch for member in (*twins, *others) if member.epoch]
    assert len(epochs) == 3
    assert len({epoch.boots["m1"] for epoch in epochs}) == 1


@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("present", [True, False])
def test_joining_a_running_session_is_refused(name: str, present: bool) -> None:
    """Whether the member of that name is present, or has left its place."""
    session = make_party(*SITES)
    epoch = session.agreed()
    if not present:
        session.kill(name)
    late = session.member(name)
    reasons = polled_until_refused(late, *session.members.values(), clock=session.clock)
    assert len(reasons) == 1
    assert "is running" in reasons[0]
    assert {str(member.epoch) for member in session.members.values()} == {str(epoch)}


@given(
    ahead_ns=st.dictionaries(
        st.sampled_from([*SITES, RECORDER]),
        st.integers(-(10**9) + 1, 10**15),
        min_size=1,
        max_size=4,
    ),
    unix_ns=st.integers(0, 2**60),
)
@settings(max_examples=15)
def test_other_clocks_begin_at_the_same_instant(ahead_ns: dict[str, int], unix_ns: int) -> None:
    session = Party(SITES)
    clocks = {
        name: session.elsewhere(ns, unix_ns + ns, f"machine of {name}")
        for name, ns in ahead_ns.items()
    }
    for name in (*SITES, RECORDER):
        session.start(name, **({"on_clock": clocks[name]} if name in clocks else {}))
    session.rounds(200)
    epochs = {name: member.epoch for name, member in session.members.items()}
    assert all(epochs.values())
    here_ns = epochs["m1"].mono_ns - ahead_ns.get("m1", 0)
    assert here_ns + 10**9 > session.clock.monotonic_ns() - 200 * STEP_NS
    for name, epoch in epochs.items():
        assert epoch.mono_ns == here_ns + ahead_ns.get(name, 0)
        assert epoch.epochs[name] == epoch.mono_ns
        assert (epoch.unix_ns, epoch.boots) == (epochs["m1"].unix_ns, epochs["m1"].boots)
        assert epoch.epochs == epochs["m1"].epochs


def test_readiness_needs_all_other_clocks() -> None:
    session = make_party("m1", "m2")
    session.start("s", on_clock=session.elsewhere(5_000_000_000))
    bus = session.members["m2"].bus
    deaf = LocalNetwork().join().inbox("nothing")
    ask = bus.query
    bus.query = lambda key: deaf if key.endswith(topics.PING) else ask(key)
    session.rounds(300)
    assert session.kinds().count("epoch") > 1
    assert {event.member for event in session.listen() if event.kind == "ready"} == {"s"}
    assert [member.epoch for member in session.members.values()] == [None] * 3
    bus.query = ask
    session.rounds(100)
    assert all(member.epoch for member in session.members.values())


def test_slow_networks_get_later_epochs() -> None:
    """Announcement, answer and start each need a way: the margin grows with the leader's round trips."""
    session = make_party("m1", "m2")
    session.start("s", on_clock=session.elsewhere(5_000_000_000))
    trip_ns = 15 * STEP_NS
    session.members["m1"].bus.query = delay_answers(
        session.members["m1"].bus.query, session.clock, trip_ns
    )
    session.rounds(200)
    (announced,) = (event for event in session.listen() if event.kind == "epoch")
    assert re.search(
        rf"tick 0 is {(EPOCH_AHEAD_NS + 2 * trip_ns) // 1_000_000} ms from now", announced.text
    )
    assert all(member.epoch for member in session.members.values())


def delay_answers(
    ask: Callable[..., Inbox], clock: ManualClock, after_ns: int
) -> Callable[..., Inbox]:
    """Asks at once, and gets the answers later."""

    class Late:
        def __init__(self, inbox: Inbox) -> None:
            self._inbox = inbox
            self._from_ns = clock.monotonic_ns() + after_ns

        def poll(self) -> tuple[str, bytes] | None:
            return self._inbox.poll() if clock.monotonic_ns() >= self._from_ns else None

    return lambda *question: Late(ask(*question))


def test_a_recorder_without_the_scenario_is_not_ready() -> None:
    session = Party(SITES)
    for name in SITES:
        session.start(name, scenario="")
    session.start(RECORDER)
    session.rounds(200)
    assert "epoch" in session.kinds()
    assert "start" not in session.kinds()


GARBAGE = [
    b"",
    b"\xc1",
    b"\x80",
    b"\xff" * 100,
    b"\x81\xa1v\x02",
    b"\x93\x01\x02\x03",
    b"\x91" * 5_000,
]
GARBAGE.append(bytes(70_000))


@pytest.mark.parametrize("name", [*SITES, RECORDER, "nobody"])
def test_garbage_delays_no_session(name: str) -> None:
    session = make_party(*SITES)
    answers = session.stranger.query_inbox(topics.key(SESSION, name, topics.INFO))
    for _ in range(30):
        query = answers.poll()
        for payload in GARBAGE:
            session.say(name, payload)
            if query is not None:
                query.reply(payload)
        session.round()
    session.agreed()


def test_foreign_tokens_are_ignored() -> None:
    session = make_party(*SITES)
    for token in (f"trilat/{SESSION}/m1/alive/xyz", f"trilat/{SESSION}/stranger/alive/0x1"):
        session.stranger.announce(token)
    session.rounds(5)
    session.stranger.close()
    session.agreed()


FORGED = {
    "an epoch of a stranger": Event(
        member="nobody",
        boot=1,
        kind="epoch",
        text="",
        epoch_mono_ns=5,
        attempt=1,
        boots={"m2": 1},
    ),
    "an epoch for other boots": Event(
        member="s",
        boot=1,
        kind="epoch",
        text="",
        epoch_mono_ns=5,
        attempt=1,
        boots={"s": 1, "m2": 1},
    ),
    "a start of nothing": Event(member="m1", boot=1, kind="start", text="", attempt=1),
    "a ready of nobody": Event(member="nobody", boot=1, kind="ready", text="", attempt=1),
    "an end before the beginning": Event(member="m1", boot=1, kind="end", text="", ticks=2**63),
}


@pytest.mark.parametrize("event", FORGED.values(), ids=FORGED.keys())
def test_unannounced_events_change_nothing(event: Event) -> None:
    session = make_party(*SITES)
    for _ in range(30):
        session.say(event.member, encode(event))
        session.round()
    assert {member.epoch.unix_ns for member in session.members.values() if member.epoch} == {
        session.agreed().unix_ns
    }


def test_answers_under_foreign_keys_do_not_count() -> None:
    session = make_party("m1", "m2")
    answers = session.stranger.query_inbox(topics.key(SESSION, "nobody", topics.INFO))
    for _ in range(50):
        while (question := answers.poll()) is not None:
            question.reply(encode(answer_info("s", 1)))
        session.round()
    assert session.members["m1"].joining.membership.list_missing() == ["s"]


def test_answers_of_other_versions_enter_the_error() -> None:
    session = make_party("m1", "m2")
    answers = session.stranger.query_inbox(topics.key(SESSION, "s", topics.INFO))
    newer: Info = answer_info("s", 1, v=VERSION + 1)
    for _ in range(50):
        while (question := answers.poll()) is not None:
            question.reply(encode(newer))
        session.round()
    assert session.members["m1"].joining.membership.list_missing() == ["s"]
    assert f"version {VERSION + 1}" in session.members["m1"].joining.membership.unreadable["s"]


def test_boots_are_random_64_bit_numbers() -> None:
    boots = {new_boot() for _ in range(1000)}
    assert len(boots) == 1000
    assert 2**60 < max(boots) < 2**64

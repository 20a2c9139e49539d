"""The contract of `Bus`, fulfilled by the real bus and by its fake."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.net.bus import Bus, Inbox, StampedInbox, StampingRing

from .local_bus import LocalNetwork
from .networks import NETWORKS, Network
from .waiting import drained, query_once, received, until


@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.long] * (name == "tls")) for name in NETWORKS]
)
def network(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Network]:
    member_network = NETWORKS[request.param](tmp_path)
    yield member_network
    member_network.close()


@pytest.fixture
def pair(network: Network) -> tuple[Bus, Bus]:
    return network.join(), network.join()


def wait_until_heard(
    publish: Callable[[bytes], None], *inboxes: Inbox | StampedInbox[bytes]
) -> None:
    deaf = list(inboxes)

    def heard() -> bool:
        publish(b"probe")
        deaf[:] = [inbox for inbox in deaf if not drained(inbox)]
        return not deaf

    until(heard)
    publish(b"last probe")
    for inbox in inboxes:
        until(lambda inbox=inbox: any(b"last probe" in message for message in drained(inbox)))


NUMBERS = [n.to_bytes(2, "big") for n in range(500)]


def test_rings_give_messages_in_order(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox = receiver.inbox("t/a")
    publish = sender.publisher("t/a")
    wait_until_heard(publish, inbox)
    for number in NUMBERS:
        publish(number)
    assert received(inbox, len(NUMBERS)) == [("t/a", number) for number in NUMBERS]


def test_expressions_match_only_their_keys(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    narrow = receiver.inbox("t/*/x")
    any_number = receiver.inbox("t/**")
    publishers = {
        key: sender.publisher(key)
        for key in ("t/b/y", "t/a/x", "t/b/b/x", "other/a/x", "t/b/x")
    }
    wait_until_heard(publishers["t/b/x"], narrow, any_number)
    for key, publish in publishers.items():
        publish(key.encode())
    assert [key for key, _ in received(narrow, 2)] == ["t/a/x", "t/b/x"]
    assert [key for key, _ in received(any_number, 4)] == ["t/b/y", "t/a/x", "t/b/b/x", "t/b/x"]


def test_own_messages_never_return(pair: tuple[Bus, Bus]) -> None:
    sender, other = pair
    own_inbox = sender.inbox("t/a")
    theirs = other.inbox("t/a")
    publish = sender.publisher("t/a")
    wait_until_heard(publish, theirs)
    wait_until_heard(other.publisher("t/a"), own_inbox)
    publish(b"mine")
    other.publisher("t/a")(b"theirs")
    assert received(own_inbox, 1) == [("t/a", b"theirs")]
    assert received(theirs, 1) == [("t/a", b"mine")]


def test_taps_get_every_message_in_order(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    heard: list[tuple[str, bytes]] = []
    inbox = receiver.inbox("t/a")
    publish = sender.publisher("t/a")
    receiver.tap("t/*", lambda key, payload: heard.append((key, payload)))
    wait_until_heard(publish, inbox)
    until(lambda: heard and heard[-1][1] == b"last probe")
    heard.clear()
    for number in NUMBERS:
        publish(number)
    until(lambda: len(heard) >= len(NUMBERS))
    assert heard == [("t/a", number) for number in NUMBERS]


def test_patient_publishers_lose_nothing(
    pair: tuple[Bus, Bus],
) -> None:
    """A multiple of the connection's capacity; the receiver is slower."""
    sender, receiver = pair
    heard: list[bytes] = []
    inbox = receiver.inbox("t/a")
    publish = sender.publisher("t/a", patient=True)
    receiver.tap("t/a", lambda _, payload: heard.append(payload))
    wait_until_heard(publish, inbox)
    until(lambda: heard and heard[-1] == b"last probe")
    heard.clear()
    said = [n.to_bytes(2, "big") * 500 for n in range(6000)]
    for payload in said:
        publish(payload)
    until(lambda: len(heard) >= len(said), 30.0)
    assert heard == said


def test_full_rings_lose_only_their_oldest(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    small = receiver.inbox("t/a", 16)
    large = receiver.inbox("t/a")
    publish = sender.publisher("t/a")
    wait_until_heard(publish, small, large)
    for number in NUMBERS:
        publish(number)
    assert len(received(large, len(NUMBERS))) == len(NUMBERS)
    kept = [payload for _, payload in received(small, 16)]
    assert kept == NUMBERS[-16:]


def test_every_answer_is_heard_once(network: Network) -> None:
    asker, *others = (network.join() for _ in range(3))
    rings = {
        name: bus.query_inbox(f"t/{name}/info") for name, bus in zip("ab", others, strict=True)
    }

    def answers() -> list[tuple[str, bytes]]:
        replies = asker.query("t/*/info")
        heard: list[tuple[str, bytes]] = []

        def all_answered() -> bool:
            for name, ring in rings.items():
                while (question := ring.poll()) is not None:
                    question.reply(name.encode())
            heard.extend(drained(replies))
            return len(heard) >= 2

        try:
            until(all_answered, timeout_s=0.5)
        except AssertionError:  # not every queryable is known yet
            return []
        return heard

    assert sorted(until(answers)) == [("t/a/info", b"a"), ("t/b/info", b"b")]


def test_questions_carry_their_payload(pair: tuple[Bus, Bus]) -> None:
    asker, other = pair
    questions = other.query_inbox("t/a/info")
    for sent in (b"", b"\x00\xff" * 2000, b"again"):

        def hears_question(sent: bytes = sent) -> bool:
            asker.query("t/*/info", sent)
            question = questions.poll()
            # or one that was asked before
            return question is not None and question.payload == sent

        until(hears_question)


def test_responders_answer_at_once_without_polling(pair: tuple[Bus, Bus]) -> None:
    asker, other = pair
    other.respond("t/a/ping", lambda sent: sent[::-1])
    assert until(lambda: query_once(asker, "t/*/ping", b"123")) == ("t/a/ping", b"321")


def test_silent_responders_let_others_be_heard(network: Network) -> None:
    asker, silent, other = (network.join() for _ in range(3))
    questions: list[bytes] = []
    silent.respond("t/a/ping", questions.append)
    other.respond("t/b/ping", lambda _: b"here")
    heard: list[tuple[str, bytes]] = []
    pending: list[Inbox] = []

    def both() -> bool:
        pending.append(asker.query("t/*/ping", b"?"))
        for replies in pending:
            heard.extend(drained(replies))
        return bool(questions and heard)

    until(both)
    assert set(questions) == {b"?"}
    assert set(heard) == {("t/b/ping", b"here")}


def test_no_member_answers_itself(pair: tuple[Bus, Bus]) -> None:
    member, other = pair
    member.respond("t/a/ping", lambda _: b"own")
    own_questions = member.query_inbox("t/b/ping")
    other.respond("t/c/ping", lambda _: b"theirs")

    def answers() -> list[tuple[str, bytes]]:
        replies = member.query("t/*/ping")
        try:
            return [until(replies.poll, timeout_s=0.5), *drained(replies)]
        except AssertionError:
            return []

    assert until(answers) == [("t/c/ping", b"theirs")]
    assert own_questions.poll() is None


class Ticking:
    """A clock whose every reading is one more than the last."""

    def __init__(self) -> None:
        self.readings = 0

    def __call__(self) -> int:
        self.readings += 1
        return self.readings


def test_every_message_is_stamped_once_at_arrival(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    clock = Ticking()
    inbox = receiver.stamped_inbox("t/a", clock, bytes)
    publish = sender.publisher("t/a")
    wait_until_heard(publish, inbox)
    before = clock.readings
    for number in NUMBERS:
        publish(number)
    taken = [until(inbox.poll) for _ in NUMBERS]
    assert taken == [(number, before + 1 + n) for n, number in enumerate(NUMBERS)]
    assert inbox.poll() is None


def test_full_stamped_rings_lose_the_oldest(pair: tuple[Bus, Bus]) -> None:
    sender, receiver = pair
    inbox = receiver.stamped_inbox("t/a", Ticking(), bytes, 16)
    publish = sender.publisher("t/a")
    done = receiver.inbox("t/done")
    finish = sender.publisher("t/done")
    wait_until_heard(publish, inbox)
    wait_until_heard(finish, done)
    for number in NUMBERS:
        publish(number)
    finish(b"all")
    until(done.poll)
    assert [number for number, _ in drained(inbox)] == NUMBERS[-16:]


@given(capacity=st.integers(1, 5), takes=st.lists(st.booleans(), max_size=60))
def test_stamped_messages_are_polled_waiting_or_oldest(
    capacity: int, takes: list[bool]
) -> None:
    ring = StampingRing(Ticking(), bytes, capacity)
    held: list[int] = []
    taken = 0
    for take in takes:
        if take:
            taken += 1
            held.append(taken)
            ring.receive(bytes([taken]))
            held = held[-capacity:]
        else:
            first = held.pop(0) if held else None
            assert ring.poll() == (first and (bytes([first]), first))


def test_late_answers_harm_nobody(pair: tuple[Bus, Bus]) -> None:
    asker, other = pair
    questions = other.query_inbox("t/a/info")

    def ask_again() -> object:
        asker.query("t/*/info")
        return questions.poll()

    question = until(ask_again)
    asker.close()
    question.reply(b"too late")
    other.publisher("t/a")(b"still here")


def test_tokens_appear_and_disappear_with_their_member(pair: tuple[Bus, Bus]) -> None:
    watcher, other = pair
    presence = watcher.presence("t/*/alive/*")
    other.announce("t/a/alive/1")
    other.announce("t/b/something/1")
    assert until(presence.poll) == ("t/a/alive/1", True)
    other.close()
    assert until(presence.poll) == ("t/a/alive/1", False)
    assert presence.poll() is None


def test_existing_tokens_come_first(pair: tuple[Bus, Bus]) -> None:
    early, late = pair
    early.announce("t/a/alive/1")
    presence = late.presence("t/*/alive/*")
    assert until(presence.poll) == ("t/a/alive/1", True)
    early.announce("t/b/alive/2")
    assert until(presence.poll) == ("t/b/alive/2", True)


def test_members_do_not_see_their_own_token(pair: tuple[Bus, Bus]) -> None:
    member, other = pair
    presence = member.presence("t/*/alive/*")
    member.announce("t/a/alive/1")
    other.announce("t/b/alive/2")
    assert until(presence.poll) == ("t/b/alive/2", True)


def test_empty_rings_give_none(network: Network) -> None:
    bus = network.join()
    rings = [bus.inbox("t/a"), bus.presence("t/*"), bus.query_inbox("t/info"), bus.query("t/*")]
    assert [ring.poll() for ring in rings for _ in range(3)] == [None] * 12


def test_leaving_twice_is_leaving_once(pair: tuple[Bus, Bus]) -> None:
    for _ in range(2):
        pair[0].close()


def test_members_of_two_networks_never_meet() -> None:
    first = LocalNetwork().join()
    other = LocalNetwork().join()
    inbox = other.inbox("**")
    first.publisher("t/a")(b"1")
    assert inbox.poll() is None

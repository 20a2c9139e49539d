"""Members of a session are found and connected to, and take changes over real connections."""

import threading
from collections.abc import Iterator
from contextlib import closing

import msgspec
import pytest

from sites.change_server import ChangeServer
from tests.net.free_endpoints import find_free_endpoints
from tests.net.manual_clock import ManualClock
from trilat_net.app.running_session import RunningSession
from trilat_net.errors import SessionError
from trilat_net.net import session_members, topics
from trilat_net.net.clock import SystemClock
from trilat_net.net.connection import Connection
from trilat_net.net.default_endpoints import DefaultEndpoints
from trilat_net.net.membership import EventPublisher
from trilat_net.net.messages import VERSION, Info
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.session_members import SessionMembers
from trilat_net.net.wire import encode
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.scenario import load_scenario, parse_scenario

from .local_bus import LocalNetwork
from .parties import answer_info
from .waiting import until

SESSION = "o"
CLOCK = SystemClock()


class Answering:
    def __init__(self, *, running: bool, deaf: bool = False) -> None:
        (self.endpoint,) = find_free_endpoints(1)
        self._bus = ZenohBus([self.endpoint])
        scenario = load_scenario("paper")
        info = answer_info(
            "s", 1, scenario_sha256=scenario.sha256, scenario=scenario.text, running=running
        )
        self._publisher = EventPublisher(self._bus, SESSION, info)
        questions = self._bus.query_inbox(
            topics.key(SESSION, "s" if not deaf else "x", topics.SET)
        )
        self._changes = ChangeServer(scenario, "s", questions)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self) -> None:
        while not self._done.wait(0.002):
            self._publisher.answer_queries()
            self._changes.pop_changes(100)

    def close(self) -> None:
        self._done.set()
        self._thread.join()
        self._bus.close()

    def request_change(self, site: str, **order: object) -> ChangeReply:
        wanted = msgspec.convert({"to": {}, **order}, ChangeRequest)
        return RunningSession(SESSION, Connection(connect=[self.endpoint])).change(site, wanted)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_members, "REPLY_TIMEOUT_S", 0.8)


@pytest.fixture
def running() -> Iterator[Answering]:
    with closing(Answering(running=True)) as site:
        yield site


def test_the_affected_site_answers_a_change(running: Answering) -> None:
    reply = running.request_change("s", link="m1->s", to={"delay_ms": 350.0})
    assert (reply.member, reply.accepted, reply.tick) == ("s", True, 200)
    refused = running.request_change("s", link="m1->s", to={"delay_ms": -1.0})
    assert (refused.accepted, refused.tick) == (False, -1)
    assert "delay_ms" in refused.text


def test_changes_for_unknown_sites_name_the_others(running: Answering) -> None:
    with pytest.raises(SessionError, match="m1, m2, s"):
        running.request_change("x", dominance="x", to={"m1": 1.0})


def test_absent_sites_do_not_answer(running: Answering) -> None:
    with pytest.raises(SessionError, match="'m1' of session 'o' does not answer"):
        running.request_change("m1", dominance="m1", to={"s": 1.0})


def test_sessions_take_no_changes_before_their_start() -> None:
    with (
        closing(Answering(running=False)) as site,
        pytest.raises(SessionError, match="has not begun"),
    ):
        site.request_change("s", link="m1->s", to={"delay_ms": 350.0})


def test_silent_members_are_named() -> None:
    with (
        closing(Answering(running=True, deaf=True)) as site,
        pytest.raises(SessionError, match="s did not answer"),
    ):
        site.request_change("s", link="m1->s", to={"delay_ms": 350.0})


def find_answering(*payloads: bytes) -> list[Info]:
    network = LocalNetwork()
    clock = ManualClock()
    for n, payload in enumerate(payloads):
        network.join().respond(
            topics.key(SESSION, f"m{n}", topics.INFO), lambda _, sent=payload: sent
        )
    asker = network.join()
    return list(
        SessionMembers(asker, clock, SESSION).find(stopped=lambda: False, timeout_s=0.5)
    )


def test_members_are_found_despite_unreadable_answers() -> None:
    members = find_answering(encode(answer_info("m0", 1)), b"garbage")
    assert {info.member for info in members} == {"m0"}
    assert len(members) >= 2
    assert find_answering() == []


def test_a_new_search_ignores_earlier_replies() -> None:
    """A second search on the same object neither yields nor reports replies to the first one."""
    network = LocalNetwork()
    members = SessionMembers(network.join(), ManualClock(), SESSION)

    def search() -> Iterator[Info]:
        return members.find(stopped=lambda: False, timeout_s=0.5)

    garbled = network.join()
    garbled.respond(topics.key(SESSION, "m0", topics.INFO), lambda _: b"garbage")
    with pytest.raises(SessionError, match="the reply of m0 cannot be read"):
        list(search())
    garbled.close()
    answering = network.join()
    for name in ("m1", "m2"):
        reply = encode(answer_info(name, 1))
        answering.respond(topics.key(SESSION, name, topics.INFO), lambda _, sent=reply: sent)
    assert next(search()).member == "m1"
    answering.close()
    assert list(search()) == []
    assert members.unreadable == {}


def test_answers_of_other_versions_name_their_member() -> None:
    with pytest.raises(
        SessionError, match=f"the reply of m0 cannot be read: .* version {VERSION + 1}"
    ):
        find_answering(encode(answer_info("m0", 1, v=VERSION + 1)))


def test_waiting_recorders_announce_themselves_first() -> None:
    session = f"discovery-{CLOCK.monotonic_ns()}"
    first = ZenohBus([DefaultEndpoints(session).of_site(0)])
    presence = first.presence(topics.presence_key(session, "*"))
    scenario = load_scenario("two_sites")
    info = answer_info("m", 1, scenario=scenario.text, scenario_sha256=scenario.sha256)
    first.respond(topics.key(session, "m", topics.INFO), lambda _: encode(info))
    patience = {"stopped": lambda: False, "timeout_s": 10.0, "recorder_boot": 7}
    nowhere = Connection(connect=None)
    with (
        closing(first),
        nowhere.open_session(
            CLOCK, session, lambda text: parse_scenario(text).names, **patience
        ) as bus,
    ):
        assert bus is not None
        assert until(presence.poll) == (
            topics.presence_token(session, topics.RECORDER, 7),
            True,
        )
        assert presence.poll() is None  # it stays announced

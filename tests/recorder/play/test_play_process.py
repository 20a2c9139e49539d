"""A whole replay on a bus inside this process, as seen and received by other members.

A watcher acts when a message arrives, which on this bus is while the message is published.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.net.local_bus import LocalNetwork
from tests.net.parties import answer_info
from tests.net.waiting import drained
from tests.recorder.play.logs import read_session_payloads, write_event_log
from trilat_net.app.play.message_source import MessageSource
from trilat_net.app.play.play_process import LINGER_NS, Playback, PlaybackSummary, PlayOptions
from trilat_net.app.play.player import PlayProgress
from trilat_net.app.play.session_reader import PlaySelection, SessionHeader, SessionReader
from trilat_net.errors import SessionError
from trilat_net.log.log_layout import ChannelFilter
from trilat_net.log.message_identity import compute_virtual_boot
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.membership import Epoch, EventPublisher
from trilat_net.net.messages import Event, Info, State
from trilat_net.net.requests import Backfill, BackfillRequest, Pong
from trilat_net.net.session import SessionJoin
from trilat_net.net.session_members import SessionMembers
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import load_scenario

from .clocks import LookedAt

SESSION = "replay-paper"
RECORDER_BOOT = 99
TICKS = 300


@dataclass
class Hall:
    """A replay and a watcher that acts after a given number of messages."""

    log: Path
    options: PlayOptions = field(default_factory=lambda: PlayOptions(SESSION))
    selection: PlaySelection = field(default_factory=PlaySelection)
    network: LocalNetwork = field(default_factory=LocalNetwork)
    clock: LookedAt = field(default_factory=LookedAt)
    acts: dict[int, Callable[[], None]] = field(default_factory=dict)
    always: Callable[[], None] = lambda: None
    stop_at: int = 10**9
    heard: dict[str, list[bytes]] = field(default_factory=dict)
    shown: list[PlayProgress] = field(default_factory=list)
    count: int = 0

    def __post_init__(self) -> None:
        self.watcher: Bus = self.network.join()
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            self.watcher.tap(topics.key(self.options.session, "*", channel), self._hear)
        self.presence = self.watcher.presence(
            topics.key(self.options.session, "*", topics.ALIVE) + "/*"
        )

    def _hear(self, key: str, payload: bytes) -> None:
        self.heard.setdefault("/".join(key.split("/")[2:]), []).append(payload)
        self.count += 1
        self.acts.get(self.count, lambda: None)()
        self.always()

    def ask(self, member: str, channel: str, payload: bytes = b"") -> Inbox:
        return self.watcher.query(topics.key(self.options.session, member, channel), payload)

    def play(self) -> PlaybackSummary:
        self.facts, block = SessionReader([self.log], self.selection).preload(1 << 28)
        bus = self.network.join()
        replay = Playback(
            bus,
            self.clock,
            self.facts,
            MessageSource(self.facts, block),
            self.options,
            lambda: self.count >= self.stop_at,
            lambda _: None,
            self.shown.append,
        )
        try:
            return replay.play(self.selection.start_ns)
        finally:
            bus.close()


class Scribe:
    """A member that announces itself as a recorder that has every record."""

    def __init__(self, hall: Hall, *, stores: bool = True) -> None:
        bus = hall.network.join()
        session = hall.options.session
        info = answer_info(topics.RECORDER, RECORDER_BOOT)
        bus.respond(topics.key(session, topics.RECORDER, topics.INFO), lambda _: encode(info))
        bus.announce(topics.presence_token(session, topics.RECORDER, RECORDER_BOOT))
        publish = bus.publisher(topics.key(session, topics.RECORDER, topics.EVENT))

        def hear(_: str, payload: bytes) -> None:
            event = decode(payload, Event)
            if event.kind == "end" and stores:
                said = Event(
                    member=topics.RECORDER,
                    boot=RECORDER_BOOT,
                    kind="stored",
                    text="",
                    about=event.member,
                )
                publish(encode(said))

        bus.tap(topics.key(session, "*", topics.EVENT), hear)


def test_payloads_come_in_order_of_their_channel(log_file: Path) -> None:
    hall = Hall(log_file)
    outcome = hall.play()
    assert hall.heard == read_session_payloads(log_file)
    assert outcome.counts == {
        f"/trilat/paper/{key}": len(payload_list) for key, payload_list in hall.heard.items()
    }
    assert (outcome.rounds, outcome.cut, outcome.strays, outcome.recorders) == (1, 0, 0, 0)
    assert outcome.lateness is not None
    assert outcome.took_s == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(("rate", "start_ns"), [(1.0, None), (2.0, 50_000_000)])
def test_visitors_find_a_running_session(
    log_file: Path, rate: float, start_ns: int | None
) -> None:
    hall = Hall(log_file, PlayOptions(SESSION, rate), PlaySelection(start_ns=start_ns))
    rings: list[Inbox] = []
    begun: list[int] = []
    hall.acts = {
        1: lambda: begun.append(hall.clock.now_ns),
        300: lambda: rings.append(hall.ask("*", "info")),
    }
    hall.play()
    infos = {
        info.member: info
        for info in (decode(payload, Info) for _, payload in drained(rings[0]))
    }
    boots = {
        name: compute_virtual_boot(hall.facts.scenario.sha256, name)
        for name in ("m1", "m2", "s")
    }
    assert {name: info.boot for name, info in infos.items()} == boots
    for name, info in infos.items():
        assert info.running
        assert info.boots == boots
        assert info.scenario_sha256 == hall.facts.scenario.sha256
        assert info.scenario == hall.facts.scenario.text
        assert info.clock == hall.clock.identity()
        assert 0 < info.ticks <= TICKS, name
        lead_ns = (start_ns or 0) / rate
        assert info.epoch_mono_ns == pytest.approx(begun[0] - lead_ns, abs=50_000)
        assert info.epoch_unix_ns - info.epoch_mono_ns == pytest.approx(
            5_000_000_000_000, abs=50_000
        )


def test_the_sites_tokens_stand_while_it_plays(log_file: Path) -> None:
    hall = Hall(log_file)
    seen: list[tuple[str, bool]] = []
    hall.acts = {1: lambda: seen.extend(drained(hall.presence))}  # type: ignore[arg-type]
    hall.play()
    tokens = {
        topics.presence_token(SESSION, name, boot) for name, boot in hall.facts.boots.items()
    }
    assert set(seen) == {(key, True) for key in tokens}
    assert set(drained(hall.presence)) == {(key, False) for key in tokens}  # type: ignore[arg-type]


def test_pings_are_answered_at_once(log_file: Path) -> None:
    hall = Hall(log_file)
    pongs: list[Pong] = []
    hall.acts = {
        5: lambda: pongs.extend(
            decode(payload, Pong) for _, payload in drained(hall.ask("*", topics.PING))
        )
    }
    hall.play()
    assert {pong.member: pong.boot for pong in pongs} == hall.facts.boots


def test_the_past_is_given_as_far_as_played(log_file: Path) -> None:
    hall = Hall(log_file)
    rings: list[Inbox] = []

    def ask() -> None:
        for first, last in ((0, 9), (40, 1000), (290, 299)):
            backfill_request = BackfillRequest(channel="state", first=first, last=last)
            rings.append(hall.ask("m2", topics.PAST, encode(backfill_request)))
        rings.append(
            hall.ask(
                "s", topics.PAST, encode(BackfillRequest(channel="link", first=0, last=99))
            )
        )
        rings.append(hall.ask("s", topics.PAST, b"garbage"))

    hall.acts = {200: ask}
    outcome = hall.play()
    published = read_session_payloads(log_file)
    early, later, unplayed, links = (
        decode(drained(ring)[0][1], Backfill) for ring in rings[:4]
    )
    assert early.payloads == published["m2/state"][:10]
    assert (early.member, early.boot, early.first) == ("m2", hall.facts.boots["m2"], 0)
    assert later.first == 40
    assert later.payloads == published["m2/state"][40 : min(104, later.made)]
    assert 60 <= later.made <= 100
    assert (unplayed.first, unplayed.payloads) == (290, [])
    assert links.payloads == published["s/link"][: links.made]
    assert drained(rings[4]) == []
    assert outcome.refilled == sum(
        len(past.payloads) for past in (early, later, unplayed, links)
    )


def test_joining_recorders_learn_tick_0(log_file: Path) -> None:
    """The recorder joins by its own code."""
    hall = Hall(log_file)
    bus = hall.network.join()
    info = answer_info(topics.RECORDER, RECORDER_BOOT)
    epochs: list[Epoch] = []
    begun: list[int] = []
    joining: list[SessionJoin] = []

    def come() -> None:
        joining.append(
            SessionJoin(bus, hall.clock, SESSION, EventPublisher(bus, SESSION, info), ())
        )

    def join() -> None:
        if joining and not epochs:
            epochs.extend(filter(None, [joining[0].poll()]))

    hall.acts = {1: lambda: begun.append(hall.clock.now_ns), 50: come}
    hall.always = join
    hall.play()
    assert epochs[0].boots == hall.facts.boots
    assert epochs[0].mono_ns == pytest.approx(begun[0], abs=50_000)


@pytest.mark.parametrize(("stores", "stays_ns"), [(True, 0), (False, LINGER_NS)])
def test_replay_waits_for_the_recorder_briefly(
    log_file: Path, stores: bool, stays_ns: int
) -> None:
    hall = Hall(log_file, PlayOptions(SESSION, needs_recorder=True))
    Scribe(hall, stores=stores)
    ended: list[int] = []
    hall.always = lambda: ended.append(hall.clock.now_ns)
    outcome = hall.play()
    assert (outcome.recorders, outcome.stored) == (1, stores)
    assert hall.clock.now_ns - ended[-1] == pytest.approx(stays_ns, abs=200_000_000)


def test_logs_play_under_their_own_name(log_file: Path) -> None:
    hall = Hall(
        log_file, PlayOptions("other"), PlaySelection(ChannelFilter(exclude=("**/link",)))
    )
    hall.play()
    wanted = {
        key: payload_list
        for key, payload_list in read_session_payloads(log_file).items()
        if not key.endswith("link")
    }
    assert hall.heard == wanted
    assert {decode(payload, State).site for payload in hall.heard["m1/state"]} == {"m1"}


def test_replays_end_in_order_on_request(log_file: Path) -> None:
    hall = Hall(log_file, stop_at=100)
    outcome = hall.play()
    assert 100 <= sum(outcome.counts.values()) <= 110
    drained(hall.presence)  # type: ignore[arg-type]
    assert hall.network.members == [hall.watcher]


def test_progress_is_shown_twice_a_second(tmp_path: Path) -> None:
    hall = Hall(
        write_event_log(tmp_path / "run.mcap", [("m1", n, 100 * n, 100 * n) for n in range(31)])
    )
    hall.play()
    positions = [progress.position_ns for progress in hall.shown]
    assert positions == sorted(positions)
    assert 5 <= len(positions) <= 8


def test_existing_sessions_are_refused() -> None:
    network = LocalNetwork()
    clock = LookedAt()
    visitor = network.join()
    playing = network.join()
    playing.respond(
        topics.key("other", "m1", topics.INFO),
        lambda _: encode(answer_info("m1", RECORDER_BOOT)),
    )
    playing.respond(topics.key(SESSION, "nobody", topics.INFO), lambda _: b"garbage")
    playing.respond(
        topics.key(SESSION, "recorder", topics.INFO),
        lambda _: encode(answer_info("recorder", RECORDER_BOOT)),
    )
    members = SessionMembers(visitor, clock, SESSION)
    members.require_absent(lambda: False)
    playing.respond(
        topics.key(SESSION, "m1", topics.INFO),
        lambda _: encode(answer_info("m1", RECORDER_BOOT)),
    )
    with pytest.raises(
        SessionError, match="session 'replay-paper' already exists and is waiting to begin"
    ):
        members.require_absent(lambda: False)


@pytest.mark.parametrize(
    ("topic", "key"),
    [
        ("/trilat/paper/m1/state", "trilat/again/m1/state"),
        ("/viz/m1/joint_states", "trilat/again/viz/m1/joint_states"),
        ("/trilat/other/m1/state", "trilat/again/trilat/other/m1/state"),
    ],
)
def test_keys_use_the_new_session_name(topic: str, key: str) -> None:
    scenario = load_scenario("paper")
    header = SessionHeader("paper", scenario, scenario.text, fingerprint="", version=0)
    assert header.map_topic(topic, "again") == key

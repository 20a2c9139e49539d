"""Session membership.

Boots, liveliness tokens, event publishers, who is present, and late join of a recorder.

Invariant: a different scenario, a running session and a second start of the same member are refused at
the first exchange; replies of strangers are ignored and kept for the error message. A recorder may join a
running session, and several recorders may be present. It then takes identities, epoch and boots from the
running members, waits for those that are present and can be pinged, and not for those that left. Sites do
not join late: their arm would be in the wrong place.
"""

import secrets
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple

import msgspec

from ..errors import SessionError, WireError
from . import topics
from .bus import Bus, Inbox
from .clock import Clock
from .messages import Event, Info
from .pinging import Pinger, RepeatedQuery
from .wire import decode, encode


def new_boot() -> int:
    """Returns a random number that names one start of one process."""
    return secrets.randbits(64)


def liveliness_token(session: str, member: str, boot: int) -> str:
    """Returns the liveliness token of one start of a member."""
    return topics.key(session, member, topics.ALIVE) + f"/{boot}"


def read_events(inbox: Inbox) -> Iterator[Event]:
    """Yields the events that wait in a ring; what is none of ours is passed over."""
    while (message := inbox.poll()) is not None:
        try:
            yield decode(message[1], Event)
        except WireError:
            continue


class EventPublisher:
    """A member's own events and answers.

    Args:
        bus: its connection.
        session: the session's name.
        info: what it answers when asked who it is.
        keep: takes every event as it is published.

    Attributes:
        info: what it answers when asked who it is.
        said: how many events it has published.
    """

    def __init__(
        self, bus: Bus, session: str, info: Info, keep: Callable[[bytes], None] = lambda _: None
    ) -> None:
        self.info = info
        self.said = 0
        self._keep = keep
        self._publish = bus.publisher(topics.key(session, info.member, topics.EVENT))
        self._questions = bus.questions(topics.key(session, info.member, topics.INFO))

    def say(self, kind: str, text: str, **facts: object) -> Event:
        """Publishes an event, numbered, and returns it."""
        own = {"member": self.info.member, "boot": self.info.boot, "n": self.said}
        event = msgspec.convert({**own, "kind": kind, "text": text, **facts}, Event)
        self.said += 1
        payload = encode(event)
        self._keep(payload)
        self._publish(payload)
        return event

    def answer(self) -> None:
        """Answers who asks who this is."""
        while (question := self._questions.poll()) is not None:
            question.answer(encode(self.info))


ASK_EVERY_NS = 200_000_000


class Membership:
    """What one member knows of the others.

    Args:
        bus: its connection.
        clock: the time.
        session: the session's name.
        voice: its own events and answers.
        sites: the sites of the scenario, in order; empty for a member that learns them (the recorder).

    Attributes:
        met: what the others said of themselves, by name.
        unreadable: whose answer could not be understood, and why.
        gone: boots of the members that have disappeared.
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, voice: EventPublisher, sites: Sequence[str]
    ) -> None:
        self.met: dict[str, Info] = {}
        self.unreadable: dict[str, str] = {}
        self.gone: set[str] = set()
        self._clock, self._session, self._voice, self._sites = clock, session, voice, tuple(sites)
        self._presence = bus.presence(topics.key(session, "*", topics.ALIVE) + "/*")
        self._asking = RepeatedQuery(bus, clock, topics.key(session, "*", topics.INFO))
        self._asked_ns = -ASK_EVERY_NS
        self._refused: set[int] = set()
        self._recorders: set[str] = set()

    @property
    def own(self) -> Info:
        """What this member says of itself."""
        return self._voice.info

    @property
    def leads(self) -> bool:
        """True where this member is the first site of the scenario."""
        return self._sites[:1] == (self.own.member,)

    def boots(self) -> dict[str, int]:
        """Returns the boots of all who are there, oneself among them."""
        return {name: info.boot for name, info in self.met.items()} | {self.own.member: self.own.boot}

    def clocks(self) -> dict[str, str]:
        """Returns the identities of their clocks."""
        return {name: info.clock for name, info in self.met.items()} | {self.own.member: self.own.clock}

    def missing(self) -> list[str]:
        """Returns the members that have not been met."""
        needed = any(info.needs_recorder for info in (self.own, *self.met.values()))
        recorder = needed or bool(self._recorders)
        wanted = [*self._sites, *([topics.RECORDER] if recorder else [])]
        return [name for name in wanted if name != self.own.member and name not in self.met]

    def poll(self, *, invited: bool) -> None:
        """Asks again and again who is there, takes the answers, and forgets who is gone.

        Args:
            invited: whether this member has said ready: then others may begin before it knows.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        now_ns = self._clock.monotonic_ns()
        while (answer := self._asking.poll()) is not None:
            where = topics.parse_key(answer.key)
            try:
                info = decode(answer.payload, Info)
            except WireError as error:  # another version of us, or a stranger: no reason to leave
                if where is not None and where.member in (*self._sites, topics.RECORDER):
                    self.unreadable[where.member] = str(error)
                continue
            if where is not None and where.member == info.member:
                self.take(info, invited=invited)
        if now_ns - self._asked_ns >= ASK_EVERY_NS:
            self._asked_ns = self._asking.ask()
        self._watch()

    def take(self, info: Info, *, invited: bool) -> None:
        """Takes what a member says of itself.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        own = self.own
        if info.boot == own.boot or (not self._sites and info.member == topics.RECORDER):
            return
        if info.running and not invited and (self._sites or not info.boots):
            raise SessionError(f"session {self._session!r} is running; {info.member} is at tick {info.ticks}")
        if info.member == own.member:
            if info.boot < own.boot:
                raise SessionError(f"there is a {own.member} in session {self._session!r} already")
            return
        if self._sites and info.scenario_sha256 and info.scenario_sha256 != own.scenario_sha256:
            self._refuse(info)
            return
        if info.member == topics.RECORDER and self._has_recorder(info):
            return
        if not self._sites or info.member in self._sites or info.member == topics.RECORDER:
            self.met[info.member] = info

    def _has_recorder(self, info: Info) -> bool:
        """True where another recorder was met before, which is still there: the first one is the member."""
        met = self.met.get(topics.RECORDER)
        return met is not None and met.boot != info.boot

    def _refuse(self, info: Info) -> None:
        """The leader's scenario is the session's: others leave, and the leader says why."""
        own = self.own
        text = (
            f"another scenario: {info.member} has {info.scenario_sha256[:16]}, "
            f"{own.member} has {own.scenario_sha256[:16]}"
        )
        if not self.leads and info.member == self._sites[0]:
            raise SessionError(f"{text}; the one of {info.member}, who leads, counts")
        if self.leads and info.boot not in self._refused:
            self._refused.add(info.boot)
            self._voice.say("refused", text, about=info.member)

    def _watch(self) -> None:
        """Notes recorders that announce themselves, and forgets members that are gone."""
        while (change := self._presence.poll()) is not None:
            key, alive = change
            where = topics.parse_key(key)
            if where is None:
                continue
            if where.member == topics.RECORDER:
                (self._recorders.add if alive else self._recorders.discard)(where.boot)
            (self.gone.discard if alive else self.gone.add)(where.boot)
            if alive:
                continue
            met = self.met.get(where.member)
            if met is not None and str(met.boot) == where.boot:
                del self.met[where.member]


LATE_GATHER_NS = 1_500_000_000
"""How long to wait for the other members of a session whose first has been met."""


class RunningSession(NamedTuple):
    """Tick 0 of a running session, on the own clock as it stands now against the member's, and the boots."""

    mono_ns: int
    unix_ns: int
    boots: dict[str, int]


class LateJoin:
    """A recorder's eye for sessions that run.

    Args:
        meeting: who has been met.
        pinger: where clocks stand.
    """

    def __init__(self, meeting: Membership, pinger: Pinger) -> None:
        self._meeting, self._pinger = meeting, pinger
        self._first_ns: int | None = None

    def poll(self, now_ns: int) -> RunningSession | None:
        """Returns the session's beginning, once all its members that are there have been met.

        Args:
            now_ns: the own clock.
        """
        running = self._running()
        if not running:
            self._first_ns = None
            return None
        if self._first_ns is None:
            self._first_ns = now_ns
        sites = set(running[0].boots) - {topics.RECORDER}
        if {info.member for info in running} < sites and now_ns - self._first_ns < LATE_GATHER_NS:
            return None
        return self._beginning(running, now_ns)

    def _running(self) -> list[Info]:
        """Returns what the members of one running session say of themselves."""
        infos = [
            info
            for _, info in sorted(self._meeting.met.items())
            if info.running and info.scenario and info.boots.get(info.member) == info.boot
        ]
        return [info for info in infos if info.boots == infos[0].boots]

    def _beginning(self, running: Collection[Info], now_ns: int) -> RunningSession | None:
        """Returns the epoch by a clock that is the own one, or else by one that is known."""
        own = self._meeting.own.clock
        for info in sorted(running, key=lambda info: info.clock != own):
            if info.clock == own:
                offset_ns = 0
            elif self._pinger.know([info.boot]):
                # as the clocks stand now: what they drifted apart since the epoch is nobody's to know
                offset_ns = self._pinger.estimate(info.boot).offset_at(now_ns)
            else:
                continue
            return RunningSession(info.epoch_mono_ns - offset_ns, info.epoch_unix_ns, dict(info.boots))
        return None

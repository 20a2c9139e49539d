"""How the members of a session find together and agree on one epoch.

Law: one epoch whatever the start order. The first site of the scenario leads: with every member's answer
in and equal where it must be, it announces an epoch and the boots that it is for; when all have answered
`ready` in time it says `start`, and otherwise announces another one. Nobody starts without `start`.

Everything here is polled, on a `Bus` and a `Clock` that it is given; nothing waits.
"""

import secrets
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from ..errors import SessionError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .messages import Event, Info
from .wire import decode, encode

AHEAD_NS = 500_000_000
"""How far ahead an epoch is announced."""
DECIDE_NS = 150_000_000
"""How long before the epoch every answer must be in."""
ASK_EVERY_NS = 200_000_000


class Epoch(NamedTuple):
    """Tick 0 of a session.

    Attributes:
        mono_ns: on this process's monotonic clock.
        unix_ns: in Unix time, as the leader read it.
        boots: the members and their boots.
    """

    mono_ns: int
    unix_ns: int
    boots: dict[str, int]


def new_boot() -> int:
    """Returns a random number that names one start of one process."""
    return secrets.randbits(64)


def token(session: str, member: str, boot: int) -> str:
    """Returns the liveliness token of one start of a member."""
    return topics.key(session, member, topics.ALIVE) + f"/{boot}"


class Voice:
    """A member's own events and answers.

    Args:
        bus: its connection.
        session: the session's name.
        info: what it answers when asked who it is.

    Attributes:
        info: what it answers when asked who it is.
    """

    def __init__(self, bus: Bus, session: str, info: Info) -> None:
        self.info = info
        self._publish = bus.publisher(topics.key(session, info.member, topics.EVENT))
        self._questions = bus.questions(topics.key(session, info.member, topics.INFO))

    def say(self, kind: str, text: str, **facts: object) -> Event:
        """Publishes an event and returns it."""
        event = msgspec.convert(
            {"member": self.info.member, "boot": self.info.boot, "kind": kind, "text": text, **facts}, Event
        )
        self._publish(encode(event))
        return event

    def answer(self) -> None:
        """Answers who asks who this is."""
        while (question := self._questions.poll()) is not None:
            question.answer(encode(self.info))


class Joining:
    """One member's way into a session; call `poll` until it returns the epoch.

    Args:
        bus: its connection, on which its subscriptions stand already.
        clock: the time.
        session: the session's name.
        voice: its own events and answers.
        sites: the sites of the scenario, in order; empty for a member that learns them (the recorder).

    Attributes:
        met: what the other members said of themselves, by name.
        unreadable: whose answer could not be understood, and why.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, voice: Voice, sites: Sequence[str]) -> None:
        self.met: dict[str, Info] = {}
        self.unreadable: dict[str, str] = {}
        self._bus, self._clock, self._session, self._voice = bus, clock, session, voice
        self._sites = tuple(sites)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self._presence = bus.presence(topics.key(session, "*", topics.ALIVE) + "/*")
        self._asked_ns = -ASK_EVERY_NS
        self._replies = bus.ask(topics.key(session, "*", topics.INFO))
        self._announced: Event | None = None
        self._announcer_gone = False
        self._attempt = 0
        self._ready: set[str] = set()
        self._refused: set[int] = set()
        self._recorders: set[str] = set()
        bus.announce(token(session, voice.info.member, voice.info.boot))

    @property
    def _own(self) -> Info:
        return self._voice.info

    @property
    def _leads(self) -> bool:
        return bool(self._sites) and self._sites[0] == self._own.member

    def missing(self) -> list[str]:
        """Returns the members that have not been met."""
        needed = any(info.needs_recorder for info in (self._own, *self.met.values()))
        recorder = needed or bool(self._recorders)
        wanted = [*self._sites, *([topics.RECORDER] if recorder else [])]
        return [name for name in wanted if name != self._own.member and name not in self.met]

    def poll(self) -> Epoch | None:
        """Does what is to be done now; returns the epoch once it is fixed.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        self._voice.answer()
        self._meet()
        self._watch()
        started = self._listen()
        if started is None and self._leads:
            started = self._lead()
        return None if started is None else self._epoch(started)

    def _meet(self) -> None:
        """Asks again and again who is there, and takes the answers."""
        now_ns = self._clock.monotonic_ns()
        while (reply := self._replies.poll()) is not None:
            where = topics.address(reply[0])
            try:
                info = decode(reply[1], Info)
            except WireError as error:  # another version of us, or a stranger: no reason to leave
                if where is not None and where.member in (*self._sites, topics.RECORDER):
                    self.unreadable[where.member] = str(error)
                continue
            if where is not None and where.member == info.member:
                self._take(info)
        if now_ns - self._asked_ns >= ASK_EVERY_NS:
            self._asked_ns = now_ns
            self._replies = self._bus.ask(topics.key(self._session, "*", topics.INFO))

    def _take(self, info: Info) -> None:
        own = self._own
        if info.boot == own.boot:
            return
        invited = self._announced is not None and not self._leads
        if info.running and not invited:
            raise SessionError(f"session {self._session!r} is running; {info.member} is at tick {info.ticks}")
        if info.member == own.member:
            if info.boot < own.boot:
                raise SessionError(f"there is a {own.member} in session {self._session!r} already")
            return
        if self._sites and info.scenario_sha256 and info.scenario_sha256 != own.scenario_sha256:
            self._refuse(info)
            return
        if not self._sites or info.member in self._sites or info.member == topics.RECORDER:
            self.met[info.member] = info

    def _refuse(self, info: Info) -> None:
        """The leader's scenario is the session's: others leave, and the leader says why."""
        own = self._own
        text = (
            f"another scenario: {info.member} has {info.scenario_sha256[:16]}, "
            f"{own.member} has {own.scenario_sha256[:16]}"
        )
        if not self._leads and info.member == self._sites[0]:
            raise SessionError(f"{text}; the one of {info.member}, who leads, counts")
        if self._leads and info.boot not in self._refused:
            self._refused.add(info.boot)
            self._voice.say("refused", text, about=info.member)

    def _watch(self) -> None:
        """Notes recorders that announce themselves, and forgets members that are gone."""
        while (change := self._presence.poll()) is not None:
            key, alive = change
            where = topics.address(key)
            if where is None:
                continue
            if where.member == topics.RECORDER:
                (self._recorders.add if alive else self._recorders.discard)(where.boot)
            if alive:
                continue
            if self._announced is not None and str(self._announced.boot) == where.boot:
                self._announcer_gone = True
            met = self.met.get(where.member)
            if met is not None and str(met.boot) == where.boot:
                del self.met[where.member]

    def _listen(self) -> Event | None:
        """Takes events; returns the announcement that has been started."""
        while (message := self._events.poll()) is not None:
            try:
                event = decode(message[1], Event)
            except WireError:
                continue  # a stranger's; the loop counts those, joining has no use for them
            if event.boots.get(event.member) != event.boot:
                continue  # from nobody whom the announcement is for
            if event.kind == "epoch":
                self._consider(event)
            elif event.kind == "ready" and self._answers(event):
                self._ready.add(event.member)
            elif event.kind == "start" and self._answers(event) and event.boot == self._announced_by():
                return self._announced
        return None

    def _answers(self, event: Event) -> bool:
        """True where an event belongs to the announcement in hand."""
        announced = self._announced
        return announced is not None and (event.attempt, event.boots) == (announced.attempt, announced.boots)

    def _announced_by(self) -> int | None:
        return None if self._announced is None else self._announced.boot

    def _consider(self, event: Event) -> None:
        """Answers an announced epoch, if it is the leader's and for this boot."""
        if self._leads or (self._sites and event.member != self._sites[0]):
            return
        if not self._sites and not self._knows_scenario(event):
            return  # a recorder that has not learnt the scenario yet is not ready
        if event.boots.get(self._own.member) == self._own.boot:
            if self._bound(event):
                return
            self._announced, self._announcer_gone = event, False
            self._voice.say("ready", f"{self._own.member} is ready", attempt=event.attempt, boots=event.boots)
        elif self._own.member in event.boots:
            raise SessionError(f"session {self._session!r} goes on with another {self._own.member}")

    def _knows_scenario(self, event: Event) -> bool:
        return any(info.scenario and event.boots.get(name) == info.boot for name, info in self.met.items())

    def _bound(self, event: Event) -> bool:
        """True where this member has said ready to another leader, who may still say start."""
        announced = self._announced
        if announced is None or announced.boot == event.boot or self._announcer_gone:
            return False
        return self._clock.monotonic_ns() < self._epoch(announced).mono_ns

    def _lead(self) -> Event | None:
        """Announces an epoch when all are there; returns it when all are ready in time."""
        now_ns = self._clock.monotonic_ns()
        announced = self._announced
        if announced is not None:
            boots = self._boots()
            if now_ns >= announced.epoch_mono_ns - DECIDE_NS or announced.boots != boots or self.missing():
                self._announced = None  # somebody was too late, is gone, or has come: another attempt
            elif self._ready | {self._own.member} >= set(announced.boots):
                self._voice.say("start", "all are ready", attempt=announced.attempt, boots=announced.boots)
                return announced
            return None
        if not self.missing():
            self._announce(now_ns)
        return None

    def _boots(self) -> dict[str, int]:
        return {name: info.boot for name, info in self.met.items()} | {self._own.member: self._own.boot}

    def _announce(self, now_ns: int) -> None:
        boots = self._boots()
        self._ready = set()
        self._attempt += 1
        self._announced = self._voice.say(
            "epoch",
            f"{', '.join(sorted(boots))}: tick 0 is {AHEAD_NS // 1_000_000} ms from now",
            attempt=self._attempt,
            epoch_mono_ns=now_ns + AHEAD_NS,
            epoch_unix_ns=self._clock.unix_ns() + AHEAD_NS,
            clock=self._clock.identity(),
            boots=boots,
        )

    def _epoch(self, event: Event) -> Epoch:
        """Puts an announced epoch onto this process's monotonic clock."""
        mono_ns = event.epoch_mono_ns
        if event.clock != self._clock.identity():  # another machine: by the wall clocks of both
            mono_ns = event.epoch_unix_ns - self._clock.unix_ns() + self._clock.monotonic_ns()
        return Epoch(mono_ns, event.epoch_unix_ns, dict(event.boots))

"""The start of a session: members meet and agree on one epoch.

Invariant: one epoch for any start order. The first site of the scenario leads: once every member has replied
consistently, it announces an epoch with the boots it is for; once all have replied `ready` in time it sends
`start`, and otherwise announces another epoch. No member starts without `start`; a late recorder learns the
epoch from the running members.

The epoch is an instant of the leader's monotonic clock. A member on another clock converts it by pings, to
half a round trip, and is ready only when it knows all clocks it needs; wall clocks decide nothing.
Everything is polled, on a given `Bus` and `Clock`; nothing waits.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..errors import SessionError
from . import topics
from .bus import Bus
from .clock import Clock
from .membership import EventPublisher, LateJoin, Membership, liveliness_token, read_events
from .messages import Event, Info
from .pinging import Pinger, answer_pings

EPOCH_AHEAD_NS = 500_000_000
"""How far ahead an epoch is announced, and two round trips more."""
DECIDE_NS = 150_000_000
"""How long before the epoch every answer must be in, and a round trip more."""


class Epoch(NamedTuple):
    """Tick 0 of a session.

    Attributes:
        mono_ns: on this process's monotonic clock.
        unix_ns: in Unix time, as the leader read it.
        boots: the members and their boots.
        epochs: the same instant on every member's own clock.
    """

    mono_ns: int
    unix_ns: int
    boots: dict[str, int]
    epochs: Mapping[str, int] = {}


class SessionJoin:
    """One member's way into a session; call `poll` until it returns the epoch.

    Args:
        bus: its connection, on which its subscriptions stand already.
        clock: the time.
        session: the session's name.
        voice: its own events and answers.
        sites: the sites of the scenario, in order; empty for a member that learns them (the recorder).

    Attributes:
        meeting: who is there.
        pinger: where their clocks stand.
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, voice: EventPublisher, sites: Sequence[str]
    ) -> None:
        self._clock, self._session, self._voice = clock, session, voice
        self._sites = tuple(sites)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self.meeting = Membership(bus, clock, session, voice, sites)
        self.pinger = Pinger(bus, clock, session)
        self._latecomer = LateJoin(self.meeting, self.pinger)
        answer_pings(bus, clock, session, voice.info)
        self._offered: Event | None = None
        self._epoch_ns = 0
        self._announced: Event | None = None
        self._attempt = 0
        self._ready: dict[str, int] = {}
        bus.announce(liveliness_token(session, voice.info.member, voice.info.boot))

    @property
    def _own(self) -> Info:
        return self._voice.info

    def poll(self) -> Epoch | None:
        """Does what is to be done now; returns the epoch once it is fixed.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        meeting = self.meeting
        self._voice.answer()
        meeting.poll(invited=self._announced is not None and not meeting.leads)
        self.pinger.poll(self._apart(meeting.boots(), meeting.clocks()))
        epoch = self._listen()
        if epoch is None:
            self._answer()
        if epoch is None and meeting.leads:
            epoch = self._lead()
        if epoch is None and not self._sites:
            epoch = self._come_late()
        return epoch

    def _come_late(self) -> Epoch | None:
        """Returns the epoch of a session that runs; not while its `start` may still be under way."""
        now_ns = self._clock.monotonic_ns()
        if self._announced is not None and now_ns < self._epoch_ns:
            return None
        since = self._latecomer.poll(now_ns)
        return None if since is None else Epoch(*since)

    def _apart(self, boots: Mapping[str, int], clocks: Mapping[str, str]) -> set[int]:
        """Returns the boots of the sites whose clock is another one than the own."""
        return {
            boot
            for name, boot in boots.items()
            if name != topics.RECORDER and clocks.get(name) != self._own.clock
        }

    def _listen(self) -> Epoch | None:
        """Takes events; returns the epoch of the announcement that has been started."""
        for event in read_events(self._events):
            if event.boots.get(event.member) != event.boot:
                continue  # from nobody whom the announcement is for
            if event.kind == "epoch":
                self._consider(event)
            elif event.kind == "ready" and self._answers(event):
                self._ready[event.member] = event.epoch_mono_ns
            elif event.kind == "start" and self._starts(event):
                return self._epoch(event)
        return None

    def _answers(self, event: Event) -> bool:
        """True where an event belongs to the announcement in hand."""
        announced = self._announced
        return announced is not None and (event.attempt, event.boots) == (announced.attempt, announced.boots)

    def _starts(self, event: Event) -> bool:
        """True where an event starts the announcement in hand."""
        announced = self._announced
        return (
            announced is not None
            and self._answers(event)
            and event.boot == announced.boot
            and event.epochs.keys() == announced.boots.keys()
        )

    def _consider(self, event: Event) -> None:
        """Answers an announced epoch, if it is the leader's and for this boot."""
        if self.meeting.leads or (self._sites and event.member != self._sites[0]):
            return
        if not self._sites and not self._knows_scenario(event):
            return  # a recorder that has not learnt the scenario yet is not ready
        if event.boots.get(self._own.member) == self._own.boot:
            if self._bound(event):
                return
            self._offered = event
            self._answer()
        elif self._own.member in event.boots and self._sites:  # of two recorders, one comes late
            raise SessionError(f"session {self._session!r} goes on with another {self._own.member}")

    def _answer(self) -> None:
        """Says ready to what is offered, once every clock is known that it will take."""
        event = self._offered
        if event is None or not self.pinger.know(self._apart(event.boots, event.clocks)):
            return
        self._offered, self._announced = None, event
        estimate = self.pinger.estimate(event.boot)
        about_ns = event.epoch_mono_ns - estimate.offset_ns
        self._epoch_ns = event.epoch_mono_ns - estimate.offset_at(about_ns)
        self._voice.say(
            "ready",
            f"{self._own.member} is ready",
            attempt=event.attempt,
            boots=event.boots,
            epoch_mono_ns=self._epoch_ns,
            clock=self._own.clock,
        )

    def _knows_scenario(self, event: Event) -> bool:
        return any(
            info.scenario and event.boots.get(name) == info.boot for name, info in self.meeting.met.items()
        )

    def _bound(self, event: Event) -> bool:
        """True where this member has said ready to another leader, who may still say start."""
        announced = self._announced
        if announced is None or announced.boot == event.boot:
            return False
        if str(announced.boot) in self.meeting.gone:
            return False
        return self._clock.monotonic_ns() < self._epoch_ns

    def _lead(self) -> Epoch | None:
        """Announces an epoch when all are there; returns it when all are ready in time."""
        now_ns, meeting = self._clock.monotonic_ns(), self.meeting
        announced = self._announced
        if announced is not None:
            decide_ns = self._epoch_ns - DECIDE_NS - self.pinger.slowest_ns()
            if now_ns >= decide_ns or announced.boots != meeting.boots() or meeting.missing():
                self._announced = None  # somebody was too late, is gone, or has come: another attempt
            elif self._ready.keys() | {self._own.member} >= set(announced.boots):
                return self._epoch(self._start(announced))
            return None
        if not meeting.missing() and self.pinger.know(self._apart(meeting.boots(), meeting.clocks())):
            self._announce(now_ns)
        return None

    def _start(self, announced: Event) -> Event:
        return self._voice.say(
            "start",
            "all are ready",
            attempt=announced.attempt,
            boots=announced.boots,
            epochs={**self._ready, self._own.member: self._epoch_ns},
        )

    def _announce(self, now_ns: int) -> None:
        boots = self.meeting.boots()
        self._ready = {}
        self._attempt += 1
        ahead_ns = EPOCH_AHEAD_NS + 2 * self.pinger.slowest_ns()
        self._epoch_ns = now_ns + ahead_ns
        self._announced = self._voice.say(
            "epoch",
            f"{', '.join(sorted(boots))}: tick 0 is {ahead_ns // 1_000_000} ms from now",
            attempt=self._attempt,
            epoch_mono_ns=self._epoch_ns,
            epoch_unix_ns=self._clock.unix_ns() + ahead_ns,
            clock=self._own.clock,
            clocks=self.meeting.clocks(),
            boots=boots,
        )

    def _epoch(self, start: Event) -> Epoch:
        """Returns the epoch that has been started."""
        assert self._announced is not None
        unix_ns = self._announced.epoch_unix_ns
        return Epoch(self._epoch_ns, unix_ns, dict(start.boots), dict(start.epochs))

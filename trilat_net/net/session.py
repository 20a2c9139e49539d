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

from ..errors import SessionError
from . import topics
from .bus import Bus
from .clock import Clock
from .membership import LATE_GATHER_NS, Epoch, EventPublisher, Membership, liveliness_token, read_events
from .messages import Event, Info
from .pinging import Pinger, answer_pings

EPOCH_AHEAD_NS = 500_000_000
"""Time from the announcement of an epoch to the epoch, without two round trips."""
DECIDE_NS = 150_000_000
"""Time before the epoch by which every reply must have arrived, without a round trip."""


class SessionJoin:
    """The way of a member, whose subscriptions are declared, into a session; call `poll` for the epoch."""

    def __init__(
        self, bus: Bus, clock: Clock, session: str, publisher: EventPublisher, sites: Sequence[str]
    ) -> None:
        self._clock, self._session, self._publisher = clock, session, publisher
        self._sites = tuple(sites)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self.membership = Membership(bus, clock, session, publisher, sites)
        self.pinger = Pinger(bus, clock, session)
        self._met_ns: int | None = None  # the first member of a running session
        answer_pings(bus, clock, session, publisher.info)
        self._offered: Event | None = None
        self._epoch_ns = 0
        self._announced: Event | None = None
        self._attempt = 0
        self._ready: dict[str, int] = {}
        bus.announce(liveliness_token(session, self._own.member, self._own.boot))

    @property
    def _own(self) -> Info:
        return self._publisher.info

    def poll(self) -> Epoch | None:
        """Takes messages and replies to them; returns the epoch once it is fixed.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        membership, now_ns = self.membership, self._clock.monotonic_ns()
        self._publisher.answer_queries()
        membership.poll(invited=self._announced is not None and not membership.leads)
        self.pinger.poll(self._other_clocks(membership.boots(), membership.clocks()))
        epoch = self._read_events()
        if epoch is None:
            self._reply_ready()
            if membership.leads:
                epoch = self._lead()
            elif not self._sites and (self._announced is None or now_ns >= self._epoch_ns):
                epoch = self._join_late(now_ns)  # not while `start` may still be under way
        return epoch

    def _join_late(self, now_ns: int) -> Epoch | None:
        """Returns a recorder's epoch of a running session once all its present members have been met."""
        infos = [
            info
            for _, info in sorted(self.membership.met.items())
            if info.running and info.scenario and info.boots.get(info.member) == info.boot
        ]
        running = [info for info in infos if info.boots == infos[0].boots]
        if not running:
            self._met_ns = None
            return None
        if self._met_ns is None:
            self._met_ns = now_ns
        sites = set(running[0].boots) - {topics.RECORDER}
        if {info.member for info in running} < sites and now_ns - self._met_ns < LATE_GATHER_NS:
            return None
        own = self.membership.own.clock
        for info in sorted(running, key=lambda info: info.clock != own):
            if info.clock == own or self.pinger.know([info.boot]):
                # as the clocks stand now: their drift apart since the epoch is unknown
                offset_ns = 0 if info.clock == own else self.pinger.estimate(info.boot).offset_at(now_ns)
                return Epoch(info.epoch_mono_ns - offset_ns, info.epoch_unix_ns, info.boots)
        return None

    def _other_clocks(self, boots: Mapping[str, int], clocks: Mapping[str, str]) -> set[int]:
        """Returns the boots of the sites on another clock."""
        return {
            boot
            for name, boot in boots.items()
            if name != topics.RECORDER and clocks.get(name) != self._own.clock
        }

    def _read_events(self) -> Epoch | None:
        """Takes events; returns the epoch of the announcement that is started."""
        for event in read_events(self._events):
            if event.boots.get(event.member) != event.boot:
                continue  # the announcement is not for its sender
            if event.kind == "epoch":
                self._consider(event)
                continue
            announced = self._announced
            if announced is None or (event.attempt, event.boots) != (announced.attempt, announced.boots):
                continue
            if event.kind == "ready":
                self._ready[event.member] = event.epoch_mono_ns
            elif (
                event.kind == "start"
                and event.boot == announced.boot
                and event.epochs.keys() == announced.boots.keys()
            ):
                return self._make_epoch(event)
        return None

    def _consider(self, event: Event) -> None:
        """Takes an announced epoch if it is the leader's and for this boot."""
        if self.membership.leads or (self._sites and event.member != self._sites[0]):
            return
        if not self._sites and not any(
            info.scenario and event.boots.get(name) == info.boot for name, info in self.membership.met.items()
        ):
            return  # a recorder that has not learnt the scenario is not ready
        if event.boots.get(self._own.member) == self._own.boot:
            if not self._is_bound(event):
                self._offered = event
                self._reply_ready()
        elif self._own.member in event.boots and self._sites:  # of two recorders, one joins late
            raise SessionError(f"session {self._session!r} goes on with another {self._own.member}")

    def _is_bound(self, event: Event) -> bool:
        """True if this member has sent `ready` to another leader, who may still send `start`."""
        announced = self._announced
        return (
            announced is not None
            and announced.boot != event.boot
            and str(announced.boot) not in self.membership.gone
            and self._clock.monotonic_ns() < self._epoch_ns
        )

    def _reply_ready(self) -> None:
        """Sends `ready` for the offered epoch once every clock that it needs is known."""
        event = self._offered
        if event is None or not self.pinger.know(self._other_clocks(event.boots, event.clocks)):
            return
        self._offered, self._announced = None, event
        estimate = self.pinger.estimate(event.boot)
        about_ns = event.epoch_mono_ns - estimate.offset_ns
        self._epoch_ns = event.epoch_mono_ns - estimate.offset_at(about_ns)
        self._publisher.publish(
            "ready",
            f"{self._own.member} is ready",
            attempt=event.attempt,
            boots=event.boots,
            epoch_mono_ns=self._epoch_ns,
            clock=self._own.clock,
        )

    def _lead(self) -> Epoch | None:
        """Announces an epoch when all are present; returns it when all are ready in time."""
        now_ns, membership, announced = self._clock.monotonic_ns(), self.membership, self._announced
        if announced is None:
            other_clocks = self._other_clocks(membership.boots(), membership.clocks())
            if not membership.missing() and self.pinger.know(other_clocks):
                self._announce(now_ns)
            return None
        decide_ns = self._epoch_ns - DECIDE_NS - self.pinger.slowest_ns()
        if now_ns >= decide_ns or announced.boots != membership.boots() or membership.missing():
            self._announced = None  # a member was too late, is gone, or has come: another attempt
        elif self._ready.keys() | {self._own.member} >= set(announced.boots):
            start = self._publisher.publish(
                "start",
                "all are ready",
                attempt=announced.attempt,
                boots=announced.boots,
                epochs={**self._ready, self._own.member: self._epoch_ns},
            )
            return self._make_epoch(start)
        return None

    def _announce(self, now_ns: int) -> None:
        boots = self.membership.boots()
        self._ready = {}
        self._attempt += 1
        ahead_ns = EPOCH_AHEAD_NS + 2 * self.pinger.slowest_ns()
        self._epoch_ns = now_ns + ahead_ns
        self._announced = self._publisher.publish(
            "epoch",
            f"{', '.join(sorted(boots))}: tick 0 is {ahead_ns // 1_000_000} ms from now",
            attempt=self._attempt,
            epoch_mono_ns=self._epoch_ns,
            epoch_unix_ns=self._clock.unix_ns() + ahead_ns,
            clock=self._own.clock,
            clocks=self.membership.clocks(),
            boots=boots,
        )

    def _make_epoch(self, start: Event) -> Epoch:
        assert self._announced is not None
        return Epoch(self._epoch_ns, self._announced.epoch_unix_ns, start.boots, start.epochs)

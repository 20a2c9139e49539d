"""The start of a session: members meet and agree on one epoch.

Invariant: one epoch for any start order. The first site of the scenario leads: once every
member has replied consistently, it announces an epoch with the boots it is for; once all have
replied `ready` in time it sends `start`, and otherwise announces another epoch. No member
starts without `start`; a late recorder learns the epoch from the running members. So does a
site that `returns`: it says `coming` with a first tick, and joins when every running site has
said `admit` in time, which they do once the start before it is gone.

The epoch is an instant of the leader's monotonic clock. A member on another clock converts it
by pings, to half a round trip, and is ready only when it knows all clocks it needs; wall clocks
decide nothing. Everything is polled, on a given `Bus` and `Clock`; nothing waits.
"""

from collections.abc import Mapping, Sequence

from ..core.ticks import first_tick_at, tick_ns
from ..errors import SessionError
from . import topics
from .bus import Bus
from .clock import Clock
from .membership import (
    Epoch,
    EventPublisher,
    LateSites,
    Membership,
    liveliness_token,
    read_messages,
)
from .messages import Event, Info
from .pinging import Pinger, answer_pings

EPOCH_AHEAD_NS = 500_000_000
"""Time from the announcement of an epoch to the epoch, without two round trips."""
DECIDE_NS = 150_000_000
"""Time before the epoch by which every reply must have arrived, without a round trip."""
LATE_GATHER_NS = 1_500_000_000
"""Time to wait for the other members of a running session after the first one is met."""


class SessionJoin:
    """The way of a member, whose subscriptions are declared, into a session; call `poll` for
    the epoch.

    Attributes:
        refusal: why a running site has not admitted this one, "" if none has said so.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        publisher: EventPublisher,
        sites: Sequence[str],
        late: LateSites = LateSites(),  # noqa: B008
    ) -> None:
        self._clock = clock
        self._session = session
        self._publisher = publisher
        self._sites = tuple(sites)
        self._late = late
        self.refusal = ""
        self._coming: tuple[Event, Epoch] | None = None
        self._admitted: set[str] = set()
        self._starts: dict[str, int] = {}  # of others that were admitted meanwhile
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self.membership = Membership(
            bus=bus, clock=clock, session=session, publisher=publisher, sites=sites, late=late
        )
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
    def reason(self) -> str:
        """Why this site has not joined a running session, "" if there is none or nobody said."""
        lacking = sorted(
            {info.member for info in self.membership.list_running()} - self._admitted
        )
        if self._coming is None or not lacking:
            return self.refusal
        return self.refusal or f"{', '.join(lacking)} did not admit it to the running session"

    @property
    def coming_at(self) -> int:
        """The first tick that this site has said last, if it comes to a running session; else
        0.
        """
        return 0 if self._coming is None else self._coming[0].ticks

    @property
    def _own(self) -> Info:
        return self._publisher.info

    def poll(self) -> Epoch | None:
        """Takes messages and replies to them; returns the epoch once it is fixed.

        Raises:
            SessionError: this member cannot be part of the session.
        """
        membership = self.membership
        now_ns = self._clock.monotonic_ns()
        self._publisher.answer_queries()
        membership.poll(
            may_have_started=self._announced is not None and not membership.is_leader
        )
        self.pinger.poll(self._other_clocks(membership.boots(), membership.clocks()))
        epoch = self._read_events()
        if epoch is None:
            self._reply_ready()
            running = membership.list_running()
            if running and (self._late.may_join_late or not self._sites):
                # else `start` may be under way
                if self._announced is None or now_ns >= self._epoch_ns:
                    epoch = self._join_late(running, now_ns)
            elif membership.is_leader:
                epoch = self._lead()
            if not running:
                self._met_ns = None
        return epoch

    def _join_late(self, running: Sequence[Info], now_ns: int) -> Epoch | None:
        """Returns the epoch of a running session once all its present members have been met.

        A site must have been admitted by all of them besides.
        """
        if self._met_ns is None:
            self._met_ns = now_ns
        found = self.membership
        sites = {
            name
            for name, boot in running[0].boots.items()
            if str(boot) not in found.gone and not found.has_restarted(name, boot)
        } - {topics.RECORDER, self._own.member}
        if {info.member for info in running} < sites and now_ns - self._met_ns < LATE_GATHER_NS:
            return None
        own = self._own.clock
        foreign = {info.boot for info in running if info.clock != own}
        if self._sites and not self.pinger.knows_clocks(foreign):
            return None
        # ticks follow the grid of the first site
        places = {name: n for n, name in enumerate(self._sites)}
        for info in sorted(
            running, key=lambda info: (info.clock != own, places.get(info.member, -1))
        ):
            if info.clock == own or self.pinger.knows_clocks([info.boot]):
                # as the clocks stand now: their drift apart since the epoch is unknown
                offset_ns = (
                    0
                    if info.clock == own
                    else self.pinger.estimate(info.boot).extrapolate_ns(now_ns)
                )
                epoch = Epoch(info.epoch_mono_ns - offset_ns, info.epoch_unix_ns, info.boots)
                if not self._sites:
                    return epoch
                grid_ns = (info.grid_ns or info.epoch_mono_ns) - offset_ns
                return self._ask_to_join(epoch._replace(mono_ns=grid_ns), running, now_ns)
        return None

    def _ask_to_join(self, epoch: Epoch, running: Sequence[Info], now_ns: int) -> Epoch | None:
        """Says `coming`, again and again; returns the epoch when every running site has
        admitted it.
        """
        own = self._own
        rate_hz = self._late.rate_hz
        slowest_ns = self.pinger.slowest_ns()
        if self._coming is not None:
            event, told = self._coming
            first_ns = told.mono_ns + tick_ns(event.ticks, rate_hz)
            if now_ns < first_ns - DECIDE_NS:
                if not self._admitted >= {info.member for info in running}:
                    return None
                epochs = {info.member: info.epoch_mono_ns for info in running} | {
                    own.member: told.mono_ns
                }
                boots = {**running[0].boots, **self._starts, own.member: own.boot}
                return told._replace(
                    boots=boots, epochs=epochs, first=event.ticks, coming=event
                )
        since_ns = now_ns - epoch.mono_ns
        first = first_tick_at(since_ns + EPOCH_AHEAD_NS + 2 * slowest_ns, rate_hz)
        self._attempt += 1
        self._admitted = set()
        event = self._publisher.publish(
            "coming",
            f"{own.member} comes to the running session, from tick {first} on",
            t_ns=since_ns,
            ticks=first,
            attempt=self._attempt,
            epoch_mono_ns=epoch.mono_ns,
            clock=own.clock,
            bound_ns=slowest_ns,
            boots={own.member: own.boot},
        )
        self._coming = event, epoch
        return None

    def _other_clocks(self, boots: Mapping[str, int], clocks: Mapping[str, str]) -> set[int]:
        return {
            boot
            for name, boot in boots.items()
            if name != topics.RECORDER and clocks.get(name) != self._own.clock
        }

    def _read_events(self) -> Epoch | None:
        """Takes events; returns the epoch of the announcement that is started."""
        for event in read_messages(self._events, Event):
            if event.boots.get(event.member) != event.boot:
                continue  # the announcement is not for its sender
            if event.kind == "epoch":
                self._consider(event)
                continue
            if event.kind == "admit" and event.about in event.boots:
                self._starts[event.about] = event.boots[event.about]
            own = self._own
            to_own = event.about == own.member and event.boots.get(own.member) == own.boot
            # a running site admits this one, or says why not
            if self._coming is not None and to_own:
                if event.kind == "refused":
                    self.refusal = event.text
                elif event.kind == "admit" and event.attempt == self._attempt:
                    self._admitted.add(event.member)
            announced = self._announced
            if announced is None or (event.attempt, event.boots) != (
                announced.attempt,
                announced.boots,
            ):
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
        if self.membership.is_leader or (self._sites and event.member != self._sites[0]):
            return
        if not self._sites and not any(
            info.scenario and event.boots.get(name) == info.boot
            for name, info in self.membership.others.items()
        ):
            return  # a recorder that has not learnt the scenario is not ready
        if event.boots.get(self._own.member) == self._own.boot:
            if not self._is_bound(event):
                self._offered = event
                self._reply_ready()
        # of two recorders, one joins late
        elif self._own.member in event.boots and self._sites:
            raise SessionError(
                f"session {self._session!r} goes on with another {self._own.member}"
            )

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
        event = self._offered
        if event is None or not self.pinger.knows_clocks(
            self._other_clocks(event.boots, event.clocks)
        ):
            return
        self._offered = None
        self._announced = event
        estimate = self.pinger.estimate(event.boot)
        about_ns = event.epoch_mono_ns - estimate.offset_ns
        self._epoch_ns = event.epoch_mono_ns - estimate.extrapolate_ns(about_ns)
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
        now_ns = self._clock.monotonic_ns()
        membership = self.membership
        announced = self._announced
        if announced is None:
            other_clocks = self._other_clocks(membership.boots(), membership.clocks())
            if not membership.list_missing() and self.pinger.knows_clocks(other_clocks):
                self._announce(now_ns)
            return None
        decide_ns = self._epoch_ns - DECIDE_NS - self.pinger.slowest_ns()
        if (
            now_ns >= decide_ns
            or announced.boots != membership.boots()
            or membership.list_missing()
        ):
            self._announced = (
                None  # a member was too late, is gone, or has come: another attempt
            )
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

"""The start of a session: the members connect and agree on one epoch, the instant of tick 0.

The first site of the scenario is the leader. Once every member has replied consistently, the
leader publishes the event `epoch`, which names an epoch and the boots of the members. Each
member replies `ready`. If all replies arrive in time, the leader publishes `start`; otherwise
the leader announces another epoch.

A recorder that joins late learns the epoch from the running members. So does a site that may
join late: it publishes `coming` with its first tick, and joins when every running site has
published `admit` in time. The running sites do so once the site's earlier start is gone.

The epoch is an instant of the leader's monotonic clock. A member on another clock converts the
instant by pings, to half a round trip. It is ready only when it knows all clocks that it needs.

Invariant:
    - The members agree on one epoch, whatever the order in which they start.
    - No member starts without `start` or, if it joins late, without a running member.
    - Wall clocks decide nothing.
    - Everything is polled; nothing waits.
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
"""Time from the announcement of an epoch to the epoch, besides two round trips, in ns."""
DECIDE_NS = 150_000_000
"""Time before the epoch at which all replies must be there, besides a round trip, in ns."""
LATE_GATHER_NS = 1_500_000_000
"""Time to wait for further members of a running session after the first one, in ns."""


class SessionJoin:
    """The joining of a session by one member; call `poll` regularly until it returns the epoch.

    The member must have declared its subscriptions before.

    Args:
        bus: connection of this member.
        clock: clock of this member.
        session: name of the session.
        publisher: publishes the events of this member.
        sites: sites of the scenario, the leader first; empty for a recorder.
        late: rules for sites that join late.

    Attributes:
        refusal: why a running site has refused this one; "" if no site has refused it.
        membership: the other members.
        pinger: estimates of the members' clocks.
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
        self._coming: tuple[Event, Epoch] | None = None  # the last `coming`, and its epoch
        self._admitted_by: set[str] = set()
        self._admitted_boots: dict[str, int] = {}  # boots of others that joined meanwhile
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)
        self.membership = Membership(
            bus=bus, clock=clock, session=session, publisher=publisher, sites=sites, late=late
        )
        self.pinger = Pinger(bus, clock, session)
        self._found_running_ns: int | None = None  # when a running session was found
        answer_pings(bus, clock, session, publisher.info)
        self._offered: Event | None = None
        self._epoch_ns = 0
        self._announced: Event | None = None
        self._attempt = 0
        self._ready_epochs: dict[str, int] = {}  # the epoch on each ready member's clock
        bus.announce(liveliness_token(session, self._info.member, self._info.boot))

    @property
    def reason(self) -> str:
        """Why this site has not joined a running session; "" if the reason is not known."""
        running = {info.member for info in self.membership.list_running()}
        missing = sorted(running - self._admitted_by)
        if self.refusal or self._coming is None or not missing:
            return self.refusal
        return f"{', '.join(missing)} did not admit it to the running session"

    @property
    def announced_first_tick(self) -> int:
        """The first tick that this site has announced to a running session; else 0."""
        return 0 if self._coming is None else self._coming[0].ticks

    @property
    def _info(self) -> Info:
        return self._publisher.info

    def poll(self) -> Epoch | None:
        """Receives messages and replies to them; returns the epoch once it is fixed.

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
                # Before an announced epoch, `start` may still be under way.
                if self._announced is None or now_ns >= self._epoch_ns:
                    epoch = self._join_late(running, now_ns)
            elif membership.is_leader:
                epoch = self._lead()
            if not running:
                self._found_running_ns = None
        return epoch

    def _join_late(self, running: Sequence[Info], now_ns: int) -> Epoch | None:
        """Returns the epoch of a running session once this member may join the session.

        All present members must be known, and must have admitted this member if it is a site.
        """
        if self._found_running_ns is None:
            self._found_running_ns = now_ns
        if self._awaits_sites(running) and (now_ns - self._found_running_ns < LATE_GATHER_NS):
            return None
        local_clock = self._info.clock
        foreign_boots = {info.boot for info in running if info.clock != local_clock}
        if self._sites and not self.pinger.knows_clocks(foreign_boots):
            return None
        source = self._select_epoch_source(running)
        if source is None:
            return None
        # The offset at present counts: the clocks' drift apart since the epoch is unknown.
        offset_ns = 0
        if source.clock != local_clock:
            offset_ns = self.pinger.estimate(source.boot).extrapolate_ns(now_ns)
        epoch = Epoch(source.epoch_mono_ns - offset_ns, source.epoch_unix_ns, source.boots)
        if not self._sites:
            return epoch
        grid_ns = (source.grid_ns or source.epoch_mono_ns) - offset_ns
        return self._request_admission(epoch._replace(mono_ns=grid_ns), running, now_ns)

    def _awaits_sites(self, running: Sequence[Info]) -> bool:
        """True if a site of the running session is present and not known to run yet."""
        membership = self.membership
        sites = {
            name
            for name, boot in running[0].boots.items()
            if str(boot) not in membership.gone and not membership.has_restarted(name, boot)
        }
        sites -= {topics.RECORDER, self._info.member}
        return {info.member for info in running} < sites

    def _select_epoch_source(self, running: Sequence[Info]) -> Info | None:
        """Returns the running site that states the epoch, or None if no clock is known.

        A site on this member's clock is best, because its epoch needs no conversion; else the
        first site of the scenario, whose schedule the others follow.
        """
        local_clock = self._info.clock
        indices = {name: index for index, name in enumerate(self._sites)}

        def preference(info: Info) -> tuple[bool, int]:
            return info.clock != local_clock, indices.get(info.member, -1)

        for info in sorted(running, key=preference):
            if info.clock == local_clock or self.pinger.knows_clocks([info.boot]):
                return info
        return None

    def _request_admission(
        self, epoch: Epoch, running: Sequence[Info], now_ns: int
    ) -> Epoch | None:
        """Publishes `coming`, repeatedly; returns the epoch once every running site admits."""
        info = self._info
        rate_hz = self._late.rate_hz
        slowest_ns = self.pinger.slowest_ns()
        if self._coming is not None:
            coming, announced_epoch = self._coming
            first_ns = announced_epoch.mono_ns + tick_ns(coming.ticks, rate_hz)
            if now_ns < first_ns - DECIDE_NS:
                if not self._admitted_by >= {site.member for site in running}:
                    return None
                epochs = {site.member: site.epoch_mono_ns for site in running}
                return announced_epoch._replace(
                    boots={
                        **running[0].boots,
                        **self._admitted_boots,
                        info.member: info.boot,
                    },
                    epochs=epochs | {info.member: announced_epoch.mono_ns},
                    first=coming.ticks,
                    coming=coming,
                )
        since_ns = now_ns - epoch.mono_ns
        first = first_tick_at(since_ns + EPOCH_AHEAD_NS + 2 * slowest_ns, rate_hz)
        self._attempt += 1
        self._admitted_by = set()
        coming = self._publisher.publish(
            "coming",
            f"{info.member} comes to the running session, from tick {first} on",
            t_ns=since_ns,
            ticks=first,
            attempt=self._attempt,
            epoch_mono_ns=epoch.mono_ns,
            clock=info.clock,
            bound_ns=slowest_ns,
            boots={info.member: info.boot},
        )
        self._coming = coming, epoch
        return None

    def _other_clocks(self, boots: Mapping[str, int], clocks: Mapping[str, str]) -> set[int]:
        """Returns the boots of the sites whose clock is not this member's clock."""
        return {
            boot
            for name, boot in boots.items()
            if name != topics.RECORDER and clocks.get(name) != self._info.clock
        }

    def _read_events(self) -> Epoch | None:
        """Receives events; returns the epoch once its announcement is followed by `start`."""
        for event in read_messages(self._events, Event):
            if event.boots.get(event.member) != event.boot:
                continue  # the announcement does not include its sender
            if event.kind == "epoch":
                self._receive_announcement(event)
                continue
            self._receive_admission(event)
            announced = self._announced
            if announced is None:
                continue
            if event.attempt != announced.attempt or event.boots != announced.boots:
                continue
            if event.kind == "ready":
                self._ready_epochs[event.member] = event.epoch_mono_ns
            elif (
                event.kind == "start"
                and event.boot == announced.boot
                and event.epochs.keys() == announced.boots.keys()
            ):
                return self._make_epoch(event)
        return None

    def _receive_admission(self, event: Event) -> None:
        """Notes which running sites admit or refuse this site, and whom they admit besides."""
        if event.kind == "admit" and event.about in event.boots:
            self._admitted_boots[event.about] = event.boots[event.about]
        info = self._info
        is_about_local = (
            event.about == info.member and event.boots.get(info.member) == info.boot
        )
        if self._coming is None or not is_about_local:
            return
        if event.kind == "refused":
            self.refusal = event.text
        elif event.kind == "admit" and event.attempt == self._attempt:
            self._admitted_by.add(event.member)

    def _receive_announcement(self, event: Event) -> None:
        """Receives the announcement of an epoch, and replies `ready` if it is for this member.

        Raises:
            SessionError: the announcement is for another start of this site.
        """
        if self.membership.is_leader or (self._sites and event.member != self._sites[0]):
            return
        knows_scenario = self._sites or any(
            info.scenario and event.boots.get(name) == info.boot
            for name, info in self.membership.others.items()
        )
        if not knows_scenario:
            return  # a recorder that has not learnt the scenario is not ready
        if event.boots.get(self._info.member) == self._info.boot:
            if not self._is_bound(event):
                self._offered = event
                self._reply_ready()
        # Not for recorders: of two recorders, one joins late.
        elif self._info.member in event.boots and self._sites:
            raise SessionError(
                f"session {self._session!r} goes on with another {self._info.member}"
            )

    def _is_bound(self, event: Event) -> bool:
        """True if this member is `ready` for another leader, who may still send `start`."""
        announced = self._announced
        return (
            announced is not None
            and announced.boot != event.boot
            and str(announced.boot) not in self.membership.gone
            and self._clock.monotonic_ns() < self._epoch_ns
        )

    def _reply_ready(self) -> None:
        """Replies `ready` to an announcement once all clocks that it needs are known."""
        event = self._offered
        if event is None:
            return
        if not self.pinger.knows_clocks(self._other_clocks(event.boots, event.clocks)):
            return
        self._offered = None
        self._announced = event
        estimate = self.pinger.estimate(event.boot)
        # The offset is needed at the epoch, whose local instant is known roughly at first.
        rough_epoch_ns = event.epoch_mono_ns - estimate.offset_ns
        self._epoch_ns = event.epoch_mono_ns - estimate.extrapolate_ns(rough_epoch_ns)
        self._publisher.publish(
            "ready",
            f"{self._info.member} is ready",
            attempt=event.attempt,
            boots=event.boots,
            epoch_mono_ns=self._epoch_ns,
            clock=self._info.clock,
        )

    def _lead(self) -> Epoch | None:
        """Announces an epoch once all members are present; returns it once all are ready."""
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
            # A member was too late, is gone, or has joined: another attempt follows.
            self._announced = None
        elif self._ready_epochs.keys() | {self._info.member} >= set(announced.boots):
            start = self._publisher.publish(
                "start",
                "all are ready",
                attempt=announced.attempt,
                boots=announced.boots,
                epochs={**self._ready_epochs, self._info.member: self._epoch_ns},
            )
            return self._make_epoch(start)
        return None

    def _announce(self, now_ns: int) -> None:
        """Publishes the announcement of an epoch."""
        boots = self.membership.boots()
        self._ready_epochs = {}
        self._attempt += 1
        ahead_ns = EPOCH_AHEAD_NS + 2 * self.pinger.slowest_ns()
        self._epoch_ns = now_ns + ahead_ns
        self._announced = self._publisher.publish(
            "epoch",
            f"{', '.join(sorted(boots))}: tick 0 is {ahead_ns // 1_000_000} ms from now",
            attempt=self._attempt,
            epoch_mono_ns=self._epoch_ns,
            epoch_unix_ns=self._clock.unix_ns() + ahead_ns,
            clock=self._info.clock,
            clocks=self.membership.clocks(),
            boots=boots,
        )

    def _make_epoch(self, start: Event) -> Epoch:
        assert self._announced is not None
        return Epoch(
            mono_ns=self._epoch_ns,
            unix_ns=self._announced.epoch_unix_ns,
            boots=start.boots,
            epochs=start.epochs,
        )

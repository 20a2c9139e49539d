"""The present state of a running session, as an observer knows it from its messages.

The pages of a session and `trilat watch` show this state. An observer receives the same
messages as the recorder, and sends nothing to the sites except requests for missing messages.

Invariant:
    - The observer receives every record. It requests missing records from the buffers of the
      sites, as a recorder does, so that the energies equal those of the log. Pages show fewer
      records, always the newest.
    - An observer that joins late does not request earlier records. It requests all events,
      because they contain the changes.
    - A site has ended if its `end` event says so, never because it is silent. On a busy machine
      a running site may be silent for long, and its records are used when they arrive.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Generic, TypeVar

import msgspec

from recorder.backfill import GapRepair
from recorder.site_reception import InboundMessage, InboundQueue, SiteReception
from trilat_net.analysis.certificate.running_energy import (
    KEPT_S,
    EnergyCourse,
    RecordWindow,
    RunningEnergy,
)
from trilat_net.core.live_hand import TAKEN
from trilat_net.core.ticks import NS_PER_S, LifeAlarm, find_alarm
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.membership import MemberQuery
from trilat_net.net.messages import Event, Info, LinkStats, State
from trilat_net.net.wire import decode, split_states
from trilat_net.scenario import Scenario, parse_core_change, parse_embedded
from trilat_net.scenario.run_changes import LinkTables, find_requester
from trilat_net.scenario.sample_uses import PictureDelay

LATE_S = 3.0
"""An observer has joined late if the first record that it receives is of a later time, in s."""
MIN_SILENCE_NS = 2 * NS_PER_S
"""Silence after which a running site is reported as silent, in ns."""
EVENTS_KEPT = 400
"""Number of events that are kept for new pages."""

T = TypeVar("T")


class Tail(Generic[T]):
    """The last entries of a growing sequence, for readers that know only a part of it.

    Args:
        most: the largest number of entries that are kept.

    Attributes:
        count: the number of entries that have been added.
    """

    def __init__(self, most: int) -> None:
        self._entries: deque[T] = deque(maxlen=most)
        self.count = 0

    def add(self, entry: T) -> None:
        """Adds an entry."""
        self._entries.append(entry)
        self.count += 1

    def since(self, count: int, most: int) -> list[T]:
        """Returns the entries after the first `count`, at most the newest `most`."""
        size = len(self._entries)
        new_count = min(self.count - count, most, size)
        return [self._entries[index] for index in range(size - new_count, size)]


class SiteView:
    """One running site: its reception, its newest record and its statistics.

    Attributes:
        glides: whether the site follows the rule `glide`.
        peers: the names of its peers.
        layout: the layout of its records, if it continues without a lost peer, else None.
        hand: its live hand, if people can hold its arm.
        reception: which of its messages have arrived.
        window: its latest records.
        holder: the person or program that took hold of its arm last.
        stopped_by: the person or program that ordered its last stop, as its events say.
        bodies: poses of its plant's bodies by tick, as far back as the window reaches.
        dropped: counts dropped messages by reason.
        repair: requests its missing messages.
        record: its newest record; None before the first.
        stats: its newest statistics; None before the first.
        first_tick: the tick of the first record, if the observer has joined late; else 0.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        scenario: Scenario,
        name: str,
        boot: int,
        window: RecordWindow,
    ) -> None:
        rule = scenario.sites[name].on_stale
        self.glides = rule.action == "glide"
        self.peers = scenario.peers(name)
        self.layout = scenario.layout(name) if rule.rule.degrades else None
        self.hand = scenario.sites[name].find_live_hand(is_open=True)
        self.reception = SiteReception(scenario, name, boot)
        self.window = window
        self.holder = ""
        self.stopped_by = ""
        self.bodies: dict[int, list[float]] = {}
        self.dropped: Counter[str] = Counter()
        self.repair = GapRepair(bus, session, self.reception, self.dropped)
        self.record: State | None = None
        self.stats: LinkStats | None = None
        self.first_tick = 0

    def find_alarm(self, session: str, name: str) -> LifeAlarm | None:
        """Returns the alarm of the site; None if there is none.

        Args:
            session: the session's name.
            name: the site's name.
        """
        record = self.record
        if record is None or not self.glides or self.ended:
            return None
        lost: Sequence[str] = ()
        if self.layout is not None:
            lost = self.layout.list_lost_peers(record.mem, self.peers)
        alarm = find_alarm(
            session=session,
            site=name,
            mode=record.mode,
            mem=record.mem,
            shared=len(record.q_des),
            lost=lost,
        )
        if alarm is not None and alarm.order == "enable" and self.stopped_by:
            return alarm._replace(reason=f"ordered by {self.stopped_by}")
        return alarm

    @property
    def ended(self) -> bool:
        """True once the site has published its end."""
        return self.reception.final_ticks is not None

    @property
    def complete(self) -> int:
        """The last tick up to which no record can arrive any more; -1 before the first.

        All records up to that tick have arrived or are lost.
        """
        account = self.reception.accounts[topics.STATE]
        gap = account.find_requestable_gap()
        if gap is None:
            return account.last
        first_missing, _ = gap
        return first_missing - 1


class SessionView:
    """A session as an observer knows it; `poll` receives the messages that have arrived.

    Args:
        bus: a bus that reaches the session.
        clock: the clock of this process.
        session: the session's name.

    Attributes:
        scenario: the scenario of the session; None until a member has sent it.
        sites: the running sites by name; {} until all of them run.
        members: the identities of the members that have replied.
        links: the present settings of every link, as tables.
        dominance: the dominance matrix that was requested last, by site.
        energy: the running energy; None until all sites run.
        events: the events, oldest first.
        dropped: counts dropped messages by reason.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str) -> None:
        self.session = session
        self.bus = bus
        self._clock = clock
        self.scenario: Scenario | None = None
        self.sites: dict[str, SiteView] = {}
        self.members: dict[str, Info] = {}
        self.links = LinkTables({}, ())
        self.dominance: dict[str, dict[str, float]] = {}
        self.energy: RunningEnergy | None = None
        self.events: Tail[Event] = Tail(EVENTS_KEPT)
        self.dropped: Counter[str] = Counter()
        self._finished = False
        self._pictures: dict[str, PictureDelay] = {}
        self._applied_changes: set[tuple[str, str]] = set()
        self._query = MemberQuery(bus, clock, session)
        self._queue = InboundQueue(clock)
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            bus.tap(topics.key(session, "*", channel), self._queue.receive)

    @property
    def running(self) -> bool:
        """True once every site runs."""
        return bool(self.sites)

    @property
    def ended(self) -> bool:
        """True once every site has published its end, or `finish` was called."""
        if not self.running:
            return False
        return self._finished or all(site.ended for site in self.sites.values())

    def finish(self) -> None:
        """Marks the session as ended; called by the process that has seen all sites end."""
        self._finished = True

    def silence_s(self, site: SiteView) -> float:
        """Returns for how long a running site has been silent, in s.

        A silence shorter than `MIN_SILENCE_NS` is reported as 0.0, as is that of a site that
        has ended.
        """
        received_ns = site.reception.last_received_ns
        if received_ns is None or site.ended:
            return 0.0
        silence_ns = self._clock.monotonic_ns() - received_ns
        return silence_ns / NS_PER_S if silence_ns >= MIN_SILENCE_NS else 0.0

    @property
    def session_silence_s(self) -> float:
        """For how long all running sites have been silent, in s."""
        running = [site for site in self.sites.values() if not site.ended]
        return min((self.silence_s(site) for site in running), default=0.0)

    def poll(self) -> None:
        """Receives the messages that have arrived, and requests missing messages."""
        now_ns = self._clock.monotonic_ns()
        if not self.running:
            self._connect_to_sites()
        if not self.running:
            return
        for message in self._queue.drain(now_ns):
            try:
                self._receive(message)
            except WireError as error:
                self.dropped[error.reason] += 1
        for name, site in self.sites.items():
            # Silent sites are queried too: the missing message may be their `end` event.
            repaired = site.repair.poll(now_ns, alive=not site.ended)
            for channel, reply, _ in repaired:
                self._store(name, site, channel, reply.content)
        records = [site.record for site in self.sites.values()]
        times_ns = [record.t_ns for record in records if record is not None]
        self.links.advance_to(max(times_ns, default=0))

    def advance_energy(self) -> EnergyCourse | None:
        """Returns V at the ticks completed since the last call; None if there are none."""
        if self.energy is None:
            return None
        complete = {name: site.complete for name, site in self.sites.items()}
        return self.energy.compute_next(complete)

    def find_peer_ticks(
        self, site: str, tick: int, used: Mapping[str, int]
    ) -> Mapping[str, int]:
        """Returns the tick at which a site's user sees each peer.

        That is the tick of the sample in use or, if the scenario delays the picture further,
        of an earlier sample.

        Args:
            site: the site of the user.
            tick: the tick of the site's record.
            used: the ticks of the samples in use at that tick, by peer.
        """
        assert self.scenario is not None
        if site not in self._pictures:
            self._pictures[site] = PictureDelay(self.scenario, site)
        peer_ticks: dict[str, int] = {}
        for peer, peer_tick in self._pictures[site].advance_to(tick, used).items():
            peer_ticks[peer] = min(peer_tick, self.sites[peer].window.newest)
        return peer_ticks

    def _connect_to_sites(self) -> None:
        """Reads the replies of members; creates the sites once all of them run."""
        for info in self._query.poll():
            self.members[info.member] = info
            if self.scenario is None and info.scenario:
                try:
                    self.scenario = parse_embedded(info.scenario, info.member)
                except ScenarioError:
                    self.dropped["another scenario"] += 1
        if self.scenario is None:
            return
        infos = [self.members[name] for name in self.scenario.names if name in self.members]
        have_all_replied = len(infos) == len(self.scenario.names)
        if have_all_replied and all(info.running for info in infos):
            self._create_sites(self.scenario)

    def _create_sites(self, scenario: Scenario) -> None:
        """Creates the views of all sites, which have replied and run."""
        windows = {name: RecordWindow(scenario, name) for name in scenario.names}
        self.links = LinkTables(scenario.links, scenario.timeline)
        self.dominance = {site: dict(scenario.dominance[site]) for site in scenario.names}
        self.energy = RunningEnergy(scenario, windows)
        for name in scenario.names:
            self.sites[name] = SiteView(
                bus=self.bus,
                session=self.session,
                scenario=scenario,
                name=name,
                boot=self.members[name].boot,
                window=windows[name],
            )

    def _receive(self, inbound: InboundMessage) -> None:
        """Reads a message of a site, and stores its contents.

        A message of a member that is not a site, such as the recorder, is ignored.

        Raises:
            WireError: the message cannot be read.
        """
        parts = topics.parse_key(inbound.key)
        site = None if parts is None else self.sites.get(parts.member)
        if parts is None or site is None:
            return
        channel = parts.channel
        # A message on the channel of records contains a block of records.
        is_block = channel == topics.STATE
        payloads = split_states(inbound.payload) if is_block else (inbound.payload,)
        for payload in payloads:
            try:
                message = site.reception.read(channel, payload)
            except WireError:
                # A site that has been started again announces its new boot with an event.
                if channel != topics.EVENT:
                    raise
                if not self._accept_new_boot(parts.member, payload):
                    raise
                message = site.reception.read(channel, payload)
            is_first = site.record is None and site.stats is None
            if is_first and channel != topics.EVENT:
                self._skip_records_before(site, message.content)
            if site.reception.accept(channel, message, inbound.mono_ns):
                self._store(parts.member, site, channel, message.content)

    def _accept_new_boot(self, name: str, payload: bytes) -> bool:
        """Follows another boot of a site if the event is a join; otherwise returns False."""
        event = decode(payload, Event)
        site = self.sites[name]
        is_join = event.kind == "join" and event.member == name
        if not is_join or event.boots.get(name) != event.boot:
            return False
        if self.scenario is None or not self.scenario.sites_may_return:
            return False
        site.reception = SiteReception(self.scenario, name, event.boot, site.reception)
        site.repair = GapRepair(self.bus, self.session, site.reception, site.dropped)
        return True

    def _skip_records_before(self, site: SiteView, content: State | LinkStats | Event) -> None:
        """Ignores the records before the first message, if the observer has joined late.

        All events of the site are still requested.
        """
        tick = content.tick if isinstance(content, State | LinkStats) else 0
        if tick / site.window.rate_hz < LATE_S:
            return
        site.first_tick = tick
        for channel in (topics.STATE, topics.LINK):
            site.reception.accounts[channel].abandon_below(tick)
        site.repair.probe()

    def _store(
        self, name: str, site: SiteView, channel: str, content: State | LinkStats | Event
    ) -> None:
        """Stores the contents of a message, and applies the changes in it."""
        if isinstance(content, State):
            self._store_record(name, site, content)
        elif isinstance(content, LinkStats):
            site.stats = content
        elif channel == topics.EVENT:
            self._store_event(name, site, content)

    def _store_record(self, name: str, site: SiteView, record: State) -> None:
        """Stores a record, and applies the changes in it."""
        if site.record is None or record.tick > site.record.tick:
            site.record = record
        site.window.receive(record)
        if record.bodies:
            site.bodies[record.tick] = record.bodies
            while len(site.bodies) > KEPT_S * site.window.rate_hz:
                oldest_tick = next(iter(site.bodies))
                del site.bodies[oldest_tick]
        for change in record.cmd:
            self._apply_change(name, change)

    def _store_event(self, name: str, site: SiteView, event: Event) -> None:
        """Stores an event, and reads who holds the arm or has stopped it."""
        self.events.add(event)
        if event.kind == "hand":
            holder, separator, _ = event.text.partition(f" {TAKEN} ")
            if separator:
                site.holder = holder.removeprefix(f"{name}: ")
        if event.kind == "change":
            site.stopped_by = find_requester(event.text) or site.stopped_by
            if event.command:
                self._apply_change(name, event.command)

    def _apply_change(self, site: str, text: str) -> None:
        """Applies a change to links, shares and the energy.

        A change is in a record and in an event of its site, and is applied once.
        """
        if self.scenario is None or self.energy is None:
            return
        if (site, text) in self._applied_changes:
            return
        self._applied_changes.add((site, text))
        try:
            change = parse_core_change(self.scenario, site, text)
        except ScenarioError:
            self.dropped["no change"] += 1
            return
        self.energy.add_changes(site, [change])
        table = msgspec.json.decode(text)
        if "link" in table:
            self.links[table["link"]] = table["to"]
        elif "dominance" in table:
            self.dominance[site] = table["to"]

"""The present state of a session, by the messages of its sites as they arrive.

Invariant:
    - Every record counts. Missing records are requested as a recorder requests them, from the
      same buffers, so that energies equal those of the log. A page is shown fewer records, and
      always the newest.
    - A view that starts late does not request earlier records. It requests all events, because
      they hold the changes.
    - A site has ended if its `end` event says so, never because it is silent: on a busy machine
      a running site may be silent for long, and its records are used when they arrive.
"""

from collections import Counter, deque
from collections.abc import Mapping
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
"""A view has joined late if the first record of a site that it sees is of a later time."""
MIN_SILENCE_NS = 2 * NS_PER_S
"""Silence after which a running site is shown as silent."""
EVENTS_KEPT = 400

T = TypeVar("T")


class Tail(Generic[T]):
    """The last entries of an endless sequence, for readers that come at any time.

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
        new = min(self.count - count, most, size)
        return [self._entries[n] for n in range(size - new, size)]


class SiteView:
    """One running site: its reception, its newest record and its statistics.

    Attributes:
        glides: whether the site follows the rule `glide`.
        peers: the names of its peers.
        layout: the layout of its records, if it continues without a lost peer, else None.
        hand: its live hand, if people can hold its arm.
        reception: which of its messages have arrived.
        window: its latest records.
        holder: who took hold of its arm last.
        stopped_by: who ordered its last stop, as its events say.
        bodies: poses of its plant's bodies by tick, as far back as the window reaches.
        dropped: counts dropped messages by reason.
        repair: requests its missing messages.
        record: its newest record; None before the first.
        stats: its newest statistics; None before the first.
        holds_from: the first tick that the view has seen.
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
        self.holds_from = 0

    def find_alarm(self, session: str, name: str) -> LifeAlarm | None:
        """Returns the alarm of the site; None if there is none.

        Args:
            session: the session's name.
            name: the site's name.
        """
        record = self.record
        if record is None or not self.glides or self.ended:
            return None
        lost = (
            self.layout.list_lost_peers(record.mem, self.peers)
            if self.layout is not None
            else ()
        )
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
        return account.last if gap is None else gap[0] - 1


class SessionView:
    """A session as an observer sees it; `poll` receives what has arrived.

    Args:
        bus: a bus that reaches the session.
        clock: the clock of this process.
        session: the session's name.

    Attributes:
        scenario: the scenario of the session; None until a member has sent it.
        sites: the running sites by name; {} until all of them run.
        met: the identities of the members that have replied.
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
        self.met: dict[str, Info] = {}
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
        return self.running and (
            self._finished or all(site.ended for site in self.sites.values())
        )

    def finish(self) -> None:
        """Marks the session as ended; called by the process that has seen all sites end."""
        self._finished = True

    def silence_s(self, site: SiteView) -> float:
        """Returns for how long a running site has been silent, s.

        It is 0.0 below `MIN_SILENCE_NS`, and once the site has ended.
        """
        heard_ns = site.reception.last_received_ns
        if heard_ns is None or site.ended:
            return 0.0
        silence_ns = self._clock.monotonic_ns() - heard_ns
        return silence_ns / NS_PER_S if silence_ns >= MIN_SILENCE_NS else 0.0

    @property
    def session_silence_s(self) -> float:
        """For how long all running sites have been silent, s; 0.0 while one is heard."""
        running = [site for site in self.sites.values() if not site.ended]
        return min((self.silence_s(site) for site in running), default=0.0)

    def poll(self) -> None:
        """Receives what has arrived, and requests missing messages."""
        now_ns = self._clock.monotonic_ns()
        if not self.running:
            self._connect_to_sites()
        if not self.running:
            return
        for arrived in self._queue.drain(now_ns):
            try:
                self._receive(arrived)
            except WireError as error:
                self.dropped[error.reason] += 1
        for name, site in self.sites.items():
            # Silent sites are queried too: the missing message may be their `end` event.
            for channel, message, _ in site.repair.poll(now_ns, alive=not site.ended):
                self._store(name, site, channel, message.content)
        newest_ns = max(
            (site.record.t_ns for site in self.sites.values() if site.record), default=0
        )
        self.links.advance_to(newest_ns)

    def advance_energy(self) -> EnergyCourse | None:
        """Returns V at the ticks completed since the last call; None if there are none."""
        complete = {name: site.complete for name, site in self.sites.items()}
        return None if self.energy is None else self.energy.compute_next(complete)

    def find_shown(self, site: str, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns the tick of each peer that a site's user is shown.

        Args:
            site: the site of the user.
            tick: the tick of the site's record.
            used: the ticks of the samples in use at that tick, by peer.
        """
        assert self.scenario is not None
        if site not in self._pictures:
            self._pictures[site] = PictureDelay(self.scenario, site)
        shown = self._pictures[site].advance_to(tick, used)
        return {peer: min(last, self.sites[peer].window.newest) for peer, last in shown.items()}

    def _connect_to_sites(self) -> None:
        """Reads the replies of members; creates the sites once all of them run."""
        for info in self._query.poll():
            self.met[info.member] = info
            if self.scenario is None and info.scenario:
                try:
                    self.scenario = parse_embedded(info.scenario, info.member)
                except ScenarioError:
                    self.dropped["another scenario"] += 1
        if self.scenario is None:
            return
        names = self.scenario.names
        boots = {name: self.met[name].boot for name in names if name in self.met}
        if len(boots) == len(names) and all(self.met[name].running for name in boots):
            self._create_sites(self.scenario, boots)

    def _create_sites(self, scenario: Scenario, boots: dict[str, int]) -> None:
        windows = {name: RecordWindow(scenario, name) for name in scenario.names}
        self.links = LinkTables(scenario.links, scenario.timeline)
        self.dominance = {site: dict(scenario.dominance[site]) for site in scenario.names}
        self.energy = RunningEnergy(scenario, windows)
        self.sites = {
            name: SiteView(
                bus=self.bus,
                session=self.session,
                scenario=scenario,
                name=name,
                boot=boots[name],
                window=windows[name],
            )
            for name in scenario.names
        }

    def _receive(self, arrived: InboundMessage) -> None:
        """Reads a message of a site, and stores its contents.

        Raises:
            WireError: the message cannot be read.
        """
        parts = topics.parse_key(arrived.key)
        if parts is None or (site := self.sites.get(parts.member)) is None:
            return  # a message of the recorder
        is_block = parts.channel == topics.STATE
        payloads = split_states(arrived.payload) if is_block else (arrived.payload,)
        for payload in payloads:
            try:
                message = site.reception.read(parts.channel, payload)
            except WireError:
                if parts.channel != topics.EVENT:
                    raise
                if not self._accept_new_boot(parts.member, payload):
                    raise
                message = site.reception.read(parts.channel, payload)
            has_nothing = site.record is None and site.stats is None
            if has_nothing and parts.channel != topics.EVENT:
                self._skip_records_before(site, message.content)
            if site.reception.accept(parts.channel, message, arrived.mono_ns):
                self._store(parts.member, site, parts.channel, message.content)

    def _accept_new_boot(self, name: str, payload: bytes) -> bool:
        """Follows another boot of a site if its event is a join; otherwise returns False."""
        event = decode(payload, Event)
        site = self.sites[name]
        joins = (
            event.kind == "join"
            and event.member == name
            and event.boots.get(name) == event.boot
        )
        if not joins or self.scenario is None or not self.scenario.sites_may_return:
            return False
        site.reception = SiteReception(self.scenario, name, event.boot, site.reception)
        site.repair = GapRepair(self.bus, self.session, site.reception, site.dropped)
        return True

    def _skip_records_before(self, site: SiteView, content: State | LinkStats | Event) -> None:
        """Requests no records from before a late first message, but all events of its site."""
        tick = content.tick if isinstance(content, State | LinkStats) else 0
        if tick / site.window.rate_hz < LATE_S:
            return
        site.holds_from = tick
        for channel in (topics.STATE, topics.LINK):
            site.reception.accounts[channel].abandon_below(tick)
        site.repair.probe()

    def _store(
        self, name: str, site: SiteView, channel: str, content: State | LinkStats | Event
    ) -> None:
        """Stores the contents of a message, and applies the changes in it."""
        if isinstance(content, State):
            if site.record is None or content.tick > site.record.tick:
                site.record = content
            site.window.receive(content)
            if content.bodies:
                site.bodies[content.tick] = content.bodies
                while len(site.bodies) > KEPT_S * site.window.rate_hz:
                    del site.bodies[next(iter(site.bodies))]
            for text in content.cmd:
                self._apply_change(name, text)
        elif isinstance(content, LinkStats):
            site.stats = content
        elif channel == topics.EVENT:
            self.events.add(content)
            if content.kind == "hand":
                holder, separator, _ = content.text.partition(f" {TAKEN} ")
                if separator:
                    site.holder = holder.removeprefix(f"{name}: ")
            if content.kind == "change":
                site.stopped_by = find_requester(content.text) or site.stopped_by
                if content.command:
                    self._apply_change(name, content.command)

    def _apply_change(self, site: str, text: str) -> None:
        """Applies a change to links, shares and the energy, once for each text."""
        if (
            (site, text) in self._applied_changes
            or self.scenario is None
            or self.energy is None
        ):
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

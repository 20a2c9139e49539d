"""What a session does now: the records, statistics and events of its sites as they come in.

Invariant:
- Every record counts. What is missing is asked for as a recorder asks, from the same buffers,
  so that energies are those of the log; a page is shown fewer, and always the newest.
- A view that begins late asks for no records from before it, and for all events, which say what
  was changed.
- A site has ended if its `end` message says so, and never because it is silent: on a busy
  machine a running site may be silent for long, and its records are taken in when they come
  again.
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
"""A view whose first record of a site is of a later time has joined late."""
SILENT_NS = 2 * NS_PER_S
"""A running site that was not heard for so long is shown as silent."""
EVENTS_KEPT = 400

T = TypeVar("T")


class Tail(Generic[T]):
    """The last entries of a sequence without end, for readers that come when they can."""

    def __init__(self, most: int) -> None:
        self._entries: deque[T] = deque(maxlen=most)
        self.count = 0

    def add(self, entry: T) -> None:
        """Adds an entry."""
        self._entries.append(entry)
        self.count += 1

    def since(self, count: int, most: int) -> list[T]:
        """Returns the entries after the first `count`, of those that are kept; the newest
        `most` of them.
        """
        new = min(self.count - count, most, len(self._entries))
        return [self._entries[n] for n in range(len(self._entries) - new, len(self._entries))]


class SiteView:
    """One running site: its reception, its newest record and statistics.

    Attributes:
        record, stats: the newest; None before the first.
        holds_from: its first tick that was seen.
        holder: who took hold of its arm last.
        stopped_by: who ordered its last stop, as far as its events say.
        bodies: poses of its plant's bodies by tick, as far back as the window reaches; {}
            without bodies.
        layout: of its records, if it may go on without a lost one of its peers; else None.
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
        """Returns what nobody may overlook of the site, of some name; None if there is nothing."""
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
        """True once the site has said that it ends."""
        return self.reception.final_ticks is not None

    @property
    def complete(self) -> int:
        """The last tick up to which all records are there or cannot be had; -1 before the
        first.
        """
        account = self.reception.accounts[topics.STATE]
        gap = account.find_requestable_gap()
        return account.last if gap is None else gap[0] - 1


class SessionView:
    """A session as an onlooker sees it; `poll` takes in what has come.

    Attributes:
        scenario: the session's; None until a member has told it.
        sites: its running sites by name; {} until all of them run.
        links: every link as it is at present, as tables.
        dominance: the dominance matrix that was asked for last, by site.
        events: what happened, oldest first.
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
        self._changes: set[tuple[str, str]] = set()
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
        """True once every site has said that it ends, or `finish` was called."""
        return self.running and (
            self._finished or all(site.ended for site in self.sites.values())
        )

    def finish(self) -> None:
        """Shows the session as ended: whoever has started its sites knows that their processes
        are gone.
        """
        self._finished = True

    def silence_s(self, site: SiteView) -> float:
        """Returns for how long a running site was not heard, s.

        It is 0.0 below `SILENT_NS`, and once the site has ended.
        """
        heard_ns = site.reception.last_received_ns
        if heard_ns is None or site.ended:
            return 0.0
        silence_ns = self._clock.monotonic_ns() - heard_ns
        return silence_ns / NS_PER_S if silence_ns >= SILENT_NS else 0.0

    @property
    def session_silence_s(self) -> float:
        """For how long no running site was heard, s; 0.0 while one is."""
        running = [site for site in self.sites.values() if not site.ended]
        return min((self.silence_s(site) for site in running), default=0.0)

    def poll(self) -> None:
        """Takes in what has come, and asks for what is missing."""
        now_ns = self._clock.monotonic_ns()
        if not self.running:
            self._meet()
        if not self.running:
            return
        for arrived in self._queue.drain(now_ns):
            try:
                self._take(arrived)
            except WireError as error:
                self.dropped[error.reason] += 1
        for name, site in self.sites.items():
            # A silent site is asked too: its answer may be the `end` message that was lost.
            for channel, message, _ in site.repair.poll(now_ns, alive=not site.ended):
                self._keep(name, site, channel, message.content)
        newest_ns = max(
            (site.record.t_ns for site in self.sites.values() if site.record), default=0
        )
        self.links.advance_to(newest_ns)

    def advance_energy(self) -> EnergyCourse | None:
        """Returns V at the ticks of which all records have come since the last call; None
        without any.
        """
        complete = {name: site.complete for name, site in self.sites.items()}
        return None if self.energy is None else self.energy.compute_next(complete)

    def find_shown(self, site: str, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns the tick of each peer that a site's user is shown; see `PictureDelay.advance_to`."""
        assert self.scenario is not None
        if site not in self._pictures:
            self._pictures[site] = PictureDelay(self.scenario, site)
        shown = self._pictures[site].advance_to(tick, used)
        return {peer: min(last, self.sites[peer].window.newest) for peer, last in shown.items()}

    def _meet(self) -> None:
        for info in self._query.poll():
            self.met[info.member] = info
            if self.scenario is None and info.scenario:
                try:
                    self.scenario = parse_embedded(info.scenario, info.member)
                except ScenarioError:
                    self.dropped["another scenario"] += 1
        if self.scenario is None:
            return
        boots = {name: self.met[name].boot for name in self.scenario.names if name in self.met}
        if len(boots) == len(self.scenario.names) and all(
            self.met[name].running for name in boots
        ):
            self._begin(self.scenario, boots)

    def _begin(self, scenario: Scenario, boots: dict[str, int]) -> None:
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

    def _take(self, arrived: InboundMessage) -> None:
        parts = topics.parse_key(arrived.key)
        if parts is None or (site := self.sites.get(parts.member)) is None:
            return  # a recorder's own
        single = parts.channel != topics.STATE
        for payload in (arrived.payload,) if single else split_states(arrived.payload):
            try:
                message = site.reception.read(parts.channel, payload)
            except WireError:
                if parts.channel != topics.EVENT or not self._begin_start(
                    parts.member, payload
                ):
                    raise
                message = site.reception.read(parts.channel, payload)
            if site.record is None and site.stats is None and parts.channel != topics.EVENT:
                self._join(site, message.content)
            if site.reception.accept(parts.channel, message, arrived.mono_ns):
                self._keep(parts.member, site, parts.channel, message.content)

    def _begin_start(self, name: str, payload: bytes) -> bool:
        """Goes over to another start of a site, if that says that it joins."""
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

    def _join(self, site: SiteView, content: State | LinkStats | Event) -> None:
        """Asks a site for no record from before a late first one, and for its events."""
        tick = content.tick if isinstance(content, State | LinkStats) else 0
        if tick / site.window.rate_hz < LATE_S:
            return
        site.holds_from = tick
        for channel in (topics.STATE, topics.LINK):
            site.reception.accounts[channel].abandon_below(tick)
        site.repair.probe()

    def _keep(
        self, name: str, site: SiteView, channel: str, content: State | LinkStats | Event
    ) -> None:
        if isinstance(content, State):
            if site.record is None or content.tick > site.record.tick:
                site.record = content
            site.window.receive(content)
            if content.bodies:
                site.bodies[content.tick] = content.bodies
                while len(site.bodies) > KEPT_S * site.window.rate_hz:
                    del site.bodies[next(iter(site.bodies))]
            for text in content.cmd:
                self._change(name, text)
        elif isinstance(content, LinkStats):
            site.stats = content
        elif channel == topics.EVENT:
            self.events.add(content)
            words, took_hold, _ = content.text.partition(f" {TAKEN} ")
            if content.kind == "hand" and took_hold:
                site.holder = words.removeprefix(f"{name}: ")
            if content.kind == "change":
                site.stopped_by = find_requester(content.text) or site.stopped_by
            if content.command and content.kind == "change":
                self._change(name, content.command)

    def _change(self, site: str, text: str) -> None:
        if (site, text) in self._changes or self.scenario is None or self.energy is None:
            return
        self._changes.add((site, text))
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

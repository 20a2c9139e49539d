"""State of a running session, as reconstructed by an observer from its messages.

Every site publishes one record per tick, statistics of its network links, and events. An
observer receives the same messages as the recorder, and sends nothing to the sites except
requests for missing messages. The state is shown on web pages and by the command `trilat
watch`.

Invariant:
    - The observer receives every record, and requests missing records from the buffers of the
      sites, as the recorder does. The energy of the arms that it computes therefore equals the
      energy computed from the log. Pages show only the newest record of each site.
    - An observer that joins late does not request earlier records. It does request all events,
      since they contain earlier changes of the session.
    - A site has ended only if it has published an `end` event, never because it is silent. On a
      busy machine, a running site may be silent for a long time, and its records are used when
      they arrive.
    - A session has ended if every site has ended. A site that was killed sends no `end` event,
      so the session has also ended if the network reports that all sites have left and
      `AWAY_NS` have passed.
"""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Generic, TypeVar

import msgspec

from recorder import AWAY_NS, GapRepair, InboundQueue
from trilat_net.analysis import KEPT_S, RunningEnergy
from trilat_net.core import TAKEN, LifeAlarm
from trilat_net.errors import ScenarioError, WireError
from trilat_net.net import Bus, Clock, Event, Info, LinkStats, SessionMembers, State, topics
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Change, LinkTables, PictureDelay, Scenario, parse_embedded

LATE_S = 3.0
"""An observer joined late if the first record that it receives is later than this, in s."""
MIN_SILENCE_NS = 2 * NS_PER_S
"""Silence after which a running site is reported as silent, in ns."""
EVENTS_KEPT = 400
"""Number of events kept for new pages."""

T = TypeVar("T")


class Tail(Generic[T]):
    """The most recent entries of a growing list, such as the events of a session.

    A reader, such as a page, only remembers how many entries it has read, and asks for the
    entries added since.

    Args:
        most: Maximum number of entries to keep.

    Attributes:
        count: Number of entries added so far, including those no longer kept.
    """

    def __init__(self, most: int) -> None:
        self._entries: deque[T] = deque(maxlen=most)
        self.count = 0

    def add(self, entry: T) -> None:
        """Appends an entry, dropping the oldest one if the list is full.

        A reader that is too slow misses the dropped entry.

        Args:
            entry: The entry, for example a point of a plot.
        """
        self._entries.append(entry)
        self.count += 1

    def since(self, count: int, most: int) -> list[T]:
        """Returns the entries that a reader has not seen yet.

        Args:
            count: Number of entries that had been added when the reader last asked.
            most: Maximum number of entries to return. Older entries are skipped.

        Returns:
            The new entries, oldest first.
        """
        kept_count = len(self._entries)
        unread_count = self.count - count
        new_count = min(unread_count, most, kept_count)
        first_index = kept_count - new_count
        return [self._entries[index] for index in range(first_index, kept_count)]


class SiteView:
    """What an observer knows about one site: its newest state, and which messages are missing.

    Args:
        bus: Network connection that reaches the session.
        session: Name of the session.
        scenario: Scenario of the session.
        name: Name of the site.
        boot: Random number that identifies this start of the site.
        energy: Energy of the session, which holds the latest records of the site.

    Attributes:
        glides: True if the site stops smoothly when it loses its peers (stale rule `glide`).
            Only such a site has alarms.
        peers: Names of the sites whose samples the site receives.
        layout: Numbers of joints and peers in its records, if the site continues without a lost
            peer; otherwise `None`.
        hand: Settings for people who hold its arm, or `None` if nobody can hold it.
        window: Its latest records.
        holder: Person or program that last took hold of its arm.
        stopped_by: Person or program that requested its last stop, according to the site's
            events.
        bodies: Mapping from tick to the poses of the bodies that its arm can touch, as far back
            as `window`.
        dropped: Mapping from reason to number of dropped messages.
        repair: Tracks which of its messages have arrived, and requests the missing ones.
        record: Its newest record, or `None` before the first one.
        stats: Its newest statistics, or `None` before the first ones.
        first_tick: Tick of the first record if the observer joined late; otherwise 0.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        scenario: Scenario,
        name: str,
        boot: int,
        energy: RunningEnergy,
    ) -> None:
        settings = scenario.sites[name]
        loss_rule = settings.on_stale
        self.glides = loss_rule.action == "glide"
        self.peers = scenario.peers(name)
        self.layout = None
        if loss_rule.rule.degrades:
            self.layout = scenario.layout(name)
        self.hand = settings.find_live_hand(is_open=True)
        self.window = energy.windows[name]
        self.holder = ""
        self.stopped_by = ""
        self.bodies: dict[int, list[float]] = {}
        self.dropped: Counter[str] = Counter()
        self.repair = GapRepair(bus, session, scenario, name, boot, self.dropped)
        self.record: State | None = None
        self.stats: LinkStats | None = None
        self.first_tick = 0

    def find_alarm(self, session: str, name: str) -> LifeAlarm | None:
        """Returns an alarm if the arm of the site needs attention (a stop or a fault).

        Only a site with the stale rule `glide`, under which an arm comes to rest while a peer
        is silent, has alarms. The alarm is derived from the newest record of the site: from its
        mode and from `mem`, the values that it keeps from tick to tick.

        Args:
            session: Name of the session.
            name: Name of the site.

        Returns:
            The alarm with its reason. `None` if there is no alarm, if the site has ended, or if
            its stale rule is not `glide`.
        """
        record = self.record
        if record is None or not self.glides or self.ended:
            return None

        lost_peers: Sequence[str] = ()  # peers without which the site continues
        if self.layout is not None:
            lost_peers = self.layout.list_lost_peers(record.mem, self.peers)
        shared_coordinates = len(record.q_des)  # by which `mem` is divided
        # The function of the module `ticks`, which derives an alarm from a record alone.

        alarm = LifeAlarm.find(
            session=session,
            site=name,
            mode=record.mode,
            mem=record.mem,
            shared=shared_coordinates,
            lost=lost_peers,
        )
        if alarm is None:
            return None

        # The order "enable" ends a stop that was ordered. Only an event states who ordered it.
        was_stopped_by_order = alarm.order == "enable"
        if was_stopped_by_order and self.stopped_by:
            reason = f"ordered by {self.stopped_by}"
            return alarm._replace(reason=reason)
        return alarm

    @property
    def ended(self) -> bool:
        """True once the site has published its `end` event.

        The site sends no more records after this event.
        """
        return self.repair.reception.final_ticks is not None

    @property
    def complete(self) -> int:
        """Last tick up to which every record of the site has either arrived or been lost.

        No earlier record can still arrive. -1 before the first record.
        """
        record_account = self.repair.reception.accounts[topics.STATE]
        gap = record_account.find_requestable_gap()
        if gap is None:
            return record_account.last
        first_missing, _ = gap
        return first_missing - 1


class SessionView:
    """What an observer knows about a running session from the messages of its sites.

    The owner must call `poll` regularly to receive messages.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.

    Attributes:
        scenario: Scenario of the session, or `None` until a member has sent it.
        sites: Mapping from site name to the view of each running site. Empty until all sites
            run.
        members: Identities of the members (sites and recorders) that have replied.
        links: Current settings of every link, such as its delay, as tables.
        dominance: Mapping from site name to the most recently requested dominance factors of
            the site.
        energy: Energy function V of the stability proof, computed while the session runs;
            `None` until all sites run.
        events: The most recent events of all members, oldest first.
        dropped: Mapping from reason to number of dropped (invalid or unknown) messages.
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
        self._presence = bus.presence(topics.presence_key(session, "*"))
        # Keys of the liveliness tokens of sites that are present.
        self._tokens: set[str] = set()
        # Time at which the last of them disappeared. `None` if a site is present, or if no site
        # has ever been present.
        self._left_ns: int | None = None
        self._pictures: dict[str, PictureDelay] = {}
        self._applied_changes: set[tuple[str, str]] = set()
        self._query = SessionMembers(bus, clock, session)
        self._queue = InboundQueue(clock)
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            key_of_all_sites = topics.key(session, "*", channel)
            bus.tap(key_of_all_sites, self._queue.receive)

    @property
    def running(self) -> bool:
        """True once every site has replied that it is running.

        `sites` is empty until then.
        """
        return bool(self.sites)

    @property
    def ended(self) -> bool:
        """True once there is nothing more to observe.

        This is the case if every site has published its `end` event or has left the network, or
        if `finish` was called. A session that has not started has not ended.
        """
        if not self.running:
            return False
        if self._finished or self.has_left:
            return True
        return all(site.ended for site in self.sites.values())

    @property
    def has_left(self) -> bool:
        """True if every site has been gone from the network for longer than `AWAY_NS`.

        The time is measured from the last sign of life of any site: its last message, or the
        notification that it has disappeared. A short loss of the connection therefore does not
        end the observation.
        """
        if self._left_ns is None:
            return False
        arrivals_ns = [
            site.repair.reception.last_received_ns or 0 for site in self.sites.values()
        ]
        since_ns = max(self._left_ns, *arrivals_ns)
        return self._clock.monotonic_ns() - since_ns > AWAY_NS

    def finish(self) -> None:
        """Marks the session as ended, even if a message about the end of a site was lost.

        Called by the process that runs the session once the processes of all sites have ended.
        """
        self._finished = True

    def silence_s(self, site: SiteView) -> float:
        """Returns the time since the last message of a running site arrived, in s.

        A silence shorter than `MIN_SILENCE_NS` is normal and counts as 0. A site that has ended
        is not silent.

        Args:
            site: The site.
        """
        received_ns = site.repair.reception.last_received_ns
        if received_ns is None or site.ended:
            return 0.0
        silence_ns = self._clock.monotonic_ns() - received_ns
        if silence_ns < MIN_SILENCE_NS:
            return 0.0
        return silence_ns / NS_PER_S

    @property
    def session_silence_s(self) -> float:
        """Time since the last message of any running site, in s.

        Displays show this time to warn that either the session or their own connection may be
        lost. The time is 0 while messages from any site arrive.
        """
        silences_s: list[float] = []
        for site in self.sites.values():
            if not site.ended:
                silence_s = self.silence_s(site)
                silences_s.append(silence_s)
        return min(silences_s, default=0.0)

    def poll(self) -> None:
        """Receives the messages that have arrived, and requests missing ones.

        Must be called regularly, for example 30 times per second. Never blocks. Before the
        session runs, it only looks for the sites.
        """
        now_ns = self._clock.monotonic_ns()
        self._note_presence(now_ns)
        if not self.running:
            self._connect_to_sites()
        if not self.running:
            return

        for message in self._queue.drain(now_ns):
            try:
                self._receive(message.key, message.payload, message.mono_ns)
            except WireError as error:
                self.dropped[error.reason] += 1

        for name, site in self.sites.items():
            # Silent sites are queried too: the missing message may be their `end` event.
            repaired = site.repair.poll(now_ns, alive=not site.ended)
            for channel, reply, _ in repaired:
                self._store(name, site, channel, reply.content)

        newest_ns = 0
        for site in self.sites.values():
            if site.record is not None:
                newest_ns = max(newest_ns, site.record.t_ns)
        self.links.advance_to(newest_ns)

    def _note_presence(self, now_ns: int) -> None:
        """Tracks which sites have appeared on the network or disappeared, for `has_left`.

        Each member of a session has a liveliness token, which the network removes when the
        member disappears. Recorders are ignored.

        Args:
            now_ns: Current time on the monotonic clock, in ns.
        """
        while (change := self._presence.poll()) is not None:
            key, is_alive = change
            token = topics.parse_key(key)
            if token is None or token.member == topics.RECORDER:
                continue
            if is_alive:
                self._tokens.add(key)
                self._left_ns = None
            elif key in self._tokens:
                self._tokens.discard(key)
                self._left_ns = None if self._tokens else now_ns

    @property
    def complete_ticks(self) -> dict[str, int]:
        """Mapping from site to the tick up to which all records have arrived or been lost."""
        return {name: site.complete for name, site in self.sites.items()}

    def find_peer_ticks(
        self, site: str, tick: int, used: Mapping[str, int]
    ) -> Mapping[str, int]:
        """Returns the ticks of the poses in which the user of a site sees the other arms.

        The pose of a peer is that of the sample that the site uses for its control law or, if
        the scenario delays the picture further, that of an earlier sample.

        Args:
            site: Name of the user's site.
            tick: Tick of the site's record.
            used: Mapping from peer name to the tick of the sample that the site uses at `tick`.

        Returns:
            Mapping from peer name to tick.
        """
        assert self.scenario is not None
        if site not in self._pictures:
            self._pictures[site] = PictureDelay(self.scenario, site)
        picture_ticks = self._pictures[site].advance_to(tick, used)
        peer_ticks: dict[str, int] = {}
        for peer, picture_tick in picture_ticks.items():
            # This observer may not have received the peer's record of that tick yet, although
            # the site has received the sample.
            newest_received_tick = self.sites[peer].window.newest
            peer_ticks[peer] = min(picture_tick, newest_received_tick)
        return peer_ticks

    def _connect_to_sites(self) -> None:
        """Receives replies from the members of a session, and observes its sites once they run.

        The scenario is part of the first reply. An invalid scenario is counted as dropped.
        """
        for info in self._query.poll():
            self.members[info.member] = info
            if self.scenario is None and info.scenario:
                try:
                    self.scenario = parse_embedded(info.scenario, info.member)
                except ScenarioError:
                    self.dropped["another scenario"] += 1
        if self.scenario is None:
            return

        names = self.scenario.names
        infos = [self.members[name] for name in names if name in self.members]
        have_all_replied = len(infos) == len(names)
        if have_all_replied and all(info.running for info in infos):
            self._create_sites(self.scenario)

    def _create_sites(self, scenario: Scenario) -> None:
        """Creates the views of the sites, the link tables and the energy of the session.

        Requires that all sites run, since the energy is computed for all arms together.

        Args:
            scenario: Scenario of the session. All of its sites must have replied that they are
                running.
        """
        self.links = LinkTables(scenario.links, scenario.timeline)
        self.dominance = {site: dict(scenario.dominance[site]) for site in scenario.names}
        self.energy = RunningEnergy(scenario)
        for name in scenario.names:
            self.sites[name] = SiteView(
                bus=self.bus,
                session=self.session,
                scenario=scenario,
                name=name,
                boot=self.members[name].boot,
                energy=self.energy,
            )

    def _receive(self, key: str, block: bytes, mono_ns: int) -> None:
        """Decodes a message from a site, and stores each record, statistic or event in it.

        Messages from other members are ignored. The first record or statistics of a site show
        whether this observer joined late, in which case earlier ones are not requested.

        Args:
            key: Key of the message on the network.
            block: Bytes of the message, which contains several records on the record channel.
            mono_ns: Arrival time on the monotonic clock, in ns.

        Raises:
            WireError: The message cannot be decoded.
        """
        parts = topics.parse_key(key)
        site = self.sites.get(parts.member) if parts is not None else None
        if parts is None or site is None:
            return

        channel = parts.channel
        for payload in site.repair.reception.split(channel, block):
            try:
                message = site.repair.reception.read(channel, payload)
            except WireError:
                # Messages of an unknown boot (start of the process) cannot be read. A site that
                # has been started again announces its new boot with an event.
                may_announce_boot = channel == topics.EVENT
                if not may_announce_boot or not self._accept_new_boot(site, payload):
                    raise
                # From now on, messages of the new boot can be read.
                message = site.repair.reception.read(channel, payload)

            has_stored_none = site.record is None and site.stats is None
            is_first = has_stored_none and channel != topics.EVENT
            if is_first:
                self._skip_records_before(site, message.content)

            # A message that has arrived before, for example on request, is not stored again.
            is_new = site.repair.reception.accept(channel, message, mono_ns)
            if is_new:
                self._store(parts.member, site, channel, message.content)

    def _accept_new_boot(self, site: SiteView, payload: bytes) -> bool:
        """Switches to a restarted site, if an event announces that it has joined the session.

        Args:
            site: View of the site.
            payload: The event.

        Returns:
            True if the event belongs to a restarted site that may join.
        """
        boot = site.repair.reception.find_new_boot(payload, ("join",))
        if boot is None:
            return False
        site.repair = site.repair.follow_start(boot)
        return True

    def _skip_records_before(self, site: SiteView, content: State | LinkStats | Event) -> None:
        """Stops requesting records that a site sent before a late observer joined.

        All events of the site are still requested.

        Args:
            site: The site.
            content: The first message from the site.
        """
        tick = 0
        if isinstance(content, State | LinkStats):
            tick = content.tick
        first_s = tick / site.window.rate_hz
        has_joined_late = first_s >= LATE_S
        if not has_joined_late:
            return

        site.first_tick = tick
        for channel in (topics.STATE, topics.LINK):
            account = site.repair.reception.accounts[channel]
            account.abandon_below(tick)
        site.repair.probe()

    def _store(
        self, name: str, site: SiteView, channel: str, content: State | LinkStats | Event
    ) -> None:
        """Stores the content of a new message, to be shown on pages.

        Args:
            name: Name of the site that sent the message.
            site: View of this site.
            channel: Channel of the message.
            content: A record, statistics, or an event.
        """
        if isinstance(content, State):
            self._store_record(name, site, content)
        elif isinstance(content, LinkStats):
            site.stats = content
        elif channel == topics.EVENT:
            self._store_event(name, site, content)

    def _store_record(self, name: str, site: SiteView, record: State) -> None:
        """Stores a received record, and applies any changes of settings in it.

        Resent records may arrive late, so `record` of the site is updated only if the record is
        newer.

        Args:
            name: Name of the site.
            site: View of the site.
            record: The record.
        """
        if site.record is None or record.tick > site.record.tick:
            site.record = record
        site.window.receive(record)

        if record.bodies:
            site.bodies[record.tick] = record.bodies
            kept_ticks = KEPT_S * site.window.rate_hz
            while len(site.bodies) > kept_ticks:
                oldest_tick = next(iter(site.bodies))
                del site.bodies[oldest_tick]

        for change in record.cmd:
            self._apply_change(name, change)

    def _store_event(self, name: str, site: SiteView, event: Event) -> None:
        """Stores an event for the pages, and updates the state of the site from it.

        An event of the kind "hand" names the person or program that took hold of the arm. An
        event of the kind "change" names who requested a stop, and may contain a change of links
        or dominance factors.

        Args:
            name: Name of the site.
            site: View of the site.
            event: The event.
        """
        self.events.add(event)
        if event.kind == "hand":
            holder, separator, _ = event.text.partition(f" {TAKEN} ")
            if separator:
                site.holder = holder.removeprefix(f"{name}: ")

        if event.kind == "change":
            site.stopped_by = Change.find_requester(event.text) or site.stopped_by
            if event.command:
                self._apply_change(name, event.command)

    def _apply_change(self, site: str, text: str) -> None:
        """Applies a change of the session to the displayed links, weights and energies.

        A change appears both in a record and in an event of its site, but is applied only once.

        Args:
            site: Name of the site that carried out the change.
            text: The change as JSON.
        """
        if self.scenario is None or self.energy is None:
            return

        identity = (site, text)
        if identity in self._applied_changes:
            return

        self._applied_changes.add(identity)

        try:
            change = self.scenario.parse_core_change(site, text)
        except ScenarioError:
            self.dropped["no change"] += 1
            return

        self.energy.add_changes(site, [change])

        table = msgspec.json.decode(text)
        if "link" in table:
            self.links[table["link"]] = table["to"]
        elif "dominance" in table:
            self.dominance[site] = table["to"]

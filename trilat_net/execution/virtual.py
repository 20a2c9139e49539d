"""Simulates an experiment without real clocks, processes or a network, and writes its log.

A counter takes the place of the clock, and a simulated network takes the place of the message
bus. The log has the same format as that of a live session. For every arm, it contains the
record of every tick, statistics of the network links, and events. All tools for logs can
therefore be used on simulations too.

Invariant:
    - An arm advances only through `Site.step`. Ticks are executed in order of their nominal
      time; simultaneous ticks are executed in scenario order of their sites.
    - Two runs of a scenario with the same seed therefore write the same file, byte for byte.
    - A message with an older schema version is written with the current version. A message with
      the current version keeps its bytes.
"""

import bisect
import io
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from .. import process
from ..core import TAKEN, CoreChange, PlantState, Site, TickInput, describe_mode
from ..errors import CodeFailed, count_nouns
from ..hooks import find_hook
from ..log import (
    MAX_TIME_NS,
    SITE_CHANNELS,
    VIZ_HZ,
    Account,
    Log,
    LogContents,
    LogFile,
    LogWriter,
    Sink,
    collect_provenance,
    compute_virtual_boot,
    count_skipped_ticks,
)
from ..net import (
    SENT_TIME_SINCE,
    VERSION,
    Event,
    LinkStats,
    LoopStats,
    State,
    encode,
    encode_state,
    number_message,
    skipped_numbers,
    topics,
)
from ..own_code import ImportedLaw
from ..records import NS_PER_S, Arrival, Mode, TickRecord
from ..scenario import POLICY, HandPlayer, PlantPlayer, Scenario
from .resumption import select_peer_channels
from .virtual_network import Network, PromptNetwork


class SiteEntry(NamedTuple):
    """One message from a site, ready to be written to a log.

    Attributes:
        site: Name of the site that sends the message.
        t_ns: Nominal time of the message, in ns after the epoch (the common start time).
            Messages are written in this order.
        sent_ns: Time at which the site sent the message, in ns after the epoch.
        channel: Channel of the site: "state" for records, "link" for statistics, or "event".
        sequence: Tick of a record or of statistics, or number of an event.
        payload: Encoded message.
        message: Decoded message.
    """

    site: str
    t_ns: int
    sent_ns: int
    channel: str
    sequence: int
    payload: bytes
    message: Any


class SiteChannels:
    """Channels of one site in a log that is being written: records, statistics and events.

    The `make_…` methods convert ticks and messages to entries, and `write` writes an entry to
    the log. The messages of each channel are counted, so that the log can state whether any are
    missing.

    Args:
        scenario: Scenario of the log.
        session: Name of the session of the log.
        site: Name of the site.
        boot: Number that identifies this start of the site. Every message contains it.

    Attributes:
        peers: Names of the other sites, in scenario order.
        keys: Key of each channel, under which its messages are published.
        accounts: Message count of each channel.
        ticks: Number of ticks that the site has executed.
    """

    def __init__(self, scenario: Scenario, session: str, site: str, boot: int) -> None:
        """Prepares the numbering of a site's messages. No message is written yet."""
        settings = scenario.sites[site]
        self.peers = scenario.peers(site)
        self.keys = {channel: topics.key(session, site, channel) for channel in SITE_CHANNELS}
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self.ticks = 0
        self._site = site
        self._boot = boot
        self._rate_hz = settings.rate_hz
        self._glides = settings.on_stale.action == "glide"
        self._mode = Mode.RUN
        self._event_count = 0
        self._last_ns = 0

    def make_tick_entries(
        self, output: TickRecord, stats: LinkStats | None, law_failure: Exception | None = None
    ) -> Sequence[SiteEntry]:
        """Returns the statistics and events that follow the record of a tick in a log.

        Args:
            output: Record of the tick.
            stats: Statistics of the site's links. None if they are not due in this tick.
            law_failure: Error in a user's control law that changed the mode of the site. None
                if there was no error.

        Returns:
            One entry for the statistics if they are due, and one for an event if the mode of
            the site has changed.
        """
        self.ticks = output.tick + 1
        self._last_ns = output.t_ns
        self._exclude_skipped_ticks(output.tick, output.cmd)
        entries = []
        if stats is not None:
            entries.append(self.make_stats_entry(stats))
        if output.mode is not self._mode:
            self._mode = output.mode
            entries.append(self._make_mode_entry(output, law_failure))
        return entries

    def _make_mode_entry(self, output: TickRecord, law_failure: Exception | None) -> SiteEntry:
        """Returns the event for a change of the site's mode, for example after a fault."""
        text = describe_mode(self._site, output, glides=self._glides, law_failure=law_failure)
        kind = "diverged" if output.mode is Mode.DIVERGED else "mode"
        return self.make_new_event_entry(kind, text, output.t_ns)

    def _exclude_skipped_ticks(self, tick: int, cmd: Sequence[str]) -> None:
        """Excludes the ticks that a site skipped from the counts of missing messages.

        A site skips ticks if its control loop has fallen behind, and publishes nothing for
        these ticks. Their number is stated among the commands in the next record.

        Args:
            tick: Tick of the record.
            cmd: Text of each command in the record.
        """
        skipped = count_skipped_ticks(cmd)
        if not skipped:
            return
        for channel in (topics.STATE, topics.LINK):
            numbers = skipped_numbers(channel, tick, skipped, self._rate_hz)
            self.accounts[channel].mark_unpublished(*numbers)

    def make_end_entry(self, t_ns: int | None = None) -> SiteEntry:
        """Returns the log entry of the event that marks the end of the site's run.

        Args:
            t_ns: Time of the event, in ns after the epoch (the common start time). By default,
                the time of the last tick.
        """
        end_ns = self._last_ns if t_ns is None else t_ns
        text = f"{self._site} made {count_nouns(self.ticks, 'tick')}"
        return self.make_new_event_entry("end", text, end_ns)

    def make_new_event_entry(self, kind: str, text: str, t_ns: int) -> SiteEntry:
        """Creates an event of the site, with the next event number, as an entry for the log.

        Args:
            kind: Kind of the event, in a form that programs can evaluate.
            text: Description of the event in one sentence, for people.
            t_ns: Time of the event, in ns after the epoch.
        """
        number = self._event_count
        self._event_count += 1
        event = Event(
            member=self._site,
            boot=self._boot,
            n=number,
            kind=kind,
            text=text,
            t_ns=t_ns,
            ticks=self.ticks,
        )
        return self.make_event_entry(event, number)

    def make_record_entry(self, state: State, payload: bytes) -> SiteEntry:
        """Returns the record of a tick as an entry for the log.

        A record in the format of an older version is re-encoded in the current format.

        Args:
            state: The record.
            payload: The encoded form of the same record.
        """
        self._exclude_skipped_ticks(state.tick, state.cmd)
        # Old versions did not store the time of sending.
        sent_ns = state.sent_ns if state.v >= SENT_TIME_SINCE else state.t_ns

        if state.v != VERSION:
            # A record lists only the arrivals, not the contents of the samples.
            arrivals = [
                Arrival(peer=peer, tick=tick, q=(), qd=(), latency_us=latency_us)
                for peer, tick, latency_us in state.rx
            ]
            payload = encode_state(
                site=state.site,
                boot=state.boot,
                peers=self.peers,
                output=state.to_tick_record(self.peers),
                arrivals=arrivals,
                late_us=state.late_us,
                busy_us=state.busy_us,
                sent_ns=sent_ns,
                echo=state.echo,
            )
        return SiteEntry(
            site=self._site,
            t_ns=state.t_ns,
            sent_ns=sent_ns,
            channel=topics.STATE,
            sequence=state.tick,
            payload=payload,
            message=state,
        )

    def make_stats_entry(self, stats: LinkStats) -> SiteEntry:
        """Returns statistics of a site's links as an entry for the log.

        Statistics in the format of an older version are converted to the current version.

        Args:
            stats: The statistics, for example the numbers of received and lost samples.
        """
        converted = stats
        if stats.v != VERSION:
            converted = msgspec.structs.replace(stats, v=VERSION)
        return SiteEntry(
            site=self._site,
            t_ns=stats.t_ns,
            sent_ns=stats.t_ns,
            channel=topics.LINK,
            sequence=stats.tick,
            payload=encode(converted),
            message=stats,
        )

    def make_event_entry(self, event: Event, number: int) -> SiteEntry:
        """Converts an event that the site published in an earlier run to an entry for the log.

        Args:
            event: The event, such as a change of the site's mode.
            number: Number of the event, used only if the event itself has no number.
        """
        has_number = event.n >= 0  # events of the oldest versions have no number
        numbered = event if has_number else msgspec.structs.replace(event, n=number)
        payload = encode(msgspec.structs.replace(numbered, v=VERSION))
        t_ns = max(event.t_ns, 0)  # a log has no times before the epoch
        return SiteEntry(
            site=self._site,
            t_ns=t_ns,
            sent_ns=t_ns,
            channel=topics.EVENT,
            sequence=numbered.n,
            payload=payload,
            message=numbered,
        )

    def write(self, entry: SiteEntry, writer: LogWriter, epoch_unix_ns: int = 0) -> None:
        """Writes a message of the site to the log, and counts it for the completeness check.

        Args:
            entry: The message, as returned by one of the `make_…` methods.
            writer: Writer of the log.
            epoch_unix_ns: Unix time of the epoch (the common start time of the sites), in ns. 0
                in virtual time.
        """
        number = number_message(entry.channel, entry.sequence, self._rate_hz)
        self.accounts[entry.channel].receive(number)
        log_ns = min(max(0, epoch_unix_ns + entry.t_ns), MAX_TIME_NS)
        key = self.keys[entry.channel]
        writer.add(key, entry.payload, entry.sent_ns, log_ns, entry.sequence, entry.message)


def render_accounts(sites: Iterable[SiteChannels]) -> dict[str, str]:
    """Returns a mapping from topic to a string with the message count of each channel.

    The log stores these strings, which allow a reader to detect missing messages.

    Args:
        sites: Channels of the sites, after all their messages have been written.
    """
    return {
        f"/{site.keys[channel]}": f"{account.describe()}, overflowed 0"
        for site in sites
        for channel, account in site.accounts.items()
    }


class SiteTick(NamedTuple):
    """One executed tick of one site in virtual time.

    Attributes:
        site: The site, in its state after the tick.
        arrivals: Samples from other sites that arrived in this tick.
        output: Record of the tick.
    """

    site: Site
    arrivals: list[Arrival]
    output: TickRecord


ChangeSchedule = Mapping[str, Mapping[int, Sequence[CoreChange]]]
"""Changes, keyed by site and by the tick at which they take effect."""
PlantSchedule = Mapping[str, Mapping[int, PlantState]]
"""Measured states of external arms, keyed by site and tick."""
HandTracks = Mapping[str, Callable[[Site, int], Sequence[float]]]
"""For each site with a live operator, a function that returns the operator's action in a tick.

The function receives the site and the number of the site's next tick.
"""


def _find_skips(commands: Mapping[int, Sequence[CoreChange]]) -> dict[int, int]:
    """Finds the ticks that a site skipped because its control loop was too late.

    The number of skipped ticks is stated in the record of the next executed tick, in the form
    of a change.

    Args:
        commands: For each tick, the changes that the site applied before it.

    Returns:
        A mapping from the first skipped tick of each range to the first tick after the range.
        Empty if no tick was skipped.
    """
    end_ticks = {}
    for tick, changes in commands.items():
        for change in changes:
            if change.skipped:
                end_ticks[tick - change.skipped] = tick
    return end_ticks


def execute_virtual(
    scenario: Scenario,
    network: Network | None = None,
    commands: ChangeSchedule = {},  # noqa: B006
    measured: PlantSchedule = {},  # noqa: B006
    ends: Mapping[str, int] = {},
    hands: HandTracks = {},  # noqa: B006
    plants: Mapping[str, PlantPlayer] = {},
) -> Iterator[SiteTick]:
    """Simulates all sites of a scenario in virtual time, and yields every tick of every site.

    In virtual time, the sites run in one process, as fast as possible. Ticks are executed in
    order of their nominal time; simultaneous ticks are executed in scenario order of their
    sites. A site is held back until the samples that it needs have been sent. If the arm of a
    site leaves its limits, the run ends after all ticks at that time.

    Args:
        scenario: The scenario, with its sites and links.
        network: Network between the sites. By default, every sample arrives in the first tick
            after its time stamp.
        commands: Changes that take effect during the run.
        measured: Measured states of external arms.
        ends: Last tick of each site that stops before the end of the scenario.
        hands: Actions of live operators. A live operator without an entry does not hold the
            arm.
        plants: Users' programs that move the arms of sites.

    Raises:
        ScenarioError: An arm is external but appears in neither `measured` nor `plants`.
        LawFailed: A user's control law failed.
        PlantFailed: A user's program that moves an arm failed.
    """
    scenario.refuse_external_arms({**measured, **plants})
    if network is None:
        rates_hz = {name: spec.rate_hz for name, spec in scenario.sites.items()}
        network = PromptNetwork(rates_hz)

    setups = [scenario.setup(name) for name in scenario.names]
    sites = [Site(setup) for setup in setups]
    tick_counts = [
        min(scenario.ticks(name), ends.get(name, scenario.ticks(name)) + 1)
        for name in scenario.names
    ]
    skips = [_find_skips(commands.get(name, {})) for name in scenario.names]
    # The next tick of each site as (time in ns, index of the site, tick), in order of time.
    pending = [(0, index, 0) for index in range(len(sites)) if tick_counts[index]]
    last_ns = round(scenario.duration_s * NS_PER_S)
    while pending and pending[0][0] <= last_ns:
        t_ns, index, k = pending.pop(_find_ready(pending, sites, network))
        site = sites[index]
        name = site.name

        arrivals = select_peer_channels(network.deliver(name, k), setups[index].links)
        hand = hands[name](site, k) if name in hands else ()
        plant = plants.get(name)
        plant_state = measured.get(name, {}).get(k) if plant is None else plant.state
        tick_input = TickInput(
            k=k,
            arrivals=arrivals,
            commands=commands.get(name, {}).get(k, ()),
            measured=plant_state,
            hand=hand,
        )
        output = site.step(tick_input)
        if plant is not None:
            plant.move(k, output.tau)
        network.send(name, output)
        yield SiteTick(site, arrivals, output)

        if output.mode is Mode.DIVERGED:
            last_ns = t_ns
        next_tick = skips[index].get(k + 1, k + 1)
        if next_tick < tick_counts[index]:
            next_ns = next_tick * NS_PER_S // site.rate_hz
            bisect.insort(pending, (next_ns, index, next_tick))


def _find_ready(
    pending: Sequence[tuple[int, int, int]], sites: Sequence[Site], network: Network
) -> int:
    """Selects the site that executes the next tick of a simulation.

    A site can execute its next tick as soon as the samples that it needs are in the simulated
    network. Of the sites that are ready, the one with the earliest tick is selected.

    Args:
        pending: Next tick of each site, as (time in ns, index of the site, tick), in order of
            time.
        sites: The sites.
        network: Network between the sites.

    Returns:
        The position in `pending`. 0 if no site is ready, so that the run always continues.
    """
    for position, (_, index, k) in enumerate(pending):
        if network.is_ready(sites[index].name, k):
            return position
    return 0


class _VirtualChannels(SiteChannels):
    """Channels of one site in a virtual run, written while the run is executed."""

    def __init__(self, scenario: Scenario, site: Site, writer: LogWriter) -> None:
        boot = compute_virtual_boot(scenario.sha256, site.name)
        super().__init__(scenario, scenario.name, site.name, boot)
        self._writer = writer
        self._executed_site = site
        self._stats = LoopStats(site, boot)

    def write_tick(self, arrivals: list[Arrival], output: TickRecord) -> None:
        """Writes the record of a tick to the log, followed by its statistics and events.

        Args:
            arrivals: Samples from other sites that arrived in this tick.
            output: Results of the tick.
        """
        payload = encode_state(
            site=self._site,
            boot=self._boot,
            peers=self.peers,
            output=output,
            arrivals=arrivals,
            late_us=0,
            busy_us=0,
        )
        self.accounts[topics.STATE].receive(output.tick)
        self._writer.add(
            self.keys[topics.STATE], payload, output.t_ns, output.t_ns, output.tick, output
        )

        are_stats_due = self._stats.is_due(output.tick, count_skipped_ticks(output.cmd))
        stats = self._stats.pop_stats(output) if are_stats_due else None
        law_failure = self._executed_site.law_failure
        for entry in self.make_tick_entries(output, stats, law_failure):
            self.write(entry, self._writer)

    def write_hand_events(self, news: list[tuple[int, str]]) -> None:
        """Writes events to the log that report on an operator's connection.

        Args:
            news: The reports, as pairs of tick number and sentence; emptied afterwards.
        """
        for k, text in news:
            t_ns = k * NS_PER_S // self._rate_hz
            self.write(self.make_new_event_entry("hand", text, t_ns), self._writer)
        news.clear()


def write_virtual_log(
    scenario: Scenario,
    stream: Sink,
    network: Network | None = None,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = 0.0,
    *,
    hands: HandTracks = {},  # noqa: B006
    commands: ChangeSchedule = {},  # noqa: B006
    policies: Collection[str] = (),
) -> bool:
    """Simulates a scenario in virtual time, and writes the log of the run to a stream.

    The log is always completed, even if `stopped` returns True or an error occurs.

    Args:
        scenario: The scenario, with its sites and links.
        stream: Stream to which the log is written. It is not closed.
        network: Network between the sites, see `execute_virtual`.
        stopped: Function that is called after each tick. The run ends if it returns True.
        views_hz: Rate of the additional channels for viewers, in Hz, see `log.view_rates`.
        hands: Actions of live operators, see `execute_virtual`. They replace the programs that
            the scenario names as operators.
        commands: Changes that take effect during the run.
        policies: Sites whose live operator is a trained program. The log contains one event for
            each.

    Returns:
        True if all sites stayed within their limits, False if one diverged.

    Raises:
        LogError: Writing to the disk failed.
        ScenarioError: The scenario cannot run in virtual time. Nothing has been written.
        LawFailed: A user's control law failed. The log contains an event with the reason.
    """
    SimulatedLog.check_scenario(scenario)
    hand_players = HandPlayer.make_all(scenario)
    plants = PlantPlayer.make_all(scenario)
    tracks: dict[str, Callable[[Site, int], Sequence[float]]] = {
        name: player.track for name, player in hand_players.items()
    }
    tracks.update(hands)

    writer = LogWriter(
        stream=stream,
        scenario=scenario,
        session=scenario.name,
        driver="virtual",
        epoch_unix_ns=0,
        provenance=collect_provenance(),
        make_views=find_hook("offer the views of a log")(scenario, views_hz),
    )
    members: dict[str, _VirtualChannels] = {}
    within_limits = True
    t_ns = 0
    try:
        with process.pause_gc():
            ticks = execute_virtual(
                scenario, network, commands=commands, hands=tracks, plants=plants
            )
            for site, arrivals, output in ticks:
                if site.name not in members:
                    members[site.name] = _VirtualChannels(scenario, site, writer)
                    if site.name in policies:
                        taken = f"{site.name}: {POLICY} {TAKEN} at t = 0.000 s"
                        members[site.name].write_hand_events([(0, taken)])
                members[site.name].write_tick(arrivals, output)
                if site.name in hand_players:
                    members[site.name].write_hand_events(hand_players[site.name].news)
                within_limits &= output.mode is not Mode.DIVERGED
                t_ns = output.t_ns
                if stopped():
                    break
    except CodeFailed as failure:
        if failure.site not in members:
            # The event needs the channels of the site. The site is created without its law,
            # because the law failed when it was created.
            without_law = Site(scenario.setup(failure.site)._replace(law_factory=None))
            members[failure.site] = _VirtualChannels(scenario, without_law, writer)
        member = members[failure.site]
        member.write(member.make_new_event_entry("failed", str(failure), t_ns), writer)
        raise
    finally:
        try:
            for member in members.values():
                if not writer.ended:
                    member.write(member.make_end_entry(t_ns), writer)
        finally:
            writer.finish(render_accounts(members.values()))
    return within_limits


class SimulatedLog(Log):
    """Simulates a run in virtual time, and holds its log in memory.

    In virtual time, all sites run in this process, as fast as possible. The object can be used
    like a log read from a file, and `save` writes it to a file.

    Args:
        scenario: The scenario.
        hands: Actions of live operators, see `execute_virtual`. By default, nobody moves the
            arms.

    Raises:
        ScenarioError: The scenario cannot run in virtual time.
        LawFailed: A user's control law failed.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        hands: HandTracks = {},  # noqa: B006
    ) -> None:
        stream = io.BytesIO()
        write_virtual_log(scenario, stream, hands=hands)
        stream.seek(0)
        super().__init__(LogContents.read(stream, "log", trusted=True))
        self._simulated_scenario = scenario
        self._hands = hands

    @staticmethod
    def check_scenario(scenario: Scenario) -> None:
        """Raises ScenarioError if a scenario cannot run in virtual time.

        In virtual time, all sites run in a single process. A real robot cannot take part, but
        an arm whose motion is computed by a user's program can.

        Args:
            scenario: The scenario.

        Raises:
            ScenarioError: An arm is a real robot, a user's control law cannot be created, or
                the file of the law has a different hash than stated in the scenario.
        """
        # Arms that this program does not simulate are real robots, or belong to users'
        # programs.
        real_robots = set(scenario.outside)
        simulated_by_user = set(scenario.external) - real_robots
        scenario.refuse_external_arms(simulated_by_user)
        for name, settings in scenario.sites.items():
            if isinstance(settings.control, ImportedLaw):
                # A site creates its control law, and raises an error if this is not possible.
                # The site itself is not needed.
                Site(scenario.setup(name))

    @classmethod
    def without_operators(cls, log: Log) -> "SimulatedLog":
        """Simulates the experiment of a log, up to its last record, without operators.

        The result shows how the arms would move if nobody guided them.

        Args:
            log: The log that contains the scenario.
        """
        return cls(cut_to_records(log).without_hands())

    @staticmethod
    def record_scenario(
        scenario: Scenario,
        path: Path,
        *,
        force: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        views_hz: float = VIZ_HZ,
        hands: HandTracks = {},  # noqa: B006
        policies: Collection[str] = (),
    ) -> bool:
        """Simulates a scenario faster than real time, and writes the log of the run to a file.

        Args:
            scenario: The scenario, with its sites and links.
            path: File to which the log is written.
            force: If True, an existing file is replaced.
            stopped: Function that is called after each tick. The run ends if it returns True.
            views_hz: Rate of the additional channels for viewers, in Hz.
            hands: Actions of live operators, see `execute_virtual`.
            policies: Sites whose live operator is a trained program. The log contains one event
                for each.

        Returns:
            True if all sites stayed within their limits, False if one diverged.

        Raises:
            UsageError: The file exists, or cannot be created.
            LogRefused: Writing to the disk failed. The error names the part of the log that is
                kept.
            ScenarioError: The scenario cannot run in virtual time. No file is written.
            LawFailed: A user's control law failed. The file contains the ticks before the
                failure.
        """
        with LogFile(path, force=force) as stream:
            return write_virtual_log(
                scenario,
                stream,
                stopped=stopped,
                views_hz=views_hz,
                hands=hands,
                policies=policies,
            )

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the log to a file, as `trilat sim -o` does.

        The scenario is simulated a second time, because the file also contains channels for
        viewers.

        Args:
            path: File to which the log is written.
            force: If True, an existing file is replaced.

        Returns:
            The path of the file.

        Raises:
            UsageError: The file exists, or cannot be created.
            LogRefused: Writing to the disk failed.
        """
        self.record_scenario(
            self._simulated_scenario, Path(path), force=force, hands=self._hands
        )
        return Path(path)


def cut_to_records(log: Log) -> Scenario:
    """Returns the scenario of a log, shortened to end at the last record."""
    ends_s = [
        (log[name].last_tick + 1) / log[name].rate_hz for name in log.sites if len(log[name])
    ]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)

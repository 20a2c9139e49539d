"""Run a scenario in virtual time: without clocks, processes or a real network.

A counter replaces the clock and a simulated network replaces the message bus. The log of the
run holds the records, link statistics and events of every site, as the log of a live session
does.

Invariant:
    - A site advances only by `Site.step`. Ticks run in order of nominal time; ticks of the same
      time run in the order in which the scenario lists the sites.
    - Two runs of one scenario with one seed therefore write the same file, byte for byte.
    - A message of an older schema version is written in the present version. A message of the
      present version keeps its bytes.
"""

import bisect
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from .. import process
from ..core.site_step import Site
from ..core.ticks import (
    NS_PER_S,
    Arrival,
    CoreChange,
    Mode,
    PlantState,
    TickInput,
    TickRecord,
    describe_divergence,
    describe_mode,
)
from ..errors import CodeFailed, count_nouns
from ..log.accounting import Account
from ..log.log_file import LogFile
from ..log.log_layout import MAX_TIME_NS, SITE_CHANNELS
from ..log.log_reader import Log
from ..log.log_writer import LogWriter
from ..log.mcap_reader import read_contents
from ..log.mcap_writer import Sink
from ..log.message_identity import compute_virtual_boot
from ..log.ros2.viz_channels import VIZ_HZ
from ..net import topics
from ..net.messages import SENT_TIME_SINCE, VERSION, Event, LinkStats, State
from ..net.timing import LoopStats
from ..net.topics import number_message, skipped_numbers
from ..net.wire import encode, encode_state
from ..scenario import Scenario
from ..scenario.imported_code import ImportedLaw
from ..scenario.operators.program_hand import make_hand_players
from ..scenario.own_plant import PlantPlayer, make_plant_players
from ..scenario.run_changes import count_skipped_ticks
from ..scenario.validate import refuse_external_arms
from .resumption import read_output, select_peer_channels
from .virtual_network import Network, PromptNetwork


class SiteEntry(NamedTuple):
    """One message to be written into a log. Entries are written in order of `t_ns`.

    Attributes:
        site: name of the site that sends the message.
        t_ns: nominal time of the message, ns since the epoch.
        sent_ns: time at which the site sent the message, ns since the epoch.
        channel: channel of the site: "state", "link" or "event".
        sequence: tick of a record or of statistics, number of an event.
        payload: the encoded message.
        message: the decoded message.
    """

    site: str
    t_ns: int
    sent_ns: int
    channel: str
    sequence: int
    payload: bytes
    message: Any


class SiteChannels:
    """The channels of one site in a log that is written now, and their accounts.

    The `make_…` methods turn ticks and messages into entries, and `write` writes an entry.

    Args:
        scenario: the scenario of the log.
        session: name of the session of the log.
        site: name of the site.
        boot: number of the site's start, which every message of the site states.

    Attributes:
        peers: names of the site's peers, in scenario order.
        keys: key of each channel.
        accounts: account of the messages of each channel.
        ticks: number of ticks that the site has executed.
    """

    def __init__(self, scenario: Scenario, session: str, site: str, boot: int) -> None:
        spec = scenario.sites[site]
        self.peers = scenario.peers(site)
        self.keys = {channel: topics.key(session, site, channel) for channel in SITE_CHANNELS}
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self.ticks = 0
        self._site = site
        self._boot = boot
        self._rate_hz = spec.rate_hz
        self._glides = spec.on_stale.action == "glide"
        self._mode = Mode.RUN
        self._event_count = 0
        self._last_ns = 0

    def make_tick_entries(
        self, output: TickRecord, stats: LinkStats | None, law_failure: Exception | None = None
    ) -> Sequence[SiteEntry]:
        """Returns the entries that follow the record of an executed tick.

        Args:
            output: the record of the tick.
            stats: the link statistics of the tick, if statistics are due.
            law_failure: the error of the user law that changed the site's mode, if any.

        Returns:
            The entry of the statistics and the entry of an event that states a change of mode,
            as far as the tick has them.
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
        if output.mode is Mode.DIVERGED:
            text = describe_divergence(self._site, output)
            return self.make_new_event_entry("diverged", text, output.t_ns)
        text = describe_mode(self._site, output, glides=self._glides, law_failure=law_failure)
        return self.make_new_event_entry("mode", text, output.t_ns)

    def _exclude_skipped_ticks(self, tick: int, cmd: Sequence[str]) -> None:
        """Excludes from the accounts the ticks before `tick` that the site skipped by `cmd`."""
        skipped = count_skipped_ticks(cmd)
        if not skipped:
            return
        for channel in (topics.STATE, topics.LINK):
            numbers = skipped_numbers(channel, tick, skipped, self._rate_hz)
            self.accounts[channel].mark_unpublished(*numbers)

    def make_end_entry(self, t_ns: int | None = None) -> SiteEntry:
        """Returns the entry of the end event, by default at the time of the last tick."""
        end_ns = self._last_ns if t_ns is None else t_ns
        text = f"{self._site} made {count_nouns(self.ticks, 'tick')}"
        return self.make_new_event_entry("end", text, end_ns)

    def make_new_event_entry(self, kind: str, text: str, t_ns: int) -> SiteEntry:
        """Returns the entry of a new event of the site, which gets the next event number."""
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
        """Returns the entry of a record, which is encoded again if its version is older.

        Args:
            state: the record.
            payload: the bytes of the record.
        """
        self._exclude_skipped_ticks(state.tick, state.cmd)
        sent_ns = state.sent_ns if state.v >= SENT_TIME_SINCE else state.t_ns
        if state.v != VERSION:
            arrivals = [
                Arrival(peer=peer, tick=tick, q=(), qd=(), latency_us=us)
                for peer, tick, us in state.rx
            ]
            payload = encode_state(
                site=state.site,
                boot=state.boot,
                peers=self.peers,
                output=read_output(state, self.peers),
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
        """Returns the entry of link statistics."""
        present = stats
        if stats.v != VERSION:
            present = msgspec.structs.replace(stats, v=VERSION)
        return SiteEntry(
            site=self._site,
            t_ns=stats.t_ns,
            sent_ns=stats.t_ns,
            channel=topics.LINK,
            sequence=stats.tick,
            payload=encode(present),
            message=stats,
        )

    def make_event_entry(self, event: Event, number: int) -> SiteEntry:
        """Returns the entry of an event. An event without a number gets `number`."""
        numbered = event if event.n >= 0 else msgspec.structs.replace(event, n=number)
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
        """Writes an entry into a log whose epoch is `epoch_unix_ns`, and counts the message."""
        number = number_message(entry.channel, entry.sequence, self._rate_hz)
        self.accounts[entry.channel].receive(number)
        log_ns = min(max(0, epoch_unix_ns + entry.t_ns), MAX_TIME_NS)
        key = self.keys[entry.channel]
        writer.add(key, entry.payload, entry.sent_ns, log_ns, entry.sequence, entry.message)


def render_accounts(sites: Iterable[SiteChannels]) -> dict[str, str]:
    """Returns the texts of the accounts of all channels of these sites, by topic."""
    return {
        f"/{site.keys[channel]}": f"{account.describe()}, overflowed 0"
        for site in sites
        for channel, account in site.accounts.items()
    }


class SiteTick(NamedTuple):
    """One tick of one site: the site, its arrivals and its record."""

    site: Site
    arrivals: list[Arrival]
    output: TickRecord


ChangeSchedule = Mapping[str, Mapping[int, Sequence[CoreChange]]]
"""Changes by site and by the tick at which they take effect."""
PlantSchedule = Mapping[str, Mapping[int, PlantState]]
"""Measured state of each external arm, by site and tick."""
HandTracks = Mapping[str, Callable[[Site, int], Sequence[float]]]
"""Per site with a live hand: a function that returns the action of the hand at the site's next
tick, from the site and the number of that tick.
"""


def check_virtual(scenario: Scenario) -> None:
    """Checks that virtual time can run a scenario, before anything is written.

    Raises:
        ScenarioError: an arm is outside of the program, a user law cannot be constructed, or
            the file of a user law has another hash than the scenario states.
    """
    refuse_external_arms(scenario, set(scenario.external) - set(scenario.outside))
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            Site(scenario.setup(name))


def find_skips(commands: Mapping[int, Sequence[CoreChange]]) -> dict[int, int]:
    """Returns the ranges of ticks that a site skipped.

    Args:
        commands: the changes of the site, by tick; a change states how many ticks were skipped
            before its own tick.

    Returns:
        The first tick after each range, by the first tick of the range.
    """
    return {
        tick - change.skipped: tick
        for tick, changes in commands.items()
        for change in changes
        if change.skipped
    }


def execute_virtual(
    scenario: Scenario,
    network: Network | None = None,
    commands: ChangeSchedule = {},  # noqa: B006
    measured: PlantSchedule = {},  # noqa: B006
    ends: Mapping[str, int] = {},
    hands: HandTracks = {},  # noqa: B006
    plants: Mapping[str, PlantPlayer] = {},
) -> Iterator[SiteTick]:
    """Executes all sites of a scenario in virtual time and yields every tick of every site.

    Ticks run in order of nominal time; ticks of the same time run in scenario order. A site
    whose network is not ready waits while other sites run. A run that diverges ends with the
    ticks of that instant.

    Args:
        scenario: the scenario.
        network: the network between the sites; by default every sample arrives at the first
            tick after its stamp.
        commands: changes that take effect during the run.
        measured: measured states of external arms.
        ends: last tick of each site that executes fewer ticks than the scenario has.
        hands: actions of live hands; a live hand without an entry does not hold its arm.
        plants: plants that move the external arms of sites.

    Raises:
        ScenarioError: an arm is external and neither `measured` nor `plants` has it.
        LawFailed: a user law failed.
        PlantFailed: a user's plant failed.
    """
    refuse_external_arms(scenario, {**measured, **plants})
    if network is None:
        rates_hz = {name: spec.rate_hz for name, spec in scenario.sites.items()}
        network = PromptNetwork(rates_hz)
    setups = [scenario.setup(name) for name in scenario.names]
    sites = [Site(setup) for setup in setups]
    tick_counts = [
        min(scenario.ticks(name), ends.get(name, scenario.ticks(name)) + 1)
        for name in scenario.names
    ]
    skips = [find_skips(commands.get(name, {})) for name in scenario.names]
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
    """Returns the position in `pending` of the first site that can execute its next tick.

    Args:
        pending: the next tick of each site, as (t_ns, index of the site, tick), in order of
            time.
        sites: the sites, by index.
        network: the network between the sites.

    Returns:
        The position; 0 if the network is ready for no site, so that the run always goes on.
    """
    for position, (_, index, k) in enumerate(pending):
        if network.is_ready(sites[index].name, k):
            return position
    return 0


def compute_boot(scenario: Scenario, site: str) -> int:
    """Returns the boot number of a site in virtual time."""
    return compute_virtual_boot(scenario.sha256, site)


class _VirtualChannels(SiteChannels):
    """The channels of one site of a virtual run, written while the run is executed."""

    def __init__(self, scenario: Scenario, site: Site, writer: LogWriter) -> None:
        boot = compute_boot(scenario, site.name)
        super().__init__(scenario, scenario.name, site.name, boot)
        self._writer = writer
        self._executed_site = site
        self._stats = LoopStats(site, boot)

    def write_tick(self, arrivals: list[Arrival], output: TickRecord) -> None:
        """Writes the record of a tick and the entries that follow the record."""
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
        due = self._stats.is_due(output.tick, count_skipped_ticks(output.cmd))
        stats = self._stats.pop_stats(output) if due else None
        law_failure = self._executed_site.law_failure
        for entry in self.make_tick_entries(output, stats, law_failure):
            self.write(entry, self._writer)

    def write_hand_events(self, news: list[tuple[int, str]]) -> None:
        """Writes the events of a live hand, given as (tick, text), and empties the list."""
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
) -> bool:
    """Runs a scenario in virtual time and writes the log of the run.

    The log is finished however the run ends: after the last tick, by `stopped`, or by an error.

    Args:
        scenario: the scenario.
        stream: where the log is written; the stream stays open.
        network: the network between the sites, see `execute_virtual`.
        stopped: the run ends after the first tick at which this returns True.
        views_hz: rate of the standard channels for viewers, Hz, see `log.ros2.viz_channels`.
        hands: actions of live hands, see `execute_virtual`; they replace hands that the
            scenario names as programs.
        commands: changes that take effect during the run.

    Returns:
        True if the run stayed within its limits, False if it diverged.

    Raises:
        LogError: the disk refused to store the log.
        ScenarioError: virtual time cannot run the scenario; nothing is written.
        LawFailed: a user law failed; the log holds an event with the reason.
    """
    check_virtual(scenario)
    hand_players = make_hand_players(scenario)
    plants = make_plant_players(scenario)
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
        views_hz=views_hz,
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
                members[site.name].write_tick(arrivals, output)
                if site.name in hand_players:
                    members[site.name].write_hand_events(hand_players[site.name].news)
                within_limits &= output.mode is not Mode.DIVERGED
                t_ns = output.t_ns
                if stopped():
                    break
    except CodeFailed as failure:
        if failure.site not in members:
            # the event needs a site, and the law that failed cannot be constructed again
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


def record_virtual(
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = VIZ_HZ,
    hands: HandTracks = {},  # noqa: B006
) -> bool:
    """Runs a scenario in virtual time and writes the log of the run into a file.

    Args:
        scenario: the scenario.
        path: the file.
        force: whether an existing file is replaced.
        stopped: the run ends after the first tick at which this returns True.
        views_hz: rate of the standard channels for viewers, Hz.
        hands: actions of live hands, see `execute_virtual`.

    Returns:
        True if the run stayed within its limits, False if it diverged.

    Raises:
        UsageError: the file exists, or cannot be created.
        LogRefused: the disk refused to store the log; the error names the part that is kept.
        ScenarioError: virtual time cannot run the scenario; no file is written.
        LawFailed: a user law failed; the file is finished with the ticks before the failure.
    """
    with LogFile(path, force=force) as stream:
        return write_virtual_log(
            scenario, stream, stopped=stopped, views_hz=views_hz, hands=hands
        )


class SimulatedLog(Log):
    """The log of a run in virtual time, held in memory. `save` writes it into a file.

    Args:
        write: runs the scenario and writes its log into a stream, with the standard channels
            for viewers at a rate, Hz.
    """

    def __init__(self, write: Callable[[Sink, float], object]) -> None:
        stream = io.BytesIO()
        write(stream, 0.0)
        stream.seek(0)
        super().__init__(read_contents(stream, "log", trusted=True))
        self._write = write

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the log into a file, as `trilat sim -o` does, and returns its path.

        The scenario runs a second time, because the file also has the standard channels for
        viewers.

        Args:
            path: the file.
            force: whether an existing file is replaced.

        Raises:
            UsageError: the file exists, or cannot be created.
            LogRefused: the disk refused to store the log.
        """
        with LogFile(Path(path), force=force) as stream:
            self._write(stream, VIZ_HZ)
        return Path(path)


def simulate_scenario(
    scenario: Scenario,
    *,
    hands: HandTracks = {},  # noqa: B006
) -> SimulatedLog:
    """Runs a scenario in virtual time and returns its log, see `write_virtual_log`."""

    def write(stream: Sink, views_hz: float) -> None:
        write_virtual_log(scenario, stream, views_hz=views_hz, hands=hands)

    return SimulatedLog(write)

"""The virtual-time driver: a counter in place of the clock, a simulated network in place of the
bus.

Invariant: sites advance by `Site.step` alone, in order of nominal time and then of the
scenario, so that two runs of one scenario and seed give the same file, byte for byte.

What it writes of a site are records, link statistics and events. Messages of older schema
versions are written in the present one; a message of the present version keeps its bytes.
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
    """One message of the file; entries are written in order of `t_ns`, ns since the epoch."""

    site: str
    t_ns: int
    sent_ns: int
    channel: str
    sequence: int
    payload: bytes
    message: Any


class SiteChannels:
    """Turns the ticks and messages of one site into entries, writes them, and keeps their
    accounts.
    """

    def __init__(self, scenario: Scenario, session: str, site: str, boot: int) -> None:
        self.peers = scenario.peers(site)
        rate_hz = scenario.sites[site].rate_hz
        self._glides = scenario.sites[site].on_stale.action == "glide"
        self._site = site
        self._boot = boot
        self._rate_hz = rate_hz
        self.keys = {channel: topics.key(session, site, channel) for channel in SITE_CHANNELS}
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self._mode = Mode.RUN
        self._events = 0
        self._t_ns = 0
        self.ticks = 0

    def follow(
        self, output: TickRecord, stats: LinkStats | None, law_failure: Exception | None = None
    ) -> Sequence[SiteEntry]:
        """Returns the entries after the record of an executed tick: statistics if any, change
        of mode.
        """
        self.ticks = output.tick + 1
        self._t_ns = output.t_ns
        self._excuse_skipped(output.tick, output.cmd)
        entries = [] if stats is None else [self.stats(stats)]
        if output.mode is not self._mode:
            self._mode = output.mode
            diverged = output.mode is Mode.DIVERGED
            text = (
                describe_divergence(self._site, output)
                if diverged
                else describe_mode(
                    self._site, output, glides=self._glides, law_failure=law_failure
                )
            )
            entries.append(
                self.new_event("diverged" if diverged else "mode", text, output.t_ns)
            )
        return entries

    def _excuse_skipped(self, tick: int, cmd: Sequence[str]) -> None:
        if skipped := count_skipped_ticks(cmd):
            for channel in (topics.STATE, topics.LINK):
                self.accounts[channel].mark_unpublished(
                    *skipped_numbers(channel, tick, skipped, self._rate_hz)
                )

    def end(self, t_ns: int | None = None) -> SiteEntry:
        """Returns the entry of the event that ends the site's run, by default at its last tick."""
        when_ns = self._t_ns if t_ns is None else t_ns
        return self.new_event(
            "end", f"{self._site} made {count_nouns(self.ticks, 'tick')}", when_ns
        )

    def new_event(self, kind: str, text: str, t_ns: int) -> SiteEntry:
        """Returns the entry of a new event of the site."""
        n = self._events
        self._events += 1
        event = Event(
            member=self._site,
            boot=self._boot,
            n=n,
            kind=kind,
            text=text,
            t_ns=t_ns,
            ticks=self.ticks,
        )
        return self.event(event, n)

    def record(self, state: State, payload: bytes) -> SiteEntry:
        """Returns the entry of a record of the source log."""
        self._excuse_skipped(state.tick, state.cmd)
        sent_ns = state.sent_ns if state.v >= SENT_TIME_SINCE else state.t_ns
        if state.v != VERSION:
            arrivals = [
                Arrival(peer=peer, tick=tick, q=(), qd=(), latency_us=us)
                for peer, tick, us in state.rx
            ]
            output = read_output(state, self.peers)
            late_us = state.late_us
            busy_us = state.busy_us
            payload = encode_state(
                site=state.site,
                boot=state.boot,
                peers=self.peers,
                output=output,
                arrivals=arrivals,
                late_us=late_us,
                busy_us=busy_us,
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

    def stats(self, stats: LinkStats) -> SiteEntry:
        """Returns the entry of link statistics."""
        payload = encode(
            stats if stats.v == VERSION else msgspec.structs.replace(stats, v=VERSION)
        )
        return SiteEntry(
            site=self._site,
            t_ns=stats.t_ns,
            sent_ns=stats.t_ns,
            channel=topics.LINK,
            sequence=stats.tick,
            payload=payload,
            message=stats,
        )

    def event(self, event: Event, n: int) -> SiteEntry:
        """Returns the entry of an event; `n` is its number if it has none of its own."""
        numbered = event if event.n >= 0 else msgspec.structs.replace(event, n=n)
        payload = encode(msgspec.structs.replace(numbered, v=VERSION))
        t_ns = max(event.t_ns, 0)
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
        """Writes an entry into a log."""
        self.accounts[entry.channel].receive(
            number_message(entry.channel, entry.sequence, self._rate_hz)
        )
        log_ns = min(max(0, epoch_unix_ns + entry.t_ns), MAX_TIME_NS)
        key = self.keys[entry.channel]
        writer.add(key, entry.payload, entry.sent_ns, log_ns, entry.sequence, entry.message)


def describe_accounts(sites: Iterable[SiteChannels]) -> dict[str, str]:
    """Returns the accounts of all channels, by topic."""
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
"""Per site and tick the changes that take effect then."""
PlantSchedule = Mapping[str, Mapping[int, PlantState]]
"""Per site with an external arm, and per tick, the measured state of that arm."""
HandTracks = Mapping[str, Callable[[Site, int], Sequence[float]]]
"""Per site with a live hand what that does at a tick of the site, which is about to make it."""


def check_virtual(scenario: Scenario) -> None:
    """Refuses a scenario that virtual time cannot run, before anything is written.

    Raises:
        ScenarioError: an arm is outside of the program, or a user law cannot be made, or its
            file has another hash.
    """
    refuse_external_arms(scenario, set(scenario.external) - set(scenario.outside))
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            Site(scenario.setup(name))


def find_skips(commands: Mapping[int, Sequence[CoreChange]]) -> dict[int, int]:
    """Returns the tick that follows, by each first one of those that a site did not make."""
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
    """Yields every tick of every site: in order of nominal time, then of the scenario.

    A site whose network is not ready lets the others go first; by default every sample arrives
    at the next tick. A run that diverges ends with the ticks of that instant. `ends` holds the
    last tick of sites that make fewer than the scenario has. Live hands do what `hands` says;
    else nobody holds an arm.

    Raises:
        ScenarioError: an arm is external and `measured` and `plants` lack it.
        LawFailed: a user law failed.
        PlantFailed: a plant of one's own did.
    """
    refuse_external_arms(scenario, {**measured, **plants})
    joined = network or PromptNetwork(
        {name: spec.rate_hz for name, spec in scenario.sites.items()}
    )
    setups = [scenario.setup(name) for name in scenario.names]
    sites = [Site(setup) for setup in setups]
    ticks = [min(scenario.ticks(n), ends.get(n, scenario.ticks(n)) + 1) for n in scenario.names]
    # (t_ns, order, k) of each site's next tick
    pending = [(0, index, 0) for index in range(len(sites)) if ticks[index]]
    skips = [find_skips(commands.get(name, {})) for name in scenario.names]
    last_ns = round(scenario.duration_s * NS_PER_S)
    while pending and pending[0][0] <= last_ns:
        place = 0
        if not joined.is_ready(sites[pending[0][1]].name, pending[0][2]):
            place = next(
                (n for n, (_, i, k) in enumerate(pending) if joined.is_ready(sites[i].name, k)),
                0,
            )
        t_ns, index, k = pending.pop(place)
        site = sites[index]
        arrivals = select_peer_channels(joined.deliver(site.name, k), setups[index].links)
        ordered = commands.get(site.name, {})
        arm = measured.get(site.name, {})
        hand = hands[site.name](site, k) if site.name in hands else ()
        plant = plants.get(site.name)
        at = arm.get(k) if plant is None else plant.state
        output = site.step(
            TickInput(
                k=k, arrivals=arrivals, commands=ordered.get(k, ()), measured=at, hand=hand
            )
        )
        if plant is not None:
            plant.move(k, output.tau)
        joined.send(site.name, output)
        yield SiteTick(site, arrivals, output)
        if output.mode is Mode.DIVERGED:
            last_ns = t_ns
        after = skips[index].get(k + 1, k + 1)
        if after < ticks[index]:
            bisect.insort(pending, (after * NS_PER_S // site.rate_hz, index, after))


def compute_boot(scenario: Scenario, site: str) -> int:
    """Returns the boot of a site in virtual time: a function of scenario and name."""
    return compute_virtual_boot(scenario.sha256, site)


class _VirtualChannels(SiteChannels):
    """The channels of one site of a virtual run, written as it is executed."""

    def __init__(self, scenario: Scenario, site: Site, writer: LogWriter) -> None:
        boot = compute_boot(scenario, site.name)
        super().__init__(scenario, scenario.name, site.name, boot)
        self._writer = writer
        self._runs = site
        self._stats = LoopStats(site, boot)

    def tick(self, arrivals: list[Arrival], output: TickRecord) -> None:
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
        for entry in self.follow(output, stats, self._runs.law_failure):
            self.write(entry, self._writer)

    def tell(self, news: list[tuple[int, str]]) -> None:
        """Writes what a hand has done as events."""
        for k, text in news:
            self.write(
                self.new_event("hand", text, k * NS_PER_S // self._rate_hz), self._writer
            )
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
    """Runs a scenario in virtual time and writes its log, which is finished however the run
    ends.

    The stream stays open. Once `stopped` is True the run ends, and the file is finished with
    what there is. `views_hz` is the rate of the standard channels, Hz, see
    `log.ros2.viz_channels`; `network`, `hands` and `commands` are as for `execute_virtual`.

    Returns:
        True if the run stayed within its limits, False if it diverged.

    Raises:
        LogError: the disk refused.
        ScenarioError: virtual time cannot run the scenario; nothing is written.
        LawFailed: a user law failed; the log holds an event with the reason.
    """
    check_virtual(scenario)
    own = make_hand_players(scenario)
    plants = make_plant_players(scenario)
    acts = {**{name: player.track for name, player in own.items()}, **hands}
    writer = LogWriter(
        stream=stream,
        scenario=scenario,
        session=scenario.name,
        driver="virtual",
        epoch_unix_ns=0,
        views_hz=views_hz,
    )
    members: dict[str, _VirtualChannels] = {}
    within = True
    t_ns = 0
    try:
        with process.pause_gc():
            ticks = execute_virtual(
                scenario, network, commands=commands, hands=acts, plants=plants
            )
            for site, arrivals, output in ticks:
                if site.name not in members:
                    members[site.name] = _VirtualChannels(scenario, site, writer)
                members[site.name].tick(arrivals, output)
                if site.name in own:
                    members[site.name].tell(own[site.name].news)
                within &= output.mode is not Mode.DIVERGED
                t_ns = output.t_ns
                if stopped():
                    break
    except CodeFailed as failed:
        if failed.site not in members:
            without_law = Site(scenario.setup(failed.site)._replace(own=None))
            members[failed.site] = _VirtualChannels(scenario, without_law, writer)
        member = members[failed.site]
        member.write(member.new_event("failed", str(failed), t_ns), writer)
        raise
    finally:  # the file is finished however the run ends
        try:
            for member in members.values():
                if not writer.ended:
                    member.write(member.end(t_ns), writer)
        finally:
            writer.finish(describe_accounts(members.values()))
    return within


def record_virtual(
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = VIZ_HZ,
    hands: HandTracks = {},  # noqa: B006
) -> bool:
    """Runs a scenario in virtual time into a file, see `write_virtual_log`; `force` lets it
    replace one.

    Raises:
        UsageError: the file exists, or cannot be made.
        LogRefused: the disk refused; the error names what is kept.
        ScenarioError: virtual time cannot run the scenario; there is no file.
        LawFailed: a user law failed; the file is finished with the ticks before.
    """
    with LogFile(path, force=force) as stream:
        return write_virtual_log(
            scenario, stream, stopped=stopped, views_hz=views_hz, hands=hands
        )


class SimulatedLog(Log):
    """The log of a run in virtual time, which `save` makes a file of.

    Args:
        make: makes it, into a stream and with views at a rate, Hz.
    """

    def __init__(self, make: Callable[[Sink, float], object]) -> None:
        stream = io.BytesIO()
        make(stream, 0.0)
        stream.seek(0)
        super().__init__(read_contents(stream, "log", own=True))
        self._make = make

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the file that `trilat sim -o` writes, and returns its path; `force` lets it
        replace one.

        The run is made once more, with the standard channels that viewers show.

        Raises:
            UsageError: the file exists, or cannot be made.
            LogRefused: the disk refused it.
        """
        with LogFile(Path(path), force=force) as stream:
            self._make(stream, VIZ_HZ)
        return Path(path)


def simulate_scenario(scenario: Scenario, *, hands: HandTracks = {}) -> SimulatedLog:  # noqa: B006
    """Runs a scenario in virtual time and returns its log, see `write_virtual_log`."""

    def make(stream: Sink, views_hz: float) -> None:
        write_virtual_log(scenario, stream, views_hz=views_hz, hands=hands)

    return SimulatedLog(make)

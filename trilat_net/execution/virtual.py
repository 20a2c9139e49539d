"""The virtual-time driver: a counter in place of the clock, a simulated network in place of the bus.

Invariant: sites advance by `Site.step` alone, in order of nominal time and then of the scenario, so that two
runs of one scenario and seed give the same file, byte for byte.
"""

import bisect
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

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
from ..errors import LawFailed, ScenarioError
from ..log.accounting import Account
from ..log.log_file import open_new_log
from ..log.log_writer import LogWriter
from ..log.mcap_writer import Sink
from ..log.ros2.viz_channels import VIZ_HZ
from ..net import topics
from ..net.loop_stats import LoopStats
from ..net.messages import Event
from ..net.wire import encode, encode_state
from ..scenario import Scenario
from ..scenario.laws import ImportedLaw
from .virtual_network import Network, PromptNetwork


class SiteTick(NamedTuple):
    """One tick of one site: who, what it took in, and its record."""

    site: Site
    arrivals: list[Arrival]
    output: TickRecord


ChangeSchedule = Mapping[str, Mapping[int, Sequence[CoreChange]]]
"""Per site and tick the commands that come in then."""
PlantSchedule = Mapping[str, Mapping[int, PlantState]]
"""Per site whose arm is outside of the program, and per tick, what that arm was measured to do."""


def check_virtual(scenario: Scenario, *, as_named: bool = True) -> None:
    """Refuses what virtual time cannot run, before anything is written of it.

    Args:
        scenario: the experiment.
        as_named: whether laws from outside must be the ones that it names by their hashes.

    Raises:
        ScenarioError: an arm is outside of the program, or a law from outside cannot be made, or its file is
            not the one that the scenario names.
    """
    for name in scenario.external:
        raise _external_error(name)
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            if as_named:
                spec.control.check_unchanged(name)
            Site(scenario.setup(name))


def _external_error(site: str) -> ScenarioError:
    return ScenarioError(
        "is external: that arm is outside of the program, and virtual time has none; run it live, or "
        "simulate it with plant = 'simulated'",
        path=f"sites.{site}.plant",
    )


def execute_virtual(
    scenario: Scenario,
    network: Network | None = None,
    commands: ChangeSchedule = {},  # noqa: B006
    measured: PlantSchedule = {},  # noqa: B006
    ends: Mapping[str, int] = {},
) -> Iterator[SiteTick]:
    """Yields every tick of every site: in order of nominal time, then of the scenario.

    A site whose network is not ready lets the others go first. A run that diverges ends with the ticks of
    that instant.

    Args:
        scenario: the experiment.
        network: what joins the sites; by default every sample arrives at the next tick.
        commands: what is ordered from outside.
        measured: what arms outside of the program were measured to do.
        ends: the last tick of sites that make fewer than the scenario has.

    Raises:
        ScenarioError: an arm is outside of the program, and nobody measured it.
        LawFailed: a law from outside did.
    """
    for name in scenario.external:
        if name not in measured:
            raise _external_error(name)
    joined = network or PromptNetwork({name: spec.rate_hz for name, spec in scenario.sites.items()})
    sites = [Site(scenario.setup(name)) for name in scenario.names]
    ticks = [min(scenario.ticks(n), ends.get(n, scenario.ticks(n)) + 1) for n in scenario.names]
    # (t_ns, order, k) of each site's next tick
    pending = [(0, index, 0) for index in range(len(sites)) if ticks[index]]
    last_ns = round(scenario.duration_s * NS_PER_S)
    while pending and pending[0][0] <= last_ns:
        place = 0
        if not joined.ready(sites[pending[0][1]].name, pending[0][2]):
            place = next((n for n, (_, i, k) in enumerate(pending) if joined.ready(sites[i].name, k)), 0)
        t_ns, index, k = pending.pop(place)
        site = sites[index]
        arrivals = joined.deliver(site.name, k)
        ordered, arm = commands.get(site.name, {}), measured.get(site.name, {})
        output = site.step(TickInput(k, arrivals, ordered.get(k, ()), arm.get(k)))
        joined.send(site.name, output)
        yield SiteTick(site, arrivals, output)
        if output.mode is Mode.DIVERGED:
            last_ns = t_ns
        if k + 1 < ticks[index]:
            bisect.insort(pending, ((k + 1) * NS_PER_S // site.rate_hz, index, k + 1))


def virtual_boot(scenario: Scenario, site: str) -> int:
    """Returns the boot that a site has in virtual time: a function of scenario and name."""
    return int.from_bytes(hashlib.sha256(f"{scenario.sha256}/{site}".encode()).digest()[:8], "big")


class _SiteLogWriter:
    """One site's side of the log that a virtual run writes."""

    def __init__(self, scenario: Scenario, site: Site, writer: LogWriter) -> None:
        self._boot = virtual_boot(scenario, site.name)
        self._site = site
        self._writer = writer
        self._stats = LoopStats(site, self._boot, [scenario.sites[p].rate_hz for p in site.peers])
        self._keys = {
            channel: topics.key(scenario.name, site.name, channel)
            for channel in (topics.STATE, topics.LINK, topics.EVENT)
        }
        self._accounts = {channel: Account() for channel in self._keys}
        self._mode = Mode.RUN
        self.ticks = 0

    def write(self, arrivals: list[Arrival], output: TickRecord) -> None:
        """Writes one record, and what goes with it."""
        site, t_ns, k = self._site, output.t_ns, output.tick
        payload = encode_state(site.name, self._boot, site.peers, output, arrivals, 0, 0)
        self._accounts[topics.STATE].take(k)
        self._writer.add(self._keys[topics.STATE], payload, t_ns, t_ns, k, output)
        self.ticks = k + 1
        if self._stats.due(k):
            stats = self._stats.take(output)
            self._accounts[topics.LINK].take(self._accounts[topics.LINK].received)
            self._writer.add(self._keys[topics.LINK], encode(stats), t_ns, t_ns, k, stats)
        if output.mode is not self._mode:
            self._mode = output.mode
            diverged = output.mode is Mode.DIVERGED
            text = describe_divergence if diverged else describe_mode
            self.say("diverged" if diverged else "mode", text(site.name, output), t_ns)

    def say(self, kind: str, text: str, t_ns: int) -> None:
        """Writes one event."""
        n = self._accounts[topics.EVENT].received
        event = Event(
            member=self._site.name, boot=self._boot, n=n, kind=kind, text=text, t_ns=t_ns, ticks=self.ticks
        )
        self._accounts[topics.EVENT].take(n)
        self._writer.add(self._keys[topics.EVENT], encode(event), t_ns, t_ns, n, event)

    def accounts(self) -> dict[str, str]:
        """Returns the accounts of its channels, by topic."""
        texts = {channel: account.as_text() for channel, account in self._accounts.items()}
        return {f"/{self._keys[channel]}": f"{text}, overflowed 0" for channel, text in texts.items()}


def write_virtual_log(
    scenario: Scenario,
    stream: Sink,
    network: Network | None = None,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = 0.0,
    *,
    as_named: bool = True,
) -> bool:
    """Runs a scenario in virtual time and writes its log, which is finished whatever ends the run.

    Args:
        scenario: the experiment.
        stream: where the log goes; stays open.
        network: what joins the sites.
        stopped: True once the run was asked to end; then the file is finished with what there is.
        views_hz: messages a second of the standard channels beside the log's own, see `log.views`.
        as_named: whether laws from outside must be the ones that the scenario names by their hashes.

    Returns:
        True where the run stayed within its limits, False where it diverged.

    Raises:
        LogError: the disk refused.
        ScenarioError: virtual time cannot run it; then nothing is written.
        LawFailed: a law from outside did; the log says so.
    """
    check_virtual(scenario, as_named=as_named)
    writer = LogWriter(stream, scenario, scenario.name, "virtual", 0, views_hz=views_hz)
    members: dict[str, _SiteLogWriter] = {}
    within = True
    t_ns = 0
    try:
        with process.pause_gc():
            for site, arrivals, output in execute_virtual(scenario, network):
                if site.name not in members:
                    members[site.name] = _SiteLogWriter(scenario, site, writer)
                members[site.name].write(arrivals, output)
                within &= output.mode is not Mode.DIVERGED
                t_ns = output.t_ns
                if stopped():
                    break
    except LawFailed as failed:
        if failed.site not in members:
            nobody = Site(scenario.setup(failed.site)._replace(own=None))
            members[failed.site] = _SiteLogWriter(scenario, nobody, writer)
        members[failed.site].say("failed", str(failed), t_ns)
        raise
    finally:  # whatever ends the run leaves a file that is finished
        try:
            for name, member in members.items():
                if not writer.ended:
                    member.say("end", f"{name} made {member.ticks} ticks", t_ns)
        finally:
            writer.finish(
                {topic: text for member in members.values() for topic, text in member.accounts().items()}
            )
    return within


def record_virtual(
    scenario: Scenario,
    path: Path,
    *,
    force: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    views_hz: float = VIZ_HZ,
) -> bool:
    """Runs a scenario in virtual time into a file; False where the run diverged.

    Args:
        scenario: the experiment.
        path: the file.
        force: whether it may replace one.
        stopped: True once the run was asked to end.
        views_hz: messages a second of the standard channels, see `log.views`; 0 for none.

    Raises:
        UsageError: the file exists, or cannot be made.
        LogRefused: the disk refused; says what is kept.
        ScenarioError: virtual time cannot run it; then there is no file.
        LawFailed: a law from outside did; the file is finished, with what was before.
    """
    with open_new_log(path, force=force) as stream:
        return write_virtual_log(scenario, stream, stopped=stopped, views_hz=views_hz)

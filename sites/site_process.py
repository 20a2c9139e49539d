"""One site as one process, from its scenario to its exit code.

Invariant: a site declares itself alive only when its subscriptions stand and its step is compiled. Until
the epoch its arm is braked; at the end it stays until every recorder has all records, or for some seconds
(`shutdown`).
"""

import platform
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass

import msgspec

from trilat_net.core.fingerprint import compute_fingerprint
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import Mode, TickRecord, describe_divergence, describe_mode
from trilat_net.errors import RunFailed, SessionError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, make_system_clock
from trilat_net.net.connection import Connection, open_bus
from trilat_net.net.loop_stats import LoopStats
from trilat_net.net.membership import EventPublisher, new_boot
from trilat_net.net.messages import Info
from trilat_net.net.pinging import Pinger, describe_clocks
from trilat_net.net.session import Epoch, SessionJoin
from trilat_net.net.timing import ClockNotice, PeerClock, SiteTiming
from trilat_net.process import Interrupt
from trilat_net.scenario import Scenario
from trilat_net.scenario.laws import ImportedLaw

from . import realtime
from .change_server import ChangeServer
from .external_arm import MEASUREMENTS_KEPT, ExternalArm
from .law_watchdog import LawWatchdog
from .peer_monitor import PeerMonitor
from .retransmit_buffer import RetransmitBuffer
from .shutdown import await_recorders
from .site_loop import LoopIO, PeerInbox, run_loop
from .warmup import warm_up


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """How a site takes part.

    Attributes:
        session: the session's name.
        connection: how it takes part in the network.
        join_timeout_s: how long to wait for the others, s.
        needs_recorder: whether a recorder must be there.
        cpu: the processor to stay on, or None.
        stay_s: how long to stay afterwards, until the recorder has left, s at most.
        clock_offset_s: injected: how far the clock is ahead of the machine's, s.
        clock_drift_ppm: injected: by how much it runs faster, ppm.
    """

    session: str
    connection: Connection
    join_timeout_s: float = 60.0
    needs_recorder: bool = False
    cpu: int | None = None
    stay_s: float = 0.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0


def collect_peer_clocks(scenario: Scenario, name: str, epoch: Epoch, pinger: Pinger) -> list[PeerClock]:
    """Returns what is known of the peers of a site, in scenario order."""
    return [
        PeerClock(
            peer,
            epoch.epochs[peer],
            scenario.peers(peer).index(name),
            pinger.estimate(epoch.boots[peer]),
            pinger.estimator(epoch.boots[peer]),
        )
        for peer in scenario.peers(name)
    ]


POLL_NS = 5_000_000


def run_site(scenario: Scenario, name: str, options: SiteOptions, say: Callable[[str], None]) -> int:
    """Runs one site from its start to its end.

    Args:
        scenario: the experiment.
        name: which of its sites this is.
        options: how it takes part.
        say: tells a person what happens.

    Returns:
        The exit code: 0, or 128 and the number of the signal that ended it.

    Raises:
        SessionError: the session could not begin.
        UsageError: an endpoint cannot be used.
        ScenarioError: its law from outside cannot be made, or is not the one that the scenario names.
        RunFailed: the run diverged, its law from outside failed, or its arm fell silent.
    """
    law = scenario.sites[name].control
    if isinstance(law, ImportedLaw):
        law.check_unchanged(name)
    with Interrupt() as interrupt:
        clock = make_system_clock(options.clock_offset_s, options.clock_drift_ppm)
        bus = open_bus(
            options.connection,
            clock,
            interrupt.requested,
            options.join_timeout_s,
            lambda text: say(f"{name}: {text}"),
        )
        if bus is None:
            return interrupt.exit_code
        try:
            return SiteProcess(scenario, name, options, bus, clock, interrupt, say).live()
        finally:
            bus.close()


class SiteProcess:
    """A site's life in a session."""

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        options: SiteOptions,
        bus: Bus,
        clock: Clock,
        interrupt: Interrupt,
        say: Callable[[str], None],
    ) -> None:
        self._scenario, self._name, self._options = scenario, name, options
        self._bus, self._clock, self._interrupt, self._say = bus, clock, interrupt, say
        self._site = Site(scenario.setup(name))
        self._failure: RunFailed | None = None
        law = scenario.sites[name].control
        self._overtime = LawWatchdog(self._site, law.code, clock) if isinstance(law, ImportedLaw) else None
        self._boot = new_boot()
        rates = [scenario.sites[peer].rate_hz for peer in self._site.peers]
        self._stats = LoopStats(self._site, self._boot, rates)
        session = options.session
        rings = [
            bus.stamped(topics.key(session, peer, topics.STATE), clock.monotonic_ns)
            for peer in self._site.peers
        ]
        self._intake = PeerInbox(self._site.peers, rings, rates, self._stats.dropped)
        self._arm: ExternalArm | None = None
        if name in scenario.external:
            key = topics.key(session, name, topics.MEASURED)
            ring = bus.stamped(key, clock.monotonic_ns, MEASUREMENTS_KEPT)
            where = " at ".join([key, *map(str, options.connection.places[:1])])
            self._arm = ExternalArm(name, ring, clock, self._stats.dropped, where)
        questions = bus.questions(topics.key(session, name, topics.PAST))
        self._history = RetransmitBuffer(name, self._boot, self._site.rate_hz, questions)
        self._publish_state = self._kept(topics.STATE)
        self._publish_link = self._kept(topics.LINK)
        self._company = PeerMonitor(bus, session, name, self._site.peers)
        self._changes = ChangeServer(scenario, name, bus.questions(topics.key(session, name, topics.SET)))
        self._mode = Mode.RUN
        warm_up(scenario, name, clock)

    def _declare(self) -> None:
        """Says that this site is there."""
        scenario, options = self._scenario, self._options
        info = Info(
            member=self._name,
            boot=self._boot,
            scenario_sha256=scenario.sha256,
            scenario=scenario.text,
            host=platform.node(),
            clock=self._clock.identity(),
            fingerprint=compute_fingerprint(),
            needs_recorder=options.needs_recorder,
        )
        keep = self._history.rings[topics.EVENT].keep
        self._publisher = EventPublisher(self._bus, options.session, info, keep)
        self._joining = SessionJoin(self._bus, self._clock, options.session, self._publisher, scenario.names)

    def _kept(self, channel: str) -> Callable[[bytes], None]:
        """Returns what publishes on a channel of this site and keeps it for a while."""
        keep = self._history.rings[channel].keep
        publish = self._bus.publisher(topics.key(self._options.session, self._name, channel))

        def keep_and_publish(payload: bytes) -> None:
            keep(payload)
            publish(payload)

        return keep_and_publish

    def live(self) -> int:
        """Joins, runs, leaves."""
        give_up_ns = self._clock.monotonic_ns() + int(self._options.join_timeout_s * 1e9)
        if self._arm is not None and not self._arm.speaks(self._interrupt.requested, give_up_ns, self._say):
            return self._interrupt.exit_code
        self._declare()
        epoch = self._join(give_up_ns)
        if epoch is None:
            return self._interrupt.exit_code
        self._epoch = epoch
        self._company.admit(epoch.boots)
        peers = collect_peer_clocks(self._scenario, self._name, epoch, self._joining.pinger)
        self._timing = SiteTiming(epoch.mono_ns, self._site.rate_hz, peers, self._scenario.names[0])
        clocks = describe_clocks(self._joining.pinger, epoch.boots, epoch.mono_ns)
        self._intake.admit([epoch.boots[peer] for peer in self._site.peers], self._timing.meters)
        self._publisher.info = msgspec.structs.replace(
            self._publisher.info,
            running=True,
            epoch_mono_ns=epoch.mono_ns,
            epoch_unix_ns=epoch.unix_ns,
            boots=epoch.boots,
        )
        obtained = realtime.prepare(self._options.cpu)
        self._publisher.publish(
            "setup",
            ", ".join([*(f"{key}: {value}" for key, value in obtained.items()), *clocks]),
            epoch_mono_ns=epoch.mono_ns,
            clock=self._clock.identity(),
        )
        self._say(f"{self._name}: the session begins; {obtained['scheduling']}, memory {obtained['memory']}")
        self._report(self._timing.opening(), 0)
        if self._arm is not None and (text := self._arm.bind(self._scenario.sites[self._name].q0_rad)):
            self._publisher.publish("arm", f"{self._name}: {text}")
            clocks.append(text)
        for sentence in clocks:
            self._say(f"{self._name}: {sentence}")
        ports = LoopIO(
            self._clock,
            self._intake,
            self._timing,
            self._publish_state,
            self._publish_link,
            self._slack,
            self._ended,
            self._changes.take,
            self._tell,
            self._history.answer,
            lambda: None if self._arm is None else self._arm.newest,
            None if self._overtime is None else self._overtime.step,
            self._fail,
        )
        ticks = self._scenario.ticks(self._name)
        with self._overtime or nullcontext():
            output = run_loop(self._site, self._boot, ticks, self._stats, ports)
        return self._leave(output)

    def _ended(self) -> bool:
        """True where the run ends before its last tick."""
        if self._arm is not None:
            self._arm.look()
            self._failure = self._failure or self._arm.failure
        return bool(self._failure or self._company.ended_by) or self._interrupt.requested()

    def _fail(self, failure: RunFailed) -> None:
        """Remembers why this site ends the run for all."""
        self._failure = failure

    def _join(self, give_up_ns: int) -> Epoch | None:
        """Waits for the others; None where a signal came first."""
        clock = self._clock
        meeting = self._joining.membership
        self._say(f"{self._name}: waiting for {', '.join(meeting.missing()) or 'the epoch'}")
        while not self._interrupt.requested():
            epoch = self._joining.poll()
            if epoch is not None:
                return epoch
            now_ns = clock.monotonic_ns()
            if now_ns > give_up_ns:
                missing = meeting.missing()
                who = f"{', '.join(missing)} never came" if missing else "the others came, but no epoch"
                for member, reason in meeting.unreadable.items():
                    who += f"; the answer of {member} cannot be understood: {reason}"
                raise SessionError(
                    f"{self._name} waited {self._options.join_timeout_s:g} s in session "
                    f"{self._options.session!r}: {who}"
                )
            clock.sleep_until(now_ns + self._joining.pinger.pause_ns(POLL_NS))
        return None

    def _slack(self, k: int, t_ns: int) -> None:
        """Ten times a second: answers questions, follows the leader's grid, and says who is gone."""
        self._publisher.info = msgspec.structs.replace(self._publisher.info, ticks=k + 1)
        self._publisher.answer_queries()
        self._report(self._timing.settle(k + 1, self._clock.monotonic_ns()), t_ns)
        self._company.watch(self._publisher, t_ns)

    def _report(self, clocks: Iterable[ClockNotice], t_ns: int) -> None:
        """Says what is new of the peers' clocks."""
        for news in clocks:
            self._publisher.publish(news.kind, news.text, t_ns=t_ns, **news.facts)

    def _tell(self, output: TickRecord) -> None:
        """Says what a tick changed."""
        for text in output.cmd:
            said = f"{self._name} takes in {text}"
            self._publisher.publish("change", said, t_ns=output.t_ns, ticks=output.tick, command=text)
        if output.mode is not self._mode:
            self._mode = output.mode
            self._publisher.publish(
                "mode", describe_mode(self._name, output), t_ns=output.t_ns, ticks=output.tick
            )

    def _leave(self, output: TickRecord | None) -> int:
        """Says how the run ended, and stays until the recorder has all of it."""
        ticks = 0 if output is None else output.tick + 1
        t_ns = -1 if output is None else output.t_ns
        if output is not None and output.mode is Mode.DIVERGED:
            self._failure = RunFailed(describe_divergence(self._name, output))
            self._publisher.publish("diverged", str(self._failure), t_ns=t_ns, ticks=ticks)
        elif self._failure is not None:
            self._publisher.publish("failed", str(self._failure), t_ns=t_ns, ticks=ticks)
        if self._overtime is not None and (told := self._overtime.told()):
            self._publisher.publish("law", told, t_ns=t_ns, ticks=ticks)
            self._say(f"{self._name}: {told}")
        self._publisher.publish("end", f"{self._name} made {ticks} ticks", t_ns=t_ns, ticks=ticks)
        code = self._interrupt.exit_code if self._interrupt.requested() else 0  # later signals end the wait
        self._company.watch(self._publisher, t_ns)
        if topics.RECORDER in self._epoch.boots or self._company.recorders:
            self._await_recorders(ticks, t_ns)
        dropped = ", ".join(f"{count} {reason}" for reason, count in self._stats.dropped.items())
        self._say(
            f"{self._name}: {ticks} ticks, {self._stats.overruns} of them late by a period or more"
            + (f"; dropped: {dropped}" if dropped else "")
        )
        if self._failure is not None:
            raise self._failure
        if self._company.ended_by:
            raise RunFailed(f"{self._name} ended because {self._company.ended_by}")
        return code

    def _await_recorders(self, ticks: int, t_ns: int) -> None:
        """Waits for the recorders; meanwhile answers them."""

        def attend() -> None:
            self._publisher.answer_queries()
            self._company.watch(self._publisher, t_ns)

        stopped, stay_ns = self._interrupt.requested, int(self._options.stay_s * 1e9)
        await_recorders(self._company, self._history.answer, attend, self._clock, stopped, ticks, stay_ns)

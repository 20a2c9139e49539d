"""One site as one process: from its scenario to its exit code.

Law: a site declares itself alive only when its subscriptions stand and its step is compiled. Until the
epoch its arm is braked; at the end it stays until the recorder has every record, or `LINGER_S`.
"""

import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec

from trilat_net.core.fingerprint import fingerprint
from trilat_net.core.site import Site
from trilat_net.core.tick import Mode, Output, diverged_text, mode_text
from trilat_net.errors import RunFailed, SessionError
from trilat_net.interrupt import Interrupt
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, system_clock
from trilat_net.net.connection import Connection, open_bus
from trilat_net.net.messages import Info
from trilat_net.net.pinging import clock_texts
from trilat_net.net.session import Epoch, Joining
from trilat_net.net.stats import LoopStats
from trilat_net.net.timing import News, Timing
from trilat_net.net.voice import Voice, new_boot
from trilat_net.scenario import Scenario

from . import realtime
from .changes import Changes
from .clocks import peers_of
from .company import Company
from .history import History
from .intake import Intake
from .loop import Ports, run_loop
from .warming import warm_up

LINGER_S = 5
POLL_NS = 5_000_000
LAST_WORD_NS = 100_000_000
PARTING_NS = 2_000_000_000
ASKED_NS = 1_000_000_000
"""A recorder that has asked within this time is there, whatever its token says."""


@dataclass(frozen=True, slots=True)
class Options:
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


def run_site(scenario: Scenario, name: str, options: Options, say: Callable[[str], None]) -> int:
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
        RunFailed: the run diverged.
    """
    with Interrupt() as interrupt:
        clock = system_clock(options.clock_offset_s, options.clock_drift_ppm)
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
            return Member(scenario, name, options, bus, clock, interrupt, say).live()
        finally:
            bus.close()


class Member:
    """A site's life in a session."""

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        options: Options,
        bus: Bus,
        clock: Clock,
        interrupt: Interrupt,
        say: Callable[[str], None],
    ) -> None:
        self._scenario, self._name, self._options = scenario, name, options
        self._bus, self._clock, self._interrupt, self._say = bus, clock, interrupt, say
        self._site = Site(scenario.setup(name))
        self._boot = new_boot()
        rates = [scenario.sites[peer].rate_hz for peer in self._site.peers]
        self._stats = LoopStats(self._site, self._boot, rates)
        session = options.session
        rings = [
            bus.stamped(topics.key(session, peer, topics.STATE), clock.monotonic_ns)
            for peer in self._site.peers
        ]
        self._intake = Intake(self._site.peers, rings, rates, self._stats.dropped)
        questions = bus.questions(topics.key(session, name, topics.PAST))
        self._history = History(name, self._boot, self._site.rate_hz, questions)
        self._publish_state = self._kept(topics.STATE)
        self._publish_link = self._kept(topics.LINK)
        self._company = Company(bus, session, name, self._site.peers)
        self._changes = Changes(scenario, name, bus.questions(topics.key(session, name, topics.SET)))
        self._mode = Mode.RUN
        warm_up(scenario, name)
        self._voice = Voice(
            bus,
            session,
            Info(
                member=name,
                boot=self._boot,
                scenario_sha256=scenario.sha256,
                scenario=scenario.text,
                host=platform.node(),
                clock=clock.identity(),
                fingerprint=fingerprint(),
                needs_recorder=options.needs_recorder,
            ),
            self._history.rings[topics.EVENT].keep,
        )
        self._joining = Joining(bus, clock, session, self._voice, scenario.names)

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
        epoch = self._join()
        if epoch is None:
            return self._interrupt.exit_code
        self._epoch = epoch
        self._company.admit(epoch.boots)
        peers = peers_of(self._scenario, self._name, epoch, self._joining.pinger)
        self._timing = Timing(epoch.mono_ns, self._site.rate_hz, peers, self._scenario.names[0])
        clocks = clock_texts(self._joining.pinger, epoch.boots, epoch.mono_ns)
        self._intake.admit([epoch.boots[peer] for peer in self._site.peers], self._timing.meters)
        self._voice.info = msgspec.structs.replace(
            self._voice.info,
            running=True,
            epoch_mono_ns=epoch.mono_ns,
            epoch_unix_ns=epoch.unix_ns,
            boots=epoch.boots,
        )
        obtained = realtime.prepare(self._options.cpu)
        self._voice.say(
            "setup",
            ", ".join([*(f"{key}: {value}" for key, value in obtained.items()), *clocks]),
            epoch_mono_ns=epoch.mono_ns,
            clock=self._clock.identity(),
        )
        self._say(f"{self._name}: the session begins; {obtained['scheduling']}, memory {obtained['memory']}")
        self._report(self._timing.opening(), 0)
        for sentence in clocks:
            self._say(f"{self._name}: {sentence}")
        ports = Ports(
            self._clock,
            self._intake,
            self._timing,
            self._publish_state,
            self._publish_link,
            self._slack,
            lambda: self._interrupt.requested() or bool(self._company.ended_by),
            self._changes.take,
            self._tell,
            self._history.answer,
        )
        ticks = self._scenario.ticks(self._name)
        output = run_loop(self._site, self._boot, ticks, self._stats, ports)
        return self._leave(output)

    def _join(self) -> Epoch | None:
        """Waits for the others; None where a signal came first."""
        clock = self._clock
        give_up_ns = clock.monotonic_ns() + int(self._options.join_timeout_s * 1e9)
        meeting = self._joining.meeting
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
        self._voice.info = msgspec.structs.replace(self._voice.info, ticks=k + 1)
        self._voice.answer()
        self._report(self._timing.settle(k + 1, self._clock.monotonic_ns()), t_ns)
        self._company.watch(self._voice, t_ns)

    def _report(self, clocks: Iterable[News], t_ns: int) -> None:
        """Says what is new of the peers' clocks."""
        for news in clocks:
            self._voice.say(news.kind, news.text, t_ns=t_ns, **news.facts)

    def _tell(self, output: Output) -> None:
        """Says what a tick changed."""
        for text in output.cmd:
            said = f"{self._name} takes in {text}"
            self._voice.say("change", said, t_ns=output.t_ns, ticks=output.tick, command=text)
        if output.mode is not self._mode:
            self._mode = output.mode
            self._voice.say("mode", mode_text(self._name, output), t_ns=output.t_ns, ticks=output.tick)

    def _leave(self, output: Output | None) -> int:
        """Says how the run ended, and stays until the recorder has all of it."""
        ticks = 0 if output is None else output.tick + 1
        t_ns = -1 if output is None else output.t_ns
        diverged = output is not None and output.mode is Mode.DIVERGED
        if output is not None and diverged:
            self._voice.say("diverged", diverged_text(self._name, output), t_ns=t_ns, ticks=ticks)
        self._voice.say("end", f"{self._name} made {ticks} ticks", t_ns=t_ns, ticks=ticks)
        code = self._interrupt.exit_code if self._interrupt.requested() else 0  # later signals end the wait
        self._company.watch(self._voice, t_ns)
        if topics.RECORDER in self._epoch.boots or self._company.recorders:
            self._await_recorders(ticks, t_ns)
        dropped = ", ".join(f"{count} {reason}" for reason, count in self._stats.dropped.items())
        self._say(
            f"{self._name}: {ticks} ticks, {self._stats.overruns} of them late by a period or more"
            + (f"; dropped: {dropped}" if dropped else "")
        )
        if output is not None and diverged:
            raise RunFailed(diverged_text(self._name, output))
        if self._company.ended_by:
            raise RunFailed(f"{self._name} ended because {self._company.ended_by}")
        return code

    def _await_recorders(self, ticks: int, t_ns: int) -> None:
        """Waits for the word of every recorder that is there that it has all that it can have.

        At most `LINGER_S` after the last question of one of them, and `stay_s` after their word.
        """
        clock, company = self._clock, self._company
        give_up_ns = clock.monotonic_ns() + LINGER_S * 1_000_000_000
        asked_ns = 0
        while clock.monotonic_ns() < give_up_ns and not (company.stored and self._interrupt.requested()):
            self._voice.answer()
            while self._history.answer():
                asked_ns = clock.monotonic_ns()
                give_up_ns = max(give_up_ns, asked_ns + LINGER_S * 1_000_000_000)
            company.watch(self._voice, t_ns)
            away = not company.recorders and clock.monotonic_ns() - asked_ns > ASKED_NS
            if away:  # its last word may still be under way; or its process ends
                patience_ns = PARTING_NS if company.stored else LAST_WORD_NS
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + patience_ns)
            if company.hear_recorders(ticks) and company.recorders <= company.stored:
                give_up_ns = clock.monotonic_ns() + int(self._options.stay_s * 1e9)
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

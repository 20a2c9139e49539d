"""Runs one site as one process: joins a session, controls the arm, and leaves.

A site is a process that runs one arm and its control loop. `run_site` connects to the network,
builds the parts of the site, agrees with the other members on the epoch (the time of tick 0),
runs the loop, and waits until the recorders have stored everything.

The control loop itself is in `site_loop`. It calls a `RunningSite` of this module in every tick
and ten times a second.

Invariant:
    - A site announces itself only after it has declared its subscriptions and compiled its
      control step. A site that is announced can thus be expected to execute its first tick in
      time, and to receive all messages.
    - The arm is braked until the epoch.
    - After its last tick, the process continues until every recorder that is present has
      stored all messages of the site, or until a time limit. Otherwise the end of the log
      could be lost.
"""

import signal
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing

import msgspec
import numpy as np
from msgspec.structs import asdict

from sites.line_printer import LinePrinter
from trilat_net.core.step.fingerprint import compute_fingerprint
from trilat_net.core.step.site_setup import StaleAction
from trilat_net.core.step.ticks import (
    NS_PER_S,
    Arrival,
    LifeReason,
    Mode,
    TickInput,
    TickRecord,
    describe_divergence,
    describe_mode,
    find_alarm,
    find_life_reason,
    tick_ns,
)
from trilat_net.errors import CodeFailed, PeerLeft, RunFailed, SessionError, count_nouns
from trilat_net.log.site_log import compute_task_errors
from trilat_net.net import topics
from trilat_net.net.clock import make_system_clock
from trilat_net.net.connection import open_bus
from trilat_net.net.known_sites import make_site_known
from trilat_net.net.membership import Epoch, EventPublisher, LateSites, describe_member
from trilat_net.net.messages import MODE_WORDS, Event
from trilat_net.net.pinging import Pinger, describe_clocks
from trilat_net.net.requests import ChangeRequest
from trilat_net.net.session import SessionJoin
from trilat_net.net.timing import ClockNotice, PeerClock, SiteTiming, find_turn_ns
from trilat_net.net.wire import encode
from trilat_net.net.zenoh_bus import share_threads
from trilat_net.recorded_change import count_skipped_ticks
from trilat_net.scenario import Scenario
from trilat_net.scenario.run_changes import describe_change
from trilat_net.scenario.scenario_types import Change
from trilat_net.scenario.validate import check_outside_arms
from trilat_net.signals import Interrupt

from . import realtime
from .external_arm import ExternalArm
from .hand_server import RemoteHand
from .site_loop import PeerInbox, run_loop
from .site_parts import SiteOptions, SiteParts

POLL_NS = 5_000_000
"""Longest pause between two polls while the site joins or leaves a session, in ns."""
NO_BOOT = -1
"""Used in place of the boot (the number of a process start) of a peer that is not present."""
STATUS_PERIOD_S = 5
"""Time between two status lines for the user, in s."""
LINGER_NS = 10 * NS_PER_S
"""Longest time that a site waits at its end after the last query of a recorder, in ns.

A recorder whose process was suspended, or whose connection broke, needs seconds to connect
again: the lease of Zenoh, 5 s, and one attempt after that.
"""
ANNOUNCE_AFTER_NS = NS_PER_S
"""Time after which a site tells the user that it is waiting for a recorder, in ns."""
LEAVE_TIMEOUT_NS = 2 * NS_PER_S
"""Time that a site waits after the last recorder has stored everything and left, in ns."""
QUERIED_NS = NS_PER_S
"""A recorder counts as present for this time after its last query, even without a token."""


def run_site(
    scenario: Scenario,
    name: str,
    options: SiteOptions,
    say: Callable[[str], None],
) -> int:
    """Runs one site of a scenario from its start to its end.

    A site is a process that runs one arm and its control loop.

    Args:
        scenario: Scenario of the session.
        name: Name of the site.
        options: How the site connects to the session, and how long it waits for others.
        say: Function that prints a line for the user.

    Returns:
        Exit code of the process: 0, or 128 plus the number of the signal that ended the site.

    Raises:
        SessionError: The session could not begin.
        UsageError: An endpoint cannot be used.
        ScenarioError: The user's control law cannot be imported or differs from the law that
            the scenario names, or the scenario lacks the limits of an external arm.
        RunFailed: The run diverged, the user's law failed, or the arm fell silent.
    """
    check_outside_arms(scenario)
    # A site that rejoins a session needs its keys for less time: see `_join_session`.
    if not scenario.sites_may_return:
        options.connection.require_keys_until(scenario.duration_s)
    share_threads()
    with Interrupt() as interrupt:
        clock = make_system_clock(options.clock_offset_s, options.clock_drift_ppm)

        bus = open_bus(
            connection=options.connection,
            clock=clock,
            stopped=interrupt.is_requested,
            timeout_s=options.join_timeout_s,
            say=lambda text: say(f"{name}: {text}"),
        )
        if bus is None:
            return interrupt.exit_code
        with closing(bus), LinePrinter(say) as printer:
            with interrupt.raising():  # compilation may take minutes
                parts = SiteParts(
                    scenario=scenario,
                    name=name,
                    options=options,
                    bus=bus,
                    clock=clock,
                    interrupt=interrupt,
                    say=printer.put,
                )
            if options.connection.listen:
                endpoints = ", ".join(map(str, options.connection.listen))
                parts.say(f"others connect to {endpoints}")
            return join_and_run(parts)


def join_and_run(parts: SiteParts) -> int:
    """Joins a session with the parts of a site, runs the site, and leaves the session.

    A site with an external arm, or with an operator program in another process, first waits for
    the first message from there.

    Args:
        parts: Parts of the site, such as its network connection and its arm.

    Returns:
        Exit code of the process, as `run_site` returns it.

    Raises:
        SessionError: The session could not begin.
        RunFailed: The run failed.
    """
    timeout_ns = int(parts.options.join_timeout_s * 1e9)
    give_up_ns = parts.clock.monotonic_ns() + timeout_ns
    stopped = parts.interrupt.is_requested
    for device in (parts.arm, parts.hand):
        if not isinstance(device, ExternalArm | RemoteHand):
            continue
        if not device.wait_for_first(stopped, give_up_ns, parts.say):
            return parts.interrupt.exit_code
    running = _join_session(parts, give_up_ns)
    if running is None:
        return parts.interrupt.exit_code
    running.run()
    return running.leave_session()


def _join_session(parts: SiteParts, give_up_ns: int) -> "RunningSite | None":
    """Announces the site, and waits for the other members and for the start of the session.

    The members agree on the epoch, the common start time of the session.

    Args:
        parts: Parts of the site, such as its network connection and its arm.
        give_up_ns: Time at which the site gives up, on the monotonic clock of this process.

    Returns:
        The site, ready to run. None if a signal ended the wait.

    Raises:
        SessionError: The session did not begin in time, or this site cannot be part of it.
    """
    scenario = parts.scenario
    options = parts.options
    info = describe_member(
        parts.name,
        parts.boot,
        parts.clock,
        compute_fingerprint(),
        scenario.text,
        needs_recorder=options.needs_recorder,
    )
    store_event = parts.buffer.channels[topics.EVENT].store
    publisher = EventPublisher(parts.bus, options.session, info, store_event)
    joining = SessionJoin(
        bus=parts.bus,
        clock=parts.clock,
        session=options.session,
        publisher=publisher,
        sites=scenario.names,
        late=LateSites(scenario.sites_may_return, options.without, parts.site.rate_hz),
    )
    pinger = joining.pinger
    missing = ", ".join(joining.membership.list_missing())
    parts.say(f"waiting for {missing or 'the epoch'}")

    first_tick = 0
    while not parts.interrupt.is_requested():
        epoch = joining.poll()
        if epoch is not None:
            since_ns = parts.clock.monotonic_ns() - epoch.mono_ns
            options.connection.require_keys_until(scenario.duration_s - since_ns / NS_PER_S)
            return RunningSite(parts, publisher, pinger, epoch)
        if joining.announced_first_tick != first_tick:
            first_tick = joining.announced_first_tick
            # The first tick of a site that joins late. It is prepared before the epoch, because
            # the preparation takes 0.1 s for every hour that the session has been running.
            parts.site.start_at(first_tick)
        now_ns = parts.clock.monotonic_ns()
        if now_ns > give_up_ns:
            raise _describe_failed_join(parts, joining)
        parts.clock.sleep_until(now_ns + pinger.pause_ns(POLL_NS))
    return None


def _describe_failed_join(parts: SiteParts, joining: SessionJoin) -> SessionError:
    """Returns the error for a site that has waited in vain for its session to begin.

    The text names why a running session has not admitted the site, if that is known, and
    otherwise the members that are missing. Replies of members that could not be decoded are
    added, as they often explain why a member seems to be missing.

    Args:
        parts: Parts of the site.
        joining: The attempt to join the session.
    """
    options = parts.options
    missing = joining.membership.list_missing()
    reason = joining.reason
    if not reason and missing:
        reason = f"{', '.join(missing)} did not join"
    elif not reason:
        reason = "the other members joined, but no common start time (epoch) was agreed on"
    for member, problem in joining.membership.unreadable.items():
        reason += f"; the reply of {member} cannot be read: {problem}"
    waited_s = f"{options.join_timeout_s:g} s"
    return SessionError(
        f"{parts.name} waited {waited_s} in session {options.session!r}: {reason}"
    )


class RunningSite:
    """Runs a site from the epoch, the common start of the session, until it leaves the session.

    `_join_session` creates this object. The loop calls its methods: `should_stop` and `step` in
    every tick, `report_tick` after ticks in which something changed, and `run_housekeeping` ten
    times a second. After the last tick, `leave_session` completes the work.

    If at least a quarter of the period is left after a block of records was published, the loop
    also calls `use_slack`, which answers one query of a recorder for lost messages. It returns
    True if it has answered one. The loop then calls it again after the next tick, because more
    queries may wait.

    Args:
        parts: Parts of the site.
        publisher: Publishes the events of the site.
        pinger: Offsets of the other members' clocks, as estimated by pings.
        epoch: The agreed epoch, and the members of the session.

    Attributes:
        publish_sample: Function that publishes a sample, the state that peers receive.
        publish_link: Function that publishes statistics of the loop and its links.
        use_slack: Function that the loop calls if time is left.
    """

    def __init__(
        self,
        parts: SiteParts,
        publisher: EventPublisher,
        pinger: Pinger,
        epoch: Epoch,
    ) -> None:
        site = parts.site
        self._parts = parts
        self._publisher = publisher
        self._epoch = epoch

        self._failure: RunFailed | None = None
        self._mode = Mode.RUN
        self._skipped = list[str]()  # ranges of skipped ticks that are not published yet
        self._output: TickRecord | None = None  # the record of the newest tick
        # Seconds of the session in which a status line, a `waiting` event and an alarm were
        # last issued. They limit how often these are repeated.
        self._status_s = 0
        self._waiting_s = 0
        self._alarm_s = -1
        self._has_given_up = False
        self._rejoined_ns = tick_ns(epoch.first, site.rate_hz)

        # Methods of the parts that the loop calls.
        self.publish_sample = parts.publish_sample
        self.publish_link = parts.publish_link
        self.use_slack = parts.buffer.answer_query

        parts.monitor.boots = epoch.boots
        site.start_at(epoch.first)
        parts.buffer.start_at(epoch.first)
        self._timing = self._make_timing(pinger)
        self._clock_texts = describe_clocks(pinger, epoch.boots, epoch.mono_ns)
        self._inbox = PeerInbox(
            links=parts.setup.links,
            rings=parts.rings,
            boots=[epoch.boots.get(peer, NO_BOOT) for peer in site.peers],
            monitors=self._timing.monitors,
            dropped=parts.stats.dropped,
            from_ns=tick_ns(epoch.first, site.rate_hz),
        )

        publisher.update(
            running=True,
            epoch_mono_ns=epoch.mono_ns,
            epoch_unix_ns=epoch.unix_ns,
            boots=epoch.boots,
        )

    def _make_timing(self, pinger: Pinger) -> SiteTiming:
        """Returns the schedule of the site's ticks, and the timing of its links.

        Sites on one machine have the same clock. They wake up one after another in each period,
        in the order of the scenario, so that they do not compete for the processors. The names
        of the sites on this machine are also stored, for the real-time settings.

        Args:
            pinger: Offsets of the other members' clocks, as estimated by pings.
        """
        parts = self._parts
        epoch = self._epoch
        scenario = parts.scenario
        peer_clocks = []
        local_names = {parts.name}  # sites on this machine
        for name in parts.site.peers:
            # The pings are stored by boot, the number of a process start. A peer that is not
            # present has no pings, and is assumed to have the same epoch on the same clock.
            boot = epoch.boots.get(name, NO_BOOT)
            peer_clock = PeerClock(
                name=name,
                epoch_ns=epoch.epochs.get(name, epoch.mono_ns),
                index_at_peer=scenario.peers(name).index(parts.name),
                estimate=pinger.estimate(boot),
                estimator=pinger.estimator(boot),
            )
            peer_clocks.append(peer_clock)
            is_present = name in epoch.boots
            is_on_this_machine = peer_clock.is_own
            if is_on_this_machine and is_present:
                local_names.add(name)

        self._local_sites = [name for name in scenario.names if name in local_names]
        turn = self._local_sites.index(parts.name)
        highest_rate_hz = max(scenario.sites[name].rate_hz for name in self._local_sites)
        return SiteTiming(
            epoch_ns=epoch.mono_ns,
            rate_hz=parts.site.rate_hz,
            peers=peer_clocks,
            leader=scenario.names[0],  # all sites follow the tick schedule of this one
            turn_ns=find_turn_ns(turn, len(self._local_sites), highest_rate_hz),
        )

    def run(self) -> None:
        """Runs the control loop of the site until the last tick, or until the run ends early.

        A tick is one period of the control loop. The run may end early because of a failure, a
        signal, or a request of another member.
        """
        parts = self._parts
        # Samples may wait for the next block only if all peers share this machine.
        parts.states.holds_samples &= all(meter.peer.is_own for meter in self._timing.monitors)

        self._publish_setup()
        stop_request = ChangeRequest(order="stop", source="the operator")
        known_site = make_site_known(
            parts.options.session,
            parts.name,
            parts.scenario.names,
            parts.boot,
            parts.options.connection,
            encode(stop_request),
        )

        with known_site, parts.watchdog:
            self._output = run_loop(
                site=parts.site,
                boot=parts.boot,
                ticks=parts.scenario.ticks(parts.name),
                clock=parts.clock,
                inbox=self._inbox,
                timing=self._timing,
                stats=parts.stats,
                states=parts.states,
                io=self,
                first=self._epoch.first,
                catches_up=parts.arm is None,
            )

        output = self._output
        self._ticks = 0 if output is None else output.tick + 1
        self._t_ns = -1 if output is None else output.t_ns
        if output is not None:
            self._publish_skipped(output.tick, output.t_ns)

    def _publish_setup(self) -> None:
        """Publishes the real-time settings and the clock offsets, and prints them for the user.

        A site that joins a running session also publishes the event `join`. From here on, an
        external arm accepts measurements only from its present driver. If the arm is not where
        the scenario says that it starts, a warning is published.
        """
        parts = self._parts
        user_lines = self._clock_texts
        obtained = realtime.prepare(parts.options.cpu, len(self._local_sites))
        obtained["turn"] = f"{self._timing.turn_ns // 1000} us after the grid"
        settings = [f"{key}: {value}" for key, value in obtained.items()]
        self._publisher.publish(
            "setup",
            ", ".join([*settings, *user_lines]),
            epoch_mono_ns=self._epoch.mono_ns,
            clock=parts.clock.identity(),
        )

        begins = "the session begins"
        first_tick = self._epoch.first
        if first_tick:
            t_ns = tick_ns(first_tick, parts.site.rate_hz)
            begins = f"joins the running session at t = {t_ns * 1e-9:.3f} s"
            self._publisher.publish(
                "join",
                f"{parts.name} {begins}",
                t_ns=t_ns,
                boots=self._epoch.boots,
                ticks=first_tick,
            )
        parts.say(f"{begins}; {obtained['scheduling']}, memory {obtained['memory']}")
        self._publish_clocks(self._timing.list_initial_notices(), 0)

        if parts.arm is not None:
            warning = parts.arm.bind(parts.scenario.sites[parts.name].q0_rad)
            if warning:
                self._publisher.publish("arm", f"{parts.name}: {warning}")
                user_lines = [*user_lines, warning]
        for line in user_lines:
            parts.say(line)

    def _publish_clocks(self, notices: Iterable[ClockNotice], t_ns: int) -> None:
        """Publishes events about the offsets and faults of the peers' clocks.

        Args:
            notices: Fields of the events.
            t_ns: Time of the events, in ns since the epoch (the common start of the session).
        """
        for notice in notices:
            self._publisher.publish(**notice, t_ns=t_ns)

    def should_stop(self) -> bool:
        """Reads the messages of the arm and its dead-man switch, and decides if the run ends.

        Returns:
            True if the site failed, if a member ended the run for all, if the user stopped the
            session or this process, or if a peer has been away for too long.
        """
        parts = self._parts
        for device in (parts.arm, parts.switch):
            if device is not None:
                device.poll()
        is_ended = self._failure or parts.monitor.ended_by or parts.changes.stopped
        return bool(is_ended) or parts.interrupt.is_requested() or self._has_given_up

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord | None:
        """Executes one tick: reads the inputs, computes the torque, and moves a simulated arm.

        Args:
            k: Number of the tick, a period of the control loop.
            arrivals: Samples of the peers (their published states) that have arrived since the
                previous tick.

        Returns:
            The record of the tick. None if the user's own law, plant or operator failed, which
            ends the run.
        """
        parts = self._parts
        measured = None if parts.arm is None else parts.arm.newest
        hand = () if parts.hand is None else parts.hand.track(parts.site, k)

        try:
            if parts.plant is not None:
                measured = parts.plant.state
            inputs = TickInput(
                k=k,
                arrivals=arrivals,
                commands=parts.pop_changes(k),
                measured=measured,
                hand=hand,
            )
            self._output = parts.step(inputs)
            if parts.plant is not None:
                parts.plant.move(k, self._output.tau)
        except CodeFailed as failed:
            self._failure = failed
            return None
        return self._output

    def run_housekeeping(self, k: int, t_ns: int) -> None:
        """Executes the work that need not be done in every tick.

        The site replies to queries, updates the clock offsets, admits peers that join,
        publishes events, and prints a status line for the user. The loop calls this method ten
        times a second.

        Args:
            k: Tick (period of the control loop) that was executed last.
            t_ns: Nominal time of that tick, in ns since the epoch (the common start of the
                session).
        """
        parts = self._parts
        next_tick = k + 1
        next_nominal_ns = tick_ns(next_tick, parts.site.rate_hz)
        # Start of the session as the present schedule implies it, for sites that join late. It
        # changes slowly, because the schedule follows the clock of the leader.
        grid_ns = self._timing.schedule.due_ns(next_tick) - next_nominal_ns
        self._publisher.update(ticks=next_tick, grid_ns=grid_ns)
        self._publisher.answer_queries()

        # Other members: their clocks, and who takes part.
        notices = self._timing.update_clocks(next_tick, parts.clock.monotonic_ns())
        self._publish_clocks(notices, t_ns)
        self._watch_members(t_ns)
        self._rejoin(t_ns)

        # News of this site. Each is a tick and a sentence.
        if parts.hand is not None:  # who has started or ended to move the arm
            for _, text in parts.hand.news:
                # `say` prints the name of the site itself.
                _, _, text_without_site = text.partition(": ")
                parts.say(text_without_site)
            self._publish_news("hand", parts.hand.news)
        self._publish_news("mark", parts.changes.marks)
        self._publish_skipped(k, t_ns)
        self._publish_waiting(k, t_ns)

        second = t_ns // NS_PER_S
        is_status_due = second >= self._status_s + STATUS_PERIOD_S
        if self._output is not None and is_status_due:
            self._status_s = second
            parts.say(self._describe_status(self._output))

    def _publish_news(self, kind: str, news: list[tuple[int, str]]) -> None:
        """Publishes an event for each entry of a list, and empties the list.

        Args:
            kind: Kind of the events.
            news: The entries: the tick in which something happened, and a sentence about it.
        """
        rate_hz = self._parts.site.rate_hz
        for tick, text in news:
            self._publisher.publish(kind, text, t_ns=tick_ns(tick, rate_hz), ticks=tick)
        news.clear()

    def _publish_skipped(self, k: int, t_ns: int) -> None:
        """Publishes one event about the ticks that the site has skipped since the last call.

        A site skips ticks only if its arm is external, and the loop was late.

        Args:
            k: Tick that was executed last.
            t_ns: Nominal time of that tick, in ns since the epoch (the common start of the
                session).
        """
        if self._skipped:
            ticks = " ".join(self._skipped)
            self._skipped = []
            text = f"{self._parts.name} did not make ticks {ticks}"
            self._publisher.publish("overrun", text, t_ns=t_ns, ticks=k + 1, command=ticks)

    def _publish_waiting(self, k: int, t_ns: int) -> None:
        """Reports once a second that the arm is too far from its peers to approach them.

        This can only happen if the scenario lets an arm glide back to its peers after an
        interrupted connection. The arm then waits until its operator moves it closer.

        Args:
            k: Tick that was executed last.
            t_ns: Nominal time of that tick, in ns since the epoch (the common start of the
                session).
        """
        output = self._output
        if output is None or output.mode not in (Mode.WAITING, Mode.HOLD):
            return
        if self._parts.setup.on_stale.action is not StaleAction.GLIDE:
            return
        second = t_ns // NS_PER_S
        is_too_far = find_life_reason(output) is LifeReason.ALIGN_LIMIT
        if is_too_far and second > self._waiting_s:
            self._waiting_s = second
            text = describe_mode(self._parts.name, output, glides=True)
            self._publisher.publish("waiting", text, t_ns=t_ns, ticks=k)
            self._parts.say(text)

    def _watch_members(self, t_ns: int) -> None:
        """Updates who takes part in the session, and checks if a peer is away for too long.

        A member is present while its token exists in the network, which the monitor observes.
        The monitor also collects the events of new processes of peers that may join.

        Args:
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        parts = self._parts
        monitor = parts.monitor
        monitor.watch(self._publisher, t_ns)
        if monitor.changed:
            # If all links have long delays, the samples of a few ticks are held and published
            # together. A peer has published a change, which may shorten a delay. Therefore
            # every sample is published in its own tick from now on. This is early enough: a
            # change takes effect at least 100 ms after its request, when all samples that are
            # held at present have been published.
            parts.states.holds_samples = False

        # A peer whose samples arrive is present, even if its token was lost.
        if monitor.departed:
            for link_monitor in self._timing.monitors:
                if link_monitor.is_receiving(parts.clock.monotonic_ns()):
                    monitor.mark_present(link_monitor.peer.name, t_ns)

        for join_event in monitor.admitted:
            self._admit_peer(join_event, t_ns)
        monitor.admitted.clear()
        self._has_given_up = self._is_peer_away_too_long(t_ns)  # ends the loop

    def _is_peer_away_too_long(self, t_ns: int) -> bool:
        """Returns True if a peer left longer ago than the user's options tolerate."""
        patience_s = self._parts.options.leave_timeout_s
        departures = self._parts.monitor.departed.values()
        if patience_s is None or not departures:
            return False
        first_left_ns = min(left_ns for left_ns, _ in departures)
        return t_ns - first_left_ns > patience_s * NS_PER_S

    def _admit_peer(self, event: Event, t_ns: int) -> None:
        """Prepares this site for a peer that joins, or rejoins, the running session.

        From the tick that the event names, samples of the new process of the peer are accepted.
        Samples of its previous process are not accepted any more.

        Args:
            event: Event with which the peer announced its join.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        parts = self._parts
        index = parts.site.peers.index(event.member)
        join_ns = tick_ns(event.ticks, parts.scenario.sites[event.member].rate_hz)
        has_same_clock = event.clock == parts.clock.identity()
        bound_ns = None if has_same_clock else event.bound_ns
        self._publish_last_heard(index, event, t_ns)
        notices = self._timing.admit(index, join_ns, event.epoch_mono_ns, bound_ns)
        self._publish_clocks(notices, t_ns)
        self._inbox.admit(index, event.boot, event.ticks)
        parts.say(f"{event.member} joins at t = {join_ns * 1e-9:.3f} s")

    def _rejoin(self, t_ns: int) -> None:
        """Repeats the request to join the session until no peer ignores this site any more.

        A peer whose connection was interrupted has not received the request, and drops the
        samples of this site as those of an unknown process. The request is repeated at most
        once a second, until every peer whose samples arrive has confirmed samples of this site.

        Args:
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        coming = self._epoch.coming  # None if this site was present from the start
        now_ns = self._parts.clock.monotonic_ns()
        if coming is None or t_ns < self._rejoined_ns + NS_PER_S:
            return

        is_ignored = False
        for meter in self._timing.monitors:
            # None means that the peer has never acknowledged a sample of this site.
            has_never_acknowledged = meter.is_acknowledged(now_ns) is None
            if meter.is_receiving(now_ns) and has_never_acknowledged:
                is_ignored = True
        if is_ignored:
            self._rejoined_ns = t_ns
            fields = {**asdict(coming), "t_ns": t_ns, "n": self._publisher.published}
            self._publisher.publish(**fields)

    def _publish_last_heard(self, index: int, coming: Event, t_ns: int) -> None:
        """Publishes the last tick that was received from a peer before the peer was restarted.

        The previous process of the peer may have been killed before it could publish its end.
        From its last tick, the recorder knows how many records to expect.

        Args:
            index: Index of the peer.
            coming: Event with which the new process of the peer announced its join.
            t_ns: Present time, in ns since the epoch (the common start of the session).
        """
        tick = self._inbox.find_last_tick_of(index, coming.boot)
        if tick is None:
            return
        self._publisher.publish(
            "last",
            f"the previous start of {coming.member} was heard up to tick {tick}",
            t_ns=t_ns,
            about=coming.member,
            boots={coming.member: coming.boot},
            ticks=tick + 1,
        )

    def _describe_status(self, output: TickRecord) -> str:
        """Returns the status line that is printed for the user every few seconds.

        It contains the time, the mode, the largest synchronisation error and torque of a joint,
        and the numbers of late ticks and dropped messages.
        """
        parts = self._parts
        position = np.array([output.shared()[0]])
        desired = np.array([output.q_des])
        if output.x:
            unit = "m or rad"
            error = compute_task_errors(position, desired, parts.scenario.arms[parts.name].axes)
        else:
            unit = "rad"
            error = position - desired

        largest_error = np.abs(error).max()
        torque_nm = max(map(abs, output.tau))
        dropped = sum(parts.stats.dropped.values())

        return (
            f"t = {output.t_ns / NS_PER_S:.0f} s, {MODE_WORDS[output.mode]}, "
            f"|e| {largest_error:.3g} {unit}, torque {torque_nm:.3g} N m, "
            f"{count_nouns(parts.stats.overruns, 'tick')} late, "
            f"{count_nouns(dropped, 'message')} dropped"
        )

    def report_tick(self, output: TickRecord) -> None:
        """Publishes an event for each change that took effect in a tick, such as a new delay.

        A new mode of the site, such as "fault", is also a change. Skipped ticks are only stored
        here, because `run_housekeeping` later publishes them together in one event. A tick is a
        period of the control loop.

        Args:
            output: Record of the tick: what the site measured and computed.
        """
        parts = self._parts
        skipped = count_skipped_ticks(output.cmd)
        if skipped:
            self._skipped.append(f"{output.tick - skipped}-{output.tick - 1}")

        for change in output.cmd:
            if count_skipped_ticks([change]):
                continue
            source = parts.changes.sources.pop(change, "")
            sentence = describe_change(msgspec.json.decode(change, type=Change), source)
            self._publisher.publish(
                "change", sentence, command=change, t_ns=output.t_ns, ticks=output.tick
            )
            parts.say(sentence)

        if output.mode is not self._mode:
            self._mode = output.mode
            text = describe_mode(
                parts.name,
                output,
                glides=parts.setup.on_stale.action is StaleAction.GLIDE,
                law_failure=parts.site.law_failure,
            )
            self._publisher.publish("mode", text, t_ns=output.t_ns, ticks=output.tick)
            self._raise_alarm(output)

    def _raise_alarm(self, output: TickRecord) -> None:
        """Prints an alarm with a reason and a remedy, if the new mode requires an alarm.

        Alarms exist only under the rule `glide` for interrupted connections. An arm that holds
        its position may change its mode many times, and raises at most one alarm a second.

        Args:
            output: Record of the tick in which the mode has changed.
        """
        parts = self._parts
        mode = output.mode
        rule = parts.setup.on_stale  # what the arm does while samples of a peer are missing
        if mode is Mode.HOLD:
            second = output.t_ns // NS_PER_S
            had_alarm_in_this_second = second <= self._alarm_s
            if had_alarm_in_this_second:
                return
            self._alarm_s = second

        if rule.action is not StaleAction.GLIDE:
            return

        # Some arms go on without a lost peer. They have an alarm as they return to the others.
        lost_peers: Sequence[str] = ()
        if rule.degrades and mode is Mode.RETURN:
            lost_peers = parts.site.layout.list_lost_peers(output.mem, parts.site.peers)

        alarm = find_alarm(
            session=parts.options.session,
            site=parts.name,
            mode=MODE_WORDS[mode],
            mem=output.mem,
            shared=len(output.q_des),
            lost=lost_peers,
        )
        if alarm is not None:
            parts.say(f"*** {alarm}")

    def leave_session(self) -> int:
        """Publishes how the run ended, waits for the recorders, and tells the user the result.

        Returns:
            Exit code of the process: 0, or 128 plus the number of the signal that ended the
            run.

        Raises:
            PeerLeft: A peer left before the end and did not return.
            RunFailed: The run failed, at this site or at a peer.
        """
        parts = self._parts
        interrupt = parts.interrupt
        monitor = parts.monitor
        self._publish_end()

        # The exit code is read before the wait: a later signal only ends the wait.
        code = interrupt.exit_code if interrupt.is_requested() else 0
        monitor.watch(self._publisher, self._t_ns)
        if topics.RECORDER in monitor.boots or monitor.recorders:
            self._await_recorders()
        ticks = count_nouns(self._ticks, "tick")
        summary = f"{ticks}, {parts.stats.overruns} of them late by a period or more"
        dropped_counts = parts.stats.dropped.items()
        if dropped_counts:
            dropped = ", ".join(f"{count} {reason}" for reason, count in dropped_counts)
            summary += f"; dropped: {dropped}"
        parts.say(summary)

        if self._failure is not None:
            raise self._failure
        if monitor.ended_by:
            raise RunFailed(f"{parts.name} ended because {monitor.ended_by}")
        if not code and self._departures:
            names = " and ".join(monitor.departed)
            raise PeerLeft(
                f"{parts.name} executed {ticks}; {self._departures}; {names} did not rejoin "
                "the session"
            )
        return code

    def _publish_end(self) -> None:
        """Publishes the events at the end of a run.

        They are the failure if there was one, delays of the user's own code, and the event
        `end`, whose sentence says how many ticks were executed and why the run ended early.
        """
        parts = self._parts
        output = self._output
        failure_kind = "failed"
        if output is not None and output.mode is Mode.DIVERGED:
            failure_kind = "diverged"
            self._failure = RunFailed(describe_divergence(parts.name, output))
        if self._failure is not None:
            self._publish_end_event(failure_kind, str(self._failure))

        for code in parts.watchdog.codes:
            hiccups = code.describe_hiccups()
            if hiccups:
                self._publish_end_event("law", hiccups)
                parts.say(hiccups)

        about, cause = self._find_cause()
        meters = self._timing.monitors
        unheard = [meter.peer.name for meter in meters if meter.is_unacknowledged]
        if unheard:
            cause += f"; {', '.join(unheard)} did not hear it at the end"
        text = f"{parts.name} made {count_nouns(self._ticks, 'tick')}{cause}"
        self._publish_end_event("end", text, about=about)

    @property
    def _departures(self) -> str:
        """Sentences about the sites that have left. Empty if all sites are present."""
        return "; ".join(text for _, text in self._parts.monitor.departed.values())

    def _find_cause(self) -> tuple[str, str]:
        """Determines why the run ended before the last tick of the scenario.

        Returns:
            member: Name of the member that ended the run. Empty if the run was completed, or
                was ended by a request to all sites.
            cause: Text that names the cause, to be appended to the sentence "m1 made 500
                ticks". Empty if the run was completed.
        """
        parts = self._parts
        monitor = parts.monitor
        if self._failure is not None:  # of this site
            return parts.name, f": {self._failure}"
        if monitor.ended_by:  # another member ended it, or has replaced this site
            return monitor.ended_member, f": {monitor.ended_by}"
        if parts.changes.stopped:  # users requested that all sites end at the same tick
            return "", ", as many as it was asked for"
        scenario_ticks = parts.scenario.ticks(parts.name)
        if self._ticks == scenario_ticks:
            return "", ""
        if parts.interrupt.is_requested():
            signal_name = signal.Signals(parts.interrupt.number).name
            return parts.name, f", ended by {signal_name}"

        # The site has waited too long for peers that left.
        first_departed = next(iter(monitor.departed), "")
        return first_departed, f": {self._departures}"

    def _publish_end_event(self, kind: str, text: str, about: str = "") -> None:
        """Publishes an event with the number of executed ticks and the time of the last one."""
        self._publisher.publish(kind, text, t_ns=self._t_ns, ticks=self._ticks, about=about)

    def _await_recorders(self) -> None:
        """Waits until every recorder has stored the messages of this site and has left.

        Recorders query the site for messages that were lost on the way, and the site must
        reply. Once all is stored, the site stays for the time that the user's options allow,
        until the recorders have left.

        A first signal does not shorten the wait for the recorders: records that are not stored
        would be lost with this process. A second signal ends it.
        """
        parts = self._parts
        clock = parts.clock
        monitor = parts.monitor
        begun_ns = clock.monotonic_ns()
        give_up_ns = begun_ns + LINGER_NS
        queried_ns = 0
        is_announced = False
        while clock.monotonic_ns() < give_up_ns and not self._may_leave():
            while not parts.interrupt.is_repeated() and parts.buffer.answer_query():
                queried_ns = clock.monotonic_ns()
                give_up_ns = max(give_up_ns, queried_ns + LINGER_NS)
            self._publisher.answer_queries()
            monitor.watch(self._publisher, self._t_ns)

            is_gone = not monitor.recorders and clock.monotonic_ns() - queried_ns > QUERIED_NS
            # A recorder that has gone, but still lacks messages, may come back: then the limit
            # stays as it is.
            if is_gone and monitor.stored:
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + LEAVE_TIMEOUT_NS)
            if monitor.read_stored(self._ticks) and monitor.all_stored:
                give_up_ns = clock.monotonic_ns() + int(parts.options.stay_s * 1e9)

            waited_ns = clock.monotonic_ns() - begun_ns
            is_long = not monitor.all_stored and waited_ns > ANNOUNCE_AFTER_NS
            if is_long and not is_announced:
                is_announced = True
                parts.say(
                    "keeps its last records until the recorder has them, or has asked for none "
                    f"for {LINGER_NS // NS_PER_S} s; Ctrl-C a second time ends it at once"
                )
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _may_leave(self) -> bool:
        """Returns True if the site need not wait for the recorders any longer.

        This is so after a second signal. After a first signal, it is so once the recorders have
        stored everything.
        """
        interrupt = self._parts.interrupt
        is_complete = self._parts.monitor.all_stored and interrupt.is_requested()
        return interrupt.is_repeated() or is_complete

"""One site as one process: it joins a session, runs, and leaves.

Invariant:
    - A site announces itself only when its subscriptions are declared and its step is compiled.
    - The arm is braked until the epoch.
    - After its last tick, the site stays until every recorder present has all messages of this
      site, or until a time limit.
"""

import signal
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing

import msgspec
import numpy as np
from msgspec.structs import asdict

from trilat_net.core.site_setup import StaleAction
from trilat_net.core.ticks import (
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
from trilat_net.process import Interrupt, LinePrinter
from trilat_net.scenario import Scenario
from trilat_net.scenario.run_changes import count_skipped_ticks, describe_change
from trilat_net.scenario.scenario_types import Change
from trilat_net.scenario.validate import check_outside_arms

from . import realtime
from .external_arm import ExternalArm
from .hand_server import RemoteHand
from .site_loop import PeerInbox, run_loop
from .site_parts import SiteOptions, SiteParts

POLL_NS = 5_000_000
NO_BOOT = -1
"""The boot of a peer that is not present yet."""
STATUS_PERIOD_S = 5
"""Time between two status lines, s."""
LINGER_NS = 10 * NS_PER_S
"""Longest wait after the last query of a recorder.

A recorder whose process was suspended, or whose connection broke, needs seconds to connect
again: the lease of Zenoh, 5 s, and one attempt after that.
"""
ANNOUNCE_AFTER_NS = NS_PER_S
"""A longer wait is announced to the user."""
LEAVE_TIMEOUT_NS = 2 * NS_PER_S
"""Wait after the last recorder has left with everything; its process is ending."""
QUERIED_NS = NS_PER_S
"""A recorder whose last query is younger counts as present, even without a liveliness token."""


def run_site(
    scenario: Scenario, name: str, options: SiteOptions, say: Callable[[str], None]
) -> int:
    """Runs one site of a scenario from its start to its end.

    Args:
        scenario: the scenario of the session.
        name: the site's name.
        options: how the site joins the session.
        say: prints a line for the user.

    Returns:
        The exit code: 0, or 128 plus the number of the signal that ended the site.

    Raises:
        SessionError: the session could not begin.
        UsageError: an endpoint cannot be used.
        ScenarioError: the user's law cannot be imported or differs from the scenario's, or an
            external arm lacks limits.
        RunFailed: the run diverged, the user's law failed, or the arm fell silent.
    """
    check_outside_arms(scenario)
    # A site that rejoins a session needs its keys for less time: see `join_session`.
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
    """Joins a session, runs and leaves.

    Returns:
        The exit code of the process.

    Raises:
        SessionError: the session could not begin.
        RunFailed: the run failed.
    """
    timeout_ns = int(parts.options.join_timeout_s * 1e9)
    give_up_ns = parts.clock.monotonic_ns() + timeout_ns
    stopped = parts.interrupt.is_requested
    for device in (parts.arm, parts.hand):
        if not isinstance(device, ExternalArm | RemoteHand):
            continue
        if not device.wait_for_first(stopped, give_up_ns, parts.say):
            return parts.interrupt.exit_code
    running = join_session(parts, give_up_ns)
    if running is None:
        return parts.interrupt.exit_code
    running.run()
    return running.leave_session()


def join_session(parts: SiteParts, give_up_ns: int) -> "RunningSite | None":
    """Announces the site, and waits for the other members and the epoch.

    Args:
        parts: the parts of the site.
        give_up_ns: when to give up, on this process's monotonic clock.

    Returns:
        The running site; None if a signal ended the wait.

    Raises:
        SessionError: the session did not begin in time, or this site cannot be part of it.
    """
    scenario = parts.scenario
    options = parts.options
    info = describe_member(
        parts.name,
        parts.boot,
        parts.clock,
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
    membership = joining.membership
    pinger = joining.pinger
    parts.say(f"waiting for {', '.join(membership.list_missing()) or 'the epoch'}")
    first_tick = 0
    while not parts.interrupt.is_requested():
        epoch = joining.poll()
        if epoch is not None:
            since_ns = parts.clock.monotonic_ns() - epoch.mono_ns
            options.connection.require_keys_until(scenario.duration_s - since_ns / NS_PER_S)
            return RunningSite(parts, publisher, pinger, epoch)
        if joining.announced_first_tick != first_tick:
            first_tick = joining.announced_first_tick
            # Prepared here, since it takes 0.1 s for every hour of the running session.
            parts.site.start_at(first_tick)
        now_ns = parts.clock.monotonic_ns()
        if now_ns > give_up_ns:
            raise _describe_failed_join(parts, joining)
        parts.clock.sleep_until(now_ns + pinger.pause_ns(POLL_NS))
    return None


def _describe_failed_join(parts: SiteParts, joining: SessionJoin) -> SessionError:
    options = parts.options
    missing = joining.membership.list_missing()
    reason = joining.reason
    if not reason and missing:
        reason = f"{', '.join(missing)} never came"
    elif not reason:
        reason = "the others came, but no epoch"
    for member, problem in joining.membership.unreadable.items():
        reason += f"; the answer of {member} cannot be read: {problem}"
    waited_s = f"{options.join_timeout_s:g} s"
    return SessionError(
        f"{parts.name} waited {waited_s} in session {options.session!r}: {reason}"
    )


class RunningSite:
    """A site between the epoch and its last tick.

    The loop calls `use_slack` after a block of records, if a quarter of a period is left. If
    that returns True, the loop calls it again after the next tick.
    """

    def __init__(
        self, parts: SiteParts, publisher: EventPublisher, pinger: Pinger, epoch: Epoch
    ) -> None:
        site = parts.site
        self._parts = parts
        self._publisher = publisher
        self._epoch = epoch
        self._failure: RunFailed | None = None
        self._mode = Mode.RUN
        self._skipped = list[str]()
        self._output: TickRecord | None = None
        self._status_s = 0
        self._waiting_s = 0
        self._has_given_up = False
        self._alarm_s = -1
        self._rejoined_ns = tick_ns(epoch.first, site.rate_hz)
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
        """Returns the timing of the site, with its turn among the sites of this machine.

        Sites with the same clock run on the same machine.
        """
        parts = self._parts
        epoch = self._epoch
        scenario = parts.scenario
        peers = []
        for peer in parts.site.peers:
            boot = epoch.boots.get(peer, NO_BOOT)
            peers.append(
                PeerClock(
                    name=peer,
                    epoch_ns=epoch.epochs.get(peer, epoch.mono_ns),
                    index_at_peer=scenario.peers(peer).index(parts.name),
                    estimate=pinger.estimate(boot),
                    estimator=pinger.estimator(boot),
                )
            )
        local_names = {peer.name for peer in peers if peer.is_own and peer.name in epoch.boots}
        local_names.add(parts.name)
        self._local_sites = [name for name in scenario.names if name in local_names]
        turn = self._local_sites.index(parts.name)
        rate_hz = max(scenario.sites[name].rate_hz for name in self._local_sites)
        return SiteTiming(
            epoch_ns=epoch.mono_ns,
            rate_hz=parts.site.rate_hz,
            peers=peers,
            leader=scenario.names[0],
            turn_ns=find_turn_ns(turn, len(self._local_sites), rate_hz),
        )

    def run(self) -> None:
        """Runs all ticks, or until the run ends early."""
        parts = self._parts
        parts.states.holds_samples &= all(meter.peer.is_own for meter in self._timing.monitors)
        self._publish_setup()
        known_site = make_site_known(
            parts.options.session,
            parts.name,
            parts.scenario.names,
            parts.boot,
            parts.options.connection,
            encode(ChangeRequest(order="stop", source="the operator")),
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
        """Publishes the settings of the process, the clocks, and how the arm stands."""
        parts = self._parts
        texts = self._clock_texts
        obtained = realtime.prepare(parts.options.cpu, len(self._local_sites))
        obtained["turn"] = f"{self._timing.turn_ns // 1000} us after the grid"
        settings = [f"{key}: {value}" for key, value in obtained.items()]
        self._publisher.publish(
            "setup",
            ", ".join([*settings, *texts]),
            epoch_mono_ns=self._epoch.mono_ns,
            clock=parts.clock.identity(),
        )
        begins = "the session begins"
        if first := self._epoch.first:
            t_ns = tick_ns(first, parts.site.rate_hz)
            begins = f"joins the running session at t = {t_ns * 1e-9:.3f} s"
            self._publisher.publish(
                "join",
                f"{parts.name} {begins}",
                t_ns=t_ns,
                boots=self._epoch.boots,
                ticks=first,
            )
        parts.say(f"{begins}; {obtained['scheduling']}, memory {obtained['memory']}")
        self._publish_clocks(self._timing.list_initial_notices(), 0)
        if parts.arm is not None:
            warning = parts.arm.bind(parts.scenario.sites[parts.name].q0_rad)
            if warning:
                self._publisher.publish("arm", f"{parts.name}: {warning}")
                texts = [*texts, warning]
        for text in texts:
            parts.say(text)

    def _publish_clocks(self, notices: Iterable[ClockNotice], t_ns: int) -> None:
        for notice in notices:
            self._publisher.publish(**notice, t_ns=t_ns)

    def should_stop(self) -> bool:
        """Returns True if the run ends before its next tick."""
        parts = self._parts
        for input_ in (parts.arm, parts.switch):
            if input_ is not None:
                input_.poll()
        ended = self._failure or parts.monitor.ended_by or parts.changes.stopped
        return bool(ended) or parts.interrupt.is_requested() or self._has_given_up

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord | None:
        """Steps the site; returns None if its law or plant failed, which ends the run."""
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
        """Replies to queries, follows the leader's grid, and publishes news.

        The loop calls it ten times a second, after the statistics of tick `k` at its nominal
        time `t_ns`, ns since the epoch.
        """
        parts = self._parts
        nominal_ns = tick_ns(k + 1, parts.site.rate_hz)
        grid_ns = self._timing.schedule.due_ns(k + 1) - nominal_ns
        self._publisher.update(ticks=k + 1, grid_ns=grid_ns)
        self._publisher.answer_queries()
        self._publish_clocks(
            self._timing.update_clocks(k + 1, parts.clock.monotonic_ns()), t_ns
        )
        self._watch_members(t_ns)
        self._rejoin(t_ns)
        if parts.hand is not None:
            for _, text in parts.hand.news:
                parts.say(text.partition(": ")[2])
            self._publish_news("hand", parts.hand.news)
        self._publish_news("mark", parts.changes.marks)
        self._publish_skipped(k, t_ns)
        self._publish_waiting(k, t_ns)
        second = t_ns // NS_PER_S
        if self._output is not None and second >= self._status_s + STATUS_PERIOD_S:
            self._status_s = second
            parts.say(self._describe_status(self._output))

    def _publish_news(self, kind: str, news: list[tuple[int, str]]) -> None:
        """Publishes and removes all news, which are pairs of a tick and a text."""
        rate_hz = self._parts.site.rate_hz
        for tick, text in news:
            self._publisher.publish(kind, text, t_ns=tick_ns(tick, rate_hz), ticks=tick)
        news.clear()

    def _publish_skipped(self, k: int, t_ns: int) -> None:
        if self._skipped:
            ticks = " ".join(self._skipped)
            self._skipped = []
            text = f"{self._parts.name} did not make ticks {ticks}"
            self._publisher.publish("overrun", text, t_ns=t_ns, ticks=k + 1, command=ticks)

    def _publish_waiting(self, k: int, t_ns: int) -> None:
        """Publishes once a second that the site is too far from its peers to approach them."""
        output = self._output
        if output is None or output.mode not in (Mode.WAITING, Mode.HOLD):
            return
        if self._parts.setup.on_stale.action is not StaleAction.GLIDE:
            return
        second = t_ns // NS_PER_S
        if find_life_reason(output) is LifeReason.ALIGN_LIMIT and second > self._waiting_s:
            self._waiting_s = second
            text = describe_mode(self._parts.name, output, glides=True)
            self._publisher.publish("waiting", text, t_ns=t_ns, ticks=k)
            self._parts.say(text)

    def _watch_members(self, t_ns: int) -> None:
        """Tracks the members that join and leave, and admits the peers that join."""
        parts = self._parts
        monitor = parts.monitor
        monitor.watch(self._publisher, t_ns)
        if monitor.changed:
            # A change holds from 100 ms after its request, so no earlier sample was due sooner.
            parts.states.holds_samples = False
        if monitor.departed:
            for meter in self._timing.monitors:
                if meter.is_receiving(parts.clock.monotonic_ns()):
                    monitor.mark_present(meter.peer.name, t_ns)
        for event in monitor.admitted:
            self._admit_peer(event, t_ns)
        monitor.admitted.clear()
        patience_s = parts.options.leave_timeout_s
        if patience_s is None:
            self._has_given_up = False
        else:
            since_ns = min((left_ns for left_ns, _ in monitor.departed.values()), default=t_ns)
            self._has_given_up = t_ns - since_ns > patience_s * NS_PER_S

    def _admit_peer(self, event: Event, t_ns: int) -> None:
        """Accepts samples of a peer's new boot from the tick on that its event names."""
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
        """Announces this site's join again, once a second, while a heard peer ignores the site.

        A peer whose connection was broken at the time of the join has not received that event.
        """
        coming = self._epoch.coming
        now_ns = self._parts.clock.monotonic_ns()
        if coming is None or t_ns < self._rejoined_ns + NS_PER_S:
            return
        meters = self._timing.monitors
        if any(
            meter.is_receiving(now_ns) and meter.is_acknowledged(now_ns) is None
            for meter in meters
        ):
            self._rejoined_ns = t_ns
            fields = {**asdict(coming), "t_ns": t_ns, "n": self._publisher.published}
            self._publisher.publish(**fields)

    def _publish_last_heard(self, index: int, coming: Event, t_ns: int) -> None:
        """Publishes the last tick that was received of a peer's previous boot.

        That boot may have ended without an event of its own.
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
        """Returns a line with the time, the mode, the error, the torque and the problems."""
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
        """Publishes the changes that a tick has applied, and a change of the mode."""
        parts = self._parts
        # Skipped ticks are collected here, and published together by `run_housekeeping`.
        if skipped := count_skipped_ticks(output.cmd):
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
        """Prints an alarm with its reason and a remedy.

        An arm that is stopped always raises one; an arm that holds at most one a second.
        """
        parts = self._parts
        mode = output.mode
        rule = parts.setup.on_stale
        if mode is Mode.HOLD:
            second = output.t_ns // NS_PER_S
            if second <= self._alarm_s:
                return
            self._alarm_s = second
        if rule.action is not StaleAction.GLIDE:
            return
        lost: Sequence[str] = ()
        if rule.degrades and mode is Mode.RETURN:
            lost = parts.site.layout.list_lost_peers(output.mem, parts.site.peers)
        alarm = find_alarm(
            parts.options.session,
            parts.name,
            MODE_WORDS[mode],
            output.mem,
            len(output.q_des),
            lost,
        )
        if alarm is not None:
            parts.say(f"*** {alarm}")

    def leave_session(self) -> int:
        """Publishes the end, waits for the recorders, and returns the exit code.

        Raises:
            PeerLeft: a peer left before the end and did not return.
            RunFailed: the run failed, at this site or at a peer.
        """
        parts = self._parts
        interrupt = parts.interrupt
        monitor = parts.monitor
        self._publish_end()
        # Signals that arrive later end the wait for the recorders, and do not change the code.
        code = interrupt.exit_code if interrupt.is_requested() else 0
        monitor.watch(self._publisher, self._t_ns)
        if topics.RECORDER in monitor.boots or monitor.recorders:
            self._await_recorders()
        ticks = count_nouns(self._ticks, "tick")
        counts = parts.stats.dropped.items()
        dropped = ", ".join(f"{count} {reason}" for reason, count in counts)
        parts.say(
            f"{ticks}, {parts.stats.overruns} of them late by a period or more"
            + (f"; dropped: {dropped}" if dropped else "")
        )
        if self._failure is not None:
            raise self._failure
        if monitor.ended_by:
            raise RunFailed(f"{parts.name} ended because {monitor.ended_by}")
        if not code and self._departures:
            raise PeerLeft(
                f"{parts.name} made {ticks}; {self._departures}, and did not come back"
            )
        return code

    def _publish_end(self) -> None:
        """Publishes the failure, the law's hiccups and the end, with their causes."""
        parts = self._parts
        output = self._output
        kind = "failed"
        if output is not None and output.mode is Mode.DIVERGED:
            kind = "diverged"
            self._failure = RunFailed(describe_divergence(parts.name, output))
        if self._failure is not None:
            self._publish_end_event(kind, str(self._failure))
        for code in parts.watchdog.codes:
            if hiccups := code.describe_hiccups():
                self._publish_end_event("law", hiccups)
                parts.say(hiccups)
        about, cause = self._find_cause()
        if unheard := [
            meter.peer.name for meter in self._timing.monitors if meter.is_unacknowledged
        ]:
            cause += f"; {', '.join(unheard)} did not hear it at the end"
        text = f"{parts.name} made {count_nouns(self._ticks, 'tick')}{cause}"
        self._publish_end_event("end", text, about=about)

    @property
    def _departures(self) -> str:
        """The sentences about the sites that have left, "" if all are present."""
        return "; ".join(text for _, text in self._parts.monitor.departed.values())

    def _find_cause(self) -> tuple[str, str]:
        """Returns which member ended the run early, and the end of a sentence that says why."""
        parts = self._parts
        monitor = parts.monitor
        if self._failure is not None:
            return parts.name, f": {self._failure}"
        if monitor.ended_by:
            return monitor.ended_member, f": {monitor.ended_by}"
        if parts.changes.stopped:
            return "", ", as many as it was asked for"
        if self._ticks == parts.scenario.ticks(parts.name):
            return "", ""
        if parts.interrupt.is_requested():
            return parts.name, f", ended by {signal.Signals(parts.interrupt.number).name}"
        return next(iter(monitor.departed), ""), f": {self._departures}"

    def _publish_end_event(self, kind: str, text: str, about: str = "") -> None:
        self._publisher.publish(kind, text, t_ns=self._t_ns, ticks=self._ticks, about=about)

    def _await_recorders(self) -> None:
        """Waits until every recorder has stored everything, then `stay_s` for them to leave.

        A signal does not shorten the first wait, since records that are not stored are lost
        with this process; a second signal ends it.
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
            if is_gone and monitor.stored:  # a recorder that lacks messages may come back
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + LEAVE_TIMEOUT_NS)
            if monitor.read_stored(self._ticks) and monitor.all_stored:
                give_up_ns = clock.monotonic_ns() + int(parts.options.stay_s * 1e9)
            waited_ns = clock.monotonic_ns() - begun_ns
            if not is_announced and not monitor.all_stored and waited_ns > ANNOUNCE_AFTER_NS:
                is_announced = True
                parts.say(
                    "keeps its last records until the recorder has them, "
                    f"{LINGER_NS // NS_PER_S} s at most; Ctrl-C a second time ends it at once"
                )
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _may_leave(self) -> bool:
        """Returns True if the user insists, or ended the run and the recorders have it all."""
        interrupt = self._parts.interrupt
        return interrupt.is_repeated() or (
            self._parts.monitor.all_stored and interrupt.is_requested()
        )

"""One site as one process: it joins a session, runs, and leaves.

Invariant: a site declares itself alive only when its subscriptions are declared and its step is
compiled. Until the epoch its arm is braked; at the end it stays until every recorder present
has all messages that it can have, or for some seconds.
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
NOBODY = -1
"""No start of a peer that is not there yet."""
STATUS_TICKS_S = 5
"""Between two lines that say how a site does, s."""
LINGER_NS = 10 * NS_PER_S
"""Longest wait after the last query of a recorder. One whose process was frozen, or whose
connection broke, needs seconds to connect again: that takes the lease of Zenoh, 5 s, and one
attempt after that.
"""
TELL_NS = NS_PER_S
"""A wait of this length is announced to the user."""
LEAVE_TIMEOUT_NS = 2 * NS_PER_S
"""Wait after a recorder that has everything is gone: its process ends."""
QUERIED_NS = NS_PER_S
"""A recorder that has sent a query within this time is present, whatever its token says."""


def run_site(
    scenario: Scenario, name: str, options: SiteOptions, say: Callable[[str], None]
) -> int:
    """Runs one site of a scenario from its start to its end.

    Returns:
        The exit code: 0, or 128 and the number of the signal that ended it.

    Raises:
        SessionError: the session could not begin.
        UsageError: an endpoint cannot be used.
        ScenarioError: its user law cannot be made, or is not the one that the scenario names;
            or an arm outside of the program lacks limits.
        RunFailed: the run diverged, its user law failed, or its arm fell silent.
    """
    check_outside_arms(scenario)
    # one that returns to a session has less time to go: see `join_session`
    if not scenario.sites_may_return:
        options.connection.require_keys_until(scenario.duration_s)
    share_threads()
    with Interrupt() as interrupt:
        clock = make_system_clock(options.clock_offset_s, options.clock_drift_ppm)

        def named(text: str) -> None:
            say(f"{name}: {text}")

        timeout_s = options.join_timeout_s
        bus = open_bus(
            connection=options.connection,
            clock=clock,
            stopped=interrupt.is_requested,
            timeout_s=timeout_s,
            say=named,
        )
        if bus is None:
            return interrupt.exit_code
        with closing(bus), LinePrinter(say) as printer:
            with interrupt.raising():  # it may compile for minutes
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
                parts.say(f"others connect to {', '.join(map(str, options.connection.listen))}")
            return take_part(parts)


def take_part(parts: SiteParts) -> int:
    """Joins a session, runs and leaves; returns the exit code.

    Raises:
        SessionError: the session could not begin.
        RunFailed: the run ended badly.
    """
    give_up_ns = parts.clock.monotonic_ns() + int(parts.options.join_timeout_s * 1e9)
    waits = parts.interrupt.is_requested, give_up_ns, parts.say
    for awaited in (parts.arm, parts.hand):
        if isinstance(awaited, ExternalArm | RemoteHand) and not awaited.wait_for_first(*waits):
            return parts.interrupt.exit_code
    running = join_session(parts, give_up_ns)
    if running is None:
        return parts.interrupt.exit_code
    running.run()
    return running.leave()


def join_session(parts: SiteParts, give_up_ns: int) -> "RunningSite | None":
    """Declares a site alive, and waits for the others and the epoch; None if a signal comes
    first.

    Raises:
        SessionError: the session did not begin in time, or this site cannot be part of it.
    """
    scenario = parts.scenario
    options = parts.options
    needs = {"needs_recorder": options.needs_recorder}
    info = describe_member(parts.name, parts.boot, parts.clock, scenario.text, **needs)
    late = LateSites(scenario.sites_may_return, options.without, parts.site.rate_hz)
    keep = parts.buffer.channels[topics.EVENT].keep
    publisher = EventPublisher(parts.bus, options.session, info, keep)
    joining = SessionJoin(
        bus=parts.bus,
        clock=parts.clock,
        session=options.session,
        publisher=publisher,
        sites=scenario.names,
        late=late,
    )
    membership = joining.membership
    pinger = joining.pinger
    parts.say(f"waiting for {', '.join(membership.list_missing()) or 'the epoch'}")
    begins = 0
    while not parts.interrupt.is_requested():
        epoch = joining.poll()
        if epoch is not None:
            since_ns = parts.clock.monotonic_ns() - epoch.mono_ns
            options.connection.require_keys_until(scenario.duration_s - since_ns / NS_PER_S)
            return RunningSite(parts, publisher, pinger, epoch)
        if joining.announced_first_tick != begins:
            begins = joining.announced_first_tick
            parts.site.start_at(begins)  # it takes 0.1 s for every hour that the session runs
        now_ns = parts.clock.monotonic_ns()
        if now_ns > give_up_ns:
            missing = membership.list_missing()
            reason = (
                f"{', '.join(missing)} never came"
                if missing
                else "the others came, but no epoch"
            )
            reason = joining.reason or reason
            for member, problem in membership.unreadable.items():
                reason += f"; the answer of {member} cannot be read: {problem}"
            waited = f"{parts.name} waited {options.join_timeout_s:g} s in session {options.session!r}"
            raise SessionError(f"{waited}: {reason}")
        parts.clock.sleep_until(now_ns + pinger.pause_ns(POLL_NS))
    return None


class RunningSite:
    """A site between the epoch and its last tick.

    The loop calls `use_slack` after a block of records, and again after the next tick if it
    returns true, in a quarter of a period.
    """

    def __init__(
        self, parts: SiteParts, publisher: EventPublisher, pinger: Pinger, epoch: Epoch
    ) -> None:
        scenario = parts.scenario
        site = parts.site
        self._parts = parts
        self._publisher = publisher
        self._epoch = epoch
        self._failure: RunFailed | None = None
        self._mode = Mode.RUN
        self._skipped = list[str]()
        self._output: TickRecord | None = None
        self._status_s = self._told_s = 0
        self._given_up = False
        self._held_s = -1
        self._came_ns = tick_ns(epoch.first, site.rate_hz)
        self.publish_sample = parts.publish_sample
        self.publish_link = parts.publish_link
        self.use_slack = parts.buffer.answer_query
        parts.monitor.boots = epoch.boots
        boots = [epoch.boots.get(peer, NOBODY) for peer in site.peers]
        peers = [
            PeerClock(
                name=peer,
                epoch_ns=epoch.epochs.get(peer, epoch.mono_ns),
                index_at_peer=scenario.peers(peer).index(parts.name),
                estimate=pinger.estimate(boot),
                estimator=pinger.estimator(boot),
            )
            for peer, boot in zip(site.peers, boots, strict=True)
        ]
        site.start_at(epoch.first)
        parts.buffer.begin_at(epoch.first)
        own = {peer.name for peer in peers if peer.is_own and peer.name in epoch.boots}
        self._here = [name for name in scenario.names if name == parts.name or name in own]
        rate_hz = max(scenario.sites[name].rate_hz for name in self._here)
        turn_ns = find_turn_ns(self._here.index(parts.name), len(self._here), rate_hz)
        self._timing = SiteTiming(
            epoch_ns=epoch.mono_ns,
            rate_hz=site.rate_hz,
            peers=peers,
            leader=scenario.names[0],
            turn_ns=turn_ns,
        )
        self._clock_texts = describe_clocks(pinger, epoch.boots, epoch.mono_ns)
        heard = (parts.rings, boots, self._timing.monitors, parts.stats.dropped)
        self._inbox = PeerInbox(parts.setup.links, *heard, tick_ns(epoch.first, site.rate_hz))
        publisher.update(
            running=True,
            epoch_mono_ns=epoch.mono_ns,
            epoch_unix_ns=epoch.unix_ns,
            boots=epoch.boots,
        )

    def run(self) -> None:
        """Runs every tick, or until the run ends."""
        parts = self._parts
        parts.states.holds_samples &= all(meter.peer.is_own for meter in self._timing.monitors)
        self._publish_setup()
        order = encode(ChangeRequest(order="stop", source="the operator"))
        name = parts.name
        here = (
            parts.options.session,
            name,
            parts.scenario.names,
            parts.boot,
            parts.options.connection,
        )
        with make_site_known(*here, order), parts.watchdog:
            ticks = parts.scenario.ticks(name)
            timed = (ticks, parts.clock, self._inbox, self._timing, parts.stats)
            last = (parts.states, self, self._epoch.first)
            self._output = run_loop(
                parts.site, parts.boot, *timed, *last, catches_up=parts.arm is None
            )
        output = self._output
        self._ticks = 0 if output is None else output.tick + 1
        self._t_ns = -1 if output is None else output.t_ns
        if output is not None:
            self._tell_skipped(output.tick, output.t_ns)

    def _publish_setup(self) -> None:
        parts = self._parts
        texts = self._clock_texts
        obtained = realtime.prepare(parts.options.cpu, len(self._here))
        obtained["turn"] = f"{self._timing.turn_ns // 1000} us after the grid"
        self._publisher.publish(
            "setup",
            ", ".join([*(f"{key}: {value}" for key, value in obtained.items()), *texts]),
            epoch_mono_ns=self._epoch.mono_ns,
            clock=parts.clock.identity(),
        )
        begins = "the session begins"
        if first := self._epoch.first:
            begins = f"joins the running session at t = {tick_ns(first, parts.site.rate_hz) * 1e-9:.3f} s"
            text = f"{parts.name} {begins}"
            about = {"boots": self._epoch.boots, "ticks": first}
            self._publisher.publish(
                "join", text, t_ns=tick_ns(first, parts.site.rate_hz), **about
            )
        parts.say(f"{begins}; {obtained['scheduling']}, memory {obtained['memory']}")
        self._publish_clocks(self._timing.list_initial_notices(), 0)
        if parts.arm is not None and (
            text := parts.arm.bind(parts.scenario.sites[parts.name].q0_rad)
        ):
            self._publisher.publish("arm", f"{parts.name}: {text}")
            texts = [*texts, text]
        for text in texts:
            parts.say(text)

    def _publish_clocks(self, notices: Iterable[ClockNotice], t_ns: int) -> None:
        for notice in notices:
            self._publisher.publish(**notice, t_ns=t_ns)

    def should_stop(self) -> bool:
        """True if the run ends before its next tick."""
        parts = self._parts
        for input_ in (parts.arm, parts.switch):
            if input_ is not None:
                input_.poll()
        ended = self._failure or parts.monitor.ended_by or parts.changes.stopped
        return bool(ended) or parts.interrupt.is_requested() or self._given_up

    def step(self, k: int, arrivals: Sequence[Arrival]) -> TickRecord | None:
        """Steps the site; None if its law failed, which ends the run."""
        parts = self._parts
        measured = None if parts.arm is None else parts.arm.newest
        hand = () if parts.hand is None else parts.hand.track(parts.site, k)
        try:
            if parts.plant is not None:
                measured = parts.plant.state
            self._output = parts.step(
                TickInput(
                    k=k,
                    arrivals=arrivals,
                    commands=parts.take_changes(k),
                    measured=measured,
                    hand=hand,
                )
            )
            if parts.plant is not None:
                parts.plant.move(k, self._output.tau)
        except CodeFailed as failed:
            self._failure = failed
            return None
        return self._output

    def attend(self, k: int, t_ns: int) -> None:
        """Answers queries, follows the leader's grid, publishes news: ten times a second, after
        statistics.

        These are of tick k, whose nominal time is given.
        """
        grid_ns = self._timing.schedule.due_ns(k + 1) - tick_ns(k + 1, self._parts.site.rate_hz)
        self._publisher.update(ticks=k + 1, grid_ns=grid_ns)
        self._publisher.answer_queries()
        self._publish_clocks(
            self._timing.update_clocks(k + 1, self._parts.clock.monotonic_ns()), t_ns
        )
        self._watch_members(t_ns)
        self._come_again(t_ns)
        if (hand := self._parts.hand) is not None:
            for _, text in hand.news:
                self._parts.say(text.partition(": ")[2])
            self._tell("hand", hand.news)
        self._tell("mark", self._parts.changes.marks)
        self._tell_skipped(k, t_ns)
        self._tell_waiting(k, t_ns)
        if self._output is not None and t_ns // NS_PER_S >= self._status_s + STATUS_TICKS_S:
            self._status_s = t_ns // NS_PER_S
            self._parts.say(self._describe_status(self._output))

    def _tell(self, kind: str, news: list[tuple[int, str]]) -> None:
        for tick, text in news:
            self._publisher.publish(
                kind, text, t_ns=tick_ns(tick, self._parts.site.rate_hz), ticks=tick
            )
        news.clear()

    def _tell_skipped(self, k: int, t_ns: int) -> None:
        if self._skipped:
            ticks = " ".join(self._skipped)
            self._skipped = []
            text = f"{self._parts.name} did not make ticks {ticks}"
            self._publisher.publish("overrun", text, t_ns=t_ns, ticks=k + 1, command=ticks)

    def _tell_waiting(self, k: int, t_ns: int) -> None:
        """Publishes once a second that the site does not go to its peers because they are too
        far away.
        """
        output = self._output
        holds = output is not None and output.mode in (Mode.WAITING, Mode.HOLD)
        if (
            output is None
            or not holds
            or self._parts.setup.on_stale.action is not StaleAction.GLIDE
        ):
            return
        if (
            find_life_reason(output) is LifeReason.ALIGN_LIMIT
            and t_ns // NS_PER_S > self._told_s
        ):
            self._told_s = t_ns // NS_PER_S
            text = describe_mode(self._parts.name, output, glides=True)
            self._publisher.publish("waiting", text, t_ns=t_ns, ticks=k)
            self._parts.say(text)

    def _watch_members(self, t_ns: int) -> None:
        parts = self._parts
        monitor = self._parts.monitor
        monitor.watch(self._publisher, t_ns)
        if monitor.changed:  # 100 ms ago at most: no sample so far is due sooner than before
            parts.states.holds_samples = False
        for meter in self._timing.monitors if monitor.away else ():
            if meter.is_receiving(parts.clock.monotonic_ns()):
                monitor.meet_again(meter.peer.name, t_ns)
        for event in monitor.admitted:
            index = parts.site.peers.index(event.member)
            rate_hz = parts.scenario.sites[event.member].rate_hz
            bound_ns = None if event.clock == parts.clock.identity() else event.bound_ns
            joins = (tick_ns(event.ticks, rate_hz), event.epoch_mono_ns, bound_ns)
            self._tell_last(index, event, t_ns)
            self._publish_clocks(self._timing.admit(index, *joins), t_ns)
            self._inbox.admit(index, event.boot, event.ticks)
            parts.say(f"{event.member} joins at t = {joins[0] * 1e-9:.3f} s")
        monitor.admitted.clear()
        patience_s = parts.options.leave_timeout_s
        since_ns = min((since_ns for since_ns, _ in monitor.away.values()), default=t_ns)
        self._given_up = patience_s is not None and t_ns - since_ns > patience_s * NS_PER_S

    def _come_again(self, t_ns: int) -> None:
        """Says once a second that this site has come, while a peer that was cut off then
        ignores it.
        """
        coming = self._epoch.coming
        now_ns = self._parts.clock.monotonic_ns()
        if coming is None or t_ns < self._came_ns + NS_PER_S:
            return
        if any(
            meter.is_receiving(now_ns) and meter.is_acknowledged(now_ns) is None
            for meter in self._timing.monitors
        ):
            self._came_ns = t_ns
            self._publisher.publish(
                **{**asdict(coming), "t_ns": t_ns, "n": self._publisher.published}
            )

    def _tell_last(self, index: int, coming: Event, t_ns: int) -> None:
        """Publishes how far the start of a peer was heard that ends now: it may not have been
        able to.
        """
        newest = self._inbox.newest_before(index, coming.boot)
        if newest is not None:
            text = f"of the start of {coming.member} before came samples up to tick {newest}"
            about = {
                "about": coming.member,
                "boots": {coming.member: coming.boot},
                "ticks": newest + 1,
            }
            self._publisher.publish("last", text, t_ns=t_ns, **about)

    def _describe_status(self, output: TickRecord) -> str:
        shared = output.shared()[0]
        own, desired = (np.array([vector]) for vector in (shared, output.q_des))
        axes = self._parts.scenario.arms[self._parts.name].axes
        apart = np.abs(
            compute_task_errors(own, desired, axes) if output.x else own - desired
        ).max()
        unit = "m or rad" if output.x else "rad"
        torque_nm = max(map(abs, output.tau))
        stats = self._parts.stats
        dropped = sum(stats.dropped.values())
        return (
            f"t = {output.t_ns / NS_PER_S:.0f} s, {MODE_WORDS[output.mode]}, |e| {apart:.3g} {unit}, torque "
            f"{torque_nm:.3g} N m, {count_nouns(stats.overruns, 'tick')} late, "
            f"{count_nouns(dropped, 'message')} dropped"
        )

    def report(self, output: TickRecord) -> None:
        """Tells of a tick that took a command in, or at which the mode changed."""
        name = self._parts.name
        at = {"t_ns": output.t_ns, "ticks": output.tick}
        if skipped := count_skipped_ticks(output.cmd):  # told together, in `attend`
            self._skipped.append(f"{output.tick - skipped}-{output.tick - 1}")
        for change in output.cmd:
            if not count_skipped_ticks([change]):
                source = self._parts.changes.sources.pop(change, "")
                sentence = describe_change(msgspec.json.decode(change, type=Change), source)
                self._publisher.publish("change", sentence, command=change, **at)
                self._parts.say(sentence)
        if output.mode is not self._mode:
            self._mode = output.mode
            glides = self._parts.setup.on_stale.action is StaleAction.GLIDE
            failure = self._parts.site.law_failure
            text = describe_mode(name, output, glides=glides, law_failure=failure)
            self._publisher.publish("mode", text, **at)
            self._raise_alarm(output)

    def _raise_alarm(self, output: TickRecord) -> None:
        """Says that the arm is stopped, or at most once a second that it holds; why, and what
        to do.
        """
        parts = self._parts
        mode = output.mode
        rule = self._parts.setup.on_stale
        second = output.t_ns // NS_PER_S
        if mode is Mode.HOLD and second <= self._held_s:
            return
        self._held_s = second if mode is Mode.HOLD else self._held_s
        if rule.action is not StaleAction.GLIDE:
            return
        says_lost = rule.degrades and mode is Mode.RETURN
        lost = (
            parts.site.layout.list_lost_peers(output.mem, parts.site.peers) if says_lost else ()
        )
        shown = (
            parts.options.session,
            parts.name,
            MODE_WORDS[mode],
            output.mem,
            len(output.q_des),
            lost,
        )
        if (alarm := find_alarm(*shown)) is not None:
            parts.say(f"*** {alarm}")

    def leave(self) -> int:
        """Publishes the end, waits for the recorders, and returns the exit code.

        Raises:
            RunFailed: the run ended badly, here or at a peer; as `PeerLeft`, without a peer.
        """
        parts = self._parts
        interrupt = self._parts.interrupt
        output = self._output
        kind = "failed"
        if output is not None and output.mode is Mode.DIVERGED:
            kind = "diverged"
            self._failure = RunFailed(describe_divergence(parts.name, output))
        if self._failure is not None:
            self._publish(kind, str(self._failure))
        for hiccups in filter(None, (code.describe_hiccups() for code in parts.watchdog.codes)):
            self._publish("law", hiccups)
            parts.say(hiccups)
        about, why = self._find_cause()
        if unheard := [
            meter.peer.name for meter in self._timing.monitors if meter.is_unacknowledged
        ]:
            why += f"; {', '.join(unheard)} did not hear it at the end"
        self._publish(
            "end", f"{parts.name} made {count_nouns(self._ticks, 'tick')}{why}", about=about
        )
        code = (
            interrupt.exit_code if interrupt.is_requested() else 0
        )  # later signals end the wait
        parts.monitor.watch(self._publisher, self._t_ns)
        if topics.RECORDER in parts.monitor.boots or parts.monitor.recorders:
            self._await_recorders()
        dropped = ", ".join(
            f"{count} {reason}" for reason, count in parts.stats.dropped.items()
        )
        parts.say(
            f"{count_nouns(self._ticks, 'tick')}, {parts.stats.overruns} of them late by a period or more"
            + (f"; dropped: {dropped}" if dropped else "")
        )
        if self._failure is not None:
            raise self._failure
        if parts.monitor.ended_by:
            raise RunFailed(f"{parts.name} ended because {parts.monitor.ended_by}")
        if not code and self._away:
            raise PeerLeft(
                f"{parts.name} made {count_nouns(self._ticks, 'tick')}; {self._away}, and did not come back"
            )
        return code

    @property
    def _away(self) -> str:
        """What sites that have left said of it, "" if all are there."""
        return "; ".join(text for _, text in self._parts.monitor.away.values())

    def _find_cause(self) -> tuple[str, str]:
        """Returns whose end it was if the run ends before its time, and why, to be put behind a
        sentence.
        """
        parts = self._parts
        monitor = self._parts.monitor
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
        return next(iter(monitor.away), ""), f": {self._away}"

    def _publish(self, kind: str, text: str, about: str = "") -> None:
        self._publisher.publish(kind, text, t_ns=self._t_ns, ticks=self._ticks, about=about)

    def _await_recorders(self) -> None:
        """Waits until every recorder present has stored all, then for `stay_s` until they are
        gone.

        A signal does not shorten the first wait, since records that are not stored are lost
        with this process; a second signal ends it.
        """
        parts = self._parts
        clock = self._parts.clock
        monitor = self._parts.monitor
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
            if is_gone and monitor.stored:  # one that has not stored all may come back
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + LEAVE_TIMEOUT_NS)
            if monitor.read_stored(self._ticks) and monitor.all_stored:
                give_up_ns = clock.monotonic_ns() + int(parts.options.stay_s * 1e9)
            if (
                not (is_announced or monitor.all_stored)
                and clock.monotonic_ns() - begun_ns > TELL_NS
            ):
                is_announced = True
                parts.say(
                    f"keeps its last records until the recorder has them, {LINGER_NS // NS_PER_S} s at most; "
                    "Ctrl-C a second time ends it at once"
                )
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _may_leave(self) -> bool:
        """True if the user insists, or wants the end and every recorder present has stored all."""
        interrupt = self._parts.interrupt
        return interrupt.is_repeated() or (
            self._parts.monitor.all_stored and interrupt.is_requested()
        )

"""Runs the control loop of one arm, from the start of the session to its last tick.

The loop in `site_loop` calls a `RunningSite` in every tick, and ten times per second for work
that is not urgent. Three other objects do the work that is not part of a tick: `SiteNews`
reports events, `PeerAdmission` admits other arms, and `SiteEnd` leaves the session.

Invariant:
    - The work that is not urgent has a fixed order: replies to queries, clocks, members, news.
      This ensures that an event about the clock of a peer precedes the admission that depends
      on it.
"""

from collections.abc import Sequence

from trilat_net.core import TickInput, tick_ns
from trilat_net.errors import CodeFailed, RunFailed
from trilat_net.net import (
    ChangeRequest,
    Epoch,
    EventPublisher,
    PeerClock,
    Pinger,
    SiteTiming,
    encode,
    find_turn_ns,
    make_site_known,
)
from trilat_net.records import Arrival, TickRecord

from . import realtime
from .peer_admission import PeerAdmission
from .site_end import SiteEnd
from .site_loop import PeerInbox, run_loop
from .site_news import SiteNews
from .site_parts import SiteParts

_NO_BOOT = -1
"""Placeholder for the boot (the number that identifies a process start) of an absent peer."""


class RunningSite:
    """Runs a site from the epoch (the common start of the session) to its last tick.

    The loop calls `should_stop` and `step` in every tick, `report_tick` after ticks in which
    something changed, and `run_housekeeping` ten times per second.

    If at least a quarter of the tick remains after a block of records was published, the loop
    also calls `use_slack`, which answers one query from a recorder for lost messages. If
    `use_slack` answered a query and returned True, the loop calls it again after the next tick,
    because more queries may be waiting.

    Args:
        parts: Parts of the site.
        publisher: Publishes the events of the site.
        pinger: Offsets of the other members' clocks, as estimated from pings.
        epoch: The agreed epoch, and the members of the session.

    Attributes:
        publish_sample: Function that publishes a sample for the peers.
        publish_link: Function that publishes statistics of the loop and its links.
        report_tick: Function that publishes what has changed in a tick.
        use_slack: Function that the loop calls if there is time left.
    """

    def __init__(
        self,
        parts: SiteParts,
        publisher: EventPublisher,
        pinger: Pinger,
        epoch: Epoch,
    ) -> None:
        site = parts.site
        self._publisher = publisher
        self._parts = parts
        self._epoch = epoch
        self._failure: RunFailed | None = None
        self._output: TickRecord | None = None  # the record of the newest tick

        parts.monitor.boots = epoch.boots
        site.start_at(epoch.first)
        parts.buffer.start_at(epoch.first)
        self._timing = self._make_timing(pinger)
        self._clock_texts = pinger.describe_clocks(epoch.boots, epoch.mono_ns)
        self._inbox = PeerInbox(
            links=parts.setup.links,
            rings=parts.rings,
            boots=[epoch.boots.get(peer, _NO_BOOT) for peer in site.peers],
            monitors=self._timing.monitors,
            dropped=parts.stats.dropped,
            from_ns=tick_ns(epoch.first, site.rate_hz),
        )
        self._news = SiteNews(parts, publisher)
        self._admission = PeerAdmission(
            parts=parts,
            publisher=publisher,
            epoch=epoch,
            timing=self._timing,
            inbox=self._inbox,
        )

        # Methods of the parts that the loop calls.
        self.publish_sample = parts.publish_sample
        self.publish_link = parts.publish_link
        self.report_tick = self._news.report_tick
        self.use_slack = parts.buffer.answer_query

        publisher.update(
            running=True,
            epoch_mono_ns=epoch.mono_ns,
            epoch_unix_ns=epoch.unix_ns,
            boots=epoch.boots,
        )

    def _make_timing(self, pinger: Pinger) -> SiteTiming:
        """Creates the schedule of the site's ticks, and the timing of its links.

        Sites on one machine share its clock. They wake up one after another in each tick, in
        scenario order, so that they do not compete for the processors. The names of the sites
        on this machine are also stored, for the real-time settings.

        Args:
            pinger: Offsets of the other members' clocks, as estimated from pings.
        """
        parts = self._parts
        epoch = self._epoch
        scenario = parts.scenario
        peer_clocks = []
        local_names = {parts.name}  # sites on this machine
        for name in parts.site.peers:
            # The pings are stored by boot, the number of a process start. A peer that is not
            # present has no pings, and is assumed to have the same epoch on the same clock.
            boot = epoch.boots.get(name, _NO_BOOT)
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
            leader=scenario.names[0],  # all sites follow the tick schedule of this site
            turn_ns=find_turn_ns(turn, len(self._local_sites), highest_rate_hz),
        )

    def run(self) -> SiteEnd:
        """Runs the control loop of the site until the last tick, or until the run ends early.

        The run may end early because of a failure, a signal, or a request from another member.

        Returns:
            The object that publishes how the run ended, and leaves the session.
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

        if self._output is not None:
            self._news.publish_skipped(self._output)
        return SiteEnd(
            parts=parts,
            publisher=self._publisher,
            link_monitors=self._timing.monitors,
            output=self._output,
            failure=self._failure,
        )

    def _publish_setup(self) -> None:
        """Publishes the real-time settings and the clock offsets, and prints them for the user.

        A site that joins a running session also publishes the event `join`. From here on,
        measurements of an external arm are accepted only from its current driver. If the arm is
        not in the start pose of the scenario, a warning is published.
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
        self._publisher.publish_clocks(self._timing.list_initial_notices(), 0)

        if parts.arm is not None:
            warning = parts.arm.bind(parts.scenario.sites[parts.name].q0_rad)
            if warning:
                self._publisher.publish("arm", f"{parts.name}: {warning}")
                user_lines = [*user_lines, warning]
        for line in user_lines:
            parts.say(line)

    def should_stop(self) -> bool:
        """Decides at the beginning of each tick whether the run must end.

        The messages from an external arm and its dead-man switch are read first, because they
        can end the run.

        Returns:
            True if the site failed, if a member ended the run for everyone, if the user stopped
            the session or this process, or if a peer has been away for too long.
        """
        parts = self._parts
        for device in (parts.arm, parts.switch):
            if device is not None:
                device.poll()
        return (
            self._failure is not None
            or parts.monitor.ended_by != ""
            or parts.changes.stopped
            or parts.interrupt.is_requested()
            or self._admission.has_given_up
        )

    def step(self, tick: int, arrivals: Sequence[Arrival]) -> TickRecord | None:
        """Executes one tick: reads the inputs, computes the torque, and moves a simulated arm.

        Args:
            tick: Number of the tick.
            arrivals: Samples from the peers that have arrived since the previous tick.

        Returns:
            The record of the tick, or None if the user's own law, plant or operator failed,
            which ends the run.
        """
        parts = self._parts
        measured = None if parts.arm is None else parts.arm.newest
        hand = () if parts.hand is None else parts.hand.track(parts.site, tick)

        try:
            if parts.plant is not None:
                measured = parts.plant.state
            inputs = TickInput(
                k=tick,
                arrivals=arrivals,
                commands=parts.pop_changes(tick),
                measured=measured,
                hand=hand,
            )
            self._output = parts.step(inputs)
            if parts.plant is not None:
                parts.plant.move(tick, self._output.tau)
        except CodeFailed as failed:
            self._failure = failed
            return None
        return self._output

    def run_housekeeping(self, output: TickRecord) -> None:
        """Does the work that is not needed in every tick.

        The site replies to queries, updates the clock offsets, admits peers that join,
        publishes events, and prints a status line for the user. The loop calls this method ten
        times per second.

        Args:
            output: Record of the newest tick.
        """
        parts = self._parts
        next_tick = output.tick + 1
        next_nominal_ns = tick_ns(next_tick, parts.site.rate_hz)
        # Start of the session as the present schedule implies it, for sites that join late. It
        # changes slowly, because the schedule follows the clock of the leader.
        grid_ns = self._timing.schedule.due_ns(next_tick) - next_nominal_ns
        self._publisher.update(ticks=next_tick, grid_ns=grid_ns)
        self._publisher.answer_queries()

        notices = self._timing.update_clocks(next_tick, parts.clock.monotonic_ns())
        self._publisher.publish_clocks(notices, output.t_ns)
        self._admission.watch_members(output.t_ns)
        self._admission.rejoin(output.t_ns)
        self._news.publish_news(output)

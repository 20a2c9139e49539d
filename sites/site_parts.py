"""Creates everything that a site needs before it joins a session.

`SiteParts` creates the arm and its control law in the simulation kernel, the queues for
incoming messages, the publishers, the buffer from which lost messages are resent, and whatever
else the scenario requires. `site_process` then joins the session with these parts.

Invariant:
    - Once a `SiteParts` object has been created, all subscriptions of the site are declared and
      its control step is compiled. A site announces itself only after that, so it misses no
      message and its first tick is not late.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from trilat_net.core import CoreChange, PlantState, Site, SiteSetup, TickInput, tick_ns
from trilat_net.errors import LawFailed, WireError
from trilat_net.net import (
    Bus,
    Clock,
    Connection,
    LoopStats,
    OffsetEstimator,
    OffsetLimit,
    PeerSample,
    StampedInbox,
    SystemClock,
    decode,
    encode_sample,
    encode_state,
    join_states,
    make_sample_reader,
    new_boot,
    topics,
)
from trilat_net.own_code import ImportedLaw
from trilat_net.recorded_change import SiteOrder
from trilat_net.records import Arrival, TickRecord
from trilat_net.scenario import HandPlayer, HandSite, OwnPlant, PlantPlayer, Scenario
from trilat_net.signals import Interrupt

from .change_server import ChangeServer
from .code_watchdog import CodeWatchdog, WatchedCode
from .external_arm import MEASUREMENTS_KEPT, DeadManSwitch, ExternalArm
from .hand_server import MESSAGES_KEPT, HandServer, RemoteHand
from .peer_monitor import PeerMonitor
from .retransmit_buffer import RetransmitBuffer
from .site_loop import StateBlock


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """The user's options for how a site joins a session and waits for others.

    The options are given on the command line of `trilat site`.

    Attributes:
        session: Name of the session.
        connection: Endpoints of the site, and keys.
        join_timeout_s: Longest wait for the start of the session, in s.
        needs_recorder: True if the session starts only when a recorder is present.
        cpu: Processor to which the control loop is pinned. If None, all processors may be used.
        stay_s: Longest time that the site waits after the run for the recorder to leave, in s.
        clock_offset_s: Offset added to the clock of the site to emulate another machine, in s.
        clock_drift_ppm: Drift added to the clock of the site, in parts per million.
        without: Sites that the session does not wait for. They may join the running session.
        leave_timeout_s: How long the site continues after a peer has left and not returned, in
            s. If None, it continues until the end of the run.
    """

    session: str
    connection: Connection
    join_timeout_s: float = 60.0
    needs_recorder: bool = False
    cpu: int | None = None
    stay_s: float = 0.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0
    without: tuple[str, ...] = ()
    leave_timeout_s: float | None = None


class SiteParts:
    """All objects that make up a site: arm, control law, network queues and buffers.

    The constructor creates the objects that the scenario needs. All others are None.

    Args:
        scenario: Scenario of the session.
        name: Name of the site.
        options: How the site joins the session.
        bus: Network connection of the site.
        clock: Clock of the site.
        interrupt: Handler of the signals of this process.
        say: Function that prints a line for the user.

    Attributes:
        arm: Connection to the driver of an external arm.
        switch: Dead-man switch of that arm.
        plant: The user's own simulation of the arm.
        hand: The live operator, a person or program that moves the arm.
        step: Function that computes one tick. If the control law is the user's own, the
            watchdog measures its computing time.
        rings: Queues of the samples from the peers, in the order of the links.
        buffer: Recent messages, for recorders that missed them.
        states: Records that are waiting to be sent to the recorders.
        monitor: Presence of the other members of the session.
        changes: Requests to change something during the run.
    """

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
        self.scenario = scenario
        self.name = name
        self.options = options
        self.bus = bus
        self.clock = clock
        self.interrupt = interrupt
        self.say: Callable[[str], None] = lambda text: say(f"{name}: {text}")

        # The site in the simulation kernel, and the function that computes a tick.
        self.setup = scenario.setup(name)
        self.site = Site(self.setup)
        self.boot = new_boot()
        self.stats = LoopStats(self.site, self.boot)
        self.watchdog, self.step = _watch_law(scenario, self.site, clock)

        # Queues of the samples from the peers.
        self.rings: list[StampedInbox[PeerSample | WireError]] = []
        for link in self.setup.links:
            sample_layout = self.setup.layout._replace(sent=link.channel.record_size)
            read = make_sample_reader(sample_layout)
            key = self._key(topics.SAMPLE, link.peer)
            self.rings.append(bus.stamped_inbox(key, clock.monotonic_ns, read))

        # The arm, its simulation by the user, and its operator.
        self.arm: ExternalArm | None = None
        self.switch: DeadManSwitch | None = None
        self._connect_outside_arm()
        self.plant: PlantPlayer | None = None
        plant = scenario.sites[name].plant
        if isinstance(plant, OwnPlant):
            run_plant = self._watch_code(f"the plant {plant.code}", self.site.rate_hz)
            self.plant = PlantPlayer(scenario, name, plant, run_plant)
        self.hand: HandServer | HandPlayer | None = None
        self._connect_hand()

        # What the site publishes.
        past_queries = bus.query_inbox(self._key(topics.PAST))
        self.buffer = RetransmitBuffer(self.site, self.boot, past_queries)
        self._make_publishers()

        # Members of the session, and requests of users.
        self.monitor = PeerMonitor(
            bus, options.session, name, self.site.peers, admits=scenario.sites_may_return
        )
        self._next_tick = -1
        self.changes = ChangeServer(
            scenario=scenario,
            site=name,
            queries=bus.query_inbox(self._key(topics.SET)),
            mode=lambda: self.site.mode,
            held=lambda: self.switch is None or self.switch.held,
            stops=bus.query_inbox(self._key(topics.STOP)),
        )

        warm_up(scenario, name, clock)

    def _key(self, channel: str, member: str = "") -> str:
        """Returns the Zenoh key under which a process publishes a channel.

        A key contains the names of the session, the process, and the channel.

        Args:
            channel: Name of the channel, such as its records or events, see `topics`.
            member: Name of another process of the session. Empty for this one.
        """
        return topics.key(self.options.session, member or self.name, channel)

    def _make_publishers(self) -> None:
        """Creates the functions that publish samples, records and statistics.

        Samples go to the peers; records and statistics go to the recorder. The latter are also
        stored in the buffer, from which a recorder can request those that it has lost.
        """
        scenario = self.scenario
        self.publish_sample = self.bus.publisher(self._key(topics.SAMPLE))
        send_records = self._make_storing_publisher(topics.STATE)
        send_statistics = self._make_storing_publisher(topics.LINK)
        self.publish_link: Callable[[bytes], None] = lambda payload: send_statistics([payload])

        # Usually the records of several ticks are sent together. They are sent in every tick if
        # the site has a real arm or may be restarted: if such a site is killed, its last
        # records must not be lost.
        sends_every_tick = self.arm is not None or scenario.sites_may_return
        self.states = StateBlock(
            site=self.site,
            boot=self.boot,
            send=send_records,
            turn=scenario.names.index(self.name),  # sites send in different ticks
            single=sends_every_tick,
        )
        peers_can_wait = _may_hold_samples(scenario, self.name)
        self.states.holds_samples = peers_can_wait and not sends_every_tick

    def _watch_code(self, name: str, rate_hz: int) -> Callable[..., Any]:
        """Returns a function that calls a user's code and limits its computing time.

        Without this limit, slow code would delay the control loop.

        Args:
            name: Name of the code, such as "the plant myplant:MyPlant".
            rate_hz: How often the code is called, in 1/s.

        Returns:
            A function of the number of the tick and the function to call, see
            `WatchedCode.run`. It raises TimeoutError if the code is too slow.
        """
        code = WatchedCode(name, rate_hz, lambda _, problem: TimeoutError(problem), self.clock)
        self.watchdog.codes.append(code)
        return code.run

    def _connect_hand(self) -> None:
        """Creates the object through which people or programs move the arm, if there are any.

        A user's operator class runs in this process (`HandPlayer`) or in its own process
        (`RemoteHand`). Without such a class, people and programs may move the arm over the
        network (`HandServer`).
        """
        name = self.name
        live_hand = self.scenario.sites[name].find_live_hand()
        if live_hand is None:
            return

        own_hand = HandSite.find(self.scenario, name)
        if own_hand is not None and not self.scenario.sites[name].needs_hand_process:
            run_hand = self._watch_code(f"the hand {own_hand.program}", own_hand.rate_hz)
            self.hand = HandPlayer(own_hand, own_hand.make_program(), run_hand)
            return

        inbox = self.bus.inbox(self._key(topics.HAND), MESSAGES_KEPT)
        if own_hand is not None:
            self.hand = RemoteHand(
                hand_site=own_hand,
                boot=self.boot,
                inbox=inbox,
                publish=self.bus.publisher(self._key(topics.VIEW)),
                dropped=self.stats.dropped,
                clock=self.clock,
            )
            return

        self.hand = HandServer(
            site=self.site,
            hand=live_hand,
            arm=self.scenario.arms[name],
            inbox=inbox,
            dropped=self.stats.dropped,
            limits=self.scenario.motion_limits(name),
        )

    def _connect_outside_arm(self) -> None:
        """Connects the site to the driver of an external arm, and to its dead-man switch.

        `arm` stays None if the site simulates the arm. `switch` stays None if the arm has no
        dead-man switch.
        """
        name = self.name
        read_clock = self.clock.monotonic_ns
        if name in self.scenario.outside:
            key = self._key(topics.MEASURED)
            connection = self.options.connection
            # The driver connects to an endpoint of this site, or to the router of this site.
            endpoints = connection.reach(connection.listen or connection.connect or ())
            self.arm = ExternalArm(
                site=self.site,
                ring=self.bus.stamped_inbox(key, read_clock, bytes, MEASUREMENTS_KEPT),
                clock=self.clock,
                dropped=self.stats.dropped,
                address=" at ".join([key, *map(str, endpoints[:1])]),
            )

        if self.scenario.sites[name].arm.dead_man:
            ring = self.bus.stamped_inbox(
                self._key(topics.ENABLE), read_clock, bytes, MEASUREMENTS_KEPT
            )
            self.switch = DeadManSwitch(name, ring, self.clock, self.stats.dropped)

    def _make_storing_publisher(self, channel: str) -> Callable[[list[bytes]], None]:
        """Returns a function that publishes messages and also stores them for a while.

        A recorder that has missed a message requests it again, and receives the stored copy.

        Args:
            channel: Channel of the messages, records or statistics.
        """
        store = self.buffer.channels[channel].store
        publish = self.bus.publisher(self._key(channel))

        def store_and_publish(payloads: list[bytes]) -> None:
            """Stores messages so that they can be resent, and publishes them in blocks.

            Args:
                payloads: The encoded messages.
            """
            for payload in payloads:
                store(payload)
            for block in join_states(payloads):
                publish(block)

        return store_and_publish

    def pop_changes(self, tick: int) -> list[CoreChange]:
        """Returns the changes of settings or mode that the site applies in the next tick.

        Some changes were requested by users. Others are caused by an external arm: ticks were
        skipped, its measurements stopped arriving, or its dead-man switch was released or is
        held again.

        Args:
            tick: Number of the tick.
        """
        changes = list(self.changes.pop_changes(tick))
        if self.arm is None:
            return changes

        # No tick is skipped before the first one, even if that is the late first tick of a site
        # that joins a running session.
        is_first_tick = self._next_tick < 0
        skipped = 0 if is_first_tick else tick - self._next_tick
        self._next_tick = tick + 1  # the next tick if no tick is skipped
        if skipped:
            self.buffer.skip(tick - skipped, tick)
            changes.append(self._make_order_change(tick, "overrun", skipped))

        mode = self.site.mode
        orders: list[SiteOrder] = [self.arm.pop_order(mode)]
        if self.switch is not None:
            orders.append(self.switch.pop_order(self.site))
        changes += [self._make_order_change(tick, order) for order in orders if order]
        return changes

    def _make_order_change(self, tick: int, order: SiteOrder, skipped: int = 0) -> CoreChange:
        """Returns the change that makes a command from the site itself take effect in a tick.

        Such commands are caused by an external arm, for example "released" if its dead-man
        switch was released. As a change, the command is part of the record, so that the run can
        be repeated.

        Args:
            tick: Number of the tick.
            order: The command.
            skipped: Number of skipped ticks, for the command "overrun".
        """
        change = self.scenario.make_site_order(
            site=self.name, order=order, from_ns=tick_ns(tick, self.site.rate_hz), ticks=skipped
        )
        return self.scenario.to_core_change(change)


_MIN_HELD_DELAY_US = 100_000
"""Minimum delay of a link whose samples may be sent late without an effect, in us."""


def _may_hold_samples(scenario: Scenario, name: str) -> bool:
    """Returns True if a site may send the samples of several ticks together, and thus late.

    The receiver of a link delays each sample as prescribed by the scenario, counted from the
    tick of the sample and not from its arrival. If every link from the site prescribes at least
    `_MIN_HELD_DELAY_US`, no peer uses a sample before that time, so sending it a few
    milliseconds late has no effect on the run.

    The result applies to the delays in the scenario. If the user shortens a delay during the
    run, the site stops holding samples, see `PeerAdmission.watch_members`.

    Args:
        scenario: The scenario.
        name: Name of the site.
    """
    for receiver in scenario.names:
        for link in scenario.setup(receiver).links:
            sender = link.peer
            if sender != name:
                continue
            # The models replace each other in the course of the run.
            for model in link.models:
                if model.least_us < _MIN_HELD_DELAY_US:
                    return False
    return True


WARM_UP_TICKS = 200
"""Number of ticks after which all code of a tick has been used at least once."""


def warm_up(scenario: Scenario, name: str, clock: Clock | None = None) -> None:
    """Executes the control loop of a temporary site, so that all code is compiled.

    Otherwise, the first ticks of the actual site would be late.

    Args:
        scenario: The scenario.
        name: Name of the site.
        clock: Clock of this process. If None, a clock is created.

    Raises:
        LawFailed: The user's law fails although all arms are at rest at their start.
    """
    setup = scenario.setup(name)
    site = Site(setup)
    watchdog, step = _watch_law(scenario, site, clock or SystemClock())
    try:
        with watchdog:
            _run_warm_up(setup, site, step)
    except LawFailed as failed:
        problem = (
            f"{failed.problem}; this was the rehearsal, with every arm at rest where it starts"
        )
        raise LawFailed(problem, site=name, code=failed.code, tick=failed.tick) from None


def _watch_law(
    scenario: Scenario, site: Site, clock: Clock
) -> tuple[CodeWatchdog, Callable[[TickInput], TickRecord]]:
    """Creates the function that computes a tick, and a watchdog for a user's control law.

    A control law that the user has written in Python may be too slow or never return. The
    watchdog limits its computing time. The built-in laws need no watchdog.

    Args:
        scenario: The scenario.
        site: The site in the simulation kernel.
        clock: Clock of this process.

    Returns:
        watchdog: The watchdog. It monitors only the user's law, and nothing if the law is
        built-in. step: Function that computes one tick of the site. It raises LawFailed if the
        user's law fails or is too slow.
    """
    law = scenario.sites[site.name].control
    if not isinstance(law, ImportedLaw):
        idle_watchdog = CodeWatchdog()
        return idle_watchdog, site.step

    def make_error(tick: int, problem: str) -> LawFailed:
        return LawFailed(problem, site=site.name, code=law.code, tick=tick)

    watched_law = WatchedCode(f"the law {law.code}", site.rate_hz, make_error, clock)

    def watched_step(inputs: TickInput) -> TickRecord:
        return watched_law.run(inputs.k, lambda: site.step(inputs))

    return CodeWatchdog(watched_law), watched_step


def _run_warm_up(setup: SiteSetup, site: Site, step: Callable[[TickInput], TickRecord]) -> None:
    """Executes ticks of a temporary site, and encodes and decodes the messages of each tick.

    Every tick except the first receives one sample from each peer, so that all code of a tick
    is executed.

    Args:
        setup: Settings of the site.
        site: The site in the simulation kernel.
        step: Function that computes a tick of the site.
    """
    site.start_at(0)
    site.release_tick(0, 0)  # as when a site joins late
    estimator = OffsetEstimator()
    measured = PlantState(setup.q0, setup.qd0) if setup.external else None

    for tick in range(WARM_UP_TICKS):
        arrivals = []
        if tick > 0:
            for index, link in enumerate(setup.links):
                speeds = (0.0,) * len(link.q0)
                channel = (0.0,) * link.channel.received_size
                arrivals.append(Arrival(index, tick - 1, link.q0, speeds, ch=channel))

        output = step(TickInput(tick, arrivals, (), measured))
        echo = [(arrival.peer, arrival.tick, tick) for arrival in arrivals]

        sample = encode_sample(site=setup.name, boot=0, output=output, sent_ns=tick, echo=echo)
        decode(sample, PeerSample, layout=site.layout)
        encode_state(
            site=setup.name,
            boot=0,
            peers=site.peers,
            output=output,
            arrivals=arrivals,
            late_us=0,
            busy_us=0,
            sent_ns=tick,
            echo=echo,
        )
        estimator.add(OffsetLimit(tick, 1), OffsetLimit(tick, -1))

    estimator.estimate(WARM_UP_TICKS)

"""The parts of a site that live from its start to its end, and its options.

Invariant: once made, every subscription of the site is declared and its step is compiled, so a
site that declares itself alive is ready for its session.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from trilat_net.core.site_setup import SiteSetup
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import (
    Arrival,
    CoreChange,
    PlantState,
    TickInput,
    TickRecord,
    first_tick_at,
    tick_ns,
)
from trilat_net.errors import LawFailed
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection
from trilat_net.net.membership import new_boot
from trilat_net.net.messages import PeerSample
from trilat_net.net.offset import OffsetEstimator, OffsetLimit
from trilat_net.net.timing import LoopStats
from trilat_net.net.wire import decode, encode_sample, encode_state, join_states
from trilat_net.process import Interrupt
from trilat_net.scenario import Scenario
from trilat_net.scenario.imported_code import ImportedLaw
from trilat_net.scenario.operators.program_hand import (
    HandPlayer,
    find_own_hand,
    make_hand_program,
)
from trilat_net.scenario.own_plant import OwnPlant, PlantPlayer
from trilat_net.scenario.run_changes import make_site_order, to_core_change
from trilat_net.scenario.scenario_types import SiteOrder

from .change_server import ChangeServer
from .code_watchdog import CodeWatchdog, WatchedCode
from .external_arm import MEASUREMENTS_KEPT, DeadManSwitch, ExternalArm
from .hand_server import MESSAGES_KEPT, HandServer, RemoteHand
from .peer_monitor import PeerMonitor
from .retransmit_buffer import RetransmitBuffer
from .site_loop import StateBlock, make_sample_readers, may_hold_samples


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """How a site takes part in a session.

    Attributes:
        stay_s: how long to stay afterwards until the recorder has left, at most, s.
        without: sites without which the session begins; they may join it while it runs.
        leave_timeout_s: how long to go on after a site has left that does not come back, s;
            None: to the end.
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
    """One site's parts; those that its scenario does not ask for are None."""

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
        self.setup = scenario.setup(name)
        self.site = Site(self.setup)
        self.boot = new_boot()
        peers = self.site.peers
        session = options.session
        self.stats = LoopStats(self.site, self.boot)
        self.watchdog, self.step = watch_law(scenario, self.site, clock)
        self.rings = [
            bus.stamped_inbox(
                topics.key(session, link.peer, topics.SAMPLE), clock.monotonic_ns, read
            )
            for link, read in zip(
                self.setup.links, make_sample_readers(self.setup), strict=True
            )
        ]
        self.arm: ExternalArm | None = None
        self.switch: DeadManSwitch | None = None
        self._meet_outside_arm()
        self.plant: PlantPlayer | None = None
        if isinstance(plant := scenario.sites[name].plant, OwnPlant):
            watch = self._watch(f"the plant {plant.code}", self.site.rate_hz)
            self.plant = PlantPlayer(scenario, name, plant, watch)
        self.hand: HandServer | HandPlayer | None = None
        self._meet_hand()
        queries = bus.query_inbox(topics.key(session, name, topics.PAST))
        self.buffer = RetransmitBuffer(self.site, self.boot, queries)
        self.publish_sample = bus.publisher(topics.key(session, name, topics.SAMPLE))
        # a site that is killed loses no record
        single = self.arm is not None or scenario.sites_may_return
        send_states, send_links = map(self._keeping_publisher, (topics.STATE, topics.LINK))
        self.states = StateBlock(
            self.site, self.boot, send_states, scenario.names.index(name), single=single
        )
        self.states.holds_samples = not single and may_hold_samples(scenario, name)
        self.publish_link: Callable[[bytes], None] = lambda payload: send_links([payload])
        self.monitor = PeerMonitor(bus, session, name, peers, admits=scenario.sites_may_return)
        self._next_tick = -1
        asked, stops = (
            bus.query_inbox(topics.key(session, name, one)) for one in (topics.SET, topics.STOP)
        )
        inputs = (lambda: self.site.mode), (lambda: self.switch is None or self.switch.held)
        self.changes = ChangeServer(scenario, name, asked, *inputs, stops)
        warm_up(scenario, name, clock)

    def _watch(self, name: str, rate_hz: int) -> Callable[..., Any]:
        """Returns what calls code of one's own under the watchdog; one that is too slow raises."""
        code = WatchedCode(name, rate_hz, lambda _, problem: TimeoutError(problem), self.clock)
        self.watchdog.codes.append(code)
        return code.run

    def _meet_hand(self) -> None:
        name = self.name
        bus = self.bus
        session = self.options.session
        live = self.scenario.sites[name].find_live_hand()
        at = find_own_hand(self.scenario, name)
        if live is None:
            return
        if at is not None and not at.has_separate_process:
            watch = self._watch(f"the hand {at.program}", at.rate_hz)
            self.hand = HandPlayer(at, make_hand_program(at), watch)
            return
        inbox = bus.inbox(topics.key(session, name, topics.HAND), MESSAGES_KEPT)
        dropped = self.stats.dropped
        if at is not None:
            publish = bus.publisher(topics.key(session, name, topics.VIEW))
            self.hand = RemoteHand(
                at=at,
                boot=self.boot,
                inbox=inbox,
                publish=publish,
                dropped=dropped,
                clock=self.clock,
            )
            return
        self.hand = HandServer(
            site=self.site,
            hand=live,
            arm=self.scenario.arms[name],
            inbox=inbox,
            dropped=dropped,
            limits=self.scenario.motion_limits(name),
        )

    def _meet_outside_arm(self) -> None:
        name = self.name
        session = self.options.session
        dropped = self.stats.dropped
        measured, enable = (
            topics.key(session, name, one) for one in (topics.MEASURED, topics.ENABLE)
        )
        if name in self.scenario.outside:
            ring = self.bus.stamped_inbox(
                measured, self.clock.monotonic_ns, bytes, MEASUREMENTS_KEPT
            )
            connection = self.options.connection
            # its own, or a router
            reached = connection.reach(connection.listen or connection.connect or ())
            place = " at ".join([measured, *map(str, reached[:1])])
            self.arm = ExternalArm(
                site=self.site, ring=ring, clock=self.clock, dropped=dropped, place=place
            )
        if self.scenario.sites[name].arm.dead_man:
            ring = self.bus.stamped_inbox(
                enable, self.clock.monotonic_ns, bytes, MEASUREMENTS_KEPT
            )
            self.switch = DeadManSwitch(name, ring, self.clock, dropped)

    def _keeping_publisher(self, channel: str) -> Callable[[list[bytes]], None]:
        keep = self.buffer.channels[channel].keep
        publish = self.bus.publisher(topics.key(self.options.session, self.name, channel))

        def keep_and_publish(payloads: list[bytes]) -> None:
            for payload in payloads:
                keep(payload)
            for block in join_states(payloads):
                publish(block)

        return keep_and_publish

    def take_changes(self, k: int) -> list[CoreChange]:
        """Returns what the site takes in at tick k: requests, and what it finds out about its
        own arm.
        """
        changes = list(self.changes.take(k))
        if self.arm is None:
            return changes
        # it may join a running session
        skipped = k - self._next_tick if self._next_tick >= 0 else 0
        self._next_tick = k + 1
        if skipped:
            self.buffer.skip(k - skipped, k)
        mode = self.site.mode
        orders: list[tuple[SiteOrder, int]] = [
            ("overrun", skipped),
            (self.arm.take_order(mode), 0),
        ]
        if self.switch is not None:
            orders.append((self.switch.take_order(mode, self.site.life_reason), 0))
        for order, ticks in orders:
            if ticks or (order and order != "overrun"):
                t_ns = tick_ns(k, self.site.rate_hz)
                change = make_site_order(
                    scenario=self.scenario,
                    site=self.name,
                    order=order,
                    from_ns=t_ns,
                    ticks=ticks,
                )
                changes.append(to_core_change(self.scenario, change))
        return changes


WARM_UP_TICKS = 200


def warm_up(scenario: Scenario, name: str, clock: Clock | None = None) -> None:
    """Steps a throw-away site, so that all code of a tick is compiled and in memory; it leaves
    no trace.

    Raises:
        LawFailed: a user law fails already with every arm at rest where it starts.
    """
    setup = scenario.setup(name)
    site = Site(setup)
    watchdog, step = watch_law(scenario, site, clock or SystemClock())
    try:
        with watchdog:
            _warm(setup, site, step)
    except LawFailed as failed:
        problem = (
            f"{failed.problem}; this was the rehearsal, with every arm at rest where it starts"
        )
        raise LawFailed(problem, site=name, code=failed.code, tick=failed.tick) from None


def watch_law(
    scenario: Scenario, site: Site, clock: Clock
) -> tuple[CodeWatchdog, Callable[[TickInput], TickRecord]]:
    """Returns what watches a site's law, if that is a user's, and the step of the site."""
    law = scenario.sites[site.name].control
    if not isinstance(law, ImportedLaw):
        return CodeWatchdog(), site.step

    def fail(k: int, problem: str) -> LawFailed:
        return LawFailed(problem, site=site.name, code=law.code, tick=k)

    code = WatchedCode(f"the law {law.code}", site.rate_hz, fail, clock)
    return CodeWatchdog(code), lambda tick: code.run(tick.k, lambda: site.step(tick))


def _warm(setup: SiteSetup, site: Site, step: Callable[[TickInput], TickRecord]) -> None:
    site.start_at(first_tick_at(0, site.rate_hz))
    site.release_tick(0, 0)  # as a site does that joins late
    estimator = OffsetEstimator()
    measured = PlantState(setup.q0, setup.qd0) if setup.external else None
    for k in range(WARM_UP_TICKS):
        arrivals = [
            Arrival(
                j, k - 1, link.q0, (0.0,) * len(link.q0), ch=(0.0,) * link.channel.received_size
            )
            for j, link in enumerate(setup.links)
            if k > 0
        ]
        output = step(TickInput(k, arrivals, (), measured))
        echo = [(arrival.peer, arrival.tick, k) for arrival in arrivals]
        decode(
            encode_sample(site=setup.name, boot=0, output=output, sent_ns=k, echo=echo),
            PeerSample,
            layout=site.layout,
        )
        encode_state(
            site=setup.name,
            boot=0,
            peers=site.peers,
            output=output,
            arrivals=arrivals,
            late_us=0,
            busy_us=0,
            sent_ns=k,
            echo=echo,
        )
        estimator.add(OffsetLimit(k, 1), OffsetLimit(k, -1))
    estimator.estimate(WARM_UP_TICKS)

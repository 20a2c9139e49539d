"""Measures how late the control loop of an arm runs on this machine, without a network.

`trilat doctor` uses this module to find the highest tick rate that the machine can sustain. A
tick is late if it begins after the time at which it was due. The loop does the same work as in
a session, except that no messages are exchanged.
"""

from collections.abc import Sequence

from trilat_net.core import Site, TickInput
from trilat_net.net import Clock, LoopStats, SiteTiming
from trilat_net.records import NS_PER_S, Arrival, TickRecord
from trilat_net.scenario import Scenario

from .site_loop import PeerInbox, StateBlock, run_loop


def rehearse_loop(scenario: Scenario, name: str, clock: Clock) -> list[int]:
    """Runs the control loop of one arm in real time, and measures how late ticks begin.

    `trilat doctor` uses the result to decide whether this machine is fast enough. The loop runs
    without other arms and without a network.

    Args:
        scenario: The scenario.
        name: Name of the site.
        clock: Clock of this process.

    Returns:
        The time from when each tick was due until it began, in us.
    """
    return _Rehearsal(scenario, name).run(clock)


class _Rehearsal(LoopStats):
    """Runs the control loop of a single site without a network, to measure how late ticks are.

    The loop does the same work as in a session, except that no messages are exchanged. This
    object stands in for two objects of the loop: for its statistics, to store the lateness of
    each tick, and for the `_LoopSite`, whose methods do nothing here.

    A tick is late if it begins after the time at which it was due.

    Args:
        scenario: The scenario.
        name: Name of the site.
    """

    def __init__(self, scenario: Scenario, name: str) -> None:
        self._site = Site(scenario.setup(name))
        self._ticks = scenario.ticks(name)
        super().__init__(self._site, 1)
        self._late_us: list[int] = []

    def run(self, clock: Clock) -> list[int]:
        """Runs the control loop of one arm for the scenario's duration, in real time.

        The loop receives no messages from other arms, and its results are not sent anywhere.

        Args:
            clock: Clock of this process.

        Returns:
            The time from when each tick was due until it began, in us.
        """
        boot = 1  # identifies the start of the process, which matters only in a network
        inbox_without_peers = PeerInbox(
            links=(), rings=(), boots=(), monitors=(), dropped=self.dropped
        )
        # The first tick is due a tenth of a second from now.
        first_tick_ns = clock.monotonic_ns() + NS_PER_S // 10
        timing = SiteTiming(first_tick_ns, self._site.rate_hz, peers=(), leader="")
        discarded_records = StateBlock(self._site, boot, send=lambda _: None)

        run_loop(
            site=self._site,
            boot=boot,
            ticks=self._ticks,
            clock=clock,
            inbox=inbox_without_peers,
            timing=timing,
            stats=self,
            states=discarded_records,
            io=self,
        )
        return self._late_us

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Stores how late one tick began.

        Called by the loop in place of `LoopStats.count_tick`.

        Args:
            late_us: How late the tick began, in us.
            busy_us: Computing time of the previous tick, in us.
            skipped: Number of ticks that were skipped before this tick.
        """
        super().count_tick(late_us, busy_us, skipped)
        self._late_us.append(late_us)

    def step(self, tick: int, arrivals: Sequence[Arrival]) -> TickRecord:
        """Computes one tick of the arm without samples from other arms, to test the timing.

        Called by the loop in place of `_LoopSite.step`.

        Args:
            tick: Number of the tick.
            arrivals: Samples that have arrived. Always empty in this test.

        Returns:
            The record of the tick.
        """
        return self._site.step(TickInput(tick, arrivals))

    def run_housekeeping(self, *_: object) -> bool:
        """Does nothing, because this test of the control loop has no network.

        The loop calls this method ten times per second. In a session, the site then replies to
        queries and publishes events.

        Returns:
            False, to continue the loop.
        """
        return False

    # The other methods of `_LoopSite`.
    publish_sample = run_housekeeping
    publish_link = run_housekeeping
    report_tick = run_housekeeping
    should_stop = run_housekeeping
    use_slack = run_housekeeping

"""The real-time loop of a site on an absolute tick grid, and the inbox of its peers' samples.

Invariant (L1): tick k lies at epoch + k periods of the leader's grid. Lateness is telemetry and enters no
formula; a late loop runs its missed ticks back to back and counts them. No arriving payload can raise out
of the loop: it is a peer's sample, or it is counted by reason and dropped. Samples carry the instants of
their arrival, not of their draining.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trilat_net.core.link import AHEAD_LIMIT_NS
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import (
    MAX_ARRIVALS,
    NS_PER_S,
    Arrival,
    CoreChange,
    Mode,
    PlantState,
    TickInput,
    TickRecord,
)
from trilat_net.errors import LawFailed, WireError
from trilat_net.net.bus import StampedInbox
from trilat_net.net.clock import Clock
from trilat_net.net.loop_stats import LoopStats
from trilat_net.net.messages import PeerSample
from trilat_net.net.timing import LinkTimingMonitor, SiteTiming
from trilat_net.net.wire import decode, encode, encode_state


class PeerInbox:
    """The rings of a site's peers.

    Args:
        peers: names of the peers, in scenario order.
        rings: their rings.
        rates: their tick rates, Hz.
        dropped: where what is dropped is counted, by reason.
    """

    def __init__(
        self, peers: Sequence[str], rings: Sequence[StampedInbox], rates: Sequence[int], dropped: Counter[str]
    ) -> None:
        self._peers, self._rings, self._rates = peers, rings, rates
        self._dropped = dropped
        self._boots: list[int] = []
        self._meters: list[LinkTimingMonitor] = []
        self._last = [-1] * len(peers)

    def admit(self, boots: Sequence[int], meters: Sequence[LinkTimingMonitor]) -> None:
        """Says which start of each peer belongs to the session, and what measures its link.

        Messages of other starts are dropped.
        """
        self._boots, self._meters = list(boots), list(meters)

    def drain(self, since_epoch_ns: int) -> list[Arrival]:
        """Returns what has come, peer by peer, each in its order; at most MAX_ARRIVALS, the rest waits.

        Args:
            since_epoch_ns: nominal time since the epoch, ns.
        """
        arrivals: list[Arrival] = []
        for index, ring in enumerate(self._rings):
            while len(arrivals) < MAX_ARRIVALS and (message := ring.poll()) is not None:
                arrival = self._arrival(index, *message, since_epoch_ns)
                if arrival is not None:
                    arrivals.append(arrival)
        return arrivals

    def _arrival(self, index: int, payload: bytes, arrived_ns: int, since_epoch_ns: int) -> Arrival | None:
        try:
            sample = decode(payload, PeerSample)
        except WireError as error:
            self._dropped[error.reason] += 1
            return None
        if sample.site != self._peers[index] or sample.boot != self._boots[index]:
            self._dropped["stranger"] += 1
            return None
        stamp_ns = sample.tick * NS_PER_S // self._rates[index]
        if stamp_ns - since_epoch_ns > AHEAD_LIMIT_NS:
            self._dropped["ahead"] += 1
            return None
        if sample.tick > self._last[index] + 1:  # dropped on the way, or the ring overflowed
            self._dropped["missing"] += sample.tick - self._last[index] - 1
        self._last[index] = max(self._last[index], sample.tick)
        delay_ns = self._meters[index].take(sample, arrived_ns)
        return Arrival(index, sample.tick, sample.q, sample.qd, delay_ns // 1000, sample.tau_x)


@dataclass(slots=True)
class LoopIO:
    """What the loop touches besides its site.

    Attributes:
        clock: the time.
        intake: the peers' samples.
        timing: when ticks are due, and what the stamps say.
        publish_state: publishes a record.
        publish_link: publishes statistics.
        slack: called ten times a second, after the tick's work is done, with the tick and its nominal time.
        stopped: True once the loop was asked to end.
        commands: what the site is ordered at a tick.
        news: called after a tick that took a command in, or at which the mode changed.
        spare: called after a tick that left a quarter of its period.
        measured: what an arm outside of the program was measured to do, at this instant.
        step: steps the site; by default the site's own.
        failed: is told of a law from outside that failed; the loop ends then.
    """

    clock: Clock
    intake: PeerInbox
    timing: SiteTiming
    publish_state: Callable[[bytes], None]
    publish_link: Callable[[bytes], None]
    slack: Callable[[int, int], None]
    stopped: Callable[[], bool]
    commands: Callable[[int], Sequence[CoreChange]] = lambda _: ()
    news: Callable[[TickRecord], None] = lambda _: None
    spare: Callable[[], object] = lambda: None
    measured: Callable[[], PlantState | None] = lambda: None
    step: Callable[[TickInput], TickRecord] | None = None
    failed: Callable[[LawFailed], None] | None = None


def run_loop(site: Site, boot: int, ticks: int, stats: LoopStats, ports: LoopIO) -> TickRecord | None:
    """Runs a site in real time, from tick 0, and returns its last record.

    Args:
        site: the site, at its start.
        boot: this process's boot.
        ticks: how many ticks to make.
        stats: where the loop is accounted for.
        ports: what the loop touches.

    Returns:
        The last record: its mode says whether the run stayed within its limits. None if it made no tick.

    Raises:
        LawFailed: a law from outside did, and nobody wants to be told.
    """
    clock, intake, timing = ports.clock, ports.intake, ports.timing
    step = ports.step or site.step
    quarter_ns = NS_PER_S // (4 * site.rate_hz)
    busy_us = 0
    mode = Mode.RUN
    output = None
    for k in range(ticks):
        deadline_ns = timing.grid.deadline(k)
        clock.sleep_until(deadline_ns)
        if ports.stopped():
            break
        woke_ns = clock.monotonic_ns()
        late_us = max(0, (woke_ns - deadline_ns) // 1000)
        arrivals = intake.drain(k * NS_PER_S // site.rate_hz + woke_ns - deadline_ns)
        try:
            output = step(TickInput(k, arrivals, ports.commands(k), ports.measured()))
        except LawFailed as failed:  # of this tick there is no record
            if ports.failed is None:
                raise
            ports.failed(failed)
            break
        sent_ns, echo = timing.sent(k, clock.monotonic_ns()), timing.echo()
        ports.publish_state(
            encode_state(site.name, boot, site.peers, output, arrivals, late_us, busy_us, sent_ns, echo)
        )
        stats.tick(late_us, busy_us)
        if stats.due(k):
            ports.publish_link(encode(stats.take(output, timing.measured(woke_ns))))
            ports.slack(k, output.t_ns)
        if output.mode is Mode.DIVERGED:
            break
        if output.cmd or output.mode is not mode:
            mode = output.mode
            ports.news(output)
        if timing.grid.deadline(k + 1) - clock.monotonic_ns() > quarter_ns:
            ports.spare()
        busy_us = (clock.monotonic_ns() - woke_ns) // 1000
    return output

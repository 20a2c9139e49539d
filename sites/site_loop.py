"""The real-time loop of a site on an absolute tick grid, and the inbox of its peers' samples.

Invariant (L1):
    - Tick k lies at the epoch plus k periods of the leader's grid; the site wakes up for it in
      its turn.
    - Lateness is telemetry and enters no formula. A late loop runs its missed ticks back to
      back and counts them. With an external arm it skips them, because the arm has moved on in
      the meantime: the numbers of its ticks then jump.
    - No received payload can raise out of the loop: it is a peer's sample, or it is counted by
      reason and dropped.
    - Samples are decoded when they arrive, before their tick. They carry the instants of their
      arrival, not of the tick that reads them.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from trilat_net.core.delay import DelayKind
from trilat_net.core.link import AHEAD_LIMIT_NS
from trilat_net.core.live_hand import HandInForce
from trilat_net.core.site_setup import LinkSetup, SiteSetup
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import (
    MAX_ARRIVALS,
    NS_PER_S,
    Arrival,
    Mode,
    TickRecord,
    first_tick_at,
)
from trilat_net.errors import WireError
from trilat_net.net.bus import StampedInbox
from trilat_net.net.clock import Clock
from trilat_net.net.messages import PeerSample
from trilat_net.net.timing import LinkTimingMonitor, LoopStats, SiteTiming
from trilat_net.net.wire import encode, encode_sample, encode_state, make_reader
from trilat_net.scenario import Scenario

if TYPE_CHECKING:
    from .site_process import RunningSite


def make_sample_readers(setup: SiteSetup) -> list[Callable[[bytes], PeerSample | WireError]]:
    """Returns a decoder of samples for each peer of a site.

    The decoders run in threads of the network, where nothing may raise: they return the error.
    """
    layouts = [setup.layout._replace(sent=link.channel.record_size) for link in setup.links]
    return [make_reader(PeerSample, layout) for layout in layouts]


GLIDE_AHEAD_LIMIT_NS = NS_PER_S
"""Under `glide`, samples stamped further ahead than this are dropped."""
STEP_MARGIN_RAD = 0.02
"""Distance by which a joint may exceed the way that its speed limit allows."""


class PeerInbox:
    """The samples of a site's peers.

    Messages of other boots are dropped. A site that joins late ignores samples stamped before
    its own first tick. Under `glide`, samples that the peer's arm cannot have reached since the
    previous one are dropped, and so are samples far ahead.

    Args:
        links: the links from the peers, in scenario order; all other sequences have this order.
        rings: the inboxes of the samples, with the instants of arrival.
        boots: the peers' boots.
        monitors: the timing monitors of the links.
        dropped: counts dropped samples by reason.
        from_ns: the site's first tick, ns since the epoch.
    """

    def __init__(
        self,
        links: Sequence[LinkSetup],
        rings: Sequence[StampedInbox[PeerSample | WireError]],
        boots: Sequence[int],
        monitors: Sequence[LinkTimingMonitor],
        dropped: Counter[str],
        from_ns: int = 0,
    ) -> None:
        self._links = links
        self._rings = rings
        self._from_ns = from_ns
        self._boots = list(boots)
        self._monitors = monitors
        self._dropped = dropped
        self._last = [first_tick_at(from_ns, link.rate_hz) - 1 for link in links]
        self._skipped_until = list(self._last)
        self._newest: list[PeerSample | None] = [None] * len(links)
        if from_ns:
            # Samples that arrived during the wait must not burden the first tick.
            self.drain(from_ns)

    def admit(self, index: int, boot: int, first: int) -> None:
        """Accepts from now on only samples of a peer's new boot, from its tick `first` on."""
        self._boots[index] = boot
        self._newest[index] = None
        self._last[index] = max(self._last[index], first - 1)
        self._skipped_until[index] = self._last[index]

    def find_last_tick_of(self, index: int, boot: int) -> int | None:
        """Returns the last tick received from a peer's present boot, if `boot` is another one.

        Returns None if `boot` is the present boot, or if no sample of the present one arrived.
        """
        last_tick = self._last[index]
        if boot != self._boots[index] and last_tick > self._skipped_until[index]:
            return last_tick
        return None

    def drain(self, since_epoch_ns: int) -> list[Arrival]:
        """Returns the arrived samples, peer by peer, each in order; at most MAX_ARRIVALS.

        Args:
            since_epoch_ns: the present time, ns since the epoch.
        """
        arrivals: list[Arrival] = []
        for index, ring in enumerate(self._rings):
            while len(arrivals) < MAX_ARRIVALS and (message := ring.poll()) is not None:
                sample, arrived_ns = message
                arrival = self._accept(index, sample, arrived_ns, since_epoch_ns)
                if arrival is not None:
                    arrivals.append(arrival)
        return arrivals

    def _accept(
        self, index: int, sample: PeerSample | WireError, arrived_ns: int, since_epoch_ns: int
    ) -> Arrival | None:
        """Returns the arrival of a sample; None if the sample is dropped."""
        if isinstance(sample, WireError):
            self._dropped[sample.reason] += 1
            return None
        link = self._links[index]
        if sample.site != link.peer or sample.boot != self._boots[index]:
            self._dropped["stranger"] += 1
            return None
        stamp_ns = sample.tick * NS_PER_S // link.rate_hz
        if stamp_ns < self._from_ns:
            return None
        glides = bool(link.speed_limit)
        ahead_limit_ns = GLIDE_AHEAD_LIMIT_NS if glides else AHEAD_LIMIT_NS
        if stamp_ns - since_epoch_ns > ahead_limit_ns:
            self._dropped["ahead"] += 1
            return None
        if glides and not self._is_reachable(index, sample):
            self._dropped["implausible"] += 1
            return None
        if sample.tick > self._last[index] + 1:  # lost on the way, or the ring overflowed
            self._dropped["missing"] += sample.tick - self._last[index] - 1
        self._last[index] = max(self._last[index], sample.tick)
        delay_ns = self._monitors[index].receive(sample, arrived_ns)
        return Arrival(
            peer=index,
            tick=sample.tick,
            q=sample.q,
            qd=sample.qd,
            latency_us=delay_ns // 1000,
            tau_x=sample.tau_x,
            ch=link.channel.select_for_peer(sample.ch, link.index_at_peer) if sample.ch else (),
        )

    def _is_reachable(self, index: int, sample: PeerSample) -> bool:
        """True if the peer's arm can have moved from its newest sample to this one."""
        link = self._links[index]
        newest = self._newest[index]
        for speed, limit in zip(sample.qd, link.speed_limit, strict=True):
            if not abs(speed) <= limit:  # also refuses NaN
                return False
        if newest is not None:
            elapsed_s = abs(sample.tick - newest.tick) / link.rate_hz
            steps = zip(sample.q, newest.q, link.speed_limit, strict=True)
            for angle, newest_angle, limit in steps:
                if not abs(angle - newest_angle) <= limit * elapsed_s + STEP_MARGIN_RAD:
                    return False
        if newest is None or sample.tick > newest.tick:
            self._newest[index] = sample
        return True


BLOCKS_PER_S = 100
"""Recorders receive the records of 10 ms in one block."""
WAKES_PER_S = 200
"""Peers on the same machine receive the samples of 5 ms together, if none is due sooner."""
MIN_HELD_DELAY_US = 100_000
"""Smallest delay of a link whose samples may be held back for that long."""


def may_hold_samples(scenario: Scenario, name: str) -> bool:
    """True if all links from a site delay its samples by at least `MIN_HELD_DELAY_US`.

    The site must receive the events of changes of these links, to stop holding samples in time.
    """
    links = [
        link
        for site in scenario.names
        for link in scenario.setup(site).links
        if link.peer == name
    ]
    models = [model for link in links for model in link.models]
    return all(
        max(model.playout_us, model.location * (model.kind == DelayKind.CONSTANT))
        >= MIN_HELD_DELAY_US
        for model in models
    )


class StateBlock:
    """The records of a site's latest ticks, which recorders receive in blocks.

    Recorders receive a record after the peers have received its sample.

    Args:
        site: the kernel's site.
        boot: the boot of this process.
        send: publishes the encoded records of a block.
        turn: the site's index in the scenario, so that sites of one processor take turns.
        single: whether every record is sent with its tick, for the program of an external arm.

    Attributes:
        holds_samples: whether peers receive several samples at once, so that they wake up less
            often.
    """

    def __init__(
        self,
        site: Site,
        boot: int,
        send: Callable[[list[bytes]], None],
        turn: int = 0,
        *,
        single: bool = False,
    ) -> None:
        self._site = site
        self._boot = boot
        self._send = send
        self._ticks = 1 if single else max(1, site.rate_hz // BLOCKS_PER_S)
        self._turn = 3 * turn % self._ticks
        self._ticks_per_wake = max(1, site.rate_hz // WAKES_PER_S)
        self.holds_samples = False
        self._waiting_records: list[tuple[Any, ...]] = []
        self._records: list[tuple[Any, ...]] = []

    def add(self, output: TickRecord, *facts: Any) -> bool:
        """Adds the record of a tick.

        Args:
            output: the record.
            facts: the further arguments of `encode_state` up to the stamps.

        Returns:
            True if the block is due. It is due at every tick while somebody holds the arm: the
            holder receives every record at once.
        """
        self._waiting_records.append((output, *facts))
        is_held = bool(output.hand) and HandInForce.read(output.hand).source > 0
        return is_held or (output.tick + 1) % self._ticks == self._turn

    def send_samples(self, k: int, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the waiting samples, if peers receive samples after tick `k`.

        Args:
            k: the tick.
            send: sends the sample of a record and returns its stamps.
        """
        if not self.holds_samples or (k + 1 - self._turn) % self._ticks_per_wake == 0:
            self._add_stamps(send)

    def _add_stamps(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        self._records += [(*record, *send(record[0])) for record in self._waiting_records]
        self._waiting_records.clear()

    def flush(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends all waiting samples and records."""
        self._add_stamps(send)
        site = self._site
        records = self._records
        self._records = []
        if records:
            self._send(
                [encode_state(site.name, self._boot, site.peers, *record) for record in records]
            )


def _publish_sample(
    name: str,
    boot: int,
    clock: Clock,
    timing: SiteTiming,
    io: "RunningSite",
    output: TickRecord,
) -> tuple[Any, ...]:
    """Publishes the sample of a record; returns its time of sending and its echoes."""
    sent_ns = timing.record_sent(output.tick, clock.monotonic_ns())
    echo = timing.pop_echo()
    io.publish_sample(encode_sample(name, boot, output, sent_ns, echo))
    return sent_ns, echo


def run_loop(
    site: Site,
    boot: int,
    ticks: int,
    clock: Clock,
    inbox: PeerInbox,
    timing: SiteTiming,
    stats: LoopStats,
    states: StateBlock,
    io: "RunningSite",
    first: int = 0,
    *,
    catches_up: bool = True,
) -> TickRecord | None:
    """Runs a site in real time.

    Args:
        site: the kernel's site.
        boot: the boot of this process.
        ticks: the tick before which the run ends.
        clock: the clock of this process.
        inbox: the samples of the peers.
        timing: the deadlines and clocks of the site.
        stats: the statistics of the loop.
        states: the records for the recorders.
        io: the steps, messages and events of the site.
        first: the first tick.
        catches_up: whether missed ticks are run back to back; otherwise they are skipped.

    Returns:
        The last record; None if no tick was run.
    """
    send = partial(_publish_sample, site.name, boot, clock, timing, io)
    quarter_ns = NS_PER_S // (4 * site.rate_hz)
    deadline_ns = timing.deadline_ns(first)
    busy_us = 0
    mode = Mode.RUN
    last = None
    has_slack_work = False
    k = first
    while k < ticks:
        clock.sleep_until(deadline_ns)
        if io.should_stop():
            break
        woke_ns = clock.monotonic_ns()
        skipped = 0
        if not catches_up and k > first and woke_ns >= timing.deadline_ns(k + 1):
            # Continue with the last tick whose deadline has passed.
            skipped = bisect_right(range(k, ticks), woke_ns, key=timing.deadline_ns) - 1
            k += skipped
            deadline_ns = timing.deadline_ns(k)
        late_us = max(0, (woke_ns - deadline_ns) // 1000)
        arrivals = inbox.drain(k * NS_PER_S // site.rate_hz + woke_ns - deadline_ns)
        output = io.step(k, arrivals)
        if output is None:  # the law or the plant failed: this tick has no record
            break
        last = output
        block_due = states.add(output, arrivals, late_us, busy_us)
        states.send_samples(k, send)
        stats.count_tick(late_us, busy_us, skipped)
        stats_due = stats.is_due(k, skipped)
        if block_due or stats_due:  # the statistics count records that must exist by then
            states.flush(send)
        if stats_due:
            io.publish_link(encode(stats.pop_stats(output, timing.pop_measurements(woke_ns))))
            io.run_housekeeping(k, output.t_ns)
        if output.mode is Mode.DIVERGED:
            break
        if output.cmd or output.mode is not mode:
            mode = output.mode
            io.report_tick(output)
        k += 1
        deadline_ns = timing.deadline_ns(k)
        if (block_due or has_slack_work) and deadline_ns - clock.monotonic_ns() > quarter_ns:
            has_slack_work = io.use_slack()
        busy_us = (clock.monotonic_ns() - woke_ns) // 1000
    states.flush(send)
    return last

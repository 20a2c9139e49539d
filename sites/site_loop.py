"""The real-time loop of a site on an absolute tick grid, and the inbox of its peers' samples.

Invariant (L1): tick k lies at epoch + k periods of the leader's grid; the site wakes up for it
in its turn. Lateness is telemetry and enters no formula; a late loop runs its missed ticks back
to back and counts them, or at an arm outside makes none of them, since no plant can be caught
up with: the numbers of its ticks jump. No arriving payload can raise out of the loop: it is a
peer's sample, or it is counted by reason and dropped. Samples are decoded as they arrive,
before their tick, and carry the instants of their arrival, not of their draining.
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
    """Returns for each peer of a site what reads its samples, in threads that nothing may raise
    in.
    """
    layouts = [setup.layout._replace(sent=link.channel.record_size) for link in setup.links]
    return [make_reader(PeerSample, layout) for layout in layouts]


GUARDED_AHEAD_NS = NS_PER_S
"""Of a site that glides: a stamp further ahead is dropped."""
STEP_MARGIN_RAD = 0.02
"""A peer's angle may be so much farther from the last one than its limit of speed lets it go.
"""


class PeerInbox:
    """The samples of a site's peers; every sequence has one entry for each, in scenario order.

    Messages of other boots are dropped; `dropped` counts what is dropped, by reason. A site
    that joins late passes over samples stamped before its own first tick, at `from_ns`: it
    takes nothing for the past. Under `glide` a sample that the peer's arm cannot have made
    since the last is dropped too, and one far ahead.
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
        self._passed_over = list(self._last)
        self._newest: list[PeerSample | None] = [None] * len(links)
        if from_ns:
            self.drain(from_ns)  # what came while it waited must not burden the first tick

    def admit(self, index: int, boot: int, first: int) -> None:
        """Takes from now on the samples of another start of a peer, which begins at a tick of
        its own.
        """
        self._boots[index] = boot
        self._newest[index] = None
        self._last[index] = max(self._last[index], first - 1)
        self._passed_over[index] = self._last[index]

    def newest_before(self, index: int, boot: int) -> int | None:
        """Returns the newest tick of which a sample came of a peer's start, if this is another
        one.
        """
        newest = self._last[index]
        return (
            newest if boot != self._boots[index] and newest > self._passed_over[index] else None
        )

    def drain(self, since_epoch_ns: int) -> list[Arrival]:
        """Returns the samples that arrived, peer by peer, each in order; at most MAX_ARRIVALS."""
        arrivals: list[Arrival] = []
        for index, ring in enumerate(self._rings):
            while len(arrivals) < MAX_ARRIVALS and (message := ring.poll()) is not None:
                arrival = self._read(index, *message, since_epoch_ns)
                if arrival is not None:
                    arrivals.append(arrival)
        return arrivals

    def _read(
        self, index: int, sample: PeerSample | WireError, arrived_ns: int, since_epoch_ns: int
    ) -> Arrival | None:
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
        guarded = bool(link.speed_limit)
        if stamp_ns - since_epoch_ns > (GUARDED_AHEAD_NS if guarded else AHEAD_LIMIT_NS):
            self._dropped["ahead"] += 1
            return None
        if guarded and not self._is_plausible(index, sample):
            self._dropped["implausible"] += 1
            return None
        if sample.tick > self._last[index] + 1:  # dropped on the way, or the ring overflowed
            self._dropped["missing"] += sample.tick - self._last[index] - 1
        self._last[index] = max(self._last[index], sample.tick)
        delay_ns = self._monitors[index].receive(sample, arrived_ns)
        ch = link.channel.select_for_peer(sample.ch, link.index_at_peer) if sample.ch else ()
        return Arrival(
            peer=index,
            tick=sample.tick,
            q=sample.q,
            qd=sample.qd,
            latency_us=delay_ns // 1000,
            tau_x=sample.tau_x,
            ch=ch,
        )

    def _is_plausible(self, index: int, sample: PeerSample) -> bool:
        link = self._links[index]
        newest = self._newest[index]
        for speed, limit in zip(sample.qd, link.speed_limit, strict=True):
            if not abs(speed) <= limit:
                return False
        if newest is not None:
            passed_s = abs(sample.tick - newest.tick) / link.rate_hz
            for here, there, limit in zip(sample.q, newest.q, link.speed_limit, strict=True):
                if not abs(here - there) <= limit * passed_s + STEP_MARGIN_RAD:
                    return False
        if newest is None or sample.tick > newest.tick:
            self._newest[index] = sample
        return True


BLOCKS_PER_S = 100
"""Recorders get the records of 10 ms together."""
HELD_PER_S = 200
HELD_DELAY_US = 100_000
"""Peers on the same machine get the samples of 5 ms together where none is due sooner after its
stamp.
"""


def may_hold_samples(scenario: Scenario, name: str) -> bool:
    """True if all links from a site delay its samples so much, and it hears of changes of these
    links.
    """
    return all(
        max(model.playout_us, model.location * (model.kind == DelayKind.CONSTANT))
        >= HELD_DELAY_US
        for site in scenario.names
        for link in scenario.setup(site).links
        for model in link.models
        if link.peer == name
    )


class StateBlock:
    """The records of a site's latest ticks, which recorders get together, and after peers have
    their samples.

    Args:
        turn: the site's place among those of the scenario, so that sites of one processor take
            turns.
        single: True if every record is sent with its tick, for the program of an external arm.

    Attributes:
        holds_samples: True if samples wait for others too, so that peers are woken up once for
            some.
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
        self._held = max(1, site.rate_hz // HELD_PER_S)
        self.holds_samples = False
        self._unsent: list[tuple[Any, ...]] = []
        self._records: list[tuple[Any, ...]] = []

    def add(self, output: TickRecord, *facts: Any) -> bool:
        """Adds a record, with the arguments of `encode_state` up to the stamps; true if its
        block is due.

        Whoever holds the arm gets every record at once.
        """
        self._unsent.append((output, *facts))
        held = bool(output.hand) and HandInForce.read(output.hand).source > 0
        return held or (output.tick + 1) % self._ticks == self._turn

    def send_samples(self, k: int, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the samples so far if peers get them after tick k; `send` returns the stamps of
        one.
        """
        if not self.holds_samples or (k + 1 - self._turn) % self._held == 0:
            self._add_stamps(send)

    def _add_stamps(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        self._records += [(*record, *send(record[0])) for record in self._unsent]
        self._unsent.clear()

    def flush(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the samples and the records so far."""
        self._add_stamps(send)
        site = self._site
        records = self._records
        self._records = []
        if records:
            self._send(
                [encode_state(site.name, self._boot, site.peers, *record) for record in records]
            )


def _send_sample(
    name: str,
    boot: int,
    clock: Clock,
    timing: SiteTiming,
    io: "RunningSite",
    output: TickRecord,
) -> tuple[Any, ...]:
    stamps = timing.record_sent(output.tick, clock.monotonic_ns()), timing.pop_echo()
    io.publish_sample(encode_sample(name, boot, output, *stamps))
    return stamps


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
    """Runs a site in real time, from its first tick, and returns its last record; None without
    a tick.
    """
    send = partial(_send_sample, site.name, boot, clock, timing, io)
    quarter_ns = NS_PER_S // (4 * site.rate_hz)
    deadline_ns = timing.deadline_ns(first)
    busy_us = 0
    mode = Mode.RUN
    last = None
    asked = False
    k = first
    while k < ticks:
        clock.sleep_until(deadline_ns)
        if io.should_stop():
            break
        woke_ns = clock.monotonic_ns()
        skipped = 0
        if not catches_up and k > first and woke_ns >= timing.deadline_ns(k + 1):
            skipped = bisect_right(range(k, ticks), woke_ns, key=timing.deadline_ns) - 1
            k += skipped
            deadline_ns = timing.deadline_ns(k)
        late_us = max(0, (woke_ns - deadline_ns) // 1000)
        arrivals = inbox.drain(k * NS_PER_S // site.rate_hz + woke_ns - deadline_ns)
        output = io.step(k, arrivals)
        if output is None:  # there is no record of this tick
            break
        last = output
        block_due = states.add(output, arrivals, late_us, busy_us)
        states.send_samples(k, send)
        stats.count_tick(late_us, busy_us, skipped)
        stats_due = stats.is_due(k, skipped)
        if block_due or stats_due:  # statistics say that these records exist
            states.flush(send)
        if stats_due:
            io.publish_link(encode(stats.pop_stats(output, timing.pop_measurements(woke_ns))))
            io.attend(k, output.t_ns)
        if output.mode is Mode.DIVERGED:
            break
        if output.cmd or output.mode is not mode:
            mode = output.mode
            io.report(output)
        k += 1
        deadline_ns = timing.deadline_ns(k)
        if (block_due or asked) and deadline_ns - clock.monotonic_ns() > quarter_ns:
            asked = io.use_slack()
        busy_us = (clock.monotonic_ns() - woke_ns) // 1000
    states.flush(send)
    return last

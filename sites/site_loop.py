"""Runs the control loop of an arm in real time, and queues the samples sent by other arms.

In every tick, the loop sleeps until the tick is due, reads the samples that the peers have sent
in the meantime, computes the torque, and publishes the state of its own arm: a sample for the
peers, and a record of the tick for the recorder.

Invariant (law L1 of docs/develop/design.md):
    - Tick k is due k tick periods after the epoch, the common start time of the session, as
      measured by the leader (the first site of the scenario). The sites on one machine wake up
      one after another within the tick.
    - A late tick computes the same values as a punctual tick, because formulas use the nominal
      time of a tick and never the measured one. A late loop executes the missed ticks
      immediately one after another. With an external arm it skips them instead, because the arm
      has moved in the meantime.
    - A message from the network cannot raise an exception in the loop. It is either a valid
      sample from a peer, or it is dropped and counted under the reason.
    - The arrival time of a sample is measured when it arrives, not when a tick reads it, so
      measured delays do not depend on the tick rate.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

from trilat_net.core import (
    AHEAD_LIMIT_NS,
    MAX_ARRIVALS,
    HandInForce,
    LinkSetup,
    Site,
    first_tick_at,
)
from trilat_net.errors import WireError
from trilat_net.net import (
    Clock,
    LinkTimingMonitor,
    LoopStats,
    PeerSample,
    SiteTiming,
    StampedInbox,
    encode,
    encode_sample,
    encode_state,
)
from trilat_net.records import NS_PER_S, Arrival, Mode, TickRecord

_GLIDE_AHEAD_LIMIT_NS = NS_PER_S
"""Maximum time by which a sample may lie in the future under the rule `glide`, in ns.

Under this rule, arms glide back to their peers after an interrupted connection.
"""
STEP_MARGIN_RAD = 0.02
"""Tolerance for the distance that a joint moves between two samples, in rad."""


class PeerInbox:
    """Receives the samples from the peers of a site, and drops those that fail a check.

    For each peer, only samples with a single boot (the number that identifies one start of a
    process) are accepted, so that two processes cannot act as the same peer. A site that joins
    a running session ignores samples from before its own first tick.

    If the scenario lets the arm glide back to its peers after an interruption, two more kinds
    of samples are dropped: those far in the future, and those that the peer's arm cannot have
    reached from its previous sample within its speed limit.

    Args:
        links: Directed connections from the peers to this site. All other sequences have the
            same order.
        rings: Inboxes of the samples, with the time of each arrival.
        boots: Boot of each peer.
        monitors: Timing monitors of the links.
        dropped: Mapping from reason to number of dropped samples. The counts are increased in
            place.
        from_ns: Time of the site's first tick, in ns since the epoch (the common start of the
            session).
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

        # For each peer: the newest tick that was received or need not be received, and the last
        # tick before the first that was expected from the peer's present boot.
        self._last = [first_tick_at(from_ns, link.rate_hz) - 1 for link in links]
        self._skipped_until = list(self._last)
        self._newest: list[PeerSample | None] = [None] * len(links)

        if from_ns:
            # Discard the samples that arrived during the wait. Otherwise the first tick would
            # have to process all of them.
            self.drain(from_ns)

    def admit(self, index: int, boot: int, first: int) -> None:
        """Accepts samples of a restarted peer only from its new process.

        A sample is accepted only if it has the boot stored for its peer. The ticks between the
        last sample of the previous process and the first tick of the new process have no
        samples, and do not count as missing.

        Args:
            index: Index of the peer among all peers of this site.
            boot: Number that identifies the new process of the peer.
            first: First tick of the new process.
        """
        self._boots[index] = boot
        # The new process may start in any pose. Therefore its first sample is not compared with
        # the newest sample of the previous process.
        self._newest[index] = None
        last_tick_without_sample = max(self._last[index], first - 1)
        self._last[index] = last_tick_without_sample
        self._skipped_until[index] = last_tick_without_sample

    def find_last_tick_of(self, index: int, boot: int) -> int | None:
        """Returns the last tick whose sample arrived from the previous process of a peer.

        Call this method before `admit`, which replaces the stored boot with that of the new
        process.

        Args:
            index: Index of the peer among all peers of this site.
            boot: Boot of the peer's new process, whose samples are not accepted yet.

        Returns:
            The last tick received from the previous process. None if no sample from that
            process has arrived, or if the samples with `boot` are already accepted.
        """
        accepted_boot = self._boots[index]
        is_accepted_already = boot == accepted_boot
        last_tick = self._last[index]
        # Before the first sample of a process, `_last` is the tick before its first tick.
        tick_before_process = self._skipped_until[index]
        has_received_sample = last_tick > tick_before_process
        if is_accepted_already or not has_received_sample:
            return None
        return last_tick

    def drain(self, since_epoch_ns: int) -> list[Arrival]:
        """Returns the samples that have arrived from other arms and pass all checks.

        The control loop calls this method at the beginning of each tick.

        Args:
            since_epoch_ns: Present time, in ns since the epoch (the common start of the
                session).

        Returns:
            At most `MAX_ARRIVALS` samples, grouped by peer and in order of arrival. Further
            samples stay in the queue.
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
        self,
        index: int,
        sample: PeerSample | WireError,
        arrived_ns: int,
        since_epoch_ns: int,
    ) -> Arrival | None:
        """Checks a sample from another arm, and measures its delay.

        A sample is dropped and counted if it cannot be decoded, comes from an unexpected
        process, or lies too far in the future. This prevents a faulty sender from moving this
        arm.

        Args:
            index: Index of the peer.
            sample: The sample, or the error raised when decoding it.
            arrived_ns: Time of its arrival on the local clock, in ns.
            since_epoch_ns: Present time, in ns since the epoch (the common start of the
                session).

        Returns:
            The sample as an input of the tick, or None if it is dropped.
        """
        if isinstance(sample, WireError):
            self._dropped[sample.reason] += 1
            return None

        link = self._links[index]
        if sample.site != link.peer or sample.boot != self._boots[index]:
            self._dropped["stranger"] += 1
            return None

        nominal_ns = sample.tick * NS_PER_S // link.rate_hz  # time of its tick since the epoch
        if nominal_ns < self._from_ns:
            return None  # from before the first tick of this site

        glides = bool(link.speed_limit)  # only links under the rule `glide` have this limit
        ahead_limit_ns = _GLIDE_AHEAD_LIMIT_NS if glides else AHEAD_LIMIT_NS
        if nominal_ns - since_epoch_ns > ahead_limit_ns:
            self._dropped["ahead"] += 1
            return None
        if glides and not self._is_reachable(index, sample):
            self._dropped["implausible"] += 1
            return None

        # Samples between the last one and this one were lost on the network or in a full queue.
        missing = sample.tick - self._last[index] - 1
        if missing > 0:
            self._dropped["missing"] += missing
        self._last[index] = max(self._last[index], sample.tick)

        delay_ns = self._monitors[index].receive(sample, arrived_ns)
        # Numbers that the control law of the peer sends to the control law of this site.
        channel: Sequence[float] = ()
        if sample.ch:
            channel = link.channel.select_for_peer(sample.ch, link.index_at_peer)
        return Arrival(
            peer=index,
            tick=sample.tick,
            q=sample.q,
            qd=sample.qd,
            latency_us=delay_ns // 1000,
            tau_x=sample.tau_x,
            ch=channel,
        )

    def _is_reachable(self, index: int, sample: PeerSample) -> bool:
        """Returns True if a peer's arm can have moved from its newest known state to a sample.

        Each joint speed must be within the limit of the joint. Each joint must have moved by at
        most its speed limit times the time between the samples, plus `STEP_MARGIN_RAD`. A
        sample that contains NaN is not plausible.

        Args:
            index: Index of the peer.
            sample: Sample from the peer. If it is plausible and the newest, it is stored.
        """
        link = self._links[index]
        newest = self._newest[index]
        # Comparisons with NaN are False, so NaN counts as outside of every limit.
        for speed, speed_limit in zip(sample.qd, link.speed_limit, strict=True):
            is_within_limit = abs(speed) <= speed_limit
            if not is_within_limit:
                return False

        if newest is not None:
            elapsed_s = abs(sample.tick - newest.tick) / link.rate_hz
            joints = zip(sample.q, newest.q, link.speed_limit, strict=True)
            for angle, newest_angle, speed_limit in joints:
                distance_limit = speed_limit * elapsed_s + STEP_MARGIN_RAD
                is_within_limit = abs(angle - newest_angle) <= distance_limit
                if not is_within_limit:
                    return False

        if newest is None or sample.tick > newest.tick:
            self._newest[index] = sample
        return True


_BLOCKS_PER_S = 100
"""Number of blocks per second. Recorders receive the records of 10 ms in one block."""
_WAKES_PER_S = 200
"""Number of wake ticks per second, at which local peers receive the samples of 5 ms together.
"""


class StateBlock:
    """Collects the records of a site's ticks, and sends them to the recorders in blocks.

    Blocks of records take less computing time than single messages. A record is always sent
    after the sample of its tick, because it contains the time at which the sample was sent.

    Args:
        site: The site in the simulation kernel.
        boot: Random number that identifies this start of the site.
        send: Function that publishes the encoded records of a block.
        turn: Index of the site in the scenario. Sites on one machine send their blocks in
            different ticks, which spreads the work over time.
        single: True to send each record in its own tick. This is required for an external arm,
            whose driver reads the torque from the records, and for a site that may be
            restarted.

    Attributes:
        holds_samples: True if the samples for the peers are collected too, so that peers on the
            same machine are woken up less often.
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
        self._ticks = 1 if single else max(1, site.rate_hz // _BLOCKS_PER_S)
        self._turn = 3 * turn % self._ticks
        self._ticks_per_wake = max(1, site.rate_hz // _WAKES_PER_S)
        self.holds_samples = False
        # Records whose samples are not sent yet, and records that wait for their block. The
        # fields of an entry are the arguments of `encode_state` after the peers. A record gets
        # its last two fields, the sending time and the echoes, when its sample is sent.
        self._waiting_records: list[tuple[Any, ...]] = []
        self._records: list[tuple[Any, ...]] = []

    def add(
        self,
        output: TickRecord,
        arrivals: Sequence[Arrival],
        late_us: int,
        busy_us: int,
    ) -> bool:
        """Adds the record of a tick to the current block, and decides whether the block is due.

        A block is due once it is complete, or while an operator is moving the arm. The
        operator's program renders the force from the records, and needs each of them
        immediately.

        Args:
            output: The record.
            arrivals: Samples from the peers received by the tick.
            late_us: How late the tick began, in us.
            busy_us: Computing time of the previous tick, in us.

        Returns:
            True if the block must be sent now.
        """
        self._waiting_records.append((output, arrivals, late_us, busy_us))
        # The source of the operator's commands is 0 if no operator moves the arm.
        has_operator = bool(output.hand) and HandInForce.read(output.hand).source > 0
        is_block_complete = (output.tick + 1) % self._ticks == self._turn
        return has_operator or is_block_complete

    def send_samples(self, tick: int, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the pending samples to the peers, unless they are held until a later tick.

        If the samples may be held (`holds_samples`), they are sent together in every wake tick.
        There are `_WAKES_PER_S` wake ticks per second. Sites with different values of `turn`
        have different wake ticks, so that not all sites of a machine wake their peers at the
        same time.

        Args:
            tick: Number of the current tick.
            send: Function that sends the sample of a record. It returns the sending time and
                the acknowledgements of received samples ("echoes") contained in the sample.
                Both become part of the record.
        """
        ticks_after_this_one = tick + 1
        is_wake_tick = (ticks_after_this_one - self._turn) % self._ticks_per_wake == 0
        if not self.holds_samples or is_wake_tick:
            self._send_waiting_samples(send)

    def _send_waiting_samples(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the pending samples of this arm to the other arms.

        This completes the records of the same ticks, because a record states when its sample
        was sent. The records move to the next block for the recorders.

        Args:
            send: Function that sends the sample of a record, see `send_samples`.
        """
        for entry in self._waiting_records:
            output = entry[0]
            self._records.append((*entry, *send(output)))
        self._waiting_records.clear()

    def flush(self, send: Callable[[TickRecord], tuple[Any, ...]]) -> None:
        """Sends the pending samples to the peers, and the pending records to the recorders.

        The samples are sent first, because the peers are waiting for them.

        Args:
            send: Function that sends the sample of a record, see `send_samples`.
        """
        self._send_waiting_samples(send)
        kernel_site = self._site
        records = self._records
        self._records = []
        if records:
            payloads = [
                encode_state(kernel_site.name, self._boot, kernel_site.peers, *record)
                for record in records
            ]
            self._send(payloads)


class _LoopSite(Protocol):
    """Methods that the control loop calls in each tick and between ticks.

    They are implemented by `RunningSite` in a session, and by `loop_rehearsal` for measuring
    the machine. The loop ignores results of type `object`.
    """

    def should_stop(self) -> bool:
        """Returns True if the current tick must not be executed, because the run is over."""

    def step(self, tick: int, arrivals: Sequence[Arrival]) -> TickRecord | None:
        """Executes one tick: computes the reference, the control law and the motion of the arm.

        Args:
            tick: Number of the tick.
            arrivals: Samples that have arrived since the previous tick.

        Returns:
            The record of the tick, or None if the run ends because the tick failed.
        """

    def publish_sample(self, payload: bytes, /) -> object:
        """Publishes an encoded sample (the part of a record that the peers need)."""

    def publish_link(self, payload: bytes, /) -> object:
        """Publishes encoded statistics of the loop and its links, which the recorder stores."""

    def run_housekeeping(self, output: TickRecord, /) -> object:
        """Does the slow work of the site, ten times per second.

        This includes replies to queries, clock comparison, the list of present processes, and
        news for the user. It is not part of a tick, because it would take too long.

        Args:
            output: Record of the newest tick.
        """

    def report_tick(self, output: TickRecord, /) -> object:
        """Publishes events and alarms about what has changed in a tick.

        For example, an arm may have stopped following the others because their samples were
        missing.

        Args:
            output: Record of the tick.
        """

    def use_slack(self) -> bool:
        """Does one piece of work that can wait, in the time left before the next tick.

        For example, it may answer a recorder's request for lost messages.

        Returns:
            True if there may be more work.
        """


def _publish_sample(
    name: str,
    boot: int,
    clock: Clock,
    timing: SiteTiming,
    io: _LoopSite,
    output: TickRecord,
) -> tuple[Any, ...]:
    """Sends the state of this arm to the other arms after a tick.

    This message (the sample) contains only the part of the result that their control laws need.

    Args:
        name: Name of this site.
        boot: Random number that identifies this start of the site.
        clock: Clock of this process.
        timing: Stores the time of sending, and provides the echoes.
        io: Publishes the encoded sample.
        output: Record of the tick.

    Returns:
        The time of sending in ns since the epoch (the common start of the session), on the
        local clock, and the echoes, which acknowledge samples received from the peers along
        with their times of arrival. From them, the peers compute delays and round trip times.
    """
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
    io: _LoopSite,
    first: int = 0,
    *,
    catches_up: bool = True,
) -> TickRecord | None:
    """Executes the ticks of a site in real time, until the end of the run or an error.

    Each iteration waits until a tick is due, receives the samples from the peers, computes the
    tick, and publishes the results. The rest of the tick is used for work that is not urgent.

    Args:
        site: The site in the simulation kernel.
        boot: Random number that identifies this start of the site.
        ticks: Number of the tick before which the run ends.
        clock: Clock of this process.
        inbox: Samples from the peers.
        timing: Times at which ticks are due, and clocks of the peers.
        stats: Statistics of the loop, which are updated in every tick.
        states: Records that are waiting to be sent to the recorders.
        io: The running site, which computes each tick, and handles messages and events.
        first: Number of the first tick.
        catches_up: True if missed ticks are executed one after another, False if they are
            skipped.

    Returns:
        The record of the last tick. None if no tick was executed.
    """
    send = partial(_publish_sample, site.name, boot, clock, timing, io)
    # Work that can wait is done only if more than a quarter of the period is left.
    quarter_ns = NS_PER_S // (4 * site.rate_hz)
    deadline_ns = timing.deadline_ns(first)
    busy_us = 0
    mode = Mode.RUN
    last = None
    has_slack_work = False
    tick = first
    while tick < ticks:
        clock.sleep_until(deadline_ns)
        if io.should_stop():
            break

        woke_ns = clock.monotonic_ns()
        skipped = 0
        if not catches_up and tick > first and woke_ns >= timing.deadline_ns(tick + 1):
            # Continue with the last tick whose deadline has passed.
            skipped = bisect_right(range(tick, ticks), woke_ns, key=timing.deadline_ns) - 1
            tick += skipped
            deadline_ns = timing.deadline_ns(tick)
        late_us = max(0, (woke_ns - deadline_ns) // 1000)

        # Compute the tick. The present time is the nominal time of the tick plus its lateness.
        since_epoch_ns = tick * NS_PER_S // site.rate_hz + woke_ns - deadline_ns
        arrivals = inbox.drain(since_epoch_ns)
        output = io.step(tick, arrivals)
        if output is None:  # the law or the plant failed: this tick has no record
            break
        last = output

        # Publish. The statistics count records, which must therefore be sent before them.
        block_due = states.add(output, arrivals, late_us, busy_us)
        states.send_samples(tick, send)
        stats.count_tick(late_us, busy_us, skipped)
        stats_due = stats.is_due(tick, skipped)
        if block_due or stats_due:
            states.flush(send)
        if stats_due:
            measurements = timing.pop_measurements(woke_ns)
            io.publish_link(encode(stats.pop_stats(output, measurements)))
            io.run_housekeeping(output)
        if output.mode is Mode.DIVERGED:
            break
        if output.cmd or output.mode is not mode:
            mode = output.mode
            io.report_tick(output)

        tick += 1
        deadline_ns = timing.deadline_ns(tick)
        if (block_due or has_slack_work) and deadline_ns - clock.monotonic_ns() > quarter_ns:
            has_slack_work = io.use_slack()
        busy_us = (clock.monotonic_ns() - woke_ns) // 1000
    states.flush(send)
    return last

"""Publishes the messages of a recorded session in order, each at its scheduled time.

The deadline of a message (the time at which it is due) is a linear function of its time in the
log, determined by the start time and the playback speed. The player sleeps until shortly before
a deadline and then polls the clock. Between deadlines it does other work: replies to other
programs, prefetching, and progress reports. If there is no time between deadlines, it still
does some of this work a hundred times a second.

Invariant:
    - The deadlines depend only on the times in the log and on one start time, so that a late
      message does not delay the later ones.
    - The memory of the histogram of lateness (in whole microseconds) is bounded, however long
      the log is (L6).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trilat_net.errors import UsageError

from ...net import Clock
from .batch import MessageBatch
from .message_source import MessageSource
from .site_stand_ins import PlayedHistory

SPIN_NS = 150_000
"""Time before a deadline at which the player stops sleeping, in ns.

A sleep usually lasts about 60 us too long.
"""
SLOWEST = 1e-3
"""Smallest rate, in seconds of the log per second."""
FASTEST = 1e3
"""Largest rate, except for an unlimited rate."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Schedule of a playback: converts log times to times on the player's clock.

    The conversion is a linear function, given by the start time and the playback speed.

    Attributes:
        origin_ns: Time on the clock at which messages with log time `start_ns` are due, in ns.
        start_ns: Log time at which playback begins, in ns after the start of the recorded
            session.
        rate: Playback speed, in seconds of the log per second. With `math.inf`, all messages
            are due at the origin.
    """

    origin_ns: int
    start_ns: int
    rate: float = 1.0

    def due_ns(self, t_ns: int) -> int:
        """Computes the deadline of a message, in ns on the player's clock.

        At double speed, for example, a message 4 s after the start is due after 2 s.

        Args:
            t_ns: Time of the message in the log, in ns after the start of the recorded session.
        """
        return self.origin_ns + round((t_ns - self.start_ns) / self.rate)

    def later(self, length_ns: int) -> "Pace":
        """Returns the schedule for the next round when a log is played in a loop.

        Args:
            length_ns: Log time from the start of this round to the start of the next one, in
                ns.

        Returns:
            A schedule with the same speed that is shifted to the next round.
        """
        return Pace(self.due_ns(self.start_ns + length_ns), self.start_ns, self.rate)

    @staticmethod
    def parse_rate(text: str) -> float:
        """Parses the option `--rate`, the playback speed relative to the recorded run.

        For example, "2" plays a log twice as fast. Both "max" and "0" mean as fast as possible.

        Returns:
            Seconds of the log per second, or `math.inf` for as fast as possible.

        Raises:
            UsageError: The argument is not a rate from `SLOWEST` to `FASTEST`.
        """
        if text.strip().lower() == "max":
            return math.inf

        try:
            rate = float(text)
        except ValueError:
            rate = math.nan

        if rate == 0:
            return math.inf
        if not SLOWEST <= rate <= FASTEST:
            raise UsageError(
                f"--rate, the speed relative to the recorded run, must be from {SLOWEST:g} to "
                f"{FASTEST:g}, or max, not {text!r}"
            )
        return rate


def wait_until(clock: Clock, due_ns: int, spin_ns: int) -> int:
    """Waits until a deadline in ns: sleeps at first, then polls the clock just before it.

    Sleeping alone would end about 60 us late, and polling alone would keep a processor busy.

    Args:
        clock: Clock to wait on.
        due_ns: The deadline. If it has passed, the function returns at once.
        spin_ns: How long before the deadline to start polling the clock, in ns. With 0, the
            clock is not polled, and the function may return about 60 us late.

    Returns:
        The time on the clock, in ns.
    """
    clock.sleep_until(due_ns - spin_ns)
    now_ns = clock.monotonic_ns()
    while spin_ns and now_ns < due_ns:
        now_ns = clock.monotonic_ns()
    return now_ns


LATENESS_LIMIT_US = 100_000
"""Lateness above which all values are counted in one bin. The maximum is still exact."""


class LatenessHistogram:
    """Histogram of how long after their deadlines messages were published, in us.

    Percentiles can be computed from the counts at any time, without storing the lateness of
    every message. The bin width is 1 us.

    Attributes:
        max_us: Maximum lateness, in us.
    """

    class Summary(NamedTuple):
        """Lateness of the messages of a replay: median, 99th percentile and maximum, in us.

        A percentile above `LATENESS_LIMIT_US` is outside the range of the histogram, so the
        maximum is stated instead.
        """

        p50_us: int
        p99_us: int
        max_us: int

    def __init__(self) -> None:
        self.max_us = 0
        self._counts = [0] * (LATENESS_LIMIT_US + 1)

    def add(self, late_ns: int) -> None:
        """Adds the lateness of one published message, in ns.

        This method is called for every message, so it must be fast.

        Args:
            late_ns: Time from the deadline of the message to its publication, in ns.
        """
        late_us = late_ns // 1000
        # Comparisons are faster than `min` and `max`, which matters for every message.
        self._counts[late_us if late_us < LATENESS_LIMIT_US else LATENESS_LIMIT_US] += 1
        if late_us > self.max_us:
            self.max_us = late_us

    def summary(self) -> Summary | None:
        """Computes the statistics of all messages counted so far, in us.

        The p-th percentile is the smallest lateness that at least p percent of the messages do
        not exceed. The test 100 * (messages with at most this lateness) >= p * (all messages)
        uses integers and is therefore exact.

        Returns:
            Median, 99th percentile and maximum of the lateness, in us. `None` if no message was
            counted.
        """
        # The index of each entry is the lateness in us. The last entry is the overflow bin,
        # which counts all messages from LATENESS_LIMIT_US on.
        counts_up_to = np.cumsum(self._counts)
        total = counts_up_to[-1]
        if not total:
            return None

        percents = np.array([50, 99])
        percentiles_us = np.searchsorted(100 * counts_up_to, total * percents).tolist()
        # The overflow bin has no lateness of its own, and the maximum is used instead.
        p50_us, p99_us = [
            percentile_us if percentile_us < LATENESS_LIMIT_US else self.max_us
            for percentile_us in percentiles_us
        ]
        return self.Summary(p50_us, p99_us, self.max_us)


MIN_SLACK_NS = 400_000
"""Smallest time before a deadline that is used for other work, in ns."""
SERVICE_EVERY_NS = 10_000_000
"""Longest time without other work, in ns."""
IDLE_NS = 1_000_000
"""Pause while there is nothing to do, in ns."""
HELD_NS = 2_000_000
"""Duration above which a publication counts as waiting for a receiver, in ns."""
CUT_NS = 4_900_000_000
"""Duration of a publication after which the receiver that delays it has lost its connection, in
ns. The messages on this connection are lost, too.
"""
LOOP_PAUSE_NS = 100_000_000
"""Pause between two rounds, in ns of the log."""

Publish = Callable[[bytes], None]


class PlayProgress(NamedTuple):
    """Progress of playing a log, shown to the user as a line in the terminal.

    Attributes:
        position_ns: Time of the next message, in ns after the start of the recorded session.
        published: Number of messages published so far.
        late_max_us: Maximum lateness of these messages, in us.
    """

    position_ns: int
    published: int
    late_max_us: int


class Player:
    """Publishes the messages of a recorded log again on schedule, once or in a loop.

    To programs such as a monitor, the session then seems to be running.

    Args:
        source: Supplies the messages in playback order.
        history: Stores the messages, so that recorders can request them again.
        clock: The clock.
        publisher: Function that takes a channel index and returns a function that publishes a
            message on that channel.
        serve: Function that does other work, such as sending replies. Called between messages.
        stopped: Function that returns True when playback must end.
        low_cpu: True to sleep until each deadline instead of polling the clock.

    Attributes:
        counts: Number of published messages, keyed by channel index.
        rounds: Number of passes through the log that were started.
        lateness: Histogram of the time from the deadline of a message to its publication.
        stalls: Number of publications that took so long that a receiver lost its connection.
        held_ns: Total time that publications waited for receivers, in ns.
    """

    def __init__(
        self,
        source: MessageSource,
        history: PlayedHistory,
        clock: Clock,
        publisher: Callable[[int], Publish],
        serve: Callable[[PlayProgress], None],
        stopped: Callable[[], bool],
        *,
        low_cpu: bool = False,
    ) -> None:
        self.counts: list[int] = []
        self.stalls = 0
        self.rounds = 0
        self.held_ns = 0
        self.lateness = LatenessHistogram()
        self._source = source
        self._history = history
        self._clock = clock
        self._publisher = publisher
        self._serve_others = serve
        self._stopped = stopped
        self._spin_ns = 0 if low_cpu else SPIN_NS
        # Publishing functions, by the number of the channel.
        self._publishers: list[Publish] = []
        # Time on the clock at which other work was done last.
        self._served_ns = 0
        # Time of the newest message in the log.
        self._position_ns = 0
        self._published = 0
        # Messages that `prepare` has waited for, and that are played first.
        self._first_batch: MessageBatch | None = None

    def prepare(self) -> int | None:
        """Waits for the first messages, so that playback can begin without delay.

        Messages that are only read or decoded when they are due would be published late.

        Returns:
            The time of the first message, in ns after the start of the recorded session. `None`
            if there is no message, or the playback was stopped.
        """
        self._first_batch = self._wait_for_batch()
        if self._first_batch is None:
            return None
        self._position_ns = int(self._first_batch.times_ns[0])
        return self._position_ns

    def play(self, pace: Pace, *, loop: bool = False) -> None:
        """Plays all messages, until the end of the log or until playback is stopped.

        A round is one pass through the log. In a loop, the next round begins `LOOP_PAUSE_NS`
        after the last message of the current one.

        Every message is stored in the history before it is played, because recorders may
        request it again. A log held entirely in memory is stored once, in the first round. For
        a log that is read during playback, the history holds only recent messages, which differ
        in each round. The history is therefore cleared before the next round.

        Args:
            pace: Start time and playback speed, which determine the deadlines of the messages.
            loop: True to play the log repeatedly until playback is stopped.
        """
        is_log_in_memory = self._source.whole
        while not self._stopped():
            self.rounds += 1
            is_first_round = self.rounds == 1
            # The method is called until it returns None, at the end of the round.
            for batch in iter(self._wait_for_batch, None):
                if is_first_round or not is_log_in_memory:
                    self._history.add(batch)
                for piece in batch.pieces():
                    self._play_piece(piece, pace)
                    if self._stopped():
                        return
            if not loop:
                return

            round_ns = self._position_ns - pace.start_ns + LOOP_PAUSE_NS
            pace = pace.later(round_ns)
            self._source.restart()
            if not is_log_in_memory:
                self._history.clear()

    def _wait_for_batch(self) -> MessageBatch | None:
        """Waits for the next messages and returns them.

        Returns:
            The messages. `None` at the end of the round, or if the playback was stopped.
        """
        batch = self._first_batch
        self._first_batch = None
        while batch is None and not (self._source.ended or self._stopped()):
            batch = self._source.poll()
            if batch is None and not self._source.ended and not self._source.fill():
                self._serve()
                self._clock.sleep_until(self._clock.monotonic_ns() + IDLE_NS)
        return batch

    def _play_piece(self, piece: MessageBatch, pace: Pace) -> None:
        """Publishes some messages at their deadlines. Returns early if the playback is stopped.

        For each message, the method has four steps:

        1. It waits for the deadline, and meanwhile does other work, such as replies to other
           programs. If the playback is late and there is no time left, the other work is done
           every `SERVICE_EVERY_NS` nevertheless.
        2. It measures by how much the message is late.
        3. It publishes the message. The network blocks this call while a receiver is slow. If
           it blocks for longer than `HELD_NS`, the duration counts as waiting for a receiver.
           If it blocks for longer than `CUT_NS`, the receiver has been disconnected (a stall).
        4. It counts the message.

        Args:
            piece: The messages, in the order of playing.
            pace: Converts the times of the messages in the log to deadlines on the clock.
        """
        clock = self._clock
        read_clock = clock.monotonic_ns
        add_lateness = self.lateness.add
        next_numbers = self._history.next_numbers
        for t_ns, channel, number, payload in piece.messages():
            self._position_ns = t_ns
            due_ns = pace.due_ns(t_ns)
            publish_ns = read_clock()
            if publish_ns < due_ns:
                is_continued = self._use_slack(due_ns, publish_ns)
                if not is_continued:
                    return
                publish_ns = wait_until(clock, due_ns, self._spin_ns)
            elif publish_ns - self._served_ns > SERVICE_EVERY_NS:
                self._serve()
                if self._stopped():
                    return
                publish_ns = read_clock()
            add_lateness(publish_ns - due_ns)

            # A channel is declared on the network before its first message. Channels are
            # numbered consecutively, so that their publishers form a list.
            while len(self._publishers) <= channel:
                new_channel = len(self._publishers)
                self._publishers.append(self._publisher(new_channel))
                self.counts.append(0)
            publish = self._publishers[channel]
            publish(payload)
            duration_ns = read_clock() - publish_ns
            if duration_ns > HELD_NS:
                self.held_ns += duration_ns
                self.stalls += duration_ns > CUT_NS

            self._published += 1
            self.counts[channel] += 1
            if number >= next_numbers.get(channel, 0):
                next_numbers[channel] = number + 1

    def _use_slack(self, due_ns: int, now_ns: int) -> bool:
        """Does other work until shortly before the deadline of the next message.

        Such work includes replies to other programs and reading in advance. Shortly before the
        deadline, nothing may delay the player.

        Args:
            due_ns: The deadline, in ns.
            now_ns: Present time on the clock, in ns.

        Returns:
            False if the playback was stopped.
        """
        while due_ns - now_ns > MIN_SLACK_NS:
            self._serve()
            if self._stopped():
                return False
            now_ns = self._clock.monotonic_ns()
            if due_ns - now_ns <= SERVICE_EVERY_NS:
                break
            self._clock.sleep_until(now_ns + IDLE_NS)
            now_ns = self._clock.monotonic_ns()
        return True

    def _serve(self) -> None:
        """Reads messages in advance, and does other work, such as replies to queries."""
        self._source.fill()
        self._serve_others(
            PlayProgress(self._position_ns, self._published, self.lateness.max_us)
        )
        self._served_ns = self._clock.monotonic_ns()

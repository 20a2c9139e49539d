"""Play messages: publish each message once, in order, at its deadline.

The player sleeps until shortly before a deadline and then polls the clock. Other work (replies,
reading ahead, progress) is done in the slack between deadlines; without slack it gets short
slices a hundred times a second.

Invariant:
    - Deadlines are a function of log time alone, counted from one origin, so that a late
      message does not delay the messages after it.
    - The memory of the histogram of lateness (in whole microseconds) is bounded for any length
      of play (L6).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trilat_net.errors import UsageError
from trilat_net.net.clock import Clock

from .batch import MessageBatch
from .message_source import MessageSource
from .site_stand_ins import PlayedHistory

SPIN_NS = 150_000
"""Time before a deadline at which the player stops sleeping. Sleep usually lasts some 60 us too
long.
"""
SLOWEST = 1e-3
FASTEST = 1e3


@dataclass(frozen=True, slots=True)
class Pace:
    """A linear function from log time to time on the clock.

    Attributes:
        origin_ns: time on the clock at which `start_ns` of the log is due, ns.
        start_ns: beginning of the play, ns since the epoch of the log.
        rate: seconds of the log per second; `math.inf`: all messages are due at the origin.
    """

    origin_ns: int
    start_ns: int
    rate: float = 1.0

    def due_ns(self, t_ns: int) -> int:
        """Returns the deadline on the clock of a time of the log, ns."""
        return self.origin_ns + round((t_ns - self.start_ns) / self.rate)

    def later(self, length_ns: int) -> "Pace":
        """Returns the pace of the next round, which starts after `length_ns` of the log."""
        return Pace(self.due_ns(self.start_ns + length_ns), self.start_ns, self.rate)


def parse_rate(text: str) -> float:
    """Returns the rate that a user's text states; "max" and 0 mean as fast as possible.

    Raises:
        UsageError: the text is not a rate from `SLOWEST` to `FASTEST`.
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
            f"--rate is how much faster than it was, from {SLOWEST:g} to {FASTEST:g}, "
            f"or max; not {text!r}"
        )
    return rate


def wait_until(clock: Clock, due_ns: int, spin_ns: int) -> int:
    """Waits for a deadline and returns the time on the clock, ns.

    Args:
        clock: the clock.
        due_ns: the deadline; if it has passed, the function returns at once.
        spin_ns: time before the deadline from which the clock is polled; 0: no polling.
    """
    clock.sleep_until(due_ns - spin_ns)
    now_ns = clock.monotonic_ns()
    while spin_ns and now_ns < due_ns:
        now_ns = clock.monotonic_ns()
    return now_ns


LATENESS_LIMIT_US = 100_000
"""All higher values of lateness share one bin; the maximum is exact nevertheless."""


class LatenessSummary(NamedTuple):
    """Median, 99th percentile and maximum of the lateness, us.

    A percentile above `LATENESS_LIMIT_US` is replaced by the maximum.
    """

    p50_us: int
    p99_us: int
    max_us: int


class LatenessHistogram:
    """Counts messages by lateness: from their deadline to the call that publishes them."""

    def __init__(self) -> None:
        self.max_us = 0
        self._counts = [0] * (LATENESS_LIMIT_US + 1)

    def add(self, late_ns: int) -> None:
        """Counts one message by its lateness, ns."""
        late_us = late_ns // 1000
        # comparisons instead of `min` and `max`, which take longer for every message
        self._counts[late_us if late_us < LATENESS_LIMIT_US else LATENESS_LIMIT_US] += 1
        if late_us > self.max_us:
            self.max_us = late_us

    def summary(self) -> LatenessSummary | None:
        """Returns median, 99th percentile and maximum; None without a message."""
        sums = np.cumsum(self._counts)
        if not sums[-1]:
            return None
        percentiles = np.searchsorted(100 * sums, sums[-1] * np.array([50, 99])).tolist()
        p50_us, p99_us = (us if us < LATENESS_LIMIT_US else self.max_us for us in percentiles)
        return LatenessSummary(p50_us, p99_us, self.max_us)


MIN_SLACK_NS = 400_000
"""Smallest time before a deadline that is used for other work."""
SERVICE_EVERY_NS = 10_000_000
"""Longest time without other work."""
IDLE_NS = 1_000_000
"""Pause while no message has been read."""
HELD_NS = 2_000_000
"""A publication that takes longer waits for a receiver or for a processor."""
CUT_NS = 4_900_000_000
"""A receiver that delays a publication for this time loses its connection and the messages on
the connection.
"""
LOOP_PAUSE_NS = 100_000_000
"""Pause between the last message of a round and the first message of the next round."""

Publish = Callable[[bytes], None]


class PlayProgress(NamedTuple):
    """Progress of a play.

    Attributes:
        position_ns: time of the next message, ns since the epoch of the log.
        published: number of messages published so far.
        late_max_us: largest lateness of these messages, us.
    """

    position_ns: int
    published: int
    late_max_us: int


class Player:
    """One play of a log.

    Args:
        source: supplies the messages.
        history: receives the messages that are about to be played.
        clock: the time.
        publisher: returns the function that publishes messages of a channel, by its number.
        serve: does a little other work.
        stopped: returns True if the play has to end.
        low_cpu: whether the player sleeps until a deadline instead of polling the clock.

    Attributes:
        counts: number of published messages, by channel.
        rounds: number of rounds that were started.
        lateness: lateness of the messages.
        stalls: number of publications that took so long that a receiver lost its connection.
        held_ns: time that publications waited for receivers, ns.
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
        self._publishers: list[Publish] = []  # by channel
        self._served_ns = 0
        self._position_ns = 0
        self._published = 0
        self._first_batch: MessageBatch | None = None

    def prepare(self) -> int | None:
        """Waits for the first messages.

        Returns:
            The time of the first message, ns since the epoch of the log; None if no message is
            to be played.
        """
        self._first_batch = self._wait_for_batch()
        if self._first_batch is None:
            return None
        self._position_ns = int(self._first_batch.times_ns[0])
        return self._position_ns

    def play(self, pace: Pace, *, loop: bool = False) -> None:
        """Plays all messages, until the end of the log or until stopped.

        Args:
            pace: the deadlines of the first round.
            loop: whether the messages are played round after round, until stopped.
        """
        while not self._stopped():
            self.rounds += 1
            for batch in iter(self._wait_for_batch, None):
                if self.rounds == 1 or not self._source.whole:
                    self._history.add(batch)
                for piece in batch.pieces():
                    self._play_piece(piece, pace)
                    if self._stopped():
                        return
            if not loop:
                return
            pace = pace.later(self._position_ns - pace.start_ns + LOOP_PAUSE_NS)
            self._source.restart()
            if not self._source.whole:
                self._history.clear()

    def _wait_for_batch(self) -> MessageBatch | None:
        """Waits for the next messages; None at the end of the round, or if stopped."""
        batch = self._first_batch
        self._first_batch = None
        while batch is None and not (self._source.ended or self._stopped()):
            batch = self._source.poll()
            if batch is None and not self._source.ended and not self._source.fill():
                self._serve()
                self._clock.sleep_until(self._clock.monotonic_ns() + IDLE_NS)
        return batch

    def _play_piece(self, piece: MessageBatch, pace: Pace) -> None:
        """Publishes the messages of a piece at their deadlines."""
        clock = self._clock
        read_clock = clock.monotonic_ns
        add_lateness = self.lateness.add
        next_numbers = self._history.next_numbers
        for t_ns, channel, number, payload in piece.messages():
            self._position_ns = t_ns
            due_ns = pace.due_ns(t_ns)
            start_ns = read_clock()
            if start_ns < due_ns:
                if not self._use_slack(due_ns, start_ns):
                    return
                start_ns = wait_until(clock, due_ns, self._spin_ns)
            elif start_ns - self._served_ns > SERVICE_EVERY_NS:
                self._serve()
                if self._stopped():
                    return
                start_ns = read_clock()
            add_lateness(start_ns - due_ns)
            while len(self._publishers) <= channel:  # declared when first needed
                self._publishers.append(self._publisher(len(self._publishers)))
                self.counts.append(0)
            self._publishers[channel](payload)
            duration_ns = read_clock() - start_ns
            if duration_ns > HELD_NS:
                self.held_ns += duration_ns
                self.stalls += duration_ns > CUT_NS
            self._published += 1
            self.counts[channel] += 1
            if number >= next_numbers.get(channel, 0):
                next_numbers[channel] = number + 1

    def _use_slack(self, due_ns: int, now_ns: int) -> bool:
        """Uses the time before a deadline for other work.

        Returns:
            False if the play was stopped.
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
        """Reads ahead, and lets the playback do its other work."""
        self._source.fill()
        self._serve_others(
            PlayProgress(self._position_ns, self._published, self.lateness.max_us)
        )
        self._served_ns = self._clock.monotonic_ns()

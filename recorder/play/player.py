"""The player: publishes each message once, in order, at its deadline.

Invariant: deadlines are a pure function of log time, absolute, from one origin: a late message
delays no later one. Sleep until shortly before the deadline, then poll the clock. Replies,
reading ahead and progress use the slack between deadlines; without slack they get short slices
a hundred times a second. The histogram of lateness (whole microseconds) is bounded for any
length of play (L6).
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
"""Time before a deadline at which sleep must end: it oversleeps by some 60 us as a rule."""
SLOWEST = 1e-3
FASTEST = 1e3


@dataclass(frozen=True, slots=True)
class Pace:
    """A line from log time to the clock.

    Attributes:
        origin_ns: the clock at `start_ns`.
        start_ns: beginning of the play, ns since the epoch of the log.
        rate: seconds of the log per second; `math.inf`: everything is due at the origin.
    """

    origin_ns: int
    start_ns: int
    rate: float = 1.0

    def due_ns(self, t_ns: int) -> int:
        """Returns the deadline of an instant of the log, on the clock."""
        return self.origin_ns + round((t_ns - self.start_ns) / self.rate)

    def later(self, length_ns: int) -> "Pace":
        """Returns the pace of the next round, which begins after such a length of the log."""
        return Pace(self.due_ns(self.start_ns + length_ns), self.start_ns, self.rate)


def parse_rate(text: str) -> float:
    """Returns a rate that a user gives; "max" and 0 mean as fast as possible.

    Raises:
        UsageError: it is no rate.
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
            f"--rate is how much faster than it was, from {SLOWEST:g} to {FASTEST:g}, or max; not {text!r}"
        )
    return rate


def wait_until(clock: Clock, due_ns: int, spin_ns: int) -> int:
    """Returns the clock's reading at a deadline, or at once if that has passed.

    It stops sleeping `spin_ns` before and polls the clock; with 0 it sleeps to the end.
    """
    clock.sleep_until(due_ns - spin_ns)
    now_ns = clock.monotonic_ns()
    while spin_ns and now_ns < due_ns:
        now_ns = clock.monotonic_ns()
    return now_ns


LATENESS_LIMIT_US = 100_000
"""Higher values share one bin; the maximum is exact all the same."""


class LatenessSummary(NamedTuple):
    """Median, 99th percentile and maximum of the lateness, us; a quantile above the limit is
    the maximum.
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
        self._counts[late_us if late_us < LATENESS_LIMIT_US else LATENESS_LIMIT_US] += 1
        if late_us > self.max_us:
            self.max_us = late_us

    def summary(self) -> LatenessSummary | None:
        """Returns the quantiles; None without a message."""
        sums = np.cumsum(self._counts)
        if not sums[-1]:
            return None
        bins = np.searchsorted(100 * sums, sums[-1] * np.array([50, 99])).tolist()
        p50_us, p99_us = (us if us < LATENESS_LIMIT_US else self.max_us for us in bins)
        return LatenessSummary(p50_us, p99_us, self.max_us)


MIN_SLACK_NS = 400_000
"""Time before a deadline that suffices for other work."""
SERVICE_EVERY_NS = 10_000_000
"""Longest time without other work."""
IDLE_NS = 1_000_000
"""Pause while no message is there yet."""
HELD_NS = 2_000_000
"""A publisher that takes longer waits for others, or for a processor."""
CUT_NS = 4_900_000_000
"""A receiver that delays a publisher for so long loses the connection, and the messages on it.
"""
LOOP_PAUSE_NS = 100_000_000
"""Between the last message of a round and the first of the next."""

Publish = Callable[[bytes], None]


class PlayProgress(NamedTuple):
    """Time of the next message, ns since the epoch of the log; messages so far; their largest
    lateness.
    """

    position_ns: int
    published: int
    late_max_us: int


class Player:
    """One play of a log: `publisher` returns the publisher of a channel, `serve` does a little
    other work.

    Attributes:
        counts: messages published, by channel.
        stalls: number of publications that took so long that a receiver lost its connection.
        held_ns: time that publishers waited for others, ns.
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
        self.stalls = self.rounds = self.held_ns = 0
        self.lateness = LatenessHistogram()
        self._source = source
        self._history = history
        self._clock = clock
        self._publisher = publisher
        self._serve_others = serve
        self._stopped = stopped
        self._spin_ns = 0 if low_cpu else SPIN_NS
        self._publish: list[Publish] = []
        self._served_ns = self._position_ns = self._published = 0
        self._first: MessageBatch | None = None

    def prepare(self) -> int | None:
        """Waits for the first messages; returns the time of the first one, or None if there are
        none.
        """
        self._first = self._next()
        if self._first is None:
            return None
        self._position_ns = int(self._first.times_ns[0])
        return self._position_ns

    def play(self, pace: Pace, *, loop: bool = False) -> None:
        """Plays all messages, round after round if `loop`; returns at the end, or if stopped."""
        while not self._stopped():
            self.rounds += 1
            for batch in iter(self._next, None):
                if self.rounds == 1 or not self._source.whole:
                    self._history.add(batch)
                for piece in batch.pieces():
                    self._play(piece, pace)
                    if self._stopped():
                        return
            if not loop:
                return
            pace = pace.later(self._position_ns - pace.start_ns + LOOP_PAUSE_NS)
            self._source.restart()
            if not self._source.whole:
                self._history.clear()

    def _next(self) -> MessageBatch | None:
        """Waits for the next messages; None at the end of the round, or if stopped."""
        batch = self._first
        self._first = None
        while batch is None and not (self._source.ended or self._stopped()):
            batch = self._source.poll()
            if batch is None and not self._source.ended and not self._source.fill():
                self._serve()
                self._clock.sleep_until(self._clock.monotonic_ns() + IDLE_NS)
        return batch

    def _play(self, piece: MessageBatch, pace: Pace) -> None:
        clock = self._clock
        add_lateness = self.lateness.add
        made = self._history.next_numbers
        now_ns = clock.monotonic_ns
        for t_ns, channel, number, payload in piece.messages():
            self._position_ns = t_ns
            due_ns = pace.due_ns(t_ns)
            begun_ns = now_ns()
            if begun_ns < due_ns:
                if not self._use_slack(due_ns, begun_ns):
                    return
                begun_ns = wait_until(clock, due_ns, self._spin_ns)
            elif begun_ns - self._served_ns > SERVICE_EVERY_NS:
                self._serve()
                if self._stopped():
                    return
                begun_ns = now_ns()
            add_lateness(begun_ns - due_ns)
            while len(self._publish) <= channel:  # declared when first needed
                self._publish.append(self._publisher(len(self._publish)))
                self.counts.append(0)
            self._publish[channel](payload)
            took_ns = now_ns() - begun_ns
            if took_ns > HELD_NS:
                self.held_ns += took_ns
                self.stalls += took_ns > CUT_NS
            self._published += 1
            self.counts[channel] += 1
            if number >= made.get(channel, 0):
                made[channel] = number + 1

    def _use_slack(self, due_ns: int, now_ns: int) -> bool:
        """Uses the time before a deadline for other work; False if the play was stopped."""
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
        self._source.fill()
        self._serve_others(
            PlayProgress(self._position_ns, self._published, self.lateness.max_us)
        )
        self._served_ns = self._clock.monotonic_ns()

"""The player: publishes each message once, in order, at its deadline.

Invariant: deadlines are absolute. Replies, reading ahead and progress use the slack between deadlines;
without slack they get short slices a hundred times a second.
"""

from collections.abc import Callable
from typing import NamedTuple

from trilat_net.net.clock import Clock

from .batch import MessageBatch
from .pace import SPIN_NS, LatenessHistogram, LatenessSummary, Pace, wait_until
from .reader_process import MessageSource
from .site_stand_ins import PlayedHistory

MIN_SLACK_NS = 400_000
"""As much time before a deadline is enough for something else."""
SERVICE_EVERY_NS = 10_000_000
"""How long the player may be without a look at anything else."""
IDLE_NS = 1_000_000
"""How long to wait where nothing is there yet."""
MESSAGES_PER_SLICE = 256
"""Messages that are made ready at a time."""
HELD_NS = 2_000_000
"""Who publishes for longer waits for others, or for a processor."""
CUT_NS = 4_900_000_000
"""Who lets a publisher wait for as long loses the connection, and what was to come over it."""
LOOP_PAUSE_NS = 100_000_000
"""Between the last message of a round and the first of the next."""

Publish = Callable[[bytes], None]


class PlayProgress(NamedTuple):
    """Where the play is.

    Attributes:
        position_ns: the message that is due next, ns since the epoch of the log.
        published: how many messages have been.
        late_max_us: the latest so far, us.
    """

    position_ns: int
    published: int
    late_max_us: int


class Player:
    """One play of a log.

    Args:
        source: where the messages come from.
        memory: takes what is played.
        clock: the time.
        publisher: returns what publishes the messages of a channel.
        attend: does a little of everything else; called again and again.
        stopped: True once the play was asked to end.
        low_cpu: sleep to the deadline instead of looking at the clock before it.

    Attributes:
        counts: messages published, by channel.
        stalls: how often a publisher waited so long that somebody lost the connection.
        held_ns: for how long publishers have waited for others, ns.
        rounds: rounds begun.
        lateness: how late the messages were.
    """

    def __init__(
        self,
        source: MessageSource,
        memory: PlayedHistory,
        clock: Clock,
        publisher: Callable[[int], Publish],
        attend: Callable[[PlayProgress], None],
        stopped: Callable[[], bool],
        *,
        low_cpu: bool = False,
    ) -> None:
        self.counts: list[int] = []
        self.stalls = self.rounds = self.held_ns = 0
        self._source, self._memory, self._clock, self._publisher = source, memory, clock, publisher
        self._attend, self._stopped = attend, stopped
        self._spin_ns = 0 if low_cpu else SPIN_NS
        self._publish: list[Publish] = []
        self._lateness = LatenessHistogram()
        self._looked_ns = 0
        self._position_ns = 0
        self._published = 0
        self._first: MessageBatch | None = None

    @property
    def lateness(self) -> LatenessSummary | None:
        """How late the messages were; None where there was none."""
        return self._lateness.summary()

    def prepare(self) -> int | None:
        """Waits for the first messages; returns the time of the first one, or None where there are none."""
        while self._first is None and not (self._stopped() or self._source.ended):
            while self._source.fill():
                pass
            self._first = self._source.poll()
            if self._first is None:
                self._idle()
        self._position_ns = int(self._first.times_ns[0]) if self._first is not None else 0
        return None if self._first is None else self._position_ns

    def play(self, pace: Pace, *, loop: bool = False) -> None:
        """Plays all messages, round after round if asked; returns at the end, or where it was stopped."""
        while not self._stopped():
            self.rounds += 1
            for block in iter(self._next, None):
                if self.rounds == 1 or not self._source.whole:
                    self._memory.add(block)
                for piece in block.pieces(MESSAGES_PER_SLICE):
                    self._play(piece, pace)
                    if self._stopped():
                        return
            if not loop:
                return
            pace = pace.later(self._position_ns - pace.start_ns + LOOP_PAUSE_NS)
            self._source.again()
            if not self._source.whole:
                self._memory.forget()

    def _next(self) -> MessageBatch | None:
        """Waits for the next messages; None at the end of the round, or where the play was stopped."""
        block, self._first = self._first, None
        while block is None and not (self._source.ended or self._stopped()):
            block = self._source.poll()
            if block is None and not self._source.ended and not self._source.fill():
                self._idle()
        return block

    def _idle(self) -> None:
        self._look()
        self._clock.sleep_until(self._clock.monotonic_ns() + IDLE_NS)

    def _play(self, piece: MessageBatch, pace: Pace) -> None:
        """Publishes some messages."""
        clock, late, made, now_ns = (
            self._clock,
            self._lateness.add,
            self._memory.made,
            self._clock.monotonic_ns,
        )
        for t_ns, channel, number, payload in piece.messages():
            self._position_ns, due_ns, begun_ns = t_ns, pace.due_ns(t_ns), now_ns()
            if begun_ns < due_ns:
                if not self._pass_time(due_ns, begun_ns):
                    return
                begun_ns = wait_until(clock, due_ns, self._spin_ns)
            elif begun_ns - self._looked_ns > SERVICE_EVERY_NS:
                self._look()
                if self._stopped():
                    return
                begun_ns = now_ns()
            late(begun_ns - due_ns)
            self._to(channel)(payload)
            took_ns = now_ns() - begun_ns
            if took_ns > HELD_NS:
                self.held_ns += took_ns
                self.stalls += took_ns > CUT_NS
            self._published += 1
            self.counts[channel] += 1
            if number >= made.get(channel, 0):
                made[channel] = number + 1

    def _to(self, channel: int) -> Publish:
        """Returns what publishes on a channel; declared when it is first needed."""
        while len(self._publish) <= channel:
            self._publish.append(self._publisher(len(self._publish)))
            self.counts.append(0)
        return self._publish[channel]

    def _pass_time(self, due_ns: int, now_ns: int) -> bool:
        """Uses the time before a deadline for everything else; False where the play was stopped."""
        while due_ns - now_ns > MIN_SLACK_NS:
            self._look()
            if self._stopped():
                return False
            now_ns = self._clock.monotonic_ns()
            if due_ns - now_ns > SERVICE_EVERY_NS:
                self._clock.sleep_until(now_ns + IDLE_NS)
                now_ns = self._clock.monotonic_ns()
            else:
                break
        return True

    def _look(self) -> None:
        self._source.fill()
        self._attend(PlayProgress(self._position_ns, self._published, self._lateness.max_us))
        self._looked_ns = self._clock.monotonic_ns()

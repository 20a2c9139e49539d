"""Playback as one process, from a log to its summary.

Invariant: it stays until its recorders have every message, or request none any more.
"""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path

from trilat_net import process
from trilat_net.core.ticks import NS_PER_S
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection
from trilat_net.net.discovery import open_playback_bus, refuse_running_session

from .batch import MessageBatch
from .pace import LatenessSummary, Pace
from .player import Player, PlayProgress
from .reader_process import MemorySource, MessageSource, ProcessSource
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader
from .site_stand_ins import PlayedHistory, SiteStandIns

POLL_NS = 5_000_000
AHEAD_NS = 500_000_000
"""How long before its first message a replay says when that is."""
LISTEN_NS = 5_000_000_000
"""How long to wait for a recorder that has announced itself to listen."""
LINGER_NS = 5_000_000_000
"""How long to stay afterwards for recorders, from their last question on."""
LAST_EVENT_NS = 100_000_000
NICE = -10
PROGRESS_EVERY_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a log is played.

    Attributes:
        session: the name of the session that others see.
        rate: seconds of the log in a second; `math.inf`: as fast as everybody takes it.
        loop: round after round.
        low_cpu: sleep to the deadlines.
        needs_recorder: do not begin without a recorder.
    """

    session: str
    rate: float = 1.0
    loop: bool = False
    low_cpu: bool = False
    needs_recorder: bool = False


@dataclass(frozen=True, slots=True)
class PlaybackSummary:
    """What came of a replay.

    Attributes:
        counts: messages published, by topic of the file.
        rounds: rounds begun.
        lateness: how late they were; None where nothing was due at a time.
        took_s: how long it took, from the first message to the last, s.
        held_s: for how long others were waited for that did not keep up, s.
        cut: how often somebody took nothing for 5 s and was cut off.
        strays: messages that stood so far from their turn in the file that they were not played in it.
        recorders: recorders that were there after the last message.
        stored: whether all of them said that they have everything.
        told: messages given once more to recorders that had missed them.
        torn: files that are not whole, and why.
    """

    counts: dict[str, int]
    rounds: int
    lateness: LatenessSummary | None
    took_s: float
    held_s: float
    cut: int
    strays: int
    recorders: int
    stored: bool
    told: int
    torn: dict[Path, str]


class Playback:
    """One replay in a session of its own.

    Args:
        bus: the connection.
        clock: the time.
        facts: what the log says of its session.
        source: its messages.
        options: how it is played.
        stopped: True once it was asked to end.
        say: tells a person what happens.
        show: tells a person now and then where the play is.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        facts: SessionHeader,
        source: MessageSource,
        options: PlayOptions,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
        show: Callable[[PlayProgress], None],
    ) -> None:
        self._bus, self._clock, self._facts, self._source = bus, clock, facts, source
        self._options, self._stopped, self._say, self._show = options, stopped, say, show
        memory = PlayedHistory(None if source.whole else HORIZON_NS)
        self._cast = SiteStandIns(bus, clock, options.session, facts, memory)
        self._shown_ns = clock.monotonic_ns()
        self._player = Player(
            source, memory, clock, self._publisher, self._attend, stopped, low_cpu=options.low_cpu
        )

    def _publisher(self, channel: int) -> Callable[[bytes], None]:
        key = map_key_to_session(self._facts.topics[channel], self._facts.session, self._options.session)
        return self._bus.publisher(key, patient=True)

    def _attend(self, progress: PlayProgress) -> None:
        """Does a little of all that is not playing."""
        self._cast.attend()
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._shown_ns >= PROGRESS_EVERY_NS:
            self._shown_ns = now_ns
            self._show(progress)

    def play(self, start_ns: int | None) -> PlaybackSummary:
        """Plays, and stays until those who record it have everything.

        Args:
            start_ns: where the play begins, ns since the epoch of the log; None: with the first message.
        """
        clock, options = self._clock, self._options
        first_ns = self._player.prepare()
        self._await_recorders()
        begun_ns = clock.monotonic_ns() + AHEAD_NS
        if first_ns is not None:
            pace = Pace(begun_ns, first_ns if start_ns is None else start_ns, options.rate)
            self._cast.run(pace)
            self._player.play(pace, loop=options.loop)
        took_ns = max(0, clock.monotonic_ns() - begun_ns)
        self._cast.attend()
        recorders = set(self._cast.recorders)
        self._stay()
        return PlaybackSummary(
            counts=dict(zip(self._facts.topics, self._player.counts, strict=False)),
            rounds=self._player.rounds,
            lateness=self._player.lateness if math.isfinite(options.rate) else None,
            took_s=took_ns / NS_PER_S,
            held_s=self._player.held_ns / NS_PER_S,
            cut=self._player.stalls,
            strays=self._source.strays,
            recorders=len(recorders),
            stored=self._cast.stored(recorders),
            told=self._cast.told,
            torn=self._facts.torn,
        )

    def _await_recorders(self) -> None:
        """Waits for recorders that have announced themselves, for one at least if that is asked for."""
        clock, cast = self._clock, self._cast
        if self._options.needs_recorder:
            self._say("waiting for a recorder")
        patience_ns = clock.monotonic_ns() + LISTEN_NS
        while not self._stopped():
            cast.attend()
            missing = self._options.needs_recorder and not cast.recorders
            listening = cast.recorders_listen()
            if not missing and (listening or clock.monotonic_ns() > patience_ns):
                return
            if missing:
                patience_ns = clock.monotonic_ns() + LISTEN_NS
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _stay(self) -> None:
        """Answers recorders until they have said that they have everything, or ask nothing for a while."""
        clock, cast = self._clock, self._cast
        give_up_ns = clock.monotonic_ns() + LINGER_NS
        while clock.monotonic_ns() < give_up_ns and not self._stopped():
            if cast.attend():
                give_up_ns = clock.monotonic_ns() + LINGER_NS
                continue
            if not cast.recorders or cast.stored(cast.recorders):  # the last messages may still be under way
                give_up_ns = min(give_up_ns, clock.monotonic_ns() + LAST_EVENT_NS)
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)


def play_log(
    loaded: tuple[SessionHeader, MessageBatch | None],
    paths: Sequence[Path],
    selection: PlaySelection,
    options: PlayOptions,
    connection: Connection,
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    show: Callable[[PlayProgress], None],
) -> PlaybackSummary | None:
    """Plays a log over Zenoh.

    Args:
        loaded: what `loading.load` made of the files.
        paths: the files.
        selection: what is played of them.
        options: how.
        connection: how to take part in the network.
        clock: the time.
        stopped: True once it was asked to end.
        say: tells a person what happens.
        show: tells a person now and then where the play is.

    Returns:
        What came of it; None where it was asked to end before it had begun.

    Raises:
        SessionError: there is a session of that name.
        UsageError: an endpoint cannot be used.
        LogError: a file cannot be read any more.
    """
    facts, block = loaded
    # not SCHED_FIFO, as sites: who looks at the clock until it is time would keep Zenoh's own threads waiting
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    with ExitStack() as stack:
        stack.enter_context(process.pause_gc())
        bus = open_playback_bus(connection, clock, options.session, stopped, say)
        if bus is None:
            return None
        stack.enter_context(closing(bus))
        refuse_running_session(bus, clock, options.session, stopped)
        source: MessageSource = (
            MemorySource(block) if block else ProcessSource(paths, selection, facts, loop=options.loop)
        )
        stack.enter_context(closing(source))
        replay = Playback(bus, clock, facts, source, options, stopped, say, show)
        return replay.play(selection.start_ns)


def map_key_to_session(topic: str, was: str, session: str) -> str:
    """Returns the key that a channel is played under.

    Args:
        topic: its topic in the file.
        was: the session's name there; what is of that session is played as of the new one.
        session: its name here; what is of none is played below it all the same, so that it meets nobody else.
    """
    chunks = topic.strip("/").split("/")
    return "/".join([topics.ROOT, session, *(chunks[2:] if chunks[:2] == [topics.ROOT, was] else chunks)])

"""Playback as one process, from a log to its summary.

Invariant: it stays until its recorders have every message, or request none any more.
"""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from trilat_net import process
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import NS_PER_S, Clock
from trilat_net.net.connection import Connection
from trilat_net.net.discovery import open_playback_bus, refuse_running_session

from .batch import MessageBatch
from .message_source import MessageSource
from .player import LatenessSummary, Pace, Player, PlayProgress
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader
from .site_stand_ins import PlayedHistory, SiteStandIns

POLL_NS = 5_000_000
AHEAD_NS = 500_000_000
"""Time before its first message at which a playback announces it."""
LISTEN_NS = 5_000_000_000
"""Longest wait for an announced recorder to listen."""
LINGER_NS = 5_000_000_000
"""How long to stay for recorders at the end, after their last query."""
LAST_EVENT_NS = 100_000_000
NICE = -10
PROGRESS_EVERY_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """How a log is played.

    Attributes:
        rate: seconds of the log per second; `math.inf`: as fast as all receivers take it.
        low_cpu: whether to sleep to the deadlines.
    """

    session: str
    rate: float = 1.0
    loop: bool = False
    low_cpu: bool = False
    needs_recorder: bool = False


class PlaybackSummary(NamedTuple):
    """The result of a playback.

    Attributes:
        counts: messages published, by topic of the file.
        lateness: their lateness; None if they had no deadline.
        held_s: time spent waiting for receivers that did not keep up, s.
        cut: how often a receiver took nothing for 5 s and was cut off.
        strays: messages that stood so far from their turn in the file that they were not played
            in it.
        recorders: recorders that were present after the last message.
        stored: whether all of them reported that they have everything.
        refilled: messages given again to recorders that had missed them.
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
    refilled: int
    torn: dict[Path, str]


@dataclass
class Playback:
    """One playback in a session of its own."""

    bus: Bus
    clock: Clock
    header: SessionHeader
    source: MessageSource
    options: PlayOptions
    stopped: Callable[[], bool]
    say: Callable[[str], None]
    show: Callable[[PlayProgress], None]

    def __post_init__(self) -> None:
        history = PlayedHistory(kept_ns=None if self.source.whole else HORIZON_NS)
        self._stand_ins = SiteStandIns(
            bus=self.bus,
            clock=self.clock,
            session=self.options.session,
            header=self.header,
            history=history,
        )
        self._shown_ns = self.clock.monotonic_ns()
        own = history, self.clock, self._publisher, self._serve, self.stopped
        self._player = Player(self.source, *own, low_cpu=self.options.low_cpu)

    def _publisher(self, channel: int) -> Callable[[bytes], None]:
        key = map_key_to_session(
            self.header.topics[channel], self.header.session, self.options.session
        )
        return self.bus.publisher(key, patient=True)

    def _serve(self, progress: PlayProgress) -> None:
        self._stand_ins.serve_queries()
        now_ns = self.clock.monotonic_ns()
        if now_ns - self._shown_ns >= PROGRESS_EVERY_NS:
            self._shown_ns = now_ns
            self.show(progress)

    def play(self, start_ns: int | None) -> PlaybackSummary:
        """Plays from `start_ns` since the epoch of the log (None: from the first message) to
        the end.

        It stays until all recorders have everything.
        """
        clock = self.clock
        options = self.options
        first_ns = self._player.prepare()
        self._await_recorders()
        begun_ns = clock.monotonic_ns() + AHEAD_NS
        if first_ns is not None:
            pace = Pace(begun_ns, first_ns if start_ns is None else start_ns, options.rate)
            self._stand_ins.begin(pace.due_ns(0))
            self._player.play(pace, loop=options.loop)
        took_ns = max(0, clock.monotonic_ns() - begun_ns)
        self._stand_ins.serve_queries()
        recorders = set(self._stand_ins.recorders)
        self._linger()
        return PlaybackSummary(
            counts=dict(zip(self.header.topics, self._player.counts, strict=False)),
            rounds=self._player.rounds,
            lateness=self._player.lateness.summary() if math.isfinite(options.rate) else None,
            took_s=took_ns / NS_PER_S,
            held_s=self._player.held_ns / NS_PER_S,
            cut=self._player.stalls,
            strays=self.source.strays,
            recorders=len(recorders),
            stored=self._stand_ins.have_stored(recorders),
            refilled=self._stand_ins.refilled,
            torn=self.header.torn,
        )

    def _await_recorders(self) -> None:
        clock = self.clock
        stand_ins = self._stand_ins
        if self.options.needs_recorder:
            self.say("waiting for a recorder")
        give_up_ns = clock.monotonic_ns() + LISTEN_NS
        while not self.stopped():
            stand_ins.serve_queries()
            missing = self.options.needs_recorder and not stand_ins.recorders
            listening = stand_ins.are_recorders_listening()
            if missing:
                give_up_ns = clock.monotonic_ns() + LISTEN_NS
            elif listening or clock.monotonic_ns() > give_up_ns:
                return
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _linger(self) -> None:
        clock = self.clock
        stand_ins = self._stand_ins
        give_up_ns = clock.monotonic_ns() + LINGER_NS
        while clock.monotonic_ns() < give_up_ns and not self.stopped():
            if stand_ins.serve_queries():
                give_up_ns = clock.monotonic_ns() + LINGER_NS
                continue
            # the last messages may still be under way
            if stand_ins.have_stored(stand_ins.recorders):
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
    """Plays a log over Zenoh; None if it was stopped before it began.

    Raises:
        SessionError: there is a session of that name.
        UsageError: an endpoint cannot be used.
        LogError: a file cannot be read any more.
    """
    header, batch = loaded
    # not SCHED_FIFO, as sites: polling the clock would starve Zenoh's own threads
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    with ExitStack() as stack:
        stack.enter_context(process.pause_gc())
        bus = open_playback_bus(
            connection=connection,
            clock=clock,
            session=options.session,
            stopped=stopped,
            say=say,
        )
        if bus is None:
            return None
        stack.enter_context(closing(bus))
        refuse_running_session(bus, clock, options.session, stopped)
        source = stack.enter_context(closing(MessageSource(header, batch)))
        if batch is None:
            source.read(paths, selection, loop=options.loop)
        playback = Playback(
            bus=bus,
            clock=clock,
            header=header,
            source=source,
            options=options,
            stopped=stopped,
            say=say,
            show=show,
        )
        return playback.play(selection.start_ns)


def map_key_to_session(topic: str, recorded_session: str, session: str) -> str:
    """Returns the key of a channel in the playback's session.

    A topic of the recorded session becomes one of the new session; any other topic is played
    below the new session, so that it meets no other.
    """
    chunks = topic.strip("/").split("/")
    own = chunks[:2] == [topics.ROOT, recorded_session]
    return "/".join([topics.ROOT, session, *(chunks[2:] if own else chunks)])

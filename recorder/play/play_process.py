"""Play a log as a process, from its first message to the summary of the playback.

Invariant:
    - The process stays until its recorders have every message, or send no more requests.
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
"""Pause between two polls while the playback waits for recorders."""
AHEAD_NS = 500_000_000
"""Time from the announcement of a playback to its first message."""
LISTEN_NS = 5_000_000_000
"""Longest wait for a recorder that is present to reply."""
LINGER_NS = 5_000_000_000
"""Time for which the playback stays at the end after the last query of a recorder."""
LAST_EVENT_NS = 100_000_000
"""Time for which the playback stays after the recorders have stored everything."""
NICE = -10
"""Priority of the process, if permitted."""
PROGRESS_EVERY_NS = 500_000_000
"""Period of progress reports."""


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """Options of a playback.

    Attributes:
        session: name of the playback's session.
        rate: seconds of the log per second; `math.inf`: as fast as all receivers accept it.
        loop: whether the log is played again and again.
        low_cpu: whether the player sleeps until a deadline instead of polling the clock.
        needs_recorder: whether the playback waits for a recorder before it starts.
    """

    session: str
    rate: float = 1.0
    loop: bool = False
    low_cpu: bool = False
    needs_recorder: bool = False


class PlaybackSummary(NamedTuple):
    """The result of a playback.

    Attributes:
        counts: number of published messages, by topic of the file.
        rounds: number of rounds that were started.
        lateness: lateness of the messages; None if they had no deadlines.
        took_s: duration of the play, s.
        held_s: time spent waiting for receivers that did not keep up, s.
        cut: how often a receiver accepted no message for 5 s and was disconnected.
        strays: number of messages that were so far from their turn in the file that they did
            not play at their turn.
        recorders: number of recorders that were present after the last message.
        stored: whether all these recorders reported that they stored everything.
        refilled: number of messages that were sent to recorders by backfill.
        torn: damaged files, with the reason.
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
    """One playback in a session of its own.

    Attributes:
        bus: the connection to the session.
        clock: the time.
        header: content of the files.
        source: supplies the messages.
        options: the options.
        stopped: returns True if the playback has to end.
        say: prints a line for the user.
        show: reports the progress to the user.
    """

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
        self._reported_ns = self.clock.monotonic_ns()
        self._player = Player(
            source=self.source,
            history=history,
            clock=self.clock,
            publisher=self._make_publisher,
            serve=self._serve,
            stopped=self.stopped,
            low_cpu=self.options.low_cpu,
        )

    def _make_publisher(self, channel: int) -> Callable[[bytes], None]:
        key = map_key_to_session(
            self.header.topics[channel], self.header.session, self.options.session
        )
        return self.bus.publisher(key, patient=True)

    def _serve(self, progress: PlayProgress) -> None:
        self._stand_ins.serve_queries()
        now_ns = self.clock.monotonic_ns()
        if now_ns - self._reported_ns >= PROGRESS_EVERY_NS:
            self._reported_ns = now_ns
            self.show(progress)

    def play(self, start_ns: int | None) -> PlaybackSummary:
        """Plays the log to its end, and stays until all recorders have every message.

        Args:
            start_ns: beginning of the play, ns since the epoch of the log; None: the first
                message.
        """
        clock = self.clock
        options = self.options
        first_ns = self._player.prepare()
        self._wait_for_recorders()
        origin_ns = clock.monotonic_ns() + AHEAD_NS
        if first_ns is not None:
            pace = Pace(origin_ns, first_ns if start_ns is None else start_ns, options.rate)
            self._stand_ins.start_session(pace.due_ns(0))
            self._player.play(pace, loop=options.loop)
        duration_ns = max(0, clock.monotonic_ns() - origin_ns)
        self._stand_ins.serve_queries()
        recorders = set(self._stand_ins.recorders)
        self._linger()
        return PlaybackSummary(
            counts=dict(zip(self.header.topics, self._player.counts, strict=False)),
            rounds=self._player.rounds,
            lateness=self._player.lateness.summary() if math.isfinite(options.rate) else None,
            took_s=duration_ns / NS_PER_S,
            held_s=self._player.held_ns / NS_PER_S,
            cut=self._player.stalls,
            strays=self.source.strays,
            recorders=len(recorders),
            stored=self._stand_ins.have_stored(recorders),
            refilled=self._stand_ins.refilled,
            torn=self.header.torn,
        )

    def _wait_for_recorders(self) -> None:
        """Waits until every recorder that is present has replied, `LISTEN_NS` at most."""
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
        """Replies to queries until the recorders have every message, or send no query."""
        clock = self.clock
        stand_ins = self._stand_ins
        give_up_ns = clock.monotonic_ns() + LINGER_NS
        while clock.monotonic_ns() < give_up_ns and not self.stopped():
            if stand_ins.serve_queries():
                give_up_ns = clock.monotonic_ns() + LINGER_NS
                continue
            # the last messages may still be in transit
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
    """Plays a log over Zenoh.

    Args:
        loaded: content of the files, and the messages if they were preloaded.
        paths: the files.
        selection: the messages that are played.
        options: the options.
        connection: how to connect to the network.
        clock: the time.
        stopped: returns True if the playback has to end.
        say: prints a line for the user.
        show: reports the progress to the user.

    Returns:
        The summary; None if the playback was stopped before it began.

    Raises:
        SessionError: a session of that name is running.
        UsageError: an endpoint cannot be used.
        LogError: a file cannot be read any more.
    """
    header, batch = loaded
    # not SCHED_FIFO as for sites: polling the clock would starve the threads of Zenoh
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
            source.start_reader(paths, selection, loop=options.loop)
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

    The name of the recorded session is replaced. The topic of another session is placed below
    the playback's session as a whole, so that it cannot collide with another topic.
    """
    chunks = topic.strip("/").split("/")
    if chunks[:2] == [topics.ROOT, recorded_session]:
        chunks = chunks[2:]
    return "/".join([topics.ROOT, session, *chunks])

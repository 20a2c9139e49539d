"""The playback process: plays a log on the network and ends with a summary for the user.

A log contains the messages of a session, a joint run of several arms. The process opens the
log, publishes its messages with the timing of the original session, and reports to the user how
late they were. To recorders and viewers, it looks like a running session.

Invariant:
    - After the last message, the process stays on the network until its recorders have every
      message, or no longer request missing messages.
"""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from trilat_net import process
from trilat_net.errors import UsageError
from trilat_net.records import NS_PER_S

from ...net import Bus, Clock, Connection, SessionMembers
from .batch import MessageBatch
from .message_source import MessageSource
from .player import LatenessHistogram, Pace, Player, PlayProgress
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader
from .site_stand_ins import PlayedHistory, SiteStandIns

POLL_NS = 5_000_000
"""Pause between two polls while the playback waits for recorders, in ns."""
AHEAD_NS = 500_000_000
"""Time from the announcement of a playback to its first message, in ns."""
LISTEN_NS = 5_000_000_000
"""Longest time to wait for the reply of a recorder that is present, in ns."""
LINGER_NS = 5_000_000_000
"""Time for which the playback stays at the end after the last request of a recorder, in ns."""
LAST_EVENT_NS = 100_000_000
"""Time for which the playback stays after the recorders have stored everything, in ns."""
NICE = -10
"""Priority (niceness) of the process, if it is permitted."""
PROGRESS_EVERY_NS = 500_000_000
"""Period of the progress reports, in ns."""


@dataclass(frozen=True, slots=True)
class PlayOptions:
    """Settings for playing a log over the network, taken from the command-line options.

    Attributes:
        session: Name of the session in which the log is played.
        rate: Playback speed, in seconds of the log per second. With `math.inf`, messages are
            played as fast as all receivers accept them.
        loop: True to play the log repeatedly.
        low_cpu: True to sleep until each deadline instead of polling the clock. This uses less
            processor time, but is less precise.
        needs_recorder: True to wait for a recorder before playback starts.
    """

    session: str
    rate: float = 1.0
    loop: bool = False
    low_cpu: bool = False
    needs_recorder: bool = False


class PlaybackSummary(NamedTuple):
    """Result of playing a log: message counts, duration in s, and how late messages were.

    Attributes:
        counts: Number of published messages, keyed by topic in the file.
        rounds: Number of passes through the log that were started.
        lateness: How long after their deadlines the messages were published. `None` if they had
            no deadlines.
        took_s: Duration of the playback, in s.
        held_s: Time for which the player waited for slow receivers, in s.
        cut: How often a receiver was disconnected because it accepted no message for 5 s.
        strays: Number of messages played out of order, because they appear too late in the
            file.
        recorders: Number of recorders that were present after the last message.
        stored: True if all these recorders reported that they stored everything.
        refilled: Number of messages that were sent again to recorders that missed them.
        torn: The damaged files, each with a description of the damage.
    """

    counts: dict[str, int]
    rounds: int
    lateness: LatenessHistogram.Summary | None
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
    """One playback of a log, which looks like a running session to other programs.

    The session has the name `options.session`. This object replies to other programs on behalf
    of the original sites, while its `Player` publishes the messages.

    Attributes:
        bus: Network connection of the player.
        clock: Clock of the player.
        header: Description of the recorded session.
        source: Supplies the messages in playback order.
        options: Playback settings.
        stopped: Function that returns True when playback must end.
        say: Function that prints a line for the user.
        show: Function that shows the progress to the user.
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
        """Returns the function that publishes messages of a channel, by its number."""
        key = self.header.map_topic(self.header.topics[channel], self.options.session)
        return self.bus.publisher(key, patient=True)

    def _serve(self, progress: PlayProgress) -> None:
        """Replies to queries, and shows the progress to the user twice a second."""
        self._stand_ins.serve_queries()
        now_ns = self.clock.monotonic_ns()
        if now_ns - self._reported_ns >= PROGRESS_EVERY_NS:
            self._reported_ns = now_ns
            self.show(progress)

    def play(self, start_ns: int | None) -> PlaybackSummary:
        """Plays the log to its end, and waits until the recorders need no more messages.

        Returns earlier if `stopped` returns True.

        Args:
            start_ns: Log time at which playback begins, in ns after the start of the recorded
                session. If `None`, playback begins with the first message.

        Returns:
            The result of the playback, on which the summary for the user is based.
        """
        clock = self.clock
        options = self.options
        first_ns = self._player.prepare()  # None if the log has no messages to play
        self._wait_for_recorders()

        origin_ns = clock.monotonic_ns() + AHEAD_NS
        if first_ns is not None:
            if start_ns is None:
                start_ns = first_ns
            pace = Pace(origin_ns, start_ns, options.rate)
            self._stand_ins.start_session(pace.due_ns(0))
            self._player.play(pace, loop=options.loop)
        duration_ns = max(0, clock.monotonic_ns() - origin_ns)

        self._stand_ins.serve_queries()

        # Recorders that leave from now on still belong to the result.
        recorders = set(self._stand_ins.recorders)
        self._linger()

        has_deadlines = math.isfinite(options.rate)
        return PlaybackSummary(
            counts=dict(zip(self.header.topics, self._player.counts, strict=False)),
            rounds=self._player.rounds,
            lateness=self._player.lateness.summary() if has_deadlines else None,
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
        """Waits until every recorder on the network is ready to receive messages.

        The wait lasts at most `LISTEN_NS`. Without this wait, the first messages could be
        missing from the logs of the recorders. A recorder is ready when it has replied to a
        query. If the options require a recorder, the waiting time begins when a recorder is
        present.
        """
        clock = self.clock
        stand_ins = self._stand_ins
        if self.options.needs_recorder:
            self.say("waiting for a recorder")
        give_up_ns = clock.monotonic_ns() + LISTEN_NS
        while not self.stopped():
            stand_ins.serve_queries()
            is_recorder_missing = self.options.needs_recorder and not stand_ins.recorders
            are_ready = stand_ins.are_recorders_listening()
            if is_recorder_missing:
                give_up_ns = clock.monotonic_ns() + LISTEN_NS
            elif are_ready or clock.monotonic_ns() > give_up_ns:
                return
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)

    def _linger(self) -> None:
        """Stays on the network after the last message, so that recorders can complete the log.

        In place of the original sites, it replies to recorders that request missing messages.
        It returns in the first of these cases:

        - No recorder has sent a request for `LINGER_NS`.
        - `LAST_EVENT_NS` have passed since all recorders reported that they stored everything.
        - The playback was stopped.
        """
        clock = self.clock
        stand_ins = self._stand_ins
        leave_ns = clock.monotonic_ns() + LINGER_NS
        while clock.monotonic_ns() < leave_ns and not self.stopped():
            has_replied_to_request = stand_ins.serve_queries()
            if has_replied_to_request:
                leave_ns = clock.monotonic_ns() + LINGER_NS
                continue  # further requests may be waiting

            if stand_ins.have_stored(stand_ins.recorders):
                # The process leaves soon, but further events of recorders may be in transit.
                leave_ns = min(leave_ns, clock.monotonic_ns() + LAST_EVENT_NS)
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
    """Plays a log over the network, so that other programs see a running session.

    The messages are published again with the timing of the original session.

    Args:
        loaded: Description of the recorded session, and its messages if they are in memory.
        paths: The files of the log.
        selection: Which messages are played.
        options: Playback settings.
        connection: How to connect to the network.
        clock: Clock of this process.
        stopped: Function that returns True when playback must end.
        say: Function that prints a line for the user.
        show: Function that shows the progress to the user.

    Returns:
        The summary. `None` if the playback was stopped before it began.

    Raises:
        SessionError: A session with the name `options.session` is already running.
        UsageError: An endpoint cannot be used.
        LogError: A file can no longer be read.
    """
    header, batch = loaded
    # Sites use the scheduling class SCHED_FIFO. The player does not, because its polling of the
    # clock would then starve the threads of Zenoh.
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)

    with ExitStack() as stack:
        stack.enter_context(process.pause_gc())
        bus = _open_bus(
            connection=connection,
            clock=clock,
            session=options.session,
            stopped=stopped,
            say=say,
        )
        if bus is None:
            return None
        stack.enter_context(closing(bus))

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


def _open_bus(
    connection: Connection,
    clock: Clock,
    session: str,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
) -> Bus | None:
    """Opens the network connection of a playback, which publishes the messages of a log again.

    If the port is in use, the error says whether a session of the same name uses it.

    Args:
        connection: Endpoints of the playback.
        clock: Clock of the caller.
        session: Name under which the log will be played back.
        stopped: Function that returns True to give up.
        say: Function that prints a line for the user.

    Returns:
        The connection. `None` if `stopped` returned True.

    Raises:
        SessionError: A session of the same name is running.
        UsageError: An endpoint cannot be used.
    """
    try:
        bus = connection.open_bus(clock=clock, stopped=stopped, timeout_s=None, say=say)
    except UsageError:
        if not connection.listen:
            raise
        # The port may be in use by a site of a session with the same name.
        target = replace(connection, listen=(), connect=connection.listen)
        session_bus = target.open_bus(clock=clock, stopped=stopped, timeout_s=1.0, say=say)
        if session_bus is not None:
            with closing(session_bus):
                SessionMembers(session_bus, clock, session).require_absent(stopped)
        raise
    if bus is not None:
        with ExitStack() as stack:
            stack.enter_context(closing(bus))
            SessionMembers(bus, clock, session).require_absent(stopped)
            stack.pop_all()  # the connection stays open
    return bus

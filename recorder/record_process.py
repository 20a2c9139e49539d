"""Runs the recorder: a process that joins a session, writes its messages, and ends with it.

Sites publish the state of their arms, typically a thousand times per second, and the recorder
writes these messages to a log. Each site keeps its recent messages in a buffer, from which the
recorder requests those that it missed.

Invariant:
    - A message is never lost once it has arrived, or while a site still has it in its buffer.
    - Messages are stamped with their time of arrival and wait in a single bounded queue. One
      thread writes them.
    - The file is flushed about every 65 ms, and completed whenever the process ends without a
      crash.
    - The first signal, such as Ctrl-C, ends the recorder after it has received the messages
      that the sites still have. The second signal ends it at once.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

from trilat_net import process
from trilat_net.errors import LogRefused, RunFailed, SessionError
from trilat_net.log import LogParts, LogStorage, LogWriter, MakeViews, SessionScenario, Sink
from trilat_net.net import (
    Bus,
    Clock,
    Connection,
    Epoch,
    EventPublisher,
    SessionJoin,
    describe_member,
    new_boot,
    share_threads,
    topics,
)
from trilat_net.signals import Interrupt

from .session_recording import RecorderReport, Recording
from .site_reception import InboundQueue

NICE = -5
"""Requested nice value, so that a busy machine does not delay the recorder for seconds.

Sites have a higher priority, because their ticks are due within a millisecond.
"""
POLL_NS = 10_000_000
"""Pause between polls while the recorder waits for the session or for missing messages, in ns.
"""
_END_S = 10
"""Time in s with no recovered message after which the recorder ends, once a signal has told it
to. Sites keep their messages for that long.
"""
END_NS = _END_S * 1_000_000_000
LONGEST_END_NS = 60_000_000_000
"""Maximum time after a signal during which the sites' remaining messages are requested, in ns.
"""
FLUSH_NS = 65_000_000
"""Interval at which the messages are written and flushed, in ns.

A crash loses at most the messages of one interval. A longer interval costs less computing time.
"""


ReadScenario = Callable[[str, str], tuple[SessionScenario, MakeViews | None]]
"""Function that parses the text of a resolved scenario, which another process has sent.

Its second argument is the name of the text, for error messages. The text is not trusted. The
result contains the names, rates and sizes of the sites, which determine the expected messages.
It also contains a function that creates the messages for log viewers, or None if the log
contains no such messages. The recorder does not import the code that interprets scenarios, so
its caller provides this function.
"""
CollectProvenance = Callable[[], Mapping[str, str]]
"""Function that returns the information about this program stored in a log, see `provenance`.
"""


class Recorder:
    """Records one session: joins it, writes its messages, and completes the log.

    The recorder runs in its own process, so that a slow disk cannot delay the control loops of
    the arms.

    Args:
        bus: Network connection of the recorder.
        clock: Clock of the recorder.
        session: Name of the session.
        boot: Random number that identifies this start of the recorder.
        storage: Place where the log is written.
        read_scenario: Function that parses the text of the session's scenario.
        provenance: Information about this program that is stored in the log.
        stopped: Function that returns True if the recorder must end at once.
        say: Function that prints a line for the user.
        is_ending: Function that returns True if the recorder must end as soon as it has the
            messages that the sites still store. It stops waiting for them if none arrives for
            `END_NS`, and at the latest after `LONGEST_END_NS`.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        boot: int,
        storage: LogStorage,
        read_scenario: ReadScenario,
        provenance: Mapping[str, str],
        stopped: Callable[[], bool],
        say: Callable[[str], None],
        is_ending: Callable[[], bool] = lambda: False,
    ) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session
        self._storage = storage
        self._read_scenario = read_scenario
        self._provenance = provenance
        self._stopped = stopped
        self._say = say
        self._is_ending = is_ending

        # The queue receives the messages of all sites from now on.
        self._queue = InboundQueue(clock)
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            bus.tap(topics.key(session, "*", channel), self._queue.receive)
        self._presence = bus.presence(topics.presence_key(session, "*"))

        # The recorder announces itself, and records its own events too.
        info = describe_member(topics.RECORDER, boot, clock, provenance["fingerprint"])
        keep = partial(self._queue.receive, topics.key(session, topics.RECORDER, topics.EVENT))
        self._publisher = EventPublisher(bus, session, info, keep)

        self._joining = SessionJoin(
            bus=bus, clock=clock, session=session, publisher=self._publisher, sites=()
        )

    def join(self, timeout_s: float | None) -> Epoch | None:
        """Waits until the session begins, or joins a session that is already running.

        All members of a session, including the recorder, first agree on a common start time.

        Args:
            timeout_s: Longest wait, in s. If None, there is no limit.

        Returns:
            The common start time of the session, and the boot of each member (the number that
            identifies a start of its process). None if the recorder has to stop before the
            session begins.

        Raises:
            SessionError: The session did not begin in time.
        """
        started_ns = self._clock.monotonic_ns()
        while not (self._stopped() or self._is_ending()):
            epoch = self._joining.poll()
            if epoch is not None:
                return epoch

            now_ns = self._clock.monotonic_ns()
            is_too_late = timeout_s is not None and now_ns - started_ns > timeout_s * 1e9
            if is_too_late:
                members = ", ".join(self._joining.membership.others) or "none"
                raise SessionError(
                    f"the recorder waited {timeout_s:g} s for session {self._session!r} "
                    f"to begin; members present: {members}"
                )
            self._clock.sleep_until(now_ns + self._joining.pinger.pause_ns(POLL_NS))
        return None

    def record(self, epoch: Epoch) -> Recording:
        """Writes the messages of the session to the log (an MCAP file) until the session ends.

        Args:
            epoch: Common start time of the session.

        Returns:
            The finished recording.

        Raises:
            UsageError: The file cannot be created.
            LogRefused: Writing to the disk failed. The error states which part is saved.
        """
        scenario, make_views = self._find_scenario(epoch)

        def open_part(stream: Sink, part: Mapping[str, str]) -> LogWriter:
            """Creates the writer for one MCAP file. A long log is split into several files.

            Args:
                stream: The open file.
                part: Description of the part of the log that the file contains.
            """
            return LogWriter(
                stream=stream,
                scenario=scenario,
                session=self._session,
                driver="live",
                epoch_unix_ns=epoch.unix_ns,
                provenance=self._provenance,
                part=part,
                choice=self._storage.choice,
                make_views=make_views,
            )

        with LogParts(self._storage, open_part) as log:
            recording = Recording(
                writer=log,
                scenario=scenario,
                session=self._session,
                epoch=epoch,
                bus=self._bus,
                publisher=self._publisher,
            )
            log.current_accounts = partial(recording.render_accounts, self._queue)
            report = RecorderReport(
                bus=self._bus,
                clock=self._clock,
                recording=recording,
                queue=self._queue,
                size=lambda: log.written_bytes,
            )
            self._announce_start(recording, epoch, log.path)
            # A full disk has no room for the messages that wait in the queue.
            has_room = True
            try:
                self._run(recording, report)
            except LogRefused:
                has_room = False
                raise
            finally:
                report.publish()
                try:
                    recording.finish(self._queue, rest=has_room)
                except LogRefused:
                    recording.finish(self._queue, rest=False)
                    raise
        return recording

    def _find_scenario(self, epoch: Epoch) -> tuple[SessionScenario, MakeViews | None]:
        """Returns the scenario to record, and the function that creates channels for viewers.

        The scenario is part of a member's identity, so a recorder needs no scenario file. The
        function is None if no channels for viewers are recorded. Members that were restarted
        after the common start was agreed have a different boot, and are ignored.

        Args:
            epoch: Agreed start of the session, with the boots of its members.
        """
        agreed_members = [
            info
            for info in self._joining.membership.others.values()
            if epoch.boots.get(info.member) == info.boot
        ]
        sender = next(info for info in agreed_members if info.scenario)
        return self._read_scenario(sender.scenario, sender.member)

    def _announce_start(self, recording: Recording, epoch: Epoch, path: Path) -> None:
        """Announces on the network that the recorder is running.

        The announcement tells the other processes of the session, which wait for it, that their
        messages are recorded. A recorder that joins late also requests earlier messages.

        Args:
            recording: The recording, which has just been created.
            epoch: Common start time of the session.
            path: The file, for the user.
        """
        info = self._publisher.info
        now_ns = self._clock.monotonic_ns()
        self._publisher.update(running=True)
        text = "the session begins"
        joins_late = epoch.boots.get(info.member) != info.boot
        if joins_late:
            elapsed_s = (now_ns - epoch.mono_ns) / 1e9
            text = f"joins the session, which has been running for {elapsed_s:.1f} s"
            recording.assume_gone()
            self._receive_presence(recording)
            recording.join_late(now_ns)

        self._say(f"recorder: {text}, writing {path}")
        for clock_text in self._joining.pinger.describe_clocks(epoch.boots, epoch.mono_ns):
            self._say(f"recorder: {clock_text}")

    def _receive_presence(self, recording: Recording) -> None:
        """Informs the recording which processes have joined the session's network or left it.

        Zenoh, the network library, reports both. The recording uses these reports to decide
        which sites it still has to wait for before closing the log.
        """
        while (change := self._presence.poll()) is not None:
            key, alive = change
            recording.note_presence(key, alive)

    def _run(self, recording: Recording, report: RecorderReport) -> None:
        """Writes received messages to the log at regular intervals until the session is over.

        The loop also ends if the recorder itself is told to end, for example by Ctrl-C.

        Args:
            recording: The recording, whose log is written.
            report: Publishes statistics of the recorder, such as the number of stored messages.
        """
        ending_since_ns: int | None = None
        while not (self._stopped() or recording.is_over(self._clock.monotonic_ns())):
            now_ns = self._clock.monotonic_ns()
            if ending_since_ns is None and self._is_ending():
                ending_since_ns = now_ns
                self._say(
                    "recorder: requesting the missing records until no more arrive for "
                    f"{_END_S} s; Ctrl-C a second time ends it at once"
                )
            if ending_since_ns is not None:
                # Wait for missing messages as long as some of them arrive, but not forever.
                waited_ns = now_ns - ending_since_ns
                without_arrival_ns = now_ns - max(ending_since_ns, recording.repaired_ns)
                has_waited = without_arrival_ns > END_NS or waited_ns > LONGEST_END_NS
                if has_waited or recording.is_up_to_date(ending_since_ns, now_ns):
                    return

            self._publisher.answer_queries()
            recording.write(self._queue, now_ns)
            self._receive_presence(recording)
            report.poll()
            flush_start_ns = self._clock.monotonic_ns()
            recording.flush()
            report.note_flush(self._clock.monotonic_ns() - flush_start_ns)
            self._repair_until(recording, now_ns + FLUSH_NS)

    def _repair_until(self, recording: Recording, until_ns: int) -> None:
        """Waits until a given time while requesting and writing missing messages.

        A site sends only a few messages per reply, to avoid delaying its control loop. If each
        request waited for the next flush, a recorder that was delayed on a busy machine would
        never catch up.

        Args:
            recording: The recording.
            until_ns: End of the wait on the monotonic clock, in ns.
        """
        while recording.is_repairing:
            now_ns = self._clock.monotonic_ns()
            if now_ns + POLL_NS >= until_ns:
                break
            self._clock.sleep_until(now_ns + POLL_NS)
            recording.write(self._queue, self._clock.monotonic_ns())
        self._clock.sleep_until(until_ns)


def record_session(
    session: str,
    storage: LogStorage,
    connection: Connection,
    read_scenario: ReadScenario,
    collect_provenance: CollectProvenance,
    join_timeout_s: float | None,
    clock: Clock,
    say: Callable[[str], None],
    afterwards: Callable[[], None] = lambda: None,
    warn: Callable[[], None] = lambda: None,
) -> int:
    """Records a session in this process, from finding it on the network to the finished log.

    Args:
        session: Name of the session.
        storage: Place where the log (an MCAP file) is written.
        connection: How to connect to the session, see `Connection.open_session`.
        read_scenario: Function that parses the text of the session's scenario.
        collect_provenance: Function that returns the information about this program that is
            stored in the log. It is called once the recorder is connected.
        join_timeout_s: Longest wait for the session to begin, in s. If None, there is no limit.
        clock: Clock of the recorder.
        say: Function that prints a line for the user.
        afterwards: Function that processes the finished log, unless the recorder was
            interrupted. The recorder remains a member of the session until this function
            returns, and sites that were started with `--stay` wait until then.
        warn: Function that is called when the connection is open, to warn the user of risks.

    Returns:
        The exit code: 0, or 128 plus the number of the signal that ended the recorder.

    Raises:
        TrilatError: The session did not begin, the file cannot be written, or records are
            missing.
    """
    share_threads()
    boot = new_boot()
    say(f"recorder: waiting for session {session!r} to begin")
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt())
        bus = stack.enter_context(
            connection.open_session(
                clock,
                session,
                lambda text: read_scenario(text, session)[0].names,
                stopped=interrupt.is_requested,
                timeout_s=join_timeout_s,
                say=lambda text: say(f"recorder: {text}"),
                recorder_boot=boot,
            )
        )
        if bus is None:
            return interrupt.exit_code
        warn()
        recorder = Recorder(
            bus=bus,
            clock=clock,
            session=session,
            boot=boot,
            storage=storage,
            read_scenario=read_scenario,
            provenance=collect_provenance(),
            stopped=interrupt.is_repeated,
            say=say,
            is_ending=interrupt.is_requested,
        )
        process.freeze_gc()  # a pause for garbage collection would delay the next flush
        process.raise_priority(NICE)
        epoch = recorder.join(join_timeout_s)
        if epoch is None:
            say("recorder: ended before the session began; nothing was written")
            return interrupt.exit_code
        recording = recorder.record(epoch)
        process.raise_priority(0)
        say("\n".join(recording.render_summary()))
        if not interrupt.is_requested():
            with suppress(KeyboardInterrupt), interrupt.raising():
                afterwards()
    if interrupt.is_requested():
        return interrupt.exit_code

    problem = recording.describe_problem()
    if problem:
        raise RunFailed(problem)
    return 0

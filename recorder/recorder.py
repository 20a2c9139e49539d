"""One recording: joins a session, writes what comes, ends with it.

Law: nothing is lost that arrived, or that a site still remembers. Messages are stamped where they come in
and wait in one bounded queue; one thread writes. The file is flushed every 100 ms and finished whatever ends
the process in order.
"""

import platform
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import msgspec

from trilat_net.core.fingerprint import fingerprint
from trilat_net.errors import LogRefused, SessionError
from trilat_net.log.container import Sink
from trilat_net.log.parts import LogParts, Storage
from trilat_net.log.writer import LogWriter
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.messages import Info
from trilat_net.net.pinging import clock_texts
from trilat_net.net.session import Epoch, Joining
from trilat_net.net.voice import Voice
from trilat_net.scenario import Scenario, embedded

from .recording import Recording
from .report import Report
from .tap import Tap

POLL_NS = 10_000_000
FLUSH_NS = 80_000_000
"""How often the log is handed to the operating system: a crash loses this, and at most two polls."""


class Recorder:
    """One recording, from the first poll to the end mark of the file.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        boot: this process's boot.
        storage: where the log goes.
        stopped: True once the recorder was asked to end.
        say: tells a person what happens.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        boot: int,
        storage: Storage,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        self._bus, self._clock, self._session, self._storage = bus, clock, session, storage
        self._stopped, self._say = stopped, say
        self._tap = Tap(clock)
        for channel in (topics.STATE, topics.LINK, topics.EVENT):
            bus.tap(topics.key(session, "*", channel), self._tap.take)
        self._presence = bus.presence(topics.key(session, "*", topics.ALIVE) + "/*")
        self._voice = Voice(
            bus,
            session,
            Info(
                member=topics.RECORDER,
                boot=boot,
                scenario_sha256="",
                scenario="",
                host=platform.node(),
                clock=clock.identity(),
                fingerprint=fingerprint(),
            ),
            partial(self._tap.take, topics.key(session, topics.RECORDER, topics.EVENT)),
        )
        self._joining = Joining(bus, clock, session, self._voice, ())

    def join(self, timeout_s: float | None) -> Epoch | None:
        """Waits for a session to begin.

        Args:
            timeout_s: how long, s; None for as long as it takes.

        Returns:
            The epoch, or None where the recorder was asked to end before.

        Raises:
            SessionError: none began in time.
        """
        begun_ns = self._clock.monotonic_ns()
        while not self._stopped():
            epoch = self._joining.poll()
            if epoch is not None:
                return epoch
            now_ns = self._clock.monotonic_ns()
            if timeout_s is not None and now_ns - begun_ns > timeout_s * 1e9:
                met = ", ".join(self._joining.meeting.met) or "nobody"
                raise SessionError(
                    f"the recorder waited {timeout_s:g} s for session {self._session!r} to begin; "
                    f"it met {met}"
                )
            self._clock.sleep_until(now_ns + self._joining.pinger.pause_ns(POLL_NS))
        return None

    def record(self, epoch: Epoch) -> Recording:
        """Writes the session from its epoch to its end, and returns the finished recording.

        Raises:
            UsageError: the file cannot be made.
            LogRefused: the disk refused; says what is kept.
        """
        scenario = self._scenario(epoch)

        def begin(stream: Sink, part: Mapping[str, str]) -> LogWriter:
            return LogWriter(
                *(stream, scenario, self._session, "live", epoch.unix_ns),
                part=part,
                choice=self._storage.choice,
                views_hz=self._storage.views_hz,
            )

        with LogParts(self._storage, begin) as log:
            recording = Recording(log, scenario, self._session, epoch, self._bus, self._voice)
            log.so_far = partial(recording.account_texts, self._tap)
            boot = self._voice.info.boot
            report = Report(
                *(self._bus, self._clock, self._session, boot, epoch, recording, self._tap),
                lambda: log.written_bytes,
            )
            self._begin(recording, epoch, log.path)
            left = self._tap
            try:
                self._run(recording, report)
            except LogRefused:
                left = self._nothing()
                raise
            finally:
                report.say()
                self._finish(recording, left)
        return recording

    def _finish(self, recording: Recording, left: Tap) -> None:
        """Writes what is left and the end of the log; where the disk refuses what is left, the end."""
        try:
            recording.finish(left)
        except LogRefused:
            recording.finish(self._nothing())
            raise

    def _nothing(self) -> Tap:
        """Returns a queue in which nothing waits: on a full disk there is no room for it."""
        tap = Tap(self._clock)
        tap.overflowed = self._tap.overflowed
        return tap

    def _scenario(self, epoch: Epoch) -> Scenario:
        """Returns the scenario, as a member of the session has it."""
        return next(
            embedded(info.scenario, info.member)
            for info in self._joining.meeting.met.values()
            if info.scenario and epoch.boots.get(info.member) == info.boot
        )

    def _begin(self, recording: Recording, epoch: Epoch, path: Path) -> None:
        """Says that it is one of the session's members, or that it comes late."""
        own, now_ns = self._voice.info, self._clock.monotonic_ns()
        self._voice.info = msgspec.structs.replace(own, running=True)
        how = "the session begins"
        if epoch.boots.get(own.member) != own.boot:
            how = f"joins the session, which runs since {(now_ns - epoch.mono_ns) / 1e9:.1f} s"
            recording.away()
            self._attend(recording)
            recording.late(now_ns)
        self._say(f"recorder: {how}, writing {path}")
        for text in clock_texts(self._joining.pinger, epoch.boots, epoch.mono_ns):
            self._say(f"recorder: {text}")

    def _attend(self, recording: Recording) -> None:
        """Notes who has come and who has gone."""
        while (change := self._presence.poll()) is not None:
            recording.presence(*change)

    def _run(self, recording: Recording, report: Report) -> None:
        """Takes and writes until the session is over."""
        flushed_ns = self._clock.monotonic_ns()
        while not (self._stopped() or recording.over(self._clock.monotonic_ns())):
            self._voice.answer()
            recording.write(self._tap, self._clock.monotonic_ns())
            self._attend(recording)
            report.poll()
            now_ns = self._clock.monotonic_ns()
            if now_ns - flushed_ns >= FLUSH_NS:
                recording.flush()
                flushed_ns = now_ns
                report.flushed(self._clock.monotonic_ns() - now_ns)
            self._clock.sleep_until(now_ns + POLL_NS)

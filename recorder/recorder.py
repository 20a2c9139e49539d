"""One recording: joins a session, writes what comes, ends with it.

Law: nothing is lost that arrived. Messages are stamped where they come in and wait in one bounded queue;
one thread writes. The file is flushed every 100 ms and finished whatever ends the process in order.
"""

import platform
from collections.abc import Callable
from pathlib import Path

import msgspec

from trilat_net.core.fingerprint import fingerprint
from trilat_net.errors import SessionError
from trilat_net.log.writer import new_file
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.messages import Info
from trilat_net.net.pinging import clock_texts
from trilat_net.net.session import Epoch, Joining
from trilat_net.net.voice import Voice
from trilat_net.scenario import parse

from .recording import Recording
from .tap import Tap

POLL_NS = 10_000_000
FLUSH_NS = 100_000_000


class Recorder:
    """One recording, from the first poll to the end mark of the file.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        boot: this process's boot.
        path: where the log goes; must not exist.
        stopped: True once the recorder was asked to end.
        say: tells a person what happens.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        boot: int,
        path: Path,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
    ) -> None:
        self._clock, self._session, self._path = clock, session, path
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
            LogError: the disk refused.
        """
        self._voice.info = msgspec.structs.replace(self._voice.info, running=True)
        scenario = next(
            parse(info.scenario, info.member)
            for info in self._joining.meeting.met.values()
            if info.scenario and epoch.boots.get(info.member) == info.boot
        )
        with new_file(self._path) as stream:
            recording = Recording(stream, scenario, self._session, epoch, self._voice)
            self._say(f"recorder: the session begins, writing {self._path}")
            for text in clock_texts(self._joining.pinger, epoch.boots, epoch.mono_ns):
                self._say(f"recorder: {text}")
            try:
                self._run(recording)
            finally:
                recording.finish(self._tap)
        return recording

    def _run(self, recording: Recording) -> None:
        """Takes and writes until the session is over."""
        flushed_ns = self._clock.monotonic_ns()
        while not (self._stopped() or recording.over(self._clock.monotonic_ns())):
            self._voice.answer()
            recording.write(self._tap, self._clock.monotonic_ns())
            while (change := self._presence.poll()) is not None:
                recording.presence(*change)
            now_ns = self._clock.monotonic_ns()
            if now_ns - flushed_ns >= FLUSH_NS:
                recording.flush()
                flushed_ns = now_ns
            self._clock.sleep_until(now_ns + POLL_NS)

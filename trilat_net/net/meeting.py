"""Who is there: every member asks every other one, and knows who is missing.

Law: another scenario, a running session and a second start of oneself are refused at the first meeting; what
strangers answer is remembered for the error, and passed over. A recorder may meet a running session, and
there may be other recorders.
"""

from collections.abc import Sequence

from ..errors import SessionError, WireError
from . import topics
from .asking import Asking
from .bus import Bus
from .clock import Clock
from .messages import Info
from .voice import Voice
from .wire import decode

ASK_EVERY_NS = 200_000_000


class Meeting:
    """What one member knows of the others.

    Args:
        bus: its connection.
        clock: the time.
        session: the session's name.
        voice: its own events and answers.
        sites: the sites of the scenario, in order; empty for a member that learns them (the recorder).

    Attributes:
        met: what the others said of themselves, by name.
        unreadable: whose answer could not be understood, and why.
        gone: boots of the members that have disappeared.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, voice: Voice, sites: Sequence[str]) -> None:
        self.met: dict[str, Info] = {}
        self.unreadable: dict[str, str] = {}
        self.gone: set[str] = set()
        self._clock, self._session, self._voice, self._sites = clock, session, voice, tuple(sites)
        self._presence = bus.presence(topics.key(session, "*", topics.ALIVE) + "/*")
        self._asking = Asking(bus, clock, topics.key(session, "*", topics.INFO))
        self._asked_ns = -ASK_EVERY_NS
        self._refused: set[int] = set()
        self._recorders: set[str] = set()

    @property
    def own(self) -> Info:
        """What this member says of itself."""
        return self._voice.info

    @property
    def leads(self) -> bool:
        """True where this member is the first site of the scenario."""
        return self._sites[:1] == (self.own.member,)

    def boots(self) -> dict[str, int]:
        """Returns the boots of all who are there, oneself among them."""
        return {name: info.boot for name, info in self.met.items()} | {self.own.member: self.own.boot}

    def clocks(self) -> dict[str, str]:
        """Returns the identities of their clocks."""
        return {name: info.clock for name, info in self.met.items()} | {self.own.member: self.own.clock}

    def missing(self) -> list[str]:
        """Returns the members that have not been met."""
        needed = any(info.needs_recorder for info in (self.own, *self.met.values()))
        recorder = needed or bool(self._recorders)
        wanted = [*self._sites, *([topics.RECORDER] if recorder else [])]
        return [name for name in wanted if name != self.own.member and name not in self.met]

    def poll(self, *, invited: bool) -> None:
        """Asks again and again who is there, takes the answers, and forgets who is gone.

        Args:
            invited: whether this member has said ready: then others may begin before it knows.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        now_ns = self._clock.monotonic_ns()
        while (answer := self._asking.poll()) is not None:
            where = topics.address(answer.key)
            try:
                info = decode(answer.payload, Info)
            except WireError as error:  # another version of us, or a stranger: no reason to leave
                if where is not None and where.member in (*self._sites, topics.RECORDER):
                    self.unreadable[where.member] = str(error)
                continue
            if where is not None and where.member == info.member:
                self.take(info, invited=invited)
        if now_ns - self._asked_ns >= ASK_EVERY_NS:
            self._asked_ns = self._asking.ask()
        self._watch()

    def take(self, info: Info, *, invited: bool) -> None:
        """Takes what a member says of itself.

        Raises:
            SessionError: this member cannot be part of the session, and why.
        """
        own = self.own
        if info.boot == own.boot or (not self._sites and info.member == topics.RECORDER):
            return
        if info.running and not invited and (self._sites or not info.boots):
            raise SessionError(f"session {self._session!r} is running; {info.member} is at tick {info.ticks}")
        if info.member == own.member:
            if info.boot < own.boot:
                raise SessionError(f"there is a {own.member} in session {self._session!r} already")
            return
        if self._sites and info.scenario_sha256 and info.scenario_sha256 != own.scenario_sha256:
            self._refuse(info)
            return
        if info.member == topics.RECORDER and self._has_recorder(info):
            return
        if not self._sites or info.member in self._sites or info.member == topics.RECORDER:
            self.met[info.member] = info

    def _has_recorder(self, info: Info) -> bool:
        """True where another recorder was met before, which is still there: the first one is the member."""
        met = self.met.get(topics.RECORDER)
        return met is not None and met.boot != info.boot

    def _refuse(self, info: Info) -> None:
        """The leader's scenario is the session's: others leave, and the leader says why."""
        own = self.own
        text = (
            f"another scenario: {info.member} has {info.scenario_sha256[:16]}, "
            f"{own.member} has {own.scenario_sha256[:16]}"
        )
        if not self.leads and info.member == self._sites[0]:
            raise SessionError(f"{text}; the one of {info.member}, who leads, counts")
        if self.leads and info.boot not in self._refused:
            self._refused.add(info.boot)
            self._voice.say("refused", text, about=info.member)

    def _watch(self) -> None:
        """Notes recorders that announce themselves, and forgets members that are gone."""
        while (change := self._presence.poll()) is not None:
            key, alive = change
            where = topics.address(key)
            if where is None:
                continue
            if where.member == topics.RECORDER:
                (self._recorders.add if alive else self._recorders.discard)(where.boot)
            (self.gone.discard if alive else self.gone.add)(where.boot)
            if alive:
                continue
            met = self.met.get(where.member)
            if met is not None and str(met.boot) == where.boot:
                del self.met[where.member]

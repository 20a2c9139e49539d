"""Stands in for the sites of a session that is played: their tokens, who they are, their past.

Law: a recorder, a viewer or a ping finds what it would find in a running session that it comes to late; and
nothing is said in a site's name that the log does not hold, but who it is.
"""

import platform
from collections.abc import Collection, Mapping

import msgspec

from ..errors import WireError
from ..net import topics
from ..net.answers import Past, Wanted
from ..net.asking import Asking
from ..net.bus import Bus, Question, Questions
from ..net.clock import Clock
from ..net.meeting import ASK_EVERY_NS
from ..net.messages import Info
from ..net.pinging import answer_pings
from ..net.voice import said, token
from ..net.wire import decode, encode
from .memory import Memory
from .pace import Pace
from .reading import Facts

REFRESH_NS = 500_000_000
"""How old an answer to who somebody is may be: it holds a whole scenario, which takes long to encode."""


class Part:
    """One site that is stood in for.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        info: what it answers when asked who it is.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, info: Info) -> None:
        self.info = info
        self.past: Questions = bus.questions(topics.key(session, info.member, topics.PAST))
        self._clock = clock
        self._asked = bus.questions(topics.key(session, info.member, topics.INFO))
        self._answer, self._made_ns = b"", -REFRESH_NS
        answer_pings(bus, clock, session, info)

    def run(self, epoch_mono_ns: int, epoch_unix_ns: int, boots: Mapping[str, int]) -> None:
        """Says from now on that the session runs."""
        self.info = msgspec.structs.replace(
            self.info,
            running=True,
            epoch_mono_ns=epoch_mono_ns,
            epoch_unix_ns=epoch_unix_ns,
            boots=dict(boots),
        )
        self._answer = b""

    def introduce(self, ticks: int) -> None:
        """Answers who asks who this is."""
        while (question := self._asked.poll()) is not None:
            now_ns = self._clock.monotonic_ns()
            if not self._answer or now_ns - self._made_ns >= REFRESH_NS:
                self.info = msgspec.structs.replace(self.info, ticks=ticks)
                self._answer, self._made_ns = encode(self.info), now_ns
            question.answer(self._answer)


class Cast:
    """All sites of a session, and who listens.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name here.
        facts: what the log says of the session.
        memory: what has been played.

    Attributes:
        recorders: boots of the recorders that are there.
        told: how many messages have been given to recorders that had missed them.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, facts: Facts, memory: Memory) -> None:
        self.recorders: set[str] = set()
        self.told = 0
        self._bus, self._clock, self._session, self._facts, self._memory = bus, clock, session, facts, memory
        self._stored: dict[str, set[str]] = {}
        self._met: set[str] = set()
        self._presence = bus.presence(topics.key(session, topics.RECORDER, topics.ALIVE) + "/*")
        self._said = bus.inbox(topics.key(session, topics.RECORDER, topics.EVENT), 256)
        self._asking = Asking(bus, clock, topics.key(session, topics.RECORDER, topics.INFO))
        self._asked_ns = -ASK_EVERY_NS
        self._parts = {
            site: Part(
                bus,
                clock,
                session,
                Info(
                    member=site,
                    boot=boot,
                    scenario_sha256=facts.scenario_sha256,
                    scenario=facts.scenario_text,
                    host=platform.node(),
                    clock=clock.identity(),
                    fingerprint=facts.fingerprint,
                ),
            )
            for site, boot in facts.boots.items()
        }
        for site, boot in facts.boots.items():
            bus.announce(token(session, site, boot))

    def run(self, pace: Pace) -> None:
        """Says from now on that the session runs, with tick 0 where the pace puts it."""
        epoch_mono_ns = pace.due_ns(0)
        epoch_unix_ns = self._clock.unix_ns() + epoch_mono_ns - self._clock.monotonic_ns()
        for part in self._parts.values():
            part.run(epoch_mono_ns, epoch_unix_ns, self._facts.boots)

    def attend(self) -> bool:
        """Answers who they are, notes who has come or gone, and answers one question for the past.

        Returns:
            True where there was such a question.
        """
        for site, part in self._parts.items():
            part.introduce(self._ticks(site))
        while (change := self._presence.poll()) is not None:
            where = topics.address(change[0])
            if where is not None:
                (self.recorders.add if change[1] else self.recorders.discard)(where.boot)
        for event in said(self._said):
            if event.kind == "stored":
                self._stored.setdefault(str(event.boot), set()).add(event.about)
        for site, part in self._parts.items():
            question = part.past.poll()
            if question is not None:
                self._tell(site, question)
                return True
        return False

    def recorders_listen(self) -> bool:
        """Asks the recorders that are there who they are; True once all have said so."""
        while (answer := self._asking.poll()) is not None:
            try:
                self._met.add(str(decode(answer.payload, Info).boot))
            except WireError:
                continue  # a stranger's
        now_ns = self._clock.monotonic_ns()
        if self.recorders - self._met and now_ns - self._asked_ns >= ASK_EVERY_NS:
            self._asked_ns = self._asking.ask()
        return not self.recorders - self._met

    def stored(self, recorders: Collection[str]) -> bool:
        """True where all of these recorders have said that they have all of every site."""
        return all(self._stored.get(boot, set()) >= self._parts.keys() for boot in recorders)

    def _channel(self, site: str, channel: str) -> int:
        topic = "/" + topics.key(self._facts.session, site, channel)
        return self._facts.topics.index(topic) if topic in self._facts.topics else -1

    def _ticks(self, site: str) -> int:
        return self._memory.made.get(self._channel(site, topics.STATE), 0)

    def _tell(self, site: str, question: Question) -> None:
        try:
            wanted = decode(question.payload, Wanted)
        except WireError:
            return  # a stranger's: it gets no answer
        channel = self._channel(site, wanted.channel)
        first, payloads = self._memory.chunk(channel, wanted.first, wanted.last)
        past = Past(
            member=site,
            boot=self._facts.boots[site],
            channel=wanted.channel,
            first=first,
            payloads=payloads,
            made=self._memory.made.get(channel, 0),
        )
        question.answer(encode(past))
        self.told += len(payloads)

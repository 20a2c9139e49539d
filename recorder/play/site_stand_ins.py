"""Stand-ins for the sites of a played session: tokens, identities, pings and backfill.

Invariant: recorders, viewers and pings find what a running session would show a late joiner; apart from
identities, nothing is published in a site's name that the log does not hold. Backfill covers messages already
played: a minute of them when the log is read during play (L6), all of them when it is preloaded.
"""

import platform
from bisect import bisect_left
from collections import deque
from collections.abc import Collection, Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Query, QueryInbox
from trilat_net.net.clock import Clock
from trilat_net.net.membership import ASK_EVERY_NS, liveliness_token, read_events
from trilat_net.net.messages import Info
from trilat_net.net.pinging import RepeatedQuery, answer_pings
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES, Backfill, BackfillRequest
from trilat_net.net.wire import decode, encode

from .batch import Ints, MessageBatch
from .pace import Pace
from .session_reader import SessionHeader


class _PlayedRun(NamedTuple):
    """Messages of one channel that lie in one block: their numbers, ascending, and their places in it."""

    numbers: Ints
    places: Ints
    block: MessageBatch


class PlayedHistory:
    """Per channel the messages that have been given to the player.

    Args:
        kept_ns: how much of the log to remember, ns; None: everything.

    Attributes:
        made: per channel the number of its last message played, and one.
    """

    def __init__(self, kept_ns: int | None = None) -> None:
        self.made: dict[int, int] = {}
        self._kept_ns = kept_ns
        self._stretches: dict[int, deque[_PlayedRun]] = {}

    def add(self, block: MessageBatch) -> None:
        """Takes messages that are about to be played, and forgets the oldest."""
        for channel in np.unique(block.channels).tolist():
            places = np.flatnonzero(block.channels == channel)
            stretches = self._stretches.setdefault(channel, deque())
            stretches.append(_PlayedRun(block.numbers[places], places, block))
            while self._kept_ns is not None and self._old(stretches[0], int(block.times_ns[-1])):
                stretches.popleft()

    def _old(self, stretch: _PlayedRun, now_ns: int) -> bool:
        assert self._kept_ns is not None
        return int(stretch.block.times_ns[-1]) < now_ns - self._kept_ns

    def forget(self) -> None:
        """Forgets everything but how much was played: another round begins."""
        self._stretches.clear()

    def chunk(self, channel: int, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns consecutive messages of a channel, as many as one answer takes, and the first one's number.

        Args:
            channel: which.
            first: number of the first one wanted; where there is none of that number, the next one that
                there is comes first.
            last: number of the last one wanted.
        """
        stretches = self._stretches.get(channel, deque())
        made = self.made.get(channel, 0)
        payloads: list[bytes] = []
        size, wanted, begun = 0, first, first
        for stretch in list(stretches)[bisect_left(stretches, first, key=lambda s: int(s.numbers[-1])) :]:
            begin = int(np.searchsorted(stretch.numbers, wanted))
            for number, place in zip(
                stretch.numbers[begin : begin + BACKFILL_MESSAGES + 1].tolist(),
                stretch.places[begin : begin + BACKFILL_MESSAGES + 1].tolist(),
                strict=True,
            ):
                if not payloads:
                    begun = wanted = max(first, min(number, made))
                if number < wanted:
                    continue  # the same number once more
                payload = stretch.block.payload(place)
                size += len(payload)
                full = len(payloads) == BACKFILL_MESSAGES or (payloads and size > BACKFILL_BYTES)
                if number > min(last, made - 1) or number > wanted or full:
                    return begun, payloads
                payloads.append(payload)
                wanted = number + 1
        return (begun if payloads or first >= made else made), payloads


REFRESH_NS = 500_000_000
"""How old an answer to who somebody is may be: it holds a whole scenario, which takes long to encode."""


class SiteStandIn:
    """One site that is stood in for.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        info: what it answers when asked who it is.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, info: Info) -> None:
        self.info = info
        self.past: QueryInbox = bus.questions(topics.key(session, info.member, topics.PAST))
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


class SiteStandIns:
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

    def __init__(
        self, bus: Bus, clock: Clock, session: str, facts: SessionHeader, memory: PlayedHistory
    ) -> None:
        self.recorders: set[str] = set()
        self.told = 0
        self._bus, self._clock, self._session, self._facts, self._memory = bus, clock, session, facts, memory
        self._stored: dict[str, set[str]] = {}
        self._met: set[str] = set()
        self._presence = bus.presence(topics.key(session, topics.RECORDER, topics.ALIVE) + "/*")
        self._said = bus.inbox(topics.key(session, topics.RECORDER, topics.EVENT), 256)
        self._asking = RepeatedQuery(bus, clock, topics.key(session, topics.RECORDER, topics.INFO))
        self._asked_ns = -ASK_EVERY_NS
        self._parts = {
            site: SiteStandIn(
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
            bus.announce(liveliness_token(session, site, boot))

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
            where = topics.parse_key(change[0])
            if where is not None:
                (self.recorders.add if change[1] else self.recorders.discard)(where.boot)
        for event in read_events(self._said):
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

    def _tell(self, site: str, question: Query) -> None:
        try:
            wanted = decode(question.payload, BackfillRequest)
        except WireError:
            return  # a stranger's: it gets no answer
        channel = self._channel(site, wanted.channel)
        first, payloads = self._memory.chunk(channel, wanted.first, wanted.last)
        past = Backfill(
            member=site,
            boot=self._facts.boots[site],
            channel=wanted.channel,
            first=first,
            payloads=payloads,
            made=self._memory.made.get(channel, 0),
        )
        question.answer(encode(past))
        self.told += len(payloads)

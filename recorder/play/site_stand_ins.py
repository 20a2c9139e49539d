"""Stand-ins for the sites of a played session: tokens, identities, pings and backfill.

Invariant: recorders, viewers and pings find what a running session would show a late joiner;
apart from identities, nothing is published in a site's name that the log does not hold.
Backfill covers messages already
played: a minute of them when the log is read during play (L6), all of them when it is
preloaded.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Collection
from contextlib import suppress

import msgspec
import numpy as np

from trilat_net.errors import WireError
from trilat_net.log.record_columns import Ints
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Query
from trilat_net.net.clock import Clock
from trilat_net.net.membership import (
    MemberQuery,
    describe_member,
    liveliness_token,
    read_messages,
)
from trilat_net.net.messages import Event
from trilat_net.net.pinging import answer_backfill, answer_pings
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES, BackfillRequest
from trilat_net.net.wire import decode, encode

from .batch import MessageBatch
from .session_reader import NUMBERS_OF_A_START, SessionHeader

_PlayedRun = tuple[Ints, Ints, MessageBatch]
"""Messages of one channel within one batch: their numbers, ascending, their places in it, and
the batch.
"""


class PlayedHistory:
    """Per channel the messages that were given to the player.

    Args:
        kept_ns: length of log that is kept, ns; None: everything.

    Attributes:
        next_numbers: per channel the number after that of its last played message.
    """

    def __init__(self, kept_ns: int | None = None) -> None:
        self.next_numbers: dict[int, int] = {}
        self._kept_ns = kept_ns
        self._runs: dict[int, deque[_PlayedRun]] = {}

    def add(self, batch: MessageBatch) -> None:
        """Adds messages that are about to be played, and drops the oldest."""
        for channel in np.unique(batch.channels).tolist():
            places = np.flatnonzero(batch.channels == channel)
            runs = self._runs.setdefault(channel, deque())
            runs.append((batch.numbers[places], places, batch))
            if self._kept_ns is not None:
                oldest_ns = int(batch.times_ns[-1]) - self._kept_ns
                while int(runs[0][2].times_ns[-1]) < oldest_ns:
                    runs.popleft()

    def clear(self) -> None:
        """Drops all messages, but not how many were played: another round begins."""
        self._runs.clear()

    def find_messages(self, channel: int, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns the number of the first message and the consecutive messages of one answer.

        Args:
            channel: the channel.
            first: number of the first one wanted; without a message of that number, the next
                one comes first.
            last: number of the last one wanted.
        """
        runs = list(self._runs.get(channel, ()))
        made = self.next_numbers.get(channel, 0)
        payloads: list[bytes] = []
        size = 0
        wanted = first
        begun = first
        for numbers, places, batch in runs[
            bisect_left(runs, first, key=lambda run: int(run[0][-1])) :
        ]:
            begin = int(np.searchsorted(numbers, wanted))
            part = slice(begin, begin + BACKFILL_MESSAGES + 1)
            for number, place in zip(
                numbers[part].tolist(), places[part].tolist(), strict=True
            ):
                if not payloads:
                    begun = wanted = max(first, min(number, made))
                if number < wanted:
                    continue  # a repeated number
                payload = batch.payload(place)
                size += len(payload)
                full = len(payloads) == BACKFILL_MESSAGES or (
                    payloads and size > BACKFILL_BYTES
                )
                if number > min(last, made - 1) or number > wanted or full:
                    return begun, payloads
                payloads.append(payload)
                wanted = number + 1
        return (begun if payloads or first >= made else made), payloads


REFRESH_NS = 500_000_000
"""Longest age of an encoded identity: it holds a whole scenario, which takes long to encode."""


class SiteStandIns:
    """The stand-ins for all sites of a session, and the recorders that listen.

    Attributes:
        refilled: number of messages given to recorders that had missed them.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        header: SessionHeader,
        history: PlayedHistory,
    ) -> None:
        self.recorders: set[str] = set()
        self.refilled = 0
        self._clock = clock
        self._header = header
        self._history = history
        self._stored: dict[str, set[str]] = {}
        self._met: set[str] = set()
        self._boots: dict[str, tuple[int, int]] = {}
        self._presence = bus.presence(topics.presence_key(session, topics.RECORDER))
        self._recorder_events = bus.inbox(
            topics.key(session, topics.RECORDER, topics.EVENT), 256
        )
        self._recorder_query = MemberQuery(bus, clock, session, topics.RECORDER)
        self._infos = {
            site: describe_member(
                site, boot, clock, header.scenario_text, fingerprint=header.fingerprint
            )
            for site, boot in header.boots.items()
        }
        self._encoded: dict[
            str, tuple[int, bytes]
        ] = {}  # per site its identity, and since when
        self._queries = {}
        for site, info in self._infos.items():
            keys = (
                topics.key(session, site, topics.INFO),
                topics.key(session, site, topics.PAST),
            )
            self._queries[site] = bus.query_inbox(keys[0]), bus.query_inbox(keys[1])
            answer_pings(bus, clock, session, info)
            bus.announce(liveliness_token(session, site, info.boot))

    def begin(self, epoch_mono_ns: int) -> None:
        """Shows the session as running, with tick 0 at an instant of the clock."""
        running = {
            "running": True,
            "epoch_mono_ns": epoch_mono_ns,
            "epoch_unix_ns": self._clock.unix_ns() + epoch_mono_ns - self._clock.monotonic_ns(),
            "boots": dict(self._header.boots),
        }
        self._infos = {
            site: msgspec.structs.replace(info, **running) for site, info in self._infos.items()
        }
        self._encoded.clear()

    def serve_queries(self) -> bool:
        """Answers identity queries, notes presence and events of recorders, and answers one
        backfill query.

        Returns:
            True if there was a backfill query.
        """
        for site, (identity_queries, _) in self._queries.items():
            while (query := identity_queries.poll()) is not None:
                query.reply(self._identity(site))
        for parts, alive in topics.read_presence(self._presence):
            (self.recorders.add if alive else self.recorders.discard)(parts.boot)
        for event in read_messages(self._recorder_events, Event):
            if event.kind == "stored":
                self._stored.setdefault(str(event.boot), set()).add(event.about)
        for site, (_, backfill_queries) in self._queries.items():
            query = backfill_queries.poll()
            if query is not None:
                self._answer_backfill(site, query)
                return True
        return False

    def _identity(self, site: str) -> bytes:
        encoded_ns, answer = self._encoded.get(site, (0, b""))
        now_ns = self._clock.monotonic_ns()
        if not answer or now_ns - encoded_ns >= REFRESH_NS:
            ticks = self._history.next_numbers.get(self._find_channel(site, topics.STATE), 0)
            answer = encode(msgspec.structs.replace(self._infos[site], ticks=ticks))
            self._encoded[site] = now_ns, answer
        return answer

    def are_recorders_listening(self) -> bool:
        """Asks the present recorders for their identities; True once all have answered."""
        self._met |= {str(info.boot) for info in self._recorder_query.poll()}
        return not self.recorders - self._met

    def have_stored(self, recorders: Collection[str]) -> bool:
        """True if all of these recorders have reported that they stored everything of every
        site.
        """
        return all(self._stored.get(boot, set()) >= self._infos.keys() for boot in recorders)

    def _find_channel(self, site: str, channel: str) -> int:
        topic = "/" + topics.key(self._header.session, site, channel)
        return self._header.topics.index(topic) if topic in self._header.topics else -1

    def _find_start(self, site: str) -> tuple[int, int]:
        """Returns which start of a site is played, from 0, and its boot: that of its newest
        event.
        """
        channel = self._find_channel(site, topics.EVENT)
        newest = self._history.next_numbers.get(channel, 0) - 1
        start = max(newest, 0) // NUMBERS_OF_A_START
        if start and self._boots.get(site, (0, 0))[0] != start:
            for payload in self._history.find_messages(channel, newest, newest)[1]:
                with suppress(WireError):
                    self._boots[site] = start, decode(payload, Event).boot
        first = 0, self._infos[site].boot
        return self._boots.get(site, first) if start else first

    def _answer_backfill(self, site: str, query: Query) -> None:
        start, boot = self._find_start(site)

        def find(wanted: BackfillRequest) -> tuple[int, list[bytes], int]:
            channel = self._find_channel(site, wanted.channel)
            before = start * NUMBERS_OF_A_START if wanted.channel == topics.EVENT else 0
            made = self._history.next_numbers.get(channel, 0) - before
            first, payloads = self._history.find_messages(
                channel, wanted.first + before, wanted.last + before
            )
            return max(first - before, 0), payloads, max(made, 0)

        self.refilled += answer_backfill(query, site, boot, find)

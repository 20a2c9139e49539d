"""Retransmission buffer of a site: recently published messages, for recorders that missed them.

Invariant (L6): bounded in memory, a minute of every channel, and in time, one chunk per request. The loop
answers in the slack of its ticks.
"""

from array import array

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.bus import Query, QueryInbox
from trilat_net.net.loop_stats import STATS_PER_SECOND
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES, Backfill, BackfillRequest
from trilat_net.net.wire import decode, encode

KEPT_S = 60
RECORDS_KEPT = 120_000
"""Most records that are kept: a minute up to 2 kHz, less above."""
RECORD_BYTES = 640
"""What a record takes on average, at most, for a minute of them to be kept."""
STATISTICS_BYTES = 4_096
EVENTS_KEPT, EVENTS_BYTES = 4_096, 4_000_000


class ChannelBuffer:
    """The last messages of one channel; their numbers are their places, from 0.

    They lie in one piece of memory that is there from the start: nothing is allocated while the loop runs.

    Args:
        capacity: how many it holds, at most.
        size_bytes: how many bytes of them, at most; more than one message has.

    Attributes:
        made: how many messages there have been.
        oldest: number of the oldest one that is left.
    """

    def __init__(self, capacity: int, size_bytes: int) -> None:
        self.made = self.oldest = 0
        self._capacity, self._size = capacity, size_bytes
        self._bytes = bytearray().ljust(size_bytes, b"\xff")  # touched, so that it stands in memory
        self._starts, self._lengths = array("q", bytes(8 * capacity)), array("q", bytes(8 * capacity))
        self._head = 0  # bytes written since the start, and those left out at the end of the memory

    def keep(self, payload: bytes) -> None:
        """Takes the next message; the oldest ones make room."""
        length, at = len(payload), self._head % self._size
        if at + length > self._size:  # a message lies in one piece
            self._head += self._size - at
            at = 0
        self._bytes[at : at + length] = payload
        slot = self.made % self._capacity
        self._starts[slot], self._lengths[slot] = self._head, length
        self._head += length
        self.made += 1
        self.oldest = max(self.oldest, self.made - self._capacity)
        while self._starts[self.oldest % self._capacity] < self._head - self._size:
            self.oldest += 1

    def chunk(self, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns messages from a number on, as many as one answer takes, and the number of the first.

        Args:
            first: number of the first one wanted; where it is gone, the oldest one that is left comes first.
            last: number of the last one wanted.
        """
        first = max(first, self.oldest)
        payloads: list[bytes] = []
        size = 0
        for number in range(first, min(last + 1, self.made, first + BACKFILL_MESSAGES)):
            slot = number % self._capacity
            at, length = self._starts[slot] % self._size, self._lengths[slot]
            size += length
            if payloads and size > BACKFILL_BYTES:
                break
            payloads.append(bytes(self._bytes[at : at + length]))
        return first, payloads


class RetransmitBuffer:
    """What a site can tell of its past.

    Args:
        site: its name.
        boot: its process start.
        rate_hz: its tick rate.
        questions: what it is asked.

    Attributes:
        rings: per channel its last messages.
    """

    def __init__(self, site: str, boot: int, rate_hz: int, questions: QueryInbox) -> None:
        self._site, self._boot, self._questions = site, boot, questions
        records, statistics = min(KEPT_S * rate_hz, RECORDS_KEPT), KEPT_S * STATS_PER_SECOND
        self.rings = {
            topics.STATE: ChannelBuffer(records, max(records * RECORD_BYTES, EVENTS_BYTES)),
            topics.LINK: ChannelBuffer(statistics, statistics * STATISTICS_BYTES),
            topics.EVENT: ChannelBuffer(EVENTS_KEPT, EVENTS_BYTES),
        }

    def answer(self) -> bool:
        """Answers the oldest question; False where there is none."""
        question = self._questions.poll()
        if question is not None:
            self._tell(question)
        return question is not None

    def _tell(self, question: Query) -> None:
        try:
            wanted = decode(question.payload, BackfillRequest)
        except WireError:
            return  # a stranger's: it gets no answer
        ring = self.rings[wanted.channel]
        first, payloads = ring.chunk(wanted.first, wanted.last)
        past = Backfill(
            member=self._site,
            boot=self._boot,
            channel=wanted.channel,
            first=first,
            payloads=payloads,
            made=ring.made,
        )
        question.answer(encode(past))

"""Retransmission buffer of a site: recently published messages, for recorders that missed them.

Invariant (L6): bounded in memory, a minute of every channel, and in time, one chunk per
request. The loop answers in the slack of its ticks.
"""

from array import array

from trilat_net.core.site_setup import Layout
from trilat_net.core.site_step import Site
from trilat_net.net import topics
from trilat_net.net.bus import QueryInbox
from trilat_net.net.pinging import answer_backfill
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES, BackfillRequest
from trilat_net.net.topics import STATS_PER_SECOND, count_messages, skipped_numbers

KEPT_S = 60
RECORDS_KEPT = 120_000
"""Capacity in records: a minute up to 2 kHz, less above."""
RECORD_BYTES = 640
"""Largest mean size of a record of two joints at which a minute of them is kept."""
FLOAT_BYTES = 9
STATISTICS_BYTES = 4_096
EVENTS_KEPT = 4_096
EVENTS_BYTES = 4_000_000


class ChannelBuffer:
    """The last messages of one channel; their numbers count from 0. `size_bytes` holds any one
    message.

    The memory is allocated at the start: nothing is allocated while the loop runs.
    """

    def __init__(self, capacity: int, size_bytes: int) -> None:
        self.made = self.oldest = 0
        self._capacity = capacity
        self._size = size_bytes
        self._bytes = bytearray().ljust(size_bytes, b"\xff")  # touched, so that the pages exist
        self._starts = array("q", bytes(8 * capacity))
        self._lengths = array("q", bytes(8 * capacity))
        self._head = (
            0  # bytes written since the start, with those skipped at the end of the memory
        )

    def begin_at(self, number: int) -> None:
        """Lets the first message have a number, before there is any."""
        self.made = self.oldest = number

    def keep(self, payload: bytes) -> None:
        """Adds the next message; drops the oldest ones to make room."""
        length = len(payload)
        at = self._head % self._size
        if at + length > self._size:  # a message is contiguous
            self._head += self._size - at
            at = 0
        self._bytes[at : at + length] = payload
        slot = self.made % self._capacity
        self._starts[slot] = self._head
        self._lengths[slot] = length
        self._head += length
        self.made += 1
        self.oldest = max(self.oldest, self.made - self._capacity)
        while self._starts[self.oldest % self._capacity] < self._head - self._size:
            self.oldest += 1

    def skip(self, count: int) -> None:
        """Adds numbers of messages that are never made: an empty one stands for each."""
        for _ in range(count):
            self.keep(b"")

    def chunk(self, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns the number of the first message and the messages of one answer, of those that
        are kept.
        """
        first = max(first, self.oldest)
        payloads: list[bytes] = []
        size = 0
        for number in range(first, min(last + 1, self.made, first + BACKFILL_MESSAGES)):
            slot = number % self._capacity
            at = self._starts[slot] % self._size
            length = self._lengths[slot]
            size += length
            if payloads and size > BACKFILL_BYTES:
                break
            payloads.append(bytes(self._bytes[at : at + length]))
        return first, payloads


class RetransmitBuffer:
    """The recently published messages of a site, by channel."""

    def __init__(self, site: Site, boot: int, queries: QueryInbox) -> None:
        self._site = site
        self._boot = boot
        self._queries = queries
        records = min(KEPT_S * site.rate_hz, RECORDS_KEPT)
        statistics = KEPT_S * STATS_PER_SECOND
        record_bytes = RECORD_BYTES + FLOAT_BYTES * (site.layout.floats - Layout().floats)
        self.channels = {
            topics.STATE: ChannelBuffer(records, max(records * record_bytes, EVENTS_BYTES)),
            topics.LINK: ChannelBuffer(statistics, statistics * STATISTICS_BYTES),
            topics.EVENT: ChannelBuffer(EVENTS_KEPT, EVENTS_BYTES),
        }

    def begin_at(self, tick: int) -> None:
        """Lets tick be the first one of the site."""
        self.channels[topics.STATE].begin_at(tick)
        self.channels[topics.LINK].begin_at(
            count_messages(topics.LINK, tick, self._site.rate_hz)
        )

    def skip(self, first: int, next_tick: int) -> None:
        """Adds the numbers of what a site never publishes that makes no ticks from one on, up
        to another.
        """
        self.channels[topics.STATE].skip(next_tick - first)
        ticks = next_tick, next_tick - first
        number, first_skipped = skipped_numbers(topics.LINK, *ticks, self._site.rate_hz)
        self.channels[topics.LINK].skip(max(0, number - first_skipped))

    def answer_query(self) -> bool:
        """Answers the oldest query; False without one."""
        query = self._queries.poll()
        if query is None:
            return False
        answer_backfill(query, self._site.name, self._boot, self._find)
        return True

    def _find(self, wanted: BackfillRequest) -> tuple[int, list[bytes], int]:
        buffer = self.channels[wanted.channel]
        return *buffer.chunk(wanted.first, wanted.last), buffer.made

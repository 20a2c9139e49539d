"""Retransmission buffer of a site: recent messages, for recorders that missed them.

Invariant (L6):
    - The memory is bounded: it holds at most a minute of every channel.
    - The time is bounded: each query is answered with one chunk, in the slack of a tick.
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
"""Capacity in records: a minute at rates up to 2 kHz, less at higher rates."""
RECORD_BYTES = 640
"""Mean size up to which a minute of records fits, for an arm of two joints."""
FLOAT_BYTES = 9
STATISTICS_BYTES = 4_096
EVENTS_KEPT = 4_096
EVENTS_BYTES = 4_000_000


class ChannelBuffer:
    """The last messages of one channel, numbered from 0 on.

    The memory is a ring that is allocated at the start: nothing is allocated while the loop
    runs.

    Args:
        capacity: the largest number of messages.
        size_bytes: the size of the memory; any single message must fit.

    Attributes:
        next_number: the number of the next message.
        oldest: the number of the oldest message that is kept.
    """

    def __init__(self, capacity: int, size_bytes: int) -> None:
        self.next_number = 0
        self.oldest = 0
        self._capacity = capacity
        self._size = size_bytes
        # Every byte is written once, so that the operating system maps all pages now.
        self._bytes = bytearray().ljust(size_bytes, b"\xff")
        self._starts = array("q", bytes(8 * capacity))
        self._lengths = array("q", bytes(8 * capacity))
        # Bytes written since the start, and those skipped at the end of the memory.
        self._head = 0

    def start_at(self, number: int) -> None:
        """Sets the number of the first message; the buffer must be empty."""
        self.next_number = number
        self.oldest = number

    def store(self, payload: bytes) -> None:
        """Adds the next message, and drops the oldest ones to make room."""
        length = len(payload)
        offset = self._head % self._size
        if offset + length > self._size:  # a message must be contiguous
            self._head += self._size - offset
            offset = 0
        self._bytes[offset : offset + length] = payload
        slot = self.next_number % self._capacity
        self._starts[slot] = self._head
        self._lengths[slot] = length
        self._head += length
        self.next_number += 1
        self.oldest = max(self.oldest, self.next_number - self._capacity)
        while self._starts[self.oldest % self._capacity] < self._head - self._size:
            self.oldest += 1

    def skip(self, count: int) -> None:
        """Adds `count` empty messages for numbers that the site never publishes."""
        for _ in range(count):
            self.store(b"")

    def read_chunk(self, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns the kept messages from `first` to `last`, as many as one reply can hold.

        Returns:
            The number of the first returned message, and the messages.
        """
        first = max(first, self.oldest)
        end = min(last + 1, self.next_number, first + BACKFILL_MESSAGES)
        payloads: list[bytes] = []
        size = 0
        for number in range(first, end):
            slot = number % self._capacity
            offset = self._starts[slot] % self._size
            length = self._lengths[slot]
            size += length
            if payloads and size > BACKFILL_BYTES:
                break
            payloads.append(bytes(self._bytes[offset : offset + length]))
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

    def start_at(self, tick: int) -> None:
        """Sets the first tick of the site."""
        link_number = count_messages(topics.LINK, tick, self._site.rate_hz)
        self.channels[topics.STATE].start_at(tick)
        self.channels[topics.LINK].start_at(link_number)

    def skip(self, first: int, next_tick: int) -> None:
        """Adds empty messages for the skipped ticks `first` to `next_tick` - 1."""
        self.channels[topics.STATE].skip(next_tick - first)
        number, first_skipped = skipped_numbers(
            topics.LINK, next_tick, next_tick - first, self._site.rate_hz
        )
        self.channels[topics.LINK].skip(max(0, number - first_skipped))

    def answer_query(self) -> bool:
        """Answers the oldest query; returns False if there is none."""
        query = self._queries.poll()
        if query is None:
            return False
        answer_backfill(query, self._site.name, self._boot, self._find_messages)
        return True

    def _find_messages(self, wanted: BackfillRequest) -> tuple[int, list[bytes], int]:
        buffer = self.channels[wanted.channel]
        first, payloads = buffer.read_chunk(wanted.first, wanted.last)
        return first, payloads, buffer.next_number

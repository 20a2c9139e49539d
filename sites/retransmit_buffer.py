"""Stores the recent messages of a site, and resends them to recorders that missed them.

A site publishes its state in every tick, and recorders write these messages to the log. If
messages are lost on the network, a recorder notices gaps in their numbers and queries the site
for the missing ones.

Invariant (law L6 of docs/develop/design.md):
    - Memory is bounded and allocated at the start. It holds at most one minute of every
      channel.
    - Computing time is bounded. The control loop answers one query at a time, with a limited
      number of messages, and only if there is time left in a tick.
"""

from array import array

from trilat_net.core import Site
from trilat_net.net import (
    BACKFILL_BYTES,
    BACKFILL_MESSAGES,
    STATS_PER_SECOND,
    BackfillRequest,
    QueryInbox,
    answer_backfill,
    count_messages,
    skipped_numbers,
    topics,
)
from trilat_net.records import Layout

KEPT_S = 60
"""Time for which messages are stored, in s."""
RECORDS_KEPT = 120_000
"""Maximum number of stored records: one minute at tick rates up to 2 kHz, less at higher rates.
"""
_RECORD_BYTES = 640
"""Mean record size of a two-joint arm, used to dimension the memory, in bytes."""
_FLOAT_BYTES = 9
"""Size of an encoded floating-point number, in bytes."""
_STATISTICS_BYTES = 4_096
"""Memory for one message with statistics, in bytes."""
EVENTS_KEPT = 4_096
"""Maximum number of stored events."""
_EVENTS_BYTES = 4_000_000
"""Memory for events, in bytes."""


class ChannelBuffer:
    """Stores the most recent messages of one channel, numbered consecutively.

    The messages are stored one after another in a ring of bytes that is allocated at the start,
    so no memory is allocated while the control loop is running. New messages overwrite the
    oldest ones.

    Args:
        capacity: Largest number of messages.
        size_bytes: Size of the memory, in bytes. It must be larger than any message.

    Attributes:
        next_number: Number of the next message.
        oldest: Number of the oldest message that is still stored.
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
        # Number of bytes written since the start, including those that were left unused at the
        # end of the ring. The position in the ring is this number modulo the size.
        self._head = 0

    def start_at(self, number: int) -> None:
        """Sets the number of the first message that will be stored.

        Needed for a site that joins a running session, whose first message does not have the
        number 0. May only be called while the buffer is empty.

        Args:
            number: Number of the first message.
        """
        self.next_number = number
        self.oldest = number

    def store(self, payload: bytes) -> None:
        """Stores a published message under the next number, so that it can be resent.

        If the buffer is full, the oldest messages are removed.

        Args:
            payload: The encoded message.
        """
        length = len(payload)
        offset = self._head % self._size
        if offset + length > self._size:
            # The message must be contiguous, but does not fit into the rest of the ring.
            # Therefore it is stored at the beginning.
            self._head += self._size - offset
            offset = 0
        self._bytes[offset : offset + length] = payload

        slot = self.next_number % self._capacity
        self._starts[slot] = self._head
        self._lengths[slot] = length
        self._head += length
        self.next_number += 1

        # Forget the messages whose slot or whose bytes have been overwritten.
        self.oldest = max(self.oldest, self.next_number - self._capacity)
        while self._starts[self.oldest % self._capacity] < self._head - self._size:
            self.oldest += 1

    def skip(self, count: int) -> None:
        """Stores empty messages for numbers under which the site publishes no message.

        Message numbers follow the ticks, and a skipped tick has no message. Without empty
        messages in their place, all later messages would get wrong numbers.

        Args:
            count: Number of empty messages.
        """
        for _ in range(count):
            self.store(b"")

    def read_chunk(self, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns as many consecutive stored messages as fit into one network reply.

        The recorder sends another request for the messages that do not fit.

        Args:
            first: Number of the first requested message. If it is no longer stored, the reply
                starts with the oldest stored message.
            last: Number of the last requested message.

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
    """Stores the recent messages of a site, and answers recorders' queries for lost ones.

    If a message is lost on the network, the recorder notices the gap in the numbers and asks
    the site to send the message again.

    Args:
        site: The site in the simulation kernel.
        boot: Random number that identifies this start of the site.
        queries: Queue of the queries.

    Attributes:
        channels: Mapping from channel (records, statistics and events) to its stored messages.
    """

    def __init__(self, site: Site, boot: int, queries: QueryInbox) -> None:
        self._site = site
        self._boot = boot
        self._queries = queries
        records = min(KEPT_S * site.rate_hz, RECORDS_KEPT)
        statistics = KEPT_S * STATS_PER_SECOND
        # A record of an arm with more than two joints contains more numbers.
        record_bytes = _RECORD_BYTES + _FLOAT_BYTES * (site.layout.floats - Layout().floats)
        self.channels = {
            topics.STATE: ChannelBuffer(records, max(records * record_bytes, _EVENTS_BYTES)),
            topics.LINK: ChannelBuffer(statistics, statistics * _STATISTICS_BYTES),
            topics.EVENT: ChannelBuffer(EVENTS_KEPT, _EVENTS_BYTES),
        }

    def start_at(self, tick: int) -> None:
        """Sets the first tick of a site that joins a running session.

        Records and statistics are then numbered from this tick. Must be called before any
        message is stored.

        Args:
            tick: Number of the first tick.
        """
        link_number = count_messages(topics.LINK, tick, self._site.rate_hz)
        self.channels[topics.STATE].start_at(tick)
        self.channels[topics.LINK].start_at(link_number)

    def skip(self, first: int, next_tick: int) -> None:
        """Adds an empty message for each message that the skipped ticks would have published.

        The number of a message follows from its tick: a record (channel `STATE`) has the number
        of its tick, and statistics (channel `LINK`), which are published several times per
        second, are numbered from 0. Without the empty messages, later messages would be stored
        under wrong numbers.

        Args:
            first: First skipped tick.
            next_tick: First tick after the skipped ones.
        """
        skipped_ticks = next_tick - first
        self.channels[topics.STATE].skip(skipped_ticks)

        next_statistics_number, published_statistics = skipped_numbers(
            topics.LINK, next_tick, skipped_ticks, self._site.rate_hz
        )
        # Statistics are numbered from 0, so this difference is their number in the skipped
        # ticks.
        unpublished_statistics = max(0, next_statistics_number - published_statistics)
        self.channels[topics.LINK].skip(unpublished_statistics)

    def answer_query(self) -> bool:
        """Answers the oldest request from a recorder for messages that it has missed.

        Each call answers only one request, so that many requests do not delay the control loop.

        Returns:
            True if a query was answered, or False if no query was waiting.
        """
        query = self._queries.poll()
        if query is None:
            return False
        answer_backfill(query, self._site.name, self._boot, self._find_messages)
        return True

    def _find_messages(self, wanted: BackfillRequest) -> tuple[int, list[bytes], int]:
        """Looks up the stored messages that a recorder has missed and now requests.

        Args:
            wanted: The request, with the channel and the numbers of the missing messages.
        """
        buffer = self.channels[wanted.channel]
        first, payloads = buffer.read_chunk(wanted.first, wanted.last)
        return first, payloads, buffer.next_number

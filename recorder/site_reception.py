"""Receive the messages of a recorder: one bounded queue, and per site the received messages.

`InboundQueue` holds the messages between the bus and the writer. `SiteReception` decodes the
messages of one site, checks them, and keeps the accounts that tell which messages are missing.

Invariant (L6):
    - The queue is bounded in messages and in bytes. Each key has a share of the bytes, so that
      a flood of messages from one member does not displace the messages of other members.
      Messages that do not fit are counted and reported.
    - A message counts only if it can be decoded, is of this site and of this start, and has a
      number that the scenario and the clock allow.
    - A message may imply that other messages exist. Records and statistics are as many as the
      scenario has ticks, and a message of a tick in the future is refused.
    - Events are accepted up to a number of bytes, and the first end event is accepted even
      beyond that.
"""

import math
import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from trilat_net.errors import WireError, count_nouns
from trilat_net.log.accounting import Account, StartGap
from trilat_net.log.log_layout import CHANNEL_TYPES, SITE_CHANNELS
from trilat_net.net import topics
from trilat_net.net.clock import Clock
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.requests import Backfill
from trilat_net.net.topics import (
    count_messages,
    count_under_way,
    number_message,
    skipped_numbers,
)
from trilat_net.net.wire import make_decoder
from trilat_net.scenario import Scenario
from trilat_net.scenario.run_changes import count_skipped_ticks

CAPACITY = 60_000
"""Capacity of the queue in messages: minutes of three sites at 1 kHz, whose records come in
blocks.
"""
CAPACITY_BYTES = 96 << 20
"""Capacity of the queue in bytes."""
KEY_BYTES = 32 << 20
"""Capacity in bytes for the messages of one key. A planar arm at 1 kHz sends half a megabyte
per second.
"""
OVERHEAD_BYTES = 200
"""Memory of a message besides its payload, bytes."""
KEYS = 1_000
"""Largest number of keys that are counted separately; further keys share one count."""
_OTHER_KEYS = "others"
"""Under this name all keys beyond `KEYS` are counted."""


class InboundMessage(NamedTuple):
    """A received message.

    Attributes:
        key: the key under which the message was published.
        payload: the bytes of the message.
        mono_ns: time of arrival on the monotonic clock, ns.
    """

    key: str
    payload: bytes
    mono_ns: int


class InboundQueue:
    """A bounded queue between the threads of the bus and the thread of the writer.

    Args:
        clock: stamps the messages.

    Attributes:
        overflowed: number of messages that did not fit, by key.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._queue: deque[InboundMessage] = deque()
        # each counter is written by one side only, so the sides need no common lock
        self._received_bytes = Counter[str]()
        self._drained_bytes = Counter[str]()
        self._total_received_bytes = 0
        self._total_drained_bytes = 0
        self._receive_lock = threading.Lock()  # a bus may have several threads
        self.overflowed: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._queue)

    def receive(self, key: str, payload: bytes) -> None:
        """Stamps a message and appends it, or counts it as overflowed. The bus calls this."""
        size = len(payload) + OVERHEAD_BYTES
        with self._receive_lock:
            counted_key = key
            if key not in self._received_bytes and len(self._received_bytes) >= KEYS:
                counted_key = _OTHER_KEYS
            waiting = self._total_received_bytes - self._total_drained_bytes
            key_waiting = self._received_bytes[counted_key] - self._drained_bytes[counted_key]
            is_full = len(self._queue) >= CAPACITY or waiting >= CAPACITY_BYTES
            if is_full or key_waiting >= KEY_BYTES:
                self.overflowed[counted_key] += 1
                return
            self._received_bytes[counted_key] += size
            self._total_received_bytes += size
            self._queue.append(InboundMessage(key, payload, self._clock.monotonic_ns()))

    def drain(self, until_ns: int | None = None) -> Iterator[InboundMessage]:
        """Removes waiting messages from the queue and yields them, oldest first.

        Args:
            until_ns: messages that arrived after this time stay; None: no message stays.
        """
        queue = self._queue
        while queue and (until_ns is None or queue[0].mono_ns <= until_ns):
            message = queue.popleft()
            size = len(message.payload) + OVERHEAD_BYTES
            is_counted = message.key in self._received_bytes
            counted_key = message.key if is_counted else _OTHER_KEYS
            self._drained_bytes[counted_key] += size
            self._total_drained_bytes += size
            yield message


CHANNEL_NOUNS = {topics.STATE: "records", topics.LINK: "statistics", topics.EVENT: "events"}
_LEAD_NS = 2_000_000_000
_DRIFT = 1e-3
"""The clock of a site may be ahead of the recorder's clock by `_LEAD_NS`, and by this share of
the session's time.
"""
EVENT_BYTES = 512 << 10
EVENT_BYTES_PER_S = 4 << 10
"""Bytes of a site's events that a log accepts at all, and per second of the scenario (ten
events per second).
"""
_LEAST_EVENT_BYTES = 128
"""Smallest size of an event, bytes."""


class SiteMessage(NamedTuple):
    """A decoded message of a site.

    Attributes:
        number: number of the message in its channel; -1 without a number.
        sequence: tick of a record or of statistics; number of an event.
        t_ns: time of sending, ns since the epoch on the sender's clock; negative before the
            epoch.
        content: the message.
    """

    number: int
    sequence: int
    t_ns: int
    content: State | LinkStats | Event


class SiteReception:
    """The messages received from one start of a site, and the accounts of missing messages.

    Args:
        scenario: the scenario of the session.
        name: name of the site.
        boot: number of the start; None if the site has not started yet.
        before: the reception of the previous start, whose ticks this start continues.

    Attributes:
        name: name of the site.
        accounts: account of the messages of each channel. Records and statistics are counted
            over all starts, events begin at 0 with every start.
        event_accounts: accounts of the events of previous starts.
        final_ticks: number of ticks of the site, from its end event; None before that event.
        last_received_ns: arrival of the last message on the recorder's clock, ns; None before
            the first message.
        since_ns: present time since the epoch on the recorder's clock, ns. Messages of later
            ticks are refused.
        period_ns: tick period of the site, ns.
    """

    def __init__(
        self,
        scenario: Scenario,
        name: str,
        boot: int | None,
        before: "SiteReception | None" = None,
    ) -> None:
        self.name = name
        self._before = before
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self.event_accounts: tuple[Account, ...] = ()
        self.since_ns: float = math.inf
        if before is not None:
            self.accounts = {**before.accounts, topics.EVENT: Account()}
            self.event_accounts = (*before.event_accounts, before.accounts[topics.EVENT])
            self.since_ns = before.since_ns
        self.final_ticks: int | None = None
        self.last_received_ns: int | None = None
        self._boot = boot
        self._ticks = scenario.ticks(name)
        self._rate_hz = scenario.sites[name].rate_hz
        self.period_ns = 1_000_000_000 // self._rate_hz
        layout = scenario.layout(name)
        self._decoders = {
            channel: make_decoder(CHANNEL_TYPES[channel], layout=layout)
            for channel in SITE_CHANNELS
        }
        self._start_gaps = {
            channel: StartGap(self.accounts[channel], count_under_way(channel, self._rate_hz))
            for channel in (topics.STATE, topics.LINK)
        }
        self._event_bytes_left = EVENT_BYTES + round(EVENT_BYTES_PER_S * scenario.duration_s)
        self._largest_counts = {
            channel: count_messages(channel, self._ticks, self._rate_hz)
            for channel in SITE_CHANNELS
        }
        self._largest_counts[topics.EVENT] = self._event_bytes_left // _LEAST_EVENT_BYTES

    def read(self, channel: str, payload: bytes) -> SiteMessage:
        """Decodes and checks a payload, without counting the message.

        Raises:
            WireError: the payload is not a valid message of this channel of the site.
        """
        if channel == topics.EVENT:
            return self._read_event(payload)
        content = self._decoders[channel](payload)
        number = number_message(channel, content.tick, self._rate_hz)
        sent_ns = content.sent_ns if channel == topics.STATE else content.t_ns
        self._check(
            channel=channel,
            sender=content.site,
            boot=content.boot,
            number=number,
            ticks=content.tick + 1,
        )
        return SiteMessage(number, content.tick, sent_ns, content)

    def _read_event(self, payload: bytes) -> SiteMessage:
        event: Event = self._decoders[topics.EVENT](payload)
        if event.kind == "end" and not 0 <= event.ticks <= self._ticks:
            raise WireError(
                "out of range",
                f"{self.name} says it made {count_nouns(event.ticks, 'tick')}",
            )
        self._check(
            channel=topics.EVENT,
            sender=event.member,
            boot=event.boot,
            number=event.n,
            ticks=event.ticks if event.kind in ("join", "end") else 0,
        )
        self._reserve_event_bytes(event, len(payload))
        return SiteMessage(event.n, event.n, event.t_ns, event)

    def _check(self, channel: str, sender: str, boot: int, number: int, ticks: int) -> None:
        """Refuses a message of another sender, an impossible number, or ticks in the future.

        Args:
            channel: channel of the message.
            sender: name of the site that the message states.
            boot: number of the start that the message states.
            number: number of the message in its channel.
            ticks: number of ticks that the site has executed if the message is true.
        """
        if sender != self.name or boot != self._boot:
            raise WireError("stranger", f"{sender}, start {boot}, on a key of {self.name}")
        if number >= self._largest_counts[channel]:
            raise WireError("out of range", f"{self.name}/{channel} number {number}")
        if ticks > self._possible_ticks:
            raise WireError(f"{self.name} is ahead of the clock", f"{channel} number {number}")

    def accept_records(
        self, payloads: Iterable[bytes], received_ns: int
    ) -> Iterator[tuple[bytes, State]]:
        """Counts the published records of one block, and yields records that are new.

        This does the work of `read` and `accept` for many records at once.

        Args:
            payloads: the records.
            received_ns: arrival of the block on the recorder's clock, ns.

        Raises:
            WireError: a payload is not a record of this site; the records before it count.
        """
        decode = self._decoders[topics.STATE]
        account = self.accounts[topics.STATE]
        name = self.name
        boot = self._boot
        possible_ticks = self._possible_ticks
        for payload in payloads:
            record: State = decode(payload)
            tick = record.tick
            if tick >= possible_ticks or record.site != name or record.boot != boot:
                self._check(
                    channel=topics.STATE,
                    sender=record.site,
                    boot=record.boot,
                    number=tick,
                    ticks=tick + 1,
                )
            self.last_received_ns = received_ns
            is_new = account.receive(tick, received_ns)
            if record.cmd:
                self._count_implied(record)
            if is_new:
                yield payload, record

    @property
    def _possible_ticks(self) -> int:
        """Largest number of ticks that the site can have executed by now."""
        latest_ns = self.since_ns * (1.0 + _DRIFT) + _LEAD_NS
        return int(min(self._ticks, latest_ns * 1e-9 * self._rate_hz + 1.0))

    def _reserve_event_bytes(self, event: Event, size: int) -> None:
        """Refuses events of a flood, which would fill the log with events alone."""
        is_first_end = event.kind == "end" and self.final_ticks is None
        is_exempt = is_first_end and size <= EVENT_BYTES_PER_S
        if size > self._event_bytes_left and not is_exempt:
            raise WireError(
                "flood of events", f"{self.name} sent more than a log takes of one site"
            )
        self._event_bytes_left -= size

    def accept(self, channel: str, message: SiteMessage, received_ns: int) -> bool:
        """Counts a published message.

        Returns:
            True if the message is new; False if it is a duplicate.
        """
        self.last_received_ns = received_ns
        account = self.accounts[channel]
        is_new = message.number < 0 or account.receive(message.number, received_ns)
        self._count_implied(message.content)
        return is_new

    def refill(self, channel: str, message: SiteMessage) -> bool:
        """Counts a backfilled message.

        Returns:
            True if the message is new; False if it is a duplicate.
        """
        is_new = self.accounts[channel].refill(message.number)
        self._count_implied(message.content)
        return is_new

    def check_sender(self, reply: Backfill) -> None:
        """Refuses a reply that does not come from this start of the site.

        Raises:
            WireError: the reply comes from another site or start.
        """
        if reply.member != self.name or reply.boot != self._boot:
            raise WireError(
                "stranger", f"{reply.member}, start {reply.boot}, answers for {self.name}"
            )

    def add_expected(self, channel: str, count: int) -> None:
        """Raises the number of messages of a channel that exist at least.

        The scenario and the clock limit that number.
        """
        largest = self._largest_counts[channel]
        if channel != topics.EVENT:
            possible = count_messages(channel, self._possible_ticks, self._rate_hz)
            largest = min(largest, possible)
        self.accounts[channel].add_expected(min(count, largest))

    def count_previous_start(self, ticks: int) -> None:
        """Counts the messages of the previous start, of which another site knows.

        Args:
            ticks: number of ticks of the previous start that the other site knows.
        """
        for channel, gap in self._start_gaps.items():
            gap.note_published(number_message(channel, ticks, self._rate_hz))

    def _count_implied(self, content: State | LinkStats | Event) -> None:
        """Counts the messages that must exist, or that cannot exist, because of a message."""
        if isinstance(content, State):
            self._exclude_skipped_ticks(content)
        elif isinstance(content, LinkStats):
            self.add_expected(topics.STATE, content.tick + 1)
        elif content.kind == "join":
            self._begin_start(content.ticks)
        elif content.kind == "end":
            self.final_ticks = content.ticks
            for channel in (topics.STATE, topics.LINK):
                count = count_messages(channel, content.ticks, self._rate_hz)
                self.add_expected(channel, count)

    def _exclude_skipped_ticks(self, record: State) -> None:
        """Excludes the messages of the ticks that the site skipped before a record."""
        skipped = count_skipped_ticks(record.cmd) if record.cmd else 0
        if not skipped:
            return
        for channel in (topics.STATE, topics.LINK):
            numbers = skipped_numbers(channel, record.tick, skipped, self._rate_hz)
            self.accounts[channel].mark_unpublished(*numbers)

    def _begin_start(self, first_tick: int) -> None:
        """Excludes the messages of the ticks between the previous start and this start."""
        previous_ticks = 0
        if self._before is not None and self._before.final_ticks is not None:
            previous_ticks = self._before.final_ticks
        for channel, gap in self._start_gaps.items():
            first = count_messages(channel, first_tick, self._rate_hz)
            published = count_messages(channel, previous_ticks, self._rate_hz)
            gap.begin_next_start(first, published)

    @property
    def lacks_messages(self) -> bool:
        """True while a message is missing that the site can still send again."""
        return any(account.find_requestable_gap() for account in self.accounts.values())

    @property
    def is_complete(self) -> bool:
        """True once the site has ended and can send no missing message again."""
        return self.final_ticks is not None and not self.lacks_messages

    def give_up(self) -> None:
        """Counts all missing messages as lost for good."""
        for account in self.accounts.values():
            account.abandon_below(account.last + 1)

    def describe_missing(self) -> str:
        """Returns the missing messages as text; "" if no message is missing."""
        texts = []
        for channel, account in self.accounts.items():
            if account.missing:
                counts = f"{account.missing} of {account.expected} {CHANNEL_NOUNS[channel]}"
                texts.append(f"{counts} ({' '.join(account.format_gaps(5))})")
        return ", ".join(texts)

"""Receives the messages of a session, checks them, and determines which are missing.

The recorder must neither lose messages in a burst nor trust a faulty sender. `InboundQueue`
holds the messages between the network threads and the thread that writes the log.
`SiteReception` decodes, checks and counts the messages of one site.

Invariant:
    - The queue is bounded in messages and in bytes. The bytes of each sender's channel are
      bounded too, so that a sender with too many messages does not displace the messages of
      others. Messages for which there is no space are counted and reported.
    - A message is accepted only if it can be decoded, names the right site and the right start
      of its process, and has a number that the site can have reached by now.
    - A message may imply that earlier messages exist. The number of records and statistics
      expected as a result is limited by the duration of the scenario. A message from the future
      is rejected.
    - The events of a site are accepted up to a number of bytes. The first event "end", with
      which a site reports that it has ended, is accepted even beyond that limit.
"""

import math
import threading
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

from trilat_net.errors import WireError, count_nouns
from trilat_net.log import (
    CHANNEL_TYPES,
    SITE_CHANNELS,
    Account,
    SessionScenario,
    StartGap,
    count_skipped_ticks,
)
from trilat_net.net import (
    Backfill,
    Clock,
    Event,
    LinkStats,
    State,
    count_messages,
    count_under_way,
    decode,
    make_decoder,
    number_message,
    skipped_numbers,
    split_states,
    topics,
)

AWAY_NS = 15_000_000_000
"""Time to wait for a site that disappeared without an "end" event, in ns.

Its link may have been cut and may recover.
"""
CAPACITY = 60_000
"""Maximum number of messages in the queue, enough for minutes of three sites at 1 kHz, which
send their records in blocks.
"""
CAPACITY_BYTES = 96 << 20
"""Maximum size of the queue, in bytes."""
KEY_BYTES = 32 << 20
"""Maximum total size of the queued messages of one key, in bytes. A planar arm at 1 kHz sends
half a megabyte per second.
"""
_OVERHEAD_BYTES = 200
"""Memory used by a queued message in addition to its payload, in bytes."""
KEYS = 1_000
"""Maximum number of keys that are counted separately. All further keys are counted together."""
_OTHER_KEYS = "others"
"""Name under which the keys beyond `KEYS` are counted."""


class _InboundMessage(NamedTuple):
    """A network message in the recorder's queue that has not been decoded or logged yet.

    Attributes:
        key: Key under which the message was published. It names the session, the member and the
            channel.
        payload: Bytes of the message.
        mono_ns: Time of the arrival on the monotonic clock, in ns.
    """

    key: str
    payload: bytes
    mono_ns: int


class InboundQueue:
    """Bounded queue of messages between the network threads and the writing thread.

    Messages wait here while the disk is slow. If the queue is full, a message is dropped and
    counted, because an unbounded queue could exhaust the memory.

    Args:
        clock: Clock that determines the times of arrival.

    Attributes:
        overflowed: Mapping from key to the number of messages that were dropped because the
            queue was full.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._queue: deque[_InboundMessage] = deque()
        # The threads of the network write the counters of received bytes, and the other thread
        # those of drained bytes. Therefore they need no common lock.
        self._received_bytes = Counter[str]()
        self._drained_bytes = Counter[str]()
        self._total_received_bytes = 0
        self._total_drained_bytes = 0
        # The network may have several threads.
        self._receive_lock = threading.Lock()
        self.overflowed: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._queue)

    def receive(self, key: str, payload: bytes) -> None:
        """Adds a message to the queue with its time of arrival, if there is space.

        Called in the network threads. The bytes of each key are limited, so that one sender
        cannot fill the queue.

        Args:
            key: Key under which the message was published.
            payload: Bytes of the message.
        """
        size = len(payload) + _OVERHEAD_BYTES
        with self._receive_lock:
            # The number of counted keys is limited too. Further keys share one counter.
            counted_key = key
            if key not in self._received_bytes and len(self._received_bytes) >= KEYS:
                counted_key = _OTHER_KEYS

            waiting_bytes = self._total_received_bytes - self._total_drained_bytes
            key_bytes = self._received_bytes[counted_key] - self._drained_bytes[counted_key]
            is_full = len(self._queue) >= CAPACITY or waiting_bytes >= CAPACITY_BYTES
            if is_full or key_bytes >= KEY_BYTES:
                self.overflowed[counted_key] += 1
                return
            self._received_bytes[counted_key] += size
            self._total_received_bytes += size
            self._queue.append(_InboundMessage(key, payload, self._clock.monotonic_ns()))

    def drain(self, until_ns: int | None = None) -> Iterator[_InboundMessage]:
        """Removes messages from the queue, so that they can be written.

        Called in the thread that writes the log, while the network threads fill the queue.

        Args:
            until_ns: Messages that arrived after this time stay in the queue, in ns on the
                monotonic clock. If None, all messages are removed.

        Yields:
            The messages, oldest first.
        """
        queue = self._queue
        while queue and (until_ns is None or queue[0].mono_ns <= until_ns):
            message = queue.popleft()
            size = len(message.payload) + _OVERHEAD_BYTES
            is_counted = message.key in self._received_bytes
            counted_key = message.key if is_counted else _OTHER_KEYS
            self._drained_bytes[counted_key] += size
            self._total_drained_bytes += size
            yield message


_CHANNEL_NOUNS = {topics.STATE: "records", topics.LINK: "statistics", topics.EVENT: "events"}
"""Noun for the messages of each channel, used in sentences for the user."""
_LEAD_NS = 2_000_000_000
_DRIFT = 1e-3
"""Fraction of the time since the start of the session by which a site's clock may be ahead of
the recorder's clock, in addition to `_LEAD_NS`.
"""
EVENT_BYTES = 512 << 10
_EVENT_BYTES_PER_S = 4 << 10
"""Additional bytes of events that a log accepts from a site per second of the scenario, beyond
`EVENT_BYTES`. This is enough for about ten events.
"""
_LEAST_EVENT_BYTES = 128
"""Minimum size of an event, in bytes."""


class SiteMessage(NamedTuple):
    """A decoded message from a site, with the numbers under which the log stores it.

    Attributes:
        number: Number of the message in its channel. -1 for an event without a number.
        sequence: Sequence number in the log: the tick of a record or of statistics, or the
            number of an event.
        t_ns: Sending time relative to the start of the session, on the sender's clock, in ns.
            Negative before the start.
        content: The decoded message.
    """

    number: int
    sequence: int
    t_ns: int
    content: State | LinkStats | Event


class SiteReception:
    """Receives the messages from one start of a site, and counts the missing ones.

    If the site is restarted, a new object is created, which continues the counts of the
    previous one.

    Args:
        scenario: Scenario of the session.
        name: Name of the site.
        boot: Random number that identifies the start. None if the site has not appeared yet.
        before: Object for the previous start of the site. None for the first start.

    Attributes:
        name: Name of the site.
        accounts: Counts of the messages of each channel. Records and statistics are counted
            across all starts, whereas the count of events begins at 0 with every start.
        event_accounts: Counts of the events of the previous starts.
        skipped_ticks: Number of ticks that the site skipped, over all starts. They are counted
            as unpublished in the account of the records.
        final_ticks: Number of ticks that the site executed. None until its "end" event arrives.
        last_received_ns: Arrival of the last message on the monotonic clock, in ns. None before
            the first message.
        since_ns: Present time relative to the start of the session, on the recorder's clock, in
            ns. Set by the caller. Messages of later ticks are rejected.
        period_ns: Tick period of the site, in ns.
    """

    def __init__(
        self,
        scenario: SessionScenario,
        name: str,
        boot: int | None,
        before: "SiteReception | None" = None,
    ) -> None:
        self.name = name
        self._before = before
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self.event_accounts: tuple[Account, ...] = ()
        self.skipped_ticks = 0
        self.since_ns: float = math.inf

        if before is not None:
            self.accounts = {**before.accounts, topics.EVENT: Account()}
            self.event_accounts = (*before.event_accounts, before.accounts[topics.EVENT])
            self.skipped_ticks = before.skipped_ticks
            self.since_ns = before.since_ns

        self.final_ticks: int | None = None
        self.last_received_ns: int | None = None
        self._boot = boot
        self._may_return = scenario.sites_may_return
        self._ticks = scenario.ticks(name)
        self._rate_hz = scenario.sites[name].rate_hz
        self.period_ns = 1_000_000_000 // self._rate_hz

        layout = scenario.layout(name)
        self._decoders = {
            channel: make_decoder(CHANNEL_TYPES[channel], layout=layout)
            for channel in SITE_CHANNELS
        }
        # Gap between the previous start and this one, by channel.
        self._start_gaps = {
            channel: StartGap(self.accounts[channel], count_under_way(channel, self._rate_hz))
            for channel in (topics.STATE, topics.LINK)
        }

        self._event_bytes_left = EVENT_BYTES + round(_EVENT_BYTES_PER_S * scenario.duration_s)
        self._largest_counts = {
            channel: count_messages(channel, self._ticks, self._rate_hz)
            for channel in SITE_CHANNELS
        }
        self._largest_counts[topics.EVENT] = self._event_bytes_left // _LEAST_EVENT_BYTES

    def split(self, channel: str, block: bytes) -> Iterable[bytes]:
        """Splits the bytes that arrived on a channel into the payloads of single messages.

        A block on the channel of records contains several records.

        Args:
            channel: Name of the channel.
            block: The bytes.
        """
        return split_states(block) if channel == topics.STATE else (block,)

    def read(self, channel: str, payload: bytes) -> SiteMessage:
        """Decodes a message from a site and checks its sender and number, without counting it.

        The message is written to the log only if this method accepts it.

        Args:
            channel: Name of the channel on which the message arrived.
            payload: Bytes of the message.

        Returns:
            The decoded message with its number. Pass it to `accept` or `refill` to count it.

        Raises:
            WireError: The payload is not a valid message from this site on this channel.
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
        """Decodes and checks an event, and subtracts its size from the allowed bytes.

        The total size of a site's events is limited, so that a faulty sender cannot fill the
        disk.

        Raises:
            WireError: The payload is not a valid event of this site, or there were too many.
        """
        event: Event = self._decoders[topics.EVENT](payload)
        if event.kind == "end" and not 0 <= event.ticks <= self._ticks:
            raise WireError(
                "out of range",
                f"{self.name} reports {count_nouns(event.ticks, 'tick')}, but must report 0 to "
                f"{self._ticks}",
            )

        # Only these two events state how many ticks the site has executed.
        stated_ticks = event.ticks if event.kind in ("join", "end") else 0
        self._check(
            channel=topics.EVENT,
            sender=event.member,
            boot=event.boot,
            number=event.n,
            ticks=stated_ticks,
        )
        self._reserve_event_bytes(event, len(payload))
        return SiteMessage(event.n, event.n, event.t_ns, event)

    def find_new_boot(self, payload: bytes, kinds: Collection[str]) -> int | None:
        """Returns the boot of the next start of the site, if an event announces this start.

        Each start of a site is identified by a random number, its boot. Messages with an
        unknown boot are rejected until an event announces that the new process exists.

        Args:
            payload: The encoded event.
            kinds: Kinds of events that announce a start: "coming" before the site has been
                admitted to the session, "join" afterwards.

        Returns:
            The boot, or None if the event announces no start of this site, or if sites may not
            return to the session.

        Raises:
            WireError: The message is not an event.
        """
        event = decode(payload, Event)
        is_announcement = event.kind in kinds and event.member == self.name
        names_own_boot = event.boots.get(self.name) == event.boot
        return event.boot if is_announcement and names_own_boot and self._may_return else None

    def _check(self, channel: str, sender: str, boot: int, number: int, ticks: int) -> None:
        """Raises WireError if a message is from another sender or start, or implausible.

        A site that was restarted has a new start, and messages from its earlier process must no
        longer be accepted. A number that is too large would make the recorder request messages
        that do not exist.

        Args:
            channel: Channel of the message.
            sender: Name of the site stated in the message.
            boot: Number that identifies the sender's start, as stated in the message.
            number: Number of the message in its channel.
            ticks: Number of ticks that the site has executed according to the message.

        Raises:
            WireError: The message comes from a different sender or start, its number is too
                large, or its ticks lie in the future.
        """
        if sender != self.name or boot != self._boot:
            raise WireError(
                "stranger", f"{sender} (start {boot}) sent a message under a key of {self.name}"
            )
        if number >= self._largest_counts[channel]:
            raise WireError(
                "out of range", f"number {number} of {self.name}/{channel} is too large"
            )
        if ticks > self._possible_ticks:
            raise WireError(
                f"{self.name} is ahead of the clock",
                f"message {number} of {channel} is from the future",
            )

    def accept_records(
        self, payloads: Iterable[bytes], received_ns: int
    ) -> Iterator[tuple[bytes, State]]:
        """Decodes, checks and counts records from the site that arrived together in one block.

        A record is valid if it names this site, the right boot (the random number that
        identifies the start of the site), and a tick that the site can have reached by now.
        Each valid record is counted by its number, which is that of its tick, so gaps show
        which records are missing.

        At 1 kHz, this loop processes a thousand records per second and site. For speed, it
        reads attributes only once, and compares the values itself instead of calling `_check`
        for each record.

        Args:
            payloads: The encoded records, in the order of sending.
            received_ns: Arrival of the block on the monotonic clock, in ns.

        Yields:
            The encoded and the decoded record, for each record that was not received before.

        Raises:
            WireError: A payload is not a valid record of this site. The records before it have
                been counted.
        """
        decode_record = self._decoders[topics.STATE]
        account = self.accounts[topics.STATE]
        name = self.name
        boot = self._boot
        possible_ticks = self._possible_ticks
        for payload in payloads:
            record: State = decode_record(payload)
            tick = record.tick
            if tick >= possible_ticks or record.site != name or record.boot != boot:
                # Determines which condition the record violates, and raises the error.
                self._check(
                    channel=topics.STATE,
                    sender=record.site,
                    boot=record.boot,
                    number=tick,
                    ticks=tick + 1,
                )
            self.last_received_ns = received_ns
            is_new = account.receive(tick, received_ns)
            # The field `cmd` lists changes of the run. One of them may state that the site
            # skipped ticks, for which no records exist. It is empty in most records.
            if record.cmd:
                self._count_implied(record)
            if is_new:
                yield payload, record

    @property
    def _possible_ticks(self) -> int:
        """Largest number of ticks that the site can have executed by now.

        The time since its start is extended by the tolerated drift and lead of its clock. A
        message with a later tick is rejected, because it would make all earlier ticks count as
        missing.
        """
        latest_ns = self.since_ns * (1.0 + _DRIFT) + _LEAD_NS
        return int(min(self._ticks, latest_ns * 1e-9 * self._rate_hz + 1.0))

    def _reserve_event_bytes(self, event: Event, size: int) -> None:
        """Limits how many bytes of events one site may add to the log.

        Otherwise, a faulty site could fill the disk. The size of each event is subtracted from
        the remaining bytes.

        Args:
            event: The event.
            size: Size of the event, in bytes.

        Raises:
            WireError: The site has sent too many events.
        """
        is_first_end = event.kind == "end" and self.final_ticks is None
        is_exempt = is_first_end and size <= _EVENT_BYTES_PER_S
        if size > self._event_bytes_left and not is_exempt:
            raise WireError(
                "flood of events",
                f"{self.name} sent more events than a log accepts from one site",
            )
        self._event_bytes_left -= size

    def accept(self, channel: str, message: SiteMessage, received_ns: int) -> bool:
        """Counts a published message, and detects messages that are missing before it.

        A gap between its number and that of the previous message shows that messages are
        missing. Use `refill` for messages that were sent on request.

        Args:
            channel: Name of the channel.
            message: The message, decoded and checked by `read`.
            received_ns: Arrival of the message on the monotonic clock, in ns.

        Returns:
            True if the message is new, or False if it was received before.
        """
        self.last_received_ns = received_ns
        account = self.accounts[channel]
        is_new = message.number < 0 or account.receive(message.number, received_ns)
        self._count_implied(message.content)
        return is_new

    def refill(self, channel: str, message: SiteMessage) -> bool:
        """Counts a message that the site resent from its buffer on request.

        The log may contain each message only once, so a message that has already arrived is not
        counted again.

        Args:
            channel: Name of the channel.
            message: The message, decoded and checked by `read`.

        Returns:
            True if the message fills a gap, or False if it was received before.
        """
        is_new = self.accounts[channel].refill(message.number)
        self._count_implied(message.content)
        return is_new

    def check_sender(self, reply: Backfill) -> None:
        """Raises WireError if a reply with resent messages comes from another start or site.

        The reply of an earlier start would contain messages with the same numbers but different
        contents.

        Args:
            reply: The reply to the recorder's request.

        Raises:
            WireError: The reply comes from another site, or from an earlier or later start of
                this site's process.
        """
        if reply.member != self.name or reply.boot != self._boot:
            raise WireError(
                "stranger",
                f"{reply.member} (start {reply.boot}) answered in place of {self.name}",
            )

    def add_expected(self, channel: str, count: int) -> None:
        """Registers that a site has published at least a given number of messages on a channel.

        Expected messages that have not been received count as missing. Since a faulty site
        could report any number, the number is limited to the largest number that is possible in
        the scenario by now.

        Args:
            channel: Name of the channel.
            count: Number of messages that the site has published on this channel.
        """
        largest = self._largest_counts[channel]
        if channel != topics.EVENT:
            possible = count_messages(channel, self._possible_ticks, self._rate_hz)
            largest = min(largest, possible)
        self.accounts[channel].add_expected(min(count, largest))

    def count_previous_start(self, ticks: int) -> None:
        """Registers the minimum number of ticks that a site executed before its restart.

        A site that was killed could not report the number itself, but other sites have received
        its samples. Without the number, records lost at the end of the previous start would not
        be counted as missing.

        Args:
            ticks: Number of ticks reported by another site.
        """
        for channel, gap in self._start_gaps.items():
            gap.note_published(number_message(channel, ticks, self._rate_hz))

    def _count_implied(self, content: State | LinkStats | Event) -> None:
        """Derives from a message which other messages from its sender exist.

        Messages that exist but have not arrived are counted as missing. A record states which
        ticks were skipped. Statistics show that all records up to their tick exist. The events
        "join" and "end" state the first tick and the number of ticks.
        """
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
        """Registers that no messages exist for ticks that the site has skipped.

        A site with an external arm skips ticks that came too late. They must not count as lost
        messages.

        Args:
            record: Record whose field `cmd` says how many ticks were skipped.
        """
        skipped = count_skipped_ticks(record.cmd) if record.cmd else 0
        if not skipped:
            return

        for channel in (topics.STATE, topics.LINK):
            next_number, published = skipped_numbers(
                channel, record.tick, skipped, self._rate_hz
            )
            account = self.accounts[channel]
            lowest_unpublished = account.mark_unpublished(next_number, published)
            if channel == topics.STATE:
                self.skipped_ticks += next_number - lowest_unpublished

    def _begin_start(self, first_tick: int) -> None:
        """Accounts for the messages between the previous start of the site and this one.

        A site that was restarted continues at a later tick. The messages of the ticks in
        between count as unpublished instead of missing. If the previous start ended properly,
        it has reported how many ticks it executed, and its messages up to that tick still count
        as missing. If it was killed, that number is unknown and taken as 0. Reports from other
        sites may correct this, see `count_previous_start`.

        Args:
            first_tick: First tick of this start.
        """
        previous_ticks = 0
        if self._before is not None and self._before.final_ticks is not None:
            previous_ticks = self._before.final_ticks

        for channel, gap in self._start_gaps.items():
            first_number = count_messages(channel, first_tick, self._rate_hz)
            previously_published = count_messages(channel, previous_ticks, self._rate_hz)
            gap.begin_next_start(first_number, previously_published)

    @property
    def lacks_messages(self) -> bool:
        """True if a message is missing that its sender can still resend.

        Messages that the sender has overwritten in its buffer do not count.
        """
        return any(account.find_requestable_gap() for account in self.accounts.values())

    @property
    def is_complete(self) -> bool:
        """True if the site has ended and the recorder has received all of its messages.

        When a site ends, it publishes how many ticks it has executed, which determines the
        messages to expect.
        """
        return self.final_ticks is not None and not self.lacks_messages

    def give_up(self) -> None:
        """Stops requesting missing messages from a site that can no longer send them.

        If a site has crashed, its buffer of sent messages is lost. The messages are still
        counted as missing in the summary of the log.
        """
        for account in self.accounts.values():
            account.abandon_below(account.last + 1)

    def describe_missing(self) -> str:
        """Describes the missing messages of one site, for the user.

        Messages that were lost and could not be obtained again leave gaps in the log.

        Returns:
            The number of missing messages and their first ranges, for each channel. Empty if no
            message is missing.
        """
        texts = []
        for channel, account in self.accounts.items():
            if account.missing:
                counts = f"{account.missing} of {account.expected} {_CHANNEL_NOUNS[channel]}"
                first_gaps = " ".join(account.format_gaps(5))
                texts.append(f"{counts} ({first_gaps})")
        return ", ".join(texts)

"""What comes to a recorder: the bounded queue of messages, and per site those received and
those missing.

Invariant (L6): the queue is bounded, in messages and in bytes, and each key in its share of the
bytes, so that one member's flood does not displace what the others send; overflow is counted
and reported. A message counts only when it is decoded, of this site, of this boot, and has a
number that the scenario and the clock allow; each such message may imply that others exist.
Records and statistics are as many as the scenario has ticks, and none is of a tick still to
come; of events a log takes so many bytes, and the first word of an end all the same.
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
"""Capacity in messages: minutes of three sites at 1 kHz, whose records come in blocks."""
CAPACITY_BYTES = 96 << 20
KEY_BYTES = 32 << 20
"""Capacity in bytes, and of messages of one key: a planar arm at 1 kHz makes half a megabyte a
second.
"""
OVERHEAD_BYTES = 200
"""What a message takes besides its payload."""
KEYS = 1_000
"""Keys whose losses, and whose shares, are counted separately."""


class InboundMessage(NamedTuple):
    """One message: its key, its bytes, and its arrival on the monotonic clock."""

    key: str
    payload: bytes
    mono_ns: int


class InboundQueue:
    """A queue between the bus's thread, which takes, and the writer's, which drains."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._queue: deque[InboundMessage] = deque()
        self._taken = Counter[str]()
        self._drained = Counter[str]()  # each of one thread, bytes by key
        self._taken_bytes = self._drained_bytes = 0
        self._taking = threading.Lock()  # a bus may have several threads
        self.overflowed: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._queue)

    def receive(self, key: str, payload: bytes) -> None:
        """Stamps and appends one message; called by the bus."""
        size = len(payload) + OVERHEAD_BYTES
        with self._taking:
            of = key if key in self._taken or len(self._taken) < KEYS else "others"
            waiting = (
                self._taken_bytes - self._drained_bytes,
                self._taken[of] - self._drained[of],
            )
            if (
                len(self._queue) >= CAPACITY
                or waiting[0] >= CAPACITY_BYTES
                or waiting[1] >= KEY_BYTES
            ):
                self.overflowed[of] += 1
                return
            self._taken[of] += size
            self._taken_bytes += size
            self._queue.append(InboundMessage(key, payload, self._clock.monotonic_ns()))

    def drain(self, until_ns: int | None = None) -> Iterator[InboundMessage]:
        """Yields the waiting messages that arrived until an instant, oldest first; all without
        one.
        """
        queue = self._queue
        while queue and (until_ns is None or queue[0].mono_ns <= until_ns):
            message = queue.popleft()
            size = len(message.payload) + OVERHEAD_BYTES
            self._drained[message.key if message.key in self._taken else "others"] += size
            self._drained_bytes += size
            yield message


CHANNEL_NOUNS = {topics.STATE: "records", topics.LINK: "statistics", topics.EVENT: "events"}
_LEAD_NS = 2_000_000_000
_DRIFT = 1e-3
"""By so much, and this share of the session's time, clocks of sites may be ahead of the
recorder's.
"""
EVENT_BYTES = 512 << 10
EVENT_BYTES_PER_S = 4 << 10
"""Bytes of a site's events that a log takes, and more for each of its seconds: ten events a
second.
"""
_LEAST_EVENT_BYTES = 128
"""No event is shorter."""


class SiteMessage(NamedTuple):
    """A decoded message of a site.

    Attributes:
        number: its number in its channel; -1 without one.
        t_ns: time of sending, ns since the epoch on the sender's clock; negative before it.
    """

    number: int
    sequence: int
    t_ns: int
    content: State | LinkStats | Event


class SiteReception:
    """The messages received from one start of one site, and those missing.

    Args:
        boot: its start; None: it is not there yet.
        before: the reception of the start before, whose ticks this one continues.

    Attributes:
        accounts: its messages by channel; those of events begin anew with every start.
        event_accounts: those of the starts before.
        final_ticks: number of its ticks, once its end event has arrived; else None.
        last_received_ns: arrival of its last message, on the recorder's clock; None before.
        since_ns: time since the epoch on that clock: what claims to be later is not believed.
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
        if before is not None:
            self.accounts = {**before.accounts, topics.EVENT: Account()}
            self.event_accounts = (*before.event_accounts, before.accounts[topics.EVENT])
        self.final_ticks: int | None = None
        self.last_received_ns: int | None = None
        self.since_ns: float = math.inf if before is None else before.since_ns
        self._boot = boot
        self._rate_hz = scenario.sites[name].rate_hz
        layout = scenario.layout(name)
        self._decoders = {
            name: make_decoder(CHANNEL_TYPES[name], layout=layout) for name in SITE_CHANNELS
        }
        self.period_ns = 1_000_000_000 // self._rate_hz
        self._gaps = {
            channel: StartGap(self.accounts[channel], count_under_way(channel, self._rate_hz))
            for channel in (topics.STATE, topics.LINK)
        }
        self._ticks = scenario.ticks(name)
        self._event_room = EVENT_BYTES + round(EVENT_BYTES_PER_S * scenario.duration_s)
        self._most = {
            channel: count_messages(channel, self._ticks, self._rate_hz)
            for channel in SITE_CHANNELS
        } | {topics.EVENT: self._event_room // _LEAST_EVENT_BYTES}

    def read(self, channel: str, payload: bytes) -> SiteMessage:
        """Decodes a payload.

        Raises:
            WireError: it is no message of this site's channel.
        """
        if channel == topics.EVENT:
            event = self._decoders[channel](payload)
            message = SiteMessage(event.n, event.n, event.t_ns, event)
            sender = event.member
            ticks = event.ticks if event.kind in ("join", "end") else 0
            if event.kind == "end" and not 0 <= event.ticks <= self._ticks:
                raise WireError(
                    "out of range",
                    f"{self.name} says it made {count_nouns(event.ticks, 'tick')}",
                )
        else:
            tick = self._decoders[channel](payload)
            number = number_message(channel, tick.tick, self._rate_hz)
            t_ns = tick.sent_ns if channel == topics.STATE else tick.t_ns
            message = SiteMessage(number, tick.tick, t_ns, tick)
            sender = tick.site
            ticks = tick.tick + 1
        self._check(
            channel=channel,
            sender=sender,
            boot=message.content.boot,
            number=message.number,
            ticks=ticks,
        )
        if isinstance(message.content, Event):
            self._take_room(message.content, len(payload))
        return message

    def _check(self, channel: str, sender: str, boot: int, number: int, ticks: int) -> None:
        if sender != self.name or boot != self._boot:
            raise WireError("stranger", f"{sender}, start {boot}, on a key of {self.name}")
        if number >= self._most[channel]:
            raise WireError("out of range", f"{self.name}/{channel} number {number}")
        if ticks > self._possible_ticks:
            raise WireError(f"{self.name} is ahead of the clock", f"{channel} number {number}")

    def accept_records(
        self, payloads: Iterable[bytes], came_ns: int
    ) -> Iterator[tuple[bytes, State]]:
        """Counts the published records of one block, and yields those that are no duplicates.

        Raises:
            WireError: one is no record of this site; those before it count.
        """
        decode = self._decoders[topics.STATE]
        account = self.accounts[topics.STATE]
        name = self.name
        boot = self._boot
        possible = self._possible_ticks
        for payload in payloads:
            record: State = decode(payload)
            tick = record.tick
            if tick >= possible or record.site != name or record.boot != boot:
                self._check(
                    channel=topics.STATE,
                    sender=record.site,
                    boot=record.boot,
                    number=tick,
                    ticks=tick + 1,
                )
            self.last_received_ns = came_ns
            new = account.receive(tick, came_ns)
            if record.cmd:
                self._imply(record)
            if new:
                yield payload, record

    @property
    def _possible_ticks(self) -> int:
        latest_ns = self.since_ns * (1.0 + _DRIFT) + _LEAD_NS
        return int(min(self._ticks, latest_ns * 1e-9 * self._rate_hz + 1.0))

    def _take_room(self, event: Event, size: int) -> None:
        """Refuses the events of a flood, which would make a log of nothing else."""
        ends = event.kind == "end" and self.final_ticks is None and size <= EVENT_BYTES_PER_S
        if size > self._event_room and not ends:
            raise WireError(
                "flood of events", f"{self.name} sent more than a log takes of one site"
            )
        self._event_room -= size

    def accept(self, channel: str, message: SiteMessage, came_ns: int) -> bool:
        """Counts a published message; False if it is a duplicate."""
        self.last_received_ns = came_ns
        new = message.number < 0 or self.accounts[channel].receive(message.number, came_ns)
        self._imply(message.content)
        return new

    def refill(self, channel: str, message: SiteMessage) -> bool:
        """Counts a backfilled message; False if it is a duplicate."""
        new = self.accounts[channel].refill(message.number)
        self._imply(message.content)
        return new

    def check_sender(self, past: Backfill) -> None:
        """Refuses an answer that this start of the site did not give.

        Raises:
            WireError: its sender is another one.
        """
        if past.member != self.name or past.boot != self._boot:
            raise WireError(
                "stranger", f"{past.member}, start {past.boot}, answers for {self.name}"
            )

    def add_expected(self, channel: str, made: int) -> None:
        """Counts the messages of a channel that exist at least; no more than scenario and clock
        allow.
        """
        most = self._most[channel]
        if channel != topics.EVENT:
            most = min(most, count_messages(channel, self._possible_ticks, self._rate_hz))
        self.accounts[channel].add_expected(min(made, most))

    def count_previous_start(self, ticks: int) -> None:
        """Counts what the start before published at least, of which another site heard so many
        ticks.
        """
        for channel, gap in self._gaps.items():
            gap.note_published(number_message(channel, ticks, self._rate_hz))

    def _imply(self, content: State | LinkStats | Event) -> None:
        """Counts the messages that must exist because this one does, and those that never did."""
        if (
            isinstance(content, State)
            and content.cmd
            and (skipped := count_skipped_ticks(content.cmd))
        ):
            for channel in (topics.STATE, topics.LINK):
                left_out = skipped_numbers(channel, content.tick, skipped, self._rate_hz)
                self.accounts[channel].mark_unpublished(*left_out)
        if isinstance(content, LinkStats):
            self.add_expected(topics.STATE, content.tick + 1)
        elif isinstance(content, Event) and content.kind == "join":
            made = (
                0
                if self._before is None or self._before.final_ticks is None
                else self._before.final_ticks
            )
            for channel, gap in self._gaps.items():
                numbers = (
                    count_messages(channel, ticks, self._rate_hz)
                    for ticks in (content.ticks, made)
                )
                gap.begin_next_start(*numbers)
        elif isinstance(content, Event) and content.kind == "end":
            self.final_ticks = content.ticks
            for channel in (topics.STATE, topics.LINK):
                self.add_expected(
                    channel, count_messages(channel, content.ticks, self._rate_hz)
                )

    @property
    def lacks_messages(self) -> bool:
        """True while a message is missing that can still be had."""
        return any(account.find_requestable_gap() for account in self.accounts.values())

    @property
    def is_complete(self) -> bool:
        """True once it has ended and no missing message can still be had."""
        return self.final_ticks is not None and not self.lacks_messages

    def give_up(self) -> None:
        """Counts all missing messages as lost for good."""
        for account in self.accounts.values():
            account.abandon_below(account.last + 1)

    def describe_missing(self) -> str:
        """Describes the missing messages; "" without any."""
        return ", ".join(
            f"{account.missing} of {account.expected} {CHANNEL_NOUNS[channel]} "
            f"({' '.join(account.format_gaps(5))})"
            for channel, account in self.accounts.items()
            if account.missing
        )

"""Check of one channel of a session, message by message: numbering, schema and time stamps.

Invariant: a message is checked against its own content, its scenario and the messages before it; nothing
is executed. All problems are counted, the first of them kept.
"""

import json
from collections import defaultdict
from typing import Any, NamedTuple

from ..core.ticks import NS_PER_S
from ..errors import WireError
from ..net import topics
from ..net.messages import READABLE, VERSION, Event, LinkStats, RecorderStats, State, json_schema
from ..net.wire import decode
from .accounting import Account, count_messages, number_message
from .log_layout import CHANNEL_TYPES, MAX_TIME_NS
from .mcap_check import ProblemList
from .mcap_reader import ChannelInfo, McapMessage

MAX_AHEAD_NS = 10 * NS_PER_S
"""No message is sent more than this after it came, whatever the clocks."""
MAX_BOOTS = 64
"""Starts of a member that are distinguished."""
_SENT_SINCE = 2
"""First version whose records state when they were sent."""


class ChannelProblems(NamedTuple):
    """Problems of messages, by check."""

    sequence: ProblemList
    schema: ProblemList
    times: ProblemList


class MessageIdentity(NamedTuple):
    """Identity of a message by its own content.

    Attributes:
        member: its sender.
        boot: which start of it.
        number: its number in its channel, -1 for none.
        sequence: the number that the file should state.
        sent_ns: when it was sent, ns since the epoch; None if it does not state that.
    """

    member: str
    boot: int
    number: int
    sequence: int
    sent_ns: int | None


class ChannelCheck:
    """Check of one channel.

    Args:
        member: its sender.
        kind: "state", "link", "event" or "stats".
        rate_hz: tick rate of the member; 0 of the recorder.
        epoch_ns: Unix time of tick 0.
        version: schema version of the session.
        problems: receives the problems.

    Attributes:
        accounts: received and missing messages, by the member's boot.
        first: number and publish time of the message with the lowest number.
        last: the same of the highest.
        ticks: how many ticks the member made, once it has stated that.
    """

    def __init__(
        self, member: str, kind: str, rate_hz: int, epoch_ns: int, version: int, problems: ChannelProblems
    ) -> None:
        self.member, self.kind, self.rate_hz = member, kind, rate_hz
        self.accounts: dict[int, Account] = defaultdict(Account)
        self.first: tuple[int, int] | None = None
        self.last: tuple[int, int] | None = None
        self.ticks: int | None = None
        self._in_file: dict[int, Account] = self.accounts
        self._file = ""
        self._epoch_ns, self._version, self._problems = epoch_ns, version, problems
        self._log_ns = 0

    @property
    def name(self) -> str:
        """Its short name, as in "m1/state"."""
        return f"{self.member}/{self.kind}"

    @property
    def received(self) -> int:
        """Number of messages, each number once."""
        return sum(account.received for account in self.accounts.values())

    @property
    def missing(self) -> int:
        """Number of missing messages."""
        return sum(account.missing for account in self.accounts.values())

    def gaps(self, *, whole: bool) -> list[tuple[int, int]]:
        """Returns missing numbers, as (first, last); those before the first one only if `whole`."""
        begins = 0 if whole or self.first is None else self.first[0]
        all_gaps = (gap for account in self.accounts.values() for gap in account.gaps)
        return [(max(first, begins), last) for first, last in all_gaps if last >= begins]

    def expect(self, ticks: int) -> None:
        """Counts as missing what the member sent in so many ticks and is not there."""
        for account in self.accounts.values():
            account.expect(count_messages(self.kind, ticks, self.rate_hz))

    def begin(self, file: str, channel: ChannelInfo) -> None:
        """Begins with another file, and checks how it describes the channel."""
        self._in_file = defaultdict(Account) if self._file else self.accounts
        self._file = file
        self._log_ns = 0
        if fault := self._find_schema_fault(channel):
            self._problems.schema.add(file, None, f"{self.name}: {fault}")

    def _find_schema_fault(self, channel: ChannelInfo) -> str:
        kind = CHANNEL_TYPES[self.kind]
        rate = channel.metadata.get("rate_hz", str(self.rate_hz))
        if not channel.schema:
            return "has no schema"
        if (channel.encoding, channel.schema_encoding) != ("msgpack", "jsonschema"):
            return f"is {channel.encoding} with {channel.schema_encoding}, not msgpack with jsonschema"
        if channel.schema != (name := f"trilat.{kind.__name__}.v{self._version}"):
            return f"has the schema {channel.schema}, not {name}"
        if self._version == VERSION and channel.schema_data != json.dumps(json_schema(kind)).encode():
            return f"the schema {channel.schema} is not what it was released as"
        if self.kind == topics.STATE and rate != str(self.rate_hz):
            return f"says {rate} Hz, the scenario {self.rate_hz}"
        return ""

    def take(self, stored: McapMessage, offset: int) -> None:
        """Checks a message; `offset` is its place, or that of its chunk."""
        kind: Any = CHANNEL_TYPES[self.kind]
        try:
            message = decode(stored.payload, kind, READABLE)
        except WireError as error:
            self._add(self._problems.schema, offset, str(error))
            return
        identity = self._identify(message)
        if message.v != self._version:
            text = f"a message of version {message.v} in a log of version {self._version}"
            self._add(self._problems.schema, offset, text)
        if identity.member != self.member:
            text = f"a message says that it is of {identity.member[:40]!r}"
            self._add(self._problems.schema, offset, text)
        if identity.number >= 0:  # events have numbers from version 3 on
            self._check_number(stored, identity, offset)
        self._check_times(stored, identity, offset)

    def _add(self, problems: ProblemList, offset: int, text: str) -> None:
        problems.add(self._file, offset, f"{self.name}: {text}")

    def _identify(self, message: State | LinkStats | Event | RecorderStats) -> MessageIdentity:
        match message:
            case State():
                sent_ns = message.sent_ns if message.v >= _SENT_SINCE else message.t_ns
                return MessageIdentity(message.site, message.boot, message.tick, message.tick, sent_ns)
            case LinkStats():
                number = number_message(self.kind, message.tick, self.rate_hz)
                return MessageIdentity(message.site, message.boot, number, message.tick, message.t_ns)
            case Event():
                if message.kind == "end":
                    self.ticks = message.ticks
                # a recorder's own events are stamped as it hears them; before the epoch there is no time
                stamped = message.t_ns >= 0 and message.member != topics.RECORDER
                event_ns = message.t_ns if stamped else None
                return MessageIdentity(message.member, message.boot, message.n, max(0, message.n), event_ns)
        account = self.accounts.get(message.boot)
        number = 0 if account is None else account.expected
        return MessageIdentity(topics.RECORDER, message.boot, number, number, None)

    def _check_number(self, stored: McapMessage, identity: MessageIdentity, offset: int) -> None:
        problems, number, boot = self._problems.sequence, identity.number, identity.boot
        if stored.sequence != identity.sequence & 0xFFFFFFFF:
            self._add(problems, offset, f"number {identity.sequence} is stored as {stored.sequence}")
        if boot not in self.accounts and len(self.accounts) >= MAX_BOOTS:
            self._add(problems, offset, f"more than {MAX_BOOTS} starts")
            return
        new = self.accounts[boot].take(number)
        if self._in_file is not self.accounts:  # parts may repeat a message, a file may not
            new = self._in_file[boot].take(number)
        if not new:
            self._add(problems, offset, f"number {number} is there twice")
        place = (number, stored.publish_time_ns)
        self.first = place if self.first is None else min(self.first, place)
        self.last = place if self.last is None else max(self.last, place)

    def _check_times(self, stored: McapMessage, identity: MessageIdentity, offset: int) -> None:
        problems, number = self._problems.times, identity.number
        log_ns, publish_ns = stored.log_time_ns, stored.publish_time_ns
        if log_ns < self._log_ns:
            self._add(
                problems, offset, f"log_time goes back by {self._log_ns - log_ns} ns at number {number}"
            )
        self._log_ns = log_ns
        sent_ns = publish_ns
        if identity.sent_ns is not None:
            sent_ns = min(max(0, self._epoch_ns + identity.sent_ns), MAX_TIME_NS)
        if publish_ns != sent_ns:
            self._add(problems, offset, f"number {number} was sent at {sent_ns} ns, not {publish_ns}")
        elif publish_ns > log_ns + MAX_AHEAD_NS:
            ahead_s = (publish_ns - log_ns) / NS_PER_S
            self._add(problems, offset, f"number {number} came {ahead_s:.1f} s before it was sent")

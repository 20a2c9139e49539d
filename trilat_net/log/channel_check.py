"""Check of one channel of a session, message by message: numbering, schema and time stamps.

Invariant: a message is checked against its own content, its scenario and the messages before it; nothing
is executed. All problems are counted, the first of them kept.
"""

import json
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..core.ticks import NS_PER_S
from ..errors import WireError
from ..net import topics
from ..net.loop_stats import ticks_per_stats
from ..net.messages import READABLE, VERSION, Event, LinkStats, RecorderStats, State, json_schema
from ..net.wire import decode
from .accounting import Account
from .log_layout import CHANNEL_TYPES
from .mcap_doctor import RawMessage

MAX_LISTED_PLACES = 1000
"""Places that a tally keeps."""


@dataclass(slots=True)
class ProblemList:
    """What is wrong, of one kind.

    Attributes:
        wrong: how many things.
        places: the first of them: in which file, at which byte (None: the whole), what.
    """

    wrong: int = 0
    places: list[tuple[str, int | None, str]] = field(default_factory=list)

    def tell(self, file: str, offset: int | None, text: str) -> None:
        """Takes in that something is wrong."""
        self.wrong += 1
        if len(self.places) < MAX_LISTED_PLACES:
            self.places.append((file, offset, text))

    def text(self) -> str:
        """Returns the first of it, and how much more there is."""
        _, offset, text = self.places[0]
        first = text if offset is None else f"byte {offset}: {text}"
        return f"{first}; and {self.wrong - 1} more" if self.wrong > 1 else first


MAX_AHEAD_NS = 10 * NS_PER_S
"""No message is sent more than this after it came, whatever the clocks."""
MAX_BOOTS = 64
"""Starts of a member that are told apart."""
_LAST_NS = (1 << 64) - 1
_SENT_SINCE = 2
"""First version whose records say when they were sent."""


class ChannelProblems(NamedTuple):
    """What is wrong with messages, by check."""

    sequence: ProblemList
    schema: ProblemList
    times: ProblemList


class MessageIdentity(NamedTuple):
    """What a message says of itself.

    Attributes:
        member: who sends it.
        boot: which start of it.
        number: its number in its channel, -1 where it has none.
        sequence: what the file calls it by.
        sent_ns: when it was sent, ns since the epoch; None where it does not say.
    """

    member: str
    boot: int
    number: int
    sequence: int
    sent_ns: int | None


class ChannelCheck:
    """One channel.

    Args:
        topic: its topic.
        member: whose it is.
        kind: "state", "link", "event" or "stats".
        rate_hz: tick rate of the member; 0 of the recorder.
        epoch_ns: Unix time of tick 0.
        version: schema version of the session.
        tallies: where to tell what is wrong.

    Attributes:
        accounts: per start of the member, what came and what is missing.
        first: number and publish time of the message with the lowest number.
        last: the same of the highest.
        ends: how many ticks the member said that it made, once it did.
    """

    def __init__(
        self,
        topic: str,
        member: str,
        kind: str,
        rate_hz: int,
        epoch_ns: int,
        version: int,
        tallies: ChannelProblems,
    ) -> None:
        self.topic, self.member, self.kind, self.rate_hz = topic, member, kind, rate_hz
        self.accounts: dict[int, Account] = {}
        self.first: tuple[int, int] | None = None
        self.last: tuple[int, int] | None = None
        self.ends: int | None = None
        self._here: dict[int, Account] = {}
        self._file = ""
        self._epoch_ns, self._version, self._tallies = epoch_ns, version, tallies
        self._every = ticks_per_stats(rate_hz) if rate_hz else 1
        self._log_ns = 0

    @property
    def name(self) -> str:
        """The channel as people call it, as in "m1/state"."""
        return f"{self.member}/{self.kind}"

    @property
    def received(self) -> int:
        """How many messages there are, each number once."""
        return sum(account.received for account in self.accounts.values())

    @property
    def missing(self) -> int:
        """How many are missing."""
        return sum(account.missing for account in self.accounts.values())

    def gaps(self, *, whole: bool) -> list[tuple[int, int]]:
        """Returns the numbers that are missing, as (first, last).

        Args:
            whole: whether what is missing before the first one counts.
        """
        begins = 0 if whole or self.first is None else self.first[0]
        all_gaps = (gap for account in self.accounts.values() for gap in account.gaps)
        return [(max(first, begins), last) for first, last in all_gaps if last >= begins]

    def expect(self, ticks: int) -> None:
        """Books how many ticks the member made."""
        for account in self.accounts.values():
            account.expect(ticks if self.kind == topics.STATE else -(-ticks // self._every))

    def begin(self, file: str) -> None:
        """Begins with another file."""
        self._file = file
        self._here = self.accounts if not self._here else {}
        self._log_ns = 0

    def look(self, channel: Any, schema: Any, offset: int | None = None) -> None:
        """Judges what a file says of the channel.

        Args:
            channel: the record, as the `mcap` package has it.
            schema: likewise; None where there is none.
            offset: where to say that it is.
        """
        wrong = self._schema_fault(channel, schema)
        if wrong:
            self._tallies.schema.tell(self._file, offset, f"{self.name}: {wrong}")

    def _schema_fault(self, channel: Any, schema: Any) -> str:
        kind = CHANNEL_TYPES[self.kind]
        rate = channel.metadata.get("rate_hz", str(self.rate_hz))
        if schema is None:
            return "has no schema"
        if (channel.message_encoding, schema.encoding) != ("msgpack", "jsonschema"):
            return f"is {channel.message_encoding} with {schema.encoding}, not msgpack with jsonschema"
        if schema.name != (name := f"trilat.{kind.__name__}.v{self._version}"):
            return f"has the schema {schema.name}, not {name}"
        if self._version == VERSION and schema.data != json.dumps(json_schema(kind)).encode():
            return f"the schema {schema.name} is not what it was released as"
        if self.kind == topics.STATE and rate != str(self.rate_hz):
            return f"says {rate} Hz, the scenario {self.rate_hz}"
        return ""

    def take(self, raw: RawMessage) -> None:
        """Judges a message."""
        try:
            message = decode(raw.payload, _KINDS[self.kind], READABLE)
        except WireError as error:
            self._tallies.schema.tell(self._file, raw.offset, f"{self.name}: {error}")
            return
        said = self._said(message)
        if message.v != self._version:
            text = f"{self.name}: a message of version {message.v} in a log of version {self._version}"
            self._tallies.schema.tell(self._file, raw.offset, text)
        if said.member != self.member:
            text = f"{self.name}: a message says that it is of {said.member[:40]!r}"
            self._tallies.schema.tell(self._file, raw.offset, text)
        self._number(raw, said)
        self._time(raw, said)

    def _said(self, message: State | LinkStats | Event | RecorderStats) -> MessageIdentity:
        match message:
            case State():
                stamp_ns = message.sent_ns if message.v >= _SENT_SINCE else message.t_ns
                return MessageIdentity(message.site, message.boot, message.tick, message.tick, stamp_ns)
            case LinkStats():
                number = message.tick // self._every
                return MessageIdentity(message.site, message.boot, number, message.tick, message.t_ns)
            case Event():
                if message.kind == "end":
                    self.ends = message.ticks
                # what a recorder says itself is stamped as it hears it; before the epoch there is no time
                stamped = message.t_ns >= 0 and message.member != topics.RECORDER
                sent_ns = message.t_ns if stamped else None
                return MessageIdentity(message.member, message.boot, message.n, max(0, message.n), sent_ns)
        whole = self.accounts.get(message.boot)
        number = 0 if whole is None else whole.expected
        return MessageIdentity(topics.RECORDER, message.boot, number, number, None)

    def _number(self, raw: RawMessage, said: MessageIdentity) -> None:
        if said.number < 0:  # an event of before version 3
            return
        if raw.sequence != said.sequence & 0xFFFFFFFF:
            text = f"{self.name}: number {said.sequence} is stored as {raw.sequence}"
            self._tallies.sequence.tell(self._file, raw.offset, text)
        if said.boot not in self.accounts and len(self.accounts) >= MAX_BOOTS:
            self._tallies.sequence.tell(self._file, raw.offset, f"{self.name}: more than {MAX_BOOTS} starts")
            return
        new = self._account(self.accounts, said.boot).take(said.number)
        if self._here is not self.accounts:
            new = self._account(self._here, said.boot).take(said.number)
        if not new:
            text = f"{self.name}: number {said.number} is there twice"
            self._tallies.sequence.tell(self._file, raw.offset, text)
        place = (said.number, raw.publish_ns)
        self.first = place if self.first is None else min(self.first, place)
        self.last = place if self.last is None else max(self.last, place)

    @staticmethod
    def _account(accounts: dict[int, Account], boot: int) -> Account:
        account = accounts.get(boot)
        if account is None:
            account = accounts[boot] = Account()
        return account

    def _time(self, raw: RawMessage, said: MessageIdentity) -> None:
        tally = self._tallies.times
        if raw.log_ns < self._log_ns:
            text = (
                f"{self.name}: log_time goes back by {self._log_ns - raw.log_ns} ns at number {said.number}"
            )
            tally.tell(self._file, raw.offset, text)
        self._log_ns = raw.log_ns
        told_ns = None if said.sent_ns is None else min(max(0, self._epoch_ns + said.sent_ns), _LAST_NS)
        if told_ns is not None and raw.publish_ns != told_ns:
            text = f"{self.name}: number {said.number} was sent at {told_ns} ns, not {raw.publish_ns}"
            tally.tell(self._file, raw.offset, text)
        elif raw.publish_ns > raw.log_ns + MAX_AHEAD_NS:
            ahead_s = (raw.publish_ns - raw.log_ns) / NS_PER_S
            tally.tell(
                self._file,
                raw.offset,
                f"{self.name}: number {said.number} came {ahead_s:.1f} s before it was sent",
            )


_KINDS: dict[str, Any] = {**CHANNEL_TYPES}

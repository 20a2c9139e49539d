"""Accounts of channels: received and missing messages by number, counted live or rebuilt from a log.

Invariant: expected = received + missing, always. A message's number is its tick for a record, its place
from 0 for statistics and events. Memory is bounded: of more gaps than `MAX_GAPS`, the lowest are only
counted. Rebuilding decodes events only, and judges a part of a log from its first message on.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping

from ..errors import ScenarioError, WireError
from ..net import topics
from ..net.loop_stats import ticks_per_stats
from ..net.messages import READABLE, Event
from ..net.wire import decode
from ..scenario import parse_embedded
from .log_layout import PART, SCENARIO, SESSION


class RangeSet:
    """A set of whole numbers that grows at its upper end.

    Args:
        most: ranges that are kept apart.

    Attributes:
        count: how many numbers are in it.
    """

    __slots__ = ("_firsts", "_lasts", "_most", "count")

    def __init__(self, most: int) -> None:
        self.count = 0
        self._most = most
        self._firsts: list[int] = []
        self._lasts: list[int] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Yields (first, last) of every range, lowest first."""
        return zip(self._firsts, self._lasts, strict=True)

    def __len__(self) -> int:
        """Returns how many ranges there are."""
        return len(self._firsts)

    def append(self, first: int, last: int) -> None:
        """Adds numbers that lie above all that are in it."""
        if self._lasts and self._lasts[-1] == first - 1:
            self._lasts[-1] = last
        else:
            self._firsts.append(first)
            self._lasts.append(last)
        self.count += last - first + 1
        self._bound()

    def remove(self, number: int) -> bool:
        """Takes one number out; False where it is not in."""
        place = bisect_right(self._firsts, number) - 1
        if place < 0 or number > self._lasts[place]:
            return False
        first, last = self._firsts[place], self._lasts[place]
        parts = [(a, b) for a, b in ((first, number - 1), (number + 1, last)) if a <= b]
        self._firsts[place : place + 1] = [a for a, _ in parts]
        self._lasts[place : place + 1] = [b for _, b in parts]
        self.count -= 1
        self._bound()
        return True

    def from_(self, number: int) -> tuple[int, int] | None:
        """Returns the first range at or above a number, cut off below it; None where there is none."""
        place = max(0, bisect_right(self._firsts, number) - 1)
        if place < len(self._lasts) and self._lasts[place] < number:
            place += 1
        if place >= len(self._firsts):
            return None
        return max(number, self._firsts[place]), self._lasts[place]

    def longest(self) -> int:
        """Returns how many numbers the longest range has."""
        return max((last - first + 1 for first, last in self), default=0)

    def _bound(self) -> None:
        if len(self._firsts) > self._most:
            self.count -= self._lasts.pop(0) - self._firsts.pop(0) + 1


MAX_GAPS = 50_000
"""Gaps that an account keeps apart: of those before, it knows how many are missing, and no more which."""
SHOWN_GAPS = 20
"""Gaps that are named in a text."""


class Account:
    """The account of one channel.

    Attributes:
        received: messages that there are, each number once.
        duplicate: those that came though their number was there.
        reordered: those that came after one with a higher number had come.
        refilled: those that came from the sender's memory, after they had been missing.
        last: largest number that is known to exist, -1 before the first.
        hopeless: numbers below this one that are missing can be had from nobody.
        silence_ns: the longest time between two that came, ns; 0 where nobody stamps them.
    """

    __slots__ = (
        "_came_ns",
        "_gaps",
        "_newest",
        "duplicate",
        "hopeless",
        "last",
        "received",
        "refilled",
        "reordered",
        "silence_ns",
    )

    def __init__(self) -> None:
        self.received = self.duplicate = self.reordered = self.refilled = 0
        self.last = -1
        self.hopeless = 0
        self.silence_ns = 0
        self._newest = -1  # of those that came by themselves
        self._came_ns: int | None = None
        self._gaps = RangeSet(MAX_GAPS)

    def take(self, number: int, came_ns: int | None = None) -> bool:
        """Books one message; False where its number is there already.

        Args:
            number: its number, 0 or more.
            came_ns: when it came, on a clock that never steps.
        """
        if came_ns is not None:
            if self._came_ns is not None and came_ns - self._came_ns > self.silence_ns:
                self.silence_ns = came_ns - self._came_ns
            self._came_ns = came_ns
        passed = number <= self._newest
        self._newest = max(self._newest, number)
        if not self._is_new(number):
            self.duplicate += 1
            return False
        self.reordered += passed
        self.received += 1
        return True

    def refill(self, number: int) -> bool:
        """Books one message from the sender's memory; False where its number is there already."""
        new = self._is_new(number)
        self.refilled += new
        self.received += new
        return new

    def expect(self, made: int) -> None:
        """Books what is missing, where it is known how many there are at least."""
        if made > self.last + 1:
            self._gaps.append(self.last + 1, made - 1)
            self.last = made - 1

    def give_up(self, below: int) -> None:
        """Books what is missing below a number as lost for good; should it come yet, it is welcome."""
        self.hopeless = max(self.hopeless, below)

    def wanted(self, number: int = 0) -> tuple[int, int] | None:
        """Returns the first gap at or above a number that is not hopeless; None where there is none."""
        return self._gaps.from_(max(number, self.hopeless))

    @property
    def expected(self) -> int:
        """How many are known to exist."""
        return self.last + 1

    @property
    def missing(self) -> int:
        """How many of them are missing."""
        return self.last + 1 - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Numbers that are missing, as [first, last] pairs; the newest MAX_GAPS of them."""
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """How many the largest gap has."""
        return self._gaps.longest()

    def as_text(self) -> str:
        """Returns the account in one line, for the file and for people."""
        gaps = self.gap_texts(SHOWN_GAPS)
        named = f" ({' '.join(gaps)}{' ...' if len(self._gaps) > len(gaps) else ''})" if gaps else ""
        silence = f", longest silence {self.silence_ns / 1e6:.1f} ms" if self.silence_ns else ""
        return (
            f"expected {self.expected}, received {self.received}, missing {self.missing}, "
            f"duplicate {self.duplicate}, reordered {self.reordered}, refilled {self.refilled}, "
            f"largest gap {self.largest_gap}{named}{silence}"
        )

    def gap_texts(self, most: int) -> list[str]:
        """Returns the gaps as "first-last", the first ones of them."""
        return [f"{first}-{last}" for (first, last), _ in zip(self._gaps, range(most), strict=False)]

    def _is_new(self, number: int) -> bool:
        """Takes a number out of what is missing; False where it was not."""
        if number > self.last:
            self.expect(number)
            self.last = number
            return True
        return self._gaps.remove(number)


EVENTS_NUMBERED_SINCE = 3
"""Events have numbers from this version of the schema on."""


class RebuiltAccounts:
    """The accounts of one file.

    Args:
        metadata: the file's, by name, as far as it was read.
        attachments: the file's, by name.

    Raises:
        NotOurs: it is no log of ours.
    """

    def __init__(self, metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]) -> None:
        session = metadata.get(SESSION, {})
        try:
            scenario = parse_embedded(attachments[SCENARIO].decode(), SCENARIO)
            self._session = session["session"]
            version = int(session["schema_version"])
        except (KeyError, ValueError, ScenarioError) as error:
            raise NotATrilatLog(str(error)) from None
        self._sites = scenario.names
        self._every = {name: ticks_per_stats(scenario.sites[name].rate_hz) for name in scenario.names}
        self._numbered = (topics.STATE, topics.LINK, topics.EVENT)[
            : 3 if version >= EVENTS_NUMBERED_SINCE else 2
        ]
        self._carried_on = metadata.get(PART, {}).get("index", "1") != "1"
        self._accounts: dict[str, Account] = {}
        self._bases: dict[str, int] = {}

    def open(self, topic: str) -> None:
        """Takes note of a channel that the file has."""
        where = topics.parse_key(topic.removeprefix("/"))
        if where is not None and where.session == self._session and where.channel in self._numbered:
            self._accounts[topic] = Account()

    def take(self, topic: str, sequence: int, payload: bytes) -> None:
        """Books a message."""
        account = self._accounts.get(topic)
        if account is None:
            return
        member, channel = topic.split("/")[-2:]
        number = sequence // self._every.get(member, 1) if channel == topics.LINK else sequence
        base = self._bases.setdefault(topic, number if self._carried_on else 0)
        if number >= base:
            account.take(number - base)
        if channel == topics.LINK:
            self._expect(member, topics.STATE, sequence + 1)
        elif channel == topics.EVENT:
            self._learn(payload)

    def _learn(self, payload: bytes) -> None:
        """Books what an event says of the number of ticks."""
        try:
            event = decode(payload, Event, READABLE)
        except WireError:
            return
        if event.kind == "end" and event.member in self._every and 0 <= event.ticks < 1 << 32:
            self._expect(event.member, topics.STATE, event.ticks)
            self._expect(event.member, topics.LINK, -(-event.ticks // self._every[event.member]))

    def _expect(self, member: str, channel: str, made: int) -> None:
        topic = "/" + topics.key(self._session, member, channel)
        if topic in self._accounts:
            self._accounts[topic].expect(made - self._bases.get(topic, 0))

    def texts(self) -> dict[str, str]:
        """Returns the accounts by topic, as the file holds them."""
        return {
            topic: self._text(topic, account)
            for topic, account in self._accounts.items()
            if account.expected or topic.split("/")[-2] in self._every
        }

    def _text(self, topic: str, account: Account) -> str:
        base = self._bases.get(topic, 0)
        return account.as_text() if not base else f"from {base} on: {account.as_text()}"

    def records(self) -> dict[str, int]:
        """Returns per site how many of its records are in the file."""
        topics_of = {site: "/" + topics.key(self._session, site, topics.STATE) for site in self._sites}
        return {
            site: self._accounts[topic].received
            for site, topic in topics_of.items()
            if topic in self._accounts
        }

    def missing(self) -> Iterator[str]:
        """Yields per site which of its records are not in the file."""
        for site in self._sites:
            topic = "/" + topics.key(self._session, site, topics.STATE)
            account = self._accounts.get(topic)
            if account is not None and account.missing:
                base = self._bases.get(topic, 0)
                gaps = [f"{base + first}-{base + last}" for first, last in account.gaps[:SHOWN_GAPS]]
                more = " ..." if len(account.gaps) > len(gaps) else ""
                yield f"{site}: {account.missing} of {account.expected} records: {' '.join(gaps)}{more}"


class NotATrilatLog(Exception):  # noqa: N818 - what it says of a file
    """A file that is no log of ours; never leaves this package."""

"""Accounts of channels: received and missing messages by number, counted live or from a log.

Invariant: expected = received + missing, always. A message's number is its tick for a record,
its place from 0 for statistics and events. Ticks between two starts of a site were not made:
they are neither expected nor missing. Memory is bounded: of more gaps than `MAX_GAPS`, the
lowest are only counted. Accounts made from a file decode events only, and count a later part of
a log from its first message on.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from ..errors import ScenarioError, WireError, count_nouns
from ..net import topics
from ..net.messages import READABLE, Event
from ..net.topics import count_messages, count_under_way, number_message, skipped_numbers
from ..net.wire import decode
from ..scenario import Scenario, parse_embedded
from .log_layout import PART, SCENARIO, SESSION, SITE_CHANNELS


class RangeSet:
    """A set of whole numbers that grows at its upper end; keeps the highest `most` ranges."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._ranges: list[tuple[int, int]] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._ranges)

    def __len__(self) -> int:
        return len(self._ranges)

    def _count_until(self, number: int) -> int:
        """Returns how many ranges begin at or below a number."""
        return bisect_right(self._ranges, (number, math.inf))

    def insert(self, first: int, last: int) -> None:
        """Adds numbers that are not in it, wherever they belong."""
        place = self._count_until(first)
        if place and self._ranges[place - 1][1] == first - 1:
            self._ranges[place - 1] = self._ranges[place - 1][0], last
        else:
            self._ranges.insert(place, (first, last))
        del self._ranges[: -self._most]

    def remove(self, number: int, last: int | None = None) -> bool:
        """Removes one number, or those up to the last one of a range; returns False if it is
        not in.
        """
        if (found := self.find(number)) is None:
            return False
        place = self._count_until(number) - 1
        sides = (found[0], number - 1), ((last or number) + 1, found[1])
        self._ranges[place : place + 1] = [side for side in sides if side[0] <= side[1]]
        del self._ranges[: -self._most]
        return True

    def find(self, number: int) -> tuple[int, int] | None:
        """Returns the range that a number is in, None if it is in none."""
        place = self._count_until(number) - 1
        return self._ranges[place] if place >= 0 and number <= self._ranges[place][1] else None

    def find_from(self, number: int) -> tuple[int, int] | None:
        """Returns the first range at or above a number, cut off below it; None if there is
        none.
        """
        place = max(0, self._count_until(number) - 1)
        near = self._ranges[place : place + 2]
        return next(
            ((max(number, first), last) for first, last in near if last >= number), None
        )


MAX_GAPS = 50_000
"""Gaps that an account keeps apart; of those before, it keeps the number of missing messages
only.
"""
SHOWN_GAPS = 20
"""Gaps that are named in a text."""


class Account:
    """The account of one channel.

    Attributes:
        received: messages that are there, each number once.
        duplicate: messages that came though their number was there.
        reordered: messages that came after one with a higher number.
        refilled: messages from the sender's memory, after they had been missing.
        unmade: numbers that no message has: the sender left them out, or ended before them and
            began anew behind them.
        last: largest number that is known to exist, -1 before the first.
        silence_ns: the longest time between two that came, ns; 0 if they are not stamped.
    """

    def __init__(self) -> None:
        self.received = self.duplicate = self.reordered = self.refilled = self.unpublished = 0
        self.last = -1
        self.silence_ns = 0
        self._lost_below = 0  # missing numbers below this one cannot be had from any member
        self._newest = -1  # of those that came by themselves
        self._came_ns: int | None = None
        self._gaps = RangeSet(MAX_GAPS)

    def receive(self, number: int, came_ns: int | None = None) -> bool:
        """Counts one message; returns False if its number is there already.

        It came at `came_ns`, on a clock that never steps.
        """
        if came_ns is not None:
            if self._came_ns is not None and came_ns - self._came_ns > self.silence_ns:
                self.silence_ns = came_ns - self._came_ns
            self._came_ns = came_ns
        overtaken = number <= self._newest
        self._newest = max(self._newest, number)
        if not self._add(number):
            self.duplicate += 1
            return False
        self.reordered += overtaken
        self.received += 1
        return True

    def refill(self, number: int) -> bool:
        """Counts one message from the sender's memory; returns False if its number is there
        already.
        """
        new = self._add(number)
        self.refilled += new
        self.received += new
        return new

    def add_expected(self, made: int) -> None:
        """Counts as missing what is not there of the first `made` messages."""
        if made > self.last + 1:
            self._gaps.insert(self.last + 1, made - 1)
            self.last = made - 1

    def mark_unpublished(self, first: int, published: int = 0) -> int:
        """Takes the gap just below a number for not made: another start of the sender begins
        with it.

        The start before had `made` as many messages at least; what is missing of those stays
        missing. Returns the lowest number of those not made, the given one without any.
        """
        self.add_expected(first)
        gap = self._gaps.find(first - 1)
        if gap is None or (begin := max(gap[0], published)) >= first:
            return first
        self._gaps.remove(begin, first - 1)
        self.unpublished += first - begin
        return begin

    def mark_missing(self, first: int, last: int) -> None:
        """Counts as missing what was taken for not made."""
        self._gaps.insert(first, last)
        self.unpublished -= last + 1 - first

    def abandon_below(self, below: int) -> None:
        """Marks what is missing below a number as lost for good; if it comes all the same, it
        counts.
        """
        self._lost_below = max(self._lost_below, below)

    def find_requestable_gap(self, number: int = 0) -> tuple[int, int] | None:
        """Returns the first gap at or above a number that is not given up; None if there is
        none.
        """
        return self._gaps.find_from(max(number, self._lost_below))

    @property
    def expected(self) -> int:
        """Number of messages that are known to exist."""
        return self.last + 1 - self.unpublished

    @property
    def missing(self) -> int:
        """Number of missing messages."""
        return self.expected - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Missing numbers, as [first, last] pairs; the newest MAX_GAPS of them."""
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """Number of messages that the largest gap has."""
        return max((last - first + 1 for first, last in self._gaps), default=0)

    def describe(self, *before: "Account") -> str:
        """Returns the account in one line, for the file and for people.

        It is together with those `before`, of earlier starts that counted their messages from 0
        as well.
        """
        counts = {
            name: sum(getattr(one, name) for one in (*before, self))
            for name in (
                "expected",
                "received",
                "missing",
                "duplicate",
                "reordered",
                "refilled",
            )
        }
        gaps = self.format_gaps(SHOWN_GAPS)
        named = (
            f" ({' '.join(gaps)}{' ...' if len(self._gaps) > len(gaps) else ''})"
            if gaps
            else ""
        )
        silence = f", longest silence {self.silence_ns / 1e6:.1f} ms" if self.silence_ns else ""
        unmade = f", not made {self.unpublished}" if self.unpublished else ""
        starts = f", of {count_nouns(len(before) + 1, 'start')}" if before else ""
        return (
            ", ".join(f"{name} {count}" for name, count in counts.items())
            + f", largest gap {self.largest_gap}{named}{silence}{unmade}{starts}"
        )

    def format_gaps(self, most: int, base: int = 0) -> list[str]:
        """Returns the first gaps as "first-last", where number 0 stands for `base`."""
        pairs = zip(self._gaps, range(most), strict=False)
        return [f"{base + first}-{base + last}" for (first, last), _ in pairs]

    def _add(self, number: int) -> bool:
        if number > self.last:
            self.add_expected(number)
            self.last = number
            return True
        return self._gaps.remove(number)


class StartGap:
    """What one channel lacks between two starts of its sender, in whatever order others tell of
    it.

    The start before may have been killed, and has then not stated what it made: it made at
    least what others have heard of. What was `under_way` to the recorder died with it, and is
    taken for not made.
    """

    def __init__(self, account: Account, under_way: int) -> None:
        self._account = account
        self._under_way = under_way
        self._heard = 0
        # first that did not come, was not made, of the later start
        self._silent = self._begin = self._first = -1

    def begin_next_start(self, first: int, made: int) -> None:
        """The later start begins with a number; the one before stated how many messages it
        made, or 0.
        """
        if self._first < 0:
            self._first = first
            self._silent = self._begin = self._account.mark_unpublished(first, made)
            self.note_published(self._heard)

    def note_published(self, made: int) -> None:
        """Somebody knows of so many messages of the start before."""
        self._heard = max(self._heard, made)
        made = min(made, self._first)
        if made - self._silent > self._under_way and made > self._begin >= 0:
            self._account.mark_missing(self._begin, made - 1)
            self._begin = made


def describe_unknown_ends(sites: Sequence[str]) -> str:
    """Returns the sentence for sites whose event at their end never arrived."""
    whose = " and ".join([", ".join(sites[:-1]), sites[-1]] if len(sites) > 1 else sites)
    return f"the end of {whose} is unknown: later records may be missing"


def parse_counts(account: str) -> dict[str, int]:
    """Returns how many messages an account's text says are "received" and "missing"; {} if it
    is none.
    """
    return {word: int(n) for word, n in re.findall(r"(received|missing) (\d{1,15})\b", account)}


MIN_COVERAGE = 0.999
"""Least share of every site's ticks that must be judged, by default."""


class Coverage(NamedTuple):
    """How much of a run there is, or was judged: ticks by site, the judged ones and all."""

    judged: dict[str, int]
    expected: dict[str, int]

    @property
    def share(self) -> float:
        """Share of judged ticks of the site with the least; 0 if there are no ticks at all."""
        return (
            min(map(self._share, self.expected), default=0.0)
            if any(self.expected.values())
            else 0.0
        )

    def _share(self, site: str) -> float:
        expected = self.expected[site]
        return min(1.0, self.judged.get(site, 0) / expected) if expected else 1.0

    def __str__(self) -> str:
        lacking = {site: n for site in self.expected if (n := self._share(site)) < 1.0}
        if not lacking:
            return f"all {count_nouns(sum(self.expected.values()), 'tick')}"
        return ", ".join(
            f"{site} {self.judged.get(site, 0)} of "
            f"{count_nouns(self.expected[site], 'tick')} ({_percent(share)})"
            for site, share in lacking.items()
        )

    def describe(self, least: float) -> str:
        """Returns the coverage in words, and the share that was asked for if that is more."""
        short = f", less than {_percent(least)}" if self.share < least else ""
        return f"judged {self}{short}"

    def to_json(self) -> dict[str, list[int]]:
        """Returns the judged ticks and all ticks of every site."""
        return {
            site: [self.judged.get(site, 0), ticks] for site, ticks in self.expected.items()
        }


def _percent(share: float) -> str:
    """Returns a share in percent; no less than all is 100 %."""
    return f"{math.floor(1e5 * share) / 1e3:g} %"


OVERRUN = "overrun"
LAST = "last"
"""Kinds of events: of ticks that a site did not make, and how many others know of a start that
is gone.
"""
MAX_STARTS = 64
"""Starts of a member whose events are counted apart."""
EVENTS_NUMBERED_SINCE = 3
"""Events have numbers from this version of the schema on."""


class SessionAccounts:
    """Accounts of the numbered channels of a session.

    Args:
        session: its name.
        scenario: its scenario; None if it cannot be read.
        continued: True for a later part of a log, which is counted from its first message on.
        events: True if events have numbers.
    """

    def __init__(
        self,
        session: str,
        scenario: Scenario | None,
        *,
        continued: bool = False,
        events: bool = True,
    ) -> None:
        self._session = session
        self._continued = continued
        self._rates_hz = (
            {name: site.rate_hz for name, site in scenario.sites.items()} if scenario else {}
        )
        self._ticks = (
            {name: scenario.ticks(name) for name in scenario.names} if scenario else {}
        )
        self._ends: dict[str, int] = {}
        self._numbered = SITE_CHANNELS if events else (topics.STATE, topics.LINK)
        self._accounts: dict[str, Account] = {}
        self._starts: dict[
            str, dict[int, Account]
        ] = {}  # of events, by boot: each counts from 0
        self._bases: dict[str, int] = {}
        self._start_gaps: dict[tuple[str, int], StartGap] = {}

    def _topic(self, member: str, channel: str) -> str:
        return "/" + topics.key(self._session, member, channel)

    def open_channel(self, topic: str) -> None:
        """Opens the account of a channel, if it is a numbered one of the session."""
        key = topics.parse_key(topic.removeprefix("/"))
        if key is not None and key.session == self._session and key.channel in self._numbered:
            self._accounts.setdefault(topic, Account())

    def receive(self, topic: str, sequence: int, payload: bytes = b"") -> None:
        """Counts a message by its sequence number; the payload of an event may state the number
        of ticks.
        """
        if topic not in self._accounts:
            return
        member, channel = topic.split("/")[-2:]
        event: Event | None = None
        with suppress(WireError):  # an event that cannot be read counts like any other message
            event = (
                decode(payload, Event, READABLE)
                if channel == topics.EVENT and payload
                else None
            )
        number = number_message(channel, sequence, self._rates_hz.get(member, 0))
        if event is None:
            self.count(topic, number)
        else:
            self.receive_event(topic, number, event)
        if channel == topics.LINK:
            self._expect(member, topics.STATE, sequence + 1)

    def receive_event(self, topic: str, number: int, event: Event) -> bool:
        """Counts an event, and what it says of the ticks of a site; returns False if it is
        there already.
        """
        starts = self._starts.setdefault(topic, {})
        if event.boot not in starts and len(starts) < MAX_STARTS:
            starts[event.boot] = Account() if starts else self._accounts[topic]
            self._accounts[topic] = starts[event.boot]
        account = starts.get(event.boot, self._accounts[topic])
        is_first = account is next(iter(starts.values()))
        new = self.count(topic, number, account) if is_first else account.receive(number)
        self.apply_event(event)
        return new

    def apply_event(self, event: Event) -> None:
        """Counts what an event says of the ticks of a site."""
        if event.member not in self._rates_hz or event.ticks < 0:
            return
        if event.kind == "end":
            self._ends[event.member] = min(event.ticks, self._ticks[event.member])
            self.add_expected_ticks(event.member, self._ends[event.member])
        elif event.kind == "join" and event.ticks <= self._ticks[event.member]:
            made = self._ends.pop(event.member, 0)
            rate_hz = self._rates_hz[event.member]
            for channel, gap in self._find_start_gaps(event.member, event.boot):
                base = self._bases.get(self._topic(event.member, channel), 0)
                gap.begin_next_start(
                    *(count_messages(channel, n, rate_hz) - base for n in (event.ticks, made))
                )
        elif event.kind == OVERRUN:
            for first, last in re.findall(r"(\d{1,12})-(\d{1,12})", event.command):
                if int(first) <= int(last) < event.ticks:
                    self.mark_skipped_ticks(
                        event.member, int(last) + 1, int(last) + 1 - int(first)
                    )
        elif event.kind == LAST and event.about in self._rates_hz:
            for channel, gap in self._find_start_gaps(
                event.about, event.boots.get(event.about, 0)
            ):
                base = self._bases.get(self._topic(event.about, channel), 0)
                gap.note_published(
                    number_message(channel, event.ticks, self._rates_hz[event.about]) - base
                )

    def mark_skipped_ticks(self, site: str, tick: int, skipped: int) -> None:
        """Counts nothing as missing of so many ticks before one, which a site did not make."""
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            if topic in self._accounts:
                base = self._bases.get(topic, 0)
                numbers = skipped_numbers(channel, tick, skipped, self._rates_hz[site])
                self._accounts[topic].mark_unpublished(*(number - base for number in numbers))

    def count(self, topic: str, number: int, account: Account | None = None) -> bool:
        """Counts a message by its number in its channel; returns False if it is there already."""
        base = self._bases.setdefault(topic, number if self._continued else 0)
        return number < base or (account or self._accounts[topic]).receive(number - base)

    def _find_start_gaps(self, site: str, boot: int) -> Iterator[tuple[str, StartGap]]:
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            known = (topic, boot) in self._start_gaps
            if topic in self._accounts and (
                known or len(self._start_gaps) < MAX_STARTS * len(self._rates_hz)
            ):
                gap = StartGap(
                    self._accounts[topic], count_under_way(channel, self._rates_hz[site])
                )
                yield channel, self._start_gaps.setdefault((topic, boot), gap)

    def add_expected_ticks(self, site: str, ticks: int) -> None:
        """Counts as missing what a site published in so many ticks and is not there."""
        for channel in (topics.STATE, topics.LINK):
            self._expect(site, channel, count_messages(channel, ticks, self._rates_hz[site]))

    def _expect(self, member: str, channel: str, made: int) -> None:
        topic = self._topic(member, channel)
        if topic in self._accounts:
            self._accounts[topic].add_expected(made - self._bases.get(topic, 0))

    def format_accounts(self) -> dict[str, str]:
        """Returns the accounts by topic, as a file holds them."""
        return {
            topic: (f"from {base} on: " if (base := self._bases.get(topic, 0)) else "")
            + account.describe(*list(self._starts.get(topic, {}).values())[:-1])
            for topic, account in self._accounts.items()
            if account.expected or topic.split("/")[-2] in self._rates_hz
        }

    def list_starts(self, topic: str) -> list[Account]:
        """Returns the accounts of a channel: of events one for each start of their sender."""
        return list(self._starts.get(topic, {}).values()) or [self._accounts[topic]]

    def list_gaps(self, topic: str) -> list[tuple[int, int]]:
        """Returns the missing numbers of a channel, as (first, last)."""
        base = self._bases.get(topic, 0)
        return [
            (base + first, base + last)
            for one in self.list_starts(topic)
            for first, last in one.gaps
        ]

    def coverage(self) -> Coverage:
        """Returns the records that are there, of the ticks that each site made, else those of
        the run.
        """
        accounts = {
            site: self._accounts.get(self._topic(site, topics.STATE)) for site in self._rates_hz
        }
        there = {
            site: account.received for site, account in accounts.items() if account is not None
        }
        ticks = {
            site: min(most, self._ends.get(site, most))
            - (account.unpublished if account is not None else 0)
            for site, most in self._ticks.items()
            for account in [accounts.get(site)]
        }
        return Coverage(there, ticks)

    def describe_missing(self) -> Iterator[str]:
        """Yields a text per site that lacks records."""
        for site in self._rates_hz:
            topic = self._topic(site, topics.STATE)
            account = self._accounts.get(topic)
            if account is not None and account.missing:
                gaps = account.format_gaps(SHOWN_GAPS, self._bases.get(topic, 0))
                more = " ..." if len(account.gaps) > len(gaps) else ""
                yield (
                    f"{site}: {account.missing} of "
                    f"{count_nouns(account.expected, 'record')}: {' '.join(gaps)}{more}"
                )

    @property
    def unknown_ends(self) -> list[str]:
        """The sites whose event at their end is not there."""
        return [site for site in self._rates_hz if site not in self._ends]

    def describe_unfinished_sites(self) -> Iterator[str]:
        """Yields a text per site whose end is unknown and whose records end before the scenario
        does.
        """
        for site in self.unknown_ends:
            topic = self._topic(site, topics.STATE)
            account = self._accounts.get(topic)
            count = 0 if account is None else self._bases.get(topic, 0) + account.expected
            if count < self._ticks[site]:
                last = (f"tick {count - 1}") if count else "none"
                yield (
                    f"{site}: its end is unknown; its last record is {last}, of "
                    f"{count_nouns(self._ticks[site], 'tick')}"
                )


def open_session_accounts(
    metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]
) -> SessionAccounts | None:
    """Returns empty accounts for the messages of a file; None if it is no trilat-net log."""
    about = metadata.get(SESSION, {})
    try:
        scenario = parse_embedded(attachments[SCENARIO].decode(), SCENARIO)
        session = about["session"]
        version = int(about["schema_version"])
    except (KeyError, ValueError, ScenarioError):
        return None
    return SessionAccounts(
        session,
        scenario,
        continued=metadata.get(PART, {}).get("index", "1") != "1",
        events=version >= EVENTS_NUMBERED_SINCE,
    )

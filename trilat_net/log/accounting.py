"""Accounts of channels: which numbered messages were received, and which are missing.

An account counts the messages of one channel by number, live or from a log. The number of a
record is its tick. Statistics and events are numbered from 0.

Invariant:
    - expected = received + missing, always.
    - Ticks between two starts of a site were never published: they are neither expected nor
      missing.
    - Memory is bounded: of more than `MAX_GAPS` gaps, the lowest ones are only counted.
    - Accounts that are made from a file decode events only. They count a later part of a log
      from its first message on.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import NamedTuple

from ..errors import ScenarioError, WireError, count_nouns
from ..net import topics
from ..net.messages import READABLE, Event
from ..net.topics import count_messages, count_under_way, number_message, skipped_numbers
from ..net.wire import decode
from ..scenario import Scenario, parse_embedded
from .log_layout import PART, SCENARIO, SESSION, SITE_CHANNELS


class RangeSet:
    """A set of whole numbers, stored as ranges (first, last) in ascending order.

    Args:
        max_ranges: largest number of ranges; the lowest ranges are dropped beyond it.
    """

    def __init__(self, max_ranges: int) -> None:
        self._max_ranges = max_ranges
        self._ranges: list[tuple[int, int]] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._ranges)

    def __len__(self) -> int:
        return len(self._ranges)

    def _count_started(self, number: int) -> int:
        """Returns the number of ranges that begin at or below a number."""
        return bisect_right(self._ranges, (number, math.inf))

    def insert(self, first: int, last: int) -> None:
        """Inserts a range of numbers that the set does not contain yet."""
        index = self._count_started(first)
        if index > 0:
            previous_first, previous_last = self._ranges[index - 1]
            if previous_last == first - 1:
                self._ranges[index - 1] = previous_first, last
                return
        self._ranges.insert(index, (first, last))
        del self._ranges[: -self._max_ranges]

    def remove(self, number: int, last: int | None = None) -> bool:
        """Removes a number, or all numbers from it to `last`, which are in one range.

        Returns:
            False if the set does not contain the number.
        """
        containing = self.find(number)
        if containing is None:
            return False
        last_removed = last or number
        before = (containing[0], number - 1)
        after = (last_removed + 1, containing[1])
        remaining = [part for part in (before, after) if part[0] <= part[1]]
        index = self._count_started(number) - 1
        self._ranges[index : index + 1] = remaining
        del self._ranges[: -self._max_ranges]
        return True

    def find(self, number: int) -> tuple[int, int] | None:
        """Returns the range that contains a number, or None if there is no such range."""
        index = self._count_started(number) - 1
        if index < 0 or number > self._ranges[index][1]:
            return None
        return self._ranges[index]

    def find_from(self, number: int) -> tuple[int, int] | None:
        """Returns the first range that reaches a number, without its part below the number.

        Returns None if the set has no number at or above that number.
        """
        index = max(0, self._count_started(number) - 1)
        for first, last in self._ranges[index : index + 2]:
            if last >= number:
                return max(number, first), last
        return None


MAX_GAPS = 50_000
"""Number of gaps that an account stores. Of lower gaps it counts only the messages."""
SHOWN_GAPS = 20
"""Number of gaps that a text lists."""


class Account:
    """The account of one channel.

    Attributes:
        received: messages that were received, each number once.
        duplicate: messages that arrived although their number had been received.
        reordered: messages that arrived after a message with a higher number.
        refilled: messages that were missing, and then came from the sender's memory.
        unpublished: numbers that no message has, because the sender skipped these numbers, or
            ended before them and started again behind them.
        last: largest number that is known to exist; -1 before the first message.
        silence_ns: the longest time between two arrivals, in ns; 0 without arrival times.
    """

    def __init__(self) -> None:
        self.received = 0
        self.duplicate = 0
        self.reordered = 0
        self.refilled = 0
        self.unpublished = 0
        self.last = -1
        self.silence_ns = 0
        # No member has the missing messages below this number.
        self._abandoned_below = 0
        # Largest number that arrived without a request.
        self._newest = -1
        self._last_arrival_ns: int | None = None
        self._gaps = RangeSet(MAX_GAPS)

    def receive(self, number: int, arrived_ns: int | None = None) -> bool:
        """Counts a message that its sender published.

        Args:
            number: number of the message.
            arrived_ns: arrival on a clock that never steps; None if it is unknown.

        Returns:
            False if the number had been received before.
        """
        if arrived_ns is not None:
            if self._last_arrival_ns is not None:
                self.silence_ns = max(self.silence_ns, arrived_ns - self._last_arrival_ns)
            self._last_arrival_ns = arrived_ns
        is_overtaken = number <= self._newest
        self._newest = max(self._newest, number)
        if not self._add(number):
            self.duplicate += 1
            return False
        self.reordered += is_overtaken
        self.received += 1
        return True

    def refill(self, number: int) -> bool:
        """Counts a message from the sender's memory.

        Returns:
            False if the number had been received before.
        """
        is_new = self._add(number)
        self.refilled += is_new
        self.received += is_new
        return is_new

    def add_expected(self, published: int) -> None:
        """Adds the first `published` messages to the expected messages.

        Messages that are not known yet count as missing.
        """
        if published > self.last + 1:
            self._gaps.insert(self.last + 1, published - 1)
            self.last = published - 1

    def mark_unpublished(self, first: int, published: int = 0) -> int:
        """Counts the gap just below a number as never published.

        Args:
            first: first number of the sender's next start, or after a pause.
            published: number of messages that exist at least; missing messages among them stay
                missing.

        Returns:
            The lowest number that counts as never published, or `first` if there is none.
        """
        self.add_expected(first)
        gap = self._gaps.find(first - 1)
        if gap is None:
            return first
        lowest = max(gap[0], published)
        if lowest >= first:
            return first
        self._gaps.remove(lowest, first - 1)
        self.unpublished += first - lowest
        return lowest

    def mark_missing(self, first: int, last: int) -> None:
        """Counts a range of numbers as missing that counted as never published."""
        self._gaps.insert(first, last)
        self.unpublished -= last + 1 - first

    def abandon_below(self, number: int) -> None:
        """Stops requests for the missing messages below a number.

        Such a message still counts if it arrives.
        """
        self._abandoned_below = max(self._abandoned_below, number)

    def find_requestable_gap(self, number: int = 0) -> tuple[int, int] | None:
        """Returns the first gap at or above a number that is not abandoned, or None."""
        return self._gaps.find_from(max(number, self._abandoned_below))

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
        """Missing numbers as [first, last] pairs: the highest MAX_GAPS gaps."""
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """Number of messages in the largest gap."""
        return max((last - first + 1 for first, last in self._gaps), default=0)

    def describe(self, *before: "Account") -> str:
        """Returns the account in one line, as a log stores it.

        Args:
            *before: accounts of earlier starts of the sender, which numbered their messages
                from 0 as well. Their counts are added.
        """
        starts = (*before, self)
        counts = []
        for name in ("expected", "received", "missing", "duplicate", "reordered", "refilled"):
            total = sum(getattr(start, name) for start in starts)
            counts.append(f"{name} {total}")
        text = ", ".join(counts)
        text += f", largest gap {self.largest_gap}"
        gaps = self.format_gaps(SHOWN_GAPS)
        if gaps:
            more = " ..." if len(self._gaps) > len(gaps) else ""
            text += f" ({' '.join(gaps)}{more})"
        if self.silence_ns:
            text += f", longest silence {self.silence_ns / 1e6:.1f} ms"
        if self.unpublished:
            text += f", not made {self.unpublished}"
        if before:
            text += f", of {count_nouns(len(starts), 'start')}"
        return text

    def format_gaps(self, most: int, base: int = 0) -> list[str]:
        """Returns at most `most` of the first gaps as "first-last".

        Args:
            most: largest number of gaps.
            base: number of the message that this account counts as 0.
        """
        gaps = islice(self._gaps, most)
        return [f"{base + first}-{base + last}" for first, last in gaps]

    def _add(self, number: int) -> bool:
        """Adds a received number; returns False if the number had been added before."""
        if number > self.last:
            self.add_expected(number)
            self.last = number
            return True
        return self._gaps.remove(number)


class StartGap:
    """Missing messages of one channel between two starts of its sender.

    The earlier start may have been killed before it stated how many messages it published.
    Other members may know a number of messages that it published at least; their reports come
    in any order, before or after the next start. Messages that were still under way to the
    recorder died with the sender, and count as never published.

    Args:
        account: account of the channel.
        under_way: largest number of messages that may have been under way.
    """

    def __init__(self, account: Account, under_way: int) -> None:
        self._account = account
        self._under_way = under_way
        # Messages that the earlier start published, as others report.
        self._reported = 0
        # First number that never arrived.
        self._first_silent = -1
        # First number that counts as never published.
        self._first_unpublished = -1
        # First number of the next start; -1 before the next start.
        self._next_first = -1

    def begin_next_start(self, first: int, published: int) -> None:
        """Starts the next start of the sender.

        Args:
            first: first number of the next start.
            published: number of messages that the earlier start stated to have published; 0 if
                it stated no number.
        """
        if self._next_first < 0:
            self._next_first = first
            self._first_silent = self._account.mark_unpublished(first, published)
            self._first_unpublished = self._first_silent
            self.note_published(self._reported)

    def note_published(self, published: int) -> None:
        """Notes the number of messages that the earlier start published at least."""
        self._reported = max(self._reported, published)
        published = min(published, self._next_first)
        is_beyond_under_way = published - self._first_silent > self._under_way
        if is_beyond_under_way and published > self._first_unpublished >= 0:
            self._account.mark_missing(self._first_unpublished, published - 1)
            self._first_unpublished = published


def describe_unknown_ends(sites: Sequence[str]) -> str:
    """Returns the sentence for sites whose event at their end never arrived."""
    names = sites[0]
    if len(sites) > 1:
        names = f"{', '.join(sites[:-1])} and {sites[-1]}"
    return f"the end of {names} is unknown: later records may be missing"


def parse_counts(account: str) -> dict[str, int]:
    """Returns the numbers of "received" and "missing" messages in an account's text.

    The dictionary is empty if the text is not that of an account.
    """
    matches = re.findall(r"(received|missing) (\d{1,15})\b", account)
    return {name: int(digits) for name, digits in matches}


MIN_COVERAGE = 0.999
"""Default of the smallest share of every site's ticks that must be judged."""


class Coverage(NamedTuple):
    """Coverage of a run: how many ticks of each site were recorded or judged.

    Attributes:
        judged: number of recorded or judged ticks, by site.
        expected: number of all ticks, by site.
    """

    judged: dict[str, int]
    expected: dict[str, int]

    @property
    def share(self) -> float:
        """Smallest share of judged ticks of any site; 0 if there are no ticks at all."""
        if not any(self.expected.values()):
            return 0.0
        return min(map(self._share, self.expected), default=0.0)

    def _share(self, site: str) -> float:
        """Returns the share of judged ticks of a site; 1 for a site without ticks."""
        expected = self.expected[site]
        if not expected:
            return 1.0
        return min(1.0, self.judged.get(site, 0) / expected)

    def __str__(self) -> str:
        incomplete = [site for site in self.expected if self._share(site) < 1.0]
        if not incomplete:
            return f"all {count_nouns(sum(self.expected.values()), 'tick')}"
        return ", ".join(map(self._describe_site, incomplete))

    def _describe_site(self, site: str) -> str:
        """Returns the coverage of a site as a text."""
        ticks = count_nouns(self.expected[site], "tick")
        percent = _format_percent(self._share(site))
        return f"{site} {self.judged.get(site, 0)} of {ticks} ({percent})"

    def describe(self, least: float) -> str:
        """Returns the coverage as a text, which names `least` if the share is below it."""
        shortage = f", less than {_format_percent(least)}" if self.share < least else ""
        return f"judged {self}{shortage}"

    def to_json(self) -> dict[str, list[int]]:
        """Returns [judged ticks, all ticks] of every site."""
        return {
            site: [self.judged.get(site, 0), ticks] for site, ticks in self.expected.items()
        }


def _format_percent(share: float) -> str:
    """Returns a share in percent, rounded down so that only a full share is 100 %."""
    return f"{math.floor(1e5 * share) / 1e3:g} %"


OVERRUN = "overrun"
"""Kind of the event that lists the ticks that a site skipped."""
LAST = "last"
"""Kind of the event that states how many ticks others received of an earlier start."""
MAX_STARTS = 64
"""Number of starts of a member whose events are counted separately."""
EVENTS_NUMBERED_SINCE = 3
"""First version of the schema whose events have numbers."""


class SessionAccounts:
    """Accounts of the numbered channels of a session.

    Args:
        session: name of the session.
        scenario: scenario of the session; None if it cannot be read.
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
        self._rates_hz: dict[str, int] = {}
        self._ticks: dict[str, int] = {}
        if scenario:
            self._rates_hz = {name: site.rate_hz for name, site in scenario.sites.items()}
            self._ticks = {name: scenario.ticks(name) for name in scenario.names}
        self._end_ticks: dict[str, int] = {}
        self._numbered_channels = SITE_CHANNELS if events else (topics.STATE, topics.LINK)
        self._accounts: dict[str, Account] = {}
        # Accounts of events by boot: every start of a member numbers its events from 0.
        self._starts: dict[str, dict[int, Account]] = {}
        # Numbers of the messages that accounts count as 0, by topic.
        self._bases: dict[str, int] = {}
        self._start_gaps: dict[tuple[str, int], StartGap] = {}

    def _topic(self, member: str, channel: str) -> str:
        """Returns the topic of a member's channel."""
        return "/" + topics.key(self._session, member, channel)

    def open_channel(self, topic: str) -> None:
        """Opens the account of a topic, if the topic is a numbered channel of the session."""
        key = topics.parse_key(topic.removeprefix("/"))
        if key is None or key.session != self._session:
            return
        if key.channel in self._numbered_channels:
            self._accounts.setdefault(topic, Account())

    def receive(self, topic: str, sequence: int, payload: bytes = b"") -> None:
        """Counts a message by its sequence number.

        Args:
            topic: topic of the message.
            sequence: its sequence number in the file: the tick of records and statistics.
            payload: its bytes; an event may state the number of a site's ticks.
        """
        if topic not in self._accounts:
            return
        member, channel = topic.split("/")[-2:]
        event: Event | None = None
        if channel == topics.EVENT and payload:
            with suppress(WireError):  # an unreadable event counts like any other message
                event = decode(payload, Event, READABLE)
        number = number_message(channel, sequence, self._rates_hz.get(member, 0))
        if event is None:
            self.count_message(topic, number)
        else:
            self.receive_event(topic, number, event)
        if channel == topics.LINK:
            self._add_expected(member, topics.STATE, sequence + 1)

    def receive_event(self, topic: str, number: int, event: Event) -> bool:
        """Counts an event, and applies its statements on the ticks of a site.

        Returns:
            False if the event had been received before.
        """
        starts = self._starts.setdefault(topic, {})
        if event.boot not in starts and len(starts) < MAX_STARTS:
            starts[event.boot] = Account() if starts else self._accounts[topic]
            self._accounts[topic] = starts[event.boot]
        account = starts.get(event.boot, self._accounts[topic])
        first_start = next(iter(starts.values()))
        if account is first_start:
            is_new = self.count_message(topic, number, account)
        else:
            is_new = account.receive(number)
        self.apply_event(event)
        return is_new

    def apply_event(self, event: Event) -> None:
        """Applies the statements of an event on the ticks that sites made or skipped."""
        if event.member not in self._rates_hz or event.ticks < 0:
            return
        if event.kind == "end":
            self._end_ticks[event.member] = min(event.ticks, self._ticks[event.member])
            self.add_expected_ticks(event.member, self._end_ticks[event.member])
        elif event.kind == "join" and event.ticks <= self._ticks[event.member]:
            self._apply_join(event)
        elif event.kind == OVERRUN:
            self._apply_overrun(event)
        elif event.kind == LAST and event.about in self._rates_hz:
            self._apply_last(event)

    def _apply_join(self, event: Event) -> None:
        """Begins the next start of a site, from the tick that its event states."""
        site = event.member
        published_ticks = self._end_ticks.pop(site, 0)
        rate_hz = self._rates_hz[site]
        for channel, gap in self._find_start_gaps(site, event.boot):
            base = self._bases.get(self._topic(site, channel), 0)
            first = count_messages(channel, event.ticks, rate_hz) - base
            published = count_messages(channel, published_ticks, rate_hz) - base
            gap.begin_next_start(first, published)

    def _apply_overrun(self, event: Event) -> None:
        """Marks the ranges of ticks that an event lists as skipped."""
        ranges = re.findall(r"(\d{1,12})-(\d{1,12})", event.command)
        for first_digits, last_digits in ranges:
            first = int(first_digits)
            last = int(last_digits)
            if first <= last < event.ticks:
                self.mark_skipped_ticks(event.member, last + 1, last + 1 - first)

    def _apply_last(self, event: Event) -> None:
        """Notes how many ticks of an earlier start of a site another site received."""
        site = event.about
        for channel, gap in self._find_start_gaps(site, event.boots.get(site, 0)):
            base = self._bases.get(self._topic(site, channel), 0)
            number = number_message(channel, event.ticks, self._rates_hz[site])
            gap.note_published(number - base)

    def mark_skipped_ticks(self, site: str, tick: int, skipped: int) -> None:
        """Counts the messages of `skipped` ticks before `tick` as never published."""
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            account = self._accounts.get(topic)
            if account is None:
                continue
            base = self._bases.get(topic, 0)
            first, published = skipped_numbers(channel, tick, skipped, self._rates_hz[site])
            account.mark_unpublished(first - base, published - base)

    def count_message(self, topic: str, number: int, account: Account | None = None) -> bool:
        """Counts a message by its number in its channel.

        Args:
            topic: topic of the message.
            number: number of the message.
            account: the account to use; by default that of the topic.

        Returns:
            False if the message had been received before.
        """
        base = self._bases.setdefault(topic, number if self._continued else 0)
        if number < base:
            return True
        account = account or self._accounts[topic]
        return account.receive(number - base)

    def _find_start_gaps(self, site: str, boot: int) -> Iterator[tuple[str, StartGap]]:
        """Yields the channels of a site, with the gap before its start `boot`."""
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            if topic not in self._accounts:
                continue
            gap = self._start_gaps.get((topic, boot))
            has_room = len(self._start_gaps) < MAX_STARTS * len(self._rates_hz)
            if gap is None and has_room:
                under_way = count_under_way(channel, self._rates_hz[site])
                gap = StartGap(self._accounts[topic], under_way)
                self._start_gaps[topic, boot] = gap
            if gap is not None:
                yield channel, gap

    def add_expected_ticks(self, site: str, ticks: int) -> None:
        """Adds the messages of a site's first `ticks` ticks to the expected messages.

        Messages that the log lacks count as missing.
        """
        for channel in (topics.STATE, topics.LINK):
            published = count_messages(channel, ticks, self._rates_hz[site])
            self._add_expected(site, channel, published)

    def _add_expected(self, member: str, channel: str, published: int) -> None:
        """Adds the first `published` messages of a channel to the expected messages."""
        topic = self._topic(member, channel)
        account = self._accounts.get(topic)
        if account is not None:
            base = self._bases.get(topic, 0)
            account.add_expected(published - base)

    def format_accounts(self) -> dict[str, str]:
        """Returns the accounts as texts, by topic, as a file stores them."""
        texts = {}
        for topic, account in self._accounts.items():
            member = topic.split("/")[-2]
            if not account.expected and member not in self._rates_hz:
                continue
            earlier_starts = list(self._starts.get(topic, {}).values())[:-1]
            base = self._bases.get(topic, 0)
            prefix = f"from {base} on: " if base else ""
            texts[topic] = prefix + account.describe(*earlier_starts)
        return texts

    def list_starts(self, topic: str) -> list[Account]:
        """Returns the accounts of a topic: of events, one for each start of their sender."""
        return list(self._starts.get(topic, {}).values()) or [self._accounts[topic]]

    def list_gaps(self, topic: str) -> list[tuple[int, int]]:
        """Returns the ranges (first, last) of missing numbers of a topic."""
        base = self._bases.get(topic, 0)
        gaps = []
        for account in self.list_starts(topic):
            gaps += [(base + first, base + last) for first, last in account.gaps]
        return gaps

    def coverage(self) -> Coverage:
        """Returns the number of records and of ticks of every site.

        A site whose end is unknown is expected to make all ticks of the scenario.
        """
        records = {}
        ticks = {}
        for site, scenario_ticks in self._ticks.items():
            account = self._accounts.get(self._topic(site, topics.STATE))
            end_ticks = self._end_ticks.get(site, scenario_ticks)
            unpublished = 0
            if account is not None:
                records[site] = account.received
                unpublished = account.unpublished
            ticks[site] = min(scenario_ticks, end_ticks) - unpublished
        return Coverage(records, ticks)

    def describe_missing(self) -> Iterator[str]:
        """Yields a text for every site that lacks records."""
        for site in self._rates_hz:
            topic = self._topic(site, topics.STATE)
            account = self._accounts.get(topic)
            if account is None or not account.missing:
                continue
            gaps = account.format_gaps(SHOWN_GAPS, self._bases.get(topic, 0))
            more = " ..." if len(account.gaps) > len(gaps) else ""
            records = count_nouns(account.expected, "record")
            yield f"{site}: {account.missing} of {records}: {' '.join(gaps)}{more}"

    @property
    def unknown_ends(self) -> list[str]:
        """The sites whose event at their end never arrived."""
        return [site for site in self._rates_hz if site not in self._end_ticks]

    def describe_unfinished_sites(self) -> Iterator[str]:
        """Yields a text for every site with an unknown end whose last ticks are missing."""
        for site in self.unknown_ends:
            topic = self._topic(site, topics.STATE)
            account = self._accounts.get(topic)
            count = 0
            if account is not None:
                count = self._bases.get(topic, 0) + account.expected
            if count < self._ticks[site]:
                last = f"tick {count - 1}" if count else "none"
                ticks = count_nouns(self._ticks[site], "tick")
                yield f"{site}: its end is unknown; its last record is {last}, of {ticks}"


def open_session_accounts(
    metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]
) -> SessionAccounts | None:
    """Returns empty accounts for the messages of a file.

    Args:
        metadata: metadata of the file, by name.
        attachments: attachments of the file, by name.

    Returns:
        The accounts; None if the file is not a log of trilat-net.
    """
    session_facts = metadata.get(SESSION, {})
    try:
        scenario = parse_embedded(attachments[SCENARIO].decode(), SCENARIO)
        session = session_facts["session"]
        version = int(session_facts["schema_version"])
    except (KeyError, ValueError, ScenarioError):
        return None
    return SessionAccounts(
        session,
        scenario,
        continued=metadata.get(PART, {}).get("index", "1") != "1",
        events=version >= EVENTS_NUMBERED_SINCE,
    )

"""Counts the messages of a session: which were received, and which are missing.

The messages of a channel are numbered consecutively. Therefore a gap in the numbers shows that
a message is missing. An `Account` holds these counts for one channel. A recorder updates its
accounts while it records, and a tool can compute them again later from the log.

A site is a process that runs one arm. A tick is one period of its control loop, and a record is
the message with the results of one tick. The number of a record is the number of its tick.
Statistics and events are numbered from 0.

Some numbers never had a message: a site that is late skips ticks, and a site that is killed and
started again continues at a later tick. These numbers count as unpublished instead of missing.

Invariant:
    - In every account, the number of expected messages is the sum of the received and the
      missing messages.
    - Unpublished numbers are neither expected nor missing.
    - The memory is bounded: an account stores at most `MAX_GAPS` ranges of missing numbers. If
      there are more ranges, those with the lowest numbers are forgotten, but their messages
      still count as missing.
    - To count the messages of a file, only the events are decoded.
    - If a log is divided into several files, a later file is counted from its first message on.
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
    """Set of integers, such as the numbers of missing messages, stored as ranges.

    A range is a pair of its first and its last number. The ranges are in ascending order. Thus
    long sequences of numbers need little memory.

    Args:
        max_ranges: Largest number of ranges. If there are more, the lowest ones are forgotten.
    """

    def __init__(self, max_ranges: int) -> None:
        self._max_ranges = max_ranges
        self._ranges: list[tuple[int, int]] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._ranges)

    def __len__(self) -> int:
        return len(self._ranges)

    def _count_started(self, number: int) -> int:
        """Returns the number of ranges whose first number is at most `number`."""
        return bisect_right(self._ranges, (number, math.inf))

    def insert(self, first: int, last: int) -> None:
        """Inserts a range of consecutive numbers, none of which the set contains yet.

        If the set contains the number before the range, the range extends that one. It is not
        merged with a range directly behind it, which would only save memory. If there are too
        many ranges afterwards, those with the lowest numbers are forgotten.

        Args:
            first: First number of the range.
            last: Last number of the range, which belongs to it.
        """
        index = self._count_started(first)  # the new range belongs at this index
        if index > 0:
            previous_first, previous_last = self._ranges[index - 1]
            continues_previous = previous_last == first - 1
            if continues_previous:
                self._ranges[index - 1] = previous_first, last
                return
        self._ranges.insert(index, (first, last))
        self._forget_lowest()

    def _forget_lowest(self) -> None:
        """Removes the ranges with the lowest numbers if there are more than permitted."""
        del self._ranges[: -self._max_ranges]

    def remove(self, number: int, last: int | None = None) -> bool:
        """Removes a number, or the numbers from `number` to `last`.

        All numbers to remove must be in one range of the set. What remains of that range is one
        range, two ranges or nothing.

        Args:
            number: The number, or the first of several numbers.
            last: Last number to remove. None removes only `number`.

        Returns:
            False if the set does not contain `number`. Nothing is removed in this case.
        """
        containing = self.find(number)
        if containing is None:
            return False

        last_removed = number if last is None else last
        before = (containing[0], number - 1)
        after = (last_removed + 1, containing[1])
        remaining = [part for part in (before, after) if part[0] <= part[1]]
        index = self._count_started(number) - 1
        self._ranges[index : index + 1] = remaining
        self._forget_lowest()
        return True

    def find(self, number: int) -> tuple[int, int] | None:
        """Returns the range of consecutive numbers in the set that contains a number.

        Args:
            number: The number to look for.

        Returns:
            The first and the last number of the range. None if the set does not contain the
            number.
        """
        index = self._count_started(number) - 1
        if index < 0 or number > self._ranges[index][1]:
            return None
        return self._ranges[index]

    def find_from(self, number: int) -> tuple[int, int] | None:
        """Finds the first range of numbers in the set that are at or above a number.

        If a range of the set contains the number, only the part from the number on is returned.

        Args:
            number: Smallest number of interest.

        Returns:
            The first and the last number of the range. None if all numbers of the set are
            lower.
        """
        # The range that starts at or below the number may contain it. If it does not, the next
        # range is entirely above the number.
        index = max(0, self._count_started(number) - 1)
        for first, last in self._ranges[index : index + 2]:
            if last >= number:
                return max(number, first), last
        return None


MAX_GAPS = 50_000
"""Largest number of gaps that an account stores. The messages of lower gaps are only counted.
"""
SHOWN_GAPS = 20
"""Largest number of gaps that are listed in a text."""


class Account:
    """Counts the messages of one channel, and knows which of their numbers are missing.

    Attributes:
        received: Number of messages that were received, without repetitions.
        duplicate: Number of messages that arrived although a message with their number had been
            received.
        reordered: Number of messages that arrived after a message with a higher number.
        refilled: Number of messages that were missing at first, and that the sender sent again
            from its memory.
        unpublished: How many numbers never had a message. The sender skipped them, or was
            killed before it reached them and continued behind them after its next start.
        last: Largest number of a message that is known to exist. It is -1 before the first
            message.
        silence_ns: Longest time between two arrivals, in ns. It is 0 without arrival times.
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
        """Counts a message that arrived from its sender without a request.

        Missing numbers between the previous messages and this one are noted as a gap.

        Args:
            number: Number of the message in its channel.
            arrived_ns: Time of the arrival on a monotonic clock, in ns. None if it is unknown.

        Returns:
            True if the message is new. False if a message with this number had been received
            before.
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
        """Counts a message that the sender sent again from its memory, as requested.

        Args:
            number: Number of the message in its channel.

        Returns:
            True if the message is new. False if a message with this number had been received
            before.
        """
        is_new = self._add(number)
        self.refilled += is_new
        self.received += is_new
        return is_new

    def add_expected(self, published: int) -> None:
        """States that the sender has published at least `published` messages, numbered from 0.

        Those that have not been received count as missing from now on.
        """
        if published > self.last + 1:
            self._gaps.insert(self.last + 1, published - 1)
            self.last = published - 1

    def mark_unpublished(self, first: int, published: int = 0) -> int:
        """Notes that the missing numbers just below a number never had a message.

        This happens when the sender skips numbers, or is killed and started again. The missing
        numbers form a range that ends just below `first`. Those of them from `published` on
        count as unpublished instead of missing.

        Args:
            first: Number of the first message after the gap. It is the first message that the
                sender published after its next start, or after the numbers that it skipped.
            published: Number of messages that are known to have been published before the gap.
                They have the numbers below `published`. Those of them that were not received
                stay missing.

        Returns:
            The lowest number that counts as unpublished from now on. It is `first` if there is
            no such number.
        """
        self.add_expected(first)
        gap = self._gaps.find(first - 1)
        if gap is None:  # the message just below was received
            return first
        gap_first, _ = gap
        lowest_unpublished = max(gap_first, published)
        if lowest_unpublished >= first:
            return first
        self._gaps.remove(lowest_unpublished, first - 1)
        self.unpublished += first - lowest_unpublished
        return lowest_unpublished

    def mark_missing(self, first: int, last: int) -> None:
        """Counts numbers as missing that had been counted as unpublished.

        This is necessary when another site reports that messages with these numbers existed.

        Args:
            first: First number of the range.
            last: Last number of the range, which belongs to it.
        """
        self._gaps.insert(first, last)
        self.unpublished -= last + 1 - first

    def abandon_below(self, number: int) -> None:
        """Gives up the missing messages below a number, because nobody can send them any more.

        They are no longer requested, but still count as missing. Such a message still counts as
        received if it arrives.

        Args:
            number: First number that is not affected.
        """
        self._abandoned_below = max(self._abandoned_below, number)

    def find_requestable_gap(self, number: int = 0) -> tuple[int, int] | None:
        """Finds the first missing messages that can still be requested from the sender.

        Args:
            number: Smallest number to consider.

        Returns:
            The first and the last number of the gap. None if no message can be requested.
        """
        return self._gaps.find_from(max(number, self._abandoned_below))

    @property
    def expected(self) -> int:
        """Number of messages that are known to have been published."""
        return self.last + 1 - self.unpublished

    @property
    def missing(self) -> int:
        """Number of messages that were published but not received."""
        return self.expected - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Ranges of missing numbers in ascending order, as pairs [first, last].

        There are at most `MAX_GAPS` pairs: those with the highest numbers.
        """
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """Number of missing messages in the largest gap. It is 0 if no message is missing."""
        return max((last - first + 1 for first, last in self._gaps), default=0)

    def describe(self, *before: "Account") -> str:
        """Describes the account of a channel in one line, in the form that a log stores.

        The line contains the numbers of expected, received and missing messages, and the first
        ranges of missing numbers.

        Args:
            *before: Accounts of earlier starts of the sender, which numbered their messages
                from 0 as well. Their counts are added to those of this account. Missing ranges
                are listed for the last start only.

        Returns:
            The line, which `parse_counts` can read.
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
        """Formats the first ranges of missing numbers for a message to the user.

        Args:
            most: Largest number of ranges to return.
            base: Number that is added to all numbers, if the account does not count from the
                first message of the session.

        Returns:
            A string "first-last" for each range. Empty if no message is missing.
        """
        gaps = islice(self._gaps, most)
        return [f"{base + first}-{base + last}" for first, last in gaps]

    def _add(self, number: int) -> bool:
        """Removes a number from the gaps, or extends the known numbers up to it.

        Returns:
            False if the number had been added before.
        """
        if number > self.last:
            self.add_expected(number)
            self.last = number
            return True
        return self._gaps.remove(number)


class StartGap:
    """Gap between the messages of two starts of a site, in one channel.

    A site that is killed cannot state how many messages it published. After its next start it
    continues at a later tick. The messages in between were either published and lost on the way
    to the recorder, or never published. Other sites may have received samples of the earlier
    start. In that case these sites know a number of messages that the earlier start published
    at least. Their reports may arrive before or after the next start. A few messages were still
    in transit to the recorder when the site was killed. These count as unpublished.

    The numbers of the gap are divided at one point, which only moves up:

        received | missing | unpublished | next start
                 ^         ^             ^
                 |         |             _next_first
                 |         _first_unpublished
                 _first_silent

    Args:
        account: Account of the channel.
        under_way: Largest number of messages that may have been in transit.
    """

    def __init__(self, account: Account, under_way: int) -> None:
        self._account = account
        self._under_way = under_way
        # Largest number of messages that the earlier start published, as other sites report.
        self._reported = 0
        # First number of the gap: no message from this number on to the next start arrived. It
        # is -1 until the next start is known.
        self._first_silent = -1
        # First number that counts as unpublished. It is -1 until the next start is known.
        self._first_unpublished = -1
        # First number of the next start. It is -1 until the next start is known.
        self._next_first = -1

    def begin_next_start(self, first: int, published: int) -> None:
        """Evaluates the gap before the next start of the site, once that start is known.

        The site was killed and has been started again. The missing messages just before the
        next start now count as unpublished in the account, except the messages that the site
        itself is known to have published. Reports of other sites that arrived earlier are then
        evaluated. They may turn some of these numbers into missing ones again. Only the first
        call has an effect.

        Args:
            first: Number of the first message that belongs to the next start.
            published: Number of messages of the earlier start, as that start itself stated when
                it ended. It is 0 if the site was killed before it could state the number.
        """
        is_evaluated = self._next_first >= 0
        if is_evaluated:
            return
        self._next_first = first
        self._first_silent = self._account.mark_unpublished(first, published)
        self._first_unpublished = self._first_silent
        self.note_published(self._reported)

    def note_published(self, published: int) -> None:
        """Takes into account how many messages the site published before it was killed.

        Other sites report this number, because they received samples, the states that a site
        sends. Missing messages before the next start first count as unpublished, because they
        may have been in transit when the site was killed. If the reported number shows that
        more messages were lost than can have been in transit, all lost messages count as
        missing instead: the numbers from `_first_unpublished` to below the reported number.

        Before the next start is known, the report is only stored. `begin_next_start` evaluates
        it later.

        Args:
            published: Number of messages that the site published at least. They have the
                numbers below it.
        """
        self._reported = max(self._reported, published)
        # Messages of the next start do not belong to the gap.
        published_before = min(published, self._next_first)
        lost = published_before - self._first_silent
        are_too_many_for_transit = lost > self._under_way
        is_next_start_known = self._first_unpublished >= 0
        has_news = published_before > self._first_unpublished
        if are_too_many_for_transit and is_next_start_known and has_news:
            self._account.mark_missing(self._first_unpublished, published_before - 1)
            self._first_unpublished = published_before


def describe_unknown_ends(sites: Sequence[str]) -> str:
    """Returns a sentence for the user about sites of which the end is unknown.

    A site publishes an "end" event when it ends. Without this event, nobody knows whether the
    site published further records after the last record that was received.

    Args:
        sites: Names of the sites whose "end" event was not received, at least one.
    """
    names = sites[0]
    if len(sites) > 1:
        names = f"{', '.join(sites[:-1])} and {sites[-1]}"
    return f"the end of {names} is unknown: later records may be missing"


def parse_counts(account: str) -> dict[str, int]:
    """Reads the numbers of received and missing messages from a line of `Account.describe`.

    Args:
        account: The line, as a log stores it for each topic.

    Returns:
        The numbers, under the keys "received" and "missing". Empty if the text is no such line.
    """
    matches = re.findall(r"(received|missing) (\d{1,15})\b", account)
    return {name: int(digits) for name, digits in matches}


MIN_COVERAGE = 0.999
"""Default of the smallest fraction of every site's ticks that must be judged."""


class Coverage(NamedTuple):
    """States for each site which part of a run was recorded, or checked by a tool.

    A site is a process that runs one arm. A tick is one period of its control loop.

    Attributes:
        judged: Number of recorded or checked ticks, by name of the site.
        expected: Number of all ticks of the site in the run, by name of the site.
    """

    judged: dict[str, int]
    expected: dict[str, int]

    @property
    def share(self) -> float:
        """Smallest fraction of recorded or checked ticks of any site, from 0 to 1.

        It is 0 if no site has ticks.
        """
        if not any(self.expected.values()):
            return 0.0
        return min(map(self._share, self.expected), default=0.0)

    def _share(self, site: str) -> float:
        """Returns the fraction of judged ticks of a site. It is 1 for a site without ticks."""
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
        """Returns the coverage of a site as a string, such as "m1 990 of 1000 ticks (99 %)"."""
        ticks = count_nouns(self.expected[site], "tick")
        percent = _format_percent(self._share(site))
        return f"{site} {self.judged.get(site, 0)} of {ticks} ({percent})"

    def describe(self, least: float) -> str:
        """Describes in words how much of the run was recorded or checked.

        Args:
            least: Smallest fraction of ticks that is sufficient, from 0 to 1. The text mentions
                it if the actual fraction is smaller.

        Returns:
            The text for the user.
        """
        shortage = f", less than {_format_percent(least)}" if self.share < least else ""
        return f"judged {self}{shortage}"

    def to_json(self) -> dict[str, list[int]]:
        """Converts the numbers of recorded or checked ticks to plain values for JSON.

        Returns:
            For each site the pair [recorded or checked ticks, all ticks]. A tick is one period
            of the control loop of the site.
        """
        return {
            site: [self.judged.get(site, 0), ticks] for site, ticks in self.expected.items()
        }


def _format_percent(share: float) -> str:
    """Formats a fraction as a percentage, rounded down so that only a full share is 100 %."""
    return f"{math.floor(1e5 * share) / 1e3:g} %"


OVERRUN = "overrun"
"""Kind of the event in which a site lists the ticks that it skipped because it was late."""
LAST = "last"
"""Kind of the event in which a site states how many ticks of a peer it had received before the
peer was started again.
"""
MAX_STARTS = 64
"""Largest number of starts of a member whose events are counted separately."""
EVENTS_NUMBERED_SINCE = 3
"""First version of the schema whose events have numbers."""


class SessionAccounts:
    """Counts the received and missing messages of all numbered channels of a session.

    A recorder uses this class while it records, and the tools use it to count the messages of a
    log. The caller passes every message. From the events, the class learns how many ticks the
    sites executed.

    Args:
        session: Name of the session.
        scenario: Scenario of the session. None if it cannot be read.
        continued: True for a later part of a log, which is counted from its first message on.
        events: True if events have numbers, which they lack in the oldest logs.
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
        # Accounts of events, by topic and by the boot, a random number that identifies a start
        # of the member. Every start numbers its events from 0.
        self._starts: dict[str, dict[int, Account]] = {}
        # Number of the first message of a later part, by topic. The account counts it as 0.
        self._bases: dict[str, int] = {}
        # Gap before a start of a site, by topic and boot.
        self._start_gaps: dict[tuple[str, int], StartGap] = {}

    def _topic(self, member: str, channel: str) -> str:
        """Returns the topic of a member's channel."""
        return "/" + topics.key(self._session, member, channel)

    def open_channel(self, topic: str) -> None:
        """Starts to count the messages of a channel, before its first message has arrived.

        If no message ever arrives, the losses are noticed nevertheless. Nothing happens if the
        topic does not belong to the session, or if the messages of its channel are not
        numbered.

        Args:
            topic: Topic of the channel, such as "/trilat/paper/m1/state".
        """
        key = topics.parse_key(topic.removeprefix("/"))
        if key is None or key.session != self._session:
            return
        if key.channel in self._numbered_channels:
            self._accounts.setdefault(topic, Account())

    def receive(self, topic: str, sequence: int, payload: bytes = b"") -> None:
        """Counts one message of a log file.

        The message is ignored if its topic is not counted, because `open_channel` was not
        called for the topic or the topic does not belong to the session.

        Args:
            topic: Topic of the message.
            sequence: Sequence number of the message in the file. For records and statistics, it
                is the number of their tick, the period of the control loop.
            payload: Bytes of the message. Only the bytes of events are used, because events
                state how many ticks a site executed or skipped.
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
            # The statistics of a tick show that the record of this tick exists.
            self._add_expected(member, topics.STATE, sequence + 1)

    def receive_event(self, topic: str, number: int, event: Event) -> bool:
        """Counts an event, and evaluates what it states about the ticks of a site.

        Each start of a site numbers its events from 0. Therefore each start has an account of
        its own, the object that counts its events. The boot in the event, a random number,
        identifies the start. The first start uses the account that `open_channel` created, and
        `_accounts` refers to that of the newest start. If there are more than `MAX_STARTS`
        starts, which only a faulty sender causes, the newest account counts the events of all
        further ones.

        Args:
            topic: Topic of the event.
            number: Number of the event.
            event: The event.

        Returns:
            False if the event had been received before.
        """
        starts = self._starts.setdefault(topic, {})
        is_new_start = event.boot not in starts
        if is_new_start and len(starts) < MAX_STARTS:
            is_first_start = not starts
            new_account = self._accounts[topic] if is_first_start else Account()
            starts[event.boot] = new_account
            self._accounts[topic] = new_account
        account = starts.get(event.boot, self._accounts[topic])

        # In a later part of a log, only the first start can have events in an earlier part. It
        # is counted from its first event in this part, which `count_message` notes. Any further
        # start is counted from 0.
        first_account = next(iter(starts.values()))
        if account is first_account:
            is_new = self.count_message(topic, number, account)
        else:
            is_new = account.receive(number)
        self.apply_event(event)
        return is_new

    def apply_event(self, event: Event) -> None:
        """Learns from an event how many ticks the sites executed or skipped.

        These kinds of events state something about ticks, the periods of the control loop:

        - "end": number of ticks that the sender executed until it ended. A number beyond the
          duration of the scenario is reduced to it, because the site has ended in any case.
        - "join": first tick of the sender when it joins the running session. An impossible tick
          is ignored, because it would leave a gap up to that tick.
        - `OVERRUN`: ticks that the sender skipped because it was late.
        - `LAST`: number of ticks of another site that the sender received before that site was
          started again.

        Other events are ignored, and so are events of members that are not sites.

        Args:
            event: The event.
        """
        sender = event.member
        if sender not in self._rates_hz or event.ticks < 0:
            return
        if event.kind == "end":
            self._end_ticks[sender] = min(event.ticks, self._ticks[sender])
            self.add_expected_ticks(sender, self._end_ticks[sender])
        elif event.kind == "join" and event.ticks <= self._ticks[sender]:
            self._apply_join(event)
        elif event.kind == OVERRUN:
            self._apply_overrun(event)
        elif event.kind == LAST and event.about in self._rates_hz:
            self._apply_last(event)

    def _apply_join(self, event: Event) -> None:
        """Handles the event of a site that joins the running session at a stated tick."""
        site = event.member
        published_ticks = self._end_ticks.pop(site, 0)
        rate_hz = self._rates_hz[site]
        for channel, gap in self._find_start_gaps(site, event.boot):
            base = self._bases.get(self._topic(site, channel), 0)
            first = count_messages(channel, event.ticks, rate_hz) - base
            published = count_messages(channel, published_ticks, rate_hz) - base
            gap.begin_next_start(first, published)

    def _apply_overrun(self, event: Event) -> None:
        """Counts the ticks that a site skipped as unpublished, as its event lists them.

        Args:
            event: Event of the kind `OVERRUN`. Its command contains ranges of skipped ticks in
                the form "first-last", and its ticks are the number of ticks that have passed.
                Ranges that are not below this number are not valid, and are ignored.
        """
        # More than 12 digits are no number of a tick.
        ranges = re.findall(r"(\d{1,12})-(\d{1,12})", event.command)
        for first_digits, last_digits in ranges:
            first = int(first_digits)
            last = int(last_digits)
            is_valid = first <= last < event.ticks
            if is_valid:
                next_tick = last + 1
                self.mark_skipped_ticks(event.member, next_tick, next_tick - first)

    def _apply_last(self, event: Event) -> None:
        """Handles the event that states how many ticks of a peer's earlier start arrived."""
        site = event.about
        for channel, gap in self._find_start_gaps(site, event.boots.get(site, 0)):
            base = self._bases.get(self._topic(site, channel), 0)
            number = number_message(channel, event.ticks, self._rates_hz[site])
            gap.note_published(number - base)

    def mark_skipped_ticks(self, site: str, tick: int, skipped: int) -> None:
        """Counts the messages of skipped ticks as unpublished, so that they are not missing.

        A tick is one period of the control loop. A site that is late skips ticks. It does not
        execute the skipped ticks, and publishes no messages for them.

        Args:
            site: Name of the site, the process that runs one arm.
            tick: First tick after the skipped ticks.
            skipped: Number of skipped ticks.
        """
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            account = self._accounts.get(topic)
            if account is None:
                continue
            base = self._bases.get(topic, 0)
            first, published = skipped_numbers(channel, tick, skipped, self._rates_hz[site])
            account.mark_unpublished(first - base, published - base)

    def count_message(self, topic: str, number: int, account: Account | None = None) -> bool:
        """Counts a message as received, by its number in its channel.

        If the log is divided into several files, a later file is counted from its first message
        on. Messages with lower numbers than that message are ignored.

        Args:
            topic: Topic of the message.
            number: Number of the message in its channel.
            account: Object that counts the message. None uses the object that counts the
                messages of the topic.

        Returns:
            False if a message with this number had been received before. True otherwise, also
            for a message that is ignored.
        """
        base = self._bases.setdefault(topic, number if self._continued else 0)
        if number < base:
            return True
        account = account or self._accounts[topic]
        return account.receive(number - base)

    def _find_start_gaps(self, site: str, boot: int) -> Iterator[tuple[str, StartGap]]:
        """Yields the numbered channels of a site, with the gap before one of its starts.

        The gaps are created when they are needed first. Their number is limited, so that events
        with invented boots cannot fill the memory.

        Args:
            site: Name of the site.
            boot: Random number that identifies the start.
        """
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
        """Takes into account that a site executed at least a given number of ticks.

        Records and statistics of these ticks that have not been received count as missing from
        now on.

        Args:
            site: Name of the site.
            ticks: Number of executed ticks, counted from the start of the session.
        """
        for channel in (topics.STATE, topics.LINK):
            published = count_messages(channel, ticks, self._rates_hz[site])
            self._add_expected(site, channel, published)

    def _add_expected(self, member: str, channel: str, published: int) -> None:
        """States that at least `published` messages of a channel exist."""
        topic = self._topic(member, channel)
        account = self._accounts.get(topic)
        if account is not None:
            base = self._bases.get(topic, 0)
            account.add_expected(published - base)

    def format_accounts(self) -> dict[str, str]:
        """Formats the numbers of received and missing messages, as they are stored in a log.

        A line is, for example, "expected 1000, received 998, missing 2, ...". If the log is a
        later part of a recording, the messages are counted from the first one in this part. The
        line then begins with the number of that message, such as "from 5000 on: ".

        Returns:
            A line of text for each topic, such as "/trilat/paper/m1/state", whose last two
            parts are the member and the channel. A member that is not a site, such as a
            recorder, has no line if no message is expected of it.
        """
        texts = {}
        for topic, account in self._accounts.items():
            member, _channel = topic.split("/")[-2:]
            is_site = member in self._rates_hz
            if not account.expected and not is_site:
                continue
            # Whenever a member is started again, it numbers its events from 0 again, and they
            # get a new account. `account` is the last one, that of the newest start.
            accounts_of_starts = list(self._starts.get(topic, {}).values())
            earlier_accounts = accounts_of_starts[:-1]
            first_number = self._bases.get(topic, 0)
            prefix = f"from {first_number} on: " if first_number else ""
            texts[topic] = prefix + account.describe(*earlier_accounts)
        return texts

    def list_starts(self, topic: str) -> list[Account]:
        """Lists the message counts of a topic, separately for each start of its sender.

        An `Account` holds the numbers of received and missing messages. Events are numbered
        from 0 again whenever their sender is started. Therefore each start has its own account.
        All other messages continue their numbers. Therefore the topic of such messages has a
        single account.

        Args:
            topic: Topic of the channel. It must be counted, see `open_channel`.
        """
        return list(self._starts.get(topic, {}).values()) or [self._accounts[topic]]

    def list_gaps(self, topic: str) -> list[tuple[int, int]]:
        """Lists the ranges of missing numbers of a topic, over all starts of its sender.

        Args:
            topic: Topic of the channel.

        Returns:
            The first and the last number of each range. Empty if no message is missing.
        """
        base = self._bases.get(topic, 0)
        gaps = []
        for account in self.list_starts(topic):
            gaps += [(base + first, base + last) for first, last in account.gaps]
        return gaps

    def coverage(self) -> Coverage:
        """Computes how many ticks of every site were executed, and how many were recorded.

        If it is unknown when a site ended, all ticks of the scenario count as executed.

        Returns:
            Both numbers for every site.
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
        """Describes the missing records for the user.

        Yields:
            A line for every site that lacks records, with the first ranges of missing ticks.
        """
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
        """Names of the sites of which the end is unknown.

        A site publishes an "end" event when it ends, which states how many ticks (periods of
        the control loop) it executed. For these sites, no such event has been received.
        """
        return [site for site in self._rates_hz if site not in self._end_ticks]

    def describe_unfinished_sites(self) -> Iterator[str]:
        """Describes for the user which sites may have executed more ticks than were recorded.

        These are the sites that never published the event "end", and whose last recorded tick
        is not the last tick of the scenario.

        Yields:
            A line for each of these sites.
        """
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
    """Creates the object that counts the messages of a file, before they are read.

    Args:
        metadata: Metadata of the file, by name. They state the session.
        attachments: Attachments of the file, by name. One of them is the scenario.

    Returns:
        The object, which has counted no message yet. None if the file is not a log of
        trilat-net.
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

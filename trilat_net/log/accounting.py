"""Counts the messages of a session: which were received, and which are missing.

The messages of a channel are numbered consecutively. A gap in the numbers therefore shows that
a message is missing: after the numbers 1, 2 and 5, the messages 3 and 4 are missing. An
`Account` contains these counts for one channel. The process that writes a log (the recorder)
updates its accounts while it records, and a check of the log computes them again later.

The results of an arm's control loop are numbered by its periods (ticks). Some numbers never had
a message: an arm that is late skips ticks, and an arm whose process is killed and started again
continues at a later tick. These numbers count as unpublished instead of missing.

Invariant:
    - In every account, the number of expected messages is the sum of the received and the
      missing messages.
    - Unpublished numbers are neither expected nor missing.
    - The memory is bounded: an account stores at most `MAX_GAPS` ranges of missing numbers. If
      there are more ranges, the lowest ranges are forgotten, but their messages still count as
      missing.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

from ..errors import count_nouns
from ..net import count_messages, number_message


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

        If a range of the set ends just before the new range, that range is extended. The new
        range is not merged with a range that begins just after it, because this would only save
        memory. If there are then too many ranges, the lowest ones are forgotten.

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
        """Removes the ranges with the lowest numbers, if there are more than permitted.

        The memory thus stays bounded, whatever numbers a faulty or hostile sender uses (L6).
        """
        del self._ranges[: -self._max_ranges]

    def remove(self, number: int, last_to_remove: int | None = None) -> bool:
        """Removes a number, or the numbers from `number` to `last_to_remove`.

        All numbers to remove must be in one range of the set. The rest of that range is one
        range, two ranges or nothing.

        Args:
            number: The number, or the first of several numbers.
            last_to_remove: Last number to remove. If None, only `number` is removed.

        Returns:
            False if the set does not contain `number`. Nothing is removed in this case.
        """
        range_with_number = self.find(number)
        if range_with_number is None:
            return False

        first, last = range_with_number
        end_removed = number if last_to_remove is None else last_to_remove
        remaining = []
        if first < number:
            remaining.append((first, number - 1))
        if end_removed < last:
            remaining.append((end_removed + 1, last))
        index = self._count_started(number) - 1
        self._ranges[index : index + 1] = remaining
        self._forget_lowest()
        return True

    def find(self, number: int) -> tuple[int, int] | None:
        """Returns the range of consecutive numbers that contains a number, or None.

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
    """Counts the messages of one channel by their numbers, and knows which are missing.

    Attributes:
        received: Number of messages that were received, without repetitions.
        duplicate: Number of messages that arrived although a message with their number had been
            received.
        reordered: Number of messages that arrived after a message with a higher number.
        refilled: Number of messages that were initially missing, and that the sender sent again
            from its memory.
        unpublished: Number of messages that were never published. The sender skipped them, or
            was killed before it reached them and continued after them at its next start.
        last: Largest number of a message that is known to exist. It is -1 before the first
            message.
        silence_ns: Longest time between two arrivals, in ns. It is 0 without arrival times.
    """

    def __init__(self) -> None:
        """Starts an account of received messages with no message counted yet."""
        self.received = 0
        self.duplicate = 0
        self.reordered = 0
        self.refilled = 0
        self.unpublished = 0
        self.last = -1
        self.silence_ns = 0
        # No member still has the missing messages below this number.
        self._abandoned_below = 0
        # Largest number that arrived without a request.
        self._newest = -1
        self._last_arrival_ns: int | None = None
        self._gaps = RangeSet(MAX_GAPS)

    @classmethod
    def of_ticks(
        cls,
        channel: str,
        ticks: Sequence[int],
        rate_hz: int,
        absences: Sequence[tuple[int, int]],
    ) -> "Account":
        """Counts the messages of a site in one channel of a log by their ticks.

        Args:
            channel: Name of the channel, of the records or of the link statistics.
            ticks: Tick of every message, in the order of the file.
            rate_hz: Tick rate of the site, in Hz.
            absences: Ticks that the site did not execute, as spans (first, last). They are not
                missing.
        """
        account = cls()
        for tick in ticks:
            account.receive(number_message(channel, tick, rate_hz))
        for first_tick, last_tick in absences:
            next_number = count_messages(channel, last_tick + 1, rate_hz)
            first_number = count_messages(channel, first_tick, rate_hz)
            account.mark_unpublished(next_number, first_number)
        return account

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

        A recorder requests missing messages. A message that arrives in this way closes its gap.

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
        """Notes that the sender has published at least the messages 0 to `published` - 1.

        Those that have not arrived count as missing from now on. Without this, messages missing
        at the end would remain unnoticed, because no later number reveals the gap.
        """
        if published > self.last + 1:
            self._gaps.insert(self.last + 1, published - 1)
            self.last = published - 1

    def mark_unpublished(self, first: int, published: int = 0) -> int:
        """Notes that the missing numbers just below a number never had a message.

        This happens when the sender skips numbers, or is killed and started again. The missing
        numbers form a range that ends just below `first`. Those that are not below `published`
        count as unpublished instead of missing.

        Args:
            first: Number of the first message after the gap. It is the first message that the
                sender published after its next start, or after the numbers that it skipped.
            published: Number of messages that are known to have been published before the gap.
                These messages have the numbers below `published`, and stay missing if they were
                not received.

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
        """Gives up the missing messages below a number, which no process can send any more.

        They are no longer requested, but still count as missing. Such a message still counts as
        received if it arrives.

        Args:
            number: First number that is not affected.
        """
        self._abandoned_below = max(self._abandoned_below, number)

    def find_requestable_gap(self, number: int = 0) -> tuple[int, int] | None:
        """Finds the first missing messages that can still be requested from the sender.

        Messages that no member (process of a session) has any more are left out, so that they
        are not requested repeatedly.

        Args:
            number: Smallest number to consider.

        Returns:
            The first and the last number of the gap. None if no message can be requested.
        """
        return self._gaps.find_from(max(number, self._abandoned_below))

    @property
    def expected(self) -> int:
        """Number of messages that a process has published, as far as a receiver knows.

        Skipped numbers that never had a message (`unpublished`) are not counted.
        """
        return self.last + 1 - self.unpublished

    @property
    def missing(self) -> int:
        """Number of lost messages: those that were published but never received."""
        return self.expected - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Numbers of the messages that are missing, as pairs [first, last] in ascending order.

        The value is [[10, 12]], for example, if the messages 10, 11 and 12 are missing. At most
        `MAX_GAPS` pairs with the highest numbers are included.
        """
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """Number of messages in the longest series of missing messages. 0 if there are none.

        A long series indicates an interruption, while the same number of single losses may be
        harmless.
        """
        return max((last - first + 1 for first, last in self._gaps), default=0)

    def describe(self, *before: "Account") -> str:
        """Describes the account of a channel in one line, as a log stores it for each channel.

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
            text += f", unpublished {self.unpublished}"
        if before:
            text += f", of {count_nouns(len(starts), 'start')}"
        return text

    @staticmethod
    def parse_counts(account: str) -> dict[str, int]:
        """Reads the numbers of received and missing messages from a line of `describe`.

        A finished log stores the counts as such lines, for people and for programs.

        Args:
            account: The line, as a log stores it for each topic.

        Returns:
            The numbers, under the keys "received" and "missing". Empty if the text is not such
            a line.
        """
        matches = re.findall(r"(received|missing) (\d{1,15})\b", account)
        return {name: int(digits) for name, digits in matches}

    def format_gaps(self, most: int, base: int = 0) -> list[str]:
        """Formats the first ranges of missing numbers for a message to the user.

        The result is, for example, ["10-12", "40-40"] if the numbers 10 to 12 and 40 are
        missing.

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
        """Marks the number of a message as received.

        It is removed from the missing numbers, or extends the known numbers.

        Returns:
            False if the number had been marked as received before.
        """
        if number > self.last:
            self.add_expected(number)
            self.last = number
            return True
        return self._gaps.remove(number)


class StartGap:
    """Gap between the messages of two starts of a site (arm controller), in one channel.

    A site that is killed cannot state how many messages it published. After its next start it
    continues at a later tick (control period). The messages in between were either published
    and lost on the way to the recorder, or never published. Other sites may have received
    samples of the earlier start. In that case these sites know a lower limit of the number of
    messages that the earlier start published. Their reports may arrive before or after the next
    start. A few messages were still in transit to the recorder when the site was killed. These
    count as unpublished.

    The gap is divided at the number `_first_unpublished`, which never decreases:

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
        """Stores the account of a site's messages before the site was started again.

        The number of messages that were lost between both starts is initially unknown.
        """
        self._account = account
        self._under_way = under_way
        # Number of messages that the earlier start published, according to other sites.
        self._reported = 0
        # First number of the gap. No message from this number up to the next start has arrived.
        # It is -1 until the next start is known.
        self._first_silent = -1
        # First number that counts as unpublished. It is -1 until the next start is known.
        self._first_unpublished = -1
        # First number of the next start. It is -1 until the next start is known.
        self._next_first = -1

    def begin_next_start(self, first: int, published: int) -> None:
        """Evaluates the gap before the next start of the site, once that start is known.

        The site (arm controller) was killed and has been started again. The missing messages
        just before the next start now count as unpublished in the account, except the messages
        that the site itself is known to have published. Reports of other sites that arrived
        earlier are then evaluated. Some of these numbers may then count as missing again. Only
        the first call has an effect.

        Args:
            first: Number of the first message that belongs to the next start.
            published: Number of messages that the earlier start itself stated when it ended. It
                is 0 if the site was killed before it could state the number.
        """
        is_evaluated = self._next_first >= 0
        if is_evaluated:
            return
        self._next_first = first
        self._first_silent = self._account.mark_unpublished(first, published)
        self._first_unpublished = self._first_silent
        self.note_published(self._reported)

    def note_published(self, published: int) -> None:
        """Updates the gap with the number of messages that the killed site had published.

        Other sites (arm controllers) report this number, because they received samples, the
        states that a site sends. Missing messages before the next start first count as
        unpublished, because they may have been in transit when the site was killed. If the
        reported number shows that more messages were lost than can have been in transit, all
        lost messages count as missing instead: the numbers from `_first_unpublished` to below
        the reported number.

        Before the next start is known, the report is only stored. `begin_next_start` evaluates
        it later.

        Args:
            published: Lower limit of the number of messages that the site published. These
                messages have the numbers below it.
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
    """Returns a sentence for the user about sites whose end is unknown.

    A site (arm controller) publishes an "end" event when it ends. Without this event, nobody
    knows whether the site published further records (results of control periods) after the last
    record that was received.

    Args:
        sites: Names of the sites whose "end" event was not received, at least one.
    """
    names = sites[0]
    if len(sites) > 1:
        names = f"{', '.join(sites[:-1])} and {sites[-1]}"
    return f"the end of {names} is unknown: later records may be missing"


MIN_COVERAGE = 0.999
"""Default of the smallest fraction of every site's ticks that must be judged."""


class Coverage(NamedTuple):
    """Part of a run that was recorded, or checked by a tool, for each site.

    A site is a process that runs one arm. A tick is one period of its control loop.

    Attributes:
        judged: Number of recorded or checked ticks, by name of the site.
        expected: Number of all ticks of the site in the run, by name of the site.
    """

    judged: dict[str, int]
    expected: dict[str, int]

    @property
    def share(self) -> float:
        """Smallest fraction of control periods of any site that were recorded, from 0 to 1.

        A run is known only as well as its worst site (arm controller). In the result of a
        check, the fraction is that of checked periods. It is 0 if no site has any periods. A
        single site without periods does not reduce it.
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
        """Describes for the user how much of the run was recorded or checked.

        Args:
            least: Smallest fraction of ticks (control periods) that is sufficient, from 0 to 1.
                The text mentions it if the actual fraction is smaller.

        Returns:
            The text for the user.
        """
        shortage = f", less than {_format_percent(least)}" if self.share < least else ""
        return f"judged {self}{shortage}"

    def to_json(self) -> dict[str, list[int]]:
        """Returns how many control periods of each site were recorded or checked, for JSON.

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


LAST = "last"
"""Kind of the event in which a site states how many ticks of a peer it had received before the
peer was started again.
"""

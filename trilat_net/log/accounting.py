"""Counts the messages of a session: how many were received, and which are missing.

The messages of a channel are numbered consecutively, so a gap in the numbers reveals missing
messages: if 1, 2 and 5 arrive, messages 3 and 4 are missing. An `Account` holds these counts
for one channel. The recorder updates its accounts while it writes a log, and a check of the log
later recomputes them.

The records of a site are numbered by tick. Some numbers never had a message: a site that falls
behind skips ticks, and a site that is killed and restarted continues at a later tick. These
numbers count as unpublished rather than missing.

Invariant:
    - In every account, the number of expected messages is the sum of the received and the
      missing messages.
    - Unpublished numbers are neither expected nor missing.
    - Memory is bounded: an account stores at most `MAX_GAPS` ranges of missing numbers. Beyond
      that limit the lowest ranges are forgotten, but their messages still count as missing.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from typing import NamedTuple

import msgspec

from ..errors import count_nouns
from ..net import count_messages, number_message
from ..recorded_change import RecordedChange


class RangeSet:
    """Set of integers stored as ranges, such as the numbers of missing messages.

    A range is a pair (first, last), both inclusive, and the ranges are in ascending order. Long
    runs of consecutive numbers therefore need little memory.

    Args:
        max_ranges: Maximum number of ranges. Beyond this limit the lowest ranges are forgotten.
    """

    def __init__(self, max_ranges: int) -> None:
        self._max_ranges = max_ranges
        self._ranges: list[tuple[int, int]] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._ranges)

    def __len__(self) -> int:
        return len(self._ranges)

    def _count_started(self, number: int) -> int:
        """Returns the number of ranges that begin at or below `number`."""
        return bisect_right(self._ranges, (number, math.inf))

    def insert(self, first: int, last: int) -> None:
        """Adds a range of consecutive numbers, none of which may already be in the set.

        The new range is merged with a range that ends just before it. It is not merged with a
        range that begins just after it, since that would only save memory. If the set then has
        too many ranges, the lowest ones are forgotten.

        Args:
            first: First number of the range.
            last: Last number of the range, inclusive.
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
        """Removes the lowest ranges if there are more than the permitted number.

        This bounds the memory, whatever numbers a faulty or hostile sender uses (L6).
        """
        del self._ranges[: -self._max_ranges]

    def remove(self, number: int, last_to_remove: int | None = None) -> bool:
        """Removes a number, or all numbers from `number` to `last_to_remove`.

        All numbers to remove must lie within a single range of the set. Up to two smaller
        ranges remain in its place.

        Args:
            number: The number to remove, or the first of several.
            last_to_remove: Last number to remove, inclusive. If None, only `number` is removed.

        Returns:
            False, with nothing removed, if `number` is not in the set.
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
        """Returns the range (first, last) that contains a number, or None if no range does.

        Args:
            number: The number to look up.
        """
        index = self._count_started(number) - 1
        if index < 0 or number > self._ranges[index][1]:
            return None
        return self._ranges[index]

    def find_from(self, number: int) -> tuple[int, int] | None:
        """Finds the first run of consecutive numbers in the set at or above a given number.

        If the number lies inside a range, only the part of the range from that number on is
        returned.

        Args:
            number: Lower limit of the search.

        Returns:
            The first and last number of the run, or None if the set has no number at or above
            the limit.
        """
        # The range that starts at or below the number may contain it. If it does not, the next
        # range is entirely above the number.
        index = max(0, self._count_started(number) - 1)
        for first, last in self._ranges[index : index + 2]:
            if last >= number:
                return max(number, first), last
        return None


MAX_GAPS = 50_000
"""Maximum number of gaps that an account stores. The messages of lower gaps are only counted.
"""
SHOWN_GAPS = 20
"""Maximum number of gaps listed in a message to the user."""


class Account:
    """Counts the messages of one channel by number, and keeps track of which are missing.

    Attributes:
        received: Number of messages received, not counting duplicates.
        duplicate: Number of messages that arrived although a message with the same number had
            already been received.
        reordered: Number of messages that arrived after a message with a higher number.
        refilled: Number of messages that were missing at first and that the sender then sent
            again from its memory.
        unpublished: Number of messages that were never published, because the sender skipped
            their numbers, or was killed and continued with higher numbers when restarted.
        last: Highest message number known to exist; -1 before the first message.
        silence_ns: Longest time between two consecutive arrivals, in ns; 0 if no arrival times
            are known.
    """

    def __init__(self) -> None:
        """Creates an account in which no message has been counted yet."""
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
        """Counts the messages of a site in one channel of a log, given their ticks.

        Args:
            channel: Name of the channel that holds the records or the link statistics.
            ticks: Tick of each message, in file order.
            rate_hz: Tick rate of the site, in Hz.
            absences: Spans (first, last) of ticks that the site did not execute. They do not
                count as missing.
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
        """Counts a message that arrived from its sender without having been requested.

        Any numbers skipped since the previous message are recorded as a gap.

        Args:
            number: Number of the message in its channel.
            arrived_ns: Arrival time on a monotonic clock, in ns. None if unknown.

        Returns:
            True if the message is new, False if a message with this number had already been
            received.
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
        """Counts a message that the sender sent again from its memory on request.

        A recorder requests missing messages. A message that arrives in this way closes its gap.

        Args:
            number: Number of the message in its channel.

        Returns:
            True if the message is new, False if a message with this number had already been
            received.
        """
        is_new = self._add(number)
        self.refilled += is_new
        self.received += is_new
        return is_new

    def add_expected(self, published: int) -> None:
        """Records that the sender has published at least the messages 0 to `published` - 1.

        The messages among them that have not arrived count as missing from now on. Messages
        lost at the end would otherwise go unnoticed, because no later number reveals the gap.
        """
        if published > self.last + 1:
            self._gaps.insert(self.last + 1, published - 1)
            self.last = published - 1

    def mark_unpublished(self, first: int, published: int = 0) -> int:
        """Reclassifies the missing numbers just below `first` as never published.

        This applies when the sender skips numbers, or is killed and restarted. In the range of
        missing numbers that ends just below `first`, the numbers at or above `published` count
        as unpublished instead of missing.

        Args:
            first: Number of the first message that was published after the restart or after the
                skipped numbers.
            published: Number of messages that the sender is known to have published before it
                was restarted or skipped numbers. These messages have the numbers below
                `published`, and stay missing if they were not received.

        Returns:
            The lowest number that now counts as unpublished, or `first` if there is none.
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
        """Reclassifies a range of unpublished numbers as missing.

        Needed when another site reports that messages with these numbers were published.

        Args:
            first: First number of the range.
            last: Last number of the range, inclusive.
        """
        self._gaps.insert(first, last)
        self.unpublished -= last + 1 - first

    def abandon_below(self, number: int) -> None:
        """Gives up on the missing messages below a number, because no process can resend them.

        They are no longer requested but still count as missing. If one of them arrives after
        all, it counts as received.

        Args:
            number: First number that is not affected.
        """
        self._abandoned_below = max(self._abandoned_below, number)

    def find_requestable_gap(self, number: int = 0) -> tuple[int, int] | None:
        """Finds the first gap whose messages can still be requested from the sender.

        Messages that no member of the session holds any more are skipped, so they are not
        requested over and over.

        Args:
            number: Lowest message number to consider.

        Returns:
            The first and last number of the gap, or None if there is nothing left to request.
        """
        return self._gaps.find_from(max(number, self._abandoned_below))

    @property
    def expected(self) -> int:
        """Number of messages that the sender has published, as far as the receiver knows.

        Numbers of messages that were never published (`unpublished`) are excluded.
        """
        return self.last + 1 - self.unpublished

    @property
    def missing(self) -> int:
        """Number of lost messages, that is, messages that were published but never received."""
        return self.expected - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Ranges of missing message numbers, as pairs [first, last] in ascending order.

        For example, [[10, 12]] if messages 10, 11 and 12 are missing. At most `MAX_GAPS` ranges
        are stored, namely those with the highest numbers.
        """
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """Length of the longest run of consecutive missing messages; 0 if none is missing.

        A long run indicates an interruption, whereas the same number of isolated losses may be
        harmless.
        """
        return max((last - first + 1 for first, last in self._gaps), default=0)

    def describe(self, *before: "Account") -> str:
        """Summarises the account in one line, as a log stores it for each channel.

        The line states the expected, received and missing counts and the first ranges of
        missing numbers. `parse_counts` reads the received and missing counts from the line.

        Args:
            *before: Accounts of earlier starts of the sender, each of which numbered its
                messages from 0. Their counts are added to those of this account. Missing ranges
                are listed for the last start only.
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
        """Parses the received and missing counts from a line written by `describe`.

        A finished log stores its counts as such lines, readable by people and programs alike.

        Args:
            account: The line that a log stores for a topic.

        Returns:
            The counts under the keys "received" and "missing". Empty if the line has another
            format.
        """
        matches = re.findall(r"(received|missing) (\d{1,15})\b", account)
        return {name: int(digits) for name, digits in matches}

    def format_gaps(self, most: int, base: int = 0) -> list[str]:
        """Formats the first ranges of missing numbers for a message to the user.

        For example, ["10-12", "40-40"] if messages 10 to 12 and 40 are missing.

        Args:
            most: Maximum number of ranges to return.
            base: Offset added to every number, if the account does not count from the first
                message of the session.

        Returns:
            One "first-last" string per range. Empty if no message is missing.
        """
        gaps = islice(self._gaps, most)
        return [f"{base + first}-{base + last}" for first, last in gaps]

    def _add(self, number: int) -> bool:
        """Marks a message number as received.

        The number is removed from the missing numbers, or extends the range of known numbers.

        Returns:
            False if the number had already been marked as received.
        """
        if number > self.last:
            self.add_expected(number)
            self.last = number
            return True
        return self._gaps.remove(number)


class StartGap:
    """Gap in the message numbers of one channel, left by a site that was killed and restarted.

    A site that is killed cannot state how many messages it published, and when restarted it
    continues at a later tick. The messages in between were either published and lost on the way
    to the recorder, or never published. The samples that other sites received give a lower
    bound on the number of messages that the killed site published. The other sites may report
    this bound before or after the restart. A few messages may still have been in transit to the
    recorder when the site was killed. These messages count as unpublished.

    The gap is divided at the number `_first_unpublished`, which never decreases:

        received | missing | unpublished | next start
                 ^         ^             ^
                 |         |             _next_first
                 |         _first_unpublished
                 _first_silent

    Args:
        account: Account of the channel.
        under_way: Maximum number of messages that may have been in transit.
    """

    def __init__(self, account: Account, under_way: int) -> None:
        """Stores the account of a site's messages before the site was restarted.

        The number of messages lost between the two starts is unknown at first.
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
        """Evaluates the gap before the next start of a killed site, once that start is known.

        The missing messages just before the next start are reclassified as unpublished, except
        those that the site itself is known to have published. Reports that other sites sent
        earlier are then evaluated, which may turn some of these numbers back into missing ones.
        Only the first call has an effect.

        Args:
            first: Number of the first message of the next start.
            published: Number of messages published by the earlier process of the site, as
                stated when it ended; 0 if it was killed before it could state the number.
        """
        is_evaluated = self._next_first >= 0
        if is_evaluated:
            return
        self._next_first = first
        self._first_silent = self._account.mark_unpublished(first, published)
        self._first_unpublished = self._first_silent
        self.note_published(self._reported)

    def note_published(self, published: int) -> None:
        """Updates the gap after a report of how many messages the killed site had published.

        Other sites that received samples of the killed site send these reports. The missing
        messages before the next start first count as unpublished, since they may have been in
        transit when the site was killed. If a report shows that more messages were lost than
        can have been in transit, all of these messages (from `_first_unpublished` up to, but
        excluding, the reported number) count as missing instead.

        Before the next start is known, the report is only stored for `begin_next_start` to
        evaluate.

        Args:
            published: Lower bound on the number of messages that the site published. Their
                numbers are below it.
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
    """Returns a warning for the user about sites whose shutdown was not recorded.

    A site publishes an "end" event when it shuts down. Without this event, it is unknown
    whether the site published any more records after the last one received.

    Args:
        sites: Names of the sites whose "end" event was not received, at least one.
    """
    names = sites[0]
    if len(sites) > 1:
        names = f"{', '.join(sites[:-1])} and {sites[-1]}"
    return f"the end of {names} is unknown: later records may be missing"


MIN_COVERAGE = 0.999
"""Default for the smallest fraction of each site's ticks that must be judged."""


class Coverage(NamedTuple):
    """How much of a run was recorded, or checked by a tool, per site.

    Attributes:
        judged: Maps the name of each site to the number of its ticks that were recorded or
            checked.
        expected: Maps the name of each site to the total number of its ticks in the run.
    """

    judged: dict[str, int]
    expected: dict[str, int]

    @property
    def share(self) -> float:
        """Fraction of ticks that were recorded or checked at the worst site, from 0 to 1.

        The smallest fraction among the sites counts. It is 0 if no site has any ticks, but a
        single site without ticks does not lower it.
        """
        if not any(self.expected.values()):
            return 0.0
        return min(map(self._share, self.expected), default=0.0)

    def _share(self, site: str) -> float:
        """Returns the fraction of a site's ticks that were judged (1 if it has no ticks)."""
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
            least: Smallest sufficient fraction of ticks, from 0 to 1. Mentioned in the
                description if the actual fraction is smaller.
        """
        shortage = f", less than {_format_percent(least)}" if self.share < least else ""
        return f"judged {self}{shortage}"

    def to_json(self) -> dict[str, list[int]]:
        """Returns, per site, how many ticks were recorded or checked, for output as JSON.

        Returns:
            Maps the name of each site to the pair [recorded or checked ticks, all ticks].
        """
        return {
            site: [self.judged.get(site, 0), ticks] for site, ticks in self.expected.items()
        }


def _format_percent(share: float) -> str:
    """Formats a fraction as a percentage, rounded down so that only 1 is shown as 100 %."""
    return f"{math.floor(1e5 * share) / 1e3:g} %"


LAST = "last"
"""Kind of the event in which a site states how many ticks of a peer it had received before the
peer was restarted.
"""


def count_skipped_ticks(texts: Sequence[str]) -> int:
    """Returns how many ticks a site skipped just before a record.

    A site skips ticks when its control loop falls behind. It reports the number of skipped
    ticks as a change in its next record, among the other changes of that tick.

    Args:
        texts: Changes in the record, as JSON strings. Invalid strings are ignored.
    """
    skipped = 0
    for text in texts:
        if "overrun" in text:
            with suppress(msgspec.MsgspecError):
                skipped += msgspec.json.decode(text, type=RecordedChange).ticks
    return skipped

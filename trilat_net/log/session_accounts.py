"""Counts the received and missing messages of all channels of a session.

A channel contains the numbered messages of one kind from one sender. `SessionAccounts` has one
`Account` per channel. It evaluates the events that show which ticks exist: when a site began,
which ticks it skipped, and when it ended.

Invariant:
    - Only the events of a file are decoded, because they suffice to count its messages.
    - If a log is divided into several files, the counts for a later file begin at its first
      message.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress

from ..errors import ScenarioError, WireError, count_nouns
from ..net import (
    READABLE,
    Event,
    count_messages,
    count_under_way,
    decode,
    number_message,
    skipped_numbers,
    topics,
)
from ..scenario import Scenario, parse_embedded
from .accounting import LAST, SHOWN_GAPS, Account, Coverage, StartGap
from .log_layout import PART, SCENARIO, SESSION, SITE_CHANNELS

_OVERRUN = "overrun"
"""Kind of the event in which a site lists the ticks that it skipped because it was late."""
_MAX_STARTS = 64
"""Maximum number of starts of a member whose events are counted separately."""
_EVENTS_NUMBERED_SINCE = 3
"""First version of the schema in which events are numbered."""


class SessionAccounts:
    """Counts the received and missing messages of all numbered channels of a session.

    Used by a recorder while it records, and later by the check of a log. The caller reports
    every message to this object, which determines from the events how many ticks each site
    executed.

    Args:
        session: Name of the session.
        scenario: Scenario of the session. None if it cannot be read.
        continued: True for a later part of a log, whose counts begin at its first message.
        events: True if events are numbered. In the oldest logs they are not.
    """

    def __init__(
        self,
        session: str,
        scenario: Scenario | None,
        *,
        continued: bool = False,
        events: bool = True,
    ) -> None:
        """Creates the accounts of a session, with no messages counted yet."""
        self._session = session
        self._continued = continued
        self._rates_hz: dict[str, int] = {}
        self._ticks: dict[str, int] = {}
        if scenario:
            self._rates_hz = {name: site.rate_hz for name, site in scenario.sites.items()}
            self._ticks = {name: scenario.ticks(name) for name in scenario.names}
        # Number of ticks that a site executed, as its event "end" states.
        self._end_ticks: dict[str, int] = {}
        self._numbered_channels = SITE_CHANNELS if events else (topics.STATE, topics.LINK)

        # Counts of the messages, by topic. The account of events is that of the newest start.
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
        """Starts counting the messages of a channel before its first message has arrived.

        Losses are then noticed even if no message ever arrives. Does nothing if the topic does
        not belong to the session, or if the messages of its channel are not numbered.

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

        The message is ignored if its topic is not being counted, because `open_channel` was not
        called for it or it does not belong to the session.

        Args:
            topic: Topic of the message.
            sequence: Sequence number of the message in the file. For records and statistics,
                this is their tick.
            payload: Bytes of the message. Needed only for events, which state how many ticks a
                site executed or skipped.
        """
        if topic not in self._accounts:
            return

        site, channel = topic.split("/")[-2:]
        event: Event | None = None
        if channel == topics.EVENT and payload:
            with suppress(WireError):  # an unreadable event counts like any other message
                event = decode(payload, Event, READABLE)
        number = number_message(channel, sequence, self._rates_hz.get(site, 0))
        if event is None:
            self.count_message(topic, number)
        else:
            self.receive_event(topic, number, event)
        if channel == topics.LINK:
            # The statistics of a tick show that the record of this tick exists.
            self._add_expected(site, topics.STATE, sequence + 1)

    def receive_event(self, topic: str, number: int, event: Event) -> bool:
        """Counts an event, and updates the ticks of the sites from the event (`apply_event`).

        A site numbers its events from 0 again whenever it is started, so each start has its own
        account. The boot in the event, a random number, identifies the start. The first start
        uses the account that `open_channel` created, and `_accounts` refers to the account of
        the newest start. If there are more than `_MAX_STARTS` starts, which only a faulty
        sender causes, the newest account also counts the events of all further starts.

        Args:
            topic: Topic of the event.
            number: Number of the event.
            event: The event.

        Returns:
            False if the event had already been received.
        """
        starts = self._starts.setdefault(topic, {})
        is_new_start = event.boot not in starts
        if is_new_start and len(starts) < _MAX_STARTS:
            is_first_start = not starts
            new_account = self._accounts[topic] if is_first_start else Account()
            starts[event.boot] = new_account
            self._accounts[topic] = new_account
        account = starts.get(event.boot, self._accounts[topic])

        # In a later part of a log, only the first start can have events in an earlier part. It
        # is counted from its first event in this part, which `count_message` notes. All further
        # starts are counted from 0.
        first_account = next(iter(starts.values()))
        if account is first_account:
            is_new = self.count_message(topic, number, account)
        else:
            is_new = account.receive(number)
        self.apply_event(event)
        return is_new

    def apply_event(self, event: Event) -> None:
        """Updates the executed and skipped ticks of the sites from an event.

        The following kinds of events state something about ticks:

        - "end": number of ticks that the sender executed until it ended. If the number exceeds
          the number of ticks in the scenario, the number in the scenario is used instead.
        - "join": first tick of a sender that joins the running session. The event is ignored if
          this tick is after the end of the scenario.
        - `_OVERRUN`: ticks that the sender skipped because it was late.
        - `LAST`: minimum number of ticks that another site executed before it was restarted,
          known from the samples that the sender received from that site.

        Other events are ignored, as are events of members that are not sites.

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
        elif event.kind == _OVERRUN:
            self._apply_overrun(event)
        elif event.kind == LAST and event.about in self._rates_hz:
            self._apply_last(event)

    def _apply_join(self, event: Event) -> None:
        """Handles the event "join" of a site that joins the running session at a stated tick.

        The site published no messages for the ticks before that, at least since its previous
        start ended. These messages must not count as missing.
        """
        site = event.member
        published_ticks = self._end_ticks.pop(site, 0)
        rate_hz = self._rates_hz[site]
        for channel, gap in self._find_start_gaps(site, event.boot):
            first_number = self._bases.get(self._topic(site, channel), 0)
            first = count_messages(channel, event.ticks, rate_hz) - first_number
            published = count_messages(channel, published_ticks, rate_hz) - first_number
            gap.begin_next_start(first, published)

    def _apply_overrun(self, event: Event) -> None:
        """Handles the event of a site that skipped ticks, whose records are then not missing.

        The site reports this because its computer was too slow.

        Args:
            event: Event of the kind `_OVERRUN`. Its command contains ranges of skipped ticks in
                the form "first-last", and its ticks are the number of ticks that have passed.
                Ranges that are not below this number are invalid, and are ignored.
        """
        # The number of a tick has at most 12 digits.
        ranges = re.findall(r"(\d{1,12})-(\d{1,12})", event.command)
        for first_digits, last_digits in ranges:
            first = int(first_digits)
            last = int(last_digits)
            is_valid = first <= last < event.ticks
            if is_valid:
                next_tick = last + 1
                self.mark_skipped_ticks(event.member, next_tick, next_tick - first)

    def _apply_last(self, event: Event) -> None:
        """Handles the event that states how many ticks of a peer's earlier start arrived.

        This is a lower bound on the number of messages that the peer published before it was
        killed, which shows whether missing messages were lost or never sent.
        """
        site = event.about
        for channel, gap in self._find_start_gaps(site, event.boots.get(site, 0)):
            base = self._bases.get(self._topic(site, channel), 0)
            number = number_message(channel, event.ticks, self._rates_hz[site])
            gap.note_published(number - base)

    def mark_skipped_ticks(self, site: str, tick: int, skipped: int) -> None:
        """Counts the messages of skipped ticks as unpublished rather than missing.

        A site that is late skips ticks. It does not execute them, and publishes no messages for
        them.

        Args:
            site: Name of the site.
            tick: First tick after the skipped ticks.
            skipped: Number of skipped ticks.
        """
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            account = self._accounts.get(topic)
            if account is None:
                continue
            first, published = skipped_numbers(channel, tick, skipped, self._rates_hz[site])
            # An account counts from 0, the first message of this part of the log.
            first_number = self._bases.get(topic, 0)
            account.mark_unpublished(first - first_number, published - first_number)

    def count_message(self, topic: str, number: int, account: Account | None = None) -> bool:
        """Counts a message as received, given its number in its channel.

        If the log is divided into several files, the counts for a later file begin at its first
        message, and messages with lower numbers are ignored.

        Args:
            topic: Topic of the message.
            number: Number of the message in its channel.
            account: Account in which to count the message. If None, the account of the topic.

        Returns:
            False if a message with this number had already been received. True otherwise, even
            for a message that is ignored.
        """
        first_number = self._bases.setdefault(topic, number if self._continued else 0)
        if number < first_number:
            return True
        account = account or self._accounts[topic]
        return account.receive(number - first_number)

    def _find_start_gaps(self, site: str, boot: int) -> Iterator[tuple[str, StartGap]]:
        """Yields, for each numbered channel of a site, the gap in its numbers before a start.

        While a site was away, it published nothing. The gap prevents these numbers from
        counting as missing, and is created when it is first needed. The number of gaps is
        limited, so that forged events with invented starts cannot fill the memory.

        Args:
            site: Name of the site.
            boot: Random number that identifies the start.
        """
        for channel in (topics.STATE, topics.LINK):
            topic = self._topic(site, channel)
            if topic not in self._accounts:
                continue
            gap = self._start_gaps.get((topic, boot))
            has_space = len(self._start_gaps) < _MAX_STARTS * len(self._rates_hz)
            if gap is None and has_space:
                samples_under_way = count_under_way(channel, self._rates_hz[site])
                gap = StartGap(self._accounts[topic], samples_under_way)
                self._start_gaps[topic, boot] = gap
            if gap is not None:
                yield channel, gap

    def add_expected_ticks(self, site: str, ticks: int) -> None:
        """Updates the accounts, given that a site executed at least `ticks` ticks.

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
        """Records that at least `published` messages of a channel exist."""
        topic = self._topic(member, channel)
        account = self._accounts.get(topic)
        if account is not None:
            base = self._bases.get(topic, 0)
            account.add_expected(published - base)

    def format_accounts(self) -> dict[str, str]:
        """Formats the numbers of received and missing messages for storage in a log.

        A typical line is "expected 1000, received 998, missing 2, ...". In a later part of a
        recording, messages are counted from the first one in this part, and the line begins
        with the number of that message, for example "from 5000 on: ".

        Returns:
            Maps each topic, such as "/trilat/paper/m1/state", to a line of text. The last two
            components of a topic are the member and the channel. A member that is not a site,
            such as a recorder, has no line if no message is expected from it.
        """
        texts = {}
        for topic, account in self._accounts.items():
            member, _channel = topic.split("/")[-2:]
            is_site = member in self._rates_hz
            if not account.expected and not is_site:
                continue
            # Whenever a member is started again, it numbers its events from 0 again, and these
            # events get a new account. `account` is the last account, which belongs to the
            # newest start.
            accounts_of_starts = list(self._starts.get(topic, {}).values())
            earlier_accounts = accounts_of_starts[:-1]
            first_number = self._bases.get(topic, 0)
            prefix = f"from {first_number} on: " if first_number else ""
            texts[topic] = prefix + account.describe(*earlier_accounts)
        return texts

    def list_starts(self, topic: str) -> list[Account]:
        """Lists the message counts of a topic, separately for each start of its sender.

        Events are numbered from 0 again whenever their sender is restarted, so there is one
        `Account` per start. The numbers of all other messages continue after a restart, so
        their topics have a single account.

        Args:
            topic: Topic of the channel, for which `open_channel` must have been called.
        """
        return list(self._starts.get(topic, {}).values()) or [self._accounts[topic]]

    def list_gaps(self, topic: str) -> list[tuple[int, int]]:
        """Lists the ranges of missing numbers of a topic, over all starts of its sender.

        Events are numbered from 0 again at each start of their sender. Each start then has its
        own account, and all accounts are included.

        Args:
            topic: Topic of the channel.

        Returns:
            The first and last number of each range. Empty if no message is missing.
        """
        first_number = self._bases.get(topic, 0)
        gaps = []
        for account in self.list_starts(topic):
            gaps += [
                (first_number + first, first_number + last) for first, last in account.gaps
            ]
        return gaps

    def coverage(self) -> Coverage:
        """Counts how many ticks each site executed, and how many of them were recorded.

        If it is unknown when a site ended, all ticks of the scenario count as executed.
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
        """Describes how many records are missing, with one line per incomplete site.

        Yields:
            A line such as "m1: 3 of 5000 records: ...", with the first ranges of missing ticks.
            Sites without missing records are left out.
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
        """Names of the sites for which it is unknown when they ended.

        When a site ends, it publishes an event "end", which states how many ticks the site
        executed. No "end" event has been received from the sites listed here.
        """
        return [site for site in self._rates_hz if site not in self._end_ticks]

    def describe_unfinished_sites(self) -> Iterator[str]:
        """Describes for the user which sites may have executed more ticks than were recorded.

        These are the sites that never published the event "end", and whose last recorded tick
        is not the last tick of the scenario.

        Yields:
            One line per such site.
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

    @classmethod
    def open(
        cls, metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]
    ) -> "SessionAccounts | None":
        """Prepares to count the messages of a session, before a file of its log is read.

        Args:
            metadata: Maps the name of each metadata record of the file to its contents. These
                records identify the session.
            attachments: Maps the name of each attachment of the file to its contents. One of
                them is the scenario.

        Returns:
            Accounts with no messages counted yet, or None if the file is not a log of
            trilat-net.
        """
        session_facts = metadata.get(SESSION, {})
        try:
            scenario = parse_embedded(attachments[SCENARIO].decode(), SCENARIO)
            session = session_facts["session"]
            version = int(session_facts["schema_version"])
        except (KeyError, ValueError, ScenarioError):
            return None

        part_number = metadata.get(PART, {}).get("index", "1")
        return cls(
            session,
            scenario,
            continued=part_number != "1",
            events=version >= _EVENTS_NUMBERED_SINCE,
        )

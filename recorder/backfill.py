"""Requests messages that were lost on the network from their sender again.

Sites publish numbered messages, which the recorder writes to a log. A gap in the numbers shows
that a message was lost. Losing the last messages leaves no gap. If nothing arrives from a site
for a while, the recorder therefore requests the newest messages of that site (a probe). The
functions never wait, and receive the present time as an argument.

Invariant:
    - At most one request to a site is open at a time.
    - No request for missing messages is sent if no message is missing.
    - A message that the site no longer has is not requested again.
    - Messages from the buffer of the site undergo the same checks as published messages.
"""

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from trilat_net.errors import WireError
from trilat_net.log import SITE_CHANNELS, Account, SessionScenario
from trilat_net.net import (
    BACKFILL_MESSAGES,
    Backfill,
    BackfillRequest,
    Bus,
    Inbox,
    decode,
    encode,
    topics,
)

from .site_reception import SiteMessage, SiteReception

GRACE_NS = 50_000_000
"""Time before a missing message is requested, in case it is only late, in ns."""
SILENT_NS = 1_000_000_000
"""Time with no messages after which the newest messages of a site are requested, in ns.

For slow sites, three tick periods are used instead.
"""
ANSWER_NS = (300_000_000, 3_000_000_000)
"""Minimum and maximum timeout of a request, in ns. It doubles after each request without a
reply.
"""
_REST_NS = 250_000_000
"""Pause after a reply that contained no new message, in ns."""
MAX_VAIN_REQUESTS = 20
"""Number of consecutive replies with no new message after which the gaps are given up."""
GIVE_UP_NS = 10_000_000_000
"""Time with no new message, after a site has ended, until its gaps are given up, in ns."""


RepairedMessage = tuple[str, SiteMessage, bytes]
"""A message that a site resent on request: channel, message and payload."""


class _OpenRequest(NamedTuple):
    """An unanswered request from the recorder for missing messages.

    Attributes:
        request: The request, which states the wanted message numbers.
        replies: Inbox in which the network connection stores the replies to the request.
        sent_ns: Time at which the request was sent, on the monotonic clock, in ns.
    """

    request: BackfillRequest
    replies: Inbox
    sent_ns: int


class GapRepair:
    """Requests messages that were lost on the network from the site that sent them.

    A site keeps its recent messages in a buffer for this purpose. Each object handles one start
    of the site's process.

    Args:
        bus: Network connection of the recorder.
        session: Name of the session.
        scenario: Scenario of the session.
        site: Name of the site.
        boot: Random number that identifies the start of the site. None if the site has not
            appeared yet.
        dropped: Mapping from reason to number of dropped messages. Invalid replies are added.
        now_ns: Present time on the monotonic clock, in ns.
        before: Object for the previous start of the site. None for the first start.

    Attributes:
        reception: Receives the messages of the site, and counts the missing ones.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        scenario: SessionScenario,
        site: str,
        boot: int | None,
        dropped: Counter[str],
        *,
        now_ns: int = 0,
        before: "GapRepair | None" = None,
    ) -> None:
        previous = None if before is None else before.reception
        self.reception: SiteReception = SiteReception(scenario, site, boot, previous)
        self._bus = bus
        self._session = session
        self._scenario = scenario
        self._key = topics.key(session, site, topics.PAST)
        self._dropped = dropped
        # The channels take turns. The channel of the last request is at the end.
        self._turns = list(SITE_CHANNELS)
        # Channels whose newest messages will be requested.
        self._probes: set[str] = set()
        # Number at which the search for the next gap begins, by channel.
        self._next_numbers = dict.fromkeys(SITE_CHANNELS, 0)
        # Number of successive replies without any new message, by channel.
        self._vain_requests = dict.fromkeys(SITE_CHANNELS, 0)
        self._open: _OpenRequest | None = None
        # Time at which the next request is sent. None if no message is missing.
        self._due_ns: int | None = None
        self._timeout_ns = ANSWER_NS[0]
        # Number of messages per request. It is reduced while no replies arrive, because large
        # replies may not get through a bad connection.
        self._request_size = BACKFILL_MESSAGES
        self._polled_ns = now_ns
        self._probed_ns = now_ns
        # Time at which the last new message arrived.
        self._progress_ns = now_ns
        self._ended_ns: int | None = None

    @property
    def is_active(self) -> bool:
        """True if messages are missing that the site may still have, or if a reply is pending.

        The recorder then checks for replies more often than it writes to the disk.
        """
        return self._open is not None or self._due_ns is not None

    @property
    def progress_ns(self) -> int:
        """Time at which a missing message last arrived, on the monotonic clock, in ns.

        If this was long ago, the site probably no longer has any of the missing messages.
        """
        return self._progress_ns

    def follow_start(self, boot: int) -> "GapRepair":
        """Returns the object for the next start of the site, which continues the counts.

        Args:
            boot: Random number that identifies the next start.
        """
        return GapRepair(
            bus=self._bus,
            session=self._session,
            scenario=self._scenario,
            site=self.reception.name,
            boot=boot,
            dropped=self._dropped,
            before=self,
        )

    def probe(self) -> None:
        """Makes `poll` request the newest messages of every channel of the site.

        Because messages are numbered, each one shows whether earlier ones were lost. The loss
        of the last messages can only be detected with this request.
        """
        self._probes = set(SITE_CHANNELS)

    def poll(self, now_ns: int, *, alive: bool) -> Iterator[RepairedMessage]:
        """Receives replies from the site, and sends the next request if messages are missing.

        The recorder calls this method regularly for each site. It never waits for replies.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
            alive: True if the site is present on the network and can reply.

        Yields:
            The messages contained in the replies. Nothing if no reply has arrived.
        """
        if now_ns - self._polled_ns > SILENT_NS:
            # Nothing could arrive while this process was suspended, so the site was not silent.
            self._progress_ns = now_ns
        self._polled_ns = now_ns

        if self._open is not None:
            yield from self._receive_reply(self._open, now_ns)
        if alive:
            self._probe_if_silent(now_ns)
            if self._open is None:
                self._send_request(now_ns)

        if self.reception.final_ticks is not None:
            if self._ended_ns is None:
                self._ended_ns = now_ns
            # After the end of the site, messages are requested from its buffer until no more
            # arrive.
            waited_since_ns = max(self._ended_ns, self._progress_ns)
            if now_ns - waited_since_ns > GIVE_UP_NS:
                self.reception.give_up()

    def _probe_if_silent(self, now_ns: int) -> None:
        """Requests the newest messages of a running site whose messages have stopped arriving.

        If its last messages were lost, no later number reveals the gap, so the recorder has to
        ask. The silence is measured from the last message or the last probe. For a slow site,
        three tick periods are allowed.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
        """
        last_received_ns = self.reception.last_received_ns or 0
        silence_ns = now_ns - max(last_received_ns, self._probed_ns)
        longest_silence_ns = max(SILENT_NS, 3 * self.reception.period_ns)
        is_running = self.reception.final_ticks is None
        if is_running and silence_ns > longest_silence_ns:
            self._probed_ns = now_ns
            self.probe()

    def _send_request(self, now_ns: int) -> None:
        """Sends the next request to the site if messages are missing and the request is due.

        A message that has just been noticed as missing may only be late, so the first request
        is due `GRACE_NS` later. The due time then stays in the past, and a request without a
        reply is repeated immediately after its timeout. A reply sets a new due time, see
        `_accept_reply`. Once nothing is missing any more, the due time is cleared.

        The caller ensures that no other request is open.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
        """
        request = self._make_request()
        if request is None:
            self._due_ns = None
            return

        was_nothing_missing = self._due_ns is None
        if was_nothing_missing:
            self._due_ns = now_ns + GRACE_NS
        assert self._due_ns is not None
        if now_ns < self._due_ns:
            return

        # The requested channel goes to the end of the list, so that the others are next.
        self._turns.remove(request.channel)
        self._turns.append(request.channel)
        replies = self._bus.query(self._key, encode(request))
        self._open = _OpenRequest(request, replies, now_ns)

    def _make_request(self) -> BackfillRequest | None:
        """Chooses the channel and the numbers of the messages that are requested next.

        The channels take turns, and the one whose last request is longest ago is examined
        first. The gaps of a channel are requested in ascending order. After the gap with the
        highest numbers, the search starts over at the lowest ones, because replies may be
        incomplete.

        A probe requests the messages after the last known one. It reveals whether the site has
        published messages of which nothing has arrived.

        Returns:
            A request for at most `_request_size` consecutive messages of one channel, or None
            if no message is missing and no probe is scheduled.
        """
        for channel in self._turns:
            account = self.reception.accounts[channel]
            next_gap = account.find_requestable_gap(self._next_numbers[channel])
            first_gap = account.find_requestable_gap() if next_gap is None else None
            requested_range = next_gap or first_gap
            if requested_range is None and channel in self._probes:
                requested_range = (account.last + 1, account.last + self._request_size)
            if requested_range is None:
                continue

            first, last_missing = requested_range
            highest = first + self._request_size - 1
            last = self._extend_over_gaps(account, last_missing, highest)
            return BackfillRequest(channel=channel, first=first, last=last)  # type: ignore[arg-type]
        return None

    @staticmethod
    def _extend_over_gaps(account: Account, last_missing: int, limit: int) -> int:
        """Returns the last number of a request, extended to cover gaps that follow closely.

        On a busy machine, many single messages may be lost in a second. With one request per
        gap, the recorder would fall further behind than the site's buffer reaches. The messages
        between the gaps arrive a second time and are ignored.

        Args:
            account: Account of the channel.
            last_missing: Last number of the first gap.
            limit: Highest number that the request may contain.
        """
        while last_missing < limit:
            next_gap = account.find_requestable_gap(last_missing + 1)
            if next_gap is None:
                break
            gap_first, gap_last = next_gap
            if gap_first > limit:
                break
            last_missing = gap_last
        return min(last_missing, limit)

    def _receive_reply(
        self, open_request: _OpenRequest, now_ns: int
    ) -> Iterator[RepairedMessage]:
        """Yields the messages in the reply if it has arrived, or closes an expired request.

        The timeout and the size of the next requests adapt to the connection:

        - After a valid reply, the timeout is four times the time that the reply took, within
          the limits `ANSWER_NS`. The number of requested messages is doubled.
        - If no valid reply arrives within the timeout, the request is closed, so that it can be
          repeated. The timeout is doubled and the number of requested messages is halved,
          because small replies get through a bad connection more easily.

        An invalid reply is counted as dropped and has no other effect: the request stays open
        until a valid reply arrives or the timeout expires.

        Args:
            open_request: The open request.
            now_ns: Present time on the monotonic clock, in ns.

        Yields:
            The new messages in a valid reply. Nothing if no valid reply has arrived.
        """
        request = open_request.request

        # The connection works: ask for more at once, and adapt the timeout.
        shortest_timeout_ns, longest_timeout_ns = ANSWER_NS
        elapsed_ns = now_ns - open_request.sent_ns
        while (reply := open_request.replies.poll()) is not None:
            _key, payload = reply
            try:
                backfill = self._decode(payload, request)
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            timeout_ns = max(shortest_timeout_ns, 4 * elapsed_ns)
            self._timeout_ns = min(timeout_ns, longest_timeout_ns)
            self._request_size = min(2 * self._request_size, BACKFILL_MESSAGES)
            self._open = None
            yield from self._accept_reply(backfill, request, now_ns)
            return

        is_expired = elapsed_ns >= self._timeout_ns
        if is_expired:
            self._timeout_ns = min(2 * self._timeout_ns, longest_timeout_ns)
            self._request_size = max(1, self._request_size // 2)
            self._open = None

    def _decode(self, payload: bytes, request: BackfillRequest) -> Backfill:
        """Decodes a reply to a request, and checks that the two belong together.

        If the site no longer stores the first requested messages, the reply begins at a higher
        number than requested. It cannot, however, begin after the number of messages that the
        site has published so far, which the reply states. A probe requests messages that may
        not exist, so a reply that begins exactly at the requested number is always valid.

        Args:
            payload: The site's encoded reply.
            request: The request that is open.

        Returns:
            The reply: consecutive messages of one channel.

        Raises:
            WireError: The reply is invalid, comes from another process, or contains messages
                other than those requested.
        """
        backfill = decode(payload, Backfill)
        self.reception.check_sender(backfill)
        published = backfill.made
        highest_first = max(published, request.first)
        is_other_channel = backfill.channel != request.channel
        if is_other_channel or backfill.first > highest_first:
            raise WireError(
                "out of range",
                f"the reply contains {backfill.channel} starting at number {backfill.first} "
                f"(of {published} published), but {request.channel} starting at number "
                f"{request.first} was requested",
            )
        return backfill

    def _accept_reply(
        self, backfill: Backfill, request: BackfillRequest, now_ns: int
    ) -> Iterator[RepairedMessage]:
        """Evaluates a reply with previously lost messages, and yields those that are new.

        A reply that fills no gap is counted, because the recorder gives up after several of
        them. Finally, the next request is scheduled.

        Args:
            backfill: The reply.
            request: The request that it answers.
            now_ns: Present time on the monotonic clock, in ns.
        """
        channel = backfill.channel
        account = self.reception.accounts[channel]
        self._probes.discard(channel)
        self.reception.add_expected(channel, backfill.made)
        if backfill.first > request.first:
            # The site no longer has the messages before the first one of the reply.
            account.abandon_below(backfill.first)

        is_useful = False
        for number, payload in enumerate(backfill.payloads, backfill.first):
            if not payload:
                continue  # the site skipped this tick, as a record states
            try:
                message = self.reception.read(channel, payload)
                if message.number != number:
                    raise WireError(
                        "out of range",
                        f"number {message.number} of {channel} arrived where number {number} "
                        "was expected",
                    )
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            if self.reception.refill(channel, message):
                is_useful = True
                yield channel, message, payload

        next_number = backfill.first + len(backfill.payloads)
        self._next_numbers[channel] = max(next_number, request.first + 1)
        gap = account.find_requestable_gap(request.first)
        self._due_ns = now_ns
        if is_useful:
            self._progress_ns = now_ns

        is_gap_closed = gap is None or gap[0] > request.first
        if is_useful or is_gap_closed:
            self._vain_requests[channel] = 0
        else:
            self._due_ns = now_ns + _REST_NS
            self._count_vain_request(channel)

    def _count_vain_request(self, channel: str) -> None:
        """Counts a request that filled no gap, and gives up after `MAX_VAIN_REQUESTS` of them.

        All messages that are missing on the channel then count as permanently missing.

        Args:
            channel: Channel of the missing messages.
        """
        self._vain_requests[channel] += 1
        if self._vain_requests[channel] >= MAX_VAIN_REQUESTS:
            self._vain_requests[channel] = 0
            account = self.reception.accounts[channel]
            account.abandon_below(account.last + 1)

"""Repair gaps: request missing messages of a site from its retransmission buffer.

A probe requests the newest messages of a site that has been silent for too long. Lost last
records, a lost end event and lost statistics are found by that. No function waits; the time is
an argument.

Invariant:
    - At most one request to a site is outstanding.
    - No request is sent while no message is missing.
    - A message that the site does not have is not requested twice.
    - Backfilled messages pass the same checks as published messages.
"""

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from trilat_net.errors import WireError
from trilat_net.log.log_layout import SITE_CHANNELS
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.requests import BACKFILL_MESSAGES, Backfill, BackfillRequest
from trilat_net.net.wire import decode, encode

from .site_reception import SiteMessage, SiteReception

GRACE_NS = 50_000_000
"""Wait before a missing message is requested, because it may only be late."""
SILENT_NS = 1_000_000_000
"""Silence after which the newest messages of a site are requested; at least three periods of
the site.
"""
ANSWER_NS = (300_000_000, 3_000_000_000)
"""First and longest timeout of a request. It doubles after each request without a reply."""
REST_NS = 250_000_000
"""Pause after a reply without any requested message."""
MAX_VAIN_REQUESTS = 20
"""Number of successive replies of that kind after which the gaps of a channel are given up."""
GIVE_UP_NS = 10_000_000_000
"""Longest time without progress after a site has ended, before all its gaps are given up."""


RepairedMessage = tuple[str, SiteMessage, bytes]
"""A message from the retransmission buffer of a site: channel, message and payload."""


class _OpenRequest(NamedTuple):
    """A request that waits for its reply.

    Attributes:
        request: the request.
        replies: receives the replies.
        sent_ns: time at which the request was sent, ns.
    """

    request: BackfillRequest
    replies: Inbox
    sent_ns: int


class GapRepair:
    """The requests for missing messages to one site.

    Args:
        bus: the connection to the session.
        session: name of the session.
        reception: the received messages of the site.
        dropped: counts the invalid replies by reason.
        now_ns: the present time on the recorder's clock, ns.
    """

    def __init__(
        self,
        bus: Bus,
        session: str,
        reception: SiteReception,
        dropped: Counter[str],
        now_ns: int = 0,
    ) -> None:
        self._bus = bus
        self._key = topics.key(session, reception.name, topics.PAST)
        self._reception = reception
        self._dropped = dropped
        self._turns = list(SITE_CHANNELS)  # the channel of the last request is at the end
        self._probes: set[str] = set()  # channels whose newest messages are requested next
        self._next_numbers = dict.fromkeys(SITE_CHANNELS, 0)
        self._vain_requests = dict.fromkeys(SITE_CHANNELS, 0)
        self._open: _OpenRequest | None = None
        self._due_ns: int | None = None
        # fewer messages per request while no replies arrive
        self._timeout_ns = ANSWER_NS[0]
        self._request_size = BACKFILL_MESSAGES
        self._polled_ns = now_ns
        self._probed_ns = now_ns
        self._progress_ns = now_ns
        self._ended_ns: int | None = None

    def probe(self) -> None:
        """Lets the next requests ask for the newest messages of every channel."""
        self._probes = set(SITE_CHANNELS)

    def poll(self, now_ns: int, *, alive: bool) -> Iterator[RepairedMessage]:
        """Yields missing messages that have arrived, and requests more.

        Args:
            now_ns: the present time, ns.
            alive: whether the site is present, so that it can reply.
        """
        if now_ns - self._polled_ns > SILENT_NS:  # this process was suspended, not the site
            self._progress_ns = now_ns
        self._polled_ns = now_ns
        if self._open is not None:
            yield from self._receive_reply(self._open, now_ns)
        if alive:
            self._probe_if_silent(now_ns)
            if self._open is None:
                self._send_request(now_ns)
        if self._reception.final_ticks is not None:
            if self._ended_ns is None:
                self._ended_ns = now_ns
            if now_ns - max(self._ended_ns, self._progress_ns) > GIVE_UP_NS:
                self._reception.give_up()

    def _probe_if_silent(self, now_ns: int) -> None:
        last_received_ns = self._reception.last_received_ns or 0
        silence_ns = now_ns - max(last_received_ns, self._probed_ns)
        longest_ns = max(SILENT_NS, 3 * self._reception.period_ns)
        if self._reception.final_ticks is None and silence_ns > longest_ns:
            self._probed_ns = now_ns
            self.probe()

    def _send_request(self, now_ns: int) -> None:
        """Sends the next request if it is due."""
        request = self._make_request()
        if request is None:
            self._due_ns = None
            return
        if self._due_ns is None:
            self._due_ns = now_ns + GRACE_NS
        if now_ns >= self._due_ns:
            self._turns.remove(request.channel)
            self._turns.append(request.channel)
            replies = self._bus.query(self._key, encode(request))
            self._open = _OpenRequest(request, replies, now_ns)

    def _make_request(self) -> BackfillRequest | None:
        """Returns the next request; None if no message is missing."""
        for channel in self._turns:
            account = self._reception.accounts[channel]
            gap = account.find_requestable_gap(self._next_numbers[channel])
            if gap is None:
                gap = account.find_requestable_gap()
            if gap is None and channel in self._probes:
                gap = (account.last + 1, account.last + self._request_size)
            if gap is not None:
                first, last = gap
                last = min(last, first + self._request_size - 1)
                return BackfillRequest(channel=channel, first=first, last=last)  # type: ignore[arg-type]
        return None

    def _receive_reply(
        self, open_request: _OpenRequest, now_ns: int
    ) -> Iterator[RepairedMessage]:
        """Yields the messages of a valid reply; closes a request that has timed out."""
        request = open_request.request
        round_trip_ns = now_ns - open_request.sent_ns
        while (reply := open_request.replies.poll()) is not None:
            try:
                past = self._decode(reply[1], request)
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            self._timeout_ns = min(max(ANSWER_NS[0], 4 * round_trip_ns), ANSWER_NS[1])
            self._request_size = min(2 * self._request_size, BACKFILL_MESSAGES)
            self._open = None
            yield from self._accept_reply(past, request, now_ns)
            return
        if round_trip_ns >= self._timeout_ns:
            self._timeout_ns = min(2 * self._timeout_ns, ANSWER_NS[1])
            self._request_size = max(1, self._request_size // 2)
            self._open = None

    def _decode(self, payload: bytes, request: BackfillRequest) -> Backfill:
        past = decode(payload, Backfill)
        self._reception.check_sender(past)
        if past.channel != request.channel or past.first > max(past.made, request.first):
            raise WireError(
                "out of range", f"{past.channel} from {past.first} on, of {past.made}"
            )
        return past

    def _accept_reply(
        self, past: Backfill, request: BackfillRequest, now_ns: int
    ) -> Iterator[RepairedMessage]:
        """Counts the messages of a reply, and yields messages that are new."""
        channel = past.channel
        account = self._reception.accounts[channel]
        self._probes.discard(channel)
        self._reception.add_expected(channel, past.made)
        if past.first > request.first:  # the site does not hold the messages before
            account.abandon_below(past.first)
        is_useful = False
        for number, payload in enumerate(past.payloads, past.first):
            if not payload:  # the site skipped this tick, as a record states
                continue
            try:
                message = self._reception.read(channel, payload)
                if message.number != number:
                    raise WireError(
                        "out of range", f"{channel} {message.number} in the place of {number}"
                    )
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            if self._reception.refill(channel, message):
                is_useful = True
                yield channel, message, payload
        next_number = past.first + len(past.payloads)
        self._next_numbers[channel] = max(next_number, request.first + 1)
        gap = account.find_requestable_gap(request.first)
        self._due_ns = now_ns
        if is_useful:
            self._progress_ns = now_ns
        if is_useful or gap is None or gap[0] > request.first:
            self._vain_requests[channel] = 0
        else:
            self._due_ns = now_ns + REST_NS
            self._count_vain_request(channel)

    def _count_vain_request(self, channel: str) -> None:
        """Counts a reply without any requested message, and gives up after too many."""
        self._vain_requests[channel] += 1
        if self._vain_requests[channel] >= MAX_VAIN_REQUESTS:
            self._vain_requests[channel] = 0
            account = self._reception.accounts[channel]
            account.abandon_below(account.last + 1)

"""Gap repair: requests missing messages from one site's retransmission buffer.

Invariant: at most one request is outstanding, none is sent while nothing is missing, and a
message that the site does not have is not requested twice. Backfilled messages pass the same
checks as live ones.

A site that is silent for too long is asked for its newest messages, so a lost tail, a lost end
and lost statistics are noticed. Time is an argument; nothing waits.
"""

from collections import Counter
from collections.abc import Iterator

from trilat_net.errors import WireError
from trilat_net.log.log_layout import SITE_CHANNELS
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.requests import BACKFILL_MESSAGES, Backfill, BackfillRequest
from trilat_net.net.wire import decode, encode

from .site_reception import SiteMessage, SiteReception

GRACE_NS = 50_000_000
"""Time for a message that may only be late, before it is requested."""
SILENT_NS = 1_000_000_000
"""Silence, and three periods of the site, after which the site is asked for its newest
messages.
"""
ANSWER_NS = (300_000_000, 3_000_000_000)
"""First and longest timeout of a request; it doubles after each request without an answer."""
REST_NS = 250_000_000
"""Pause after an answer that brought nothing requested."""
MAX_VAIN_REQUESTS = 20
"""So many of these in a row, and the channel's gaps are given up."""
GIVE_UP_NS = 10_000_000_000
"""Time for a site that has ended to answer."""


RepairedMessage = tuple[str, SiteMessage, bytes]
"""One message out of a site's retransmission buffer: its channel, the message, its payload."""


class GapRepair:
    """The requests to one site; `dropped` counts its invalid answers by reason."""

    def __init__(
        self,
        bus: Bus,
        session: str,
        reception: SiteReception,
        dropped: Counter[str],
        now_ns: int = 0,
    ) -> None:
        self._progress_ns = self._polled_ns = now_ns
        self._bus = bus
        self._key = topics.key(session, reception.name, topics.PAST)
        self._reception = reception
        self._dropped = dropped
        self._turns = list(SITE_CHANNELS)
        self._probes: set[str] = set()
        self._probed_ns = now_ns
        self._next = dict.fromkeys(SITE_CHANNELS, 0)
        self._vain = dict.fromkeys(SITE_CHANNELS, 0)
        self._open: tuple[BackfillRequest, Inbox, int] | None = (
            None  # its answers, when it was sent
        )
        self._due_ns: int | None = None
        # fewer messages per request while answers do not arrive
        self._timeout_ns = ANSWER_NS[0]
        self._chunk = BACKFILL_MESSAGES
        self._ended_ns: int | None = None

    def probe(self) -> None:
        """Requests the newest messages of every channel next."""
        self._probes = set(SITE_CHANNELS)

    def poll(self, now_ns: int, *, alive: bool) -> Iterator[RepairedMessage]:
        """Yields missing messages that have arrived; requests more."""
        if now_ns - self._polled_ns > SILENT_NS:  # this process was frozen, not the site
            self._progress_ns = now_ns
        self._polled_ns = now_ns
        if self._open is not None:
            yield from self._read_answers(*self._open, now_ns)
        if alive:
            silent_ns = now_ns - max(self._reception.last_received_ns or 0, self._probed_ns)
            if self._reception.final_ticks is None and silent_ns > max(
                SILENT_NS, 3 * self._reception.period_ns
            ):
                self._probed_ns = now_ns
                self.probe()
            if self._open is None:
                self._request(now_ns)
        if self._reception.final_ticks is not None:
            if self._ended_ns is None:
                self._ended_ns = now_ns
            if now_ns - max(self._ended_ns, self._progress_ns) > GIVE_UP_NS:
                self._reception.give_up()

    def _request(self, now_ns: int) -> None:
        wanted = self._next_request()
        if wanted is None:
            self._due_ns = None
            return
        if self._due_ns is None:
            self._due_ns = now_ns + GRACE_NS
        if now_ns >= self._due_ns:
            self._turns.remove(wanted.channel)
            self._turns.append(wanted.channel)
            self._open = wanted, self._bus.query(self._key, encode(wanted)), now_ns

    def _next_request(self) -> BackfillRequest | None:
        for channel in self._turns:
            account = self._reception.accounts[channel]
            gap = (
                account.find_requestable_gap(self._next[channel])
                or account.find_requestable_gap()
            )
            if gap is None and channel in self._probes:
                gap = (account.last + 1, account.last + self._chunk)
            if gap is not None:
                last = min(gap[1], gap[0] + self._chunk - 1)
                return BackfillRequest(channel=channel, first=gap[0], last=last)  # type: ignore[arg-type]
        return None

    def _read_answers(
        self, wanted: BackfillRequest, answers: Inbox, asked_ns: int, now_ns: int
    ) -> Iterator[RepairedMessage]:
        """Takes a valid answer if it has arrived; closes the request if it should have."""
        while (reply := answers.poll()) is not None:
            try:
                past = self._decode(reply[1], wanted)
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            self._timeout_ns = min(max(ANSWER_NS[0], 4 * (now_ns - asked_ns)), ANSWER_NS[1])
            self._chunk = min(2 * self._chunk, BACKFILL_MESSAGES)
            self._open = None
            yield from self._take(past, wanted, now_ns)
            return
        if now_ns - asked_ns >= self._timeout_ns:
            self._timeout_ns = min(2 * self._timeout_ns, ANSWER_NS[1])
            self._chunk = max(1, self._chunk // 2)
            self._open = None

    def _decode(self, payload: bytes, wanted: BackfillRequest) -> Backfill:
        past = decode(payload, Backfill)
        self._reception.check_sender(past)
        if past.channel != wanted.channel or past.first > max(past.made, wanted.first):
            raise WireError(
                "out of range", f"{past.channel} from {past.first} on, of {past.made}"
            )
        return past

    def _take(
        self, past: Backfill, wanted: BackfillRequest, now_ns: int
    ) -> Iterator[RepairedMessage]:
        channel = past.channel
        account = self._reception.accounts[channel]
        self._probes.discard(channel)
        self._reception.add_expected(channel, past.made)
        if past.first > wanted.first:
            account.abandon_below(past.first)
        useful = False
        for number, payload in enumerate(past.payloads, past.first):
            if not payload:  # the site never made it, and a record says so
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
                useful = True
                yield channel, message, payload
        self._next[channel] = max(past.first + len(past.payloads), wanted.first + 1)
        gap = account.find_requestable_gap(wanted.first)
        self._due_ns = now_ns
        if useful:
            self._progress_ns = now_ns
        if useful or gap is None or gap[0] > wanted.first:
            self._vain[channel] = 0
            return
        self._due_ns = now_ns + REST_NS
        self._vain[channel] += 1
        if self._vain[channel] >= MAX_VAIN_REQUESTS:
            self._vain[channel] = 0
            account.abandon_below(account.last + 1)

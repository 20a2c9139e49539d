"""Gap repair: requests missing messages from one site's retransmission buffer.

Invariant: at most one request is outstanding, none is sent while nothing is missing, and a message that the
site does not have is not requested twice. Backfilled messages pass the same checks as live ones.

A site that is silent for too long is asked for its newest messages, so a lost tail, a lost end and lost
statistics are noticed. Time is an argument; nothing waits.
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
"""How long to wait for what may only be late before it is asked for."""
SILENT_NS = 1_000_000_000
"""After how long without a word a site is asked whether it has said any; and three of its periods."""
ANSWER_NS = (300_000_000, 3_000_000_000)
"""How long to wait for an answer, at first and at most: twice as long after each that did not come."""
REST_NS = 250_000_000
"""Before the next question, where an answer brought nothing that was wanted."""
MAX_VAIN_REQUESTS = 20
"""So many of these in a row, and the channel's gaps are given up."""
GIVE_UP_NS = 10_000_000_000
"""How long to ask a site that has ended and does not answer."""


class RepairedMessage(NamedTuple):
    """One message out of a site's memory."""

    channel: str
    message: SiteMessage
    payload: bytes


class _OpenRequest(NamedTuple):
    """A question under way."""

    wanted: BackfillRequest
    answers: Inbox
    asked_ns: int


class GapRepair:
    """What one site is asked for.

    Args:
        bus: the connection.
        session: the session's name.
        sender: the site.
        dropped: where answers that are none are counted, by reason.
        now_ns: the time, on the recorder's clock.
    """

    def __init__(
        self, bus: Bus, session: str, sender: SiteReception, dropped: Counter[str], now_ns: int = 0
    ) -> None:
        self._progress_ns = now_ns
        self._bus, self._key = bus, topics.key(session, sender.name, topics.PAST)
        self._sender, self._dropped = sender, dropped
        self._turns = list(SITE_CHANNELS)
        self._probes: set[str] = set()
        self._probed_ns = now_ns
        self._next = dict.fromkeys(SITE_CHANNELS, 0)
        self._vain = dict.fromkeys(SITE_CHANNELS, 0)
        self._open: _OpenRequest | None = None
        self._due_ns: int | None = None
        # fewer at once where answers do not come
        self._patience_ns, self._chunk = ANSWER_NS[0], BACKFILL_MESSAGES
        self._ended_ns: int | None = None

    def probe(self) -> None:
        """Asks next what the site has made so far, of every channel."""
        self._probes = set(SITE_CHANNELS)

    def poll(self, now_ns: int, *, alive: bool) -> Iterator[RepairedMessage]:
        """Yields what was missing and has come; asks for more.

        Args:
            now_ns: the time.
            alive: whether the site is there to be asked.
        """
        if self._open is not None:
            yield from self._hear(self._open, now_ns)
        if alive:
            self._notice_silence(now_ns)
            if self._open is None:
                self._ask(now_ns)
        self._give_up(now_ns)

    def _notice_silence(self, now_ns: int) -> None:
        """A site that should have been heard is asked, once for each time that it should have been."""
        patience_ns = max(SILENT_NS, 3 * self._sender.period_ns)
        last_ns = max(self._sender.heard_ns or 0, self._probed_ns)
        if self._sender.made is None and now_ns - last_ns > patience_ns:
            self._probed_ns = now_ns
            self.probe()

    def _ask(self, now_ns: int) -> None:
        wanted = self._wanted()
        if wanted is None:
            self._due_ns = None
            return
        if self._due_ns is None:
            self._due_ns = now_ns + GRACE_NS
        if now_ns >= self._due_ns:
            self._turns.remove(wanted.channel)
            self._turns.append(wanted.channel)
            self._open = _OpenRequest(wanted, self._bus.ask(self._key, encode(wanted)), now_ns)

    def _wanted(self) -> BackfillRequest | None:
        """Returns what to ask for next: channel by channel in turn, gap by gap."""
        for channel in self._turns:
            account = self._sender.accounts[channel]
            gap = account.wanted(self._next[channel]) or account.wanted()
            if gap is None and channel in self._probes:
                gap = (account.last + 1, account.last + self._chunk)
            if gap is not None:
                last = min(gap[1], gap[0] + self._chunk - 1)
                return BackfillRequest(channel=channel, first=gap[0], last=last)  # type: ignore[arg-type]
        return None

    def _hear(self, question: _OpenRequest, now_ns: int) -> Iterator[RepairedMessage]:
        """Takes the answer, if it has come; asks on if it should have."""
        while (reply := question.answers.poll()) is not None:
            try:
                past = self._understood(reply[1], question.wanted)
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            trip_ns = now_ns - question.asked_ns
            self._patience_ns = min(max(ANSWER_NS[0], 4 * trip_ns), ANSWER_NS[1])
            self._chunk = min(2 * self._chunk, BACKFILL_MESSAGES)
            self._open = None
            yield from self._take(past, question.wanted, now_ns)
            return
        if now_ns - question.asked_ns >= self._patience_ns:
            self._patience_ns = min(2 * self._patience_ns, ANSWER_NS[1])
            self._chunk = max(1, self._chunk // 2)
            self._open = None

    def _understood(self, payload: bytes, wanted: BackfillRequest) -> Backfill:
        """Returns an answer to a question.

        Raises:
            WireError: it is none.
        """
        past = decode(payload, Backfill)
        self._sender.trust(past)
        if past.channel != wanted.channel or past.first > max(past.made, wanted.first):
            raise WireError("out of range", f"{past.channel} from {past.first} on, of {past.made}")
        return past

    def _take(self, past: Backfill, wanted: BackfillRequest, now_ns: int) -> Iterator[RepairedMessage]:
        """Takes what an answer brings, and learns what it says of the rest."""
        channel = past.channel
        account = self._sender.accounts[channel]
        self._probes.discard(channel)
        self._sender.expect(channel, past.made)
        if past.first > wanted.first:
            account.give_up(past.first)
        some = False
        for number, payload in enumerate(past.payloads, past.first):
            try:
                message = self._sender.read(channel, payload)
                if message.number != number:
                    raise WireError("out of range", f"{channel} {message.number} in the place of {number}")
            except WireError as error:
                self._dropped[error.reason] += 1
                continue
            if self._sender.refill(channel, message):
                some = True
                yield RepairedMessage(channel, message, payload)
        self._next[channel] = max(past.first + len(past.payloads), wanted.first + 1)
        self._settle(channel, wanted, now_ns, some=some)

    def _settle(self, channel: str, wanted: BackfillRequest, now_ns: int, *, some: bool) -> None:
        """Notes whether an answer was of use: if it was not, the next question may wait."""
        account = self._sender.accounts[channel]
        still = account.wanted(wanted.first)
        self._due_ns = now_ns
        if some:
            self._progress_ns = now_ns
        if some or still is None or still[0] > wanted.first:
            self._vain[channel] = 0
            return
        self._due_ns = now_ns + REST_NS
        self._vain[channel] += 1
        if self._vain[channel] >= MAX_VAIN_REQUESTS:
            self._vain[channel] = 0
            account.give_up(account.last + 1)

    def _give_up(self, now_ns: int) -> None:
        """A site that has ended and answers no more is asked no more."""
        if self._sender.made is None:
            return
        if self._ended_ns is None:
            self._ended_ns = now_ns
        if now_ns - max(self._ended_ns, self._progress_ns) > GIVE_UP_NS:
            self._sender.give_up()

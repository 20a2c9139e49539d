"""What a page may ask for: its messages, checked, and how they reach the sites.

Invariant: a message is one of the types below with finite numbers in range, or it is counted and dropped.
What a site takes in is for the site to decide. Of a link or a row only the newest order waits, however often
it is changed, and one question to a site is open at a time.
"""

import math
from collections import Counter
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.clock import Clock
from trilat_net.net.requests import ChangeReply, ChangeRequest
from trilat_net.net.wire import decode, encode

MAX_MESSAGE_BYTES = 4_096
REPLY_TIMEOUT_NS = 3_000_000_000
LEAST_RAMP_S = 0.25
"""The time in which shares change that somebody drags, s."""
FARTHEST_M = 100.0
"""A hand further from the base is a mistake, m; so is a force of more than ten thousand N."""
MOST_FORCE_N = 1e4

Name = Annotated[str, Meta(max_length=64)]
Numbers = Annotated[list[float], Meta(max_length=12)]


class PageMessage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="do"):
    """A message of a page; the tag says what it is."""


class Seen(PageMessage, frozen=True, kw_only=True, tag="seen"):
    """The page has drawn frame `n`; the next one may come."""

    n: Annotated[int, Meta(ge=0, lt=2**53)]


class TakePart(PageMessage, frozen=True, kw_only=True, tag="control"):
    """The page wants to take part, or no longer."""

    want: bool


class SetLink(PageMessage, frozen=True, kw_only=True, tag="link"):
    """New values of a link, as `trilat set` takes them."""

    link: Name
    to: Annotated[dict[Name, float | Name], Meta(max_length=8)]


class SetShares(PageMessage, frozen=True, kw_only=True, tag="shares"):
    """A new row of the dominance matrix."""

    site: Name
    to: Annotated[dict[Name, float], Meta(max_length=16)]


class EndSession(PageMessage, frozen=True, kw_only=True, tag="end"):
    """The session is to end, in order."""


Order = SetLink | SetShares
_DECODER = msgspec.json.Decoder(Seen | TakePart | SetLink | SetShares | EndSession)


def read_page_message(text: str | bytes) -> PageMessage:
    """Returns the message of a page.

    Raises:
        WireError: it is none, or a number in it is not finite or out of range.
    """
    try:
        message: PageMessage = _DECODER.decode(text)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise WireError("malformed", str(error)) from None
    if isinstance(message, SetLink | SetShares):
        numbers = [value for value in message.to.values() if not isinstance(value, str)]
        if not all(map(math.isfinite, numbers)):
            raise WireError("not finite", type(message).__name__)
    return message


class OrderDesk:
    """The orders of all pages to the sites; `replies` are the answers that nobody has read yet.

    Attributes:
        refused: messages of pages that were dropped, by reason.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str) -> None:
        self._bus, self._clock, self._session = bus, clock, session
        self._waiting: dict[tuple[str, str], ChangeRequest] = {}
        self._open: dict[str, tuple[Inbox, int]] = {}
        self.replies: list[tuple[str, bool, str]] = []
        self.refused: Counter[str] = Counter()

    def order(self, order: Order) -> None:
        """Takes an order; it replaces the one for the same link or row that waits."""
        if isinstance(order, SetLink):
            site, request = order.link.partition("->")[2], _link_request(order)
        else:
            site = order.site
            shares: dict[str, Any] = dict(order.to)
            request = ChangeRequest(dominance=site, to=shares, ramp_s=LEAST_RAMP_S)
        if not site or "/" in site or "*" in site:
            self.refused["no such site"] += 1
            return
        if len(self._waiting) < 256:
            self._waiting[site, request.link] = request

    def poll(self) -> None:
        """Asks the sites, one question each at a time, and reads their answers."""
        now_ns = self._clock.monotonic_ns()
        for site, (inbox, asked_ns) in list(self._open.items()):
            if (answer := inbox.poll()) is not None:
                del self._open[site]
                try:
                    reply = decode(answer[1], ChangeReply)
                    self.replies.append((site, reply.accepted, reply.text))
                except WireError as error:
                    self.refused[error.reason] += 1
            elif now_ns - asked_ns > REPLY_TIMEOUT_NS:
                del self._open[site]
                self.replies.append((site, False, f"{site} does not answer"))
        for (site, what), request in list(self._waiting.items()):
            if site not in self._open:
                del self._waiting[site, what]
                inbox = self._bus.ask(topics.key(self._session, site, topics.SET), encode(request))
                self._open[site] = inbox, now_ns


def _link_request(order: SetLink) -> ChangeRequest:
    """Returns the request of a link: constant delay, or one that jitters; or a preset."""
    to: dict[str, Any] = dict(order.to)
    if "preset" not in to and "delay_ms" in to:
        jitters = to.get("deviation_ms", 0.0) > 0.0 and to["delay_ms"] > 0.0
        to["model"] = "gamma" if jitters else "constant"
        if not jitters:
            to.pop("deviation_ms", None)
    return ChangeRequest(link=order.link, to=to)

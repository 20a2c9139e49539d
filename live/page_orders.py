"""What a page may ask for, by who looks at it: roles and their links, messages, and how they
reach the sites.

Invariant: a message is one of the types below with finite numbers in range and names of the
session, and comes no oftener than its kind may, or it is counted and dropped. What a site takes
in is for the site to decide. Of a link or a row only the newest order waits, however often it
is changed, and one question to a site is open at a time, besides that to stop. A token gives a
role and, to a user, a site; the rest of a link may lower the role and never raises it. Every
link has a token, on loopback as well: other users of the machine reach that too. Every role
stops the arms.
"""

import hmac
import secrets
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs

import msgspec
from msgspec import Meta

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.arm_client import SiteSender, make_hand_sender
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.clock import Clock
from trilat_net.net.requests import ChangeReply, ChangeRequest, HandMessage
from trilat_net.net.wire import decode, encode

MAX_MESSAGE_BYTES = 4_096
REPLY_TIMEOUT_NS = 3_000_000_000
MOST_WAITING = 256
TOKEN_BYTES = 16
RELEASE = "release"
"""The subject of waiting orders that let an arm follow again or end its fault."""
LEAST_RAMP_S = 0.25
"""The time in which shares change that somebody drags, s."""

Name = Annotated[str, Meta(max_length=64)]
Numbers = Annotated[list[float], Meta(max_length=12)]


class PageMessage(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="do"
):
    """A message of a page; the tag says what it is."""


class Seen(PageMessage, frozen=True, kw_only=True, tag="seen"):
    """The page has drawn frame `n`; the next one may come."""

    n: Annotated[int, Meta(ge=0, lt=2**53)]


class TakePart(PageMessage, frozen=True, kw_only=True, tag="control"):
    """The page wants to take part, or no longer."""

    want: bool


class AnswerPage(PageMessage, frozen=True, kw_only=True, tag="answer"):
    """A page that holds an arm lets another one take part, or not."""

    page: Annotated[int, Meta(ge=0, lt=2**53)]
    yes: bool


class StopArms(PageMessage, frozen=True, kw_only=True, tag="stop"):
    """Every arm is to stop, while the session goes on."""


class ReleaseArms(PageMessage, frozen=True, kw_only=True, tag="release"):
    """Arms that were stopped are to follow again, or the fault of arms is to end.

    Attributes:
        order: "enable" for arms that were stopped, "reset" for arms in fault.
        sites: which arms.
    """

    order: Literal["enable", "reset"]
    sites: Annotated[list[Name], Meta(min_length=1, max_length=16)]


class SetLink(PageMessage, frozen=True, kw_only=True, tag="link"):
    """New values of a link, as `trilat set` takes them."""

    link: Name
    to: Annotated[dict[Name, float | Name], Meta(max_length=8)]


class SetShares(PageMessage, frozen=True, kw_only=True, tag="shares"):
    """A new row of the dominance matrix."""

    site: Name
    to: Annotated[dict[Name, float], Meta(max_length=16)]


class MarkMoment(PageMessage, frozen=True, kw_only=True, tag="mark"):
    """A text that the log keeps as an event of this moment."""

    text: Annotated[str, Meta(min_length=1, max_length=80)]


class ShowAges(PageMessage, frozen=True, kw_only=True, tag="ages"):
    """Users are to see how old what they see of their peers is, or no longer."""

    shown: bool


class MoveHand(PageMessage, frozen=True, kw_only=True, tag="hand"):
    """The page takes hold of an arm, moves what it holds, or lets go.

    Attributes:
        to: the target of the end effector, m, or of the joints, rad; for an arm that is pushed
            the force, N.
    """

    site: Name
    grip: bool
    to: Numbers = []


class EndSession(PageMessage, frozen=True, kw_only=True, tag="end"):
    """The session is to end, in order."""


class DoStep(PageMessage, frozen=True, kw_only=True, tag="step"):
    """A user has done what the stage asks for: has agreed, is ready, or has answered.

    Attributes:
        key: of the step, as the page was shown it.
        answers: of a questionnaire, in the order of its items; None for an item that was left
            out.
    """

    key: Name
    answers: Annotated[list[float | None], Meta(max_length=40)] = []


class AbortTrial(PageMessage, frozen=True, kw_only=True, tag="abort"):
    """The trial that runs is to end, and to be made again later."""

    why: Annotated[str, Meta(max_length=200)] = ""


Order = SetLink | SetShares
StageMessage = DoStep | AbortTrial
_DECODER = msgspec.json.Decoder(reduce(or_, PageMessage.__subclasses__()))
_RATES: dict[type[PageMessage], tuple[float, int]] = {
    PageMessage: (240.0, 480),
    MoveHand: (200.0, 400),
    MarkMoment: (2.0, 10),
    TakePart: (1.0, 5),
    AnswerPage: (1.0, 5),
    StopArms: (5.0, 10),
    ReleaseArms: (5.0, 10),
    DoStep: (2.0, 5),
    AbortTrial: (1.0, 3),
}
"""Messages of a kind, and of all, that a page may send on average, 1/s, and at once."""


class MessageLimits:
    """What a page may still send: of each kind with a rate, and of all, a bucket that fills at
    that rate.
    """

    def __init__(self) -> None:
        self._buckets = {kind: (float(burst), 0) for kind, (_, burst) in _RATES.items()}

    def allows(self, kind: type[PageMessage], now_ns: int) -> bool:
        """True if a message of a kind may come now; one more has come then."""
        if kind not in _RATES:
            return True
        rate, burst = _RATES[kind]
        left, filled_ns = self._buckets[kind]
        left = min(left + (now_ns - filled_ns) * 1e-9 * rate, burst) if filled_ns else left
        self._buckets[kind] = left - (left >= 1.0), now_ns
        return left >= 1.0


def read_page_message(text: str | bytes) -> PageMessage:
    """Returns the message of a page.

    Raises:
        WireError: it is none, or a number in it is out of range.
    """
    try:
        # JSON has no infinity, and 1e999 is refused
        message: PageMessage = _DECODER.decode(text)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise WireError("malformed", str(error)) from None
    return message


@dataclass(frozen=True, slots=True)
class Role:
    """What somebody may do, and which view of the arms is shown.

    Attributes:
        kind: an experimenter may do everything, a user holds the arm of one site, a watcher
            does nothing.
        site: as which site the arms are shown; "": as they are, without delay.
    """

    kind: Literal["experimenter", "user", "watcher"] = "experimenter"
    site: str = ""

    def may(self, message: PageMessage) -> bool:
        """True if a message is one that this role may send."""
        if isinstance(message, Seen | StopArms) or self.kind == "experimenter":
            return True
        own = isinstance(message, MoveHand) and message.site == self.site
        return self.kind == "user" and (own or isinstance(message, StageMessage))

    @property
    def noun(self) -> str:
        """Who this is, in a sentence of an event."""
        return {"experimenter": "the experimenter", "user": f"the user of {self.site}"}.get(
            self.kind, "a watcher"
        )

    @property
    def query(self) -> str:
        """The query of this role's link."""
        words = ["watch"] if self.kind == "watcher" else []
        return "&".join([*words, f"as={self.site}"] if self.site else words)


class RoleLinks:
    """The links of a page that is served, a token for each role."""

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(TOKEN_BYTES)

    def link(self, address: str, role: Role) -> str:
        """Returns the link of a role; its token stands where a browser sends it to no server by
        itself.
        """
        query = f"?{role.query}" if role.query else ""
        return f"{address}{query}#token={self._make_token(role)}"

    def find(self, query: str) -> Role | None:
        """Returns the role of whoever comes by a link with this query; None if no role has its
        token.
        """
        asked = parse_qs(query, keep_blank_values=True)
        token, site = (asked.get(key, [""])[0] for key in ("token", "as"))
        able = Role(), Role("user", site), Role("watcher")
        given = next((role for role in able if self._is_token(token, role)), None)
        if given is None or given.kind == "user":
            return given
        if given.kind == "watcher" or "watch" in asked:
            return Role("watcher", site)
        return Role("user", site) if site else given

    def _make_token(self, role: Role) -> str:
        return hmac.digest(self._secret, f"{role.kind} {role.site}".encode(), "sha256")[
            :TOKEN_BYTES
        ].hex()

    def _is_token(self, token: str, role: Role) -> bool:
        return hmac.compare_digest(token.encode(), self._make_token(role).encode())


class PageHands:
    """The hands of one page, one for each arm that it has ever held.

    A hand lives by the page's own messages: if these stay away, the site lets go.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, source: str) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session
        self._source = source
        self._senders: dict[str, SiteSender] = {}
        self._held: set[str] = set()

    def move(self, order: MoveHand, *, pushes: bool) -> None:
        """Sends an arm's site what the page wants of it."""
        site = order.site
        if site not in self._senders:
            if not order.grip:
                return
            self._senders[site] = make_hand_sender(self._bus, self._clock, self._session, site)
            self._senders[site].number = 0  # a page counts from 1
        (self._held.add if order.grip else self._held.discard)(site)
        goals = {"force" if pushes else "target": order.to if order.grip else []}
        self._senders[site].send(HandMessage, source=self._source, grip=order.grip, **goals)

    def release(self) -> None:
        """Lets go of every arm."""
        for site in list(self._held):
            self.move(MoveHand(site=site, grip=False), pushes=False)

    def holds(self, site: str, source: int) -> bool:
        """True if it is this page that a record of a site names as holding its arm."""
        return source != 0 and site in self._senders and self._senders[site].boot == source


class OrderDesk:
    """The orders of all pages to the sites.

    Attributes:
        replies: the answers that nobody has read yet: site, channel of the order, if it is
            accepted, text.
        refused: counts what is refused, and why.
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, refused: Counter[str] | None = None
    ) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session
        self._waiting: dict[tuple[str, str], ChangeRequest] = {}
        self._open: dict[tuple[str, str], tuple[Inbox, int, ChangeRequest]] = {}
        self.replies: list[tuple[str, str, bool, str]] = []
        self.refused: Counter[str] = Counter() if refused is None else refused

    def order(
        self, order: Order, sites: Collection[str], links: Collection[str], source: str = ""
    ) -> None:
        """Takes an order, if the session has the site or the link; it replaces one that waits
        for that.

        Args:
            order: the new values of a link, or a new row of shares.
            sites: the sites of the session.
            links: its links.
            source: who orders it, for the site's event.
        """
        if isinstance(order, SetLink):
            what = "link"
            site = order.link.partition("->")[2]
            known = order.link in links
            request = _link_request(order)
        else:
            what = "site"
            site = order.site
            known = order.site in sites
            request = ChangeRequest(dominance=site, to={**order.to}, ramp_s=LEAST_RAMP_S)
        if not known:
            self.refused[f"no such {what}"] += 1
        else:
            self._wait(site, request.link, _name_source(request, source))

    def stop(self, sites: Iterable[str], source: str = "") -> None:
        """Orders sites to stop, at once, whatever they have been asked before.

        Args:
            sites: which sites.
            source: who orders it, for the sites' events.
        """
        for site in sites:
            # An order that is not carried out yet would let the arm go again right after the stop.
            self._waiting.pop((site, RELEASE), None)
            self._ask(site, topics.STOP, _name_source(ChangeRequest(order="stop"), source))

    def release(self, order: ReleaseArms, sites: Collection[str], source: str = "") -> None:
        """Orders arms to follow again, or their faults to end.

        Args:
            order: which order, and of which arms.
            sites: the sites of the session.
            source: who orders it, for the sites' events.
        """
        for site in order.sites:
            if site not in sites:
                self.refused["no such site"] += 1
            else:
                self._wait(
                    site, RELEASE, _name_source(ChangeRequest(order=order.order), source)
                )

    def _wait(self, site: str, subject: str, request: ChangeRequest) -> None:
        """Keeps a request until the site is asked; a newer one of the same subject replaces it."""
        if (site, subject) in self._waiting or len(self._waiting) < MOST_WAITING:
            self._waiting[site, subject] = request

    def _ask(self, site: str, channel: str, request: ChangeRequest) -> None:
        inbox = self._bus.query(topics.key(self._session, site, channel), encode(request))
        self._open[site, channel] = inbox, self._clock.monotonic_ns(), request

    def mark(self, site: str, text: str) -> None:
        """Asks a site to mark this moment in the log."""
        self._wait(site, f"mark {text}", ChangeRequest(mark=text))

    def poll(self) -> None:
        """Asks the sites, one question each at a time, and reads their answers."""
        now_ns = self._clock.monotonic_ns()
        for (site, channel), (inbox, asked_ns, request) in list(self._open.items()):
            if (answer := inbox.poll()) is not None:
                del self._open[site, channel]
                try:
                    self._take_reply(site, channel, request, decode(answer[1], ChangeReply))
                except WireError as error:
                    self.refused[error.reason] += 1
            elif now_ns - asked_ns > REPLY_TIMEOUT_NS:
                del self._open[site, channel]
                self.replies.append((site, channel, False, f"{site} does not answer"))
        for (site, what), request in list(self._waiting.items()):
            if (site, topics.SET) not in self._open:
                del self._waiting[site, what]
                self._ask(site, topics.SET, request)

    def _take_reply(
        self, site: str, channel: str, request: ChangeRequest, reply: ChangeReply
    ) -> None:
        """Keeps an answer for the pages; a stop that was refused is ordered again without its
        source.

        A site of an older program knows no source and refuses the whole request; its arm has to
        stop too.
        """
        if (
            channel == topics.STOP
            and not reply.accepted
            and request.source is not msgspec.UNSET
        ):
            self._ask(site, channel, msgspec.structs.replace(request, source=msgspec.UNSET))
        else:
            self.replies.append((site, channel, reply.accepted, reply.text))


def _name_source(request: ChangeRequest, source: str) -> ChangeRequest:
    """Returns a request that names who makes it, if that is known."""
    return msgspec.structs.replace(request, source=source) if source else request


def _link_request(order: SetLink) -> ChangeRequest:
    """Returns the request of a link: constant delay, or one that jitters; or a preset."""
    to: dict[str, Any] = dict(order.to)
    if "preset" not in to and "delay_ms" in to:
        jitters = all(
            str(to.get(key, 0.0)) not in ("0.0", "-0.0") for key in ("deviation_ms", "delay_ms")
        )
        to["model"] = "gamma" if jitters else "constant"
        if not jitters:
            to.pop("deviation_ms", None)
    return ChangeRequest(link=order.link, to=to)

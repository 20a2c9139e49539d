"""Defines the requests that a web page may send, and forwards them to the sites.

The role of a person at a page is experimenter, user of one arm, or watcher. The page server
parses each message with `PageMessage.read` and checks with `Role.may` whether the role permits
it. `PageHands` moves the arms that the person holds. `OrderDesk` sends other requests to the
sites and receives their replies.

Invariant:
    - A valid message has one of the types below, finite numbers in range, and names that exist
      in the session. Any other message, and any message that exceeds the rate of its type, is
      counted and dropped.
    - If several waiting requests change the same network link, only the newest is sent. The
      same applies to the dominance factors of a site.
    - Only one request at a time waits for the reply of a site. A request to stop the arm does
      not wait but is sent immediately, and every role may send it.
    - The address of a page contains a secret token, which grants a role and, for a user, a
      site. The rest of the address may lower the role but never raise it.
"""

import hmac
import secrets
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs

import msgspec
from msgspec import Meta

from trilat_net.errors import SessionError, WireError
from trilat_net.net import (
    Bus,
    ChangeReply,
    ChangeRequest,
    Clock,
    HandSender,
    SessionMembers,
    topics,
)

MAX_MESSAGE_BYTES = 4_096
"""Maximum size of a message from a page."""
MAX_PENDING = 256
"""Maximum number of orders waiting to be sent."""
TOKEN_BYTES = 16
"""Size of the token in a link."""
RELEASE = "release"
"""Subject of waiting orders that release a stopped arm or clear its fault."""
MIN_RAMP_S = 0.25
"""Duration of a dominance change that a user makes by dragging with the mouse, in s."""

Name = Annotated[str, Meta(max_length=64)]
Numbers = Annotated[list[float], Meta(max_length=12)]
Count = Annotated[int, Meta(ge=0, lt=2**53)]
"""Number of a frame or page; JavaScript represents integers exactly up to 2^53."""


class PageMessage(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="do"
):
    """Base class of the messages that a page sends to its server.

    The JSON field `do` contains the kind of message, for example {"do": "mark", "text":
    "contact"}. Unknown fields are rejected.
    """

    @staticmethod
    def read(text: str | bytes) -> "PageMessage":
        """Decodes and validates a message from a page.

        The message may come from anybody, so it must be validated before it moves an arm.

        Args:
            text: The message as JSON.

        Returns:
            The message, of the class given by its field `do`.

        Raises:
            WireError: The text is not a valid message, or a number is out of range.
        """
        try:
            # All numbers are finite: JSON has no infinity, and the decoder refuses 1e999.
            message: PageMessage = _DECODER.decode(text)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise WireError("malformed", str(error)) from None
        return message


class Seen(PageMessage, frozen=True, kw_only=True, tag="seen"):
    """Acknowledgement by a page that it has drawn a frame and is ready for the next one.

    A frame is a message in which the server describes the current state of the session.

    Attributes:
        n: Number of the frame that was drawn.
    """

    n: Count


class TakePart(PageMessage, frozen=True, kw_only=True, tag="control"):
    """Request from a page to obtain or give up the right to move arms and change settings.

    Attributes:
        want: True to request the right, False to give it up.
    """

    want: bool


class AnswerPage(PageMessage, frozen=True, kw_only=True, tag="answer"):
    """Reply from a page to another page that has asked for control of the session.

    A page with control may move arms and change settings. The pages that currently hold an arm
    must agree before another page is given control.

    Attributes:
        page: Number of the page that asked.
        yes: True to agree, False to refuse.
    """

    page: Count
    yes: bool


class StopArms(PageMessage, frozen=True, kw_only=True, tag="stop"):
    """Request from a page to stop all arms immediately. Anybody may send it, even a watcher.

    The session continues, and the arms remain stopped until somebody releases them.
    """


class _ReleaseArms(PageMessage, frozen=True, kw_only=True, tag="release"):
    """Request from a page to release stopped arms, or to reset arms after a fault.

    Attributes:
        order: "enable" to let stopped arms follow the other arms again, "reset" to clear
            faults.
        sites: Names of the sites of these arms.
    """

    order: Literal["enable", "reset"]
    sites: Annotated[list[Name], Meta(min_length=1, max_length=16)]


class _SetLink(PageMessage, frozen=True, kw_only=True, tag="link"):
    """Request from a page to change the delay or other settings of a network link.

    The command `trilat set` changes the same settings.

    Attributes:
        link: Name of the link, such as "m1->s" from site m1 to site s.
        to: Mapping from the name of each setting to its new value.
    """

    link: Name
    to: Annotated[dict[Name, float | Name], Meta(max_length=8)]


class _SetShares(PageMessage, frozen=True, kw_only=True, tag="shares"):
    """Request from a page to change the dominance factors of a site.

    Attributes:
        site: Name of the site.
        to: Mapping from peer name to new dominance factor.
    """

    site: Name
    to: Annotated[dict[Name, float], Meta(max_length=16)]


class _MarkMoment(PageMessage, frozen=True, kw_only=True, tag="mark"):
    """Request from a page to mark the current moment in the log with an event.

    Attributes:
        text: Label of the mark, for example "contact".
    """

    text: Annotated[str, Meta(min_length=1, max_length=80)]


class ShowAges(PageMessage, frozen=True, kw_only=True, tag="ages"):
    """Request from a page to show or hide the ages of displayed poses on the pages of users.

    The age is the delay with which a user sees another arm over the network.

    Attributes:
        shown: True to show the ages, False to hide them.
    """

    shown: bool


class MoveHand(PageMessage, frozen=True, kw_only=True, tag="hand"):
    """Request from a page to take hold of an arm, to move it, or to release it.

    Attributes:
        site: Name of the site of the arm.
        grip: True to hold the arm, False to release it.
        to: Target to which the arm is pulled: the position of the end effector in m, or the
            joint positions in rad. For an arm that is pushed, the force in N.
    """

    site: Name
    grip: bool
    to: Numbers = []


class EndSession(PageMessage, frozen=True, kw_only=True, tag="end"):
    """Request from a page to end the session in an orderly way, so that its log is complete.

    Accepted only by sessions that were started together with their page.
    """


class DoStep(PageMessage, frozen=True, kw_only=True, tag="step"):
    """Notification from a page that its user has completed a step of an experiment.

    The user has given consent, is ready, or has answered a questionnaire.

    Attributes:
        key: Key of the step, as the server sent it to the page.
        answers: Answers to a questionnaire, in the order of its items; `None` for a missing
            answer.
    """

    key: Name
    answers: Annotated[list[float | None], Meta(max_length=40)] = []


class AbortTrial(PageMessage, frozen=True, kw_only=True, tag="abort"):
    """Request from a page to abort the running trial of an experiment and repeat it later.

    Attributes:
        why: The reason, for the journal of the experiment.
    """

    why: Annotated[str, Meta(max_length=200)] = ""


SiteOrder = _SetLink | _SetShares | _ReleaseArms | _MarkMoment
"""Request from a page that `OrderDesk.accept` forwards to sites."""
StageMessage = DoStep | AbortTrial
_ANY_MESSAGE = reduce(or_, PageMessage.__subclasses__())
_DECODER = msgspec.json.Decoder(_ANY_MESSAGE)
_RATES: dict[type[PageMessage], tuple[float, int]] = {
    PageMessage: (240.0, 480),
    MoveHand: (200.0, 400),
    _MarkMoment: (2.0, 10),
    TakePart: (1.0, 5),
    AnswerPage: (1.0, 5),
    StopArms: (5.0, 10),
    _ReleaseArms: (5.0, 10),
    DoStep: (2.0, 5),
    AbortTrial: (1.0, 3),
}
"""Maximum mean rate, in 1/s, and maximum burst of a page's messages, by kind.

The entry of `PageMessage` applies to all kinds together.
"""


@dataclass(slots=True)
class _TokenBucket:
    """State of a token bucket, which limits a message rate.

    Tokens are replenished at the permitted rate, up to the maximum burst, and each message
    takes one token. A message exceeds the limit if there is no token left.

    Attributes:
        tokens: Number of tokens in the bucket.
        filled_ns: Time of the last message, in ns; 0 before the first one.
    """

    tokens: float
    filled_ns: int = 0


class MessageLimits:
    """Limits how many messages a page may send, per kind of message and in total.

    A page that sends more messages than a person can cause is faulty or hostile. Excess
    messages are dropped.
    """

    def __init__(self) -> None:
        self._buckets: dict[type[PageMessage], _TokenBucket] = {}
        for kind, (_, burst) in _RATES.items():
            self._buckets[kind] = _TokenBucket(float(burst))

    def allows(self, kind: type[PageMessage], now_ns: int) -> bool:
        """Counts a message, and returns True if it is within the permitted rate.

        The rate is limited with a token bucket: each message takes a token, and tokens are
        replenished at the permitted rate, up to the largest burst.

        Args:
            kind: Kind of the message.
            now_ns: Current time on the monotonic clock, in ns.

        Returns:
            False if the page has sent too many messages and this one must be dropped.
        """
        if kind not in _RATES:
            return True

        rate_per_s, largest_burst = _RATES[kind]
        bucket = self._buckets[kind]
        # The bucket is full before the first message.
        if bucket.filled_ns:
            elapsed_ns = now_ns - bucket.filled_ns
            new_tokens = elapsed_ns * 1e-9 * rate_per_s
            bucket.tokens = min(bucket.tokens + new_tokens, largest_burst)
        bucket.filled_ns = now_ns

        is_allowed = bucket.tokens >= 1.0
        if is_allowed:
            bucket.tokens -= 1.0
        return is_allowed


@dataclass(frozen=True, slots=True)
class Role:
    """Rights of the user of a web page, and the site whose view the page shows.

    Attributes:
        kind: Kind of role. An experimenter may do everything, a user may hold the arm of one
            site, and a watcher may only stop the arms.
        site: Name of the site whose user's view is shown, with delayed poses of the other arms.
            Empty to show all arms with no delay.
    """

    kind: Literal["experimenter", "user", "watcher"] = "experimenter"
    site: str = ""

    def may(self, message: PageMessage) -> bool:
        """Returns True if a person with this role may send a message.

        An experimenter may send every message. A user may move the arm of the user's site, and
        send replies in an experiment. Everybody may stop the arms.

        Args:
            message: The message from the person's web page.
        """
        if self.kind == "experimenter":
            return True
        if isinstance(message, Seen | StopArms):
            return True
        if self.kind != "user":
            return False
        if isinstance(message, MoveHand):
            return message.site == self.site
        return isinstance(message, StageMessage)

    @property
    def noun(self) -> str:
        """How session events refer to the user of a web page, for example "the user of m1"."""
        if self.kind == "experimenter":
            return "the experimenter"
        if self.kind == "user":
            return f"the user of {self.site}"
        return "a watcher"

    @property
    def query(self) -> str:
        """Part of a web page's address that gives the role of its user.

        "as=m1" for the user of the arm m1, "watch" for a watcher, and empty for an
        experimenter.
        """
        fields: list[str] = []
        if self.kind == "watcher":
            fields.append("watch")
        if self.site:
            fields.append(f"as={self.site}")
        return "&".join(fields)


class RoleLinks:
    """Creates the links that open a page and determines the role granted by a link.

    A link contains a secret token, so only those who received the link can open the page. The
    token is required even on this machine, since other users of the machine can connect. The
    token of a role is derived from a random secret and need not be stored.
    """

    def __init__(self) -> None:
        self._secret = secrets.token_bytes(TOKEN_BYTES)

    def link(self, address: str, role: Role) -> str:
        """Creates the link that opens the page for a role.

        The secret token is in the fragment of the link, the part after #, which a browser does
        not send to other servers.

        Args:
            address: Address of the page.
            role: The role that the link grants.
        """
        query = f"?{role.query}" if role.query else ""
        token = self._make_token(role)
        return f"{address}{query}#token={token}"

    def find(self, query: str) -> Role | None:
        """Returns the role granted by the link with which a page was opened.

        An experimenter may choose a lower role, for example to see the view of an arm's user.

        Args:
            query: Query string of the page's request, including the token.

        Returns:
            The role, or `None` if the token does not belong to any role.
        """
        fields = parse_qs(query, keep_blank_values=True)
        token = fields.get("token", [""])[0]
        site = fields.get("as", [""])[0]

        experimenter = Role()
        user = Role("user", site)
        if self._is_token(token, experimenter):
            # An experimenter may use a lower role.
            if "watch" in fields:
                return Role("watcher", site)
            return user if site else experimenter
        if self._is_token(token, user):
            return user
        if self._is_token(token, Role("watcher")):
            return Role("watcher", site)
        return None

    def _make_token(self, role: Role) -> str:
        """Returns the secret token that grants the rights of a role.

        The token is a keyed digest of the role, and cannot be guessed without the server's
        secret.
        """
        text = f"{role.kind} {role.site}".encode()
        digest = hmac.digest(self._secret, text, "sha256")
        return digest[:TOKEN_BYTES].hex()

    def _is_token(self, token: str, role: Role) -> bool:
        """Returns True if a token from a link grants the rights of a role.

        The comparison takes the same time for any token, which prevents timing attacks.
        """
        role_token = self._make_token(role)
        # The time of this comparison does not reveal how many characters are right.
        return hmac.compare_digest(
            token.encode(),
            role_token.encode(),
        )


class PageHands:
    """Moves the arms held by the person at one page.

    Messages from the page act as a heartbeat: if they stop, for example because the page was
    closed, the site releases the arm.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        source: Name by which the page identifies itself to the sites.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, source: str) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session
        self._source = source
        self._senders: dict[str, HandSender] = {}
        self._held_sites: set[str] = set()

    def move(self, order: MoveHand, *, pushes: bool) -> None:
        """Moves or releases the arm of a site as requested by the person at the page.

        The arm is held if `grip` is set, and released otherwise.

        Args:
            order: Message from the page, with the name of the site and the target or force.
            pushes: True if the message contains a force on the arm, in N; False if it contains
                a target to which the arm is pulled, in m or rad.
        """
        site = order.site
        if site not in self._senders:
            if not order.grip:
                return  # the page has never held this arm
            new_sender = HandSender(self._bus, self._clock, self._session, site)
            new_sender.number = 0  # the messages of a page are numbered from 1
            self._senders[site] = new_sender

        sender = self._senders[site]
        if order.grip:
            self._held_sites.add(site)
        else:
            self._held_sites.discard(site)

        numbers = order.to if order.grip else []
        field = "force" if pushes else "target"
        sender.move(self._source, grip=order.grip, **{field: numbers})

    def release(self) -> None:
        """Releases all arms held by the user of the page.

        Called, for example, when the page is closed.
        """
        for site in list(self._held_sites):
            message = MoveHand(site=site, grip=False)
            self.move(message, pushes=False)

    def holds(self, site: str, source: int) -> bool:
        """Returns True if the user of this page holds the arm of a site.

        Args:
            site: Name of the site.
            source: Number of the holder, from the newest record of the site. 0 if nobody holds
                the arm.
        """
        sender = self._senders.get(site)
        if source == 0 or sender is None:
            return False
        return sender.boot == source


class OrderDesk:
    """Sends the requests of all pages to the sites, one at a time, and collects their replies.

    For example, a request may change the delay of a link.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        refused: Mapping from reason to number of refused orders, which is updated. If `None`, a
            new mapping is created.

    Attributes:
        replies: Replies that have not been read yet. Each contains the name of the site, the
            channel of the order, whether the site accepted it, and a message.
        refused: Mapping from reason to number of refused orders.
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, refused: Counter[str] | None = None
    ) -> None:
        self._members = SessionMembers(bus, clock, session)
        # Requests that wait to be sent, by site and subject.
        self._pending: dict[tuple[str, str], ChangeRequest] = {}
        # Functions that return the replies to open requests, by site and channel.
        self._open_requests: dict[tuple[str, str], Callable[[], ChangeReply | None]] = {}
        self.replies: list[tuple[str, str, bool, str]] = []
        if refused is None:
            refused = Counter()
        self.refused = refused

    def accept(
        self,
        order: SiteOrder,
        sites: Collection[str],
        links: Collection[str],
        first_site: str,
        source: str = "",
    ) -> None:
        """Queues a page's request to change settings, release arms, or mark a moment.

        Args:
            order: The request.
            sites: Names of the sites of the session, empty until all of them run.
            links: Names of the links of the session.
            first_site: Site that publishes the mark. Empty while the scenario is not yet known.
            source: Sender of the request, as recorded in log events.
        """
        if isinstance(order, _SetLink | _SetShares):
            self._queue_change(order, sites, links, source)
        elif isinstance(order, _ReleaseArms):
            self._release(order, sites, source)
        elif first_site:
            self.mark(first_site, order.text)

    def _queue_change(
        self,
        order: _SetLink | _SetShares,
        sites: Collection[str],
        links: Collection[str],
        source: str,
    ) -> None:
        """Queues a request to change the settings of a link or the dominance factors of a site.

        A slider on a page sends many values, so a request replaces any waiting request for the
        same link or site. A request for an unknown link or site is refused and counted.

        Args:
            order: New settings of a link, or new dominance factors of a site.
            sites: Names of the sites of the session.
            links: Names of the links of the session.
            source: Sender of the request, as recorded in the site's event.
        """
        if isinstance(order, _SetLink):
            if order.link not in links:
                self.refused["no such link"] += 1
                return
            # The receiver of a link delays the link's samples.
            _, _, site = order.link.partition("->")
            request = _make_link_request(order)
        else:
            if order.site not in sites:
                self.refused["no such site"] += 1
                return
            site = order.site
            request = ChangeRequest(
                dominance=site,
                to={**order.to},
                ramp_s=MIN_RAMP_S,
            )
        self._enqueue(site, request.link, _add_source(request, source))

    def stop(self, sites: Iterable[str], source: str = "") -> None:
        """Asks sites to stop their arms immediately, ahead of all waiting requests.

        Waiting requests that would release the same arms are withdrawn.

        Args:
            sites: Names of the sites.
            source: Sender of the request, as recorded in the sites' events.
        """
        stop = ChangeRequest(order="stop")
        request = _add_source(stop, source)
        for site in sites:
            # A pending release would let the arm move again right after the stop.
            self._pending.pop((site, RELEASE), None)
            self._send_request(site, request)

    def _release(self, order: _ReleaseArms, sites: Collection[str], source: str) -> None:
        """Queues requests to release stopped arms, or to reset arms after a fault.

        A request that names a site outside the session is refused and counted.

        Args:
            order: The request, with the names of the sites of these arms.
            sites: Names of all sites of the session.
            source: Person or program that sent the request, as recorded in log events.
        """
        release = ChangeRequest(order=order.order)
        request = _add_source(release, source)
        for site in order.sites:
            if site in sites:
                self._enqueue(site, RELEASE, request)
            else:
                self.refused["no such site"] += 1

    def _enqueue(self, site: str, subject: str, request: ChangeRequest) -> None:
        """Queues a request, replacing any waiting request on the same subject.

        A slider on a page sends many values, of which only the latest matters. A request on a
        new subject is dropped if too many requests are waiting.

        Args:
            site: Name of the site.
            subject: Subject of the request, for example the name of a link.
            request: The request.
        """
        is_replacement = (site, subject) in self._pending
        if is_replacement or len(self._pending) < MAX_PENDING:
            self._pending[site, subject] = request

    def _send_request(self, site: str, request: ChangeRequest) -> None:
        """Sends a request to a site. The reply is received by `poll`.

        For example, a request may change the delay of a link or stop an arm. Stops have a
        channel of their own. On each channel, only one request at a time waits for its reply.

        Args:
            site: Name of the site.
            request: The request.
        """
        channel = topics.STOP if request.order == "stop" else topics.SET
        self._open_requests[site, channel] = self._members.request_change(site, request)

    def mark(self, site: str, text: str) -> None:
        """Asks a site to publish an event that marks this moment in the log.

        Args:
            site: Name of the site that publishes the event.
            text: Label of the mark, for example "trial 3 begins".
        """
        subject = f"mark {text}"
        request = ChangeRequest(mark=text)
        self._enqueue(site, subject, request)

    def poll(self) -> None:
        """Receives the sites' replies to earlier requests, and sends waiting requests.

        A site receives one request at a time, and the next one only after its reply. If a site
        does not reply in time, an entry saying so is added to `replies`.
        """
        # A copy of the items, because answered requests are removed.
        for (site, channel), poll_reply in list(self._open_requests.items()):
            try:
                reply = poll_reply()
            except SessionError:
                del self._open_requests[site, channel]
                self.replies.append((site, channel, False, f"{site} does not answer"))
            except WireError as error:
                del self._open_requests[site, channel]
                self.refused[error.reason] += 1
            else:
                if reply is not None:
                    del self._open_requests[site, channel]
                    self.replies.append((site, channel, reply.accepted, reply.text))

        pending = list(self._pending.items())
        for (site, subject), request in pending:
            waits_for_reply = (site, topics.SET) in self._open_requests
            if not waits_for_reply:
                del self._pending[site, subject]
                self._send_request(site, request)


def _add_source(request: ChangeRequest, source: str) -> ChangeRequest:
    """Adds the name of the sender to a request, unless the name is empty."""
    if not source:
        return request
    return msgspec.structs.replace(request, source=source)


def _make_link_request(order: _SetLink) -> ChangeRequest:
    """Returns the request that changes the settings of a link as ordered by a page.

    The page sets a delay and its standard deviation. Unless the page names a preset, a nonzero
    deviation gives a gamma distribution, and a zero or missing deviation gives a constant
    delay.
    """
    settings: dict[str, Any] = dict(order.to)
    sets_delay = "preset" not in settings and "delay_ms" in settings
    if sets_delay:
        delay_ms = settings["delay_ms"]
        deviation_ms = settings.get("deviation_ms", 0.0)
        is_random = not _is_zero(delay_ms) and not _is_zero(deviation_ms)
        if is_random:
            settings["model"] = "gamma"
        else:
            settings["model"] = "constant"
            settings.pop("deviation_ms", None)
    return ChangeRequest(link=order.link, to=settings)


def _is_zero(value: float | str) -> bool:
    """Returns True if a setting is the number 0. Strings are left for the site to reject."""
    return str(value) in ("0.0", "-0.0")

"""Queries the members of a session, receives their messages, and sends requests to its sites.

Members use this module to find each other. Programs outside the session, such as the commands
that stop arms or change network delays, use it to reach the members.

Invariant:
    - A change is requested only once, because a second request might apply it twice. The caller
      receives either a reply or an error that names the arm that did not reply.
    - A log is never played back under the name of a running session, because programs could not
      tell the messages of the log from those of the session.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import TypeVar

import msgspec
from msgspec import UNSET

from ..errors import SessionError, WireError
from ..records import Layout
from . import topics
from .bus import RING_CAPACITY, Bus, Inbox
from .clock import Clock
from .messages import Event, Info, LinkStats, State
from .pinging import RepeatedQuery
from .requests import BACKFILL_MESSAGES, Backfill, BackfillRequest, ChangeReply, ChangeRequest
from .wire import decode, encode, read_messages

_POLL_NS = 5_000_000
"""Time between two polls for replies, in ns."""
REPLY_TIMEOUT_S = 3.0
"""Longest wait for a reply, in s."""
_NAME_CHECK_S = 0.7
"""Time for which a playback searches for sites of a session with the same name, in s.

Sites try to connect every half second.
"""
_CHANNELS: dict[type, str] = {
    State: topics.STATE,
    LinkStats: topics.LINK,
    Event: topics.EVENT,
}
"""Channel on which members publish the messages of each type."""

P = TypeVar("P", State, LinkStats, Event)


class SessionMembers:
    """Receives messages from the members of a session, and sends them queries and requests.

    Args:
        bus: Network connection through which the session can be reached.
        clock: Clock of the caller.
        session: Name of the session.
        member: Name of the member that is addressed. "*" stands for all members.

    Attributes:
        unreadable: Reasons why replies could not be decoded, keyed by the name of the member
            that sent the reply.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, member: str = "*") -> None:
        self.unreadable: dict[str, str] = {}
        self._bus = bus
        self._clock = clock
        self._session = session
        self._member = member
        self._query = self._make_query()

    def _make_query(self) -> RepeatedQuery:
        """Returns a new query for the identities of the members."""
        key = topics.key(self._session, self._member, topics.INFO)
        return RepeatedQuery(self._bus, self._clock, key)

    def subscribe(
        self,
        kind: type[P],
        member: str = "",
        *,
        capacity: int = RING_CAPACITY,
        layout: Layout | None = None,
    ) -> Callable[[], Iterator[P]]:
        """Subscribes to the messages of one type, and returns a function that reads them.

        Args:
            kind: Type of the messages: records, statistics or events.
            member: Name of the member that publishes the messages. If empty, the messages of
                the members that this object addresses are received.
            capacity: Number of messages that can wait to be read. If more arrive, the oldest
                ones are dropped.
            layout: Expected numbers of joints and peers, see `read_messages`.

        Returns:
            A function that removes and yields the messages that have arrived since the last
            call. Messages that cannot be decoded are skipped.
        """
        key = topics.key(self._session, member or self._member, _CHANNELS[kind])
        return partial(read_messages, self._bus.inbox(key, capacity), kind, layout)

    def poll(self) -> Iterator[Info]:
        """Yields the identities that have arrived, and repeats the query if it is due.

        A query may be lost, and members may start at any time, so the query is repeated for as
        long as this method is called.

        A reply is skipped if it cannot be decoded, or if the name in the identity differs from
        the name in the key under which the reply arrived.
        """
        while (reply := self._query.poll()) is not None:
            _, key, payload = reply
            parts = topics.parse_key(key)
            if parts is None:
                continue
            try:
                info = decode(payload, Info)
            except WireError as error:  # another version of this program, or another program
                self.unreadable[parts.member] = str(error)
                continue
            if parts.member == info.member:
                yield info
        self._query.repeat()

    def find(
        self,
        *,
        stopped: Callable[[], bool],
        timeout_s: float | None,
    ) -> Iterator[Info]:
        """Queries the members of a session, and yields their identities as they arrive.

        The query is repeated until the search ends, because a reply may be lost. The same
        identity is therefore yielded repeatedly. Replies to earlier queries are ignored.

        Args:
            stopped: Function that returns True to end the search.
            timeout_s: Duration of the search, in s. If None, there is no limit.

        Yields:
            The identity of a member, as soon as its reply arrives.

        Raises:
            SessionError: The time has run out, and members replied, but none of their replies
                could be decoded.
        """
        self._query = self._make_query()
        self.unreadable.clear()
        has_readable_reply = False
        begun_ns = self._clock.monotonic_ns()
        timeout_ns = math.inf if timeout_s is None else timeout_s * 1e9
        while not stopped() and self._clock.monotonic_ns() - begun_ns < timeout_ns:
            for info in self.poll():
                has_readable_reply = True
                yield info
            self._clock.sleep_until(self._clock.monotonic_ns() + _POLL_NS)
        if self.unreadable and not has_readable_reply and not stopped():
            member, reason = next(iter(self.unreadable.items()))
            raise SessionError(f"the reply of {member} cannot be read: {reason}")

    def send_change(self, site: str, request: ChangeRequest) -> ChangeReply:
        """Sends a request to a site of a running session, and waits for the reply.

        If the members of the session have keys, only the operator's keys allow changes. The
        command to stop is accepted from every member.

        Args:
            site: Name of the site.
            request: The requested change, or a command such as "stop".

        Returns:
            The reply of the site, which either accepts or rejects the request.

        Raises:
            SessionError: The site does not reply.
        """
        poll = self.request_change(site, request)
        try:
            while (reply := poll()) is None:
                self._clock.sleep_until(self._clock.monotonic_ns() + _POLL_NS)
        except WireError as error:
            raise SessionError(f"the reply of {site} cannot be read: {error}") from None
        return reply

    def request_change(
        self, site: str, request: ChangeRequest
    ) -> Callable[[], ChangeReply | None]:
        """Sends a request to a site like `send_change`, but does not wait for the reply.

        Args:
            site: Name of the site.
            request: The requested change, or a command such as "stop".

        Returns:
            A function that returns the reply of the site, or None if no reply has arrived yet.
            It raises SessionError if the site has not replied within `REPLY_TIMEOUT_S`, and
            WireError if the reply cannot be decoded.
        """
        return _RequestedChange(self._bus, self._clock, self._session, site, request).poll

    def list_past_events(
        self,
        site: str,
    ) -> Iterator[Event]:
        """Queries a site for the events that it has published, and yields them in order.

        The first event is the oldest one that the site still stores. The iteration ends early
        if the site does not reply.

        Args:
            site: Name of the site.
        """
        key = topics.key(self._session, site, topics.PAST)
        first = 0
        published = 1
        with suppress(WireError):  # a reply of another program ends the iteration
            while first < published:
                request = BackfillRequest(
                    channel="event", first=first, last=first + BACKFILL_MESSAGES - 1
                )
                reply = self._wait_for_reply(self._bus.query(key, encode(request)))
                backfill = None if reply is None else decode(reply, Backfill)
                if backfill is None or not backfill.payloads:
                    return

                for payload in backfill.payloads:
                    yield decode(payload, Event)
                first = backfill.first + len(backfill.payloads)
                published = backfill.made

    def require_absent(self, stopped: Callable[[], bool]) -> None:
        """Raises SessionError if a session already exists under the name chosen for a playback.

        Args:
            stopped: Function that returns True to end the check early.

        Raises:
            SessionError: A site of the session replies.
        """
        for info in self.find(stopped=stopped, timeout_s=_NAME_CHECK_S):
            if info.member == topics.RECORDER:
                continue
            state = "is waiting to begin"
            if info.running:
                state = f"is running ({info.member} is at tick {info.ticks})"
            raise SessionError(
                f"session {self._session!r} already exists and {state}; replay the log under "
                "another name with --prefix or --session"
            )

    def _wait_for_reply(self, replies: Inbox) -> bytes | None:
        """Waits for the first reply to a query, and returns its payload.

        Returns None if no reply arrives within `REPLY_TIMEOUT_S`.
        """
        deadline_ns = self._clock.monotonic_ns() + int(REPLY_TIMEOUT_S * 1e9)
        while self._clock.monotonic_ns() < deadline_ns:
            self._clock.sleep_until(self._clock.monotonic_ns() + _POLL_NS)
            reply = replies.poll()
            if reply is not None:
                _key, payload = reply
                return payload
        return None


class _RequestedChange:
    """A request that has been sent to a site, and whose reply is awaited.

    A site with an older version of this program does not know the field `source`, and refuses
    the whole request. Its arm must stop as well, so a refused command to stop is repeated
    without this field.

    Args:
        bus: Network connection through which the site can be reached.
        clock: Clock of the caller.
        session: Name of the session.
        site: Name of the site.
        request: The requested change, or a command such as "stop".
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, site: str, request: ChangeRequest
    ) -> None:
        self._bus = bus
        self._clock = clock
        self._site = site
        self._request = request
        self._stops = request.order == "stop"
        channel = topics.STOP if self._stops else topics.SET
        self._key = topics.key(session, site, channel)
        self._replies = self._send()

    def _send(self) -> Inbox:
        """Sends the request, and returns the queue that receives the reply."""
        self._sent_ns = self._clock.monotonic_ns()
        return self._bus.query(self._key, encode(self._request))

    def poll(self) -> ChangeReply | None:
        """Returns the reply of the site, or None if no reply has arrived yet.

        Raises:
            SessionError: The site has not replied within `REPLY_TIMEOUT_S`.
            WireError: The reply cannot be decoded.
        """
        entry = self._replies.poll()
        if entry is None:
            if self._clock.monotonic_ns() - self._sent_ns > REPLY_TIMEOUT_S * 1e9:
                hint = "; in a session with keys, only the operator may request changes"
                raise SessionError(
                    f"{self._site} did not answer; the records of {self._site} show whether "
                    f"the change was made{'' if self._stops else hint}"
                )
            return None

        _key, payload = entry
        reply = decode(payload, ChangeReply)
        if self._stops and not reply.accepted and self._request.source is not UNSET:
            self._request = msgspec.structs.replace(self._request, source=UNSET)
            self._replies = self._send()
            return None
        return reply

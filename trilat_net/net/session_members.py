"""Queries the members of a session, and sends requests to its sites.

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

import msgspec
from msgspec import UNSET

from ..errors import SessionError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .messages import Event, Info
from .pinging import RepeatedQuery
from .requests import (
    BACKFILL_MESSAGES,
    Backfill,
    BackfillRequest,
    ChangeReply,
    ChangeRequest,
    DirectMessage,
)
from .wire import decode, encode

POLL_NS = 5_000_000
"""Time between two polls for replies, in ns."""
REPLY_TIMEOUT_S = 3.0
"""Longest wait for a reply, in s."""
_NAME_CHECK_S = 0.7
"""Time for which a playback searches for sites of a session with the same name, in s.

Sites try to connect every half second.
"""


class ChangeQuery:
    """A request for a change that was sent to a site, and whose reply is awaited.

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
        channel = topics.STOP if request.order == "stop" else topics.SET
        self._key = topics.key(session, site, channel)
        self._send(request)

    def _send(self, request: ChangeRequest) -> None:
        """Sends the request, and starts to wait for its reply."""
        self._request = request
        self._replies = self._bus.query(self._key, encode(request))
        self._sent_ns = self._clock.monotonic_ns()

    @property
    def is_overdue(self) -> bool:
        """True if the site has not replied within `REPLY_TIMEOUT_S`."""
        return self._clock.monotonic_ns() - self._sent_ns >= REPLY_TIMEOUT_S * 1e9

    def poll(self) -> ChangeReply | None:
        """Returns the reply of the site, which accepts or rejects the request.

        Returns:
            The reply. None while it has not arrived.

        Raises:
            WireError: The reply cannot be decoded.
        """
        arrived = self._replies.poll()
        if arrived is None:
            return None
        _, payload = arrived
        reply = decode(payload, ChangeReply)
        request = self._request
        if request.order == "stop" and not reply.accepted and request.source is not UNSET:
            # A site with an older version of this program does not know the field `source`, and
            # refuses the whole request. Its arm must stop as well.
            self._send(msgspec.structs.replace(request, source=UNSET))
            return None
        return reply


class SessionMembers:
    """Queries the members of a running session over an open connection.

    Args:
        bus: Network connection through which the session can be reached.
        clock: Clock of the caller.
        session: Name of the session.
        member: Name of the member whose identity is queried. "*" queries all members.

    Attributes:
        unreadable: Reasons why replies could not be decoded, keyed by the name of the member
            that sent the reply.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, member: str = "*") -> None:
        self.unreadable: dict[str, str] = {}
        self._bus = bus
        self._clock = clock
        self._session = session
        self._query = RepeatedQuery(bus, clock, topics.key(session, member, topics.INFO))

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
        identity is therefore yielded repeatedly.

        Args:
            stopped: Function that returns True to end the search.
            timeout_s: Duration of the search, in s. If None, there is no limit.

        Yields:
            The identity of a member, as soon as its reply arrives.

        Raises:
            SessionError: The time has run out, and none of the replies received could be
                decoded.
        """
        has_readable_reply = False
        begun_ns = self._clock.monotonic_ns()
        timeout_ns = math.inf if timeout_s is None else timeout_s * 1e9
        while not stopped() and self._clock.monotonic_ns() - begun_ns < timeout_ns:
            for info in self.poll():
                has_readable_reply = True
                yield info
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
        if self.unreadable and not has_readable_reply and not stopped():
            member, reason = next(iter(self.unreadable.items()))
            raise SessionError(f"the reply of {member} cannot be read: {reason}")

    def send_change(
        self,
        site: str,
        request: ChangeRequest,
    ) -> ChangeReply:
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
        query = ChangeQuery(self._bus, self._clock, self._session, site, request)
        while not query.is_overdue:
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
            try:
                reply = query.poll()
            except WireError as error:
                raise SessionError(f"the reply of {site} cannot be read: {error}") from None
            if reply is not None:
                return reply

        hint = "; in a session with keys, only the operator may request changes"
        raise SessionError(
            f"{site} did not answer; the records of {site} show whether the change was made"
            f"{'' if request.order == 'stop' else hint}"
        )

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
                reply = self._query_once(key, request)
                backfill = None if reply is None else decode(reply, Backfill)
                if backfill is None or not backfill.payloads:
                    return

                for payload in backfill.payloads:
                    yield decode(payload, Event)
                first = backfill.first + len(backfill.payloads)
                published = backfill.made

    def require_absent(self, stopped: Callable[[], bool]) -> None:
        """Raises SessionError if a member is present under the session name of a playback.

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

    def _query_once(
        self,
        key: str,
        request: DirectMessage,
    ) -> bytes | None:
        """Sends a request to other processes once, and waits for the first reply.

        Args:
            key: Key under which the receiver accepts requests, see `topics.key`.
            request: The request.

        Returns:
            The payload of the reply, or None if no reply arrives within `REPLY_TIMEOUT_S`.
        """
        replies = self._bus.query(key, encode(request))
        deadline_ns = self._clock.monotonic_ns() + int(REPLY_TIMEOUT_S * 1e9)
        while self._clock.monotonic_ns() < deadline_ns:
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
            reply = replies.poll()
            if reply is not None:
                _key, payload = reply
                return payload
        return None

"""Finds a running session from outside, connects to it, and sends requests to its arms.

This module serves programs that are not part of a session: the commands that stop arms, change
network delays or measure the network, and a playback of a log.

Invariant:
    - A change is requested only once, because a second request might apply it twice. The caller
      receives either a reply, or an error that names the arm that did not reply.
    - A log is not played back under the name of a session that is running, because programs
      could not distinguish the messages of the log from those of the session.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace

import msgspec
from msgspec import UNSET

from ..errors import ScenarioError, SessionError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .connection import Connection, DefaultEndpoints
from .known_sites import find_known_endpoints
from .membership import MemberQuery, liveliness_token
from .messages import Event, Info
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
"""Time for which a playback looks for sites of a session with the same name, in s.

Sites try to connect every half second.
"""

SiteNamesOf = Callable[[str], tuple[str, ...]]
"""Function that returns the names of the sites in the text of a scenario, in their order.

It raises `ScenarioError` if the text is not a scenario.
"""


class SessionMembers:
    """The members of a running session, which are queried over an open connection.

    A member is a process of the session, for example a site (arm controller).

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of the caller.
        session: Name of the session.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session

    def find(
        self,
        *,
        stopped: Callable[[], bool],
        timeout_s: float | None,
    ) -> Iterator[Info]:
        """Queries the members of a session, and yields their identities as they arrive.

        The query is repeated until the search ends, because a reply may be lost. The identity
        of a member (process of a session) is therefore yielded repeatedly.

        Args:
            stopped: Function that returns True to end the search.
            timeout_s: Duration of the search, in s. If None, there is no limit.

        Yields:
            The identity of a member, as soon as a reply has arrived.

        Raises:
            SessionError: The time is over, and none of the replies that arrived could be
                decoded.
        """
        query = MemberQuery(self._bus, self._clock, self._session)
        has_readable_reply = False
        begun_ns = self._clock.monotonic_ns()
        timeout_ns = math.inf if timeout_s is None else timeout_s * 1e9
        while not stopped() and self._clock.monotonic_ns() - begun_ns < timeout_ns:
            for info in query.poll():
                has_readable_reply = True
                yield info
            self._clock.sleep_until(self._clock.monotonic_ns() + POLL_NS)
        if query.unreadable and not has_readable_reply and not stopped():
            member, reason = next(iter(query.unreadable.items()))
            raise SessionError(f"the reply of {member} cannot be read: {reason}")

    def send_change(
        self,
        site: str,
        request: ChangeRequest,
    ) -> ChangeReply:
        """Sends a request to a site of a running session, and waits for the reply.

        If the members of the session have keys, changes can be requested only with the keys of
        the operator. Every member may send the order to stop.

        Args:
            site: Name of the site.
            request: The requested change, or an order such as "stop".

        Returns:
            The reply of the site, accepted or refused.

        Raises:
            SessionError: The site does not reply.
        """
        channel = topics.STOP if request.order == "stop" else topics.SET
        payload = self._query_once(topics.key(self._session, site, channel), request)
        if payload is None:
            hint = "; in a session with keys, only the operator may request changes"
            raise SessionError(
                f"{site} did not answer; the records of {site} show whether the change was made"
                f"{'' if channel == topics.STOP else hint}"
            )

        try:
            reply = decode(payload, ChangeReply)
        except WireError as error:
            raise SessionError(f"the reply of {site} cannot be read: {error}") from None

        if request.order == "stop" and not reply.accepted and request.source is not UNSET:
            # A site with an older version of this program does not know the field `source`, and
            # refuses the whole request. Its arm must stop as well.
            return self.send_change(site, msgspec.structs.replace(request, source=UNSET))
        return reply

    def list_past_events(
        self,
        site: str,
    ) -> Iterator[Event]:
        """Queries a site for the events that it has published, and yields them in order.

        The first event is the oldest one that the site (arm controller) still stores. The
        iteration ends early if the site does not reply.

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
        """Checks that no member is present, before the session's name is used for a playback.

        Args:
            stopped: Function that returns True to end the check early.

        Raises:
            SessionError: A site (arm controller) of the session replies.
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
            The payload of the reply. None if no reply arrives within `REPLY_TIMEOUT_S`.
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


@contextmanager
def connect_to_session(
    connection: Connection,
    clock: Clock,
    session: str,
    names: SiteNamesOf,
    *,
    stopped: Callable[[], bool],
    timeout_s: float | None,
    say: Callable[[str], None] = lambda _: None,
    recorder_boot: int | None = None,
) -> Iterator[Bus | None]:
    """Connects to the sites of a session, as a context manager that closes the connection.

    If the endpoints are not known (`connection.connect` is None), they are found in two ways.
    If files on this machine show that all sites of the session run here, their endpoints are
    used. Otherwise the first site of the session, at its default endpoint on this machine, is
    queried for the names of the other sites, whose default endpoints follow from the names.

    Args:
        connection: Endpoints and mode of the caller.
        clock: Clock of the caller.
        session: Name of the session.
        names: Function that returns the names of the sites in a scenario. If it returns no
            names, only the first site is connected.
        stopped: Function that returns True to give up.
        timeout_s: Longest wait for the first site or for a router, in s. If None, there is no
            limit.
        say: Function that prints a line for the user.
        recorder_boot: Random number that identifies this start of the caller, if the caller is
            a recorder. The recorder is announced during the search, so that the session waits
            for it. None for other callers.

    Yields:
        The network connection. None if `stopped` returned True.

    Raises:
        SessionError: No site, or no router, replies in time.
        UsageError: An endpoint cannot be used.
    """
    with ExitStack() as stack:

        def connect(target: Connection) -> Bus | None:
            """Opens a network connection, which is closed at the end of the `with` block.

            The yielded connection is None if `stopped` has returned True.
            """
            bus = target.open_bus(clock=clock, stopped=stopped, timeout_s=timeout_s, say=say)
            return None if bus is None else stack.enter_context(closing(bus))

        # A recorder does not use the known sites: it must announce itself to the first site.
        if connection.connect is None and recorder_boot is None:
            connection = replace(connection, connect=find_known_endpoints(session, connection))
        if connection.connect is None:
            default_endpoints = DefaultEndpoints(session)
            first_endpoint = default_endpoints.of_site(0)
            first_bus = connect(replace(connection, listen=(), connect=[first_endpoint]))
            sites = None
            if first_bus is not None:
                if recorder_boot is not None:
                    token = liveliness_token(session, topics.RECORDER, recorder_boot)
                    first_bus.announce(token)
                sites = _query_sites(
                    bus=first_bus,
                    clock=clock,
                    session=session,
                    parse_site_names=names,
                    stopped=stopped,
                    timeout_s=timeout_s,
                )
            if sites is None:  # the caller has stopped the search
                yield None
                return
            endpoints = list(default_endpoints.by_site(sites).values()) or [first_endpoint]
            connection = replace(connection, connect=endpoints)
        yield connect(connection)


def _query_sites(
    bus: Bus,
    clock: Clock,
    session: str,
    parse_site_names: SiteNamesOf,
    stopped: Callable[[], bool],
    timeout_s: float | None,
) -> tuple[str, ...] | None:
    """Queries the members of a session for the names of its sites.

    A site is a process that runs one arm. Its reply contains the scenario, the description of
    the experiment, which names all sites of the session.

    Args:
        bus: Network connection that reaches the first site.
        clock: Clock of the caller.
        session: Name of the session.
        parse_site_names: Function that returns the names of the sites in the text of a
            scenario. It raises `ScenarioError` if the text is not a scenario.
        stopped: Function that returns True to give up.
        timeout_s: Longest wait for a reply, in s. If None, the wait lasts until `stopped`
            returns True.

    Returns:
        The names, from the first reply that contains a scenario. None if `stopped` returned
        True.

    Raises:
        SessionError: No member with a scenario replies in time.
    """
    members = SessionMembers(bus, clock, session)
    for info in members.find(stopped=stopped, timeout_s=timeout_s):
        try:
            if info.scenario:
                return parse_site_names(info.scenario)
        except ScenarioError:  # not a scenario of this program
            continue

    # The search has ended, because the caller has stopped it or because the time is over. The
    # second case cannot occur without a limit, so `timeout_s` is a number below.
    if stopped():
        return None
    raise SessionError(
        f"no site of session {session!r} answered at {DefaultEndpoints(session).of_site(0)} "
        f"within {timeout_s:g} s; check the name of the session, or name other endpoints with "
        "--connect"
    )

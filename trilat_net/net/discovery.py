"""Discovery of a session from outside: find its members, connect to it, request a change.

Invariant: one way of asking who is present (`find_members`). A session name belongs to one
session: a playback under a name that a site answers to is refused. A change is requested once,
and the caller gets a reply or an error that names the member without one.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace

import msgspec
from msgspec import UNSET

from ..errors import ScenarioError, SessionError, UsageError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .connection import Connection, default_endpoint, default_endpoints, open_bus
from .known_sites import find_known_endpoints
from .membership import MemberQuery, liveliness_token
from .messages import Event, Info
from .requests import (
    BACKFILL_MESSAGES,
    Backfill,
    BackfillRequest,
    ChangeReply,
    ChangeRequest,
    Request,
)
from .wire import decode, encode

POLL_NS = 5_000_000
REPLY_TIMEOUT_S = 3.0
NAME_CHECK_S = 0.7
"""Time to look for other sites before a playback: they try to connect every half a second."""

SiteNamesOf = Callable[[str], tuple[str, ...]]
"""Returns the sites that a scenario's text names, in order; raises ScenarioError if it is none.
"""


def find_members(
    bus: Bus,
    clock: Clock,
    session: str,
    *,
    stopped: Callable[[], bool],
    timeout_s: float | None,
) -> Iterator[Info]:
    """Yields identities of members as they arrive, each again and again, until the time, if
    any, is over.

    Raises:
        SessionError: the time is over, and all answers that arrived are unreadable.
    """
    query = MemberQuery(bus, clock, session)
    found = False
    begun_ns = clock.monotonic_ns()
    while not stopped() and (
        timeout_s is None or clock.monotonic_ns() - begun_ns < timeout_s * 1e9
    ):
        for info in query.poll():
            found = True
            yield info
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)
    if query.unreadable and not found and not stopped():
        member, reason = next(iter(query.unreadable.items()))
        raise SessionError(f"the answer of {member} cannot be read: {reason}")


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
    """Yields a bus that reaches a session's sites, or None if `stopped`; closes it at the end.

    Without endpoints to connect to (`connect` is None) it takes those of sites that are known
    to run on this machine, if all do. Else it asks the session's first site, on this machine,
    for the others; if `names` returns none, that site's endpoint remains. It waits for the
    first site, or for a router, for `timeout_s`, or for as long as it takes. A recorder is
    announced by its boot meanwhile: then the session waits for it.

    Raises:
        SessionError: no site or no router answers in time.
        UsageError: an endpoint cannot be used.
    """
    with ExitStack() as stack:

        def connect(there: Connection) -> Bus | None:
            bus = open_bus(
                connection=there, clock=clock, stopped=stopped, timeout_s=timeout_s, say=say
            )
            return None if bus is None else stack.enter_context(closing(bus))

        if connection.connect is None and recorder_boot is None:
            connection = replace(connection, connect=find_known_endpoints(session, connection))
        if connection.connect is None:
            first = default_endpoint(session, 0)
            visitor = connect(replace(connection, listen=(), connect=[first]))
            if visitor is not None and recorder_boot is not None:
                visitor.announce(liveliness_token(session, topics.RECORDER, recorder_boot))
            sites = (
                _ask_for_sites(
                    bus=visitor,
                    clock=clock,
                    session=session,
                    names=names,
                    stopped=stopped,
                    timeout_s=timeout_s,
                )
                if visitor
                else None
            )
            if sites is None:
                yield None
                return
            connection = replace(
                connection, connect=list(default_endpoints(session, sites).values()) or [first]
            )
        yield connect(connection)


def _ask_for_sites(
    bus: Bus,
    clock: Clock,
    session: str,
    names: SiteNamesOf,
    stopped: Callable[[], bool],
    timeout_s: float | None,
) -> tuple[str, ...] | None:
    for info in find_members(bus, clock, session, stopped=stopped, timeout_s=timeout_s):
        try:
            if info.scenario:
                return names(info.scenario)
        except ScenarioError:  # not a scenario of this program
            continue
    if stopped():
        return None
    raise SessionError(
        f"no site of session {session!r} answered at {default_endpoint(session, 0)} within {timeout_s:g} s; "
        "is that its name? name other endpoints with --connect"
    )


def send_change(
    bus: Bus, clock: Clock, session: str, site: str, request: ChangeRequest
) -> ChangeReply:
    """Sends a request to a site of a session that runs, and returns its reply; any member may
    ask to stop.

    Raises:
        SessionError: the site does not reply.
    """
    channel = topics.STOP if request.order == "stop" else topics.SET
    reply = _ask_once(bus, clock, topics.key(session, site, channel), request)
    if reply is None:
        whose = (
            "" if channel == topics.STOP else "; with keys, only the operator's may ask for it"
        )
        raise SessionError(
            f"{site} gave no answer; its records show whether it made the change{whose}"
        )
    try:
        answer = decode(reply, ChangeReply)
    except WireError as error:
        raise SessionError(f"the answer of {site} cannot be read: {error}") from None
    if request.order == "stop" and not answer.accepted and request.source is not UNSET:
        # A site of an older program knows no source and refuses the whole request; its arm has to stop too.
        return send_change(
            bus=bus,
            clock=clock,
            session=session,
            site=site,
            request=msgspec.structs.replace(request, source=UNSET),
        )
    return answer


def _ask_once(bus: Bus, clock: Clock, key: str, request: Request) -> bytes | None:
    replies = bus.query(key, encode(request))
    give_up_ns = clock.monotonic_ns() + int(REPLY_TIMEOUT_S * 1e9)
    while clock.monotonic_ns() < give_up_ns:
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        if (reply := replies.poll()) is not None:
            return reply[1]
    return None


def list_past_events(bus: Bus, clock: Clock, session: str, site: str) -> Iterator[Event]:
    """Yields the events of a site that runs, from its first one on, as far as it keeps them and
    answers.
    """
    first = 0
    made = 1
    with suppress(WireError):  # a stranger's answer
        while first < made:
            wanted = BackfillRequest(
                channel="event", first=first, last=first + BACKFILL_MESSAGES - 1
            )
            reply = _ask_once(bus, clock, topics.key(session, site, topics.PAST), wanted)
            past = None if reply is None else decode(reply, Backfill)
            if past is None or not past.payloads:
                return
            yield from (decode(payload, Event) for payload in past.payloads)
            first = past.first + len(past.payloads)
            made = past.made


def open_playback_bus(
    connection: Connection,
    clock: Clock,
    session: str,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
) -> Bus | None:
    """Returns the bus of a playback; None if `stopped`.

    Raises:
        SessionError: the session of that name is running and holds the port.
        UsageError: an endpoint cannot be used.
    """
    try:
        return open_bus(
            connection=connection, clock=clock, stopped=stopped, timeout_s=None, say=say
        )
    except UsageError:
        if not connection.listen:
            raise
        there = replace(connection, listen=(), connect=connection.listen)
        visitor = open_bus(
            connection=there, clock=clock, stopped=stopped, timeout_s=1.0, say=say
        )
        if visitor is not None:
            with closing(visitor):
                refuse_running_session(visitor, clock, session, stopped)
        raise


def refuse_running_session(
    bus: Bus, clock: Clock, session: str, stopped: Callable[[], bool]
) -> None:
    """Refuses a session name that a site answers to.

    Raises:
        SessionError: a site of that session answers.
    """
    for info in find_members(bus, clock, session, stopped=stopped, timeout_s=NAME_CHECK_S):
        if info.member != topics.RECORDER:
            state = (
                f"runs; {info.member} is at tick {info.ticks}"
                if info.running
                else "waits to begin"
            )
            raise SessionError(
                f"session {session!r} is there already and {state}; play under another name with "
                "--prefix or --session"
            )

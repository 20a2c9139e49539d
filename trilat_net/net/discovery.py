"""Discovery of a session from outside.

Connect to it, find its members, refuse a taken name, request a change.

Invariant: a session name belongs to one session; a playback under a name that a site answers to is
refused. A change is requested once, and the caller gets a reply or an error that names the member without
one.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

from ..errors import SessionError, UsageError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .connection import Connection, default_endpoint, default_endpoints, open_bus
from .membership import ASK_EVERY_NS
from .messages import Info
from .pinging import RepeatedQuery
from .requests import ChangeReply, ChangeRequest
from .wire import decode, encode

POLL_NS = 5_000_000
NAME_CHECK_NS = 700_000_000
"""How long to look for others before anything is played: they try to connect every half a second."""


def open_playback_bus(
    connection: Connection,
    clock: Clock,
    session: str,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
) -> Bus | None:
    """Returns the connection; who has its port may be the session whose name is taken."""
    try:
        return open_bus(connection, clock, stopped, None, say)
    except UsageError:
        if not connection.listen:
            raise
        there = replace(connection, listen=(), connect=connection.listen)
        visitor = open_bus(there, clock, stopped, 1.0, say)
        if visitor is not None:
            with closing(visitor):
                refuse_running_session(visitor, clock, session, stopped)
        raise


def refuse_running_session(bus: Bus, clock: Clock, session: str, stopped: Callable[[], bool]) -> None:
    """Looks for sites that answer to a session's name.

    Raises:
        SessionError: there are.
    """
    asking = RepeatedQuery(bus, clock, topics.key(session, "*", topics.INFO))
    until_ns, asked_ns = clock.monotonic_ns() + NAME_CHECK_NS, clock.monotonic_ns() - ASK_EVERY_NS
    while clock.monotonic_ns() < until_ns and not stopped():
        if clock.monotonic_ns() - asked_ns >= ASK_EVERY_NS:
            asked_ns = asking.ask()
        info = _answering_site(asking)
        if info is not None:
            doing = f"runs; {info.member} is at tick {info.ticks}" if info.running else "waits to begin"
            raise SessionError(
                f"session {session!r} is there already and {doing}; play under another name with "
                "--prefix or --session"
            )
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)


def _answering_site(replies: RepeatedQuery) -> Info | None:
    """Returns a site of a running or waiting session that has answered, or None."""
    while (answer := replies.poll()) is not None:
        try:
            info = decode(answer.payload, Info)
        except WireError:
            continue  # a stranger's
        if info.member != topics.RECORDER:
            return info
    return None


REPLY_TIMEOUT_S = 3.0

SiteNamesOf = Callable[[str], tuple[str, ...]]
"""Gives the sites that a scenario's text names, in order."""


def request_change(
    connection: Connection, clock: Clock, session: str, site: str, order: ChangeRequest, names: SiteNamesOf
) -> ChangeReply:
    """Asks a site for a change and returns its answer.

    Args:
        connection: how to reach the session; without endpoints to connect to, on this machine.
        clock: the time.
        session: the session's name.
        site: who is to do it.
        order: the change.
        names: reads a scenario's text.

    Raises:
        SessionError: the session has no such site, has not begun, or nobody answers.
    """
    if connection.connect is None:
        with closing(
            _open_client(replace(connection, connect=[default_endpoint(session, 0)]), clock)
        ) as first:
            members = names(_any_site_info(first, clock, session).scenario)
        connection = replace(connection, connect=list(default_endpoints(session, members).values()))
    with closing(_open_client(connection, clock)) as bus:
        info = _site_info(bus, clock, session, site, names)
        if not info.running:
            raise SessionError(f"session {session!r} has not begun: {site} waits for the others")
        return _send_change(bus, clock, topics.key(session, site, topics.SET), site, order)


def _open_client(connection: Connection, clock: Clock) -> Bus:
    bus = open_bus(connection, clock, lambda: False, REPLY_TIMEOUT_S, lambda _: None)
    assert bus is not None  # nothing stops it
    return bus


def _member_infos(bus: Bus, clock: Clock, session: str) -> Iterator[Info]:
    """Yields what members say of themselves, for `PATIENCE_S`."""
    asking = RepeatedQuery(bus, clock, topics.key(session, "*", topics.INFO))
    give_up_ns = clock.monotonic_ns() + int(REPLY_TIMEOUT_S * 1e9)
    while clock.monotonic_ns() < give_up_ns:
        again_ns = asking.ask() + ASK_EVERY_NS
        while clock.monotonic_ns() < again_ns:
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
            while (answer := asking.poll()) is not None:
                try:
                    yield decode(answer.payload, Info)
                except WireError as error:
                    raise SessionError(f"the answer of {answer.key} cannot be understood: {error}") from None


def _any_site_info(bus: Bus, clock: Clock, session: str) -> Info:
    """Returns what any site says of itself."""
    for info in _member_infos(bus, clock, session):
        if info.scenario:
            return info
    raise SessionError(
        f"no site of session {session!r} answers; is that its name? name endpoints with --connect"
    )


def _site_info(bus: Bus, clock: Clock, session: str, site: str, names: SiteNamesOf) -> Info:
    """Returns what a site says of itself."""
    sites: tuple[str, ...] = ()
    for info in _member_infos(bus, clock, session):
        if info.member == site:
            return info
        sites = names(info.scenario) if info.scenario else sites
        if sites and site not in sites:
            raise SessionError(f"session {session!r} has no site {site!r}; its sites are {', '.join(sites)}")
    raise SessionError(f"site {site!r} of session {session!r} does not answer")


def _send_change(bus: Bus, clock: Clock, key: str, site: str, order: ChangeRequest) -> ChangeReply:
    replies = bus.ask(key, encode(order))
    give_up_ns = clock.monotonic_ns() + int(REPLY_TIMEOUT_S * 1e9)
    while clock.monotonic_ns() < give_up_ns:
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        if (reply := replies.poll()) is not None:
            try:
                return decode(reply[1], ChangeReply)
            except WireError as error:
                raise SessionError(f"the answer of {site} cannot be understood: {error}") from None
    raise SessionError(f"{site} gave no answer; whether it took the change in, its records tell")

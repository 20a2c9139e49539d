"""Asking a site of a running session for a change.

Law: a change is asked for once, and whoever asks gets an answer or an error that says who gave none.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

from ..errors import SessionError, WireError
from . import topics
from .answers import Order, Reply
from .asking import Asking
from .bus import Bus
from .clock import Clock
from .connection import Connection, open_bus
from .endpoints import default_endpoint, default_endpoints
from .meeting import ASK_EVERY_NS
from .messages import Info
from .wire import decode, encode

POLL_NS = 5_000_000
PATIENCE_S = 3.0

Names = Callable[[str], tuple[str, ...]]
"""Gives the sites that a scenario's text names, in order."""


def place_order(
    connection: Connection, clock: Clock, session: str, site: str, order: Order, names: Names
) -> Reply:
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
        with closing(_open(replace(connection, connect=[default_endpoint(session, 0)]), clock)) as first:
            members = names(_anyone(first, clock, session).scenario)
        connection = replace(connection, connect=list(default_endpoints(session, members).values()))
    with closing(_open(connection, clock)) as bus:
        info = _member(bus, clock, session, site, names)
        if not info.running:
            raise SessionError(f"session {session!r} has not begun: {site} waits for the others")
        return _ask(bus, clock, topics.key(session, site, topics.SET), site, order)


def _open(connection: Connection, clock: Clock) -> Bus:
    bus = open_bus(connection, clock, lambda: False, PATIENCE_S, lambda _: None)
    assert bus is not None  # nothing stops it
    return bus


def _infos(bus: Bus, clock: Clock, session: str) -> Iterator[Info]:
    """Yields what members say of themselves, for `PATIENCE_S`."""
    asking = Asking(bus, clock, topics.key(session, "*", topics.INFO))
    give_up_ns = clock.monotonic_ns() + int(PATIENCE_S * 1e9)
    while clock.monotonic_ns() < give_up_ns:
        again_ns = asking.ask() + ASK_EVERY_NS
        while clock.monotonic_ns() < again_ns:
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
            while (answer := asking.poll()) is not None:
                try:
                    yield decode(answer.payload, Info)
                except WireError as error:
                    raise SessionError(f"the answer of {answer.key} cannot be understood: {error}") from None


def _anyone(bus: Bus, clock: Clock, session: str) -> Info:
    """Returns what any site says of itself."""
    for info in _infos(bus, clock, session):
        if info.scenario:
            return info
    raise SessionError(
        f"no site of session {session!r} answers; is that its name? name endpoints with --connect"
    )


def _member(bus: Bus, clock: Clock, session: str, site: str, names: Names) -> Info:
    """Returns what a site says of itself."""
    sites: tuple[str, ...] = ()
    for info in _infos(bus, clock, session):
        if info.member == site:
            return info
        sites = names(info.scenario) if info.scenario else sites
        if sites and site not in sites:
            raise SessionError(f"session {session!r} has no site {site!r}; its sites are {', '.join(sites)}")
    raise SessionError(f"site {site!r} of session {session!r} does not answer")


def _ask(bus: Bus, clock: Clock, key: str, site: str, order: Order) -> Reply:
    replies = bus.ask(key, encode(order))
    give_up_ns = clock.monotonic_ns() + int(PATIENCE_S * 1e9)
    while clock.monotonic_ns() < give_up_ns:
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        if (reply := replies.poll()) is not None:
            try:
                return decode(reply[1], Reply)
            except WireError as error:
                raise SessionError(f"the answer of {site} cannot be understood: {error}") from None
    raise SessionError(f"{site} gave no answer; whether it took the change in, its records tell")

"""How a replay comes into the network.

Law: the name of a session belongs to one; where somebody answers to it already, nothing is played.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

from ..errors import SessionError, UsageError, WireError
from ..net import topics
from ..net.asking import Asking
from ..net.bus import Bus
from ..net.clock import Clock
from ..net.connection import Connection, open_bus
from ..net.meeting import ASK_EVERY_NS
from ..net.messages import Info
from ..net.wire import decode

POLL_NS = 5_000_000
GATHER_NS = 700_000_000
"""How long to look for others before anything is played: they try to connect every half a second."""


def opened(
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
                refuse_others(visitor, clock, session, stopped)
        raise


def refuse_others(bus: Bus, clock: Clock, session: str, stopped: Callable[[], bool]) -> None:
    """Looks for sites that answer to a session's name.

    Raises:
        SessionError: there are.
    """
    asking = Asking(bus, clock, topics.key(session, "*", topics.INFO))
    until_ns, asked_ns = clock.monotonic_ns() + GATHER_NS, clock.monotonic_ns() - ASK_EVERY_NS
    while clock.monotonic_ns() < until_ns and not stopped():
        if clock.monotonic_ns() - asked_ns >= ASK_EVERY_NS:
            asked_ns = asking.ask()
        info = _site(asking)
        if info is not None:
            doing = f"runs; {info.member} is at tick {info.ticks}" if info.running else "waits to begin"
            raise SessionError(
                f"session {session!r} is there already and {doing}; play under another name with "
                "--prefix or --session"
            )
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)


def _site(replies: Asking) -> Info | None:
    """Returns a site of a running or waiting session that has answered, or None."""
    while (answer := replies.poll()) is not None:
        try:
            info = decode(answer.payload, Info)
        except WireError:
            continue  # a stranger's
        if info.member != topics.RECORDER:
            return info
    return None

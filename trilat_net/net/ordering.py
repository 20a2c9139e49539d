"""Asking a site for a change.

Law: whoever asks gets an answer or an error that says who did not give one.
"""

from ..errors import SessionError, WireError
from . import topics
from .bus import Bus
from .clock import Clock
from .messages import Order, Reply
from .wire import decode, encode

POLL_NS = 5_000_000
ASK_EVERY_NS = 1_000_000_000


def place_order(
    bus: Bus, clock: Clock, session: str, site: str, order: Order, timeout_s: float = 3.0
) -> Reply:
    """Asks a site for a change and returns its answer.

    Args:
        bus: a connection that reaches the site.
        clock: the time.
        session: the session's name.
        site: who is to do it.
        order: the change.
        timeout_s: how long to wait, s.

    Raises:
        SessionError: no site answered in time, or not in words that this version knows.
    """
    key = topics.key(session, site, topics.SET)
    begun_ns = clock.monotonic_ns()
    while True:
        replies = bus.ask(key, encode(order))
        asked_ns = clock.monotonic_ns()
        while clock.monotonic_ns() < asked_ns + ASK_EVERY_NS:
            if (answer := replies.poll()) is not None:
                try:
                    return decode(answer[1], Reply)
                except WireError as error:
                    raise SessionError(f"the answer of {site} cannot be understood: {error}") from None
            clock.sleep_until(clock.monotonic_ns() + POLL_NS)
        if clock.monotonic_ns() - begun_ns > timeout_s * 1e9:
            raise SessionError(f"no site {site!r} of a running session {session!r} answers")

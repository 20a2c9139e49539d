"""A router: where sites meet that cannot reach each other directly.

Law: Zenoh routes; this process only stands there and says who comes and goes.
"""

import math
from collections.abc import Callable

from . import topics
from .bus import Bus
from .clock import Clock

POLL_NS = 50_000_000


def run_router(
    bus: Bus,
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    until_idle_s: float | None = None,
) -> None:
    """Stands until it is stopped, or until all members have left.

    Args:
        bus: a router's connection.
        clock: the time.
        stopped: whether to end now.
        say: tells a person what happens.
        until_idle_s: end so many seconds after the last member has left, or None.
    """
    presence = bus.presence(topics.key("*", "*", topics.ALIVE) + "/*")
    there: set[str] = set()
    idle_ns = math.inf if until_idle_s is None else until_idle_s * 1e9
    empty_since_ns: int | None = None  # nobody has come yet: no end
    while not stopped():
        while (change := presence.poll()) is not None:
            key, alive = change
            where = topics.address(key)
            if where is None or alive == (key in there):
                continue
            (there.add if alive else there.remove)(key)
            say(f"session {where.session}: {where.member} {'is here' if alive else 'has left'}")
            empty_since_ns = None if there else clock.monotonic_ns()
        now_ns = clock.monotonic_ns()
        if empty_since_ns is not None and now_ns - empty_since_ns >= idle_ns:
            say(f"nobody has been here for {until_idle_s:g} s")
            return
        clock.sleep_until(now_ns + POLL_NS)

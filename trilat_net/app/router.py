"""Runs the router process, through which members of sessions reach each other.

Invariant:
    - A router forwards the messages of all sessions, and prints which processes join and leave.
"""

import math
from collections.abc import Callable

from ..net import Bus, Clock, topics

ROUTER_POLL_NS = 50_000_000
"""Time between two checks of the members by a router, in ns."""


def run_router(
    bus: Bus,
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    until_idle_s: float | None = None,
) -> None:
    """Runs a router until it is stopped, and prints which members join and leave.

    Members that cannot reach each other directly communicate through a router.

    Args:
        bus: Network connection of the router. The connection itself forwards the messages.
        clock: Clock of this process.
        stopped: Function that returns True when the router must end.
        say: Function that prints a line for the user.
        until_idle_s: Time after which the router ends once the last member has left, in s. If
            None, the router does not end by itself.
    """
    presence = bus.presence(topics.presence_key("*", "*"))
    present: set[topics.KeyParts] = set()
    idle_ns = math.inf if until_idle_s is None else until_idle_s * 1e9
    empty_since_ns: int | None = None  # None before the first member

    while not stopped():
        for parts, is_alive in topics.read_presence(presence):
            if is_alive == (parts in present):
                continue
            if is_alive:
                present.add(parts)
            else:
                present.remove(parts)
            change = "is here" if is_alive else "has left"
            say(f"session {parts.session}: {parts.member} {change}")
            empty_since_ns = None if present else clock.monotonic_ns()

        now_ns = clock.monotonic_ns()
        if empty_since_ns is not None and now_ns - empty_since_ns >= idle_ns:
            say(f"no member for {until_idle_s:g} s")
            return
        clock.sleep_until(now_ns + ROUTER_POLL_NS)

"""Waiting in tests: for a condition, with a time limit, by a clock."""

from collections.abc import Callable
from typing import TypeVar

from trilat_net.net.bus import Bus, Inbox, PolledRing
from trilat_net.net.clock import Clock, SystemClock

T = TypeVar("T")
STEP_NS = 2_000_000


def until(condition: Callable[[], T], timeout_s: float = 30.0, clock: Clock | None = None) -> T:
    """Returns the result of a condition once it is true; fails after a time limit."""
    clock = clock or SystemClock()
    give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
    while not (result := condition()):
        now_ns = clock.monotonic_ns()
        assert now_ns < give_up_ns, f"not within {timeout_s:g} s"
        clock.sleep_until(now_ns + STEP_NS)
    return result


def drained(ring: PolledRing[T]) -> list[T]:
    """Returns all messages that wait in a ring."""
    return list(iter(ring.poll, None))


def query_once(asker: Bus, key: str, payload: bytes = b"?") -> tuple[str, bytes] | None:
    """Returns the first reply to a question, or None without a reply within half a second."""
    replies = asker.query(key, payload)
    try:
        return until(replies.poll, timeout_s=0.5)
    except AssertionError:
        return None


def received(inbox: Inbox, count: int) -> list[tuple[str, bytes]]:
    """Returns messages of an inbox as soon as there are at least `count`."""
    messages: list[tuple[str, bytes]] = []

    def enough() -> bool:
        messages.extend(drained(inbox))
        return len(messages) >= count

    until(enough)
    return messages


def sleep_for_ns(clock: Clock, duration_ns: int) -> None:
    """Sleeps on a clock for a duration."""
    clock.sleep_until(clock.monotonic_ns() + duration_ns)

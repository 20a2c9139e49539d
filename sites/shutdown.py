"""Shutdown linger of a site: wait for the recorders after the last tick.

Invariant: the wait ends when every recorder present has all messages that it can have, and it is bounded.
"""

from collections.abc import Callable

from trilat_net.net.clock import Clock

from .peer_monitor import PeerMonitor

LINGER_S = 5
POLL_NS = 5_000_000
LAST_EVENT_NS = 100_000_000
LEAVE_TIMEOUT_NS = 2_000_000_000
ASKED_NS = 1_000_000_000
"""A recorder that has asked within this time is there, whatever its token says."""


def await_recorders(
    company: PeerMonitor,
    answer: Callable[[], bool],
    attend: Callable[[], None],
    clock: Clock,
    stopped: Callable[[], bool],
    ticks: int,
    stay_ns: int,
) -> None:
    """Waits for the word of every recorder that is there that it has all that it can have.

    At most `LINGER_S` after the last question of one of them, and `stay_ns` after their word.

    Args:
        company: the others.
        answer: answers the oldest question of a recorder; False where there is none.
        attend: does what else is to be done meanwhile.
        clock: the time.
        stopped: True once the site was asked to end.
        ticks: how many ticks the site has made.
        stay_ns: how long to stay after their word, until they are gone.
    """
    give_up_ns = clock.monotonic_ns() + LINGER_S * 1_000_000_000
    asked_ns = 0
    while clock.monotonic_ns() < give_up_ns and not (company.stored and stopped()):
        while answer():
            asked_ns = clock.monotonic_ns()
            give_up_ns = max(give_up_ns, asked_ns + LINGER_S * 1_000_000_000)
        attend()
        away = not company.recorders and clock.monotonic_ns() - asked_ns > ASKED_NS
        if away:  # its last word may still be under way; or its process ends
            patience_ns = LEAVE_TIMEOUT_NS if company.stored else LAST_EVENT_NS
            give_up_ns = min(give_up_ns, clock.monotonic_ns() + patience_ns)
        if company.hear_recorders(ticks) and company.recorders <= company.stored:
            give_up_ns = clock.monotonic_ns() + stay_ns
        clock.sleep_until(clock.monotonic_ns() + POLL_NS)

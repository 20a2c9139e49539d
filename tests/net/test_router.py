"""A router says who comes and goes, and ends when it is told to or when nobody is left."""

from collections.abc import Callable

from trilat_net.net.bus import Bus, LocalNetwork
from trilat_net.net.clock import ManualClock
from trilat_net.net.connection import ROUTER_POLL_NS, run_router


class Played(ManualClock):
    """A clock on which things happen, each after one more sleep; then the router is stopped."""

    def __init__(self, *events: Callable[[], object], rest: int = 0) -> None:
        super().__init__()
        self._events = [*events, *([lambda: None] * rest)]
        self.over = False

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns)
        if self._events:
            self._events.pop(0)()
        else:
            self.over = True

    def stopped(self) -> bool:
        return self.over


def routed(clock: Played, network: LocalNetwork, until_idle_s: float | None = None) -> list[str]:
    said: list[str] = []
    run_router(network.join(), clock, clock.stopped, said.append, until_idle_s)
    return said


def member(network: LocalNetwork, key: str) -> Bus:
    bus = network.join()
    bus.announce(key)
    return bus


def test_it_says_who_comes_and_goes_in_every_session() -> None:
    network = LocalNetwork()
    there = member(network, "trilat/one/m1/alive/1")
    member(network, "other/one/m1/alive/1")
    clock = Played(lambda: member(network, "trilat/two/s/alive/2"), there.close)
    assert routed(clock, network) == [
        "session one: m1 is here",
        "session two: s is here",
        "session one: m1 has left",
    ]


def test_two_starts_of_one_member_are_two_and_one_start_is_one() -> None:
    """A token may be heard twice, as after a link that healed; it is said once."""
    network = LocalNetwork()
    first = member(network, "trilat/t/m1/alive/1")
    clock = Played(
        lambda: first.announce("trilat/t/m1/alive/1"),
        lambda: member(network, "trilat/t/m1/alive/2"),
        first.close,
    )
    assert routed(clock, network) == [
        "session t: m1 is here",
        "session t: m1 is here",
        "session t: m1 has left",
    ]


def test_it_stays_until_members_have_come_and_all_have_left_for_so_long() -> None:
    network = LocalNetwork()
    members: list[Bus] = []

    def comes() -> None:
        members.append(member(network, f"trilat/t/m1/alive/{len(members)}"))

    def goes() -> None:
        members[-1].close()

    idle_ns = 4 * ROUTER_POLL_NS
    nothing = [lambda: None] * 10
    pause = [lambda: None] * 2
    clock = Played(*nothing, comes, *nothing, goes, *pause, comes, *nothing, goes, rest=100)
    said = routed(clock, network, idle_ns * 1e-9)
    assert said[-1] == "no member for 0.2 s"
    assert len(said) == 5
    assert not clock.over
    assert clock.monotonic_ns() == (10 + 1 + 10 + 1 + 2 + 1 + 10 + 1 + 4) * ROUTER_POLL_NS


def test_without_a_time_it_stays_for_ever() -> None:
    network = LocalNetwork()
    there = member(network, "trilat/t/m1/alive/1")
    clock = Played(there.close, rest=1000)
    routed(clock, network)
    assert clock.over

"""The router process: the members that it reports, and its end."""

from collections.abc import Callable

from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from trilat_net.app.router import ROUTER_POLL_NS, run_router
from trilat_net.net.bus import Bus


class Played(ManualClock):
    """A clock on which events happen, each after one more sleep; then the router is stopped."""

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


def run_router_until_idle(
    clock: Played, network: LocalNetwork, until_idle_s: float | None = None
) -> list[str]:
    said: list[str] = []
    run_router(network.join(), clock, clock.stopped, said.append, until_idle_s)
    return said


def announce_member(network: LocalNetwork, key: str) -> Bus:
    bus = network.join()
    bus.announce(key)
    return bus


def test_routers_report_members_in_every_session() -> None:
    network = LocalNetwork()
    other_token = announce_member(network, "trilat/one/m1/alive/1")
    announce_member(network, "other/one/m1/alive/1")
    clock = Played(lambda: announce_member(network, "trilat/two/s/alive/2"), other_token.close)
    assert run_router_until_idle(clock, network) == [
        "session one: m1 is here",
        "session two: s is here",
        "session one: m1 has left",
    ]


def test_two_starts_of_a_member_count_twice() -> None:
    """A token may be heard twice, as after a link that healed; it is reported once."""
    network = LocalNetwork()
    first = announce_member(network, "trilat/t/m1/alive/1")
    clock = Played(
        lambda: first.announce("trilat/t/m1/alive/1"),
        lambda: announce_member(network, "trilat/t/m1/alive/2"),
        first.close,
    )
    assert run_router_until_idle(clock, network) == [
        "session t: m1 is here",
        "session t: m1 is here",
        "session t: m1 has left",
    ]


def test_a_router_stays_until_all_members_have_left() -> None:
    network = LocalNetwork()
    members: list[Bus] = []

    def comes() -> None:
        members.append(announce_member(network, f"trilat/t/m1/alive/{len(members)}"))

    def goes() -> None:
        members[-1].close()

    idle_ns = 4 * ROUTER_POLL_NS
    nothing = [lambda: None] * 10
    pause = [lambda: None] * 2
    clock = Played(*nothing, comes, *nothing, goes, *pause, comes, *nothing, goes, rest=100)
    said = run_router_until_idle(clock, network, idle_ns * 1e-9)
    assert said[-1] == "no member for 0.2 s"
    assert len(said) == 5
    assert not clock.over
    assert clock.monotonic_ns() == (10 + 1 + 10 + 1 + 2 + 1 + 10 + 1 + 4) * ROUTER_POLL_NS


def test_without_a_time_it_stays_for_ever() -> None:
    network = LocalNetwork()
    other_token = announce_member(network, "trilat/t/m1/alive/1")
    clock = Played(other_token.close, rest=1000)
    run_router_until_idle(clock, network)
    assert clock.over

"""Endpoints by default, from the command line and from a file together; the router process."""

import re
import socket
from collections.abc import Callable
from contextlib import ExitStack, closing
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.manual_clock import ManualClock
from trilat_net.errors import SessionError, UsageError
from trilat_net.net.bus import Bus
from trilat_net.net.connection import (
    ROUTER_POLL_NS,
    Connection,
    default_endpoint,
    default_endpoints,
    find_free_endpoints,
    reserve_session_endpoints,
    run_router,
)
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.net.zenoh_config import ZenohFile, check_zenoh_file

from .local_bus import LocalNetwork

HERE = ["tcp/127.0.0.1:1"]
THERE = ["tcp/127.0.0.1:2"]
A = "tcp/a:1"
B = "tcp/b:1"
C = "tcp/c:1"


def check_file(**stated: object) -> ZenohFile:
    return check_zenoh_file("mine.json5", stated, lambda _: "")


def make_member_connection(
    listen: list[str] | None = None,
    connect: list[str] | None = None,
    routers: list[str] | None = None,
    own: ZenohFile | None = None,
) -> Connection:
    return Connection.of_member(listen, connect, routers, own, HERE, THERE)


def test_defaults_stay_on_this_machine() -> None:
    assert make_member_connection() == Connection(HERE, THERE, "peer", {})
    assert make_member_connection(own=check_file(namespace="n")) == Connection(
        HERE, THERE, "peer", {"namespace": "n"}
    )


def test_named_places_replace_the_local_ones() -> None:
    assert make_member_connection(listen=[A]) == Connection([A], THERE)
    assert make_member_connection(connect=[A, B]) == Connection(HERE, [A, B])
    assert make_member_connection(listen=[], connect=[]) == Connection([], [])
    assert make_member_connection(own=check_file(listen={"endpoints": [A]})).listen == [A]
    assert make_member_connection(own=check_file(connect={"endpoints": [A]})).connect == [A]
    # --connect first
    assert make_member_connection(
        connect=[B], own=check_file(connect={"endpoints": [A, B]})
    ).connect == [
        B,
        A,
    ]


def test_clients_of_routers_listen_nowhere() -> None:
    assert make_member_connection(routers=[A, B]) == Connection((), [A, B], "client", {})
    stated = check_file(mode="client", connect={"endpoints": [C]})
    assert make_member_connection(routers=[A], own=stated) == Connection(
        (), [A, C], "client", {"connect": {}}
    )
    assert make_member_connection(own=stated) == Connection((), [C], "client", {"connect": {}})
    assert make_member_connection(connect=[A], own=stated).connect == [A, C]


@pytest.mark.parametrize(
    "endpoint",
    [
        A,
        "tls/[::1]:7447",
        "quic/host:7447#iface=eth0",
        "udp/h:1?rel=0",
        "unixsock-stream//run/zenoh.sock",
    ],
)
def test_any_address_of_zenoh_may_be_a_router(endpoint: str) -> None:
    assert make_member_connection(routers=[endpoint]).connect == [endpoint]


def make_router_connection(
    listen: list[str] | None, connect: list[str] | None, zenoh_file: ZenohFile | None
) -> Connection:
    return Connection.of_member(listen, connect, None, zenoh_file, HERE, routes=True)


def test_routers_listen_and_connect_as_configured() -> None:
    assert make_router_connection(None, None, None) == Connection(HERE, (), "router", {})
    lines = make_router_connection([A], [B], check_file(mode="router"))
    assert lines == Connection([A], [B], "router", {})
    places = {"router": [C], "peer": [B]}
    assert make_router_connection(
        None, None, check_file(listen={"endpoints": places})
    ).listen == [C]
    for mode in ("peer", "client"):
        with pytest.raises(
            UsageError, match=f"mine.json5: the mode must be router here, not {mode}"
        ):
            make_router_connection(None, None, check_file(mode=mode))


class Answering(ManualClock):
    """A clock on which a router appears, or a signal, after a number of sleeps."""

    def __init__(
        self, endpoints: list[str], comes_after: int = 0, stops_after: int = 0
    ) -> None:
        super().__init__()
        self.sleeps = 0
        self.router: ZenohBus | None = None
        self._endpoints = endpoints
        self._comes_after = comes_after
        self._stops_after = stops_after

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns)
        self.sleeps += 1
        if self.sleeps == self._comes_after:
            self.router = ZenohBus(self._endpoints, mode="router")

    def stopped(self) -> bool:
        return 0 < self._stops_after <= self.sleeps


def test_late_routers_are_awaited() -> None:
    endpoints = find_free_endpoints(1)
    clock = Answering(endpoints, comes_after=3)
    said = []
    bus = Connection((), endpoints, "client").open_bus(clock, clock.stopped, 5.0, said.append)
    assert bus is not None
    bus.close()
    assert clock.router is not None
    clock.router.close()
    assert clock.sleeps == 3
    assert said == [f"no router answers at {endpoints[0]} yet; trying again"]


def test_missing_routers_are_reported_and_signals_end_waiting() -> None:
    endpoints = find_free_endpoints(2)
    clock = Answering(endpoints)
    connection = Connection((), endpoints, "client")
    with pytest.raises(
        SessionError, match=f"no router answers at {', '.join(endpoints)} within 1 s"
    ):
        connection.open_bus(clock, clock.stopped, 1.0, lambda _: None)
    clock = Answering(endpoints, stops_after=4)
    assert connection.open_bus(clock, clock.stopped, None, lambda _: None) is None
    assert clock.sleeps == 4


def test_peers_wait_for_nobody() -> None:
    endpoints = find_free_endpoints(2)
    clock = Answering(endpoints)
    bus = Connection(endpoints[:1], endpoints[1:]).open_bus(
        clock, clock.stopped, 0.0, lambda _: None
    )
    assert bus is not None
    bus.close()
    assert clock.sleeps == 0


NAMES = st.text("abcdefghijklmnopqrstuvwxyz0123456789_-.", min_size=1, max_size=40)


def find_port(endpoint: str) -> int:
    match = re.fullmatch(r"tcp/127\.0\.0\.1:(\d+)", endpoint)
    assert match, endpoint
    return int(match[1])


@given(NAMES, st.integers(0, 1000))
def test_default_ports_are_below_the_ephemeral_ones(session: str, index: int) -> None:
    assert 1024 <= find_port(default_endpoint(session, index)) < 32_768


@given(NAMES, st.lists(NAMES, min_size=2, max_size=64, unique=True))
def test_sites_have_endpoints_of_their_own(session: str, sites: list[str]) -> None:
    places = default_endpoints(session, sites)
    assert list(places) == sites
    assert len(set(places.values())) == len(sites)
    assert places[sites[0]] == default_endpoint(session, 0)


def test_endpoints_are_a_published_function() -> None:
    assert default_endpoint("paper", 0) == "tcp/127.0.0.1:24448"
    assert default_endpoint("paper", 2) == "tcp/127.0.0.1:24450"


def test_free_endpoints_can_be_used_together() -> None:
    endpoints = find_free_endpoints(8)
    assert len(set(endpoints)) == 8
    with ExitStack() as stack:
        for endpoint in endpoints:
            stack.enter_context(socket.socket()).bind(("127.0.0.1", find_port(endpoint)))


def test_sessions_keep_free_ports() -> None:
    """So that `trilat set` and `trilat ping` find the session without its ports."""
    sites = ("a", "b", "c")
    places = list(default_endpoints("endpoints-test", sites).values())
    with reserve_session_endpoints("endpoints-test", sites) as reserved:
        assert reserved == places
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", find_port(places[1])))
        taken.listen()
        with reserve_session_endpoints("endpoints-test", sites) as others:
            assert len(set(others)) == 3
            assert not set(others) & set(places)


def test_namesake_sessions_get_their_own_ports() -> None:
    """Each keeps its choice, and its sites can listen there all the same."""
    sites = ("a", "b", "c")
    with ExitStack() as stack:
        chosen = [
            stack.enter_context(reserve_session_endpoints("endpoints-test", sites))
            for _ in range(3)
        ]
        places = list(chain.from_iterable(chosen))
        assert len(set(places)) == 9
        for endpoint in places:
            stack.enter_context(closing(ZenohBus([endpoint])))


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

"""Endpoints by default, and from the command line and a file together."""

import re
import socket
from contextlib import ExitStack, closing
from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.free_endpoints import find_free_endpoints
from tests.net.manual_clock import ManualClock
from trilat_net.errors import SessionError, UsageError
from trilat_net.net.connection import Connection
from trilat_net.net.default_endpoints import DefaultEndpoints
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.net.zenoh_config import ZenohFile

HERE = ["tcp/127.0.0.1:1"]
THERE = ["tcp/127.0.0.1:2"]
A = "tcp/a:1"
B = "tcp/b:1"
C = "tcp/c:1"


def check_file(**stated: object) -> ZenohFile:
    return ZenohFile.check("mine.json5", stated, lambda _: "")


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
    assert 1024 <= find_port(DefaultEndpoints(session).of_site(index)) < 32_768


@given(NAMES, st.lists(NAMES, min_size=2, max_size=64, unique=True))
def test_sites_have_endpoints_of_their_own(session: str, sites: list[str]) -> None:
    default_endpoints = DefaultEndpoints(session)
    places = default_endpoints.by_site(sites)
    assert list(places) == sites
    assert len(set(places.values())) == len(sites)
    assert places[sites[0]] == default_endpoints.of_site(0)


def test_endpoints_are_a_published_function() -> None:
    assert DefaultEndpoints("paper").of_site(0) == "tcp/127.0.0.1:24448"
    assert DefaultEndpoints("paper").of_site(2) == "tcp/127.0.0.1:24450"


def test_free_endpoints_can_be_used_together() -> None:
    endpoints = find_free_endpoints(8)
    assert len(set(endpoints)) == 8
    with ExitStack() as stack:
        for endpoint in endpoints:
            stack.enter_context(socket.socket()).bind(("127.0.0.1", find_port(endpoint)))


def test_sessions_keep_free_ports() -> None:
    """So that `trilat set` and `trilat ping` find the session without its ports."""
    default_endpoints = DefaultEndpoints("endpoints-test")
    places = list(default_endpoints.by_site(("a", "b", "c")).values())
    with default_endpoints.reserve(3) as reserved:
        assert reserved == places
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", find_port(places[1])))
        taken.listen()
        with default_endpoints.reserve(3) as others:
            assert len(set(others)) == 3
            assert not set(others) & set(places)


def test_namesake_sessions_get_their_own_ports() -> None:
    """Each keeps its choice, and its sites can listen there all the same."""
    default_endpoints = DefaultEndpoints("endpoints-test")
    with ExitStack() as stack:
        chosen = [stack.enter_context(default_endpoints.reserve(3)) for _ in range(3)]
        places = list(chain.from_iterable(chosen))
        assert len(set(places)) == 9
        for endpoint in places:
            stack.enter_context(closing(ZenohBus([endpoint])))

import re
import socket

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.net.connection import (
    choose_session_endpoints,
    default_endpoint,
    default_endpoints,
    find_free_endpoints,
)

NAMES = st.text("abcdefghijklmnopqrstuvwxyz0123456789_-.", min_size=1, max_size=40)


def port(endpoint: str) -> int:
    found = re.fullmatch(r"tcp/127\.0\.0\.1:(\d+)", endpoint)
    assert found, endpoint
    return int(found[1])


@given(NAMES, st.integers(0, 1000))
def test_defaults_are_unprivileged_loopback_ports_below_the_ephemeral_ones(session: str, index: int) -> None:
    assert 1024 <= port(default_endpoint(session, index)) < 32_768


@given(NAMES, st.lists(NAMES, min_size=2, max_size=64, unique=True))
def test_sites_of_a_session_have_endpoints_of_their_own(session: str, sites: list[str]) -> None:
    places = default_endpoints(session, sites)
    assert list(places) == sites
    assert len(set(places.values())) == len(sites)
    assert places[sites[0]] == default_endpoint(session, 0)


def test_they_are_a_published_function_of_session_and_site() -> None:
    assert default_endpoint("paper", 0) == "tcp/127.0.0.1:24448"
    assert default_endpoint("paper", 2) == "tcp/127.0.0.1:24450"


def test_most_sessions_do_not_share_ports() -> None:
    first = {default_endpoint(f"session-{n}", 0) for n in range(100)}
    assert len(first) > 80


def test_free_endpoints_can_be_listened_at_all_at_once() -> None:
    endpoints = find_free_endpoints(8)
    assert len(set(endpoints)) == 8
    sockets = [socket.socket() for _ in endpoints]
    try:
        for endpoint, probe in zip(endpoints, sockets, strict=True):
            probe.bind(("127.0.0.1", port(endpoint)))
    finally:
        for probe in sockets:
            probe.close()


def test_a_session_stays_at_its_ports_unless_one_of_them_is_taken() -> None:
    """So that `trilat set` and `trilat ping` find it without being told."""
    sites = ("a", "b", "c")
    places = list(default_endpoints("endpoints-test", sites).values())
    assert choose_session_endpoints("endpoints-test", sites) == places
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port(places[1])))
        taken.listen()
        others = choose_session_endpoints("endpoints-test", sites)
    assert len(set(others)) == 3
    assert not set(others) & set(places)

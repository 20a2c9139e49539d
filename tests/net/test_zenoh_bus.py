"""What the contract of `Bus` does not say: endpoints, encryption, and routers that end and begin again."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from trilat_net.errors import UsageError
from trilat_net.net.bus import Bus
from trilat_net.net.endpoints import free_endpoints
from trilat_net.net.zenoh_bus import RouterSilent, ZenohBus

from .networks import Routed, encrypted, meet
from .waiting import received, until


def test_a_busy_port_is_the_callers_error_and_named() -> None:
    (endpoint,) = free_endpoints(1)
    first = ZenohBus([endpoint])
    try:
        with pytest.raises(UsageError, match=rf"{endpoint}: the port is in use"):
            ZenohBus([endpoint])
    finally:
        first.close()


@pytest.mark.parametrize("endpoint", ["", "nonsense", "tcp/", "carrier-pigeon/1:2"])
@pytest.mark.parametrize("side", ["listen", "connect"])
def test_a_malformed_endpoint_is_the_callers_error(endpoint: str, side: str) -> None:
    with pytest.raises(UsageError, match="cannot"):
        ZenohBus(**{side: [endpoint]}).close()


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:1", "carrier-pigeon/1:2"])
def test_a_client_whose_router_does_not_answer_says_so(endpoint: str) -> None:
    with pytest.raises(RouterSilent, match=f"no router answers at {endpoint}"):
        ZenohBus([], [endpoint], "client")


def test_a_stranger_without_a_certificate_of_the_authority_does_not_get_in(tmp_path: Path) -> None:
    """Each side of TLS asks the other: a stranger is refused by the router, and refuses a strange router."""
    for folder in ("ours", "theirs"):
        (tmp_path / folder).mkdir()
    ours, theirs = (encrypted("tls", tmp_path / folder) for folder in ("ours", "theirs"))
    (endpoint,) = (place.replace("tcp", "tls") for place in free_endpoints(1))
    router = ZenohBus([endpoint], mode="router", own=ours.own)
    try:
        for own in (theirs.own, None):
            with pytest.raises(RouterSilent):
                ZenohBus([], [endpoint], "client", own)
        ZenohBus([], [endpoint], "client", ours.own).close()
    finally:
        router.close()


def test_messages_go_over_quic_too(tmp_path: Path) -> None:
    network = encrypted("quic", tmp_path)
    try:
        sender, receiver = network.join(), network.join()
        inbox, publish = receiver.inbox("t/a"), sender.publisher("t/a")
        meet(publish, receiver, "t/a")
        numbers = [n.to_bytes(2, "big") for n in range(500)]
        for number in numbers:
            publish(number)
        heard = received(inbox, 501)
        assert [payload for _, payload in heard if payload] == numbers
    finally:
        network.close()


@pytest.fixture
def routed() -> Iterator[Routed]:
    network = Routed()
    yield network
    network.close()


def test_members_meet_again_through_a_router_that_was_started_again(routed: Routed) -> None:
    one, other = routed.join(), routed.join()
    one.announce("t/one/alive/1")
    presence, inbox, publish = other.presence("t/*/alive/*"), other.inbox("t/a"), one.publisher("t/a")
    one.respond("t/one/ping", lambda sent: sent)
    assert until(presence.poll) == ("t/one/alive/1", True)
    routed.restart()
    assert until(presence.poll) == ("t/one/alive/1", False)
    assert until(presence.poll) == ("t/one/alive/1", True)

    def heard() -> bool:
        publish(b"again")
        return inbox.poll() is not None

    until(heard)
    assert until(lambda: answered(other)) == ("t/one/ping", b"?")


def answered(asker: Bus) -> tuple[str, bytes] | None:
    replies = asker.ask("t/*/ping", b"?")
    try:
        return until(replies.poll, timeout_s=0.3)
    except AssertionError:
        return None


def test_routers_that_connect_to_each_other_are_one() -> None:
    endpoints = free_endpoints(2)
    routers = [ZenohBus(endpoints[:1], mode="router"), ZenohBus(endpoints[1:], endpoints[:1], "router")]
    members = [ZenohBus([], [endpoint], "client") for endpoint in endpoints]
    try:
        meet(members[0].publisher("t/a"), members[1], "t/a")
        meet(members[1].publisher("t/b"), members[0], "t/b")
    finally:
        for bus in (*members, *routers):
            bus.close()

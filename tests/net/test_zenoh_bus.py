"""Rules of the real bus beyond the contract of `Bus`: endpoints, encryption, and routers that
end and begin again.
"""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.net.free_endpoints import find_free_endpoints
from tests.net.networks import make_encrypted_mesh, wait_for_meeting
from trilat_net.errors import UsageError
from trilat_net.net.connection import Connection
from trilat_net.net.zenoh_bus import RouterSilent, ZenohBus, read_zenoh_file
from trilat_net.net.zenoh_config import MOST_PUT_BYTES

from .networks import Routed
from .waiting import query_once, received, until


def test_busy_ports_are_the_callers_named_error() -> None:
    (endpoint,) = find_free_endpoints(1)
    first = ZenohBus([endpoint])
    try:
        with pytest.raises(UsageError, match=rf"{endpoint}: the port is in use"):
            ZenohBus([endpoint])
    finally:
        first.close()


def test_messages_without_member_are_refused() -> None:
    """Rings hold hundreds of messages, which at hundreds of megabytes each would fill the memory."""
    (endpoint,) = find_free_endpoints(1)
    with (
        closing(ZenohBus([endpoint])) as listener,
        closing(ZenohBus([], [endpoint])) as connecting,
    ):
        inbox = listener.inbox("trilat/x/m/event")
        publish = connecting.publisher("trilat/x/m/event", patient=True)

        def hear() -> tuple[str, bytes] | None:
            publish(bytes(MOST_PUT_BYTES + 1))
            publish(b"word")
            return inbox.poll()

        assert until(hear) == ("trilat/x/m/event", b"word")


@pytest.mark.parametrize("endpoint", ["", "nonsense", "tcp/", "carrier-pigeon/1:2"])
@pytest.mark.parametrize("side", ["listen", "connect"])
def test_malformed_endpoints_are_the_callers_error(endpoint: str, side: str) -> None:
    with pytest.raises(UsageError, match="cannot"):
        ZenohBus(**{side: [endpoint]}).close()


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:1", "carrier-pigeon/1:2"])
def test_clients_report_unanswering_routers(endpoint: str) -> None:
    with pytest.raises(RouterSilent, match=f"no router answers at {endpoint}"):
        ZenohBus([], [endpoint], "client")


def test_strangers_without_certificate_stay_outside(tmp_path: Path) -> None:
    """Each side of TLS asks the other: a stranger is refused by the router, and refuses a
    strange router.
    """
    for folder in ("ours", "theirs"):
        (tmp_path / folder).mkdir()
    ours, theirs = (
        make_encrypted_mesh("tls", tmp_path / folder) for folder in ("ours", "theirs")
    )
    (endpoint,) = (
        free_endpoint.replace("tcp", "tls") for free_endpoint in find_free_endpoints(1)
    )
    router = ZenohBus([endpoint], mode="router", settings=ours.settings)
    try:
        for own_file in (theirs.settings, None):
            with pytest.raises(RouterSilent):
                ZenohBus([], [endpoint], "client", own_file)
        ZenohBus([], [endpoint], "client", ours.settings).close()
    finally:
        router.close()


ACCESS = """{
    transport: { auth: { usrpwd: { user: "router", password: "r", dictionary_file: "USERS" } } },
    access_control: {
        enabled: true,
        default_permission: "deny",
        rules: [{
            id: "lab",
            permission: "allow",
            flows: ["ingress", "egress"],
            messages: ["put", "declare_subscriber", "query", "reply", "declare_queryable",
                       "liveliness_token", "declare_liveliness_subscriber", "liveliness_query"],
            key_exprs: ["trilat/lab/**"],
        }],
        subjects: [{ id: "everybody" }],
        policies: [{ rules: ["lab"], subjects: ["everybody"] }],
    },
}"""


def test_routers_admit_by_password_and_filter(tmp_path: Path) -> None:
    users = tmp_path / "users.txt"
    file = tmp_path / "router.json5"
    users.write_text("lab:secret\n")
    file.write_text(ACCESS.replace("USERS", str(users)))
    endpoints = find_free_endpoints(1)
    router = ZenohBus(endpoints, mode="router", settings=read_zenoh_file(file).settings)
    members: list[ZenohBus] = []

    def enter(password: str) -> ZenohBus:
        member = tmp_path / "member.json5"
        member.write_text(
            f"{{transport: {{auth: {{usrpwd: {{user: 'lab', password: '{password}'}}}}}}}}"
        )
        members.append(ZenohBus([], endpoints, "client", read_zenoh_file(member).settings))
        return members[-1]

    try:
        with pytest.raises(RouterSilent, match="or no router accepts this member"):
            enter("guessed")
        with pytest.raises(RouterSilent):
            ZenohBus([], endpoints, "client")
        first = enter("secret")
        other = enter("secret")
        first.announce("trilat/lab/one/alive/1")
        first.respond("trilat/lab/one/ping", lambda sent: sent)
        assert until(other.presence("trilat/lab/*/alive/*").poll) == (
            "trilat/lab/one/alive/1",
            True,
        )
        assert until(lambda: query_once(other, "trilat/lab/*/ping")) == (
            "trilat/lab/one/ping",
            b"?",
        )
        elsewhere = other.inbox("trilat/elsewhere/state")
        publish = first.publisher("trilat/elsewhere/state")
        publish(b"not allowed")
        wait_for_meeting(first.publisher("trilat/lab/one/state"), other, "trilat/lab/one/state")
        publish(b"nor this")
        wait_for_meeting(first.publisher("trilat/lab/one/event"), other, "trilat/lab/one/event")
        assert elsewhere.poll() is None
    finally:
        for bus in (*members, router):
            bus.close()


@pytest.mark.long
def test_messages_travel_over_quic(tmp_path: Path) -> None:
    network = make_encrypted_mesh("quic", tmp_path)
    try:
        sender = network.join()
        receiver = network.join()
        inbox = receiver.inbox("t/a")
        publish = sender.publisher("t/a")
        wait_for_meeting(publish, receiver, "t/a")
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


@pytest.mark.long
def test_members_meet_again_through_restarted_routers(routed: Routed) -> None:
    first = routed.join()
    other = routed.join()
    first.announce("t/one/alive/1")
    presence = other.presence("t/*/alive/*")
    inbox = other.inbox("t/a")
    publish = first.publisher("t/a")
    first.respond("t/one/ping", lambda sent: sent)
    assert until(presence.poll) == ("t/one/alive/1", True)
    routed.restart()
    assert until(presence.poll) == ("t/one/alive/1", False)
    assert until(presence.poll) == ("t/one/alive/1", True)

    def heard() -> bool:
        publish(b"again")
        return inbox.poll() is not None

    until(heard)
    assert until(lambda: query_once(other, "t/*/ping")) == ("t/one/ping", b"?")


@pytest.mark.long
def test_connected_routers_are_one_network() -> None:
    endpoints = find_free_endpoints(2)
    routers = [
        ZenohBus(endpoints[:1], mode="router"),
        ZenohBus(endpoints[1:], endpoints[:1], "router"),
    ]
    members = [ZenohBus([], [endpoint], "client") for endpoint in endpoints]
    try:
        wait_for_meeting(members[0].publisher("t/a"), members[1], "t/a")
        wait_for_meeting(members[1].publisher("t/b"), members[0], "t/b")
    finally:
        for bus in (*members, *routers):
            bus.close()


def test_members_meet_at_a_private_socket(tmp_path: Path) -> None:
    """A Unix socket in a folder that no other user may enter, in place of a port of loopback."""
    endpoint = f"unixsock-stream/{tmp_path}/m1.sock"
    with closing(ZenohBus([endpoint])) as site, closing(ZenohBus([], [endpoint])) as peer:
        inbox = peer.inbox("trilat/x/m1/event")
        publish = site.publisher("trilat/x/m1/event")

        def arrived() -> bool:
            publish(b"1")
            return inbox.poll() is not None

        until(arrived)
    assert not Connection(listen=[endpoint]).unprotected_addresses

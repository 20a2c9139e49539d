"""The table of transports on docs/sessions/network.md: the samples that arrive over each, and
which transports are refused.
"""

from contextlib import closing
from pathlib import Path

import pytest

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.errors import UsageError
from trilat_net.net.connection import Connection
from trilat_net.net.member_keys import create_keys, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

from .waiting import until


def find_endpoint(transport: str, folder: Path) -> str:
    if transport == "unixsock-stream":
        return f"{transport}/{folder}/m1.sock"
    (endpoint,) = find_free_endpoints(1)
    return endpoint.replace("tcp", transport)


@pytest.mark.parametrize("transport", ["tls", "quic", "tcp", "ws", "unixsock-stream"])
def test_samples_arrive_over_each_transport(transport: str, tmp_path: Path) -> None:
    create_keys(tmp_path / "keys", ["m1", "m2"], [], 1)
    endpoint = find_endpoint(transport, tmp_path)
    with_keys = transport in ("tls", "quic")

    def connect(member: str, listen: list[str], others: list[str]) -> ZenohBus:
        keys = read_member_keys(tmp_path / "keys" / member) if with_keys else None
        stated = Connection(listen, others)
        safe = stated.secure(keys, insecure=False)
        return ZenohBus(safe.listen, others, settings=safe.settings)

    with (
        closing(connect("m1", [endpoint], [])) as m1,
        closing(connect("m2", [], [endpoint])) as m2,
    ):
        inbox = m2.inbox("trilat/x/m1/sample")
        publish = m1.publisher("trilat/x/m1/sample")

        def arrives() -> bool:
            publish(b"1")
            return inbox.poll() is not None

        until(arrives)


@pytest.mark.parametrize("transport", ["tcp", "ws", "tls", "quic"])
def test_without_keys_other_machines_need_insecure(transport: str) -> None:
    connection = Connection([f"{transport}/0.0.0.0:7447"], [])
    with pytest.raises(UsageError, match="anybody on that network"):
        connection.secure(None, insecure=False)
    assert connection.secure(None, insecure=True) == connection


@pytest.mark.parametrize("insecure", [False, True])
def test_udp_is_refused_even_on_loopback(insecure: bool) -> None:
    connection = Connection(["udp/127.0.0.1:7447"], [])
    with pytest.raises(UsageError, match=r"UDP is not supported.*use tcp, tls or quic"):
        connection.secure(None, insecure=insecure)

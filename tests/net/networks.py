"""The networks that keep the contract of `Bus`, behind one face for the tests."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from trilat_net.net.bus import Bus, LocalNetwork
from trilat_net.net.connection import find_free_endpoints
from trilat_net.net.zenoh_bus import ZenohBus, read_zenoh_file

from .certificates import Certificates
from .waiting import until

SEATS = 3


class Network(Protocol):
    def join(self) -> Bus:
        """The connection of a new member, which has met those before it."""

    def close(self) -> None:
        """All members leave."""


class Local:
    """Members of one process."""

    def __init__(self) -> None:
        self._network = LocalNetwork()

    def join(self) -> Bus:
        return self._network.join()

    def close(self) -> None:
        for member in list(self._network.members):
            member.close()


class Mesh:
    """A full mesh of Zenoh sessions on loopback, at most SEATS of them."""

    def __init__(self, protocol: str = "tcp", own: Mapping[str, Any] | None = None) -> None:
        self.own = own
        self._endpoints = [endpoint.replace("tcp", protocol) for endpoint in find_free_endpoints(SEATS)]
        self._members: list[Bus] = []

    def join(self) -> Bus:
        seat = len(self._members)
        bus = ZenohBus(self._endpoints[seat : seat + 1], self._endpoints[:seat], own=self.own)
        greet(bus, self._members)
        self._members.append(bus)
        return bus

    def close(self) -> None:
        for member in self._members:
            member.close()


class Routed:
    """Zenoh sessions that reach a router and nothing else."""

    def __init__(self) -> None:
        self._endpoints = find_free_endpoints(1)
        self._router = ZenohBus(self._endpoints, mode="router")
        self._members: list[Bus] = []

    def join(self) -> Bus:
        bus = ZenohBus([], self._endpoints, "client")
        greet(bus, self._members)
        self._members.append(bus)
        return bus

    def restart(self) -> None:
        """The router ends, and another one begins at its place."""
        self._router.close()
        self._router = ZenohBus(self._endpoints, mode="router")

    def close(self) -> None:
        for member in (*self._members, self._router):
            member.close()


def encrypted(protocol: str, folder: Path) -> Mesh:
    """A mesh whose members prove to each other who they are, by a person's own configuration."""
    made = Certificates(folder)
    file = folder / "zenoh.json5"
    file.write_text(
        f"""{{ // both sides show a certificate of the same authority
            transport: {{ link: {{ tls: {{
                root_ca_certificate: "{made.authority}",
                enable_mtls: true,
                listen_certificate: "{made.certificate}", listen_private_key: "{made.key}",
                connect_certificate: "{made.certificate}", connect_private_key: "{made.key}",
            }} }} }},
        }}"""
    )
    return Mesh(protocol, read_zenoh_file(file).settings)


def greet(newcomer: Bus, members: Sequence[Bus]) -> None:
    """Returns once a newcomer is heard by those who were there before."""
    greeting = newcomer.publisher("greeting")
    for member in members:
        meet(greeting, member, "greeting")


def meet(publish: Callable[[bytes], None], receiver: Bus, key: str) -> None:
    """Returns once what is published reaches a receiver."""
    inbox = receiver.inbox(key)

    def heard() -> bool:
        publish(b"")
        return inbox.poll() is not None

    until(heard)


NETWORKS: dict[str, Callable[[Path], Network]] = {
    "local": lambda _: Local(),
    "zenoh": lambda _: Mesh(),
    "router": lambda _: Routed(),
    "tls": lambda folder: encrypted("tls", folder),
}
"""All that keep the contract; each is made in a folder of its own."""

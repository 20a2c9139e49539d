"""The networks that fulfil the contract of `Bus`, with one interface for the tests."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.net.bus import Bus
from trilat_net.net.zenoh_bus import ZenohBus, read_zenoh_file

from .certificates import Certificates
from .local_bus import LocalNetwork
from .waiting import until

SEATS = 3


class Network(Protocol):
    def join(self) -> Bus:
        """Returns the connection of a new member, which has met the earlier members."""

    def close(self) -> None:
        """Closes all members."""


class Local:
    def __init__(self) -> None:
        self._network = LocalNetwork()

    def join(self) -> Bus:
        return self._network.join()

    def close(self) -> None:
        for member in list(self._network.members):
            member.close()


class Connected:
    def __init__(self) -> None:
        self._members: list[Bus] = []

    def _enter(self, bus: Bus) -> Bus:
        greet_members(bus, self._members)
        self._members.append(bus)
        return bus

    def close(self) -> None:
        for member in self._members:
            member.close()


class Mesh(Connected):
    def __init__(
        self, protocol: str = "tcp", settings: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.settings = settings
        self._endpoints = [
            endpoint.replace("tcp", protocol) for endpoint in find_free_endpoints(SEATS)
        ]

    def join(self) -> Bus:
        seat = len(self._members)
        return self._enter(
            ZenohBus(
                self._endpoints[seat : seat + 1], self._endpoints[:seat], settings=self.settings
            )
        )


class Routed(Connected):
    def __init__(self) -> None:
        super().__init__()
        self._endpoints = find_free_endpoints(1)
        self._router = ZenohBus(self._endpoints, mode="router")

    def join(self) -> Bus:
        return self._enter(ZenohBus([], self._endpoints, "client"))

    def restart(self) -> None:
        self._router.close()
        self._router = ZenohBus(self._endpoints, mode="router")

    def close(self) -> None:
        super().close()
        self._router.close()


def make_encrypted_mesh(protocol: str, folder: Path) -> Mesh:
    """Returns a mesh whose members authenticate each other, by a person's own configuration."""
    return Mesh(protocol, read_zenoh_file(Certificates(folder).zenoh_file()).settings)


def greet_members(newcomer: Bus, members: Sequence[Bus]) -> None:
    """Returns once the earlier members hear a newcomer."""
    greeting = newcomer.publisher("greeting")
    for member in members:
        wait_for_meeting(greeting, member, "greeting")


def wait_for_meeting(publish: Callable[[bytes], None], receiver: Bus, key: str) -> None:
    """Returns once published messages reach a receiver."""
    inbox = receiver.inbox(key)

    def heard() -> bool:
        publish(b"")
        return inbox.poll() is not None

    until(heard)


NETWORKS: dict[str, Callable[[Path], Network]] = {
    "local": lambda _: Local(),
    "zenoh": lambda _: Mesh(),
    "router": lambda _: Routed(),
    "tls": lambda folder: make_encrypted_mesh("tls", folder),
}
"""The networks that fulfil the contract; each one is created in its own folder."""

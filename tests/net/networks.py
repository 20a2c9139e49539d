"""The two networks that keep the contract of `Bus`, behind one face for the tests."""

from collections.abc import Callable
from typing import Protocol

from trilat_net.net.bus import Bus, LocalNetwork
from trilat_net.net.endpoints import free_endpoints
from trilat_net.net.zenoh_bus import ZenohBus

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


class Zenoh:
    """A full mesh of Zenoh sessions on loopback, at most SEATS of them."""

    def __init__(self) -> None:
        self._endpoints = free_endpoints(SEATS)
        self._members: list[Bus] = []

    def join(self) -> Bus:
        seat = len(self._members)
        bus = ZenohBus(self._endpoints[seat : seat + 1], self._endpoints[:seat])
        greeting = bus.publisher("greeting")
        for member in self._members:
            meet(greeting, member, "greeting")
        self._members.append(bus)
        return bus

    def close(self) -> None:
        for member in self._members:
            member.close()


def meet(publish: Callable[[bytes], None], receiver: Bus, key: str) -> None:
    """Returns once what is published reaches a receiver."""
    inbox = receiver.inbox(key)

    def heard() -> bool:
        publish(b"")
        return inbox.poll() is not None

    until(heard)


NETWORKS: dict[str, Callable[[], Network]] = {"local": Local, "zenoh": Zenoh}

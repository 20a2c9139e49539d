"""Computes the endpoints on which the sites of a session listen by default.

Two processes of a session on one machine find each other without any options, because each site
has a default port derived from the name of the session and the index of the site.

Invariant:
    - Default endpoints are only reachable from this machine (127.0.0.1).
    - Sessions with different names usually get different default ports, because the port is
      derived from a checksum of the name.
"""

import socket
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

_FIRST_PORT = 10_240
"""Lowest default port. The default ports are divided into blocks, one block per session."""
_BLOCKS = 340
"""Number of blocks. The block of a session is selected by the CRC-32 of its name."""
_BLOCK = 64
"""Number of ports in a block."""


@dataclass(frozen=True, slots=True)
class DefaultEndpoints:
    """Network addresses on which the sites of a session listen unless the user names others.

    The ports are computed from the name of the session and the index of the site, so every
    process can find the endpoints without configuration.

    Attributes:
        session: Name of the session.
    """

    session: str

    def of_site(self, index: int) -> str:
        """Returns the endpoint of one site on this machine, such as "tcp/127.0.0.1:10241".

        Args:
            index: Index of the site in the scenario, starting from 0.
        """
        # A checksum of the name selects one of `_BLOCKS` blocks of consecutive ports, so that
        # two sessions on one machine rarely get the same ports.
        block = zlib.crc32(self.session.encode()) % _BLOCKS
        port = _FIRST_PORT + block * _BLOCK + index % _BLOCK
        return f"tcp/127.0.0.1:{port}"

    def by_site(self, sites: Sequence[str], *, encrypted: bool = False) -> dict[str, str]:
        """Returns a mapping from the name of each site to its endpoint.

        Args:
            sites: Names of the sites, in scenario order.
            encrypted: True for TLS endpoints instead of TCP.
        """
        endpoints = {}
        for index, site in enumerate(sites):
            endpoint = self.of_site(index)
            endpoints[site] = endpoint.replace("tcp/", "tls/") if encrypted else endpoint
        return endpoints

    @contextmanager
    def reserve(self, site_count: int) -> Iterator[list[str]]:
        """Reserves a network endpoint for each site of the session, as a context manager.

        The default endpoints are used if they are free; otherwise any free ports are used.
        Inside the `with` block, other callers of this method get different endpoints, so two
        sessions with the same name can run at the same time.

        Args:
            site_count: Number of sites.

        Yields:
            One endpoint per site, in scenario order.
        """
        default = [self.of_site(index) for index in range(site_count)]
        ports = [int(endpoint.rpartition(":")[2]) for endpoint in default]
        # The last port of the block shows that the block is reserved. The ports themselves
        # cannot show it, because they are shared with the sites that will listen on them.
        first_port_of_block = ports[0] - ports[0] % _BLOCK
        last_port_of_block = first_port_of_block + _BLOCK - 1
        with ExitStack() as stack:
            try:
                _bind_ports(stack, [last_port_of_block], shared=False)
                endpoints = _bind_ports(stack, ports, shared=True)
            except OSError:
                endpoints = _bind_ports(stack, [0] * site_count, shared=True)
            yield endpoints


def _bind_ports(stack: ExitStack, ports: Sequence[int], *, shared: bool) -> list[str]:
    """Reserves ports of this machine for sites that will listen on them.

    A port is reserved by binding a socket to it without listening. The operating system then
    does not assign the port to programs that ask for any free port.

    Args:
        stack: Closes the sockets, which ends the reservation.
        ports: Numbers of the ports. 0 stands for any free port.
        shared: True if the site can listen on its port while the port is still reserved. False
            to reserve the port exclusively.

    Returns:
        The endpoints of the reserved ports, in the same order.

    Raises:
        OSError: A port is in use.
    """
    sockets = [stack.enter_context(socket.socket()) for _ in ports]
    for reserving_socket, port in zip(sockets, ports, strict=True):
        reserving_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(shared))
        reserving_socket.bind(("127.0.0.1", port))

    reserved_ports = [reserving_socket.getsockname()[1] for reserving_socket in sockets]
    return [f"tcp/127.0.0.1:{port}" for port in reserved_ports]

"""Where the members of a session listen, when nobody says otherwise.

Law: explicit loopback endpoints, a function of session and site, so that separate terminals find each
other and two sessions on one host do not.
"""

import socket
import zlib
from collections.abc import Sequence

_FIRST_PORT, _BLOCKS, _BLOCK = 10_240, 340, 64


def default_endpoint(session: str, index: int) -> str:
    """Returns where the site of that index in the scenario listens by default."""
    port = _FIRST_PORT + zlib.crc32(session.encode()) % _BLOCKS * _BLOCK + index % _BLOCK
    return f"tcp/127.0.0.1:{port}"


def default_endpoints(session: str, sites: Sequence[str]) -> dict[str, str]:
    """Returns where every site of a session listens by default."""
    return {site: default_endpoint(session, index) for index, site in enumerate(sites)}


def free_endpoints(count: int) -> list[str]:
    """Returns loopback endpoints whose ports nobody has at this moment."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for probe in sockets:
            probe.bind(("127.0.0.1", 0))
        return [f"tcp/127.0.0.1:{probe.getsockname()[1]}" for probe in sockets]
    finally:
        for probe in sockets:
            probe.close()

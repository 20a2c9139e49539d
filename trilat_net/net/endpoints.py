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


def session_endpoints(session: str, sites: Sequence[str]) -> list[str]:
    """Returns where the sites of a session may listen: by default, or elsewhere where a port is taken."""
    default = [default_endpoint(session, index) for index in range(len(sites))]
    return default if all(map(_is_free, default)) else free_endpoints(len(sites))


def _is_free(endpoint: str) -> bool:
    """True where nobody has the port of a loopback endpoint at this moment."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))
        except OSError:
            return False
    return True


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

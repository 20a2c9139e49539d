"""Rejects misspelt host names before a network connection is opened.

Zenoh, the library that transports the messages, keeps trying to reach a misspelt host forever
without reporting an error. `check_hosts` therefore resolves the host name of each endpoint (a
network address such as tcp/host:10241) without opening a connection. Endpoints that contain no
host name, such as numeric addresses and socket files, are not checked.
"""

import ipaddress
import re
import socket
from collections.abc import Iterable, Mapping

from ..errors import UsageError
from .zenoh_config import Endpoint

_ENDPOINT = re.compile(r"[a-z]+(?:/|://)(\[[^\]]*\]|[^/?#]*):\d+(?:[/?#].*)?")
"""Pattern that matches a Zenoh endpoint or a web address with a host and a port."""


class UnknownHost(UsageError):  # noqa: N818 - it names an outcome
    """Error: the host name of a network address cannot be resolved.

    The name may be misspelt, or the name service may be unreachable.
    """


def find_endpoint_addresses(endpoints: Iterable[Endpoint]) -> list[str]:
    """Returns the addresses of endpoints as strings, including those of grouped endpoints.

    A user's Zenoh file may group several addresses into one endpoint, which is then a table
    with the key "locators".

    Args:
        endpoints: Endpoints as strings, or as tables with the key "locators".

    Returns:
        All addresses, in the order of the endpoints.
    """
    addresses: list[str] = []
    for endpoint in endpoints:
        locators = endpoint.get("locators", ()) if isinstance(endpoint, Mapping) else [endpoint]
        if isinstance(locators, str):
            addresses.append(locators)
        else:
            addresses += map(str, locators)
    return addresses


def check_hosts(endpoints: Iterable[Endpoint]) -> None:
    """Raises UnknownHost if the host name of an endpoint cannot be resolved.

    The check comes before any connection is opened, since Zenoh would retry an unknown name
    forever. IP addresses are not checked.

    Args:
        endpoints: Endpoints such as tcp/arm.example:7447, web addresses such as
            tcp://arm.example:8786, or tables that group several endpoints.

    Raises:
        UnknownHost: A host name cannot be resolved. The error names the first endpoint with
            this problem.
    """
    for address in find_endpoint_addresses(endpoints):
        match = _ENDPOINT.fullmatch(address)
        host = "" if match is None else match[1].strip("[]")
        if host and not _is_address(host):
            _resolve(host, address)


def _is_address(host: str) -> bool:
    """Returns True if a host is a numeric address, for example 127.0.0.1 or fe80::1%eth0.

    Numeric addresses do not require a name service lookup, which could take seconds.
    """
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def _resolve(host: str, endpoint: str) -> None:
    """Raises UnknownHost if the host name of an endpoint cannot be resolved.

    Args:
        host: The host name.
        endpoint: Endpoint that contains the host name, for the error message.

    Raises:
        UnknownHost: The host name cannot be resolved.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        # UnicodeError: a part of the name is empty or too long.
        reason = getattr(error, "strerror", None) or "this is not a valid host name"
        raise UnknownHost(
            f"{endpoint}: the host name {host!r} does not resolve ({reason}): "
            "correct it, or give an address"
        ) from None

"""Host names of endpoints, resolved before anything connects: Zenoh would try a misspelt name
for ever.

Invariant: what names no host (an address in digits, a socket file) is passed over, and nothing
connects here.
"""

import ipaddress
import re
import socket
from collections.abc import Iterable

from ..errors import UsageError

_PLACE = re.compile(r"[a-z]+(?:/|://)(\[[^\]]*\]|[^/?#]*):\d+(?:[/?#].*)?")
"""An endpoint of Zenoh or an address of the web, with a host and a port."""


class UnknownHost(UsageError):  # noqa: N818 - it names an outcome
    """An endpoint whose host name does not resolve."""


def check_hosts(places: Iterable[str]) -> None:
    """Refuses endpoints whose host name does not resolve.

    Args:
        places: endpoints as in tcp/arm.example:7447 and addresses as in tcp://arm.example:8786.

    Raises:
        UnknownHost: with the endpoint, the name and the resolver's reason.
    """
    for place in places:
        found = _PLACE.fullmatch(place)
        host = "" if found is None else found[1].strip("[]")
        if host and not _is_address(host):
            _resolve(host, place)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def _resolve(host: str, place: str) -> None:
    try:
        socket.getaddrinfo(host, None)
    except (
        OSError,
        UnicodeError,
    ) as error:  # UnicodeError: a part of the name is empty or too long
        reason = getattr(error, "strerror", None) or "it is no host name"
        raise UnknownHost(
            f"{place}: the host name {host!r} does not resolve ({reason}): correct it, or give an address"
        ) from None

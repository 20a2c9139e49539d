"""Check of the host names in endpoints, before anything connects.

Zenoh would try to connect to a misspelt host name for ever.

Invariant:
    - Endpoints without a host name, such as numeric addresses and socket files, are skipped.
    - Nothing connects here.
"""

import ipaddress
import re
import socket
from collections.abc import Iterable

from ..errors import UsageError

_ENDPOINT = re.compile(r"[a-z]+(?:/|://)(\[[^\]]*\]|[^/?#]*):\d+(?:[/?#].*)?")
"""Pattern of a Zenoh endpoint, or of a web address, with a host and a port."""


class UnknownHost(UsageError):  # noqa: N818 - it names an outcome
    """An endpoint whose host name does not resolve."""


def check_hosts(endpoints: Iterable[str]) -> None:
    """Refuses endpoints whose host name does not resolve.

    Args:
        endpoints: endpoints like tcp/arm.example:7447, or addresses like
            tcp://arm.example:8786.

    Raises:
        UnknownHost: a host name does not resolve.
    """
    for endpoint in endpoints:
        match = _ENDPOINT.fullmatch(endpoint)
        host = "" if match is None else match[1].strip("[]")
        if host and not _is_address(host):
            _resolve(host, endpoint)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True


def _resolve(host: str, endpoint: str) -> None:
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        # UnicodeError: a part of the name is empty or too long.
        reason = getattr(error, "strerror", None) or "it is no host name"
        raise UnknownHost(
            f"{endpoint}: the host name {host!r} does not resolve ({reason}): "
            "correct it, or give an address"
        ) from None

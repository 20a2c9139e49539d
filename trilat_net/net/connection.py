"""A member's connection to the network, and the router process.

A connection has endpoints and a mode; opening it returns the bus.

Invariant:
    - Default endpoints are explicit loopback addresses. They are a function of session and
      site, so that separate terminals find each other and two sessions on one host do not.
    - A named endpoint replaces the defaults. Values on the command line and in a file are
      united or refused; the program never chooses between them.
    - A router forwards Zenoh traffic, and prints which members join and leave.
"""

import ipaddress
import math
import re
import socket
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SessionError, UsageError
from . import topics
from .bus import Bus
from .clock import Clock
from .host_names import UnknownHost, check_hosts
from .zenoh_bus import RouterSilent, ZenohBus
from .zenoh_config import Endpoint, ZenohFile, ZenohMode, merge_settings

if TYPE_CHECKING:
    from .member_keys import MemberKeys

_FIRST_PORT = 10_240
_BLOCKS = 340
_BLOCK = 64
"""Number of ports in a block; a session has the block that the CRC-32 of its name selects."""


def default_endpoint(session: str, index: int) -> str:
    """Returns the default endpoint of a site by its index in the scenario."""
    port = _FIRST_PORT + zlib.crc32(session.encode()) % _BLOCKS * _BLOCK + index % _BLOCK
    return f"tcp/127.0.0.1:{port}"


def default_endpoints(
    session: str, sites: Sequence[str], *, encrypted: bool = False
) -> dict[str, str]:
    """Returns the default endpoint of every site of a session."""
    endpoints = {}
    for index, site in enumerate(sites):
        endpoint = default_endpoint(session, index)
        endpoints[site] = endpoint.replace("tcp/", "tls/") if encrypted else endpoint
    return endpoints


@contextmanager
def reserve_session_endpoints(session: str, sites: Sequence[str]) -> Iterator[list[str]]:
    """Yields endpoints for the sites of a session: the defaults, or else free ones.

    Inside the block, other callers of this function get other endpoints.
    """
    default = list(default_endpoints(session, sites).values())
    ports = [int(endpoint.rpartition(":")[2]) for endpoint in default]
    with ExitStack() as stack:
        try:
            _bind_ports(stack, [ports[0] - ports[0] % _BLOCK + _BLOCK - 1], shared=False)
            chosen = _bind_ports(stack, ports, shared=True)
        except OSError:
            chosen = _bind_ports(stack, [0] * len(sites), shared=True)
        yield chosen


def find_free_endpoints(count: int) -> list[str]:
    """Returns loopback endpoints whose ports are free at present."""
    with ExitStack() as stack:
        return _bind_ports(stack, [0] * count, shared=False)


def _bind_ports(stack: ExitStack, ports: Sequence[int], *, shared: bool) -> list[str]:
    """Binds loopback ports until the stack is closed, and returns their endpoints.

    Args:
        stack: closes the sockets.
        ports: the ports; 0 stands for any free port.
        shared: True if another program may listen at the ports meanwhile.

    Raises:
        OSError: a port is in use.
    """
    sockets = [stack.enter_context(socket.socket()) for _ in ports]
    for probe, port in zip(sockets, ports, strict=True):
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(shared))
        probe.bind(("127.0.0.1", port))
    return [f"tcp/127.0.0.1:{probe.getsockname()[1]}" for probe in sockets]


ENDS_SOON = timedelta(days=7)
"""Time before the end of keys from which on the user is warned."""
DATE = "%Y-%m-%d %H:%M:%S UTC"
RETRY_NS = 200_000_000
"""Time between two attempts to reach a router, in ns."""


@dataclass(frozen=True, slots=True)
class Connection:
    """Endpoints and mode of a member.

    Attributes:
        listen: endpoints at which the member listens.
        connect: endpoints to which the member connects; a client uses the first one that
            answers. None if the endpoints are still to be found.
        mode: "peer" of the other members, "client" of a router, or "router".
        settings: Zenoh settings of a user's file, or of a member's keys.
        keys_of: the member whose keys the connection uses; "" without keys. With keys, links
            are encrypted, and both ends prove their identities by certificates.
        keys_end: end of the validity of these keys, in UTC; None without keys.
    """

    listen: Sequence[Endpoint] = ()
    connect: Sequence[Endpoint] | None = ()
    mode: ZenohMode = "peer"
    settings: Mapping[str, Any] = field(default_factory=dict)
    keys_of: str = ""
    keys_end: datetime | None = None

    def reach(self, endpoints: Sequence[Endpoint]) -> list[Endpoint]:
        """Returns endpoints as this member opens them: with keys, TLS replaces TCP."""
        if not self.keys_of:
            return list(endpoints)
        return [
            re.sub("^tcp/", "tls/", endpoint) if isinstance(endpoint, str) else endpoint
            for endpoint in endpoints
        ]

    def open(self) -> ZenohBus:
        """Opens the connection; see `ZenohBus`.

        Raises:
            UnknownHost: a host name does not resolve. Zenoh would try to resolve it for ever.
        """
        listen = self.reach(self.listen)
        connect = self.reach(self.connect or ())
        check_hosts(find_endpoint_addresses([*listen, *connect]))
        return ZenohBus(listen, connect, self.mode, self.settings)

    def require_keys_until(self, left_s: float) -> None:
        """Refuses keys that end before a session does.

        An open link outlives the end of its certificate, but no link can be opened after that:
        a cable that is pulled for six seconds would then end the session.

        Args:
            left_s: remaining duration of the session, in s.

        Raises:
            UsageError: the keys end before the session.
        """
        if self.keys_end is None:
            return
        planned_end = datetime.now(UTC) + timedelta(seconds=left_s)
        if self.keys_end <= planned_end:
            raise UsageError(
                f"--keys: the keys of {self.keys_of} end on {self.keys_end:{DATE}}, and the "
                f"session is planned until {planned_end:{DATE}}: renew them with "
                "trilat keys renew (docs/network.md)"
            )

    def describe_end(self) -> str:
        """Returns a sentence if the keys end soon, else ""."""
        if self.keys_end is None or self.keys_end - datetime.now(UTC) > ENDS_SOON:
            return ""
        remedy = "renew them with trilat keys renew (docs/network.md)"
        return f"the keys of {self.keys_of} end on {self.keys_end:{DATE}}: {remedy}"

    def require(self, member: str) -> "Connection":
        """Returns this connection if it may be used by a member.

        Raises:
            UsageError: the connection uses the keys of another member.
        """
        if self.keys_of not in ("", member):
            raise UsageError(
                f"--keys: these are the keys of {self.keys_of}; the keys of {member} are needed"
            )
        return self


def secure_connection(
    connection: Connection, keys: "MemberKeys | str | Path | None", *, insecure: bool
) -> Connection:
    """Returns a connection with a member's keys, or checks that it is safe without keys.

    Args:
        connection: the connection.
        keys: a member's keys, or the folder of these; None for no keys.
        insecure: True to accept endpoints that other machines reach without keys.

    Raises:
        UsageError: an endpoint is not encrypted, or other machines reach it without keys; or
            the user's settings contradict the keys; or the keys cannot be used.
    """
    if isinstance(keys, str | Path):
        from .member_keys import read_member_keys  # loads the cryptography package

        keys = read_member_keys(keys)
    endpoints = (*connection.listen, *(connection.connect or ()))
    addresses = find_endpoint_addresses(endpoints)
    for address in addresses:
        if address.startswith("udp/"):
            raise UsageError(
                f"{address}: UDP loses, repeats and trusts everything: use tcp, tls or quic"
            )
    if keys is None:
        _check_open_endpoints(connection, insecure=insecure)
        return connection
    for address in addresses:
        _check_encrypted_endpoint(address)
    _check_settings_without_keys(connection.settings)
    return replace(
        connection,
        settings=merge_settings(keys.settings, connection.settings),
        keys_of=keys.member,
        keys_end=keys.ends,
    )


def _check_encrypted_endpoint(address: str) -> None:
    """Refuses an endpoint that is not encrypted, or states how it is encrypted."""
    if not address.startswith(ENCRYPTED):
        raise UsageError(
            f"{address}: with --keys an endpoint is encrypted: tls/HOST:PORT or quic/HOST:PORT"
        )
    if re.search(r"[#;](?!(iface|bind|dscp)=|so_)", address):
        raise UsageError(
            f"{address}: how it is encrypted comes from --keys; leave out what follows the #"
        )


def _check_settings_without_keys(settings: Mapping[str, Any]) -> None:
    """Refuses user settings that the keys set as well."""
    for name in sorted(set(settings) & {"access_control", "low_pass_filter", "adminspace"}):
        raise UsageError(f"--zenoh-config: {name}: comes from --keys; give it in one place")
    link_settings = settings.get("transport", {}).get("link", {})
    for name in sorted(set(link_settings) & {"tls", "protocols"}):
        raise UsageError(
            f"--zenoh-config: transport/link/{name}: comes from --keys; give it in one place"
        )


def _check_open_endpoints(connection: Connection, *, insecure: bool) -> None:
    """Refuses endpoints without keys that other machines reach, unless `insecure`."""
    link_settings = connection.settings.get("transport", {}).get("link", {})
    has_mutual_tls = link_settings.get("tls", {}).get("enable_mtls") is True
    for address in find_endpoint_addresses(connection.listen):
        is_certified = has_mutual_tls and address.startswith(ENCRYPTED)
        if not (insecure or is_loopback(address) or is_certified):
            raise UsageError(
                f"--listen {address}: anybody on that network could take part: give "
                "--keys DIR (make them with trilat keys new), or --insecure where you trust "
                "everybody on it"
            )


ENCRYPTED = ("tls/", "quic/")


def find_endpoint_addresses(endpoints: Sequence[Endpoint]) -> list[str]:
    """Returns the addresses of endpoints, including those in Zenoh's groups of locators."""
    addresses: list[str] = []
    for endpoint in endpoints:
        locators = endpoint.get("locators", ()) if isinstance(endpoint, Mapping) else [endpoint]
        if isinstance(locators, str):
            addresses.append(locators)
        else:
            addresses += map(str, locators)
    return addresses


def is_loopback(address: str) -> bool:
    """True if other machines cannot reach an address."""
    protocol, _, rest = address.partition("/")
    host = re.split(r"[?#]", rest)[0].rpartition(":")[0].strip("[]")
    if protocol.startswith("unix") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def resolve_member_connection(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    routers: Sequence[str] | None,
    file: ZenohFile | None = None,
    listen_else: Sequence[str] = (),
    connect_else: Sequence[str] | None = None,
    *,
    routes: bool = False,
) -> Connection:
    """Returns the connection of a member or a tool by the command line and a user's file.

    With a router, named by `--router` or by a file of mode "client", a member listens nowhere
    and connects only to the router.

    Args:
        listen: endpoints of --listen; None without the option.
        connect: endpoints of --connect; None without the option.
        routers: endpoints of --router; None without the option.
        file: the user's Zenoh configuration.
        listen_else: endpoints at which to listen if neither an option nor the file names any.
        connect_else: endpoints to which to connect if neither an option nor the file names any.
        routes: True for the connection of a router.

    Raises:
        UsageError: options and file contradict each other.
    """
    file = file or ZenohFile("")
    if routes:
        if file.mode not in ("", "router"):
            raise UsageError(f"{file.source}: mode: {file.mode} must be router here")
        return _join_options(
            listen=listen,
            connect=connect,
            file=file,
            mode="router",
            listen_else=listen_else,
            connect_else=(),
        )
    if file.mode == "router":
        raise UsageError(
            f"{file.source}: mode: router is for `trilat router`; here it is peer or client"
        )
    if not routers and file.mode != "client":
        return _join_options(
            listen=listen,
            connect=connect,
            file=file,
            mode="peer",
            listen_else=listen_else,
            connect_else=connect_else,
        )
    client_source = "--router" if routers else f"{file.source}: mode: client"
    if routers and file.mode == "peer":
        raise UsageError(
            f"{file.source}: mode: peer contradicts --router, which makes a client"
        )
    if listen is not None or file.endpoints("listen", "client"):
        raise UsageError(
            f"{client_source}: a client of a router listens nowhere; "
            "leave out the endpoints to listen at"
        )
    if routers and connect is not None:
        raise UsageError("--router: a client connects to a router only; leave out --connect")
    for endpoint in routers or ():
        if not re.fullmatch(
            r"(tcp|tls|quic|udp|ws)/[^/]+:\d+([?#].*)?|unixsock-stream/.+", endpoint
        ):
            raise UsageError(
                f"--router: an endpoint is like tcp/192.0.2.1:7447, not {endpoint!r}"
            )
    endpoints = _merge_endpoints(routers or connect, file, "client", ())
    if not endpoints:
        raise UsageError(
            f"{client_source}: there is no router to connect to; name it with --router"
        )
    return Connection((), endpoints, "client", file.settings)


def _join_options(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    listen_else: Sequence[str],
    connect_else: Sequence[str] | None,
) -> Connection:
    """Returns the connection of a peer or a router; see `resolve_member_connection`."""
    file_listen = file.endpoints("listen", mode)
    if listen is not None and file_listen is not None:
        raise UsageError(
            f"{file.source}: listen/endpoints: given by --listen too; give them in one place"
        )
    listening = file_listen if listen is None else listen
    if listening is None:
        listening = listen_else
    connected = _merge_endpoints(connect, file, mode, connect_else)
    return Connection(listening, connected, mode, file.settings)


def _merge_endpoints(
    named: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    otherwise: Sequence[str] | None,
) -> Sequence[Endpoint] | None:
    """Returns the endpoints of options and file to which to connect, each once."""
    file_endpoints = file.endpoints("connect", mode)
    if named is None and file_endpoints is None:
        return otherwise
    endpoints: list[Endpoint] = list(named or ())
    more = [endpoint for endpoint in file_endpoints or () if endpoint not in endpoints]
    return endpoints + more


def open_bus(
    connection: Connection,
    clock: Clock,
    stopped: Callable[[], bool],
    timeout_s: float | None,
    say: Callable[[str], None],
) -> ZenohBus | None:
    """Opens a connection whose `connect` is known, and waits for a router.

    Args:
        connection: the connection.
        clock: clock of the caller.
        stopped: returns True to give up.
        timeout_s: time to wait for a router, in s; None for no limit.
        say: receives messages for the user.

    Returns:
        The bus; None if `stopped` before a router answers.

    Raises:
        UsageError: an endpoint cannot be used.
        UnknownHost: a host name does not resolve at the first attempt. Later attempts may fail
            while the name service is away.
        SessionError: no router answered in time.
    """
    begun_ns = clock.monotonic_ns()
    has_reported = False
    while not stopped():
        try:
            return connection.open()
        except UnknownHost:
            if not has_reported:
                raise
        except RouterSilent as silent:
            if timeout_s is not None and clock.monotonic_ns() - begun_ns >= timeout_s * 1e9:
                raise SessionError(f"{silent} within {timeout_s:g} s") from None
            if not has_reported:
                say(f"{silent} yet; trying again")
            has_reported = True
        clock.sleep_until(clock.monotonic_ns() + RETRY_NS)
    return None


ROUTER_POLL_NS = 50_000_000


def run_router(
    bus: Bus,
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    until_idle_s: float | None = None,
) -> None:
    """Runs a router until `stopped`, or until `until_idle_s` after the last member has left."""
    presence = bus.presence(topics.presence_key("*", "*"))
    present: set[topics.KeyParts] = set()
    idle_ns = math.inf if until_idle_s is None else until_idle_s * 1e9
    empty_since_ns: int | None = None  # None before the first member
    while not stopped():
        for parts, is_alive in topics.read_presence(presence):
            if is_alive == (parts in present):
                continue
            if is_alive:
                present.add(parts)
            else:
                present.remove(parts)
            change = "is here" if is_alive else "has left"
            say(f"session {parts.session}: {parts.member} {change}")
            empty_since_ns = None if present else clock.monotonic_ns()
        now_ns = clock.monotonic_ns()
        if empty_since_ns is not None and now_ns - empty_since_ns >= idle_ns:
            say(f"no member for {until_idle_s:g} s")
            return
        clock.sleep_until(now_ns + ROUTER_POLL_NS)

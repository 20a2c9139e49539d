"""A member's connection to the network: endpoints, mode, the opened bus; and the router
process.

Invariant: default endpoints are explicit loopback addresses, a function of session and site, so
that separate terminals meet and two sessions on one host do not. A named endpoint replaces the
defaults; values given both on the command line and in a file are united or refused, never
chosen between. A router carries Zenoh traffic and prints who joins and leaves; it adds no
routing of its own.
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


def default_endpoint(session: str, index: int) -> str:
    """Returns the default endpoint of a site by its index in the scenario."""
    port = _FIRST_PORT + zlib.crc32(session.encode()) % _BLOCKS * _BLOCK + index % _BLOCK
    return f"tcp/127.0.0.1:{port}"


def default_endpoints(
    session: str, sites: Sequence[str], *, encrypted: bool = False
) -> dict[str, str]:
    """Returns the default endpoint of every site of a session."""
    places = {site: default_endpoint(session, index) for index, site in enumerate(sites)}
    return {
        site: place.replace("tcp/", "tls/") if encrypted else place
        for site, place in places.items()
    }


@contextmanager
def reserve_session_endpoints(session: str, sites: Sequence[str]) -> Iterator[list[str]]:
    """Yields endpoints for the sites of a session: the defaults, or free ones if these are
    taken.

    Others who choose in this way get other endpoints, from here to the end of the block.
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
    """Returns loopback endpoints whose ports are free now."""
    with ExitStack() as stack:
        return _bind_ports(stack, [0] * count, shared=False)


def _bind_ports(stack: ExitStack, ports: Sequence[int], *, shared: bool) -> list[str]:
    """Binds loopback ports, of which 0 stands for any, until the stack ends; returns their
    endpoints.

    A shared one can be listened at meanwhile. Raises OSError.
    """
    sockets = [stack.enter_context(socket.socket()) for _ in ports]
    for probe, port in zip(sockets, ports, strict=True):
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(shared))
        probe.bind(("127.0.0.1", port))
    return [f"tcp/127.0.0.1:{probe.getsockname()[1]}" for probe in sockets]


ENDS_SOON = timedelta(days=7)
DATE = "%Y-%m-%d %H:%M:%S UTC"
RETRY_NS = 200_000_000
"""Between two attempts to reach a router."""


@dataclass(frozen=True, slots=True)
class Connection:
    """Endpoints and mode of a member.

    Attributes:
        connect: endpoints to connect to; a client takes the first that answers. None: still to
            be found.
        mode: peer of the other members, client of a router, or a router.
        settings: Zenoh settings of a user's file, or of a member's keys.
        keys_of: the member whose keys it has: links are encrypted, and both ends prove by
            certificates who they are; "": none.
        keys_end: when these keys end, in UTC; None: there are none.
    """

    listen: Sequence[Endpoint] = ()
    connect: Sequence[Endpoint] | None = ()
    mode: ZenohMode = "peer"
    settings: Mapping[str, Any] = field(default_factory=dict)
    keys_of: str = ""
    keys_end: datetime | None = None

    def reach(self, endpoints: Sequence[Endpoint]) -> list[Endpoint]:
        """Returns endpoints as this member opens them: with keys, the defaults over TLS."""
        if not self.keys_of:
            return list(endpoints)
        return [
            re.sub("^tcp/", "tls/", one) if isinstance(one, str) else one for one in endpoints
        ]

    def open(self) -> ZenohBus:
        """Opens it; see `ZenohBus`.

        Raises:
            UnknownHost: an endpoint names a host that does not resolve, which Zenoh would try
                for ever.
        """
        listen, connect = (self.reach(side or ()) for side in (self.listen, self.connect))
        check_hosts(find_endpoint_addresses([*listen, *connect]))
        return ZenohBus(listen, connect, self.mode, self.settings)

    def require_keys_until(self, left_s: float) -> None:
        """Refuses keys that end before a session does.

        An open link outlives the end of its certificate, but no link is made again after it: a
        cable that is pulled for six seconds would end the session then.

        Args:
            left_s: how long the session lasts from now on, s.

        Raises:
            UsageError: the keys end before.
        """
        if self.keys_end is None or self.keys_end > (
            planned := datetime.now(UTC) + timedelta(seconds=left_s)
        ):
            return
        raise UsageError(
            f"--keys: the keys of {self.keys_of} end on {self.keys_end:{DATE}}, and the session is planned "
            f"until {planned:{DATE}}: renew them with trilat keys renew (docs/network.md)"
        )

    def describe_end(self) -> str:
        """Returns a sentence on keys that end soon, "" for others."""
        if self.keys_end is None or self.keys_end - datetime.now(UTC) > ENDS_SOON:
            return ""
        remedy = "renew them with trilat keys renew (docs/network.md)"
        return f"the keys of {self.keys_of} end on {self.keys_end:{DATE}}: {remedy}"

    def require(self, member: str) -> "Connection":
        """Returns itself.

        Raises:
            UsageError: it has the keys of another member than this.
        """
        if self.keys_of not in ("", member):
            raise UsageError(
                f"--keys: these are the keys of {self.keys_of}, and this takes those of {member}"
            )
        return self


def secure_connection(
    connection: Connection, keys: "MemberKeys | str | Path | None", *, insecure: bool
) -> Connection:
    """Returns a connection with a member's keys, or those of a folder; else it must not be open
    to a network.

    Raises:
        UsageError: an endpoint is not encrypted, or reached from other machines without keys,
            the user's own settings contradict the keys, or these cannot be used.
    """
    if isinstance(keys, str | Path):
        from .member_keys import read_member_keys  # loads what makes certificates

        keys = read_member_keys(keys)
    own = connection.settings
    named = (*connection.listen, *(connection.connect or ()))
    if udp := [place for place in find_endpoint_addresses(named) if place.startswith("udp/")]:
        raise UsageError(
            f"{udp[0]}: UDP loses, repeats and trusts everything: use tcp, tls or quic"
        )
    if keys is not None:
        for place in find_endpoint_addresses(named):
            if not place.startswith(ENCRYPTED):
                raise UsageError(
                    f"{place}: with --keys an endpoint is encrypted: tls/HOST:PORT or quic/HOST:PORT"
                )
            if re.search(r"[#;](?!(iface|bind|dscp)=|so_)", place):
                raise UsageError(
                    f"{place}: how it is encrypted comes from --keys; leave out what follows the #"
                )
        if twice := sorted(set(own) & {"access_control", "low_pass_filter", "adminspace"}):
            raise UsageError(
                f"--zenoh-config: {twice[0]}: comes from --keys; give it in one place"
            )
        if twice := sorted(
            set(own.get("transport", {}).get("link", {})) & {"tls", "protocols"}
        ):
            raise UsageError(
                f"--zenoh-config: transport/link/{twice[0]}: comes from --keys; give it in one place"
            )
        return replace(
            connection,
            settings=merge_settings(keys.settings, own),
            keys_of=keys.member,
            keys_end=keys.ends,
        )
    mutual = own.get("transport", {}).get("link", {}).get("tls", {}).get("enable_mtls") is True
    for place in find_endpoint_addresses(connection.listen):
        if not (insecure or is_loopback(place) or (mutual and place.startswith(ENCRYPTED))):
            raise UsageError(
                f"--listen {place}: anybody on that network could take part: give --keys DIR (make them with "
                "trilat keys new), or --insecure where you trust everybody on it"
            )
    return connection


ENCRYPTED = ("tls/", "quic/")


def find_endpoint_addresses(endpoints: Sequence[Endpoint]) -> list[str]:
    """Returns the addresses of endpoints, those of Zenoh's groups of locators too."""
    addresses: list[str] = []
    for one in endpoints:
        stated = one.get("locators", ()) if isinstance(one, Mapping) else [one]
        addresses += [stated] if isinstance(stated, str) else map(str, stated)
    return addresses


def is_loopback(address: str) -> bool:
    """True if nobody on another machine reaches an address."""
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
    """Returns the connection of a site, a recorder or a tool; or of a router, which `routes`.

    With a router, named by `--router` or by a file of mode "client", a member listens nowhere
    and connects to nothing else. `listen_else` and `connect_else` hold where neither an option
    nor the file names endpoints.

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
    where = "--router" if routers else f"{file.source}: mode: client"
    if routers and file.mode == "peer":
        raise UsageError(
            f"{file.source}: mode: peer contradicts --router, which makes a client"
        )
    if listen is not None or file.endpoints("listen", "client"):
        raise UsageError(
            f"{where}: a client of a router listens nowhere; leave out the endpoints to listen at"
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
    chosen = _merge_endpoints(routers or connect, file, "client", ())
    if not chosen:
        raise UsageError(f"{where}: there is no router to connect to; name it with --router")
    return Connection((), chosen, "client", file.settings)


def _join_options(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    listen_else: Sequence[str],
    connect_else: Sequence[str] | None,
) -> Connection:
    stated = file.endpoints("listen", mode)
    if listen is not None and stated is not None:
        raise UsageError(
            f"{file.source}: listen/endpoints: given by --listen too; give them in one place"
        )
    named = stated if listen is None else listen
    connected = _merge_endpoints(connect, file, mode, connect_else)
    return Connection(listen_else if named is None else named, connected, mode, file.settings)


def _merge_endpoints(
    named: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    otherwise: Sequence[str] | None,
) -> Sequence[Endpoint] | None:
    stated = file.endpoints("connect", mode)
    if named is None and stated is None:
        return otherwise
    first: list[Endpoint] = list(named or ())
    return first + [endpoint for endpoint in stated or () if endpoint not in first]


def open_bus(
    connection: Connection,
    clock: Clock,
    stopped: Callable[[], bool],
    timeout_s: float | None,
    say: Callable[[str], None],
) -> ZenohBus | None:
    """Opens a connection whose `connect` is known; returns None if `stopped` before the router
    answers.

    It waits for a router for `timeout_s`, or for ever, and says so.

    Raises:
        UsageError: an endpoint cannot be used.
        UnknownHost: a host name does not resolve at the first attempt; later on it may be away
            for a while.
        SessionError: no router answered in time.
    """
    begun_ns = clock.monotonic_ns()
    printed = False
    while not stopped():
        try:
            return connection.open()
        except UnknownHost:
            if not printed:
                raise
        except RouterSilent as silent:
            if timeout_s is not None and clock.monotonic_ns() - begun_ns >= timeout_s * 1e9:
                raise SessionError(f"{silent} within {timeout_s:g} s") from None
            if not printed:
                say(f"{silent} yet; trying again")
            printed = True
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
    """Runs a router until `stopped`, or until the last member has left `until_idle_s` ago."""
    presence = bus.presence(topics.presence_key("*", "*"))
    present: set[topics.KeyParts] = set()
    idle_ns = math.inf if until_idle_s is None else until_idle_s * 1e9
    empty_since_ns: int | None = None  # None before the first member
    while not stopped():
        for parts, alive in topics.read_presence(presence):
            if alive == (parts in present):
                continue
            (present.add if alive else present.remove)(parts)
            say(f"session {parts.session}: {parts.member} {'is here' if alive else 'has left'}")
            empty_since_ns = None if present else clock.monotonic_ns()
        now_ns = clock.monotonic_ns()
        if empty_since_ns is not None and now_ns - empty_since_ns >= idle_ns:
            say(f"no member for {until_idle_s:g} s")
            return
        clock.sleep_until(now_ns + ROUTER_POLL_NS)

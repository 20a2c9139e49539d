"""Decides how a process connects to the network of a session.

On one machine, the sites of a session listen on default endpoints (`default_endpoints`). If the
session spans several machines, the user names the endpoints, for example tcp/host:10241. A
`Connection` holds the endpoints on which a process listens and to which it connects, its mode
and, optionally, the keys that prove its identity. `Connection.of_member` builds one from the
command line and the user's Zenoh file.

Programs that are not (yet) part of a session find it with `Connection.open_session`: the
recorder before it joins, and the commands that stop arms, change network delays or measure the
network.

Invariant:
    - Other machines cannot connect unless the user names an endpoint.
    - An endpoint named by the user replaces the default. If the command line and the file name
      different endpoints, they are either combined or rejected; neither is silently preferred.
"""

import ipaddress
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import ScenarioError, SessionError, UsageError
from . import topics
from .bus import Bus
from .clock import Clock
from .default_endpoints import DefaultEndpoints
from .host_names import UnknownHost, check_hosts, find_endpoint_addresses
from .known_sites import find_known_endpoints
from .zenoh_bus import RouterSilent, ZenohBus, read_zenoh_file
from .zenoh_config import Endpoint, ZenohFile, ZenohMode, merge_settings

if TYPE_CHECKING:
    from .member_keys import MemberKeys

ENDS_SOON = timedelta(days=7)
"""The user is warned if the keys expire within this time."""
_DATE = "%Y-%m-%d %H:%M:%S UTC"
"""Format of the expiry date in messages to the user."""
RETRY_NS = 200_000_000
"""Time between two attempts to reach a router, in ns."""

SiteNamesOf = Callable[[str], tuple[str, ...]]
"""Function that returns the names of the sites from the text of a scenario, in scenario order.

It raises `ScenarioError` if the text is not a scenario.
"""


@dataclass(frozen=True, slots=True)
class Connection:
    """Describes how a process connects to the network of a session: endpoints, mode and keys.

    Attributes:
        listen: Endpoints on which the process listens.
        connect: Endpoints to which the process connects. A client uses the first one that
            answers. None if the endpoints are not known yet and have to be found.
        mode: "peer" connects directly to the other members, "client" connects to a router, and
            "router" acts as a router.
        settings: Zenoh settings from the user's file or from keys.
        keys_of: Name of the member whose keys are used, or empty if there are no keys. With
            keys, all messages are encrypted, and both ends prove their identities with
            certificates.
        keys_end: Expiry time of the keys, in UTC. None if there are no keys.
    """

    listen: Sequence[Endpoint] = ()
    connect: Sequence[Endpoint] | None = ()
    mode: ZenohMode = "peer"
    settings: Mapping[str, Any] = field(default_factory=dict)
    keys_of: str = ""
    keys_end: datetime | None = None

    def reach(self, endpoints: Sequence[Endpoint]) -> list[Endpoint]:
        """Converts endpoints to encrypted endpoints if this process has keys.

        With keys, TLS replaces TCP. Without keys, the endpoints are returned unchanged.

        Args:
            endpoints: Endpoints as strings, such as "tcp/127.0.0.1:10241", or groups of
                endpoints from a user's Zenoh file. Groups are returned unchanged.
        """
        if not self.keys_of:
            return list(endpoints)

        encrypted: list[Endpoint] = []
        for endpoint in endpoints:
            if isinstance(endpoint, str):
                endpoint = re.sub("^tcp/", "tls/", endpoint)
            encrypted.append(endpoint)
        return encrypted

    @property
    def listen_addresses(self) -> list[str]:
        """Addresses on which the process listens, as strings. With keys, TLS replaces TCP."""
        return find_endpoint_addresses(self.reach(self.listen))

    @property
    def connect_addresses(self) -> list[str]:
        """Addresses to which the process connects, as strings. With keys, TLS replaces TCP.

        Empty if the endpoints are not known yet.
        """
        return find_endpoint_addresses(self.reach(self.connect or ()))

    @property
    def unprotected_addresses(self) -> list[str]:
        """Addresses whose connections are neither encrypted nor limited to this machine.

        Anybody on the network of one of these addresses can read the messages and take part.
        """
        return [
            address
            for address in (*self.listen_addresses, *self.connect_addresses)
            if not (address.startswith(ENCRYPTED) or _is_loopback(address))
        ]

    def open(self) -> ZenohBus:
        """Opens the network connection of this process, as described by the attributes.

        If the process has keys, the endpoints are replaced by encrypted ones (`reach`). The
        mode determines whether the process connects to the other members, connects to a router,
        or acts as a router.

        Returns:
            The bus that sends and receives messages.

        Raises:
            UnknownHost: A host name cannot be resolved. This is checked first, since Zenoh
                would retry an unknown name forever.
            RouterSilent: This process is a client, and no router answers.
            UsageError: Zenoh cannot use an endpoint.
        """
        listen_endpoints = self.reach(self.listen)
        # None means that the endpoints are not known yet. Then the process only listens.
        connect_endpoints = self.reach(self.connect or ())
        check_hosts([*listen_endpoints, *connect_endpoints])
        return ZenohBus(listen_endpoints, connect_endpoints, self.mode, self.settings)

    def require_keys_until(self, left_s: float) -> None:
        """Raises UsageError if the member's keys expire before the planned end of a session.

        A connection that is already open survives the expiry of its certificate, but new
        connections are impossible. After a short interruption of the network, a member could
        therefore not reconnect.

        Args:
            left_s: Remaining duration of the session, in s.

        Raises:
            UsageError: The keys expire before the end of the session.
        """
        if self.keys_end is None:
            return
        planned_end = datetime.now(UTC) + timedelta(seconds=left_s)
        if self.keys_end <= planned_end:
            raise UsageError(
                f"--keys: the keys of {self.keys_of} expire on {self.keys_end:{_DATE}}, but "
                f"the session is planned until {planned_end:{_DATE}}: renew the keys with "
                "trilat keys renew (docs/sessions/keys.md)"
            )

    def describe_end(self) -> str:
        """Returns a warning for the user if the keys of this process will expire soon.

        Returns:
            The warning, or an empty string if the process has no keys or the keys remain valid
            for longer than `ENDS_SOON`.
        """
        if self.keys_end is None or self.keys_end - datetime.now(UTC) > ENDS_SOON:
            return ""
        remedy = "renew the keys with trilat keys renew (docs/sessions/keys.md)"
        return f"the keys of {self.keys_of} expire on {self.keys_end:{_DATE}}: {remedy}"

    def require(self, member: str) -> "Connection":
        """Raises UsageError if this connection uses the keys of a different member.

        The other members would reject a process that joins under one name but proves its
        identity with the keys of another.

        Args:
            member: Name under which this process will take part in the session.

        Returns:
            This connection, which allows the check to be part of an expression.

        Raises:
            UsageError: The connection uses the keys of a different member.
        """
        if self.keys_of not in ("", member):
            raise UsageError(
                f"--keys: these are the keys of {self.keys_of}; the keys of {member} are needed"
            )
        return self

    @classmethod
    def of_member(
        cls,
        listen: Sequence[str] | None,
        connect: Sequence[str] | None,
        routers: Sequence[str] | None,
        file: ZenohFile | Path | None = None,
        listen_else: Sequence[str] = (),
        connect_else: Sequence[str] | None = None,
        *,
        routes: bool = False,
    ) -> "Connection":
        """Builds the connection of a process from the command line and the user's Zenoh file.

        If there is a router (named with `--router`, or implied by the mode "client" in the
        file), the process connects only to the router and does not listen.

        Args:
            listen: Endpoints given with --listen. None if the option is absent.
            connect: Endpoints given with --connect. None if the option is absent.
            routers: Endpoints given with --router. None if the option is absent.
            file: The user's Zenoh file or its path. None if there is no file.
            listen_else: Endpoints on which to listen if neither an option nor the file names
                any.
            connect_else: Endpoints to which to connect if neither an option nor the file names
                any.
            routes: True if the process itself is a router.

        Returns:
            The connection, with endpoints and mode but no keys.

        Raises:
            UsageError: The file cannot be used, or the options and the file contradict each
                other.
        """
        if isinstance(file, Path):
            file = read_zenoh_file(file)
        file = file or ZenohFile("")
        if routes:
            if file.mode not in ("", "router"):
                raise UsageError(
                    f"{file.source}: the mode must be router here, not {file.mode}"
                )
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
                f'{file.source}: mode "router" can be used only with `trilat router`; here the '
                "mode must be peer or client"
            )

        # Without a router, the process connects to the other members.
        if not routers and file.mode != "client":
            return _join_options(
                listen=listen,
                connect=connect,
                file=file,
                mode="peer",
                listen_else=listen_else,
                connect_else=connect_else,
            )

        # The process is a client of a router.
        client_source = "--router" if routers else f'{file.source}: mode "client"'
        if routers and file.mode == "peer":
            raise UsageError(
                f'{file.source}: mode "peer" contradicts --router, which requires mode "client"'
            )
        if listen is not None or file.endpoints("listen", "client"):
            raise UsageError(
                f"{client_source}: a client of a router does not listen on any endpoint; "
                "leave out the endpoints to listen on"
            )
        if routers and connect is not None:
            raise UsageError(
                "--router: a client connects only to a router; leave out --connect"
            )

        for endpoint in routers or ():
            if not re.fullmatch(
                r"(tcp|tls|quic|udp|ws)/[^/]+:\d+([?#].*)?|unixsock-stream/.+", endpoint
            ):
                raise UsageError(
                    "--router: an endpoint must have a form such as tcp/192.0.2.1:7447, not "
                    f"{endpoint!r}"
                )

        endpoints = _merge_endpoints(routers or connect, file, "client", ())
        if not endpoints:
            raise UsageError(
                f"{client_source}: there is no router to connect to; "
                "name a router with --router"
            )
        return Connection((), endpoints, "client", file.settings)

    def secure(self, keys: "MemberKeys | str | Path | None", *, insecure: bool) -> "Connection":
        """Adds a member's keys to a connection, or checks that it is safe without keys.

        Args:
            keys: Keys of a member, or the folder that contains them. None if there are no keys.
            insecure: True to allow endpoints that other machines can reach without keys.

        Returns:
            The connection with the keys.

        Raises:
            UsageError: The keys cannot be used or contradict the user's settings, an endpoint
                is not encrypted although there are keys, or other machines can reach an
                endpoint although there are no keys.
        """
        if isinstance(keys, str | Path):
            from .member_keys import read_member_keys  # takes time: it loads cryptography

            keys = read_member_keys(keys)

        endpoints = (*self.listen, *(self.connect or ()))
        addresses = find_endpoint_addresses(endpoints)
        for address in addresses:
            if address.startswith("udp/"):
                raise UsageError(
                    f"{address}: UDP is not supported, because it can lose or repeat messages "
                    "and does not authenticate their senders: use tcp, tls or quic"
                )
        if keys is None:
            _check_open_endpoints(self, insecure=insecure)
            return self

        for address in addresses:
            _check_encrypted_endpoint(address)
        _refuse_settings_of_keys(self.settings)
        return replace(
            self,
            settings=merge_settings(keys.settings, self.settings),
            keys_of=keys.member,
            keys_end=keys.ends,
        )

    def open_bus(
        self,
        clock: Clock,
        stopped: Callable[[], bool],
        timeout_s: float | None,
        say: Callable[[str], None],
    ) -> ZenohBus | None:
        """Opens a connection and, if there is a router, waits until it answers.

        Args:
            clock: Clock of the caller.
            stopped: Function that returns True to cancel the wait.
            timeout_s: Longest wait for a router, in s. If None, there is no limit.
            say: Function that prints a line for the user.

        Returns:
            The bus, or None if `stopped` returned True before a router answered.

        Raises:
            UsageError: An endpoint cannot be used.
            UnknownHost: A host name cannot be resolved at the first attempt. Later failures are
                ignored, since the name service may be temporarily unavailable.
            SessionError: No router answered in time.
        """
        begun_ns = clock.monotonic_ns()
        has_reported = False
        while not stopped():
            try:
                return self.open()
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

    @contextmanager
    def open_session(
        self,
        clock: Clock,
        session: str,
        names: SiteNamesOf,
        *,
        stopped: Callable[[], bool],
        timeout_s: float | None,
        say: Callable[[str], None] = lambda _: None,
        recorder_boot: int | None = None,
    ) -> Iterator[Bus | None]:
        """Connects to the sites of a session, as a context manager that closes the connection.

        If the endpoints are not known (`connect` is None), they are found in one of two ways.
        If files on this machine show that all sites of the session run here, their endpoints
        are used. Otherwise, the first site of the session is queried at its default endpoint on
        this machine. It returns the names of the other sites, which determine their default
        endpoints.

        Args:
            clock: Clock of the caller.
            session: Name of the session.
            names: Function that returns the names of the sites in a scenario. If it returns no
                names, only the first site is connected.
            stopped: Function that returns True to cancel the search.
            timeout_s: Longest wait for the first site or for a router, in s. If None, there is
                no limit.
            say: Function that prints a line for the user.
            recorder_boot: Boot of the caller (the random number that identifies this start of
                its process) if the caller is a recorder. The recorder is then announced during
                the search, so that the session waits for it. None for other callers.

        Yields:
            The network connection, or None if `stopped` returned True.

        Raises:
            SessionError: No site or router replies in time.
            UsageError: An endpoint cannot be used.
        """
        with ExitStack() as stack:

            def connect(target: Connection) -> Bus | None:
                """Opens a network connection, which is closed when `open_session` ends.

                Returns None if `stopped` has returned True.
                """
                bus = target.open_bus(clock, stopped, timeout_s, say)
                return None if bus is None else stack.enter_context(closing(bus))

            connection = self
            # A recorder does not use the known sites: it must announce itself to the first
            # site.
            if connection.connect is None and recorder_boot is None:
                known_endpoints = find_known_endpoints(session, connection)
                connection = replace(connection, connect=known_endpoints)
            if connection.connect is None:
                default_endpoints = DefaultEndpoints(session)
                first_endpoint = default_endpoints.of_site(0)
                first_bus = connect(replace(connection, listen=(), connect=[first_endpoint]))
                sites = None
                if first_bus is not None:
                    if recorder_boot is not None:
                        token = topics.presence_token(session, topics.RECORDER, recorder_boot)
                        first_bus.announce(token)
                    sites = _query_sites(
                        bus=first_bus,
                        clock=clock,
                        session=session,
                        first_endpoint=first_endpoint,
                        parse_site_names=names,
                        stopped=stopped,
                        timeout_s=timeout_s,
                    )
                if sites is None:  # the caller has stopped the search
                    yield None
                    return
                endpoints = list(default_endpoints.by_site(sites).values()) or [first_endpoint]
                connection = replace(connection, connect=endpoints)
            yield connect(connection)


def _query_sites(
    bus: Bus,
    clock: Clock,
    session: str,
    first_endpoint: str,
    parse_site_names: SiteNamesOf,
    stopped: Callable[[], bool],
    timeout_s: float | None,
) -> tuple[str, ...] | None:
    """Queries the members of a session for the names of its sites.

    A site replies with its scenario, which names all sites of the session.

    Args:
        bus: Network connection through which the first site can be reached.
        clock: Clock of the caller.
        session: Name of the session.
        first_endpoint: Default endpoint of the first site, for the error message.
        parse_site_names: Function that returns the names of the sites from the text of a
            scenario. It raises `ScenarioError` if the text is not a scenario.
        stopped: Function that returns True to cancel the search.
        timeout_s: Longest wait for a reply, in s. If None, the wait lasts until `stopped`
            returns True.

    Returns:
        The names, from the first reply that contains a scenario, or None if `stopped` returned
        True.

    Raises:
        SessionError: No member with a scenario replies in time.
    """
    from .session_members import SessionMembers  # takes time: it loads NumPy

    members = SessionMembers(bus, clock, session)
    for info in members.find(stopped=stopped, timeout_s=timeout_s):
        try:
            if info.scenario:
                return parse_site_names(info.scenario)
        except ScenarioError:  # not a scenario of this program
            continue

    # The search has ended, because the caller has stopped it or because the time is over. The
    # second case cannot occur without a limit, so `timeout_s` is a number below.
    if stopped():
        return None
    raise SessionError(
        f"no site of session {session!r} answered at {first_endpoint} "
        f"within {timeout_s:g} s; check the name of the session, or name other endpoints with "
        "--connect"
    )


def _check_encrypted_endpoint(address: str) -> None:
    """Raises UsageError if an endpoint is unencrypted, or sets its own encryption settings.

    The encryption settings must come from the keys. Settings of the network interface (`iface`,
    `bind`, `dscp`, `so_...`) are allowed.

    Raises:
        UsageError: The endpoint is rejected.
    """
    if not address.startswith(ENCRYPTED):
        raise UsageError(
            f"{address}: with --keys an endpoint must be encrypted: use tls/HOST:PORT or "
            "quic/HOST:PORT"
        )
    if re.search(r"[#;](?!(iface|bind|dscp)=|so_)", address):
        raise UsageError(
            f"{address}: --keys sets the encryption of an endpoint; leave out the part from # "
            "on"
        )


def _refuse_settings_of_keys(settings: Mapping[str, Any]) -> None:
    """Raises UsageError if the user's Zenoh settings contradict a session's encryption keys.

    Args:
        settings: Settings from the file.

    Raises:
        UsageError: The file contains such a setting.
    """
    set_by_keys = {"access_control", "low_pass_filter", "adminspace"}
    link_set_by_keys = {"tls", "protocols"}
    link_settings = settings.get("transport", {}).get("link", {})
    conflicts = sorted(set(settings) & set_by_keys)
    conflicts += [
        f"transport/link/{name}" for name in sorted(set(link_settings) & link_set_by_keys)
    ]
    if conflicts:
        raise UsageError(
            f"--zenoh-config: {conflicts[0]} is also set by --keys; leave out {conflicts[0]}"
        )


def _check_open_endpoints(connection: Connection, *, insecure: bool) -> None:
    """Raises UsageError if a process without keys listens for other machines.

    This is allowed if the user's own Zenoh settings require certificates at both ends.

    Args:
        connection: The connection.
        insecure: True to allow such endpoints.

    Raises:
        UsageError: An endpoint is rejected.
    """
    link_settings = connection.settings.get("transport", {}).get("link", {})
    has_mutual_tls = link_settings.get("tls", {}).get("enable_mtls") is True
    for address in find_endpoint_addresses(connection.listen):
        is_certified = has_mutual_tls and address.startswith(ENCRYPTED)
        is_safe = insecure or _is_loopback(address) or is_certified
        if not is_safe:
            raise UsageError(
                f"--listen {address}: anybody on that network could take part: give "
                "--keys DIR (create the keys with trilat keys new), or --insecure if you trust "
                "everybody on that network"
            )


ENCRYPTED = ("tls/", "quic/")
"""Prefixes of the endpoints whose transport is encrypted."""


def _is_loopback(address: str) -> bool:
    """Returns True if an address can only be reached from this machine.

    Such addresses need no encryption, because other machines cannot connect to them.

    Args:
        address: Address of an endpoint, such as "tcp/127.0.0.1:7447".
    """
    protocol, _, address_part = address.partition("/")
    host_and_port = re.split(r"[?#]", address_part)[0]  # without Zenoh's settings
    host = host_and_port.rpartition(":")[0].strip("[]")
    if protocol.startswith("unix") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _join_options(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    listen_else: Sequence[str],
    connect_else: Sequence[str] | None,
) -> Connection:
    """Builds the network connection of a process from its options and the user's Zenoh file.

    `listen_else` and `connect_else` are the defaults, see `Connection.of_member`.

    Raises:
        UsageError: Both the command line and the file name endpoints on which to listen.
    """
    file_listen = file.endpoints("listen", mode)
    if listen is not None and file_listen is not None:
        raise UsageError(
            f"{file.source}: listen/endpoints are also given by --listen; give the "
            "endpoints in only one place"
        )

    listen_endpoints: Sequence[Endpoint] = listen_else
    if listen is not None:
        listen_endpoints = listen
    elif file_listen is not None:
        listen_endpoints = file_listen
    connect_endpoints = _merge_endpoints(connect, file, mode, connect_else)
    return Connection(listen_endpoints, connect_endpoints, mode, file.settings)


def _merge_endpoints(
    named_endpoints: Sequence[str] | None,
    file: ZenohFile,
    mode: ZenohMode,
    fallback_endpoints: Sequence[str] | None,
) -> Sequence[Endpoint] | None:
    """Returns the endpoints to which a process connects, from the command line and the file.

    Endpoints from the command line come first, followed by additional ones from the user's
    Zenoh file.

    Args:
        named_endpoints: Endpoints given with the option. None if the option is absent.
        file: The user's Zenoh file.
        mode: Mode of the process.
        fallback_endpoints: Endpoints to use if neither the option nor the file names any.
    """
    file_endpoints = file.endpoints("connect", mode)
    if named_endpoints is None and file_endpoints is None:
        return fallback_endpoints
    endpoints: list[Endpoint] = list(named_endpoints or ())
    further_endpoints = [
        endpoint for endpoint in file_endpoints or () if endpoint not in endpoints
    ]
    return endpoints + further_endpoints

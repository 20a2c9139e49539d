"""How a member takes part in the network: where it listens, what it connects to, and as what.

Law: a place that is named replaces the places on this machine, whoever names it. What the command line and
a file both say is united or refused, never chosen between.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..errors import SessionError, UsageError
from .clock import Clock
from .zenoh_bus import RouterSilent, ZenohBus
from .zenoh_config import Endpoint, Mode
from .zenoh_file import ZenohFile

AGAIN_NS = 200_000_000
"""How long to wait between two tries to reach a router."""


@dataclass(frozen=True, slots=True)
class Connection:
    """How a member takes part in the network.

    Attributes:
        listen: endpoints to listen at.
        connect: endpoints to connect to; a client takes the first that answers. None: still to be found.
        mode: peer of the other members, client of a router, or a router.
        own: settings of a person's own for Zenoh.
    """

    listen: Sequence[Endpoint] = ()
    connect: Sequence[Endpoint] | None = ()
    mode: Mode = "peer"
    own: Mapping[str, Any] = field(default_factory=dict)

    @property
    def places(self) -> Sequence[Endpoint]:
        """Where others reach this member: where it listens, or the routers of a client."""
        return self.listen or self.connect or ()


def member_connection(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    routers: Sequence[str] | None,
    file: ZenohFile | None,
    listen_else: Sequence[str],
    connect_else: Sequence[str] | None,
) -> Connection:
    """Returns how a site, a recorder or a tool takes part.

    With a router, named by `--router` or by a file of mode "client", a member listens nowhere and connects to
    nothing else.

    Args:
        listen: `--listen`.
        connect: `--connect`.
        routers: `--router`; the first that answers.
        file: `--zenoh-config`.
        listen_else: where to listen if nobody says.
        connect_else: what to connect to if nobody says.

    Raises:
        UsageError: what is said contradicts itself.
    """
    file = file or ZenohFile("")
    if file.mode == "router":
        raise UsageError(f"{file.source}: mode: router is for `trilat router`; here it is peer or client")
    if not routers and file.mode != "client":
        return Connection(
            _listen(listen, file, "peer", listen_else),
            _united(connect, file, "peer", connect_else),
            "peer",
            file.settings,
        )
    where = "--router" if routers else f"{file.source}: mode: client"
    if routers and file.mode == "peer":
        raise UsageError(f"{file.source}: mode: peer contradicts --router, which makes a client")
    if listen is not None or file.endpoints("listen", "client"):
        raise UsageError(
            f"{where}: a client of a router listens nowhere; leave out the endpoints to listen at"
        )
    if routers and connect is not None:
        raise UsageError("--router: a client connects to a router only; leave out --connect")
    for endpoint in routers or ():
        if not re.fullmatch(r"(tcp|tls|quic|udp|ws)/[^/]+:\d+([?#].*)?|unixsock-stream/.+", endpoint):
            raise UsageError(f"--router: an endpoint is like tcp/192.0.2.1:7447, not {endpoint!r}")
    chosen = _united(routers or connect, file, "client", ())
    if not chosen:
        raise UsageError(f"{where}: there is no router to connect to; name it with --router")
    return Connection((), chosen, "client", file.settings)


def router_connection(
    listen: Sequence[str] | None,
    connect: Sequence[str] | None,
    file: ZenohFile | None,
    listen_else: Sequence[str],
) -> Connection:
    """Returns how a router takes part; arguments as for `member_connection`.

    Raises:
        UsageError: what is said contradicts itself.
    """
    file = file or ZenohFile("")
    if file.mode not in ("", "router"):
        raise UsageError(f"{file.source}: mode: {file.mode} must be router here")
    return Connection(
        _listen(listen, file, "router", listen_else),
        _united(connect, file, "router", ()),
        "router",
        file.settings,
    )


def _listen(
    named: Sequence[str] | None, file: ZenohFile, mode: Mode, otherwise: Sequence[str]
) -> Sequence[Endpoint]:
    stated = file.endpoints("listen", mode)
    if named is not None and stated is not None:
        raise UsageError(f"{file.source}: listen/endpoints: given by --listen too; give them in one place")
    if named is not None:
        return named
    return otherwise if stated is None else stated


def _united(
    named: Sequence[str] | None, file: ZenohFile, mode: Mode, otherwise: Sequence[str] | None
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
    """Returns a bus of that connection; None where `stopped` said so before the router answered.

    Args:
        connection: how to take part; its `connect` is known.
        clock: the time.
        stopped: whether to give up.
        timeout_s: how long to wait for a router, s; None for ever.
        say: tells a person what happens.

    Raises:
        UsageError: an endpoint cannot be used.
        SessionError: no router answered in time.
    """
    begun_ns, told = clock.monotonic_ns(), False
    while not stopped():
        try:
            return ZenohBus(connection.listen, connection.connect or (), connection.mode, connection.own)
        except RouterSilent as silent:
            if timeout_s is not None and clock.monotonic_ns() - begun_ns >= timeout_s * 1e9:
                raise SessionError(f"{silent} within {timeout_s:g} s") from None
            if not told:
                say(f"{silent} yet; trying again")
            told = True
        clock.sleep_until(clock.monotonic_ns() + AGAIN_NS)
    return None

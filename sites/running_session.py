"""A running session from Python: orders, changes and pings; and processes of a session.

Invariant: each call connects, as its command does, and holds no connection afterwards.
"""

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from trilat_net.errors import RunFailed
from trilat_net.net.access_rules import OPERATOR
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection, resolve_member_connection, secure_connection
from trilat_net.net.discovery import REPLY_TIMEOUT_S, connect_to_session, request_change
from trilat_net.net.member_keys import read_member_keys
from trilat_net.net.requests import ChangeRequest, OrderName
from trilat_net.results import Result
from trilat_net.scenario import embedded_names_reader

from .doctor import DoctorFinding, examine_machine
from .session_ping import PingReport, describe_ping, ping_session
from .session_stop import order_sites, stop_session

T = TypeVar("T")


class RunningSession:
    """A session that runs; see `session`. Methods return what the sites answer, a sentence each."""

    def __init__(self, name: str, connection: Connection) -> None:
        self.name, self._connection = name, connection

    def _act(self, act: Callable[[Bus, Clock], T], *, operates: bool = True) -> T:
        if operates:
            self._connection.require(OPERATOR)
        clock, names = SystemClock(), embedded_names_reader(self.name)
        reached = connect_to_session(
            self._connection, clock, self.name, names, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S
        )
        with reached as bus:
            assert bus is not None  # nothing stops it
            return act(bus, clock)

    def _order(self, sites: Sequence[str], order: OrderName) -> list[str]:
        replies = self._act(
            lambda bus, clock: order_sites(bus, clock, self.name, sites, order), operates=order != "stop"
        )
        if refused := [reply.text for reply in replies if not reply.accepted]:
            raise RunFailed("; ".join([*refused, *(reply.text for reply in replies if reply.accepted)]))
        return [reply.text for reply in replies]

    def stop(self, *sites: str) -> list[str]:
        """Stops arms at once, all or some, while the session goes on; as `trilat stop`."""
        return self._order(sites, "stop")

    def enable(self, *sites: str) -> list[str]:
        """Lets arms that were stopped follow again; as `trilat enable`."""
        return self._order(sites, "enable")

    def reset(self, *sites: str) -> list[str]:
        """Ends the fault of sites, unless its reason is still there; as `trilat reset`."""
        return self._order(sites, "reset")

    def end(self) -> list[str]:
        """Ends the session in order; as `trilat stop --end`."""
        return self._act(lambda bus, clock: stop_session(bus, clock, self.name))

    def set_link(self, link: str, **to: Any) -> str:
        """Changes keys of a link such as "m1->s", as in `delay_ms=350`; as `trilat set link`."""
        return self._change(link.partition("->")[2], link=link, to=to)

    def set_dominance(self, site: str, shares: Mapping[str, float], ramp_s: float = 1.0) -> str:
        """Changes a site's shares in its peers, as in `{"m1": 0.9, "m2": 0.1}`; as `trilat set dominance`."""
        return self._change(site, dominance=site, to=dict(shares), ramp_s=ramp_s)

    def _change(self, site: str, **change: Any) -> str:
        names = embedded_names_reader(self.name)
        request = ChangeRequest(**change)
        reply = request_change(
            self._connection.require(OPERATOR), SystemClock(), self.name, site, request, names
        )
        if not reply.accepted:
            raise RunFailed(f"refused: {reply.text}")
        return reply.text

    def ping(self, count: int = 50, timeout_s: float = 3.0) -> PingReport:
        """Measures round trips, clock offsets and links of the session; as `trilat ping`."""
        clock = SystemClock()
        probe = ping_session(self._connection, clock, self.name, count, timeout_s, lambda: False)
        assert probe is not None  # nothing stops it
        return describe_ping(self.name, probe)


def session(
    name: str,
    *,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> RunningSession:
    """Returns a running session, to stop, change and measure it; as `trilat stop`, `set`, `ping`.

    >>> paper = tn.session("paper")  # doctest: +SKIP
    >>> paper.set_link("m1->s", delay_ms=350)  # doctest: +SKIP
    >>> paper.stop("s"), paper.enable("s"), paper.ping()  # doctest: +SKIP

    Args:
        name: the session's name.
        connect: endpoints, as of --connect; without them the session's default ones on this machine.
        router: endpoints of routers to go through instead, as of --router.
        keys: folder of the operator's keys, as of --keys; of any member's, to stop arms and to ping.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    connection = resolve_member_connection(None, connect, router, None, [], None)
    known = None if keys is None else read_member_keys(Path(keys))
    return RunningSession(name, secure_connection(connection, known, insecure=False))


def start(*words: str | Path) -> "subprocess.Popen[bytes]":
    """Starts a process of a session, as in a terminal; it runs until its end, or until it is terminated.

    The commands are `trilat site`, `record`, `router`, `replay`, `watch` and `live`.

    >>> recorder = tn.start("record", "--session", "paper", "-o", "run.mcap")  # doctest: +SKIP
    >>> player = tn.start("replay", "run.mcap", "--rate", "2")  # doctest: +SKIP
    >>> player.wait()  # doctest: +SKIP

    Args:
        words: the words of the command, without `trilat`.
    """
    return subprocess.Popen([sys.executable, "-m", "trilat_net", *map(str, words)])


@dataclass(frozen=True, repr=False)
class DoctorReport(Result):
    """What stands in the way of a session on this machine, and what does not."""

    findings: list[DoctorFinding]

    def headline(self) -> str:
        """Returns how many findings warn or fail."""
        states = [finding.state for finding in self.findings]
        return f"{states.count('fail')} fail, {states.count('warn')} warn, {states.count('ok')} ok"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the findings as of `trilat doctor --json`."""
        return {"findings": self.to_rows()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per finding."""
        return [finding._asdict() for finding in self.findings]


def doctor(
    *,
    listen: Sequence[str] | None = None,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
    session: str | None = None,
    folder: str | Path = "runs",
    insecure: bool = False,
) -> DoctorReport:
    """Examines keys, links, clocks, rights, disk and processors; the command is `trilat doctor`.

    >>> "clock" in {finding.check for finding in tn.doctor().findings}
    True

    Args:
        listen: endpoints to listen at.
        connect: endpoints to connect to.
        router: endpoints of routers.
        keys: folder of a member's keys.
        session: a session whose members are asked for their clocks.
        folder: where results would go.
        insecure: whether everybody on the network is trusted.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    connection = resolve_member_connection(listen, connect, router, None, [], None)
    place = None if keys is None else Path(keys)
    found = examine_machine(connection, place, Path(folder), session, SystemClock(), insecure=insecure)
    return DoctorReport(list(found))

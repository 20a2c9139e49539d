"""Ping client: round trips to every member of a session, and the link statistics that its sites publish.

Invariant: read-only. It announces no token; a session neither waits for it nor sees it.
"""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from trilat_net.errors import RunFailed, ScenarioError, SessionError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection, default_endpoint
from trilat_net.net.discovery import connect_to_session
from trilat_net.net.membership import MemberQuery, read_messages
from trilat_net.net.messages import Info, LinkStats
from trilat_net.net.offset import OffsetEstimate, exact_offset
from trilat_net.net.pinging import PING_PACE_NS, Pinger
from trilat_net.results import Result
from trilat_net.scenario import parse_embedded

POLL_NS = 1_000_000
GATHER_NS = 600_000_000
"""Time to find members after the first one."""
PATIENCE_NS = 3_000_000_000
"""Time to wait for the last answers beyond their due time."""


@dataclass(frozen=True, slots=True)
class PingResult:
    """Round trips to one member.

    Attributes:
        rtts_ns: round trips, without the time that it held them.
        shared: whether its clock is the client's own.
        estimate: offset of its clock from the client's; None if too few round trips agree.
    """

    info: Info
    rtts_ns: tuple[int, ...]
    shared: bool
    estimate: OffsetEstimate | None


class SessionPing:
    """One measurement of a session, of `count` round trips to each member; call `poll` until `over`.

    Attributes:
        infos: identities of the members that answered, by name.
        links: latest statistics of every running site.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, count: int) -> None:
        self.infos: dict[str, Info] = {}
        self.links: dict[str, LinkStats] = {}
        self._clock, self._count = clock, count
        self._members = MemberQuery(bus, clock, session)
        self._stats = bus.inbox(topics.key(session, "*", topics.LINK), 256)
        self.pinger = Pinger(bus, clock, session, count)
        self._first_ns: int | None = None

    def poll(self) -> None:
        """Takes the answers that have arrived, and asks again."""
        for info in self._members.poll():
            self.infos[info.member] = info
            self._first_ns = self._first_ns or self._clock.monotonic_ns()
        for stats in read_messages(self._stats, LinkStats):
            self.links[stats.site] = stats
        self.pinger.poll(self._boots)

    @property
    def _boots(self) -> set[int]:
        return {info.boot for info in self.infos.values()}

    def over(self, timeout_ns: int, begun_ns: int) -> bool:
        """True once every member has answered, or has had the time to."""
        now_ns = self._clock.monotonic_ns()
        if self._first_ns is None:
            return now_ns - begun_ns > timeout_ns
        passed_ns = now_ns - self._first_ns
        enough_ns = GATHER_NS + self._count * PING_PACE_NS + PATIENCE_NS
        return passed_ns > GATHER_NS and (self.pinger.know(self._boots) or passed_ns > enough_ns)

    def reached(self) -> list[PingResult]:
        """Returns the measurements in the order of the members' names."""
        own = self._clock.identity()
        reached = []
        for _, info in sorted(self.infos.items()):
            trips = self.pinger.trips.get(info.boot)
            rtts = tuple(trips.rtts_ns) if trips else ()
            shared = info.clock == own
            estimate = exact_offset(0) if shared else trips.latest if trips else None
            reached.append(PingResult(info, rtts, shared, estimate))
        return reached


def ping_session(
    connection: Connection,
    clock: Clock,
    session: str,
    count: int,
    timeout_s: float,
    stopped: Callable[[], bool],
) -> SessionPing | None:
    """Measures a session once; None if `stopped`. It waits for the first answer for `timeout_s`.

    Raises:
        RunFailed: no member answered.
    """

    def site_names(text: str) -> tuple[str, ...]:
        try:
            return parse_embedded(text, session).names
        except ScenarioError:  # of another version: the first site's endpoint is all that is known
            return ()

    with ExitStack() as stack:
        try:
            bus = stack.enter_context(
                connect_to_session(
                    connection, clock, session, site_names, stopped=stopped, timeout_s=timeout_s
                )
            )
        except SessionError as error:
            raise RunFailed(str(error)) from None
        if bus is None:
            return None
        ping, begun_ns = SessionPing(bus, clock, session, count), clock.monotonic_ns()
        while not ping.over(int(timeout_s * 1e9), begun_ns):
            if stopped():
                return None
            ping.poll()
            clock.sleep_until(clock.monotonic_ns() + ping.pinger.pause_ns(POLL_NS))
    if not ping.infos:
        places = ", ".join(map(str, connection.connect or [default_endpoint(session, 0)]))
        raise RunFailed(
            f"no member of session {session!r} answered at {places} within {timeout_s:g} s; is that its "
            "name, and has it not ended? name other endpoints with --connect"
        )
    return ping


@dataclass(frozen=True, repr=False)
class PingReport(Result):
    """Round trips and clock offsets to every member of a session, and its links as its sites measure them."""

    session: str
    members: list[dict[str, Any]]
    links: list[dict[str, Any]]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat ping --json`."""
        return {"session": self.session, "members": self.members, "links": self.links}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per member."""
        return self.members


def describe_ping(session: str, probe: SessionPing) -> PingReport:
    """Returns what a measurement found."""
    return PingReport(session, [_member(reach) for reach in probe.reached()], _links(probe))


def _member(reach: PingResult) -> dict[str, Any]:
    info, rtts = reach.info, sorted(reach.rtts_ns)
    facts: dict[str, Any] = {
        "member": info.member,
        "host": info.host,
        "running": info.running,
        "ticks": info.ticks,
        "answers": len(rtts),
        "same_clock": reach.shared,
    }
    if rtts:
        steps = [abs(b - a) for a, b in zip(reach.rtts_ns, reach.rtts_ns[1:], strict=False)]
        facts["rtt_us"] = {
            "min": rtts[0] / 1000,
            "p50": rtts[len(rtts) // 2] / 1000,
            "p99": rtts[min(len(rtts) - 1, len(rtts) * 99 // 100)] / 1000,
        }
        facts["jitter_us"] = sum(steps) / max(1, len(steps)) / 1000
    if reach.estimate is not None:
        estimate = reach.estimate
        facts["offset_ns"] = estimate.offset_ns
        facts["bound_us"] = estimate.bound_at(estimate.at_ns, estimate.offset_ns) / 1000
    return facts


def _links(probe: SessionPing) -> list[dict[str, Any]]:
    """Returns the links as running sites measure them; times in us."""
    return [
        {
            "from": peer,
            "to": site,
            "delay_us": stats.delay_us[peer],
            "delay_max_us": stats.delay_max_us.get(peer, -1),
            "rtt_us": stats.rtt_us.get(peer, -1),
            "offset_us": stats.offset_us.get(peer, 0),
            "bound_us": stats.bound_us.get(peer, 0),
        }
        for site, stats in sorted(probe.links.items())
        for peer in stats.delay_us
    ]

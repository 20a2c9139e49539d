"""Ping client: round trips to every member of a session, the links of its sites; delays of a
topic of ROS 2.

Invariant: read-only. It announces no token in a session, which neither waits for it nor sees
it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import RunFailed, ScenarioError, SessionError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection, default_endpoint
from trilat_net.net.discovery import connect_to_session
from trilat_net.net.membership import MemberQuery, read_messages
from trilat_net.net.messages import Info, LinkStats
from trilat_net.net.offset import exact_offset
from trilat_net.net.pinging import PING_PACE_NS, Pinger
from trilat_net.net.ros2_graph import Attachment, Ros2Graph
from trilat_net.results import Result
from trilat_net.scenario import parse_embedded

POLL_NS = 1_000_000
GATHER_NS = 600_000_000
"""Time to find members after the first one."""
PATIENCE_NS = 3_000_000_000
"""Time to wait for the last answers beyond their due time."""


@dataclass(frozen=True, repr=False)
class PingReport(Result):
    """Round trips and clock offsets to every member of a session, and its links as its sites
    measure them.
    """

    session: str
    members: list[dict[str, Any]]
    links: list[dict[str, Any]]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per member."""
        return self.members


class SessionPing:
    """One measurement of a session, of `count` round trips to each member; call `poll` until
    `over`.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, count: int) -> None:
        self.infos: dict[str, Info] = {}
        self.links: dict[str, LinkStats] = {}
        self._clock = clock
        self._session = session
        self._count = count
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
        return passed_ns > GATHER_NS and (
            self.pinger.knows_clocks(self._boots) or passed_ns > enough_ns
        )

    def report(self) -> PingReport:
        """Returns what it found."""
        members = [self._describe(info) for _, info in sorted(self.infos.items())]
        links = [
            {
                "from": peer,
                "to": site,
                "delay_us": stats.delay_us[peer],
                "delay_max_us": stats.delay_max_us.get(peer, -1),
                "rtt_us": stats.rtt_us.get(peer, -1),
                "offset_us": stats.offset_us.get(peer, 0),
                "bound_us": stats.bound_us.get(peer, 0),
            }
            for site, stats in sorted(self.links.items())
            for peer in stats.delay_us
        ]
        return PingReport(self._session, members, links)

    def _describe(self, info: Info) -> dict[str, Any]:
        trips = self.pinger.trips.get(info.boot)
        shared = info.clock == self._clock.identity()
        rtts_ns = tuple(trips.rtts_ns) if trips else ()
        facts: dict[str, Any] = {
            "member": info.member,
            "host": info.host,
            "running": info.running,
            "ticks": info.ticks,
            "answers": len(rtts_ns),
            "same_clock": shared,
        }
        if rtts_ns:
            steps = [abs(b - a) for a, b in pairwise(rtts_ns)]
            ordered = sorted(rtts_ns)
            facts["rtt_us"] = {
                "min": ordered[0] / 1000,
                "p50": ordered[len(ordered) // 2] / 1000,
                "p99": ordered[min(len(ordered) - 1, len(ordered) * 99 // 100)] / 1000,
            }
            facts["jitter_us"] = sum(steps) / max(1, len(steps)) / 1000
        estimate = exact_offset(0) if shared else trips.latest if trips else None
        if estimate is not None:
            facts["offset_ns"] = estimate.offset_ns
            facts["bound_us"] = (
                estimate.error_bound_ns(estimate.local_ns, estimate.offset_ns) / 1000
            )
        return facts


def ping_session(
    connection: Connection,
    clock: Clock,
    session: str,
    count: int,
    timeout_s: float,
    stopped: Callable[[], bool],
) -> PingReport | None:
    """Measures a session once; None if `stopped`. It waits for the first answer for
    `timeout_s`.

    Raises:
        RunFailed: no member answered.
    """

    def site_names(text: str) -> tuple[str, ...]:
        try:
            return parse_embedded(text, session).names
        # of another version: the first site's endpoint is all that is known
        except ScenarioError:
            return ()

    there = connection, clock, session, site_names
    try:
        with connect_to_session(*there, stopped=stopped, timeout_s=timeout_s) as bus:
            if bus is None:
                return None
            ping = SessionPing(bus, clock, session, count)
            begun_ns = clock.monotonic_ns()
            while not ping.over(int(timeout_s * 1e9), begun_ns):
                if stopped():
                    return None
                ping.poll()
                clock.sleep_until(clock.monotonic_ns() + ping.pinger.pause_ns(POLL_NS))
    except SessionError as error:
        raise RunFailed(str(error)) from None
    if not ping.infos:
        places = ", ".join(map(str, connection.connect or [default_endpoint(session, 0)]))
        raise RunFailed(
            f"no member of session {session!r} answered at {places} within {timeout_s:g} s; is that its "
            "name, and has it not ended? name other endpoints with --connect"
        )
    return ping.report()


@dataclass(frozen=True, repr=False)
class TopicDelays(Result):
    """How long messages of a topic of ROS 2 were on their way, for each publisher of it.

    From the time of sending in the attachment of each to its arrival here: it contains the
    offset between the clocks of the two machines.
    """

    topic: str
    lasted_s: float
    publishers: list[dict[str, Any]]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per publisher."""
        return self.publishers


def ping_topic(
    graph: Ros2Graph, clock: Clock, topic: str, lasts_s: float, stopped: Callable[[], bool]
) -> TopicDelays:
    """Listens to a topic of ROS 2 for some time, or until `stopped`.

    Raises:
        RunFailed: nobody published anything.
    """
    heard: dict[bytes, list[tuple[int, int]]] = {}
    types: dict[bytes, str] = {}

    def take(kind: str, attachment: Attachment) -> None:
        late_ns = clock.unix_ns() - attachment.sent_unix_ns
        types[attachment.gid] = kind
        heard.setdefault(attachment.gid, []).append((attachment.number, late_ns))

    graph.tap(topic, take)
    begun_ns = clock.monotonic_ns()
    while not stopped() and clock.monotonic_ns() - begun_ns < lasts_s * NS_PER_S:
        clock.sleep_until(clock.monotonic_ns() + 10 * POLL_NS)
    lasted_s = (clock.monotonic_ns() - begun_ns) / NS_PER_S
    if not heard:
        raise RunFailed(
            f"nobody published on /{topic} in {lasted_s:.3g} s: see ros2 topic list, and --domain"
        )
    publishers = [
        {
            "gid": gid.hex(),
            "type": types[gid].replace("::dds_::", "/").replace("::", "/").removesuffix("_"),
        }
        | _describe_delays(list(came), lasted_s)
        for gid, came in list(heard.items())
    ]
    return TopicDelays(topic, lasted_s, publishers)


def _describe_delays(came: Sequence[tuple[int, int]], lasted_s: float) -> dict[str, Any]:
    """Returns what is known of one publisher; a number that is missing between others was lost."""
    numbers = {number for number, _ in came}
    late_us = np.array([late_ns for _, late_ns in came]) / 1e3
    counts, edges_us = np.histogram(late_us, bins=20)
    quantiles = {"min": 0.0, "p50": 50.0, "p99": 99.0, "max": 100.0}
    return {
        "messages": len(came),
        "lost": max(numbers) - min(numbers) + 1 - len(numbers),
        "rate_hz": len(came) / lasted_s,
        "delay_us": {name: float(np.percentile(late_us, at)) for name, at in quantiles.items()},
        "histogram": {"edges_us": edges_us.tolist(), "counts": counts.tolist()},
    }

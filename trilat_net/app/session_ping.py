"""Measures the network of a running session.

The members of a session are its sites (the processes that each control one arm) and its
recorders. A ping is a message to which a member replies at once. `ping_session` pings all
members, and reports round-trip times and the offsets of their clocks. It also reports the
delays of the links between the sites, as measured by the receiving sites.

Invariant:
    - The measurement does not disturb the session. This process does not announce itself as a
      member, so that the session does not wait for it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from trilat_net.errors import RunFailed, ScenarioError, SessionError
from trilat_net.results import Result
from trilat_net.scenario import parse_embedded

from ..net import (
    PING_PACE_NS,
    Bus,
    Clock,
    Connection,
    DefaultEndpoints,
    Info,
    LinkStats,
    Pinger,
    SessionMembers,
)

POLL_NS = 1_000_000
"""Longest pause between two polls, in ns."""
GATHERING_NS = 600_000_000
"""Time that further members have to reply after the first reply, in ns."""
PATIENCE_NS = 3_000_000_000
"""Time after which missing replies to pings are given up, counted from when they are due, in
ns.
"""


@dataclass(frozen=True, repr=False)
class PingReport(Result):
    """Measured network delays between processes of a session, and offsets of their clocks.

    Attributes:
        session: Name of the session.
        members: One table row per member, with the round-trip times of the pings, and the
            offset of the member's clock from the clock of this process.
        links: One table row per link (directed connection between two sites), as measured by
            the receiving site.
    """

    session: str
    members: list[dict[str, Any]]
    links: list[dict[str, Any]]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one table row per process of the session, for example for pandas.

        Links between the arms are not included, because they have different columns.
        """
        return self.members

    def blocks(self) -> Iterator[Any]:
        """Returns the tables of round-trip times that `trilat ping` prints.

        The formatting module is imported inside this method, because a program that only reads
        the results does not need it.
        """
        from ..presentation import compose_ping

        return compose_ping(self)


class SessionPing:
    """A single measurement of a session's round-trip times and link delays.

    Call `poll` repeatedly until `is_over` returns True, then call `report`. The object finds
    the members by sending a query, measures round-trip times with pings, and reads the link
    delays from the statistics that the sites publish. It takes no part in the control loops.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        count: Number of round trips to each member.

    Attributes:
        infos: Identity of each member that has replied, keyed by name.
        links: Latest statistics of each site, keyed by name.
        pinger: Sends the pings, and estimates the clock offsets.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        count: int,
    ) -> None:
        self.infos: dict[str, Info] = {}
        self.links: dict[str, LinkStats] = {}
        self._clock = clock
        self._session = session
        self._trips_per_member = count
        self._members = SessionMembers(bus, clock, session)
        self._read_statistics = self._members.subscribe(LinkStats, capacity=256)
        self.pinger = Pinger(bus, clock, session, count)
        self._first_ns: int | None = None

    def poll(self) -> None:
        """Processes the messages that have arrived, and sends pings and queries that are due.

        Call this method repeatedly until `is_over` returns True. It never blocks.
        """
        for info in self._members.poll():
            self.infos[info.member] = info
            if self._first_ns is None:
                self._first_ns = self._clock.monotonic_ns()
        for stats in self._read_statistics():
            self.links[stats.site] = stats
        self.pinger.poll(self._boots)

    @property
    def _boots(self) -> set[int]:
        """Random numbers that identify the processes that have replied as session members.

        Only pings of these processes are evaluated.
        """
        return {info.boot for info in self.infos.values()}

    def is_over(self, timeout_ns: int, begun_ns: int) -> bool:
        """Returns True once the pings to every member are complete, or have been given up.

        The measurement lasts at least `GATHERING_NS` after the first reply from a member, to
        leave time for other members to reply. It is given up `PATIENCE_NS` after all pings
        should have been sent.

        Args:
            timeout_ns: Maximum time to wait for the first reply, in ns.
            begun_ns: Time at which the measurement started, on the clock of this process, in
                ns.
        """
        now_ns = self._clock.monotonic_ns()
        if self._first_ns is None:  # no member has replied
            return now_ns - begun_ns > timeout_ns

        since_first_reply_ns = now_ns - self._first_ns
        sending_ns = self._trips_per_member * PING_PACE_NS  # needed to send all pings
        give_up_after_ns = GATHERING_NS + sending_ns + PATIENCE_NS
        is_complete = self.pinger.knows_clocks(self._boots)
        is_given_up = since_first_reply_ns > give_up_after_ns
        has_gathered_members = since_first_reply_ns > GATHERING_NS
        return has_gathered_members and (is_complete or is_given_up)

    def report(self) -> PingReport:
        """Returns the delays and clock offsets measured so far.

        Member rows are sorted by name, and link rows by the name of the receiving site. A value
        of -1 means that a delay was not measured.
        """
        members = [self._describe_member(info) for _, info in sorted(self.infos.items())]

        links = []
        for site, stats in sorted(self.links.items()):
            for peer in stats.delay_us:
                link_row = {
                    "from": peer,
                    "to": site,
                    "delay_us": stats.delay_us[peer],
                    "delay_max_us": stats.delay_max_us.get(peer, -1),
                    "rtt_us": stats.rtt_us.get(peer, -1),
                    "offset_us": stats.offset_us.get(peer, 0),
                    "bound_us": stats.bound_us.get(peer, 0),
                }
                links.append(link_row)

        return PingReport(self._session, members, links)

    def _describe_member(self, info: Info) -> dict[str, Any]:
        """Returns the row of a member in the report.

        If the member has replied to pings, the row contains quantiles of the round trip time
        and the jitter, which is the mean change from one round trip time to the next. If the
        offset of the member's clock is known, the row contains it with its error bound.

        Args:
            info: Identity of the member.
        """
        trips = self.pinger.trips.get(info.boot)
        has_same_clock = info.clock == self._clock.identity()
        rtts_ns = tuple(trips.rtts_ns) if trips else ()
        fields: dict[str, Any] = {
            "member": info.member,
            "host": info.host,
            "running": info.running,
            "ticks": info.ticks,
            "answers": len(rtts_ns),
            "same_clock": has_same_clock,
        }

        if rtts_ns:
            ordered_ns = sorted(rtts_ns)
            count = len(ordered_ns)
            median_index = count // 2
            p99_index = min(count - 1, count * 99 // 100)
            fields["rtt_us"] = {
                "min": ordered_ns[0] / 1000,
                "p50": ordered_ns[median_index] / 1000,
                "p99": ordered_ns[p99_index] / 1000,
            }
            changes_ns = [abs(following - rtt) for rtt, following in pairwise(rtts_ns)]
            fields["jitter_us"] = sum(changes_ns) / max(1, len(changes_ns)) / 1000

        estimate = trips.latest if trips else None
        if has_same_clock:
            fields["offset_ns"] = 0
            fields["bound_us"] = 0.0
        elif estimate is not None:
            bound_ns = estimate.error_bound_ns(estimate.local_ns, estimate.offset_ns)
            fields["offset_ns"] = estimate.offset_ns
            fields["bound_us"] = bound_ns / 1000
        return fields


def ping_session(
    connection: Connection,
    clock: Clock,
    session: str,
    count: int,
    timeout_s: float,
    stopped: Callable[[], bool],
) -> PingReport | None:
    """Measures the round-trip times and link delays of a running session.

    Args:
        connection: Endpoints of the session, and keys.
        clock: Clock of this process.
        session: Name of the session.
        count: Number of round trips to each member.
        timeout_s: Maximum time to wait for the first reply, in s.
        stopped: Function that returns True to end the measurement.

    Returns:
        The results. `None` if `stopped` returned True.

    Raises:
        RunFailed: No member replied.
    """

    def read_site_names(text: str) -> tuple[str, ...]:
        """Extracts the names of the sites from the TOML text of a scenario.

        Returns an empty tuple if the scenario was written for another version of the program.
        """
        try:
            return parse_embedded(text, session).names
        except ScenarioError:
            # The scenario belongs to another version of this program. Without the names of the
            # sites, only the default endpoint of the first site is known.
            return ()

    try:
        with connection.open_session(
            clock, session, read_site_names, stopped=stopped, timeout_s=timeout_s
        ) as bus:
            if bus is None:
                return None

            ping = SessionPing(bus, clock, session, count)
            begun_ns = clock.monotonic_ns()
            while not ping.is_over(int(timeout_s * 1e9), begun_ns):
                if stopped():
                    return None
                ping.poll()
                clock.sleep_until(clock.monotonic_ns() + ping.pinger.pause_ns(POLL_NS))
    except SessionError as error:
        raise RunFailed(str(error)) from None

    if not ping.infos:
        endpoints = connection.connect or [DefaultEndpoints(session).of_site(0)]
        raise RunFailed(
            f"no member of session {session!r} answered at {', '.join(map(str, endpoints))} "
            f"within {timeout_s:g} s; check the name of the session and whether the session "
            "has ended, or name other endpoints with --connect"
        )
    return ping.report()

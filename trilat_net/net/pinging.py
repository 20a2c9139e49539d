"""Measures the clocks of other processes by pings, and repeats queries over a poor network.

A ping is a query to which a process replies at once, with the readings of its clock when the
ping arrived and when the reply was sent. The difference between its clock and the local clock
is then known to half the round trip, however large the difference is. For example, a round trip
of 0.4 ms gives the difference to 0.2 ms.

Queries and replies may be lost, or may take longer than the time between two queries. Therefore
a query is repeated, and replies to the last QUERIES_KEPT copies are accepted.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping

from ..errors import WireError
from ..records import NS_PER_S
from . import topics
from .bus import Bus, Inbox, Query
from .clock import Clock
from .messages import Info
from .offset import OffsetEstimate, OffsetEstimator, OffsetLimit, format_offset
from .requests import Backfill, BackfillRequest, Pong
from .wire import decode, encode

QUERIES_KEPT = 128
"""Number of the latest copies of a query whose replies are accepted."""
QUERY_PERIOD_NS = 200_000_000
"""Time between two queries for identities, in ns."""


class RepeatedQuery:
    """Sends a query repeatedly, and collects the replies to all of its copies.

    A query may be lost and is therefore sent several times. Each reply is assigned to the copy
    of the query that it answers, which gives the round trip time.

    Args:
        bus: Network connection of the member (process of a session) that sends the query.
        clock: Clock of that member.
        key: Key of the query. Every member that serves a matching key replies.
    """

    def __init__(self, bus: Bus, clock: Clock, key: str) -> None:
        self._bus = bus
        self._clock = clock
        self._key = key
        self._pending: deque[tuple[int, Inbox]] = deque(maxlen=QUERIES_KEPT)

    def repeat(self, period_ns: int = QUERY_PERIOD_NS) -> bool:
        """Sends the query again if enough time has passed since it was sent last.

        A query may be lost, or its receiver may have started later.

        Args:
            period_ns: Shortest time between two copies, in ns.

        Returns:
            True if the query was sent.
        """
        now_ns = self._clock.monotonic_ns()
        if self._pending:
            last_queried_ns, _inbox = self._pending[-1]
            if now_ns - last_queried_ns < period_ns:
                return False
        self._pending.append((now_ns, self._bus.query(self._key)))
        return True

    def poll(self) -> tuple[int, str, bytes] | None:
        """Returns the next reply that has arrived for the query, without waiting.

        Returns:
            The time at which the query was sent in ns, the key and the payload of the reply.
            None if no reply has arrived.
        """
        for queried_ns, inbox in self._pending:
            reply = inbox.poll()
            if reply is not None:
                key, payload = reply
                return queried_ns, key, payload
        return None


PINGS = 20
"""Number of round trips after which the clock of a member counts as known."""
PINGS_PER_WINDOW = 5
"""Number of round trips in a window. Of each window, only the most precise limits are used."""
PING_PACE_NS = 10_000_000
"""Time between two pings until all clocks are known, in ns."""
PING_REST_NS = 250_000_000
"""Time between two pings when all clocks are known, to keep the estimates up to date, in ns."""
GLANCE_NS = 100_000
"""Time between two polls while a reply is expected, in ns.

It is short because the arrival of a reply is measured when it is polled.
"""
_ROUND_TRIPS_KEPT = 10_000
"""Number of the latest round trips that are kept for statistics."""
_LATE_REPLY_NS = 20_000_000
"""Margin for the time in which a reply is expected, in ns. Two round trips are added to it."""


def answer_pings(
    bus: Bus,
    clock: Clock,
    session: str,
    info: Info,
) -> None:
    """Replies to pings in a network thread, until the network connection is closed.

    A ping is a query to which a member (process of a session) replies at once with two time
    stamps (`Pong`). From the replies, the sender computes round trip times and the offset
    between the clocks.

    Args:
        bus: Network connection of the member.
        clock: Clock of the member.
        session: Name of the session.
        info: Identity of the member.
    """

    def answer(_: bytes) -> bytes:
        """Returns the reply to a ping: the clock's readings on its arrival and at the reply.

        The sender subtracts the time between both readings from the measured round trip.
        """
        received_ns = clock.monotonic_ns()
        sent_ns = clock.monotonic_ns()
        pong = Pong(
            member=info.member,
            boot=info.boot,
            clock=info.clock,
            came_ns=received_ns,
            left_ns=sent_ns,
        )
        return encode(pong)

    bus.respond(topics.key(session, info.member, topics.PING), answer)


def answer_backfill(
    query: Query,
    member: str,
    boot: int,
    find: Callable[[BackfillRequest], tuple[int, list[bytes], int]],
) -> int:
    """Sends messages again that were lost on the way to a recorder, at its request.

    Args:
        query: The query as it has arrived from the recorder.
        member: Name of the member (process of a session) that replies.
        boot: Random number that identifies this start of the member.
        find: Function that looks up the requested messages among those that the member still
            stores. It returns the number of the first message, the payloads of consecutive
            messages, and the number of messages that the member has published.

    Returns:
        The number of messages in the reply. 0 if the query cannot be decoded, in which case no
        reply is sent.
    """
    try:
        request = decode(query.payload, BackfillRequest)
    except WireError:
        return 0  # sent by another program

    first, payloads, published = find(request)
    backfill = Backfill(
        member=member,
        boot=boot,
        channel=request.channel,
        first=first,
        payloads=payloads,
        made=published,
    )
    query.reply(encode(backfill))
    return len(payloads)


class RoundTrips:
    """Estimates the clock offset of one member from round trips: pings and their replies.

    A member is a process that takes part in a session. It replies to a ping at once, with the
    readings of its clock. `Pinger` creates one object of this class for each start of a member.

    Args:
        required: Number of round trips after which the clock offset counts as known. The count
            starts again when round trips contradict each other.

    Attributes:
        rtts_ns: The latest round trip times in ns, without the time that the member took to
            reply.
        shortest_ns: The shortest round trip time in ns. 0 before the first round trip.
        estimator: Estimator of the clock offset, with the limits from all round trips so far.
        latest: Latest estimate of the clock offset. None before the first estimate.
    """

    def __init__(self, required: int) -> None:
        self._required = required
        self.rtts_ns: deque[int] = deque(maxlen=_ROUND_TRIPS_KEPT)
        self.shortest_ns = 0
        self.estimator = OffsetEstimator()
        self.latest: OffsetEstimate | None = None
        self._window: list[tuple[OffsetLimit, OffsetLimit]] = []
        self._agreeing = 0

    @property
    def is_known(self) -> bool:
        """True once the offset between two clocks is known.

        It is known when enough measured round trips of messages agree with each other.
        """
        return self._agreeing >= self._required

    def receive(self, pinged_ns: int, pong: Pong, now_ns: int) -> None:
        """Evaluates the reply to a ping. A reply with impossible times is ignored.

        The offset (member's clock minus local clock) is at most the arrival of the ping minus
        its sending, and at least the sending of the reply minus its arrival.

        Args:
            pinged_ns: Time at which the ping was sent, on the local clock, in ns.
            pong: The reply of the member (process of a session), with the times at which the
                ping arrived and the reply left.
            now_ns: Time at which the reply arrived, on the local clock, in ns.
        """
        reply_time_ns = pong.left_ns - pong.came_ns
        rtt_ns = now_ns - pinged_ns - reply_time_ns
        if rtt_ns < 0 or reply_time_ns < 0:
            return
        self.shortest_ns = min(self.shortest_ns, rtt_ns) if self.rtts_ns else rtt_ns
        self.rtts_ns.append(rtt_ns)
        ceiling = OffsetLimit(pinged_ns, pong.came_ns - pinged_ns)
        floor = OffsetLimit(now_ns, pong.left_ns - now_ns)
        self._window.append((ceiling, floor))
        if len(self._window) == PINGS_PER_WINDOW:
            self._close_window(now_ns)

    def _close_window(self, now_ns: int) -> None:
        """Estimates the offset from the tightest limits of the window, and starts a new one.

        Limits from different times are extrapolated to the present with the last estimate of
        the drift, and then compared.

        Args:
            now_ns: Present time on the local clock, in ns.
        """
        drift_per_ns = self.latest.drift / NS_PER_S if self.latest else 0.0

        def extrapolate_limit(limit: OffsetLimit) -> float:
            """Returns a limit of the clock offset at the present time, in ns.

            The limit was measured earlier, and moves with the drift of the clocks.
            """
            return limit.offset_ns - drift_per_ns * (limit.local_ns - now_ns)

        ceilings, floors = zip(*self._window, strict=True)
        self._window = []
        lowest_ceiling = min(ceilings, key=extrapolate_limit)
        highest_floor = max(floors, key=extrapolate_limit)
        self.estimator.add(lowest_ceiling, highest_floor)
        estimate = self.estimator.estimate(now_ns)
        if estimate is None:  # the clock has stepped, so earlier round trips no longer count
            self._agreeing = 0
            return
        self._agreeing += PINGS_PER_WINDOW
        self.latest = estimate


class Pinger:
    """Sends pings to the members of a session, and estimates the offsets of their clocks.

    The owner calls `poll` regularly.

    Args:
        bus: Network connection of this member.
        clock: Clock of this member.
        session: Name of the session.
        required: Number of round trips after which the offset of a clock counts as known, if
            they do not contradict each other.

    Attributes:
        trips: Round trips to each member, by its boot, the random number that identifies the
            start of the member's process.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        required: int = PINGS,
    ) -> None:
        """Prepares to measure round trips to other processes, but sends no ping yet."""
        self.trips: dict[int, RoundTrips] = {}
        self._clock = clock
        self._required = required
        self._query = RepeatedQuery(bus, clock, topics.key(session, "*", topics.PING))
        # Time on the local clock until which a reply to the latest ping is expected.
        self._reply_expected_until_ns = 0

    def poll(self, boots: Collection[int]) -> None:
        """Sends a ping to the other members if it is due, and evaluates the replies to pings.

        A ping is a query to which a member replies with the readings of its clock. The method
        does not wait for replies. Until the offsets of all clocks are known, pings are sent
        with the short period `PING_PACE_NS`. Afterwards, the longer period `PING_REST_NS`
        suffices to keep the estimates up to date.

        Args:
            boots: Boots of the members whose replies are evaluated. A boot is a number that
                identifies one start of a process. If there are no boots, no ping is sent.
        """
        period_ns = PING_REST_NS if self.knows_clocks(boots) else PING_PACE_NS
        was_ping_sent = bool(boots) and self._query.repeat(period_ns)
        if was_ping_sent:
            # Until this time, `pause_ns` makes the caller poll often. The arrival of a reply is
            # measured when it is polled, so late polling makes the measurement worse.
            longest_reply_ns = 2 * self.slowest_ns() + _LATE_REPLY_NS
            self._reply_expected_until_ns = self._clock.monotonic_ns() + longest_reply_ns
        while (reply := self._query.poll()) is not None:
            pinged_ns, key, payload = reply
            now_ns = self._clock.monotonic_ns()
            parts = topics.parse_key(key)
            try:
                pong = decode(payload, Pong)
            except WireError:
                continue  # a reply of another program
            is_from_member = parts is not None and parts.member == pong.member
            if is_from_member and pong.boot in boots:
                trips = self.trips.setdefault(pong.boot, RoundTrips(self._required))
                trips.receive(pinged_ns, pong, now_ns)

    def knows_clocks(self, boots: Collection[int]) -> bool:
        """Returns True if the clock offsets to all of the given processes are known.

        Args:
            boots: Boots of these members, the numbers that identify the starts of their
                processes.
        """
        return all(boot in self.trips and self.trips[boot].is_known for boot in boots)

    def estimate(self, boot: int) -> OffsetEstimate:
        """Returns the latest estimate of the offset of a member's clock.

        The offset is exactly zero for a member without an estimate, because only members on
        other machines are pinged.

        Args:
            boot: Boot of the member, the number that identifies the start of its process.
        """
        trips = self.trips.get(boot)
        if trips is None or trips.latest is None:
            return OffsetEstimate.exact(0)
        return trips.latest

    def estimator(self, boot: int) -> OffsetEstimator | None:
        """Returns the object that estimates the clock offset of a member.

        It contains the limits of the offset from all pings to this member so far.

        Args:
            boot: Boot of the member, the number that identifies the start of its process.

        Returns:
            The estimator. None if the member has not replied to any ping.
        """
        trips = self.trips.get(boot)
        return None if trips is None else trips.estimator

    def slowest_ns(self) -> int:
        """Returns the largest round trip time to any member, in ns.

        The round trip time of a member is the shortest one that was measured, because longer
        ones contain waiting times. The result is 0 if nothing has been measured yet.
        """
        return max((trips.shortest_ns for trips in self.trips.values()), default=0)

    def pause_ns(self, otherwise_ns: int) -> int:
        """Returns how long the caller may wait until the next poll, in ns.

        While replies to pings are expected, the pause is short, so that they are evaluated
        soon.

        Args:
            otherwise_ns: Pause while no reply to a ping is expected, in ns.
        """
        if self._clock.monotonic_ns() < self._reply_expected_until_ns:
            return min(GLANCE_NS, otherwise_ns)
        return otherwise_ns

    def describe_clocks(self, boots: Mapping[str, int], local_ns: int) -> list[str]:
        """Describes the clocks of the members on other machines, for the user.

        Members on this machine use the same clock and are left out.

        Args:
            boots: Boot of each member, the number that identifies the start of its process, by
                name.
            local_ns: Time on the local clock for which the offsets are stated, in ns.

        Returns:
            One sentence for each member on another machine.
        """
        texts = []
        for name, boot in boots.items():
            if boot in self.trips:
                estimate = self.estimate(boot)
                offset_ns = estimate.extrapolate_ns(local_ns)
                offset = format_offset(offset_ns, estimate.error_bound_ns(local_ns, offset_ns))
                texts.append(f"clock of {name}: another one, {offset}")
        return texts

"""Measures the clocks of other processes with pings, and repeats queries over a poor network.

A ping is a query that a process answers immediately with two readings of its clock: when the
ping arrived, and when the reply was sent. This determines the difference between its clock and
the local clock to within half the round trip, however large the difference is. A round trip of
0.4 ms, for example, gives the difference to within 0.2 ms.

Queries and replies may be lost, or may take longer than the interval between two queries.
Queries are therefore repeated, and replies to the last QUERIES_KEPT copies are accepted.
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
"""Number of most recent copies of a query whose replies are accepted."""
QUERY_PERIOD_NS = 200_000_000
"""Time between two queries for identities, in ns."""


class RepeatedQuery:
    """Sends a query repeatedly, in case it is lost, and collects the replies to all copies.

    Each reply is matched to the copy of the query that it answers, which gives the round trip
    time.

    Args:
        bus: Network connection of the member that sends the query.
        clock: Clock of that member.
        key: Key of the query. Every member that serves a matching key replies.
    """

    def __init__(self, bus: Bus, clock: Clock, key: str) -> None:
        self._bus = bus
        self._clock = clock
        self._key = key
        self._pending: deque[tuple[int, Inbox]] = deque(maxlen=QUERIES_KEPT)

    def repeat(self, period_ns: int = QUERY_PERIOD_NS) -> bool:
        """Sends the query again if enough time has passed since the last copy.

        Returns True if the query was sent. A repetition is needed because a query may be lost,
        and its receiver may start later.

        Args:
            period_ns: Shortest interval between two copies, in ns.
        """
        now_ns = self._clock.monotonic_ns()
        if self._pending:
            last_queried_ns, _inbox = self._pending[-1]
            if now_ns - last_queried_ns < period_ns:
                return False
        self._pending.append((now_ns, self._bus.query(self._key)))
        return True

    def poll(self) -> tuple[int, str, bytes] | None:
        """Returns the next reply to the query if one has arrived, without waiting.

        Returns:
            The time at which the query was sent (in ns), the key of the reply and its payload.
            None if no reply has arrived.
        """
        for queried_ns, inbox in self._pending:
            reply = inbox.poll()
            if reply is not None:
                key, payload = reply
                return queried_ns, key, payload
        return None


PINGS = 20
"""Number of round trips after which the clock of a member is considered known."""
PINGS_PER_WINDOW = 5
"""Number of round trips in a window. Only the most precise limits of each window are used."""
PING_PACE_NS = 10_000_000
"""Interval between pings until all clocks are known, in ns."""
PING_REST_NS = 250_000_000
"""Interval between pings that keep the estimates up to date once clocks are known, in ns."""
GLANCE_NS = 100_000
"""Interval between polls while a reply is expected, in ns.

It is short because the arrival time of a reply is taken when the reply is polled.
"""
_ROUND_TRIPS_KEPT = 10_000
"""Number of most recent round trips that are kept for statistics."""
_LATE_REPLY_NS = 20_000_000
"""Margin of the time within which a reply is expected, in ns. Two round trips are added."""


def answer_pings(
    bus: Bus,
    clock: Clock,
    session: str,
    info: Info,
) -> None:
    """Answers pings in a network thread until the network connection is closed.

    The reply contains two time stamps (`Pong`), from which the sender of the ping computes the
    round trip time and the offset between the clocks.

    Args:
        bus: Network connection of the member.
        clock: Clock of the member.
        session: Name of the session.
        info: Identity of the member.
    """

    def answer(_: bytes) -> bytes:
        """Returns the reply to a ping, with the times of the ping's arrival and of the reply.

        The sender of the ping subtracts the time between these two from the measured round trip
        time.
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
    """Resends messages that a recorder has missed, at the recorder's request.

    Args:
        query: The query received from the recorder.
        member: Name of the member that replies.
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
    """Estimates the clock offset of one member from the round trip times of pings.

    A member answers a ping immediately with the readings of its clock. `Pinger` creates one
    object of this class per start of a member.

    Args:
        required: Number of round trips after which the clock offset is considered known. The
            count restarts when round trips contradict each other.

    Attributes:
        rtts_ns: The most recent round trip times in ns, excluding the time that the member took
            to reply.
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
        """True once enough round trips agree for the clock offset to be known."""
        return self._agreeing >= self._required

    def receive(self, pinged_ns: int, pong: Pong, now_ns: int) -> None:
        """Evaluates the reply to a ping. A reply with impossible times is ignored.

        The offset (member's clock minus local clock) is at most the arrival time of the ping
        minus its sending time, and at least the sending time of the reply minus its arrival
        time.

        Args:
            pinged_ns: Time at which the ping was sent, on the local clock, in ns.
            pong: The member's reply, with the times at which the ping arrived and the reply was
                sent.
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

        Limits from different times are extrapolated to the present with the last drift
        estimate, and then compared.

        Args:
            now_ns: Present time on the local clock, in ns.
        """
        drift_per_ns = self.latest.drift / NS_PER_S if self.latest else 0.0

        def extrapolate_limit(limit: OffsetLimit) -> float:
            """Extrapolates a limit on the clock offset to the present time, in ns.

            The limit was measured earlier, and shifts with the drift of the clocks.
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
    """Pings the members of a session and estimates the offsets of their clocks.

    The owner must call `poll` regularly.

    Args:
        bus: Network connection of this member.
        clock: Clock of this member.
        session: Name of the session.
        required: Number of round trips after which the offset of a clock is considered known,
            provided they do not contradict each other.

    Attributes:
        trips: Mapping from the boot of each member (the random number that identifies the start
            of its process) to the round trips.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        required: int = PINGS,
    ) -> None:
        """Prepares to measure round trips to other processes. No ping is sent yet."""
        self.trips: dict[int, RoundTrips] = {}
        self._clock = clock
        self._required = required
        self._query = RepeatedQuery(bus, clock, topics.key(session, "*", topics.PING))
        # Time on the local clock until which a reply to the latest ping is expected.
        self._reply_expected_until_ns = 0

    def poll(self, boots: Collection[int]) -> None:
        """Pings the other members if a ping is due, and evaluates replies received so far.

        Never waits for replies. Pings are sent with the short period `PING_PACE_NS` until the
        offsets of all clocks are known. After that, the longer period `PING_REST_NS` is enough
        to keep the estimates up to date.

        Args:
            boots: Boots of the members whose replies are evaluated. If empty, no ping is sent.
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
        """Returns True if the clock offsets of all given members are known.

        Args:
            boots: Boots of the members, the numbers that identify the starts of their
                processes.
        """
        return all(boot in self.trips and self.trips[boot].is_known for boot in boots)

    def estimate(self, boot: int) -> OffsetEstimate:
        """Returns the latest estimate of the offset of a member's clock.

        A member without an estimate has an offset of exactly zero, because offsets are
        estimated only for members on other machines.

        Args:
            boot: Boot of the member, the number that identifies the start of its process.
        """
        trips = self.trips.get(boot)
        if trips is None or trips.latest is None:
            return OffsetEstimate.exact(0)
        return trips.latest

    def estimator(self, boot: int) -> OffsetEstimator | None:
        """Returns the estimator of a member's clock offset, or None before its first reply.

        The estimator holds the limits on the offset from all pings to this member so far.

        Args:
            boot: Boot of the member, the number that identifies the start of its process.
        """
        trips = self.trips.get(boot)
        return None if trips is None else trips.estimator

    def slowest_ns(self) -> int:
        """Returns the round trip time to the slowest member, in ns; 0 if none was measured.

        The shortest measured round trip of each member is compared, because longer ones include
        waiting times.
        """
        return max((trips.shortest_ns for trips in self.trips.values()), default=0)

    def pause_ns(self, otherwise_ns: int) -> int:
        """Returns how long the caller may wait until the next poll, in ns.

        The pause is short while replies to pings are expected, so that they are evaluated
        promptly.

        Args:
            otherwise_ns: Pause while no reply to a ping is expected, in ns.
        """
        if self._clock.monotonic_ns() < self._reply_expected_until_ns:
            return min(GLANCE_NS, otherwise_ns)
        return otherwise_ns

    def describe_clocks(self, boots: Mapping[str, int], local_ns: int) -> list[str]:
        """Describes the clock of each member on another machine in one sentence, for the user.

        Members on this machine share its clock and are omitted.

        Args:
            boots: Mapping from the name of each member to its boot, the number that identifies
                the start of its process.
            local_ns: Time on the local clock for which the offsets are stated, in ns.
        """
        texts = []
        for name, boot in boots.items():
            if boot in self.trips:
                estimate = self.estimate(boot)
                offset_ns = estimate.extrapolate_ns(local_ns)
                offset = format_offset(offset_ns, estimate.error_bound_ns(local_ns, offset_ns))
                texts.append(f"clock of {name}: another one, {offset}")
        return texts

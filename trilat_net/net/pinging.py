"""Repeated queries over a slow network, and pings, which measure the clocks of members.

A member replies to a ping at once, in a thread of its bus, with the readings of its clock on
receiving and on sending. The member that pinged then knows that clock to half the round trip,
however far the two clocks differ.

Invariant:
    - A reply counts however late it arrives, as long as its query is one of the last
      QUERIES_KEPT.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping

from ..core.ticks import NS_PER_S
from ..errors import WireError
from . import topics
from .bus import Bus, Inbox, Query
from .clock import Clock
from .messages import Info
from .offset import OffsetEstimate, OffsetEstimator, OffsetLimit, exact_offset, format_offset
from .requests import Backfill, BackfillRequest, Pong
from .wire import decode, encode

QUERIES_KEPT = 128
"""Number of queries whose replies still count."""
QUERY_PERIOD_NS = 200_000_000
"""Time between two queries for identities, in ns."""


class RepeatedQuery:
    """A query that is sent periodically; replies to its last QUERIES_KEPT copies count."""

    def __init__(self, bus: Bus, clock: Clock, key: str) -> None:
        self._bus = bus
        self._clock = clock
        self._key = key
        self._pending: deque[tuple[int, Inbox]] = deque(maxlen=QUERIES_KEPT)

    def repeat(self, period_ns: int = QUERY_PERIOD_NS) -> bool:
        """Sends the query if a period has passed since the last; True if it was sent."""
        now_ns = self._clock.monotonic_ns()
        is_due = not self._pending or now_ns - self._pending[-1][0] >= period_ns
        if is_due:
            self._pending.append((now_ns, self._bus.query(self._key)))
        return is_due

    def poll(self) -> tuple[int, str, bytes] | None:
        """Returns the next reply, or None if there is none yet; never waits.

        Returns:
            The sending time of the query in ns, and the key and the payload of the reply.
        """
        for queried_ns, inbox in self._pending:
            reply = inbox.poll()
            if reply is not None:
                key, payload = reply
                return queried_ns, key, payload
        return None


PINGS = 20
"""Number of round trips after which a member's clock counts as known."""
PINGS_PER_WINDOW = 5
"""Number of round trips in a window, of which the tightest limits are kept."""
PING_PACE_NS = 10_000_000
"""Time between two pings until all clocks are known, in ns."""
PING_REST_NS = 250_000_000
"""Time between two pings afterwards, so that the estimates stay fresh, in ns."""
GLANCE_NS = 100_000
"""Time between two polls while a reply is under way, in ns.

It is short because replies are stamped when they are polled.
"""
_ROUND_TRIPS_KEPT = 10_000
_LATE_REPLY_NS = 20_000_000
"""Time added to two round trips in which a reply is expected, in ns."""


def answer_pings(bus: Bus, clock: Clock, session: str, info: Info) -> None:
    """Replies to pings of a member, in a thread of the bus, until the bus is closed."""

    def answer(_: bytes) -> bytes:
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
    """Replies to a recorder's query for missing messages.

    Args:
        query: the query of the recorder.
        member: name of the replying member.
        boot: boot of that member.
        find: returns the number of the first message found, the payloads of the messages, and
            the number of messages that the member has published.

    Returns:
        The number of messages sent; 0 for an unreadable query, which gets no reply.
    """
    try:
        request = decode(query.payload, BackfillRequest)
    except WireError:
        return 0  # a query of a stranger
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
    """The round trips of pings to one start of a member.

    Args:
        required: number of agreeing round trips after which the member's clock is known.

    Attributes:
        rtts_ns: the latest round trips, without the time between the member's two stamps.
        shortest_ns: the shortest round trip; 0 before the first.
        estimator: limits of the offset of the member's clock.
        latest: the latest estimate of that offset; None before the first.
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
        """True once enough round trips agree."""
        return self._agreeing >= self._required

    def receive(self, pinged_ns: int, pong: Pong, now_ns: int) -> None:
        """Receives the reply to a ping; an impossible reply is ignored.

        Args:
            pinged_ns: sending time of the ping, on the local clock.
            pong: the reply.
            now_ns: arrival of the reply, on the local clock.
        """
        rtt_ns = now_ns - pinged_ns - (pong.left_ns - pong.came_ns)
        if rtt_ns < 0 or pong.left_ns < pong.came_ns:
            return
        self.shortest_ns = min(self.shortest_ns, rtt_ns) if self.rtts_ns else rtt_ns
        self.rtts_ns.append(rtt_ns)
        ceiling = OffsetLimit(pinged_ns, pong.came_ns - pinged_ns)
        floor = OffsetLimit(now_ns, pong.left_ns - now_ns)
        self._window.append((ceiling, floor))
        if len(self._window) == PINGS_PER_WINDOW:
            self._close_window(now_ns)

    def _close_window(self, now_ns: int) -> None:
        """Adds the tightest limits of the window to the estimator, and estimates the offset."""
        drift_per_ns = self.latest.drift / NS_PER_S if self.latest else 0.0

        def extrapolate_limit(limit: OffsetLimit) -> float:
            return limit.offset_ns - drift_per_ns * (limit.local_ns - now_ns)

        ceilings, floors = zip(*self._window, strict=True)
        self._window = []
        lowest_ceiling = min(ceilings, key=extrapolate_limit)
        highest_floor = max(floors, key=extrapolate_limit)
        self.estimator.add(lowest_ceiling, highest_floor)
        estimate = self.estimator.estimate(now_ns)
        if estimate is None:  # the clock has stepped: earlier round trips do not count
            self._agreeing = 0
            return
        self._agreeing += PINGS_PER_WINDOW
        self.latest = estimate


class Pinger:
    """Pings the members of a session; call `poll` regularly.

    Args:
        bus: connection of this member.
        clock: clock of this member.
        session: name of the session.
        required: number of agreeing round trips after which a clock is known.

    Attributes:
        trips: round trips by boot of the member.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, required: int = PINGS) -> None:
        self.trips: dict[int, RoundTrips] = {}
        self._clock = clock
        self._required = required
        self._query = RepeatedQuery(bus, clock, topics.key(session, "*", topics.PING))
        self._reply_expected_until_ns = 0

    def poll(self, boots: Collection[int]) -> None:
        """Sends a ping if it is due, and receives the replies of members.

        Args:
            boots: boots of the members whose replies count.
        """
        period_ns = PING_REST_NS if self.knows_clocks(boots) else PING_PACE_NS
        if boots and self._query.repeat(period_ns):
            expected_ns = 2 * self.slowest_ns() + _LATE_REPLY_NS
            self._reply_expected_until_ns = self._clock.monotonic_ns() + expected_ns
        while (reply := self._query.poll()) is not None:
            pinged_ns, key, payload = reply
            now_ns = self._clock.monotonic_ns()
            parts = topics.parse_key(key)
            try:
                pong = decode(payload, Pong)
            except WireError:
                continue  # a reply of a stranger
            if parts is not None and parts.member == pong.member and pong.boot in boots:
                trips = self.trips.setdefault(pong.boot, RoundTrips(self._required))
                trips.receive(pinged_ns, pong, now_ns)

    def knows_clocks(self, boots: Collection[int]) -> bool:
        """True if the clocks of all members with these boots are known."""
        return all(boot in self.trips and self.trips[boot].is_known for boot in boots)

    def estimate(self, boot: int) -> OffsetEstimate:
        """Returns the latest estimate of the offset of a member's clock.

        Without any round trip, the member counts as sharing the local clock.
        """
        trips = self.trips.get(boot)
        if trips is None or trips.latest is None:
            return exact_offset(0)
        return trips.latest

    def estimator(self, boot: int) -> OffsetEstimator | None:
        """Returns the limits of a member's clock, or None if it is the local clock."""
        trips = self.trips.get(boot)
        return None if trips is None else trips.estimator

    def slowest_ns(self) -> int:
        """Returns the longest of the members' shortest round trips, ns; 0 before the first."""
        return max((trips.shortest_ns for trips in self.trips.values()), default=0)

    def pause_ns(self, otherwise_ns: int) -> int:
        """Returns the time until the next poll, in ns: `otherwise_ns` unless a reply is due."""
        if self._clock.monotonic_ns() < self._reply_expected_until_ns:
            return min(GLANCE_NS, otherwise_ns)
        return otherwise_ns


def describe_clocks(pinger: Pinger, boots: Mapping[str, int], local_ns: int) -> list[str]:
    """Returns a sentence for every member on another clock.

    Args:
        pinger: the round trips to the members.
        boots: boots of the members, by name.
        local_ns: instant of the local clock for which the offsets are stated.
    """
    texts = []
    for name, boot in boots.items():
        if boot in pinger.trips:
            estimate = pinger.estimate(boot)
            offset_ns = estimate.extrapolate_ns(local_ns)
            offset = format_offset(offset_ns, estimate.error_bound_ns(local_ns, offset_ns))
            texts.append(f"clock of {name}: another one, {offset}")
    return texts

"""Queries: repeated over a slow network, for missed messages, and pings, which tell of clocks.

Invariant: a reply counts however many queries later it arrives, as long as its query is one of
the last QUERIES_KEPT. A member answers a ping at once, in a thread of its bus, with its clock's
reading; the asker then knows that clock to half the round trip, however far the clocks differ.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any

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
QUERY_EVERY_NS = 200_000_000
"""Between two queries for identities."""


class RepeatedQuery:
    """A query that is sent again and again; answers to the last QUERIES_KEPT of them count."""

    def __init__(self, bus: Bus, clock: Clock, key: str) -> None:
        self._bus = bus
        self._clock = clock
        self._key = key
        self._open: deque[tuple[int, Inbox]] = deque(maxlen=QUERIES_KEPT)

    def repeat(self, every_ns: int = QUERY_EVERY_NS) -> bool:
        """Sends the query if the last one is that long ago; True if so."""
        now_ns = self._clock.monotonic_ns()
        due = not self._open or now_ns - self._open[-1][0] >= every_ns
        if due:
            self._open.append((now_ns, self._bus.query(self._key)))
        return due

    def poll(self) -> tuple[int, str, bytes] | None:
        """Returns when a query was sent, ns, and key and payload of its answer; None without.
        Never waits.
        """
        for asked_ns, inbox in self._open:
            if (reply := inbox.poll()) is not None:
                return asked_ns, *reply
        return None


PINGS = 20
"""Round trips until a member's clock counts as known."""
PINGS_PER_WINDOW = 5
"""Round trips of which the tightest limits are kept."""
PING_PACE_NS = 10_000_000
"""Between two pings until all clocks are known."""
PING_REST_NS = 250_000_000
"""Between two pings afterwards, so that the estimates stay fresh."""
GLANCE_NS = 100_000
"""Between two polls while an answer is under way: polling stamps it."""
_ROUND_TRIPS_KEPT = 10_000
_STRAGGLE_NS = 20_000_000


def answer_pings(bus: Bus, clock: Clock, session: str, info: Info) -> None:
    """Answers pings until the bus is closed."""

    def answer(_: bytes) -> bytes:
        came_ns = clock.monotonic_ns()
        left_ns = clock.monotonic_ns()
        return encode(
            Pong(
                member=info.member,
                boot=info.boot,
                clock=info.clock,
                came_ns=came_ns,
                left_ns=left_ns,
            )
        )

    bus.respond(topics.key(session, info.member, topics.PING), answer)


def answer_backfill(
    query: Query,
    member: str,
    boot: int,
    find: Callable[[BackfillRequest], tuple[int, list[bytes], int]],
) -> int:
    """Answers a recorder's query for messages that it missed; returns how many it gets.

    `find` returns the number of the first one, the messages, and how many the member has made.
    """
    try:
        wanted = decode(query.payload, BackfillRequest)
    except WireError:
        return 0  # a stranger's: it gets no answer
    first, payloads, made = find(wanted)
    found: dict[str, Any] = {
        "channel": wanted.channel,
        "first": first,
        "payloads": payloads,
        "made": made,
    }
    query.reply(encode(Backfill(member=member, boot=boot, **found)))
    return len(payloads)


class RoundTrips:
    """The round trips to one start of a member; its clock counts as known after `enough` that
    agree.

    Attributes:
        rtts_ns: the latest round trips, without the time that the member held them.
    """

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self.rtts_ns: deque[int] = deque(maxlen=_ROUND_TRIPS_KEPT)
        self.shortest_ns = 0
        self.estimator = OffsetEstimator()
        self.latest: OffsetEstimate | None = None
        self._window: list[tuple[OffsetLimit, OffsetLimit]] = []
        self._agreeing = 0

    @property
    def is_known(self) -> bool:
        """True once there are enough round trips that agree."""
        return self._agreeing >= self._enough

    def receive(self, asked_ns: int, pong: Pong, now_ns: int) -> None:
        """Takes one round trip; ignores an impossible one."""
        rtt_ns = now_ns - asked_ns - (pong.left_ns - pong.came_ns)
        if rtt_ns < 0 or pong.left_ns < pong.came_ns:
            return
        self.shortest_ns = min(self.shortest_ns, rtt_ns) if self.rtts_ns else rtt_ns
        self.rtts_ns.append(rtt_ns)
        self._window.append(
            (
                OffsetLimit(asked_ns, pong.came_ns - asked_ns),
                OffsetLimit(now_ns, pong.left_ns - now_ns),
            )
        )
        if len(self._window) < PINGS_PER_WINDOW:
            return
        drift = self.latest.drift / NS_PER_S if self.latest else 0.0

        def offset_now(limit: OffsetLimit) -> float:
            return limit.offset_ns - drift * (limit.local_ns - now_ns)

        ceilings, floors = zip(*self._window, strict=True)
        self._window = []
        self.estimator.add(min(ceilings, key=offset_now), max(floors, key=offset_now))
        estimate = self.estimator.estimate(now_ns)
        self._agreeing = self._agreeing + PINGS_PER_WINDOW if estimate else 0
        self.latest = estimate or self.latest


class Pinger:
    """Pings every member of a session, by its boot; call `poll` again and again."""

    def __init__(self, bus: Bus, clock: Clock, session: str, enough: int = PINGS) -> None:
        self.trips: dict[int, RoundTrips] = {}
        self._clock = clock
        self._enough = enough
        self._query = RepeatedQuery(bus, clock, topics.key(session, "*", topics.PING))
        self._glance_until_ns = 0

    def poll(self, wanted: Collection[int]) -> None:
        """Sends a ping if it is due, and takes the answers that have arrived from the boots
        wanted.
        """
        pace_ns = PING_REST_NS if self.knows_clocks(wanted) else PING_PACE_NS
        if wanted and self._query.repeat(pace_ns):
            self._glance_until_ns = (
                self._clock.monotonic_ns() + 2 * self.slowest_ns() + _STRAGGLE_NS
            )
        while (reply := self._query.poll()) is not None:
            asked_ns, key, payload = reply
            now_ns = self._clock.monotonic_ns()
            parts = topics.parse_key(key)
            try:
                pong = decode(payload, Pong)
            except WireError:
                continue  # a stranger's
            if parts is not None and parts.member == pong.member and pong.boot in wanted:
                trips = self.trips.setdefault(pong.boot, RoundTrips(self._enough))
                trips.receive(asked_ns, pong, now_ns)

    def knows_clocks(self, boots: Collection[int]) -> bool:
        """True once the clocks of all these members are known."""
        return all(boot in self.trips and self.trips[boot].is_known for boot in boots)

    def estimate(self, boot: int) -> OffsetEstimate:
        """Returns the latest estimate of a member's clock; exactly the own clock without pings
        to it.
        """
        trips = self.trips.get(boot)
        return exact_offset(0) if trips is None or trips.latest is None else trips.latest

    def estimator(self, boot: int) -> OffsetEstimator | None:
        """Returns the limits of a member's clock, or None if it is the own clock."""
        trips = self.trips.get(boot)
        return None if trips is None else trips.estimator

    def slowest_ns(self) -> int:
        """Returns the longest of the members' shortest round trips, ns; 0 before the first."""
        return max((trips.shortest_ns for trips in self.trips.values()), default=0)

    def pause_ns(self, otherwise_ns: int) -> int:
        """Returns the time until the next poll, ns: short while answers are under way."""
        under_way = self._clock.monotonic_ns() < self._glance_until_ns
        return min(GLANCE_NS, otherwise_ns) if under_way else otherwise_ns


def describe_clocks(pinger: Pinger, boots: Mapping[str, int], at_ns: int) -> list[str]:
    """Returns a sentence for every member on another clock, as of an instant of the own clock."""
    texts = []
    for name, boot in boots.items():
        if boot in pinger.trips:
            estimate = pinger.estimate(boot)
            offset_ns = estimate.extrapolate_ns(at_ns)
            offset = format_offset(offset_ns, estimate.error_bound_ns(at_ns, offset_ns))
            texts.append(f"clock of {name}: another one, {offset}")
    return texts

"""Round trips to the members of a session, and what they say of the members' clocks.

Law: who is asked answers at once, in a thread of its bus, with what its clock read; who asks learns where
that clock stands, to half the round trip, however much the two clocks differ.
"""

from collections import deque
from collections.abc import Collection, Mapping

from ..core.grid import NS_PER_S
from ..errors import WireError
from . import topics
from .answers import Pong
from .asking import Asking
from .bus import Bus
from .clock import Clock
from .messages import Info
from .offset import Estimate, Limit, OffsetEstimator, known, offset_text
from .wire import decode, encode

PINGS = 20
"""Answers from a member until its clock counts as known."""
WINDOW = 5
"""Of so many the tightest are kept."""
PACE_NS = 10_000_000
"""Between two pings until then."""
REST_NS = 250_000_000
"""Between two pings afterwards, so that what is known does not grow old."""
GLANCE_NS = 100_000
"""How often to poll while an answer is under way: it is stamped when it is found."""
_KEPT = 10_000
_STRAGGLE_NS = 20_000_000


def answer_pings(bus: Bus, clock: Clock, session: str, info: Info) -> None:
    """Answers pings for as long as the bus stands."""

    def answer(_: bytes) -> bytes:
        came_ns = clock.monotonic_ns()
        pong = Pong(
            member=info.member,
            boot=info.boot,
            clock=info.clock,
            came_ns=came_ns,
            left_ns=clock.monotonic_ns(),
        )
        return encode(pong)

    bus.respond(topics.key(session, info.member, topics.PING), answer)


class Trips:
    """The round trips to one start of a member.

    Args:
        pong: its first answer.
        enough: round trips until its clock counts as known.

    Attributes:
        member: its name.
        clock: identity of its clock.
        rtts_ns: the round trips, without the time that it held them; the latest.
        shortest_ns: the shortest of all.
        estimator: all that they say of its clock.
        latest: where it stood last, or None before some answers.
    """

    def __init__(self, pong: Pong, enough: int) -> None:
        self._enough = enough
        self.member, self.clock = pong.member, pong.clock
        self.rtts_ns: deque[int] = deque(maxlen=_KEPT)
        self.shortest_ns = 0
        self.estimator = OffsetEstimator()
        self.latest: Estimate | None = None
        self._window: list[tuple[Limit, Limit]] = []
        self._agreeing = 0

    @property
    def known(self) -> bool:
        """True where there are enough round trips, and they agree."""
        return self._agreeing >= self._enough

    def take(self, asked_ns: int, pong: Pong, now_ns: int) -> None:
        """Takes one round trip; one that cannot be is passed over."""
        rtt_ns = now_ns - asked_ns - (pong.left_ns - pong.came_ns)
        if rtt_ns < 0 or pong.left_ns < pong.came_ns:
            return
        self.shortest_ns = min(self.shortest_ns, rtt_ns) if self.rtts_ns else rtt_ns
        self.rtts_ns.append(rtt_ns)
        self._window.append((Limit(asked_ns, pong.came_ns - asked_ns), Limit(now_ns, pong.left_ns - now_ns)))
        if len(self._window) == WINDOW:
            self._close(now_ns)

    def _close(self, now_ns: int) -> None:
        """Keeps the tightest of some, and draws the line."""
        drift = self.latest.drift / NS_PER_S if self.latest else 0.0

        def level(limit: Limit) -> float:
            return limit.offset_ns - drift * (limit.at_ns - now_ns)

        ceilings, floors = zip(*self._window, strict=True)
        self._window = []
        self.estimator.add(min(ceilings, key=level), max(floors, key=level))
        estimate = self.estimator.estimate(now_ns)
        self._agreeing = self._agreeing + WINDOW if estimate else 0
        self.latest = estimate or self.latest


class Pinger:
    """Pings every member of a session; call `poll` again and again.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        enough: round trips until a member's clock counts as known.

    Attributes:
        trips: what came of it, by the boot of who answered.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, enough: int = PINGS) -> None:
        self.trips: dict[int, Trips] = {}
        self._clock, self._enough = clock, enough
        self._asking = Asking(bus, clock, topics.key(session, "*", topics.PING))
        self._asked_ns = -REST_NS
        self._glance_until_ns = 0

    def poll(self, wanted: Collection[int]) -> None:
        """Asks if it is time, and takes the answers that have come.

        Args:
            wanted: boots of the members to learn the clocks of; nobody is asked where there are none.
        """
        if wanted:
            pace_ns = REST_NS if self.know(wanted) else PACE_NS
            if self._clock.monotonic_ns() - self._asked_ns >= pace_ns:
                self._asked_ns = self._asking.ask()
                self._glance_until_ns = self._asked_ns + 2 * self.slowest_ns() + _STRAGGLE_NS
        while (answer := self._asking.poll()) is not None:
            now_ns = self._clock.monotonic_ns()
            where = topics.address(answer.key)
            try:
                pong = decode(answer.payload, Pong)
            except WireError:
                continue  # a stranger's
            if where is not None and where.member == pong.member and pong.boot in wanted:
                self.trips.setdefault(pong.boot, Trips(pong, self._enough)).take(
                    answer.asked_ns, pong, now_ns
                )

    def know(self, boots: Collection[int]) -> bool:
        """True where enough answers have come from all of these."""
        return all(boot in self.trips and self.trips[boot].known for boot in boots)

    def estimate(self, boot: int) -> Estimate:
        """Returns where a member's clock stands, as last known: exactly here where nobody had to ask."""
        trips = self.trips.get(boot)
        return known(0) if trips is None or trips.latest is None else trips.latest

    def estimator(self, boot: int) -> OffsetEstimator | None:
        """Returns all that is known of a member's clock, or None where it is the own one."""
        trips = self.trips.get(boot)
        return None if trips is None else trips.estimator

    def slowest_ns(self) -> int:
        """Returns the longest of the members' shortest round trips, ns; 0 before the first."""
        return max((trips.shortest_ns for trips in self.trips.values()), default=0)

    def pause_ns(self, otherwise_ns: int) -> int:
        """Returns how long to wait before the next poll, ns: short while answers are under way."""
        under_way = self._clock.monotonic_ns() < self._glance_until_ns
        return min(GLANCE_NS, otherwise_ns) if under_way else otherwise_ns


def clock_texts(pinger: Pinger, boots: Mapping[str, int], at_ns: int) -> list[str]:
    """Returns a sentence for every member whose clock is another one, as of an instant of the own clock."""
    texts = []
    for name, boot in boots.items():
        if boot in pinger.trips:
            estimate = pinger.estimate(boot)
            offset_ns = estimate.offset_at(at_ns)
            known_text = offset_text(offset_ns, estimate.bound_at(at_ns, offset_ns))
            texts.append(f"clock of {name}: another one, {known_text}")
    return texts

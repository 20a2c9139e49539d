"""Two simulated clocks and a network between them, whose readings and true times are known."""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

from trilat_net.net.offset import OffsetLimit

S = 1_000_000_000
Delay = Callable[[random.Random], int]


def make_queueing_delay(floor_us: float, mean_us: float) -> Delay:
    """Returns a delay with a minimum and random queues."""
    return lambda rnd: int(1000 * (floor_us + rnd.expovariate(1.0 / mean_us)))


@dataclass
class Other:
    offset_ns: int
    drift_ppb: float
    wander: Callable[[int], float] = field(default=lambda _: 0.0)

    def offset(self, own_ns: int) -> float:
        return self.offset_ns + own_ns * self.drift_ppb / S + self.wander(own_ns)

    def reads(self, own_ns: int) -> int:
        return round(own_ns + self.offset(own_ns))


def make_ceiling(other: Other, sent_ns: int, delay_ns: int) -> OffsetLimit:
    """Returns the bound that a message sent from here gives, for its travel time."""
    return OffsetLimit(sent_ns, other.reads(sent_ns + delay_ns) - sent_ns)


def make_floor(other: Other, sent_ns: int, delay_ns: int) -> OffsetLimit:
    """Returns the bound that a message sent from there gives, for an instant of the own clock
    and its travel time.
    """
    return OffsetLimit(sent_ns + delay_ns, other.reads(sent_ns) - sent_ns - delay_ns)


def exchange_second(
    other: Other,
    begin_ns: int,
    way: Delay,
    back: Delay,
    rnd: random.Random,
    messages: int = 50,
) -> tuple[OffsetLimit, OffsetLimit]:
    """Returns the tightest bounds of a second of messages both ways, all of which have arrived
    within that second.
    """
    ceilings = []
    floors = []
    for n in range(messages):
        at_ns = begin_ns + n * (S // 2) // messages
        ceilings.append(make_ceiling(other, at_ns, way(rnd)))
        floors.append(make_floor(other, at_ns, back(rnd)))
    level = lambda limit: limit.offset_ns - other.drift_ppb * limit.local_ns / S  # noqa: E731
    return min(ceilings, key=level), max(floors, key=level)

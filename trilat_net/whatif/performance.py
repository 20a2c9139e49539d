"""The rerun itself: the sites that are executed take turns, each against what came to it.

Law: a site takes in the samples of recorded peers as they stand in the log, and those of peers that are
executed too as they are made now, each at the tick at which the log says that it came. So the network stays
the log's; what a link does to samples besides is the scenario's.
"""

import bisect
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from ..core.tick import Output
from ..errors import LogError
from ..log.chunks import Progress
from ..log.reader import Log
from ..replay.resumption import Pose
from ..replay.verify import last_ticks
from .actor import Actor, Made
from .delivery import Deliveries, Sender, complete, recorded, retimed
from .premise import Premise

_TELL_EVERY = 1000
MEMORY_S = 120
"""How long a sample that was made now may be under way, s: longer than any queue holds one."""


class Sample(NamedTuple):
    """What others need of a tick."""

    q: list[float]
    qd: list[float]
    tau_x: list[float]


class Recent:
    """The last samples of a site that is executed.

    Args:
        rate_hz: its tick rate.

    Attributes:
        samples: by tick; of the last `MEMORY_S` seconds.
    """

    def __init__(self, rate_hz: int) -> None:
        self.samples: dict[int, Sample] = {}
        self._most = MEMORY_S * rate_hz

    def take(self, output: Output) -> None:
        """Remembers a sample."""
        self.samples[output.tick] = Sample(output.q, output.qd, output.tau_x)
        if len(self.samples) > self._most:
            del self.samples[next(iter(self.samples))]


class Performance:
    """The sites of a premise, executed.

    Args:
        log: the log.
        premise: what is asked of it.

    Attributes:
        actors: the sites that are executed.
        came: per site that is executed, what came to it and when.

    Raises:
        LogError: the log does not tell enough.
    """

    def __init__(self, log: Log, premise: Premise) -> None:
        self._log, self._premise = log, premise
        self._ends = last_ticks(log)
        self._recent = {name: Recent(premise.scenario.sites[name].rate_hz) for name in premise.replaced}
        samples: dict[str, Mapping[int, Pose]] = {name: log[name].by_tick for name in premise.recorded}
        samples |= {name: recent.samples for name, recent in self._recent.items()}  # filled as they are made
        self.came = {name: self._deliveries(name) for name in premise.replaced}
        self.actors = {
            name: Actor(
                premise.scenario,
                log[name],
                self.came[name],
                [samples[peer] for peer in log[name].peers],
                [self._ends[peer] for peer in log[name].peers],
                log.commands(name),
                changed=bool(premise.changes),
            )
            for name in premise.replaced
        }

    def _deliveries(self, name: str) -> Deliveries:
        """Returns what comes to a site at each of its ticks."""
        part, original, scenario = self._log[name], self._log.scenario, self._premise.scenario
        if not self._premise.changes:
            return recorded(part)
        before = [original.sites[peer].rate_hz for peer in part.peers]
        after = [scenario.sites[peer].rate_hz for peer in part.peers]
        came = complete(part, [Sender(hz, self._ends[p]) for hz, p in zip(before, part.peers, strict=True)])
        rate_hz = scenario.sites[name].rate_hz
        if (part.rate_hz, before) == (rate_hz, after):
            return came
        if came.first > 0:
            raise LogError(
                f"{self._log.source}: the records of {name} begin at tick {came.first}: "
                "a site that begins in the middle keeps its rate, and so do its peers"
            )
        return retimed(came, part.rate_hz, rate_hz, before, after)

    def run(self, progress: Progress | None = None) -> Iterator[Made]:
        """Yields every tick of every site that is executed, in order of time as far as arrivals allow.

        A site that left its limits makes no more ticks. Where something is changed, the others end with it.

        Args:
            progress: told now and then how many ticks are made, and how many there will be at most.
        """
        order = {name: n for n, name in enumerate(self.actors)}
        pending = sorted((a.t_ns, order[a.name], a) for a in self.actors.values() if not a.done)
        total = sum(came.last + 1 - came.first for came in self.came.values())
        done, last_ns = 0, None
        while pending and (last_ns is None or pending[0][0] <= last_ns):
            place = next((n for n, (_, _, actor) in enumerate(pending) if self._ready(actor)), 0)
            t_ns, _, actor = pending.pop(place)
            made = actor.make()
            self._recent[actor.name].take(actor.output)
            yield made
            if actor.diverged and self._premise.changes:
                last_ns = t_ns
            if not actor.done:
                bisect.insort(pending, (actor.t_ns, order[actor.name], actor))
            done += 1
            if progress is not None and done % _TELL_EVERY == 0:
                progress(done, total)

    def _ready(self, actor: Actor) -> bool:
        """True where every sample that comes to a site's next tick has been made, or never will be."""
        peers = self._log[actor.name].peers
        for peer, tick, _ in actor.listed:
            sender = self.actors.get(peers[peer])
            if sender is not None and not sender.done and tick >= sender.k:
                return False
        return True

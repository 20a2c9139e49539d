"""Executes the sites of a rerun in turn, each against the samples that arrived at it.

Invariants: a site advances by `Site.step` alone. It receives the samples of recorded peers as logged and
those of executed peers as computed now, each at the tick at which the log says that it arrived. Without
changes a site resumes after a gap from two consecutive records, and the record stands where too little is
known; with changes its own steps carry it through gaps.
"""

import bisect
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from ..core.site_step import Site
from ..core.ticks import MAX_ARRIVALS, NS_PER_S, Arrival, CoreChange, Mode, TickInput, TickRecord
from ..errors import LogError
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..log.site_log import SiteLog
from ..net.loop_stats import LoopStats
from ..net.messages import LinkStats
from ..net.wire import encode_state
from ..scenario import Scenario
from .difference import RecordDifference, equal_bits, equal_record, find_first_difference
from .rerun_request import RerunRequest
from .resumption import ReceivedMotion, Resumption, read_output
from .verify import find_last_ticks
from .virtual_network import (
    ArrivalEntry,
    Deliveries,
    PeerTicks,
    complete_deliveries,
    recorded_deliveries,
    retime_deliveries,
)


class RerunTick(NamedTuple):
    """One tick of a site that is executed.

    Attributes:
        site: which site.
        tick: which tick.
        t_ns: its nominal time, ns since the epoch.
        mode: what the site was doing.
        payload: its record as it would be published; the log's own where that stands.
        same: True where the log has a record of that tick of which every computed field has the same bits.
        stands: True where the log's record stands, because too little is known to execute it.
        stats: its statistics, at the ticks that have some.
    """

    site: str
    tick: int
    t_ns: int
    mode: Mode
    payload: bytes
    same: bool
    stands: bool
    stats: LinkStats | None


class RerunSite:
    """One site, executed afresh against what came to it.

    Args:
        scenario: what holds in the rerun.
        part: the site's records.
        came: what came to it, and when.
        samples: per peer, in scenario order, its samples by tick; those of peers that are executed too
            appear in it as they are made.
        ends: per peer the last tick that it made.
        commands: per tick the changes that were ordered then.
        changed: whether anything is otherwise than in the log.

    Attributes:
        name: the site.
        k: the tick that it makes next.
        first: the first record that is not the log's, in what.
        lacking: how many samples came and are not in the log.
        diverged: whether it has left its limits.
        output: the last record that it made.
    """

    output: TickRecord

    def __init__(
        self,
        scenario: Scenario,
        part: SiteLog,
        came: Deliveries,
        samples: Sequence[Mapping[int, ReceivedMotion]],
        ends: Sequence[int],
        commands: Mapping[int, Sequence[CoreChange]],
        *,
        changed: bool,
    ) -> None:
        self.name = part.name
        self.k = came.first
        self.first: RecordDifference | None = None
        self.lacking = 0
        self.diverged = False
        self._site = Site(scenario.setup(part.name))
        self._part, self._came, self._samples, self._changed = part, came, samples, changed
        self._commands = sorted(commands.items())
        self._resumption = Resumption(part, samples, ends)
        self._last = min(came.last, scenario.ticks(part.name) - 1)
        ordinary = self._site.rate_hz == part.rate_hz
        self._recorded: list[int] = part.tick.tolist() if ordinary else []
        self._places = {tick: n for n, tick in enumerate(self._recorded)}
        self._boot = part.states[0].boot if len(part) else 0
        self._stats = LoopStats(self._site, self._boot, [scenario.sites[p].rate_hz for p in self._site.peers])
        self._assured = came.first == 0

    @property
    def done(self) -> bool:
        """True where it makes no more ticks."""
        return self.diverged or self.k > self._last

    @property
    def t_ns(self) -> int:
        """Nominal time of the tick that it makes next, ns since the epoch."""
        return self.k * NS_PER_S // self._site.rate_hz

    @property
    def listed(self) -> Sequence[ArrivalEntry]:
        """What comes to the tick that it makes next."""
        return self._came.at.get(self.k, ())

    def make(self) -> RerunTick:
        """Makes one tick.

        Raises:
            LogError: the log orders more changes than a site takes, or a record is none that a site can make.
        """
        n = self._places.get(self.k)
        try:
            if n is not None and not self._assured and self._resumption.possible(n):
                for command in self._ordered(self.k - 1):
                    self._site.order(command)
                self._resumption.place(self._site, n)
                self._assured = True
            made = self._executed(n) if self._assured or n is None else self._standing(n)
        except (ValueError, OverflowError) as error:
            raise LogError(f"{self.name}, tick {self.k}: {error}") from None
        self.diverged = made.mode is Mode.DIVERGED
        self._go_on()
        return made

    def _executed(self, n: int | None) -> RerunTick:
        """Steps the site, and looks whether record n of the log says the same."""
        arrivals, whole = self._arrivals()
        output = self._site.step(TickInput(self.k, arrivals, self._ordered(self.k)))
        stats = self._stats.take(output) if self._stats.due(self.k) else None
        same = False
        if n is not None:
            state = self._part.states[n]
            # the sum of what came in: another where peers are otherwise, or where the log lacks a sample
            comparable = output._replace(rx_crc=state.rx_crc) if self._changed or not whole else output
            same = equal_record(state, comparable, self._part.peers)
            if not same and not self._changed and self._resumption.in_doubt(state, output):
                return self._standing(n)
            if not same and self.first is None:
                self.first = find_first_difference(state, comparable, self._part.peers, equal_bits)
        payload = encode_state(self.name, self._boot, self._part.peers, output, arrivals, 0, 0)
        return self._made(output, payload, stats, same=same)

    def _standing(self, n: int) -> RerunTick:
        """Lets record n of the log stand, from which one that can be executed will go on."""
        self._assured = False
        output = read_output(self._part.states[n], self._part.peers)
        return self._made(output, self._part.payloads[n], None, stands=True)

    def _made(
        self,
        output: TickRecord,
        payload: bytes,
        stats: LinkStats | None,
        *,
        same: bool = False,
        stands: bool = False,
    ) -> RerunTick:
        self.output = output
        return RerunTick(self.name, output.tick, output.t_ns, output.mode, payload, same, stands, stats)

    def _arrivals(self) -> tuple[list[Arrival], bool]:
        """Returns what comes to this tick, and whether all of it is known."""
        arrivals, whole = [], True
        for peer, tick, delay_us in self.listed:
            sample = self._samples[peer].get(tick)
            if sample is not None:
                arrivals.append(Arrival(peer, tick, sample.q, sample.qd, delay_us, sample.tau_x))
                continue
            whole = False
            self.lacking += 1
            self._resumption.lacking[peer].add(tick)
        return arrivals[:MAX_ARRIVALS], whole

    def _ordered(self, tick: int) -> list[CoreChange]:
        """Returns the changes that were ordered up to a tick and that have not been taken in yet."""
        ordered: list[CoreChange] = []
        while self._commands and self._commands[0][0] <= tick:
            ordered += self._commands.pop(0)[1]
        return ordered

    def _go_on(self) -> None:
        """Turns to the next tick: of a site that is not what it was, to any; else to one with a record."""
        self.k += 1
        if (self._changed and self._assured) or self.k in self._places:
            return
        behind = bisect_right(self._recorded, self.k)
        self.k = self._recorded[behind] if behind < len(self._recorded) else self._last + 1
        self._assured = False


_PROGRESS_EVERY = 1000
MEMORY_S = 120
"""How long a sample that was made now may be under way, s: longer than any queue holds one."""


class RerunSample(NamedTuple):
    """What others need of a tick."""

    q: list[float]
    qd: list[float]
    tau_x: list[float]


class RecentSamples:
    """The last samples of a site that is executed.

    Args:
        rate_hz: its tick rate.

    Attributes:
        samples: by tick; of the last `MEMORY_S` seconds.
    """

    def __init__(self, rate_hz: int) -> None:
        self.samples: dict[int, RerunSample] = {}
        self._most = MEMORY_S * rate_hz

    def take(self, output: TickRecord) -> None:
        """Remembers a sample."""
        self.samples[output.tick] = RerunSample(output.q, output.qd, output.tau_x)
        if len(self.samples) > self._most:
            del self.samples[next(iter(self.samples))]


class RerunExecution:
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

    def __init__(self, log: Log, premise: RerunRequest) -> None:
        self._log, self._premise = log, premise
        self._ends = find_last_ticks(log)
        self._recent = {
            name: RecentSamples(premise.scenario.sites[name].rate_hz) for name in premise.replaced
        }
        samples: dict[str, Mapping[int, ReceivedMotion]] = {
            name: log[name].by_tick for name in premise.recorded
        }
        samples |= {name: recent.samples for name, recent in self._recent.items()}  # filled as they are made
        self.came = {name: self._deliveries(name) for name in premise.replaced}
        self.actors = {
            name: RerunSite(
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
            return recorded_deliveries(part)
        before = [original.sites[peer].rate_hz for peer in part.peers]
        after = [scenario.sites[peer].rate_hz for peer in part.peers]
        came = complete_deliveries(
            part, [PeerTicks(hz, self._ends[p]) for hz, p in zip(before, part.peers, strict=True)]
        )
        rate_hz = scenario.sites[name].rate_hz
        if (part.rate_hz, before) == (rate_hz, after):
            return came
        if came.first > 0:
            raise LogError(
                f"{self._log.source}: the records of {name} begin at tick {came.first}: "
                "a site that begins in the middle keeps its rate, and so do its peers"
            )
        return retime_deliveries(came, part.rate_hz, rate_hz, before, after)

    def run(self, progress: Progress | None = None) -> Iterator[RerunTick]:
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
            if progress is not None and done % _PROGRESS_EVERY == 0:
                progress(done, total)

    def _ready(self, actor: RerunSite) -> bool:
        """True where every sample that comes to a site's next tick has been made, or never will be."""
        peers = self._log[actor.name].peers
        for peer, tick, _ in actor.listed:
            sender = self.actors.get(peers[peer])
            if sender is not None and not sender.done and tick >= sender.k:
                return False
        return True

"""One site of a log, executed afresh.

Law: it advances by `Site.step` alone. Where nothing is changed, it stands behind a gap where the log's next
two records find it, and where too little is known the log's record stands; where something is changed it is
nowhere but where its own steps lead it, through gaps as well.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..core.grid import NS_PER_S
from ..core.site import Site
from ..core.tick import MAX_ARRIVALS, Arrival, Command, Mode, Output, Tick
from ..errors import LogError
from ..log.reader import SiteLog
from ..net.messages import LinkStats
from ..net.stats import LoopStats
from ..net.wire import encode_state
from ..replay.difference import Difference, first_difference, identical, same_bits
from ..replay.resumption import Pose, Resumption, recorded_output
from ..scenario import Scenario
from .delivery import Deliveries, Listed


class Made(NamedTuple):
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


class Actor:
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

    output: Output

    def __init__(
        self,
        scenario: Scenario,
        part: SiteLog,
        came: Deliveries,
        samples: Sequence[Mapping[int, Pose]],
        ends: Sequence[int],
        commands: Mapping[int, Sequence[Command]],
        *,
        changed: bool,
    ) -> None:
        self.name = part.name
        self.k = came.first
        self.first: Difference | None = None
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
    def listed(self) -> Sequence[Listed]:
        """What comes to the tick that it makes next."""
        return self._came.at.get(self.k, ())

    def make(self) -> Made:
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

    def _executed(self, n: int | None) -> Made:
        """Steps the site, and looks whether record n of the log says the same."""
        arrivals, whole = self._arrivals()
        output = self._site.step(Tick(self.k, arrivals, self._ordered(self.k)))
        stats = self._stats.take(output) if self._stats.due(self.k) else None
        same = False
        if n is not None:
            state = self._part.states[n]
            # the sum of what came in: another where peers are otherwise, or where the log lacks a sample
            comparable = output._replace(rx_crc=state.rx_crc) if self._changed or not whole else output
            same = identical(state, comparable, self._part.peers)
            if not same and not self._changed and self._resumption.in_doubt(state, output):
                return self._standing(n)
            if not same and self.first is None:
                self.first = first_difference(state, comparable, self._part.peers, same_bits)
        payload = encode_state(self.name, self._boot, self._part.peers, output, arrivals, 0, 0)
        return self._made(output, payload, stats, same=same)

    def _standing(self, n: int) -> Made:
        """Lets record n of the log stand, from which one that can be executed will go on."""
        self._assured = False
        output = recorded_output(self._part.states[n], self._part.peers)
        return self._made(output, self._part.payloads[n], None, stands=True)

    def _made(
        self,
        output: Output,
        payload: bytes,
        stats: LinkStats | None,
        *,
        same: bool = False,
        stands: bool = False,
    ) -> Made:
        self.output = output
        return Made(self.name, output.tick, output.t_ns, output.mode, payload, same, stands, stats)

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

    def _ordered(self, tick: int) -> list[Command]:
        """Returns the changes that were ordered up to a tick and that have not been taken in yet."""
        ordered: list[Command] = []
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

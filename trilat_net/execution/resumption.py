"""The state of a site in the middle of a log: samples in use and samples that wait in its links.

Invariant (L3): two consecutive records and the contents of the links suffice. Arrivals at ticks without a
record are unknown; samples that no record lists are assumed to have arrived there.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Protocol

from ..core.delay import MAX_DELAY_US
from ..core.site_step import Site
from ..core.ticks import MAX_ARRIVALS, NS_PER_S, Arrival, Mode, PlantState, TickRecord
from ..core.two_link_arm import JOINTS
from ..log.site_log import SiteLog
from ..net.messages import State

_LOOK_BACK = 100
"""Records before a gap in which to look for the newest sample that had come."""


class ReceivedMotion(Protocol):
    """What a receiver needs of a sample."""

    @property
    def q(self) -> Sequence[float]:
        """Joint angles, rad."""

    @property
    def qd(self) -> Sequence[float]:
        """Joint velocities, rad/s."""

    @property
    def tau_x(self) -> Sequence[float]:
        """The torque of hands and surroundings, N m."""


def read_output(state: State, peers: tuple[str, ...]) -> TickRecord:
    """Returns a record as `Site.step` returned it."""
    modes = {mode.name.lower(): mode for mode in Mode}
    mem = state.mem if len(state.mem) > JOINTS else []
    used = [state.used.get(peer, -1) for peer in peers]
    return TickRecord(
        state.tick,
        state.t_ns,
        modes.get(state.mode, Mode.DIVERGED),
        state.q,
        state.qd,
        state.q_des,
        state.qd_des,
        state.tau,
        state.tau_x,
        state.theta_hat,
        used,
        state.rx_crc,
        state.cmd,
        mem,
    )


def read_plant_state(state: State) -> PlantState:
    """Returns what an arm outside of the program was measured to do at a tick: it stands in the record."""
    return PlantState(state.q, state.qd)


class Resumption:
    """Puts one site where its records find it.

    Args:
        part: its records.
        samples: per peer, in scenario order, its samples by tick.
        ends: per peer the last tick that it made.

    Attributes:
        assumed: per peer the samples that are taken to have come where no record is.
        lacking: per peer the samples that came, and whose own record is missing.
    """

    def __init__(
        self, part: SiteLog, samples: Sequence[Mapping[int, ReceivedMotion]], ends: Sequence[int]
    ) -> None:
        self._part, self._samples, self._ends = part, samples, ends
        self.assumed: list[set[int]] = [set() for _ in samples]
        self.lacking: list[set[int]] = [set() for _ in samples]

    def possible(self, n: int) -> bool:
        """True where two records stand right before record n, and the samples in use are known."""
        states = self._part.states
        if n < 2 or [s.tick for s in states[n - 2 : n]] != [states[n].tick - 2, states[n].tick - 1]:
            return False
        in_use = read_output(states[n - 1], self._part.peers).used
        return all(used < 0 or used in known for used, known in zip(in_use, self._samples, strict=True))

    def place(self, site: Site, n: int) -> None:
        """Brings a site to where record n finds it; only where that is `possible`."""
        states, peers = self._part.states, self._part.peers
        before, last = (read_output(states[m], peers) for m in (n - 2, n - 1))
        in_use: list[Arrival | None] = []
        waiting: list[Arrival] = []
        for j, used in enumerate(last.used):
            sample = self._samples[j].get(used)
            in_use.append(None if sample is None else Arrival(j, used, sample.q, sample.qd, 0, sample.tau_x))
            # one that is older than the sample in use comes into use no more
            self.lacking[j] = {tick for tick in self.lacking[j] if tick > used}
            certain, self.assumed[j] = self._came_before(n, j, used, site.peer_rate_hz(j))
            for tick in sorted(certain | self.assumed[j]):
                if (came := self._samples[j].get(tick)) is not None:
                    waiting.append(Arrival(j, tick, came.q, came.qd, 0, came.tau_x))
                else:
                    self.lacking[j].add(tick)
        site.prime(states[n].tick, in_use, waiting[-MAX_ARRIVALS:])
        site.resume(before, last)

    def in_doubt(self, state: State, output: TickRecord) -> bool:
        """True where a sample is in use of which the log does not tell when it came, or what it was."""
        return any(
            output.used[j] in self.assumed[j]
            or state.used.get(peer, -1) in self.assumed[j]
            or state.used.get(peer, -1) in self.lacking[j]
            for j, peer in enumerate(self._part.peers)
        )

    def _came_before(self, n: int, peer: int, used: int, rate_hz: int) -> tuple[set[int], set[int]]:
        """Returns which samples newer than the one in use had come before record n: (certainly, probably).

        Certain are those that a record before n lists. Probable are those that no record lists at all
        and that are older than record n, or than the first sample that came after it.
        """
        states = self._part.states
        by_time = -(-states[n].t_ns * rate_hz // NS_PER_S) - 1
        first_listed = self._first_listed[peer]
        newest = max(by_time, self._next_listed(peer, n) - 1)
        before = (
            tick for state in states[max(0, n - _LOOK_BACK) : n] for j, tick, _ in state.rx if j == peer
        )
        highest = max(before, default=-1)
        certain: set[int] = set()
        probable: set[int] = set()
        # what waits was sent within the longest delay there is; before that, nothing waits
        oldest = (states[n].t_ns - MAX_DELAY_US * 1000) * rate_hz // NS_PER_S
        for tick in range(max(used + 1, oldest), min(max(newest, highest), self._ends[peer]) + 1):
            listed = first_listed.get(tick)
            if listed is None and tick <= newest:
                probable.add(tick)
            elif listed is not None and listed < n:
                certain.add(tick)
        return certain, probable

    @cached_property
    def _first_listed(self) -> list[dict[int, int]]:
        """Per peer and sample, the first record (by its place) that lists it."""
        listed: list[dict[int, int]] = [{} for _ in self._samples]
        for m, state in enumerate(self._part.states):
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(listed):
                    listed[peer].setdefault(tick, m)
        return listed

    def _next_listed(self, peer: int, n: int) -> int:
        """Returns the tick of the first sample of a peer that record n or a later one lists."""
        places, ticks = self._listing[peer]
        next_one = bisect_left(places, n)
        return ticks[next_one] if next_one < len(places) else self._ends[peer] + 1

    @cached_property
    def _listing(self) -> list[tuple[list[int], list[int]]]:
        """Per peer the records (by their places) that list samples of it, and the first that each lists."""
        listing: list[tuple[list[int], list[int]]] = [([], []) for _ in self._samples]
        for m, state in enumerate(self._part.states):
            seen = set()
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(listing) and peer not in seen:
                    seen.add(peer)
                    listing[peer][0].append(m)
                    listing[peer][1].append(tick)
        return listing

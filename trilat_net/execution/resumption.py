"""The inputs of one site as its log recorded them, and its state in the middle of the log.

Invariant (L3): two consecutive records and the contents of the links suffice to resume.
Arrivals at ticks without a record are unknown; samples that no record lists are assumed to have
arrived there.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property
from operator import attrgetter
from typing import Generic, TypeVar

import numpy as np

from ..core.delay import MAX_DELAY_US
from ..core.site_setup import LinkSetup
from ..core.site_step import Site
from ..core.ticks import MAX_ARRIVALS, NS_PER_S, Arrival, CoreChange, TickRecord
from ..log.site_log import SiteLog
from ..net.messages import MODES, RESTING_MODES, State

_LOOK_BACK = 100
"""Records before a gap in which to look for the newest sample that had arrived."""

Change = TypeVar("Change")

ArrivalEntry = Sequence[int]
"""As in a record's `rx`: index of the peer, tick of its sample, us."""


ReceivedMotion = State | Arrival
"""A sample of a peer, as it was recorded or as it is computed now."""


_MOTION = attrgetter("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
_REST = attrgetter("x", "xd", "wrench", "ch", "hand", "bodies")


def read_output(state: State, peers: tuple[str, ...]) -> TickRecord:
    """Returns a record in the form in which `Site.step` returned it."""
    begin = state.tick, state.t_ns, MODES.get(state.mode, MODES["diverged"]).mode
    taken = [state.used.get(peer, -1) for peer in peers], state.rx_crc, state.cmd
    mem = state.mem if len(state.mem) > len(state.q_des) else []
    return TickRecord._make([*begin, *_MOTION(state), *taken, mem, *_REST(state)])


def make_arrival(
    peer: int, tick: int, sample: ReceivedMotion | TickRecord, latency_us: int = 0
) -> Arrival:
    """Returns the arrival of a peer's sample, whose numbers are those of its record, see
    `select_peer_channels`.
    """
    if isinstance(sample, Arrival) or not sample.x:
        return Arrival(
            peer=peer,
            tick=tick,
            q=sample.q,
            qd=sample.qd,
            latency_us=latency_us,
            tau_x=sample.tau_x,
            ch=sample.ch,
        )
    return Arrival(
        peer=peer,
        tick=tick,
        q=sample.x,
        qd=sample.xd,
        latency_us=latency_us,
        tau_x=sample.wrench,
        ch=sample.ch,
    )


def select_peer_channels(
    arrivals: Sequence[Arrival], links: Sequence[LinkSetup]
) -> list[Arrival]:
    """Returns the arrivals of whole samples as a site takes them in: without what is for other
    peers.
    """
    return [
        one._replace(ch=links[one.peer].channel.select_for_peer(one.ch, links[one.peer].place))
        if one.ch
        else one
        for one in arrivals
    ]


def find_recorded_hand(part: SiteLog, site: Site, k: int) -> list[float]:
    """Returns what a live hand did at a tick, by the latest record until then; [] without a
    live hand.
    """
    until = (
        np.searchsorted(part.t_ns, k * NS_PER_S // site.rate_hz, side="right")
        if part.layout.hand
        else 0
    )
    found: list[float] = part.hand[int(until) - 1].tolist() if until else []
    return found


class RecordedInputs(Generic[Change]):
    """Arrivals, changes and resumption of one site, from its records and those of its peers.

    Attributes:
        assumed: per peer the samples that are assumed to have arrived where no record is.
        lacking: per peer the samples that arrived and whose own record is missing.
    """

    def __init__(
        self,
        part: SiteLog,
        samples: Mapping[str, Mapping[int, ReceivedMotion]],
        ends: Mapping[str, int],
        changes: Mapping[int, Sequence[Change]],
        links: Sequence[LinkSetup],
    ) -> None:
        self._part = part
        self._links = links
        self.samples = [samples[peer] for peer in part.peers]
        self.ends = [ends[peer] for peer in part.peers]
        self._changes = sorted(changes.items(), reverse=True)
        self.assumed: list[set[int]] = [set() for _ in part.peers]
        self.lacking: list[set[int]] = [set() for _ in part.peers]

    def pop_changes(self, tick: int) -> list[tuple[int, Change]]:
        """Returns the changes up to a tick that have not been taken yet, each with its own
        tick.
        """
        taken: list[tuple[int, Change]] = []
        while self._changes and self._changes[-1][0] <= tick:
            named, changes = self._changes.pop()
            taken += [(named, change) for change in changes]
        return taken

    def find_arrivals(
        self, entries: Sequence[ArrivalEntry]
    ) -> tuple[list[Arrival], list[ArrivalEntry]]:
        """Returns the arrivals that entries list, and the entries whose sample no record holds."""
        arrivals: list[Arrival] = []
        missing: list[ArrivalEntry] = []
        samples = self.samples
        for entry in entries:
            peer, tick, latency_us = entry
            sample = samples[peer].get(tick) if 0 <= peer < len(samples) else None
            if sample is None:
                missing.append(entry)
            else:
                arrivals.append(make_arrival(peer, tick, sample, latency_us))
        return select_peer_channels(arrivals, self._links), missing

    def add_lacking(self, entries: Sequence[ArrivalEntry]) -> None:
        """Notes samples that arrived and whose own record is missing."""
        for peer, tick, _ in entries:
            self.lacking[peer].add(tick)

    def can_resume(self, n: int, *, apart: bool = False) -> bool:
        """True if the two records before record n are consecutive and the samples in use are
        known.

        Those that are not known do not matter to a site that holds, `apart` from its peers, by
        a reference of its own.
        """
        states = self._part.states
        if n < 2 or [s.tick for s in states[n - 2 : n]] != [
            states[n].tick - 2,
            states[n].tick - 1,
        ]:
            return False
        in_use = read_output(states[n - 1], self._part.peers).used
        if apart and states[n - 1].mode in RESTING_MODES:
            return True
        return all(
            used < 0 or used in known for used, known in zip(in_use, self.samples, strict=True)
        )

    def resume(self, site: Site, n: int, changes: Sequence[CoreChange] = ()) -> None:
        """Brings a site into its state at record n, after `changes`, if it `can_resume` there."""
        states = self._part.states
        peers = self._part.peers
        for change in changes:
            site.order(change, states[n].t_ns)
        before, last = (read_output(states[m], peers) for m in (n - 2, n - 1))
        in_use: list[Arrival | None] = []
        waiting: list[Arrival] = []
        for j, used in enumerate(last.used):
            sample = self.samples[j].get(used)
            if sample is None and used >= 0:  # see `can_resume`
                unknown = (0.0,) * len(last.q_des)
                sample = Arrival(j, used, unknown, unknown)
                self.lacking[j].add(used)
            in_use += (
                [None]
                if sample is None
                else select_peer_channels([make_arrival(j, used, sample)], self._links)
            )
            # a sample older than the one in use is never used any more
            self.lacking[j] = {tick for tick in self.lacking[j] if tick >= used}
            certain, self.assumed[j] = self._find_waiting(n, j, used, site.peer_rate_hz(j))
            arrived, missing = self.find_arrivals(
                [(j, tick, 0) for tick in sorted(certain | self.assumed[j])]
            )
            self.add_lacking(missing)
            waiting += arrived
        site.prime(states[n].tick, in_use, waiting[-MAX_ARRIVALS:])
        site.resume(before, last)

    def is_uncertain(self, state: State, output: TickRecord) -> bool:
        """True if a sample is in use whose arrival or content the log does not tell."""
        return any(
            output.used[j] in self.assumed[j]
            or state.used.get(peer, -1) in self.assumed[j]
            or state.used.get(peer, -1) in self.lacking[j]
            for j, peer in enumerate(self._part.peers)
        )

    def _find_waiting(
        self, n: int, peer: int, used: int, rate_hz: int
    ) -> tuple[set[int], set[int]]:
        """Returns the samples newer than the one in use that arrived before record n: (certain,
        probable).

        Certain are those that a record before n lists. Probable are those that no record lists
        and that are older than record n, or than the first sample that arrived after it.
        """
        states = self._part.states
        first_listed, records, ticks = self._listing[peer]
        place = bisect_left(records, n)
        next_listed = ticks[place] if place < len(records) else self.ends[peer] + 1
        newest = max(-(-states[n].t_ns * rate_hz // NS_PER_S) - 1, next_listed - 1)
        before = (
            tick
            for state in states[max(0, n - _LOOK_BACK) : n]
            for j, tick, _ in state.rx
            if j == peer
        )
        highest = max(before, default=-1)
        certain: set[int] = set()
        probable: set[int] = set()
        # a waiting sample was sent within the longest delay there is
        oldest = (states[n].t_ns - MAX_DELAY_US * 1000) * rate_hz // NS_PER_S
        for tick in range(
            max(used + 1, oldest), min(max(newest, highest), self.ends[peer]) + 1
        ):
            listed = first_listed.get(tick)
            if listed is None and tick <= newest:
                probable.add(tick)
            elif listed is not None and listed < n:
                certain.add(tick)
        return certain, probable

    @cached_property
    def _listing(self) -> list[tuple[dict[int, int], list[int], list[int]]]:
        """Per peer the first record (by its place) that lists each sample.

        Beside it the records that list any sample of it, and the first that each of them lists.
        """
        listing: list[tuple[dict[int, int], list[int], list[int]]] = [
            ({}, [], []) for _ in self.samples
        ]
        for m, state in enumerate(self._part.states):
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(listing):
                    first_listed, records, ticks = listing[peer]
                    first_listed.setdefault(tick, m)
                    if not records or records[-1] != m:
                        records.append(m)
                        ticks.append(tick)
        return listing

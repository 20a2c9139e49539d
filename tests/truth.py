"""The true one-way delay of every sample of a log whose clocks were skewed on one machine.

All clocks there are one clock underneath, and a skewed clock's identity says how it was skewed: undoing it
puts every raw stamp, the sender's `sent_ns` and the receiver's `echo`, onto that one clock.
"""

import re
from bisect import bisect_right
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from trilat_net.core.step.ticks import NS_PER_S
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event
from trilat_net.net.offset import SLEW_NS

SKEWED = re.compile(r"skewed by (-?\d+) ns and (-?\d+) ns/s since (-?\d+) ns$")
Ints = NDArray[np.int64]


@dataclass
class Member:
    """A member's clock, whose reading is start + offset + (true - start) (1 + drift)."""

    epoch_ns: int
    start_ns: int
    offset_ns: int
    rate: Fraction

    def true_ns(self, since_epoch_ns: int) -> int:
        """Returns a reading since the epoch on the clock underneath."""
        passed_ns = self.epoch_ns + since_epoch_ns - self.start_ns - self.offset_ns
        return self.start_ns + round(passed_ns / self.rate)

    def reading_ns(self, true_ns: int) -> int:
        """Returns the reading of the clock at an instant of the clock underneath."""
        return self.start_ns + self.offset_ns + round((true_ns - self.start_ns) * self.rate)

    def offset_to_ns(self, other: "Member", since_epoch_ns: int) -> int:
        """Returns the lead of another clock over this one at a reading of this one since the epoch."""
        true_ns = self.true_ns(since_epoch_ns)
        return other.reading_ns(true_ns) - self.reading_ns(true_ns)


def list_members(log: Log) -> dict[str, Member]:
    """Returns the clocks of a log's members."""
    started = next(event for event in log.events if event.kind == "start")
    announced = next(
        e for e in log.events if e.kind == "epoch" and e.attempt == started.attempt
    )
    clocks = {}
    for name, identity in announced.clocks.items():
        skew = SKEWED.search(identity)
        offset_ns, drift_ppb, start_ns = map(int, skew.groups()) if skew else (0, 0, 0)
        clocks[name] = Member(
            started.epochs[name], start_ns, offset_ns, 1 + Fraction(drift_ppb, NS_PER_S)
        )
    return clocks


def find_restarted(log: Log, name: str) -> Member:
    """Returns the clock of the last start of a member that joined the running session."""
    event = [e for e in log.events if e.kind == "coming" and e.member == name][-1]
    skew = SKEWED.search(event.clock)
    offset_ns, drift_ppb, start_ns = map(int, skew.groups()) if skew else (0, 0, 0)
    return Member(event.epoch_mono_ns, start_ns, offset_ns, 1 + Fraction(drift_ppb, NS_PER_S))


@dataclass
class Judged:
    """One link's samples: how wrong the logged delay of each was, and what was said of that at most.

    Attributes:
        tick: the receiver's tick that took the sample in.
        delay_us: the true one-way delay, us.
        error_us: logged minus true, us.
        bound_us: the bound in force, us.
    """

    tick: Ints
    delay_us: NDArray[np.float64]
    error_us: NDArray[np.float64]
    bound_us: NDArray[np.float64]

    @property
    def inside(self) -> float:
        """Share of the samples whose error is inside the bound; a logged delay is whole microseconds."""
        return float(np.mean(np.abs(self.error_us) <= self.bound_us + 1.0))


class Bound:
    """The logged bounds of a site's error about the clock of one peer, over time."""

    def __init__(self, log: Log, site: str, peer: str) -> None:
        self.events: list[Event] = [
            e for e in log.events if (e.kind, e.member, e.about) == ("clock", site, peer)
        ]
        self._ticks = [event.ticks for event in self.events]

    def at(self, tick: int, t_ns: int) -> float | None:
        """Returns the bound of an offset at a tick, us; None before the first that was logged."""
        index = bisect_right(self._ticks, tick) - 1
        if index < 0:
            return None
        event = self.events[index]
        later_ns = max(0, t_ns - event.t_ns - SLEW_NS)
        return (event.bound_ns + later_ns * event.drift_bound_ppb / NS_PER_S) / 1000


def judge_link(log: Log, site: str, peer: str) -> Judged:
    """Returns every sample of a link that its receiver echoed, against the truth."""
    clocks = list_members(log)
    peer_index = log.scenario.peers(site).index(peer)
    sent = {state.tick: state.sent_ns for state in log[peer].states}
    bound = Bound(log, site, peer)
    shared = clocks[site] == clocks[peer]
    rows = []
    for state in log[site].states:
        logged = {tick: delay_us for index, tick, delay_us in state.rx if index == peer_index}
        for index, tick, arrived_ns in state.echo:
            limit_us = 0.0 if shared else bound.at(state.tick, state.t_ns)
            if index == peer_index and limit_us is not None:
                true_ns = clocks[site].true_ns(arrived_ns) - clocks[peer].true_ns(sent[tick])
                rows.append(
                    (state.tick, true_ns / 1000, logged[tick] - true_ns / 1000, limit_us)
                )
    ticks, delay, error, limit = np.array(rows).T
    return Judged(ticks.astype(np.int64), delay, error, limit)


def offset_errors(log: Log, site: str, peer: str) -> NDArray[np.float64]:
    """Returns the error of every logged estimate: t (s), error of the offset (us) and of the drift (ppm)."""
    clocks = list_members(log)
    own_clock = clocks[site]
    other = clocks[peer]
    drift_ppm = float(other.rate / own_clock.rate - 1) * 1e6
    rows = []
    for event in Bound(log, site, peer).events:
        offset_ns = own_clock.offset_to_ns(other, event.t_ns)
        rows.append(
            (
                event.t_ns / NS_PER_S,
                (event.offset_ns - offset_ns) / 1000,
                event.drift_ppb / 1000 - drift_ppm,
            )
        )
    return np.array(rows).reshape(-1, 3)

"""One site's book: its functional, and all that changes it.

Law: V_i - V_i(0) + dissipation + passed on - work vanishes for every site by itself: no weights are needed.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..core.setup import Scheme
from ..log.reader import Log
from . import dissipation, work
from .equations import Equations, equations
from .functional import Parts, parts
from .parting import parted
from .periods import Booked, Periods, periods
from .shares import Shares, shares
from .track import Bools, Past, Track, tracks
from .views import View, view

LEAST_PERIODS = 10
"""Fewer show nothing of what happens within them."""


class Book(NamedTuple):
    """A site's book over its K rows and K - 1 periods.

    Attributes:
        track: its records.
        eq: its constants.
        shares: its shares in its peers.
        views: what it sees of them, by name.
        parts: its functional.
        taken: dissipation: `damping` and `disagreement`.
        passed: what it passes on to the sites that follow it.
        given: work: `hands`, `walls`, per link "j->i", `shares`, `rule`, `torque limit`, `estimates`.
        sampling: the work of the scheme by which the continuous law was sampled.
        judged: whether a period rests on records alone, shape (K - 1,).
        coupling: the part of `doubt` by changes of r and a torque together, J.
    """

    track: Track
    eq: Equations
    shares: Shares
    views: dict[str, View]
    parts: Parts
    taken: dict[str, Booked]
    passed: Booked
    given: dict[str, Booked]
    sampling: Booked
    judged: Bools
    coupling: float

    @property
    def residual(self) -> Array:
        """V_i - V_i(0) + dissipation + passed on - work, over the judged periods, shape (K,), J."""
        change = np.diff(self.parts.total) + self.passed.total
        change += np.sum([one.total for one in self.taken.values()], axis=0)
        change -= np.sum([one.total for one in self.given.values()], axis=0)
        return cumulative(np.where(self.judged, change, 0.0))

    @property
    def unexplained(self) -> Array:
        """The residual without what the scheme does, shape (K,), J."""
        return self.residual - cumulative(np.where(self.judged, self.sampling.total, 0.0))

    @property
    def begin_s(self) -> float:
        """The first tick at which all that is under way rests on records, s; infinite where there is none."""
        seen = [v.seen.known & v.now.known for j, v in enumerate(self.views.values()) if self.follows(j)]
        rows = np.flatnonzero(np.logical_and.reduce(seen))
        return float(self.track.t_s[rows[0]]) if len(rows) else np.inf

    @property
    def followed(self) -> set[str]:
        """The peers that have a share at any time."""
        return {peer for j, peer in enumerate(self.views) if self.follows(j)}

    def follows(self, j: int) -> bool:
        """True where a peer, by its index, has a share at any time."""
        return bool(self.shares.alpha[:, j].any())

    @property
    def doubt(self) -> float:
        """How far off the books may be here by what happens within a period, J.

        The trapezoid rule by the second differences of all powers, summed; sampling and hands by what r and a
        torque change by together: where that adds up, the period is long for these gains. Where there are too
        few periods for second differences, all is in doubt.
        """
        if self.judged.sum() < LEAST_PERIODS:
            every = (self.passed, *self.taken.values(), *self.given.values())
            return float(sum(np.abs(one.left).sum() + np.abs(one.right).sum() for one in every))
        power = self.passed.left + np.sum([one.left for one in self.taken.values()], axis=0)
        power -= np.sum([one.left for one in self.given.values()], axis=0)
        return float(np.abs(np.diff(power[self.judged], 2)).sum()) / 6.0 + self.coupling


def cumulative(amounts: Array) -> Array:
    """Returns what has come together at every row, from 0 on."""
    return np.concatenate([[0.0], np.cumsum(amounts)])


def books(log: Log) -> dict[str, Book]:
    """Returns the books of all sites, in scenario order; {} where there is no time in which all are known.

    Args:
        log: a log all of whose sites have a functional.

    Raises:
        LogError: a record names a change that is none.
    """
    found = tracks(log)
    pasts = {site: Past(track) for site, track in found.items()}
    made = {site: _book(log, found, pasts, site) for site in found}
    begin_s = max((book.begin_s for book in made.values()), default=np.inf)
    fastest = max((track.rate_hz for track in found.values()), default=1)
    end_s = min((track.t_s[-1] for track in found.values()), default=0.0)
    return made if end_s - begin_s > 0.5 / fastest else {}


def _book(log: Log, found: dict[str, Track], pasts: dict[str, Past], site: str) -> Book:
    track, spec = found[site], log.scenario.sites[site]
    eq, share = equations(spec), shares(log, track)
    views = {peer: view(track, found[peer], pasts[peer]) for peer in track.used}
    seen = list(views.values())
    ends = periods(track, eq, share, seen)
    pushed = parted(track, spec)
    digital = Scheme[log.scenario.scheme.upper()] is Scheme.DIGITAL
    given = {
        "hands": work.of_torque(track, ends, pushed.hands, pushed.hands_held),
        "walls": work.of_torque(track, ends, pushed.walls, pushed.walls_held),
        **{
            f"{peer}->{site}": work.of_link(track, eq, share, ends, j, one)
            for j, (peer, one) in enumerate(views.items())
        },
        "shares": work.of_shares(track, eq, share, ends, seen),
        "rule": work.of_rule(track, eq, share, ends, seen),
        "torque limit": work.of_torque_limit(track, eq),
        "estimates": work.of_estimates(track, eq, digital=digital),
    }
    taken = {
        "damping": dissipation.damping(track, eq, ends),
        "disagreement": dissipation.disagreement(track, eq, share, seen),
    }
    known = [track.known[:-1], track.known[1:]]
    known += [v.known for j, v in enumerate(seen) if share.alpha[:, j].any()]
    judged: Bools = np.logical_and.reduce(known)
    return Book(
        track,
        eq,
        share,
        views,
        parts(track, eq, share, seen),
        taken,
        dissipation.passed_on(track, eq, share, seen),
        given,
        work.of_sampling(track, eq, ends, digital=digital),
        judged,
        sum(_coupling(track, ends, torque, judged) for torque in (track.tau, track.tau_x)),
    )


def _coupling(track: Track, ends: Periods, torque: Array, judged: Bools) -> float:
    """Returns twice the largest sum of h dr' dtau over the judged periods, J."""
    together = track.h_s * ((ends.r_right - ends.r_left) * np.diff(torque, axis=0)).sum(axis=1)
    return 2.0 * float(np.abs(cumulative(np.where(judged, together, 0.0))).max())

"""Energy balance of each site, and of all sites together under the weights beta.

Invariant: V_i - V_i(0) + dissipation + transfer - work vanishes for every site, without any weights; V -
V(0) + dissipation - work vanishes for the weighted sum, whatever the operators do. A log that violates it
was not produced by the equations that it claims.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from ...core.site_setup import Scheme
from ...core.vectors import Array
from ...log.log_reader import Log
from ..aligned import (
    AlignedRecords,
    Bools,
    DelayedPeer,
    PeerTrajectory,
    align_common_records,
    view_delayed_peer,
)
from ..dominance_history import DominanceHistory, trace_dominance
from ..lyapunov_weights import compute_lyapunov_weights
from ..torque_split import split_torque
from . import energy_terms
from .energy_terms import (
    FunctionalParts,
    Increment,
    PeriodEnds,
    SiteConstants,
    derive_site_constants,
    evaluate_functional,
    split_periods,
)

MIN_PERIODS = 10
"""Fewer show nothing of what happens within them."""


class SiteEnergy(NamedTuple):
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

    track: AlignedRecords
    eq: SiteConstants
    shares: DominanceHistory
    views: dict[str, DelayedPeer]
    parts: FunctionalParts
    taken: dict[str, Increment]
    passed: Increment
    given: dict[str, Increment]
    sampling: Increment
    judged: Bools
    coupling: float

    @property
    def residual(self) -> Array:
        """V_i - V_i(0) + dissipation + passed on - work, over the judged periods, shape (K,), J."""
        change = np.diff(self.parts.total) + self.passed.total
        change += np.sum([one.total for one in self.taken.values()], axis=0)
        change -= np.sum([one.total for one in self.given.values()], axis=0)
        return accumulate(np.where(self.judged, change, 0.0))

    @property
    def unexplained(self) -> Array:
        """The residual without what the scheme does, shape (K,), J."""
        return self.residual - accumulate(np.where(self.judged, self.sampling.total, 0.0))

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
        if self.judged.sum() < MIN_PERIODS:
            every = (self.passed, *self.taken.values(), *self.given.values())
            return float(sum(np.abs(one.left).sum() + np.abs(one.right).sum() for one in every))
        power = self.passed.left + np.sum([one.left for one in self.taken.values()], axis=0)
        power -= np.sum([one.left for one in self.given.values()], axis=0)
        return float(np.abs(np.diff(power[self.judged], 2)).sum()) / 6.0 + self.coupling


def accumulate(amounts: Array) -> Array:
    """Returns what has come together at every row, from 0 on."""
    return np.concatenate([[0.0], np.cumsum(amounts)])


def compute_site_energies(log: Log) -> dict[str, SiteEnergy]:
    """Returns the books of all sites, in scenario order; {} where there is no time in which all are known.

    Args:
        log: a log all of whose sites have a functional.

    Raises:
        LogError: a record names a change that is none.
    """
    found = align_common_records(log)
    pasts = {site: PeerTrajectory(track) for site, track in found.items()}
    made = {site: _site_energy(log, found, pasts, site) for site in found}
    begin_s = max((book.begin_s for book in made.values()), default=np.inf)
    fastest = max((track.rate_hz for track in found.values()), default=1)
    end_s = min((track.t_s[-1] for track in found.values()), default=0.0)
    return made if end_s - begin_s > 0.5 / fastest else {}


def _site_energy(
    log: Log, found: dict[str, AlignedRecords], pasts: dict[str, PeerTrajectory], site: str
) -> SiteEnergy:
    track, spec = found[site], log.scenario.sites[site]
    eq, share = derive_site_constants(spec), trace_dominance(log, track)
    views = {peer: view_delayed_peer(track, found[peer], pasts[peer]) for peer in track.used}
    seen = list(views.values())
    ends = split_periods(track, eq, share, seen)
    pushed = split_torque(track, spec)
    digital = Scheme[log.scenario.scheme.upper()] is Scheme.DIGITAL
    given = {
        "hands": energy_terms.torque_work(track, ends, pushed.hands, pushed.hands_held),
        "walls": energy_terms.torque_work(track, ends, pushed.walls, pushed.walls_held),
        **{
            f"{peer}->{site}": energy_terms.link_work(track, eq, share, ends, j, one)
            for j, (peer, one) in enumerate(views.items())
        },
        "shares": energy_terms.dominance_change_work(track, eq, share, ends, seen),
        "rule": energy_terms.stale_rule_work(track, eq, share, ends, seen),
        "torque limit": energy_terms.torque_limit_work(track, eq),
        "estimates": energy_terms.estimate_work(track, eq, digital=digital),
    }
    taken = {
        "damping": energy_terms.damping_dissipation(track, eq, ends),
        "disagreement": energy_terms.disagreement_dissipation(track, eq, share, seen),
    }
    known = [track.known[:-1], track.known[1:]]
    known += [v.known for j, v in enumerate(seen) if share.alpha[:, j].any()]
    judged: Bools = np.logical_and.reduce(known)
    return SiteEnergy(
        track,
        eq,
        share,
        views,
        evaluate_functional(track, eq, share, seen),
        taken,
        energy_terms.transferred_energy(track, eq, share, seen),
        given,
        energy_terms.sampling_work(track, eq, ends, digital=digital),
        judged,
        sum(_coupling(track, ends, torque, judged) for torque in (track.tau, track.tau_x)),
    )


def _coupling(track: AlignedRecords, ends: PeriodEnds, torque: Array, judged: Bools) -> float:
    """Returns twice the largest sum of h dr' dtau over the judged periods, J."""
    together = track.h_s * ((ends.r_right - ends.r_left) * np.diff(torque, axis=0)).sum(axis=1)
    return 2.0 * float(np.abs(accumulate(np.where(judged, together, 0.0))).max())


WeightFunction = Callable[[Array], Array]
ZERO_ENERGY_J = 1e-12
"""What rounding may leave of no energy at all."""


class EnergyBalance(NamedTuple):
    """The functional over time, at the ticks of the fastest site; energies in J.

    What is taken, given and passed counts in judged periods alone.

    Attributes:
        t_s: shape (T,), s.
        beta: the weights over time, shape (T, N).
        sites: per site beta_i V_i, each shape (T,).
        parts: of all sites: kinetic, parameter, position, delay, each shape (T,).
        taken: what was dissipated until then, by kind, each shape (T,).
        given: the work until then, by who did it, each shape (T,).
        sampling: the work of the scheme until then; no part of the balance, see `unexplained`, shape (T,).
        passed: what the weights failed to cancel until then, 0 where they are right, shape (T,).
        judged: whether the period before a tick rests on records alone, shape (T - 1,).
    """

    t_s: Array
    beta: Array
    sites: dict[str, Array]
    parts: dict[str, Array]
    taken: dict[str, Array]
    given: dict[str, Array]
    sampling: Array
    passed: Array
    judged: Bools

    @property
    def V(self) -> Array:  # noqa: N802 - the paper's symbol
        """The functional, shape (T,), J."""
        return _sum(self.parts)

    @property
    def residual(self) -> Array:
        """V - V(0) + dissipation - work, over the judged periods, shape (T,), J."""
        change = np.diff(self.V + _sum(self.taken) - _sum(self.given))
        return accumulate(np.where(self.judged, change, 0.0))

    @property
    def unexplained(self) -> Array:
        """What nobody accounts for: the residual less the scheme's work and what beta left, shape (T,), J."""
        known = np.diff(self.sampling - self.passed)
        return self.residual - accumulate(np.where(self.judged, known, 0.0))

    @property
    def own(self) -> Array:
        """V less what hands and walls gave, over the judged periods, shape (T,), J: what must not rise."""
        change = np.where(self.judged, np.diff(self.V - self.pushed), 0.0)
        own: Array = self.V[0] + accumulate(change)
        return own

    @property
    def pushed(self) -> Array:
        """The work of hands and walls until then, shape (T,), J."""
        return self.given["hands"] + self.given["walls"]

    @property
    def pushers(self) -> list[str]:
        """Who pushed: hands, walls, both or nobody."""
        return [name for name in ("hands", "walls") if self.given[name].any()]

    @property
    def scale(self) -> float:
        """What residuals are held against: the largest V, or the largest work where that is more, J."""
        return max(float(np.abs(x).max()) for x in (self.V, *self.given.values()))

    @property
    def relative(self) -> float:
        """Largest residual as a share of the scale; 0 where there is no energy but of rounding."""
        return float(np.abs(self.residual).max()) / self.scale if self.scale > ZERO_ENERGY_J else 0.0


def compute_energy_balance(books: Mapping[str, SiteEnergy], *, ones: bool = False) -> EnergyBalance:
    """Returns the balance of all sites.

    Args:
        books: of every site, in scenario order.
        ones: whether to weigh every site alike, as the paper does; then it need not close.
    """
    times = _times(books)
    weigh = _weigher(books, ones=ones)
    columns = {site: _column(books, site, times, weigh) for site in books}
    every = list(columns.values())
    judged: Bools = np.logical_and.reduce([np.diff(column.unjudged) == 0.0 for column in every])

    def booked(amounts: list[Array]) -> Array:
        """Adds up what came together, without what came while records are missing."""
        return accumulate(np.where(judged, np.diff(np.sum(amounts, axis=0)), 0.0))

    names = dict.fromkeys(name for column in every for name in column.given)
    return EnergyBalance(
        times,
        np.stack([column.beta for column in every], axis=1),
        {site: _sum(column.parts) for site, column in columns.items()},
        {name: _sum({n: c.parts[name] for n, c in columns.items()}) for name in FunctionalParts._fields},
        {name: booked([column.taken[name] for column in every]) for name in every[0].taken},
        {name: booked([column.given[name] for column in every if name in column.given]) for name in names},
        booked([column.sampling for column in every]),
        booked([column.passed for column in every]),
        judged,
    )


class _Column(NamedTuple):
    """What one site adds to the balance, at the common times."""

    beta: Array
    parts: dict[str, Array]
    taken: dict[str, Array]
    given: dict[str, Array]
    sampling: Array
    passed: Array
    unjudged: Array


def _column(books: Mapping[str, SiteEnergy], site: str, times: Array, weigh: WeightFunction) -> _Column:
    book, n = books[site], list(books).index(site)
    t_s = book.track.t_s
    beta = weigh(interpolate_dominance(books, t_s))[:, n]
    before = weigh(interpolate_dominance(books, t_s[:-1], book.track.h_s))[:, n]  # before a sudden change

    def at(values: Array) -> Array:
        same = len(t_s) == len(times) and t_s[0] == times[0]
        return values if same else np.interp(times, t_s, values)

    def together(amounts: Array) -> Array:
        values = at(accumulate(amounts))
        shifted: Array = values - values[0]
        return shifted

    def summed(one: Increment) -> Array:
        return together(beta[:-1] * one.left + before * (one.right + one.jump))

    given = {name: summed(one) for name, one in book.given.items()}
    V = book.parts.total
    smooth = (before - beta[:-1]) * 0.5 * (V[:-1] + V[1:])
    given["shares"] = given["shares"] + together(smooth + (beta[1:] - before) * V[1:])
    return _Column(
        at(beta),
        {name: at(beta * part) for name, part in book.parts._asdict().items()},
        {name: summed(one) for name, one in book.taken.items()},
        given,
        summed(book.sampling),
        summed(book.passed),
        together((~book.judged).astype(np.float64)),
    )


def _weigher(books: Mapping[str, SiteEnergy], *, ones: bool) -> WeightFunction:
    """Returns what gives beta, shape (T, N), for dominance matrices, shape (T, N, N)."""
    Kd = np.array([book.eq.Kd for book in books.values()])
    if ones:
        return lambda alpha: np.ones(alpha.shape[:2])

    @cache
    def beta(alpha: bytes) -> Array:
        return compute_lyapunov_weights(np.frombuffer(alpha).reshape(len(Kd), -1), Kd).beta

    def over_time(alpha: Array) -> Array:
        flat = np.round(alpha.reshape(len(alpha), -1), 12) + 0.0
        if np.all(flat == flat[0]):
            return np.tile(beta(flat[0].tobytes()), (len(flat), 1))
        rows, place = np.unique(flat, axis=0, return_inverse=True)
        return np.array([beta(row.tobytes()) for row in rows])[place.ravel()]

    return over_time


def interpolate_dominance(books: Mapping[str, SiteEnergy], t_s: Array, ahead_s: float = 0.0) -> Array:
    """Returns the dominance matrix at times, shape (T, N, N).

    Args:
        books: of every site, in scenario order.
        t_s: the times, shape (T,), s.
        ahead_s: how much further a ramp that is under way is followed, s.
    """
    names = list(books)
    alpha = np.zeros((len(t_s), len(names), len(names)))
    for i, book in enumerate(books.values()):
        place = (t_s - book.track.t_s[0]) * book.track.rate_hz
        row = np.clip(np.floor(place + 1e-5), 0, len(book.track.known) - 1).astype(np.int64)
        later_s = np.maximum(place - row, 0.0) / book.track.rate_hz + ahead_s
        for j, peer in enumerate(book.views):
            alpha[:, i, names.index(peer)] = book.shares.alpha[row, j] + later_s * book.shares.rate[row, j]
    # between its last tick and its end a ramp has been followed too far
    return np.clip(alpha, 0.0, 1.0)


def _times(books: Mapping[str, SiteEnergy]) -> Array:
    """Returns the ticks of the fastest site within the time in which every V_i is known from its start on."""
    tracks = [book.track for book in books.values()]
    times = max(tracks, key=lambda track: track.rate_hz).t_s
    begin_s = max(book.begin_s for book in books.values())
    end_s = min(track.t_s[-1] for track in tracks)
    kept: Array = times[(times >= begin_s - 1e-9) & (times <= end_s + 1e-9)]
    return kept


def _sum(columns: Mapping[str, Array]) -> Array:
    total: Array = np.sum(list(columns.values()), axis=0)
    return total

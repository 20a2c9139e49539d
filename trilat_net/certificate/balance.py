"""V of all sites together, and its energy balance.

Law: V(t) - V(0) + dissipation - work vanishes whatever the hands do. A log that breaks it was not made by the
equations that it claims.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .book import Book, cumulative
from .functional import Parts
from .periods import Booked
from .track import Bools
from .weights import weights

Weigher = Callable[[Array], Array]
NOTHING_J = 1e-12
"""What rounding may leave of no energy at all."""


class Balance(NamedTuple):
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
        return cumulative(np.where(self.judged, change, 0.0))

    @property
    def unexplained(self) -> Array:
        """What nobody accounts for: the residual less the scheme's work and what beta left, shape (T,), J."""
        known = np.diff(self.sampling - self.passed)
        return self.residual - cumulative(np.where(self.judged, known, 0.0))

    @property
    def own(self) -> Array:
        """V less what hands and walls gave, over the judged periods, shape (T,), J: what must not rise."""
        change = np.where(self.judged, np.diff(self.V - self.pushed), 0.0)
        own: Array = self.V[0] + cumulative(change)
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
        return float(np.abs(self.residual).max()) / self.scale if self.scale > NOTHING_J else 0.0


def balance(books: Mapping[str, Book], *, ones: bool = False) -> Balance:
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
        return cumulative(np.where(judged, np.diff(np.sum(amounts, axis=0)), 0.0))

    names = dict.fromkeys(name for column in every for name in column.given)
    return Balance(
        times,
        np.stack([column.beta for column in every], axis=1),
        {site: _sum(column.parts) for site, column in columns.items()},
        {name: _sum({n: c.parts[name] for n, c in columns.items()}) for name in Parts._fields},
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


def _column(books: Mapping[str, Book], site: str, times: Array, weigh: Weigher) -> _Column:
    book, n = books[site], list(books).index(site)
    t_s = book.track.t_s
    beta = weigh(alpha_at(books, t_s))[:, n]
    before = weigh(alpha_at(books, t_s[:-1], book.track.h_s))[:, n]  # before a sudden change

    def at(values: Array) -> Array:
        same = len(t_s) == len(times) and t_s[0] == times[0]
        return values if same else np.interp(times, t_s, values)

    def together(amounts: Array) -> Array:
        values = at(cumulative(amounts))
        shifted: Array = values - values[0]
        return shifted

    def summed(one: Booked) -> Array:
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


def _weigher(books: Mapping[str, Book], *, ones: bool) -> Weigher:
    """Returns what gives beta, shape (T, N), for dominance matrices, shape (T, N, N)."""
    Kd = np.array([book.eq.Kd for book in books.values()])
    if ones:
        return lambda alpha: np.ones(alpha.shape[:2])

    @cache
    def beta(alpha: bytes) -> Array:
        return weights(np.frombuffer(alpha).reshape(len(Kd), -1), Kd).beta

    def over_time(alpha: Array) -> Array:
        flat = np.round(alpha.reshape(len(alpha), -1), 12) + 0.0
        if np.all(flat == flat[0]):
            return np.tile(beta(flat[0].tobytes()), (len(flat), 1))
        rows, place = np.unique(flat, axis=0, return_inverse=True)
        return np.array([beta(row.tobytes()) for row in rows])[place.ravel()]

    return over_time


def alpha_at(books: Mapping[str, Book], t_s: Array, ahead_s: float = 0.0) -> Array:
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


def _times(books: Mapping[str, Book]) -> Array:
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

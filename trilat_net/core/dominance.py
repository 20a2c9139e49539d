"""Dominance: who follows whom, by how much, and the reference that a site derives from its
peers.

Invariant: rows of alpha sum to one, the diagonal is zero, and beta is the LEFT null vector of
Upsilon. While factors change, they are a function of time and of the ramps alone; between two
rows that sum to 1 every row does. A stale peer stops the reference; the return is smooth: from
the held pose to the peers along 3 x^2 - 2 x^3.

Source: Eq. (6), (7), (20) of the paper. The paper takes beta = (1, 1, 1); that is the right
null vector, and a left one only if the columns sum to one as well. The left one of an
irreducible matrix is its Perron vector, positive and unique up to its length.
"""

import numpy as np
from numpy.typing import NDArray

from .jit import leaf
from .lost_peers import regroup
from .site_setup import StaleAction
from .ticks import Mode, tick_ns
from .vectors import Array, Row, RowArray, put

ROW_SUM_TOLERANCE = 1e-9


def find_row_problem(row: Array, own: int) -> str | None:
    """Returns the problem of one row of alpha, shape (N,), of site `own`, or None: Eq. (7) for
    N sites.
    """
    if not np.isfinite(row).all():
        return "shares must be finite numbers"
    if row[own] != 0.0:
        return f"a site does not follow itself, yet its own share is {row[own]:g}"
    if (row < 0.0).any() or (row > 1.0).any():
        return "shares must lie between 0 and 1"
    if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
        return f"shares must sum to 1, Eq. (7), and sum to {row.sum():.12g}"
    return None


def find_reach(alpha: Array) -> NDArray[np.bool_]:
    """Returns which site reaches which along links with a factor above 0, shape (N, N), for
    alpha so.
    """
    reach: NDArray[np.bool_] = (alpha > 0.0) | np.eye(len(alpha), dtype=bool)
    for _ in range(len(alpha).bit_length()):
        reach = reach @ reach
    return reach


def is_irreducible(alpha: Array) -> bool:
    """True if every site reaches every other along links with a factor above 0, alpha of shape
    (N, N).
    """
    return bool(find_reach(alpha).all())


def find_balancing_weights(alpha: Array) -> Array | None:
    """Returns D > 0 with D_i alpha_ij = D_j alpha_ji (detailed balance), shape (N,); None if
    there is none.

    Shares that have such weights are reversible: their products are the same along every circle
    and against it (Kolmogorov), alpha12 alpha23 alpha31 = alpha13 alpha32 alpha21 for three
    sites, and the eigenvalues of alpha are real. Links out of a group of sites that reach each
    other are left out: no circle has them.
    """
    reach = find_reach(alpha)
    followed = reach & reach.T & (alpha > 0.0)
    D = np.zeros(len(alpha))
    for first in range(len(alpha)):
        waiting = [] if D[first] else [first]
        D[first] = D[first] or 1.0
        while waiting:
            i = waiting.pop()
            for j in np.flatnonzero(followed[i]).tolist():
                here = D[i] * alpha[i, j]
                there = alpha[j, i]
                if not D[j] and there:
                    D[j] = here / there
                    waiting.append(j)
                elif abs(here - D[j] * there) > ROW_SUM_TOLERANCE * here:
                    return None
    return D


def perron_vector(alpha: Array) -> Array:
    """Returns beta > 0 with beta' Upsilon = 0 and sum 1, shape (N,), for an irreducible alpha.

    By the elimination of Grassmann, Taksar and Heyman (1985): no subtraction occurs, so every
    entry is right to a few units in its last place, however many orders of magnitude the
    factors differ by.

    Raises:
        ValueError: alpha is reducible; then some site's weight would be zero, or beta not
            unique.
    """
    if not is_irreducible(alpha):
        raise ValueError("alpha is reducible: beta has a zero entry or is not unique")
    a = alpha.copy()
    size = len(a)
    for last in range(size - 1, 0, -1):
        a[:last, last] /= a[last, :last].sum()
        a[:last, :last] += np.outer(a[:last, last], a[last, :last])
    beta = np.zeros(size)
    beta[0] = 1.0
    for site in range(1, size):
        beta[site] = beta[:site] @ a[:site, site]
    normalised: Array = beta / beta.sum()
    return normalised


RAMP_COLUMNS = 2
"""A ramp is a row: start and end, ns, then the dominance factor of each peer at its end."""


@leaf
def _interpolate(
    t_ns: float, start_ns: float, end_ns: float, before: float, after: float
) -> float:
    if t_ns >= end_ns:
        return after
    return before + (after - before) * ((t_ns - start_ns) / (end_ns - start_ns))


@leaf
def apply_ramps(t_ns: int, count: int, ramps: Array, links: RowArray) -> None:
    """Writes alpha and its derivative at time t into every link.

    The first `count` rows of `ramps`, shape (R, RAMP_COLUMNS + P), are filled, in the order of
    their starts; row 0 holds the factors at the epoch. A ramp begins where the one before it is
    at that time, complete or not.
    """
    for j in range(links.shape[0]):
        link: Row = links[j]
        column = RAMP_COLUMNS + j
        before = ramps[0, column]
        current = 0
        for n in range(1, count):
            if t_ns < ramps[n, 0]:
                break
            before = _interpolate(
                t_ns=ramps[n, 0],
                start_ns=ramps[current, 0],
                end_ns=ramps[current, 1],
                before=before,
                after=ramps[current, column],
            )
            current = n
        start_ns = ramps[current, 0]
        end_ns = ramps[current, 1]
        after = ramps[current, column]
        link.alpha = _interpolate(
            t_ns=t_ns, start_ns=start_ns, end_ns=end_ns, before=before, after=after
        )
        link.alpha_rate = (
            (after - before) / ((end_ns - start_ns) * 1e-9) if t_ns < end_ns else 0.0
        )


def fold_ramps(t_ns: int, count: int, ramps: Array) -> int:
    """Folds the ramps that are over at time t into the first row, and returns how many rows are
    left.

    A ramp begins where the one before it is at that time. Row 0 then holds that of the last one
    that has
    begun: from there on `apply_ramps` writes the same bits.
    """
    last = int(np.searchsorted(ramps[1:count, 0], t_ns, side="right"))
    if last < 2:
        return count
    before = ramps[0, RAMP_COLUMNS:].copy()
    current = 0
    for n in range(1, last + 1):
        start_ns, end_ns = ramps[current, :RAMP_COLUMNS]
        for j, after in enumerate(ramps[current, RAMP_COLUMNS:]):
            before[j] = _interpolate(
                t_ns=ramps[n, 0],
                start_ns=start_ns,
                end_ns=end_ns,
                before=before[j],
                after=after,
            )
        current = n
    ramps[0, RAMP_COLUMNS:] = before
    ramps[1 : count - last + 1] = ramps[last:count].copy()
    return count - last + 1


_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_HOLD = int(Mode.HOLD)
_BRAKE = int(Mode.BRAKE)
_RETURN = int(Mode.RETURN)
_USE = int(StaleAction.USE)
_ACT_BRAKE = int(StaleAction.BRAKE)


@leaf
def any_peer_stale(t_ns: int, age_ns: int, links: RowArray) -> bool:
    """True if a peer that is followed is older than `age_ns`; before its first sample it is as
    old as t.
    """
    for j in range(links.shape[0]):
        link: Row = links[j]
        stamp_ns = tick_ns(max(link.used, 0), link.rate_hz)
        if link.alpha > 0.0 and t_ns - stamp_ns > age_ns:
            return True
    return False


@leaf
def update_stale_mode(t_ns: int, site: Row, links: RowArray) -> None:
    """Changes the mode if peers became stale or fresh, and the reference as the mode requires."""
    if site.on_stale == _USE or site.mode == _DIVERGED:
        return
    stale = any_peer_stale(t_ns, site.stale_ns, links)
    if stale and (site.mode == _RUN or site.mode == _RETURN):
        braking = site.on_stale == _ACT_BRAKE
        for i in range(site.q_held.shape[0]):
            here = site.x[i] if site.task else site.q[i]
            site.q_held[i] = here if braking else site.q_followed[i]
        site.mode = _BRAKE if braking else _HOLD
        site.return_from_ns = 0
    elif not stale and (site.mode == _HOLD or site.mode == _BRAKE):
        site.mode = _RETURN
        site.return_from_ns = t_ns
    if site.mode == _RETURN and t_ns - site.return_from_ns >= site.return_ns:
        site.mode = _RUN
    if site.mode == _RUN:
        return
    x = (t_ns - site.return_from_ns) / site.return_ns if site.mode == _RETURN else 0.0
    share = x * x * (3.0 - 2.0 * x)
    share_rate = 6.0 * x * (1.0 - x) / (site.return_ns * 1e-9)
    for i in range(site.q_held.shape[0]):
        way = site.q_des[i] - site.q_held[i]
        site.q_des[i] = site.q_held[i] + share * way
        site.qd_des[i] = share * site.qd_des[i] + share_rate * way


@leaf
def update_reference(t_ns: int, site: Row, links: RowArray, ramps: Array) -> None:
    """Writes q_id and its derivative, Eq. (6), summing over peers in scenario order.

    While factors change, the derivative includes their rates.
    """
    if site.ramps > 1 or site.degrades:
        apply_ramps(t_ns, site.ramps, ramps, links)
    if site.degrades:
        regroup(t_ns, site, links)
    put(site.q_followed, site.q_des)
    put(site.qd_followed, site.qd_des)
    for i in range(site.q_des.shape[0]):
        q_des = qd_des = felt = 0.0
        for j in range(links.shape[0]):
            link: Row = links[j]
            q_des += link.alpha * link.q[i]
            qd_des += link.alpha * link.qd[i] + link.alpha_rate * link.q[i]
            felt -= link.alpha * link.tau_x[i]
        site.q_des[i] = q_des
        site.qd_des[i] = qd_des
        site.felt[i] = felt

"""Dominance of sites: alpha of Eq. (6) over time, ramps and steps included, and the weights
that it gives.

Invariant: alpha is a function of time and of the applied changes alone; a ramp starts from the
value that the ramp before it has at that time.

The weights of the sites' functionals are beta_i = pi_i / c_i: pi is the left Perron vector of
alpha, c_i the scalar in Kd_i = c_i Kbar. Both conditions are necessary: beta' Upsilon <= 0
together with Upsilon 1 = 0 forces equality, so there is no slack. pi as the weight of a delayed
consensus is a known result (docs/errata.md); the paper uses ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.dominance import find_reach, perron_vector
from ..core.ticks import DominanceRamp
from ..core.vectors import Array
from ..errors import UsageError
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..scenario import Scenario

RAMP_TIME_TOLERANCE_S = 5e-10
"""Half of the nanosecond in which ramps begin and end."""


class DominanceHistory(NamedTuple):
    """Dominance factors of a site for its peers, in scenario order.

    Attributes:
        alpha: at every row, shape (K, P).
        rate: their derivative as the controller takes it into account, shape (K, P), 1/s.
        before: at the end of every period, before a step there, shape (K - 1, P).
    """

    alpha: Array
    rate: Array
    before: Array

    @property
    def constant(self) -> bool:
        """True if nothing changes."""
        return bool(np.all(self.alpha == self.alpha[0]) and not self.rate.any())


def trace_dominance(log: Log, site: str, t_s: Array) -> DominanceHistory:
    """Returns the dominance factors of a site at ticks in a row, s.

    Raises:
        LogError: a record names a change that is none.
    """
    planned = evaluate_ramps(
        *list_ramps(log, site), t_s, 1.0 / log.scenario.sites[site].rate_hz
    )
    there = ~find_lost_peers(log, site, t_s)
    if there.all():
        return planned
    alpha = planned.alpha * there
    rate = planned.rate * there
    before = planned.before * there[:-1]
    whole = alpha.sum(axis=1, keepdims=True)
    whole_rate = rate.sum(axis=1, keepdims=True)
    rate = (rate * whole - alpha * whole_rate) / whole**2
    return DominanceHistory(alpha / whole, rate, before / before.sum(axis=1, keepdims=True))


def list_ramps(log: Log, site: str) -> tuple[Array, list[DominanceRamp]]:
    """Returns the factors of a site at the epoch, shape (P,), and its ramps, scripted and
    ordered.
    """
    start, scripted = list_scripted_ramps(log.scenario, site)
    ordered = [
        c.ramp for batch in log.commands(site).values() for c in batch if c.ramp is not None
    ]
    return start, [*scripted, *ordered]


def find_users(scenario: Scenario) -> tuple[str, list[str]]:
    """Returns the first slave, "" if there is none, and its users: the masters."""
    slaves, users = (
        [site for site, spec in scenario.sites.items() if spec.role == role]
        for role in ("slave", "master")
    )
    return next(iter(slaves), ""), users


class UserShares(NamedTuple):
    """Who of its users leads a slave, over K times. Where that is not the program, somebody
    intervenes.

    Attributes:
        shares: alpha of the slave for each of them, shape (K, U).
        leader: the user with the largest share, by its place; the program, if no share is larger.
        program: the user that a program holds, by its place.
    """

    shares: Array
    leader: Ints
    program: int


def find_user_shares(scenario: Scenario, alpha: Array, program: str = "") -> UserShares:
    """Returns who leads the slave of `find_users`, by its alpha, shape (K, P).

    Raises:
        UsageError: there is no such user; by default the program is the last one.
    """
    slave, users = find_users(scenario)
    if (program := program or users[-1]) not in users:
        raise UsageError(f"the program holds one of {', '.join(users)}, not {program!r}")
    shares = alpha[:, [scenario.peers(slave).index(user) for user in users]]
    place = users.index(program)
    tied = shares[:, place] >= shares.max(axis=1)
    return UserShares(shares, np.where(tied, place, shares.argmax(axis=1)), place)


def find_lost_peers(log: Log, site: str, t_s: Array) -> NDArray[np.bool_]:
    """Returns which peers a site goes on without at some times, s, shape (K, P): see
    `core.lost_peers`.
    """
    part = log[site]
    peers = len(log[site].peers)
    lost = np.zeros((len(t_s), peers), dtype=bool)
    if not log.scenario.sites[site].on_stale.rule.degrades or not len(part):
        return lost
    gone = part.memory(part.layout.count_life_memory(peers), peers) != 0.0
    rows = np.searchsorted(part.t_s, t_s + RAMP_TIME_TOLERANCE_S, side="right") - 1
    lost[rows >= 0] = gone[rows[rows >= 0]]
    return lost


def list_losses(log: Log) -> list[str]:
    """Returns the times in which a site went on without a peer, in words."""
    found = []
    for site in log.sites:
        part = log[site]
        lost = find_lost_peers(log, site, part.t_s).astype(int)
        for j, peer in enumerate(part.peers):
            edges = np.diff(np.concatenate([[0], lost[:, j], [0]]))
            times = (
                np.append(part.t_s, part.t_s[-1] + 1.0 / part.rate_hz)
                if len(part)
                else part.t_s
            )
            for first, last in zip(
                np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True
            ):
                found.append(f"{site} without {peer} {times[first]:.4g} to {times[last]:.4g} s")
    return found


def list_scripted_ramps(scenario: Scenario, site: str) -> tuple[Array, list[DominanceRamp]]:
    """Returns the factors of a site at the epoch, shape (P,), and the ramps of the scenario's
    timeline.
    """
    start = np.array([scenario.dominance[site].get(peer, 0.0) for peer in scenario.peers(site)])
    return start, scenario.scripted_ramps(site)


def drop_finished_ramps(
    start: Array, ramps: Sequence[DominanceRamp], from_s: float
) -> tuple[Array, list[DominanceRamp]]:
    """Returns factors and ramps that give the same history from a time on, without the ramps
    before it.
    """
    ordered = sorted(ramps, key=lambda ramp: ramp.start_ns)
    begun = sum(ramp.start_ns * 1e-9 <= from_s for ramp in ordered)
    if begun < 2:
        return start, ordered
    turn_s = np.array([ordered[begun - 1].start_ns * 1e-9])
    return evaluate_ramps(start, ordered[: begun - 1], turn_s, 0.0).alpha[0], ordered[
        begun - 1 :
    ]


def evaluate_ramps(
    start: Array, ramps: Sequence[DominanceRamp], t_s: Array, h_s: float
) -> DominanceHistory:
    """Returns dominance factors, at the epoch `start`, shape (P,), at ascending times, `h_s`
    apart, s.
    """
    alpha = np.tile(start, (len(t_s), 1))
    rate = np.zeros((len(t_s), len(start)))
    before = start
    start_s = 0.0
    end_s = 0.0
    after = start
    for ramp in sorted(ramps, key=lambda ramp: ramp.start_ns):
        at_s = ramp.start_ns * 1e-9
        share = 1.0 if at_s >= end_s else (at_s - start_s) / (end_s - start_s)
        before = after if share == 1.0 else before + (after - before) * share
        start_s = at_s
        end_s = ramp.end_ns * 1e-9
        after = np.array(ramp.alpha)
        later = t_s >= start_s - RAMP_TIME_TOLERANCE_S
        climbs = later & (t_s < end_s - RAMP_TIME_TOLERANCE_S)
        alpha[later] = after
        rate[later] = 0.0
        if climbs.any():
            slope = (after - before) / ((ramp.end_ns - ramp.start_ns) * 1e-9)
            alpha[climbs] = before + slope * (t_s[climbs, np.newaxis] - start_s)
            rate[climbs] = slope
    return DominanceHistory(alpha, rate, alpha[:-1] + h_s * rate[:-1])


KD_SHAPE_TOLERANCE = 1e-9
"""Relative difference up to which two gains are one."""


class LyapunovWeights(NamedTuple):
    """Weights beta, as far as they exist.

    Attributes:
        beta: per site, sum N, so that equal shares give the paper's ones, shape (N,).
        groups: the closed groups of sites, each a tuple of indices: none in it follows a site
            outside. Of one group pi is unique, though some of its entries may be 0.
        scales: c_i of Kd_i = c_i Kbar, c of the first site 1, shape (N,); None if the Kd differ
            in shape.
    """

    beta: Array
    groups: tuple[tuple[int, ...], ...]
    scales: Array | None


def find_closed_groups(alpha: Array) -> tuple[tuple[int, ...], ...]:
    """Returns the groups of sites that reach each other and no other along shares, alpha shape
    (N, N).
    """
    reach = find_reach(alpha)
    groups = []
    for site in range(len(alpha)):
        group = tuple(np.flatnonzero(reach[site] & reach[:, site]).tolist())
        if group[0] == site and reach[site].sum() == len(group):
            groups.append(group)
    return tuple(groups)


def left_perron_vector(alpha: Array) -> Array:
    """Returns pi >= 0 with pi' alpha = pi' and sum 1, shape (N,); 0 for sites outside of closed
    groups.

    If several closed groups make it ambiguous, each counts by its number of sites.
    """
    pi = np.zeros(len(alpha))
    groups = find_closed_groups(alpha)
    total = sum(map(len, groups))
    for group in groups:
        pi[list(group)] = perron_vector(alpha[np.ix_(group, group)]) * len(group) / total
    return pi


def find_kd_scales(Kd: Array) -> Array | None:
    """Returns c_i of Kd_i = c_i Kbar with c_1 = 1, or None if there are no such scalars, Kd
    shape (N, n).

    A number that is NaN is of an axis of the task that its site does not follow. If every Kd is
    zero, nothing couples the sites and any scale holds: ones.
    """
    if not np.nan_to_num(Kd).any():
        return np.ones(len(Kd))
    sizes = Kd[:, np.isfinite(Kd).all(axis=0)].sum(axis=1)
    if not sizes.all():
        return None
    shapes = Kd / sizes[:, np.newaxis]
    if (
        np.nan_to_num(np.fmax.reduce(shapes) - np.fmin.reduce(shapes)).max()
        > KD_SHAPE_TOLERANCE
    ):
        return None
    scales: Array = sizes / sizes[0]
    return scales


def compute_lyapunov_weights(alpha: Array, Kd: Array) -> LyapunovWeights:
    """Returns beta_i = pi_i / c_i; if the Kd, shape (N, n), differ in shape, pi alone, which
    lets V rise.
    """
    scales = find_kd_scales(Kd)
    beta = left_perron_vector(alpha) / (1.0 if scales is None else scales)
    return LyapunovWeights(beta * (len(beta) / beta.sum()), find_closed_groups(alpha), scales)

"""Traces the dominance of sites over time, alpha of Eq. (6), and its Lyapunov weights.

The weights of the sites' functionals are beta_i = pi_i / c_i, where pi is the left Perron
vector of alpha, and c_i the scalar in Kd_i = c_i Kbar. Both conditions are necessary: beta'
Upsilon <= 0 together with Upsilon 1 = 0 forces equality, so that there is no slack. pi as the
weight of a delayed consensus is a known result (docs/errata.md); the paper uses ones.

Invariant:
    - alpha is a function of time and of the applied changes alone.
    - A ramp starts from the value that the ramp before it has at that time.
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
"""Half of the nanosecond to which ramps start and end, s."""


class DominanceHistory(NamedTuple):
    """Dominance factors of a site for its P peers, in scenario order.

    Attributes:
        alpha: factors at every row, shape (K, P).
        rate: their derivatives as the controller takes them into account, shape (K, P), 1/s.
        before: factors at the end of every period, before a step there, shape (K - 1, P).
    """

    alpha: Array
    rate: Array
    before: Array

    @property
    def constant(self) -> bool:
        """True if no factor ever changes."""
        return bool(np.all(self.alpha == self.alpha[0]) and not self.rate.any())


def trace_dominance(log: Log, site: str, t_s: Array) -> DominanceHistory:
    """Returns the dominance factors of a site at successive ticks.

    A site that goes on without a peer rescales the factors of the others to the sum 1.

    Args:
        log: the log of a run.
        site: name of the site.
        t_s: times of the ticks, shape (K,), s.

    Raises:
        LogError: a record names a change that is not valid.
    """
    start, ramps = list_ramps(log, site)
    planned = evaluate_ramps(start, ramps, t_s, 1.0 / log.scenario.sites[site].rate_hz)
    present = ~find_lost_peers(log, site, t_s)
    if present.all():
        return planned
    alpha = planned.alpha * present
    rate = planned.rate * present
    before = planned.before * present[:-1]
    total = alpha.sum(axis=1, keepdims=True)
    total_rate = rate.sum(axis=1, keepdims=True)
    return DominanceHistory(
        alpha=alpha / total,
        rate=(rate * total - alpha * total_rate) / total**2,
        before=before / before.sum(axis=1, keepdims=True),
    )


def list_ramps(log: Log, site: str) -> tuple[Array, list[DominanceRamp]]:
    """Returns the factors of a site at the epoch, shape (P,), and all its ramps.

    The ramps are those of the scenario and those that were ordered.

    Raises:
        LogError: a record names a change that is not valid.
    """
    start, scripted = list_scripted_ramps(log.scenario, site)
    changes = [change for batch in log.commands(site).values() for change in batch]
    ordered = [change.ramp for change in changes if change.ramp is not None]
    return start, [*scripted, *ordered]


def find_users(scenario: Scenario) -> tuple[str, list[str]]:
    """Returns the first slave ("" if there is none) and its users, which are all masters."""
    slaves = [site for site, spec in scenario.sites.items() if spec.role == "slave"]
    masters = [site for site, spec in scenario.sites.items() if spec.role == "master"]
    return next(iter(slaves), ""), masters


class UserShares(NamedTuple):
    """Shares of the users of a slave, over K times.

    If the leader is not the user that the program holds, somebody intervenes.

    Attributes:
        shares: the slave's dominance factors for its U users, shape (K, U).
        leader: index of the user with the largest share, shape (K,); that of the program if no
            share is larger than the program's.
        program: index of the user that a program holds.
    """

    shares: Array
    leader: Ints
    program: int


def find_user_shares(scenario: Scenario, alpha: Array, program: str = "") -> UserShares:
    """Returns the shares of the users in the slave of `find_users`.

    Args:
        scenario: scenario of the run.
        alpha: dominance factors of the slave, shape (K, P).
        program: the user that a program holds; by default the last user.

    Raises:
        UsageError: there is no such user.
    """
    slave, users = find_users(scenario)
    program = program or users[-1]
    if program not in users:
        raise UsageError(f"the program holds one of {', '.join(users)}, not {program!r}")
    peers = scenario.peers(slave)
    shares = alpha[:, [peers.index(user) for user in users]]
    program_index = users.index(program)
    program_leads = shares[:, program_index] >= shares.max(axis=1)
    leader = np.where(program_leads, program_index, shares.argmax(axis=1))
    return UserShares(shares, leader, program_index)


def find_lost_peers(log: Log, site: str, t_s: Array) -> NDArray[np.bool_]:
    """Returns the peers without which a site goes on, over time; see `core.lost_peers`.

    Args:
        log: the log of a run.
        site: name of the site.
        t_s: times, shape (K,), s.

    Returns:
        True for each lost peer, shape (K, P).
    """
    part = log[site]
    peer_count = len(part.peers)
    lost = np.zeros((len(t_s), peer_count), dtype=bool)
    if not log.scenario.sites[site].on_stale.rule.degrades or not len(part):
        return lost
    first = part.layout.count_life_memory(peer_count)
    is_lost = part.memory(first, peer_count) != 0.0
    rows = np.searchsorted(part.t_s, t_s + RAMP_TIME_TOLERANCE_S, side="right") - 1
    recorded = rows >= 0
    lost[recorded] = is_lost[rows[recorded]]
    return lost


def list_losses(log: Log) -> list[str]:
    """Returns sentences on the times in which a site went on without a peer."""
    sentences = []
    for site in log.sites:
        part = log[site]
        lost = find_lost_peers(log, site, part.t_s).astype(int)
        times_s = part.t_s
        if len(part):
            times_s = np.append(part.t_s, part.t_s[-1] + 1.0 / part.rate_hz)
        for j, peer in enumerate(part.peers):
            edges = np.diff(np.concatenate([[0], lost[:, j], [0]]))
            starts_s = times_s[np.flatnonzero(edges > 0)]
            ends_s = times_s[np.flatnonzero(edges < 0)]
            sentences += [
                f"{site} without {peer} {from_s:.4g} to {to_s:.4g} s"
                for from_s, to_s in zip(starts_s, ends_s, strict=True)
            ]
    return sentences


def list_scripted_ramps(scenario: Scenario, site: str) -> tuple[Array, list[DominanceRamp]]:
    """Returns the factors of a site at the epoch, shape (P,), and the scenario's ramps."""
    factors = scenario.dominance[site]
    start = np.array([factors.get(peer, 0.0) for peer in scenario.peers(site)])
    return start, scenario.scripted_ramps(site)


def drop_finished_ramps(
    start: Array, ramps: Sequence[DominanceRamp], from_s: float
) -> tuple[Array, list[DominanceRamp]]:
    """Returns factors and ramps with the same history from a time on, without earlier ramps.

    Args:
        start: factors at the epoch, shape (P,).
        ramps: all ramps.
        from_s: time from which the history must be the same, in s.
    """
    ordered = sorted(ramps, key=lambda ramp: ramp.start_ns)
    started = sum(ramp.start_ns * 1e-9 <= from_s for ramp in ordered)
    if started < 2:
        return start, ordered
    finished = ordered[: started - 1]
    remaining = ordered[started - 1 :]
    turn_s = np.array([remaining[0].start_ns * 1e-9])
    return evaluate_ramps(start, finished, turn_s, 0.0).alpha[0], remaining


def evaluate_ramps(
    start: Array, ramps: Sequence[DominanceRamp], t_s: Array, h_s: float
) -> DominanceHistory:
    """Returns the dominance factors over time.

    Args:
        start: factors at the epoch, shape (P,).
        ramps: ramps of the factors.
        t_s: ascending times, one period apart, shape (K,), s.
        h_s: the period, in s.
    """
    alpha = np.tile(start, (len(t_s), 1))
    rate = np.zeros((len(t_s), len(start)))
    # the ramp in progress: its factors at start and end, and its times
    before = start
    after = start
    start_s = 0.0
    end_s = 0.0
    for ramp in sorted(ramps, key=lambda ramp: ramp.start_ns):
        next_start_s = ramp.start_ns * 1e-9
        share = 1.0
        if next_start_s < end_s:
            share = (next_start_s - start_s) / (end_s - start_s)
        # exact factors at the end of a finished ramp, which interpolation would round
        before = after if share == 1.0 else before + (after - before) * share
        after = np.array(ramp.alpha)
        start_s = next_start_s
        end_s = ramp.end_ns * 1e-9
        is_later = t_s >= start_s - RAMP_TIME_TOLERANCE_S
        is_climbing = is_later & (t_s < end_s - RAMP_TIME_TOLERANCE_S)
        alpha[is_later] = after
        rate[is_later] = 0.0
        if is_climbing.any():
            slope = (after - before) / ((ramp.end_ns - ramp.start_ns) * 1e-9)
            alpha[is_climbing] = before + slope * (t_s[is_climbing, np.newaxis] - start_s)
            rate[is_climbing] = slope
    return DominanceHistory(alpha, rate, alpha[:-1] + h_s * rate[:-1])


KD_SHAPE_TOLERANCE = 1e-9
"""Relative difference up to which two gains count as equal."""


class LyapunovWeights(NamedTuple):
    """Lyapunov weights beta, as far as they exist.

    Attributes:
        beta: weight of each site, with the sum N, so that equal shares give the paper's ones,
            shape (N,).
        groups: the closed groups of sites, as tuples of indices: no site of a group follows a
            site outside. If there is a single group, pi is unique, though some of its entries
            may be 0.
        scales: c_i of Kd_i = c_i Kbar, with 1 for the first site, shape (N,); None if the Kd
            differ in shape.
    """

    beta: Array
    groups: tuple[tuple[int, ...], ...]
    scales: Array | None


def find_closed_groups(alpha: Array) -> tuple[tuple[int, ...], ...]:
    """Returns the groups of sites that reach each other along shares, and no other site.

    Args:
        alpha: the dominance matrix, shape (N, N).
    """
    reach = find_reach(alpha)
    groups = []
    for site in range(len(alpha)):
        group = tuple(np.flatnonzero(reach[site] & reach[:, site]).tolist())
        if group[0] == site and reach[site].sum() == len(group):
            groups.append(group)
    return tuple(groups)


def left_perron_vector(alpha: Array) -> Array:
    """Returns pi >= 0 with pi' alpha = pi' and sum 1, shape (N,).

    pi is 0 for sites outside closed groups. If several closed groups make it ambiguous, each
    group counts by its number of sites.
    """
    pi = np.zeros(len(alpha))
    groups = find_closed_groups(alpha)
    total = sum(map(len, groups))
    for group in groups:
        pi[list(group)] = perron_vector(alpha[np.ix_(group, group)]) * len(group) / total
    return pi


def find_kd_scales(Kd: Array) -> Array | None:
    """Returns c_i of Kd_i = c_i Kbar with c_1 = 1; None if there are no such scalars.

    If every Kd is zero, nothing couples the sites, and any scale holds: ones are returned.

    Args:
        Kd: gains, shape (N, n); NaN along an axis that a site does not follow.
    """
    if not np.nan_to_num(Kd).any():
        return np.ones(len(Kd))
    is_common_axis = np.isfinite(Kd).all(axis=0)
    sizes = Kd[:, is_common_axis].sum(axis=1)
    if not sizes.all():
        return None
    shapes = Kd / sizes[:, np.newaxis]
    # fmax and fmin ignore NaN
    differences = np.fmax.reduce(shapes) - np.fmin.reduce(shapes)
    if np.nan_to_num(differences).max() > KD_SHAPE_TOLERANCE:
        return None
    scales: Array = sizes / sizes[0]
    return scales


def compute_lyapunov_weights(alpha: Array, Kd: Array) -> LyapunovWeights:
    """Returns the weights beta_i = pi_i / c_i.

    If the Kd differ in shape, pi alone is returned as beta, which lets V rise.

    Args:
        alpha: the dominance matrix, shape (N, N).
        Kd: gains, shape (N, n).
    """
    scales = find_kd_scales(Kd)
    beta = left_perron_vector(alpha) / (1.0 if scales is None else scales)
    return LyapunovWeights(
        beta=beta * (len(beta) / beta.sum()),
        groups=find_closed_groups(alpha),
        scales=scales,
    )

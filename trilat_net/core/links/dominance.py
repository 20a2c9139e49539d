"""Computes the position that an arm follows: a weighted mean of the positions of other arms.

Site i follows site j with weight alpha_ij, called the dominance factor or share. If two users
with factors 0.7 and 0.3 lead a slave, the slave follows 0.7 q_1 + 0.3 q_2, where q_j is the
position of arm j. This sum is the reference of the slave.

In the stability proof, the coupling is described by the matrix Upsilon = I - alpha, where I is
the identity. The energy function of the proof weights site i by beta_i.

Invariant:
    - Each row of the matrix alpha sums to 1, and its diagonal is zero.
    - beta is the LEFT null vector of Upsilon.
    - Factors change along ramps. Every row also sums to 1 during a ramp. The factors at a given
      time depend only on this time and the ramps.
    - If samples from another site stop arriving, the reference stops. It later returns smoothly
      from the held pose along the polynomial 3 x^2 - 2 x^3, with x from 0 to 1.

Source: Eq. (6), (7), (20) of the paper on which this project is based
(docs/reference/references.md). The paper uses beta = (1, 1, 1). This is the right null vector
of Upsilon, and is a left null vector only if the columns also sum to 1. The left null vector of
an irreducible matrix is its Perron vector, which is positive and unique up to scaling.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..step.jit import leaf
from ..step.row_fields import LinkRow, SiteRow
from ..step.site_setup import StaleAction
from ..step.ticks import Mode, tick_ns
from ..step.vectors import Array, RowArray
from .lost_peers import regroup

ROW_SUM_TOLERANCE = 1e-9


class DominanceMatrix:
    """Matrix of the dominance factors alpha_ij with which N sites follow each other.

    Site i follows site j, with weight alpha_ij, if alpha_ij is positive.

    Args:
        alpha: Dominance factors, shape (N, N). Row i contains the weights with which site i
            follows the other sites.

    Attributes:
        alpha: The dominance factors passed to the constructor.
    """

    @classmethod
    def complementary(cls, a: float) -> "DominanceMatrix":
        """Computes all dominance factors of two users and a slave from the single factor a.

        The slave follows user 1 with the weight a and user 2 with 1 - a. User 1 follows user 2
        with 1 - a and the slave with a. User 2 follows user 1 with a and the slave with 1 - a.

        Args:
            a: Authority of user 1, from 0 to 1. User 2 has 1 - a.

        Returns:
            The matrix, in the order user 1, user 2, slave.
        """
        user_1 = (0.0, 1.0 - a, a)
        user_2 = (a, 0.0, 1.0 - a)
        slave = (a, 1.0 - a, 0.0)
        return cls(np.array([user_1, user_2, slave]))

    def __init__(self, alpha: Array) -> None:
        self.alpha = alpha
        # True at [i, j] if i = j, or if site i follows site j directly or through other sites.
        reach: NDArray[np.bool_] = (alpha > 0.0) | np.eye(len(alpha), dtype=bool)
        # Each squaring doubles the length of the paths.
        for _ in range(len(alpha).bit_length()):
            reach = reach @ reach
        self._reach = reach

    @property
    def is_irreducible(self) -> bool:
        """True if every site follows every other site, directly or through others.

        The stability theorem requires this property.
        """
        return bool(self._reach.all())

    @cached_property
    def closed_groups(self) -> tuple[tuple[int, ...], ...]:
        """Groups of sites that follow each other, but follow no site outside their group.

        Each group is a tuple of the indices of its sites. If there are several groups, the
        weights of the sites in the energy function V are not unique.
        """
        reach = self._reach
        groups = []
        for site in range(len(reach)):
            is_mutual = reach[site] & reach[:, site]
            group = tuple(np.flatnonzero(is_mutual).tolist())
            # The first site of a group represents the group.
            is_first = group[0] == site
            is_closed = reach[site].sum() == len(group)
            if is_first and is_closed:
                groups.append(group)
        return tuple(groups)

    def find_balancing_weights(self) -> Array | None:
        """Returns weights D > 0 with D_i alpha_ij = D_j alpha_ji, if the matrix is reversible.

        With such weights, the matrix is similar to a symmetric matrix, so its eigenvalues are
        real. Some stability conditions hold only in this case. The equation is called detailed
        balance. It has a solution if the products of the dominance factors around each cycle of
        sites are equal in both directions (Kolmogorov's criterion), for example alpha12 alpha23
        alpha31 = alpha13 alpha32 alpha21 for three sites. Links that leave a group of mutually
        reachable sites belong to no cycle and are ignored.

        Returns:
            D, shape (N,), with D = 1 at the first site of each group. None if no D exists.
        """
        alpha = self.alpha
        is_on_circle = self._reach & self._reach.T & (alpha > 0.0)
        D = np.zeros(len(alpha))  # 0: not known yet
        for first in range(len(alpha)):
            if D[first]:
                continue
            # Start at the first site of a group: the balance with its neighbours determines
            # their weights.
            D[first] = 1.0
            unvisited = [first]
            while unvisited:
                i = unvisited.pop()
                for j in np.flatnonzero(is_on_circle[i]).tolist():
                    forward = D[i] * alpha[i, j]
                    alpha_back = alpha[j, i]
                    imbalance = abs(forward - D[j] * alpha_back)
                    if not D[j] and alpha_back:
                        D[j] = forward / alpha_back
                        unvisited.append(j)
                    elif imbalance > ROW_SUM_TOLERANCE * forward:
                        return None
        return D

    def find_least_eigenvalue(self) -> float | None:
        """Returns the least eigenvalue of the matrix, or None if the matrix is not reversible.

        All eigenvalues of a reversible matrix are real, see `find_balancing_weights`. A
        stability condition for spring laws requires that d / (K T) exceed the negative of the
        least eigenvalue, where d is the damping, K the stiffness and T the delay
        (docs/theory/damping-conditions.md).
        """
        if self.find_balancing_weights() is None:
            return None
        eigenvalues = np.linalg.eigvals(self.alpha)
        return float(eigenvalues.real.min())

    def find_beta(self) -> Array:
        """Returns the weights beta of the sites in the energy function of the proof.

        The weights are the positive solution of beta' = beta' alpha whose entries sum to 1
        (beta' Upsilon = 0 in the paper's notation). They are computed with the elimination
        method of Grassmann, Taksar and Heyman (1985), which uses no subtractions. Each entry is
        therefore accurate to a few units in the last place even if the dominance factors differ
        by many orders of magnitude.

        Returns:
            The weights, shape (N,).

        Raises:
            ValueError: The matrix is reducible: the weight of some site is zero, or beta is not
                unique.
        """
        if not self.is_irreducible:
            raise ValueError("alpha is reducible: beta has a zero entry or is not unique")
        a = self.alpha.copy()
        size = len(a)
        # Eliminate the last site: its followers follow its peers instead.
        for last in range(size - 1, 0, -1):
            row = a[last, :last]
            a[:last, last] /= row.sum()
            column = a[:last, last]
            a[:last, :last] += np.outer(column, row)
        # Substitute back, starting with the weight 1 for the first site.
        beta = np.zeros(size)
        beta[0] = 1.0
        for site in range(1, size):
            beta[site] = beta[:site] @ a[:site, site]
        normalised: Array = beta / beta.sum()
        return normalised

    def find_pi(self) -> Array:
        """Returns the left eigenvector pi for the eigenvalue 1, even if alpha is reducible.

        The vector satisfies pi >= 0 and pi' alpha = pi', and its entries sum to 1. pi is 0 for
        sites outside closed groups, see `closed_groups`. With several closed groups, pi is
        not unique; the sum of its entries in each group is then chosen proportional to the
        number of sites in the group.

        Returns:
            The vector, shape (N,).
        """
        pi = np.zeros(len(self.alpha))
        groups = self.closed_groups
        total = sum(map(len, groups))
        for group in groups:
            group_pi = DominanceMatrix(self.alpha[np.ix_(group, group)]).find_beta()
            pi[list(group)] = group_pi * len(group) / total
        return pi


RAMP_COLUMNS = 2
"""Number of columns before the factors in a row of `ramps`.

Each row is a ramp: its start and
end, ns, followed by the dominance factor of each peer at its end.
"""


@leaf
def _interpolate(
    t_ns: float, start_ns: float, end_ns: float, before: float, after: float
) -> float:
    """Returns a dominance factor at time t during its linear change from `before` to `after`.

    The factor stays at `after` once the change has ended.

    Args:
        t_ns: Time t, ns since the start of the session.
        start_ns: Start of the change.
        end_ns: End of the change.
        before: Factor at the start.
        after: Factor at the end.
    """
    if t_ns >= end_ns:
        return after
    progress = (t_ns - start_ns) / (end_ns - start_ns)
    return before + (after - before) * progress


@leaf
def apply_ramps(t_ns: int, count: int, ramps: Array, links: RowArray) -> None:
    """Computes the dominance factors of an arm's links, and their derivatives, at time t.

    The factors change along ramps, which are linear in time. A ramp starts at the factors that
    the previous ramp has reached by then, even if that ramp is not complete.

    Args:
        t_ns: The time, ns since the epoch (the common start of the session).
        count: Number of rows of `ramps` in use.
        ramps: Ramps ordered by start time, shape (R, RAMP_COLUMNS + P). Row 0 holds the factors
            at the epoch.
        links: State of each link, one row per peer, shape (P,); updated in place.
    """
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        column = RAMP_COLUMNS + j
        # Find the current ramp, and the factor `before` at its start.
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
        link.alpha_rate = 0.0
        if t_ns < end_ns:
            duration_s = (end_ns - start_ns) * 1e-9
            link.alpha_rate = (after - before) / duration_s


def fold_ramps(t_ns: int, count: int, ramps: Array) -> int:
    """Removes old ramps of the dominance factors from a table, to make room for new ones.

    The last ramp that has started is kept, because it may still be in progress, and its initial
    values are stored in row 0. For `t_ns` and all later times, `apply_ramps` therefore computes
    exactly the same factors as before.

    If m is the row of the last ramp that has started, the table changes as follows:

        row 0                   factors at the start of the session
                                -> factors at the start of ramp m
        rows 1 to m - 1         older ramps, removed
        rows m to count - 1     -> rows 1 to count - m

    Args:
        t_ns: Current time, ns since the start of the session.
        count: Number of rows of `ramps` in use.
        ramps: Ramps ordered by start time, shape (R, RAMP_COLUMNS + P) for P peers; updated in
            place. A row contains the start and the end of a ramp, ns, and the P factors at its
            end.

    Returns:
        The number of rows still in use.
    """
    last_started = int(np.searchsorted(ramps[1:count, 0], t_ns, side="right"))
    if last_started < 2:
        return count  # no ramp is older than the last ramp that has started

    # Compute the factors at the start of the current ramp, going from ramp to ramp.
    factors = ramps[0, RAMP_COLUMNS:].copy()
    current = 0
    for following in range(1, last_started + 1):
        start_ns, end_ns = ramps[current, :RAMP_COLUMNS]
        for j, factor_at_end in enumerate(ramps[current, RAMP_COLUMNS:]):
            factors[j] = _interpolate(
                t_ns=ramps[following, 0],
                start_ns=start_ns,
                end_ns=end_ns,
                before=factors[j],
                after=factor_at_end,
            )
        current = following

    ramps[0, RAMP_COLUMNS:] = factors
    rows_left = 1 + count - last_started
    ramps[1:rows_left] = ramps[last_started:count].copy()
    return rows_left


_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_HOLD = int(Mode.HOLD)
_BRAKE = int(Mode.BRAKE)
_RETURN = int(Mode.RETURN)
_USE = int(StaleAction.USE)
_ACT_BRAKE = int(StaleAction.BRAKE)


@leaf
def _any_peer_stale(t_ns: int, age_ns: int, links: RowArray) -> bool:
    """Returns True if this arm has no recent sample from an arm that it follows.

    This means that the sample in use was sent too long ago. If no sample has arrived yet, its
    age is counted from the common start of the session.

    Args:
        t_ns: Time, ns since the epoch.
        age_ns: Largest age, ns.
        links: State of each link from another site, one row per link.
    """
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        stamp_ns = tick_ns(max(link.used, 0), link.rate_hz)
        if link.alpha > 0.0 and t_ns - stamp_ns > age_ns:
            return True
    return False


@leaf
def update_stale_mode(t_ns: int, site: SiteRow, links: RowArray) -> None:
    """Holds the reference of an arm while a peer that it follows is silent.

    A peer is silent if its last sample is too old. In the mode HOLD, the reference keeps its
    last value. In BRAKE, the reference is the pose that the arm had when the peer fell silent.
    In RETURN, once samples arrive again, the reference moves smoothly back to the position
    q_des computed from the peers:

        reference = q_held + s (q_des - q_held),    s = 3 x^2 - 2 x^3

    Here q_held is the reference before the return, and x is the elapsed fraction of the time
    `return_ns`, from 0 to 1.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site, including q_des; updated in place.
        links: State of each link from another site, one row per link.
    """
    if site.on_stale == _USE or site.mode == _DIVERGED:
        return
    is_stale = _any_peer_stale(t_ns, site.stale_ns, links)
    follows = site.mode == _RUN or site.mode == _RETURN
    is_stopped = site.mode == _HOLD or site.mode == _BRAKE
    if is_stale and follows:
        brakes = site.on_stale == _ACT_BRAKE
        for i in range(site.q_held.shape[0]):
            pose = site.x[i] if site.task else site.q[i]
            site.q_held[i] = pose if brakes else site.q_followed[i]
        site.mode = _BRAKE if brakes else _HOLD
        site.return_from_ns = 0
    elif not is_stale and is_stopped:
        site.mode = _RETURN
        site.return_from_ns = t_ns

    elapsed_ns = t_ns - site.return_from_ns
    if site.mode == _RETURN and elapsed_ns >= site.return_ns:
        site.mode = _RUN
    if site.mode == _RUN:
        return  # the reference of the peers is used

    # With x = 0, in HOLD and BRAKE, the reference stays at q_held.
    x = elapsed_ns / site.return_ns if site.mode == _RETURN else 0.0
    s = x * x * (3.0 - 2.0 * x)
    s_rate = 6.0 * x * (1.0 - x) / (site.return_ns * 1e-9)
    for i in range(site.q_held.shape[0]):
        held = site.q_held[i]
        distance = site.q_des[i] - held
        site.q_des[i] = held + s * distance
        site.qd_des[i] = s * site.qd_des[i] + s_rate * distance


@leaf
def update_reference(t_ns: int, site: SiteRow, links: RowArray, ramps: Array) -> None:
    """Computes the reference of an arm, a weighted mean of the positions of its peers.

        q_des  = sum_j alpha_ij q_j                                  Eq. (6)
        qd_des = sum_j (alpha_ij qd_j + alpha_ij' q_j)
        felt   = -sum_j alpha_ij tau_x_j

    Here q_j, qd_j and tau_x_j are the position, velocity and external torque in the sample from
    peer j, alpha_ij is the dominance factor of this peer and alpha_ij' its derivative. `felt`
    is the weighted sum of the torques that operators and environments exert on the peers' arms.
    Terms are added in scenario order, since another order could change the last bits of the
    sums.

    Args:
        t_ns: Time, ns since the epoch (the common start of the session).
        site: State of the site; updated in place.
        links: State of each link from another site, one row per link.
        ramps: Changes of the dominance factors, see `apply_ramps`.
    """
    # Row 0 of the ramps contains the initial factors, which apply if there is no other row.
    if site.ramps > 1 or site.degrades:
        apply_ramps(t_ns, site.ramps, ramps, links)
    if site.degrades:
        regroup(t_ns, site, links)
    for i in range(site.q_des.shape[0]):
        site.q_followed[i] = site.q_des[i]
        site.qd_followed[i] = site.qd_des[i]
        q_des = 0.0
        qd_des = 0.0
        felt = 0.0
        for j in range(links.shape[0]):
            link: LinkRow = links[j]
            alpha = link.alpha
            q = link.q[i]
            q_des += alpha * q
            qd_des += alpha * link.qd[i] + link.alpha_rate * q
            felt -= alpha * link.tau_x[i]
        site.q_des[i] = q_des
        site.qd_des[i] = qd_des
        site.felt[i] = felt

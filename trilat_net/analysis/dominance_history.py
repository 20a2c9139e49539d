"""Computes the dominance factors over time, and the energy weights of the arms.

A slave may follow two masters, for example with weights 0.7 and 0.3, and these weights may
change during the run, suddenly or along a ramp. The weight with which arm i follows arm j is
called the dominance factor alpha_ij. `DominanceHistory` contains the factors at all times.

The stability proof uses a weighted sum of the energies of all arms. The weight of arm i is

    beta_i = pi_i / c_i

where pi is the left eigenvector of the matrix alpha for the eigenvalue 1 (the Perron vector),
and c_i is the ratio of the damping gain of arm i to that of the first arm. Without these
weights the proof does not hold (docs/theory/errata-proof.md).

Invariant:
    - The factors depend only on time and on the changes that were carried out.
    - A ramp starts from the value that the preceding ramp has reached at that time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import Array, DominanceMatrix, DominanceRamp
from ..log import Log
from ..scenario import Scenario

RAMP_TIME_TOLERANCE_S = 5e-10
"""Tolerance for the starts and ends of ramps, in s: half of the nanosecond to which they are
rounded.
"""


class DominanceHistory(NamedTuple):
    """The dominance factors with which an arm follows each of its P peers, over time.

    A factor lies between 0 and 1. The peers are in scenario order.

    Attributes:
        alpha: Factors at every row, shape (K, P).
        rate: Their time derivatives as used by the controller, shape (K, P), in 1/s.
        before: Factors at the end of every tick period, just before any sudden change at that
            time, shape (K - 1, P).
    """

    alpha: Array
    rate: Array
    before: Array

    @property
    def constant(self) -> bool:
        """True if no dominance factor changes during the run."""
        has_steps = bool(np.any(self.alpha != self.alpha[0]))
        has_ramps = bool(self.rate.any())
        return not has_steps and not has_ramps

    @classmethod
    def of_scenario(cls, scenario: Scenario, site: str, t_s: Array) -> "DominanceHistory":
        """Returns the dominance factors that the scenario plans for a site.

        Args:
            scenario: The scenario.
            site: Name of the site.
            t_s: Ascending times, one tick period apart, shape (K,), in s.
        """
        return DominancePlan.of_scenario(scenario, site).evaluate(t_s)

    @classmethod
    def of_log(cls, log: Log, site: str, t_s: Array) -> "DominanceHistory":
        """Returns the dominance factors of a site at consecutive ticks of a run.

        The factors change according to the timeline of the scenario and the commands during the
        run. If the site lost a peer and continued without it, the remaining factors are scaled
        to add up to 1.

        Args:
            log: The log of the run.
            site: Name of the site.
            t_s: Times of the ticks, shape (K,), in s.

        Raises:
            LogError: A recorded change is invalid.
        """
        history = DominancePlan.of_log(log, site).evaluate(t_s)
        is_present = ~_find_lost_peers(log, site, t_s)
        if is_present.all():
            return history

        # the factors of the remaining peers are divided by their sum
        alpha = history.alpha * is_present
        rate = history.rate * is_present
        before = history.before * is_present[:-1]
        total = alpha.sum(axis=1, keepdims=True)
        total_rate = rate.sum(axis=1, keepdims=True)
        total_before = before.sum(axis=1, keepdims=True)
        # derivative of alpha / total by the quotient rule
        numerator = rate * total - alpha * total_rate
        return cls(
            alpha=alpha / total,
            rate=numerator / total**2,
            before=before / total_before,
        )

    @classmethod
    def list_ramp_spans_s(cls, log: Log, site: str) -> list[tuple[float, float]]:
        """Lists the start and end of each ramp of a site's dominance factors, in s.

        The slopes of the factors change only at these times, as long as no peer is lost. Start
        and end are equal for a sudden change.

        Args:
            log: The log of the run.
            site: Name of the site.

        Raises:
            LogError: A recorded change is invalid.
        """
        ramps = DominancePlan.of_log(log, site).ramps
        return [(ramp.start_ns * 1e-9, ramp.end_ns * 1e-9) for ramp in ramps]


class DominancePlan(NamedTuple):
    """Changes of the dominance factors with which a site follows its P peers.

    Every change is a ramp from the old to the new factors, and a sudden change is a ramp of
    zero length. A ramp that begins while another one is in progress starts from the values
    reached at that time.

    Attributes:
        start: Factors at the start of the session, shape (P,).
        ramps: Changes of the factors.
        h_s: Tick period of the site, in s.
    """

    start: Array
    ramps: list[DominanceRamp]
    h_s: float

    @classmethod
    def of_scenario(cls, scenario: Scenario, site: str) -> "DominancePlan":
        """Returns the changes of dominance factors that the scenario plans for a site.

        Args:
            scenario: The scenario.
            site: Name of the site.
        """
        factors = scenario.dominance[site]
        start = np.array([factors.get(peer, 0.0) for peer in scenario.peers(site)])
        h_s = 1.0 / scenario.sites[site].rate_hz
        return cls(start, list(scenario.scripted_ramps(site)), h_s)

    @classmethod
    def of_log(cls, log: Log, site: str) -> "DominancePlan":
        """Returns the planned changes of a run together with those requested by commands.

        Args:
            log: The log of the run.
            site: Name of the site.

        Raises:
            LogError: A recorded change is invalid.
        """
        plan = cls.of_scenario(log.scenario, site)
        for changes in log.commands(site).values():
            plan.ramps.extend(change.ramp for change in changes if change.ramp is not None)
        return plan

    def drop_finished(self, from_s: float) -> "DominancePlan":
        """Removes changes that were complete before a given time.

        The initial factors are adjusted to leave the factors from this time on unchanged.

        Args:
            from_s: Time from which the factors must remain the same, in s.
        """
        sorted_ramps = sorted(self.ramps, key=lambda ramp: ramp.start_ns)
        started = sum(ramp.start_ns * 1e-9 <= from_s for ramp in sorted_ramps)
        if started < 2:
            return self._replace(ramps=sorted_ramps)

        # the last ramp that has started may still be in progress
        finished = self._replace(ramps=sorted_ramps[: started - 1])
        remaining = sorted_ramps[started - 1 :]
        last_start = np.array([remaining[0].start_ns * 1e-9])
        history = finished.evaluate(last_start)
        return self._replace(start=history.alpha[0], ramps=remaining)

    def evaluate(self, t_s: Array) -> DominanceHistory:
        """Computes the dominance factors over time in the same way as the simulation.

        Args:
            t_s: Ascending times, one tick period apart, shape (K,), in s.
        """
        alpha = np.tile(self.start, (len(t_s), 1))
        rate = np.zeros((len(t_s), len(self.start)))
        # the ramp in progress: its factors at start and end, and its times
        from_factors = self.start
        to_factors = self.start
        start_s = 0.0
        end_s = 0.0
        sorted_ramps = sorted(self.ramps, key=lambda ramp: ramp.start_ns)
        for ramp in sorted_ramps:
            next_start_s = ramp.start_ns * 1e-9
            finished_share = 1.0
            if next_start_s < end_s:
                elapsed_s = next_start_s - start_s
                finished_share = elapsed_s / (end_s - start_s)
            interpolated = from_factors + (to_factors - from_factors) * finished_share
            # exact factors at the end of a finished ramp, which interpolation would round
            from_factors = to_factors if finished_share == 1.0 else interpolated
            to_factors = np.array(ramp.alpha)
            start_s = next_start_s
            end_s = ramp.end_ns * 1e-9

            has_started = t_s >= start_s - RAMP_TIME_TOLERANCE_S
            has_not_ended = t_s < end_s - RAMP_TIME_TOLERANCE_S
            is_in_ramp = has_started & has_not_ended
            alpha[has_started] = to_factors
            rate[has_started] = 0.0
            if is_in_ramp.any():
                length_s = (ramp.end_ns - ramp.start_ns) * 1e-9
                slope = (to_factors - from_factors) / length_s
                since_start_s = t_s[is_in_ramp, np.newaxis] - start_s
                alpha[is_in_ramp] = from_factors + slope * since_start_s
                rate[is_in_ramp] = slope

        alpha_left = alpha[:-1]
        rate_left = rate[:-1]
        at_period_ends = alpha_left + self.h_s * rate_left
        return DominanceHistory(alpha, rate, at_period_ends)


def _find_lost_peers(log: Log, site: str, t_s: Array) -> NDArray[np.bool_]:
    """Finds the times at which an arm continued without another arm whose messages had stopped.

    An arm counts as lost if no message from it arrived for some time, see `core.lost_peers`.

    Args:
        log: The log of the run.
        site: Name of the site.
        t_s: Times, shape (K,), in s.

    Returns:
        True while the peer is lost, shape (K, P), with a column for each of the P peers.
    """
    site_log = log[site]
    peer_count = len(site_log.peers)
    times = len(t_s)
    lost = np.zeros((times, peer_count), dtype=bool)
    if not log.scenario.sites[site].on_stale.rule.degrades or not len(site_log):
        return lost

    first = site_log.layout.count_life_memory(peer_count)
    is_lost = site_log.memory(first, peer_count) != 0.0
    # the newest record at each time
    latest_s = t_s + RAMP_TIME_TOLERANCE_S
    rows_after = np.searchsorted(site_log.t_s, latest_s, side="right")
    rows = rows_after - 1
    recorded = rows >= 0
    lost[recorded] = is_lost[rows[recorded]]
    return lost


class PeerLoss(NamedTuple):
    """Time interval in which a site continued without a peer whose samples had stopped.

    The site then follows only the remaining peers, which changes its dominance factors.

    Attributes:
        site: Name of the site.
        peer: Name of the peer.
        from_s: Start, in s.
        to_s: End, in s.
    """

    site: str
    peer: str
    from_s: float
    to_s: float

    @classmethod
    def list_of_log(cls, log: Log) -> "list[PeerLoss]":
        """Lists the time intervals in which sites continued without a lost peer.

        In these intervals the dominance factors differ from the planned ones, because a site
        distributes the share of the lost peer among the others.

        Args:
            log: The log of the run.

        Returns:
            The intervals, ordered by site and peer. Empty if no peer was lost.
        """
        losses = []
        for site in log.sites:
            site_log = log[site]
            is_lost = _find_lost_peers(log, site, site_log.t_s)
            lost = is_lost.astype(int)
            times_s = site_log.t_s
            if len(site_log):
                end_s = site_log.t_s[-1] + 1.0 / site_log.rate_hz
                times_s = np.append(site_log.t_s, end_s)

            for j, peer in enumerate(site_log.peers):
                # +1 where a loss begins, and -1 where it ends
                changes = np.diff(lost[:, j], prepend=0, append=0)
                start_rows = np.flatnonzero(changes > 0)
                end_rows = np.flatnonzero(changes < 0)
                starts_s = times_s[start_rows].tolist()
                ends_s = times_s[end_rows].tolist()
                for from_s, to_s in zip(starts_s, ends_s, strict=True):
                    losses.append(PeerLoss(site, peer, from_s, to_s))
        return losses


KD_SHAPE_TOLERANCE = 1e-9
"""Largest relative difference of two gains that count as equal."""


class _LyapunovWeights(NamedTuple):
    """Weights beta of the N arms in the energy function V of the stability proof.

    With these weights the energies that arms transfer to each other cancel in V. The weights
    follow from the matrix alpha of the dominance factors and from the damping gains Kd.

    Attributes:
        beta: Weight of each site, shape (N,), with the sum N. With equal dominance factors each
            weight is 1, as in the paper.
        groups: Groups of sites that follow no site outside their group, as tuples of indices.
            With a single group the left eigenvector pi of alpha is unique, though some of its
            entries may be 0. With several groups beta is not unique.
        scales: Factors c_i such that Kd_i = c_i Kbar with a common Kbar, and c_i = 1 for the
            first site, shape (N,). `None` if no such factors exist.
    """

    beta: Array
    groups: tuple[tuple[int, ...], ...]
    scales: Array | None


def find_kd_scales(Kd: Array) -> Array | None:
    """Finds the ratio of each arm's damping gain Kd to the gain of the first arm.

    The stability proof allows arms with different gains if the ratio is the same for all joints
    of an arm. The weights of the arms in the energy function V of the proof then compensate for
    the different gains.

    Args:
        Kd: Damping gains of the N arms along n axes, shape (N, n). NaN along an axis that an
            arm does not follow.

    Returns:
        The ratios, shape (N,), or `None` if the gains of the arms are not multiples of each
        other. All ratios are 1 if all gains are zero.
    """
    if not np.nan_to_num(Kd).any():
        return np.ones(len(Kd))
    is_common_axis = np.isfinite(Kd).all(axis=0)
    sizes = Kd[:, is_common_axis].sum(axis=1)
    if not sizes.all():
        return None

    shapes = Kd / sizes[:, np.newaxis]
    # fmax and fmin ignore NaN
    largest = np.fmax.reduce(shapes)
    least = np.fmin.reduce(shapes)
    differences = np.nan_to_num(largest - least)
    if differences.max() > KD_SHAPE_TOLERANCE:
        return None
    scales: Array = sizes / sizes[0]
    return scales


def compute_lyapunov_weights(alpha: Array, Kd: Array) -> _LyapunovWeights:
    """Computes the weight of each site in the energy function of the stability proof.

    The weight of site i is beta_i = pi_i / c_i, where pi is the left eigenvector of `alpha` for
    the eigenvalue 1, and c_i is the ratio of the damping gain of site i to that of the first
    site. The weights are scaled to sum to N. If the gains are not multiples of each other, c_i
    = 1 is used, and the energy may rise.

    Args:
        alpha: Dominance factors: entry (i, j) is the weight with which site i follows site j,
            shape (N, N).
        Kd: Damping gains of the N sites along n axes, shape (N, n).
    """
    dominance = DominanceMatrix(alpha)
    pi = dominance.find_pi()
    scales = find_kd_scales(Kd)
    beta = pi if scales is None else pi / scales
    sites = len(beta)
    factor = sites / beta.sum()
    return _LyapunovWeights(
        beta=beta * factor,
        groups=dominance.closed_groups,
        scales=scales,
    )

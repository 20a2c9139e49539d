"""Computes the energy balance of each site, and of all sites together under the weights beta.

For every site, without any weights:

    V_i - V_i(0) + dissipation + transfer - work = 0

For the weighted sum over all sites, whatever the operators do:

    V - V(0) + dissipation - work = 0

Invariant:
    - Records for which these sums do not vanish were not produced by the equations that the log
      claims.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ...core.site_setup import Scheme
from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario import Scenario
from ..aligned import (
    AlignedRecords,
    Bools,
    DelayedPeer,
    PeerTrajectory,
    align_records,
    view_delayed_peer,
)
from ..dominance_history import DominanceHistory, compute_lyapunov_weights, trace_dominance
from ..torque_sources import split_torque
from . import energy_terms
from .energy_terms import FunctionalParts, Increment, SiteMotion

MIN_PERIODS = 10
"""With fewer judged periods nothing is known of what happens within a period."""
ZERO_ENERGY_J = 1e-12
"""Rounding error of an energy that is zero, J."""
EXTERNAL_SOURCES = ("hands", "walls", "stops")
"""Sources of work outside the loop: operators, environments, and the stops of joints."""


@dataclass(frozen=True)
class SiteEnergy:
    """Energies of a site over its K rows and K - 1 periods.

    Attributes:
        motion: motion of the site, from which its energies are computed.
        parts: the site's functional V_i by its parts.
        dissipation: dissipated energy per period, by kind.
        transfer: energy per period that the site gives to its followers, less the energy that
            it gets from the sites that it follows.
        work: work per period on the site, by source.
        sampling: work per period of the scheme that samples the continuous law.
    """

    motion: SiteMotion
    parts: FunctionalParts
    dissipation: dict[str, Increment]
    transfer: Increment
    work: dict[str, Increment]
    sampling: Increment

    @cached_property
    def judged(self) -> Bools:
        """True if a period follows from records alone, shape (K - 1,)."""
        known = [
            self.motion.records.known_periods,
            *(view.known for view in self.followed.values()),
        ]
        return np.asarray(np.logical_and.reduce(known))

    @cached_property
    def residual(self) -> Array:
        """V_i - V_i(0) + dissipation + transfer - work over judged periods, shape (K,), J."""
        change = np.diff(self.parts.total) + self.transfer.total
        change += np.sum([kind.total for kind in self.dissipation.values()], axis=0)
        change -= np.sum([source.total for source in self.work.values()], axis=0)
        return _accumulate(change, self.judged)

    @cached_property
    def unexplained(self) -> Array:
        """The residual without the work of the scheme, shape (K,), J."""
        return self.residual - _accumulate(self.sampling.total, self.judged)

    @property
    def followed(self) -> dict[str, DelayedPeer]:
        """The peers that have a share at any time, as the site sees them."""
        alpha = self.motion.dominance.alpha
        views = enumerate(self.motion.peers.items())
        return {peer: view for j, (peer, view) in views if alpha[:, j].any()}

    @property
    def largest_age_s(self) -> float:
        """The largest age of a sample in use, in s; 0 if no sample came into use."""
        t_s = self.motion.records.t_s
        ages_s = [t_s - view.stamp_s for view in self.followed.values()]
        largest_s = [float(np.nanmax(age_s)) for age_s in ages_s if np.isfinite(age_s).any()]
        return max(largest_s, default=0.0)

    @property
    def begin_s(self) -> float:
        """The first tick at which V_i follows from records, in s; infinite if there is none."""
        known = [view.delayed.known & view.now.known for view in self.followed.values()]
        rows = np.flatnonzero(np.logical_and.reduce(known))
        return float(self.motion.records.t_s[rows[0]]) if len(rows) else np.inf

    @cached_property
    def uncertainty(self) -> float:
        """Bound of the energies' error by motion within the periods, in J.

        The error of the trapezoid rule is estimated by the second differences of the total
        power, summed; that of sampling and operators by the products of the changes of r and of
        a torque. If these products add up, the period is long for these gains. With too few
        periods for second differences, the whole energy is uncertain.
        """
        dissipated = [self.transfer, *self.dissipation.values()]
        signed = [(1.0, increment) for increment in dissipated]
        signed += [(-1.0, increment) for increment in self.work.values()]
        if self.judged.sum() < MIN_PERIODS:
            sizes = (
                np.abs(increment.left).sum() + np.abs(increment.right).sum()
                for _, increment in signed
            )
            return float(sum(sizes))
        power = np.sum([sign * increment.left for sign, increment in signed], axis=0)
        records = self.motion.records
        change_of_r = self.motion.ends.r_right - self.motion.ends.r_left
        coupled = 0.0
        for torque in (records.tau, records.tau_x):
            product = records.h_s * (change_of_r * np.diff(torque, axis=0)).sum(axis=1)
            coupled += 2.0 * float(np.abs(_accumulate(product, self.judged)).max())
        return float(np.abs(np.diff(power[self.judged], 2)).sum()) / 6.0 + coupled


def _accumulate(amounts: Array, judged: Bools | None = None) -> Array:
    """Returns the running sum of amounts per period, over the judged periods, shape (K,)."""
    counted = amounts if judged is None else np.where(judged, amounts, 0.0)
    return np.concatenate([[0.0], np.cumsum(counted)])


def compute_site_energies(log: Log) -> dict[str, SiteEnergy]:
    """Returns the energies of the sites of a log, all of which must have a functional.

    Returns:
        The energies by site; {} if V is known at no two ticks.

    Raises:
        LogError: a record names a change that is not valid.
    """
    records = align_records(log, common=True)
    pasts = {site: PeerTrajectory(site_records) for site, site_records in records.items()}
    energies = derive_site_energies(log.scenario, records, pasts, partial(trace_dominance, log))
    return energies if energies and len(find_common_times(energies)) > 1 else {}


def derive_site_energies(
    scenario: Scenario,
    records: Mapping[str, AlignedRecords],
    pasts: Mapping[str, PeerTrajectory],
    dominance: Callable[[str, Array], DominanceHistory],
) -> dict[str, SiteEnergy]:
    """Returns the energies of sites over some records; every site must have a functional.

    Args:
        scenario: scenario of the run.
        records: records of every site.
        pasts: motion of every site, back to the oldest sample that was in use.
        dominance: returns the dominance factors of a site at times in s.
    """
    energies = {}
    constants = {site: energy_terms.derive_site_constants(scenario, site) for site in records}
    axes = [c.axes for c in constants.values() if c.axes]
    common_axes = tuple(np.prod(axes, axis=0).tolist()) if axes else ()
    for site, site_records in records.items():
        motion = SiteMotion(
            records=site_records,
            constants=constants[site],
            dominance=dominance(site, site_records.t_s),
            peers={
                peer: view_delayed_peer(site_records, pasts[peer]) for peer in site_records.used
            },
            torque=split_torque(site_records, scenario),
            scheme=Scheme[scenario.scheme.upper()],
            common=common_axes,
        )
        energies[site] = SiteEnergy(
            motion=motion,
            parts=energy_terms.evaluate_functional(motion),
            dissipation=energy_terms.compute_dissipation(motion),
            transfer=energy_terms.compute_transfer(motion, np.array(common_axes or 1.0)),
            work=energy_terms.compute_work(motion),
            sampling=energy_terms.compute_sampling_work(motion),
        )
    return energies


def find_common_times(energies: Mapping[str, SiteEnergy]) -> Array:
    """Returns the ticks of the fastest site at which every V_i is known, shape (T,), s."""
    records = [energy.motion.records for energy in energies.values()]
    times = max(records, key=lambda site_records: site_records.rate_hz).t_s
    begin_s = max(energy.begin_s for energy in energies.values())
    end_s = min(site_records.t_s[-1] for site_records in records)
    common: Array = times[(times >= begin_s - 1e-9) & (times <= end_s + 1e-9)]
    return common


@dataclass(frozen=True)
class EnergyBalance:
    """The functional V of a group of sites over time, and all energies that change it.

    Energies are given at the T ticks of the fastest site, in J, shape (T,) unless stated
    otherwise. Dissipation, work and transfer are sums over the judged periods from the first
    tick on.

    Attributes:
        t_s: the ticks, in s.
        beta: the weights of the N sites over time, shape (T, N).
        sites: beta_i V_i by site.
        parts: the parts of V by name, summed over the sites.
        dissipation: dissipated energy by kind.
        work: work by source.
        sampling: work of the sampling scheme; not part of the balance, see `unexplained`.
        transfer: transferred energy that the weights do not cancel; 0 if the weights are right.
        judged: True if the period before a tick follows from records alone, shape (T - 1,).
    """

    t_s: Array
    beta: Array
    sites: dict[str, Array]
    parts: dict[str, Array]
    dissipation: dict[str, Array]
    work: dict[str, Array]
    sampling: Array
    transfer: Array
    judged: Bools

    @cached_property
    def V(self) -> Array:  # noqa: N802 - the paper's symbol
        """The functional, shape (T,), J."""
        return _sum(self.parts)

    @cached_property
    def residual(self) -> Array:
        """V - V(0) + dissipation - work over the judged periods, shape (T,), J."""
        return self._accumulate_judged(self.V + _sum(self.dissipation) - _sum(self.work))

    @cached_property
    def unexplained(self) -> Array:
        """The residual less the work of sampling and the transfer, shape (T,), J."""
        return self.residual - self._accumulate_judged(self.sampling - self.transfer)

    @cached_property
    def unsupplied(self) -> Array:
        """V less the external work, over the judged periods, shape (T,), J.

        By the theorem this quantity does not rise.
        """
        unsupplied: Array = self.V[0] + self._accumulate_judged(self.V - self.external_work)
        return unsupplied

    @property
    def external_work(self) -> Array:
        """Work of operators, environments and stops since the first tick, shape (T,), J."""
        return _sum({name: self.work[name] for name in EXTERNAL_SOURCES if name in self.work})

    @property
    def external(self) -> dict[str, Array]:
        """External work by source (hands, walls, stops), of sources that did any work."""
        names = [name for name in EXTERNAL_SOURCES if name in self.work]
        return {name: self.work[name] for name in names if self.work[name].any()}

    @cached_property
    def scale(self) -> float:
        """Reference for residuals: the largest V, or the largest work if larger, in J."""
        return max(float(np.abs(x).max()) for x in (self.V, *self.work.values()))

    def _accumulate_judged(self, values: Array) -> Array:
        return _accumulate(np.diff(values), self.judged)


def compute_energy_balance(
    energies: Mapping[str, SiteEnergy], *, paper_weights: bool = False
) -> EnergyBalance:
    """Returns the energy balance of a group of sites.

    Args:
        energies: energies of the sites in scenario order; no site follows a site outside the
            group.
        paper_weights: give all sites the same weight, as in the paper; the balance need not
            close then.
    """
    times = find_common_times(energies)
    weights_by_grid = {}
    beta_columns = []
    sites = {}
    unjudged = np.zeros(len(times))
    sums: dict[tuple[str, str], Array] = {}
    for n, (site, energy) in enumerate(energies.items()):
        records = energy.motion.records
        grid = (records.first, len(records.known), records.rate_hz)
        if grid not in weights_by_grid:
            weights_by_grid[grid] = _trace_weights(
                energies, records, paper_weights=paper_weights
            )
        left, right = (beta[:, n] for beta in weights_by_grid[grid])
        for key, amounts in _weigh_site(energy, left, right).items():
            resampled = _resample(times, records.t_s, amounts)
            sums[key] = sums[key] + resampled if key in sums else resampled
        beta_columns.append(_resample(times, records.t_s, left))
        sites[site] = _resample(times, records.t_s, left * energy.parts.total)
        unjudged_periods = _accumulate((~energy.judged).astype(np.float64))
        unjudged += np.abs(_resample(times, records.t_s, unjudged_periods))
    judged: Bools = np.diff(unjudged) == 0.0

    def select(kind: str) -> dict[str, Array]:
        """Returns the running sums of a kind by name, over the judged periods."""
        return {
            name: x - x[0] if judged.all() else _accumulate(np.diff(x), judged)
            for (group, name), x in sums.items()
            if group == kind
        }

    return EnergyBalance(
        t_s=times,
        beta=np.stack(beta_columns, axis=1),
        sites=sites,
        parts={name: sums["parts", name] for name in FunctionalParts._fields},
        dissipation=select("dissipation"),
        work=select("work"),
        sampling=select("sampling")[""],
        transfer=select("transfer")[""],
        judged=judged,
    )


def _weigh_site(energy: SiteEnergy, left: Array, right: Array) -> dict[tuple[str, str], Array]:
    """Returns a site's weighted contributions to the balance, at its own ticks.

    A change of the weight itself does work on V_i, along a ramp and at a step. That work is
    booked under `shares`.

    Args:
        energy: energies of the site over K ticks.
        left: the site's weight at every tick, shape (K,).
        right: its weight at the end of every period, before a step there, shape (K - 1,).

    Returns:
        Contributions by (kind, name), shape (K,) each, in J.
    """

    def weigh(increment: Increment) -> Array:
        return _accumulate(
            left[:-1] * increment.left + right * (increment.right + increment.jump)
        )

    V = energy.parts.total
    ramp_work = (right - left[:-1]) * 0.5 * (V[:-1] + V[1:])
    step_work = (left[1:] - right) * V[1:]
    weighted = {("parts", name): left * part for name, part in energy.parts._asdict().items()}
    for name, increment in energy.dissipation.items():
        weighted["dissipation", name] = weigh(increment)
    for name, increment in energy.work.items():
        weighted["work", name] = weigh(increment)
    weighted["work", "shares"] = weighted["work", "shares"] + _accumulate(ramp_work + step_work)
    weighted["sampling", ""] = weigh(energy.sampling)
    weighted["transfer", ""] = weigh(energy.transfer)
    return weighted


def _resample(times: Array, t_s: Array, values: Array) -> Array:
    """Returns values at `t_s` interpolated at `times`; unchanged if the times are equal."""
    is_same_grid = len(t_s) == len(times) and t_s[0] == times[0]
    return values if is_same_grid else np.interp(times, t_s, values)


def _trace_weights(
    energies: Mapping[str, SiteEnergy], records: AlignedRecords, *, paper_weights: bool
) -> tuple[Array, Array]:
    """Returns the weights beta of all N sites, on the tick grid of one site's records.

    Returns:
        beta at the ticks, shape (K, N).
        beta at the end of every period, before a step there, shape (K - 1, N).
    """
    Kd = np.array([energy.motion.constants.weighing_Kd for energy in energies.values()])
    constant = all(energy.motion.dominance.constant for energy in energies.values())
    beta_by_matrix: dict[bytes, Array] = {}

    def compute_beta(t_s: Array, ahead_s: float) -> Array:
        if paper_weights:
            return np.ones((len(t_s), len(Kd)))
        alpha = _interpolate_dominance(energies, t_s[:1] if constant else t_s, ahead_s)
        # equal matrices must be equal in their bytes, and adding 0.0 turns -0.0 into 0.0
        rows = np.round(alpha, 12).reshape(len(alpha), -1) + 0.0
        matrices, matrix_index = np.unique(rows, axis=0, return_inverse=True)
        for matrix in matrices:
            key = matrix.tobytes()
            if key not in beta_by_matrix:
                weights = compute_lyapunov_weights(matrix.reshape(len(Kd), -1), Kd)
                beta_by_matrix[key] = weights.beta
        betas = np.array([beta_by_matrix[matrix.tobytes()] for matrix in matrices])
        beta = betas[matrix_index.ravel()]
        return np.tile(beta, (len(t_s), 1)) if constant else beta

    return compute_beta(records.t_s, 0.0), compute_beta(records.t_s[:-1], records.h_s)


def _interpolate_dominance(
    energies: Mapping[str, SiteEnergy], t_s: Array, ahead_s: float = 0.0
) -> Array:
    """Returns the dominance matrix of a group of sites over time, shape (T, N, N).

    Args:
        energies: energies of the N sites; peers outside the group are left out.
        t_s: times, shape (T,), s.
        ahead_s: time by which a ramp in progress is extrapolated, in s.
    """
    names = list(energies)
    alpha = np.zeros((len(t_s), len(names), len(names)))
    for i, energy in enumerate(energies.values()):
        records = energy.motion.records
        dominance = energy.motion.dominance
        position = (t_s - records.t_s[0]) * records.rate_hz
        last_row = len(records.known) - 1
        row = np.clip(np.floor(position + 1e-5), 0, last_row).astype(np.int64)
        later_s = np.maximum(position - row, 0.0) / records.rate_hz + ahead_s
        for j, peer in enumerate(energy.motion.peers):
            if peer in energies:
                factor = dominance.alpha[row, j] + later_s * dominance.rate[row, j]
                alpha[:, i, names.index(peer)] = factor
    # a ramp that ends between two ticks is extrapolated beyond its end
    return np.clip(alpha, 0.0, 1.0)


def find_dominance_matrices(energies: Mapping[str, SiteEnergy]) -> Array:
    """Returns every dominance matrix that was in force, shape (M, N, N); of a ramp its ends."""
    times = [next(iter(energies.values())).motion.records.t_s[:1]]
    for energy in energies.values():
        t_s = energy.motion.records.t_s
        dominance = energy.motion.dominance
        rate_changes = np.diff(dominance.rate, axis=0, prepend=0.0).any(axis=1)
        is_step = (dominance.alpha[1:] != dominance.before).any(axis=1)
        times.append(t_s[np.flatnonzero(rate_changes)])
        times.append(t_s[np.flatnonzero(is_step) + 1])
    return _interpolate_dominance(energies, np.concatenate(times))


def rise_above_minimum(values: Array) -> Array:
    """Returns how far a quantity is above its minimum up to each time, shape (T,)."""
    return values - np.minimum.accumulate(values)


def _sum(columns: Mapping[str, Array]) -> Array:
    total: Array = np.sum(list(columns.values()), axis=0)
    return total

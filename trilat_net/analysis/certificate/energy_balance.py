"""Energy balance of each site, and of a group of sites together under the weights beta.

Invariant: V_i - V_i(0) + dissipation + transfer - work vanishes for every site, without any
weights; V - V(0) + dissipation - work vanishes for the weighted sum, whatever the operators do.
A log that violates it was not produced by the equations that it claims.
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
"""Fewer show nothing of what happens within them."""
ZERO_ENERGY_J = 1e-12
"""What rounding may leave of no energy at all."""
EXTERNAL_SOURCES = ("hands", "walls", "stops")
"""The sources of work that are outside of the loop: operator, environment, and stops of joints.
"""


@dataclass(frozen=True)
class SiteEnergy:
    """Energies of a site over its K rows and K - 1 periods.

    Attributes:
        motion, parts: what they are computed from, and its functional.
        dissipation, work: by kind, and by source.
        transfer: to the sites that follow it, less what it gets from those that it follows.
        sampling: the work of the scheme that samples the continuous law.
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
        """V_i - V_i(0) + dissipation + transfer - work, over the judged periods, shape (K,), J."""
        change = np.diff(self.parts.total) + self.transfer.total
        change += np.sum([one.total for one in self.dissipation.values()], axis=0)
        change -= np.sum([one.total for one in self.work.values()], axis=0)
        return _accumulate(change, self.judged)

    @cached_property
    def unexplained(self) -> Array:
        """The residual without the work of the scheme, shape (K,), J."""
        return self.residual - _accumulate(self.sampling.total, self.judged)

    @property
    def followed(self) -> dict[str, DelayedPeer]:
        """The peers that ever have a share, as the site sees them."""
        views = enumerate(self.motion.peers.items())
        return {
            peer: view for j, (peer, view) in views if self.motion.dominance.alpha[:, j].any()
        }

    @property
    def largest_age_s(self) -> float:
        """The largest age of a sample in use, s; 0 if none came into use."""
        ages_s = [self.motion.records.t_s - view.stamp_s for view in self.followed.values()]
        return max(
            (float(np.nanmax(age_s)) for age_s in ages_s if np.isfinite(age_s).any()),
            default=0.0,
        )

    @property
    def begin_s(self) -> float:
        """The first tick at which everything in transit follows from records, s; infinite
        without one.
        """
        seen = [view.delayed.known & view.now.known for view in self.followed.values()]
        rows = np.flatnonzero(np.logical_and.reduce(seen))
        return float(self.motion.records.t_s[rows[0]]) if len(rows) else np.inf

    @cached_property
    def uncertainty(self) -> float:
        """How far the energies may be off by what happens within a period, J.

        The trapezoid rule by the second differences of all powers, summed; sampling and
        operators by the products of the changes of r and of a torque: if these add up, the
        period is long for these gains. With too few periods for second differences all is
        uncertain.
        """
        signed = [(1.0, self.transfer), *((1.0, one) for one in self.dissipation.values())]
        signed += [(-1.0, one) for one in self.work.values()]
        if self.judged.sum() < MIN_PERIODS:
            return float(
                sum(np.abs(one.left).sum() + np.abs(one.right).sum() for _, one in signed)
            )
        power = np.sum([sign * one.left for sign, one in signed], axis=0)
        records = self.motion.records
        ends = self.motion.ends
        coupled = 0.0
        for torque in (records.tau, records.tau_x):
            together = records.h_s * (
                (ends.r_right - ends.r_left) * np.diff(torque, axis=0)
            ).sum(axis=1)
            coupled += 2.0 * float(np.abs(_accumulate(together, self.judged)).max())
        return float(np.abs(np.diff(power[self.judged], 2)).sum()) / 6.0 + coupled


def _accumulate(amounts: Array, judged: Bools | None = None) -> Array:
    counted = amounts if judged is None else np.where(judged, amounts, 0.0)
    return np.concatenate([[0.0], np.cumsum(counted)])


def compute_site_energies(log: Log) -> dict[str, SiteEnergy]:
    """Returns the energies of a log's sites, each of which has a functional; {} if at no time
    all are known.

    Raises:
        LogError: a record names a change that is none.
    """
    records = align_records(log, common=True)
    pasts = {site: PeerTrajectory(own) for site, own in records.items()}
    energies = derive_site_energies(log.scenario, records, pasts, partial(trace_dominance, log))
    return energies if energies and len(find_common_times(energies)) > 1 else {}


def derive_site_energies(
    scenario: Scenario,
    records: Mapping[str, AlignedRecords],
    pasts: Mapping[str, PeerTrajectory],
    dominance: Callable[[str, Array], DominanceHistory],
) -> dict[str, SiteEnergy]:
    """Returns the energies of sites over some of their records, each of which has a functional.

    `pasts` reach back to the samples that were in use then; `dominance` gives a site's factors
    at times, s.
    """
    energies = {}
    constants = {site: energy_terms.derive_site_constants(scenario, site) for site in records}
    axes = [c.axes for c in constants.values() if c.axes]
    common = tuple(np.prod(axes, axis=0).tolist()) if axes else ()
    for site, own in records.items():
        motion = SiteMotion(
            records=own,
            constants=constants[site],
            dominance=dominance(site, own.t_s),
            peers={peer: view_delayed_peer(own, pasts[peer]) for peer in own.used},
            torque=split_torque(own, scenario),
            scheme=Scheme[scenario.scheme.upper()],
            common=common,
        )
        energies[site] = SiteEnergy(
            motion=motion,
            parts=energy_terms.evaluate_functional(motion),
            dissipation=energy_terms.compute_dissipation(motion),
            transfer=energy_terms.compute_transfer(motion, np.array(common or 1.0)),
            work=energy_terms.compute_work(motion),
            sampling=energy_terms.compute_sampling_work(motion),
        )
    return energies


def find_common_times(energies: Mapping[str, SiteEnergy]) -> Array:
    """Returns the ticks of the fastest site from when every V_i is known to the end of the
    records, s.
    """
    records = [energy.motion.records for energy in energies.values()]
    times = max(records, key=lambda own: own.rate_hz).t_s
    begin_s = max(energy.begin_s for energy in energies.values())
    end_s = min(own.t_s[-1] for own in records)
    common: Array = times[(times >= begin_s - 1e-9) & (times <= end_s + 1e-9)]
    return common


@dataclass(frozen=True)
class EnergyBalance:
    """The functional of a group of sites over time, at the ticks of its fastest; shape (T,) and
    J by default.

    Dissipation, work and transfer count in judged periods alone, from the beginning to the
    tick.

    Attributes:
        t_s: the ticks, s.
        beta: the weights over time, shape (T, N).
        sites, parts: beta_i V_i per site; of all sites by its parts.
        dissipation, work: by kind, and by source.
        sampling: the work of the scheme; no part of the balance, see `unexplained`.
        transfer: what the weights did not cancel, 0 if they are right.
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
        """V - V(0) + dissipation - work, over the judged periods, shape (T,), J."""
        return self._over_judged(self.V + _sum(self.dissipation) - _sum(self.work))

    @cached_property
    def unexplained(self) -> Array:
        """The residual less the scheme's work and what beta did not cancel, shape (T,), J."""
        return self.residual - self._over_judged(self.sampling - self.transfer)

    @cached_property
    def unsupplied(self) -> Array:
        """V less the work of operator and environment, over the judged periods, shape (T,), J.

        By the theorem it does not rise.
        """
        unsupplied: Array = self.V[0] + self._over_judged(self.V - self.external_work)
        return unsupplied

    @property
    def external_work(self) -> Array:
        """The work of operator and environment until then, shape (T,), J."""
        return _sum({name: self.work[name] for name in EXTERNAL_SOURCES if name in self.work})

    @property
    def external(self) -> dict[str, Array]:
        """That work by its sources, of those that did any: hands, walls and stops, shape (T,),
        J.
        """
        names = [name for name in EXTERNAL_SOURCES if name in self.work]
        return {name: self.work[name] for name in names if self.work[name].any()}

    @cached_property
    def scale(self) -> float:
        """The energy that residuals are compared with: the largest V, or the largest work if
        more, J.
        """
        return max(float(np.abs(x).max()) for x in (self.V, *self.work.values()))

    def _over_judged(self, values: Array) -> Array:
        return _accumulate(np.diff(values), self.judged)


def compute_energy_balance(
    energies: Mapping[str, SiteEnergy], *, paper_weights: bool = False
) -> EnergyBalance:
    """Returns the balance of a group of sites, in scenario order, of which none follows a site
    outside.

    With `paper_weights` every site weighs the same, as in the paper; then it need not close.
    """
    times = find_common_times(energies)
    grids = {}
    columns = []
    sites = {}
    unjudged = np.zeros(len(times))
    sums: dict[tuple[str, str], Array] = {}
    for n, (site, energy) in enumerate(energies.items()):
        records = energy.motion.records
        grid = records.first, len(records.known), records.rate_hz
        if grid not in grids:
            grids[grid] = _trace_weights(energies, records, paper_weights=paper_weights)
        left, right = (beta[:, n] for beta in grids[grid])
        weighted = _weigh_site(energy, left, right)
        for key, values in weighted.items():
            values = _resample(times, records.t_s, values)
            sums[key] = sums[key] + values if key in sums else values
        columns.append(_resample(times, records.t_s, left))
        sites[site] = _resample(times, records.t_s, left * energy.parts.total)
        unjudged += np.abs(
            _resample(times, records.t_s, _accumulate((~energy.judged).astype(np.float64)))
        )
    judged: Bools = np.diff(unjudged) == 0.0

    def of_kind(kind: str) -> dict[str, Array]:
        """The growth of running sums, without that while records are missing."""
        return {
            name: x - x[0] if judged.all() else _accumulate(np.diff(x), judged)
            for (group, name), x in sums.items()
            if group == kind
        }

    return EnergyBalance(
        t_s=times,
        beta=np.stack(columns, axis=1),
        sites=sites,
        parts={name: sums["parts", name] for name in FunctionalParts._fields},
        dissipation=of_kind("dissipation"),
        work=of_kind("work"),
        sampling=of_kind("sampling")[""],
        transfer=of_kind("transfer")[""],
        judged=judged,
    )


def _weigh_site(energy: SiteEnergy, left: Array, right: Array) -> dict[tuple[str, str], Array]:
    """Returns what a site adds to the balance at its own ticks, by kind and name.

    Its weight is `left` at every tick, shape (K,), and `right` at the end of every period,
    before a step. A change of the weight itself does work on V_i, booked as `shares`: along a
    ramp, and at a step.
    """

    def weigh(one: Increment) -> Array:
        return _accumulate(left[:-1] * one.left + right * (one.right + one.jump))

    V = energy.parts.total
    reweighted = (right - left[:-1]) * 0.5 * (V[:-1] + V[1:]) + (left[1:] - right) * V[1:]
    weighted = {("parts", name): left * part for name, part in energy.parts._asdict().items()}
    weighted |= {("dissipation", name): weigh(one) for name, one in energy.dissipation.items()}
    weighted |= {("work", name): weigh(one) for name, one in energy.work.items()}
    weighted["work", "shares"] = weighted["work", "shares"] + _accumulate(reweighted)
    return weighted | {
        ("sampling", ""): weigh(energy.sampling),
        ("transfer", ""): weigh(energy.transfer),
    }


def _resample(times: Array, t_s: Array, values: Array) -> Array:
    same = len(t_s) == len(times) and t_s[0] == times[0]
    return values if same else np.interp(times, t_s, values)


def _trace_weights(
    energies: Mapping[str, SiteEnergy], records: AlignedRecords, *, paper_weights: bool
) -> tuple[Array, Array]:
    """Returns beta at a site's ticks, shape (K, N), and at the ends of its periods, before a
    step there.
    """
    Kd = np.array([energy.motion.constants.weighing_Kd for energy in energies.values()])
    constant = all(energy.motion.dominance.constant for energy in energies.values())
    solved: dict[bytes, Array] = {}  # by dominance matrix

    def solve(t_s: Array, ahead_s: float) -> Array:
        if paper_weights:
            return np.ones((len(t_s), len(Kd)))
        alpha = _interpolate_dominance(energies, t_s[:1] if constant else t_s, ahead_s)
        rows = np.round(alpha, 12).reshape(len(alpha), -1) + 0.0
        matrices, place = np.unique(rows, axis=0, return_inverse=True)
        for matrix in matrices:
            if (key := matrix.tobytes()) not in solved:
                solved[key] = compute_lyapunov_weights(matrix.reshape(len(Kd), -1), Kd).beta
        beta = np.array([solved[matrix.tobytes()] for matrix in matrices])[place.ravel()]
        return np.tile(beta, (len(t_s), 1)) if constant else beta

    return solve(records.t_s, 0.0), solve(records.t_s[:-1], records.h_s)


def _interpolate_dominance(
    energies: Mapping[str, SiteEnergy], t_s: Array, ahead_s: float = 0.0
) -> Array:
    """Returns the dominance matrix of a group at times, s, shape (T, N, N), without the sites
    outside of it.

    A ramp in progress is followed for `ahead_s` more.
    """
    names = list(energies)
    alpha = np.zeros((len(t_s), len(names), len(names)))
    for i, energy in enumerate(energies.values()):
        records = energy.motion.records
        dominance = energy.motion.dominance
        place = (t_s - records.t_s[0]) * records.rate_hz
        row = np.clip(np.floor(place + 1e-5), 0, len(records.known) - 1).astype(np.int64)
        later_s = np.maximum(place - row, 0.0) / records.rate_hz + ahead_s
        for j, peer in enumerate(energy.motion.peers):
            if peer in energies:
                factor = dominance.alpha[row, j] + later_s * dominance.rate[row, j]
                alpha[:, i, names.index(peer)] = factor
    # between its last tick and its end a ramp is followed too far
    return np.clip(alpha, 0.0, 1.0)


def find_dominance_matrices(energies: Mapping[str, SiteEnergy]) -> Array:
    """Returns every dominance matrix that was in force, of a ramp its ends, shape (M, N, N)."""
    times = [next(iter(energies.values())).motion.records.t_s[:1]]
    for energy in energies.values():
        t_s = energy.motion.records.t_s
        dominance = energy.motion.dominance
        turns = np.flatnonzero(np.diff(dominance.rate, axis=0, prepend=0.0).any(axis=1))
        steps = np.flatnonzero((dominance.alpha[1:] != dominance.before).any(axis=1)) + 1
        times += [t_s[turns], t_s[steps]]
    return _interpolate_dominance(energies, np.concatenate(times))


def rise_above_minimum(values: Array) -> Array:
    """Returns how far a quantity is above the least that it was until then, shape (T,)."""
    return values - np.minimum.accumulate(values)


def _sum(columns: Mapping[str, Array]) -> Array:
    total: Array = np.sum(list(columns.values()), axis=0)
    return total

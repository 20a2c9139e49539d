"""Checks that the energy of each arm, and of all arms together, changes only for known reasons.

If the records of a run come from the equations stated in the log, their energies balance,
whatever the operators do. This module checks the balance. V_i is the energy function of arm i
in the stability proof, which `energy_terms` defines. For each arm:

    V_i - V_i(0) + dissipation + transfer - work = 0

The dissipation is the energy that the controller has removed, the transfer is the energy that
the arm has passed to the arms that follow it, and the work is the energy that operators and
environments have supplied. The transfers cancel in the weighted sum over all arms. The total
energy function V therefore satisfies

    V - V(0) + dissipation - work = 0

The weights beta of the arms in this sum follow from the dominance factors.

Invariant:
    - If these sums do not vanish, the records were not produced by the equations that the log
      claims.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from ...core import Array
from ...log import Log
from ...scenario import Scenario
from ..aligned import AlignedRecords, Bools, DelayedPeer, PeerTrajectory
from ..dominance_history import DominanceHistory, compute_lyapunov_weights
from ..row_reductions import any_in_rows, sum_rows
from ..torque_sources import TorqueSplit
from .energy_terms import FunctionalParts, Increment, SiteConstants, SiteMotion
from .verdict_facts import FunctionalRise, UnsuppliedGrowth

MIN_PERIODS = 10
"""Least number of judged periods from which the error of the trapezoid rule is estimated."""
ZERO_ENERGY_J = 1e-12
"""Rounding error of an energy that is zero, in J."""
EXTERNAL_SOURCES = ("hands", "walls", "stops")
"""Sources of work outside the loop: operators, environments, and the stops of joints."""
_NOTABLE_CAUSE_SHARE = 0.05
"""Least share of a rise of V that a source must supply to be named as a cause."""
_EnergyKey = tuple[str, str]
"""Kind and name of an energy, such as ("dissipation", "damping")."""


@dataclass(frozen=True)
class SiteEnergy:
    """Energy V_i of one arm in the stability proof, and every energy flow that changes it.

    V_i is the share of arm i in the energy function V of the proof. Over each of the K - 1 tick
    periods, its change must equal the sum of the energies listed here. Otherwise, the records
    contradict the model.

    Attributes:
        motion: Motion of the site, from which its energies are computed.
        parts: The values of V_i, split into its parts.
        dissipation: Dissipated energy in each period, keyed by kind, such as damping.
        transfer: Energy that the site passes to its followers in each period, minus the energy
            that it receives from the sites that it follows.
        work: Work on the site in each period, keyed by source, such as the operator.
        sampling: Work in each period caused by executing the continuous control law only once
            per tick.
    """

    motion: SiteMotion
    parts: FunctionalParts
    dissipation: dict[str, Increment]
    transfer: Increment
    work: dict[str, Increment]
    sampling: Increment

    @cached_property
    def judged(self) -> Bools:
        """Marks the tick periods in which all energies come from records, shape (K - 1,).

        In all other periods, some motion was interpolated because records are missing. These
        periods are excluded from the energy balance.
        """
        peer_periods = [peer_motion.known for peer_motion in self.followed.values()]
        known_periods = self.motion.records.known_periods
        known = [known_periods, *peer_periods]
        is_judged = np.logical_and.reduce(known)
        return np.asarray(is_judged)

    @cached_property
    def residual(self) -> Array:
        """Change of V_i that dissipation, transfer and work do not explain, shape (K,), in J.

        The residual is V_i - V_i(0) + dissipation + transfer - work, summed over the `judged`
        periods. The last three terms are the attributes of the same names. The residual still
        contains the work caused by executing the control law in ticks (see `unexplained`).
        """
        dissipated_energies = [kind.total for kind in self.dissipation.values()]
        work_of_sources = [source.total for source in self.work.values()]
        change_of_energy = np.diff(self.parts.total)
        change = change_of_energy + self.transfer.total
        change += np.sum(dissipated_energies, axis=0)
        change -= np.sum(work_of_sources, axis=0)
        return _accumulate(change, self.judged)

    @cached_property
    def unexplained(self) -> Array:
        """Change of the arm's energy that has no known cause, shape (K,), in J.

        The value is 0 up to numerical errors if the records obey the model of the arm. A large
        value means that either the records or the model is wrong. It equals `residual` minus
        the work caused by executing the continuous control law only once per tick.
        """
        sampling = _accumulate(self.sampling.total, self.judged)
        return self.residual - sampling

    @property
    def followed(self) -> dict[str, DelayedPeer]:
        """The delayed motion of the peers that this arm follows, keyed by site name.

        A peer is included if its dominance factor differs from zero at any time.
        """
        alpha = self.motion.dominance.alpha
        peers = self.motion.peers
        followed = {}
        for j, peer in enumerate(peers):
            alpha_of_peer = alpha[:, j]
            if alpha_of_peer.any():
                followed[peer] = peers[peer]
        return followed

    @property
    def largest_age_s(self) -> float:
        """Largest age, in s, of any peer state that the site used.

        The age of a state is the delay that the controller sees: the time since the peer sent
        the state. It is 0 if the site never used the state of a peer.
        """
        t_s = self.motion.records.t_s
        largest_s = []
        for peer_motion in self.followed.values():
            age_s = t_s - peer_motion.stamp_s
            if np.isfinite(age_s).any():
                largest_s.append(float(np.nanmax(age_s)))
        return max(largest_s, default=0.0)

    @property
    def begin_s(self) -> float:
        """Time of the first tick at which the energy V_i of the site can be computed, in s.

        V_i depends on the motion of the other sites since they sent the states in use. At the
        first ticks, this motion may not be recorded. The time is infinite if V_i cannot be
        computed at any tick.
        """
        known = []
        for peer_motion in self.followed.values():
            is_known = peer_motion.delayed.known & peer_motion.now.known
            known.append(is_known)
        all_known = np.logical_and.reduce(known)
        known_rows = np.flatnonzero(all_known)
        if not len(known_rows):
            return np.inf
        first_row = known_rows[0]
        return float(self.motion.records.t_s[first_row])

    @cached_property
    def uncertainty(self) -> float:
        """Estimated numerical error of the arm's energies, in J.

        Smaller changes of energy are not significant. The energies are integrated from records
        at the ticks, and motion between the ticks causes errors.

        The error of the trapezoidal rule is estimated from the curvature of the total power.
        The error due to torques that are constant between ticks is estimated from the changes
        of these torques, multiplied by the changes of the filtered error r = qd - v, where qd
        is the joint velocity and v the reference velocity. If fewer than `MIN_PERIODS` periods
        can be evaluated (see `judged`), the entire energy is considered uncertain.
        """
        outflows = [self.transfer, *self.dissipation.values()]
        inflows = list(self.work.values())
        if self.judged.sum() < MIN_PERIODS:
            sizes = []
            for increment in [*outflows, *inflows]:
                left_size = np.abs(increment.left).sum()
                right_size = np.abs(increment.right).sum()
                sizes.append(left_size + right_size)
            return float(sum(sizes))

        # error of the trapezoid rule, from the second differences of the total power
        powers = [increment.left for increment in outflows]
        powers += [-increment.left for increment in inflows]
        power = np.sum(powers, axis=0)
        judged_power = power[self.judged]
        curvature = np.diff(judged_power, 2)
        total_curvature = float(np.abs(curvature).sum())
        rule_error = total_curvature / 6.0
        return rule_error + self._estimate_coupled_error()

    def _estimate_coupled_error(self) -> float:
        """Estimates the error of the energies that the trapezoid rule integrates, in J.

        Within a period, both the filtered error r and the torques change. The mean of the
        powers at the ends of the period does not include the product of both changes. The
        estimate is an upper bound for the error of the balance.
        """
        records = self.motion.records
        ends = self.motion.ends
        change_of_r = ends.r_right - ends.r_left
        error_j = 0.0
        for torque in (records.tau, records.tau_x):
            change_of_torque = np.diff(torque, axis=0)
            products = change_of_r * change_of_torque
            amounts = records.h_s * sum_rows(products)
            energy = _accumulate(amounts, self.judged)
            largest_energy = float(np.abs(energy).max())
            error_j += 2.0 * largest_energy
        return error_j

    @classmethod
    def by_site(cls, log: Log) -> "dict[str, SiteEnergy]":
        """Computes the energy of each arm in the stability proof from a log.

        An energy function must exist for the control law of every arm.

        Args:
            log: The log of the run.

        Returns:
            A mapping from site name to energy. Empty if there are no two ticks at which the
            energies of all sites can be computed.

        Raises:
            LogError: The log records an invalid change of the settings, such as of a dominance
                factor.
        """
        records = AlignedRecords.by_site(log, common=True)
        pasts = {}
        for site, site_records in records.items():
            pasts[site] = PeerTrajectory(site_records)
        dominance = partial(DominanceHistory.of_log, log)
        energies = SiteEnergy.derive_all(log.scenario, records, pasts, dominance)
        if not energies or len(find_common_times(energies)) < 2:
            return {}
        return energies

    @classmethod
    def derive_all(
        cls,
        scenario: Scenario,
        records: Mapping[str, AlignedRecords],
        pasts: Mapping[str, PeerTrajectory],
        dominance: Callable[[str, Array], DominanceHistory],
    ) -> "dict[str, SiteEnergy]":
        """Computes the energy of each arm in the stability proof, and all flows that change it.

        An energy function must exist for the control law of every arm.

        Args:
            scenario: The scenario of the run.
            records: Records of every site, keyed by site name.
            pasts: Trajectory of every site, keyed by site name. It must reach back to when the
                oldest state that a site uses was sent.
            dominance: Function that returns the dominance factors of a site at given times in
                s.

        Returns:
            A mapping from site name to energy.
        """
        energies = {}
        constants = {}
        followed_axes = []
        for site in records:
            site_constants = SiteConstants.derive(scenario, site)
            constants[site] = site_constants
            if site_constants.axes:
                followed_axes.append(site_constants.axes)
        common_axes: tuple[float, ...] = ()
        if followed_axes:
            # 1 along the axes that all sites follow
            products = np.prod(followed_axes, axis=0)
            common_axes = tuple(products.tolist())
        transferred_axes = np.array(common_axes or 1.0)

        for site, site_records in records.items():
            peers = {}
            for peer in site_records.used:
                peers[peer] = site_records.view_delayed_peer(pasts[peer])
            motion = SiteMotion(
                records=site_records,
                constants=constants[site],
                dominance=dominance(site, site_records.t_s),
                peers=peers,
                torque=TorqueSplit.of_records(site_records, scenario),
                scheme=scenario.scheme,
                common=common_axes,
            )
            energies[site] = SiteEnergy(
                motion=motion,
                parts=motion.evaluate_functional(),
                dissipation=motion.compute_dissipation(),
                transfer=motion.compute_transfer(transferred_axes),
                work=motion.compute_work(),
                sampling=motion.compute_sampling_work(),
            )
        return energies


def _accumulate(amounts: Array, judged: Bools | None = None) -> Array:
    """Returns the cumulative sum of amounts, such as energies per period, shape (K,), from 0.

    Args:
        amounts: Amount in each period, shape (K - 1,).
        judged: True for each period that is included. `None` to include all periods.
    """
    if judged is not None:
        amounts = np.where(judged, amounts, 0.0)
    sums = np.cumsum(amounts)
    return np.concatenate([[0.0], sums])


def find_common_times(energies: Mapping[str, SiteEnergy]) -> Array:
    """Returns the times at which the energies V_i of all arms are known, shape (T,), in s.

    These are ticks of the arm with the highest tick rate.

    Args:
        energies: Energies of the sites, keyed by site name.
    """
    records = [energy.motion.records for energy in energies.values()]
    fastest = max(records, key=lambda site_records: site_records.rate_hz)
    times = fastest.t_s
    begin_s = max(energy.begin_s for energy in energies.values())
    end_s = min(site_records.t_s[-1] for site_records in records)
    has_begun = times >= begin_s - 1e-9
    has_not_ended = times <= end_s + 1e-9
    common: Array = times[has_begun & has_not_ended]
    return common


@dataclass(frozen=True)
class EnergyBalance:
    """The energy function V of a group of sites over time, and all energy flows that change it.

    Energies are given at the T ticks of the fastest site, in J, with shape (T,) unless stated
    otherwise. Dissipation, work and transfer are accumulated over the `judged` periods since
    the first tick.

    Attributes:
        t_s: Times of the ticks, in s.
        beta: Weights of the N sites over time, shape (T, N).
        sites: beta_i V_i, keyed by site.
        parts: The named parts of V, each summed over the sites.
        dissipation: Dissipated energy, keyed by kind.
        work: Work, keyed by source.
        sampling: Work caused by executing the law in ticks. It is not part of the balance (see
            `unexplained`).
        transfer: Transferred energy that the weights do not cancel. 0 if the weights are
            correct.
        judged: True for each tick period whose energies all come from records, shape (T - 1,).
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
    def unjudged_spans(self) -> list[tuple[float, float]]:
        """Time spans in which V cannot be evaluated because records are missing.

        Each span is a pair of start and end, in s. The list is empty if V can be evaluated
        throughout.
        """
        # Judged periods before and after the run give each span a start and an end.
        padded = np.concatenate([[True], self.judged, [True]])
        edges = np.flatnonzero(np.diff(padded.astype(np.int8)))
        times = self.t_s[edges]
        starts_s = times[::2].tolist()
        ends_s = times[1::2].tolist()
        return list(zip(starts_s, ends_s, strict=True))

    @cached_property
    def V(self) -> Array:  # noqa: N802 - the paper's symbol
        """Total energy V of the arms in the stability proof, shape (T,), in J.

        V = sum_i beta_i V_i, where V_i is the energy of site i, and beta_i its weight in
        `beta`. According to the stability theorem, V never rises unless an operator supplies
        energy.
        """
        return _sum(self.parts)

    @cached_property
    def residual(self) -> Array:
        """Change of V that dissipation and work do not explain, shape (T,), in J.

        The residual is V - V(0) + dissipation - work, summed over the tick periods that can be
        evaluated from the records alone. Apart from the two causes that `unexplained`
        subtracts, it should be close to 0. A larger residual shows that the records contradict
        each other.
        """
        dissipation = _sum(self.dissipation)
        work = _sum(self.work)
        return self._accumulate_judged(self.V + dissipation - work)

    @cached_property
    def unexplained(self) -> Array:
        """Change of the group's energy that has no known cause, shape (T,), in J.

        A large value means that the log contradicts the model of the arms, or that records are
        wrong.

        It equals `residual` minus two known causes: the work caused by executing control laws
        in ticks, and the energy transfers between arms that the site weights do not cancel.
        """
        explained = self._accumulate_judged(self.sampling - self.transfer)
        return self.residual - explained

    @cached_property
    def unsupplied(self) -> Array:
        """The energy V excluding the work of operators and environments, shape (T,), in J.

        The curve starts at V(0) and accumulates the changes of V minus the work of operators,
        environments and joint stops, except in tick periods with missing records (see
        `judged`). The curve never rises if the conditions of the stability theorem hold.
        """
        rise = self._accumulate_judged(self.V - self.external_work)
        unsupplied: Array = self.V[0] + rise
        return unsupplied

    @property
    def _work_from_outside(self) -> dict[str, Array]:
        """Work of operators, environments and end stops on the arms, by source, in J.

        Each has the shape (T,). Other work, such as that of gravity, is internal to the arms.
        """
        sources = {}
        for name in EXTERNAL_SOURCES:
            if name in self.work:
                sources[name] = self.work[name]
        return sources

    @property
    def external_work(self) -> Array:
        """Work of operators, walls and joint stops on all arms since the first tick, in J.

        The stability proof permits the energy V to rise by this amount. The shape is (T,), with
        one entry per tick.
        """
        return _sum(self._work_from_outside)

    @property
    def external(self) -> dict[str, Array]:
        """Work of each external source, shape (T,), in J, keyed by the name of the source.

        The sources are the operators, the environments and the mechanical joint stops. Sources
        that did no work are left out. The report of the certificate lists the others.
        """
        sources = self._work_from_outside
        return {name: work for name, work in sources.items() if work.any()}

    @cached_property
    def scale(self) -> float:
        """Scale of the energies in the balance, in J, to which its errors are compared.

        The scale is the largest magnitude that the total energy V, or the work of any source,
        reaches during the run. An error of 1 mJ is negligible on a scale of 100 J, but not on a
        scale of 1 mJ.
        """
        largest = []
        for energy in [self.V, *self.work.values()]:
            magnitudes = np.abs(energy)
            largest.append(float(magnitudes.max()))
        return max(largest)

    def _accumulate_judged(self, values: Array) -> Array:
        """Returns the sum of a quantity's changes over the judged periods, shape (T,)."""
        return _accumulate(np.diff(values), self.judged)

    def find_largest_rise(self, tolerance: float) -> FunctionalRise | None:
        """Finds the largest rise of the energy function V above an earlier minimum.

        The work of operators and environments is subtracted first, because V may rise by this
        amount. The result also names the main causes of the remaining rise.

        Args:
            tolerance: Threshold that the rise must exceed, in J.

        Returns:
            The rise, or `None` if it does not exceed the tolerance.
        """
        V = self.unsupplied
        rise = rise_above_minimum(V)
        peak_row = int(rise.argmax())
        if rise[peak_row] <= tolerance:
            return None
        start_row = int(V[: peak_row + 1].argmin())

        # work of every source inside the loop: any of them may have caused the rise
        work_by_source = {}
        for name, work in self.work.items():
            if name not in EXTERNAL_SOURCES:
                is_link = "->" in name
                work_by_source[name if is_link else f"the {name}"] = work
        work_by_source["sampling"] = self.sampling
        work_by_source["what beta does not cancel"] = -self.transfer

        causes = {}
        for name, work in work_by_source.items():
            causes[name] = float(work[peak_row] - work[start_row])
        least_amount = _NOTABLE_CAUSE_SHARE * rise[peak_row]
        notable = {}
        for name in sorted(causes, key=causes.__getitem__, reverse=True):
            if causes[name] > least_amount:
                notable[name] = causes[name]

        return FunctionalRise(
            from_s=float(self.t_s[start_row]),
            at_s=float(self.t_s[peak_row]),
            amount=float(rise[peak_row]),
            causes=notable,
        )

    def find_unsupplied_growth(self, tolerance: float) -> list[UnsuppliedGrowth]:
        """Finds growth of the energy V that no external source supplied.

        Such growth is evidence that the run is not stable. The work of operators and
        environments is first subtracted from V, the energy function of the stability proof. Two
        rules are then checked. First, V must not end higher than it started. Second, in the
        second half of the run, the rise from the minimum to the end must be at most half of the
        fall from the beginning of this half to the minimum.

        Args:
            tolerance: Threshold that a rise must exceed to count, in J.

        Returns:
            The growth for each violated rule.
        """
        V = self.unsupplied
        middle_row = len(V) // 2
        growths = []
        gained = float(V[-1] - V[0])
        if gained > tolerance:
            growths.append(UnsuppliedGrowth(gained))

        judged = V[middle_row:]
        lowest_row = int(judged.argmin())
        risen = float(judged[-1] - judged[lowest_row])
        fell = float(judged[0] - judged[lowest_row])
        if risen > tolerance and risen > 0.5 * fell:
            growths.append(
                UnsuppliedGrowth(risen, from_s=float(self.t_s[middle_row + lowest_row]))
            )
        return growths

    @classmethod
    def of_energies(
        cls, energies: Mapping[str, SiteEnergy], *, paper_weights: bool = False
    ) -> "EnergyBalance":
        """Combines the energies of several sites into the energy balance of the group.

        The sites are weighted such that the energies that they transfer to each other cancel in
        the sum.

        Args:
            energies: Energies of the sites in scenario order. No site may follow a site outside
                the group.
            paper_weights: True to give all sites the same weight, as in the paper on which the
                control law is based. The transferred energies then may not cancel, in which
                case the balance does not close.
        """
        times = find_common_times(energies)
        weights_by_grid = {}
        beta_columns = []
        sites = {}
        unjudged = np.zeros(len(times))
        sums: dict[_EnergyKey, Array] = {}
        for n, (site, energy) in enumerate(energies.items()):
            records = energy.motion.records
            t_s = records.t_s
            # sites with the same ticks share their weights
            count = len(records.known)
            grid = (records.first, count, records.rate_hz)
            if grid not in weights_by_grid:
                weights_by_grid[grid] = _trace_weights(
                    energies, records, paper_weights=paper_weights
                )

            beta_left, beta_right = weights_by_grid[grid]
            left = beta_left[:, n]
            right = beta_right[:, n]
            weighted = _weigh_site(energy, left, right)
            for key, amounts in weighted.items():
                resampled = _resample(times, t_s, amounts)
                if key in sums:
                    resampled = sums[key] + resampled
                sums[key] = resampled
            beta_columns.append(_resample(times, t_s, left))
            weighted_V = left * energy.parts.total
            sites[site] = _resample(times, t_s, weighted_V)

            is_unjudged = (~energy.judged).astype(np.float64)
            unjudged_periods = _accumulate(is_unjudged)
            resampled_periods = _resample(times, t_s, unjudged_periods)
            unjudged += np.abs(resampled_periods)

        judged: Bools = np.diff(unjudged) == 0.0
        all_judged = bool(judged.all())

        def select(kind: str) -> dict[str, Array]:
            """Accumulates energies of one kind, such as dissipation, over the `judged` periods.

            Args:
                kind: The kind, such as "dissipation" or "work".

            Returns:
                Accumulated energies in J, starting with 0, each keyed by a name such as
                "damping".
            """
            selected = {}
            for (group, name), energy in sums.items():
                if group != kind:
                    continue
                if all_judged:
                    selected[name] = energy - energy[0]
                else:
                    selected[name] = _accumulate(np.diff(energy), judged)
            return selected

        parts = {}
        for name in FunctionalParts._fields:
            parts[name] = sums["parts", name]
        return cls(
            t_s=times,
            beta=np.stack(beta_columns, axis=1),
            sites=sites,
            parts=parts,
            dissipation=select("dissipation"),
            work=select("work"),
            sampling=select("sampling")[""],
            transfer=select("transfer")[""],
            judged=judged,
        )


def _weigh_site(
    energy: SiteEnergy, weight: Array, weight_at_end: Array
) -> dict[_EnergyKey, Array]:
    """Returns the contributions of a site to the energy balance of all sites, with its weight.

    A change of the weight itself does work on the total energy V, along a ramp and at a step.
    That work is counted as work of the dominance factors, under the name "shares".

    Args:
        energy: Energies of the site over K ticks.
        weight: Weight of the site at every tick, shape (K,).
        weight_at_end: Its weight at the end of every period, before a step there, shape (K -
            1,).

    Returns:
        Contributions at the ticks of the site by (kind, name), shape (K,) each, in J.
    """
    weight_at_start = weight[:-1]
    weight_after_step = weight[1:]

    def weigh(increment: Increment) -> Array:
        """Returns the accumulated energy over time, multiplied by the weight of the site."""
        at_start = weight_at_start * increment.left
        at_end = weight_at_end * (increment.right + increment.jump)
        return _accumulate(at_start + at_end)

    weighted = {}
    parts = energy.parts._asdict()
    for name, part in parts.items():
        weighted["parts", name] = weight * part
    for name, increment in energy.dissipation.items():
        weighted["dissipation", name] = weigh(increment)
    for name, increment in energy.work.items():
        weighted["work", name] = weigh(increment)

    V = energy.parts.total
    V_start = V[:-1]
    V_end = V[1:]
    ramp_work = (weight_at_end - weight_at_start) * 0.5 * (V_start + V_end)
    step_work = (weight_after_step - weight_at_end) * V_end
    weight_work = _accumulate(ramp_work + step_work)
    weighted["work", "shares"] = weighted["work", "shares"] + weight_work

    weighted["sampling", ""] = weigh(energy.sampling)
    weighted["transfer", ""] = weigh(energy.transfer)
    return weighted


def _resample(times: Array, t_s: Array, values: Array) -> Array:
    """Interpolates a curve linearly at other times, to add curves of arms with different rates.

    At the times of the given values, these values are returned unchanged.

    Args:
        times: Times of the result, shape (T,), in s.
        t_s: Times of the values, shape (K,), in s.
        values: The values, shape (K,).
    """
    has_same_length = len(t_s) == len(times)
    if has_same_length and t_s[0] == times[0]:
        return values
    return np.interp(times, t_s, values)


def _trace_weights(
    energies: Mapping[str, SiteEnergy],
    records: AlignedRecords,
    *,
    paper_weights: bool,
) -> tuple[Array, Array]:
    """Returns the weight of each of N arms in the total energy V, at the ticks of one arm.

    V is the energy function of the stability proof. The weights beta follow from the dominance
    factors, which may change during the run.

    Args:
        energies: Energies of the N sites.
        records: Records of the site that has these ticks.
        paper_weights: True to return the weights of the paper, which are ones.

    Returns:
        beta at the ticks, shape (K, N). beta at the end of every period, before a step there,
        shape (K - 1, N).
    """
    motions = [energy.motion for energy in energies.values()]
    Kd = np.array([motion.constants.weighing_Kd for motion in motions])
    is_constant = all(motion.dominance.constant for motion in motions)
    beta_by_matrix: dict[bytes, Array] = {}

    def compute_beta(t_s: Array, ahead_s: float) -> Array:
        """Computes the weights beta of the arms in the energy V from the dominance factors.

        Dominance factors seldom change, so the weights for each matrix of factors are computed
        once and cached in `beta_by_matrix`.

        Args:
            t_s: Times, shape (T,), in s.
            ahead_s: Time added to `t_s` before the factors are evaluated, in s.

        Returns:
            The weights, shape (T, N) for N sites. All are 1 if the paper's weights are
            requested.
        """
        count = len(t_s)
        if paper_weights:
            return np.ones((count, len(Kd)))
        different_s = t_s[:1] if is_constant else t_s
        alpha = _interpolate_dominance(energies, different_s, ahead_s)
        # equal matrices must be equal in their bytes, and adding 0.0 turns -0.0 into 0.0
        rounded = np.round(alpha, 12)
        rows = rounded.reshape(len(alpha), -1) + 0.0
        matrices, matrix_index = np.unique(rows, axis=0, return_inverse=True)
        betas = []
        for matrix in matrices:
            key = matrix.tobytes()
            if key not in beta_by_matrix:
                square = matrix.reshape(len(Kd), -1)
                beta_by_matrix[key] = compute_lyapunov_weights(square, Kd).beta
            betas.append(beta_by_matrix[key])
        beta = np.array(betas)[matrix_index.ravel()]
        if is_constant:
            return np.tile(beta, (count, 1))
        return beta

    at_ticks = compute_beta(records.t_s, 0.0)
    period_starts_s = records.t_s[:-1]
    at_period_ends = compute_beta(period_starts_s, records.h_s)
    return at_ticks, at_period_ends


def _interpolate_dominance(
    energies: Mapping[str, SiteEnergy],
    t_s: Array,
    ahead_s: float = 0.0,
) -> Array:
    """Returns the matrix of dominance factors of a group of arms over time, shape (T, N, N).

    A dominance factor is the weight, from 0 to 1, with which one arm follows another.

    Args:
        energies: Energies of the N sites. Peers outside the group are left out.
        t_s: Times, shape (T,), in s.
        ahead_s: Time by which a ramp in progress is extrapolated, in s.
    """
    names = list(energies)
    sites = len(names)
    alpha = np.zeros((len(t_s), sites, sites))
    for i, energy in enumerate(energies.values()):
        records = energy.motion.records
        dominance = energy.motion.dominance
        elapsed_s = t_s - records.t_s[0]
        position = elapsed_s * records.rate_hz

        tick_before = np.floor(position + 1e-5)
        last_row = len(records.known) - 1
        recorded_tick = np.clip(tick_before, 0, last_row)
        row = recorded_tick.astype(np.int64)
        since_tick = np.maximum(position - row, 0.0)
        later_s = since_tick / records.rate_hz + ahead_s

        for j, peer in enumerate(energy.motion.peers):
            if peer not in energies:
                continue
            at_tick = dominance.alpha[row, j]
            rate = dominance.rate[row, j]
            column = names.index(peer)
            alpha[:, i, column] = at_tick + later_s * rate
    # a ramp that ends between two ticks is extrapolated beyond its end
    return np.clip(alpha, 0.0, 1.0)


def find_dominance_matrices(energies: Mapping[str, SiteEnergy]) -> Array:
    """Finds all matrices of dominance factors that were in effect during a run.

    Entry (i, j) is the weight with which site i follows site j. If the factors change gradually
    along a ramp, only the matrices at the ends of the ramp are returned.

    Args:
        energies: Energies of the N sites, keyed by site name.

    Returns:
        The M matrices, shape (M, N, N).
    """
    motions = [energy.motion for energy in energies.values()]
    first_s = motions[0].records.t_s[:1]
    times = [first_s]
    for motion in motions:
        t_s = motion.records.t_s
        dominance = motion.dominance
        change_of_rate = np.diff(dominance.rate, axis=0, prepend=0.0)
        ramp_rows = np.flatnonzero(any_in_rows(change_of_rate))

        is_step = dominance.alpha[1:] != dominance.before
        periods_with_step = np.flatnonzero(any_in_rows(is_step))
        step_rows = periods_with_step + 1

        times.append(t_s[ramp_rows])
        times.append(t_s[step_rows])
    return _interpolate_dominance(energies, np.concatenate(times))


def rise_above_minimum(values: Array) -> Array:
    """Returns how far a quantity is above its smallest earlier value, at each time.

    For example, the values 3, 1, 2, 0 give 0, 0, 1, 0. An earlier fall of an energy thus does
    not hide a later rise.

    Args:
        values: Values of the quantity over time, shape (T,).

    Returns:
        The rise, shape (T,). It is 0 where a new minimum is reached.
    """
    minimum_so_far = np.minimum.accumulate(values)
    return values - minimum_so_far


def _sum(columns: Mapping[str, Array]) -> Array:
    """Returns the sum of curves at each time, shape (T,)."""
    curves = list(columns.values())
    total: Array = np.sum(curves, axis=0)
    return total

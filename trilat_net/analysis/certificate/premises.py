"""Checks whether a recorded run meets the conditions of the stability theorem.

The theorem states that an energy function V of all arms never rises unless an operator supplies
energy. Its proof is in docs/theory/theorem.md. The conditions of the theorem are called
premises:

- The network delays are constant.
- The dominance factors are constant, and every arm follows every other arm, directly or through
  further arms.
- The damping gain Kd is the same at every arm, up to one factor per arm.
- Every arm uses the adaptive law, which estimates the parameters theta of the arm.
- No operator moves an arm, or the operators are passive with respect to the filtered error r,
  which is the joint velocity plus a gain Lambda times the position error.

The module also finds time spans in which records are missing.

Invariant:
    - A premise holds, fails, or cannot be decided, and always contains the quantities that show
      which. The package `presentation` generates the sentences.
    - Missing information never makes a run stable. The verdict stays open if too many records
      are missing, or if the run was repeated with the recorded motion of some arms.
    - A log that was modified after it was written does not pass.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...core import DominanceMatrix
from ...log import Log
from ...net import HALTED_MODES
from ..aligned import Bools
from ..dominance_history import PeerLoss, compute_lyapunov_weights, find_kd_scales
from ..following import TaskFollowing
from ..row_reductions import any_in_rows
from ..timeline import Timeline
from ..torque_sources import WallEnergy
from .energy_balance import (
    ZERO_ENERGY_J,
    EnergyBalance,
    SiteEnergy,
    find_dominance_matrices,
    rise_above_minimum,
)
from .energy_terms import SiteConstants
from .premise_quantities import (
    LEAST_ABSENCE_S,
    AbsentSpan,
    AgeRange,
    AxisQuantities,
    CutTorque,
    DelayQuantities,
    DominanceQuantities,
    FollowingQuantities,
    GainQuantities,
    Interruption,
    LawQuantities,
    MissingFunctional,
    OperatorQuantities,
    ParameterFault,
    ParameterQuantities,
    Premise,
    PresenceQuantities,
    PresentStretch,
    RecordQuantities,
    SingularPoseQuantities,
    StopQuantities,
    Supply,
    TorqueQuantities,
    TouchedStop,
    WallQuantities,
)
from .verdict_facts import Evidence, NoFunctional, RecordGap

CONSTANT_DELAY_TOLERANCE_S = 1e-7
"""Ages of samples that differ by less than this count as equal, in s.

Time stamps are whole nanoseconds. Therefore constant delays differ by rounding.
"""
SAMPLING_RISE_SHARE = 1e-4
"""Largest rise of V that may be an effect of sampling, as a share of the scale of V.

The rise is excused only up to the residual of the energy balance.
"""
MIN_FREE_S = 1.0
"""Shortest motion without operators at the end of a run to which the theorem applies, in s."""
MIN_FREE_AGES = 5.0
"""Shortest motion without operators, as a multiple of the largest age of a sample in use."""
LEAST_SPEED_M_S = 1e-9
"""Smallest speed of an end effector that counts as motion along an axis, in m/s.

Slower speeds are the rounding error of an axis along which the end effector cannot move.
"""


class FunctionalFacts(NamedTuple):
    """Quantities for checking the theorem's conditions on a run whose energy V is known.

    V is the energy function of the stability theorem. The gaps in the log are also listed.
    `RunFacts.of_log` computes this object once for all checks.

    Attributes:
        log: The log of the run.
        energies: Energies of every site, keyed by site name.
        balance: Energy balance of all sites together.
        groups: Closed groups of sites, at the first time at which there are several of them.
            The sites of a closed group follow no site outside the group. With several groups,
            the weights beta of the sites in V are not unique. Empty if the weights are always
            unique.
        absent: Time intervals in which a site was absent.
        unjudged: Time spans (start, end) in s in which records are missing although all sites
            were present.
        tolerance: Threshold that a rise of V must exceed to count, in J.
    """

    log: Log
    energies: dict[str, SiteEnergy]
    balance: EnergyBalance
    groups: tuple[tuple[str, ...], ...]
    absent: list[AbsentSpan]
    unjudged: list[tuple[float, float]]
    tolerance: float


class RunFacts(NamedTuple):
    """Quantities of a run needed to check the conditions of the stability theorem.

    The theorem states that an energy function V of all arms does not rise by itself.

    Attributes:
        log: The log of the run.
        constants: Gains and limits of every site, keyed by site name. Empty if V does not exist
            for some site.
        functional: V over time and the energies that changed it, or `None` if V cannot be
            computed.
        unknown: The reason why V cannot be computed, or `None` if it can.
    """

    log: Log
    constants: dict[str, SiteConstants]
    functional: FunctionalFacts | None = None
    unknown: NoFunctional | RecordGap | None = None

    @classmethod
    def of_log(cls, log: Log) -> "RunFacts":
        """Computes from a log the quantities needed to check the stability theorem.

        The theorem is based on an energy function of all arms. If this function does not exist
        for one of the control laws, or if the records of the arms overlap at too few times to
        compute it, the result contains the reason.

        Args:
            log: The log of the run.

        Raises:
            LogError: The log contains an invalid change of a setting, such as a dominance
                factor.
        """
        missing = MissingFunctional.list_of_scenario(log.scenario)
        if missing:
            return cls(log, {}, unknown=NoFunctional(tuple(missing)))

        constants = {site: SiteConstants.derive(log.scenario, site) for site in log.sites}
        energies = SiteEnergy.by_site(log)
        if not energies:
            return cls(log, constants, unknown=RecordGap.NO_COMMON_TIME)
        balance = EnergyBalance.of_energies(energies)
        absent = AbsentSpan.list_of_log(log)
        if not balance.judged.any():
            return cls(log, constants, unknown=RecordGap.NO_PERIOD)

        # the first dominance matrix with several closed groups, for which beta is not unique
        matrices = map(DominanceMatrix, find_dominance_matrices(energies))
        closed_groups = (matrix.closed_groups for matrix in matrices)
        ambiguous_groups = next((groups for groups in closed_groups if len(groups) > 1), ())
        group_names = tuple(
            tuple(log.sites[index] for index in group) for group in ambiguous_groups
        )
        unjudged_while_present = []
        for from_s, to_s in balance.unjudged_spans:
            if not any(span.from_s < to_s and from_s < span.to_s for span in absent):
                unjudged_while_present.append((from_s, to_s))

        sampling_j = min(float(np.ptp(balance.residual)), SAMPLING_RISE_SHARE * balance.scale)
        facts = FunctionalFacts(
            log=log,
            energies=energies,
            balance=balance,
            groups=group_names,
            absent=absent,
            unjudged=unjudged_while_present,
            tolerance=float(np.ptp(balance.unexplained)) + sampling_j + ZERO_ENERGY_J,
        )
        return cls(log, constants, facts)

    def check_premises(self) -> list[Premise]:
        """Checks whether a run meets the conditions (premises) of the stability theorem.

        Also checks that virtual walls, whose force is computed once per tick, generate no
        energy. If the energy function of the theorem cannot be computed, only the control laws
        and the walls are checked.

        Returns:
            The premises that apply to this run, in the order used in the stability certificate.
        """
        missing = MissingFunctional.list_of_scenario(self.log.scenario)
        law = Premise("law", bool(self.constants), LawQuantities(tuple(missing)))
        premises: list[Premise | None] = [law]

        if self.constants:
            premises += [_check_parameters(self), _check_gains(self)]
        premises.append(_check_walls(self.log))
        if self.functional is not None:
            premises += [check(self.functional) for check in FUNCTIONAL_CHECKS]

        # A check returns None if its premise does not concern the run.
        return [premise for premise in premises if premise is not None]

    def collect_evidence(self, min_coverage: float) -> Evidence:
        """Collects evidence on how complete the records are and whether the log was modified.

        A run with too few records is not judged stable (see `Evidence.reasons`).

        Args:
            min_coverage: Smallest acceptable fraction of ticks that were recorded, and of tick
                periods in which the energy of the stability proof is known. Between 0 and 1.
        """
        facts = self.functional
        functional_share = None
        if facts is not None and not facts.groups:
            t_s = facts.balance.t_s
            judged = facts.balance.judged
            # Spans that are unjudged because a site was absent do not count against the share.
            unjudged_in_absence = set(facts.balance.unjudged_spans) - set(facts.unjudged)
            all_present = np.ones(len(judged), dtype=np.bool_)
            for from_s, to_s in unjudged_in_absence:
                all_present &= (t_s[:-1] < from_s) | (t_s[:-1] >= to_s)
            functional_share = float(judged[all_present].mean()) if all_present.any() else 0.0

        return Evidence(
            log=self.log.judge_quality(),
            functional_share=functional_share,
            min_coverage=min_coverage,
        )


def _check_parameters(run: RunFacts) -> Premise:
    """Checks that the adaptive laws can learn the parameters theta of their arms.

    A law keeps its estimates within limits, so theta must lie between them. Parameters that a
    law does not adapt must be known from the start, and the law must compensate all friction.
    """
    faults = []
    for site, constants in run.constants.items():
        theta = constants.theta
        lower_limit = constants.low
        upper_limit = constants.high
        if ((theta < lower_limit) | (theta > upper_limit)).any():
            faults.append((site, ParameterFault.OUTSIDE_BOX))

        gains = run.log.scenario.sites[site].control.gains(theta)
        first_estimate = np.clip(gains.theta_hat0, lower_limit, upper_limit)
        is_wrong_forever = ~constants.adapts & (first_estimate != theta)
        if is_wrong_forever.any():
            faults.append((site, ParameterFault.NEVER_LEARNT))
        if constants.unknown_friction.any():
            faults.append((site, ParameterFault.FRICTION))
    return Premise("parameters", not faults, ParameterQuantities(tuple(faults)))


def _check_gains(run: RunFacts) -> Premise:
    """Checks that the gains Kd of all sites are positive and equal up to a scalar per site.

    Only then do weights beta exist with which the exchanged energies of all sites cancel in V.
    """
    constants = run.constants
    Kd = np.array([values.weighing_Kd for values in constants.values()])

    scales = find_kd_scales(Kd)
    scales_by_site = None
    if scales is not None:
        scales_by_site = dict(zip(constants, map(float, scales), strict=True))

    quantities = GainQuantities(
        Kd={site: tuple(values.Kd.tolist()) for site, values in constants.items()},
        scales=scales_by_site,
        is_positive=bool(Kd.all()),  # NaN (an axis that is not followed) counts as positive
    )
    holds = scales_by_site is not None and quantities.is_positive
    return Premise("Kd", holds, quantities)


def _check_walls(log: Log) -> Premise | None:
    """Checks that the simulated walls do not generate energy.

    A simulated wall computes its torque once per tick and holds it for the tick period h. A
    wall of stiffness K and damping B thereby generates energy in contact, unless the arm's own
    damping exceeds K h / 2 + B.

    Returns:
        The premise. `None` if the scenario contains no such wall.
    """
    if WallEnergy.count_generating_walls(log.scenario) == 0:
        return None
    quantities = WallQuantities(tuple(WallEnergy.list_of_log(log)))
    return Premise("walls", not quantities.active, quantities)


def _check_dominance(run: FunctionalFacts) -> Premise:
    """Checks the dominance factors, with which the sites follow each other.

    The factors must be constant, and their matrix alpha must be irreducible: every site follows
    every other site, directly or through further sites. Otherwise some site has the weight zero
    in V, or the weights are not unique.
    """
    names = run.log.scenario.names
    energies = run.energies
    changing = [
        site for site, energy in energies.items() if not energy.motion.dominance.constant
    ]
    if changing:
        losses = tuple(PeerLoss.list_of_log(run.log))
        quantities = DominanceQuantities(changing=tuple(changing), losses=losses)
        return Premise("shares", False, quantities)

    Kd = np.array([energy.motion.constants.weighing_Kd for energy in energies.values()])
    weights = compute_lyapunov_weights(run.log.scenario.alpha, Kd)
    groups = tuple(tuple(names[n] for n in group) for group in weights.groups)
    if len(groups) > 1:
        return Premise("shares", False, DominanceQuantities(groups=groups))

    weightless = tuple(site for site in names if site not in groups[0])
    beta = None
    if weights.scales is not None:
        beta = dict(zip(names, weights.beta.tolist(), strict=True))
    quantities = DominanceQuantities(groups=groups, weightless=weightless, beta=beta)
    return Premise("shares", not weightless, quantities)


def _check_delays(run: FunctionalFacts) -> Premise:
    """Checks that the delay of every link is constant.

    The delay is the age of the peer's sample that a site uses in a tick. The condition is not
    decided if no sample of any peer came into use.
    """
    varying = []
    constant_s = []
    for site, energy in run.energies.items():
        records = energy.motion.records
        for peer, peer_motion in energy.followed.items():
            is_used = np.isfinite(peer_motion.stamp_s) & records.known
            if not is_used.any():
                continue
            age_s = (records.t_s - peer_motion.stamp_s)[is_used]
            # With a constant delay the first sample in use is the first one that was sent. A
            # later first sample shows that the delay was shorter when it was sent.
            first_stamp_s = peer_motion.stamp_s[is_used][0]
            latest_first_s = records.h_s + CONSTANT_DELAY_TOLERANCE_S
            starts_late = records.first == 0 and first_stamp_s > latest_first_s
            if np.ptp(age_s) > CONSTANT_DELAY_TOLERANCE_S or starts_late:
                ages = AgeRange(
                    peer=peer,
                    site=site,
                    shortest_s=float(age_s.min()),
                    longest_s=float(age_s.max()),
                )
                varying.append(ages)
            else:
                constant_s.append(float(age_s[0]))

    holds = None  # no sample of any peer came into use
    if varying or constant_s:
        holds = not varying
    return Premise("delays", holds, DelayQuantities(tuple(varying), tuple(constant_s)))


def _check_following(run: FunctionalFacts) -> Premise:
    """Checks that every site follows its peers during the whole run.

    A site does not follow its peers while it holds its position, brakes, returns or has
    stopped. Nor does it follow them while the velocity of its reference is limited.
    """
    log = run.log
    timeline = Timeline(log)
    interruptions = []
    is_halted = False
    for site in log.sites:
        intervals = timeline.find_mode_intervals(site)
        interruptions += _list_interruptions(site, intervals)
        is_halted = is_halted or any(interval.mode in HALTED_MODES for interval in intervals)

    limited_ticks = {}
    for site in log.sites:
        limits = log.scenario.sites[site].limits
        limited_rows = ~limits.find_unlimited_rows(log[site].qd_des)
        if limited_rows.any():
            limited_ticks[site] = int(np.count_nonzero(limited_rows))

    holds = not interruptions and not limited_ticks
    quantities = FollowingQuantities(tuple(interruptions), limited_ticks, is_halted)
    return Premise("following", holds, quantities)


def _list_interruptions(
    site: str, intervals: Sequence[tuple[str, float, float]]
) -> list[Interruption]:
    """Lists the times during which a site did not follow its peers, in chronological order.

    Between two interruptions the site followed its peers, so modes that succeed each other
    without a gap make up one interruption.

    Args:
        site: Name of the site.
        intervals: Mode, start and end of each interval in which the site did not follow, see
            `Timeline.find_mode_intervals`.
    """
    interruptions: list[Interruption] = []
    for _, from_s, to_s in intervals:
        if interruptions and interruptions[-1].to_s == from_s:
            interruptions[-1] = interruptions[-1]._replace(to_s=to_s)
        else:
            interruptions.append(Interruption(site, from_s, to_s))
    return interruptions


def _check_torque_limits(run: FunctionalFacts) -> Premise:
    """Checks that no torque of a law was cut off at the limit of its actuator."""
    cut_off = []
    for site, energy in run.energies.items():
        limited = energy.motion.limited
        if limited.any():
            ticks = int(np.count_nonzero(any_in_rows(limited)))
            cut_off.append(CutTorque(site, _find_joints(run, site, limited), ticks))
    return Premise("torque", not cut_off, TorqueQuantities(tuple(cut_off)))


def _check_stops(run: FunctionalFacts) -> Premise | None:
    """Checks that no joint touches the mechanical stops at the ends of its range.

    Stops are passive with respect to the velocity qd, but not with respect to the filtered
    error r = qd + Lambda e of the proof.

    Returns:
        The premise. `None` if no joint has stops.
    """
    arms = run.log.scenario.arms.values()
    stop_stiffnesses: list[float] = []
    for model in arms:
        if model.chain is not None:
            stop_stiffnesses += [joint.stop_stiffness for joint in model.chain.joints]
    if not any(stop_stiffnesses):
        return None

    touched = []
    for site, energy in run.energies.items():
        records = energy.motion.records
        touches_stop = energy.motion.constants.arm.stop_torque(records.q, records.qd) != 0.0
        if touches_stop.any():
            first_row = int(np.argmax(any_in_rows(touches_stop)))
            first_s = float(records.t_s[first_row])
            touched.append(TouchedStop(site, _find_joints(run, site, touches_stop), first_s))
    return Premise("stops", not touched, StopQuantities(tuple(touched)))


def _check_axes(run: FunctionalFacts) -> Premise | None:
    """Checks that each followed site follows along the same axes of the end effector.

    Sites that work in task space may follow their peers along some axes only. If a follower
    uses an axis along which the followed site is free, the followed site is an operator on this
    axis. An axis along which the followed site did not move has no effect.

    Returns:
        The premise. `None` if all sites work in joint space.
    """
    motions = {
        site: energy.motion
        for site, energy in run.energies.items()
        if energy.motion.constants.axes
    }
    if not motions:
        return None

    faults = []
    for site, motion in motions.items():
        is_free = np.array(motion.constants.axes) == 0.0
        largest_speed = np.abs(motion.records.xd).max(axis=0)
        axes_in_free_motion = is_free & (largest_speed > LEAST_SPEED_M_S)
        for follower, follower_motion in motions.items():
            is_followed = site in run.energies[follower].followed
            followed_axes = np.array(follower_motion.constants.axes) > 0.0
            if is_followed and (axes_in_free_motion & followed_axes).any():
                faults.append((follower, site))
    return Premise("axes", not faults, AxisQuantities(tuple(faults)))


def _check_singular_poses(run: FunctionalFacts) -> Premise | None:
    """Checks that no arm came near a singular pose, where its inverse Jacobian is damped.

    The proof needs J J+ = I, with the Jacobian J and its pseudo-inverse J+. Near a singular
    pose the pseudo-inverse is damped to stay finite, and the product differs from I.

    Returns:
        The premise. `None` if all sites work in joint space.
    """
    near_s = {}
    least_values = {}
    for site, energy in run.energies.items():
        following = energy.motion.following
        if not isinstance(following, TaskFollowing):
            continue
        least_values[site] = float(following.least.min())
        if following.damping.any():
            first_row = int(np.argmax(following.damping > 0.0))
            near_s[site] = float(energy.motion.records.t_s[first_row])

    if not least_values:
        return None
    quantities = SingularPoseQuantities(near_s, least_values)
    return Premise("singular poses", not near_s, quantities)


def _check_operators(run: FunctionalFacts) -> Premise:
    """Checks that operators and environments are passive with respect to r.

    An operator is the person or program that moves an arm, and r is the filtered error of the
    proof. Operators are passive if they supply no more energy than they absorbed before. If
    operators do supply energy, the premise still holds for a run that ends with enough motion
    without operators: the theorem then applies to that motion.
    """
    energies = run.energies
    balance = run.balance
    push_times_s = {}
    for site, energy in energies.items():
        records = energy.motion.records
        t_s = records.t_s[any_in_rows(records.tau_x)]
        if len(t_s):
            push_times_s[site] = t_s

    external = run.log.scenario.external
    if external and not push_times_s:
        # Arms outside the program record their external torque only if they measure it.
        return Premise("hands", None, OperatorQuantities(unmeasured=tuple(external)))
    if not push_times_s:
        return Premise("hands", True, OperatorQuantities())

    weightless = tuple(
        site
        for n, site in enumerate(energies)
        if site in push_times_s and not balance.beta[:, n].any()
    )
    if weightless:
        return Premise("hands", False, OperatorQuantities(weightless=weightless))

    supplied_energy_j = float(rise_above_minimum(balance.external_work).max())
    released_s = float(max(t_s[-1] for t_s in push_times_s.values()))
    ages_s = [energy.largest_age_s for energy in energies.values()]
    supply = Supply(
        sources=tuple(balance.external),
        energy_j=supplied_energy_j,
        is_passive=bool(supplied_energy_j <= 1e-9 * balance.scale + ZERO_ENERGY_J),
        in_task_space=any(energy.motion.constants.axes for energy in energies.values()),
        released_s=released_s,
        free_s=float(balance.t_s[-1]) - released_s,
        least_free_s=float(max(MIN_FREE_S, MIN_FREE_AGES * max(ages_s))),
    )
    holds = supply.is_passive or supply.free_s >= supply.least_free_s
    return Premise("hands", holds, OperatorQuantities(supply=supply))


def _check_records(run: FunctionalFacts) -> Premise:
    """Checks that the log has all records of all arms while their processes were present.

    Missing records leave the condition undecided, because the energy function V of the
    stability proof is unknown at these times.
    """
    quantities = RecordQuantities(
        unjudged_s=tuple(run.unjudged),
        is_whole=bool(run.balance.judged.all()),
    )
    return Premise("records", None if run.unjudged else True, quantities)


def _check_presence(run: FunctionalFacts) -> Premise | None:
    """Checks that all sites are present during the whole run.

    The theorem says nothing about a run in which a site is absent, but it applies to each
    stretch of time between the absences. Therefore the evidence describes each stretch.

    Returns:
        The premise, which fails. `None` if all sites are present all the time.
    """
    if not run.absent:
        return None
    stretch_start_s = max(energy.begin_s for energy in run.energies.values())
    end_s = Timeline(run.log).end_s

    # Empty absences at the start and at the end let the loop treat all stretches alike.
    absences = [(stretch_start_s, stretch_start_s)]
    absences += [(span.from_s, span.to_s) for span in run.absent]
    absences.append((end_s, end_s))
    stretches = []
    for from_s, to_s in absences:
        if from_s - stretch_start_s > LEAST_ABSENCE_S:
            stretches.append(_examine_stretch(run.energies, stretch_start_s, from_s))
        stretch_start_s = max(stretch_start_s, to_s)

    quantities = PresenceQuantities(tuple(run.absent), tuple(stretches))
    return Premise("presence", False, quantities)


FUNCTIONAL_CHECKS = (
    _check_dominance,
    _check_delays,
    _check_following,
    _check_torque_limits,
    _check_stops,
    _check_axes,
    _check_singular_poses,
    _check_operators,
    _check_records,
    _check_presence,
)
"""Checks of the premises that can be decided only if V is known, in the order of the report."""


def _find_joints(run: FunctionalFacts, site: str, is_affected: Bools) -> tuple[str, ...]:
    """Returns the names of the joints that are affected, for example by a torque limit.

    Args:
        run: Facts of the run.
        site: Site of the arm.
        is_affected: True for each record and joint that is affected, shape (K, n).

    Returns:
        The names. Empty for the built-in planar arm, whose joints have no names.
    """
    model = run.log.scenario.arms[site]
    if model.chain is None:
        return ()
    affected_joints = np.flatnonzero(is_affected.any(axis=0))
    return tuple(model.joint_names[joint] for joint in affected_joints)


def _examine_stretch(
    energies: Mapping[str, SiteEnergy], from_s: float, to_s: float
) -> PresentStretch:
    """Finds when all arms began to follow each other in an interval, and which delays varied.

    The stability theorem applies if all arms follow with constant delays. During the interval,
    no process was absent.

    Args:
        energies: Energies of every site.
        from_s: Start of the span, in s.
        to_s: End of the span, in s.
    """
    all_follow_s = from_s
    for energy in energies.values():
        records = energy.motion.records
        is_inside = (records.t_s >= from_s) & (records.t_s < to_s)
        is_interrupted = records.known & ~records.follows & is_inside
        if is_interrupted.any():
            last_row = np.flatnonzero(is_interrupted)[-1]
            all_follow_s = max(all_follow_s, float(records.t_s[last_row]) + records.h_s)

    if to_s - all_follow_s < LEAST_ABSENCE_S:
        return PresentStretch(from_s, to_s, follow_from_s=None)

    varying = []
    for site, energy in energies.items():
        records = energy.motion.records
        is_inside = records.known & (records.t_s >= all_follow_s) & (records.t_s < to_s)
        for peer, peer_motion in energy.followed.items():
            age_s = (records.t_s - peer_motion.stamp_s)[
                is_inside & np.isfinite(peer_motion.stamp_s)
            ]
            if len(age_s) and np.ptp(age_s) > CONSTANT_DELAY_TOLERANCE_S:
                varying.append((peer, site))
    return PresentStretch(from_s, to_s, all_follow_s, tuple(varying))

"""Judges a run by V, the energy function of the stability proof.

The judgements decide whether the records are false, whether V can be judged, and whether V
rose.

Invariant:
    - A rise of V beyond the work of operators and environments is reported with its time and
      amount, because the theorem rules out such a rise.
    - Energy of unknown origin means that the records were not produced by the equations stated
      in the log. The energy balance is then called broken.
"""

from collections.abc import Sequence

import numpy as np

from ..row_reductions import max_rows
from .energy_balance import ZERO_ENERGY_J
from .premise_quantities import Premise
from .premises import FunctionalFacts
from .verdict_facts import (
    AmbiguousWeights,
    CoarseEnergies,
    FunctionalCourse,
    StabilityFinding,
    StabilityVerdict,
    UnclosedBalance,
    WrongTorque,
)

BROKEN_BALANCE_SHARE = 2e-4
"""Largest energy without a source that counts as rounding, as a share of the scale of V.

The error of the trapezoid rule, with which the energies are integrated, is added to it.
"""
CLEAR_BREAK_SHARE = 1e-3
"""Unexplained energy above this share of the scale shows that records are false.

Below it, a tick period that is long for the gains may be the cause.
"""
TORQUE_TOLERANCE = 1e-6
"""Largest difference of a recorded torque from the law, Eq. (13), relative to 1 + |tau|."""
COARSE_TOLERANCE_SHARE = 1e-2
"""Largest tolerance for a rise at which V is still judged, as a share of the scale of V."""


def _judge_site_balances(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """Returns a verdict if the energy balance of some site does not close.

    Each site is judged by itself. If energy appears or disappears without a source, the records
    are false, unless a tick period that is too long for the gains may be the cause. V cannot be
    judged if only external arms are concerned, which run outside this program: such an arm need
    not follow its theta, and its angles and velocities are not measured at the same instant.
    """
    energies = run.energies
    scale = run.balance.scale

    def compute_bound_j(worst_site: str, share: float = BROKEN_BALANCE_SHARE) -> float:
        return share * scale + 2.0 * energies[worst_site].uncertainty + ZERO_ENERGY_J

    error_j = {
        worst_site: float(np.abs(energy.unexplained).max())
        for worst_site, energy in energies.items()
    }
    unbalanced = [
        worst_site
        for worst_site in energies
        if error_j[worst_site] > compute_bound_j(worst_site)
    ]
    if not unbalanced:
        return None

    external = run.log.scenario.external
    simulated_sites = []
    for worst_site in unbalanced:
        involved = {worst_site, *energies[worst_site].followed}
        if involved.isdisjoint(external):
            simulated_sites.append(worst_site)
    worst_site = max(simulated_sites or unbalanced, key=error_j.__getitem__)
    exceeds = np.abs(energies[worst_site].unexplained) > compute_bound_j(worst_site)
    first_row = int(np.argmax(exceeds))
    is_clear = error_j[worst_site] > compute_bound_j(worst_site, CLEAR_BREAK_SHARE)
    is_known_well = energies[worst_site].uncertainty < CLEAR_BREAK_SHARE * scale
    facts = UnclosedBalance(
        site=worst_site,
        from_s=float(energies[worst_site].motion.records.t_s[first_row]),
        error_j=error_j[worst_site],
        scale_j=scale,
        external=() if simulated_sites else tuple(external),
        is_certain=bool(is_clear and is_known_well),
    )
    finding = StabilityFinding.BROKEN if simulated_sites else StabilityFinding.NOT_JUDGED
    return StabilityVerdict(finding, facts)


def _judge_torques(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """Returns the verdict BROKEN if recorded torques differ from the control law, Eq. (13).

    The records are then false, and nothing can be concluded from them. `None` if all agree.
    """
    for site, energy in run.energies.items():
        records = energy.motion.records
        error_nm = energy.motion.measure_torque_error()
        largest_nm = max_rows(np.abs(records.tau))
        is_wrong = error_nm > TORQUE_TOLERANCE * (1.0 + largest_nm)
        if is_wrong.any():
            first_row = int(np.argmax(is_wrong))
            facts = WrongTorque(
                site=site,
                from_s=float(records.t_s[first_row]),
                error_nm=float(error_nm.max()),
            )
            return StabilityVerdict(StabilityFinding.BROKEN, facts)
    return None


def _judge_decidability(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """Returns a verdict if V cannot be judged.

    This is the case if the weights beta of the sites in V are not unique, or if the energies
    are not known precisely enough to decide whether V rose.
    """
    if run.groups:
        return StabilityVerdict(StabilityFinding.NOT_JUDGED, AmbiguousWeights(run.groups))
    scale = run.balance.scale
    if run.tolerance <= COARSE_TOLERANCE_SHARE * scale + 2.0 * ZERO_ENERGY_J:
        return None
    return StabilityVerdict(StabilityFinding.NOT_JUDGED, CoarseEnergies(run.tolerance, scale))


def _judge_course(run: FunctionalFacts, premises: Sequence[Premise]) -> StabilityVerdict:
    """Judges a run by its energy function V: whether V rose, and whether the theorem applies.

    V must not rise beyond the supplied energy. The stability theorem applies if its premises
    (conditions) hold.
    """
    balance = run.balance
    # Energies that are rounding errors are written as zero.
    first_j = balance.V[0] if balance.V[0] > ZERO_ENERGY_J else 0.0
    last_j = balance.V[-1] if balance.V[-1] > ZERO_ENERGY_J else 0.0

    rise = balance.find_largest_rise(run.tolerance)
    course = FunctionalCourse(
        failed=tuple(premise.name for premise in premises if premise.holds is False),
        undecided=tuple(premise.quantities for premise in premises if premise.holds is None),
        external=tuple(balance.external),
        from_s=float(balance.t_s[0]),
        to_s=float(balance.t_s[-1]),
        first_j=float(first_j),
        last_j=float(last_j),
        largest_j=float(balance.V.max()),
        rise=rise,
    )

    finding = StabilityFinding.COVERED
    if rise is not None:
        finding = StabilityFinding.ROSE
    elif course.failed:
        finding = StabilityFinding.DID_NOT_RISE
    return StabilityVerdict(finding, course, rise)


JUDGEMENTS = (
    _judge_site_balances,
    _judge_torques,
    _judge_decidability,
    _judge_course,
)
"""Judgements of V, in order. The first one that returns a verdict decides.

They decide whether the records are false, whether V can be judged, and whether V rose.
"""

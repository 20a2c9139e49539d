"""Judges from a log whether the run was stable, and explains the judgement.

`certify` is the entry point, and `Certificate` its result. A certificate combines:

- the conditions (premises) of the stability theorem, which `premises` checks;
- the energy function V of the stability proof, which must not rise unless an operator or an
  environment supplied the energy;
- the motion at the end of the run, which `run_end` judges without any theory;
- repetitions of the run with small disturbances, if they were computed;
- the energies that control laws declare, which `observed_energy` checks;
- how complete the records are, and whether the log was changed.

Invariant:
    - A rise of V beyond the work of operators and environments is reported with its time and
      amount, because the theorem excludes such a rise.
    - Energy without any cause means that the equations stated in the log did not produce the
      records. The energy balance is then called broken.
    - Anything that a log cannot decide is stated. If V does not exist, the end of the run alone
      decides.
    - Keys of the JSON output end in their unit, and unknown values are null.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from ...core import Array
from ...hooks import find_hook
from ...log import MIN_COVERAGE, Log
from ...results import JsonObject, Result, finite_or_none
from ..row_reductions import max_rows
from ..run_end import EndBehaviour, RunEnd, Stability
from ..stability_decision import LoopRoots, RunFindings, StabilityDecision, decide_stability
from ..twins.twin_growth import TwinGrowth
from . import energy_terms
from .energy_balance import (
    EXTERNAL_SOURCES,
    ZERO_ENERGY_J,
    EnergyBalance,
    SiteEnergy,
    compute_energy_balance,
    rise_above_minimum,
)
from .observed_energy import ObservedEnergy, ObservedFinding
from .premise_quantities import Premise
from .premises import (
    FunctionalFacts,
    check_premises,
    collect_evidence,
    find_unjudged_spans,
    gather_facts,
)
from .verdict_facts import (
    AmbiguousWeights,
    CoarseEnergies,
    Evidence,
    FunctionalCourse,
    FunctionalRise,
    StabilityFinding,
    StabilityVerdict,
    UnclosedBalance,
    UnsuppliedGrowth,
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
"""Largest tolerance of a rise, as a share of the scale of V, with which V is still judged."""
NOTABLE_CAUSE_SHARE = 0.05
"""Least share of a rise of V that a source must supply to be named as a cause."""

_REFUTING_FINDINGS = (ObservedFinding.NEGATIVE, ObservedFinding.BROKEN)


@dataclass(frozen=True, repr=False)
class Certificate(Result):
    """Judgement whether a recorded run was stable, with every reason. `certify` creates it.

    It combines several kinds of evidence: the energy function V of the stability proof, the end
    of the motion, the roots of the linearised loop, and repeated runs with a small push.

    Attributes:
        premises: The conditions of the stability theorem, each checked.
        verdict: What the energy function V shows.
        end: The end of the run, judged from the errors e and the velocities qd alone.
        evidence: On how many records the certificate rests, and whether the log was changed.
        balance: Energy balance of all sites. None if V does not exist, or if the weights beta
            of the sites in V are not unique.
        paper_balance: Energy balance with the weights of the paper, which are 1 for every site.
            None if these are the right weights, or if there is no balance.
        groups: Closed groups of sites, which follow nobody outside their group. Empty unless
            there are several; beta is then not unique.
        energies: Energies of every site, by name. Empty if V does not exist.
        roots: Roots of the loop at the pose where the run ended. None if not computed.
        observed: Check of the energies that control laws declare. None if no law declares any.
        twins: Growth of small pushes in repeated runs. None if not computed.
        law_proofs: Phrases that name the stability conditions of control laws that hold at
            every site and prove that small motions die away. Empty if there are none.
        law_conditions: Sentences on the stability conditions of the control laws of the run.
        has_lasting_delays: True if delays that are constant in the run stay so after it.
        remarks: Conditions that readers of the judgement should know, such as a motor at its
            torque limit. See `run_remarks`.
    """

    premises: list[Premise]
    verdict: StabilityVerdict
    end: RunEnd
    evidence: Evidence
    balance: EnergyBalance | None = None
    paper_balance: EnergyBalance | None = None
    groups: tuple[tuple[str, ...], ...] = ()
    energies: Mapping[str, SiteEnergy] = field(default_factory=lambda: MappingProxyType({}))
    roots: LoopRoots | None = None
    observed: ObservedEnergy | None = None
    twins: TwinGrowth | None = None
    law_proofs: tuple[str, ...] = ()
    law_conditions: tuple[str, ...] = ()
    has_lasting_delays: bool = True
    remarks: tuple[str, ...] = ()

    @property
    def has_functional(self) -> bool:
        """True if the energy function V of the stability proof exists for this run's laws.

        Texts and pages leave out V and its terms otherwise.
        """
        laws = [premise.holds for premise in self.premises if premise.name == "law"]
        return laws != [False]

    @property
    def paper_weights_rise(self) -> FunctionalRise | None:
        """The largest rise that the total energy would have if all arms had the same weight.

        The paper on which the control law is based uses such equal weights in the energy
        function of its stability proof. None if this energy does not rise, or was not computed.
        """
        if self.paper_balance is None:
            return None
        return _find_largest_rise(self.paper_balance, self.verdict.tolerance)

    @property
    def bounded_by_v(self) -> bool:
        """True if the energy V of the stability proof limits the motion of every arm.

        V must not have risen, and every arm must have a positive weight in V. An arm has the
        weight zero if the arms that it follows do not follow it. It is limited as well if only
        the condition on the dominance factors, the weights with which arms follow each other,
        fails, and these factors are constant. It then converges after the arms that it follows.
        """
        did_not_rise = (StabilityFinding.COVERED, StabilityFinding.DID_NOT_RISE)
        if self.balance is None or self.verdict.finding not in did_not_rise:
            return False
        if (self.balance.beta > 0.0).all():
            return True
        failed = [premise.name for premise in self.premises if premise.holds is not True]
        constant = all(energy.motion.dominance.constant for energy in self.energies.values())
        return failed == ["shares"] and constant

    @property
    def proofs(self) -> tuple[str, ...]:
        """Phrases that name the proofs for this loop, apart from its characteristic roots.

        The stability theorem is a proof if all of its premises hold, also after the run, and V
        did not rise. The stability condition of a control law is a proof if it holds at every
        site.
        """
        covered = self.verdict.finding is StabilityFinding.COVERED
        all_hold = all(premise.holds is True for premise in self.premises)
        is_proof = covered and all_hold and self.has_lasting_delays
        if not is_proof:
            return self.law_proofs
        return (str(find_hook("name the theorem")()), *self.law_proofs)

    @property
    def _doubts(self) -> tuple[str, ...]:
        """Sentences on findings that contradict a stable run. Empty if there are none.

        Such findings are a rise of the energy function V, declared energies that are wrong or
        negative, and a damaged or incomplete log.
        """
        doubts = []
        if self.verdict.finding is StabilityFinding.BROKEN:
            doubts.append(self.verdict.text)
        elif self.balance is not None:
            growths = find_unsupplied_growth(self.balance, self.verdict.tolerance)
            doubts += [str(find_hook("describe a growth of V")(growth)) for growth in growths]
        if self.observed is not None and self.observed.finding in _REFUTING_FINDINGS:
            doubts.append(self.observed.text)
        return (*doubts, *self.evidence.reasons)

    @cached_property
    def decision(self) -> StabilityDecision:
        """The decision whether the run is stable, with its evidence and the reasons against it.

        It combines the motion at the end, the repetitions with small pushes, the characteristic
        roots, the proofs and the doubts, by the rules of `stability_decision`. It is computed
        at first use.
        """
        findings = RunFindings(
            end=self.end,
            twins=self.twins,
            roots=self.roots,
            proofs=self.proofs,
            doubts=self._doubts,
            rises=self.verdict.finding is StabilityFinding.ROSE,
        )
        return decide_stability(findings)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences on everything that speaks against calling the run stable.

        They concern the end of the run, the energy V, the roots at the end pose, the energies
        that control laws declare, and the completeness of the log. Empty for a stable run.
        """
        return self.decision.reasons

    @property
    def stability(self) -> Stability:
        """The judgement of the run in one word: stable, settled, not stable, or open.

        `stability_decision` explains how the findings lead to this judgement.
        """
        return self.decision.stability

    @property
    def passed(self) -> bool:
        """True if the run is judged stable, in the strict sense.

        A run that merely settled, so that its motion became slow, has not passed. `accepts` is
        less strict.
        """
        return self.accepts(())

    def headline(self) -> str:
        """Returns the judgement and its basis in one line for people.

        For example "stable: converged; rests on: exact roots, slowest -0.832 /s". The line is
        composed by the package `presentation`.
        """
        return str(find_hook("head a certificate")(self))

    def to_dict(self) -> JsonObject:
        """Converts the certificate to plain values, as `trilat certify --json` prints them.

        docs/reference/json.md explains the most important keys. The entry "functional" is None
        if the energy function V cannot be computed.
        """
        verdict = self.verdict
        end = self.end
        balance = self.balance
        return {
            "passed": self.passed,
            "stability": self.stability.value,
            "rests_on": self.decision.rests_on,
            "reasons": list(self.reasons),
            "remarks": list(self.remarks),
            "verdict": verdict.finding.name.lower(),
            "text": verdict.text,
            "rise": _rise_to_json(verdict.rise),
            "tolerance_j": verdict.tolerance,
            "closed_groups": [list(group) for group in self.groups],
            "premises": [premise.to_json() for premise in self.premises],
            "growth": {
                "motion": end.behaviour.name.lower(),
                "text": end.text,
                "where": end.where or None,
                "error_rate_per_s": finite_or_none(end.error.rate_per_s),
                "speed_rate_per_s": finite_or_none(end.speed.rate_per_s),
                "end_error_rad": end.end_error_rad,
                "end_error_where": end.end_error_where or None,
                "end_speed_rad_s": end.end_speed_rad_s,
                "end_speed_where": end.end_speed_where or None,
            },
            "evidence": self.evidence.to_json(),
            "roots": None if self.roots is None else self.roots._asdict(),
            "observed": None if self.observed is None else self.observed.to_json(),
            "twins": None if self.twins is None else self.twins.to_json(),
            "functional": None if balance is None else _functional_to_json(self, balance),
        }

    def to_rows(self) -> list[JsonObject]:
        """Returns the conditions (premises) of the stability theorem as rows of a table.

        A row has the keys "name", "holds" and "text", from which `to_frame` makes a data frame.
        """
        return [premise.to_json() for premise in self.premises]

    def accepts(self, accepted: Collection[str]) -> bool:
        """Returns True if the run is stable, or has another judgement that the user accepts.

        For example, a user may accept "settled". A run with a broken energy balance or a
        changed log is never accepted.

        Args:
            accepted: Further judgements to accept: "settled" for a run that slowed down and
                whose pushes all died away, "bounded" for a bounded oscillation, "open" for a
                run that cannot be decided.
        """
        if self.verdict.finding is StabilityFinding.BROKEN:
            return False
        if not self.evidence.integrity.passed:
            return False
        if "bounded" in accepted and self.end.behaviour is EndBehaviour.BOUNDED:
            return True
        stability = self.decision.stability
        if "settled" in accepted and stability is Stability.SETTLED:
            return True
        if "open" in accepted and stability is Stability.OPEN:
            return True
        return stability is Stability.STABLE


def certify(
    log: Log,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
) -> Certificate:
    """Judges from a log whether a run was stable, and collects every reason.

    The log may be incomplete or empty. The run is not repeated with small disturbances, and the
    characteristic roots of its linearised loop are not computed. These checks can be added
    later.

    Args:
        log: The log of the run.
        min_coverage: Least fraction of the ticks of each site that must be recorded. With less,
            a run that would be stable is left open.
        own_laws: True to run the code of control laws that are not part of this program. This
            is necessary to check the energies that they declare.

    Raises:
        LogError: A record cannot be read, or names a change that is not valid.
    """
    run = gather_facts(log)
    facts = run.functional
    premises = check_premises(run)

    if facts is not None:
        verdicts = (judge(facts, premises) for judge in JUDGEMENTS)
        verdict = next(verdict for verdict in verdicts if verdict is not None)
        if not facts.groups:
            verdict = verdict._replace(tolerance=facts.tolerance)
    else:
        assert run.unknown is not None
        verdict = StabilityVerdict(StabilityFinding.NOT_JUDGED, run.unknown)

    certificate = Certificate(
        premises=premises,
        verdict=verdict,
        end=RunEnd.of_log(log),
        evidence=collect_evidence(run, min_coverage),
        observed=ObservedEnergy.of_log(log, own_laws=own_laws),
    )
    if facts is None:
        return certificate
    if facts.groups:  # without unique weights there is no balance of all sites
        return replace(certificate, groups=facts.groups, energies=facts.energies)

    paper_balance = None
    if not np.allclose(facts.balance.beta, 1.0):
        paper_balance = compute_energy_balance(facts.energies, paper_weights=True)
    return replace(
        certificate,
        balance=facts.balance,
        paper_balance=paper_balance,
        energies=facts.energies,
    )


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
        worst_site: _largest(energy.unexplained) for worst_site, energy in energies.items()
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

    The records are then false, so that nothing can be concluded from them. None if all agree.
    """
    for site, energy in run.energies.items():
        records = energy.motion.records
        error_nm = energy_terms.measure_torque_error(energy.motion)
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

    rise = _find_largest_rise(balance, run.tolerance)
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


def _find_largest_rise(balance: EnergyBalance, tolerance: float) -> FunctionalRise | None:
    """Finds the largest rise of the energy function V above an earlier minimum.

    The work of operators and environments is subtracted before, because V may rise by it. The
    sources of the remaining energy are also found.

    Args:
        balance: Energy balance of all sites.
        tolerance: Size that the rise must exceed, in J.

    Returns:
        The rise. None if it does not exceed the tolerance.
    """
    V = balance.unsupplied
    rise = rise_above_minimum(V)
    peak_row = int(rise.argmax())
    if rise[peak_row] <= tolerance:
        return None
    start_row = int(V[: peak_row + 1].argmin())

    # work of every source inside the loop: any of them may have caused the rise
    work_by_source = {}
    for name, work in balance.work.items():
        if name not in EXTERNAL_SOURCES:
            is_link = "->" in name
            work_by_source[name if is_link else f"the {name}"] = work
    work_by_source["sampling"] = balance.sampling
    work_by_source["what beta does not cancel"] = -balance.transfer

    causes = {}
    for name, work in work_by_source.items():
        causes[name] = float(work[peak_row] - work[start_row])
    least_amount = NOTABLE_CAUSE_SHARE * rise[peak_row]
    notable = {}
    for name in sorted(causes, key=causes.__getitem__, reverse=True):
        if causes[name] > least_amount:
            notable[name] = causes[name]

    return FunctionalRise(
        from_s=float(balance.t_s[start_row]),
        at_s=float(balance.t_s[peak_row]),
        amount=float(rise[peak_row]),
        causes=notable,
    )


def find_unsupplied_growth(balance: EnergyBalance, tolerance: float) -> list[UnsuppliedGrowth]:
    """Finds growths of the energy V that nobody supplied, although the run looks stable.

    V is the energy function of the stability proof, from which the work of operators and
    environments is subtracted here. Two rules are checked. First, V must not end above its
    beginning. Second, only the second half of the run is regarded: the rise from the minimum to
    the end must be at most half of the fall from the beginning of this half to the minimum.

    Args:
        balance: Energy balance of all arms.
        tolerance: Size that a rise must exceed to count, in J.

    Returns:
        The growth for each rule that is violated.
    """
    V = balance.unsupplied
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
            UnsuppliedGrowth(risen, from_s=float(balance.t_s[middle_row + lowest_row]))
        )
    return growths


def _functional_to_json(certificate: Certificate, balance: EnergyBalance) -> JsonObject:
    """Converts the results about the energy function V to plain values for JSON output.

    Args:
        certificate: The certificate.
        balance: Its energy balance, which must exist.
    """
    V = balance.V
    sites = certificate.energies

    paper_balance = certificate.paper_balance
    paper_json: JsonObject | None = None
    if paper_balance is not None:
        paper_json = {
            "v_first_j": float(paper_balance.V[0]),
            "v_max_j": float(paper_balance.V.max()),
            "rise": _rise_to_json(certificate.paper_weights_rise),
        }

    return {
        "beta_first": dict(zip(sites, balance.beta[0].tolist(), strict=True)),
        "beta_last": dict(zip(sites, balance.beta[-1].tolist(), strict=True)),
        "v_first_j": float(V[0]),
        "v_last_j": float(V[-1]),
        "v_max_j": float(V.max()),
        "parts_last_j": _last_values(balance.parts),
        "taken_j": _last_values(balance.dissipation),
        "given_j": _last_values(balance.work),
        "sampling_j": float(balance.sampling[-1]),
        "passed_on_j": float(balance.transfer[-1]),
        "scale_j": balance.scale,
        "residual_max_j": _largest(balance.residual),
        "unexplained_max_j": _largest(balance.unexplained),
        "sites_unexplained_max_j": {
            site: _largest(energy.unexplained) for site, energy in sites.items()
        },
        "not_judged_s": find_unjudged_spans(balance),
        "ones": paper_json,
    }


def _rise_to_json(rise: FunctionalRise | None) -> JsonObject | None:
    """Returns a rise of V as plain values, with the keys of the JSON output."""
    if rise is None:
        return None
    return {
        "from_s": rise.from_s,
        "at_s": rise.at_s,
        "amount_j": rise.amount,
        "causes_j": rise.causes,
    }


def _last_values(columns: dict[str, Array]) -> dict[str, float]:
    """Returns the value at the end of the run of each curve, by the name of the curve."""
    return {name: float(values[-1]) for name, values in columns.items()}


def _largest(values: Array) -> float:
    """Returns the largest absolute value."""
    return float(np.abs(values).max())

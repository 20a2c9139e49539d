"""Judges from a log whether the run was stable, and explains the verdict.

`Certificate.of_log` is the entry point, and `judge.certify_run` adds the repetitions of the run
and the characteristic roots. `stability_decision` decides from the evidence. A certificate
combines:

- the conditions (premises) of the stability theorem, which `premises` checks;
- the energy function V of the stability proof, which must not rise unless an operator or an
  environment supplied the energy;
- the motion at the end of the run, which `run_end` judges without any theory;
- repetitions of the run with small disturbances, if they were computed;
- the energies that control laws declare, which `observed_energy` checks;
- how complete the records are, and whether the log was modified.

Invariant:
    - The certificate names every question that a log cannot answer. If V does not exist, the
      verdict is based on the other evidence.
    - Keys of the JSON output end in their unit, and unknown values are null.
    - The package `presentation` generates every sentence on request.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from ...core import Array
from ...hooks import find_hook
from ...log import MIN_COVERAGE, Log
from ...results import JsonObject, Result, finite_or_none
from ..run_end import EndBehaviour, RunEnd, Stability
from ..run_remarks import RunCircumstances
from ..stability_decision import Doubt, LoopRoots, RunFindings, StabilityDecision
from ..twins.twin_growth import TwinGrowth
from .energy_balance import EnergyBalance, SiteEnergy
from .functional_judgements import JUDGEMENTS
from .observed_energy import ObservedEnergy
from .premise_quantities import Premise
from .premises import RunFacts
from .verdict_facts import Evidence, FunctionalRise, StabilityFinding, StabilityVerdict

_REFUTING_FINDINGS = ("negative", "broken")


@dataclass(frozen=True, repr=False)
class Certificate(Result):
    """Verdict on whether a recorded run was stable, with every reason. Created by `of_log`.

    A certificate combines several kinds of evidence: the energy function V of the stability
    proof, the end of the motion, the roots of the linearised loop, and repeated runs with a
    small push.

    Attributes:
        premises: The conditions of the stability theorem, each checked.
        verdict: Result of examining the energy function V.
        end: Verdict on the end of the run, from the errors e and the velocities qd only.
        evidence: How many records the certificate is based on, and whether the log was
            modified.
        balance: Energy balance of all sites, or `None` if V does not exist or the weights beta
            of the sites in V are not unique.
        paper_balance: Energy balance with the weights of the paper, which are 1 for every site.
            `None` if these are the correct weights, or if there is no balance.
        groups: Closed groups of sites, which follow no site outside their group. Empty unless
            there are several groups, in which case beta is not unique.
        energies: Energies of every site, keyed by site name. Empty if V does not exist.
        roots: Roots of the loop at the final pose of the run, or `None` if not computed.
        observed: Check of the energies that control laws declare, or `None` if no law declares
            any.
        twins: Growth of the effects of small pushes in repeated runs, or `None` if not
            computed.
        law_proofs: Phrases that name the stability conditions of control laws that hold at
            every site and prove that small motions decay. Empty if there are none.
        law_conditions: Sentences on the stability conditions of the control laws of the run.
        has_lasting_delays: True if delays that are constant in the run remain constant after
            the run.
        circumstances: Circumstances that readers of the verdict should know about, such as a
            motor at its torque limit. Empty if they were not examined.
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
    circumstances: RunCircumstances = field(default_factory=RunCircumstances)

    @classmethod
    def of_log(
        cls,
        log: Log,
        *,
        min_coverage: float = MIN_COVERAGE,
        own_laws: bool = False,
    ) -> "Certificate":
        """Judges from a log whether a run was stable, and collects all reasons for the verdict.

        The log may be incomplete or empty. The run is not repeated with small disturbances, and
        the characteristic roots of its linearised loop are not computed. These checks can be
        added later.

        Args:
            log: The log of the run.
            min_coverage: Smallest acceptable fraction of recorded ticks at each site. If the
                fraction is smaller, the verdict on a run that would otherwise be judged stable
                is "open".
            own_laws: True to execute the code of control laws that are not part of this
                program, which is necessary to check the energies that they declare.

        Raises:
            LogError: A record cannot be read, or contains an invalid change.
        """
        run = RunFacts.of_log(log)
        facts = run.functional
        premises = run.check_premises()

        if facts is not None:
            verdicts = (judge(facts, premises) for judge in JUDGEMENTS)
            verdict = next(verdict for verdict in verdicts if verdict is not None)
            if not facts.groups:
                verdict = verdict._replace(tolerance=facts.tolerance)
        else:
            assert run.unknown is not None
            verdict = StabilityVerdict(StabilityFinding.NOT_JUDGED, run.unknown)

        certificate = cls(
            premises=premises,
            verdict=verdict,
            end=RunEnd.of_log(log),
            evidence=run.collect_evidence(min_coverage),
            observed=ObservedEnergy.of_log(log, own_laws=own_laws),
        )
        if facts is None:
            return certificate
        if facts.groups:  # without unique weights there is no balance of all sites
            return replace(certificate, groups=facts.groups, energies=facts.energies)

        paper_balance = None
        if not np.allclose(facts.balance.beta, 1.0):
            paper_balance = EnergyBalance.of_energies(facts.energies, paper_weights=True)
        return replace(
            certificate,
            balance=facts.balance,
            paper_balance=paper_balance,
            energies=facts.energies,
        )

    @property
    def has_functional(self) -> bool:
        """True if the energy function V of the stability proof exists for the laws of this run.

        If V does not exist, reports and pages omit V and its terms.
        """
        laws = [premise.holds for premise in self.premises if premise.name == "law"]
        return laws != [False]

    @property
    def paper_weights_rise(self) -> FunctionalRise | None:
        """The largest rise that the total energy would have if all arms had the same weight.

        The paper on which the control law is based uses equal weights in the energy function of
        its stability proof. `None` if this energy does not rise, or was not computed.
        """
        if self.paper_balance is None:
            return None
        return self.paper_balance.find_largest_rise(self.verdict.tolerance)

    @property
    def bounded_by_v(self) -> bool:
        """True if the energy V of the stability proof bounds the motion of every arm.

        This requires that V did not rise and that every arm has a positive weight in V. The
        weight of an arm is zero if the arms that it follows do not follow it. The motion of an
        arm with zero weight is still bounded if the dominance factors are constant, and if all
        conditions of the stability theorem hold except the one on these factors. The arm then
        converges after the arms that it follows have converged.
        """
        did_not_rise = (StabilityFinding.COVERED, StabilityFinding.DID_NOT_RISE)
        if self.balance is None or self.verdict.finding not in did_not_rise:
            return False
        if (self.balance.beta > 0.0).all():
            return True
        failed = [premise.name for premise in self.premises if premise.holds is not True]
        constant = all(energy.motion.dominance.constant for energy in self.energies.values())
        return failed == ["shares"] and constant

    def accepts(self, accepted: Collection[str]) -> bool:
        """Returns True if the run is stable, or has another verdict that the user accepts.

        For example, a user may accept "settled". A run with a broken energy balance or a
        modified log is never accepted.

        Args:
            accepted: Further verdicts to accept: "settled" for a run that slowed down, and that
                recovered from every small push when it was repeated, "bounded" for a bounded
                oscillation, "open" for a run whose stability could not be determined.
        """
        if self.verdict.finding is StabilityFinding.BROKEN:
            return False
        if not self.evidence.log.integrity.passed:
            return False
        if "bounded" in accepted and self.end.behaviour is EndBehaviour.BOUNDED:
            return True
        stability = self.decision.stability
        if "settled" in accepted and stability is Stability.SETTLED:
            return True
        if "open" in accepted and stability is Stability.OPEN:
            return True
        return stability is Stability.STABLE

    @cached_property
    def decision(self) -> StabilityDecision:
        """The decision on whether the run is stable, with the evidence for it.

        The rules of `stability_decision` are applied to the motion at the end of the run, the
        repetitions with small pushes, the characteristic roots, the proofs of stability, and
        the findings that contradict a stable run. The decision is computed when first used.
        """
        findings = RunFindings(
            end=self.end,
            twins=self.twins,
            roots=self.roots,
            is_covered=self._is_covered,
            law_proofs=self.law_proofs,
            doubts=self._doubts,
            rises=self.verdict.finding is StabilityFinding.ROSE,
        )
        return findings.decide()

    @property
    def _is_covered(self) -> bool:
        """True if the stability theorem proves that the loop is stable.

        All of its premises must hold, constant delays must remain constant after the run, and V
        must not have risen.
        """
        covered = self.verdict.finding is StabilityFinding.COVERED
        all_hold = all(premise.holds is True for premise in self.premises)
        return covered and all_hold and self.has_lasting_delays

    @property
    def proofs(self) -> tuple[str, ...]:
        """Phrases that name the proofs of this loop's stability, apart from its roots.

        The stability theorem is a proof if all of its premises hold, constant delays remain
        constant after the run, and the energy V did not rise. The stability conditions of the
        control laws are a proof if all of them guarantee that all motions decay.
        """
        if not self._is_covered:
            return self.law_proofs
        return (str(find_hook("name the theorem")()), *self.law_proofs)

    @property
    def _doubts(self) -> tuple[Doubt, ...]:
        """Findings that contradict a stable run. Empty if there are none.

        Such findings are a rise of the energy function V, declared energies that are wrong or
        negative, and a damaged or incomplete log.
        """
        doubts: list[Doubt] = []
        if self.verdict.finding is StabilityFinding.BROKEN:
            doubts.append(self.verdict)
        elif self.balance is not None:
            doubts += self.balance.find_unsupplied_growth(self.verdict.tolerance)
        if self.observed is not None and self.observed.finding in _REFUTING_FINDINGS:
            doubts.append(self.observed)
        return (*doubts, *self.evidence.doubts)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences on all findings that rule out the verdict "stable".

        They cover the end of the run, the energy V, the roots at the final pose, the energies
        that control laws declare, and the completeness of the log. Empty for a stable run.
        """
        return self.decision.reasons

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on circumstances that readers of the verdict should know about.

        An example is a motor at its torque limit. See `run_remarks`.
        """
        return self.circumstances.remarks

    @property
    def stability(self) -> Stability:
        """The verdict on the run: stable, settled, not stable, or open.

        `stability_decision` explains how the findings lead to this verdict.
        """
        return self.decision.stability

    @property
    def passed(self) -> bool:
        """True if the run is judged stable, in the strict sense.

        A run that merely settled (its motion became slow) has not passed. `accepts` is less
        strict.
        """
        return self.accepts(())

    def headline(self) -> str:
        """Returns the verdict and the evidence for it as one line of text.

        An example is "stable: converged; rests on: exact roots, slowest -0.832 /s". The package
        `presentation` generates the line.
        """
        return str(find_hook("head a certificate")(self))

    def to_dict(self) -> JsonObject:
        """Converts the certificate to the plain values that `trilat certify --json` prints.

        docs/reference/json.md explains the most important keys. The entry "functional" is
        `None` if the energy function V cannot be computed.
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
            "roots": None if self.roots is None else self.roots.to_json(),
            "observed": None if self.observed is None else self.observed.to_json(),
            "twins": None if self.twins is None else self.twins.to_json(),
            "functional": None if balance is None else _functional_to_json(self, balance),
        }

    def to_rows(self) -> list[JsonObject]:
        """Returns the conditions (premises) of the stability theorem as table rows.

        Each row has the keys "name", "holds" and "text". `to_frame` converts the rows to a data
        frame.
        """
        return [premise.to_json() for premise in self.premises]


def _functional_to_json(certificate: Certificate, balance: EnergyBalance) -> JsonObject:
    """Converts the results on the energy function V to plain values for JSON output.

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
        "not_judged_s": balance.unjudged_spans,
        "ones": paper_json,
    }


def _rise_to_json(rise: FunctionalRise | None) -> JsonObject | None:
    """Converts a rise of V to plain values with the keys of the JSON output."""
    if rise is None:
        return None
    return {
        "from_s": rise.from_s,
        "at_s": rise.at_s,
        "amount_j": rise.amount,
        "causes_j": rise.causes,
    }


def _last_values(columns: dict[str, Array]) -> dict[str, float]:
    """Returns the value of each curve at the end of the run, by the name of the curve."""
    return {name: float(values[-1]) for name, values in columns.items()}


def _largest(values: Array) -> float:
    """Returns the largest absolute value of an energy over time, in J."""
    return float(np.abs(values).max())

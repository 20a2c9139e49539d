"""Decides whether a recorded or simulated run is stable, from all available evidence.

All commands of the program use this module and therefore reach the same decision. `certify_run`
judges the log of a run from three kinds of evidence: the energy function V of the stability
proof, repetitions of the run with small disturbances (twins), and the characteristic roots of
the linearised control loop. `VirtualRun` judges a simulated run without a log, such as one run
of a parameter sweep. To save computing time, it computes V only if V may change the decision.

Invariant:
    - All commands decide with `stability_decision.RunFindings.decide`, using roots from
      `loop_roots`.
"""

from dataclasses import replace
from functools import cached_property

import msgspec

from ..execution import FusedRun, SimulatedLog
from ..log import MIN_COVERAGE, Log
from ..scenario import Scenario
from .blas_threads import limit_blas_threads
from .certificate.observed_energy import ObservedEnergy
from .certificate.premise_quantities import MissingFunctional
from .certificate.stability_certificate import Certificate
from .run_end import RunEnd, Stability
from .run_remarks import RunCircumstances
from .stability_decision import LoopRoots, RunFindings, StabilityDecision
from .theory.loop_roots import find_log_roots, find_run_roots
from .theory.operating_point import has_lasting_delays
from .timeline import Timeline
from .twins.twin_growth import TwinGrowth


def list_law_proofs(scenario: Scenario) -> list[str]:
    """Lists the control laws' stability conditions, if they prove that all motions decay.

    The conditions are evaluated for the delays at the end of the scenario.

    Args:
        scenario: The scenario.

    Returns:
        One phrase per distinct condition. Empty if a change of the dominance factors is
        planned, or if the law of some site has no condition that proves the decay of all
        motions.
    """
    if any(change.dominance for change in scenario.timeline):
        return []
    links = {name: scenario.find_final_link(name) for name in scenario.links}
    final_scenario = msgspec.structs.replace(scenario, links=links, timeline=())
    proofs = []
    for _, law, situation in final_scenario.law_situations():
        condition = law.condition(situation)
        if condition is None or not condition.proves_decay:
            return []
        proofs.append(f"the condition of {law.tag}: {condition.text}")
    return list(dict.fromkeys(proofs))


@limit_blas_threads()
def certify_run(
    log: Log,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
    twins: int | None = None,
) -> Certificate:
    """Judges whether a recorded run was stable, using all available checks.

    In addition to the checks of `Certificate.of_log`, the run is repeated with small pushes,
    which shows whether disturbances grow. The characteristic roots of the coupled arms are
    computed at the final pose.

    Args:
        log: The log of the run.
        min_coverage: Smallest acceptable fraction of recorded ticks at each site.
        own_laws: True if the code of users' control laws may be executed.
        twins: Number of repeated runs with a push: `None` for enough to push each joint
            (`Push.choose`), 0 for none.

    Raises:
        LogError: A record cannot be read, or contains an invalid change.
    """
    certificate = Certificate.of_log(log, min_coverage=min_coverage, own_laws=own_laws)

    growth = None
    if twins != 0:
        growth = TwinGrowth.of_log(log, certificate.end, twins, own_laws=own_laws)

    final_scenario = Timeline(log).final_scenario
    roots = find_log_roots(log, own_laws=own_laws)
    conditions = final_scenario.describe_law_conditions(ticks_grow=roots.is_refutation)

    return replace(
        certificate,
        roots=roots,
        twins=growth,
        law_proofs=tuple(list_law_proofs(final_scenario)),
        law_conditions=tuple(conditions),
        has_lasting_delays=has_lasting_delays(final_scenario),
        circumstances=RunCircumstances.of_log(log),
    )


MAX_RECORDED_TICKS = 1_500_000
"""Largest number of ticks of all sites for which a simulated run is recorded for its energies.

The records of so many ticks need half a gigabyte of memory.
"""


class VirtualRun:
    """A simulated run without a log, with all evidence on whether the run is stable.

    Parameter sweeps use this class, because writing and reading a log for each run would take
    longer than the run. Each piece of evidence is computed when it is first needed.

    Args:
        scenario: Scenario of the run, whose duration may differ from that of the run.
        run: The run in the fused loop. The caller must not continue this run, because evidence
            that is computed later would then refer to a longer run.
        end: How the motion ends. If `None`, this is determined from the run.
    """

    def __init__(self, scenario: Scenario, run: FusedRun, end: RunEnd | None = None) -> None:
        # the run may have been longer or shorter than its scenario states
        self._scenario = scenario
        if run.diverged_s is None:
            self._scenario = msgspec.structs.replace(scenario, duration_s=run.ran_s)
        self._run = run
        self._end = end

    @cached_property
    def end(self) -> RunEnd:
        """How the motion of the arms ends."""
        if self._end is not None:
            return self._end
        return RunEnd.of_run(self._run, self._scenario)

    @cached_property
    def roots(self) -> LoopRoots:
        """Roots of the control loop at the end of the run."""
        return find_run_roots(self._scenario, self._run)

    @cached_property
    @limit_blas_threads()
    def twins(self) -> TwinGrowth | None:
        """How the effects of small pushes in repeated runs develop.

        The pushes are those of `Push.choose`. `None` if the roots and the motion at the end of
        the run are sufficient for the decision.
        """
        if self._findings.is_decided_by_roots:
            return None
        return TwinGrowth.of_scenario(self._scenario, self.end, self._run.ran_s)

    @cached_property
    def _findings(self) -> RunFindings:
        """The evidence on the run without twins and without energies."""
        return RunFindings(
            end=self.end, roots=self.roots, law_proofs=list_law_proofs(self._scenario)
        )

    @cached_property
    @limit_blas_threads()
    def decision(self) -> StabilityDecision:
        """The decision on whether the run is stable.

        The energies of a run may provide a proof of stability, or evidence against the verdict
        "settled". To compute the energies, the run is simulated again with a record of every
        tick. This is done only if the verdict would otherwise be "settled" or "open", if the
        control laws have an energy function V or declare energies, and if the run has at most
        `MAX_RECORDED_TICKS` ticks. Up to this number of ticks, the decision is the same as in a
        certificate of the run.
        """
        scenario = self._scenario
        decision = self._findings._replace(twins=self.twins).decide()
        # only energies, which need the records of the run, may change a weak decision
        is_weak = decision.stability in (Stability.SETTLED, Stability.OPEN)
        ticks_per_s = sum(site.rate_hz for site in scenario.sites.values())
        ticks = ticks_per_s * scenario.duration_s
        if not is_weak or ticks > MAX_RECORDED_TICKS or not _has_energies(scenario):
            return decision

        # Only a written log contains the memories from which laws compute declared energies.
        if ObservedEnergy.find_laws(scenario, own_laws=True):
            log: Log = SimulatedLog(scenario)
        else:
            log = FusedRun.simulate_log(scenario)
        certificate = replace(
            Certificate.of_log(log, own_laws=True),
            roots=self.roots,
            twins=self.twins,
            law_proofs=tuple(self._findings.law_proofs),
            has_lasting_delays=has_lasting_delays(scenario),
        )
        return certificate.decision


def _has_energies(scenario: Scenario) -> bool:
    """Returns True if a run has the energy function V, or energies that its laws declare."""
    has_functional = not MissingFunctional.list_of_scenario(scenario)
    return has_functional or bool(ObservedEnergy.find_laws(scenario, own_laws=True))

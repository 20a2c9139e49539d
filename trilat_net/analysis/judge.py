"""Decides whether a recorded or simulated run is stable, from all available evidence.

All commands of the program use this module and therefore reach the same decision. `certify_run`
judges the log of a run from three kinds of evidence: the energy function V of the stability
proof, repetitions of the run with small disturbances (twins), and the characteristic roots of
the linearised control loop. `judge_virtual_run` judges a simulated run without a log, such as
one run of a parameter sweep. To save computing time, it computes V only if V may change the
decision.

Invariant:
    - All commands decide with `analysis.stability_decision.decide_stability`, using roots from
      `loop_roots`.
"""

from dataclasses import replace
from typing import NamedTuple

import msgspec

from ..execution import FusedRun, SimulatedLog
from ..log import MIN_COVERAGE, Log
from ..scenario import Scenario
from .blas_threads import limit_blas_threads
from .certificate.observed_energy import ObservedEnergy
from .certificate.premise_quantities import MissingFunctional
from .certificate.stability_certificate import Certificate
from .decision_facts import LoopRoots, RunFindings, StabilityDecision
from .delay_period import find_final_link
from .run_end import RunEnd, Stability
from .run_remarks import RunCircumstances
from .stability_decision import decide_stability, is_decided_by_roots
from .theory.loop_roots import find_log_roots, find_run_roots, resolve_final_scenario
from .theory.operating_point import has_lasting_delays
from .twins.twin_growth import TwinGrowth


def list_law_proofs(scenario: Scenario) -> list[str]:
    """Lists the stability conditions of control laws that prove that all motions decay.

    The conditions are evaluated for the delays and dominance factors at the end of the
    scenario.

    Args:
        scenario: The scenario.

    Returns:
        One phrase per condition. Empty unless the condition of every site holds and is a proof.
    """
    if any(change.dominance for change in scenario.timeline):
        return []
    links = {name: find_final_link(scenario, name) for name in scenario.links}
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
    """Certifies whether a recorded run was stable, using all available checks.

    In addition to the checks of `Certificate.of_log`, the run is repeated with small pushes,
    which shows whether disturbances grow. The characteristic roots of the coupled arms are
    computed at the final pose.

    Args:
        log: The log of the run.
        min_coverage: Smallest acceptable fraction of recorded ticks at each site.
        own_laws: True if the code of users' control laws may be executed.
        twins: Number of repeated runs with a push. `None` for one push per joint, 0 for no
            repetition.

    Raises:
        LogError: A record cannot be read, or contains an invalid change.
    """
    certificate = Certificate.of_log(log, min_coverage=min_coverage, own_laws=own_laws)

    growth = None
    if twins != 0:
        growth = TwinGrowth.of_log(log, certificate.end, twins, own_laws=own_laws)

    final_scenario = resolve_final_scenario(log)
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


class _VirtualJudgement(NamedTuple):
    """Judgement whether a simulated run is stable, if the simulation wrote no log.

    Parameter sweeps use it, because writing and reading a log for each run would take longer
    than the run.

    Attributes:
        end: How the motion ends.
        roots: Roots of the loop at the end of the run.
        twins: How small pushes in repeated runs develop. `None` if the roots decide without
            them.
        decision: The decision.
    """

    end: RunEnd
    roots: LoopRoots
    twins: TwinGrowth | None
    decision: StabilityDecision


@limit_blas_threads()
def judge_virtual_run(
    scenario: Scenario, run: FusedRun, end: RunEnd | None = None
) -> _VirtualJudgement:
    """Judges a simulated run as its certificate would, without a log.

    Twins, one per joint, are executed only if they may change the decision. The run is repeated
    with all its records only if it has settled or is open, if its laws have an energy function
    V or declare energies, and if it has at most `MAX_RECORDED_TICKS` ticks. Energies, which
    require the records, may prove that the run is stable, or contradict that it settled.

    Args:
        scenario: Scenario of the run. Its duration may be shorter than that of the run.
        run: The run in the fused loop.
        end: How the motion ends. If `None`, this is determined from the run.
    """
    # the run may have been longer or shorter than its scenario states
    executed_scenario = scenario
    if run.diverged_s is None:
        executed_scenario = msgspec.structs.replace(scenario, duration_s=run.ran_s)
    if end is None:
        end = RunEnd.of_run(run, executed_scenario)
    findings = RunFindings(
        end=end,
        roots=find_run_roots(executed_scenario, run),
        law_proofs=list_law_proofs(executed_scenario),
    )
    twins = None
    if not is_decided_by_roots(findings):
        twins = TwinGrowth.of_scenario(executed_scenario, end, run.ran_s)
        findings = findings._replace(twins=twins)
    decision = decide_stability(findings)
    # only energies, which need the records of the run, may change a weak decision
    is_weak = decision.stability in (Stability.SETTLED, Stability.OPEN)
    ticks = (
        sum(site.rate_hz for site in executed_scenario.sites.values())
        * executed_scenario.duration_s
    )
    if is_weak and ticks <= MAX_RECORDED_TICKS and _has_energies(executed_scenario):
        # Only a written log contains the memories from which laws compute declared energies.
        if ObservedEnergy.find_laws(executed_scenario, own_laws=True):
            log: Log = SimulatedLog(executed_scenario)
        else:
            log = FusedRun.simulate_log(executed_scenario)
        certificate_of_log = Certificate.of_log(log, own_laws=True)
        certificate = replace(
            certificate_of_log,
            roots=findings.roots,
            twins=twins,
            law_proofs=tuple(findings.law_proofs),
            has_lasting_delays=has_lasting_delays(executed_scenario),
        )
        decision = certificate.decision
    assert findings.roots is not None
    return _VirtualJudgement(end, findings.roots, twins, decision)


def _has_energies(scenario: Scenario) -> bool:
    """Returns True if a run has the energy function V, or energies that its laws declare."""
    has_functional = not MissingFunctional.list_of_scenario(scenario)
    return has_functional or bool(ObservedEnergy.find_laws(scenario, own_laws=True))

"""Decides about the stability of recorded and simulated runs, with all that is known.

A recorded run is certified by V, the energy function of the stability proof, by twins, which
are repeated runs with a small push, and by the characteristic roots of its final loop. A
simulated run without a log, as in a sweep, is decided in the same way without V.

Invariant:
    - All commands decide by `analysis.stability_decision.decide_stability`, with roots from
      `loop_roots`.
"""

from dataclasses import replace

from ..analysis.certificate.stability_certificate import Certificate, certify
from ..analysis.run_end import RunEnd
from ..analysis.stability_decision import (
    LoopRoots,
    RunFindings,
    StabilityDecision,
    decide_stability,
)
from ..analysis.twin_growth import TwinGrowth, measure_twins
from ..log.accounting import MIN_COVERAGE
from ..log.log_reader import Log
from ..scenario import Scenario
from ..scenario.describe import describe_law_conditions, list_law_proofs
from .loop_roots import find_log_roots, resolve_final_scenario


def certify_run(
    log: Log,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
    twins: int | None = None,
) -> Certificate:
    """Certifies whether a recorded run was stable, with all available checks.

    In addition to the checks of `certify`, the run is repeated with small pushes, to see
    whether disturbances grow. The characteristic roots of the coupled arms are computed at the
    end pose.

    Args:
        log: The log of the run.
        min_coverage: Least fraction of the ticks (periods of the control loop) of each arm's
            process that must be recorded.
        own_laws: True if the code of users' control laws may be executed.
        twins: Number of repeated runs with a push. None for one of every joint, 0 for none.

    Raises:
        LogError: A record cannot be read, or names a change that does not exist.
    """
    certificate = certify(log, min_coverage=min_coverage, own_laws=own_laws)
    growth = None
    if twins != 0:
        growth = measure_twins(log, certificate.end, twins, own_laws=own_laws)
    final_scenario = resolve_final_scenario(log)
    return replace(
        certificate,
        roots=find_log_roots(log, own_laws=own_laws),
        twins=growth,
        law_proofs=tuple(list_law_proofs(final_scenario)),
        law_conditions=tuple(describe_law_conditions(final_scenario)),
    )


def decide_virtual_run(
    scenario: Scenario,
    end: RunEnd,
    roots: LoopRoots,
    twins: TwinGrowth | None = None,
) -> StabilityDecision:
    """Decides whether a simulated run is stable, as its certificate would.

    Args:
        scenario: Scenario of the run, with the duration of the run.
        end: How the motion ends.
        roots: Roots of the loop at the end of the run.
        twins: How small pushes in repeated runs develop. None if no run was repeated.
    """
    findings = RunFindings(
        end=end,
        twins=twins,
        roots=roots,
        proofs=list_law_proofs(scenario),
    )
    return decide_stability(findings)

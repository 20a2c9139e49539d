"""Decides whether a run is stable, settled, not stable, or open, for every command.

The decision combines all evidence on a run:

- how its motion ends, which `run_end` judges without any theory;
- how small pushes in repeated runs (twins) develop, which `twin_growth` measures;
- proofs that hold for its control loop: the stability theorem with all its premises, the
  stability condition of a control law, or the characteristic roots of the loop.

The four verdicts are:

- Stable: a proof exists for this loop, and the run does not contradict it.
- Settled: the run became slow or its motion was decaying (`run_end` defines the limits), and
  every push decayed, but there is no proof.
- Not stable: the run diverged, oscillates, drifts or grows, or its loop has an exact root with
  a positive real part, and no proof contradicts this.
- Open: everything else.

Invariant:
    - A run is called stable only with a proof. Without a proof and without twins, a run is
      open.
    - Roots count as a proof only if they are exact: delays are constant, or repeat after a
      known period over which the loop was analysed.
    - Exact roots in the left half-plane rule out the verdict "not stable", except for a run in
      which an arm exceeded its limits. Roots from numerical derivatives rule it out if the
      motion at the end of the run may be their slow decay.
    - A decision names the evidence on which it is based.
    - Twins never change a decision for which `is_decided_by_roots` is true. A command may
      therefore skip them.
"""

import math

from .decision_facts import Basis, Obstacle, RunFindings, StabilityDecision
from .run_end import EndBehaviour, Stability
from .site_signals import SETTLED_ERROR_RAD
from .twins.envelope_trend import FLOOR_RAD, EnvelopeTrend
from .twins.twin_growth import DOUBLES

NEAR_REST_RAD = 0.02
"""Largest distance of a run from a pose of rest at which unstable roots of that pose refute the
run, in rad.

A run that is further away may come to rest in another pose, whose roots may be stable.
"""
LEAST_BURSTS = 100.0
"""Number of bursts of lost samples above which their mean effect decides how a run ends."""
_FALLING = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
_LONGEST_ADVISED_S = 1e4
"""Length of the longest run that is advised, in s. The estimate of a longer one rests on a root
so small that its value means little.
"""
_UNTREND_ENDS = (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED)


def decide_stability(run: RunFindings) -> StabilityDecision:
    """Decides from all evidence whether a run is stable, settled, not stable, or open.

    The docstring of the module defines these verdicts.

    Args:
        run: All evidence on the run.
    """
    obstacles = _list_obstacles(run)
    decision = _decide_by_roots(run, obstacles)
    if decision is not None:
        return decision

    end = run.end
    refutation = _find_refutation(run)
    if refutation is not None:
        stability = Stability.OPEN if end.operator_acts else Stability.NOT_STABLE
        return StabilityDecision(stability, run, refutation, obstacles)

    if run.has_proof and not obstacles and _agrees_with_proof(run):
        return StabilityDecision(Stability.STABLE, run, "proofs")
    looks_unstable = end.stability is Stability.NOT_STABLE
    if looks_unstable and run.proven_by_roots != "stable" and not _is_end_excused(run):
        return StabilityDecision(Stability.NOT_STABLE, run, "end")
    if not obstacles and _has_settled(run):
        return StabilityDecision(Stability.SETTLED, run, "dying pushes")
    if obstacles:
        return StabilityDecision(Stability.OPEN, run, obstacles=obstacles)
    needed_s = _estimate_needed_s(run)
    if run.has_proof and needed_s is not None and needed_s > end.lasts_s:
        advised_s = needed_s if needed_s <= _LONGEST_ADVISED_S else None
        return StabilityDecision(
            Stability.OPEN, run, obstacles=("short record",), advised_s=advised_s
        )
    return StabilityDecision(Stability.OPEN, run, obstacles=(_explain_open(run),))


def is_decided_by_roots(run: RunFindings) -> bool:
    """Returns True if twins cannot change the decision and therefore need not be executed.

    This is the case if the run diverged, or if its exact roots and its end agree.

    Args:
        run: The evidence on the run, excluding twins.
    """
    return _decide_by_roots(run, _list_obstacles(run)) is not None


def _list_obstacles(run: RunFindings) -> tuple[Obstacle, ...]:
    """Lists the findings that prevent the judgements "stable" and "settled", in order.

    Such findings concern the end of the run, missing records, runs with small pushes, doubts of
    other analyses, and roots that show growth.

    Args:
        run: Findings of the analyses on the run.
    """
    obstacles: list[Obstacle] = []
    if run.end.doubts:
        obstacles.append("end")
    if run.end.missing_sites:
        obstacles.append("missing records")
    twins = run.twins
    if twins is not None and twins.hides_period and not run.has_proof:
        obstacles.append("hidden period")
    if run.doubts:
        obstacles.append("doubts")
    roots = run.roots
    if roots is not None and roots.verdict == "unstable":
        # Twins repeat the recorded ticks. Roots that are not exact do not count if the twins
        # exclude growth at their rate.
        excluded_per_s = math.inf if twins is None else twins.excluded_rate_per_s
        is_excluded = roots.rate_per_s is not None and roots.rate_per_s > excluded_per_s
        if roots.exact or not is_excluded:
            obstacles.append("growing roots")
    return tuple(obstacles)


def _decide_by_roots(
    run: RunFindings, obstacles: tuple[Obstacle, ...]
) -> StabilityDecision | None:
    """Decides whether a run is stable from its end and its exact roots alone.

    The roots are growth rates of small motions, computed from the linearised control loop. If
    all of them are negative, small motions die away.

    Args:
        run: Everything that is known about the run.
        obstacles: Names of the findings that prevent a stable run.

    Returns:
        The decision. `None` if twins may change it.
    """
    end = run.end
    if end.behaviour is EndBehaviour.DIVERGED:
        return StabilityDecision(Stability.NOT_STABLE, run, "divergence", ("divergence",))
    if run.roots is None:
        return None

    is_near_rest = run.roots.distance_rad <= NEAR_REST_RAD
    looks_unstable = end.stability is Stability.NOT_STABLE
    if run.proven_by_roots == "unstable" and (is_near_rest or looks_unstable):
        stability = Stability.OPEN if end.operator_acts else Stability.NOT_STABLE
        return StabilityDecision(stability, run, "roots", obstacles)
    if run.proven_by_roots != "stable":
        return None
    if obstacles:
        return StabilityDecision(Stability.OPEN, run, obstacles=obstacles)
    # Pushes of a run that rests where its loop is stable die away in the end, even if they
    # still grow in the transient before the rest.
    if is_near_rest and end.behaviour is EndBehaviour.CONVERGED:
        return StabilityDecision(Stability.STABLE, run, "proofs")
    return None


def _find_refutation(run: RunFindings) -> Basis | None:
    """Returns the evidence that small motions grow. `None` if there is no evidence.

    Unstable exact roots of a distant pose of rest are evidence if the run is shorter than the
    period of its delays, because such a run does not show where its motion ends. The growth of
    pushes is not evidence in two cases: if the run slows down, because the run then approaches
    its twins, and if exact roots are stable.
    """
    end = run.end
    twins = run.twins
    if twins is None:
        return None
    if run.proven_by_roots == "unstable" and twins.hides_period:
        return "roots"
    if not twins.pushes or run.proven_by_roots == "stable":
        return None
    is_slowing = end.speed.trend in _FALLING and end.end_speed_rad_s > FLOOR_RAD
    departs = twins.departure is not None and end.behaviour is not EndBehaviour.COASTS
    grows = twins.grows and not is_slowing and not twins.hides_period
    return "growing pushes" if grows or departs else None


def _agrees_with_proof(run: RunFindings) -> bool:
    """Returns True if neither the end of a run nor its repetitions contradict a proof.

    A repetition, a twin, has a small push. A run that is shorter than the period of its delays
    does not contradict a proof, because its motion may be part of a beat.
    """
    end = run.end
    twins = run.twins
    if twins is None or not twins.pushes:
        return end.stability is Stability.SETTLED
    if twins.hides_period or twins.trend in _FALLING:
        return True
    is_calm = end.stability is Stability.SETTLED or end.behaviour is EndBehaviour.HARDLY
    if is_calm and twins.trend is not EnvelopeTrend.GROWS:
        return True
    return _confirms_slowest_root(run)


def _confirms_slowest_root(run: RunFindings) -> bool:
    """Returns True if the slowest push decays at the rate that the slowest root predicts.

    A push is a small disturbance in a repetition of the run, and a root the growth rate of
    small motions. In this case a push without a clear trend agrees with the roots: the push
    merely decays slowly.
    """
    worst = None if run.twins is None else run.twins.worst
    if worst is None or run.roots is None or run.proven_by_roots != "stable":
        return False
    return worst.rate_per_s < 0.0 and run.roots.measure_rate_misfit(worst.rate_per_s) <= 1.0


def _is_end_excused(run: RunFindings) -> bool:
    """Returns True if pushes or roots show that an unstable-looking end is no evidence.

    The cases are:

    - Stable roots by numerical derivatives: the end may be their slow decay.
    - All pushes die away.
    - The judged part of the run is shorter than the period of its delays, and may show a beat.
    - No push grows clearly, and the judged part has few bursts of lost samples. It may
      therefore show the effect of the last burst.
    - The run seems to grow, but no push grows and the energy function V did not rise.
    """
    if run.roots is not None and run.roots.measure_decay_misfit(run.end) <= 1.0:
        return True
    twins = run.twins
    if twins is None or not twins.pushes:
        return False
    if twins.trend is EnvelopeTrend.DECAYS or twins.hides_period:
        return True
    if twins.judged_bursts < LEAST_BURSTS and not twins.grows:
        return True
    end_grows = run.end.behaviour is EndBehaviour.GROWS
    return end_grows and twins.trend is not EnvelopeTrend.GROWS and not run.rises


def _has_settled(run: RunFindings) -> bool:
    """Returns True if a run became slow, or was decaying, and every push died away.

    This judgement is weaker than stable: it rests on the recorded motion and on runs with small
    pushes, but not on a proof.

    Args:
        run: Findings of the analyses on the run.
    """
    end = run.end
    twins = run.twins
    if twins is None or not twins.pushes or twins.trend is not EnvelopeTrend.DECAYS:
        return False
    if end.stability is Stability.SETTLED:
        return True
    # A run without a trend counts as settled if its arms are too slow to move noticeably.
    judged_s = twins.to_s - twins.from_s
    travel_rad = end.end_speed_rad_s * judged_s
    return end.behaviour in _UNTREND_ENDS and travel_rad <= SETTLED_ERROR_RAD


def _explain_open(run: RunFindings) -> Obstacle:
    """Returns why the stability of a run stays open although nothing contradicts it.

    Several reasons may apply. The first of them is returned, in the order from proofs that
    disagree with the run to an end of the run that does not decide.

    Args:
        run: Findings of the analyses on the run.
    """
    if run.has_proof:
        return "disputed proof"
    if run.roots is not None and run.roots.measure_decay_misfit(run.end) <= 1.0:
        return "slow decay"
    if run.twins is None:
        return "missing pushes"
    if not run.twins.pushes:
        return "unjudged pushes"
    if run.end.stability is Stability.SETTLED:
        return "unclear pushes"
    if run.twins.judged_bursts < LEAST_BURSTS:
        return "few bursts"
    return "unclear end"


def _estimate_needed_s(run: RunFindings) -> float | None:
    """Returns how long a run must be for its slowest motion to decay clearly, in s.

    The motion decays freely only after the last action of an operator and the last change of a
    setting.
    """
    roots = run.roots
    if roots is None or roots.rate_per_s is None or not roots.rate_per_s < 0.0:
        return None
    decay_s = 8.0 * math.log(DOUBLES) / -roots.rate_per_s
    needed_s = run.end.quiet_from_s + decay_s
    # Pushes that show no clear trend yet may need a longer run.
    pushes_need_s = None if run.twins is None else run.twins.needs_s
    return needed_s if pushes_need_s is None else max(needed_s, pushes_need_s)

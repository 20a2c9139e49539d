"""Decides whether a run is stable, settled, not stable, or open, for every command.

The decision combines what is known about a run:

- how its motion ends, which `run_end` judges without any theory;
- how small pushes in repeated runs (twins) develop, which `twin_growth` measures;
- proofs that hold for its control loop: the stability theorem with all its premises, the
  stability condition of a control law, or the characteristic roots of the loop.

The words mean:

- Stable: a proof exists for this loop, and the run does not contradict it.
- Settled: the run became slow or its motion was decaying (`run_end` has the limits), and every
  push died away, but nothing proves more.
- Not stable: the run diverged, oscillates, drifts or grows, or its loop has an exact root with
  a positive real part, and no proof says otherwise.
- Open: everything else.

Invariant:
    - Stable is said only with a proof. Without a proof and without twins, a run is open.
    - Roots count as a proof only if they are exact: delays are constant, or repeat after a
      known period over which the loop was analysed.
    - Exact roots in the left half-plane exclude the word "not stable", except for a run that
      left its limits. Numerical roots exclude it if the end of the run may be their slow decay.
    - A decision states what it rests on.
    - Twins never change a decision that `is_decided_by_roots` announces, so that a command may
      save them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..errors import count_nouns
from .run_end import EndBehaviour, RunEnd, Stability
from .site_signals import SETTLED_ERROR_RAD
from .twins.envelope_trend import FLOOR_RAD, EnvelopeTrend
from .twins.twin_growth import DOUBLES, TwinGrowth

NEAR_REST_RAD = 0.02
"""Largest distance of a run from a rest whose unstable roots refute the run, in rad.

A run that is further away may come to rest in another pose, whose roots may be stable.
"""
RATE_AGREEMENT_SHARE = 0.25
"""Largest difference between the rates of a push and of the slowest root, as a share."""
RATE_AGREEMENT_PER_S = 2e-4
"""Difference of these rates that always confirms the root, in 1/s."""
LEAST_BURSTS = 100.0
"""Number of bursts of lost samples from which on their mean effect decides how a run ends."""
_FALLING = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
_LONGEST_ADVISED_S = 1e4
"""Length of the longest run that is advised, in s. The estimate of a longer one rests on a root
so small that its value means little.
"""
_UNTREND_ENDS = (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED)


class LoopRoots(NamedTuple):
    """Growth rates (roots) of small motions about the pose at which a run ended.

    They are characteristic roots of the linearised control loop. If the real parts of all of
    them are negative, small motions die away. `theory.loop_roots` computes them for every
    command.

    Attributes:
        verdict: "stable", "unstable" or "at the edge", for small motions. Empty if the loop
            cannot be linearised.
        rate_per_s: Largest real part of the roots, in 1/s, without those that are zero because
            of the structure of the loop. None if there is no such root.
        exact: True if the loop was analysed with its ticks and its repeating delays. Otherwise
            the roots may cast doubt on a run, but prove nothing.
        text: The pose and its roots, or the reason why there are no roots.
        distance_rad: Largest difference between the last angle of a joint and its angle at the
            pose at rest to which the roots belong, in rad.
        leaves_out: What the linearised loop leaves out, as a phrase, for example "how the
            program at m2 reacts to the arms". Empty if it contains everything.
        is_numerical: True if the code of a user's law was differentiated numerically. Such
            roots can refute a run, but not prove it stable.
        swing_rate_per_s: Largest real part of the computed roots that oscillate, in 1/s. None
            if no computed root oscillates.
    """

    verdict: str
    rate_per_s: float | None
    exact: bool
    text: str
    distance_rad: float = 0.0
    leaves_out: str = ""
    is_numerical: bool = False
    swing_rate_per_s: float | None = None

    @property
    def is_proof(self) -> bool:
        """True if the roots (growth rates) prove that small motions about the final pose decay.

        Only exact roots prove it: those of a loop with its ticks and its repeating delays.
        """
        return self.exact and self.verdict == "stable"

    def describe_as_basis(self) -> str:
        """Returns the phrase that a decision shows after "rests on:" if these roots decide.

        For example "exact roots, slowest -0.832 /s": the mode that decays most slowly has the
        rate of -0.832 per second. If the roots refute stability, the fastest growing mode is
        named instead. Without a root that is not zero, the phrase has no rate.
        """
        name = "roots by numerical derivatives" if self.is_numerical else "exact roots"
        if self.rate_per_s is None:
            return name
        decisive = "fastest growing" if self.is_refutation else "slowest"
        return f"{name}, {decisive} {self.rate_per_s:+.3g} /s"

    @property
    def is_refutation(self) -> bool:
        """True if the roots (growth rates) prove that small motions about the final pose grow.

        Only exact roots prove it: those of a loop with its ticks and its repeating delays.
        """
        return self.exact and self.verdict == "unstable"

    def measure_decay_misfit(self, end: RunEnd) -> float:
        """Measures how badly the slow decay of these roots explains an end that looks lasting.

        An oscillation is compared with the roots that oscillate, because another slow root does
        not explain the oscillation, and a drift with the slowest root. The decay is compatible
        if the root halves the motion at most once in the judged part, so that no trend can show
        the decay, or if |e| and |qd| have the rate of the root.

        Args:
            end: How the motion ends.

        Returns:
            A share without unit: at most 1 if the end may be the decay, infinity if the roots
            are not numerical or not stable, or if the motion grows or is not lasting.
        """
        is_swing = end.behaviour is EndBehaviour.BOUNDED
        is_lasting = is_swing or end.behaviour is EndBehaviour.DRIFTS
        rate_per_s = self.swing_rate_per_s if is_swing else self.rate_per_s
        is_stable = self.is_numerical and self.verdict == "stable"
        if rate_per_s is None or not is_stable or not is_lasting:
            return math.inf

        misfits = []
        for fit in (end.error, end.speed):
            if fit.trend is EnvelopeTrend.GROWS:
                return math.inf
            misfits.append(_measure_rate_misfit(fit.rate_per_s, rate_per_s))

        judged_s = 0.5 * (end.lasts_s - end.counts_from_s)
        halvings = -rate_per_s * judged_s / math.log(DOUBLES)
        return min(halvings, max(misfits))


class StabilityDecision(NamedTuple):
    """Decision whether a run of coupled arms is stable, with the evidence for it.

    Attributes:
        stability: The decision.
        rests_on: What the decision rests on, as a phrase for the user.
        reasons: Sentences that prevent a better decision. Empty if the run is stable.
        is_too_short: True if only the length of the record prevents a better decision.
    """

    stability: Stability
    rests_on: str
    reasons: tuple[str, ...] = ()
    is_too_short: bool = False


class RunFindings(NamedTuple):
    """All evidence on the stability of a run, from which `decide_stability` decides.

    Attributes:
        end: How the motion ends.
        twins: How small pushes in repeated runs develop. None if no run was repeated.
        roots: Roots of the loop at the end of the run. None if they were not computed.
        proofs: Phrases that name further proofs for this loop, such as the stability theorem.
        doubts: Sentences on findings that contradict a stable run, such as an energy function
            that rises, or missing records.
        rises: True if the energy function V of the stability proof rose by energy that nobody
            supplied.
    """

    end: RunEnd
    twins: TwinGrowth | None = None
    roots: LoopRoots | None = None
    proofs: Sequence[str] = ()
    doubts: Sequence[str] = ()
    rises: bool = False

    @property
    def all_proofs(self) -> list[str]:
        """Phrases that name every proof that the control loop is stable, exact roots last.

        Empty if there is no proof. The texts appear after "rests on:".
        """
        proofs = list(self.proofs)
        if self.has_stable_roots:
            assert self.roots is not None
            proofs.append(self.roots.describe_as_basis())
        return proofs

    @property
    def has_stable_roots(self) -> bool:
        """True if the exact roots (growth rates) of the loop prove that small motions die away.

        Roots that are not exact never count as a proof.
        """
        return self.roots is not None and self.roots.is_proof


def decide_stability(run: RunFindings) -> StabilityDecision:
    """Decides from all evidence whether a run is stable, settled, not stable, or open.

    The module's docstring defines these words.

    Args:
        run: Everything that is known about the run.
    """
    reasons = _list_reasons(run)
    decision = _decide_by_roots(run, reasons)
    if decision is not None:
        return decision

    run_end = run.end
    refutation = _find_refutation(run)
    if refutation:
        stability = Stability.OPEN if run_end.operator_acts else Stability.NOT_STABLE
        return StabilityDecision(stability, refutation, reasons)

    proofs = run.all_proofs
    if proofs and not reasons and _agrees_with_proof(run):
        return StabilityDecision(Stability.STABLE, "; ".join(proofs))
    looks_unstable = run_end.stability is Stability.NOT_STABLE
    if looks_unstable and not run.has_stable_roots and not _is_end_excused(run):
        # The frequency of an oscillation is known only if all records are.
        end_text = run_end._replace(frequency_hz=None).text
        return StabilityDecision(Stability.NOT_STABLE, f"the end of the run: {end_text}")
    if not reasons and _has_settled(run):
        return StabilityDecision(Stability.SETTLED, _describe_pushes(run))
    if reasons:
        return StabilityDecision(Stability.OPEN, "", reasons)
    needed_s = _estimate_needed_s(run)
    if run.all_proofs and needed_s is not None and needed_s > run_end.lasts_s:
        reason = "the run is too short to tell; try one of twice its length"
        if needed_s <= _LONGEST_ADVISED_S:
            reason = f"the run is too short to tell; a run of {needed_s:.3g} s would"
        return StabilityDecision(Stability.OPEN, "", (reason,), is_too_short=True)
    return StabilityDecision(Stability.OPEN, "", (_explain_open(run),))


def is_decided_by_roots(run: RunFindings) -> bool:
    """Returns True if twins cannot change the decision, so that they need not be executed.

    This is so if the run diverged, or if its exact roots and its end agree.

    Args:
        run: What is known about the run without twins.
    """
    return _decide_by_roots(run, _list_reasons(run)) is not None


def _list_reasons(run: RunFindings) -> tuple[str, ...]:
    """Lists the sentences that prevent the judgements "stable" and "settled", in order.

    They come from the end of the run, from missing records, from the runs with small pushes,
    from doubts about the analyses, and from roots that show growth.

    Args:
        run: What the analyses found about the run.
    """
    reasons = [*run.end.reasons]
    reasons += [f"no record of {site}" for site in run.end.missing_sites]
    twins = run.twins
    if twins is not None and twins.hides_period and not run.all_proofs:
        reasons.append(twins.period_text)
    reasons += run.doubts
    roots = run.roots
    if roots is not None and roots.verdict == "unstable":
        # Twins repeat the recorded ticks. Roots that are not exact do not count if the twins
        # exclude growth at their rate.
        excluded_per_s = math.inf if twins is None else twins.excluded_rate_per_s
        is_excluded = roots.rate_per_s is not None and roots.rate_per_s > excluded_per_s
        if roots.exact or not is_excluded:
            reasons.append(roots.text)
    return tuple(reasons)


def _decide_by_roots(run: RunFindings, reasons: tuple[str, ...]) -> StabilityDecision | None:
    """Decides whether a run is stable from its end and its exact roots alone.

    The roots are growth rates of small motions, computed from the linearised control loop. If
    all of them are negative, small motions die away.

    Args:
        run: Everything that is known about the run.
        reasons: Sentences that prevent a stable run.

    Returns:
        The decision. None if twins may change it.
    """
    end = run.end
    if end.behaviour is EndBehaviour.DIVERGED:
        return StabilityDecision(Stability.NOT_STABLE, end.text, (end.text,))
    roots = run.roots
    if roots is None or not roots.exact:
        return None

    is_near_rest = roots.distance_rad <= NEAR_REST_RAD
    looks_unstable = end.stability is Stability.NOT_STABLE
    if roots.is_refutation and (is_near_rest or looks_unstable):
        stability = Stability.OPEN if end.operator_acts else Stability.NOT_STABLE
        return StabilityDecision(stability, roots.describe_as_basis(), reasons)
    if not roots.is_proof:
        return None
    if reasons:
        return StabilityDecision(Stability.OPEN, "", reasons)
    # Pushes of a run that rests where its loop is stable die away in the end, even if they
    # still grow in the transient before the rest.
    if is_near_rest and end.behaviour is EndBehaviour.CONVERGED:
        return StabilityDecision(Stability.STABLE, "; ".join(run.all_proofs))
    return None


def _find_refutation(run: RunFindings) -> str:
    """Returns the evidence that small motions grow. Empty if there is none.

    Unstable exact roots of a distant rest are evidence if the run is shorter than the period of
    its delays, because such a run cannot show by itself where it ends. The growth of pushes is
    no evidence if the run slows down, because the run then approaches its twins, or if exact
    roots are stable.
    """
    end = run.end
    twins = run.twins
    if twins is None:
        return ""
    if run.roots is not None and run.roots.is_refutation and twins.hides_period:
        return run.roots.describe_as_basis()
    if not twins.pushes or run.has_stable_roots:
        return ""
    is_slowing = end.speed.trend in _FALLING and end.end_speed_rad_s > FLOOR_RAD
    departs = twins.departure is not None and end.behaviour is not EndBehaviour.COASTS
    grows = twins.grows and not is_slowing and not twins.hides_period
    return twins.text if grows or departs else ""


def _agrees_with_proof(run: RunFindings) -> bool:
    """Returns True if neither the end of a run nor its repetitions contradict a proof.

    A repetition, a twin, has a small push. A run that is shorter than the period of its delays
    contradicts nothing: it may show a beat.
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
    small motions. A push that shows no clear trend then agrees with the roots: it merely decays
    slowly.
    """
    roots = run.roots
    worst = None if run.twins is None else run.twins.worst
    if worst is None or roots is None or not roots.is_proof or roots.rate_per_s is None:
        return False
    if not worst.rate_per_s < 0.0:
        return False
    return _measure_rate_misfit(worst.rate_per_s, roots.rate_per_s) <= 1.0


def _measure_rate_misfit(measured_per_s: float, root_per_s: float) -> float:
    """Returns the difference of a measured rate and a root, divided by its tolerance."""
    tolerance_per_s = RATE_AGREEMENT_SHARE * abs(root_per_s) + RATE_AGREEMENT_PER_S
    return abs(measured_per_s - root_per_s) / tolerance_per_s


def _is_end_excused(run: RunFindings) -> bool:
    """Returns True if pushes or roots show that an end that looks not stable is no evidence.

    The cases are:

    - Stable roots by numerical derivatives: the end may be their slow decay.
    - All pushes die away.
    - The judged part of the run is shorter than the period of its delays, so that it may show a
      beat.
    - No push grows clearly, and the judged part has few bursts of lost samples, so that it may
      show the effect of the last burst.
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
    pushes, but on no proof.

    Args:
        run: What the analyses found about the run.
    """
    end = run.end
    twins = run.twins
    if twins is None or not twins.pushes or twins.trend is not EnvelopeTrend.DECAYS:
        return False
    if end.stability is Stability.SETTLED:
        return True
    # A run without a trend counts if its arms are too slow to get anywhere.
    judged_s = twins.to_s - twins.from_s
    travel_rad = end.end_speed_rad_s * judged_s
    return end.behaviour in _UNTREND_ENDS and travel_rad <= SETTLED_ERROR_RAD


def _describe_pushes(run: RunFindings) -> str:
    """Returns the basis of a settled run: the number of pushes, and why nothing proves more.

    For example "8 pushes over 12 s, all of which died away; its roots are not exact".
    """
    assert run.twins is not None
    pushes = len({growth.push.name for growth in run.twins.pushes})
    duration_s = run.twins.to_s
    ending = "all of which died away" if pushes > 1 else "which died away"
    text = f"{count_nouns(pushes, 'push', 'pushes')} over {duration_s:.4g} s, {ending}"
    roots = run.roots
    if roots is None:
        return text
    if not roots.verdict:
        return f"{text}; {roots.text}"
    if roots.leaves_out:
        return f"{text}; pushes and roots leave out {roots.leaves_out}"
    if not roots.exact:
        return f"{text}; its roots are not exact"
    return text


def _explain_open(run: RunFindings) -> str:
    """Returns the reason why the stability of a run stays open although nothing contradicts it.

    Several reasons may apply. The first that applies is stated, from proofs that disagree with
    the run to an end of the run that does not settle the question.

    Args:
        run: What the analyses found about the run.
    """
    if run.all_proofs:
        return "the end of the run does not agree with its proof"
    if run.roots is not None and run.roots.measure_decay_misfit(run.end) <= 1.0:
        lasting = "drift" if run.end.behaviour is EndBehaviour.DRIFTS else "oscillation"
        return (
            f"too slow to be told from a lasting {lasting} in the judged part; its numerical "
            f"roots decay at {run.roots.rate_per_s:.3g} /s"
        )

    if run.twins is None:
        return "no proof exists, and no run with small pushes was made"
    if not run.twins.pushes:
        return f"no proof exists, and no pushes were judged: {run.twins.why}"

    if run.end.stability is Stability.SETTLED:
        return run.twins.text
    if run.twins.judged_bursts < LEAST_BURSTS:
        bursts = f"{run.twins.judged_bursts:.2g} bursts of lost samples"
        return f"{run.end.text}; the judged part has {bursts}, too few for an average"
    return run.end.text


def _estimate_needed_s(run: RunFindings) -> float | None:
    """Returns how long a run must be so that its slowest motion decays clearly, in s.

    The motion decays by itself only after the last action of an operator and the last change of
    a setting.
    """
    roots = run.roots
    if roots is None or roots.rate_per_s is None or not roots.rate_per_s < 0.0:
        return None
    decay_s = 8.0 * math.log(DOUBLES) / -roots.rate_per_s
    needed_s = run.end.quiet_from_s + decay_s
    # Pushes that show no clear trend yet may need a longer run.
    pushes_need_s = None if run.twins is None else run.twins.needs_s
    return needed_s if pushes_need_s is None else max(needed_s, pushes_need_s)

"""Decides whether a run is stable, settled, not stable, or open, for every command.

The decision combines all evidence on a run:

- how its motion ends, which `run_end` judges without any theory;
- how the effects of small pushes in repeated runs (twins) develop, which `twin_growth`
  measures;
- proofs that hold for its control loop: the stability theorem with all its premises, the
  stability condition of a control law, or the characteristic roots of the loop.

The four verdicts are:

- Stable: a proof exists for this loop, and the run does not contradict it.
- Settled: the run became slow or its motion was decaying (`run_end` defines the limits), and
  the effect of every push decayed, but there is no proof.
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
    - Twins never change a decision for which `RunFindings.is_decided_by_roots` is true. A
      command may therefore skip them.
    - A decision and its evidence contain only names and numeric values, apart from phrases that
      the control laws and the analysis of roots provide. The package `presentation` generates
      the sentences.
    - Every member of `Basis` and `Obstacle` refers to values in the evidence, `RunFindings`.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from ..hooks import find_hook
from ..results import JsonObject
from .certificate.observed_energy import ObservedEnergy
from .certificate.verdict_facts import EvidenceDoubt, StabilityVerdict, UnsuppliedGrowth
from .run_end import EndBehaviour, RunEnd, Stability
from .site_signals import SETTLED_ERROR_RAD
from .twins.envelope_trend import FLOOR_RAD, EnvelopeTrend
from .twins.twin_growth import DOUBLES, TwinGrowth

NEAR_REST_RAD = 0.02
"""Largest distance of a run from a pose of rest at which unstable roots of that pose show that
the run is not stable, in rad.

A run that is further away may come to rest in another pose, whose roots may be stable.
"""
LEAST_BURSTS = 100.0
"""Number of bursts of lost samples above which their mean effect determines how a run ends."""
_FALLING = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
_LONGEST_ADVISED_S = 1e4
"""Length of the longest run that is advised, in s. The estimate of a longer one rests on a root
so small that its value means little.
"""
_UNTREND_ENDS = (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED)
_RATE_AGREEMENT_SHARE = 0.25
"""Largest relative difference at which the rates of a push and of the slowest root agree."""
_RATE_AGREEMENT_PER_S = 2e-4
"""Difference between these rates up to which they always agree, in 1/s."""

Basis = Literal[
    "nothing",
    "divergence",
    "end",
    "roots",
    "proofs",
    "growing pushes",
    "dying pushes",
]
"""Evidence on which a decision rests.

"divergence" and "end" are the end of the run: an arm exceeded its limits, or its motion does
not come to rest. "roots" are the exact roots of the loop, and "proofs" all proofs that exist.
"growing pushes" and "dying pushes" are the repetitions of the run with small pushes. The
decision that a run is open may rest on nothing.
"""
Obstacle = Literal[
    "divergence",
    "end",
    "missing records",
    "hidden period",
    "doubts",
    "growing roots",
    "short record",
    "disputed proof",
    "slow decay",
    "missing pushes",
    "unjudged pushes",
    "unclear pushes",
    "few bursts",
    "unclear end",
]
"""Reasons that prevent a better verdict.

The first six are findings against stability: an arm exceeded its limits, there are doubts about
the end of the run, sites have no records, delays repeat only after the judged part, other
analyses contradict stability, or the roots show growth.

The others say why the evidence does not suffice: the record is too short, its end does not
agree with a proof, a numerical root decays too slowly to be distinguished from lasting motion,
no run with pushes was made or judged, the pushes show no clear trend, the judged part has few
bursts of lost samples, or the end of the run shows no clear trend.
"""
Doubt = StabilityVerdict | UnsuppliedGrowth | ObservedEnergy | EvidenceDoubt
"""A finding of another analysis that contradicts a stable run."""


class LoopRoots(NamedTuple):
    """Growth rates (roots) of small motions about the final pose of a run.

    They are the characteristic roots of the linearised control loop. Small motions decay if the
    real parts of all roots are negative. `theory.loop_roots` computes the roots for every
    command.

    Attributes:
        verdict: "stable", "unstable" or "at the edge", for small motions. Empty if the loop
            cannot be linearised.
        rate_per_s: Largest real part of the roots, in 1/s, excluding roots that are zero
            because of the structure of the loop. `None` if there is no other root.
        exact: True if the loop was analysed with its ticks and its repeating delays. Otherwise
            the roots may cast doubt on a run, but prove nothing.
        distance_rad: Largest difference between the final angle of a joint and its angle in the
            pose at rest to which the roots belong, in rad.
        programs: Sites whose arms are moved by a user's program. The linearised loop omits how
            these programs react to the arms.
        is_numerical: True if the code of a user's law was differentiated numerically. Such
            roots can prove that small motions grow, but not that they decay.
        swing_rate_per_s: Largest real part of the computed roots that oscillate, in 1/s, or
            `None` if no computed root oscillates.
        omega_rad_s: Angular frequency of the root with the largest real part, in rad/s.
        drifting: Number of motions that keep their speed because of the structure of the loop.
        span_s: Time over which the roots of a sampled loop were computed, in s, or None if
            every tick has the same delays.
        repeats: True if the delays of a sampled loop repeat after this time.
        deviation_per_s: Uncertainty of the rate due to delays that do not repeat, in 1/s, or
            None if they nearly repeat.
        is_continuous: True if the roots are those of the loop in continuous time.
        has_mean_ages: True if varying ages were replaced by their means.
        reason: The reason why there are no roots. Empty if the loop was linearised.
    """

    verdict: str
    rate_per_s: float | None
    exact: bool
    distance_rad: float = 0.0
    programs: tuple[str, ...] = ()
    is_numerical: bool = False
    swing_rate_per_s: float | None = None
    omega_rad_s: float = 0.0
    drifting: int = 0
    span_s: float | None = None
    repeats: bool = False
    deviation_per_s: float | None = None
    is_continuous: bool = False
    has_mean_ages: bool = False
    reason: str = ""

    @property
    def text(self) -> str:
        """A sentence for the user on the roots, or on why there are none.

        The package `presentation` generates it.
        """
        return str(find_hook("describe a finding")(self))

    @property
    def leaves_out(self) -> str:
        """A phrase on what the linearised loop omits. Empty if it includes everything.

        The package `presentation` generates it.
        """
        return str(find_hook("describe what roots leave out")(self))

    def to_json(self) -> JsonObject:
        """Converts the roots to plain values for JSON, including the sentence about them."""
        return {
            "verdict": self.verdict,
            "rate_per_s": self.rate_per_s,
            "exact": self.exact,
            "text": self.text,
            "distance_rad": self.distance_rad,
            "leaves_out": self.leaves_out,
            "is_numerical": self.is_numerical,
            "swing_rate_per_s": self.swing_rate_per_s,
        }

    @property
    def proven(self) -> str:
        """The verdict on small motions about the final pose, if exact roots prove it.

        The verdict is "stable" if the motions decay and "unstable" if they grow. Empty if the
        roots are not exact (see `exact`).
        """
        return self.verdict if self.exact else ""

    @property
    def is_proof(self) -> bool:
        """True if the roots prove that small motions about the final pose decay."""
        return self.proven == "stable"

    @property
    def is_refutation(self) -> bool:
        """True if the roots prove that small motions about the final pose grow."""
        return self.proven == "unstable"

    def measure_decay_misfit(self, end: RunEnd) -> float:
        """Measures how poorly a slow decay explains a motion that seems to last.

        The roots predict the rate of the decay. An oscillation is compared with the slowest
        root that oscillates, because a root without oscillation does not explain it. A drift is
        compared with the slowest root of all. The decay explains the motion in two cases: if it
        halves the motion at most once in the judged part, which is too little to show a trend,
        or if |e| and |qd| change at the rate of the root.

        Args:
            end: How the motion ends.

        Returns:
            A dimensionless misfit: at most 1 if the motion at the end may be a slow decay. It
                is infinity if the roots are not stable or were not computed with numerical
                derivatives, or if the motion grows or does not seem to last.
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
            misfits.append(_compute_rate_misfit(fit.rate_per_s, rate_per_s))

        judged_s = 0.5 * (end.lasts_s - end.counts_from_s)
        halvings = -rate_per_s * judged_s / math.log(DOUBLES)
        return min(halvings, max(misfits))

    def measure_rate_misfit(self, measured_per_s: float) -> float:
        """Measures how far a measured rate deviates from that of the slowest root.

        Args:
            measured_per_s: The measured rate, in 1/s.

        Returns:
            The difference divided by its tolerance: at most 1 if the rates agree, infinity if
                there is no root.
        """
        if self.rate_per_s is None:
            return math.inf
        return _compute_rate_misfit(measured_per_s, self.rate_per_s)


def _compute_rate_misfit(measured_per_s: float, root_per_s: float) -> float:
    """Returns the difference between a measured rate and a root, divided by its tolerance."""
    tolerance_per_s = _RATE_AGREEMENT_SHARE * abs(root_per_s) + _RATE_AGREEMENT_PER_S
    return abs(measured_per_s - root_per_s) / tolerance_per_s


class RunFindings(NamedTuple):
    """All evidence on the stability of a run, the input of `decide`.

    Attributes:
        end: How the motion ends.
        twins: How the effects of small pushes in repeated runs develop, or `None` if no run was
            repeated.
        roots: Roots of the loop at the end of the run, or `None` if they were not computed.
        is_covered: True if the stability theorem proves the loop stable.
        law_proofs: Phrases that name stability conditions of control laws, if these conditions
            prove that the loop is stable.
        doubts: Findings that contradict a stable run, such as an energy function that rises, or
            missing records.
        rises: True if the energy function V of the stability proof rose without supplied
            energy.
    """

    end: RunEnd
    twins: TwinGrowth | None = None
    roots: LoopRoots | None = None
    is_covered: bool = False
    law_proofs: Sequence[str] = ()
    doubts: Sequence[Doubt] = ()
    rises: bool = False

    def decide(self) -> "StabilityDecision":
        """Decides from all evidence whether a run is stable, settled, not stable, or open.

        The docstring of the module defines these verdicts.
        """
        obstacles = self._list_obstacles()
        decision = _decide_by_roots(self, obstacles)
        if decision is not None:
            return decision

        end = self.end
        refutation = _find_refutation(self)
        if refutation is not None:
            stability = Stability.OPEN if end.operator_acts else Stability.NOT_STABLE
            return StabilityDecision(stability, self, refutation, obstacles)

        if self.has_proof and not obstacles and _agrees_with_proof(self):
            return StabilityDecision(Stability.STABLE, self, "proofs")
        looks_unstable = end.stability is Stability.NOT_STABLE
        if looks_unstable and self.proven_by_roots != "stable" and not _is_end_excused(self):
            return StabilityDecision(Stability.NOT_STABLE, self, "end")
        if not obstacles and _has_settled(self):
            return StabilityDecision(Stability.SETTLED, self, "dying pushes")
        if obstacles:
            return StabilityDecision(Stability.OPEN, self, obstacles=obstacles)
        needed_s = _estimate_needed_s(self)
        if self.has_proof and needed_s is not None and needed_s > end.lasts_s:
            advised_s = needed_s if needed_s <= _LONGEST_ADVISED_S else None
            return StabilityDecision(
                Stability.OPEN, self, obstacles=("short record",), advised_s=advised_s
            )
        return StabilityDecision(Stability.OPEN, self, obstacles=(_explain_open(self),))

    @property
    def is_decided_by_roots(self) -> bool:
        """True if repeated runs with small pushes (twins) cannot change the decision.

        Twins then need not be simulated. This is the case if an arm exceeded its limits, or if
        the exact roots and the end of the run are sufficient for the decision.
        """
        return _decide_by_roots(self, self._list_obstacles()) is not None

    def _list_obstacles(self) -> tuple[Obstacle, ...]:
        """Lists the findings that prevent the judgements "stable" and "settled", in order.

        Such findings concern the end of the run, missing records, runs with small pushes,
        doubts of other analyses, and roots that show growth.
        """
        obstacles: list[Obstacle] = []
        if self.end.doubts:
            obstacles.append("end")
        if self.end.missing_sites:
            obstacles.append("missing records")
        twins = self.twins
        if twins is not None and twins.hides_period and not self.has_proof:
            obstacles.append("hidden period")
        if self.doubts:
            obstacles.append("doubts")
        roots = self.roots
        if roots is not None and roots.verdict == "unstable":
            # Twins repeat the recorded ticks. Roots that are not exact do not count if the
            # twins exclude growth at their rate.
            excluded_per_s = math.inf if twins is None else twins.excluded_rate_per_s
            is_excluded = roots.rate_per_s is not None and roots.rate_per_s > excluded_per_s
            if roots.exact or not is_excluded:
                obstacles.append("growing roots")
        return tuple(obstacles)

    @property
    def has_proof(self) -> bool:
        """True if the loop is proven stable.

        The proof is the stability theorem, the stability conditions of the control laws, or the
        exact characteristic roots of the loop.
        """
        return self.is_covered or bool(self.law_proofs) or self.proven_by_roots == "stable"

    @property
    def proven_by_roots(self) -> str:
        """The verdict proven by the roots: "stable", "unstable", or empty if there is none."""
        return "" if self.roots is None else self.roots.proven


class StabilityDecision(NamedTuple):
    """The decision on whether a run of coupled arms is stable, with the evidence for it.

    Attributes:
        stability: The verdict on the run.
        findings: The evidence.
        basis: Name of the evidence on which the decision is based.
        obstacles: Names of the reasons that prevent a better verdict. Empty if the run is
            stable.
        advised_s: Length of a run that would clearly show the decay of the slowest motion, in
            s, or `None` if no longer run is advised.
    """

    stability: Stability
    findings: RunFindings
    basis: Basis = "nothing"
    obstacles: tuple[Obstacle, ...] = ()
    advised_s: float | None = None

    @property
    def rests_on(self) -> str:
        """A phrase for the user that names the evidence for the decision. May be empty.

        The package `presentation` generates it.
        """
        return str(find_hook("describe a finding")(self))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences on the reasons that prevent a better verdict. Empty if the run is stable.

        The package `presentation` generates them.
        """
        return tuple(find_hook("list the sentences of a finding")(self))

    @property
    def rests_on_roots_alone(self) -> bool:
        """True if the decision is based on exact roots of the loop and on no other proof."""
        has_other_proof = self.findings.is_covered or bool(self.findings.law_proofs)
        return self.basis == "roots" or (self.basis == "proofs" and not has_other_proof)

    @property
    def is_too_short(self) -> bool:
        """True if a better verdict is prevented only because the recording is too short."""
        return "short record" in self.obstacles


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
    small motions. In this case a push without a clear trend agrees with the roots: its effect
    merely decays slowly.
    """
    worst = None if run.twins is None else run.twins.worst
    if worst is None or run.roots is None or run.proven_by_roots != "stable":
        return False
    return worst.rate_per_s < 0.0 and run.roots.measure_rate_misfit(worst.rate_per_s) <= 1.0


def _is_end_excused(run: RunFindings) -> bool:
    """Returns True if an end that looks unstable is not evidence of an unstable loop.

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
    disagree with the run to an end of the run that is inconclusive.

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

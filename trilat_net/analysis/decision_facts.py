"""Defines the evidence on the stability of a run, and the decision based on it.

`stability_decision` decides. The package `presentation` generates the sentences about the basis
of a decision and the reasons against a better one.

Invariant:
    - A decision and its evidence contain only names and numeric values, apart from phrases that
      the control laws and the analysis of roots provide.
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
from .twins.envelope_trend import EnvelopeTrend
from .twins.twin_growth import DOUBLES, TwinGrowth

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
"""Reasons that prevent a better decision.

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
            roots can refute a run, but not prove it stable.
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
        """The verdict on small motions about the final pose that is proven by the roots.

        The verdict is "stable" if the motions decay and "unstable" if they grow. Only exact
        roots prove a verdict, which are those of a loop with its ticks and its repeating
        delays. Empty if the roots are not exact.
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
        """Measures how poorly the slow decay of the roots explains motion that seems to last.

        An oscillation is compared with the roots that oscillate, because another slow root does
        not explain it. A drift is compared with the slowest root. The decay is compatible with
        the motion in two cases: if the root halves the motion at most once in the judged part,
        too little for a trend to show, or if |e| and |qd| have the rate of the root.

        Args:
            end: How the motion ends.

        Returns:
            A dimensionless misfit: at most 1 if the motion at the end may be the decay,
                infinity if the roots are not numerical or not stable, or if the motion grows or
                is not lasting.
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
    """All evidence on the stability of a run, the input of `decide_stability`.

    Attributes:
        end: How the motion ends.
        twins: How small pushes in repeated runs develop, or `None` if no run was repeated.
        roots: Roots of the loop at the end of the run, or `None` if they were not computed.
        is_covered: True if the stability theorem proves the loop stable.
        law_proofs: Phrases that name the stability conditions of control laws that prove the
            loop stable.
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

    @property
    def has_proof(self) -> bool:
        """True if the theorem, a control law or exact roots prove the loop stable."""
        return self.is_covered or bool(self.law_proofs) or self.proven_by_roots == "stable"

    @property
    def proven_by_roots(self) -> str:
        """The verdict proven by the roots: "stable", "unstable", or empty if there is none."""
        return "" if self.roots is None else self.roots.proven


class StabilityDecision(NamedTuple):
    """The decision on whether a run of coupled arms is stable, with the evidence for it.

    Attributes:
        stability: The decision.
        findings: The evidence.
        basis: Name of the evidence on which the decision is based.
        obstacles: Names of the reasons that prevent a better decision. Empty if the run is
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
        """Sentences on the reasons that prevent a better decision. Empty if the run is stable.

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
        """True if only the length of the recording prevents a better decision."""
        return "short record" in self.obstacles

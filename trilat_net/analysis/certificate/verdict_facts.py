"""Defines the possible findings about the energy function V of a run, one class each.

V is the energy function of the stability proof, which must not rise by itself. For example,
`FunctionalRise` states when V rose and by how much, and `NoFunctional` for which arms V does
not exist. `stability_certificate` selects the finding, and the package `presentation` words the
sentence about it.

Invariant:
    - A finding contains only names and numeric values, never sentences.
    - Each verdict has exactly one finding. An empty collection means that nothing of this kind
      was found in the run.
"""

from enum import Enum, auto
from typing import Any, Literal, NamedTuple

from ...hooks import find_hook
from ...log import Coverage, Integrity
from .premise_quantities import MissingFunctional, PremiseQuantities


class StabilityFinding(Enum):
    """Possible results of examining V, the energy function of the stability proof, over a run.

    In JSON output, the value of `verdict` is the name of a member in lower case.
    """

    COVERED = auto()
    """All premises of the theorem hold and V did not rise. The theorem then proves the run
    stable.
    """
    DID_NOT_RISE = auto()
    """A premise of the theorem fails, and V did not rise."""
    ROSE = auto()
    """V rose without a supply of energy."""
    BROKEN = auto()
    """The energy balance does not close: the records contradict each other."""
    NOT_JUDGED = auto()
    """V cannot be judged."""


class FunctionalRise(NamedTuple):
    """Largest rise of the energy function V without energy supplied from outside.

    V is the total energy of the arms in the stability proof, minus the work of operators and
    walls. What remains must not rise.

    Attributes:
        from_s: When V was at its minimum before the rise, in s.
        at_s: When V was highest, in s.
        amount: Size of the rise, in J.
        causes: Energy that each source supplied during the rise, in J, in descending order.
            Only sources of more than 5 % of the rise are listed.
    """

    from_s: float
    at_s: float
    amount: float
    causes: dict[str, float]


class UnsuppliedGrowth(NamedTuple):
    """Finding that the energy function V grew at the end of a run without supplied energy.

    V belongs to the stability proof and must not rise unless an operator or wall does work.

    Attributes:
        energy_j: Size of the growth, in J.
        from_s: Time from which V rises, in s, or `None` if V is compared with its initial
            value.
    """

    energy_j: float
    from_s: float | None = None

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, worded by the package `presentation`."""
        return str(find_hook("describe a finding")(self))


class NoFunctional(NamedTuple):
    """Finding that the energy function V does not exist for some arms.

    One possible reason is the control law, because V exists only for certain laws. Without V,
    the run is judged from other evidence.

    Attributes:
        missing: Sites of these arms, grouped by reason.
    """

    missing: tuple[MissingFunctional, ...]


class RecordGap(Enum):
    """Finding that the energy function V cannot be computed because records are missing.

    V, the energy in the stability proof, does exist for the control laws of this run.
    """

    NO_COMMON_TIME = auto()
    """There is no time at which every site has records."""
    NO_PERIOD = auto()
    """There is no tick period whose records are complete."""


class UnclosedBalance(NamedTuple):
    """Finding that the energy of an arm changed by more than the known causes explain.

    If a run obeys the equations stated in the log, its energies balance. If they do not, the
    log or the simulation is wrong, or the tick period is too long.

    Attributes:
        site: Site with the largest error.
        from_s: Time from which the energies do not balance, in s.
        error_j: Largest error, in J.
        scale_j: Largest energy of the run, in J.
        external: External arms, if only these are affected. Empty if the site is simulated.
        is_certain: True if the records are certainly false. Otherwise, the cause may be a tick
            period that is too long for the gains.
    """

    site: str
    from_s: float
    error_j: float
    scale_j: float
    external: tuple[str, ...]
    is_certain: bool


class WrongTorque(NamedTuple):
    """Finding that recorded torques of an arm do not follow from its control law, Eq. (13).

    The log is then inconsistent, for example because it was modified or the arm ran a different
    law.

    Attributes:
        site: Name of the site.
        from_s: Time from which the torques differ, in s.
        error_nm: Largest difference, in N m.
    """

    site: str
    from_s: float
    error_nm: float


class AmbiguousWeights(NamedTuple):
    """Finding that V is not unique because its weights beta are not.

    V is the weighted sum of the energies of all arms. The weights are unique if every arm
    follows every other arm, directly or through further arms.

    Attributes:
        groups: Names of the sites in each closed group, which follows no site outside the
            group.
    """

    groups: tuple[tuple[str, ...], ...]


class CoarseEnergies(NamedTuple):
    """Finding that numerical errors of the energies are too large to decide whether V rose.

    V is the energy function of the stability proof, which must never rise.

    Attributes:
        tolerance_j: Threshold that a rise must exceed to count, in J.
        scale_j: Largest energy of the run, in J.
    """

    tolerance_j: float
    scale_j: float


class FunctionalCourse(NamedTuple):
    """First, last and largest value of the energy function V in a run, and its largest rise.

    V is the energy in the stability proof, and must never rise without supplied energy.

    Attributes:
        failed: Names of the premises that fail. If there are any, the theorem does not apply.
        undecided: Quantities of the premises that the log does not decide.
        external: Operators and environments that did work, named as in "hands".
        from_s: First time at which V is known, in s.
        to_s: Last time at which V is known, in s.
        first_j: V at the first time, in J. 0 if V is only a rounding error.
        last_j: V at the last time, in J. 0 if V is only a rounding error.
        largest_j: Largest V, in J.
        rise: Largest rise of V without supplied energy, or `None` if V did not rise.
    """

    failed: tuple[str, ...]
    undecided: tuple[PremiseQuantities, ...]
    external: tuple[str, ...]
    from_s: float
    to_s: float
    first_j: float
    last_j: float
    largest_j: float
    rise: FunctionalRise | None


VerdictFacts = (
    NoFunctional
    | RecordGap
    | UnclosedBalance
    | WrongTorque
    | AmbiguousWeights
    | CoarseEnergies
    | FunctionalCourse
)
"""The facts of any verdict."""


class StabilityVerdict(NamedTuple):
    """Result of the energy test of a run: whether the energy function V rose, and by how much.

    V belongs to the stability proof. If V rises without supplied energy, the proof does not
    hold for the run.

    Attributes:
        finding: The finding, for example that V never rose.
        facts: The data behind the finding.
        rise: The largest rise of V beyond the tolerance, or `None` if V did not rise.
        tolerance: Threshold that a rise must exceed to count, in J.
    """

    finding: StabilityFinding
    facts: VerdictFacts
    rise: FunctionalRise | None = None
    tolerance: float = 0.0

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, for example that V never rose.

        V is the energy function of the stability proof. The package `presentation` words the
        sentence.
        """
        return str(find_hook("describe a finding")(self))


class Evidence(NamedTuple):
    """The records on which a stability certificate is based, and whether they are sufficient.

    Attributes:
        coverage: Recorded ticks and expected ticks of every site.
        functional_share: Fraction of the tick periods in which the energy of the stability
            proof is known from records, excluding periods in which a site was absent. `None` if
            this energy is not judged.
        min_coverage: Smallest sufficient fraction, for both ticks and periods.
        integrity: Whether the log is unmodified since it was written.
        unmet: Sites that did not react to the other sites, because the run is a repetition in
            which their motion was copied from an earlier run.
    """

    coverage: Coverage
    functional_share: float | None
    min_coverage: float
    integrity: Integrity
    unmet: tuple[str, ...] = ()

    @property
    def doubts(self) -> "tuple[EvidenceDoubt, ...]":
        """Reasons why the records are not sufficient to call the run stable, if any.

        Examples are a log that was modified after the run, or too many missing records.
        """
        doubts = []
        if not self.integrity.passed:
            doubts.append(EvidenceDoubt("changed log", self))
        if self.coverage.share < self.min_coverage:
            doubts.append(EvidenceDoubt("missing records", self))
        judged_share = self.functional_share
        if judged_share is not None and judged_share < self.min_coverage:
            doubts.append(EvidenceDoubt("missing periods", self))
        if self.unmet:
            doubts.append(EvidenceDoubt("copied sites", self))
        return tuple(doubts)

    @property
    def reasons(self) -> list[str]:
        """Sentences on why the log is not sufficient to call the run stable, one per doubt.

        The package `presentation` words them.
        """
        return list(find_hook("list the sentences of a finding")(self))

    @property
    def text(self) -> str:
        """A sentence for the user on how many records exist and whether the log is unmodified.

        The certificate prints this sentence for every run, even if the records are sufficient.
        """
        return str(find_hook("describe a finding")(self))

    def to_json(self) -> dict[str, Any]:
        """Returns the completeness and authenticity of the records as plain values.

        The keys are those of `trilat certify --json`. For example, "coverage" is the smallest
        fraction of a site's ticks that have a record, from 0 to 1, and "integrity" states
        whether the log is unmodified.
        """
        return {
            "coverage": self.coverage.share,
            "functional_coverage": self.functional_share,
            "min_coverage": self.min_coverage,
            "judged": self.coverage.to_json(),
            "integrity": self.integrity.state.name.lower(),
            "open_loop_sites": list(self.unmet),
        }


class EvidenceDoubt(NamedTuple):
    """Finding that the records are not sufficient to call a run stable.

    Attributes:
        name: Name of the finding. "changed log": the log was modified after it was written.
            "missing records": too few ticks of a site are recorded. "missing periods": the
            energy function V is known in too few tick periods. "copied sites": the motion of
            some sites was copied from an earlier run.
        evidence: The evidence on the records, including the values behind the finding.
    """

    name: Literal["changed log", "missing records", "missing periods", "copied sites"]
    evidence: Evidence

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, worded by the package `presentation`."""
        return str(find_hook("describe a finding")(self))

"""Defines the possible findings about the energy function V of a run, one class each.

V is the energy function of the stability proof, which must not rise by itself. For example,
`FunctionalRise` says when V rose and by how much, and `NoFunctional` for which arms V does not
exist. `stability_certificate` selects the finding, and the package `presentation` writes the
sentence about it.

Invariant:
    - A finding contains only names and numbers, no sentence.
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

    In JSON output, the values of `verdict` are the names of the members in lower case.
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

    V is the total energy of the arms in the stability proof. The work of operators and walls is
    subtracted from it. What remains must not rise.

    Attributes:
        from_s: Time of the minimum of V before the rise, in s.
        at_s: Time of the highest V, in s.
        amount: Size of the rise, in J.
        causes: Energy that each source supplied during the rise, in J, largest first. Only
            sources of more than 5 % of the rise are listed.
    """

    from_s: float
    at_s: float
    amount: float
    causes: dict[str, float]


class UnsuppliedGrowth(NamedTuple):
    """Finding that the energy function V grew at the end of a run without supplied energy.

    V belongs to the stability proof, and must not rise unless an operator or wall does work.

    Attributes:
        energy_j: Size of the growth, in J.
        from_s: Time from which V rises, in s. `None` if V is compared with its beginning.
    """

    energy_j: float
    from_s: float | None = None

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, which the package `presentation` writes."""
        return str(find_hook("describe a finding")(self))


class NoFunctional(NamedTuple):
    """Finding that the energy function V does not exist for some arms.

    One reason is the control law, because V exists only for certain laws. Without V, the run is
    judged by other evidence.

    Attributes:
        missing: Sites of these arms, grouped by the reason.
    """

    missing: tuple[MissingFunctional, ...]


class RecordGap(Enum):
    """Finding that records are missing, so the energy function V cannot be computed.

    V, the energy of the stability proof, exists for the control laws of this run.
    """

    NO_COMMON_TIME = auto()
    """There is no time at which every site has records."""
    NO_PERIOD = auto()
    """There is no tick period whose records are complete."""


class UnclosedBalance(NamedTuple):
    """Finding that the energy of an arm changed by more than the known causes explain.

    The energies of a run that obeys the equations of the log add up. If the energies do not add
    up, the log or the simulation is wrong, or the control period is too long.

    Attributes:
        site: Site with the largest error.
        from_s: Time from which the energy does not add up, in s.
        error_j: Largest error, in J.
        scale_j: Largest energy of the run, in J.
        external: External arms, if only these are concerned. Empty if the site is simulated.
        is_certain: True if the records are certainly false. Otherwise a tick period that is
            too long for the gains may be the cause.
    """

    site: str
    from_s: float
    error_j: float
    scale_j: float
    external: tuple[str, ...]
    is_certain: bool


class WrongTorque(NamedTuple):
    """Finding that recorded torques of an arm do not follow from its control law, Eq. (13).

    The log is then inconsistent, for example because it was changed or the arm ran a different
    law.

    Attributes:
        site: Name of the site, the process that controls the arm.
        from_s: Time from which they differ, in s.
        error_nm: Largest difference, in N m.
    """

    site: str
    from_s: float
    error_nm: float


class AmbiguousWeights(NamedTuple):
    """Finding that V is not unique, because its weights beta are not.

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
        tolerance_j: Size that a rise must exceed to count, in J.
        scale_j: Largest energy of the run, in J.
    """

    tolerance_j: float
    scale_j: float


class FunctionalCourse(NamedTuple):
    """The energy function V during a run: first, last and largest value, and largest rise.

    V is the energy of the stability proof. V must never rise without supplied energy.

    Attributes:
        failed: Names of the premises that fail. The theorem does not apply if there are any.
        undecided: Quantities of the premises on which the log does not decide.
        external: Names of operators and environments that did work, as in "hands".
        from_s: First time at which V is known, in s.
        to_s: Last time at which V is known, in s.
        first_j: V at the first time, in J. 0 if V is a rounding error.
        last_j: V at the last time, in J. 0 if V is a rounding error.
        largest_j: Largest V, in J.
        rise: Largest rise of V without supplied energy. `None` if V did not rise.
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
        finding: The finding, such as that V never rose.
        facts: The numbers behind the finding.
        rise: The largest rise of V beyond the tolerance. `None` if V did not rise.
        tolerance: Size that a rise must exceed to count, in J.
    """

    finding: StabilityFinding
    facts: VerdictFacts
    rise: FunctionalRise | None = None
    tolerance: float = 0.0

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, such as that V never rose.

        The package `presentation` writes it. V is the energy function of the stability proof.
        """
        return str(find_hook("describe a finding")(self))


class Evidence(NamedTuple):
    """The records on which a stability certificate is based, and whether they suffice.

    A site, the process that runs one arm, stores a record in every tick (control period).

    Attributes:
        coverage: Recorded ticks and expected ticks of every site.
        functional_share: Fraction of the tick periods in which the energy of the stability
            proof is known from records. Periods in which a site was absent do not count. `None`
            if this energy is not judged.
        min_coverage: Least fraction that suffices, for the ticks and for the periods.
        integrity: Whether the log is unchanged since it was written.
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
        """Reasons why the records do not suffice to call the run stable. Empty if they suffice.

        Examples are a log that was changed after the run, or too many missing records.
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
        """Sentences that say why the log does not suffice to call the run stable.

        There is one for each doubt. The package `presentation` writes them.
        """
        return list(find_hook("list the sentences of a finding")(self))

    @property
    def text(self) -> str:
        """A sentence for the user: how many records exist, and whether the log is unchanged.

        The certificate prints this sentence for every run, even if the records suffice.
        """
        return str(find_hook("describe a finding")(self))

    def to_json(self) -> dict[str, Any]:
        """Returns the extent and authenticity of the records as plain values.

        The keys are those of `trilat certify --json`. For example, "coverage" is the smallest
        share of a site's ticks that have a record, from 0 to 1, and "integrity" states whether
        the log is unchanged.
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
    """Finding that records do not suffice to call a run stable.

    Attributes:
        name: Name of the finding. "changed log": the log was changed after it was written.
            "missing records": too few ticks of a site are recorded. "missing periods": the
            energy function V is known in too few tick periods. "copied sites": the motion of
            some sites was copied from an earlier run.
        evidence: The evidence on the records, with the numbers behind the finding.
    """

    name: Literal["changed log", "missing records", "missing periods", "copied sites"]
    evidence: Evidence

    @property
    def text(self) -> str:
        """The finding as a sentence for the user, which the package `presentation` writes."""
        return str(find_hook("describe a finding")(self))

"""Writes the sentences for users about V, the energy function of the stability proof.

`analysis` determines whether and when V rose, and returns names and numbers. For example, this
module writes that V rose by 0.2 J at 3.1 s, or which condition of the theorem failed.

Invariant:
    - Each class of `VerdictFacts` has exactly one function in `FACT_DESCRIBERS`.
    - A sentence that names a condition (premise) that fails says in plain words what the
      condition requires.
    - The name of the theorem mentions its premise of continuous time, which no log can show.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from ..analysis import verdict_facts as facts
from .premise_text import (
    describe_closed_groups,
    describe_missing_functionals,
    describe_quantities,
)

THEOREM = "the theorem (continuous time; every premise checked here holds)"
"""Basis of the judgement of a run if the stability theorem proves the run stable."""
FALSE_RECORDS_TEXT = "these records do not follow from the equations in the log"
_PERIOD_OR_FALSE = (
    f"the period is too long for these gains, or {FALSE_RECORDS_TEXT}; "
    "`trilat verify` tells which"
)
_COVERED = "covered by the theorem"
_PREFIXES = {
    facts.StabilityFinding.BROKEN: "the energy balance is broken: ",
    facts.StabilityFinding.NOT_JUDGED: "V cannot be judged: ",
}
"""Beginning of a sentence if V does not decide."""
RECORD_GAPS = {
    facts.RecordGap.NO_COMMON_TIME: "there is no time at which every site has records",
    facts.RecordGap.NO_PERIOD: "there is no period whose records are complete",
}
REQUIREMENTS = {
    "law": "must be adaptive at every site",
    "parameters": "must be learnt or known",
    "Kd": "must be one for all sites, up to a factor",
    "walls": "must create no energy",
    "shares": "must be constant and connect all sites",
    "delays": "must be constant",
    "following": "must never pause",
    "torque": "must stay below its limit",
    "stops": "must not be touched",
    "axes": "must be the same at all sites",
    "singular poses": "must be avoided",
    "hands": "must add no energy",
    "presence": "must not be interrupted",
}
"""Requirements of the theorem as ends of clauses, by the name of the premise."""


def name_theorem() -> str:
    """Returns the phrase by which judgements of runs refer to the paper's stability theorem."""
    return THEOREM


def _describe_verdict(verdict: facts.StabilityVerdict) -> str:
    """Returns a sentence on whether the energy function V of a run rose.

    V is the energy of the stability proof, which must not rise.
    """
    sentence = FACT_DESCRIBERS[type(verdict.facts)](verdict.facts)
    return f"{_PREFIXES.get(verdict.finding, '')}{sentence}"


def _describe_no_functional(lack: facts.NoFunctional) -> str:
    return describe_missing_functionals(lack.missing)


def _describe_gap(gap: facts.RecordGap) -> str:
    return RECORD_GAPS[gap]


def _describe_unclosed_balance(balance: facts.UnclosedBalance) -> str:
    amount = f"{balance.error_j:.3g} J of {balance.scale_j:.4g} J"
    span = f"from {balance.from_s:.4g} s on"
    text = f"the energy of {balance.site} does not add up {span}, by {amount}"
    if balance.external:
        arms = f"the external arm of {', '.join(balance.external)}"
        cause = "does not move according to its theta, or an unrecorded torque pushes it"
        return f"{text}: {arms} {cause}"
    return f"{text}: {FALSE_RECORDS_TEXT if balance.is_certain else _PERIOD_OR_FALSE}"


def _describe_wrong_torque(torque: facts.WrongTorque) -> str:
    return (
        f"the torque of {torque.site} differs from Eq. (13) by up to "
        f"{torque.error_nm:.3g} N m, from {torque.from_s:.4g} s on: {FALSE_RECORDS_TEXT}"
    )


def _describe_ambiguous_weights(weights: facts.AmbiguousWeights) -> str:
    return describe_closed_groups(weights.groups)


def _describe_coarse_energies(energies: facts.CoarseEnergies) -> str:
    return (
        "the period is too long for these gains, so its energies are known only to within "
        f"{energies.tolerance_j:.3g} J of {energies.scale_j:.4g} J"
    )


def _describe_course(course: facts.FunctionalCourse) -> str:
    """Returns a sentence on whether the energy V of the stability proof rose during a run.

    The sentence also says whether the premises (conditions) of the theorem hold, under which V
    must not rise.
    """
    if course.rise is not None:
        context = "although the premises of the theorem, which is about continuous time, hold"
        if course.failed:
            context = _describe_failed(course.failed)
        return f"{context}: {_describe_rise(course.rise, course.largest_j)}"

    text = "V did not rise"
    if course.external:
        text = f"V rose by no more than the {' and '.join(course.external)} supplied"
    first_text = f"{course.first_j:.4g} J at {course.from_s:.4g} s"
    text += f": {first_text}, {course.last_j:.4g} J at {course.to_s:.4g} s"
    undecided_texts = [describe_quantities(quantities) for quantities in course.undecided]
    text = "; ".join([text, *undecided_texts])
    if course.failed:
        return f"{_describe_failed(course.failed)}; {text}"

    reservation = ", as far as the log tells" if undecided_texts else ""
    return f"{_COVERED}{reservation}: {text}"


def _describe_failed(names: Sequence[str]) -> str:
    """Returns a sentence that the theorem does not apply, with its failed requirements."""
    premises = [f"{name} {REQUIREMENTS[name]}" for name in names]
    return f"the theorem does not apply (premises that fail: {'; '.join(premises)})"


def _describe_rise(rise: facts.FunctionalRise, largest_j: float) -> str:
    largest_causes = list(rise.causes.items())[:4]
    causes = ", ".join(f"{name} {amount:.3g} J" for name, amount in largest_causes)
    percent = 100.0 * rise.amount / largest_j
    text = (
        f"V rose by {rise.amount:.3g} J ({percent:.3g} % of its largest value) "
        f"from {rise.from_s:.4g} to {rise.at_s:.4g} s"
    )
    return text + (f"; supplied by {causes}" if causes else "; no source supplied it")


FACT_DESCRIBERS: dict[type, Callable[[Any], str]] = {
    facts.NoFunctional: _describe_no_functional,
    facts.RecordGap: _describe_gap,
    facts.UnclosedBalance: _describe_unclosed_balance,
    facts.WrongTorque: _describe_wrong_torque,
    facts.AmbiguousWeights: _describe_ambiguous_weights,
    facts.CoarseEnergies: _describe_coarse_energies,
    facts.FunctionalCourse: _describe_course,
}
"""For each class of facts, the function that writes its sentence."""


def _describe_growth(growth: facts.UnsuppliedGrowth) -> str:
    """Returns a sentence on a growth of the energy V that no operator or wall explains.

    V is the energy of the stability proof. Such a growth makes the judgement doubtful, even if
    the run looks stable.
    """
    energy = f"{growth.energy_j:.3g} J"
    if growth.from_s is None:
        return f"V ends {energy} above its beginning, and no source supplied that energy"
    span = f"from {growth.from_s:.4g} s on"
    return f"V rises at the end: by {energy} {span}, and no source supplied that energy"


def _describe_evidence(evidence: facts.Evidence) -> str:
    """Returns a sentence on how many records a run has, and whether its log is unchanged."""
    return f"{evidence.coverage.describe(evidence.min_coverage)}; {evidence.integrity.text}"


def _list_lacks(evidence: facts.Evidence) -> list[str]:
    """Returns sentences that say why records do not suffice to judge the stability of a run."""
    return [_describe_lack(doubt) for doubt in evidence.doubts]


def _describe_lack(doubt: facts.EvidenceDoubt) -> str:
    """Returns a sentence that says why records do not suffice to judge a run."""
    evidence = doubt.evidence
    if doubt.name == "changed log":
        return f"the log was changed after the run: {evidence.integrity.text}"
    if doubt.name == "missing records":
        coverage = evidence.coverage.describe(evidence.min_coverage)
        return f"records are missing: {coverage}"
    if doubt.name == "missing periods":
        judged_share = evidence.functional_share or 0.0
        return f"V is judged over {100.0 * judged_share:.4g} % of its periods"
    return (
        f"{' and '.join(evidence.unmet)} replayed recorded motion, without reacting to this run"
    )


DESCRIBERS: dict[type, Callable[[Any], str]] = {
    facts.StabilityVerdict: _describe_verdict,
    facts.UnsuppliedGrowth: _describe_growth,
    facts.Evidence: _describe_evidence,
    facts.EvidenceDoubt: _describe_lack,
}
"""The functions that describe the findings of this module, by the class of the finding."""
SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {facts.Evidence: _list_lacks}
"""The functions that list the sentences of a finding, by its class."""

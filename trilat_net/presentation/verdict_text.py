"""Writes the sentences about V, the energy function of the stability proof, for people.

`analysis` computes whether and when V rose, as names and numbers. For example, this module
writes that V rose by 0.2 J at 3.1 s, or which condition of the theorem failed.

Invariant:
    - Each class of `VerdictFacts` has one function here, in `FACT_DESCRIBERS`.
    - A sentence that names a condition (premise) that fails says in plain words what the
      condition requires.
    - The theorem is named with its own premises of continuous time, which no log can show.
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
"""What a run rests on if the stability theorem proves it stable."""
FALSE_RECORDS_TEXT = "these records were not made by the equations that the log claims"
_PERIOD_OR_FALSE = (
    f"the period is too long for these gains, or {FALSE_RECORDS_TEXT}; "
    "`trilat verify` tells which"
)
_COVERED = "covered by the theorem"
_PREFIXES = {
    facts.StabilityFinding.BROKEN: "the energy balance is broken: ",
    facts.StabilityFinding.NOT_JUDGED: "V cannot be judged: ",
}
"""How a sentence begins if V does not decide."""
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
"""What the theorem requires, by the name of the premise, as the end of a clause."""


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
        return f"{text}: {arms} does not move as its theta says, or somebody pushes it"
    return f"{text}: {FALSE_RECORDS_TEXT if balance.is_certain else _PERIOD_OR_FALSE}"


def _describe_wrong_torque(torque: facts.WrongTorque) -> str:
    return (
        f"the torque of {torque.site} is not that of Eq. (13), by up to "
        f"{torque.error_nm:.3g} N m, from {torque.from_s:.4g} s on: {FALSE_RECORDS_TEXT}"
    )


def _describe_ambiguous_weights(weights: facts.AmbiguousWeights) -> str:
    return describe_closed_groups(weights.groups)


def _describe_coarse_energies(energies: facts.CoarseEnergies) -> str:
    return (
        "the period is too long for these gains, so its energies are known only to "
        f"{energies.tolerance_j:.3g} J of {energies.scale_j:.4g} J"
    )


def _describe_course(course: facts.FunctionalCourse) -> str:
    """Returns a sentence on whether the energy V of the stability proof rose during a run.

    The sentence also says whether the premises (conditions) of the theorem hold, under which V
    must not rise.
    """
    if course.rise is not None:
        context = "though the premises of the theorem hold, which is one of continuous time"
        if course.failed:
            context = _describe_failed(course.failed)
        return f"{context}: {_describe_rise(course.rise, course.largest_j)}"

    text = "V did not rise"
    if course.external:
        text = f"V rose by no more than the {' and '.join(course.external)} gave"
    first_text = f"{course.first_j:.4g} J at {course.from_s:.4g} s"
    text += f": {first_text}, {course.last_j:.4g} J at {course.to_s:.4g} s"
    undecided_texts = [describe_quantities(quantities) for quantities in course.undecided]
    text = "; ".join([text, *undecided_texts])
    if course.failed:
        return f"{_describe_failed(course.failed)}; {text}"

    reservation = ", as far as the log tells" if undecided_texts else ""
    return f"{_COVERED}{reservation}: {text}"


def _describe_failed(names: Sequence[str]) -> str:
    """Returns a sentence: the theorem does not apply, and what each failed premise requires."""
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
    return text + (f"; given by {causes}" if causes else "; nobody gave it")


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

    V is the energy of the stability proof. Such a growth is doubtful, even if the run looks
    stable.
    """
    energy = f"{growth.energy_j:.3g} J"
    if growth.from_s is None:
        return f"V ends {energy} above its beginning, and nobody gave that"
    return (
        f"V rises at the end: by {energy} from {growth.from_s:.4g} s on, and nobody gave that"
    )


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
        return f"the log is not as it was made: {evidence.integrity.text}"
    if doubt.name == "missing records":
        coverage = evidence.coverage.describe(evidence.min_coverage)
        return f"records are missing: {coverage}"
    if doubt.name == "missing periods":
        judged_share = evidence.functional_share or 0.0
        return f"V is judged over {100.0 * judged_share:.4g} % of its periods"
    return f"{' and '.join(evidence.unmet)}, as recorded, did not react to this run"


DESCRIBERS: dict[type, Callable[[Any], str]] = {
    facts.StabilityVerdict: _describe_verdict,
    facts.UnsuppliedGrowth: _describe_growth,
    facts.Evidence: _describe_evidence,
    facts.EvidenceDoubt: _describe_lack,
}
"""The functions that describe the findings of this module, by the class of the finding."""
SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {facts.Evidence: _list_lacks}
"""The functions that list the sentences of a finding, by its class."""

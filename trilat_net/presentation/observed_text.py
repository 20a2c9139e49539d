"""Describes the energies declared by control laws in sentences for users.

`analysis.certificate.observed_energy` compares these energies with the records, and returns
names and numbers.
"""

from collections.abc import Callable
from typing import Any

from ..analysis import ObservedEnergy
from ..errors import count_nouns

NEGATIVE_ENERGY_MEANING = (
    "an observed energy below zero, such as -0.85 mJ, means that at this tick one end of a "
    "connection had taken out that much more energy than it knew to have been put in, its "
    "reserve included. Passivity then proves nothing about the run, which may be stable "
    "nevertheless"
)
"""Explanation of a negative energy, worded identically wherever users read it."""
_FINDINGS = {
    "passive": "observed energy never below zero",
    "negative": "observed energy below zero",
    "broken": "the energies that a law declares do not add up",
    "not_judged": "observed energy cannot be judged",
}


def _describe_observed(observed: ObservedEnergy) -> str:
    """Returns a sentence on whether the declared energies are correct and remain above zero."""
    return f"{_FINDINGS[observed.finding]}: {_describe_cause(observed)}"


def _describe_cause(observed: ObservedEnergy) -> str:
    """Returns the values behind the finding, or the reason why there are none."""
    if observed.undeclared_sites:
        return f"the law of {', '.join(observed.undeclared_sites)} declares no energies"
    if observed.incomplete_sites:
        return f"records of {', '.join(observed.incomplete_sites)} are missing"
    if observed.finding == "broken":
        return observed.premises[0].text
    if observed.finding == "negative":
        lowest = min(observed.least, key=lambda energy: energy.amount_j)
        return f"{lowest.name} is {lowest.amount_j:.3g} J at {lowest.at_s:.4g} s"

    text = (
        f"{count_nouns(len(observed.least), 'energy')}, the largest {observed.largest_j:.4g} J"
    )
    failed = [premise.name for premise in observed.premises if not premise.holds]
    if failed:
        text += f"; but a premise fails: {', '.join(failed)}"
    return text


DESCRIBERS: dict[type, Callable[[Any], str]] = {
    ObservedEnergy: _describe_observed,
}
"""Functions that describe findings, keyed by the class of the finding."""

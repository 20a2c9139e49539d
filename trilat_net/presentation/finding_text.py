"""Describes the findings of the analysis in sentences, by the class of the finding.

The classes of `analysis` contain names and numbers, and their properties `text` and `reasons`
call the two functions of this module through hooks.

Invariant:
    - Each class has its functions in one module, whose tables `DESCRIBERS` and `REASON_LISTERS`
      name them.
"""

from collections.abc import Callable
from typing import Any

from . import decision_text, end_text, observed_text, twin_text, verdict_text

_DESCRIBERS: dict[type, Callable[[Any], str]] = {
    **decision_text.DESCRIBERS,
    **end_text.DESCRIBERS,
    **observed_text.DESCRIBERS,
    **twin_text.DESCRIBERS,
    **verdict_text.DESCRIBERS,
}
_REASON_LISTERS: dict[type, Callable[[Any], list[str]]] = {
    **decision_text.REASON_LISTERS,
    **end_text.REASON_LISTERS,
    **verdict_text.REASON_LISTERS,
}


def describe_finding(finding: Any) -> str:
    """Returns a finding of the analysis as a sentence or phrase for people.

    Args:
        finding: The finding, with the numbers that show it.
    """
    return _DESCRIBERS[type(finding)](finding)


def list_finding_reasons(finding: Any) -> list[str]:
    """Returns sentences that say why a finding does not show that a run is stable.

    Args:
        finding: The finding, with the numbers that show it.

    Returns:
        The sentences. Empty if nothing speaks against a stable run.
    """
    return _REASON_LISTERS[type(finding)](finding)

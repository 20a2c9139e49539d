"""Describes the findings of the analysis in sentences, depending on the class of the finding.

The classes of `analysis` contain names and numbers. Their properties `text`, `reasons` and
`remarks` call the two functions of this module through hooks.

Invariant:
    - The functions for each class are in one module, in the tables `DESCRIBERS` and
      `SENTENCE_LISTERS`.
"""

from collections.abc import Callable, Iterable
from typing import Any

from . import decision_text, end_text, observed_text, remark_text, twin_text, verdict_text

_DESCRIBERS: dict[type, Callable[[Any], str]] = {
    **decision_text.DESCRIBERS,
    **end_text.DESCRIBERS,
    **observed_text.DESCRIBERS,
    **twin_text.DESCRIBERS,
    **verdict_text.DESCRIBERS,
}
_SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {
    **decision_text.SENTENCE_LISTERS,
    **end_text.SENTENCE_LISTERS,
    **remark_text.SENTENCE_LISTERS,
    **verdict_text.SENTENCE_LISTERS,
}


def describe_finding(finding: Any) -> str:
    """Returns a sentence or phrase that describes a finding of the analysis to users.

    Args:
        finding: The finding, with its numerical evidence.
    """
    return _DESCRIBERS[type(finding)](finding)


def list_finding_sentences(finding: Any) -> list[str]:
    """Returns one sentence for each part of a finding that has several parts.

    For example, the sentences may explain why the stability of a run cannot be determined from
    the end of its motion.

    Args:
        finding: The finding, with its numerical evidence.

    Returns:
        The sentences. Empty if the finding has no parts.
    """
    return list(_SENTENCE_LISTERS[type(finding)](finding))

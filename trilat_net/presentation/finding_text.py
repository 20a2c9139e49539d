"""Describes the findings of the analysis in sentences, by the class of the finding.

The classes of `analysis` contain names and numbers, and their properties `text`, `reasons` and
`remarks` call the two functions of this module through hooks.

Invariant:
    - The functions of each class are in one module, in the tables `DESCRIBERS` and
      `SENTENCE_LISTERS`.
"""

from collections.abc import Callable, Iterable
from typing import Any

from . import (
    decision_text,
    end_text,
    observed_text,
    remark_text,
    twin_text,
    verdict_text,
)

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
    """Returns a sentence or phrase for users on a finding of the analysis.

    Args:
        finding: The finding, with the numbers that show it.
    """
    return _DESCRIBERS[type(finding)](finding)


def list_finding_sentences(finding: Any) -> list[str]:
    """Returns the sentences on a finding that consists of several, one for each of its parts.

    For example, the sentences say why the end of a run leaves its stability open.

    Args:
        finding: The finding, with the numbers that show it.

    Returns:
        The sentences. Empty if the finding has no parts.
    """
    return list(_SENTENCE_LISTERS[type(finding)](finding))

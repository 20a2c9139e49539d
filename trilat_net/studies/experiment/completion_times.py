"""Completion times of trials that may run into a time limit: medians, their intervals, and sign
tests.

A trial that was not completed has no completion time: it is known only that the time is longer
than the limit (right censoring), or, of a trial that failed before the limit, that the task was
never done. Both count as longer than every time that was measured. Order statistics need no
more than that: the median, which is that of Kaplan and Meier, is exact as long as more than
half of the trials were completed, and otherwise it was not reached. A mean would need the times
themselves, and the limit in their place makes conditions look alike that are not.

Invariant:
- The limit never enters a sum or a difference.
- Trials are summarised per unit and condition before units are compared, so that more trials
  are not more participants.

Sources: Kaplan and Meier, "Nonparametric estimation from incomplete observations", J. American
Statistical Association 53 (1958); Conover, "Practical nonparametric statistics", 3rd edition
(1999), 3.2 and 3.4, for the interval of a median and the sign test.
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from .statistics import CONFIDENCE, Row, correct_holm, import_scipy_stats, read_number

COMPLETION = "completion_s"
SUCCESS = "succeeded"


class CompletionTime(NamedTuple):
    """How long it took to complete trials under a condition.

    Attributes:
        condition: its name.
        trials: how many count.
        censored: how many of them were not completed: `timed_out` and those that failed sooner.
        timed_out: how many of them ran into the time limit.
        number: of units.
        median: over units, of each unit's median time, s; None: it was not reached.
        interval: of that median, 95 % or more, by order statistics, s; its upper end is None if
            it was not reached. None: there are too few units, or the lower end was not reached
            either.
    """

    condition: str
    trials: int
    censored: int
    timed_out: int
    number: int
    median: float | None
    interval: tuple[float, float | None] | None


class CompletionComparison(NamedTuple):
    """Two conditions, compared within units by which of them took longer.

    Attributes:
        first: a condition.
        second: the other one.
        number: of units that have both.
        longer: of units whose median was longer under the second condition.
        shorter: of units whose median was shorter there; the rest are ties, as two that were
            not reached.
        difference: median over units of second minus first, s; None if the limit hides it.
        p: of the sign test, two-sided and exact, ties left out; None of fewer than two units
            that differ.
        p_holm: p corrected for all comparisons.
    """

    first: str
    second: str
    number: int
    longer: int
    shorter: int
    difference: float | None
    p: float | None
    p_holm: float | None = None


def is_completed(row: Row) -> bool:
    """Returns whether a trial was completed; a row that does not say so was."""
    return str(row.get(SUCCESS, 1)).strip() not in ("0", "0.0", "False")


def find_median(times_s: Sequence[float]) -> float:
    """Returns the median of times, s, of which a censored one is infinite.

    It is infinite, not reached, if half of the trials or more were not completed.
    """
    ordered = sorted(times_s)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0


def find_unit_medians(
    rows: Sequence[Row], unit: str = "participant"
) -> dict[str, dict[str, float]]:
    """Returns the median completion time of every condition and unit, s; infinite: not reached.

    Args:
        rows: trials with `completion_s` and `succeeded`, as `trials.csv` has them.
        unit: the key of what is sampled independently: "participant" or "pair".

    Raises:
        UsageError: a time is no finite number.
    """
    times_s: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if (value := row.get(COMPLETION)) in (None, ""):
            continue
        time_s = read_number(value, COMPLETION, row) if is_completed(row) else math.inf
        times_s.setdefault(str(row["condition"]), {}).setdefault(str(row[unit]), []).append(
            time_s
        )
    return {
        condition: {who: find_median(own) for who, own in each.items()}
        for condition, each in times_s.items()
    }


def summarise_times(
    rows: Sequence[Row], limit_s: float, *, unit: str = "participant"
) -> list[CompletionTime]:
    """Returns the completion time of every condition, in the order of the rows.

    Args:
        rows: as of `find_unit_medians`.
        limit_s: after which a trial was ended.
        unit: likewise.
    """
    found = []
    for condition, medians in find_unit_medians(rows, unit).items():
        trials = [row for row in rows if str(row["condition"]) == condition]
        failed = [row for row in trials if not is_completed(row)]
        ended_s = [read_number(row[COMPLETION], COMPLETION, row) for row in failed]
        found.append(
            CompletionTime(
                condition=condition,
                trials=len(trials),
                censored=len(failed),
                timed_out=sum(time_s >= limit_s - 1e-6 for time_s in ended_s),
                number=len(medians),
                median=_finite(find_median(list(medians.values()))),
                interval=find_median_interval(list(medians.values())),
            )
        )
    return found


def find_median_interval(times_s: Sequence[float]) -> tuple[float, float | None] | None:
    """Returns the interval of a median of at least 95 % by order statistics; None of fewer than
    six times.

    The r-th smallest and the r-th largest time enclose the median with probability 1 - 2 P(B <
    r), B binomial with p = 1/2; r is the largest for which that is 95 % or more. Censored times
    are infinite.
    """
    ordered = sorted(times_s)
    tail = (1.0 - CONFIDENCE) / 2.0
    binomial = import_scipy_stats().binom(len(ordered), 0.5)
    ranks = [r for r in range(1, len(ordered) // 2 + 1) if float(binomial.cdf(r - 1)) <= tail]
    if not ranks or math.isinf(ordered[ranks[-1] - 1]):
        return None
    return ordered[ranks[-1] - 1], _finite(ordered[-ranks[-1]])


def compare_times(
    rows: Sequence[Row], *, unit: str = "participant"
) -> list[CompletionComparison]:
    """Returns the comparison of every two conditions, in the order of the rows.

    A unit counts by which of its two medians is longer; one that was not reached is longer than
    any that was, and two that were not reached are a tie.

    Args:
        rows: as of `find_unit_medians`.
        unit: likewise.
    """
    medians = find_unit_medians(rows, unit)
    found = []
    for first, second in combinations(medians, 2):
        both = [who for who in medians[first] if who in medians[second]]
        pairs = [(medians[first][who], medians[second][who]) for who in both]
        found.append(_compare(first, second, pairs))
    corrected = correct_holm([one.p for one in found])
    return [one._replace(p_holm=p) for one, p in zip(found, corrected, strict=True)]


def _compare(
    first: str, second: str, pairs: Sequence[tuple[float, float]]
) -> CompletionComparison:
    """Returns the comparison of two conditions by the medians that each unit has under them, s."""
    longer = sum(after > before for before, after in pairs)
    shorter = sum(after < before for before, after in pairs)
    untied = longer + shorter
    p = float(import_scipy_stats().binomtest(longer, untied).pvalue) if untied > 1 else None
    return CompletionComparison(
        first=first,
        second=second,
        number=len(pairs),
        longer=longer,
        shorter=shorter,
        difference=_find_median_difference(pairs),
        p=p,
    )


def _find_median_difference(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Returns the median difference, s; None if it depends on medians that were not reached.

    Such a median may lie anywhere above 0, so that each difference lies between two bounds.
    Their median is known where the medians of both bounds agree.
    """
    if not pairs:
        return None
    least = [(after if math.isfinite(after) else 0.0) - before for before, after in pairs]
    most = [after - (before if math.isfinite(before) else 0.0) for before, after in pairs]
    low, high = (float(np.median(bounds)) for bounds in (least, most))
    return low if low == high else None


def _finite(time_s: float) -> float | None:
    """Returns a median, or None for one that was not reached."""
    return time_s if math.isfinite(time_s) else None


def to_table(
    found: Sequence[CompletionTime] | Sequence[CompletionComparison],
) -> list[dict[str, Any]]:
    """Returns a row for each condition or comparison."""
    return [one._asdict() for one in found]

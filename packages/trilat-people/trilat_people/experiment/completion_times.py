"""Completion times of trials with a time limit: medians, confidence intervals and sign tests.

A trial that was not completed has no completion time. If it reached the limit, its time is only
known to exceed the limit (right censoring). If it failed before the limit, the task was never
completed. In both cases, the trial counts as longer than every measured time.

This is sufficient for order statistics. The Kaplan-Meier median is exact if more than half of
the trials were completed; otherwise the median was not reached. A mean would require the
unknown times, and replacing them with the limit would make different conditions look alike.

Invariant:
    - The limit is never used in a sum or a difference.
    - Trials are summarised per unit (a participant or a pair) and condition before units are
      compared, so more trials do not count as more participants.

Sources: Kaplan and Meier, "Nonparametric estimation from incomplete observations", J. American
Statistical Association 53 (1958); Conover, "Practical nonparametric statistics", 3rd edition
(1999), 3.2 and 3.4, for the interval of a median and the sign test.
"""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from .statistics import CONFIDENCE, Row, correct_holm, import_scipy_stats, read_number

COMPLETION = "completion_s"
"""Name of the column with completion times."""
SUCCESS = "succeeded"
"""Name of the column that tells whether a trial was completed."""


class CompletionTime(NamedTuple):
    """Summary of the completion times under one condition.

    Uses medians instead of means, since a trial that was not completed has no completion time
    (it is censored). It counts as longer than every measured time, so a median or an end of a
    confidence interval may lie beyond all measured times (not reached).

    Attributes:
        condition: Name of the condition.
        trials: Number of trials evaluated.
        censored: Number of trials not completed, either because they reached the time limit
            (`timed_out`) or because they failed earlier.
        timed_out: Number of trials that reached the time limit.
        number: Number of units (participants or pairs).
        median: Median over units of each unit's median time, in s. `None` if the median was not
            reached.
        interval: Confidence interval of the median at a level of at least 95 %, from order
            statistics, in s. The upper end is `None` if it was not reached. The entire interval
            is `None` if there are too few units or the lower end was not reached either.
    """

    condition: str
    trials: int
    censored: int
    timed_out: int
    number: int
    median: float | None
    interval: tuple[float, float | None] | None


class CompletionComparison(NamedTuple):
    """Comparison of completion times between two conditions by a sign test.

    A sign test is used because trials that were not completed have no exact time.

    Attributes:
        first: Name of the first condition.
        second: Name of the second condition.
        number: Number of units (participants or pairs) with trials under both conditions.
        longer: Number of units whose median was longer under the second condition.
        shorter: Number of units whose median was shorter under the second condition. The
            remaining units are ties, for example because neither median was reached.
        difference: Median over units of the difference second minus first, in s. `None` if it
            depends on medians that were not reached.
        p: p value of the two-sided exact sign test, excluding ties. `None` if fewer than two
            units differ.
        p_holm: p value corrected for multiple comparisons.
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
    """Returns True if a trial was completed, so that its completion time is known.

    Args:
        row: The trial, with typed values or strings from a CSV file. A row without the key
            `succeeded` counts as completed.
    """
    return str(row.get(SUCCESS, 1)).strip() not in ("0", "0.0", "False")


def find_median(times_s: Sequence[float]) -> float:
    """Computes the median of completion times, in s.

    Args:
        times_s: Times, in s; infinite for trials that were not completed.

    Returns:
        The median; infinite (not reached) if half or more of the trials were not completed.
    """
    sorted_s = sorted(times_s)
    count = len(sorted_s)
    # For an odd number of times, there is a single middle value, and both indices are equal.
    lower_middle_s = sorted_s[(count - 1) // 2]
    upper_middle_s = sorted_s[count // 2]
    return (lower_middle_s + upper_middle_s) / 2.0


def find_unit_medians(
    rows: Sequence[Row], unit: str = "participant"
) -> dict[str, dict[str, float]]:
    """Returns the median completion time of each unit under each condition, in s.

    A unit is a participant, or a pair of participants who take part together. The median is
    infinite if half or more of the trials were not completed in time.

    Args:
        rows: Trials with `completion_s` and `succeeded`, as in `trials.csv`.
        unit: Key of the independently sampled unit: "participant" or "pair".

    Raises:
        UsageError: A time is not a finite number.
    """
    times_s: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        recorded_time = row.get(COMPLETION)
        if recorded_time in (None, ""):
            continue
        time_s = math.inf
        if is_completed(row):
            time_s = read_number(recorded_time, COMPLETION, row)
        times_by_unit = times_s.setdefault(str(row["condition"]), {})
        times_by_unit.setdefault(str(row[unit]), []).append(time_s)

    medians: dict[str, dict[str, float]] = {}
    for condition, times_by_unit in times_s.items():
        unit_medians = {name: find_median(times) for name, times in times_by_unit.items()}
        medians[condition] = unit_medians
    return medians


def summarise_times(
    rows: Sequence[Row], limit_s: float, *, unit: str = "participant"
) -> list[CompletionTime]:
    """Returns the median completion time under each condition, with a confidence interval.

    The median is first taken over the trials of each participant (or pair), and then over the
    participants. It is `None` (not reached) if too many trials were not completed.

    Args:
        rows: Trials as mappings with the keys `condition`, `completion_s`, `succeeded` and the
            key given by `unit`, as in `trials.csv`.
        limit_s: Time limit of a trial, in s.
        unit: "participant" if participants are independent of each other; "pair" if two
            participants did the trials together, so that only pairs are independent.

    Returns:
        One summary per condition, in the order in which the conditions first occur.
    """
    summaries: list[CompletionTime] = []
    for condition, medians_by_unit in find_unit_medians(rows, unit).items():
        medians = list(medians_by_unit.values())
        trials = [row for row in rows if str(row["condition"]) == condition]
        failed_trials = [row for row in trials if not is_completed(row)]
        end_times_s = [read_number(row[COMPLETION], COMPLETION, row) for row in failed_trials]

        # Rounding may make a time that reached the limit slightly shorter.
        timed_out_count = sum(time_s >= limit_s - 1e-6 for time_s in end_times_s)
        summary = CompletionTime(
            condition=condition,
            trials=len(trials),
            censored=len(failed_trials),
            timed_out=timed_out_count,
            number=len(medians),
            median=_replace_infinity(find_median(medians)),
            interval=_find_median_interval(medians),
        )
        summaries.append(summary)
    return summaries


def _find_median_interval(times_s: Sequence[float]) -> tuple[float, float | None] | None:
    """Returns a confidence interval of at least 95 % for a median, from order statistics.

    The r-th smallest and the r-th largest time enclose the median with probability 1 - 2 P(B <
    r), where B is binomial with p = 1/2. r is the largest rank for which this probability is at
    least 95 %.

    Args:
        times_s: Times, in s; infinite for trials that were not completed.

    Returns:
        Lower and upper end, in s. The upper end is `None` if it was not reached. The entire
        interval is `None` if there is no such rank, which is the case for fewer than six times.
    """
    sorted_s = sorted(times_s)
    tail_probability = (1.0 - CONFIDENCE) / 2.0
    binomial = import_scipy_stats().binom(len(sorted_s), 0.5)
    candidates = range(1, len(sorted_s) // 2 + 1)
    ranks = [rank for rank in candidates if float(binomial.cdf(rank - 1)) <= tail_probability]
    if not ranks:
        return None

    largest_rank = ranks[-1]
    low_s = sorted_s[largest_rank - 1]
    high_s = sorted_s[-largest_rank]
    if math.isinf(low_s):
        return None
    return low_s, _replace_infinity(high_s)


def compare_times(
    rows: Sequence[Row], *, unit: str = "participant"
) -> list[CompletionComparison]:
    """Compares the completion times of each pair of conditions by sign tests.

    The comparison is made within each unit (a participant, or a pair of participants), based on
    which condition has the longer median. A median that was not reached counts as longer than
    any median that was reached. Two medians that were not reached count as tied.

    Args:
        rows: Trials, as for `find_unit_medians`.
        unit: The independently sampled unit, "participant" or "pair".

    Returns:
        One comparison per pair of conditions, in the order of the rows.
    """
    medians = find_unit_medians(rows, unit)
    comparisons = []
    for first, second in combinations(medians, 2):
        common_units = [name for name in medians[first] if name in medians[second]]
        median_pairs = [(medians[first][name], medians[second][name]) for name in common_units]
        comparisons.append(_compare(first, second, median_pairs))

    # Many comparisons find a difference by chance. Holm's method corrects the p values.
    corrected_p = correct_holm([comparison.p for comparison in comparisons])
    return [
        comparison._replace(p_holm=p)
        for comparison, p in zip(comparisons, corrected_p, strict=True)
    ]


def _compare(
    first: str, second: str, pairs: Sequence[tuple[float, float]]
) -> CompletionComparison:
    """Compares the completion times of two conditions with a sign test, which needs no means.

    Args:
        first: Name of the first condition.
        second: Name of the second condition.
        pairs: Medians of each unit under both conditions, in s; infinite if a median was not
            reached.
    """
    longer = sum(second_s > first_s for first_s, second_s in pairs)
    shorter = sum(second_s < first_s for first_s, second_s in pairs)
    untied = longer + shorter

    p_value = None
    if untied > 1:  # a single unit cannot show a difference
        p_value = float(import_scipy_stats().binomtest(longer, untied).pvalue)

    return CompletionComparison(
        first=first,
        second=second,
        number=len(pairs),
        longer=longer,
        shorter=shorter,
        difference=_find_median_difference(pairs),
        p=p_value,
    )


def _find_median_difference(pairs: Sequence[tuple[float, float]]) -> float | None:
    """Returns the median of the differences between two conditions, in s.

    A median that was not reached may have any positive value, so each difference lies between
    two bounds. The median difference is known if the medians of both bounds agree.

    Args:
        pairs: Medians of each unit under both conditions, in s.

    Returns:
        The median difference, or `None` if it depends on medians that were not reached.
    """
    if not pairs:
        return None

    lower_bounds: list[float] = []
    upper_bounds: list[float] = []
    for first_s, second_s in pairs:
        shortest_first_s = first_s if math.isfinite(first_s) else 0.0
        shortest_second_s = second_s if math.isfinite(second_s) else 0.0
        lower_bounds.append(shortest_second_s - first_s)
        upper_bounds.append(second_s - shortest_first_s)

    low = float(np.median(lower_bounds))
    high = float(np.median(upper_bounds))
    return low if low == high else None


def _replace_infinity(time_s: float) -> float | None:
    """Returns `None` in place of an infinite median, that is, one that was not reached."""
    return time_s if math.isfinite(time_s) else None

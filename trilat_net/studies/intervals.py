"""95 % confidence intervals over the runs of many seeds: of a share, and of a mean.

Invariant:
    - An interval is a function of its numbers.
    - An interval of a mean has a width unless all numbers are equal.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Returns the 95 % score interval of a share, which has a width even if all runs agree.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", J.
    American Statistical Association 22 (1927); recommended by Brown, Cai and DasGupta,
    "Interval estimation for a binomial proportion", Statistical Science 16 (2001).
    """
    from scipy.stats import binomtest  # the import takes half a second

    if runs == 0:
        return 0.0, 1.0
    low, high = binomtest(successes, runs).proportion_ci(method="wilson")
    return float(low), float(high)


class MeanInterval(NamedTuple):
    """The mean of several runs' numbers, with its 95 % interval by Student's t.

    Attributes:
        mean: the mean.
        half: half the width of the interval.
    """

    mean: float
    half: float

    def __str__(self) -> str:
        return f"{self.mean:.4g} +- {self.half:.2g}"


def mean_interval(values: Sequence[float | None]) -> MeanInterval | None:
    """Returns the mean of at least two numbers; None for fewer, or if a number is missing."""
    known = [value for value in values if value is not None]
    count = len(known)
    if count < 2 or count < len(values):
        return None
    from scipy.special import stdtrit  # the import takes long

    standard_error = float(np.std(known, ddof=1) / np.sqrt(count))
    quantile = float(stdtrit(count - 1, 0.975))
    return MeanInterval(mean=float(np.mean(known)), half=quantile * standard_error)

"""Computes 95 % confidence intervals of a fraction and of a mean over several runs.

If 9 of 10 runs with different random seeds are stable, the stable fraction is still uncertain.
Studies print such a fraction with its Wilson interval, and a mean with its interval by
Student's t distribution.

Invariant:
    - An interval depends only on the arguments.
    - The interval of a mean has a positive width unless all values are equal.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


def wilson_interval(successes: int, runs: int) -> tuple[float, float]:
    """Returns the 95 % Wilson score interval of a fraction, for example of stable runs.

    Unlike the normal approximation, this interval has a positive width even if all runs have
    the same outcome.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", J.
    American Statistical Association 22 (1927); recommended by Brown, Cai and DasGupta,
    "Interval estimation for a binomial proportion", Statistical Science 16 (2001).

    Args:
        successes: Number of successful runs.
        runs: Total number of runs. If 0, the interval is (0, 1).

    Returns:
        The lower and upper bound.
    """
    # Imported here, because the import takes half a second.
    from scipy.stats import binomtest

    if runs == 0:
        return 0.0, 1.0
    test = binomtest(successes, runs)
    low, high = test.proportion_ci(method="wilson")
    return float(low), float(high)


class MeanInterval(NamedTuple):
    """Mean of a quantity over several runs, with its 95 % confidence interval.

    The interval is computed from Student's t distribution. It shows how much the mean might
    differ with other random seeds.

    Attributes:
        mean: The mean.
        half: Half the width of the interval.
    """

    mean: float
    half: float

    def __str__(self) -> str:
        return f"{self.mean:.4g} +- {self.half:.2g}"

    @classmethod
    def of_values(cls, values: Sequence[float | None]) -> "MeanInterval | None":
        """Computes the mean of a quantity over several runs, with its 95 % interval.

        The interval shows the uncertainty of the mean that results from the small number of
        runs.

        Args:
            values: One value per run. `None` for a run without a value.

        Returns:
            The mean and its interval. `None` if there are fewer than two values, or if a value
            is missing.
        """
        known = [value for value in values if value is not None]
        count = len(known)
        if count < 2 or count < len(values):
            return None

        # Imported here, because the import takes long.
        from scipy.special import stdtrit

        deviation = np.std(known, ddof=1)
        standard_error = float(deviation / np.sqrt(count))
        quantile = float(stdtrit(count - 1, 0.975))
        mean = float(np.mean(known))
        return MeanInterval(mean, half=quantile * standard_error)

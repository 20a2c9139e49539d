"""How far a share that some runs show may be from the share of all runs that there could be.

Law: an interval lies within [0, 1] and holds what was seen; with no runs it is all of [0, 1].
"""

import math
from typing import NamedTuple

_TWO_SIDED_95 = 1.959963984540054
"""The 0.975 quantile of the normal distribution."""


class Interval(NamedTuple):
    """From where to where a share may lie."""

    low: float
    high: float


def wilson(successes: int, runs: int) -> Interval:
    """Returns the 95 % score interval of a share.

    With n runs, p = successes / n and z the 0.975 quantile of the normal distribution it is
    (p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n). Unlike p -+ z sqrt(p (1 - p) / n)
    it has a width where all runs agree.

    Args:
        successes: how many runs had it.
        runs: how many there were.

    Returns:
        the interval, shares of 1.

    Source: Wilson, "Probable inference, the law of succession, and statistical inference", J. American
    Statistical Association 22 (1927); recommended by Brown, Cai and DasGupta, "Interval estimation for a
    binomial proportion", Statistical Science 16 (2001).
    """
    if not 0 <= successes <= runs:
        raise ValueError(f"{successes} of {runs} runs is no share")
    if runs == 0:
        return Interval(0.0, 1.0)
    share, weight = successes / runs, _TWO_SIDED_95**2 / runs
    middle = share + weight / 2.0
    half = math.sqrt(weight * (share * (1.0 - share) + weight / 4.0))
    low = (middle - half) / (1.0 + weight) if successes else 0.0
    high = (middle + half) / (1.0 + weight) if successes < runs else 1.0
    return Interval(low, high)

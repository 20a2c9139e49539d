"""Mean and deviation of the age of the sample in use for independent delays, by sums of
products of their distribution.
"""

import math

import numpy as np


def newest_wins(cdf, h_ms):
    """Returns mean and deviation of the age in use: the age exceeds n h if none of the last n
    samples has arrived yet.
    """
    none_yet = np.cumprod(1.0 - cdf(h_ms * np.arange(1, 20_000)))
    return compute_moments(np.concatenate([[1.0], none_yet]), h_ms)


def compute_ordered_moments(cdf, h_ms):
    """Returns the same for links that keep the order: the age exceeds n h unless the n-th
    sample back and all older ones have arrived.
    """
    all_there = np.cumprod(cdf(h_ms * np.arange(1, 20_000))[::-1])[::-1]
    return compute_moments(np.concatenate([[1.0], 1.0 - all_there]), h_ms)


def compute_moments(exceeds, h_ms):
    """Returns mean and deviation of n h, n >= 1, from the probabilities of n > 0, 1, 2..."""
    n = np.arange(len(exceeds))
    mean = h_ms * exceeds.sum()
    return mean, math.sqrt(h_ms**2 * ((2 * n + 1) * exceeds).sum() - mean**2)

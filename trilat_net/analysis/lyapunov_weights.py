"""Weights of the sites' functionals, beta_i = pi_i / c_i, and the conditions under which they exist.

Invariant: pi is the left Perron vector of alpha, c_i the scalar in Kd_i = c_i Kbar. Both conditions are
necessary: beta' Upsilon <= 0 together with Upsilon 1 = 0 forces equality, so there is no slack.
pi as the weight of a delayed consensus is a known result (docs/errata.md); the paper uses ones.
"""

from typing import NamedTuple

import numpy as np

from ..core.dominance import find_reach, perron_vector
from ..core.vectors import Array

KD_SHAPE_TOLERANCE = 1e-9
"""Relative difference up to which two gains are one."""


class LyapunovWeights(NamedTuple):
    """Weights beta, as far as they exist.

    Attributes:
        beta: per site, sum N, so that equal shares give the paper's ones, shape (N,).
        groups: the closed groups of sites, each a tuple of indices: none in it follows a site outside. Of one
            group pi is unique, though some of its entries may be 0.
        scales: c_i of Kd_i = c_i Kbar, c of the first site 1, shape (N,); None if the Kd differ in shape.
    """

    beta: Array
    groups: tuple[tuple[int, ...], ...]
    scales: Array | None


def find_closed_groups(alpha: Array) -> tuple[tuple[int, ...], ...]:
    """Returns the groups of sites that reach each other and no other along shares, alpha shape (N, N)."""
    reach = find_reach(alpha)
    groups = []
    for site in range(len(alpha)):
        group = tuple(np.flatnonzero(reach[site] & reach[:, site]).tolist())
        if group[0] == site and reach[site].sum() == len(group):
            groups.append(group)
    return tuple(groups)


def left_perron_vector(alpha: Array) -> Array:
    """Returns pi >= 0 with pi' alpha = pi' and sum 1, shape (N,); 0 for sites outside of closed groups.

    If several closed groups make it ambiguous, each counts by its number of sites.
    """
    pi = np.zeros(len(alpha))
    groups = find_closed_groups(alpha)
    total = sum(map(len, groups))
    for group in groups:
        pi[list(group)] = perron_vector(alpha[np.ix_(group, group)]) * len(group) / total
    return pi


def find_kd_scales(Kd: Array) -> Array | None:
    """Returns c_i of Kd_i = c_i Kbar with c_1 = 1, or None if there are no such scalars, Kd shape (N, n).

    A number that is NaN is of an axis of the task that its site does not follow. If every Kd is zero, nothing
    couples the sites and any scale holds: ones.
    """
    if not np.nan_to_num(Kd).any():
        return np.ones(len(Kd))
    sizes = Kd[:, np.isfinite(Kd).all(axis=0)].sum(axis=1)
    if not sizes.all():
        return None
    shapes = Kd / sizes[:, np.newaxis]
    if np.nan_to_num(np.fmax.reduce(shapes) - np.fmin.reduce(shapes)).max() > KD_SHAPE_TOLERANCE:
        return None
    scales: Array = sizes / sizes[0]
    return scales


def compute_lyapunov_weights(alpha: Array, Kd: Array) -> LyapunovWeights:
    """Returns beta_i = pi_i / c_i; if the Kd, shape (N, n), differ in shape, pi alone, which lets V rise."""
    scales = find_kd_scales(Kd)
    beta = left_perron_vector(alpha) / (1.0 if scales is None else scales)
    return LyapunovWeights(beta * (len(beta) / beta.sum()), find_closed_groups(alpha), scales)

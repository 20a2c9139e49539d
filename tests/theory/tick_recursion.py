"""The sampled loop at one rate and constant ages by its companion matrix, with all its eigenvalues."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.theory.loops import Array
from trilat_net.analysis.theory.floquet import CoupledTicks
from trilat_net.analysis.theory.operating_point import Equilibrium, OperatingConditions


class TickRecursion(NamedTuple):
    """X_{k+1} = S X_k + sum_d S_d X_{k-d} as one matrix: of the states, then of what acts late, newest first.

    `late` are the places of the states that act after a delay; `constant`: how many were left out.
    """

    whole: Array
    names: tuple[str, ...]
    late: NDArray[np.intp]
    constant: int

    def roots(self, rate_hz: float) -> NDArray[np.complex128]:
        """ln(z) / h of all eigenvalues that are not next to zero, by falling real part, 1/s."""
        z = np.linalg.eigvals(self.whole).astype(np.complex128)
        s = np.log(z[np.abs(z) > 1e-8]) * rate_hz
        return s[np.argsort(-s.real, kind="stable")]


def build_recursion(conditions: OperatingConditions, rest: Equilibrium) -> TickRecursion:
    """Returns the recursion of sites at one rate, a sample of tick m being in use d = max(1,
    ceil(T / h)) ticks later.
    """
    (rate_hz,) = {site.rate_hz for site in conditions.sites}
    loop = CoupledTicks.of_conditions(conditions, rest)
    n = len(loop.S)
    late = np.flatnonzero(np.abs(list(loop.effects.values())).sum(axis=(0, 1)))
    ages = {at: max(1, round(float(conditions.age_s[at]) * rate_hz)) for at in loop.effects}
    depth = max(ages.values())
    c = len(late)
    whole = np.zeros((n + depth * c, n + depth * c))
    whole[:n, :n] = loop.S
    for at, effect in loop.effects.items():
        whole[:n, n + (ages[at] - 1) * c : n + ages[at] * c] += effect[:, late]
    whole[n + np.arange(c), late] = 1.0
    whole[n + c :, n : n + (depth - 1) * c] = np.eye((depth - 1) * c)
    return TickRecursion(whole, loop.names, late, loop.constant)

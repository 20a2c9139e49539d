"""What there is to know of the roots of a loop: the rightmost ones, and those at zero by its structure.

Law: a root at zero that is there whatever the delay (poses that the sites agree on, estimates that nothing
excites) is counted, and never called the rightmost.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .pencil import Complex, Pencil, Solution, solve

SAME = 1e-8
"""Roots that differ by less, of 1 + abs(s), are one."""
EDGE_PER_S = 1e-6
"""A rightmost root within this of the imaginary axis is on it."""
_PART = 0.3
"""A state whose part is at least this share of the largest is named."""


class Root(NamedTuple):
    """One characteristic root, or a pair of conjugate ones.

    Attributes:
        s: the root, with an imaginary part that is not negative, 1/s.
        multiplicity: how many modes share it.
        states: the names of the states that take part in it most, the largest first.
    """

    s: complex
    multiplicity: int
    states: tuple[str, ...]

    @property
    def re_per_s(self) -> float:
        """Its real part: the mode goes as exp of this times t."""
        return self.s.real

    @property
    def im_rad_s(self) -> float:
        """Its imaginary part: the frequency of the mode."""
        return self.s.imag

    @property
    def damping(self) -> float:
        """Its damping ratio, -re / abs(s)."""
        return -self.s.real / abs(self.s)

    @property
    def words(self) -> str:
        """The states that take part most, those of one name together, as in "q2 of m1, m2, s"."""
        sites: dict[str, list[str]] = {}
        for state in self.states:
            site, _, name = state.partition(".")
            sites.setdefault(name, []).append(site)
        return "; ".join(f"{name} of {', '.join(sorted(who))}" for name, who in sites.items())


class Spectrum(NamedTuple):
    """Roots of a loop.

    Attributes:
        roots: the rightmost ones that are not zero by structure, by falling real part.
        zeros: how many roots are zero by structure.
        drifting: how many of those only drift: they have no vector of their own, and grow with t.
        dropped: how many candidates were no roots.
        order: of the discretisation that gave the candidates; 0 where none was needed.
    """

    roots: tuple[Root, ...]
    zeros: int
    drifting: int
    dropped: int
    order: int

    @property
    def rightmost(self) -> Root | None:
        """The rightmost root that is not zero by structure."""
        return self.roots[0] if self.roots else None

    @property
    def verdict(self) -> str:
        """stable, unstable, or at the edge."""
        re = self.roots[0].s.real if self.roots else -math.inf
        if re > EDGE_PER_S:
            return "unstable"
        return "at the edge" if re >= -EDGE_PER_S or self.drifting else "stable"


def refined(
    pencil: Pencil,
    candidates: Complex,
    names: Sequence[str],
    wanted: int,
    tries: int | None = None,
    period_rad_s: float = math.inf,
) -> tuple[list[Root], int]:
    """Returns the rightmost roots near some candidates, and how many candidates were dropped.

    Args:
        pencil: the problem.
        candidates: guesses of nonzero roots, shape (K,), by falling real part.
        names: of the states.
        wanted: how many roots.
        tries: after how many roots the rest of the candidates is left; by default two more than wanted,
            because Newton may change their order.
        period_rad_s: imaginary parts that differ by it are the same, as those of sampled loops are.
    """
    found: list[Solution] = []
    dropped = 0
    for guess in candidates:
        if guess.imag < -SAME * (1.0 + abs(guess)):
            continue
        if len(found) >= (tries or wanted + 2):
            break
        solution = solve(pencil, complex(guess))
        if solution is None or abs(solution.s) < SAME:
            dropped += 1
            continue
        solution = solution._replace(s=_folded(solution.s, period_rad_s))
        if not any(_same(solution.s, other.s) for other in found):
            found.append(solution)
    found.sort(key=lambda one: -one.s.real)
    return [_root(one, names) for one in found[:wanted]], dropped


def _folded(s: complex, period_rad_s: float) -> complex:
    if math.isinf(period_rad_s):
        return s
    return complex(s.real, math.remainder(s.imag, period_rad_s))


def _same(a: complex, b: complex) -> bool:
    return min(abs(a - b), abs(a - b.conjugate())) < SAME * (1.0 + abs(a))


def _root(found: Solution, names: Sequence[str]) -> Root:
    s = complex(found.s.real, abs(found.s.imag) if abs(found.s.imag) > SAME else 0.0)
    part = found.taking_part
    order = [int(n) for n in np.argsort(-part, kind="stable") if part[n] >= _PART * part.max()]
    return Root(s, found.multiplicity, tuple(names[n] for n in order))


def sorted_guesses(values: NDArray[np.complex128], zeros: int) -> Complex:
    """Returns eigenvalues without the smallest ones, which stand for zeros, by falling real part."""
    kept = values[np.argsort(np.abs(values), kind="stable")][zeros:]
    return kept[np.lexsort((np.abs(kept.imag), -kept.real))]

"""The front of error against effort: the runs that no other one is better than in both.

Law: both objectives are minimised; only runs that settled compete, and of two with equal objectives the one
that was tried first stays.
"""

from collections.abc import Sequence
from enum import StrEnum

from .measurement import Score
from .outcome import Outcome

Point = tuple[float, float]


class Objective(StrEnum):
    """What is weighed against effort."""

    ERROR = "error"
    SETTLING = "settling"

    @property
    def unit(self) -> str:
        """Its unit."""
        return "rad" if self is Objective.ERROR else "s"

    def of(self, score: Score) -> float | None:
        """Returns what it is in a run; None where the run has none."""
        return score.error_rad if self is Objective.ERROR else score.settled_s

    def point(self, score: Score) -> Point | None:
        """Returns (objective, effort) of a run that may stand on a front, else None."""
        value = self.of(score)
        if score.outcome is not Outcome.SETTLED or value is None or score.effort_nm is None:
            return None
        return value, score.effort_nm


def dominates(a: Point, b: Point) -> bool:
    """True where a is no worse than b in both, and better in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


def front(points: Sequence[Point | None]) -> list[int]:
    """Returns the places of the points that none dominates, by rising effort.

    Args:
        points: (objective, effort) of every run; None for one that does not compete.
    """
    order = sorted((point[1], point[0], n) for n, point in enumerate(points) if point is not None)
    kept: list[int] = []
    least = float("inf")
    for _, value, n in order:
        if value < least:
            kept.append(n)
            least = value
    return kept


def crowding(points: Sequence[Point]) -> list[float]:
    """Returns how alone each point of a front is: the side of the box between its neighbours; ends: inf.

    After Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist multiobjective genetic algorithm: NSGA-II",
    IEEE Trans. Evolutionary Computation 6 (2002).

    Args:
        points: a front, by rising effort.
    """
    if len(points) < 3:
        return [float("inf")] * len(points)
    spans = [abs(points[-1][axis] - points[0][axis]) or 1.0 for axis in (0, 1)]
    inner = [
        sum(abs(after[axis] - before[axis]) / spans[axis] for axis in (0, 1))
        for before, after in zip(points[:-2], points[2:], strict=True)
    ]
    return [float("inf"), *inner, float("inf")]

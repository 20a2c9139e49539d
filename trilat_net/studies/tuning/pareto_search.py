"""The search that every control law gets, and the Pareto front of error against effort.

Invariant: the gains tried are a function of the seed, the search space and the scores of earlier rounds;
their number is the budget. Half is a Latin hypercube in the logarithm of the gains (McKay, Beckman and
Conover, Technometrics 21, 1979), half refinement of its front. Both objectives are minimised, only stable
runs at the pose compete, and of equal ones the first stays.
"""

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from ...core.vectors import Array
from .candidate import CandidateScore
from .final_posture import CandidateClass
from .search_space import SearchSpace

ObjectivePoint = tuple[float, float]


class Objective(StrEnum):
    """What is weighed against effort."""

    ERROR = "error"
    SETTLING = "settling"

    @property
    def unit(self) -> str:
        """Its unit."""
        return "rad" if self is Objective.ERROR else "s"

    def point(self, score: CandidateScore) -> ObjectivePoint | None:
        """Returns (objective, effort) of a run that may stand on a front, else None."""
        value = score.error_rad if self is Objective.ERROR else score.settled_s
        if score.outcome is not CandidateClass.SETTLED or value is None or score.effort_nm is None:
            return None
        return value, score.effort_nm


def find_pareto_front(points: Sequence[ObjectivePoint | None]) -> list[int]:
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


def compute_crowding(points: Sequence[ObjectivePoint]) -> list[float]:
    """Returns how alone each point of a front is: the side of the box between its neighbours; ends: inf.

    After Deb, Pratap, Agarwal and Meyarivan, "A fast and elitist multiobjective genetic algorithm: NSGA-II",
    IEEE Trans. Evolutionary Computation 6 (2002).
    """
    if len(points) < 3:
        return [float("inf")] * len(points)
    spans = [abs(points[-1][axis] - points[0][axis]) or 1.0 for axis in (0, 1)]
    inner = [
        sum(abs(after[axis] - before[axis]) / spans[axis] for axis in (0, 1))
        for before, after in zip(points[:-2], points[2:], strict=True)
    ]
    return [float("inf"), *inner, float("inf")]


REFINEMENT_STEPS = (0.12, 0.08, 0.05, 0.03)
"""Deviation of the refinements, round by round, as a share of the logarithm of a gain's range."""
GAIN_DIGITS = 4
"""Gains are rounded to so many significant digits before they are tried, so that a command can name them."""

CandidateGains = dict[str, float]


class CandidateSearch:
    """One law's search, and what it found.

    Attributes:
        tried: the gains that were tried, in order.
        scores: what came of them, in the same order.
        rounds: how many candidates each round has; the budget in all.
    """

    def __init__(self, space: SearchSpace, budget: int, seed: int, objective: Objective) -> None:
        self.space = space
        self.tried: list[CandidateGains] = []
        self.scores: list[CandidateScore] = []
        self._objective = objective
        self._rng = np.random.default_rng(seed)  # the same for every law
        self._logs = np.log([[knob.low, knob.high] for knob in space.knobs])
        first, count = (budget + 1) // 2, len(REFINEMENT_STEPS)
        share, more = divmod(budget - first, count)
        self.rounds = [first, *(share + (n < more) for n in range(count))]

    @property
    def points(self) -> list[ObjectivePoint | None]:
        """(objective, effort) of every candidate; None of one that may stand on no front."""
        return [self._objective.point(score) for score in self.scores]

    @property
    def front(self) -> list[int]:
        """Places of the candidates that none of the same law dominates, by rising effort."""
        return find_pareto_front(self.points)

    @property
    def outcomes(self) -> dict[CandidateClass, int]:
        """How many candidates are of each class, all of them counted."""
        return {outcome: sum(score.outcome is outcome for score in self.scores) for outcome in CandidateClass}

    def ask(self, number: int) -> list[CandidateGains]:
        """Returns the candidates of a round; `tell` has taken all earlier ones."""
        shape = self.rounds[number], len(self.space.knobs)
        if number == 0:
            from scipy.stats import qmc  # takes half a second, which most commands can do without

            places = qmc.LatinHypercube(shape[1], rng=self._rng).random(shape[0])
        else:
            parents = self._parents(shape[0])
            moved = parents + REFINEMENT_STEPS[number - 1] * self._rng.standard_normal(shape)
            places = np.clip(moved, 0.0, 1.0)
        return [self._gains(place) for place in places]

    def tell(self, gains: Sequence[CandidateGains], scores: Sequence[CandidateScore]) -> None:
        """Takes what came of a round's candidates."""
        self.tried += gains
        self.scores += scores

    def _parents(self, count: int) -> Array:
        """Returns places to refine: every other time the best, else the loneliest points of the front.

        Where nothing settled yet, those that erred least without diverging; where all diverged, anything.
        """
        points, places = self.points, self.front
        if places:
            lonely = compute_crowding([points[n] or (0.0, 0.0) for n in places])
            by_space = [n for _, n in sorted(zip(lonely, places, strict=True), key=lambda pair: -pair[0])]
            best = places[-1]
        else:
            errors = [(s.outcome is CandidateClass.DIVERGED, s.error_rad or 0.0) for s in self.scores]
            by_space = sorted(range(len(errors)), key=errors.__getitem__)
            by_space, best = by_space[: max(1, count // 4)], by_space[0]
        chosen = [best if k % 2 == 0 else by_space[k // 2 % len(by_space)] for k in range(count)]
        tried = [[self.tried[n][knob.name] for knob in self.space.knobs] for n in chosen]
        logs = np.log(np.reshape(tried, (count, len(self.space.knobs))))
        parents: Array = (logs - self._logs[:, 0]) / (self._logs[:, 1] - self._logs[:, 0])
        return parents

    def _gains(self, place: Array) -> CandidateGains:
        logs = self._logs[:, 0] + place * (self._logs[:, 1] - self._logs[:, 0])
        return {
            knob.name: min(max(float(f"{np.exp(log):.{GAIN_DIGITS}g}"), knob.low), knob.high)
            for knob, log in zip(self.space.knobs, logs, strict=True)
        }

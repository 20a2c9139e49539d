"""The search that every law gets: half a Latin hypercube, half refinement of what it found.

Law: which gains are tried is a function of the search's seed, the law's table and the scores of earlier
rounds; how many is the budget, for every law, whatever they come to. Laws with as many gains begin at the
same places of their ranges.

Latin hypercube after McKay, Beckman and Conover, "A comparison of three methods for selecting values of input
variables", Technometrics 21 (1979), in the logarithm of every gain.
"""

from collections.abc import Sequence

import numpy as np

from ..core.arm import Array
from .front import Objective, crowding, front
from .measurement import Score
from .outcome import Outcome
from .space import Space

STEPS = (0.12, 0.08, 0.05, 0.03)
"""Deviation of the refinements, round by round, as a share of the logarithm of a gain's range."""
DIGITS = 4
"""Gains are rounded to so many significant digits before they are tried, so that they can be told."""

Gains = dict[str, float]


class Search:
    """One law's search.

    Args:
        space: where.
        budget: how many candidates in all, at least 1.
        seed: what chance is a function of.
        objective: what is weighed against effort.

    Attributes:
        space: where.
        tried: what was tried, in order.
        scores: what came of it, in the same order.
    """

    def __init__(self, space: Space, budget: int, seed: int, objective: Objective) -> None:
        self.space = space
        self.tried: list[Gains] = []
        self.scores: list[Score] = []
        self._objective = objective
        self._rng = np.random.default_rng(seed)  # the same for every law
        self._logs = np.log([[knob.low, knob.high] for knob in space.knobs])
        first = (budget + 1) // 2
        self._rounds = [first, *_parts(budget - first, len(STEPS))]

    @property
    def rounds(self) -> list[int]:
        """How many candidates each round has."""
        return list(self._rounds)

    def ask(self, number: int) -> list[Gains]:
        """Returns the candidates of a round, all earlier ones of which were told."""
        count = self._rounds[number]
        places = self._hypercube(count) if number == 0 else self._refined(count, STEPS[number - 1])
        return [self._gains(place) for place in places]

    def tell(self, gains: Sequence[Gains], scores: Sequence[Score]) -> None:
        """Takes what came of a round's candidates."""
        self.tried += gains
        self.scores += scores

    def _hypercube(self, count: int) -> Array:
        """Returns one point in every row and column of a grid, shape (count, knobs), from 0 to 1."""
        columns = [self._rng.permutation(count) for _ in self.space.knobs]
        points: Array = (np.stack(columns, axis=1) + self._rng.random((count, len(columns)))) / count
        return points

    def _refined(self, count: int, step: float) -> Array:
        """Returns points beside the parents, shape (count, knobs), within the ranges."""
        parents = self._parents(count).reshape(count, len(self.space.knobs))
        moved: Array = np.clip(parents + step * self._rng.standard_normal(parents.shape), 0.0, 1.0)
        return moved

    def _parents(self, count: int) -> Array:
        """Returns what to refine: every other time the best, else the loneliest points of the front.

        Where nothing settled yet, those that erred least without diverging; where all diverged, anything.
        """
        points = [self._objective.point(score) for score in self.scores]
        places = front(points)
        if places:
            lonely = crowding([points[n] or (0.0, 0.0) for n in places])
            by_space = [n for _, n in sorted(zip(lonely, places, strict=True), key=lambda pair: -pair[0])]
            best = places[-1]
        else:
            by_space = sorted(range(len(self.scores)), key=lambda n: _distress(self.scores[n]))
            by_space, best = by_space[: max(1, count // 4)], by_space[0]
        chosen = [best if k % 2 == 0 else by_space[k // 2 % len(by_space)] for k in range(count)]
        parents: Array = np.array([self._place(self.tried[n]) for n in chosen])
        return parents

    def _gains(self, place: Array) -> Gains:
        logs = self._logs[:, 0] + place * (self._logs[:, 1] - self._logs[:, 0])
        return {
            knob.name: min(max(float(f"{np.exp(log):.{DIGITS}g}"), knob.low), knob.high)
            for knob, log in zip(self.space.knobs, logs, strict=True)
        }

    def _place(self, gains: Gains) -> Array:
        logs = np.log([gains[knob.name] for knob in self.space.knobs])
        place: Array = (logs - self._logs[:, 0]) / (self._logs[:, 1] - self._logs[:, 0])
        return place


def _parts(total: int, count: int) -> list[int]:
    """Returns a total in parts that differ by one at most."""
    return [total // count + (n < total % count) for n in range(count)]


def _distress(score: Score) -> tuple[bool, float]:
    """Sorts runs that did not settle: diverged ones last, else by error."""
    return score.outcome is Outcome.DIVERGED, score.error_rad or 0.0

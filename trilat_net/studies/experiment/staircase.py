"""Adaptive staircases: pairs of trials, of which participants say in which one there was more
of something.

In one trial of a pair a key of the scenario has its standard value, in the other one more than
that; which comes first is drawn. After `down` right answers in a row the difference is divided
by a factor, after a wrong one multiplied by it (Levitt, 1971). It settles where both are
equally likely: where the answer is right with probability 0.5^(1 / down), 0.707 for two.

Invariant: the differences of a block are a function of the protocol and of the answers to its
pairs so far.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import numpy as np
from msgspec import Meta

from ...fields import Frozen, Positive
from .questionnaires import CHOICE, Questionnaire, Words

STANDARD = "standard"
COMPARISON = "comparison"
SKIPPED = 2
"""So many reversals come before the difference is about where it settles."""


class Staircase(Frozen, frozen=True):
    """A key of the scenario that is adapted to what a participant can tell, in each condition
    by itself.

    Attributes:
        key: of the scenario.
        start: the first difference, and the largest, in the key's unit.
        standard: the value that is compared with.
        factor: by which the difference changes.
        down: right answers in a row after which it becomes less.
        asks: the question after each pair.
        deviation: of what synthetic participants perceive, in the key's unit; None: a quarter
            of `start`.
    """

    key: str
    start: Positive
    standard: float = 0.0
    factor: Annotated[float, Meta(gt=1.0, le=10.0)] = 1.5
    down: Annotated[int, Meta(ge=1, le=5)] = 2
    asks: Words = "In which of the last two trials was it stronger?"
    deviation: Positive | None = None

    @property
    def measure(self) -> str:
        """The name of its threshold, with the key's unit, as threshold_delay_ms of
        link.delay_ms.
        """
        return "threshold_" + [part for part in self.key.split(".") if not part.isdigit()][-1]

    @property
    def form(self) -> Questionnaire:
        """What is asked after each pair; the answer is 1 or 2."""
        items = {CHOICE: self.asks}
        ends = ("the first", "the second")
        return Questionnaire(
            CHOICE, title="Which one?", items=items, low=ends[0], high=ends[1], most=2
        )

    def _list_ways(self, right: Sequence[bool]) -> list[int]:
        """Returns whether the difference becomes less, -1, or more, 1, after each answer; 0: it
        stays.
        """
        ways = list[int]()
        in_row = 0
        for is_right in right:
            in_row = in_row + 1 if is_right else 0
            ways.append(-int(in_row % self.down == 0) if is_right else 1)
        return ways

    def list_differences(self, right: Sequence[bool]) -> list[float]:
        """Returns the difference in each pair and the next one, by which answers so far were
        right.
        """
        differences = [self.start]
        for way in self._list_ways(right):
            differences.append(min(differences[-1] * self.factor**way, self.start))
        return differences

    def find_threshold(self, right: Sequence[bool]) -> float | None:
        """Returns the geometric mean of the differences where the staircase turned, in the
        key's unit.

        The first two turns do not count, nor the third of an odd number; None: less than two
        are left.
        """
        ways = zip(self.list_differences(right), self._list_ways(right), strict=False)
        changes = [(difference, way) for difference, way in ways if way]
        turns = [here for (_, before), (here, way) in pairwise(changes) if way != before]
        kept = turns[SKIPPED + len(turns) % 2 :]
        return float(np.exp(np.mean(np.log(kept)))) if kept else None

    def draw_choice(self, difference: float, comparison: int, seed: int) -> int:
        """Returns the trial, 1 or 2, that a synthetic participant chooses, of whom `comparison`
        had more.

        It perceives each with a normal error, so that it is right with probability
        Phi(difference / (sqrt(2) deviation)) (Green and Swets, 1966).
        """
        deviation = self.deviation or self.start / 4.0
        perceived = (
            difference
            + 2.0**0.5 * deviation * np.random.default_rng([seed, 2]).standard_normal()
        )
        return comparison if perceived > 0.0 else 3 - comparison

    def describe(self) -> str:
        """Returns it in a sentence of a methods paragraph."""
        return (
            f"{self.key} was adapted in a two-interval forced choice against {self.standard:g}: from a "
            f"difference of {self.start:g}, divided by {self.factor:g} after {self.down} right answers in a "
            f"row and multiplied by it after a wrong one (Levitt, 1971); a threshold, of "
            f"{100.0 * 0.5 ** (1.0 / self.down):.1f} % right answers, is the geometric mean of the "
            f"differences at its reversals but the first {SKIPPED}"
        )

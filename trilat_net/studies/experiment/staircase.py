"""Adaptive staircases: pairs of trials, after each of which the participant compares the two.

In one trial of a pair, a key of the scenario has its standard value, in the other a larger one;
their order is drawn. After `down` right answers in a row the difference is divided by `factor`,
and after a wrong answer multiplied by it (Levitt, 1971). The difference settles where both are
equally likely, that is, where the probability of a right answer is 0.5^(1 / down): 0.707 for
`down` = 2.

Invariant:
    - The differences of a block are a function of the protocol and of the answers to its pairs
      so far.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import numpy as np
from msgspec import Meta

from ...fields import Frozen, Positive
from .questionnaires import CHOICE, Questionnaire, Text

STANDARD = "standard"
COMPARISON = "comparison"
SKIPPED_REVERSALS = 2
"""Number of reversals before the difference is near its final value."""


class Staircase(Frozen, frozen=True):
    """A key of the scenario that is adapted to the participant's perception, in each condition.

    Attributes:
        key: the key of the scenario.
        start: the first difference, which is also the largest, in the key's unit.
        standard: the value to compare with.
        factor: the factor by which the difference changes.
        down: the number of right answers in a row after which the difference decreases.
        asks: the question after each pair.
        deviation: standard deviation of a synthetic participant's perception, in the key's
            unit; None stands for a quarter of `start`.
    """

    key: str
    start: Positive
    standard: float = 0.0
    factor: Annotated[float, Meta(gt=1.0, le=10.0)] = 1.5
    down: Annotated[int, Meta(ge=1, le=5)] = 2
    asks: Text = "In which of the last two trials was it stronger?"
    deviation: Positive | None = None

    @property
    def measure(self) -> str:
        """The threshold's name with its unit: threshold_delay_ms for link.delay_ms."""
        return "threshold_" + [part for part in self.key.split(".") if not part.isdigit()][-1]

    @property
    def form(self) -> Questionnaire:
        """The questionnaire after each pair; the answer is 1 or 2."""
        items = {CHOICE: self.asks}
        ends = ("the first", "the second")
        return Questionnaire(
            CHOICE, title="Which one?", items=items, low=ends[0], high=ends[1], most=2
        )

    def _list_directions(self, right: Sequence[bool]) -> list[int]:
        """Returns the direction after each answer: -1 down, 1 up, or 0 for no change."""
        ways = list[int]()
        in_row = 0
        for is_right in right:
            in_row = in_row + 1 if is_right else 0
            ways.append(-int(in_row % self.down == 0) if is_right else 1)
        return ways

    def list_differences(self, right: Sequence[bool]) -> list[float]:
        """Returns the difference of each pair, and of the next one.

        Args:
            right: whether each answer so far was right.
        """
        differences = [self.start]
        for way in self._list_directions(right):
            differences.append(min(differences[-1] * self.factor**way, self.start))
        return differences

    def find_threshold(self, right: Sequence[bool]) -> float | None:
        """Returns the threshold, in the key's unit: the geometric mean of the reversals.

        The first two reversals do not count, and neither does the third of an odd number.
        Returns None if fewer than two are left.

        Args:
            right: whether each answer was right.
        """
        pairs = zip(self.list_differences(right), self._list_directions(right), strict=False)
        changes = [(difference, direction) for difference, direction in pairs if direction]
        reversals = [
            difference
            for (_, previous), (difference, direction) in pairwise(changes)
            if direction != previous
        ]
        counted = reversals[SKIPPED_REVERSALS + len(reversals) % 2 :]
        return float(np.exp(np.mean(np.log(counted)))) if counted else None

    def draw_choice(self, difference: float, comparison: int, seed: int) -> int:
        """Returns the trial of a pair, 1 or 2, that a synthetic participant chooses.

        The participant perceives each trial with a normal error, so that the choice is right
        with probability Phi(difference / (sqrt(2) deviation)) (Green and Swets, 1966).

        Args:
            difference: the difference of the pair, in the key's unit.
            comparison: the trial with the larger value, 1 or 2.
            seed: the seed of the choice.
        """
        deviation = self.deviation or self.start / 4.0
        error = 2.0**0.5 * deviation * np.random.default_rng([seed, 2]).standard_normal()
        return comparison if difference + error > 0.0 else 3 - comparison

    def describe(self) -> str:
        """Returns the procedure as a sentence of a methods paragraph."""
        right_percent = 100.0 * 0.5 ** (1.0 / self.down)
        return (
            f"{self.key} was adapted in a two-interval forced choice against "
            f"{self.standard:g}: from a difference of {self.start:g}, divided by "
            f"{self.factor:g} after {self.down} right answers in a row and multiplied by it "
            "after a wrong one (Levitt, 1971); a "
            f"threshold, of {right_percent:.1f} % right answers, is the geometric mean of the "
            f"differences at its reversals but the first {SKIPPED_REVERSALS}"
        )

"""Measures the smallest difference that a participant perceives, with an adaptive staircase.

A staircase consists of pairs of trials. In one trial of a pair, a scenario key has its standard
value, in the other a larger value; the order is drawn at random. After each pair, the
participant says in which trial the value was larger. The difference is divided by `factor`
after `down` consecutive right answers, and multiplied by `factor` after a wrong answer (Levitt,
1971). It converges to the difference at which steps down and up are equally likely, where the
probability of a right answer is 0.5^(1 / down), for example 0.707 for `down` = 2.

Invariant:
    - The differences in a block depend only on the protocol and on the earlier answers in the
      block.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import numpy as np
from msgspec import Meta

from trilat_net.fields import Frozen, Positive

from .questionnaires import CHOICE, Questionnaire, Text

STANDARD = "standard"
"""Phase of a trial with the standard value."""
COMPARISON = "comparison"
"""Phase of a trial with the larger value."""
SKIPPED_REVERSALS = 2
"""Number of reversals before the difference is near its final value."""


class Staircase(Frozen, frozen=True):
    """Settings of a perception test for the smallest difference that a participant notices.

    Trials come in pairs. A scenario key, such as the delay, has its standard value in one trial
    of a pair and a larger value in the other. The participant says in which trial the value was
    larger. The difference between the two values decreases after right answers and increases
    after wrong answers.

    Attributes:
        key: The scenario key to vary.
        start: Initial and largest difference, in the unit of the key.
        standard: Value of the key in the standard trial, in the unit of the key.
        factor: Factor by which the difference changes.
        down: Number of consecutive right answers after which the difference decreases.
        asks: Question asked after each pair.
        deviation: Standard deviation of a synthetic participant's perception, in the unit of
            the key. If `None`, a quarter of `start`.
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
        """Name of the measured perception threshold, including its unit.

        Composed of "threshold_" and the last part of the varied key. For example,
        `link.delay_ms` gives threshold_delay_ms.
        """
        parts = [part for part in self.key.split(".") if not part.isdigit()]
        return f"threshold_{parts[-1]}"

    @property
    def form(self) -> Questionnaire:
        """Question asked after each pair of trials.

        The answer, 1 or 2, is the trial of the pair in which the varied quantity, such as a
        delay, seemed larger.
        """
        return Questionnaire(
            name=CHOICE,
            title="Which one?",
            items={CHOICE: self.asks},
            low="the first",
            high="the second",
            most=2,
        )

    def _list_directions(self, right: Sequence[bool]) -> list[int]:
        """Returns the direction in which the tested difference changes after each answer.

        The difference decreases after `down` right answers in a row, and increases after a
        wrong answer.

        Args:
            right: For each answer, True if it was right.

        Returns:
            For each answer, -1 for down, 1 for up, or 0 for no change.
        """
        directions: list[int] = []
        right_in_row = 0
        for is_right in right:
            if not is_right:
                right_in_row = 0
                directions.append(1)
                continue
            right_in_row += 1
            is_row_complete = right_in_row % self.down == 0
            directions.append(-1 if is_row_complete else 0)
        return directions

    def list_differences(self, right: Sequence[bool]) -> list[float]:
        """Lists the differences that a participant has compared so far, and the next one.

        The difference decreases after `down` consecutive right answers and increases after a
        wrong answer, up to its initial value.

        Args:
            right: One entry per answered pair, in order: True if the answer was right.

        Returns:
            The differences in the unit of the key, one per answered pair and one for the next
            pair.
        """
        differences = [self.start]
        for direction in self._list_directions(right):
            difference = differences[-1] * self.factor**direction
            differences.append(min(difference, self.start))
        return differences

    def find_threshold(self, right: Sequence[bool]) -> float | None:
        """Returns the perception threshold, to which the staircase has converged.

        The threshold is the geometric mean of the differences at the reversals, that is, at
        steps in the opposite direction to the previous step. The first two reversals are
        excluded, since the difference is still far from its final value. If the number of
        reversals is odd, the third is also excluded, to balance upward and downward reversals.

        Args:
            right: One entry per answer: True if the answer was right.

        Returns:
            The threshold in the unit of the key, or `None` if no reversals remain.
        """
        # There is one more difference than directions: that of the next pair.
        pairs = zip(self.list_differences(right), self._list_directions(right), strict=False)
        steps = [(difference, direction) for difference, direction in pairs if direction]

        reversals: list[float] = []
        for (_, previous_direction), (difference, direction) in pairwise(steps):
            if direction != previous_direction:
                reversals.append(difference)

        skipped_count = SKIPPED_REVERSALS + len(reversals) % 2
        counted = reversals[skipped_count:]
        if not counted:
            return None
        return float(np.exp(np.mean(np.log(counted))))

    def draw_choice(self, difference: float, comparison: int, seed: int) -> int:
        """Draws which trial of a pair a synthetic participant chooses.

        The perception of each trial has a normally distributed error. The choice is therefore
        right with probability Phi(difference / (sqrt(2) deviation)) (Green and Swets, 1966).

        Args:
            difference: Difference within the pair, in the unit of the key.
            comparison: Number of the trial with the larger value, 1 or 2.
            seed: Random seed.

        Returns:
            Number of the chosen trial, 1 or 2.
        """
        deviation = self.deviation or self.start / 4.0
        random = np.random.default_rng([seed, 2])
        # The difference between two normal errors has sqrt(2) times their standard deviation.
        error = 2.0**0.5 * deviation * random.standard_normal()
        standard_trial = 3 - comparison  # the other of the numbers 1 and 2
        perceived_difference = difference + error
        return comparison if perceived_difference > 0.0 else standard_trial

    def describe(self) -> str:
        """Describes in one sentence, for use in a paper, how the threshold was measured.

        The sentence states the key, its standard value, the rule for the differences, and the
        proportion of right answers at the threshold.
        """
        right_percent = 100.0 * 0.5 ** (1.0 / self.down)
        return (
            f"{self.key} was adapted in a two-interval forced choice against "
            f"{self.standard:g}: from a difference of {self.start:g}, divided by "
            f"{self.factor:g} after {self.down} right answers in a row and multiplied by it "
            "after a wrong one (Levitt, 1971); a "
            f"threshold, of {right_percent:.1f} % right answers, is the geometric mean of the "
            f"differences at its reversals but the first {SKIPPED_REVERSALS}"
        )

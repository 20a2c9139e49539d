"""Questionnaires that people answer on the page of an experiment.

NASA-TLX (workload), SUS (usability) and a questionnaire on the sense of agency are built in. A
protocol may define others.

Invariant:
    - An answer is a number on the scale of the questionnaire, or `None`. Anything else is
      rejected.
    - `None` represents an unanswered item, such as a slider that was never touched. It is
      stored and counted as missing.
    - A questionnaire with a missing answer has no score.
"""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, field
from msgspec.structs import replace

from trilat_net.errors import UsageError, count_nouns
from trilat_net.fields import Frozen

from .movement_measures import raw_tlx, sus_score

Name = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
Text = Annotated[str, Meta(max_length=300)]

CHOICE = "choice"
"""Name of the form shown after a pair of staircase trials, which must be answered."""
Answers = Mapping[str, float | None]
"""Mapping from item to answer; `None` for a missing answer."""


class Questionnaire(Frozen, frozen=True):
    """A questionnaire that participants answer on a web page.

    For a built-in questionnaire, such as the NASA Task Load Index, the name alone is
    sufficient.

    Attributes:
        name: Name of a built-in questionnaire (`tlx`, `sus`, `agency`), or any other name.
        after: "block" to ask after each block, or "experiment" to ask once, after the last
            block.
        title: Heading of the form.
        items: Mapping from item name (as used in the result table) to the text of the item.
        low: Label of the lower end of the scale.
        high: Label of the upper end of the scale.
        ends: Mapping from the name of an item that does not use `low` and `high` to the labels
            of both ends of its scale.
        least: Smallest value of the scale.
        most: Largest value of the scale.
        step: Step between two values of the scale.
    """

    name: Name
    after: Literal["block", "experiment"] = "block"
    title: Text = ""
    items: Annotated[dict[Name, Text], Meta(max_length=40)] = field(default_factory=dict)
    low: Text = ""
    high: Text = ""
    ends: dict[Name, tuple[Text, Text]] = field(default_factory=dict)
    least: int = 1
    most: int = 7
    step: Annotated[int, Meta(ge=1)] = 1

    @property
    def is_forced(self) -> bool:
        """True if every item must be answered, as in a perception test.

        Items of other questionnaires may be left unanswered.
        """
        return self.name == CHOICE

    def read(self, values: Sequence[float | None]) -> dict[str, float | None]:
        """Validates a participant's answers from a web page.

        Args:
            values: Answers in the order of the items; `None` for a missing answer.

        Returns:
            Mapping from item name to answer; `None` for a missing answer.

        Raises:
            UsageError: The number of values differs from the number of items, a value is not on
                the scale, or a required answer is missing.
        """
        are_valid = all(self._is_valid(value) for value in values)
        if len(values) != len(self.items) or not are_valid:
            count = count_nouns(len(self.items), "answer")
            raise UsageError(
                f"{self.name}: give {count} between {self.least} and {self.most}, "
                f"in steps of {self.step}"
            )
        return dict(zip(self.items, values, strict=True))

    def _is_valid(self, value: float | None) -> bool:
        """Returns True if an answer is on the scale, or is missing but not required.

        A scale of 0 to 100 in steps of 5 has the values 0, 5, 10 and so on. A missing answer is
        `None`.
        """
        if value is None:
            return not self.is_forced
        return value in range(self.least, self.most + 1, self.step)

    def score(self, answers: Answers) -> float | None:
        """Computes the score of a completed questionnaire.

        Args:
            answers: Mapping from item name to answer.

        Returns:
            The raw NASA Task Load Index for `tlx`, the System Usability Scale score for `sus`,
            or the mean answer for any other questionnaire. `None` if an answer is missing.
        """
        given_answers = {item: value for item, value in answers.items() if value is not None}
        if len(given_answers) < len(answers):
            return None
        if self.name == "tlx":
            return raw_tlx(given_answers)
        if self.name == "sus":
            return sus_score([int(value) for value in given_answers.values()])
        return float(np.mean(list(given_answers.values())))

    def find_form(self) -> "Questionnaire":
        """Returns the questionnaire with its items filled in.

        A protocol may name a built-in questionnaire without listing its items.

        Raises:
            UsageError: The questionnaire has no items and is not built in, or its scale does
                not have 2 to 101 values.
        """
        name = self.name
        built_in = _read_shipped()
        if not self.items:
            if name not in built_in:
                raise UsageError(
                    f"questionnaire {name} has no items; "
                    f"the built-in questionnaires are {', '.join(built_in)}"
                )
            form = msgspec.convert({"name": name, **built_in[name]}, Questionnaire)
            return replace(form, after=self.after)

        if name in built_in:
            raise UsageError(
                f"questionnaire {name} is built in and has its own items; "
                "give your questionnaire another name"
            )

        scale_length = self.most - self.least
        if not self.step <= scale_length <= 100 * self.step:
            raise UsageError(
                f"questionnaire {name}: the scale must have 2 to 101 numbers; "
                "correct least, most or step"
            )
        return self


@cache
def _read_shipped() -> dict[str, Any]:
    """Returns the built-in questionnaires as TOML tables, keyed by name, such as "tlx"."""
    source = resources.files(__package__) / "questionnaires.txt"
    tables: dict[str, Any] = tomllib.loads(source.read_text(encoding="utf-8"))
    return tables

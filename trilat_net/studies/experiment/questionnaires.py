"""Questionnaires that people answer on the page: published ones that ship, and the user's own.

Invariant:
    - An answer is a number of the questionnaire's scale or None; anything else is refused. None
      is an item without an answer, such as a slider that nobody touched; it is stored and
      counted as missing.
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

from ...errors import UsageError, count_nouns
from ...fields import Frozen
from .movement_measures import raw_tlx, sus_score

Name = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]{0,39}$")]
Text = Annotated[str, Meta(max_length=300)]


CHOICE = "choice"
"""The form after a pair of trials of a staircase: a forced choice, which must be answered."""
Answers = Mapping[str, float | None]
"""Answers by item; None for a missing answer."""


class Questionnaire(Frozen, frozen=True):
    """A questionnaire of a protocol; a shipped one needs only its name.

    Attributes:
        name: the name of a shipped questionnaire (`tlx`, `sus`, `agency`), or another name.
        after: when it is answered: after each block, or once after the last one.
        title: its heading.
        items: the texts of the rated items, by their names in the table.
        low, high: the words at the ends of the scale.
        ends: other words at the ends, by item.
        least, most, step: the numbers of the scale.
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
        """Whether every item must be answered."""
        return self.name == CHOICE

    def read(self, values: Sequence[float | None]) -> dict[str, float | None]:
        """Returns the answers by item.

        Args:
            values: the answers in the order of the items; None for a missing answer.

        Raises:
            UsageError: there are more or fewer values than items, a value is not on the scale,
                or a required answer is missing.
        """
        scale = range(self.least, self.most + 1, self.step)
        is_valid = [not self.is_forced if value is None else value in scale for value in values]
        if len(values) != len(self.items) or not all(is_valid):
            count = count_nouns(len(self.items), "answer")
            raise UsageError(f"{self.name}: {count} of {self.least} to {self.most}")
        return dict(zip(self.items, values, strict=True))

    def score(self, answers: Answers) -> float | None:
        """Returns the score: raw NASA-TLX, the score of SUS, or the mean of the answers.

        Returns None if an answer is missing.
        """
        complete = {item: value for item, value in answers.items() if value is not None}
        if len(complete) < len(answers):
            return None
        if self.name == "tlx":
            return raw_tlx(complete)
        if self.name == "sus":
            return sus_score([int(value) for value in complete.values()])
        return float(np.mean(list(complete.values())))


@cache
def _read_shipped() -> dict[str, Any]:
    source = resources.files("trilat_net") / "scenarios" / "_questionnaires.txt"
    tables: dict[str, Any] = tomllib.loads(source.read_text(encoding="utf-8"))
    return tables


def find_form(questionnaire: Questionnaire) -> Questionnaire:
    """Returns a questionnaire with its items.

    Raises:
        UsageError: the questionnaire has no items and no shipped one has its name, or its scale
            does not have 2 to 101 numbers.
    """
    shipped = _read_shipped()
    if questionnaire.items and questionnaire.name in shipped:
        raise UsageError(
            f"questionnaire {questionnaire.name} ships with its items: "
            "give your own another name"
        )
    if not questionnaire.items and questionnaire.name not in shipped:
        raise UsageError(
            f"questionnaire {questionnaire.name} has no items; "
            f"those that ship are {', '.join(shipped)}"
        )
    if not questionnaire.items:
        form = msgspec.convert(
            {"name": questionnaire.name, **shipped[questionnaire.name]}, Questionnaire
        )
        return replace(form, after=questionnaire.after)
    if (
        questionnaire.most < questionnaire.least + questionnaire.step
        or questionnaire.most - questionnaire.least > 100 * questionnaire.step
    ):
        raise UsageError(
            f"questionnaire {questionnaire.name}: "
            "a scale has 2 to 101 numbers from least to most"
        )
    return questionnaire

"""Questionnaires that people answer on the page: the published ones that ship, and one's own.

Invariant:
- An answer is a number of the form's scale or None, or it is refused. None is an item that was
  left out, as a slider that nobody touched; it is stored and counted as missing.
- A questionnaire with a missing answer has no score: nobody knows what the answer would have
  been.
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
Words = Annotated[str, Meta(max_length=300)]


CHOICE = "choice"
"""The form after a pair of trials of a staircase: a forced choice, which nobody can leave out.
"""
Answers = Mapping[str, float | None]
"""Answers by item; None is a missing one."""


class Questionnaire(Frozen, frozen=True):
    """A questionnaire, as a protocol has it; one that ships needs its name alone.

    Attributes:
        name: of a shipped one (`tlx`, `sus`, `agency`), or of one's own.
        after: when it is answered: after each block, or once after the last one.
        title: above it.
        items: what is rated, by its name in the table.
        low, high: the words at the ends of the scale.
        ends: other words at the ends, by item.
        least, most, step: the numbers of the scale.
    """

    name: Name
    after: Literal["block", "experiment"] = "block"
    title: Words = ""
    items: Annotated[dict[Name, Words], Meta(max_length=40)] = field(default_factory=dict)
    low: Words = ""
    high: Words = ""
    ends: dict[Name, tuple[Words, Words]] = field(default_factory=dict)
    least: int = 1
    most: int = 7
    step: Annotated[int, Meta(ge=1)] = 1

    @property
    def is_forced(self) -> bool:
        """Whether no answer can be left out."""
        return self.name == CHOICE

    def read(self, values: Sequence[float | None]) -> dict[str, float | None]:
        """Returns the answers by item.

        Args:
            values: in the order of the items; None for one that was left out.

        Raises:
            UsageError: there are more or fewer values than items, a value is not on the scale,
                or one is left out where none can be.
        """
        scale = range(self.least, self.most + 1, self.step)
        valid = [
            value in scale if value is not None else not self.is_forced for value in values
        ]
        if len(values) != len(self.items) or not all(valid):
            raise UsageError(
                f"{self.name}: {count_nouns(len(self.items), 'answer')} of {self.least} to {self.most}"
            )
        return dict(zip(self.items, values, strict=True))

    def score(self, answers: Answers) -> float | None:
        """Returns one number: raw NASA-TLX, the score of SUS, else the mean; None if an answer
        is missing.
        """
        given = {item: value for item, value in answers.items() if value is not None}
        if len(given) < len(answers):
            return None
        if self.name == "tlx":
            return raw_tlx(given)
        if self.name == "sus":
            return sus_score([int(value) for value in given.values()])
        return float(np.mean(list(given.values())))


@cache
def _read_shipped() -> dict[str, Any]:
    source = resources.files("trilat_net") / "scenarios" / "_questionnaires.txt"
    tables: dict[str, Any] = tomllib.loads(source.read_text(encoding="utf-8"))
    return tables


def find_form(asked: Questionnaire) -> Questionnaire:
    """Returns a questionnaire with its items.

    Raises:
        UsageError: it has none, and none of its name ships; or its scale has less than two
            numbers.
    """
    shipped = _read_shipped()
    if asked.items and asked.name in shipped:
        raise UsageError(
            f"questionnaire {asked.name} ships with its items: give your own another name"
        )
    if not asked.items and asked.name not in shipped:
        raise UsageError(
            f"questionnaire {asked.name} has no items; those that ship are {', '.join(shipped)}"
        )
    if not asked.items:
        form = msgspec.convert({"name": asked.name, **shipped[asked.name]}, Questionnaire)
        return replace(form, after=asked.after)
    if asked.most < asked.least + asked.step or asked.most - asked.least > 100 * asked.step:
        raise UsageError(
            f"questionnaire {asked.name}: a scale has 2 to 101 numbers from least to most"
        )
    return asked

"""Distributions in place of numbers: start poses, masses, gains and operators that each seed
draws.

Invariant (L4): a draw is a function of the seed and of the number's dotted key, rounded to nine
digits. A resolved scenario holds the number drawn and, under `drawn`, its distribution: another
seed draws it again. A number that an override replaced stays as it is.
"""

import re
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ..core.chain import MAX_JOINTS
from ..core.philox import link_key
from ..errors import ScenarioError
from ..fields import Frozen, NotNegative, Real, TomlTable, is_distribution, is_number

_MOST_ENTRIES = 64
"""Longer lists are recorded tables, in which nothing is drawn."""


class Distribution(Frozen, frozen=True, omit_defaults=True, kw_only=True):
    """The origin of a number: one of the two distributions, or none for a pose that follows the
    start pose.

    Attributes:
        normal: mean and standard deviation.
        uniform: lower and upper end.
        value: the number drawn, or the pose.
    """

    normal: tuple[Real, NotNegative] | None = None
    uniform: tuple[Real, Real] | None = None
    value: float | Annotated[list[float], Meta(max_length=MAX_JOINTS)]

    def draw(self, seed: int, key: str) -> float:
        """Returns the number of a seed under a dotted key."""
        from statistics import NormalDist  # takes some ms, which few scenarios need

        share = ((link_key(seed, key) >> 12) + 0.5) / 2.0**52
        if self.normal is not None:
            mean, deviation = self.normal
            number = mean + deviation * NormalDist().inv_cdf(share)
        else:
            low, high = self.uniform or (0.0, 0.0)
            number = low + share * (high - low)
        return float(f"{number:.9g}")

    def describe(self) -> str:
        """Returns the distribution in words."""
        if self.normal is not None:
            return f"normal, {self.normal[0]:g} with a deviation of {self.normal[1]:g}"
        return (
            f"uniform, {self.uniform[0]:g} to {self.uniform[1]:g}"
            if self.uniform
            else "as the start pose"
        )


def dotted_key(path: str) -> str:
    """Returns a path such as hands[0].peak_nm as an override writes it: hands.0.peak_nm."""
    return re.sub(r"\[(\d+)\]", r".\1", path)


class Draws:
    """Draws the numbers of one scenario.

    Args:
        seed: the scenario's; one that is not valid is refused later, at its own key.
        known: the table `drawn` of a scenario that was resolved before.

    Attributes:
        drawn: the distribution of every number drawn so far, by its dotted key.
    """

    def __init__(self, seed: Any, known: Any) -> None:
        self._seed = seed if isinstance(seed, int) else 0
        try:
            self._known = msgspec.convert(known, dict[str, Distribution])
        except msgspec.ValidationError as error:
            raise ScenarioError(str(error).replace("`", ""), path="drawn") from None
        self.drawn: dict[str, Distribution] = {}

    def draw_numbers(self, table: TomlTable, path: str) -> TomlTable:
        """Returns a table with a number in place of each distribution, also within its lists."""
        return {key: self._draw_entry(value, f"{path}.{key}") for key, value in table.items()}

    def _draw_entry(self, value: Any, path: str) -> Any:
        if isinstance(value, list) and len(value) <= _MOST_ENTRIES:
            return [
                entry if isinstance(entry, list) else self._draw_entry(entry, f"{path}[{n}]")
                for n, entry in enumerate(value)
            ]
        key = dotted_key(path)
        if is_distribution(value):
            origin = _read_distribution(value, path)
        elif (
            (known := self._known.get(key)) is not None
            and is_number(value)
            and known.value == value
        ):
            origin = known
        else:
            return value
        number = origin.draw(self._seed, key)
        self.drawn[key] = msgspec.structs.replace(origin, value=number)
        return number

    def follow_start(
        self, table: TomlTable, key: str, pose: Sequence[float], path: str
    ) -> None:
        """Writes the start pose under a key that is absent, or that followed an earlier draw of
        it.
        """
        place = dotted_key(f"{path}.{key}")
        before = self._known.get(place)
        if key in table and (before is None or table[key] != before.value):
            return
        table[key] = pose
        site = place.partition(".hands.")[0]
        if any(one.startswith((f"{site}.q0_rad", f"{site}.arm.l")) for one in self.drawn):
            self.drawn[place] = Distribution(value=list(pose))


def _read_distribution(table: TomlTable, path: str) -> Distribution:
    try:
        origin = msgspec.convert({**table, "value": 0.0}, Distribution)
    except msgspec.ValidationError:
        origin = None
    uniform = origin.uniform if origin else None
    if origin is None or len(table) != 1 or (uniform is not None and uniform[1] < uniform[0]):
        problem = "must be { normal = [mean, deviation] } or { uniform = [low, high] }"
        raise ScenarioError(f"{problem}, is {table}", path=path)
    return origin

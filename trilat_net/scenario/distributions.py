"""Distributions in place of numbers: a seed draws start poses, masses and gains.

Invariant (L4):
    - A draw is a function of the seed and of the number's dotted key, rounded to nine digits.
    - A resolved scenario holds the number that was drawn and, under `drawn`, its distribution:
      another seed draws it again. A number that an override replaced stays as it is.
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

_MAX_LIST_LENGTH = 64
"""Longer lists are recorded tables, in which nothing is drawn."""


class Distribution(Frozen, frozen=True, omit_defaults=True, kw_only=True):
    """The origin of a number: a normal or a uniform distribution.

    A pose that follows a drawn start pose has neither distribution.

    Attributes:
        normal: mean and standard deviation.
        uniform: lower and upper end.
        value: the number that was drawn, or the pose.
    """

    normal: tuple[Real, NotNegative] | None = None
    uniform: tuple[Real, Real] | None = None
    value: float | Annotated[list[float], Meta(max_length=MAX_JOINTS)]

    def draw(self, seed: int, key: str) -> float:
        """Returns the number that a seed draws for a dotted key."""
        # Few scenarios need this import, which takes some milliseconds.
        from statistics import NormalDist

        # 52 bits select one of 2^52 intervals; its middle is never 0 or 1.
        interval = link_key(seed, key) >> 12
        uniform_number = (interval + 0.5) / 2.0**52
        if self.normal is not None:
            mean, deviation = self.normal
            number = mean + deviation * NormalDist().inv_cdf(uniform_number)
        else:
            low, high = self.uniform or (0.0, 0.0)
            number = low + uniform_number * (high - low)
        return float(f"{number:.9g}")

    def describe(self) -> str:
        """Returns the distribution as text."""
        if self.normal is not None:
            mean, deviation = self.normal
            return f"normal, {mean:g} with a deviation of {deviation:g}"
        if self.uniform is not None:
            low, high = self.uniform
            return f"uniform, {low:g} to {high:g}"
        return "as the start pose"


def dotted_key(path: str) -> str:
    """Returns a path such as hands[0].peak_nm as an override writes it: hands.0.peak_nm."""
    return re.sub(r"\[(\d+)\]", r".\1", path)


class Draws:
    """Draws the numbers of one scenario.

    Args:
        seed: the seed of the scenario. An invalid seed is refused later, at its own key.
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
        """Returns a table with a number in place of each distribution, also in its lists."""
        return {key: self._draw_entry(value, f"{path}.{key}") for key, value in table.items()}

    def _draw_entry(self, value: Any, path: str) -> Any:
        """Returns the number of a distribution, or of a number that was drawn before.

        Other values are returned as they are.
        """
        if isinstance(value, list) and len(value) <= _MAX_LIST_LENGTH:
            entries = []
            for n, entry in enumerate(value):
                is_nested = isinstance(entry, list)
                entries.append(entry if is_nested else self._draw_entry(entry, f"{path}[{n}]"))
            return entries
        key = dotted_key(path)
        known = self._known.get(key)
        if is_distribution(value):
            origin = _read_distribution(value, path)
        elif known is not None and is_number(value) and known.value == value:
            origin = known
        else:
            return value
        number = origin.draw(self._seed, key)
        self.drawn[key] = msgspec.structs.replace(origin, value=number)
        return number

    def follow_start(
        self, table: TomlTable, key: str, pose: Sequence[float], path: str
    ) -> None:
        """Writes the start pose into a table, in place, unless the key has another pose.

        A pose that followed an earlier draw of the start pose is replaced.

        Args:
            table: the table of an operator.
            key: the key of the pose.
            pose: the start pose.
            path: the path of the table.
        """
        pose_key = dotted_key(f"{path}.{key}")
        known = self._known.get(pose_key)
        if key in table and (known is None or table[key] != known.value):
            return
        table[key] = pose
        site = pose_key.partition(".hands.")[0]
        start_keys = (f"{site}.q0_rad", f"{site}.arm.l")
        if any(drawn_key.startswith(start_keys) for drawn_key in self.drawn):
            self.drawn[pose_key] = Distribution(value=list(pose))


def _read_distribution(table: TomlTable, path: str) -> Distribution:
    """Returns the distribution of a table; refuses a table that is not one."""
    try:
        origin = msgspec.convert({**table, "value": 0.0}, Distribution)
    except msgspec.ValidationError:
        origin = None
    uniform = origin.uniform if origin else None
    is_reversed = uniform is not None and uniform[1] < uniform[0]
    if origin is None or len(table) != 1 or is_reversed:
        problem = "must be { normal = [mean, deviation] } or { uniform = [low, high] }"
        raise ScenarioError(f"{problem}, is {table}", path=path)
    return origin

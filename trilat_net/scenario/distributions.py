"""Draws numbers of a scenario that are given as probability distributions.

A scenario is a TOML file that describes an experiment. In place of a number, for example a mass
or a gain, its author may write `{ normal = [mean, deviation] }` or `{ uniform = [low, high] }`.
The seed, an integer in the scenario, determines the numbers that are drawn. A different seed
gives a different random instance of the experiment.

Invariant (L4):
    - A drawn number depends only on the seed and on the place of the number in the scenario,
      written as a dotted key such as `sites.s.control.Kd`. It is rounded to nine digits.
    - A resolved scenario, in which nothing is left out, contains the drawn number, and its
      distribution in the table `drawn`, so that another seed draws the number again. A number
      that an override has replaced is not drawn again.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from ..core import link_key
from ..errors import ScenarioError
from ..fields import Frozen, NotNegative, Real, TomlTable
from ..records import MAX_JOINTS
from .key_checks import is_distribution, is_number

_MAX_LIST_LENGTH = 64
"""Longest list that may contain distributions. Longer lists are recorded tables."""


DISTRIBUTION_FORM = "must be { normal = [mean, deviation] } or { uniform = [low, high] }"
"""Permitted contents of a distribution's table, as the end of a sentence about its key."""


class _DistributionKeys(Frozen, frozen=True, omit_defaults=True, kw_only=True):
    """Keys of a table that states a random distribution in place of a number.

    The distribution is either normal or uniform, for example `{ uniform = [1, 2] }`.

    Attributes:
        normal: Mean and standard deviation of a normal distribution. None for other kinds.
        uniform: Lower and upper limit of a uniform distribution. None for other kinds.
    """

    normal: tuple[Real, NotNegative] | None = None
    uniform: tuple[Real, Real] | None = None


class StatedDistribution(_DistributionKeys, frozen=True):
    """Table in a scenario that states a random distribution in place of a number.

    Each seed then gives another number. The distribution is normal or uniform, see
    `_DistributionKeys`.
    """

    def __post_init__(self) -> None:
        is_reversed = self.uniform is not None and self.uniform[1] < self.uniform[0]
        if (self.normal is None) == (self.uniform is None) or is_reversed:
            raise ValueError(DISTRIBUTION_FORM)


class Distribution(_DistributionKeys, frozen=True, omit_defaults=True, kw_only=True):
    """Random distribution of a number in a scenario, together with the number drawn from it.

    The author of a scenario, the description of an experiment, may state a distribution in
    place of a number. The value can also be a pose of an operator that was copied from the
    random start pose of an arm. In this case, both distributions are None.

    Attributes:
        value: The drawn number, or the copied pose.
    """

    value: float | Annotated[list[float], Meta(max_length=MAX_JOINTS)]

    def draw(self, seed: int, key: str) -> float:
        """Draws the number that belongs to a seed and a key.

        The same seed and key always give the same number. A hash of both gives a uniform random
        number, which the inverse distribution function converts.

        Args:
            seed: Seed of the scenario.
            key: Dotted key of the number in the scenario.
        """
        # The import is here because it takes some milliseconds and few scenarios need it.
        from statistics import NormalDist

        # 52 bits select one of 2^52 intervals, whose middle is never 0 or 1.
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
        """Returns a string that describes the distribution to a user.

        It states the mean and standard deviation of a normal distribution, or the limits of a
        uniform distribution. For a copied start pose, it says so.
        """
        if self.normal is not None:
            mean, deviation = self.normal
            return f"normal, {mean:g} with a deviation of {deviation:g}"
        if self.uniform is not None:
            low, high = self.uniform
            return f"uniform, {low:g} to {high:g}"
        return "as the start pose"


def has_distribution(value: Any) -> bool:
    """Returns True if a value of a scenario is a random distribution, or a list with one."""
    entries = value if isinstance(value, list) else [value]
    return any(map(is_distribution, entries))


def dotted_key(path: str) -> str:
    """Converts a path in an error message to a dotted key.

    For example, hands[0].peak_nm becomes hands.0.peak_nm, which is the format of a key in an
    override.

    Args:
        path: The path, with indices in brackets.
    """
    return re.sub(r"\[(\d+)\]", r".\1", path)


class Draws:
    """Draws the numbers of a scenario whose author stated random distributions.

    It also remembers them, so that the resolved scenario, in which every value is a number,
    also states the distributions.

    Args:
        seed: Seed of the scenario.
        known: Table `drawn` of a scenario that was resolved before. Empty for a new scenario.

    Attributes:
        seed: Seed of the scenario.
        drawn: Distribution of every number drawn so far, by its dotted key.
    """

    def __init__(self, seed: int, known: Mapping[str, Distribution]) -> None:
        self.seed = seed
        self._known = known
        self.drawn: dict[str, Distribution] = {}

    def draw_numbers(self, table: TomlTable, path: str) -> TomlTable:
        """Replaces all distributions in a table by drawn numbers.

        Lists in the table are included, but inner tables are not. The given table is unchanged.

        Args:
            table: Table of a scenario.
            path: Path of the table in the scenario. The path and the seed determine the
                numbers.

        Returns:
            A copy of the table with numbers.
        """
        return {key: self._draw_entry(value, f"{path}.{key}") for key, value in table.items()}

    def _draw_entry(self, value: Any, path: str) -> Any:
        """Returns a value of a table, with a drawn number in place of a distribution.

        A number that was drawn from a distribution before is drawn again, because the seed may
        have changed. Other values are returned unchanged.
        """
        if isinstance(value, list) and len(value) <= _MAX_LIST_LENGTH:
            entries = []
            for n, entry in enumerate(value):
                is_nested = isinstance(entry, list)
                entries.append(entry if is_nested else self._draw_entry(entry, f"{path}[{n}]"))
            return entries

        if not self._known and not is_distribution(value):
            return value
        key = dotted_key(path)
        known = self._known.get(key)
        if is_distribution(value):
            origin = _read_distribution(value, path)
        elif known is not None and is_number(value) and known.value == value:
            origin = known
        else:
            return value
        number = origin.draw(self.seed, key)
        self.drawn[key] = msgspec.structs.replace(origin, value=number)
        return number

    def follow_start(
        self, table: TomlTable, key: str, pose: Sequence[float], path: str
    ) -> None:
        """Sets the start pose of an operator to the start pose of the operator's arm.

        An operator is a person or program, or a model of a person. A pose that the author of
        the scenario wrote is kept. A pose that this method set before is replaced, because the
        random start pose of the arm may have changed.

        Args:
            table: Settings of the operator. They are changed.
            key: Key of the pose in these settings.
            pose: Start pose of the arm, in rad, or the position of its end effector, in m.
            path: Path of the settings in the scenario.
        """
        pose_key = dotted_key(f"{path}.{key}")
        known = self._known.get(pose_key)
        if key in table and (known is None or table[key] != known.value):
            return
        table[key] = pose

        # If the start pose was drawn, another seed must change the copy as well.
        site = pose_key.partition(".hands.")[0]
        start_keys = (f"{site}.q0_rad", f"{site}.arm.l")
        if any(drawn_key.startswith(start_keys) for drawn_key in self.drawn):
            self.drawn[pose_key] = Distribution(value=[float(angle) for angle in pose])


def _read_distribution(table: TomlTable, path: str) -> Distribution:
    """Reads a random distribution from a table of a scenario, without drawing a number from it.

    Raises:
        ScenarioError: The table does not state a distribution.
    """
    try:
        stated = msgspec.convert(table, StatedDistribution)
    except msgspec.ValidationError:
        raise ScenarioError(f"{DISTRIBUTION_FORM}, but is {table}", path=path) from None
    return Distribution(normal=stated.normal, uniform=stated.uniform, value=0.0)

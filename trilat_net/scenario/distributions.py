"""Draws the numbers that a scenario specifies as probability distributions.

In place of a number, such as a mass or a gain, a scenario may contain `{ normal = [mean,
deviation] }` or `{ uniform = [low, high] }`. The number is drawn using the seed of the
scenario; a different seed gives a different random instance of the experiment.

Invariant (L4):
    - A drawn number depends only on the seed and on the location of the number in the scenario,
      given as a dotted key such as `sites.s.control.Kd`. It is rounded to nine digits.
    - A resolved scenario contains the drawn number and, in the table `drawn`, its distribution.
      Changing the seed redraws the number, unless an override has replaced it.
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
"""Maximum length of a list that may contain distributions. Longer lists are recorded tables."""


DISTRIBUTION_FORM = "must be { normal = [mean, deviation] } or { uniform = [low, high] }"
"""Description of a valid distribution table, as the end of a sentence about its key."""


class _DistributionKeys(Frozen, frozen=True, omit_defaults=True, kw_only=True):
    """Keys of a table that specifies a random distribution in place of a number.

    The distribution is either normal or uniform, for example `{ uniform = [1, 2] }`.

    Attributes:
        normal: Mean and standard deviation of a normal distribution, otherwise None.
        uniform: Lower and upper limit of a uniform distribution, otherwise None.
    """

    normal: tuple[Real, NotNegative] | None = None
    uniform: tuple[Real, Real] | None = None


class StatedDistribution(_DistributionKeys, frozen=True):
    """Scenario table that specifies a random distribution in place of a number.

    The number is drawn anew for each seed. The distribution is normal or uniform (see
    `_DistributionKeys`).
    """

    def __post_init__(self) -> None:
        is_reversed = self.uniform is not None and self.uniform[1] < self.uniform[0]
        if (self.normal is None) == (self.uniform is None) or is_reversed:
            raise ValueError(DISTRIBUTION_FORM)


class Distribution(_DistributionKeys, frozen=True, omit_defaults=True, kw_only=True):
    """Distribution of a random number in a scenario, together with the drawn number.

    The value can also be an operator's pose that was copied from the random start pose of an
    arm. In that case, both `normal` and `uniform` are None.

    Attributes:
        value: The drawn number, or the copied pose.
    """

    value: float | Annotated[list[float], Meta(max_length=MAX_JOINTS)]

    def draw(self, seed: int, key: str) -> float:
        """Draws the number for a given seed and key.

        The result is deterministic: a hash of seed and key yields a uniform random number, to
        which the inverse distribution function is applied.

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
        """Returns a human-readable description of the distribution.

        States the mean and standard deviation of a normal distribution or the limits of a
        uniform one. A copied start pose is described as such.
        """
        if self.normal is not None:
            mean, deviation = self.normal
            return f"normal, {mean:g} with a deviation of {deviation:g}"
        if self.uniform is not None:
            low, high = self.uniform
            return f"uniform, {low:g} to {high:g}"
        return "as the start pose"


def has_distribution(value: Any) -> bool:
    """Returns True if a scenario value is a random distribution or a list that contains one."""
    entries = value if isinstance(value, list) else [value]
    return any(map(is_distribution, entries))


def dotted_key(path: str) -> str:
    """Converts a path from an error message to a dotted key.

    For example, hands[0].peak_nm becomes hands.0.peak_nm, the form used for keys in overrides.

    Args:
        path: The path, with indices in brackets.
    """
    return re.sub(r"\[(\d+)\]", r".\1", path)


class Draws:
    """Draws a number from each random distribution in a scenario.

    Also keeps the distributions, since a resolved scenario contains both the drawn numbers and
    their distributions.

    Args:
        seed: Seed of the scenario.
        known: Table `drawn` of a previously resolved scenario. Empty for a new scenario.

    Attributes:
        seed: Seed of the scenario.
        drawn: Mapping from dotted key to the distribution of each number drawn so far.
    """

    def __init__(self, seed: int, known: Mapping[str, Distribution]) -> None:
        self.seed = seed
        self._known = known
        self.drawn: dict[str, Distribution] = {}

    def draw_numbers(self, table: TomlTable, path: str) -> TomlTable:
        """Replaces the distributions in a table with drawn numbers.

        Handles lists in the table, but not nested tables. `table` is not modified.

        Args:
            table: A table of a scenario.
            path: Path of the table in the scenario. Together with the seed, it determines the
                drawn numbers.

        Returns:
            A copy of the table in which every distribution is replaced.
        """
        return {key: self._draw_entry(value, f"{path}.{key}") for key, value in table.items()}

    def _draw_entry(self, value: Any, path: str) -> Any:
        """Returns a table value, with any distribution replaced with a drawn number.

        Previously drawn numbers are drawn again, since the seed may have changed. Other values
        are returned unchanged.
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
        """Sets the start pose of an operator to the start pose of its arm.

        A pose specified by the author of the scenario is kept. A pose set by an earlier call is
        replaced, since the random start pose of the arm may have changed.

        Args:
            table: Settings of the operator, modified in place.
            key: Key of the pose in `table`.
            pose: Start pose of the arm in rad, or start position of its end effector in m.
            path: Path of `table` in the scenario.
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
    """Parses a random distribution from a scenario table, without drawing from it.

    Raises:
        ScenarioError: The table is not a valid distribution.
    """
    try:
        stated = msgspec.convert(table, StatedDistribution)
    except msgspec.ValidationError:
        raise ScenarioError(f"{DISTRIBUTION_FORM}, but is {table}", path=path) from None
    return Distribution(normal=stated.normal, uniform=stated.uniform, value=0.0)

"""Types of the values in a scenario, and the base class of its tables.

A scenario is a TOML file that describes an experiment with several robot arms. Each of its
tables is converted to an instance of a subclass of `Frozen`. Annotations restrict the values:
`Positive` limits the range of a number, and `Joints` requires one number per joint of the arm.
Rules that these types cannot express are checked by `scenario.key_checks`.

Invariant:
    - An error names the path of the key as the author of the scenario wrote it.
    - No arm quantity, gain or torque exceeds `MAX_QUANTITY`, which keeps products of a few of
      them far from overflow.
"""

import pkgutil
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Annotated, Any, NamedTuple, Self

import msgspec
from msgspec import Meta

from .core import LINK_PARAMETERS
from .records import MAX_JOINTS


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base class of the immutable types that represent the tables of a scenario.

    Unknown keys in a table are rejected, because they are probably misspelt and would otherwise
    have no effect.
    """

    @classmethod
    def find_kinds(cls, package: str) -> Iterator[type[Self]]:
        """Yields the subclasses that a scenario can select by name, as in `kind = "wall"`.

        Adding a file with a subclass to the package makes the subclass available. Classes
        without a tag (name) of their own serve only as base classes and are skipped. The
        classes are ordered by file, and by position within each file.

        Args:
            package: Dotted name of the package whose files are searched.
        """
        folders = import_module(package).__path__
        for file in pkgutil.iter_modules(folders):
            name = f"{package}.{file.name}"
            for value in vars(import_module(name)).values():
                is_subclass = isinstance(value, type) and issubclass(value, cls)
                # A class that this file imports is listed with the file that defines it.
                if not is_subclass or value.__module__ != name:
                    continue
                tag = value.__struct_config__.tag
                # Without a tag of its own, a class is only a base of others. msgspec then uses
                # the name of the class as its tag.
                if tag is not None and tag != value.__name__:
                    yield value


MAX_QUANTITY = 1e9
"""Largest absolute value of any quantity in a scenario."""

Positive = Annotated[float, Meta(gt=0.0, le=MAX_QUANTITY)]
NotNegative = Annotated[float, Meta(ge=0.0, le=MAX_QUANTITY)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Real = Annotated[float, Meta(ge=-MAX_QUANTITY, le=MAX_QUANTITY)]
_MAX_PARAMETERS = MAX_JOINTS * LINK_PARAMETERS
_PER_JOINT = Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "joints"})
_PER_PARAMETER = Meta(min_length=1, max_length=_MAX_PARAMETERS, extra={"per": "parameters"})
_PER_COORDINATE = Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "shared"})
_PER_AXIS = Meta(min_length=2, max_length=3, extra={"per": "axes"})
_POINT = Meta(min_length=2, max_length=3, extra={"point": "axes"})
Joints = Annotated[tuple[Real, ...], _PER_JOINT]
PositiveJoints = Annotated[tuple[Positive, ...], _PER_JOINT]
NotNegativeJoints = Annotated[tuple[NotNegative, ...], _PER_JOINT]
Parameters = Annotated[tuple[Real, ...], _PER_PARAMETER]
NotNegativeParameters = Annotated[tuple[NotNegative, ...], _PER_PARAMETER]
PositiveCoordinates = Annotated[tuple[Positive, ...], _PER_COORDINATE]
NotNegativeCoordinates = Annotated[tuple[NotNegative, ...], _PER_COORDINATE]
NotNegativeAxes = Annotated[tuple[NotNegative, ...], _PER_AXIS]
Point = Annotated[tuple[Real, ...], _POINT]
RateHz = Annotated[int, Meta(ge=1, le=20_000)]

TomlTable = dict[str, Any]


class KeyProblem(NamedTuple):
    """A problem with one key of a scenario table, used to build an error message.

    Attributes:
        key: Path of the key relative to the checked table. Empty for the table itself.
        problem: The problem, phrased as the end of a sentence about the key.
    """

    key: str
    problem: str


def split_refusal(error: msgspec.ValidationError) -> tuple[str, str]:
    """Splits an error message about an invalid scenario into the problem and its location.

    The error is raised by the msgspec library while converting the tables of the scenario.

    Args:
        error: The error, with a message such as "Expected `float` - at `$.sites.m1`".

    Returns:
        The problem and the path of the invalid value, such as "Expected `float`" and
        ".sites.m1".
    """
    problem, _, path = str(error).partition(" - at ")
    return problem, path.strip("`$")


_TYPE_NAMES = {
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "text",
    "array": "a list",
    "object": "a table",
}
"""Mapping from the type names of msgspec to those of TOML."""
WITHOUT_QUOTES = ": write it without quotes and unit, which the key's name states"


def reword_problem(problem: str) -> str:
    """Rewords an error message of the msgspec library for the author of a scenario.

    The library uses the type names of Python and JSON, such as "object", whereas authors know
    those of TOML, such as "a table".

    Args:
        problem: The message, without the path of the key.

    Returns:
        The reworded message. Messages that contain no msgspec terms are returned unchanged.
    """
    problem = re.sub("`([^`]*)`", _reword_types, problem)
    if problem.startswith("Expected "):
        problem = "e" + problem[1:]
    if problem.endswith("number, got text"):
        problem += WITHOUT_QUOTES
    return problem


def _reword_types(quoted: re.Match[str]) -> str:
    """Replaces type names in an msgspec error with those known to authors of TOML.

    For example, "`float | null`" becomes "a number". Null is omitted because TOML has no null.

    Args:
        quoted: Match of the quoted types, with the text between the backquotes in group 1.
    """
    types = quoted[1].split(" | ")
    return " or ".join(_TYPE_NAMES.get(name, name) for name in types if name != "null")


UNITS = {
    **{unit: unit for unit in ("rad", "m", "s", "ms", "kg")},
    "n": "N",
    "nm": "N m",
    "j": "J",
    "hz": "Hz",
    "percent": "%",
    "bits_s": "bit/s",
    "rad_s": "rad/s",
    "rad_s2": "rad/s^2",
    "m_s": "m/s",
    "m_s2": "m/s^2",
    "kg_m2": "kg m^2",
    "n_m": "N/m",
    "n_s_m": "N s/m",
    "nm_rad": "N m/rad",
    "nm_s_rad": "N m s/rad",
}
"""Mapping from the ending of a name to its unit, for example "ms" for delay_ms."""


def split_unit(name: str) -> tuple[str, str]:
    """Splits the name of a quantity into its words and its unit, for example for an axis label.

    If several endings of the name are units, the longest one is used.

    >>> split_unit("contact_stiffness_n_m")
    ('contact stiffness', 'N/m')

    Args:
        name: The name, with words and unit separated by underscores.

    Returns:
        The words, separated by spaces, and the unit. The unit is empty if the name does not end
        in a unit.
    """
    words = name.split("_")
    for word_count in range(1, len(words)):
        ending = "_".join(words[word_count:])
        if ending in UNITS:
            return " ".join(words[:word_count]), UNITS[ending]
    return " ".join(words), ""

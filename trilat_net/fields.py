"""The fields of a scenario's types: their base class, ranges of numbers, and checks of tables.

Invariant:
    - An error names the path of the key as the author wrote it, and the nearest valid name.
    - No quantity of an arm, a gain or a torque exceeds `MAX_QUANTITY`, which keeps arithmetic
      far from overflow.
"""

import difflib
import math
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any, NamedTuple, TypeGuard, TypeVar, get_type_hints

import msgspec
from msgspec import Meta

from .core.chain import LINK_PARAMETERS, MAX_JOINTS
from .core.two_link_arm import JOINTS, PARAMETERS
from .errors import ScenarioError, count_nouns


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of a scenario's types: immutable, and unknown keys are refused."""


K = TypeVar("K", bound=Frozen)


def find_kinds(package: str, base: type[K]) -> Iterator[type[K]]:
    """Yields the subclasses of `base` with a tag that the files of a package define.

    They are ordered by file and by position in the file.

    Args:
        package: the dotted name of the package.
        base: the base class.
    """
    folders = import_module(package).__path__
    for file in pkgutil.iter_modules(folders):
        name = f"{package}.{file.name}"
        for value in vars(import_module(name)).values():
            is_kind = isinstance(value, type) and issubclass(value, base)
            if not is_kind or value.__module__ != name:
                continue
            tag = value.__struct_config__.tag
            # Without a tag of its own, a class is only a base of others.
            if tag is not None and tag != value.__name__:
                yield value


MAX_QUANTITY = 1e9
"""Largest absolute value of a scenario's quantities."""

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
StructType = type[msgspec.Struct]


class VectorCounts(NamedTuple):
    """Counts of the numbers in the vectors of a site.

    Attributes:
        joints: count of a vector with one number per joint.
        parameters: count of a vector with one number per dynamic parameter.
        axes: count of a vector with one number per axis of space.
        shared: count of a vector with one number per coordinate that sites share.
    """

    joints: int = JOINTS
    parameters: int = PARAMETERS
    axes: int = 2
    shared: int = JOINTS

    @classmethod
    def of_chain(cls, joints: int, shared: int = 0) -> "VectorCounts":
        """Returns the counts of a chain.

        Args:
            joints: the number of its joints.
            shared: the number of coordinates that sites share; by default that of the joints.
        """
        return cls(
            joints=joints,
            parameters=LINK_PARAMETERS * joints,
            axes=3,
            shared=shared or joints,
        )


class KeyProblem(NamedTuple):
    """A key with an invalid value.

    Attributes:
        key: the path of the key below the checked table; "" for the table itself.
        problem: the problem.
    """

    key: str
    problem: str


@cache
def _vector_keys(kind: StructType, extra: str) -> Mapping[str, str]:
    """Returns the vector keys of a type, with the count that each vector has.

    Args:
        kind: the type.
        extra: the annotation: "per" for vectors, "point" for points.

    Returns:
        Per key the name of a field of `VectorCounts`.
    """
    counts = {}
    for key, hint in get_type_hints(kind, include_extras=True).items():
        for meta in getattr(hint, "__metadata__", ()):
            annotations = meta.extra if isinstance(meta, Meta) else None
            if annotations is not None and extra in annotations:
                counts[key] = str(annotations[extra])
    return counts


def expand_vectors(table: TomlTable, kind: StructType, counts: VectorCounts) -> TomlTable:
    """Returns a table with single numbers and distributions expanded to vectors.

    A missing vector gets the default of its type, with the length that the arm needs.

    Args:
        table: the table of a scenario.
        kind: the type of the table.
        counts: the counts of the site's vectors.
    """
    lengths = {key: getattr(counts, per) for key, per in _vector_keys(kind, "per").items()}
    expanded: TomlTable = {}
    for field in msgspec.structs.fields(kind):
        name = field.name
        if name in lengths and isinstance(field.default, tuple):
            expanded[name] = [field.default[0]] * lengths[name]
    for key, value in table.items():
        is_single = is_number(value) or is_distribution(value)
        if key in lengths and is_single:
            expanded[key] = [value] * lengths[key]
        else:
            expanded[key] = value
    return expanded


_OWNERS = {
    **dict.fromkeys(("joints", "parameters"), "the arm has"),
    "axes": "its space has",
    "shared": "sites share",
}


def find_count_problem(
    table: TomlTable, kind: StructType, counts: VectorCounts
) -> KeyProblem | None:
    """Returns the first vector of a table that has too few or too many numbers, or None."""
    vectors = {**_vector_keys(kind, "per"), **_vector_keys(kind, "point")}
    for key, per in vectors.items():
        required = getattr(counts, per)
        value = table.get(key)
        if not isinstance(value, list) or len(value) == required:
            continue
        noun = "coordinates" if per == "shared" else per
        numbers = count_nouns(len(value), "number")
        return KeyProblem(key, f"has {numbers}, and {_OWNERS[per]} {required} {noun}")
    return None


def is_number(value: Any) -> TypeGuard[float]:
    """True for a number in a scenario; true and false do not count as numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_distribution(value: Any) -> bool:
    """True for a distribution in place of a number, as { uniform = [...] }."""
    return isinstance(value, dict) and not value.keys().isdisjoint(("normal", "uniform"))


def split_refusal(error: msgspec.ValidationError) -> tuple[str, str]:
    """Returns the problem of a refused value, and the path of its key below the whole value."""
    problem, _, path = str(error).partition(" - at ")
    return problem, path.strip("`$")


def reword_problem(problem: str) -> str:
    """Returns a validation message in the words of a scenario's author."""
    replacements = (("`", ""), ("Expected ", "expected "), ("array", "list"), ("str", "text"))
    for old, new in replacements:
        problem = problem.replace(old, new)
    return problem


MOST_LETTERS = 80
"""Longest word for which `suggest_nearest` compares."""
MOST_COMPARED = 500
"""Largest number of words that `suggest_nearest` compares: its time grows by more than the
product of their number and their length.
"""


def suggest_nearest(word: str, valid: Sequence[str]) -> str:
    """Returns "; did you mean ...?" with the most similar valid word, or "".

    The result is "" if no valid word is similar, or if the word is too long to compare.
    """
    if len(word) > MOST_LETTERS:
        return ""
    candidates = [name for name in valid[:MOST_COMPARED] if len(name) <= MOST_LETTERS]
    matches = difflib.get_close_matches(word, candidates, n=1, cutoff=0.5)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def check_keys(table: Any, valid: Sequence[str], path: str) -> TomlTable:
    """Returns a table after checking that its keys are valid.

    Args:
        table: the value of a scenario.
        valid: the valid keys.
        path: the path of the table, for errors.

    Raises:
        ScenarioError: the value is not a table, or has an unknown key.
    """
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key in valid:
            continue
        key_path = f"{path}.{key}" if path else key
        hint = suggest_nearest(key, valid) or f"; valid are {', '.join(valid)}"
        raise ScenarioError(f"unknown key{hint}", path=key_path)
    return table


def field_names(kind: StructType) -> tuple[str, ...]:
    """Returns the keys of a type."""
    return kind.__struct_encode_fields__


def check_choice(word: Any, valid: Sequence[str], path: str) -> None:
    """Refuses a word that is not among the valid ones.

    Raises:
        ScenarioError: with the path of the key.
    """
    if word not in valid:
        choices = ", ".join(map(repr, valid))
        hint = suggest_nearest(str(word), valid)
        raise ScenarioError(f"is {word!r}, must be one of {choices}{hint}", path=path)


def check_finite(value: Any, path: str) -> None:
    """Refuses numbers that are not finite or have more than 64 bits, at any depth.

    Raises:
        ScenarioError: with the path of the key.
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, is {value}", path=path)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        problem = f"must be a number of at most 64 bits, has {value.bit_length()}"
        raise ScenarioError(problem, path=path)
    if isinstance(value, dict):
        for key, entry in value.items():
            entry_path = f"{path}.{key}" if path else key
            check_finite(entry, entry_path)
    if isinstance(value, list):
        for n, entry in enumerate(value):
            check_finite(entry, f"{path}[{n}]")


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
"""Units by their spelling at the end of names."""


def split_unit(name: str) -> tuple[str, str]:
    """Returns the words of a name before its unit, and the unit, or "" without a unit.

    The longest ending that is a unit counts.

    >>> split_unit("contact_stiffness_n_m")
    ('contact stiffness', 'N/m')
    """
    parts = name.split("_")
    for n in range(1, len(parts)):
        ending = "_".join(parts[n:])
        if ending in UNITS:
            return " ".join(parts[:n]), UNITS[ending]
    return " ".join(parts), ""

"""Fields of a scenario: the base of its types, ranges of its numbers, and checks of an author's
tables.

Invariant: an error names the path of the key as the author wrote it, and the nearest valid
name. No quantity of an arm, a gain or a torque exceeds `MAX_QUANTITY`, which keeps arithmetic
far from its limits.
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
from .errors import ScenarioError


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; unknown keys are refused."""


K = TypeVar("K", bound=Frozen)


def find_kinds(package: str, base: type[K]) -> Iterator[type[K]]:
    """Yields the kinds of a base, named by a tag, that the files of its package define, by file
    and place.
    """
    for found in pkgutil.iter_modules(import_module(package).__path__):
        module = f"{package}.{found.name}"
        for one in vars(import_module(module)).values():
            own = isinstance(one, type) and issubclass(one, base) and one.__module__ == module
            # else it is a base of others
            if own and one.__struct_config__.tag not in (
                None,
                one.__name__,
            ):
                yield one


MAX_QUANTITY = 1e9

Positive = Annotated[float, Meta(gt=0.0, le=MAX_QUANTITY)]
NotNegative = Annotated[float, Meta(ge=0.0, le=MAX_QUANTITY)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Real = Annotated[float, Meta(ge=-MAX_QUANTITY, le=MAX_QUANTITY)]
_PER_JOINT = Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "joints"})
_PER_PARAMETER = Meta(
    min_length=1, max_length=MAX_JOINTS * LINK_PARAMETERS, extra={"per": "parameters"}
)
_PER_COORDINATE = Meta(min_length=1, max_length=MAX_JOINTS, extra={"per": "shared"})
_PER_AXIS = Meta(min_length=2, max_length=3, extra={"per": "axes"})
Joints = Annotated[tuple[Real, ...], _PER_JOINT]
PositiveJoints = Annotated[tuple[Positive, ...], _PER_JOINT]
NotNegativeJoints = Annotated[tuple[NotNegative, ...], _PER_JOINT]
Parameters = Annotated[tuple[Real, ...], _PER_PARAMETER]
NotNegativeParameters = Annotated[tuple[NotNegative, ...], _PER_PARAMETER]
PositiveCoordinates = Annotated[tuple[Positive, ...], _PER_COORDINATE]
NotNegativeCoordinates = Annotated[tuple[NotNegative, ...], _PER_COORDINATE]
NotNegativeAxes = Annotated[tuple[NotNegative, ...], _PER_AXIS]
Point = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=3, extra={"point": "axes"})]
RateHz = Annotated[int, Meta(ge=1, le=20_000)]

TomlTable = dict[str, Any]
StructType = type[msgspec.Struct]


class VectorCounts(NamedTuple):
    """How many numbers the vectors of a site have: per joint, parameter, axis, shared
    coordinate.
    """

    joints: int = JOINTS
    parameters: int = PARAMETERS
    axes: int = 2
    shared: int = JOINTS

    @classmethod
    def of_chain(cls, joints: int, shared: int = 0) -> "VectorCounts":
        """Returns those of a chain of so many joints, which shares them or so many coordinates."""
        return cls(joints, LINK_PARAMETERS * joints, 3, shared or joints)


class KeyProblem(NamedTuple):
    """A key that cannot be as it is, below the table that is checked ("": the table itself),
    and why.
    """

    key: str
    problem: str


@cache
def _vector_keys(kind: StructType, extra: str) -> Mapping[str, str]:
    """Returns the keys of a type whose vectors have a number per joint, parameter or axis, and
    per which.
    """
    return {
        key: str(meta.extra[extra])
        for key, hint in get_type_hints(kind, include_extras=True).items()
        for meta in getattr(hint, "__metadata__", ())
        if isinstance(meta, Meta) and meta.extra is not None and extra in meta.extra
    }


def expand_vectors(table: TomlTable, kind: StructType, counts: VectorCounts) -> TomlTable:
    """Returns a table with every single number or distribution written out as the vector of its
    type.

    A vector that is absent has its type's default, as long as the arm needs it.
    """
    per = _vector_keys(kind, "per")
    defaults = {
        field.name: [field.default[0]] * getattr(counts, per[field.name])
        for field in msgspec.structs.fields(kind)
        if field.name in per and isinstance(field.default, tuple)
    }
    written = {
        key: [value] * getattr(counts, per[key])
        if key in per and (is_number(value) or is_distribution(value))
        else value
        for key, value in table.items()
    }
    return {**defaults, **written}


_OWNERS = {
    **dict.fromkeys(("joints", "parameters"), "the arm has"),
    "axes": "its space has",
    "shared": "sites share",
}


def find_count_problem(
    table: TomlTable, kind: StructType, counts: VectorCounts
) -> KeyProblem | None:
    """Returns the first vector of a table that has too few or too many numbers, or None."""
    for key, per in {**_vector_keys(kind, "per"), **_vector_keys(kind, "point")}.items():
        wanted = getattr(counts, per)
        value = table.get(key)
        if isinstance(value, list) and len(value) != wanted:
            owner = f"{_OWNERS[per]} {wanted} {per if per != 'shared' else 'coordinates'}"
            return KeyProblem(
                key, f"has {len(value)} number{'s' * (len(value) != 1)}, and {owner}"
            )
    return None


def is_number(value: Any) -> TypeGuard[float]:
    """True for a number as an author writes it; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_distribution(value: Any) -> bool:
    """True for a table that stands for a number: { normal = [...] } or { uniform = [...] }."""
    return isinstance(value, dict) and not value.keys().isdisjoint(("normal", "uniform"))


def split_refusal(error: msgspec.ValidationError) -> tuple[str, str]:
    """Returns the problem of a refused value, and the path of its key below what was converted."""
    problem, _, place = str(error).partition(" - at ")
    return problem, place.strip("`$")


def reword_problem(problem: str) -> str:
    """Returns a validation message in the words of a scenario's author."""
    words = (("`", ""), ("Expected ", "expected "), ("array", "list"), ("str", "text"))
    for old, new in words:
        problem = problem.replace(old, new)
    return problem


MOST_LETTERS = 80
MOST_COMPARED = 500
"""Of a word that is compared with others, and how many these are: the time grows by more than
the product.
"""


def suggest_nearest(word: str, valid: Sequence[str]) -> str:
    """Returns "; did you mean ...?", or "" if nothing valid is near, or there is too much to
    compare.
    """
    named = [name for name in valid[:MOST_COMPARED] if len(name) <= MOST_LETTERS]
    match = (
        difflib.get_close_matches(word, named, n=1, cutoff=0.5)
        if len(word) <= MOST_LETTERS
        else []
    )
    return f"; did you mean {match[0]!r}?" if match else ""


def check_keys(table: Any, valid: Sequence[str], path: str) -> TomlTable:
    """Returns the table if it is one and has no key but the valid ones; errors call it `path`."""
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            where = f"{path}.{key}" if path else key
            hint = suggest_nearest(key, valid) or f"; valid are {', '.join(valid)}"
            raise ScenarioError(f"unknown key{hint}", path=where)
    return table


def field_names(kind: StructType) -> tuple[str, ...]:
    """Returns the keys of a type."""
    return kind.__struct_encode_fields__


def check_choice(word: Any, valid: Sequence[str], path: str) -> None:
    """Refuses a word that is not valid."""
    if word not in valid:
        hint = suggest_nearest(str(word), valid)
        raise ScenarioError(
            f"is {word!r}, must be one of {', '.join(map(repr, valid))}{hint}", path=path
        )


def check_finite(value: Any, path: str) -> None:
    """Refuses a number that is not finite, or has more than 64 bits, at any depth."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, is {value}", path=path)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ScenarioError(
            f"must be a number of at most 64 bits, has {value.bit_length()}", path=path
        )
    if isinstance(value, dict):
        for key, entry in value.items():
            check_finite(entry, f"{path}.{key}" if path else key)
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
"""Units by how they are written at the ends of names."""


def split_unit(name: str) -> tuple[str, str]:
    """Returns a name in words without its unit, and that: of the longest ending that is one, ""
    without any.

    >>> split_unit("contact_stiffness_n_m")
    ('contact stiffness', 'N/m')
    """
    words = name.split("_")
    endings = (
        (" ".join(words[:n]), UNITS.get("_".join(words[n:]), "")) for n in range(1, len(words))
    )
    return next((found for found in endings if found[1]), (" ".join(words), ""))

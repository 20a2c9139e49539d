"""Checks scenario keys for mistakes that the types of the tables cannot detect.

The types (see `fields`) restrict individual numbers. This module checks the rest, for example
that a vector has one entry per joint of its arm, and that the name of a key is valid.

Invariant:
    - An error contains the path of the key as written by the author of the scenario. For an
      unknown name, it suggests the most similar valid name.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple, TypeGuard, get_args, get_type_hints

import msgspec
from msgspec import Meta

from ..core import LINK_PARAMETERS
from ..errors import ScenarioError, count_nouns, suggest_nearest
from ..fields import KeyProblem, TomlTable
from ..records import JOINTS, PARAMETERS

StructType = type[msgspec.Struct]

_COUNT_TEXTS = {
    "joints": ("the arm has", "joint"),
    "parameters": ("the arm has", "parameter"),
    "axes": ("the space of the arm has", "axis"),
    "shared": ("sites share", "coordinate"),
}
"""Start and noun of a sentence about each count, as in "the arm has 2 joints"."""


class VectorCounts(NamedTuple):
    """Lengths of the vectors that belong to one arm, for example 6 gains for 6 joints.

    Used to check the length of vectors in a scenario, and to expand a scalar to a vector.

    Attributes:
        joints: Length of a vector with one entry per joint.
        parameters: Length of a vector with one entry per dynamic parameter of the arm.
        axes: Length of a vector with one entry per spatial axis: 2 for a planar arm, otherwise
            3.
        shared: Length of a vector with one entry per coordinate that the sites exchange, for
            example per joint or per axis of the end effector.
    """

    joints: int = JOINTS
    parameters: int = PARAMETERS
    axes: int = 2
    shared: int = JOINTS

    @classmethod
    def of_chain(cls, joints: int, shared: int = 0) -> "VectorCounts":
        """Returns the vector lengths for a chain with the given number of joints.

        Args:
            joints: Number of joints of the arm.
            shared: Number of coordinates that the sites exchange. If 0, this is the number of
                joints.
        """
        return cls(
            joints=joints,
            parameters=LINK_PARAMETERS * joints,
            axes=3,
            shared=shared or joints,
        )

    def expand_vectors(self, table: TomlTable, kind: StructType) -> TomlTable:
        """Expands scalars to vectors of the length that the arm needs.

        For example, `Kd = 5` becomes a vector of fives with one entry per joint. A distribution
        such as `{ uniform = [1, 2] }` is repeated in the same way. A missing vector is set to
        the default of its type, with the right length.

        Args:
            table: A table of a scenario.
            kind: Type of the table.

        Returns:
            The expanded table. Other keys are unchanged.
        """
        lengths: dict[str, int] = {}
        for key, per in _vector_keys(kind, "per").items():
            lengths[key] = getattr(self, per)
        expanded: TomlTable = {}
        for field in list_fields(kind):
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

    def find_problem(self, table: TomlTable, kind: StructType) -> KeyProblem | None:
        """Finds the first vector of a table that has too few or too many entries.

        A scalar in place of a vector is not a problem.

        Args:
            table: A table of a scenario whose values have the right types.
            kind: Type of the table.

        Returns:
            The key and the problem, or None if all vectors have the right length.
        """
        count_names = {**_vector_keys(kind, "per"), **_vector_keys(kind, "point")}
        for key, per in count_names.items():
            required = getattr(self, per)
            value = table.get(key)
            if not isinstance(value, list | tuple) or len(value) == required:
                continue
            numbers = count_nouns(len(value), "number")
            owner, noun = _COUNT_TEXTS[per]
            return KeyProblem(key, f"has {numbers}, and {owner} {count_nouns(required, noun)}")
        return None


def find_extra(hint: Any, name: str) -> str | None:
    """Looks up a name in the `Meta.extra` of a type annotation.

    For example, `Annotated[str, Meta(extra={"must_be": "a name"})]` yields "a name" for
    "must_be". Returns None if the annotation does not contain the name.
    """
    # Only a type of the form `Annotated[type, ...]` has this attribute.
    for annotation in getattr(hint, "__metadata__", ()):
        extra = annotation.extra if isinstance(annotation, Meta) else None
        if extra is not None and name in extra:
            return str(extra[name])
    return None


@cache
def _vector_keys(kind: StructType, extra: str) -> Mapping[str, str]:
    """Finds the vector keys of a table, and the count that determines the length of each.

    The length of a vector depends on the arm, for example on its number of joints. It is
    declared in the annotation of the field: `Kd: Annotated[tuple[float, ...],
    Meta(extra={"per": "joints"})]` has one entry per joint, and appears in the result as `"Kd":
    "joints"`.

    Args:
        kind: Structure type of the table.
        extra: Kind of vectors to find, as a key of `Meta.extra`: "per" for vectors that a
            scalar may stand for, or "point" for points in space, which must be written in full.

    Returns:
        Mapping from vector key to the field of `VectorCounts` that contains its length.
    """
    count_names = {}
    for key, hint in get_type_hints(kind, include_extras=True).items():
        # A limit of a site is a union of a number and a vector.
        for member in (hint, *get_args(hint)):
            count_name = find_extra(member, extra)
            if count_name is not None:
                count_names[key] = count_name
    return count_names


@lru_cache(maxsize=256)
def list_fields(kind: StructType) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Returns the fields of a scenario table type such as `Arm`.

    The result is cached: `msgspec.structs.fields` evaluates the annotations again on each call,
    and a scenario has many tables of the same type.
    """
    return msgspec.structs.fields(kind)


def is_number(value: Any) -> TypeGuard[float]:
    """Returns True if a TOML value is a number.

    Booleans are not numbers, although they are integers in Python.

    Args:
        value: A value as read from TOML.
    """
    return isinstance(value, int | float) and not isinstance(value, bool)


def is_distribution(value: Any) -> bool:
    """Returns True if a TOML value is a random distribution, as in `{ uniform = [1, 2] }`.

    Args:
        value: A value as read from TOML.
    """
    if not isinstance(value, dict):
        return False
    return "normal" in value or "uniform" in value


def check_keys(
    table: Any, valid: Sequence[str], path: str, elsewhere: Sequence[str] = ()
) -> TomlTable:
    """Raises ScenarioError unless a value is a table with only valid keys.

    The error suggests the key that the author may have meant.

    Args:
        table: A value of a scenario.
        valid: Keys that the table may have.
        path: Dotted path of the table, for error messages.
        elsewhere: Dotted paths of keys in other tables that the author may have meant.

    Returns:
        The table, unchanged.

    Raises:
        ScenarioError: The value is not a table, or has an unknown key.
    """
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            key_path = f"{path}.{key}" if path else key
            raise ScenarioError(describe_unknown_key(key, valid, elsewhere), path=key_path)
    return table


def describe_unknown_key(key: str, valid: Sequence[str], elsewhere: Sequence[str]) -> str:
    """Returns a message that a key is unknown, with a suggestion for the intended key.

    Args:
        key: The unknown key.
        valid: Keys that the table may have.
        elsewhere: Dotted paths of keys in other tables that the author may have meant.
    """
    hint = hint_at_quotes(key) or suggest_nearest(key, valid, elsewhere)
    if not hint:
        hint = f"; valid keys are {', '.join(valid)}"
    return f"unknown key{hint}"


def hint_at_quotes(text: str) -> str:
    """Returns a hint for an argument that a shell has cut off at the ">" of a link name.

    Outside quotes, a shell treats ">" as output redirection. Of the argument
    `links.m1->s.delay_ms=5`, the program then receives only "links.m1-".

    Args:
        text: A key or an override.

    Returns:
        Text to append to an error message. Empty if the argument was not cut off.
    """
    if not text.endswith("-"):
        return ""
    return (
        "; a shell cuts a text off at > and writes a file: put the whole text in quotes, as in "
        "'links.m1->s.delay_ms=5'"
    )


def field_names(kind: StructType) -> tuple[str, ...]:
    """Returns the keys that a scenario table of the given type may have.

    Args:
        kind: Type of the table.
    """
    return kind.__struct_encode_fields__


def check_choice(word: Any, valid: Sequence[str], path: str) -> None:
    """Raises ScenarioError if a value, such as the name of a law, is not a valid choice.

    Args:
        word: A value of a scenario.
        valid: The valid choices.
        path: Dotted path of the key, for error messages.

    Raises:
        ScenarioError: The value is not a valid choice. The message suggests the most similar
            one.
    """
    if word not in valid:
        quoted = [repr(choice) for choice in valid]
        choices = ", ".join(quoted)
        hint = suggest_nearest(str(word), valid)
        raise ScenarioError(f"is {word!r}, but must be one of {choices}{hint}", path=path)


def check_finite(value: Any, path: str) -> None:
    """Raises ScenarioError if a number is not finite or does not fit into 64 bits.

    Tables and lists are checked recursively.

    Args:
        value: A value of a scenario.
        path: Dotted path of the key, for error messages.

    Raises:
        ScenarioError: A number is rejected. The error contains the path of its key.
    """
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, but is {value}", path=path)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        length = value.bit_length()
        problem = f"must be an integer of at most 64 bits, but has {length} bits"
        raise ScenarioError(problem, path=path)
    if isinstance(value, dict):
        for key, entry in value.items():
            entry_path = f"{path}.{key}" if path else key
            check_finite(entry, entry_path)
    if isinstance(value, list):
        for n, entry in enumerate(value):
            check_finite(entry, f"{path}[{n}]")

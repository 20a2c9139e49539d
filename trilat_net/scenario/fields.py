"""Fields of a scenario.

The base of its types, ranges of its numbers, and checks of tables as people write them.

Invariant: an error names the path of the key in the shape in which it was written, and the nearest valid
name. No quantity of an arm, a gain or a torque exceeds `MAX_QUANTITY`, which keeps arithmetic far from
its limits.
"""

import difflib
import math
from collections.abc import Sequence
from typing import Annotated, Any, TypeGuard

import msgspec
from msgspec import Meta

from ..errors import ScenarioError


class Frozen(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; unknown keys are refused."""


MAX_QUANTITY = 1e9

Positive = Annotated[float, Meta(gt=0.0, le=MAX_QUANTITY)]
NotNegative = Annotated[float, Meta(ge=0.0, le=MAX_QUANTITY)]
Real = Annotated[float, Meta(ge=-MAX_QUANTITY, le=MAX_QUANTITY)]
Joints = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]
PositiveJoints = Annotated[tuple[Positive, ...], Meta(min_length=2, max_length=2)]
NotNegativeJoints = Annotated[tuple[NotNegative, ...], Meta(min_length=2, max_length=2)]
Parameters = Annotated[tuple[Real, ...], Meta(min_length=5, max_length=5)]
NotNegativeParameters = Annotated[tuple[NotNegative, ...], Meta(min_length=5, max_length=5)]
RateHz = Annotated[int, Meta(ge=1, le=20_000)]

TomlTable = dict[str, Any]


def is_number(value: Any) -> TypeGuard[float]:
    """True where what an author wrote is a number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def suggest_nearest(word: str, valid: Sequence[str]) -> str:
    """Returns "; did you mean ...?", or "" where nothing valid is near."""
    match = difflib.get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {match[0]!r}?" if match else ""


def check_keys(table: Any, valid: Sequence[str], path: str) -> TomlTable:
    """Returns the table if it is one and has no key but the valid ones.

    Args:
        table: what the author wrote.
        valid: the keys that it may have.
        path: what errors call it.
    """
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            where = f"{path}.{key}" if path else key
            hint = suggest_nearest(key, valid) or f"; valid are {', '.join(valid)}"
            raise ScenarioError(f"unknown key{hint}", path=where)
    return table


def field_names(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    """Returns the keys that a type has."""
    return kind.__struct_fields__


def check_choice(word: Any, valid: Sequence[str], path: str) -> None:
    """Refuses a word that is none of the valid ones."""
    if word not in valid:
        hint = suggest_nearest(str(word), valid)
        raise ScenarioError(f"is {word!r}, must be one of {', '.join(map(repr, valid))}{hint}", path=path)


def check_finite(value: Any, path: str) -> None:
    """Refuses a number that is not finite, or has more than 64 bits, however deep it lies."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, is {value}", path=path)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ScenarioError(f"must be a number of at most 64 bits, has {value.bit_length()}", path=path)
    if isinstance(value, dict):
        for key, entry in value.items():
            check_finite(entry, f"{path}.{key}" if path else key)
    if isinstance(value, list):
        for n, entry in enumerate(value):
            check_finite(entry, f"{path}[{n}]")

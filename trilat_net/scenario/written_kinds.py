"""Derives the type of a table as written by an author from the type of the complete table.

In a complete scenario, every key has a value. Its author may leave out keys, write a number in
place of a vector of equal entries, and write a random distribution in place of a number.
Deriving the type avoids declaring each table twice with the same keys and ranges.
"""

from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
from msgspec import UNSET, Meta

from ..fields import Frozen, TomlTable
from .distributions import StatedDistribution
from .key_checks import StructType, find_extra, list_fields


@cache
def written_kind(
    kind: StructType, *other_keys: str, takes_distributions: bool = True
) -> StructType:
    """Derives the type of a table in a scenario file from the type of the complete table.

    Every key becomes optional. A scalar may stand for a vector with one entry per joint, axis
    or parameter.

    Args:
        kind: Type of the complete table, for example `Limits`.
        other_keys: Additional keys that the file may contain, with string values.
        takes_distributions: True if a random distribution may take the place of each number.
    """
    fields: list[tuple[str, Any, Any]] = [(key, str, UNSET) for key in other_keys]
    for field in list_fields(kind):
        hint = written_type(field.type, takes_distributions)
        if field.default == ():
            # If the default is an empty vector, a written vector must be complete.
            hint = _list_type(field.type, takes_distributions)
        fields.append((field.name, hint, UNSET))
    return msgspec.defstruct(f"Written{kind.__name__}", fields, bases=(Frozen,), frozen=True)


def written_type(hint: Any, takes_distributions: bool) -> Any:
    """Derives the type that an author may write for a key from the type of its complete value.

    In place of a number, an author may write a distribution. In place of a vector with one
    entry per joint, an author may write a number, a distribution, or a list of both.

    Args:
        hint: Type of the complete value.
        takes_distributions: True if a random distribution may take the place of a number.
    """
    base, _ = _split_annotation(hint)
    origin = get_origin(base)
    if base is float and takes_distributions:
        return hint | StatedDistribution

    if origin in (Union, UnionType):
        # TOML has no null value. A key is left out instead.
        members = [member for member in get_args(base) if member is not type(None)]
        written_members = [written_type(member, takes_distributions) for member in members]
        return Union[tuple(written_members)]  # noqa: UP007 - the members are computed

    if origin is dict:
        return dict[str, written_type(get_args(base)[1], takes_distributions)]  # type: ignore[misc]

    if origin is tuple:
        is_vector = find_extra(hint, "per") is not None
        written_list = _list_type(hint, takes_distributions)
        if not (is_vector and takes_distributions):
            return written_list
        return written_type(get_args(base)[0], takes_distributions) | written_list

    if isinstance(base, type) and issubclass(base, msgspec.Struct):
        return written_kind(base, takes_distributions=takes_distributions)
    # texts, choices, whole numbers, and true or false
    return hint


def _list_type(hint: Any, takes_distributions: bool) -> Any:
    """Returns the type of the list that an author may write in place of a complete list.

    The length of a vector depends on the arm, and is checked once the arm is known.
    """
    base, annotations = _split_annotation(hint)
    entry = get_args(base)[0]
    if get_origin(entry) is tuple:
        # The rows of a table of numbers are checked with the complete scenario.
        return list
    if isinstance(entry, type) and issubclass(entry, msgspec.Struct):
        # The keys of these tables depend on their site.
        return list[TomlTable]

    entries: Any = list[written_type(entry, takes_distributions)]  # type: ignore[misc]
    count_name = find_extra(hint, "per")
    if count_name is not None:
        return Annotated[entries, Meta(extra={"per": count_name})]
    return Annotated[(entries, *annotations)] if annotations else entries


def _split_annotation(hint: Any) -> tuple[Any, tuple[Meta, ...]]:
    """Splits the annotation of a field into the type and its limits."""
    if get_origin(hint) is Annotated:
        return get_args(hint)[0], hint.__metadata__
    return hint, ()

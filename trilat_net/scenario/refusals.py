"""Explains errors in the tables of a scenario to its author.

The tables are validated by the library msgspec, which rejects the first value of the wrong
type. Its message is meant for programmers: "Expected `float | object`, got `str` - at
`$.sites[...].arm.l1_m`". This module converts such a message to an error that names the key as
written in the file, and states the permitted values.

A type annotation may describe the permitted values in words: `Meta(extra={"must_be": "a time in
s"})`.

Invariant:
    - `refuse` composes the error message for every table that msgspec rejects, except for
      tables of operators and environments, whose keys have messages of their own
      (`operators.VALUE_TEXTS`).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from ..errors import ScenarioError
from ..fields import WITHOUT_QUOTES, TomlTable, reword_problem
from .distributions import DISTRIBUTION_FORM, Distribution, StatedDistribution, dotted_key
from .key_checks import (
    describe_unknown_key,
    field_names,
    find_extra,
    is_distribution,
    list_fields,
)

_MESSAGE = re.compile(r"(?P<problem>.*) - at `\$(?P<location>.*)`", re.DOTALL)
"""Matches a msgspec error message about a value inside a table."""
_LOCATION_PART = re.compile(r"\.(?P<key>[^.\[]+)|\[(?P<index>\d+)\]|\[\.\.\.\]")
"""Matches the next part of a location in a msgspec message: `.arm`, `[0]` or `[...]`.

`[...]` stands for a dictionary key, for example the name of a site.
"""
_VECTOR_ENTRY = {
    "joints": "joint",
    "parameters": "parameter",
    "axes": "axis",
    "shared": "coordinate that the sites share",
}
"""Mapping from each length in `VectorCounts` to the noun for one entry of such a vector."""

MAX_QUOTED_LENGTH = 60
"""Maximum length of a value quoted in an error message."""

T = TypeVar("T")
Location = list[str | int]
"""Keys and indices that lead from a table to a value inside it."""


def refuse(
    error: msgspec.ValidationError,
    table: Any,
    kind: Any,
    path: str,
    elsewhere: Sequence[str] = (),
) -> ScenarioError:
    """Converts a msgspec validation error to an error meant for the author of the table.

    The new error names the wrong key by its path in the scenario and states the permitted
    values.

    Args:
        error: Error raised by msgspec for the table.
        table: The rejected table.
        kind: Type of the table.
        path: Dotted path of the table in the scenario. Empty for the scenario itself.
        elsewhere: Dotted paths of keys in other tables that the author may have meant by an
            unknown key.

    Returns:
        The new error, to be raised by the caller.
    """
    message, location = _split_message(str(error), table, kind)
    number_location = _find_table_for_number(table, kind, location)
    unknown_key = _quoted_key(message, "Object contains unknown field ")
    missing_key = _quoted_key(message, "Object missing required field ")
    if number_location is not None:
        location = number_location
        problem = _describe_table_for_number(_value_at(table, location), kind, location)
    elif unknown_key is not None:
        valid = [name for hint in _list_hints(kind, location) for name in _list_keys(hint)]
        problem = describe_unknown_key(unknown_key, valid, () if location else elsewhere)
        location.append(unknown_key)
    elif missing_key is not None:
        location.append(missing_key)
        must_be = _find_extra(kind, location, "must_be")
        problem = f"is missing; the value must be {must_be}" if must_be else "is missing"
    else:
        problem = _describe_wrong_value(message, table, kind, location, path)
    return ScenarioError(problem, path=_join_path(path, location))


def check_table(table: Any, kind: type[T], path: str, elsewhere: Sequence[str] = ()) -> T:
    """Converts one table of a scenario to an instance of `kind`.

    Args:
        table: The table as written by its author.
        kind: Type of the table.
        path: Dotted path of the table.
        elsewhere: Dotted paths of keys in other tables that the author may have meant.

    Raises:
        ScenarioError: The table contains an unknown key or an invalid value. The error contains
            the path of the key.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise refuse(error, table, kind, path, elsewhere) from None


def convert_drawn(
    table: TomlTable, kind: type[T], path: str, drawn: Mapping[str, Distribution], seed: int
) -> T:
    """Converts a complete table of a scenario, after random numbers were drawn, to its type.

    An invalid drawn number is reported together with its distribution and seed.

    Args:
        table: The table.
        kind: Type of the complete table.
        path: Dotted path of the table. Empty for the scenario itself.
        drawn: Mapping from dotted key to the distribution of each drawn number.
        seed: Seed with which the numbers were drawn.

    Raises:
        ScenarioError: A value has a wrong type or is out of range. If the value was drawn at
            random, the error says so, since the author did not write it.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        refusal = refuse(error, table, kind, path)
        origin = drawn.get(dotted_key(refusal.path))
        if origin is None:
            raise refusal from None
        problem = f"{refusal.problem}; {origin.value:g} was drawn with seed {seed}"
        raise ScenarioError(problem, path=refusal.path) from None


def _join_path(path: str, location: Location) -> str:
    """Returns the dotted path of a value inside a table, such as `sites.m1.q0_rad[0]`.

    Args:
        path: Dotted path of the table. Empty for the scenario itself.
        location: Keys and indices that lead from the table to the value.
    """
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        else:
            path += f".{part}" if path else part
    return path


def _describe_wrong_type(value: Any, expected: str) -> str:
    """Explains why a value from a scenario file has the wrong type.

    Args:
        value: The value as read from TOML.
        expected: Description of the permitted values, such as "a number".

    Returns:
        The problem, such as "expected a number, got text", as the end of a sentence about the
        key.
    """
    if isinstance(value, str):
        return f"expected {expected}, got text{WITHOUT_QUOTES}"
    if isinstance(value, bool):
        return f"expected {expected}, got true or false"
    if isinstance(value, dict):
        return f"expected {expected}, got a table"
    if isinstance(value, list):
        return f"expected {expected}, got a list"
    return f"expected {expected}, got {value!r}"


def _describe_wrong_value(
    message: str, table: Any, kind: Any, location: Location, path: str
) -> str:
    """Explains why a value has the wrong type or is out of range.

    Args:
        message: Message of msgspec, excluding the location.
        table: The rejected table.
        kind: Type of the table.
        location: Location of the value in the table.
        path: Dotted path of the table.
    """
    hints = _list_hints(kind, location)
    value = _value_at(table, location)
    if message.startswith("Invalid enum value "):
        choices = [repr(word) for hint in hints for word in _list_choices(hint)]
        return f"is {value!r}, but must be {' or '.join(choices)}"

    is_wrong_type = message.startswith("Expected `") and ", got `" in message
    if not is_wrong_type:
        return reword_problem(message)
    must_be = _find_extra(kind, location, "must_be")
    if must_be is not None:
        quoted = repr(value)
        ending = f", but is {quoted}" if len(quoted) <= MAX_QUOTED_LENGTH else ""
        return f"must be {must_be}{ending}"
    if StatedDistribution in hints:
        return _describe_wrong_number(value, kind, location)
    if message.startswith("Expected `object`, got `"):
        return "must be a table"
    if message.startswith("Expected `array`, got `") and any(map(_is_list_of_tables, hints)):
        return f"must be a list of tables [[{_join_path(path, location)}]]"
    return reword_problem(message)


def _describe_table_for_number(table: TomlTable, kind: Any, location: Location) -> str:
    """Explains why a table in place of a number is not a valid distribution."""
    if is_distribution(table):
        return f"{DISTRIBUTION_FORM}, but is {table}"
    return _describe_wrong_number(table, kind, location)


def _describe_wrong_number(value: Any, kind: Any, location: Location) -> str:
    """Explains why a value is not a valid number, and states the permitted values.

    Args:
        value: The value.
        kind: Type of the rejected table.
        location: Location of the value in the table.
    """
    vector_length = _find_extra(kind, location, "per")
    if vector_length is None:
        return _describe_wrong_type(value, "a number")
    entry = _VECTOR_ENTRY[vector_length]
    return _describe_wrong_type(value, f"a number, or a list with one for each {entry}")


def _quoted_key(problem: str, start: str) -> str | None:
    """Returns the key quoted in a message after the words `start`, or None.

    For example, "Object missing required field `name`" quotes the key "name".
    """
    quoted = problem.removeprefix(start)
    return None if quoted == problem else quoted[1:-1]


# The location of a value, and the types that the value may have there.


def _split_message(message: str, table: Any, kind: Any) -> tuple[str, Location]:
    """Splits a msgspec message into the problem and the location of the rejected value.

    msgspec does not name dictionary keys: it writes `$.sites[...].q0_rad[0]`.
    `_find_refused_key` determines these keys.

    Args:
        message: The message.
        table: The rejected table.
        kind: Type of the table.
    """
    match = _MESSAGE.fullmatch(message)
    if match is None:
        return message, []
    location: Location = []
    value = table
    for part in _LOCATION_PART.finditer(match["location"]):
        step: Any = part["key"]
        if part["index"] is not None:
            step = int(part["index"])
        elif step is None:
            step = _find_refused_key(message, table, kind, location)
        try:
            value = value[step]
        except (LookupError, TypeError):
            # The name of an unknown key may be chosen to look like the end of a message.
            break
        location.append(step)
    return match["problem"], location


def _find_refused_key(message: str, table: Any, kind: Any, location: Location) -> str | None:
    """Determines which entry of a dictionary was rejected by msgspec.

    Its messages do not name dictionary keys, so entries are converted one at a time until one
    produces the same message.

    Args:
        message: The message.
        table: The rejected table.
        kind: Type of the table.
        location: Location of the dictionary in the table.

    Returns:
        The key, or None if no single entry produces this message.
    """
    for key, entry in _value_at(table, location).items():
        try:
            msgspec.convert(_isolate(table, location, {key: entry}), kind)
        except msgspec.ValidationError as error:
            if str(error) == message:
                return str(key)
    return None


def _isolate(table: Any, location: Location, value: Any) -> Any:
    """Returns a copy of a table with one value replaced and other tables removed.

    Values in the same table that are not tables are kept, since one of them may determine the
    type, like the key `law`. The other tables are removed because validating them again for
    every entry of a long scenario would take too long.
    """
    if not location:
        return value
    part: Any = location[0]
    inner = _isolate(table[part], location[1:], value)
    if isinstance(table, list):
        return [*table[:part], inner]
    plain = {key: entry for key, entry in table.items() if not isinstance(entry, dict | list)}
    return {**plain, part: inner}


def _value_at(table: Any, location: Location) -> Any:
    """Returns the value at a location inside nested tables and lists."""
    value = table
    for part in location:
        value = value[part]
    return value


def _find_table_for_number(table: Any, kind: Any, location: Location) -> Location | None:
    """Finds a table around a rejected value that was written in place of a number.

    Such a table specifies, or was meant to specify, a random distribution. Returns None if
    there is no such table.
    """
    for length in range(1, len(location) + 1):
        start = location[:length]
        takes_distribution = StatedDistribution in _list_hints(kind, start)
        if takes_distribution and isinstance(_value_at(table, start), dict):
            return start
    return None


def _list_hints(kind: Any, location: Location) -> list[Any]:
    """Returns the types that a value may have at a location in a scenario table.

    Args:
        kind: Type of the table.
        location: Location of the value.
    """
    hints = list(_list_alternatives(kind))
    for part in location:
        inner_hints = [inner for hint in hints for inner in _list_inner_hints(hint, part)]
        hints = [member for inner in inner_hints for member in _list_alternatives(inner)]
    return hints


def _list_alternatives(hint: Any) -> Iterator[Any]:
    """Yields the members of a union of types, or the type itself if it is not a union."""
    base = _strip_annotation(hint)
    if get_origin(base) not in (Union, UnionType):
        yield hint
        return
    for member in get_args(base):
        yield from _list_alternatives(member)


def _list_inner_hints(hint: Any, part: str | int) -> Iterator[Any]:
    """Yields the types one level down: of a field, dictionary value or list entry.

    Args:
        hint: Type of the struct, dictionary or list.
        part: Key or index.
    """
    base = _strip_annotation(hint)
    origin, arguments = get_origin(base), get_args(base)
    if isinstance(base, type) and issubclass(base, msgspec.Struct):
        yield from (field.type for field in list_fields(base) if field.encode_name == part)
    elif origin is dict and isinstance(part, str):
        yield arguments[1]
    elif origin in (list, tuple) and isinstance(part, int):
        is_fixed = origin is tuple and arguments[-1] is not Ellipsis
        yield arguments[part if is_fixed else 0]


def _strip_annotation(hint: Any) -> Any:
    """Removes the limits that an annotation adds to a type."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _find_extra(kind: Any, location: Location, name: str) -> str | None:
    """Looks up a name in the `Meta.extra` of a value's annotation, or returns None."""
    extras = (find_extra(hint, name) for hint in _list_hints(kind, location))
    return next((extra for extra in extras if extra is not None), None)


def _list_keys(hint: Any) -> tuple[str, ...]:
    """Returns the keys that a table of the given type may have. Empty for other types."""
    is_struct = isinstance(hint, type) and issubclass(hint, msgspec.Struct)
    return field_names(hint) if is_struct else ()


def _list_choices(hint: Any) -> tuple[str, ...]:
    """Returns the strings permitted by a type. Empty if the type is not a choice of strings."""
    return get_args(hint) if get_origin(hint) is Literal else ()


def _is_list_of_tables(hint: Any) -> bool:
    """Returns True if a type is a list of tables, such as the list of planned changes."""
    base = _strip_annotation(hint)
    if get_origin(base) not in (list, tuple):
        return False
    entry = get_args(base)[0]
    return get_origin(entry) is dict or bool(_list_keys(entry))

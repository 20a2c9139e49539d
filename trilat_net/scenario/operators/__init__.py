"""Operators and environments of a scenario: which there are, and how an author's tables become complete ones.

Invariant: each is found by its file in this folder; nothing else lists them. Mistakes are refused at their
own key.
"""

import pkgutil
import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Union

import msgspec

from ... import fields
from ...errors import ScenarioError
from ..distributions import Draws
from .interface import IN_WORDS, ROW_WORDS, WORDS, ActorBase, Holding
from .kernel_operators import LiveHand as LiveHand
from .kernel_operators import find_live_hand as find_live_hand


def _find_actors(group: str) -> Iterator[type[ActorBase]]:
    for found in pkgutil.iter_modules(__path__):
        module = import_module(f"{__name__}.{found.name}")
        here = (one for one in vars(module).values() if getattr(one, "__module__", "") == module.__name__)
        for one in here:
            if isinstance(one, type) and issubclass(one, ActorBase) and one.group == group and one.is_kind():
                yield one


OPERATORS: dict[str, type[ActorBase]] = {str(one.__struct_config__.tag): one for one in _find_actors("hands")}
ENVIRONMENTS: dict[str, type[ActorBase]] = {
    str(one.__struct_config__.tag): one for one in _find_actors("environment")
}
"""The operators and the environments by the name of their kind."""
if TYPE_CHECKING:
    Operator = ActorBase
    Environment = ActorBase
else:
    Operator = Union[tuple(OPERATORS.values())]  # noqa: UP007 - made of what was found
    Environment = Union[tuple(ENVIRONMENTS.values())]  # noqa: UP007
_SHOWN = 60
"""A longer value is not repeated in an error."""


def resolve_operators(
    written: Any,
    kinds: Mapping[str, type[ActorBase]],
    holding: Holding,
    path: str,
    draws: Draws,
) -> list[fields.TomlTable]:
    """Returns a site's operators or environments, complete, of the kinds that it may hold.

    Errors call the list `path`; `draws` gives the numbers of distributions.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    return [_resolve_actor(entry, kinds, holding, f"{path}[{n}]", draws) for n, entry in enumerate(written)]


def _resolve_actor(
    entry: Any, kinds: Mapping[str, type[ActorBase]], holding: Holding, path: str, draws: Draws
) -> fields.TomlTable:
    if not isinstance(entry, dict):
        raise ScenarioError("must be a table", path=path)
    kind = _check_kind(entry, kinds, path)
    fields.check_keys(entry, ("kind", *fields.field_names(kinds[kind])), path)
    table = draws.draw_numbers(fields.expand_vectors(entry, kinds[kind], holding.counts), path)
    kinds[kind].complete(table, entry, holding, draws, path)
    _check_values(table, kinds[kind], entry, path, holding.counts)
    return table


def _check_kind(entry: fields.TomlTable, kinds: Mapping[str, type[ActorBase]], path: str) -> str:
    """Returns the kind of an actor; refuses one in the wrong list with the name of the right one."""
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, others in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        if isinstance(kind, str) and kind in others and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs in {group}", path=f"{path}.kind")
    fields.check_choice(kind, list(kinds), f"{path}.kind")
    return str(kind)


def _check_values(
    table: fields.TomlTable,
    kind: type[ActorBase],
    entry: fields.TomlTable,
    path: str,
    counts: fields.VectorCounts,
) -> None:
    """Refuses a wrong or a missing value, with the values that its key takes."""
    words = {name: both[counts != fields.VectorCounts()] for name, both in IN_WORDS.items()}

    def describe_values(key: str) -> str:
        return (kind.words.get(key) or WORDS[key]).format(**words)

    try:
        msgspec.convert(table, kind)
        _check_lengths(table, kind, counts)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        if missing := re.search(r"missing required field `(\w+)`", problem):
            key = missing[1]
            raise ScenarioError(f"is missing: {describe_values(key)}", path=f"{path}.{key}") from None
        found = re.match(r"`\$\.(\w+)(.*)`", place)
        key, rest = (found[1], found[2]) if found else ("", place)
        if key not in entry:  # taken over from the arm, which is refused at its own key
            return
        if key == "points":
            one = f"a row {ROW_WORDS.format(**words)}" if rest else describe_values(key)
            raise ScenarioError(f"must be {one}", path=f"{path}.{key}{rest}") from None
        value = repr(entry[key])
        is_now = f", is {value}" if len(value) <= _SHOWN else ""
        raise ScenarioError(f"must be {describe_values(key)}{is_now}", path=f"{path}.{key}") from None


def _check_lengths(table: fields.TomlTable, kind: fields.StructType, counts: fields.VectorCounts) -> None:
    """Raises `msgspec.ValidationError` for a vector, or a row of a table, that does not fit the arm."""
    if found := fields.find_count_problem(table, kind, counts):
        raise msgspec.ValidationError(f"{found.problem} - at `$.{found.key}`")
    for n, row in enumerate(table.get("points", ())):
        if len(row) != 1 + counts.joints:
            raise msgspec.ValidationError(f"of another arm - at `$.points[{n}]`")

"""From what an author wrote of operators and environments to complete tables.

Law: a hand that says nothing of where it begins takes hold of the arm where the arm is at the start. What is
wrong is refused here, at its own key, with what would be right.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import msgspec

from ..errors import ScenarioError
from .actors import HANDS, SURROUNDINGS
from .tables import Table, fields, is_number, known, one_of

_PAIRS = ("from_rad", "to_rad", "stiffness_nm_rad", "damping_nm_s_rad", "peak_nm")
_PLANE = ("stiffness_n_m", "damping_n_s_m")
"""Where one number may stand for both joints, or for both axes."""

_TIME = "a time of at least 0 s"
_ANGLES = "one angle for both joints or two, rad"
_POINT = "two numbers, x and y, m"
_GAIN = "one number for both joints or two, at least 0"
_ROW = "[time in s, torque on joint 1, on joint 2 in N m]"
_WORDS = {
    **dict.fromkeys(("start_s", "end_s", "move_start_s", "move_end_s"), _TIME),
    **dict.fromkeys(("from_rad", "to_rad"), _ANGLES),
    **dict.fromkeys(("from_m", "to_m", "point_m"), _POINT),
    "peak_nm": "one torque for both joints or two, ON the arm, N m",
    "stiffness_nm_rad": f"{_GAIN}, N m/rad",
    "damping_nm_s_rad": f"{_GAIN}, N m s/rad",
    "normal": "two numbers, x and y: to which side the wall is free",
    "points": f"a list of rows {_ROW}",
    "sampled": "true or false",
}
_PLANE_GAINS = {
    "tip_spring": "one number for both axes or two, at least 0",
    "wall": "a number of at least 0",
}
"""What a key wants, for an author who gave it something else or nothing."""
_SHOWN = 60
"""A value that takes more letters is not repeated."""


def resolve_actors(
    written: Any, kinds: Mapping[str, type[msgspec.Struct]], site: Table, path: str
) -> list[Table]:
    """Returns what a site's operator is, or what it meets, complete.

    Args:
        written: a list of tables, each with its kind.
        kinds: what there can be.
        site: the site's own tables, complete but for this.
        path: what errors call it.
    """
    if not isinstance(written, list):
        raise ScenarioError(f"must be a list of tables [[{path}]]", path=path)
    return [_resolved(entry, kinds, site, f"{path}[{n}]") for n, entry in enumerate(written)]


def _resolved(entry: Any, kinds: Mapping[str, type[msgspec.Struct]], site: Table, path: str) -> Table:
    if not isinstance(entry, dict):
        raise ScenarioError("must be a table", path=path)
    kind = _kind(entry, kinds, path)
    both = (*_PAIRS, *(_PLANE if kind == "tip_spring" else ()))
    table = {
        key: [value] * 2 if key in both and is_number(value) else value
        for key, value in known(entry, ("kind", *fields(kinds[kind])), path).items()
    }
    if kind == "spring":
        table.setdefault("from_rad", site["q0_rad"])
        table.setdefault("to_rad", table["from_rad"])
    if kind == "tip_spring":
        table.setdefault("from_m", _tip(site))
        table.setdefault("to_m", table["from_m"])
    _check(table, kinds[kind], entry, path)
    return table


def _kind(entry: Table, kinds: Mapping[str, type[msgspec.Struct]], path: str) -> str:
    """Returns what an actor is; one that stands in the wrong list is told where it belongs."""
    if "kind" not in entry:
        raise ScenarioError(f"is missing: {' or '.join(map(repr, kinds))}", path=f"{path}.kind")
    kind = entry["kind"]
    for group, others in (("hands", HANDS), ("environment", SURROUNDINGS)):
        if isinstance(kind, str) and kind in others and kind not in kinds:
            raise ScenarioError(f"is {kind!r}, which belongs in {group}", path=f"{path}.kind")
    one_of(kind, list(kinds), f"{path}.kind")
    return str(kind)


def _check(table: Table, kind: type[msgspec.Struct], entry: Table, path: str) -> None:
    """Refuses a value that an actor cannot have, or one that it lacks, and says what its key wants."""
    try:
        msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at ")
        if lacking := re.search(r"missing required field `(\w+)`", problem):
            raise ScenarioError(
                f"is missing: {_wanted(lacking[1], table)}", path=f"{path}.{lacking[1]}"
            ) from None
        found = re.match(r"`\$\.(\w+)(.*)`", place)
        key, rest = (found[1], found[2]) if found else ("", place)
        if key not in entry:  # taken over from the arm, whose own key is refused with its own words
            return
        if key == "points":
            one = f"a row {_ROW}" if rest else _WORDS[key]
            raise ScenarioError(f"must be {one}", path=f"{path}.{key}{rest}") from None
        value = repr(entry[key])
        is_now = f", is {value}" if len(value) <= _SHOWN else ""
        raise ScenarioError(f"must be {_wanted(key, table)}{is_now}", path=f"{path}.{key}") from None


def _wanted(key: str, table: Table) -> str:
    """Returns what a key wants, in words."""
    if key not in _PLANE:
        return _WORDS[key]
    return f"{_PLANE_GAINS[table['kind']]}, {('N/m', 'N s/m')[_PLANE.index(key)]}"


def _tip(site: Table) -> list[float]:
    """Returns where the tip is at the start, m; what is no number is refused later, with its path."""
    lengths = [site["arm"].get("l1_m", 1.0), site["arm"].get("l2_m", 1.0)]
    q0 = site["q0_rad"]
    if not (isinstance(q0, list) and len(q0) == 2 and all(map(is_number, [*q0, *lengths]))):
        return [0.0, 0.0]
    turned = q0[0] + q0[1]
    return [
        lengths[0] * math.cos(q0[0]) + lengths[1] * math.cos(turned),
        lengths[0] * math.sin(q0[0]) + lengths[1] * math.sin(turned),
    ]

"""From what an author wrote of operators and environments to complete tables.

Law: a hand that says nothing of where it begins takes hold of the arm where the arm is at the start.
"""

import math
from collections.abc import Mapping
from typing import Any

import msgspec

from ..errors import ScenarioError
from .tables import Table, fields, known, one_of

_PAIRS = ("from_rad", "to_rad", "stiffness_nm_rad", "damping_nm_s_rad", "peak_nm")
_PLANE = ("stiffness_n_m", "damping_n_s_m")
"""Where one number may stand for both joints, or for both axes."""


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
    if "kind" not in entry:
        raise ScenarioError(f"kind is missing: {' or '.join(map(repr, kinds))}", path=path)
    kind = entry["kind"]
    one_of(kind, list(kinds), f"{path}.kind")
    both = (*_PAIRS, *(_PLANE if kind == "tip_spring" else ()))
    table = {
        key: [value] * 2 if key in both and _is_number(value) else value
        for key, value in known(entry, ("kind", *fields(kinds[kind])), path).items()
    }
    if kind == "spring":
        table.setdefault("from_rad", site["q0_rad"])
        table.setdefault("to_rad", table["from_rad"])
    if kind == "tip_spring":
        table.setdefault("from_m", _tip(site))
        table.setdefault("to_m", table["from_m"])
    return table


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _tip(site: Table) -> list[float]:
    """Returns where the tip is at the start, m; what is no number is refused later, with its path."""
    lengths = [site["arm"].get("l1_m", 1.0), site["arm"].get("l2_m", 1.0)]
    q0 = site["q0_rad"]
    if not (isinstance(q0, list) and len(q0) == 2 and all(map(_is_number, [*q0, *lengths]))):
        return [0.0, 0.0]
    turned = q0[0] + q0[1]
    return [
        lengths[0] * math.cos(q0[0]) + lengths[1] * math.cos(turned),
        lengths[0] * math.sin(q0[0]) + lengths[1] * math.sin(turned),
    ]

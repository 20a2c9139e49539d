"""From what an author wrote to a complete scenario: defaults, checks of keys, names and shares.

Law: what a person writes is checked in the shape in which it was written, so that the path in an error is
one that the person can find in the file.
"""

import difflib
import math
import re
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from ..core import dominance
from ..core.arm import JOINTS, PARAMETERS
from ..errors import ScenarioError
from .model import Arm, Control, Limits, Link, Pulse, SiteSpec

Table = dict[str, Any]

_TOP = ("name", "title", "about", "assumed", "rate_hz", "duration_s", "seed", "scheme")
_TABLES = ("arm", "control", "limits", "link", "sites", "dominance", "links")
_SITE = ("role", "rate_hz", "q0_rad", "qd0_rad_s", "arm", "control", "limits", "hands")
_VECTORS = {
    "Lambda": JOINTS,
    "Kp": JOINTS,
    "Kd": JOINTS,
    "q0_rad": JOINTS,
    "qd0_rad_s": JOINTS,
    "peak_nm": JOINTS,
    "Gamma": PARAMETERS,
    "theta_hat0": PARAMETERS,
}
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)


def nearest(word: str, valid: Sequence[str]) -> str:
    """Returns "; did you mean ...?", or "" where nothing valid is near."""
    match = difflib.get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {match[0]!r}?" if match else ""


def _known(table: Any, valid: Sequence[str], path: str) -> Table:
    """Returns the table if it is one and has no key but the valid ones."""
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            where = f"{path}.{key}" if path else key
            hint = nearest(key, valid) or f"; valid are {', '.join(valid)}"
            raise ScenarioError(f"unknown key{hint}", path=where)
    return table


def _fields(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    return kind.__struct_fields__


def _vectors(table: Table) -> Table:
    """Writes a single number out where a vector is wanted."""
    return {
        key: [value] * _VECTORS[key]
        if key in _VECTORS and isinstance(value, int | float) and not isinstance(value, bool)
        else value
        for key, value in table.items()
    }


def _finite(value: Any, path: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, is {value}", path=path)
    if isinstance(value, dict):
        for key, entry in value.items():
            _finite(entry, f"{path}.{key}" if path else key)
    if isinstance(value, list):
        for n, entry in enumerate(value):
            _finite(entry, f"{path}[{n}]")


def resolve(tables: Table) -> Table:
    """Returns the tables with every default written out, in the shape of `Scenario`."""
    _known(tables, _TOP + _TABLES, "")
    _finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    for group, kind in (("arm", Arm), ("control", Control), ("limits", Limits), ("link", Link)):
        _known(tables.get(group, {}), _fields(kind), group)
    sites = _resolve_sites(tables)
    resolved = {key: _unix_lines(tables[key]) for key in _TOP if key in tables and key != "rate_hz"}
    return {
        "duration_s": 20.0,
        "seed": 1,
        "scheme": "second_order",
        **resolved,
        "sites": sites,
        "dominance": _resolve_dominance(tables, list(sites)),
        "links": _resolve_links(tables, list(sites)),
    }


def _unix_lines(value: Any) -> Any:
    """Returns text with one kind of line ends, which is what TOML keeps; other values as they are."""
    if isinstance(value, list):
        return [_unix_lines(entry) for entry in value]
    return value.replace("\r\n", "\n").replace("\r", "\n") if isinstance(value, str) else value


def _resolve_sites(tables: Table) -> Table:
    sites: Table = {}
    if not isinstance(tables["sites"], dict):
        raise ScenarioError("must be tables [sites.NAME]", path="sites")
    for name, written in tables["sites"].items():
        path = f"sites.{name}"
        if not _SITE_NAME.fullmatch(name) or name in _RESERVED:
            raise ScenarioError(
                "a site's name is lower-case letters, digits and _, beginning with a letter, "
                f"and not {_RESERVED[0]!r}",
                path=path,
            )
        site = _vectors(_known(written, _SITE, path))
        for group, kind in (("arm", Arm), ("control", Control), ("limits", Limits)):
            own = _known(site.get(group, {}), _fields(kind), f"{path}.{group}")
            site[group] = _vectors({**tables.get(group, {}), **own})
        site.setdefault("role", "master")
        site.setdefault("rate_hz", tables.get("rate_hz", 1000))
        site.setdefault("q0_rad", [0.0] * JOINTS)
        site.setdefault("qd0_rad_s", [0.0] * JOINTS)
        hands = site.get("hands", [])
        if not isinstance(hands, list):
            raise ScenarioError(f"must be a list of tables [[{path}.hands]]", path=f"{path}.hands")
        site["hands"] = [
            _vectors(_known(h, _fields(Pulse), f"{path}.hands[{n}]")) for n, h in enumerate(hands)
        ]
        sites[name] = {key: site[key] for key in _fields(SiteSpec)}
    if len(sites) < 2:
        raise ScenarioError(f"an experiment has at least two sites, this one has {len(sites)}", path="sites")
    return sites


def _resolve_dominance(tables: Table, names: list[str]) -> Table:
    written = _known(tables["dominance"], names, "dominance")
    rows: Table = {}
    for own, name in enumerate(names):
        path = f"dominance.{name}"
        if name not in written:
            raise ScenarioError("is missing: whom does this site follow?", path=path)
        row = _known(written[name], names, path)
        for peer, share in row.items():
            if isinstance(share, bool) or not isinstance(share, int | float):
                raise ScenarioError(f"must be a number, is {share!r}", path=f"{path}.{peer}")
        fault = dominance.row_fault(np.array([float(row.get(peer, 0.0)) for peer in names]), own)
        if fault:
            raise ScenarioError(fault, path=path)
        rows[name] = {peer: float(row.get(peer, 0.0)) for peer in names if peer != name}
    return rows


def _resolve_links(tables: Table, names: list[str]) -> Table:
    every = [f"{j}->{i}" for i in names for j in names if i != j]
    written = _known(tables.get("links", {}), every, "links")
    default = tables.get("link", {})
    links: Table = {}
    for name in every:
        own = _known(written.get(name, {}), _fields(Link), f"links.{name}")
        links[name] = {**default, **own}
        if "delay_ms" not in links[name]:
            raise ScenarioError("is missing; give it here or in [link]", path=f"links.{name}.delay_ms")
    return links

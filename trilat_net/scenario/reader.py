"""From TOML to a `Scenario`: overrides, defaults, checks.

Law: what a person writes is checked in the shape in which it was written, so that the path in an error is
one that the person can find in the file.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from ..core import dominance
from ..core.arm import JOINTS, PARAMETERS, positive_definite
from ..errors import ScenarioError
from .model import Arm, Control, Limits, Link, Pulse, Scenario, SiteSpec

Table = dict[str, Any]

_FOLDER = resources.files("trilat_net") / "scenarios"
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
_CHOICES = {
    key: get_args(kind.__annotations__[key])
    for kind, key in ((Scenario, "scheme"), (SiteSpec, "role"), (Control, "law"), (Pulse, "kind"))
}
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)


def shipped() -> list[str]:
    """Returns the names of the scenarios that come with the package."""
    names = (entry.name for entry in _FOLDER.iterdir())
    return sorted(n.removesuffix(".toml") for n in names if n.endswith(".toml") and not n.startswith("_"))


def shipped_text(name: str) -> str:
    """Returns the text of a shipped scenario as its author wrote it."""
    if name not in shipped():
        raise ScenarioError(
            f"no scenario of that name{_nearest(name, shipped())}; "
            f"shipped are {', '.join(shipped())}; a file is named by its path, as in ./mine.toml",
            source=name,
        )
    return (_FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def template_text() -> str:
    """Returns the commented template of a scenario, valid as it stands."""
    return (_FOLDER / "_template.toml").read_text(encoding="utf-8")


def load(source: str | Path | Scenario, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Scenario:
    """Returns a scenario by the name of a shipped one or by path, with overrides applied.

    Args:
        source: a shipped name, a path, or a scenario.
        overrides: `{"control.Kd": 5}` or `["control.Kd=5"]`.

    Raises:
        ScenarioError: the source cannot be read or is not a valid scenario.
    """
    if isinstance(source, Scenario):
        return parse(source.text, source.name, overrides) if overrides else source
    name = str(source)
    if isinstance(source, Path) or name.endswith(".toml") or "/" in name or "\\" in name:
        try:
            text = Path(source).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not UTF-8 text"
            raise ScenarioError(f"cannot be read: {reason}", source=name) from None
        return parse(text, name, overrides)
    return parse(shipped_text(name), name, overrides)


def site_named(scenario: Scenario, name: str) -> SiteSpec:
    """Returns a site of a scenario.

    Raises:
        ScenarioError: it has none of that name.
    """
    if name not in scenario.sites:
        hint = _nearest(name, scenario.names)
        raise ScenarioError(
            f"no site {name!r}{hint}; its sites are {', '.join(scenario.names)}", source=scenario.name
        )
    return scenario.sites[name]


def parse(text: str, source: str = "", overrides: Mapping[str, Any] | Sequence[str] = ()) -> Scenario:
    """Returns the scenario that a TOML text describes.

    Args:
        text: the TOML text.
        source: what errors call it.
        overrides: see `load`.

    Raises:
        ScenarioError: with the path of the offending key.
    """
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"is not TOML: {error}", source=source) from None
    try:
        override(tables, overrides)
        return _convert(_resolve(tables))
    except ScenarioError as error:
        raise ScenarioError(error.problem, path=error.path, source=source) from None


def override(tables: Table, overrides: Mapping[str, Any] | Sequence[str]) -> None:
    """Writes overrides into the tables of a scenario, in place.

    Args:
        tables: as read from TOML.
        overrides: a mapping from dotted keys, or texts KEY=VALUE whose value is TOML or a bare word.
    """
    for key, value in _pairs(overrides):
        *folders, last = key.split(".")
        sites = tables.get("sites")
        if len(folders) > 1 and folders[0] == "sites" and isinstance(sites, dict) and folders[1] not in sites:
            hint = _nearest(folders[1], list(sites)) or f"; its sites are {', '.join(sites)}"
            raise ScenarioError(f"no such site{hint}", path=key)
        table = tables
        for depth, folder in enumerate(folders):
            entry = table.setdefault(folder, {})
            if not isinstance(entry, dict):
                raise ScenarioError("is a value, not a table", path=".".join(folders[: depth + 1]))
            table = entry
        table[last] = value


def _pairs(overrides: Mapping[str, Any] | Sequence[str]) -> list[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        return list(overrides.items())
    pairs = []
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ScenarioError(f"an override reads KEY=VALUE, as in control.Kd=5, not {text!r}")
        try:
            parsed: Any = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed = value.strip()
        pairs.append((key.strip(), parsed))
    return pairs


def _nearest(word: str, valid: Sequence[str]) -> str:
    match = difflib.get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {match[0]!r}?" if match else ""


def _known(table: Any, valid: Sequence[str], path: str) -> Table:
    """Returns the table if it is one and has no key but the valid ones."""
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            where = f"{path}.{key}" if path else key
            hint = _nearest(key, valid) or f"; valid are {', '.join(valid)}"
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


def _resolve(tables: Table) -> Table:
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


def _convert(resolved: Table) -> Scenario:
    """Turns resolved tables into types; wrong types and ranges become errors with the key's path."""
    try:
        scenario = msgspec.convert(resolved, Scenario)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        dotted = _dotted(resolved, path.strip("`"))
        raise ScenarioError(_plain(problem, dotted), path=dotted) from None
    for name, site in scenario.sites.items():
        if not positive_definite(site.arm.theta):
            raise ScenarioError(
                "its inertia matrix is singular in some pose: give the links mass away from their joints",
                path=f"sites.{name}.arm",
            )
        for n, pulse in enumerate(site.hands):
            if pulse.end_s <= pulse.start_s:
                raise ScenarioError(
                    f"must be later than start_s = {pulse.start_s:g}, is {pulse.end_s:g}",
                    path=f"sites.{name}.hands[{n}].end_s",
                )
    return scenario


def _plain(problem: str, path: str) -> str:
    """Puts a validation message into the words of a scenario's author."""
    if problem.startswith("Invalid enum value"):
        choices = _CHOICES[path.rpartition(".")[2]]
        return f"is {problem.split()[-1]}, must be {' or '.join(map(repr, choices))}"
    if problem.startswith("Object missing required field"):
        return f"{problem.split()[-1].strip('`')} is missing"
    words = (("`", ""), ("Expected ", "expected "), ("array", "list"), ("str", "text"))
    for old, new in words:
        problem = problem.replace(old, new)
    return problem


def _dotted(resolved: Table, path: str) -> str:
    """Turns `$.sites[...].control.Kp[0]` into the dotted path of the first value that it can mean."""
    parts = re.findall(r"\.?([^.\[\]]+|\[[^\]]*\])", path.removeprefix("$"))
    return _search(resolved, [p for p in parts if p], "") or path.removeprefix("$.")


def _search(value: Any, parts: list[str], path: str) -> str:
    """Follows the parts; where one is `[...]` (any key), takes the entry whose value breaks the rule."""
    if not parts:
        return path
    head, rest = parts[0], parts[1:]
    if head == "[...]":
        found = ""
        for key in value:
            found = _search(value[key], rest, f"{path}.{key}")
            if found and not _valid_entry(path, value[key]):
                return found
        return found
    if head.startswith("["):
        return _search(value[int(head[1:-1])], rest, f"{path}{head}")
    if isinstance(value, dict) and head in value:
        return _search(value[head], rest, f"{path}.{head}" if path else head)
    return f"{path}.{head}" if path else head


def _valid_entry(folder: str, entry: Any) -> bool:
    kind: Any = {"sites": SiteSpec, "links": Link}.get(folder)
    try:
        msgspec.convert(entry, kind)
    except msgspec.ValidationError:
        return False
    return True

"""The step from an author's tables to a complete scenario: defaults, and checks of keys, names and dominance.

Invariant: what a person writes is checked in the shape in which it was written, so the path in an error
is one that the person finds in the file.
"""

import re
from pathlib import Path
from typing import Any

import msgspec

from ..core.two_link_arm import JOINTS, PARAMETERS
from ..errors import ScenarioError
from .expect import Expect
from .expect import check_window_keys as check_windows
from .fields import TomlTable, check_choice, check_finite, check_keys, field_names, is_number
from .laws import LAW_PATH_PATTERN, LAWS, source_sha256
from .operators import ENVIRONMENTS, OPERATORS, resolve_operators
from .resolve_links import resolve_dominance_row, resolve_links
from .run_changes import resolve_timeline
from .scenario_types import Arm, Limits, OnStale, SiteSpec

_TOP = ("name", "title", "about", "assumed", "rate_hz", "duration_s", "seed", "scheme")
_TABLES = (
    "arm",
    "control",
    "limits",
    "on_stale",
    "link",
    "sites",
    "dominance",
    "links",
    "timeline",
    "expect",
)
_SITE = (
    "role",
    "rate_hz",
    "q0_rad",
    "qd0_rad_s",
    "arm",
    "control",
    "limits",
    "on_stale",
    "hands",
    "environment",
    "plant",
)
_GROUPS: dict[str, type[msgspec.Struct]] = {"arm": Arm, "limits": Limits, "on_stale": OnStale}
_VECTORS = {
    "Lambda": JOINTS,
    "Kp": JOINTS,
    "Kd": JOINTS,
    "K": JOINTS,
    "d": JOINTS,
    "q0_rad": JOINTS,
    "qd0_rad_s": JOINTS,
    "k_f": JOINTS,
    "Gamma": PARAMETERS,
    "theta_hat0": PARAMETERS,
    "theta_low": PARAMETERS,
    "theta_high": PARAMETERS,
}
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)
MAX_SITES = 32
"""Most sites of an experiment: every pair of them has two links."""


def _vectors(table: TomlTable) -> TomlTable:
    """Writes a single number out where a vector is wanted."""
    return {
        key: [value] * _VECTORS[key] if key in _VECTORS and is_number(value) else value
        for key, value in table.items()
    }


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Returns the tables with every default written out, in the shape of `Scenario`.

    Args:
        tables: as an author wrote them.
        folder: where files that they name lie; None where they may name none.
    """
    check_keys(tables, _TOP + _TABLES, "")
    check_finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    groups: dict[str, type[msgspec.Struct]] = {**_GROUPS, "expect": Expect}
    for group, kind in groups.items():
        check_keys(tables.get(group, {}), field_names(kind), group)
    check_windows(tables.get("expect", {}).get("windows"))
    _resolve_control(tables.get("control", {}), {}, "control")
    sites = _resolve_sites(tables)
    rows = _resolve_dominance(tables, list(sites))
    links = resolve_links(tables, list(sites), folder)
    resolved = {key: _unix_lines(tables[key]) for key in _TOP if key in tables and key != "rate_hz"}
    return {
        "duration_s": 20.0,
        "seed": 1,
        "scheme": "second_order",
        **resolved,
        "sites": sites,
        "dominance": rows,
        "links": links,
        "timeline": resolve_timeline(tables.get("timeline", []), links, list(sites)),
        "expect": tables.get("expect", {}),
    }


def _resolve_control(written: Any, default: TomlTable, path: str) -> TomlTable:
    """Returns a law and its gains: what is written, and the rest from a default of the same law."""
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    law = str(written.get("law", default.get("law", "adaptive")))
    if ":" in law:
        return _resolve_own_law(law, written, default, path)
    check_choice(law, [*LAWS, "package.module:Law"], f"{path}.law")
    own = check_keys(written, ("law", *field_names(LAWS[law])), path)
    inherited = default if default.get("law", "adaptive") == law else {}
    return _vectors({**inherited, **own, "law": law})


def _resolve_own_law(code: str, written: TomlTable, default: TomlTable, path: str) -> TomlTable:
    """Returns a law from outside, the hash of its file, and what it is made with."""
    inherited = default if default.get("law") == code else {}
    settings = {key: value for key, value in {**inherited, **written}.items() if key != "law"}
    if not re.fullmatch(LAW_PATH_PATTERN, code):
        raise ScenarioError(f"must be as in package.module:Law, is {code!r}", path=f"{path}.law")
    if "settings" in settings:
        raise ScenarioError(
            "what a law from outside is made with stands beside its name, as in control.gain = 5",
            path=f"{path}.settings",
        )
    return {
        "law": "own",
        "code": code,
        "source_sha256": source_sha256(code, f"{path}.law"),
        "settings": settings,
    }


def _unix_lines(value: Any) -> Any:
    """Returns text with one kind of line ends, which is what TOML keeps; other values as they are."""
    if isinstance(value, list):
        return [_unix_lines(entry) for entry in value]
    return value.replace("\r\n", "\n").replace("\r", "\n") if isinstance(value, str) else value


def _resolve_sites(tables: TomlTable) -> TomlTable:
    sites: TomlTable = {}
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
        site = _vectors(check_keys(written, _SITE, path))
        site["control"] = _resolve_control(
            site.get("control", {}), tables.get("control", {}), f"{path}.control"
        )
        for group, kind in _GROUPS.items():
            own = check_keys(site.get(group, {}), field_names(kind), f"{path}.{group}")
            site[group] = _vectors({**tables.get(group, {}), **own})
        site.setdefault("role", "master")
        site.setdefault("rate_hz", tables.get("rate_hz", 1000))
        site.setdefault("q0_rad", [0.0] * JOINTS)
        site.setdefault("qd0_rad_s", [0.0] * JOINTS)
        for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
            site[group] = resolve_operators(site.get(group, []), kinds, site, f"{path}.{group}")
        sites[name] = {key: site[key] for key in field_names(SiteSpec) if key in site}
    if len(sites) > MAX_SITES:
        raise ScenarioError(f"has {len(sites)} sites, at most {MAX_SITES} are taken", path="sites")
    if len(sites) < 2:
        raise ScenarioError(f"an experiment has at least two sites, this one has {len(sites)}", path="sites")
    return sites


def _resolve_dominance(tables: TomlTable, names: list[str]) -> TomlTable:
    written = check_keys(tables["dominance"], names, "dominance")
    rows: TomlTable = {}
    for own, name in enumerate(names):
        path = f"dominance.{name}"
        if name not in written:
            raise ScenarioError("is missing: whom does this site follow?", path=path)
        rows[name] = resolve_dominance_row(check_keys(written[name], names, path), names, own, path)
    return rows

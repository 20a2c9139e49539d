"""The step from an author's tables to a complete scenario: defaults, and checks of keys, names and dominance.

Invariant: what a person writes is checked in the shape in which it was written, so the path in an error
is one that the person finds in the file.
"""

import re
from pathlib import Path
from typing import Any

from ..core.two_link_arm import JOINTS
from ..errors import ScenarioError
from .expect import Expect, check_window_keys
from .fields import TomlTable, check_choice, check_finite, check_keys, expand_vectors, field_names
from .laws import LAW_PATH_PATTERN, LAWS, hash_law_source
from .operators import ENVIRONMENTS, OPERATORS, resolve_operators
from .resolve_links import resolve_dominance_row, resolve_links
from .run_changes import resolve_timeline
from .scenario_types import SITE_GROUPS, SiteSpec

_TOP = ("name", "title", "about", "assumed", "rate_hz", "duration_s", "seed", "scheme")
_TABLES = (*SITE_GROUPS, "control", "link", "sites", "dominance", "links", "timeline", "expect")
_SITE = field_names(SiteSpec)
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)
MAX_SITES = 32
"""Most sites of an experiment; every pair of them has two links."""


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Returns an author's tables with every default written out, in the shape of `Scenario`.

    Files that they name lie in `folder`; None: they may name none.
    """
    check_keys(tables, _TOP + _TABLES, "")
    check_finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    for group, kind in SITE_GROUPS.items():
        check_keys(tables.get(group, {}), field_names(kind), group)
    check_keys(tables.get("expect", {}), field_names(Expect), "expect")
    check_window_keys(tables.get("expect", {}).get("windows"))
    _resolve_control(tables.get("control", {}), {}, "control")
    sites = _resolve_sites(tables)
    written, rows = check_keys(tables["dominance"], list(sites), "dominance"), {}
    for name in sites:
        if name not in written:
            raise ScenarioError("is missing: whom does this site follow?", path=f"dominance.{name}")
        rows[name] = resolve_dominance_row(written[name], list(sites), name, f"dominance.{name}")
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
    """Returns a law and its gains: as written, and the rest from a default of the same law."""
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    law = str(written.get("law", default.get("law", "adaptive")))
    if ":" in law:
        return _resolve_user_law(law, written, default, path)
    check_choice(law, [*LAWS, "package.module:Law"], f"{path}.law")
    own = check_keys(written, ("law", *field_names(LAWS[law])), path)
    inherited = default if default.get("law", "adaptive") == law else {}
    return expand_vectors({**inherited, **own, "law": law}, LAWS[law])


def _resolve_user_law(code: str, written: TomlTable, default: TomlTable, path: str) -> TomlTable:
    """Returns a user's law: the hash of its file, and its settings."""
    inherited = default if default.get("law") == code else {}
    settings = {key: value for key, value in {**inherited, **written}.items() if key != "law"}
    if not re.fullmatch(LAW_PATH_PATTERN, code):
        raise ScenarioError(f"must be as in package.module:Law, is {code!r}", path=f"{path}.law")
    if "settings" in settings:
        raise ScenarioError(
            "the settings of a user's law stand next to its name, as in control.gain = 5",
            path=f"{path}.settings",
        )
    sha256 = hash_law_source(code, f"{path}.law")
    return {"law": "own", "code": code, "source_sha256": sha256, "settings": settings}


def _unix_lines(value: Any) -> Any:
    """Returns text with the line ends that TOML keeps; other values unchanged."""
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
        site = expand_vectors(check_keys(written, _SITE, path), SiteSpec)
        site["control"] = _resolve_control(
            site.get("control", {}), tables.get("control", {}), f"{path}.control"
        )
        for group, kind in SITE_GROUPS.items():
            own = check_keys(site.get(group, {}), field_names(kind), f"{path}.{group}")
            site[group] = {**tables.get(group, {}), **own}
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

"""Overrides KEY=VALUE: written into an author's tables, or expanded onto a resolved scenario.

Invariant: in a resolved scenario, as a log holds it, a key of a group (`control.Kd`, `link.delay_ms`,
`rate_hz`) applies to every site or link that can have it; a key of a single one (`sites.s.control.Kd`)
takes precedence, in any order. A key that no built-in law has is a setting of a user's law.
"""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from ..errors import ScenarioError
from .delay_models import DELAY_MODELS
from .fields import TomlTable, check_keys, field_names, suggest_nearest
from .laws import LAWS, ImportedLaw
from .resolve_links import PRESETS
from .scenario_types import Arm, Limits, OnStale, Scenario

_PLAIN: dict[str, type[msgspec.Struct]] = {"arm": Arm, "limits": Limits, "on_stale": OnStale}
_KIND = {"control": ("law",), "link": ("model", "preset")}
"""Groups whose keys depend on a word, and the keys that say it."""
_FILE = ("file", "of")
_OWN = "own"

Override = tuple[str, Any]


def expand_overrides(scenario: Scenario, pairs: Sequence[Override]) -> dict[str, Any]:
    """Returns overrides of a resolved scenario with every key of a group written out.

    Args:
        scenario: the experiment.
        pairs: dotted keys and values, as a person gave them.

    Raises:
        ScenarioError: a group has no such key, or nothing in the scenario can have it.
    """
    flat = [pair for key, value in pairs for pair in _flat(key, value)]
    given = dict(flat)
    every: dict[str, Any] = {}
    single: dict[str, Any] = {}
    for key, value in flat:
        group, _, name = key.partition(".")
        if key == "rate_hz":
            every |= {f"sites.{site}.rate_hz": value for site in scenario.names}
        elif group in _PLAIN and name:
            check_keys({name: value}, field_names(_PLAIN[group]), group)
            every |= {f"sites.{site}.{key}": value for site in scenario.names}
        elif group in _KIND and name:
            every |= dict.fromkeys(_places(scenario, group, name, given), value)
        else:
            single[_single(scenario, key, given)] = value
    return every | single


def _flat(key: str, value: Any) -> list[Override]:
    """Returns a group that was given as a whole, key by key."""
    if isinstance(value, Mapping) and (key in _PLAIN or key in _KIND):
        return [(f"{key}.{name}", entry) for name, entry in value.items()]
    return [(key, value)]


def _single(scenario: Scenario, key: str, given: Mapping[str, Any]) -> str:
    """Returns the key of a single one as the resolved scenario has it: settings of a law lie in a table."""
    group, _, rest = key.partition(".")
    site, _, name = rest.partition(".control.")
    if group == "sites" and site in scenario.sites and name and _law(scenario, site, given) == _OWN:
        return _own_place(f"sites.{site}.control", name)
    return key


def _own_place(path: str, name: str) -> str:
    """Returns where a law from outside, which stays, has a key."""
    return (
        f"{path}.{name}"
        if name.split(".")[0] in ("law", *field_names(ImportedLaw))
        else f"{path}.settings.{name}"
    )


def _places(scenario: Scenario, group: str, name: str, given: Mapping[str, Any]) -> list[str]:
    """Returns the keys of the laws or links that can have a key of their group, as they will be."""
    if group == "control":
        kinds = {f"sites.{site}.control": str(_law(scenario, site, given)) for site in scenario.names}
        keys: dict[str, tuple[str, ...]] = {
            law: field_names(kind) for law, kind in LAWS.items() if law != _OWN
        }
    else:
        kinds = {f"links.{link}": str(_model(scenario, link, given)) for link in scenario.links}
        keys = {model: field_names(kind) for model, kind in DELAY_MODELS.items()}
        keys["trace"] = (*keys["trace"], *_FILE)
    if name in _KIND[group]:
        return [f"{path}.{name}" for path in kinds]
    outside = {path: law for path, law in kinds.items() if group == "control" and _is_outside(law)}
    ours = {path: kind for path, kind in kinds.items() if path not in outside}
    valid = sorted({key for names in keys.values() for key in names})
    members = [f"{path}.{name}" for path, kind in ours.items() if name in keys.get(kind, valid)]
    if outside and not members:
        return [_own_place(path, name) if law == _OWN else f"{path}.{name}" for path, law in outside.items()]
    if name not in valid:
        hint = suggest_nearest(name, [*_KIND[group], *valid]) or f"; valid are {', '.join(valid)}"
        raise ScenarioError(f"unknown key{hint}", path=f"{group}.{name}")
    if not members:
        word, owners = _KIND[group][0], [kind for kind, names in keys.items() if name in names]
        is_now = ", ".join(dict.fromkeys(kinds.values()))
        problem = f"belongs to {word} {', '.join(owners)}, and here is only {is_now}: set {group}.{word} too"
        raise ScenarioError(problem, path=f"{group}.{name}")
    return members


def _is_outside(law: str) -> bool:
    """True for a law from outside: one that is named, or one that a log holds."""
    return law == _OWN or ":" in law


def _law(scenario: Scenario, site: str, given: Mapping[str, Any]) -> Any:
    """Returns the law that a site will have."""
    now = scenario.sites[site].control.__struct_config__.tag
    return given.get(f"sites.{site}.control.law", given.get("control.law", now))


def _model(scenario: Scenario, link: str, given: Mapping[str, Any]) -> Any:
    """Returns the model that a link will have; a word that is none is refused where it is read."""
    for path in (f"links.{link}", "link"):
        if f"{path}.model" in given:
            return given[f"{path}.model"]
        if f"{path}.preset" in given:
            return PRESETS.get(str(given[f"{path}.preset"]), {}).get("model", "constant")
    return scenario.links[link].__struct_config__.tag


_KINDS = ("model", "preset", "law")
"""Keys that say which other keys a table has."""


def apply_overrides(tables: TomlTable, overrides: Mapping[str, Any] | Sequence[str]) -> None:
    """Writes overrides into the tables of a scenario, in place.

    Args:
        tables: as read from TOML.
        overrides: a mapping from dotted keys, or texts KEY=VALUE whose value is TOML or a bare word. A number
            means what stands there in a list, counted from 0, as in sites.s.environment.0.stiffness_n_m. One
            that names a kind (a link's model or preset, a law) replaces what the table said besides.
    """
    pairs = parse_overrides(overrides)
    overridden = {key for key, _ in pairs}
    for key, value in pairs:
        *folders, last = key.split(".")
        sites = tables.get("sites")
        if len(folders) > 1 and folders[0] == "sites" and isinstance(sites, dict) and folders[1] not in sites:
            hint = suggest_nearest(folders[1], list(sites)) or f"; its sites are {', '.join(sites)}"
            raise ScenarioError(f"no such site{hint}", path=key)
        table = _reached(tables, folders, last)
        if isinstance(table, list):
            table[_place(table, last, key)] = value
            continue
        if last in _KINDS:  # what the file says is of another kind
            for other in [k for k in table if ".".join([*folders, k]) not in overridden]:
                del table[other]
        table[last] = value


def _reached(tables: TomlTable, folders: Sequence[str], last: str) -> TomlTable | list[Any]:
    """Returns the table or list that dotted keys lead to; tables that are not there are made.

    Args:
        tables: where to begin.
        folders: keys of tables, and numbers of what stands in a list.
        last: the key that will be sought in it.
    """
    reached: Any = tables
    for depth, name in enumerate(folders):
        path = ".".join(folders[: depth + 1])
        if isinstance(reached, list):
            entry = reached[_place(reached, name, path)]
        else:
            after = (*folders, last)[depth + 1]
            entry = reached.setdefault(name, [] if after.isdecimal() else {})
        if not isinstance(entry, dict | list):
            raise ScenarioError("is a value, not a table", path=path)
        reached = entry
    return reached  # type: ignore[no-any-return]


def _place(entries: list[Any], name: str, path: str) -> int:
    """Returns the place in a list that a part of a key means."""
    if not name.isdecimal() or int(name) >= len(entries):
        counted = f"it has {len(entries)}, counted from 0" if entries else "it has none"
        raise ScenarioError(f"no such entry: {counted}", path=path)
    return int(name)


def parse_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> list[tuple[str, Any]]:
    """Returns overrides as keys and values; a text is `KEY=VALUE` with a TOML value."""
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

"""Overrides KEY=VALUE: written into an author's tables, or expanded onto a resolved scenario.

Invariant: in a resolved scenario, as a log holds it, a key of a group (`control.Kd`,
`link.delay_ms`, `rate_hz`) applies to every site or link that can have it; a key of a single
one (`sites.s.control.Kd`) takes precedence, in any order. A key that no built-in law has is a
setting of a user's law.
"""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import ScenarioError
from ..fields import TomlTable, check_keys, field_names, suggest_nearest
from .delay_models import DELAY_MODELS
from .imported_code import ImportedLaw, name_law_classes
from .laws import LAWS
from .resolve import PRESETS, TRACE_KEYS
from .scenario_types import SITE_GROUPS, Scenario

_KIND_KEYS = {"control": ("law",), "link": ("model", "preset")}
"""Groups whose keys depend on a kind, and the keys that name it."""
_USER_LAW = "own"

Override = tuple[str, Any]


def expand_overrides(scenario: Scenario, pairs: Sequence[Override]) -> dict[str, Any]:
    """Returns overrides of a resolved scenario with every key of a group written out.

    Raises:
        ScenarioError: a group has no such key, or nothing in the scenario can have it.
    """
    flat: list[Override] = []
    for key, value in pairs:
        # a whole group
        if isinstance(value, Mapping) and (key in SITE_GROUPS or key in _KIND_KEYS):
            flat += [(f"{key}.{name}", entry) for name, entry in value.items()]
        else:
            flat.append((key, value))
    given = dict(flat)
    every: dict[str, Any] = {}
    single: dict[str, Any] = {}
    for key, value in flat:
        group, _, name = key.partition(".")
        if key == "rate_hz":
            every |= {f"sites.{site}.rate_hz": value for site in scenario.names}
        elif group in SITE_GROUPS and name:
            check_keys(
                {_split_entry(name)[0].split(".")[0]: value},
                field_names(SITE_GROUPS[group]),
                group,
            )
            every |= {f"sites.{site}.{key}": value for site in scenario.names}
        elif group in _KIND_KEYS and name:
            every |= dict.fromkeys(_expand_group(scenario, group, name, given), value)
        else:
            single[_expand_single(scenario, key, given)] = value
    return every | single


def _expand_single(scenario: Scenario, key: str, given: Mapping[str, Any]) -> str:
    group, _, rest = key.partition(".")
    site, _, name = rest.partition(".control.")
    if (
        group == "sites"
        and site in scenario.sites
        and name
        and _law(scenario, site, given) == _USER_LAW
    ):
        return _user_law_key(f"sites.{site}.control", name)
    return key


def _user_law_key(path: str, name: str) -> str:
    settings = "" if name.split(".")[0] in ("law", *field_names(ImportedLaw)) else "settings."
    return f"{path}.{settings}{name}"


def _expand_group(
    scenario: Scenario, group: str, name: str, given: Mapping[str, Any]
) -> list[str]:
    """Returns a key of a group for each law or link, of its future kind, that can have it."""
    if group == "control":
        kinds = {
            f"sites.{site}.control": str(_law(scenario, site, given)) for site in scenario.names
        }
        keys: dict[str, tuple[str, ...]] = {
            law: field_names(kind) for law, kind in LAWS.items() if law != _USER_LAW
        }
    else:
        kinds = {f"links.{link}": str(_model(scenario, link, given)) for link in scenario.links}
        keys = {model: field_names(kind) for model, kind in DELAY_MODELS.items()}
        keys["trace"] = (*keys["trace"], *TRACE_KEYS)
    if name in _KIND_KEYS[group]:
        return [f"{path}.{name}" for path in kinds]
    user_laws = {
        path: law
        for path, law in kinds.items()
        if group == "control" and (law == _USER_LAW or ":" in law)
    }
    built_in = {path: kind for path, kind in kinds.items() if path not in user_laws}
    valid = sorted({key for names in keys.values() for key in names})
    vector = _split_entry(name)[0]
    members = [
        f"{path}.{name}" for path, kind in built_in.items() if vector in keys.get(kind, valid)
    ]
    if user_laws and not members:
        return [
            _user_law_key(path, name) if law == _USER_LAW else f"{path}.{name}"
            for path, law in user_laws.items()
        ]
    if vector not in valid:
        hint = (
            suggest_nearest(vector, [*_KIND_KEYS[group], *valid])
            or f"; valid are {', '.join(valid)}"
        )
        raise ScenarioError(f"unknown key{hint}", path=f"{group}.{name}")
    if not members:
        word = _KIND_KEYS[group][0]
        owners = [kind for kind, names in keys.items() if vector in names]
        is_now = ", ".join(dict.fromkeys(kinds.values()))
        problem = f"belongs to {word} {', '.join(owners)}, and here is only {is_now}: set {group}.{word} too"
        raise ScenarioError(problem, path=f"{group}.{name}")
    return members


def _split_entry(key: str) -> tuple[str, str]:
    """Returns a key of an entry of a list as the key of the list and the entry's number, else
    "" for that.
    """
    vector, _, entry = key.rpartition(".")
    return (vector, entry) if vector and entry.isdecimal() else (key, "")


def split_entries(
    tables: TomlTable, pairs: Sequence[Override]
) -> tuple[dict[str, Any], list[Override]]:
    """Returns overrides of an author's tables, and those of entries of vectors that they do not
    write out.

    A vector may be one number, or be that of a group: its entries are there once the tables are
    resolved.
    """
    own = {}
    of_entries = []
    for key, value in pairs:
        vector, entry = _split_entry(key)
        reached: Any = tables if entry else []
        for name in vector.split(".") if entry else ():
            if isinstance(reached, list) and name.isdecimal() and int(name) < len(reached):
                reached = reached[int(name)]
            else:
                reached = reached.get(name) if isinstance(reached, dict) else None
        if isinstance(reached, list):
            own[key] = value
        else:
            of_entries.append((key, value))
    return own, of_entries


def _law(scenario: Scenario, site: str, given: Mapping[str, Any]) -> Any:
    now = scenario.sites[site].control.__struct_config__.tag
    return given.get(f"sites.{site}.control.law", given.get("control.law", now))


def _model(scenario: Scenario, link: str, given: Mapping[str, Any]) -> Any:
    """Returns a link's model after the overrides; an unknown one is refused when the tables are
    resolved.
    """
    for path in (f"links.{link}", "link"):
        if f"{path}.model" in given:
            return given[f"{path}.model"]
        if f"{path}.preset" in given:
            return PRESETS.get(str(given[f"{path}.preset"]), {}).get("model", "constant")
    return scenario.links[link].__struct_config__.tag


def apply_overrides(tables: TomlTable, overrides: Mapping[str, Any] | Sequence[str]) -> None:
    """Writes overrides into the tables of a scenario as read from TOML, in place.

    A number in a key means the entry of a list, counted from 0, as in
    sites.s.environment.0.stiffness_n_m. A key that names a kind (a link's model or preset, a
    law, an arm's urdf) replaces the table's other keys.
    """
    pairs = parse_overrides(overrides)
    overridden = {key for key, _ in pairs}
    for key, value in pairs:
        *folders, last = key.split(".")
        sites = tables.get("sites")
        if (
            len(folders) > 1
            and folders[0] == "sites"
            and isinstance(sites, dict)
            and folders[1] not in sites
        ):
            hint = (
                suggest_nearest(folders[1], list(sites))
                or f"; its sites are {', '.join(sites)}"
            )
            raise ScenarioError(f"no such site{hint}", path=key)
        table = _reach_table(tables, folders, last)
        if isinstance(table, list):
            table[_list_index(table, last, key)] = value
            continue
        kinds = (
            ("urdf",)
            if folders[-1:] == ["arm"]
            else [key for keys in _KIND_KEYS.values() for key in keys]
        )
        if last in kinds:  # the file's other keys are of another kind
            for other in [k for k in table if ".".join([*folders, k]) not in overridden]:
                del table[other]
        table[last] = value


def _reach_table(tables: TomlTable, folders: Sequence[str], last: str) -> TomlTable | list[Any]:
    """Returns the table or list at dotted keys, in which `last` is next; missing tables are
    added.
    """
    reached: Any = tables
    for depth, name in enumerate(folders):
        path = ".".join(folders[: depth + 1])
        if isinstance(reached, list):
            entry = reached[_list_index(reached, name, path)]
        else:
            after = (*folders, last)[depth + 1]
            entry = reached.setdefault(name, [] if after.isdecimal() else {})
        if not isinstance(entry, dict | list):
            raise ScenarioError("is a value, not a table", path=path)
        reached = entry
    return reached  # type: ignore[no-any-return]


def _list_index(entries: list[Any], name: str, path: str) -> int:
    if not name.isdecimal() or int(name) >= len(entries):
        counted = f"it has {len(entries)}, counted from 0" if entries else "it has none"
        raise ScenarioError(f"no such entry: {counted}", path=path)
    return int(name)


def parse_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> list[Override]:
    """Returns overrides as keys and values; a text is KEY=VALUE, whose value is TOML or a bare
    word.
    """
    if isinstance(overrides, Mapping):
        return list(name_law_classes(overrides).items())
    pairs = []
    for text in overrides:
        if (pair := split_assignment(str(text))) is None:
            raise ScenarioError(
                f"an override reads KEY=VALUE, as in control.Kd=5, not {text!r}"
            )
        pairs.append(pair)
    return pairs


def split_assignment(text: str) -> Override | None:
    """Returns the key and the value, TOML or a bare word, of a text KEY=VALUE; None if it is
    none.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        return None
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:  # TOMLDecodeError is one; a number of 5000 digits is another
        return key.strip(), value.strip()

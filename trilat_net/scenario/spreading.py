"""Overrides of a scenario that is resolved already, as a log holds it: its groups are written out.

Law: a key of a group (`control.Kd`, `link.delay_ms`, `rate_hz`) counts for every site or link that can have
it; a key of a single one (`sites.s.control.Kd`) counts over it, in whatever order they were given. What a law
from outside is made with can be any key: one that no law of ours has here is its own.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from ..errors import ScenarioError
from .laws import LAWS
from .links import LINKS
from .model import Scenario
from .own_law import Own
from .presets import PRESETS
from .site import Arm, Limits, OnStale
from .tables import fields, known, nearest

_PLAIN: dict[str, type[msgspec.Struct]] = {"arm": Arm, "limits": Limits, "on_stale": OnStale}
_KIND = {"control": ("law",), "link": ("model", "preset")}
"""Groups whose keys depend on a word, and the keys that say it."""
_FILE = ("file", "of")
_OWN = "own"

Pair = tuple[str, Any]


def spread(scenario: Scenario, pairs: Sequence[Pair]) -> dict[str, Any]:
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
            known({name: value}, fields(_PLAIN[group]), group)
            every |= {f"sites.{site}.{key}": value for site in scenario.names}
        elif group in _KIND and name:
            every |= dict.fromkeys(_places(scenario, group, name, given), value)
        else:
            single[_single(scenario, key, given)] = value
    return every | single


def _flat(key: str, value: Any) -> list[Pair]:
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
    return f"{path}.{name}" if name.split(".")[0] in ("law", *fields(Own)) else f"{path}.settings.{name}"


def _places(scenario: Scenario, group: str, name: str, given: Mapping[str, Any]) -> list[str]:
    """Returns the keys of the laws or links that can have a key of their group, as they will be."""
    if group == "control":
        kinds = {f"sites.{site}.control": str(_law(scenario, site, given)) for site in scenario.names}
        keys: dict[str, tuple[str, ...]] = {law: fields(kind) for law, kind in LAWS.items() if law != _OWN}
    else:
        kinds = {f"links.{link}": str(_model(scenario, link, given)) for link in scenario.links}
        keys = {model: fields(kind) for model, kind in LINKS.items()}
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
        hint = nearest(name, [*_KIND[group], *valid]) or f"; valid are {', '.join(valid)}"
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

"""Applies overrides such as `control.Kd=5` to a scenario.

Overrides can be applied to the tables of a scenario file, or to a resolved scenario, in which
every key of every site and link is written out.

Invariant:
    - In a resolved scenario, a key that names no site or link (`control.Kd`, `link.delay_ms`,
      `rate_hz`) applies to every site or link that can have the key.
    - A key of a single site or link (`sites.s.control.Kd`) takes precedence, whatever the order
      of the overrides.
    - A key of `control` that no built-in law has is an argument of a user's control law.
"""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..errors import ScenarioError, count_nouns, suggest_nearest
from ..fields import TomlTable
from ..own_code import ImportedLaw, name_law_classes
from .delay_models import DELAY_MODELS
from .key_checks import check_keys, field_names, hint_at_quotes
from .laws import LAWS
from .link_presets import PRESETS
from .scenario_types import Scenario
from .site_spec import SITE_GROUPS
from .written_tables import TRACE_KEYS

_KIND_KEYS = {"control": ("law",), "link": ("model", "preset")}
"""Groups whose other keys depend on a kind, and the keys that select this kind."""
_USER_LAW = "own"
"""Kind shared by all user-defined control laws."""

_WRONG_VALUE = "expected "
"""Prefix of messages about a value of a wrong type or range."""

Override = tuple[str, Any]
"""Dotted key and new value."""


class ScenarioOverrides(NamedTuple):
    """Overrides of scenario keys, such as `control.Kd=5`, requested by a user.

    Attributes:
        pairs: Dotted key and new value of each override.
    """

    pairs: tuple[Override, ...]

    @classmethod
    def parse(cls, written: Mapping[str, Any] | Sequence[str]) -> "ScenarioOverrides":
        """Parses overrides from the command line (KEY=VALUE) or from a Python mapping.

        Args:
            written: A mapping from dotted key to value, or strings of the form KEY=VALUE, where
                VALUE is a TOML value or a bare word.

        Raises:
            ScenarioError: A string is not of the form KEY=VALUE.
        """
        if isinstance(written, Mapping):
            return cls(tuple(name_law_classes(written).items()))
        pairs = []
        for text in written:
            pair = split_assignment(str(text))
            if pair is None:
                raise ScenarioError(
                    "an override must have the form KEY=VALUE, as in control.Kd=5, not "
                    f"{text!r}{hint_at_quotes(str(text))}"
                )
            pairs.append(pair)
        return cls(tuple(pairs))

    def expand(self, scenario: Scenario) -> "ScenarioOverrides":
        """Expands each override of a group into one override per site or link.

        A group is either all sites or all links. For example, an override of `control.K`
        becomes one override for each site whose control law has a gain K.

        Args:
            scenario: The complete scenario.

        Returns:
            Overrides with the dotted keys of individual sites and links.

        Raises:
            ScenarioError: The key does not exist, or no site or link of the scenario can have
                it.
        """
        flat_pairs = _flatten_groups(self.pairs)
        overridden = dict(flat_pairs)
        group_values: dict[str, Any] = {}
        single_values: dict[str, Any] = {}
        for key, value in flat_pairs:
            group, _, name = key.partition(".")
            is_site_group = group in SITE_GROUPS and bool(name)
            if is_site_group:
                vector, _ = _split_entry(name)
                first_key = vector.split(".")[0]
                check_keys({first_key: value}, field_names(SITE_GROUPS[group]), group)
            if is_site_group or key == "rate_hz":
                group_values |= {f"sites.{site}.{key}": value for site in scenario.names}
            elif group in _KIND_KEYS and name:
                members = _expand_group(scenario, group, name, overridden)
                group_values |= dict.fromkeys(members, value)
            else:
                single_values[_expand_single(scenario, key, overridden)] = value
        return ScenarioOverrides(tuple((group_values | single_values).items()))

    def split_entries(
        self, tables: TomlTable
    ) -> tuple["ScenarioOverrides", "ScenarioOverrides"]:
        """Separates the overrides that can be applied to an incomplete scenario from the rest.

        An override of a single list entry, such as the stiffness of joint 2, cannot be applied
        if the list is missing because its author wrote one number for all joints or omitted the
        setting. Such overrides must wait until the scenario has been completed.

        Args:
            tables: Tables of the scenario file.

        Returns:
            The overrides that can be applied now, and those that must wait.
        """
        applicable = []
        waiting = []
        for key, value in self.pairs:
            vector, entry = _split_entry(key)
            if not entry or isinstance(_find_value(tables, vector), list):
                applicable.append((key, value))
            else:
                waiting.append((key, value))
        return ScenarioOverrides(tuple(applicable)), ScenarioOverrides(tuple(waiting))

    def apply_to(self, tables: TomlTable) -> None:
        """Applies the overrides to the tables of a scenario file.

        A number in a key is a list index, counted from 0, as in
        sites.s.environment.0.stiffness_n_m. Setting a key that selects a kind (the model or
        preset of a link, a law, the URDF file of an arm) removes the other keys of its table,
        which belong to the previous kind.

        Args:
            tables: Tables of the scenario file, modified in place.

        Raises:
            ScenarioError: The key of an override does not exist.
        """
        overridden_keys = {key for key, _ in self.pairs}
        for key, value in self.pairs:
            *parents, last = key.split(".")
            _check_site_exists(tables, parents, key)
            table = _reach_table(tables, parents, last)
            if isinstance(table, list):
                table[_list_index(table, last, key)] = value
                continue
            if last in _list_kind_keys(parents):
                for other in list(table):
                    if ".".join([*parents, other]) not in overridden_keys:
                        del table[other]
            table[last] = value

    def nest(self) -> TomlTable:
        """Returns the overrides as nested tables, as in a scenario file.

        `find_written_path` searches these tables for the key of an error.
        """
        tables: TomlTable = {}
        for key, value in self.pairs:
            *parents, last = key.split(".")
            table = tables
            for name in parents:
                inner = table.setdefault(name, {})
                if not isinstance(inner, dict):
                    inner = table[name] = {}
                table = inner
            table[last] = value
        return tables


def _flatten_groups(pairs: Sequence[Override]) -> list[Override]:
    """Replaces each override of a group of keys with overrides of the individual keys.

    For example, `limits={q_max_rad=3}` becomes `limits.q_max_rad=3`, so the other keys of the
    group keep their values.
    """
    flat_pairs: list[Override] = []
    for key, value in pairs:
        is_group = key in SITE_GROUPS or key in _KIND_KEYS
        if is_group and isinstance(value, Mapping):
            flat_pairs += [(f"{key}.{name}", entry) for name, entry in value.items()]
        else:
            flat_pairs.append((key, value))
    return flat_pairs


def _expand_single(scenario: Scenario, key: str, overridden: Mapping[str, Any]) -> str:
    """Returns the complete path of an overridden key of a single site or link.

    A key of a user's control law is an argument of its class, and is given the path of this
    argument.
    """
    group, _, rest = key.partition(".")
    site, _, name = rest.partition(".control.")
    is_control_key = group == "sites" and site in scenario.sites and bool(name)
    if is_control_key and _find_law(scenario, site, overridden) == _USER_LAW:
        return _user_law_key(f"sites.{site}.control", name)
    return key


def _user_law_key(path: str, name: str) -> str:
    """Returns the complete path of an overridden key of a user's control law.

    Keys that the scenario itself does not define are arguments of the user's class.
    """
    is_field = name.split(".")[0] in ("law", *field_names(ImportedLaw))
    return f"{path}.{name}" if is_field else f"{path}.settings.{name}"


def _expand_group(
    scenario: Scenario, group: str, name: str, overridden: Mapping[str, Any]
) -> list[str]:
    """Returns the paths of a group key, one for each law or link that can have the key.

    Whether a law or link can have the key depends on its kind after the overrides.

    Args:
        scenario: The scenario.
        group: "control" or "link".
        name: Key in the group.
        overridden: Mapping from key to value of all overrides.

    Raises:
        ScenarioError: No law or link can have the key.
    """
    kinds, keys_by_kind = _list_group_kinds(scenario, group, overridden)
    if name in _KIND_KEYS[group]:
        return [f"{path}.{name}" for path in kinds]

    valid_keys = sorted({key for keys in keys_by_kind.values() for key in keys})
    vector, _ = _split_entry(name)
    members = []
    user_law_members = []
    for path, kind in kinds.items():
        if group == "control" and kind == _USER_LAW:
            user_law_members.append(_user_law_key(path, name))
        elif group == "control" and ":" in kind:
            user_law_members.append(f"{path}.{name}")
        elif vector in keys_by_kind.get(kind, valid_keys):
            # An unknown kind is refused when the tables are resolved.
            members.append(f"{path}.{name}")

    # A key that no built-in law of the scenario has is an argument of the users' laws.
    if members:
        return members
    if user_law_members:
        return user_law_members

    if vector not in valid_keys:
        hint = suggest_nearest(vector, [*_KIND_KEYS[group], *valid_keys])
        hint = hint or f"; valid keys are {', '.join(valid_keys)}"
        raise ScenarioError(f"unknown key{hint}", path=f"{group}.{name}")
    kind_key = _KIND_KEYS[group][0]
    owners = ", ".join(kind for kind, keys in keys_by_kind.items() if vector in keys)
    present = ", ".join(dict.fromkeys(kinds.values()))
    raise ScenarioError(
        f"belongs to {kind_key} {owners}, but the scenario has only {present}: set "
        f"{group}.{kind_key}, too",
        path=f"{group}.{name}",
    )


def _list_group_kinds(
    scenario: Scenario, group: str, overridden: Mapping[str, Any]
) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    """Returns the laws (or delay models) in use after the overrides, and the keys of each.

    An override for all sites applies only where the law has the key.

    Returns:
        Mapping from the path of each law or link to its kind, and mapping from built-in kind to
        its keys.
    """
    if group == "control":
        laws = {}
        for site in scenario.names:
            laws[f"sites.{site}.control"] = str(_find_law(scenario, site, overridden))
        gains = {law: field_names(kind) for law, kind in LAWS.items() if law != _USER_LAW}
        return laws, gains
    models = {}
    for link in scenario.links:
        models[f"links.{link}"] = str(_find_model(scenario, link, overridden))
    keys = {model: field_names(kind) for model, kind in DELAY_MODELS.items()}
    keys["trace"] = (*keys["trace"], *TRACE_KEYS)
    return models, keys


def _split_entry(key: str) -> tuple[str, str]:
    """Splits the key of a list entry into name and index, as in "q0_rad.1".

    Returns:
        Key of the list, and index of the entry as a string. For other keys, the key itself and
        an empty string.
    """
    vector, _, entry = key.rpartition(".")
    if vector and entry.isdecimal():
        return vector, entry
    return key, ""


def _find_value(tables: TomlTable, key: str) -> Any:
    """Returns the value at a dotted key of a scenario, where a number is a list index.

    Returns None if there is no such value.
    """
    value: Any = tables
    for name in key.split("."):
        if isinstance(value, dict):
            value = value.get(name)
        elif isinstance(value, list) and name.isdecimal() and int(name) < len(value):
            value = value[int(name)]
        else:
            return None
    return value


def _find_law(scenario: Scenario, site: str, overridden: Mapping[str, Any]) -> Any:
    """Returns the name of a site's control law after the overrides."""
    for path in (f"sites.{site}.control.law", "control.law"):
        if path in overridden:
            return overridden[path]
    return scenario.sites[site].control.__struct_config__.tag


def _find_model(scenario: Scenario, link: str, overridden: Mapping[str, Any]) -> Any:
    """Returns the name of a link's delay model after the overrides.

    An unknown model or preset is rejected later, when the tables are resolved.
    """
    for path in (f"links.{link}", "link"):
        if f"{path}.model" in overridden:
            return overridden[f"{path}.model"]
        if f"{path}.preset" in overridden:
            preset = PRESETS.get(str(overridden[f"{path}.preset"]), {})
            return preset.get("model", "constant")
    return scenario.links[link].__struct_config__.tag


def _list_kind_keys(parents: Sequence[str]) -> list[str]:
    """Returns the keys that select a kind in the table at a path, such as `law` or `model`.

    If an override changes such a key, the other keys of the table belong to the previous kind
    and are removed.

    Args:
        parents: Keys of the path.
    """
    if parents and parents[-1] == "arm":
        return ["urdf"]
    return [key for keys in _KIND_KEYS.values() for key in keys]


def _check_site_exists(tables: TomlTable, parents: Sequence[str], key: str) -> None:
    """Raises ScenarioError if an override names a site that the scenario does not have.

    Otherwise, a misspelt name would add a new site.

    Args:
        tables: Tables of the scenario.
        parents: Keys of the path, excluding the last.
        key: The complete key, for the error message.
    """
    sites = tables.get("sites")
    if len(parents) < 2 or parents[0] != "sites" or not isinstance(sites, dict):
        return
    if parents[1] not in sites:
        hint = suggest_nearest(parents[1], list(sites))
        hint = hint or f"; the sites are {', '.join(sites)}"
        raise ScenarioError(f"there is no such site{hint}", path=key)


def _reach_table(tables: TomlTable, parents: Sequence[str], last: str) -> TomlTable | list[Any]:
    """Returns the table or list that contains an overridden key, creating it if necessary.

    Args:
        tables: Tables of the scenario.
        parents: Keys of the path.
        last: Key in the table or list. If it is a number, a list is created, otherwise a table.

    Raises:
        ScenarioError: A value stands in place of a table, or a list has no such entry.
    """
    container: Any = tables
    for depth, name in enumerate(parents):
        path = ".".join(parents[: depth + 1])
        next_key = (*parents, last)[depth + 1]
        if isinstance(container, list):
            entry = container[_list_index(container, name, path)]
        else:
            entry = container.setdefault(name, [] if next_key.isdecimal() else {})
        if not isinstance(entry, dict | list):
            raise ScenarioError(
                f"is the value {entry!r}, not a table with a key {next_key}", path=path
            )
        container = entry
    return container  # type: ignore[no-any-return]


def _list_index(entries: list[Any], name: str, path: str) -> int:
    """Parses a list index in an overridden key, and checks its range.

    Args:
        entries: The list.
        name: The index as a string.
        path: Path of the entry, for the error message.

    Raises:
        ScenarioError: There is no such entry.
    """
    if not name.isdecimal() or int(name) >= len(entries):
        counted = "the list is empty"
        if entries:
            counted = f"the list has {count_nouns(len(entries), 'entry')}, counted from 0"
        raise ScenarioError(f"there is no such entry: {counted}", path=path)
    return int(name)


def find_written_path(error: ScenarioError, tables: TomlTable) -> str:
    """Returns the path of a wrong key as its author wrote it.

    The author may have set the key for all sites or links at once. For example, the path
    "links.m2->m1.delay_ms" becomes "link.delay_ms" if only that key was written. This applies
    to values of a wrong type or range and to unusable URDF files, which affect every site or
    link equally. Other errors, such as a list of the wrong length, may affect only one site, so
    their path is kept.

    Args:
        error: An error whose path names a single site or link, possibly followed by an index in
            square brackets.
        tables: Tables with the keys that the author wrote.

    Returns:
        Path of the written key, or the path of the error if no such key was written.
    """
    path = error.path
    key, bracket, index = path.partition("[")
    group, *names = key.split(".")
    is_urdf = names[1:] == ["arm", "urdf"]
    if not (is_urdf or error.problem.startswith(_WRONG_VALUE)):
        return path
    if (
        group not in ("links", "sites")
        or len(names) < 2
        or _find_value(tables, key) is not None
    ):
        return path
    common_key = ".".join(names[1:])
    if group == "links":
        common_key = f"link.{common_key}"
    # In a complete scenario, the arguments of a user's law have a separate table, which the
    # author need not write.
    for written_key in (common_key, common_key.replace("control.settings.", "control.", 1)):
        value = _find_value(tables, written_key)
        if isinstance(value, list):
            return f"{written_key}{bracket}{index}"
        if isinstance(value, dict):
            entry = index.removesuffix("]")
            return f"{written_key}.{entry}" if entry else written_key
        if value is not None:
            return written_key
    return path


def split_assignment(text: str) -> Override | None:
    """Splits a string KEY=VALUE, as given to the option --set, into key and value.

    For example, "links.delay_ms=5" yields the key "links.delay_ms" and the value 5.

    Args:
        text: The string. A value that is not valid TOML is treated as an unquoted string.

    Returns:
        Key and value, or None if the string is not of this form.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        return None
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    # TOMLDecodeError is a ValueError. A number of 5000 digits raises a plain ValueError.
    except ValueError:
        return key.strip(), value.strip()

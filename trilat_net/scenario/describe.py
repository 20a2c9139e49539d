"""A scenario in lines of text, and the differences between scenarios.

Invariant: a difference that several sites or links share is one entry; a law of another kind and a link
are entries as a whole. Names, titles and expectations describe an experiment and do not count as
differences.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from .scenario_types import Scenario


def describe_scenario(scenario: Scenario) -> list[str]:
    """Returns what a valid scenario says, and what follows from it."""
    beta = scenario.beta
    weights = (
        "none: alpha is reducible, some site's weight is zero"
        if beta is None
        else ", ".join(f"{name} {weight:.4g}" for name, weight in zip(scenario.names, beta, strict=True))
    )
    return [
        f"{scenario.name}: valid, sha256 {scenario.sha256[:16]}",
        f"sites: {', '.join(scenario.names)}; {scenario.duration_s:g} s, "
        + ", ".join(f"{scenario.ticks(name)} ticks of {name}" for name in scenario.names),
        *_link_facts(scenario),
        f"beta, the left null vector of Upsilon: {weights}",
        *(f"assumed: {text}" for text in scenario.assumed),
    ]


def _link_facts(scenario: Scenario) -> Iterator[str]:
    """Yields what the links do: in one line where all do the same."""
    words = {name: link.describe() for name, link in scenario.links.items()}
    if len(set(words.values())) == 1:
        yield f"every link: {next(iter(words.values()))}"
        return
    for name, text in words.items():
        yield f"link {name}: {text}"


_WORDS = ("name", "title", "about", "assumed", "expect")
_MOST = 80


class ScenarioDifference(NamedTuple):
    """Something in which experiments differ.

    Attributes:
        key: its dotted path; below `sites.NAME` without that.
        owners: the sites that it is of; none where it is of the whole.
        values: per experiment, in words; "none" where it has no such thing.
    """

    key: str
    owners: tuple[str, ...]
    values: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.key} of {', '.join(self.owners)}" if self.owners else self.key


def compare_scenarios(scenarios: Sequence[Scenario]) -> list[ScenarioDifference]:
    """Returns in what experiments differ, in the order of their keys; nothing where they are one.

    Args:
        scenarios: the experiments.
    """
    names = [", ".join(scenario.names) for scenario in scenarios]
    found = [] if len(set(names)) == 1 else [ScenarioDifference("sites", (), tuple(names))]
    common = [name for name in scenarios[0].names if all(name in other.sites for other in scenarios)]
    found += _rows([_whole(scenario) for scenario in scenarios])
    of_sites: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for site in common:
        for row in _rows([_site(scenario, site) for scenario in scenarios]):
            of_sites.setdefault((row.key, row.values), []).append(site)
    found += [ScenarioDifference(key, tuple(owners), values) for (key, values), owners in of_sites.items()]
    return found + _links(scenarios)


def _rows(tables: Sequence[Mapping[str, Any]]) -> list[ScenarioDifference]:
    """Returns the keys whose values differ; a law of another kind as a whole."""
    if len({table.get("control", {}).get("law") for table in tables}) > 1:
        laws = ScenarioDifference("control", (), tuple(_law(table["control"]) for table in tables))
        return [laws, *_rows([{k: v for k, v in table.items() if k != "control"} for table in tables])]
    flat = [dict(_flat(table)) for table in tables]
    keys = list(dict.fromkeys(key for one in flat for key in one))
    rows = [ScenarioDifference(key, (), tuple(_short(one.get(key)) for one in flat)) for key in keys]
    return [
        row for row, key in zip(rows, keys, strict=True) if any(f.get(key) != flat[0].get(key) for f in flat)
    ]


def _whole(scenario: Scenario) -> dict[str, Any]:
    table: dict[str, Any] = msgspec.to_builtins(scenario)
    return {key: value for key, value in table.items() if key not in (*_WORDS, "sites", "links")}


def _site(scenario: Scenario, site: str) -> dict[str, Any]:
    table: dict[str, Any] = msgspec.to_builtins(scenario.sites[site])
    return table


def _links(scenarios: Sequence[Scenario]) -> list[ScenarioDifference]:
    """Returns the links that differ, those that do so alike as one."""
    alike: dict[tuple[str, ...], list[str]] = {}
    common = [name for name in scenarios[0].links if all(name in other.links for other in scenarios)]
    for name in common:
        links = [scenario.links[name] for scenario in scenarios]
        if any(link != links[0] for link in links):
            alike.setdefault(tuple(link.describe() for link in links), []).append(name)
    return [
        ScenarioDifference("every link" if names == common else f"link {', '.join(names)}", (), values)
        for values, names in alike.items()
    ]


def _flat(table: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    """Returns the values of a table and of those in it, with dotted keys."""
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        where = f"{path}.{key}" if path else key
        pairs += _flat(value, where) if isinstance(value, dict) else [(where, value)]
    return pairs


def _law(control: Mapping[str, Any]) -> str:
    gains = ", ".join(f"{key} {_short(value)}" for key, value in control.items() if key != "law")
    return f"{control['law']} ({gains})"


def _short(value: Any) -> str:
    """Returns a value as a person wants to read it; a list of equal numbers as one of them."""
    if value is None or value == [] or value == ():
        return "none"
    if isinstance(value, dict):
        words = [_short(entry) if key == "kind" else f"{key} {_short(entry)}" for key, entry in value.items()]
        return " ".join(words)
    if isinstance(value, list | tuple):
        entries = [_short(entry) for entry in value]
        alike = isinstance(value[0], int | float) and len(set(entries)) == 1
        text = entries[0] if alike else f"[{', '.join(entries)}]"
    else:
        text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _MOST else f"{text[: _MOST - 3]}..."

"""A premise in words: what is otherwise than in the log, a line for each thing.

Law: what is otherwise in the same way for several sites or links is one line; a link, and a law that is of
another kind, is told as a whole.
"""

from collections.abc import Iterator

import msgspec

from ..scenario import Scenario, SiteSpec
from .premise import Changed, Premise

_MOST = 60


def lines(premise: Premise) -> list[str]:
    """Returns what is otherwise, a line for each thing, with all that it is of."""
    owners: dict[str, list[str]] = {}
    for what, owner, how in _parts(premise):
        owners.setdefault(f"{what}\n{how}", []).append(owner)
    found = []
    for words, of in owners.items():
        what, how = words.split("\n")
        if what == "link":
            every = len(of) == len(premise.scenario.links)
            found.append(f"{'every link' if every else ', '.join(of)}: {how}")
        else:
            found.append(f"{what}{' of ' + ', '.join(of) if all(of) else ''}: {how}")
    return found


def _parts(premise: Premise) -> Iterator[tuple[str, str, str]]:
    """Yields what is otherwise, of which site or link, and how."""
    told: set[str] = set()
    for changed in premise.changes:
        group, _, rest = changed.key.partition(".")
        owner, _, key = rest.partition(".")
        whole = _whole(premise, group, owner, key)
        if whole is None:
            named = group == "sites"
            yield (key, owner, _values(changed)) if named else (changed.key, "", _values(changed))
        elif f"{group}.{owner}" not in told:
            told.add(f"{group}.{owner}")
            yield whole


def _whole(premise: Premise, group: str, owner: str, key: str) -> tuple[str, str, str] | None:
    """Returns a link, or a law of another kind, as a whole; None where one value says it all."""
    before, after = premise.original, premise.scenario
    if group == "links":
        words = [_link(scenario, owner) for scenario in (before, after)]
        return None if words[0] == words[1] else ("link", owner, " -> ".join(words))
    if group == "sites" and key.startswith("control."):
        laws = [_law(scenario.sites[owner]) for scenario in (before, after)]
        kinds = [scenario.sites[owner].control.__struct_config__.tag for scenario in (before, after)]
        return None if kinds[0] == kinds[1] else ("control", owner, " -> ".join(laws))
    return None


def _link(scenario: Scenario, name: str) -> str:
    return scenario.links[name].describe()


def _law(site: SiteSpec) -> str:
    """Returns a law and its gains in a few words."""
    gains = {key: _short(value) for key, value in msgspec.to_builtins(site.control).items() if key != "law"}
    return (
        f"{site.control.__struct_config__.tag} ({', '.join(f'{key} {text}' for key, text in gains.items())})"
    )


def _values(changed: Changed) -> str:
    return f"{_short(changed.before)} -> {_short(changed.after)}"


def _short(value: object) -> str:
    """Returns a value as a person wants to read it; a list of equal numbers as one of them."""
    if value is None or value == () or value == []:
        return "none"
    if isinstance(value, list | tuple) and isinstance(value[0], dict):
        return f"{len(value)} {'entry' if len(value) == 1 else 'entries'}"
    if isinstance(value, list | tuple):
        numbers = [f"{entry:g}" if isinstance(entry, float) else str(entry) for entry in value]
        value = numbers[0] if len(set(numbers)) == 1 else f"[{', '.join(numbers)}]"
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _MOST else f"{text[: _MOST - 3]}..."

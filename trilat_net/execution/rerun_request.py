"""The request of a rerun: which sites are executed, which settings change, and a description of the changes.

Invariant: only executed sites can be changed. A key that affects no executed site is refused; one that
affects recorded sites too changes nothing of theirs, and the result reports it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgspec

from ..errors import ScenarioError, UsageError
from ..log.log_reader import Log
from ..scenario import Scenario, SiteSpec, find_owner, find_site, load_scenario, parse_scenario

RerunOverrides = Mapping[str, Any] | Sequence[str]

_TEXT_KEYS = ("name", "title", "about", "assumed", "expect")


class ChangedValue(NamedTuple):
    """One value that the rerun has otherwise.

    Attributes:
        key: its dotted path in the resolved scenario.
        before: what the log has.
        after: what the rerun has.
    """

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class RerunRequest:
    """A rerun, as it is meant.

    Attributes:
        original: the experiment of the log.
        scenario: what holds in it: changed for the sites that are executed, the log's for the others.
        replaced: the sites that are executed, in scenario order.
        recorded: the others.
        changes: what is otherwise than in the log.
        without_effect: what was asked for besides, of sites that stand as recorded.
    """

    original: Scenario
    scenario: Scenario
    replaced: tuple[str, ...]
    recorded: tuple[str, ...]
    changes: list[ChangedValue]
    without_effect: list[ChangedValue] = field(default_factory=list)

    @property
    def closed(self) -> bool:
        """True where every site is executed: then each reacts to the others."""
        return not self.recorded

    @property
    def mode(self) -> str:
        """In a word: "closed loop" or "open loop"."""
        return "closed loop" if self.closed else "open loop"


def resolve_rerun_request(
    log: Log, replace: Sequence[str], overrides: RerunOverrides, *, closed_loop: bool
) -> RerunRequest:
    """Returns what is asked of a log, checked.

    Args:
        log: the log.
        replace: the sites to execute.
        overrides: what to change, as `load` takes it.
        closed_loop: whether to execute all of them.

    Raises:
        UsageError: it is not said which sites to execute, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an effect.
    """
    original = log.scenario
    names = original.names
    if closed_loop and replace:
        raise UsageError("--closed-loop executes every site: leave out --replace, or --closed-loop")
    if not closed_loop and not replace:
        hint = f"--replace NAME (of {', '.join(names)}), or --closed-loop for all of them"
        raise UsageError(f"which sites are to be executed afresh? Give {hint}")
    for name in replace:
        find_site(original, name)
    replaced = tuple(name for name in names if closed_loop or name in replace)
    _check_arms(original, replaced)
    recorded = tuple(name for name in names if name not in replaced)
    for key in _keys(overrides):
        _check_key(key, replaced, recorded)
    wanted = load_scenario(original, overrides)
    _check_frame(original, wanted, recorded)
    scenario = _join_scenarios(original, wanted, recorded) if recorded else wanted
    changes = _find_changes(original, scenario)
    without = [changed for changed in _find_changes(original, wanted) if changed not in changes]
    return RerunRequest(original, scenario, replaced, recorded, changes, without)


def _check_arms(original: Scenario, replaced: Sequence[str]) -> None:
    """Refuses to execute afresh a site whose arm was outside of the program."""
    for name in original.external:
        if name in replaced:
            others = ", ".join(other for other in original.names if other not in original.external)
            raise ScenarioError(
                "is external: how that arm would have moved otherwise is not known; execute others afresh"
                + (f", as in --replace {others.split(', ')[0]}" if others else ""),
                path=f"sites.{name}.plant",
            )


def _keys(overrides: RerunOverrides) -> list[str]:
    """Returns the keys that overrides name; what is none is refused where they are read."""
    if isinstance(overrides, Mapping):
        return list(overrides)
    return [text.partition("=")[0].strip() for text in overrides]


def _check_key(key: str, replaced: Sequence[str], recorded: Sequence[str]) -> None:
    """Refuses a key that a rerun has no use for, and one of a site that stands as recorded."""
    group, _, rest = key.partition(".")
    if group in _TEXT_KEYS:
        raise ScenarioError("is nothing that is executed: a rerun has no use for it", path=key)
    if group == "rate_hz" or rest.endswith(".rate_hz"):
        if recorded:
            raise ScenarioError(
                "cannot change in an open loop: samples come at the ticks of the log; use --closed-loop",
                path=key,
            )
        return
    member = rest.partition(".")[0]
    concerned = {"sites": member, "dominance": member, "links": member.partition("->")[2]}.get(group, "")
    if concerned in recorded:
        why = f"{concerned} stands as recorded" + (
            ", and a link belongs to its receiver" if group == "links" else ""
        )
        only = ", ".join(replaced)
        raise ScenarioError(
            f"has no effect: {why}; only {only} is executed: add --replace {concerned}", path=key
        )


def _check_frame(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> None:
    """Refuses other sites, and a run beyond the end of the log."""
    if wanted.names != original.names:
        raise ScenarioError(f"a rerun has the sites of the log, {', '.join(original.names)}", path="sites")
    if wanted.duration_s > original.duration_s:
        raise ScenarioError(
            f"the experiment of the log lasts {original.duration_s:g} s: what the network would have done "
            f"until {wanted.duration_s:g} s is not known",
            path="duration_s",
        )
    for name in original.names if recorded else ():
        if wanted.sites[name].rate_hz != original.sites[name].rate_hz:
            raise ScenarioError(
                "cannot change in an open loop; use --closed-loop", path=f"sites.{name}.rate_hz"
            )


def _join_scenarios(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> Scenario:
    """Returns the wanted scenario, with all that belongs to recorded sites as it was."""

    def chosen(name: str) -> Scenario:
        return original if name in recorded else wanted

    timeline = [change for change in original.timeline if find_owner(change) in recorded]
    timeline += [change for change in wanted.timeline if find_owner(change) not in recorded]
    joined = msgspec.structs.replace(
        wanted,
        sites={name: chosen(name).sites[name] for name in original.names},
        dominance={name: chosen(name).dominance[name] for name in original.names},
        links={name: chosen(name.partition("->")[2]).links[name] for name in original.links},
        timeline=tuple(sorted(timeline, key=lambda change: change.at_s)),
    )
    return parse_scenario(joined.text, original.name)


def _find_changes(original: Scenario, other: Scenario) -> list[ChangedValue]:
    """Returns every value in which two scenarios differ."""
    before, after = (dict(_leaves(msgspec.to_builtins(scenario), "")) for scenario in (original, other))
    keys = [*before, *(key for key in after if key not in before)]
    return [
        ChangedValue(key, before.get(key), after.get(key))
        for key in keys
        if before.get(key) != after.get(key)
    ]


def _leaves(value: Any, path: str) -> list[tuple[str, Any]]:
    if not isinstance(value, dict):
        return [(path, value)]
    return [leaf for key, entry in value.items() for leaf in _leaves(entry, f"{path}.{key}" if path else key)]


_VALUE_LENGTH = 60


def describe_rerun_changes(premise: RerunRequest) -> list[str]:
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


def _parts(premise: RerunRequest) -> Iterator[tuple[str, str, str]]:
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


def _whole(premise: RerunRequest, group: str, owner: str, key: str) -> tuple[str, str, str] | None:
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


def _values(changed: ChangedValue) -> str:
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
    return text if len(text) <= _VALUE_LENGTH else f"{text[: _VALUE_LENGTH - 3]}..."

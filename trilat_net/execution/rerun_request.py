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
from ..scenario import Scenario, find_owner, find_site, load_scenario, parse_scenario
from ..scenario.describe import describe_law, describe_value, flatten_table

RerunOverrides = Mapping[str, Any] | Sequence[str]

_TEXT_KEYS = ("name", "title", "about", "assumed", "expect")


class ChangedValue(NamedTuple):
    """One value that the rerun changes, by its dotted path in the resolved scenario."""

    key: str
    before: Any
    after: Any


@dataclass(frozen=True)
class RerunRequest:
    """A rerun: its sites, its scenario and its changes.

    Attributes:
        scenario: the scenario of the rerun: changed for the executed sites, the log's for the others.
        replaced: the executed sites, in scenario order.
        without_effect: requested changes of recorded sites, which change nothing.
    """

    original: Scenario
    scenario: Scenario
    replaced: tuple[str, ...]
    recorded: tuple[str, ...]
    changes: list[ChangedValue]
    without_effect: list[ChangedValue] = field(default_factory=list)

    @property
    def mode(self) -> str:
        """The mode in words: "closed loop" if every site is executed, so that each reacts to the others."""
        return "open loop" if self.recorded else "closed loop"


def resolve_rerun_request(
    log: Log, replace: Sequence[str], overrides: RerunOverrides, *, closed_loop: bool
) -> RerunRequest:
    """Checks a request for a rerun and resolves its scenario, with overrides as `load_scenario` takes them.

    Raises:
        UsageError: the sites are not named, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an effect.
    """
    original = log.scenario
    names = original.names
    if closed_loop and replace:
        raise UsageError("--closed-loop executes every site: leave out --replace, or --closed-loop")
    if not closed_loop and not replace:
        hint = f"--replace NAME (of {', '.join(names)}), or --closed-loop for all of them"
        raise UsageError(f"which sites shall be executed? Give {hint}")
    for name in replace:
        find_site(original, name)
    replaced = tuple(name for name in names if closed_loop or name in replace)
    for name in [name for name in original.external if name in replaced]:
        others = [other for other in names if other not in original.external]
        raise ScenarioError(
            "is external: how that arm would have moved otherwise is not known; execute other sites"
            + (f", as in --replace {others[0]}" if others else ""),
            path=f"sites.{name}.plant",
        )
    recorded = tuple(name for name in names if name not in replaced)
    for text in overrides:  # keys of a mapping, or texts like KEY=VALUE
        key = text if isinstance(overrides, Mapping) else text.partition("=")[0].strip()
        _check_key(key, replaced, recorded)
    wanted = load_scenario(original, overrides)
    _check_frame(original, wanted, recorded)
    scenario = _join_scenarios(original, wanted, recorded) if recorded else wanted
    changes = _find_changes(original, scenario)
    without = [changed for changed in _find_changes(original, wanted) if changed not in changes]
    return RerunRequest(original, scenario, replaced, recorded, changes, without)


def _check_key(key: str, replaced: Sequence[str], recorded: Sequence[str]) -> None:
    group, _, rest = key.partition(".")
    if group in _TEXT_KEYS:
        raise ScenarioError("is nothing that is executed: it has no effect in a rerun", path=key)
    if group == "rate_hz" or rest.endswith(".rate_hz"):
        return  # `_check_frame` judges what comes of it
    member = rest.partition(".")[0]
    concerned = {"sites": member, "dominance": member, "links": member.partition("->")[2]}.get(group, "")
    if concerned in recorded:
        why = f"{concerned} stays as recorded{', and a link belongs to its receiver' * (group == 'links')}"
        only = f"only {', '.join(replaced)} is executed"
        raise ScenarioError(f"has no effect: {why}; {only}: add --replace {concerned}", path=key)


def _check_frame(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> None:
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
                "cannot change in an open loop: samples come at the ticks of the log; use --closed-loop",
                path=f"sites.{name}.rate_hz",
            )


def _join_scenarios(original: Scenario, wanted: Scenario, recorded: Sequence[str]) -> Scenario:

    def source(name: str) -> Scenario:
        return original if name in recorded else wanted

    timeline = [change for change in original.timeline if find_owner(change) in recorded]
    timeline += [change for change in wanted.timeline if find_owner(change) not in recorded]
    joined = msgspec.structs.replace(
        wanted,
        sites={name: source(name).sites[name] for name in original.names},
        dominance={name: source(name).dominance[name] for name in original.names},
        links={name: source(name.partition("->")[2]).links[name] for name in original.links},
        timeline=tuple(sorted(timeline, key=lambda change: change.at_s)),
    )
    return parse_scenario(joined.text, original.name)


def _find_changes(original: Scenario, other: Scenario) -> list[ChangedValue]:
    before, after = (dict(flatten_table(msgspec.to_builtins(scenario))) for scenario in (original, other))
    return [
        ChangedValue(key, before.get(key), after.get(key))
        for key in before | after
        if before.get(key) != after.get(key)
    ]


def describe_rerun_changes(request: RerunRequest) -> list[str]:
    """Returns the changes in words, a line for each, with all its owners."""
    owners: dict[tuple[str, str], list[str]] = {}
    for subject, owner, change in _describe_parts(request):
        owners.setdefault((subject, change), []).append(owner)
    lines = []
    for (subject, change), names in owners.items():
        if subject == "link":
            every = len(names) == len(request.scenario.links)
            lines.append(f"{'every link' if every else ', '.join(names)}: {change}")
        else:
            lines.append(f"{subject}{' of ' + ', '.join(names) if all(names) else ''}: {change}")
    return lines


def _describe_parts(request: RerunRequest) -> Iterator[tuple[str, str, str]]:
    done: set[str] = set()
    for changed in request.changes:
        group, _, rest = changed.key.partition(".")
        owner, _, key = rest.partition(".")
        whole = _describe_whole(request, group, owner, key)
        if whole is None:
            values = f"{_shorten(changed.before)} -> {_shorten(changed.after)}"
            yield (key, owner, values) if group == "sites" else (changed.key, "", values)
        elif f"{group}.{owner}" not in done:
            done.add(f"{group}.{owner}")
            yield whole


def _describe_whole(request: RerunRequest, group: str, owner: str, key: str) -> tuple[str, str, str] | None:
    """Describes a link, or a law of another kind, as a whole; None if single values say it all."""
    before, after = request.original, request.scenario
    if group == "links":
        links = [scenario.links[owner].describe() for scenario in (before, after)]
        return None if links[0] == links[1] else ("link", owner, " -> ".join(links))
    if group == "sites" and key.startswith("control."):
        laws = [msgspec.to_builtins(scenario.sites[owner].control) for scenario in (before, after)]
        same = laws[0]["law"] == laws[1]["law"]
        return None if same else ("control", owner, " -> ".join(map(describe_law, laws)))
    return None


def _shorten(value: object) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return f"{len(value)} {'entry' if len(value) == 1 else 'entries'}"
    return describe_value(value)

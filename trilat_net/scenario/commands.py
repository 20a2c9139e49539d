"""Changes ordered while a session runs, as its records name them.

Law: the text in a record is the whole change; whoever reads it makes the same command of it.
"""

from typing import Any

import msgspec

from ..core.grid import NS_PER_S
from ..core.tick import Command
from ..errors import ScenarioError
from .connections import change_link, change_shares
from .conversion import check_change
from .model import Scenario
from .timeline import Change

Present = dict[str, dict[str, Any]]


def present_links(scenario: Scenario) -> Present:
    """Returns what every link is at the start, as tables."""
    return {name: msgspec.to_builtins(link) for name, link in scenario.links.items()}


def resolve_change(scenario: Scenario, present: Present, written: dict[str, Any], from_ns: int) -> Change:
    """Returns a change that somebody ordered, complete and checked.

    Args:
        scenario: the experiment.
        present: what every link is now.
        written: `link` or `dominance`, and what it is `to` be, as in a scenario's timeline.
        from_ns: from when it holds, ns since the epoch.

    Raises:
        ScenarioError: there is no such link or site, or it cannot be that.
    """
    change: dict[str, Any] = {**written, "at_s": from_ns / NS_PER_S}
    if ("link" in change) == ("dominance" in change):
        raise ScenarioError("a change names either a link or, as dominance, a site")
    if "link" in change:
        change["to"] = change_link(change.get("to", {}), change["link"], present, "change")
        if change["to"]["model"] == "trace":  # a record cannot hold it
            raise ScenarioError("a link with a trace can only be given another model", path="change.to")
    else:
        change["to"] = change_shares(
            change.get("to", {}), change["dominance"], list(scenario.names), "change"
        )
    try:
        complete = msgspec.convert(change, Change)
    except msgspec.ValidationError as error:
        raise ScenarioError(str(error), path="change") from None
    check_change(complete, "change")
    return complete


def owner(change: Change) -> str:
    """Returns the site that carries a change out: a link belongs to its receiver."""
    return change.dominance or change.link.partition("->")[2]


def command(scenario: Scenario, change: Change) -> Command:
    """Returns a change as its owner takes it in."""
    text = msgspec.json.encode(change).decode()
    site = owner(change)
    if change.dominance:
        return Command(text, ramp=scenario.ramp(site, change.shares, change.start_ns, change.ramp_s))
    peer = scenario.peers(site).index(change.link.partition("->")[0])
    return Command(text, peer=peer, model=change.after.core(change.start_ns))


def command_from(scenario: Scenario, site: str, text: str) -> Command:
    """Returns the command that a record of a site names.

    Raises:
        ScenarioError: it names none of that site's.
    """
    try:
        change = msgspec.json.decode(text, type=Change)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ScenarioError(f"the record names a command that is none: {error}", path=text[:80]) from None
    if change.link not in ("", *scenario.links) or change.dominance not in ("", *scenario.names):
        raise ScenarioError(
            "the record names a command for a link or site that does not exist", path=text[:80]
        )
    if owner(change) != site or bool(change.link) == bool(change.dominance):
        raise ScenarioError(f"the record names a command that is none of {site}", path=text[:80])
    check_change(change, "cmd")
    if change.dominance:
        change_shares(change.to, change.dominance, list(scenario.names), "cmd")
    return command(scenario, change)


def later_tables(scenario: Scenario) -> list[tuple[int, str, dict[str, Any]]]:
    """Returns what links become by the scenario's own timeline: (from when, ns, the link, its table)."""
    return [(change.start_ns, change.link, change.to) for change in scenario.timeline if change.link]

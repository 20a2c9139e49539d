"""Validates changes to a running experiment, such as a new delay or a stop.

A change affects a network link, the dominance factors of a site, or the mode of an arm (through
commands such as stop, enable and reset). Changes are either planned in the scenario or
requested during the run.

Invariant:
    - A request only needs to contain the settings that change. It is completed with the current
      settings, and the log stores the complete change as a string. All programs that read the
      log therefore derive the same `CoreChange`, the record used by the control loop.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from ..core import CoreChange
from ..errors import ScenarioError
from ..records import NS_PER_S
from .change import Change
from .delay_models import LinkBase
from .refusals import check_table
from .resolve import complete_target, resolve_dominance_row
from .scenario_types import Scenario
from .validate import check_change, check_links_memory
from .written_tables import WrittenChange


class LinkTables(dict[str, dict[str, Any]]):
    """Current settings of every network link during a run.

    `advance_to` applies planned changes. A caller that accepts a change requested by a user
    stores the new settings itself.

    Args:
        links: Mapping from link name to the settings at the start of the run.
        timeline: Planned changes in ascending order of time.
    """

    def __init__(self, links: Mapping[str, LinkBase], timeline: Sequence[Change]) -> None:
        super().__init__({name: msgspec.to_builtins(link) for name, link in links.items()})
        self._planned = deque(change for change in timeline if change.link)

    def advance_to(self, t_ns: int) -> None:
        """Applies all planned link changes up to a given time.

        Args:
            t_ns: The time, in ns after the epoch (the common start time).
        """
        while self._planned and self._planned[0].start_ns <= t_ns:
            change = self._planned.popleft()
            self[change.link] = change.to


def resolve_change(
    scenario: Scenario, current_links: LinkTables, written: dict[str, Any], from_ns: int
) -> Change:
    """Completes and validates a change that a user requests during a run.

    The request may contain only the link settings that change; all others keep their current
    values.

    Args:
        scenario: The scenario.
        current_links: Current settings of all links.
        written: The request: `link` or `dominance`, and the new settings as `to`.
        from_ns: Time at which the change takes effect, in ns after the common start time of all
            sites.

    Returns:
        The change with all settings.

    Raises:
        ScenarioError: There is no such link or site, or a value is not valid.
    """
    change = {**written, "at_s": from_ns / NS_PER_S}
    request = check_table(change, WrittenChange, "change")
    names_both_or_neither = bool(request.link) == bool(request.dominance)
    if names_both_or_neither:
        raise ScenarioError("a change must name either a link (link) or a site (dominance)")
    change["to"] = complete_target(request, current_links, list(scenario.names), "change")
    # The table of a trace is too long for a record.
    if request.link and change["to"]["model"] == "trace":
        raise ScenarioError(
            "a link with a trace can be changed only by setting another model",
            path="change.to",
        )

    complete = check_table(change, Change, "change")
    check_change(complete, "change")

    # A longer delay may need more memory at the receiver.
    if complete.link:
        changed_scenario = msgspec.structs.replace(
            scenario, timeline=(*scenario.timeline, complete)
        )
        check_links_memory(changed_scenario, complete.owner)
    return complete


def parse_core_change(scenario: Scenario, site: str, text: str) -> CoreChange:
    """Parses a logged change into the record that the compiled control loop reads.

    The log may come from an untrusted source, so the change is validated completely.

    Args:
        scenario: Scenario of the run.
        site: Name of the site that published the record.
        text: The change as JSON, as stored in the record.

    Raises:
        ScenarioError: The text is not a valid change, or the change belongs to another site.
    """
    try:
        change = msgspec.json.decode(text, type=Change)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ScenarioError(
            f"the record contains a command that cannot be read: {error}", path=text[:80]
        ) from None
    sites = ("", *scenario.names)
    if (
        change.link not in ("", *scenario.links)
        or change.dominance not in sites
        or change.site not in sites
    ):
        raise ScenarioError(
            "the record contains a command for a link or site that does not exist",
            path=text[:80],
        )

    targets = [name for name in (change.link, change.dominance, change.site) if name]
    is_order = bool(change.order)
    is_for_site = change.owner == site
    if not is_for_site or len(targets) != 1 or bool(change.site) != is_order:
        raise ScenarioError(
            f"the record contains a command that is not for {site}", path=text[:80]
        )

    if is_order:
        # called only to check the change
        scenario.make_site_order(site, change.order, change.start_ns)
    check_change(change, "cmd")
    if change.dominance:
        resolve_dominance_row(change.to, list(scenario.names), change.dominance, "cmd.to")
    return scenario.to_core_change(change)

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

from ..errors import ScenarioError
from ..records import NS_PER_S
from .change import Change
from .delay_models import LinkBase
from .refusals import check_table
from .resolve import complete_target
from .scenario_types import Scenario
from .validate import check_links_memory
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
    complete.check_link("change")

    # A longer delay may need more memory at the receiver.
    if complete.link:
        changed_scenario = msgspec.structs.replace(
            scenario, timeline=(*scenario.timeline, complete)
        )
        check_links_memory(changed_scenario, complete.owner)
    return complete

"""Checks changes of a running experiment, such as a new delay or a stop.

Three things can change: a network link between two arms, the weights with which an arm follows
the others (dominance factors), and the mode of an arm, by commands such as stop, enable and
reset. Changes are planned in a scenario, the description of the experiment, or requested during
the run.

Invariant:
    - A request may state only the settings that change. They are completed with the settings
      before the change, and the log contains the complete change as a string. Therefore all
      programs that read the log derive the same `CoreChange`, the record that the control loop
      uses.
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
    """Present settings of every network link during a run, by the name of the link.

    The settings, such as the delay, change at planned times, which `advance_to` applies. A
    caller that accepts a change requested by a user stores the new settings itself.

    Args:
        links: Links at the start of the run, by name.
        timeline: Planned changes, in the order of their times.
    """

    def __init__(self, links: Mapping[str, LinkBase], timeline: Sequence[Change]) -> None:
        super().__init__({name: msgspec.to_builtins(link) for name, link in links.items()})
        self._planned = deque(change for change in timeline if change.link)

    def advance_to(self, t_ns: int) -> None:
        """Applies the changes of network links that the scenario plans up to a time.

        Args:
            t_ns: The time, in ns after the epoch (the common start time).
        """
        while self._planned and self._planned[0].start_ns <= t_ns:
            change = self._planned.popleft()
            self[change.link] = change.to


def resolve_change(
    scenario: Scenario, current_links: LinkTables, written: dict[str, Any], from_ns: int
) -> Change:
    """Completes and checks a change that a user requests during a run.

    It changes a network link, or the weights with which one arm follows the others. A user may
    state only the settings of a link that change. All others keep their present values.

    Args:
        scenario: Description of the experiment.
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
    """Converts the text of a change in a log to the form that the compiled control loop reads.

    The log may come from an untrusted source, so the change is checked completely.

    Args:
        scenario: Scenario of the run.
        site: Name of the site that published the record.
        text: JSON text of the change, as the record contains it.

    Raises:
        ScenarioError: The text is not a valid change, or not a change of this site.
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

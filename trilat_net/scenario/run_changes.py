"""Changes of links and of dominance during a run, by request or by the timeline.

Orders to a site (stop, enable, reset, …) are changes as well.

Invariant:
    - A change is completed with the state before it, and its text in a record is the whole
      change. Every reader therefore derives the same `CoreChange` from a record.
"""

import re
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import msgspec

from ..core.ticks import NS_PER_S, CoreChange, LifeOrder
from ..errors import ScenarioError
from .delay_models import LinkBase
from .resolve import resolve_dominance_row, resolve_target
from .scenario_types import Change, Scenario, SiteOrder
from .validate import check_change, check_links_memory


class LinkTables(dict[str, dict[str, Any]]):
    """The current table of every link: as at the start, then after each change.

    The changes of the timeline are applied by `advance_to`; a caller that accepts another
    change writes the new table of its link itself.
    """

    def __init__(self, links: Mapping[str, LinkBase], timeline: Sequence[Change]) -> None:
        super().__init__({name: msgspec.to_builtins(link) for name, link in links.items()})
        self._planned = deque(change for change in timeline if change.link)

    def advance_to(self, t_ns: int) -> None:
        """Applies the changes of the timeline up to the time `t_ns`, ns since the epoch."""
        while self._planned and self._planned[0].start_ns <= t_ns:
            change = self._planned.popleft()
            self[change.link] = change.to


def resolve_change(
    scenario: Scenario, current_links: LinkTables, written: dict[str, Any], from_ns: int
) -> Change:
    """Returns a requested change, complete and checked.

    Args:
        scenario: the scenario of the run.
        current_links: every link as it is now.
        written: the change as a scenario's timeline states it, without `at_s`.
        from_ns: the time from which the change holds, ns since the epoch.

    Raises:
        ScenarioError: there is no such link or site, or a value is not valid.
    """
    change = {**written, "at_s": from_ns / NS_PER_S}
    if ("link" in change) == ("dominance" in change):
        raise ScenarioError("a change names either a link or, as dominance, a site")
    change["to"] = resolve_target(change, current_links, list(scenario.names), "change")
    # The table of a trace is too long for a record.
    if "link" in change and change["to"]["model"] == "trace":
        raise ScenarioError(
            "a link with a trace can only be given another model", path="change.to"
        )
    try:
        complete = msgspec.convert(change, Change)
    except msgspec.ValidationError as error:
        raise ScenarioError(str(error), path="change") from None
    check_change(complete, "change")
    if complete.link:
        changed_scenario = msgspec.structs.replace(
            scenario, timeline=(*scenario.timeline, complete)
        )
        check_links_memory(changed_scenario, find_owner(complete))
    return complete


def find_owner(change: Change) -> str:
    """Returns the site that carries a change out; a link belongs to its receiver."""
    return change.site or change.dominance or change.link.partition("->")[2]


def make_site_order(
    scenario: Scenario, site: str, order: SiteOrder, from_ns: int, ticks: int = 0
) -> Change:
    """Returns an order to a site as a change.

    Args:
        scenario: the scenario of the run.
        site: the site.
        order: the order.
        from_ns: the time of the tick at which the site carries the order out, ns since the
            epoch.
        ticks: for "overrun", the number of ticks that the site missed.

    Raises:
        ScenarioError: the stale rule of the site does not allow orders.
    """
    action = scenario.sites[site].on_stale.action
    if action != "glide":
        raise ScenarioError(
            f"{site} has on_stale.action = {action!r}, and only a site with 'glide' can stop "
            "and go on without a jump. The whole session ends with trilat stop --end"
        )
    return Change(at_s=from_ns / NS_PER_S, site=site, order=order, ticks=ticks)


_ORDER_SENTENCES = {
    "stop": "{site} was stopped{by} at {at}",
    "enable": "{site} was enabled{by} at {at}",
    "reset": "the fault of {site} was reset{by} at {at}",
    "held": "the dead-man switch of {site} was held again at {at}",
    "released": "the dead-man switch of {site} was released at {at}",
    "arm_silent": "no measurement came from the arm of {site} at {at}",
    "arm_lost": "the arm of {site} was silent for too long at {at}",
    "arm_back": "measurements came again from the arm of {site} at {at}",
    "overrun": "{site} missed {ticks} {noun} before {at}",
}
"""The sentence that reports each order to people."""


def describe_change(change: Change, ordered_by: str = "") -> str:
    """Returns a sentence on a change without a full stop.

    An example is "m2 was stopped by the experimenter at 58.2 s".

    Args:
        change: an order to a site, a change of a link, or a change of a row of shares.
        ordered_by: who requested the change, a noun phrase; "": not known.
    """
    by = f" by {ordered_by}" if ordered_by else ""
    if change.order:
        sentence = _ORDER_SENTENCES[change.order]
        return sentence.format(
            site=change.site,
            by=by,
            at=f"{change.at_s:.1f} s",
            ticks=change.ticks,
            noun="tick" if change.ticks == 1 else "ticks",
        )
    at = f"{round(change.at_s, 3):g} s"
    if change.link:
        link = change.after.describe()
        return f"the link {change.link} was set to {link}{by}, from {at} on"
    shares = ", ".join(f"{peer} {share:g}" for peer, share in change.to.items() if share)
    ramp = f" within {change.ramp_s:g} s" if change.ramp_s else ""
    target = shares or "nobody"
    return f"the shares of {change.dominance} were set to {target}{ramp}{by}, from {at} on"


def find_requester(sentence: str) -> str:
    """Returns who requested a stop, from the sentence of `describe_change`; "" if not said."""
    match = re.fullmatch(r"\S+ was stopped by (.+) at [\d.]+ s", sentence)
    return "" if match is None else match[1]


def count_skipped_ticks(texts: Sequence[str]) -> int:
    """Returns how many ticks a site missed just before a record.

    Args:
        texts: the texts of the changes in the record.
    """
    skipped = 0
    for text in texts:
        if "overrun" in text:
            with suppress(msgspec.MsgspecError):
                skipped += msgspec.json.decode(text, type=Change).ticks
    return skipped


def to_core_change(scenario: Scenario, change: Change) -> CoreChange:
    """Returns a change in the form in which the core of its owner applies it."""
    text = msgspec.json.encode(change).decode()
    site = find_owner(change)
    if change.order:
        return CoreChange(text, order=LifeOrder[change.order.upper()], skipped=change.ticks)
    if change.dominance:
        ramp = scenario.ramp(site, change.to, change.start_ns, change.ramp_s)
        return CoreChange(text, ramp=ramp)
    sender = change.link.partition("->")[0]
    return CoreChange(
        text,
        peer=scenario.peers(site).index(sender),
        model=change.after.to_core_model(change.start_ns),
    )


def parse_core_change(scenario: Scenario, site: str, text: str) -> CoreChange:
    """Returns the change that a text in a site's record states.

    Raises:
        ScenarioError: the text is not a change of that site.
    """
    try:
        change = msgspec.json.decode(text, type=Change)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ScenarioError(
            f"the record names a command that cannot be read: {error}", path=text[:80]
        ) from None
    sites = ("", *scenario.names)
    if (
        change.link not in ("", *scenario.links)
        or change.dominance not in sites
        or change.site not in sites
    ):
        raise ScenarioError(
            "the record names a command for a link or site that does not exist", path=text[:80]
        )
    targets = [name for name in (change.link, change.dominance, change.site) if name]
    is_order = bool(change.order)
    is_for_site = find_owner(change) == site
    if not is_for_site or len(targets) != 1 or bool(change.site) != is_order:
        raise ScenarioError(
            f"the record names a command that is not for {site}", path=text[:80]
        )
    if is_order:
        make_site_order(scenario, site, change.order, change.start_ns)
    check_change(change, "cmd")
    if change.dominance:
        resolve_dominance_row(change.to, list(scenario.names), change.dominance, "cmd.to")
    return to_core_change(scenario, change)

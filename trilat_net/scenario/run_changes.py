"""Changes of links and of dominance while a run goes on, by request or by its timeline.

Invariant: a change is completed upon the state before it, and its text in a record is the whole
change: every reader derives the same `CoreChange` from it.
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
    """Every link as a table: first as at the start, then as the timeline and whoever changes
    one has it.
    """

    def __init__(self, links: Mapping[str, LinkBase], timeline: Sequence[Change]) -> None:
        super().__init__({name: msgspec.to_builtins(link) for name, link in links.items()})
        self._planned = deque(change for change in timeline if change.link)

    def advance_to(self, to_ns: int) -> None:
        """Makes the changes that the timeline has up to a time, ns since the epoch."""
        while self._planned and self._planned[0].start_ns <= to_ns:
            change = self._planned.popleft()
            self[change.link] = change.to


def resolve_change(
    scenario: Scenario, present: LinkTables, written: dict[str, Any], from_ns: int
) -> Change:
    """Returns a requested change, complete and checked, that holds from `from_ns` on, ns since
    the epoch.

    It is written as in a scenario's timeline, upon every link as it is at present.

    Raises:
        ScenarioError: there is no such link or site, or the value is not valid.
    """
    change = {**written, "at_s": from_ns / NS_PER_S}
    if ("link" in change) == ("dominance" in change):
        raise ScenarioError("a change names either a link or, as dominance, a site")
    change["to"] = resolve_target(change, present, list(scenario.names), "change")
    if "link" in change and change["to"]["model"] == "trace":  # a record cannot hold it
        raise ScenarioError(
            "a link with a trace can only be given another model", path="change.to"
        )
    try:
        complete = msgspec.convert(change, Change)
    except msgspec.ValidationError as error:
        raise ScenarioError(str(error), path="change") from None
    check_change(complete, "change")
    if complete.link:
        after = msgspec.structs.replace(scenario, timeline=(*scenario.timeline, complete))
        check_links_memory(after, find_owner(complete))
    return complete


def find_owner(change: Change) -> str:
    """Returns the site that carries a change out; a link belongs to its receiver."""
    return change.site or change.dominance or change.link.partition("->")[2]


def make_site_order(
    scenario: Scenario, site: str, order: SiteOrder, from_ns: int, ticks: int = 0
) -> Change:
    """Returns an order to a site, which it carries out at a tick at `from_ns`, ns since the
    epoch.

    Raises:
        ScenarioError: the site does not know such orders.
    """
    action = scenario.sites[site].on_stale.action
    if action != "glide":
        raise ScenarioError(
            f"{site} has on_stale.action = {action!r}; one that can stop, and go on without a jump, has "
            "'glide'. The whole session ends with trilat stop --end"
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
"""What people are told of each order to a site."""


def describe_change(change: Change, ordered_by: str = "") -> str:
    """Returns a change in a sentence without a full stop, as "m2 was stopped by the
    experimenter at 58.2 s".

    Args:
        change: an order to a site, a change of a link, or one of a row of shares.
        ordered_by: who asked for it, a noun phrase; "" if nobody knows.
    """
    by = f" by {ordered_by}" if ordered_by else ""
    if change.order:
        at = f"{change.at_s:.1f} s"
        noun = "tick" if change.ticks == 1 else "ticks"
        sentence = _ORDER_SENTENCES[change.order]
        return sentence.format(site=change.site, by=by, at=at, ticks=change.ticks, noun=noun)
    at = f"{round(change.at_s, 3):g} s"
    if change.link:
        return f"the link {change.link} was set to {change.after.describe()}{by}, from {at} on"
    shares = ", ".join(f"{peer} {share:g}" for peer, share in change.to.items() if share)
    within = f" within {change.ramp_s:g} s" if change.ramp_s else ""
    return f"the shares of {change.dominance} were set to {shares or 'nobody'}{within}{by}, from {at} on"


def find_requester(sentence: str) -> str:
    """Returns who ordered a stop, by the sentence of `describe_change`; "" if it does not say."""
    stopped = re.fullmatch(r"\S+ was stopped by (.+) at [\d.]+ s", sentence)
    return "" if stopped is None else stopped[1]


def count_skipped_ticks(texts: Sequence[str]) -> int:
    """Returns how many ticks before its own a record says that its site did not make, by its
    changes.
    """
    skipped = 0
    for text in texts:
        if "overrun" in text:
            with suppress(msgspec.MsgspecError):
                skipped += msgspec.json.decode(text, type=Change).ticks
    return skipped


def to_core_change(scenario: Scenario, change: Change) -> CoreChange:
    """Returns a change as its owner takes it in."""
    text = msgspec.json.encode(change).decode()
    site = find_owner(change)
    if change.order:
        return CoreChange(text, order=LifeOrder[change.order.upper()], skipped=change.ticks)
    if change.dominance:
        return CoreChange(
            text, ramp=scenario.ramp(site, change.to, change.start_ns, change.ramp_s)
        )
    peer = scenario.peers(site).index(change.link.partition("->")[0])
    return CoreChange(text, peer=peer, model=change.after.to_core_model(change.start_ns))


def parse_core_change(scenario: Scenario, site: str, text: str) -> CoreChange:
    """Returns the change that a text in a site's record names.

    Raises:
        ScenarioError: it names no change of that site.
    """
    try:
        change = msgspec.json.decode(text, type=Change)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise ScenarioError(
            f"the record names a command that is none: {error}", path=text[:80]
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
    named = [bool(name) for name in (change.link, change.dominance, change.site)]
    if find_owner(change) != site or sum(named) != 1 or bool(change.site) != bool(change.order):
        raise ScenarioError(
            f"the record names a command that is none of {site}", path=text[:80]
        )
    if change.order:
        make_site_order(scenario, site, change.order, change.start_ns)
    check_change(change, "cmd")
    if change.dominance:
        resolve_dominance_row(change.to, list(scenario.names), change.dominance, "cmd.to")
    return to_core_change(scenario, change)

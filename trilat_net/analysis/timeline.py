"""Timeline of a run: applied changes, link models in force, intervals of hold, brake and
return, divergence.

Invariant: every entry comes from the scenario or from a record; none is inferred from a
trajectory.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import msgspec
import numpy as np

from ..core.session_life import HELD_OVERRUN_TICKS
from ..core.ticks import find_alarm
from ..errors import count_nouns
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..net.messages import MODES, ModeMeaning
from ..scenario import find_owner
from ..scenario.delay_models import LinkBase
from ..scenario.event_text import describe_event
from ..scenario.run_changes import describe_change, find_requester
from ..scenario.scenario_types import Change


class AppliedChange(NamedTuple):
    """A change of a link or of a site's dominance factors, or an order, and the site that
    carried it out.

    Attributes:
        change: what was changed or ordered, and when.
        site: who carried it out.
        taken_at_tick: the tick whose record names it; None for a change of the scenario.
        sentence: what people are told of it, with who asked for it as far as the log knows.
    """

    change: Change
    site: str
    taken_at_tick: int | None
    sentence: str

    @property
    def about(self) -> str:
        """Its subject: a link "j->i", the shares of a site, or a site."""
        return self.change.link or self.change.site or f"shares of {self.change.dominance}"

    @property
    def text(self) -> str:
        """The value after it."""
        if self.change.order:
            ticks = f", {count_nouns(self.change.ticks, 'tick')}" if self.change.ticks else ""
            return self.change.order.replace("_", " ") + ticks
        if self.change.link:
            return self.change.after.describe()
        shares = ", ".join(
            f"{peer} {share:g}" for peer, share in self.change.to.items() if share
        )
        return f"{shares} within {self.change.ramp_s:g} s" if self.change.ramp_s else shares


class ModeInterval(NamedTuple):
    """An interval of hold, brake or return, up to the first tick after it, or the end of the
    last period.
    """

    mode: str
    from_s: float
    to_s: float

    @property
    def meaning(self) -> ModeMeaning:
        """What the mode means."""
        return MODES[self.mode]


class StatedModel(NamedTuple):
    """A link model, and the first stamp for which it holds, s after the epoch."""

    from_s: float
    link: LinkBase


def list_changes(log: Log) -> list[AppliedChange]:
    """Returns the changes before the end of the run, in the order of the times from which they
    held.

    Ticks that were not made are among them if they were so many that the site held.

    Raises:
        LogError: a record names a change that is none.
    """
    planned = log.scenario.timeline
    found = [
        AppliedChange(change, find_owner(change), None, describe_change(change))
        for change in planned
    ]
    said = {
        (event.member, event.command): event for event in log.events if event.kind == "change"
    }
    for site in log.sites:
        log.commands(site)  # refuses what is no change of that site's
        for tick, texts in log.changes(site).items():
            for text in texts:
                change = msgspec.json.decode(text, type=Change)
                event = said.get((site, text))
                sentence = describe_change(change)
                if event is not None:
                    sentence = describe_event(event.kind, event.text, event.command)
                found.append(AppliedChange(change, site, tick, sentence))
    before_s = recorded_end_s(log)
    kept = (
        c
        for c in found
        if c.change.at_s < before_s and not 0 < c.change.ticks <= HELD_OVERRUN_TICKS
    )
    return sorted(kept, key=lambda changed: changed.change.at_s)


def list_stated_models(
    log: Log, link: str, changed: Sequence[AppliedChange]
) -> list[StatedModel]:
    """Returns the models of a link, "j->i", from the start and after every listed change of it."""
    later = [
        StatedModel(c.change.at_s, c.change.after) for c in changed if c.change.link == link
    ]
    return [StatedModel(0.0, log.scenario.links[link]), *later]


def recorded_end_s(log: Log) -> float:
    """Returns when the run ended, s: the end of the last record's period; without records, its
    plan.
    """
    parts = [log[name] for name in log.sites]
    ends = [float(part.t_s[-1]) + 1.0 / part.rate_hz for part in parts if len(part)]
    return max(ends, default=log.scenario.duration_s)


def find_mode_intervals(part: SiteLog) -> list[ModeInterval]:
    """Returns the intervals in which a site held, braked or returned, in order."""
    modes: list[str] = part.mode.tolist()
    if all(MODES[mode].follows for mode in modes):
        return []
    found = []
    times = np.append(part.t_s, part.t_s[-1] + 1.0 / part.rate_hz).tolist()
    first = 0
    for mode, group in groupby(modes):
        last = first + len(list(group))
        if not MODES[mode].follows:
            found.append(ModeInterval(mode, times[first], times[last]))
        first = last
    return found


class RaisedAlarm(NamedTuple):
    """A time in which a site held, was stopped, or was in fault, under the rule `glide`."""

    site: str
    word: str
    reason: str
    from_s: float
    to_s: float

    def __str__(self) -> str:
        return f"{self.site} {self.word} {self.from_s:.3f}-{self.to_s:.3f} s: {self.reason}"


def list_alarms(log: Log) -> list[RaisedAlarm]:
    """Returns the alarms of all sites, in the order of their beginnings; of a stop with who
    ordered it.
    """
    orderers = {
        (one.site, one.taken_at_tick): find_requester(one.sentence) for one in list_changes(log)
    }
    found = []
    for site in log.sites:
        part = log[site]
        glides = log.scenario.sites[site].on_stale.action == "glide"
        for mode, from_s, to_s in find_mode_intervals(part) if glides else ():
            state = part.states[int(np.searchsorted(part.t_s, from_s))]
            alarm = find_alarm(
                session=log.scenario.name,
                site=site,
                mode=mode,
                mem=state.mem,
                shared=len(state.q_des),
            )
            if alarm is not None:
                orderer = orderers.get((site, state.tick), "")
                reason = f"ordered by {orderer}" if orderer else alarm.reason
                found.append(
                    RaisedAlarm(
                        site=site, word=alarm.word, reason=reason, from_s=from_s, to_s=to_s
                    )
                )
    return sorted(found, key=lambda one: one.from_s)

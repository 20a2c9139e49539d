"""Lists what happened in a run, over time: changes, link models, modes of sites and alarms.

Invariant:
    - Every entry comes from the scenario or from a record; none is inferred from a trajectory.
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
    """A change or an order, and the site that carried it out.

    Attributes:
        change: the change of a link or of a site's dominance factors, or the order, with its
            time.
        site: the site that carried it out.
        taken_at_tick: tick of the record that names the change; None for a change of the
            scenario.
        sentence: a sentence for people, with the name of whoever ordered the change, if known.
    """

    change: Change
    site: str
    taken_at_tick: int | None
    sentence: str

    @property
    def subject(self) -> str:
        """The subject of the change: a link "j->i", the shares of a site, or a site."""
        return self.change.link or self.change.site or f"shares of {self.change.dominance}"

    @property
    def text(self) -> str:
        """The state after the change."""
        change = self.change
        if change.order:
            order = change.order.replace("_", " ")
            return f"{order}, {count_nouns(change.ticks, 'tick')}" if change.ticks else order
        if change.link:
            return change.after.describe()
        shares = ", ".join(f"{peer} {share:g}" for peer, share in change.to.items() if share)
        return f"{shares} within {change.ramp_s:g} s" if change.ramp_s else shares


class ModeInterval(NamedTuple):
    """An interval in which a site held, braked or returned.

    Attributes:
        mode: the mode.
        from_s: time of the first tick in this mode, in s.
        to_s: time of the first tick after it, or end of the site's last period, in s.
    """

    mode: str
    from_s: float
    to_s: float

    @property
    def meaning(self) -> ModeMeaning:
        """The meaning of the mode."""
        return MODES[self.mode]


class StatedModel(NamedTuple):
    """A link model, and the first stamp to which it applies, in s after the epoch."""

    from_s: float
    link: LinkBase


def list_changes(log: Log) -> list[AppliedChange]:
    """Returns all changes before the end of the run, in the order in which they took effect.

    Ticks that a site skipped are included if they were so many that the site held.

    Raises:
        LogError: a record names a change that is not valid.
    """
    applied = [
        AppliedChange(change, find_owner(change), None, describe_change(change))
        for change in log.scenario.timeline
    ]
    change_events = {
        (event.member, event.command): event for event in log.events if event.kind == "change"
    }
    for site in log.sites:
        log.commands(site)  # raises if a record names a change that is not valid for the site
        for tick, texts in log.changes(site).items():
            for text in texts:
                change = msgspec.json.decode(text, type=Change)
                event = change_events.get((site, text))
                if event is None:
                    sentence = describe_change(change)
                else:
                    sentence = describe_event(event.kind, event.text, event.command)
                applied.append(AppliedChange(change, site, tick, sentence))
    end_s = recorded_end_s(log)
    shown = [
        entry
        for entry in applied
        if entry.change.at_s < end_s and not 0 < entry.change.ticks <= HELD_OVERRUN_TICKS
    ]
    return sorted(shown, key=lambda entry: entry.change.at_s)


def list_stated_models(
    log: Log,
    link: str,
    changed: Sequence[AppliedChange],
) -> list[StatedModel]:
    """Returns the models of a link: the one at the start, and one after every change.

    Args:
        log: the log of a run.
        link: name of the link, "j->i".
        changed: changes of the run.
    """
    later_models = [
        StatedModel(entry.change.at_s, entry.change.after)
        for entry in changed
        if entry.change.link == link
    ]
    return [StatedModel(0.0, log.scenario.links[link]), *later_models]


def recorded_end_s(log: Log) -> float:
    """Returns the end of a run in s: that of the last record's period, or the planned end."""
    parts = [log[site] for site in log.sites]
    recorded = [part for part in parts if len(part)]
    ends_s = [float(part.t_s[-1]) + 1.0 / part.rate_hz for part in recorded]
    return max(ends_s, default=log.scenario.duration_s)


def find_mode_intervals(part: SiteLog) -> list[ModeInterval]:
    """Returns the intervals in which a site held, braked or returned, in order."""
    modes: list[str] = part.mode.tolist()
    if all(MODES[mode].follows for mode in modes):
        return []
    times_s = np.append(part.t_s, part.t_s[-1] + 1.0 / part.rate_hz).tolist()
    intervals = []
    first = 0
    for mode, records in groupby(modes):
        end = first + len(list(records))
        if not MODES[mode].follows:
            intervals.append(ModeInterval(mode, times_s[first], times_s[end]))
        first = end
    return intervals


class RaisedAlarm(NamedTuple):
    """An alarm of a site under the rule `glide`: the site held, was stopped, or was in fault.

    Attributes:
        site: name of the site.
        word: name of the alarm.
        reason: reason of the alarm.
        from_s: start of the alarm, in s.
        to_s: end of the alarm, in s.
    """

    site: str
    word: str
    reason: str
    from_s: float
    to_s: float

    def __str__(self) -> str:
        return f"{self.site} {self.word} {self.from_s:.3f}-{self.to_s:.3f} s: {self.reason}"


def list_alarms(log: Log) -> list[RaisedAlarm]:
    """Returns the alarms of all sites, in order; that of a stop names whoever ordered it."""
    orderers = {
        (entry.site, entry.taken_at_tick): find_requester(entry.sentence)
        for entry in list_changes(log)
    }
    raised = []
    for site in log.sites:
        if log.scenario.sites[site].on_stale.action != "glide":
            continue
        part = log[site]
        for mode, from_s, to_s in find_mode_intervals(part):
            state = part.states[int(np.searchsorted(part.t_s, from_s))]
            alarm = find_alarm(
                session=log.scenario.name,
                site=site,
                mode=mode,
                mem=state.mem,
                shared=len(state.q_des),
            )
            if alarm is None:
                continue
            orderer = orderers.get((site, state.tick), "")
            reason = f"ordered by {orderer}" if orderer else alarm.reason
            raised.append(RaisedAlarm(site, alarm.word, reason, from_s=from_s, to_s=to_s))
    return sorted(raised, key=lambda alarm: alarm.from_s)

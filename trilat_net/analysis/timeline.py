"""Lists the events of a run over time: commands, network delays, modes of the arms, alarms.

For example, a command may change a delay at 5 s, or stop all arms at 8 s. These times help to
interpret a figure or a verdict. The mode of an arm is what its controller does: follow other
arms, hold its position, brake or return.

Invariant:
    - Every entry comes from the scenario or from a record. No entry is inferred from the motion
      of the arms.
"""

from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import msgspec
import numpy as np

from ..core import HELD_OVERRUN_TICKS, LifeAlarm
from ..errors import count_nouns
from ..log import Log
from ..net import MODES, ModeMeaning
from ..scenario import Change, LinkBase, Scenario


class _AppliedChange(NamedTuple):
    """A change of a setting at one arm during the run, such as a new network delay.

    The scenario planned the change, or a command requested it.

    Attributes:
        change: The change of a link or of dominance factors, or the order to a site, with its
            time.
        site: The site that carried it out.
        taken_at_tick: Tick of the record that names the change. `None` for a change that was
            planned in the scenario.
        sentence: A sentence for users. The sentence names the person or program that ordered
            the change, if known.
    """

    change: Change
    site: str
    taken_at_tick: int | None
    sentence: str

    @property
    def subject(self) -> str:
        """The object that was changed: a link such as "m1->s", a site, or the shares of a site.

        The shares are the dominance factors with which the site follows its peers, for example
        "shares of s".
        """
        return self.change.link or self.change.site or f"shares of {self.change.dominance}"

    @property
    def text(self) -> str:
        """A phrase for the user that describes the state after the change.

        For an order to a site, the phrase consists of the order and its duration, for example
        "hold, 500 ticks". For a link, it describes the new delay. For shares, it lists the new
        shares with the transition time, for example "m1 0.7, m2 0.3 within 2 s".
        """
        change = self.change
        if change.order:
            order = change.order.replace("_", " ")
            return f"{order}, {count_nouns(change.ticks, 'tick')}" if change.ticks else order
        if change.link:
            return change.after.describe()
        shares = ", ".join(f"{peer} {share:g}" for peer, share in change.to.items() if share)
        return f"{shares} within {change.ramp_s:g} s" if change.ramp_s else shares


class _ModeInterval(NamedTuple):
    """Interval of time in which an arm did not follow the other arms.

    Instead, the arm held its position, braked, or returned to following.

    Attributes:
        mode: Name of the mode in which the site was.
        from_s: Time of the first tick in this mode, in s.
        to_s: Time of the first tick after it, or the end of the site's last tick period, in s.
    """

    mode: str
    from_s: float
    to_s: float

    @property
    def meaning(self) -> ModeMeaning:
        """A sentence on what the arm does in this mode, such as holding its position.

        Names of modes such as "hold" are too short for readers to understand.
        """
        return MODES[self.mode]


class _RaisedAlarm(NamedTuple):
    """An interval in which a site raised an alarm: a hold, a stop or a fault of its arm.

    Alarms exist only at sites whose rule for silent peers (`on_stale` of the scenario) is
    "glide". With this rule an arm comes to rest smoothly when it no longer hears from its
    peers.

    Attributes:
        site: Name of the site.
        word: Name of the alarm.
        reason: The reason for which the alarm was raised.
        from_s: Start of the alarm, in s.
        to_s: End of the alarm, in s.
    """

    site: str
    word: str
    reason: str
    from_s: float
    to_s: float

    def __str__(self) -> str:
        """Returns the alarm as a line of text."""
        return f"{self.site} {self.word} {self.from_s:.3f}-{self.to_s:.3f} s: {self.reason}"


class _StatedModel(NamedTuple):
    """Delay model that the scenario, or a change during the run, prescribes for a network link.

    Measured delays are compared with it.

    Attributes:
        from_s: Time from which the model applies, in s after the start of the session. It
            applies to samples sent from this time on.
        link: The model: delay, losses and order of the samples.
    """

    from_s: float
    link: LinkBase


class StatedLink(NamedTuple):
    """Delay models of a network link during a run, as stated by the scenario and its changes.

    Attributes:
        models: The models in chronological order. The first one is in effect at the start, and
            each change adds another.
    """

    models: tuple[_StatedModel, ...]

    @property
    def has_one_constant_delay(self) -> bool:
        """True if the link delays every sample equally and loses none.

        The stability theorem requires constant delays.
        """
        link = self.models[0].link
        is_constant = link.constant_delay_ms is not None
        is_lossless = not (link.loss or link.duplicate or link.outages_s)
        return is_constant and is_lossless and len(self.models) == 1


class Timeline:
    """What happened in a run over time: changes of settings, modes of the arms, and alarms.

    Args:
        log: The log of the run.
    """

    def __init__(self, log: Log) -> None:
        self._log = log

    @cached_property
    def end_s(self) -> float:
        """End of the last recorded tick period, in s.

        If there are no records, the planned end of the run.
        """
        site_logs = [self._log[site] for site in self._log.sites]
        recorded_logs = [site_log for site_log in site_logs if len(site_log)]
        ends_s = [
            float(site_log.t_s[-1]) + 1.0 / site_log.rate_hz for site_log in recorded_logs
        ]
        return max(ends_s, default=self._log.scenario.duration_s)

    @cached_property
    def changes(self) -> list[_AppliedChange]:
        """All changes before the end of the run, in the order in which they took effect.

        The records also list ticks that a site had to skip. Skipped ticks are included only if
        the site skipped so many that it held its position.

        Raises:
            LogError: A recorded change is invalid.
        """
        log = self._log
        applied_changes = [
            _AppliedChange(change, change.owner, None, change.describe())
            for change in log.scenario.timeline
        ]

        change_events = {
            (event.member, event.command): event
            for event in log.events
            if event.kind == "change"
        }

        for site in log.sites:
            # This call raises if a record names a change that is not valid for the site.
            log.commands(site)
            for tick, texts in log.changes(site).items():
                for text in texts:
                    change = msgspec.json.decode(text, type=Change)
                    event = change_events.get((site, text))
                    if event is None:
                        sentence = change.describe()
                    else:
                        sentence = Change.describe_event(event.kind, event.text, event.command)
                    applied_changes.append(_AppliedChange(change, site, tick, sentence))

        visible_entries = []
        for entry in applied_changes:
            is_short_skip = 0 < entry.change.ticks <= HELD_OVERRUN_TICKS
            if entry.change.at_s < self.end_s and not is_short_skip:
                visible_entries.append(entry)
        return sorted(visible_entries, key=lambda entry: entry.change.at_s)

    @cached_property
    def effective_commands(self) -> list[Change]:
        """The commands that changed something, ordered by the time at which they take effect.

        A command that leaves a link, or the dominance factors of a site, unchanged is left out.
        Orders to sites, such as "stop", are always included.

        Raises:
            LogError: A recorded change is invalid.
        """
        scenario = self._log.scenario
        commands = []
        for site in self._log.sites:
            self._log.commands(site)  # raises LogError if a change is not valid
            for texts in self._log.changes(site).values():
                commands += [msgspec.json.decode(text, type=Change) for text in texts]

        # links and factors hold the values in force while the changes are replayed in order
        links: dict[str, LinkBase] = dict(scenario.links)
        factors = dict(scenario.dominance)
        effective_commands = []

        planned = [(change, False) for change in scenario.timeline]
        requested = [(change, True) for change in commands]
        changes = sorted([*planned, *requested], key=lambda entry: entry[0].at_s)
        for change, is_command in changes:
            has_effect = True
            if change.link:
                has_effect = links[change.link] != change.after
                links[change.link] = change.after
            elif change.dominance:
                has_effect = factors[change.dominance] != change.to
                factors[change.dominance] = change.to
            if is_command and has_effect:
                effective_commands.append(change)
        return effective_commands

    @property
    def final_scenario(self) -> Scenario:
        """The scenario of the log, in which the commands that users gave are planned changes.

        Its duration is the recorded duration. The settings in effect at its end are therefore
        those of the final control loop.
        """
        scenario = self._log.scenario
        commands = [change for change in self.effective_commands if not change.order]
        timeline = sorted([*scenario.timeline, *commands], key=lambda change: change.at_s)
        return msgspec.structs.replace(
            scenario, timeline=tuple(timeline), duration_s=self.end_s
        )

    @cached_property
    def stated_links(self) -> dict[str, StatedLink]:
        """The delay models of every network link of the scenario, keyed by the name "j->i".

        Raises:
            LogError: A recorded change is invalid.
        """
        stated_links = {}
        for name, link in self._log.scenario.links.items():
            later_models = [
                _StatedModel(entry.change.at_s, entry.change.after)
                for entry in self.changes
                if entry.change.link == name
            ]
            stated_links[name] = StatedLink((_StatedModel(0.0, link), *later_models))
        return stated_links

    def find_mode_intervals(self, site: str) -> list[_ModeInterval]:
        """Finds the time intervals in which an arm did not follow the other arms.

        In these intervals the site held its position, slowed down to a stop, or moved back to
        its reference.

        Args:
            site: Name of the site.

        Returns:
            The intervals in chronological order. Empty if the arm followed the others
            throughout.
        """
        site_log = self._log[site]
        modes: list[str] = site_log.mode.tolist()
        if all(MODES[mode].follows for mode in set(modes)):
            return []

        times_s = np.append(site_log.t_s, site_log.t_s[-1] + 1.0 / site_log.rate_hz).tolist()
        intervals = []
        first = 0
        for mode, records in groupby(modes):
            end = first + len(list(records))
            if not MODES[mode].follows:
                intervals.append(_ModeInterval(mode, times_s[first], times_s[end]))
            first = end
        return intervals

    @cached_property
    def alarms(self) -> list[_RaisedAlarm]:
        """The alarms of all arms, ordered by their start.

        If a person ordered an arm to stop, the reason for the alarm names this person.

        Raises:
            LogError: A recorded change is invalid.
        """
        log = self._log
        requesters = {
            (entry.site, entry.taken_at_tick): Change.find_requester(entry.sentence)
            for entry in self.changes
        }

        alarms_raised = []
        for site in log.sites:
            if log.scenario.sites[site].on_stale.action != "glide":
                continue
            site_log = log[site]
            for mode, from_s, to_s in self.find_mode_intervals(site):
                state = site_log.states[int(np.searchsorted(site_log.t_s, from_s))]
                alarm = LifeAlarm.find(
                    session=log.scenario.name,
                    site=site,
                    mode=mode,
                    mem=state.mem,
                    shared=len(state.q_des),
                )
                if alarm is None:
                    continue
                requester = requesters.get((site, state.tick), "")
                reason = f"ordered by {requester}" if requester else alarm.reason
                alarms_raised.append(
                    _RaisedAlarm(site, alarm.word, reason, from_s=from_s, to_s=to_s)
                )
        return sorted(alarms_raised, key=lambda alarm: alarm.from_s)

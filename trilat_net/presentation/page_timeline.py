"""Renders the section of a report that lists the events of the run, in chronological order.

For example, a command changed the network delay at 5 s, or an operator pushed an arm at 7 s.
The section also lists alarms and the mode changes of each arm, such as holding its position,
braking or returning.

Invariant:
    - Every sentence is based on the scenario or on a record.
    - Changes have the same numbers as their marks in the charts.
    - Moments beyond `MAX_SHOWN` are collapsed, and moments beyond `_MAX_MOMENTS` are omitted.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ..analysis import Bools, JointError, Timeline
from ..core import Array
from ..errors import count_nouns, join_words
from ..log import Log
from ..results import JsonObject
from ..scenario import Scenario
from .html_templates import render_macro
from .page_html import render_details, render_section
from .plot_signals import shared_unit, sites_with_operator
from .style import typeset

MAX_SHOWN = 5
"""Maximum number of moments that are not collapsed."""
_MAX_MOMENTS = 400
"""Maximum number of moments on the page. summary.json has all modes and changes."""
_MAX_PUSHES = 3
"""Maximum number of pushes of a site described in separate sentences. If there are more, they
share a sentence.
"""
_PAUSE_S = 0.2
"""Minimum pause that separates two pushes, in s."""
_LEAST_PUSH_NM = 1e-3
"""Minimum torque for an arm to count as pushed, in N m."""
_DID = {
    "hold": "held still",
    "brake": "braked",
    "return": "returned to following",
    "waiting": "waited for the other sites",
    "fault": "stood still with a fault",
    "stopped": "stood by order",
}
"""Clause that describes the behaviour of a site in each mode. Other modes are described by
their names in the records.
"""


class _RunMoment(NamedTuple):
    """An event at a certain time in a run, such as a changed delay or an alarm.

    Attributes:
        t_s: Time at which the event happened or began, in s.
        sentence: Sentence about the event.
        site: Name of the site affected. Empty if the event affects all sites.
        number: Number of the change, as shown in charts. `None` for other events.
        is_bad: True for alarms and divergence.
    """

    t_s: float
    sentence: str
    site: str = ""
    number: int | None = None
    is_bad: bool = False


def render_timeline(log: Log, facts: JsonObject) -> Markup:
    """Renders the section with the events of the run, in chronological order.

    Examples are a changed delay, a push by an operator, and an arm that stopped because the
    network was interrupted.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
    """
    moments = list_moments(log, facts)
    body = _render_moments(log, moments[:MAX_SHOWN])
    folded_moments = moments[MAX_SHOWN:_MAX_MOMENTS]
    if folded_moments:
        summary = f"{count_nouns(len(moments) - MAX_SHOWN, 'more moment')}"
        body += render_details(summary, _render_moments(log, folded_moments))

    intro = "What was done to the arms, and how they reacted."
    if facts["changes"]:
        intro += " Charts mark changes by number."
    return render_section("What happened", intro, body, "moments")


def _render_moments(log: Log, moments: list[_RunMoment]) -> Markup:
    """Renders moments as a list, each with its time, number and sentence."""
    rows = []
    for moment in moments:
        row = moment._asdict()
        row["sentence"] = typeset(moment.sentence)
        row["index"] = log.sites.index(moment.site) if moment.site in log.sites else None
        rows.append(row)
    return render_macro("timeline.html", "moments", moments=rows)


def list_moments(log: Log, facts: JsonObject) -> list[_RunMoment]:
    """Lists the events of a run in chronological order: changes, pushes, modes and errors.

    The list lets readers of the page relate the curves to the events.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
    """
    moments = [
        _RunMoment(0.0, f"The run starts; {describe_dominance(log.scenario)}."),
        *_list_changes(log, facts),
        *_list_pushes(log),
        *_list_modes(log),
        *_list_hands(log),
        *_list_errors(log, facts),
        _RunMoment(Timeline(log).end_s, "The record ends."),
    ]
    return sorted(moments, key=lambda moment: moment.t_s)


def describe_dominance(scenario: Scenario) -> str:
    """Returns which peers each site follows initially, as in "m1 follows s 0.7, m2 0.3".

    The numbers are the dominance factors. Peers with a factor of 0 are omitted.

    Args:
        scenario: Scenario of the run.
    """
    clauses = []
    for site, factors in scenario.dominance.items():
        followed_peers = [f"{peer} {factor:g}" for peer, factor in factors.items() if factor]
        clauses.append(f"{site} follows {', '.join(followed_peers) or 'no other site'}")
    return "; ".join(clauses)


def _list_hands(log: Log) -> Iterator[_RunMoment]:
    """Yields the moments at which people and programs took over or released arms, or failed."""
    failures = log.failed_hands
    for event in log.events:
        if event.kind == "hand":
            yield _RunMoment(
                max(event.t_ns, 0) * 1e-9,
                f"{event.text}.",
                event.member,
                is_bad=event.text in failures,
            )


def _list_changes(log: Log, facts: JsonObject) -> Iterator[_RunMoment]:
    """Yields the setting changes during a run, such as a new delay, for the timeline.

    Charts mark the changes with the same numbers.

    Args:
        log: Log of the run.
        facts: Key figures of the run, from `summarise_run`.
    """
    for number, change in enumerate(facts["changes"], 1):
        tick = change["taken_at_tick"]
        # Changes of the scenario have a time only. Commands are applied at a tick.
        origin = "scenario"
        if tick is not None:
            origin = f"command, applied at tick {tick} of {change['site']}"

        sentence = change["sentence"]
        subject = sentence.partition(" ")[0]
        # The name of a site keeps its letters, also at the beginning of a sentence.
        if subject not in log.sites:
            sentence = f"{sentence[:1].upper()}{sentence[1:]}"
        text = f"{sentence} ({origin})."
        yield _RunMoment(change["at_s"], text, change["site"], number)


def _list_pushes(log: Log) -> Iterator[_RunMoment]:
    """Yields the moments at which operators, walls or bodies pushed an arm, with the torque.

    Short pauses do not separate pushes. If an arm was pushed very often, a single moment states
    the number of pushes.
    """
    for site in sites_with_operator(log):
        records = log[site]
        torques = np.abs(records.tau_x).max(axis=1, initial=0.0)
        is_pushed = torques > _LEAST_PUSH_NM
        pushes = _find_spans(records.t_s, is_pushed)
        if not pushes:
            continue

        subject = _name_pusher(log, site)
        torque_text = f"with at most {torques.max():.3g} N m"
        first_s = pushes[0][0]
        last_s = pushes[-1][1]
        if len(pushes) > _MAX_PUSHES:
            times = f"{len(pushes)} times until {last_s:.3f} s"
            yield _RunMoment(first_s, f"{subject} pushes {site} {times}, {torque_text}.", site)
            continue

        for start_s, end_s in pushes:
            inside = (records.t_s >= start_s) & (records.t_s <= end_s)
            torque_text = f"with at most {torques[inside].max():.3g} N m"
            end_text = "to the end" if end_s >= records.t_s[-1] else f"until {end_s:.3f} s"
            text = f"{subject} pushes {site} {end_text}, {torque_text}."
            yield _RunMoment(start_s, text, site)


def _find_spans(t_s: Array, acts: Bools) -> list[tuple[float, float]]:
    """Returns the time intervals in which a condition holds, as start and end in s.

    The condition could be, for example, that an operator pushes. Interruptions shorter than
    `_PAUSE_S` do not split an interval.

    Args:
        t_s: Times of K records, shape (K,).
        acts: True for records at which the condition holds, shape (K,).
    """
    times_s = t_s[acts]
    if not len(times_s):
        return []

    # An interval ends at the last time before a pause, and the next one begins after the pause.
    last_before_pause = np.flatnonzero(np.diff(times_s) > _PAUSE_S)
    starts_s = times_s[np.append(0, last_before_pause + 1)]
    ends_s = times_s[np.append(last_before_pause, len(times_s) - 1)]
    return list(zip(starts_s.tolist(), ends_s.tolist(), strict=True))


def _name_pusher(log: Log, site: str) -> str:
    """Returns a phrase for the possible sources of pushes, such as "An operator"."""
    spec = log.scenario.sites[site]
    if spec.hands and spec.environment:
        return "An operator or a wall"
    if spec.environment:
        return "A wall"
    return "An operator" if spec.hands else "Something"


def _list_modes(log: Log) -> Iterator[_RunMoment]:
    """Yields the moments at which an arm stopped following in order to hold, brake or return.

    If there was an alarm, the sentence states the reason. Arms that did the same at the same
    time share a sentence.
    """
    timeline = Timeline(log)
    alarms_by_start = {(alarm.site, alarm.from_s): alarm for alarm in timeline.alarms}
    sites_by_moment: dict[tuple[float, str], list[str]] = {}
    alarming_moments = set()
    for site in log.sites:
        for mode, from_s, to_s in timeline.find_mode_intervals(site):
            alarm = alarms_by_start.get((site, from_s))
            reason = "" if alarm is None else f" ({alarm.word}: {alarm.reason})"
            end_text = "to the end" if to_s >= timeline.end_s else f"until {to_s:.3f} s"
            text = f"{_DID.get(mode, mode)} {end_text}{reason}"

            moment = (from_s, text)
            sites_by_moment.setdefault(moment, []).append(site)
            if alarm is not None:
                alarming_moments.add(moment)

    for moment, site_names in sites_by_moment.items():
        from_s, text = moment
        site = site_names[0] if len(site_names) == 1 else ""
        sentence = f"{join_words(site_names)} {text}."
        yield _RunMoment(from_s, sentence, site, is_bad=moment in alarming_moments)


def _list_errors(log: Log, facts: JsonObject) -> Iterator[_RunMoment]:
    """Yields the moments at which the tracking error peaked, became small, or diverged.

    The tracking error is the difference between the actual and the desired joint angles.
    """
    unit = shared_unit(log)
    peak = JointError.find_largest_of_all(log)
    if peak is not None and peak.value > 0.0:
        joint = peak.joint.removeprefix(f"{peak.site} ")
        text = (
            f"{peak.site} has the largest error of the run, {peak.value:.3g} {unit} at {joint}."
        )
        yield _RunMoment(peak.t_s, text, peak.site)

    if facts["settle_s"]:
        limit = f"{facts['settle_below_rad']:g} {unit}"
        yield _RunMoment(facts["settle_s"], f"From here on, every |e| stays below {limit}.")

    for name, site in facts["sites"].items():
        diverged_s = site["diverged_at_s"]
        if diverged_s is not None:
            text = f"{name} diverged: {log.describe_divergence(name)}."
            yield _RunMoment(diverged_s, text, name, is_bad=True)

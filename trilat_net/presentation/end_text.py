"""Describes the motion at the end of a run in sentences for users.

`analysis.run_end` judges the motion and returns names and numbers. This module turns them into
sentences, for example "converged: largest |e| 0.001 rad and |qd| 0.0002 rad/s in the last
second".

Invariant:
    - Each kind of doubt has exactly one template in `END_DOUBTS`.
"""

from collections.abc import Callable, Iterable
from typing import Any

from ..analysis import SETTLED_ERROR_RAD, EndBehaviour, EnvelopeTrend, RunEnd

_LASTING_ERRORS = "at rest, with remaining errors"
"""Phrase for arms that are slow but whose errors exceed the limit for settled sites."""
END_DOUBTS = {
    "sites apart": (
        "{sites[0]} and {sites[1]} stand {distance_rad:.3g} rad apart, and nothing holds them "
        "there"
    ),
    "arms fell": "{names} {hang}: the arms fell",
    "arm thrown": (
        "{names} ends {distance_rad:.3g} rad away from every start pose, although no operator "
        "pushed"
    ),
    "loop changes": "the loop changes until {until_s:.4g} s, within the judged part",
    "operator acts": "an operator acts until {until_s:.4g} s, within the judged part",
}
"""For each kind of doubt, the template of its sentence."""
_TRENDS = {
    EnvelopeTrend.DECAYS: "decays",
    EnvelopeTrend.HARDLY: "hardly decays",
    EnvelopeTrend.STEADY: "steady",
    EnvelopeTrend.GROWS: "grows",
    EnvelopeTrend.UNDECIDED: "shows no trend",
}


def _describe_end(end: RunEnd) -> str:
    """Returns a sentence on how the motion of a run ends, with the supporting numbers.

    The sentence also states the reasons why the run cannot be called stable.
    """
    return "; ".join([_describe_behaviour(end), *_list_doubts(end)])


def _list_doubts(end: RunEnd) -> list[str]:
    """Returns a sentence for each doubt about the end of a run. Empty if there are none."""
    sentences = []
    for doubt in end.doubts:
        sentence = END_DOUBTS[doubt.name].format(
            names=", ".join(doubt.sites),
            hang="hangs" if len(doubt.sites) == 1 else "hang",
            **doubt._asdict(),
        )
        sentences.append(sentence)
    return sentences


def name_behaviour(end: RunEnd) -> str:
    """Returns a phrase for the behaviour at the end of a run, such as "converged" or "growing".

    If the arms are at rest but synchronisation errors exceed the limit for settled sites, the
    phrase says that errors remain.

    Args:
        end: The motion at the end of the run.
    """
    has_converged = end.behaviour is EndBehaviour.CONVERGED
    if has_converged and end.end_error_rad > SETTLED_ERROR_RAD:
        return _LASTING_ERRORS
    if end.missing_sites and end.behaviour is EndBehaviour.UNDECIDED:
        return "undecided"  # a longer record of the other sites would not help
    return end.behaviour.value


def _describe_behaviour(end: RunEnd) -> str:
    """Returns a sentence on how a run ends, with the supporting numbers."""
    behaviour = end.behaviour
    if end.diverged_at_s is not None:
        unnamed = f"a joint passed its qd_limit_rad_s at {end.diverged_at_s:.4g} s"
        return f"diverged: {end.divergence or unnamed}"
    if end.missing_sites:
        return f"undecided: no record of {', '.join(end.missing_sites)}"

    end_error = f"|e| {end.end_error_rad:.3g} {end.error_unit}"
    end_speed = f"|qd| {end.end_speed_rad_s:.3g} rad/s"
    if end.end_error_where:
        end_error += f" of {end.end_error_where}"
    if end.end_speed_where:
        end_speed += f" of {end.end_speed_where}"
    part = "in the last second" if end.lasts_s >= 1.0 else "in the whole record"
    numbers = f"largest {end_error} and {end_speed} {part}"
    if behaviour is EndBehaviour.CONVERGED:
        return f"{name_behaviour(end)}: {numbers}"

    joint = f" at {end.where}" if end.where else ""
    if behaviour is EndBehaviour.BOUNDED:
        motion = "bounded motion"
        if end.frequency_hz is not None:
            motion = f"bounded oscillation at {end.frequency_hz:.3g} Hz"
        return f"{motion}{joint}: {numbers}"
    if behaviour is EndBehaviour.UNDECIDED:
        trends = f"|e| {_TRENDS[end.error.trend]}, |qd| {_TRENDS[end.speed.trend]}"
        return f"undecided, record longer{joint}: {trends}; {numbers}"
    error_rate = _format_rate(end.error.trend, end.error.rate_per_s)
    speed_rate = _format_rate(end.speed.trend, end.speed.rate_per_s)
    return f"{behaviour.value}{joint} (|e| {error_rate}, |qd| {speed_rate}): {numbers}"


def _format_rate(trend: EnvelopeTrend, rate_per_s: float) -> str:
    """Returns the rate at which an amplitude grows or decays, such as "+0.12/s".

    For an amplitude without a clear rate, this is a phrase such as "steady".
    """
    if trend in (EnvelopeTrend.STEADY, EnvelopeTrend.UNDECIDED):
        return _TRENDS[trend]
    return f"{rate_per_s:+.3g}/s"


DESCRIBERS: dict[type, Callable[[Any], str]] = {RunEnd: _describe_end}
"""Functions that describe findings, keyed by the class of the finding."""
SENTENCE_LISTERS: dict[type, Callable[[Any], Iterable[str]]] = {RunEnd: _list_doubts}
"""Functions that list the sentences of a finding, keyed by the class of the finding."""

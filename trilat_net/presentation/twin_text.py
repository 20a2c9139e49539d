"""Describes repetitions of a run with small pushes (twins) in sentences for users.

`analysis.twins` measures whether the effects of the pushes grow, and returns names and numbers.
This module writes, for example, that every push dies away, and which one does so most slowly.
"""

import math
from collections.abc import Callable
from typing import Any

from ..analysis import EnvelopeTrend, PushedTwins, PushGrowth, TwinGrowth
from ..errors import count_nouns

_FALLING = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)


def _describe_growth(growth: TwinGrowth) -> str:
    """Returns a sentence that says whether small pushes of a run grow or die away.

    The sentence is about the push that grows most or dies away most slowly, or about a
    departure from a rest position. If there were no pushes, it states the reason.
    """
    worst = growth.worst
    departure = growth.departure
    if worst is None:
        return f"twins: {growth.why}"
    if departure is not None:
        span = f"from {departure.from_s:.4g} to {departure.to_s:.4g} s"
        rate = f"{departure.rate_per_s:+.3g} /s at {departure.joint}"
        return (
            f"twins: {span} the run and its twins left a position of rest by themselves, {rate}"
        )
    if worst.factor == 0.0:
        return "twins: every push died down to the rounding errors"
    if math.isnan(worst.rate_per_s):
        return "twins: the run is too short to tell"

    name = worst.push.name
    span = f"in {growth.to_s - growth.from_s:.4g} s ({worst.rate_per_s:+.3g} /s)"
    if growth.trend in _FALLING:
        slowest = f"{name}, to {worst.factor:.3g} of its size {span}"
        return f"twins: every push dies away; the slowest, {slowest}{_describe_misses(growth)}"

    change = f"x {worst.factor:.3g} {span}, most at {worst.joint}"
    if growth.trend is EnvelopeTrend.GROWS:
        return f"twins: a push of {name} grows {change}"
    text = f"twins: a push of {name} shows no clear trend: it changes {change}"
    if growth.needs_s is not None:
        text += f"; a run of {growth.needs_s:.3g} s would be long enough to tell"
    return text


def _describe_misses(growth: TwinGrowth) -> str:
    """Returns a clause on the probability that random pushes fail to reveal an unstable run."""
    miss = growth.miss_chance
    if miss is None:
        return ""
    return (
        f"; {count_nouns(miss.directions, 'random direction')} of all joints miss a mode "
        f"that grows {miss.growth:g} times with a probability of {miss.probability:.0e}"
    )


def describe_push(twins: PushedTwins, pushed: PushGrowth) -> str:
    """Returns a sentence that says whether the effect of a push grows or dies away.

    Args:
        twins: The run and its twins.
        pushed: The push and its effect.
    """
    rate = "" if math.isnan(pushed.rate_per_s) else f" ({pushed.rate_per_s:+.3g} /s)"
    push = f"a push of {pushed.push.name} at {twins.at_s:.4g} s"
    to_s = twins.growth.to_s
    if pushed.ended_s is not None:
        outcome = "makes the run diverge"
        if pushed.trend is EnvelopeTrend.DECAYS:
            outcome = "dies down to the rounding errors"
        return f"{push} {outcome} in {pushed.ended_s - twins.at_s:.3g} s{rate}"
    if pushed.trend is EnvelopeTrend.GROWS:
        growth = f"grows x {pushed.factor:.3g} in {to_s - twins.growth.from_s:.4g} s"
        return f"{push} {growth}{rate}, most at {pushed.joint}"
    outcome = f"becomes {pushed.becomes_rad_s:.3g} rad/s in {to_s - twins.at_s:.4g} s{rate}"
    text = f"{push} {outcome}, most at {pushed.joint}"
    return text if pushed.trend in _FALLING else f"{text}; it shows no clear trend"


def _describe_worst_push(twins: PushedTwins) -> str:
    """Returns a sentence on the worst push, which grows most or dies away most slowly.

    If the user requested pushes of several sizes, the sentence instead says for which sizes the
    effect is proportional to the size.
    """
    if twins.linear is not None:
        return _describe_linear_sizes(twins)
    worst = twins.growth.worst
    return describe_push(twins, worst) if worst else twins.growth.text


def _describe_linear_sizes(twins: PushedTwins) -> str:
    """Returns a sentence on the sizes up to which the effect of a push is proportional to it.

    The sentence also describes the effect of the next larger push.
    """
    sizes = twins.linear
    assert sizes is not None
    text = f"not linear, from {sizes.largest:g} {sizes.unit} on"
    if sizes.largest > sizes.smallest:
        text = f"linear from {sizes.smallest:g} to {sizes.largest:g} {sizes.unit}"
    beyond = sizes.beyond
    if beyond is None:
        return text
    outcome = "saturates" if beyond.saturates else "develops differently"
    if beyond.has_wall:
        outcome += " (there is a wall)"
    ratio = f"x {beyond.ratio:.3g} of that at {beyond.at_s:.4g} s"
    return f"{text}; a push of {beyond.size:g} {outcome}: {ratio}"


DESCRIBERS: dict[type, Callable[[Any], str]] = {
    TwinGrowth: _describe_growth,
    PushedTwins: _describe_worst_push,
}
"""Functions that describe findings, keyed by the class of the finding."""

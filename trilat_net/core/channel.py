"""The network's effect on each sample of a directed link: its due time, or its loss.

Invariant (L4): the delivery of sample m is a function of the link's key, m, and the model in
force at its stamp. All memory (bursts of loss, correlated delay, order) advances sample by
sample, by index, in whatever order samples arrive.
"""

from .delay import (
    COPY,
    DELAY,
    DUPLICATE,
    LOSS,
    DelayKind,
    clamp_delay_us,
    custom_delay_us,
    draw_delay_us,
    next_ar1_value,
    sine_delay_us,
    trace_delay_us,
)
from .jit import leaf
from .philox import DrawKey, uniforms
from .ticks import tick_ns
from .vectors import IntArray, Points, Row

LOST = -1
"""Stands for the time of a sample that is lost."""

_AR1 = int(DelayKind.AR1)
_SINE = int(DelayKind.SINE)
_TRACE = int(DelayKind.TRACE)
_MEASURED = int(DelayKind.MEASURED)
_OWN = int(DelayKind.CUSTOM)


@leaf
def _in_outage(stamp_ns: int, link: Row, points: Points) -> bool:
    """True if a stamp lies in an outage of the link, which includes its beginning and not its
    end.
    """
    for n in range(link.outage_first, link.outage_first + link.outage_count):
        if points[n, 0] <= stamp_ns < points[n, 1]:
            return True
    return False


@leaf
def _draw_loss(sample: int, fresh: bool, link: Row, model: Row) -> bool:
    """Advances the two-state chain of losses (Gilbert, Elliott) by one sample; True if that is
    lost.

    A fresh chain begins in its stationary distribution.
    """
    if model.loss_good == 0.0 and model.enter == 0.0:
        return False
    key: DrawKey = link.key
    u, v = uniforms(key, sample, LOSS, 0)
    if fresh:
        link.bad = u * (model.enter + model.leave) < model.enter
    elif link.bad:
        link.bad = u >= model.leave
    else:
        link.bad = u < model.enter
    probability: float = model.loss_bad if link.bad else model.loss_good
    return v < probability


@leaf
def _delay_us(
    sample: int, stamp_ns: int, fresh: bool, link: Row, model: Row, points: Points
) -> int:
    """Returns the delay of a sample, us, or LOST by its trace."""
    key: DrawKey = link.key
    if model.kind == _MEASURED:
        return 0
    if model.kind == _TRACE:
        return trace_delay_us(stamp_ns, model, points)
    if model.kind == _SINE:
        return clamp_delay_us(sine_delay_us(stamp_ns, model))
    if model.kind == _AR1:
        link.memory = next_ar1_value(
            key=key, sample=sample, correlation=model.weight, before=link.memory, fresh=fresh
        )
        return clamp_delay_us(model.location + model.scale * link.memory)
    if model.kind == _OWN:
        return clamp_delay_us(
            custom_delay_us(
                key=key, sample=sample, stamp_ns=stamp_ns, model=model, points=points
            )
        )
    return clamp_delay_us(draw_delay_us(key, sample, DELAY, model))


@leaf
def _due_ns(
    sample: int, stamp_ns: int, fresh: bool, link: Row, model: Row, points: Points
) -> int:
    """Returns when a sample is due, ns since the epoch, or LOST."""
    lost = _draw_loss(sample, fresh, link, model)
    delay_us = _delay_us(
        sample=sample, stamp_ns=stamp_ns, fresh=fresh, link=link, model=model, points=points
    )
    if lost or delay_us < 0 or _in_outage(stamp_ns, link, points):
        return LOST
    if model.duplicate > 0.0:
        key: DrawKey = link.key
        u, _ = uniforms(key, sample, DUPLICATE, 0)
        if u < model.duplicate:
            link.copies += 1
            if model.kind < _AR1:  # models with memory or by time give the copy the same delay
                delay_us = min(
                    delay_us, clamp_delay_us(draw_delay_us(key, sample, COPY, model))
                )
    due_ns: int = stamp_ns + max(delay_us, model.playout_us) * 1000
    if model.in_order == 1:
        due_ns = max(due_ns, link.due_before)
    link.due_before = max(due_ns, link.due_before)
    return due_ns


@leaf
def schedule_deliveries(
    sample: int, link: Row, models: Row, dues: IntArray, points: Points
) -> None:
    """Decides when every sample up to one is due, and writes it into `dues`, the oldest ones
    over.

    `link` is a row of LINK_DTYPE; the others are those of `LinkArrays`.
    """
    kept = dues.shape[0]
    while link.scheduled < sample:
        m = link.scheduled + 1
        fresh = m == 0
        stamp_ns = tick_ns(m, link.rate_hz)
        while link.model + 1 < link.models and models[link.model + 1].from_ns <= stamp_ns:
            link.model += 1
            fresh = True
        dues[m % kept] = _due_ns(
            sample=m,
            stamp_ns=stamp_ns,
            fresh=fresh,
            link=link,
            model=models[link.model],
            points=points,
        )
        link.scheduled = m

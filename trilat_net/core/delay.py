"""Delay models of a link, as the core computes them.

Invariant (L4): a delay is a function of the link's key, the sample's index and its stamp,
rounded to whole microseconds. Only AR1 depends on the sample before; it advances by index, not
by arrival.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from .jit import leaf
from .philox import DrawKey, standard_gamma, standard_normal, uniforms
from .plugged import call_address
from .vectors import Points, Row, count_started

MAX_DELAY_US = 10_000_000
"""No delay is longer; the tail of a distribution is cut off here."""


class DelayKind(IntEnum):
    """The kinds of delay, and the meaning of the four parameters of a `LinkModel` in each;
    times in us.

    CONSTANT: location. UNIFORM: location +- scale. NORMAL: mean `location`, deviation `scale`,
    drawn again where it falls below zero. GAMMA: shape `extra`, `scale`. LOG_NORMAL: exp of
    normal (`location`, `scale`).
    HYPER_EXPONENTIAL: `location` + Exp(`scale`), or with probability `weight` + Exp(`extra`).
    AR1: mean `location`, deviation `scale`, correlation `weight` from sample to sample, cut off
    at zero.
    SINE: location + scale sin(2 pi t / extra + weight). TRACE: a table by time. MEASURED: none
    is injected; a sample is used as soon as it has come. CUSTOM: a function of its own, never
    above `location`.
    """

    CONSTANT = 0
    UNIFORM = 1
    NORMAL = 2
    GAMMA = 3
    LOG_NORMAL = 4
    HYPER_EXPONENTIAL = 5
    AR1 = 6
    SINE = 7
    TRACE = 8
    MEASURED = 9
    CUSTOM = 10


class TraceEnd(IntEnum):
    """How a trace goes on after its last point: it holds that, or begins again."""

    HOLD = 0
    LOOP = 1


class LinkModel(NamedTuple):
    """A link's effect on its samples from one stamp on.

    Attributes:
        from_ns: the first stamp that it applies to, ns since the epoch.
        kind: a `DelayKind`, which gives `location`, `scale`, `extra` and `weight` their
            meaning.
        at_end: a `TraceEnd`, of a trace.
        trace_first: where the points of a trace, or the numbers of an own kind, begin in the
            site's table.
        trace_count: how many they are.
        loss_good: probability that a sample is lost in the good state.
        loss_bad: probability that it is lost in the bad state.
        enter: probability to go from good to bad, per sample.
        leave: probability to go from bad to good, per sample.
        duplicate: probability that a sample has a copy, with a delay of its own.
        in_order: 1: no sample is released before an older one; 0: the newest wins.
        playout_us: every sample is held at least so long, us.
        call: the address of an own kind's function, which sees `key`, `sample` and `stamp_ns`,
            and writes `drawn_us`; see `plugged`.
    """

    from_ns: int = 0
    kind: int = DelayKind.CONSTANT
    location: float = 0.0
    scale: float = 0.0
    extra: float = 0.0
    weight: float = 0.0
    at_end: int = TraceEnd.HOLD
    trace_first: int = 0
    trace_count: int = 0
    loss_good: float = 0.0
    loss_bad: float = 0.0
    enter: float = 0.0
    leave: float = 1.0
    duplicate: float = 0.0
    in_order: int = 0
    playout_us: int = 0
    call: int = 0
    key: int = 0
    sample: int = 0
    stamp_ns: int = 0
    drawn_us: float = 0.0


LINK_MODEL_DTYPE = np.dtype(
    (
        np.record,
        [
            (name, "f8" if kind is float else "i8")
            for name, kind in LinkModel.__annotations__.items()
        ],
    )
)


_LARGEST_NORMAL = 8.6
_LARGEST_EXPONENTIAL = 36.8
"""No draw is larger in magnitude: that of Box and Muller, and -log, of 2^-53, see
`unit_interval`.
"""


def _longest_us(model: LinkModel, trace: Points | None) -> float:
    """Returns a delay that no sample exceeds, us, by the least and the largest uniform numbers."""
    location = model.location
    scale = model.scale
    extra = model.extra
    weight = abs(model.weight)
    if model.kind == DelayKind.GAMMA:
        d = extra + (extra < 1.0) - 1.0 / 3.0
        return scale * d * (1.0 + _LARGEST_NORMAL / math.sqrt(9.0 * d)) ** 3
    if model.kind == DelayKind.LOG_NORMAL:
        return math.exp(min(location + _LARGEST_NORMAL * scale, math.log(MAX_DELAY_US)))
    if model.kind == DelayKind.AR1:  # the sum of all draws, each at its largest
        most = math.sqrt((1.0 + weight) / (1.0 - weight)) if weight < 1.0 else math.inf
        return location + _LARGEST_NORMAL * scale * most
    return {
        DelayKind.CONSTANT: location,
        DelayKind.UNIFORM: location + scale,
        DelayKind.NORMAL: location + _LARGEST_NORMAL * scale,
        DelayKind.HYPER_EXPONENTIAL: location + _LARGEST_EXPONENTIAL * max(scale, extra),
        DelayKind.SINE: location + abs(scale),
        DelayKind.TRACE: 0.0 if trace is None else float(np.max(trace[:, 1], initial=0)),
        DelayKind.MEASURED: 0.0,
        DelayKind.CUSTOM: location,
    }[DelayKind(model.kind)]


def max_delay_us(models: Sequence[LinkModel], traces: Sequence[Points | None]) -> int:
    """Returns a delay that no sample of a link exceeds, us, play-out included; traces: per
    model, or None.
    """
    longest = [
        max(math.ceil(min(_longest_us(model, trace), MAX_DELAY_US)) + 1, model.playout_us)
        for model, trace in zip(models, traces, strict=True)
    ]
    return min(MAX_DELAY_US, max(longest))


LOSS = 0
DUPLICATE = 1
DELAY = 2
COPY = 5
"""Purposes of draws; a delay takes up to three, see `standard_gamma`."""

_UNIFORM = int(DelayKind.UNIFORM)
_NORMAL = int(DelayKind.NORMAL)
_GAMMA = int(DelayKind.GAMMA)
_LOG_NORMAL = int(DelayKind.LOG_NORMAL)
_HYPER = int(DelayKind.HYPER_EXPONENTIAL)
_LOOP = int(TraceEnd.LOOP)


@leaf
def draw_delay_us(key: DrawKey, sample: int, purpose: int, model: Row) -> float:
    """Returns a draw of a distribution without memory, us, not rounded; purpose: DELAY, or
    COPY.
    """
    location: float = model.location
    scale: float = model.scale
    extra: float = model.extra
    if model.kind == _UNIFORM:
        u, _ = uniforms(key, sample, purpose, 0)
        return location + scale * (2.0 * u - 1.0)
    if model.kind == _NORMAL:
        # the mean is not negative: each attempt suits with 1/2 or more
        for attempt in range(64):
            x = location + scale * standard_normal(key, sample, purpose, attempt)
            if x >= 0.0:
                return x
    if model.kind == _GAMMA:
        return scale * standard_gamma(key, sample, purpose, extra)
    if model.kind == _LOG_NORMAL:
        return math.exp(location + scale * standard_normal(key, sample, purpose, 0))
    if model.kind == _HYPER:
        u, v = uniforms(key, sample, purpose, 0)
        return location - (extra if u < model.weight else scale) * math.log(v)
    return location


@leaf
def next_ar1_value(
    key: DrawKey, sample: int, correlation: float, before: float, fresh: bool
) -> float:
    """Returns the next number of an AR(1) sequence, standard normal; a fresh one has no number
    before.
    """
    x = standard_normal(key, sample, DELAY, 0)
    if fresh:
        return x
    return correlation * before + math.sqrt(1.0 - correlation * correlation) * x


@leaf
def sine_delay_us(stamp_ns: int, model: Row) -> float:
    """Returns T(t) of a sinusoidal delay, us."""
    location: float = model.location
    scale: float = model.scale
    turns = stamp_ns * 1e-3 / model.extra
    return location + scale * math.sin(2.0 * math.pi * turns + model.weight)


@leaf
def trace_delay_us(stamp_ns: int, model: Row, points: Points) -> int:
    """Returns the delay of a trace, that of its last point at or before the stamp; -1: the
    sample is lost.

    The last point lasts as long as the one before it; after that the trace holds it or begins
    again.
    """
    first = model.trace_first
    count = model.trace_count
    t_us = stamp_ns // 1000
    if model.at_end == _LOOP and count > 1:
        end_us = points[first + count - 1, 0]
        t_us %= 2 * end_us - points[first + count - 2, 0]
    before = count_started(points, first, count, t_us) - 1
    delay_us: int = points[first + max(before, 0), 1]
    return delay_us


@leaf
def draw_pair(now: Row, index: int, attempt: int) -> tuple[float, float]:
    """Returns two uniform numbers for an own kind, a function of the link's key, an index and
    an attempt.
    """
    return uniforms(np.uint64(now.key), index, DELAY, attempt)


@leaf
def custom_delay_us(
    key: DrawKey, sample: int, stamp_ns: int, model: Row, points: Points
) -> float:
    """Returns the delay of an own kind, us, not rounded; its numbers stand in the table, two a
    row.
    """
    model.key = np.int64(key)
    model.sample = sample
    model.stamp_ns = stamp_ns
    first = model.trace_first
    count = model.trace_count
    call_address(
        model.call, (points[first : first + count].reshape(-1).view(np.float64), model)
    )
    drawn_us: float = min(model.drawn_us, model.location)
    return drawn_us


@leaf
def clamp_delay_us(delay_us: float) -> int:
    """Returns a delay in whole microseconds, from 0 to `MAX_DELAY_US`."""
    return int(min(max(math.floor(delay_us + 0.5), 0.0), float(MAX_DELAY_US)))

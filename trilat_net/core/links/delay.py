"""Computes the delay of each message in a simulated network.

A delay model is a distribution of delays, a function of time, or a recorded trace. The messages
are samples. The index of a sample is the number of the sender's control period, and its stamp
is the time at which it was sent.

Invariant (law L4 of docs/develop/design.md):
    - A delay depends only on the seed of the link and on the index and stamp of the sample, so
      a run can be repeated exactly. Delays are rounded to whole microseconds.
    - The only exception is the model AR1, whose correlated delays also depend on the previous
      sample. It processes samples in the order in which they were sent, not in order of
      arrival.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..plug.plugged import UserModel, call_address
from ..step.jit import leaf
from ..step.row_fields import LinkRow
from ..step.vectors import Points, Row, count_started
from .philox import DrawKey, standard_gamma, standard_normal, uniforms

MAX_DELAY_US = 10_000_000
"""Largest delay. Longer delays drawn from a distribution are clipped to this value."""


class DelayKind(IntEnum):
    """Types of delay, which determine the meaning of the four parameters of a `LinkModel`.

    Times are in us.

    - CONSTANT: location.
    - UNIFORM: from location - scale to location + scale.
    - NORMAL: mean `location`, standard deviation `scale`; negative draws are repeated.
    - GAMMA: shape `extra`, scale `scale`.
    - LOG_NORMAL: exponential of a normal variable with mean `location` and standard deviation
      `scale`.
    - HYPER_EXPONENTIAL: `location` plus an exponentially distributed variable. Its mean is
      `extra` with probability `weight`, and `scale` otherwise.
    - AR1: mean `location`, standard deviation `scale`, correlation `weight` between successive
      samples; clipped at zero.
    - SINE: location + scale sin(2 pi t / extra + weight).
    - TRACE: a table of delays over time.
    - MEASURED: no delay is injected; a sample is used as soon as it arrives.
    - CUSTOM: computed by a user's compiled function; at most `location`.
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


_DETERMINISTIC_KINDS = (
    DelayKind.CONSTANT,
    DelayKind.SINE,
    DelayKind.TRACE,
    DelayKind.MEASURED,
)
"""Delay kinds that are not random."""


class _TraceEnd(IntEnum):
    """How a recorded delay trace continues after its last entry.

    It either holds the last delay or starts again from the first.
    """

    HOLD = 0
    LOOP = 1


class LinkModel(NamedTuple):
    """Model of a network link: how long it delays messages, and how many it loses.

    It applies to messages sent at or after a given time, until the next model takes effect. The
    sending time of a message is called its stamp.

    Attributes:
        from_ns: First stamp to which the model applies, ns since the start of the session.
        kind: A `DelayKind`, which defines `location`, `scale`, `extra` and `weight`.
        at_end: A `_TraceEnd`, for a trace.
        trace_first: First row in the site's table that holds the points of a trace, or the data
            of a CUSTOM model.
        trace_count: Number of these rows.
        loss_good: Probability of losing a sample in the good state.
        loss_bad: Probability of losing a sample in the bad state.
        enter: Probability per sample of changing from good to bad.
        leave: Probability per sample of changing from bad to good.
        duplicate: Probability that a sample is duplicated, with a different delay.
        in_order: 1: no sample is released before an older one; 0: the newest sample is used.
        playout_us: Minimum delay of each sample, us (play-out buffer).
        call: Address of the function of a CUSTOM model, see `plugged`.
        key: Input of that function: key of the link.
        sample: Input: index of the sample.
        stamp_ns: Input: stamp of the sample, ns since the start of the session.
        drawn_us: Output: the delay, us.
    """

    from_ns: int = 0
    kind: int = DelayKind.CONSTANT
    location: float = 0.0
    scale: float = 0.0
    extra: float = 0.0
    weight: float = 0.0
    at_end: int = _TraceEnd.HOLD
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

    @classmethod
    def constant(cls, delay_us: float) -> "LinkModel":
        """Creates a model with the same delay for every sample, us."""
        return cls(kind=DelayKind.CONSTANT, location=delay_us)

    @classmethod
    def uniform(cls, mean_us: float, half_width_us: float) -> "LinkModel":
        """Creates a model with delays drawn uniformly from mean +- half width, us."""
        return cls(kind=DelayKind.UNIFORM, location=mean_us, scale=half_width_us)

    @classmethod
    def normal(cls, mean_us: float, deviation_us: float) -> "LinkModel":
        """Creates a model with normally distributed delays, us; negative draws are repeated."""
        return cls(kind=DelayKind.NORMAL, location=mean_us, scale=deviation_us)

    @classmethod
    def correlated(cls, mean_us: float, deviation_us: float, correlation: float) -> "LinkModel":
        """Creates a model with normally distributed delays that vary slowly.

        Args:
            mean_us: Mean, us, before negative delays are set to zero.
            deviation_us: Standard deviation, us.
            correlation: Correlation between the delays of successive samples.
        """
        return cls(kind=DelayKind.AR1, location=mean_us, scale=deviation_us, weight=correlation)

    @classmethod
    def gamma(cls, shape: float, scale_us: float) -> "LinkModel":
        """Creates a model with gamma-distributed delays; the scale is given in us."""
        return cls(kind=DelayKind.GAMMA, extra=shape, scale=scale_us)

    @classmethod
    def log_normal(cls, mean: float, deviation: float) -> "LinkModel":
        """Creates a model with log-normally distributed delays.

        Args:
            mean: Mean of the logarithm of the delay in us.
            deviation: Standard deviation of that logarithm.
        """
        return cls(kind=DelayKind.LOG_NORMAL, location=mean, scale=deviation)

    @classmethod
    def hyper_exponential(
        cls, floor_us: float, fast_us: float, slow_us: float, slow_share: float
    ) -> "LinkModel":
        """Creates a model whose delays are the sum of a fixed and an exponential part.

        The exponential part has one of two means, chosen at random for each message.

        Args:
            floor_us: Fixed part, us.
            fast_us: Mean of the exponential part of a fast message, us.
            slow_us: Mean of the exponential part of a slow message, us.
            slow_share: Probability that a message is slow.
        """
        return cls(
            kind=DelayKind.HYPER_EXPONENTIAL,
            location=floor_us,
            scale=fast_us,
            extra=slow_us,
            weight=slow_share,
        )

    @classmethod
    def sine(
        cls, mean_us: float, amplitude_us: float, period_us: float, phase_rad: float
    ) -> "LinkModel":
        """Creates a model whose delay varies sinusoidally with the time of sending.

        Args:
            mean_us: Mean, us.
            amplitude_us: Amplitude, us.
            period_us: Period, us.
            phase_rad: Phase at the start of the session, rad.
        """
        return cls(
            kind=DelayKind.SINE,
            location=mean_us,
            scale=amplitude_us,
            extra=period_us,
            weight=phase_rad,
        )

    @classmethod
    def measured(cls) -> "LinkModel":
        """Creates a model that adds no delay to that of the real network."""
        return cls(kind=DelayKind.MEASURED)

    @classmethod
    def custom(cls, longest_us: float) -> "LinkModel":
        """Creates a model whose delays are computed by a compiled function, see `draw_with`.

        Args:
            longest_us: Longest delay, us.
        """
        return cls(kind=DelayKind.CUSTOM, location=longest_us)

    def draw_with(self, model: Any) -> "LinkModel":
        """Returns a copy of this model with delays computed by the method `draw` of a class.

        The method is compiled.

        Args:
            model: An instance of the class. Its fields are the numeric settings of the delay.
        """
        address = UserModel(model).compile_to_address("draw", LINK_MODEL_DTYPE)
        return self._replace(call=address)

    @staticmethod
    def pack_settings(model: Any) -> Points:
        """Returns the numeric settings of a delay model in the form of a recorded trace.

        A link has one integer table, which normally holds a recorded delay trace. The bit
        patterns of the floating-point settings are stored in this table, two per row.

        Args:
            model: The delay model, see `draw_with`.
        """
        numbers = UserModel(model).numbers
        rows = math.ceil(max(len(numbers), 1) / 2)
        return np.resize(numbers, (rows, 2)).view(np.int64)

    @classmethod
    def follow_trace(cls, at_end: str) -> "LinkModel":
        """Creates a model that takes its delays from a recorded trace.

        Args:
            at_end: How the trace continues after its last entry: "hold" or "loop", see
                `_TraceEnd`.
        """
        return cls(kind=DelayKind.TRACE, at_end=_TraceEnd[at_end.upper()])

    @property
    def is_random(self) -> bool:
        """True if delays are drawn at random. Random losses and duplicates do not count."""
        return self.kind not in _DETERMINISTIC_KINDS

    @property
    def is_measured(self) -> bool:
        """True if the only delay is that of the real network."""
        return self.kind == DelayKind.MEASURED

    @property
    def least_us(self) -> float:
        """Shortest time for which a sample is held back, us.

        A random delay may be as short as 0, but the play-out buffer holds each sample until the
        sample has reached a given age.
        """
        is_constant = self.kind == DelayKind.CONSTANT
        return max(self.playout_us, self.location if is_constant else 0.0)


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
"""Largest magnitudes of random numbers.

They occur at the smallest uniform number 2^-53 (see `unit_interval`): sqrt(-2 log 2^-53) with
the Box-Muller method, and -log 2^-53.
"""


def _longest_us(model: LinkModel, trace: Points | None) -> float:
    """Returns the longest delay that a delay model can produce, or an upper bound on it, us.

    The bound is derived from those of the model's random numbers: the largest normal number is
    `_LARGEST_NORMAL`, and the largest exponential number with mean 1 is `_LARGEST_EXPONENTIAL`.
    The limit MAX_DELAY_US is only applied to the log-normal delay, whose exponential might
    overflow.

    Args:
        model: The model. See `DelayKind` for the meaning of `location`, `scale`, `extra` and
            `weight` for each type of delay.
        trace: Points of its trace, as rows of time and delay, see `Points`. None for other
            types.
    """
    location = model.location
    scale = model.scale
    extra = model.extra
    weight = abs(model.weight)
    if model.kind == DelayKind.GAMMA:
        # Marsaglia and Tsang draw d (1 + x / sqrt(9 d))^3 with a normal number x, see
        # `standard_gamma`. They draw a shape below 1 as the shape increased by 1.
        d = extra + (extra < 1.0) - 1.0 / 3.0
        return scale * d * (1.0 + _LARGEST_NORMAL / math.sqrt(9.0 * d)) ** 3

    if model.kind == DelayKind.LOG_NORMAL:
        largest_exponent = math.log(MAX_DELAY_US)
        return math.exp(min(location + _LARGEST_NORMAL * scale, largest_exponent))

    if model.kind == DelayKind.AR1:
        # With the correlation c, a draw made n samples ago has the weight sqrt(1 - c^2) c^n.
        # The sum over all past draws, each at its largest, is sqrt(1 - c^2) / (1 - c).
        gain = math.sqrt((1.0 + weight) / (1.0 - weight)) if weight < 1.0 else math.inf
        return location + _LARGEST_NORMAL * scale * gain

    longest_in_trace_us = 0.0 if trace is None else float(np.max(trace[:, 1], initial=0))
    bounds_us = {
        DelayKind.CONSTANT: location,
        DelayKind.UNIFORM: location + scale,
        DelayKind.NORMAL: location + _LARGEST_NORMAL * scale,
        DelayKind.HYPER_EXPONENTIAL: location + _LARGEST_EXPONENTIAL * max(scale, extra),
        DelayKind.SINE: location + abs(scale),
        DelayKind.TRACE: longest_in_trace_us,
        DelayKind.MEASURED: 0.0,
        DelayKind.CUSTOM: location,
    }
    return bounds_us[DelayKind(model.kind)]


def max_delay_us(models: Sequence[LinkModel], traces: Sequence[Points | None]) -> int:
    """Returns an upper bound on the delay of any message on a link, us.

    The bound determines how much memory the receiver reserves for waiting messages. It includes
    the play-out buffer, a minimum delay that the receiver enforces to reduce jitter.

    Args:
        models: Delay models that apply to the link, one after another.
        traces: For each model, its recorded trace (a table of delays over time). None for a
            model without a trace.

    Returns:
        The bound, us.
    """
    bounds_us = []
    for model, trace in zip(models, traces, strict=True):
        longest_us = min(_longest_us(model, trace), MAX_DELAY_US)
        # Add one, because delays are rounded to whole microseconds.
        rounded_us = math.ceil(longest_us) + 1
        bounds_us.append(max(rounded_us, model.playout_us))
    return min(MAX_DELAY_US, max(bounds_us))


LOSS = 0
DUPLICATE = 1
DELAY = 2
COPY = 5
"""Purposes of random draws.

DELAY and COPY also reserve the two numbers after them, see `standard_gamma`.
"""

_UNIFORM = int(DelayKind.UNIFORM)
_NORMAL = int(DelayKind.NORMAL)
_GAMMA = int(DelayKind.GAMMA)
_LOG_NORMAL = int(DelayKind.LOG_NORMAL)
_HYPER = int(DelayKind.HYPER_EXPONENTIAL)
_LOOP = int(_TraceEnd.LOOP)


@leaf
def draw_delay_us(key: DrawKey, sample: int, purpose: int, model: Row) -> float:
    """Draws a random delay, in us, that does not depend on earlier delays and is not rounded.

    The random numbers are a function of key, sample and purpose, so the same arguments always
    give the same delay. `DelayKind` defines the model parameters `location`, `scale`, `extra`
    and `weight` for each distribution.

    Args:
        key: Key of the link, which determines all its random numbers.
        sample: Index of the sample.
        purpose: Selects independent random numbers: DELAY for the sample, COPY for its
            duplicate.
        model: Delay model, a row of LINK_MODEL_DTYPE.

    Returns:
        The delay. It is the constant `location` for kinds other than UNIFORM, NORMAL, GAMMA,
        LOG_NORMAL and HYPER_EXPONENTIAL.
    """
    location: float = model.location
    scale: float = model.scale
    extra: float = model.extra
    if model.kind == _UNIFORM:
        u, _ = uniforms(key, sample, purpose, 0)
        return location + scale * (2.0 * u - 1.0)
    if model.kind == _NORMAL:
        # The mean is not negative, so each attempt succeeds with a probability of at least 1/2.
        # If all attempts fail, the delay is the mean.
        for attempt in range(64):
            x = location + scale * standard_normal(key, sample, purpose, attempt)
            if x >= 0.0:
                return x
    if model.kind == _GAMMA:
        return scale * standard_gamma(key, sample, purpose, extra)
    if model.kind == _LOG_NORMAL:
        return math.exp(location + scale * standard_normal(key, sample, purpose, 0))
    if model.kind == _HYPER:
        # u selects one of two exponential distributions, and v is the draw from it.
        u, v = uniforms(key, sample, purpose, 0)
        mean = extra if u < model.weight else scale
        return location - mean * math.log(v)
    return location


@leaf
def _next_ar1_value(
    key: DrawKey, sample: int, correlation: float, before: float, fresh: bool
) -> float:
    """Returns the next number of a random sequence in which neighbours are correlated.

        x_m = c x_{m-1} + sqrt(1 - c^2) n_m,  n_m standard normal

    Used for delays that vary slowly from message to message. Each element of this AR(1)
    sequence has mean 0 and standard deviation 1.

    Args:
        key: Key of the link, which determines all its random numbers.
        sample: Index m of the sample.
        correlation: Correlation c of neighbours.
        before: Value x_{m-1} for the previous sample.
        fresh: True if the sequence starts here, with x_m = n_m.
    """
    draw = standard_normal(key, sample, DELAY, 0)
    if fresh:
        return draw
    return correlation * before + math.sqrt(1.0 - correlation * correlation) * draw


@leaf
def _sine_delay_us(stamp_ns: int, model: Row) -> float:
    """Computes the delay of a sample on a link whose delay varies sinusoidally with time.

        delay(t) = mean + amplitude sin(2 pi t / period + phase)

    Args:
        stamp_ns: Time t at which the sample was sent, ns since the epoch (the common start of
            the session).
        model: Delay model, a row of LINK_MODEL_DTYPE. The mean is `location`, the amplitude
            `scale` and the period `extra`, all in us. The phase is `weight`, in rad.

    Returns:
        The delay, us, not rounded.
    """
    mean_us: float = model.location
    amplitude_us: float = model.scale
    period_us = model.extra
    phase_rad = model.weight
    stamp_us = stamp_ns * 1e-3
    turns = stamp_us / period_us
    return mean_us + amplitude_us * math.sin(2.0 * math.pi * turns + phase_rad)


@leaf
def trace_delay_us(stamp_ns: int, model: Row, points: Points) -> int:
    """Returns the delay of a sample on a link that follows a recorded delay trace.

    The delay is read from the last point of the trace at or before the sending time. If the
    trace loops, its last point applies for as long as the point before it, and the trace then
    starts again.

    Args:
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        model: Delay model, a row of LINK_MODEL_DTYPE.
        points: Points of all traces, as rows of time and delay, us.

    Returns:
        The delay, us, or -1 if the sample is lost.
    """
    first = model.trace_first
    count = model.trace_count
    t_us = stamp_ns // 1000
    if model.at_end == _LOOP and count > 1:
        last_us = points[first + count - 1, 0]
        before_last_us = points[first + count - 2, 0]
        loop_us = 2 * last_us - before_last_us  # the last point lasts last_us - before_last_us
        t_us %= loop_us
    index = count_started(points, first, count, t_us) - 1
    delay_us: int = points[first + max(index, 0), 1]
    return delay_us


@leaf
def draw_pair(now: Row, index: int, attempt: int) -> tuple[float, float]:
    """Returns two uniform random numbers for a user-written delay model.

    The same arguments give the same numbers in every process, so a run can be repeated exactly.

    Args:
        now: The argument passed to the user's function, which contains the seed of the link.
        index: Index of the draw, usually the index of the sample whose delay is computed.
        attempt: Number of the attempt for this index, starting at 0, for methods that reject
            some draws.
    """
    return uniforms(np.uint64(now.key), index, DELAY, attempt)


@leaf
def _custom_delay_us(
    key: DrawKey, sample: int, stamp_ns: int, model: Row, points: Points
) -> float:
    """Computes the delay of a message with the compiled function of a user's model, us.

    The delay is limited to the maximum that the user's model declares. The function takes two
    arguments: the parameters of the user's model, and the data of the delay model. From the
    latter, it reads the fields `key`, `sample` and `stamp_ns`, and it writes the delay to the
    field `drawn_us`, see `plugged`.

    Args:
        key: Seed of all random numbers of the link.
        sample: Index of the sample.
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        model: Delay model, a row of LINK_MODEL_DTYPE. The field `call` is the address of the
            function, and `location` is the maximum delay, us.
        points: Table with the parameters of all models: floats stored in an array of integers,
            two per row.

    Returns:
        The delay in us, not rounded.
    """
    # The key is unsigned, whereas the field is signed, with the same bits.
    model.key = np.int64(key)
    model.sample = sample
    model.stamp_ns = stamp_ns

    first = model.trace_first
    count = model.trace_count
    model_parameters = points[first : first + count].reshape(-1).view(np.float64)
    call_address(model.call, (model_parameters, model))
    drawn_us: float = min(model.drawn_us, model.location)
    return drawn_us


@leaf
def clamp_delay_us(delay_us: float) -> int:
    """Rounds a delay to whole microseconds and clips it to the range 0 to `MAX_DELAY_US`.

    A random distribution such as the normal one can produce a negative delay, which becomes 0.
    """
    rounded_us = math.floor(delay_us + 0.5)
    return int(min(max(rounded_us, 0.0), float(MAX_DELAY_US)))


_AR1 = int(DelayKind.AR1)
_SINE = int(DelayKind.SINE)
_TRACE = int(DelayKind.TRACE)
_MEASURED = int(DelayKind.MEASURED)
_CUSTOM = int(DelayKind.CUSTOM)


@leaf
def find_delay_us(
    sample: int, stamp_ns: int, fresh: bool, link: LinkRow, model: Row, points: Points
) -> int:
    """Returns the delay of a message on a simulated network link, us.

    The delay may follow a distribution, a function of time, or a recorded trace; see
    `DelayKind`. The result is `channel.LOST` if the trace marks the message as lost.

    Args:
        sample: Index of the sample.
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        fresh: True for the first sample to which the model applies, which initialises the
            model's state.
        link: State of the link, including the seed of its random numbers.
        model: Delay model in force, a row of LINK_MODEL_DTYPE.
        points: Delay traces and outages of all links of the receiver.
    """
    key: DrawKey = link.key
    if model.kind == _MEASURED:
        return 0
    if model.kind == _TRACE:
        return trace_delay_us(stamp_ns, model, points)
    if model.kind == _SINE:
        return clamp_delay_us(_sine_delay_us(stamp_ns, model))
    if model.kind == _AR1:
        link.memory = _next_ar1_value(
            key=key, sample=sample, correlation=model.weight, before=link.memory, fresh=fresh
        )
        return clamp_delay_us(model.location + model.scale * link.memory)
    if model.kind == _CUSTOM:
        custom_us = _custom_delay_us(
            key=key, sample=sample, stamp_ns=stamp_ns, model=model, points=points
        )
        return clamp_delay_us(custom_us)
    drawn_us = draw_delay_us(key, sample, DELAY, model)
    return clamp_delay_us(drawn_us)

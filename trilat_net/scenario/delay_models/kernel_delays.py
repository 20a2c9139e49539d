"""The delay models that the kernel itself computes.

Invariant:
    - Each model is a `DelayKind`, and the core draws from exactly the distribution that the
      model states.
"""

import math
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ...core.delay import DelayKind, LinkModel, TraceEnd
from ...core.vectors import Points
from ...fields import KeyProblem, TomlTable, is_number
from ..delay_models import MAX_DELAY_MS, LinkBase, Milliseconds, Probability, ms_to_us
from ..delay_traces import parse_trace

PositiveMilliseconds = Annotated[float, Meta(gt=0.0, le=MAX_DELAY_MS)]
Deviation = Annotated[float, Meta(ge=0.001, le=MAX_DELAY_MS)]
"""At least a microsecond, because every draw is rounded to microseconds."""
Correlation = Annotated[float, Meta(ge=0.0, lt=1.0)]


def _normal_density(x: float) -> float:
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _normal_probability(x: float) -> float:
    """Returns the probability that a standard normal number is below `x`."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


class UniformDelay(LinkBase, frozen=True, kw_only=True, tag="uniform"):
    """A delay with a uniform distribution.

    Attributes:
        delay_ms: its mean, ms.
        half_width_ms: half of its width, ms; at most the mean. If an author leaves it out, it
            is half of the mean.
    """

    delay_ms: Milliseconds
    half_width_ms: Milliseconds

    @classmethod
    def derive_keys(cls, table: TomlTable) -> TomlTable:
        """Returns the default of the half width, so that naming the model suffices."""
        delay_ms = table.get("delay_ms")
        return {"half_width_ms": 0.5 * delay_ms} if is_number(delay_ms) else {}

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.UNIFORM, location=1e3 * self.delay_ms, scale=1e3 * self.half_width_ms
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the moments; the deviation is half_width / sqrt(3)."""
        return self.delay_ms, self.half_width_ms / math.sqrt(3.0)

    def _reach_ms(self) -> float:
        return self.delay_ms + self.half_width_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        if self.half_width_ms > self.delay_ms:
            return KeyProblem("half_width_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class NormalDelay(LinkBase, frozen=True, kw_only=True, tag="normal"):
    """A delay with a normal distribution; a delay below zero is drawn again.

    Attributes:
        delay_ms: mean of the normal distribution before the cut at zero, ms.
        deviation_ms: its standard deviation before the cut, ms.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.NORMAL, location=1e3 * self.delay_ms, scale=1e3 * self.deviation_ms
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the moments of the normal distribution truncated at zero.

        With a = -m / s and the hazard H = phi(a) / Phi(-a) the mean is m + s H and the
        deviation s sqrt(1 + a H - H^2).
        """
        a = -self.delay_ms / self.deviation_ms
        hazard = _normal_density(a) / _normal_probability(-a)
        deviation_ms = self.deviation_ms * math.sqrt(1.0 + a * hazard - hazard * hazard)
        return self.delay_ms + self.deviation_ms * hazard, deviation_ms


class MeanDeviationDelay(LinkBase, frozen=True, kw_only=True):
    """A delay whose distribution is given by its moments.

    Attributes:
        delay_ms: its mean, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def _moments(self) -> tuple[float, float]:
        return self.delay_ms, self.deviation_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        delay_ms, deviation_ms = self._moments()
        if 1e-3 * delay_ms <= deviation_ms <= 10.0 * delay_ms:
            return None
        return KeyProblem(
            "deviation_ms",
            f"must be from 1/1000 to 10 times delay_ms = {delay_ms:g}, is {deviation_ms:g}",
        )


class GammaDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="gamma"):
    """A delay with a gamma distribution."""

    def _delay(self) -> LinkModel:
        """Returns the core's model: shape m^2 / s^2, scale s^2 / m (mean m, deviation s)."""
        shape = (self.delay_ms / self.deviation_ms) ** 2
        return LinkModel(kind=DelayKind.GAMMA, extra=shape, scale=1e3 * self.delay_ms / shape)


class LogNormalDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="lognormal"):
    """A delay with a log-normal distribution."""

    def _delay(self) -> LinkModel:
        """Returns the core's model: sigma^2 = ln(1 + s^2 / m^2), mu = ln m - sigma^2 / 2."""
        variance = math.log1p((self.deviation_ms / self.delay_ms) ** 2)
        location = math.log(1e3 * self.delay_ms) - 0.5 * variance
        return LinkModel(
            kind=DelayKind.LOG_NORMAL, location=location, scale=math.sqrt(variance)
        )


class HyperExponentialDelay(LinkBase, frozen=True, kw_only=True, tag="hyperexponential"):
    """A floor plus a draw from one of two exponential distributions, as in mobile networks.

    Attributes:
        floor_ms: least delay, ms.
        fast_ms: mean of the frequent part above the floor, ms.
        slow_ms: mean of the rare part above the floor, ms.
        slow_share: probability of the rare part.
    """

    floor_ms: Milliseconds
    fast_ms: Milliseconds
    slow_ms: Milliseconds
    slow_share: Probability

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.HYPER_EXPONENTIAL,
            location=1e3 * self.floor_ms,
            scale=1e3 * self.fast_ms,
            extra=1e3 * self.slow_ms,
            weight=self.slow_share,
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the moments of the mixture above the floor, plus the floor.

        The second moment of a mixture is the mixture of the second moments, here 2 a^2 and
        2 b^2 of exponential distributions with the means a and b.
        """
        fast = self.fast_ms
        slow = self.slow_ms
        share = self.slow_share
        mean = (1.0 - share) * fast + share * slow
        second_moment = 2.0 * ((1.0 - share) * fast * fast + share * slow * slow)
        return self.floor_ms + mean, math.sqrt(second_moment - mean * mean)


class CorrelatedDelay(NormalDelay, frozen=True, kw_only=True, tag="ar1"):
    """A normal delay that is correlated from sample to sample; below zero it becomes zero.

    Attributes:
        correlation: correlation of a sample's delay with that of the previous sample.
    """

    correlation: Correlation

    def _delay(self) -> LinkModel:
        return NormalDelay._delay(self)._replace(kind=DelayKind.AR1, weight=self.correlation)

    def _moments(self) -> tuple[float, float]:
        """Returns the moments of max(0, x) for a normal x.

        The variance is written in a form in which large terms do not cancel.
        """
        m = self.delay_ms
        s = self.deviation_ms
        a = m / s
        above = _normal_probability(a)
        below = _normal_probability(-a)
        density = _normal_density(a)
        variance = (
            above + a * above * a * below + a * density * (below - above) - density * density
        )
        return m * above + s * density, s * math.sqrt(max(variance, 0.0))


class NoDelay(LinkBase, frozen=True, kw_only=True, tag="none"):
    """A link without delay: a sample is in use from the next tick on."""

    def _delay(self) -> LinkModel:
        return LinkModel()

    def _moments(self) -> tuple[float, float]:
        return 0.0, 0.0

    def _describe_delay(self) -> str:
        return "no delay"


class ConstantDelay(LinkBase, frozen=True, kw_only=True, tag="constant"):
    """The same delay for every sample.

    Attributes:
        delay_ms: the delay, ms; 0 means one period.
    """

    delay_ms: Milliseconds

    def _delay(self) -> LinkModel:
        """Returns the core's model, in whole microseconds (L4)."""
        return LinkModel(kind=DelayKind.CONSTANT, location=float(ms_to_us(self.delay_ms)))

    def _moments(self) -> tuple[float, float]:
        return self.delay_ms, 0.0

    def _describe_delay(self) -> str:
        return f"{self.delay_ms:g} ms"


class SineDelay(LinkBase, frozen=True, kw_only=True, tag="sine"):
    """T(t) = delay + amplitude sin(2 pi t / period + phase), t being a sample's stamp.

    Attributes:
        delay_ms: its mean, ms.
        amplitude_ms: its amplitude, ms; at most the mean.
        period_s: its period, s.
        phase_rad: its phase at t = 0, rad.
    """

    delay_ms: Milliseconds
    amplitude_ms: Milliseconds
    period_s: Annotated[float, Meta(gt=0.0, le=1e6)]
    phase_rad: Annotated[float, Meta(ge=-1e3, le=1e3)] = 0.0

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.SINE,
            location=1e3 * self.delay_ms,
            scale=1e3 * self.amplitude_ms,
            extra=1e6 * self.period_s,
            weight=self.phase_rad,
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the moments over whole periods."""
        return self.delay_ms, self.amplitude_ms / math.sqrt(2.0)

    def _reach_ms(self) -> float:
        return self.delay_ms + self.amplitude_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        if self.amplitude_ms > self.delay_ms:
            return KeyProblem("amplitude_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class TraceDelay(LinkBase, frozen=True, kw_only=True, tag="trace"):
    """A delay that follows a recorded table of delays over time.

    The table comes from a file; a resolved scenario holds the table itself.

    Attributes:
        trace: the points of the table, "t_us delay_us, ...", with "lost" in place of the delay
            of a lost sample.
        at_end: "hold": the last delay continues; "loop": the table repeats.
    """

    trace: str
    at_end: Literal["hold", "loop"] = "hold"

    @property
    def points(self) -> Points:
        """The points of the trace."""
        return parse_trace(self.trace)

    def _delay(self) -> LinkModel:
        return LinkModel(kind=DelayKind.TRACE, at_end=TraceEnd[self.at_end.upper()])

    def _moments(self) -> tuple[float, float]:
        """Returns the moments over one pass, weighted by time, without lost samples."""
        t_us, delay_us = self.points.T
        # The last point lasts as long as the point before it.
        end_us = t_us[-1] + 1
        if len(t_us) > 1:
            end_us = 2 * t_us[-1] - t_us[-2]
        durations_us = np.diff(t_us, append=end_us)
        weights = np.where(delay_us >= 0, durations_us, 0)
        if not weights.any():
            return math.nan, math.nan
        mean_us = float(np.average(delay_us, weights=weights))
        variance = float(np.average((delay_us - mean_us) ** 2, weights=weights))
        return mean_us / 1e3, math.sqrt(variance) / 1e3

    def _reach_ms(self) -> float:
        """Returns the longest delay of the points, ms."""
        return float(self.points[:, 1].max()) / 1e3

    def _find_delay_problem(self) -> KeyProblem | None:
        try:
            parse_trace(self.trace)
        except ValueError as error:
            return KeyProblem("trace", str(error))
        return None


class NoInjectedDelay(LinkBase, frozen=True, kw_only=True, tag="measured"):
    """No injected delay: a sample is in use as soon as it arrives over the real network."""

    def _delay(self) -> LinkModel:
        return LinkModel(kind=DelayKind.MEASURED)

    def _moments(self) -> tuple[float, float]:
        """Returns NaN: the delay of the real network is not known beforehand."""
        return math.nan, math.nan

    def _describe_delay(self) -> str:
        return "measured"

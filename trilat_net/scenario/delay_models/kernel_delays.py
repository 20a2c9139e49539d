"""The delay models that the kernel itself computes.

Invariant: each is a `DelayKind`, and the core draws from just the distribution that it states.
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
"""A microsecond or more, to which every draw is rounded."""
Correlation = Annotated[float, Meta(ge=0.0, lt=1.0)]


def _density(x: float) -> float:
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _probability(x: float) -> float:
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


class UniformDelay(LinkBase, frozen=True, kw_only=True, tag="uniform"):
    """Uniform about a mean.

    Attributes:
        delay_ms: its mean, ms.
        half_width_ms: half of its width, ms; at most the mean. An author may leave it out: half
            of the mean.
    """

    delay_ms: Milliseconds
    half_width_ms: Milliseconds

    @classmethod
    def derive_keys(cls, table: TomlTable) -> TomlTable:
        """Returns the width that an author left out, so that naming the model suffices."""
        delay_ms = table.get("delay_ms")
        return {"half_width_ms": 0.5 * delay_ms} if is_number(delay_ms) else {}

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.UNIFORM, location=1e3 * self.delay_ms, scale=1e3 * self.half_width_ms
        )

    def _moments(self) -> tuple[float, float]:
        """Half the width over the root of 3."""
        return self.delay_ms, self.half_width_ms / math.sqrt(3.0)

    def _reach_ms(self) -> float:
        return self.delay_ms + self.half_width_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        if self.half_width_ms > self.delay_ms:
            return KeyProblem("half_width_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class NormalDelay(LinkBase, frozen=True, kw_only=True, tag="normal"):
    """Normal, drawn again where it falls below zero.

    Attributes:
        delay_ms: mean of the normal distribution before it is cut at zero, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation

    def _delay(self) -> LinkModel:
        return LinkModel(
            kind=DelayKind.NORMAL, location=1e3 * self.delay_ms, scale=1e3 * self.deviation_ms
        )

    def _moments(self) -> tuple[float, float]:
        """Of the normal distribution truncated at zero."""
        a = -self.delay_ms / self.deviation_ms
        hazard = _density(a) / _probability(-a)
        deviation_ms = self.deviation_ms * math.sqrt(1.0 + a * hazard - hazard * hazard)
        return self.delay_ms + self.deviation_ms * hazard, deviation_ms


class MeanDeviationDelay(LinkBase, frozen=True, kw_only=True):
    """A distribution that is given by its moments.

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
        text = f"must be from 1/1000 to 10 times delay_ms = {delay_ms:g}, is {deviation_ms:g}"
        return KeyProblem("deviation_ms", text)


class GammaDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="gamma"):
    """Gamma distribution."""

    def _delay(self) -> LinkModel:
        """Shape m^2 / s^2, scale s^2 / m."""
        shape = (self.delay_ms / self.deviation_ms) ** 2
        return LinkModel(kind=DelayKind.GAMMA, extra=shape, scale=1e3 * self.delay_ms / shape)


class LogNormalDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="lognormal"):
    """Log-normal distribution."""

    def _delay(self) -> LinkModel:
        """Sigma^2 = ln(1 + s^2 / m^2), mu = ln m - sigma^2 / 2."""
        variance = math.log1p((self.deviation_ms / self.delay_ms) ** 2)
        location = math.log(1e3 * self.delay_ms) - 0.5 * variance
        return LinkModel(
            kind=DelayKind.LOG_NORMAL, location=location, scale=math.sqrt(variance)
        )


class HyperExponentialDelay(LinkBase, frozen=True, kw_only=True, tag="hyperexponential"):
    """A floor and one of two exponential distributions, as in mobile networks.

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
        """A mixture's second moment is the mixture of theirs, 2 a^2 and 2 b^2."""
        fast = self.fast_ms
        slow = self.slow_ms
        share = self.slow_share
        above = (1.0 - share) * fast + share * slow
        square = 2.0 * ((1.0 - share) * fast * fast + share * slow * slow)
        return self.floor_ms + above, math.sqrt(square - above * above)


class CorrelatedDelay(NormalDelay, frozen=True, kw_only=True, tag="ar1"):
    """Normal, each sample's delay correlated with the one before, cut off at zero instead of
    drawn again.

    Attributes:
        correlation: of a sample's delay with that of the sample before.
    """

    correlation: Correlation

    def _delay(self) -> LinkModel:
        return NormalDelay._delay(self)._replace(kind=DelayKind.AR1, weight=self.correlation)

    def _moments(self) -> tuple[float, float]:
        """Of max(0, x) for a normal x, in a form in which nothing large cancels."""
        m = self.delay_ms
        s = self.deviation_ms
        a = m / s
        above = _probability(a)
        below = _probability(-a)
        density = _density(a)
        variance = (
            above + a * above * a * below + a * density * (below - above) - density * density
        )
        return m * above + s * density, s * math.sqrt(max(variance, 0.0))


class NoDelay(LinkBase, frozen=True, kw_only=True, tag="none"):
    """No delay: a sample is in use from the next tick on."""

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
        """In whole microseconds (L4)."""
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
        """Over whole periods."""
        return self.delay_ms, self.amplitude_ms / math.sqrt(2.0)

    def _reach_ms(self) -> float:
        return self.delay_ms + self.amplitude_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        if self.amplitude_ms > self.delay_ms:
            return KeyProblem("amplitude_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class TraceDelay(LinkBase, frozen=True, kw_only=True, tag="trace"):
    """Delays by time, from a file; a resolved scenario holds them itself.

    Attributes:
        trace: its points, "t_us delay_us, ...", "lost" in place of a delay.
        at_end: "hold" the last delay, or "loop".
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
        """Over one pass, by time; lost samples have no delay."""
        t_us, delay_us = self.points.T
        lasts_us = np.diff(
            t_us, append=2 * t_us[-1] - t_us[-2] if len(t_us) > 1 else t_us[-1] + 1
        )
        weights = np.where(delay_us >= 0, lasts_us, 0)
        if not weights.any():
            return math.nan, math.nan
        mean = float(np.average(delay_us, weights=weights))
        variance = float(np.average((delay_us - mean) ** 2, weights=weights))
        return mean / 1e3, math.sqrt(variance) / 1e3

    def _reach_ms(self) -> float:
        """That of its points, which are within bounds."""
        return float(self.points[:, 1].max()) / 1e3

    def _find_delay_problem(self) -> KeyProblem | None:
        try:
            parse_trace(self.trace)
        except ValueError as error:
            return KeyProblem("trace", str(error))
        return None


class NoInjectedDelay(LinkBase, frozen=True, kw_only=True, tag="measured"):
    """Injects no delay: a sample is in use as soon as it arrives over the real network."""

    def _delay(self) -> LinkModel:
        return LinkModel(kind=DelayKind.MEASURED)

    def _moments(self) -> tuple[float, float]:
        """The network's, not known beforehand."""
        return math.nan, math.nan

    def _describe_delay(self) -> str:
        return "measured"

"""Delay models that draw: one distribution each, as an author writes them.

Law: each model states its mean and deviation in closed form, and the core draws from just that distribution.
"""

import math
from typing import Annotated

from msgspec import Meta

from ..core.delay import Delay, Model
from .link import LIMIT_MS, Fault, LinkBase, Milliseconds, Moments, Probability

PositiveMilliseconds = Annotated[float, Meta(gt=0.0, le=LIMIT_MS)]
Deviation = Annotated[float, Meta(ge=0.001, le=LIMIT_MS)]
"""A microsecond or more: what is drawn is rounded to that."""
Correlation = Annotated[float, Meta(ge=0.0, lt=1.0)]


class Uniform(LinkBase, frozen=True, kw_only=True, tag="uniform"):
    """Uniform about a mean.

    Attributes:
        delay_ms: its mean, ms.
        half_width_ms: how far it goes to either side, ms; at most the mean.
    """

    delay_ms: Milliseconds
    half_width_ms: Milliseconds

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(kind=Delay.UNIFORM, location=1e3 * self.delay_ms, scale=1e3 * self.half_width_ms)

    def moments(self) -> Moments:
        """See `LinkBase`: half the width over the root of 3."""
        return Moments(self.delay_ms, self.half_width_ms / math.sqrt(3.0))

    def reach_ms(self) -> float:
        """See `LinkBase`."""
        return self.delay_ms + self.half_width_ms

    def fault(self) -> Fault | None:
        """See `LinkBase`."""
        if self.half_width_ms > self.delay_ms:
            return Fault("half_width_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return LinkBase.fault(self)


class Normal(LinkBase, frozen=True, kw_only=True, tag="normal"):
    """Normal, drawn again where it falls below zero.

    Attributes:
        delay_ms: mean of the normal distribution before it is truncated, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(kind=Delay.NORMAL, location=1e3 * self.delay_ms, scale=1e3 * self.deviation_ms)

    def moments(self) -> Moments:
        """See `LinkBase`: of the normal distribution truncated at zero."""
        a = -self.delay_ms / self.deviation_ms
        hazard = _density(a) / _probability(-a)
        deviation_ms = self.deviation_ms * math.sqrt(1.0 + a * hazard - hazard * hazard)
        return Moments(self.delay_ms + self.deviation_ms * hazard, deviation_ms)


class Gamma(LinkBase, frozen=True, kw_only=True, tag="gamma"):
    """Gamma distribution.

    Attributes:
        delay_ms: its mean, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def delay(self) -> Model:
        """See `LinkBase`: shape m^2 / s^2, scale s^2 / m."""
        shape = (self.delay_ms / self.deviation_ms) ** 2
        return Model(kind=Delay.GAMMA, extra=shape, scale=1e3 * self.delay_ms / shape)

    def moments(self) -> Moments:
        """See `LinkBase`."""
        return Moments(self.delay_ms, self.deviation_ms)

    def fault(self) -> Fault | None:
        """See `LinkBase`."""
        return _spread_fault(self.delay_ms, self.deviation_ms) or LinkBase.fault(self)


class LogNormal(LinkBase, frozen=True, kw_only=True, tag="lognormal"):
    """Log-normal distribution.

    Attributes:
        delay_ms: its mean, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def delay(self) -> Model:
        """See `LinkBase`: sigma^2 = ln(1 + s^2 / m^2), mu = ln m - sigma^2 / 2."""
        variance = math.log1p((self.deviation_ms / self.delay_ms) ** 2)
        location = math.log(1e3 * self.delay_ms) - 0.5 * variance
        return Model(kind=Delay.LOG_NORMAL, location=location, scale=math.sqrt(variance))

    def moments(self) -> Moments:
        """See `LinkBase`."""
        return Moments(self.delay_ms, self.deviation_ms)

    def fault(self) -> Fault | None:
        """See `LinkBase`."""
        return _spread_fault(self.delay_ms, self.deviation_ms) or LinkBase.fault(self)


class HyperExponential(LinkBase, frozen=True, kw_only=True, tag="hyperexponential"):
    """A floor and one of two exponential distributions: what mobile networks show.

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

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(
            kind=Delay.HYPER_EXPONENTIAL,
            location=1e3 * self.floor_ms,
            scale=1e3 * self.fast_ms,
            extra=1e3 * self.slow_ms,
            weight=self.slow_share,
        )

    def moments(self) -> Moments:
        """See `LinkBase`: a mixture's second moment is the mixture of theirs, 2 a^2 and 2 b^2."""
        fast, slow, share = self.fast_ms, self.slow_ms, self.slow_share
        above = (1.0 - share) * fast + share * slow
        square = 2.0 * ((1.0 - share) * fast * fast + share * slow * slow)
        return Moments(self.floor_ms + above, math.sqrt(square - above * above))


class Correlated(LinkBase, frozen=True, kw_only=True, tag="ar1"):
    """Normal, each sample's delay correlated with the one before, cut off at zero.

    Attributes:
        delay_ms: mean of the normal distribution before it is cut off, ms.
        deviation_ms: its standard deviation, ms.
        correlation: of a sample's delay with that of the sample before.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation
    correlation: Correlation

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(
            kind=Delay.AR1,
            location=1e3 * self.delay_ms,
            scale=1e3 * self.deviation_ms,
            weight=self.correlation,
        )

    def moments(self) -> Moments:
        """See `LinkBase`: of max(0, x) for a normal x, in a form in which nothing large cancels."""
        m, s = self.delay_ms, self.deviation_ms
        a = m / s
        above, below, density = _probability(a), _probability(-a), _density(a)
        variance = above + a * above * a * below + a * density * (below - above) - density * density
        return Moments(m * above + s * density, s * math.sqrt(max(variance, 0.0)))


def _spread_fault(delay_ms: float, deviation_ms: float) -> Fault | None:
    """Returns what is wrong with a deviation beside its mean: out of these bounds it is hardly meant."""
    if 1e-3 * delay_ms <= deviation_ms <= 10.0 * delay_ms:
        return None
    return Fault(
        "deviation_ms", f"must be from 1/1000 to 10 times delay_ms = {delay_ms:g}, is {deviation_ms:g}"
    )


def _density(x: float) -> float:
    """The standard normal density."""
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _probability(x: float) -> float:
    """The standard normal distribution function."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))

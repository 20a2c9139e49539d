"""All delay models of a directed link by their names; here those that draw nothing.

Law: each model states its mean and deviation in closed form, and the core draws from just that
distribution. Keys end in their unit.
"""

import math
from typing import Annotated, Literal, get_args

import numpy as np
from msgspec import Meta

from ..core.delay import AtEnd, Delay, Model, Points
from .distributions import Correlated, Gamma, HyperExponential, LogNormal, Normal, Uniform
from .link import Fault, LinkBase, Milliseconds, Moments, whole_us
from .traces import points_of


class NoDelay(LinkBase, frozen=True, kw_only=True, tag="none"):
    """No delay: a sample is in use from the next tick on."""

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model()

    def moments(self) -> Moments:
        """See `LinkBase`."""
        return Moments(0.0, 0.0)

    def _words(self) -> str:
        return "no delay"


class Constant(LinkBase, frozen=True, kw_only=True, tag="constant"):
    """The same delay for every sample.

    Attributes:
        delay_ms: the delay, ms; 0 means one period.
    """

    delay_ms: Milliseconds

    def delay(self) -> Model:
        """See `LinkBase`; in whole microseconds (L4)."""
        return Model(kind=Delay.CONSTANT, location=float(whole_us(self.delay_ms)))

    def moments(self) -> Moments:
        """See `LinkBase`."""
        return Moments(self.delay_ms, 0.0)

    def _words(self) -> str:
        return f"{self.delay_ms:g} ms"


class Sine(LinkBase, frozen=True, kw_only=True, tag="sine"):
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

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(
            kind=Delay.SINE,
            location=1e3 * self.delay_ms,
            scale=1e3 * self.amplitude_ms,
            extra=1e6 * self.period_s,
            weight=self.phase_rad,
        )

    def moments(self) -> Moments:
        """See `LinkBase`: over whole periods."""
        return Moments(self.delay_ms, self.amplitude_ms / math.sqrt(2.0))

    def reach_ms(self) -> float:
        """See `LinkBase`."""
        return self.delay_ms + self.amplitude_ms

    def fault(self) -> Fault | None:
        """See `LinkBase`."""
        if self.amplitude_ms > self.delay_ms:
            return Fault("amplitude_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return LinkBase.fault(self)


class Trace(LinkBase, frozen=True, kw_only=True, tag="trace"):
    """Delays by time, from a file; resolved, it holds them itself.

    Attributes:
        trace: its points, "t_us delay_us, ...", "lost" in the place of a delay.
        at_end: "hold" the last delay, or "loop".
    """

    trace: str
    at_end: Literal["hold", "loop"] = "hold"

    @property
    def points(self) -> Points:
        """See `LinkBase`."""
        return points_of(self.trace)

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(kind=Delay.TRACE, at_end=AtEnd[self.at_end.upper()])

    def moments(self) -> Moments:
        """See `LinkBase`: over one pass, by time; lost samples have no delay."""
        t_us, delay_us = self.points.T
        lasts_us = np.diff(t_us, append=2 * t_us[-1] - t_us[-2] if len(t_us) > 1 else t_us[-1] + 1)
        weights = np.where(delay_us >= 0, lasts_us, 0)
        if not weights.any():
            return Moments(math.nan, math.nan)
        mean = float(np.average(delay_us, weights=weights))
        variance = float(np.average((delay_us - mean) ** 2, weights=weights))
        return Moments(mean / 1e3, math.sqrt(variance) / 1e3)

    def reach_ms(self) -> float:
        """See `LinkBase`: that of its points, which are within bounds."""
        return float(self.points[:, 1].max()) / 1e3

    def fault(self) -> Fault | None:
        """See `LinkBase`."""
        try:
            points_of(self.trace)
        except ValueError as error:
            return Fault("trace", str(error))
        return LinkBase.fault(self)


class Measured(LinkBase, frozen=True, kw_only=True, tag="measured"):
    """None is injected: a sample is in use as soon as it has come over the real network."""

    def delay(self) -> Model:
        """See `LinkBase`."""
        return Model(kind=Delay.MEASURED)

    def moments(self) -> Moments:
        """See `LinkBase`: the network's, not known beforehand."""
        return Moments(math.nan, math.nan)

    def _words(self) -> str:
        return "measured"


Link = (
    NoDelay
    | Constant
    | Uniform
    | Normal
    | Gamma
    | LogNormal
    | HyperExponential
    | Correlated
    | Sine
    | Trace
    | Measured
)
LINKS: dict[str, type[LinkBase]] = {str(kind.__struct_config__.tag): kind for kind in get_args(Link)}
"""The models by their names."""

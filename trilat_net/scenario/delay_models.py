"""Delay models of a directed link by name, and what they share: loss, duplicates, outages, order, play-out.

Invariant: each model states its mean and deviation in closed form, and the core draws from just that
distribution. Loss is stated by its share and the mean length of its bursts, which people measure; the
two-state chain that draws it follows from these in closed form. Keys end in their unit.
"""

import math
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta

from ..core.delay import MAX_DELAY_US, DelayKind, LinkModel, TraceEnd
from ..core.vectors import Points
from .delay_traces import parse_trace
from .fields import Frozen

MAX_DELAY_MS = MAX_DELAY_US / 1000
"""No delay is longer."""

MAX_OUTAGES = 1000
"""Most outages of a link: each sample is held against all of them."""

Milliseconds = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_MS)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
OutageTime = Annotated[float, Meta(ge=0.0, le=1e9)]


class LinkProblem(NamedTuple):
    """What is wrong with a link: the key, and why."""

    key: str
    problem: str


class DelayMoments(NamedTuple):
    """Mean and standard deviation of a delay, ms."""

    mean_ms: float
    deviation_ms: float


class LinkBase(Frozen, frozen=True, tag_field="model", omit_defaults=True):
    """What every model has besides its delay.

    Attributes:
        loss: share of samples that are lost in the long run.
        loss_burst: mean number of samples lost in a row; 0: each is lost by itself.
        loss_bad: of a burst's samples, the share that is lost; below 1 bursts have holes.
        duplicate: share of samples that come twice, the copy with a delay of its own.
        outages_s: times between which the link is cut, by the samples' stamps, s.
        order: "newest": a newer sample replaces an older one; "in_order": none overtakes an older one.
        playout_ms: every sample is held at least so long: jitter below it becomes a constant delay.
    """

    loss: Probability = 0.0
    loss_burst: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    loss_bad: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    duplicate: Probability = 0.0
    outages_s: Annotated[tuple[tuple[OutageTime, OutageTime], ...], Meta(max_length=MAX_OUTAGES)] = ()
    order: Literal["newest", "in_order"] = "newest"
    playout_ms: Milliseconds = 0.0

    def delay(self) -> LinkModel:
        """Returns the delay alone, as the core has it."""
        raise NotImplementedError

    def moments(self) -> DelayMoments:
        """Returns what the model states of its delay, before play-out, order and the cut at `LIMIT_MS`."""
        raise NotImplementedError

    def reach_ms(self) -> float:
        """Returns how far its delays go, ms: three deviations above the mean where they have no end."""
        mean_ms, deviation_ms = self.moments()
        return mean_ms + 3.0 * deviation_ms

    @property
    def random(self) -> bool:
        """True where anything of it is drawn."""
        drawn = self.delay().kind not in (
            DelayKind.CONSTANT,
            DelayKind.SINE,
            DelayKind.TRACE,
            DelayKind.MEASURED,
        )
        return drawn or 0.0 < self.loss < 1.0 or 0.0 < self.duplicate < 1.0

    @property
    def measured(self) -> bool:
        """True where nothing is injected."""
        return self.delay().kind == DelayKind.MEASURED

    @property
    def points(self) -> Points | None:
        """The points of its trace, if it has one."""
        return None

    def core(self, from_ns: int = 0) -> LinkModel:
        """Returns what the core builds the link from.

        Args:
            from_ns: the first stamp that it applies to, ns since the epoch.
        """
        good, bad, enter, leave = self._chain()
        return self.delay()._replace(
            from_ns=from_ns,
            loss_good=good,
            loss_bad=bad,
            enter=enter,
            leave=leave,
            duplicate=self.duplicate,
            in_order=int(self.order == "in_order"),
            playout_us=ms_to_us(self.playout_ms),
        )

    def _chain(self) -> tuple[float, float, float, float]:
        """Returns the chain of losses: loss in good and bad state, probability to enter and leave the bad.

        In the bad state a sample is lost with h = `loss_bad`, in the good one never. A run of losses goes
        on with (1 - leave) h, so its mean length is B = 1 / (1 - (1 - leave) h); the share of bad samples
        is loss / h = enter / (enter + leave).
        """
        if self.loss_burst == 0.0 or self.loss == 0.0:
            return self.loss, 0.0, 0.0, 1.0
        leave = 1.0 - (1.0 - 1.0 / self.loss_burst) / self.loss_bad
        bad = self.loss / self.loss_bad
        return 0.0, self.loss_bad, leave * bad / (1.0 - bad), leave

    def fault(self) -> LinkProblem | None:
        """Returns what is wrong with it that no range of a single key shows."""
        for n, (start_s, end_s) in enumerate(self.outages_s):
            if end_s <= start_s:
                return LinkProblem(
                    f"outages_s[{n}]", f"must end after it begins, reads {start_s:g} to {end_s:g}"
                )
        if (reach_ms := self.reach_ms()) > MAX_DELAY_MS:
            problem = f"its delays reach {reach_ms:g} ms; beyond {MAX_DELAY_MS:g} ms they would be cut off"
            return LinkProblem("model", problem)
        if self.loss_burst and self.loss:
            return self._burst_fault()
        return None

    def _burst_fault(self) -> LinkProblem | None:
        if self.loss_burst < 1.0:
            return LinkProblem("loss_burst", f"must be 0 or at least 1 sample, is {self.loss_burst:g}")
        if self.loss >= self.loss_bad:
            return LinkProblem(
                "loss", f"must be below loss_bad = {self.loss_bad:g} in bursts, is {self.loss:g}"
            )
        _, _, enter, leave = self._chain()
        if leave <= 0.0:
            longest = 1.0 / (1.0 - self.loss_bad)
            return LinkProblem("loss_burst", f"must be below {longest:g} with loss_bad = {self.loss_bad:g}")
        if enter > 1.0:
            return LinkProblem("loss_burst", f"{self.loss_burst:g} is too short for a loss of {self.loss:g}")
        return None

    def describe(self) -> str:
        """Returns what it does, in a few words, with the mean and deviation that its model states."""
        words = [self._words()]
        if self.loss:
            bursts = f" in bursts of {self.loss_burst:g}" if self.loss_burst else ""
            words.append(f"loss {100 * self.loss:g} %{bursts}")
        if self.duplicate:
            words.append(f"duplicates {100 * self.duplicate:g} %")
        words += [f"cut {start:g}-{end:g} s" for start, end in self.outages_s]
        if self.order == "in_order":
            words.append("in order")
        if self.playout_ms:
            words.append(f"play-out {self.playout_ms:g} ms")
        return ", ".join(words)

    def _words(self) -> str:
        mean_ms, deviation_ms = self.moments()
        return f"{self.__struct_config__.tag} {mean_ms:.4g} +- {deviation_ms:.3g} ms"


def ms_to_us(milliseconds: float) -> int:
    """Returns a time in whole microseconds (L4)."""
    return round(milliseconds * 1_000)


PositiveMilliseconds = Annotated[float, Meta(gt=0.0, le=MAX_DELAY_MS)]
Deviation = Annotated[float, Meta(ge=0.001, le=MAX_DELAY_MS)]
"""A microsecond or more: what is drawn is rounded to that."""
Correlation = Annotated[float, Meta(ge=0.0, lt=1.0)]


class UniformDelay(LinkBase, frozen=True, kw_only=True, tag="uniform"):
    """Uniform about a mean.

    Attributes:
        delay_ms: its mean, ms.
        half_width_ms: how far it goes to either side, ms; at most the mean.
    """

    delay_ms: Milliseconds
    half_width_ms: Milliseconds

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(kind=DelayKind.UNIFORM, location=1e3 * self.delay_ms, scale=1e3 * self.half_width_ms)

    def moments(self) -> DelayMoments:
        """See `LinkBase`: half the width over the root of 3."""
        return DelayMoments(self.delay_ms, self.half_width_ms / math.sqrt(3.0))

    def reach_ms(self) -> float:
        """See `LinkBase`."""
        return self.delay_ms + self.half_width_ms

    def fault(self) -> LinkProblem | None:
        """See `LinkBase`."""
        if self.half_width_ms > self.delay_ms:
            return LinkProblem("half_width_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return LinkBase.fault(self)


class NormalDelay(LinkBase, frozen=True, kw_only=True, tag="normal"):
    """Normal, drawn again where it falls below zero.

    Attributes:
        delay_ms: mean of the normal distribution before it is truncated, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(kind=DelayKind.NORMAL, location=1e3 * self.delay_ms, scale=1e3 * self.deviation_ms)

    def moments(self) -> DelayMoments:
        """See `LinkBase`: of the normal distribution truncated at zero."""
        a = -self.delay_ms / self.deviation_ms
        hazard = _density(a) / _probability(-a)
        deviation_ms = self.deviation_ms * math.sqrt(1.0 + a * hazard - hazard * hazard)
        return DelayMoments(self.delay_ms + self.deviation_ms * hazard, deviation_ms)


class GammaDelay(LinkBase, frozen=True, kw_only=True, tag="gamma"):
    """Gamma distribution.

    Attributes:
        delay_ms: its mean, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def delay(self) -> LinkModel:
        """See `LinkBase`: shape m^2 / s^2, scale s^2 / m."""
        shape = (self.delay_ms / self.deviation_ms) ** 2
        return LinkModel(kind=DelayKind.GAMMA, extra=shape, scale=1e3 * self.delay_ms / shape)

    def moments(self) -> DelayMoments:
        """See `LinkBase`."""
        return DelayMoments(self.delay_ms, self.deviation_ms)

    def fault(self) -> LinkProblem | None:
        """See `LinkBase`."""
        return _spread_fault(self.delay_ms, self.deviation_ms) or LinkBase.fault(self)


class LogNormalDelay(LinkBase, frozen=True, kw_only=True, tag="lognormal"):
    """Log-normal distribution.

    Attributes:
        delay_ms: its mean, ms.
        deviation_ms: its standard deviation, ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def delay(self) -> LinkModel:
        """See `LinkBase`: sigma^2 = ln(1 + s^2 / m^2), mu = ln m - sigma^2 / 2."""
        variance = math.log1p((self.deviation_ms / self.delay_ms) ** 2)
        location = math.log(1e3 * self.delay_ms) - 0.5 * variance
        return LinkModel(kind=DelayKind.LOG_NORMAL, location=location, scale=math.sqrt(variance))

    def moments(self) -> DelayMoments:
        """See `LinkBase`."""
        return DelayMoments(self.delay_ms, self.deviation_ms)

    def fault(self) -> LinkProblem | None:
        """See `LinkBase`."""
        return _spread_fault(self.delay_ms, self.deviation_ms) or LinkBase.fault(self)


class HyperExponentialDelay(LinkBase, frozen=True, kw_only=True, tag="hyperexponential"):
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

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(
            kind=DelayKind.HYPER_EXPONENTIAL,
            location=1e3 * self.floor_ms,
            scale=1e3 * self.fast_ms,
            extra=1e3 * self.slow_ms,
            weight=self.slow_share,
        )

    def moments(self) -> DelayMoments:
        """See `LinkBase`: a mixture's second moment is the mixture of theirs, 2 a^2 and 2 b^2."""
        fast, slow, share = self.fast_ms, self.slow_ms, self.slow_share
        above = (1.0 - share) * fast + share * slow
        square = 2.0 * ((1.0 - share) * fast * fast + share * slow * slow)
        return DelayMoments(self.floor_ms + above, math.sqrt(square - above * above))


class CorrelatedDelay(LinkBase, frozen=True, kw_only=True, tag="ar1"):
    """Normal, each sample's delay correlated with the one before, cut off at zero.

    Attributes:
        delay_ms: mean of the normal distribution before it is cut off, ms.
        deviation_ms: its standard deviation, ms.
        correlation: of a sample's delay with that of the sample before.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation
    correlation: Correlation

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(
            kind=DelayKind.AR1,
            location=1e3 * self.delay_ms,
            scale=1e3 * self.deviation_ms,
            weight=self.correlation,
        )

    def moments(self) -> DelayMoments:
        """See `LinkBase`: of max(0, x) for a normal x, in a form in which nothing large cancels."""
        m, s = self.delay_ms, self.deviation_ms
        a = m / s
        above, below, density = _probability(a), _probability(-a), _density(a)
        variance = above + a * above * a * below + a * density * (below - above) - density * density
        return DelayMoments(m * above + s * density, s * math.sqrt(max(variance, 0.0)))


def _spread_fault(delay_ms: float, deviation_ms: float) -> LinkProblem | None:
    """Returns what is wrong with a deviation beside its mean: out of these bounds it is hardly meant."""
    if 1e-3 * delay_ms <= deviation_ms <= 10.0 * delay_ms:
        return None
    return LinkProblem(
        "deviation_ms", f"must be from 1/1000 to 10 times delay_ms = {delay_ms:g}, is {deviation_ms:g}"
    )


def _density(x: float) -> float:
    """The standard normal density."""
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _probability(x: float) -> float:
    """The standard normal distribution function."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


class NoDelay(LinkBase, frozen=True, kw_only=True, tag="none"):
    """No delay: a sample is in use from the next tick on."""

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel()

    def moments(self) -> DelayMoments:
        """See `LinkBase`."""
        return DelayMoments(0.0, 0.0)

    def _words(self) -> str:
        return "no delay"


class ConstantDelay(LinkBase, frozen=True, kw_only=True, tag="constant"):
    """The same delay for every sample.

    Attributes:
        delay_ms: the delay, ms; 0 means one period.
    """

    delay_ms: Milliseconds

    def delay(self) -> LinkModel:
        """See `LinkBase`; in whole microseconds (L4)."""
        return LinkModel(kind=DelayKind.CONSTANT, location=float(ms_to_us(self.delay_ms)))

    def moments(self) -> DelayMoments:
        """See `LinkBase`."""
        return DelayMoments(self.delay_ms, 0.0)

    def _words(self) -> str:
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

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(
            kind=DelayKind.SINE,
            location=1e3 * self.delay_ms,
            scale=1e3 * self.amplitude_ms,
            extra=1e6 * self.period_s,
            weight=self.phase_rad,
        )

    def moments(self) -> DelayMoments:
        """See `LinkBase`: over whole periods."""
        return DelayMoments(self.delay_ms, self.amplitude_ms / math.sqrt(2.0))

    def reach_ms(self) -> float:
        """See `LinkBase`."""
        return self.delay_ms + self.amplitude_ms

    def fault(self) -> LinkProblem | None:
        """See `LinkBase`."""
        if self.amplitude_ms > self.delay_ms:
            return LinkProblem("amplitude_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return LinkBase.fault(self)


class TraceDelay(LinkBase, frozen=True, kw_only=True, tag="trace"):
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
        return parse_trace(self.trace)

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(kind=DelayKind.TRACE, at_end=TraceEnd[self.at_end.upper()])

    def moments(self) -> DelayMoments:
        """See `LinkBase`: over one pass, by time; lost samples have no delay."""
        t_us, delay_us = self.points.T
        lasts_us = np.diff(t_us, append=2 * t_us[-1] - t_us[-2] if len(t_us) > 1 else t_us[-1] + 1)
        weights = np.where(delay_us >= 0, lasts_us, 0)
        if not weights.any():
            return DelayMoments(math.nan, math.nan)
        mean = float(np.average(delay_us, weights=weights))
        variance = float(np.average((delay_us - mean) ** 2, weights=weights))
        return DelayMoments(mean / 1e3, math.sqrt(variance) / 1e3)

    def reach_ms(self) -> float:
        """See `LinkBase`: that of its points, which are within bounds."""
        return float(self.points[:, 1].max()) / 1e3

    def fault(self) -> LinkProblem | None:
        """See `LinkBase`."""
        try:
            parse_trace(self.trace)
        except ValueError as error:
            return LinkProblem("trace", str(error))
        return LinkBase.fault(self)


class NoInjectedDelay(LinkBase, frozen=True, kw_only=True, tag="measured"):
    """None is injected: a sample is in use as soon as it has come over the real network."""

    def delay(self) -> LinkModel:
        """See `LinkBase`."""
        return LinkModel(kind=DelayKind.MEASURED)

    def moments(self) -> DelayMoments:
        """See `LinkBase`: the network's, not known beforehand."""
        return DelayMoments(math.nan, math.nan)

    def _words(self) -> str:
        return "measured"


Link = (
    NoDelay
    | ConstantDelay
    | UniformDelay
    | NormalDelay
    | GammaDelay
    | LogNormalDelay
    | HyperExponentialDelay
    | CorrelatedDelay
    | SineDelay
    | TraceDelay
    | NoInjectedDelay
)
DELAY_MODELS: dict[str, type[LinkBase]] = {str(kind.__struct_config__.tag): kind for kind in get_args(Link)}
"""The models by their names."""

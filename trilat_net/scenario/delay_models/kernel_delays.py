"""Delay models that are built into the simulation kernel.

Each class describes one kind of link table, for example a table with a mean and a jitter. It
converts the keys to the parameters of a probability distribution or of a function of time, and
computes the mean and the standard deviation of the delay.

Invariant:
    - Each model names a `LinkModel` of the kernel, the compiled simulation. The kernel draws
      delays from exactly the distribution whose mean and standard deviation the model states.
"""

import math
from fractions import Fraction
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ...core import LinkModel, Points
from ...fields import KeyProblem, TomlTable
from ..delay_traces import parse_trace
from ..key_checks import is_number
from . import MAX_DELAY_MS, LinkBase, Milliseconds, Probability, ms_to_us

PositiveMilliseconds = Annotated[float, Meta(gt=0.0, le=MAX_DELAY_MS)]
Deviation = Annotated[float, Meta(ge=0.001, le=MAX_DELAY_MS)]
"""Standard deviation, at least 1 microsecond since delays are integers in microseconds."""
Correlation = Annotated[float, Meta(ge=0.0, lt=1.0)]
_US_PER_S = 1_000_000


def _normal_density(x: float) -> float:
    """Returns the density of the standard normal distribution at `x`."""
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def _normal_probability(x: float) -> float:
    """Returns the probability that a standard normal random variable is below `x`."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


class UniformDelay(LinkBase, frozen=True, kw_only=True, tag="uniform"):
    """Delay drawn uniformly from mean minus half width to mean plus half width.

    For example, a mean of 50 ms and a half width of 10 ms give delays from 40 to 60 ms.

    Attributes:
        delay_ms: Mean delay, in ms.
        half_width_ms: Half of the width of the distribution, in ms. At most the mean. By
            default, half of the mean.
    """

    delay_ms: Milliseconds
    half_width_ms: Milliseconds

    @classmethod
    def derive_keys(cls, table: TomlTable) -> TomlTable:
        """Returns the default half width: half of the mean delay.

        Args:
            table: The link table as written by its author.

        Returns:
            The key `half_width_ms`. Empty if the mean is missing or not a number.
        """
        delay_ms = table.get("delay_ms")
        return {"half_width_ms": 0.5 * delay_ms} if is_number(delay_ms) else {}

    def _delay(self) -> LinkModel:
        """Returns the mean and the half width in microseconds, for the compiled simulation."""
        return LinkModel.uniform(1e3 * self.delay_ms, 1e3 * self.half_width_ms)

    def _describe_delay(self) -> str:
        """Returns the range of the delay, for example "uniform 0 to 400 ms"."""
        least_ms = self.delay_ms - self.half_width_ms
        most_ms = self.delay_ms + self.half_width_ms
        return f"uniform {least_ms:.4g} to {most_ms:.4g} ms"

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation half_width / sqrt(3), in ms."""
        return self.delay_ms, self.half_width_ms / math.sqrt(3.0)

    def _reach_ms(self) -> float:
        """Returns the longest delay, the upper end of the uniform distribution, in ms."""
        return self.delay_ms + self.half_width_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a problem if the half width exceeds the mean, giving negative delays."""
        if self.half_width_ms > self.delay_ms:
            return KeyProblem("half_width_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class NormalDelay(LinkBase, frozen=True, kw_only=True, tag="normal"):
    """Delay drawn from a normal distribution truncated at zero.

    A message cannot arrive before it was sent, so negative delays are redrawn.

    Attributes:
        delay_ms: Mean of the normal distribution before truncation, in ms.
        deviation_ms: Standard deviation of the normal distribution before truncation, in ms.
    """

    delay_ms: Milliseconds
    deviation_ms: Deviation

    def _delay(self) -> LinkModel:
        """Returns the mean and the deviation in microseconds, for the compiled simulation."""
        return LinkModel.normal(1e3 * self.delay_ms, 1e3 * self.deviation_ms)

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the delay, in ms.

        The normal distribution is truncated at zero. Let m and s be its mean and standard
        deviation before truncation, a = -m / s, phi the standard normal density, Phi its
        integral, and H = phi(a) / Phi(-a) the hazard. The mean is then m + s H, and the
        standard deviation is s sqrt(1 + a H - H^2).
        """
        a = -self.delay_ms / self.deviation_ms
        hazard = _normal_density(a) / _normal_probability(-a)
        deviation_ms = self.deviation_ms * math.sqrt(1.0 + a * hazard - hazard * hazard)
        return self.delay_ms + self.deviation_ms * hazard, deviation_ms


class MeanDeviationDelay(LinkBase, frozen=True, kw_only=True):
    """Base class for delay models configured with a mean and a standard deviation.

    Attributes:
        delay_ms: Mean delay, in ms.
        deviation_ms: Standard deviation of the delay, in ms.
    """

    delay_ms: PositiveMilliseconds
    deviation_ms: Deviation

    def _moments(self) -> tuple[float, float]:
        """Returns the configured mean and standard deviation, in ms."""
        return self.delay_ms, self.deviation_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a problem if the ratio of standard deviation to mean is extreme.

        The standard deviation must be between 1/1000 of the mean and 10 times the mean.
        """
        delay_ms, deviation_ms = self._moments()
        if 1e-3 * delay_ms <= deviation_ms <= 10.0 * delay_ms:
            return None
        return KeyProblem(
            "deviation_ms",
            f"must be from 1/1000 to 10 times delay_ms = {delay_ms:g}, but is {deviation_ms:g}",
        )


class GammaDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="gamma"):
    """Delay drawn from a gamma distribution: never negative, with a long tail.

    Configured with the mean and the standard deviation of the delay.
    """

    def _delay(self) -> LinkModel:
        """Returns the parameters from which the compiled simulation draws the delays.

        For mean m and standard deviation s, the gamma distribution has shape m^2 / s^2 and
        scale s^2 / m.
        """
        shape = (self.delay_ms / self.deviation_ms) ** 2
        return LinkModel.gamma(shape, 1e3 * self.delay_ms / shape)


class LogNormalDelay(MeanDeviationDelay, frozen=True, kw_only=True, tag="lognormal"):
    """Delay drawn from a log-normal distribution: mostly short, occasionally very long.

    Configured with the mean and the standard deviation of the delay itself, not of its
    logarithm.
    """

    def _delay(self) -> LinkModel:
        """Returns the parameters from which the compiled simulation draws the delays.

        For mean m and standard deviation s, the logarithm of the delay is normal with variance
        sigma^2 = ln(1 + s^2 / m^2) and mean mu = ln m - sigma^2 / 2.
        """
        variance = math.log1p((self.deviation_ms / self.delay_ms) ** 2)
        location = math.log(1e3 * self.delay_ms) - 0.5 * variance
        return LinkModel.log_normal(location, math.sqrt(variance))


class HyperExponentialDelay(LinkBase, frozen=True, kw_only=True, tag="hyperexponential"):
    """Fixed delay plus a random part drawn from one of two exponential distributions.

    Typical of mobile networks, where most messages are fast but some wait much longer.

    Attributes:
        floor_ms: Fixed part of the delay, in ms.
        fast_ms: Mean of the random part of a fast message, in ms.
        slow_ms: Mean of the random part of a slow message, in ms.
        slow_share: Probability that a message is slow.
    """

    floor_ms: Milliseconds
    fast_ms: Milliseconds
    slow_ms: Milliseconds
    slow_share: Probability

    def _delay(self) -> LinkModel:
        """Returns the fixed delay and both means in microseconds, for the simulation."""
        return LinkModel.hyper_exponential(
            floor_us=1e3 * self.floor_ms,
            fast_us=1e3 * self.fast_ms,
            slow_us=1e3 * self.slow_ms,
            slow_share=self.slow_share,
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the delay, in ms.

        The delay is a fixed part plus a mixture of two exponential distributions. The second
        moment of a mixture is the mixture of the second moments, which are 2 a^2 and 2 b^2 for
        exponential distributions with means a and b.
        """
        fast = self.fast_ms
        slow = self.slow_ms
        share = self.slow_share
        mean = (1.0 - share) * fast + share * slow
        second_moment = 2.0 * ((1.0 - share) * fast * fast + share * slow * slow)
        return self.floor_ms + mean, math.sqrt(second_moment - mean * mean)


class CorrelatedDelay(NormalDelay, frozen=True, kw_only=True, tag="ar1"):
    """Delay that varies slowly: a slow message is likely to be followed by another slow one.

    Delays are normally distributed and correlated between messages. Negative delays are set to
    zero.

    Attributes:
        correlation: Correlation between the delays of two consecutive samples, before negative
            delays are set to zero.
    """

    correlation: Correlation

    def _delay(self) -> LinkModel:
        """Returns mean, deviation and correlation of the delay, for the compiled simulation."""
        return LinkModel.correlated(
            1e3 * self.delay_ms, 1e3 * self.deviation_ms, self.correlation
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and standard deviation of the delay max(0, x) for normal x, in ms.

        The variance is written as a sum that avoids cancellation of large terms.
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
    """Ideal network link with no delay and no loss.

    The receiver uses a message from its next control period on, since a message cannot act in
    the period in which it was sent.
    """

    @property
    def constant_delay_ms(self) -> float:
        """Delay of every message, in ms: always 0."""
        return 0.0

    def _delay(self) -> LinkModel:
        """Returns the settings of a link with no delay, for the compiled simulation."""
        return LinkModel()

    def _moments(self) -> tuple[float, float]:
        """Returns a mean and a standard deviation of zero, in ms."""
        return 0.0, 0.0

    def _describe_delay(self) -> str:
        """Returns the description of a link with no delay."""
        return "no delay"


class ConstantDelay(LinkBase, frozen=True, kw_only=True, tag="constant"):
    """Network link with the same delay for every message.

    Attributes:
        delay_ms: Delay, in ms. Even with a delay of 0, the receiver uses a sample only from its
            next tick on, one period later.
    """

    delay_ms: Milliseconds

    @property
    def constant_delay_ms(self) -> float:
        """Delay of every message, in ms."""
        return self.delay_ms

    def _delay(self) -> LinkModel:
        """Returns the delay as an integer in microseconds, for the compiled simulation."""
        return LinkModel.constant(float(ms_to_us(self.delay_ms)))

    def _moments(self) -> tuple[float, float]:
        """Returns the constant delay as the mean, with a standard deviation of zero, in ms."""
        return self.delay_ms, 0.0

    def _describe_delay(self) -> str:
        """Returns the delay as a string."""
        return f"{self.delay_ms:g} ms"


class SineDelay(LinkBase, frozen=True, kw_only=True, tag="sine"):
    """Delay that varies sinusoidally with the send time t of the message.

        T(t) = delay + amplitude sin(2 pi t / period + phase)

    Attributes:
        delay_ms: Mean delay, in ms.
        amplitude_ms: Amplitude, in ms. At most the mean.
        period_s: Period, in s.
        phase_rad: Phase at t = 0, in rad.
    """

    delay_ms: Milliseconds
    amplitude_ms: Milliseconds
    period_s: Annotated[float, Meta(gt=0.0, le=1e6)]
    phase_rad: Annotated[float, Meta(ge=-1e3, le=1e3)] = 0.0

    @property
    def repetition_s(self) -> Fraction:
        """Period of the sine, rounded to a whole number of microseconds, in s."""
        return Fraction(round(1e6 * self.period_s), _US_PER_S)

    def _delay(self) -> LinkModel:
        """Returns the parameters of the sine in microseconds, for the compiled simulation."""
        return LinkModel.sine(
            mean_us=1e3 * self.delay_ms,
            amplitude_us=1e3 * self.amplitude_ms,
            period_us=1e6 * self.period_s,
            phase_rad=self.phase_rad,
        )

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation over complete periods, in ms."""
        return self.delay_ms, self.amplitude_ms / math.sqrt(2.0)

    def _reach_ms(self) -> float:
        """Returns the longest delay, at the crest of the sine, in ms."""
        return self.delay_ms + self.amplitude_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a problem if the amplitude exceeds the mean, giving negative delays."""
        if self.amplitude_ms > self.delay_ms:
            return KeyProblem("amplitude_ms", f"must be at most delay_ms = {self.delay_ms:g}")
        return None


class TraceDelay(LinkBase, frozen=True, kw_only=True, tag="trace"):
    """Delay replayed from a recorded trace of send times and delays.

    A scenario names a file that contains the trace. A resolved scenario contains the trace
    itself, so the experiment can be repeated without the file.

    Attributes:
        trace: The trace as a string "t_us delay_us, t_us delay_us, ...", with "lost" in place
            of the delay of a lost sample.
        at_end: What happens after the last point: "hold" to keep the last delay, or "loop" to
            repeat the trace.
    """

    trace: str
    at_end: Literal["hold", "loop"] = "hold"

    @property
    def points(self) -> Points:
        """Send times and delays of the trace, in microseconds, shape (n, 2)."""
        return parse_trace(self.trace)

    @property
    def repetition_s(self) -> Fraction | None:
        """Duration of a trace that restarts at its end, in s. None if the trace ends."""
        points = self.points
        if self.has_ending_trace or len(points) == 1:
            return None
        # The last point lasts as long as the point before it.
        last_us = int(points[-1, 0])
        end_us = 2 * last_us - int(points[-2, 0])
        return Fraction(end_us, _US_PER_S)

    @property
    def has_ending_trace(self) -> bool:
        """True if the last delay of the trace holds after its end."""
        return self.at_end == "hold"

    def _delay(self) -> LinkModel:
        """Returns the settings of a recorded delay, for the compiled simulation.

        Excludes the recorded points, which are in a separate array (see `points`).
        """
        return LinkModel.follow_trace(self.at_end)

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the recorded delays, in ms.

        Each delay is weighted by the time until the next point, and lost messages are excluded.
        Both results are NaN if all messages were lost.
        """
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
        """Returns the longest delay in the trace, in ms."""
        return float(self.points[:, 1].max()) / 1e3

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a problem if the trace cannot be parsed."""
        try:
            parse_trace(self.trace)
        except ValueError as error:
            return KeyProblem("trace", str(error))
        return None


class NoInjectedDelay(LinkBase, frozen=True, kw_only=True, tag="measured"):
    """Network link of a live session with no artificial delay.

    The receiver uses a message as soon as it arrives over the real network. These arrival times
    cannot be simulated.
    """

    def _delay(self) -> LinkModel:
        """Returns the settings of a link on which no delay is simulated."""
        return LinkModel.measured()

    def _moments(self) -> tuple[float, float]:
        """Returns NaN twice, since the delay of the real network is not known in advance."""
        return math.nan, math.nan

    def _describe_delay(self) -> str:
        """Returns the name of the model."""
        return "measured"

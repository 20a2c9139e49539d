"""Finds the time after which the network delays and the ticks of all arms repeat.

A stability analysis of a loop with changing delays covers one such period. For example, two
sinusoidal delays with periods of 1.20 s and 1.21 s repeat together after 145.2 s, their least
common multiple. A delay may also be constant, or follow a trace (a table of delays over time
that restarts at its end).

Invariant:
    - Periods are computed as exact fractions of a second. A rounding error therefore cannot
      turn a short period into a long one.
    - Random delays, measured delays, and traces that end have no period.
"""

import math
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ..scenario import LinkBase, Scenario

MAX_PERIOD_TICKS = 400_000
"""Longest true period that is analysed, in ticks of the fastest site."""
MAX_NEAR_PERIOD_S = 60.0
"""Longest approximate period that is considered, and longest analysed span of a delay trace, in
s.
"""
_SLIP = 0.05
"""Largest change of the delays after a span at which they count as repeating, in ticks.

If there is no such span, the span with the smallest change is used, up to half a tick.
"""


def _find_common_period(cycles: Iterable[Fraction], common_hz: int) -> Fraction:
    """Returns the shortest time that contains a whole number of ticks and of all cycles, in s.

    For fractions in lowest terms, the least common multiple of a / b and c / d is
    lcm(a, c) / gcd(b, d).

    Args:
        cycles: Periods of the delays of the links, in s.
        common_hz: Greatest common divisor of the tick rates of all sites.
    """
    period = Fraction(1, common_hz)
    for cycle in cycles:
        numerator = math.lcm(period.numerator, cycle.numerator)
        denominator = math.gcd(period.denominator, cycle.denominator)
        period = Fraction(numerator, denominator)
    return period


def _find_near_period_s(
    cycles: Iterable[Fraction],
    rates_hz: Sequence[int],
) -> float | None:
    """Returns a time after which network delays repeat to within half a tick, in s.

    A tick is a control period. The shortest time with a deviation of at most `_SLIP` is
    preferred, then the time with the least deviation.

    Args:
        cycles: Periods of the delays of the links, in s.
        rates_hz: Tick rate of each site.

    Returns:
        The time, at most `MAX_NEAR_PERIOD_S`. `None` if there is none.
    """
    common_hz = math.gcd(*rates_hz)
    span_count = round(MAX_NEAR_PERIOD_S * common_hz)
    spans_s = np.arange(1, span_count + 1) / common_hz
    # distance, in ticks, by which the delays fail to repeat after each span
    slips = np.zeros(len(spans_s))
    for cycle in cycles:
        cycle_s = float(cycle)
        whole_cycles = np.maximum(1.0, np.round(spans_s / cycle_s))
        difference_s = np.abs(spans_s - cycle_s * whole_cycles)
        slips = np.maximum(slips, difference_s * max(rates_hz))

    limit = max(_SLIP, float(slips.min()))
    first_match = int(np.argmax(slips <= limit))
    if slips[first_match] > 0.5:
        return None
    return float(spans_s[first_match])


class DelayPeriod(NamedTuple):
    """The time after which the pattern of all network delays and ticks repeats.

    For example, a delay that alternates every 20 ms repeats after 40 ms. The exact stability
    analysis of a sampled loop requires such a period.

    Attributes:
        true_s: The period, in s, or `None` if some delay never repeats.
        span_s: A period that can be analysed, in s: the true period, or a shorter time after
            which the delays repeat to within half a tick. `None` if there is neither.
    """

    true_s: float | None
    span_s: float | None

    @property
    def is_exact(self) -> bool:
        """True if the analysed period is the true period, so that results hold for all time.

        False if the analysed period is only an approximation, or if there is no period.
        """
        return self.span_s is not None and self.span_s == self.true_s

    @classmethod
    def of_links(cls, links: Sequence[LinkBase], rates_hz: Sequence[int]) -> "DelayPeriod":
        """Finds the period after which the delays of links and the ticks of sites repeat.

        The true period is the least common multiple of the tick periods and of the periods of
        all delays. If it is longer than `MAX_PERIOD_TICKS`, the method looks
        for a shorter time after which the delays nearly repeat.

        Args:
            links: Delay models of the links.
            rates_hz: Tick rate of each site, in Hz.

        Returns:
            The period. Its attributes are `None` if a delay is random, or follows a trace that
            ends.
        """
        for link in links:
            if link.random or link.measured or link.has_ending_trace:
                return cls(None, None)
        all_cycles = [link.repetition_s for link in links]
        cycles = [cycle for cycle in all_cycles if cycle is not None]
        true_period = _find_common_period(cycles, math.gcd(*rates_hz))
        true_s = float(true_period)
        if true_s * max(rates_hz) <= MAX_PERIOD_TICKS:
            return cls(true_s, true_s)
        return cls(true_s, _find_near_period_s(cycles, rates_hz))

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> "DelayPeriod":
        """Finds the time after which the delays and ticks at the end of a run repeat.

        Delay models that the scenario replaces before the end are ignored.

        Args:
            scenario: The scenario.
        """
        links = [scenario.find_final_link(name) for name in scenario.links]
        rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
        return cls.of_links(links, rates_hz)


def find_burst_interval_s(scenario: Scenario) -> float | None:
    """Finds the mean time between two bursts of lost samples, in s.

    Bursts follow the Gilbert-Elliott model: a sample that arrives may be followed by a burst,
    in which a fraction `loss_bad` of the samples is lost. If each sample of a burst is its last
    one with probability r, a burst has 1 / r samples on average. Bursts contain the fraction
    `loss` / `loss_bad` of all samples.

    Args:
        scenario: The scenario.

    Returns:
        The longest of these times over all link models in effect at the end of the scenario, or
        `None` if no link loses samples in bursts.
    """
    intervals_s = []
    for name in scenario.links:
        link = scenario.find_final_link(name)
        if link.loss_burst <= 1.0 or not 0.0 < link.loss < link.loss_bad:
            continue
        leave_probability = 1.0 - (1.0 - 1.0 / link.loss_burst) / link.loss_bad
        samples_per_burst = 1.0 / leave_probability
        samples_between = samples_per_burst * link.loss_bad / link.loss
        sender = name.partition("->")[0]
        intervals_s.append(samples_between / scenario.sites[sender].rate_hz)
    return max(intervals_s, default=None)

"""Every delay model has the mean, the deviation and the distribution that it states."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from tests.core.builders import (
    LINK_NAME,
    SEEDS,
    Ints,
    compute_due_ns,
    draw_delays_us,
    make_channel,
)
from tests.core.philox_reference import philox_in_integers
from trilat_net.core.links.delay import MAX_DELAY_US, LinkModel, clamp_delay_us, trace_delay_us
from trilat_net.core.links.philox import link_key
from trilat_net.scenario.delay_models import LinkBase
from trilat_net.scenario.delay_models.kernel_delays import (
    CorrelatedDelay,
    GammaDelay,
    HyperExponentialDelay,
    LogNormalDelay,
    NormalDelay,
    SineDelay,
    TraceDelay,
    UniformDelay,
)
from trilat_net.scenario.delay_traces import format_trace, parse_trace

COUNT = 1_000_000
SIGMAS = 4.0


def truncate_normal(link: NormalDelay) -> Any:
    return stats.truncnorm(
        -link.delay_ms / link.deviation_ms, np.inf, link.delay_ms, link.deviation_ms
    )


def log_normal(link: LogNormalDelay) -> Any:
    sigma = math.sqrt(math.log(1 + (link.deviation_ms / link.delay_ms) ** 2))
    return stats.lognorm(
        sigma, scale=link.delay_ms / math.sqrt(1 + (link.deviation_ms / link.delay_ms) ** 2)
    )


class Mixture:
    """A floor and one of two exponentials, composed from SciPy's distributions."""

    def __init__(self, link: HyperExponentialDelay) -> None:
        self.parts = [stats.expon(link.floor_ms, mean) for mean in (link.fast_ms, link.slow_ms)]
        self.shares = (1 - link.slow_share, link.slow_share)

    def cdf(self, x: Any) -> Any:
        return sum(
            share * part.cdf(x) for share, part in zip(self.shares, self.parts, strict=True)
        )

    def mean(self) -> float:
        return float(
            sum(
                share * part.mean() for share, part in zip(self.shares, self.parts, strict=True)
            )
        )

    def std(self) -> float:
        second = sum(
            s * (p.var() + p.mean() ** 2) for s, p in zip(self.shares, self.parts, strict=True)
        )
        return math.sqrt(second - self.mean() ** 2)


INDEPENDENT: list[tuple[LinkBase, Any]] = [
    (link, law(link))
    for law, links in (
        (
            lambda u: stats.uniform(u.delay_ms - u.half_width_ms, 2 * u.half_width_ms),
            [
                UniformDelay(delay_ms=200, half_width_ms=200),
                UniformDelay(delay_ms=35.5, half_width_ms=4),
            ],
        ),
        (
            truncate_normal,
            [
                NormalDelay(delay_ms=200, deviation_ms=30),
                NormalDelay(delay_ms=10, deviation_ms=20),
                NormalDelay(delay_ms=0, deviation_ms=5),
            ],
        ),
        (
            lambda g: stats.gamma(
                (g.delay_ms / g.deviation_ms) ** 2, scale=g.deviation_ms**2 / g.delay_ms
            ),
            [
                GammaDelay(delay_ms=50, deviation_ms=20),
                GammaDelay(delay_ms=20, deviation_ms=40),
            ],
        ),
        (
            log_normal,
            [
                LogNormalDelay(delay_ms=80, deviation_ms=15),
                LogNormalDelay(delay_ms=30, deviation_ms=20),
            ],
        ),
        (
            Mixture,
            [
                HyperExponentialDelay(floor_ms=15, fast_ms=10, slow_ms=150, slow_share=0.2),
                HyperExponentialDelay(floor_ms=7.5, fast_ms=5, slow_ms=50, slow_share=0.2),
            ],
        ),
    )
    for link in links
]
CORRELATED = [
    CorrelatedDelay(delay_ms=200, deviation_ms=30, correlation=0.9),
    CorrelatedDelay(delay_ms=60, deviation_ms=8, correlation=0.5),
    CorrelatedDelay(delay_ms=100, deviation_ms=10, correlation=0.0),
]


def name_case(value: object) -> str | None:
    return value.describe() if isinstance(value, LinkBase) else None


def is_likely(delays_us: Ints, law: Any) -> bool:
    """Applies Kolmogorov and Smirnov's test at the bounds between whole microseconds, where
    rounding has no effect.
    """
    values, counts = np.unique(delays_us, return_counts=True)
    distance = np.abs(np.cumsum(counts) / len(delays_us) - law.cdf((values + 0.5) / 1e3)).max()
    return bool(stats.kstwo.sf(distance, len(delays_us)) > 1e-4)


def holds_its_moments(
    link: LinkBase, delays: Ints, mean_factor: float = 1.0, factor: float = 1.0
) -> None:
    """Compares mean and deviation with the closed form, in standard errors; factors: variances,
    if correlated.

    Rounding to whole microseconds adds 1/12 us^2 to the variance; the cut at 10 s is
    negligible.
    """
    mean_ms, deviation_ms = link.moments()
    variance = (1e3 * deviation_ms) ** 2 + 1 / 12
    centred = delays - 1e3 * mean_ms
    second = np.mean(centred**2)
    fourth = np.mean(centred**4)
    count = len(delays)
    assert abs(centred.mean()) <= SIGMAS * math.sqrt(mean_factor * variance / count)
    error = math.sqrt(factor * (fourth - second**2) / (4 * second * count))
    assert abs(delays.std() - math.sqrt(variance)) <= SIGMAS * error


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("link", "law"), INDEPENDENT, ids=name_case)
def test_mean_and_deviation_over_a_million_draws(link: LinkBase, law: Any, seed: int) -> None:  # noqa: ARG001
    holds_its_moments(link, draw_delays_us(link, seed, COUNT))


def test_a_uniform_delay_worked_out_by_hand() -> None:
    """Python's integers lead from the published generator to microseconds, with purpose 2 and attempt 0."""
    key = link_key(1, LINK_NAME)
    draws = [philox_in_integers((m, 0, 2, 0), (key & 0xFFFFFFFF, key >> 32)) for m in range(50)]
    units = [((high >> 6 << 26) + (low >> 6) + 0.5) / 2**52 for high, low, *_ in draws]
    expected = [math.floor(200_000 + 150_000 * (2 * u - 1) + 0.5) for u in units]
    assert (
        draw_delays_us(UniformDelay(delay_ms=200, half_width_ms=150), 1, 50).tolist()
        == expected
    )


@pytest.mark.parametrize(("link", "law"), INDEPENDENT, ids=name_case)
def test_the_closed_forms_are_scipys(link: LinkBase, law: Any) -> None:
    assert link.moments() == pytest.approx((law.mean(), law.std()), rel=1e-9)


@pytest.mark.parametrize(("link", "law"), INDEPENDENT, ids=name_case)
def test_the_distribution_is_the_stated_one(link: LinkBase, law: Any) -> None:
    delays = draw_delays_us(link, 5, 200_000)
    assert is_likely(delays, law)
    assert abs(np.corrcoef(delays[:-1], delays[1:])[0, 1]) < SIGMAS / math.sqrt(len(delays))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("link", CORRELATED, ids=name_case)
def test_correlated_delays_have_their_moments_and_correlations(
    link: CorrelatedDelay, seed: int
) -> None:
    """Variances of the estimates of an AR(1) sequence: Bartlett 1946."""
    delays = draw_delays_us(link, seed, COUNT)
    c = link.correlation
    holds_its_moments(link, delays, (1 + c) / (1 - c), (1 + c**2) / (1 - c**2))
    x = (delays - delays.mean()) / delays.std()
    for lag in range(1, 6):
        variance = (1 + c**2) * (1 - c ** (2 * lag)) / (1 - c**2) - 2 * lag * c ** (2 * lag)
        assert abs(np.mean(x[:-lag] * x[lag:]) - c**lag) <= SIGMAS * math.sqrt(variance / COUNT)
    assert is_likely(delays[:: 200 if c else 1], stats.norm(link.delay_ms, link.deviation_ms))


@pytest.mark.parametrize("seed", SEEDS)
def test_correlated_delays_cut_at_zero_have_their_moments(seed: int) -> None:
    """A quarter of the delays is cut; a cut sequence is correlated less than the sequence
    before the cut.
    """
    link = CorrelatedDelay(delay_ms=10, deviation_ms=15, correlation=0.8)
    delays = draw_delays_us(link, seed, COUNT)
    assert np.mean(delays == 0) == pytest.approx(stats.norm.cdf(-10 / 15), abs=0.01)
    holds_its_moments(link, delays, 1.8 / 0.2, 1.64 / 0.36)


@given(delay_ms=st.floats(0, 1e4), deviation_ms=st.floats(1e-6, 1e4))
def test_the_moments_of_a_cut_normal_distribution(delay_ms: float, deviation_ms: float) -> None:
    """No digits cancel: within its deviation, and exact if the cut is far."""
    mean_ms, deviation = CorrelatedDelay(
        delay_ms=delay_ms, deviation_ms=deviation_ms, correlation=0.5
    ).moments()
    assert delay_ms * (1 - 1e-12) <= mean_ms <= delay_ms + deviation_ms
    assert 0.5 * deviation_ms < deviation <= deviation_ms * (1 + 1e-12)
    if delay_ms > 10 * deviation_ms:
        assert (mean_ms, deviation) == pytest.approx((delay_ms, deviation_ms), rel=1e-12)


def test_a_sine_over_whole_periods() -> None:
    """The mean, the deviation and the values of a sine are exact, since it has no randomness."""
    link = SineDelay(delay_ms=120, amplitude_ms=80, period_s=2.5, phase_rad=0.4)
    delays = draw_delays_us(link, 1, COUNT)
    assert (delays == draw_delays_us(link, 2, COUNT)).all()
    assert delays.mean() / 1e3 == pytest.approx(link.moments().mean_ms, abs=5e-4)
    assert delays.std() / 1e3 == pytest.approx(link.moments().deviation_ms, abs=5e-4)
    t_s = np.arange(COUNT) / 1000
    exact = 120_000 + 80_000 * np.sin(2 * np.pi * t_s / 2.5 + 0.4)
    assert np.abs(delays - exact).max() <= 0.5 + 1e-6


# Traces.

ROWS = [(0.0, 10.0), (0.5, 40.25), (0.75, 0.0), (1.0, 7.5)]


@pytest.mark.long
def test_looped_traces_have_moments_of_one_pass() -> None:
    link = TraceDelay(trace=format_trace(ROWS), at_end="loop")
    delays = draw_delays_us(link, 1, 1250 * 800)
    assert delays.mean() / 1e3 == pytest.approx(link.moments().mean_ms, rel=1e-12)
    assert delays.std() / 1e3 == pytest.approx(link.moments().deviation_ms, rel=1e-12)


@given(
    gaps_us=st.lists(st.integers(1, 10**7), max_size=20),
    delays=st.lists(st.integers(-1, MAX_DELAY_US), min_size=21, max_size=21),
    stamp_ns=st.integers(0, 10**12),
    at_end=st.sampled_from(["hold", "loop"]),
)
def test_a_trace_holds_its_last_points_delay(
    gaps_us: list[int], delays: list[int], stamp_ns: int, at_end: str
) -> None:
    t_us = np.cumsum([0, *gaps_us])
    # others around it
    points = np.array([(7, 7), *zip(t_us, delays, strict=False), (9, 9)], dtype=np.int64)
    rows = np.zeros(1, dtype=make_channel([LinkModel()]).models.dtype)
    rows[0] = tuple(
        LinkModel.follow_trace(at_end)._replace(trace_first=1, trace_count=len(t_us))
    )
    now_us = stamp_ns // 1000
    if at_end == "loop" and gaps_us:
        now_us %= int(t_us[-1]) + gaps_us[-1]
    expected = delays[max(n for n in range(len(t_us)) if t_us[n] <= now_us)]
    assert trace_delay_us(stamp_ns, rows[0], points) == expected


def test_a_trace_may_lose_samples() -> None:
    link = TraceDelay(trace=format_trace([(0.0, 5.0), (0.003, math.inf), (0.005, 6.0)]))
    points = parse_trace(link.trace)
    due_ns = compute_due_ns(
        make_channel([link.to_core_model()._replace(trace_count=3)], points=points), 8
    )
    assert due_ns.tolist() == [
        5_000_000,
        6_000_000,
        7_000_000,
        -1,
        -1,
        11_000_000,
        12_000_000,
        13_000_000,
    ]
    assert link.moments().mean_ms == pytest.approx((3 * 5.0 + 2 * 6.0) / 5)


# Whole microseconds.


@given(st.floats(-1e12, 1e12))
def test_delays_are_whole_microseconds_below_ten_seconds(delay_us: float) -> None:
    rounded = clamp_delay_us(delay_us)
    assert isinstance(rounded, int)
    assert 0 <= rounded <= MAX_DELAY_US
    if 0 <= delay_us <= MAX_DELAY_US:
        assert abs(rounded - delay_us) <= 0.5

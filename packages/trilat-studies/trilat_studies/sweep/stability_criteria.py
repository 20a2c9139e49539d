"""Evaluates closed-form stability conditions for scenarios of a sweep.

A condition is an inequality between parameters of a scenario, such as a gain and a delay. A
condition is used only if all of its assumptions hold. For the proportional law with damping,
P+d, the condition accounts for sampling.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from trilat_net.analysis import build_arm_rows
from trilat_net.core import Array, DominanceMatrix
from trilat_net.errors import ScenarioError
from trilat_net.laws import COMMON_MOTION_SHARE
from trilat_net.scenario import Scenario

_ROUNDING = 1e-6
"""Tolerance for rounding errors of delays in ticks."""
_MAX_ROOT_STEPS = 500
"""Maximum number of iterations of Brent's method."""


class StabilityCriterion(NamedTuple):
    """A closed-form stability condition, evaluated for one scenario.

    The condition is a theoretical inequality between scenario parameters, such as a gain and a
    delay.

    Attributes:
        symbol: Equation that holds where the condition is only just met, in TeX, for the legend
            of a figure.
        text: The same equation as plain text.
        source: Origin of the condition, and whether it is necessary or sufficient.
        excess: Difference between the two sides of the inequality, in their unit. Positive if
            the condition is met.
    """

    symbol: str
    text: str
    source: str
    excess: float

    @classmethod
    def evaluate(cls, scenario: Scenario) -> "StabilityCriterion | None":
        """Evaluates the closed-form stability condition that applies to a scenario.

        For example, identical arms under the law P+d are stable if the damping exceeds a
        certain multiple of the stiffness times the delay. A map shows the points at which the
        condition is only just met, alongside the measured edge.

        Args:
            scenario: The scenario to which the condition is applied.

        Returns:
            The condition, or `None` if the scenario violates an assumption of every known
            condition. This is the case if, for example, a parameter changes during the run, or
            a site stops following a peer whose samples are too old.
        """
        stops_following = any(spec.on_stale.action != "use" for spec in scenario.sites.values())
        if scenario.timeline or stops_following:
            return None
        if any(arm.shares_pose for arm in scenario.arms.values()):
            return None

        criterion = _evaluate_damping_criterion(scenario)
        if criterion is not None:
            return criterion
        if any(arm.chain is not None for arm in scenario.arms.values()):
            return None  # the other criterion holds only for the planar arm with two joints
        return _evaluate_sampling_criterion(scenario)

    @staticmethod
    def find_edge(
        criterion: "Callable[[float], StabilityCriterion | None]", low: float, high: float
    ) -> float | None:
        """Finds the parameter value at which a stability condition is only just met.

        The value is located with Brent's method.

        Args:
            criterion: Evaluates the criterion at a value. May raise ScenarioError for a value
                that is not valid, such as a fraction where an integer is needed.
            low: Lower end of the searched interval.
            high: Upper end of the searched interval.

        Returns:
            The value, or `None` if the criterion has the same sign at both ends or does not
            apply at a value between them.
        """
        # imported late: SciPy costs half a second, and most commands do not need it
        from scipy.optimize import brentq

        def excess(value: float) -> float:
            """Returns the margin of the condition at a value, negative if it is violated."""
            evaluated = criterion(value)
            if evaluated is None:
                raise ScenarioError("no criterion covers it")
            return evaluated.excess

        tolerance = 1e-8 * (high - low)
        try:
            met_at_low = excess(low) > 0.0
            met_at_high = excess(high) > 0.0
            if met_at_low == met_at_high:
                return None
            edge = brentq(excess, low, high, xtol=tolerance, maxiter=_MAX_ROOT_STEPS)
            return float(edge)
        except ScenarioError:
            return None


def _evaluate_damping_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Evaluates the condition on the damping of the law P+d, which has gains K and d.

    For two sites with delays T1 and T2, the loop is stable if

        4 d1 d2 > (T1 + T2)^2 K1 K2.

    For N identical sites with delay T and a reversible matrix alpha of dominance factors, whose
    smallest eigenvalue is lambda_min, the loop is stable if

        d > max(abs(lambda_min), 0.2172) K T.

    Under these conditions, the loop has no root on the unit circle for any mass above d h,
    where h is the period of a tick. No damping stabilises lighter arms at this tick rate
    (docs/theory/damping-conditions.md, 13).

    Returns:
        The condition, or `None` if it does not cover the scenario.
    """
    if scenario.scheme != "second_order":
        return None
    delays_s = _list_delays_s(scenario)
    rates_hz = {spec.rate_hz for spec in scenario.sites.values()}
    if delays_s is None or len(rates_hz) > 1:
        return None
    rate_hz = rates_hz.pop()
    K = []
    d = []
    for spec in scenario.sites.values():
        # The criteria do not cover different gains, because the arm couples its joints.
        gains = spec.control.find_uniform_spring()
        if gains is None:
            return None
        K.append(gains[0])
        d.append(gains[1])
    arms = [build_arm_rows(scenario, site) for site in scenario.names]
    least_inertia = min(arm.least_inertia_kg_m2 for arm in arms)
    if max(d) / rate_hz >= least_inertia:
        return None  # an arm is lighter than d h

    delays_ticks = []
    for delay_s in delays_s:
        delay_ticks = math.ceil(delay_s * rate_hz - _ROUNDING)
        delays_ticks.append(max(1, delay_ticks))  # used at the next tick at the earliest
    if len(K) == 2:
        mean_delay_ticks = 0.5 * sum(delays_ticks)
        pair_excess = _compute_pair_excess(K, d, mean_delay_ticks, rate_hz)
        return StabilityCriterion(
            symbol=r"$4\,d_1 d_2 = (T_1 + T_2)^2 K_1 K_2$",
            text="4 d1 d2 = (T1 + T2)² K1 K2",
            source=_DAMPING_SOURCE,
            excess=pair_excess,
        )

    are_equal = len({*K}) == len({*d}) == len({*delays_ticks}) == 1
    least_eigenvalue = DominanceMatrix(scenario.alpha).find_least_eigenvalue()
    if not are_equal or least_eigenvalue is None:
        return None
    common_delay_ticks = delays_ticks[0]
    ratio = _compute_required_ratio(least_eigenvalue, common_delay_ticks)
    required_d = K[0] * ratio * common_delay_ticks / rate_hz
    excess = d[0] - required_d
    if -least_eigenvalue < COMMON_MOTION_SHARE:
        return StabilityCriterion(
            symbol=r"$d = 0.2172\,K\,T$",
            text="d = 0.2172 K T",
            source=_DAMPING_SOURCE,
            excess=excess,
        )
    return StabilityCriterion(
        symbol=r"$d = |\lambda_{\min}(\alpha)|\,K\,T$",
        text="d = abs(lambda_min(alpha)) K T",
        source=_DAMPING_SOURCE,
        excess=excess,
    )


_DAMPING_SOURCE = "P+d: sufficient for arms of any mass, and necessary for the worst masses"


_CIRCLE_POINTS = 400
"""Number of points in each of the two parts of the sampled half circle."""


def _sample_unit_circle(delay_ticks: float) -> tuple[Array, Array, Array]:
    """Returns the frequencies at which the stability criteria of P+d are evaluated.

    The loop is sampled with the tick period h. At its stability limit, a root lies at z = exp(i
    phi) on the unit circle, where phi = w h for the frequency w. For the integration scheme
    "second_order", the equation of such a root contains two functions of t = tan(phi/2)
    (docs/theory/damping-conditions.md, 13):

    - the discrete frequency v = 2 t, in units of 1/h, which equals phi for small phi;
    - the lag 2 t^3 / (1 + 3 t^2), by which the scheme reduces the damping.

    The criteria take an extreme value over all phi, so the angles need not be sorted. The first
    angle approximates the limit phi -> 0. A dense set of angles covers the first turn of the
    delay, where phi * `delay_ticks` goes from 0 to 2 pi. The remaining angles lie between 0 and
    pi.

    Args:
        delay_ticks: Delay of the loop, in ticks.

    Returns:
        The angles phi in rad, the discrete frequencies v, and the lags, all of the same shape.
    """
    almost_zero = 1e-7 / delay_ticks
    first_turn_end = min(2.0 * np.pi / delay_ticks, 3.0)  # below pi, where t is infinite
    first_turn = np.linspace(0.0, first_turn_end, _CIRCLE_POINTS)[1:]
    half_circle = np.linspace(0.0, np.pi, _CIRCLE_POINTS)[1:-1]
    phi = np.concatenate([[almost_zero], first_turn, half_circle])
    t = np.tan(0.5 * phi)
    denominator = 1.0 + 3.0 * t**2
    lag = 2.0 * t**3 / denominator
    discrete_frequency = 2.0 * t
    return phi, discrete_frequency, lag


def _compute_required_ratio(least_eigenvalue: float, delay_ticks: int) -> float:
    """Returns the damping that identical sites with the law P+d need, relative to K T.

    K is the stiffness, d the damping, and T = n h the delay, where h is the tick period. Let a
    be a number between the smallest eigenvalue of the matrix of dominance factors and its
    largest eigenvalue, 1. A root on the unit circle at the angle phi, with the discrete
    frequency v and the lag of `_sample_unit_circle`, requires
    (docs/theory/damping-conditions.md, 13):

        d / (K T) = (lag (1 - a cos(n phi)) - a sin(n phi)) / (v n)

    If d / (K T) exceeds the largest value of the right-hand side, there is no such root, and
    the loop is stable. Since the right-hand side is linear in a, only the two extreme values of
    a matter.

    Args:
        least_eigenvalue: Smallest eigenvalue of the matrix of dominance factors, which must be
            reversible.
        delay_ticks: Delay n, in ticks.

    Returns:
        The largest value of the right-hand side, dimensionless.
    """
    phi, discrete_frequency, lag = _sample_unit_circle(delay_ticks)
    cosine = np.cos(delay_ticks * phi)
    sine = np.sin(delay_ticks * phi)
    ratios = []
    for eigenvalue in (least_eigenvalue, 1.0):
        lag_part = lag * (1.0 - eigenvalue * cosine)
        numerator = lag_part - eigenvalue * sine
        ratio = numerator / (discrete_frequency * delay_ticks)
        ratios.append(ratio)
    return float(np.max(ratios))


def _compute_pair_excess(
    K: list[float], d: list[float], mean_delay_ticks: float, rate_hz: float
) -> float:
    """Returns the margin of two P+d sites' damping over the required damping, in N m s/rad.

    In continuous time, the loop is stable if 2 sqrt(d1 d2) > (T1 + T2) sqrt(K1 K2), with
    stiffnesses K, dampings d and delays T. In the sampled loop, two quantities depend on the
    frequency (docs/theory/damping-conditions.md, 13). With the angle phi, the discrete
    frequency v in 1/s, the lag of `_sample_unit_circle` and a mean delay of n ticks, they are:

        effective damping of a site = d - K lag / v, at least 0
        effective mean delay = abs(sin(n phi) + lag cos(n phi)) / v

    The difference between the two sides of the condition is computed with these quantities, and
    its minimum over all frequencies is returned. For phi -> 0, the effective quantities are d
    and (T1 + T2) / 2.

    Args:
        K: Stiffnesses of the two sites, in N m/rad.
        d: Dampings of the two sites, in N m s/rad.
        mean_delay_ticks: The mean delay n, half of T1 + T2, in ticks.
        rate_hz: Tick rate of both sites.

    Returns:
        The minimum difference. Positive if the loop is stable.
    """
    phi, discrete_frequency, lag = _sample_unit_circle(mean_delay_ticks)
    frequency_per_s = discrete_frequency * rate_hz
    K_1, K_2 = K
    d_1, d_2 = d
    damping_1 = np.maximum(d_1 - K_1 * lag / frequency_per_s, 0.0)
    damping_2 = np.maximum(d_2 - K_2 * lag / frequency_per_s, 0.0)

    delay_angle = mean_delay_ticks * phi
    coupling = np.sin(delay_angle) + lag * np.cos(delay_angle)
    mean_delay_s = np.abs(coupling) / frequency_per_s

    mean_stiffness = math.sqrt(K_1 * K_2)
    half_excess = np.sqrt(damping_1 * damping_2) - mean_stiffness * mean_delay_s
    return float(2.0 * np.min(half_excess))  # doubled, because the delay is the mean of two


def _evaluate_sampling_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Evaluates the condition on the tick period of the adaptive law.

    The adaptive law estimates the parameters of its arm while it runs, with the adaptation gain
    Gamma. If gravity is estimated too fast for the tick rate, the arm keeps swinging. The arms
    come to rest if, for each site, approximately

        Gamma g^2 h < Kp,

    where g is the gravitational acceleration, h the period of a tick and Kp the damping gain of
    the law, see `Adaptive.find_sampling_excess`. The rule holds for the integration scheme
    `digital`, and for delays of at most one tick.

    Returns:
        The condition for the site with the smallest excess, Kp - Gamma g^2 h, which is positive
        if the condition is met. `None` if a site has another law, or if the condition does not
        cover the scenario for another reason.
    """
    delays_s = _list_delays_s(scenario)
    if not scenario.is_digital or delays_s is None:
        return None

    site_excess = []
    for spec in scenario.sites.values():
        tick_s = 1.0 / spec.rate_hz
        excess = spec.control.find_sampling_excess(spec.arm.g_m_s2, tick_s)
        if excess is None or max(delays_s) > tick_s:
            return None
        site_excess.append(excess)
    return StabilityCriterion(
        symbol=r"$\Gamma g^2 h = K_p$",
        text="Gamma g² h = Kp",
        source=(
            "a rule of thumb for arms of about 1 m and no delay: "
            "gravity must not be estimated too fast for the tick rate"
        ),
        excess=min(site_excess),
    )


def _list_delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the constant delays of all links whose samples influence an arm, in s.

    Links with a dominance factor of 0 are excluded, because their samples have no effect.

    Returns:
        The delays, or `None` if a delay is not constant or a link loses messages.
    """
    delays_s = []
    for site in scenario.names:
        dominance_factors = scenario.dominance[site]
        for peer in scenario.peers(site):
            if dominance_factors.get(peer, 0.0) == 0.0:
                continue
            link = scenario.links[f"{peer}->{site}"]
            if link.constant_delay_ms is None:
                return None
            if link.random or link.loss or link.outages_s:
                return None
            moments = link.moments()
            delay_ms = max(moments.mean_ms, link.playout_ms)
            delays_s.append(delay_ms / 1e3)
    return delays_s

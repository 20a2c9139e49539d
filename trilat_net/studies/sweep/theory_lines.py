"""Theory on a stability map.

Closed-form stability criteria, the dominant root of the linear loop, and the lines along which either is
marginal.

Invariant: a line is the zero set of a quantity that theory gives at every grid point; no run of the map
enters. A criterion applies only if all of its hypotheses hold, and its excess is positive where it is
met. With scheme `digital` the loop counts as sampled, tick by tick, otherwise as continuous.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...core.vectors import Array
from ...errors import ScenarioError
from ...scenario import Scenario
from ...scenario.delay_models import ConstantDelay, LinkBase, NoDelay
from ...scenario.laws import Adaptive, ProportionalDamped
from .map_plane import PlaneAxis

_GRAVITY = slice(3, 5)
"""The parameters of Eq. (24) that gravity's torque consists of."""
_REAL = 1e-9


class StabilityCriterion(NamedTuple):
    """A condition, at one scenario.

    Attributes:
        symbol: its edge, as a legend has it.
        text: the same for plain text.
        source: where it is from, and what it is worth.
        excess: how much more there is than it asks for, in its own unit; positive: it is met.
    """

    symbol: str
    text: str
    source: str
    excess: float


def evaluate_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Returns the condition in closed form that covers a scenario, or None."""
    if scenario.timeline or any(spec.on_stale.action != "use" for spec in scenario.sites.values()):
        return None
    return _damped(scenario) or _sampled(scenario)


def _damped(scenario: Scenario) -> StabilityCriterion | None:
    """P+d: 4 d1 d2 > (T1 + T2)^2 K1 K2 for two sites, d > abs(lambda_min(alpha)) K T for N equal ones."""
    laws = [spec.control for spec in scenario.sites.values()]
    delays_s = _delays_s(scenario)
    if delays_s is None:
        return None
    K, d = [], []
    for law in laws:
        if not isinstance(law, ProportionalDamped) or law.gravity != 1.0:
            return None
        if len({*law.K}) > 1 or len({*law.d}) > 1:  # the arm couples its joints
            return None
        K.append(law.K[0])
        d.append(law.d[0])
    source = "P+d: sufficient whatever the arms weigh, and necessary where they are heavy: K T² << M"
    if len(laws) == 2:
        excess = 2.0 * np.sqrt(d[0] * d[1]) - sum(delays_s) * np.sqrt(K[0] * K[1])
        symbol = r"$4\,d_1 d_2 = (T_1 + T_2)^2 K_1 K_2$"
        return StabilityCriterion(symbol, "4 d1 d2 = (T1 + T2)² K1 K2", source, float(excess))
    roots = np.linalg.eigvals(scenario.alpha)
    if len({*K}) > 1 or len({*d}) > 1 or len({*delays_s}) > 1 or np.abs(roots.imag).max() > _REAL:
        return None
    least = abs(float(roots.real.min()))
    symbol = r"$d = |\lambda_{\min}(\alpha)|\,K\,T$"
    return StabilityCriterion(
        symbol, "d = abs(lambda_min(alpha)) K T", source, d[0] - least * K[0] * delays_s[0]
    )


def _sampled(scenario: Scenario) -> StabilityCriterion | None:
    """The adaptive law as `digital` computes it, without delay: it rests where Gamma g^2 h < Kp, about."""
    delays_s = _delays_s(scenario)
    if scenario.scheme != "digital" or delays_s is None:
        return None
    excess = []
    for spec in scenario.sites.values():
        law, h_s = spec.control, 1.0 / spec.rate_hz
        if not isinstance(law, Adaptive) or max(delays_s) > h_s:
            return None
        excess.append(min(law.Kp) - max(law.Gamma[_GRAVITY]) * spec.arm.g_m_s2**2 * h_s)
    source = "a rule for arms of about 1 m and no delay: the estimate of gravity against the lag of a tick"
    return StabilityCriterion(r"$\Gamma g^2 h = K_p$", "Gamma g² h = Kp", source, min(excess))


def _delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the delays of all links that carry a share, s; None where one is not constant or loses."""
    delays_s = []
    for name in scenario.names:
        for peer in scenario.peers(name):
            if scenario.dominance[name].get(peer, 0.0) == 0.0:
                continue
            link: LinkBase = scenario.links[f"{peer}->{name}"]
            if not isinstance(link, ConstantDelay | NoDelay) or link.random or link.loss or link.outages_s:
                return None
            delays_s.append(max(link.moments().mean_ms, link.playout_ms) / 1e3)
    return delays_s


ScenarioAt = Callable[[float, float], Scenario]
"""The scenario of a panel at (x, y)."""

_PAIR = ((None, -1), (1, None))
"""All places but the last along an axis, and all but the first."""
_TOLERANCE = 1e-6
_MOST = 60
LINEAR_ANALYSIS = "linear analysis"
_ABOUT = "where the rightmost root of the loop, linearised, crosses the imaginary axis"


class TheoryLine(NamedTuple):
    """One line.

    Attributes:
        label: what the legend calls it.
        text: the same for plain text.
        about: where it is from.
        spare: what is zero on it and positive where theory says stable, shape (y, x); NaN where it is silent.
        rank: how it is drawn: 0 is the first look, and so on.
    """

    label: str
    text: str
    about: str
    spare: Array
    rank: int

    @property
    def there(self) -> bool:
        """Whether it goes through the map: between four places that theory speaks of, some on either side."""
        corners = np.array([self.spare[a:b, c:d] for a, b in _PAIR for c, d in _PAIR])
        stable = (corners > 0.0).sum(axis=0)
        return bool((np.isfinite(corners).all(axis=0) & (stable > 0) & (stable < len(corners))).any())

    def crossings(self, column: int, y: PlaneAxis) -> list[float]:
        """Returns where it crosses a column, from below; between two places as if it went straight."""
        spare, values = self.spare[:, column], y.values
        found = []
        for n in range(len(values) - 1):
            a, b = float(spare[n]), float(spare[n + 1])
            if np.isfinite([a, b]).all() and (a > 0.0) != (b > 0.0):
                found.append(values[n] + (values[n + 1] - values[n]) * a / (a - b))
        return found


def trace_closed_form(at: ScenarioAt, x: PlaneAxis, y: PlaneAxis) -> TheoryLine | None:
    """Returns the line of the condition in closed form; None where there is none, or not within the map."""
    told = [[evaluate_criterion(at(right, up)) for right in x.values] for up in y.values]
    first = next((one for row in told for one in row if one is not None), None)
    if first is None:
        return None
    spare = np.array([[np.nan if one is None else one.excess for one in row] for row in told])
    line = TheoryLine(first.symbol, first.text, first.source, spare, 0)
    return line if line.there else None


def trace_linear_analysis(
    columns: Sequence[tuple[list[float], list[str]]],
) -> tuple[TheoryLine | None, list[str]]:
    """Returns the line of the linear analysis, and what is to be known of it.

    Args:
        columns: per value of the x axis the real parts of the rightmost roots, 1/s, and remarks.
    """
    spare = -np.array([growths for growths, _ in columns]).T
    remarks = list(dict.fromkeys(remark for _, some in columns for remark in some))
    line = TheoryLine(LINEAR_ANALYSIS, LINEAR_ANALYSIS, _ABOUT, np.where(np.isinf(spare), np.nan, spare), 1)
    return line if line.there else None, remarks


def find_criterion_edge(
    condition: Callable[[float], StabilityCriterion | None], low: float, high: float
) -> float | None:
    """Returns where between two values a condition is just met, or None.

    By regula falsi; the weight of the end that stays is halved, so that it does not stay for ever.

    Args:
        condition: tells of a value how much more there is than it asks for; may refuse one.
        low: from.
        high: to.
    """
    a, b = _excess(condition, low), _excess(condition, high)
    if a is None or b is None or (a > 0.0) == (b > 0.0):
        return None
    small = _TOLERANCE * (abs(a) + abs(b))
    middle = low
    for _ in range(_MOST):
        middle = (low * b - high * a) / (b - a)
        here = _excess(condition, middle)
        if here is None or abs(here) <= small:
            return None if here is None else middle
        if (here > 0.0) == (a > 0.0):
            low, a, b = middle, here, 0.5 * b
        else:
            high, b, a = middle, here, 0.5 * a
    return middle


def _excess(condition: Callable[[float], StabilityCriterion | None], value: float) -> float | None:
    """Returns what a condition has to spare; None where it does not speak, as between whole numbers."""
    try:
        found = condition(value)
    except ScenarioError:
        return None
    return None if found is None else found.excess

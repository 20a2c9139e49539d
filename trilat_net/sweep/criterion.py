"""Conditions in closed form under which a loop is stable, where its law has one.

Law: a condition speaks only where all it presumes holds: elsewhere there is none. Each says how far it is
from being met, with the sign that counts: positive where it is.
"""

from typing import NamedTuple

import numpy as np

from ..scenario import Scenario
from ..scenario.laws import Adaptive, ProportionalDamped
from ..scenario.link import LinkBase
from ..scenario.links import Constant, NoDelay

_GRAVITY = slice(3, 5)
"""The parameters of Eq. (24) that gravity's torque consists of."""
_REAL = 1e-9


class Criterion(NamedTuple):
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


def criterion(scenario: Scenario) -> Criterion | None:
    """Returns the condition in closed form that covers a scenario, or None.

    Args:
        scenario: the experiment; its start, its hands and its walls do not enter.
    """
    if scenario.timeline or any(spec.on_stale.action != "use" for spec in scenario.sites.values()):
        return None
    return _damped(scenario) or _sampled(scenario)


def _damped(scenario: Scenario) -> Criterion | None:
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
        return Criterion(symbol, "4 d1 d2 = (T1 + T2)² K1 K2", source, float(excess))
    roots = np.linalg.eigvals(scenario.alpha)
    if len({*K}) > 1 or len({*d}) > 1 or len({*delays_s}) > 1 or np.abs(roots.imag).max() > _REAL:
        return None
    least = abs(float(roots.real.min()))
    symbol = r"$d = |\lambda_{\min}(\alpha)|\,K\,T$"
    return Criterion(symbol, "d = abs(lambda_min(alpha)) K T", source, d[0] - least * K[0] * delays_s[0])


def _sampled(scenario: Scenario) -> Criterion | None:
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
    return Criterion(r"$\Gamma g^2 h = K_p$", "Gamma g² h = Kp", source, min(excess))


def _delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the delays of all links that carry a share, s; None where one is not constant or loses."""
    delays_s = []
    for name in scenario.names:
        for peer in scenario.peers(name):
            if scenario.dominance[name].get(peer, 0.0) == 0.0:
                continue
            link: LinkBase = scenario.links[f"{peer}->{name}"]
            if not isinstance(link, Constant | NoDelay) or link.random or link.loss or link.outages_s:
                return None
            delays_s.append(max(link.moments().mean_ms, link.playout_ms) / 1e3)
    return delays_s

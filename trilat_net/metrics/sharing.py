"""Force sharing: who feels how much of a torque at another site, when all rest.

Law: at rest e_i obeys sum_i pi_i e_i = 0, whatever the delays, pi the left Perron vector of the shares. With
gravity known and e_i held by a stiffness K_i (Kp Lambda of the paper's law, K of P+d and PD+d), the torques
tau_i ON the arms therefore obey, per joint,

    sum_i (pi_i / K_i) tau_i = 0,

and where two sites are loaded, a hand at i feels tau_s (pi_s / K_s) / (pi_i / K_i) of a torque at s: for
equal gains tau_s beta_s / beta_i. Where gravity is learnt the estimates take up the load, and nothing is
expected.
"""

from typing import NamedTuple

import numpy as np

from ..certificate.weights import closed_groups, left_vector
from ..core.arm import JOINTS, Array
from ..core.exogenous import Acts
from ..core.setup import Law
from ..scenario import Scenario, SiteSpec
from .energy import theta_known
from .rest import LEAST_NM, Rest
from .said import Facts, Said, said

GRAVITY = (3, 4)
"""The parameters of gravity, theta_4 and theta_5."""
LOADED = 0.02
"""A site with less than this share of the largest torque is not loaded."""


class Shared(NamedTuple):
    """Two loaded sites in a window at rest.

    Attributes:
        from_s: the window's first tick, s.
        to_s: its last, s.
        joint: which joint, from 1.
        pushed: the site of the torque.
        pushed_nm: that torque, ON its arm, N m.
        by_wall: whether a wall makes most of it.
        holds: the site whose hand feels it.
        felt_nm: what that hand feels: the negative of what it does to its arm, N m.
        expected_nm: what the shares say that it feels, N m; or why they say nothing.
    """

    from_s: float
    to_s: float
    joint: int
    pushed: str
    pushed_nm: float
    by_wall: bool
    holds: str
    felt_nm: float
    expected_nm: Said

    @property
    def off(self) -> float | None:
        """How far what is felt is from what is expected, as a share of that; None where nothing is."""
        expected = self.expected_nm.value
        return None if expected is None or expected == 0.0 else abs(self.felt_nm / expected - 1.0)


class Lever(NamedTuple):
    """The torques of a joint in a window at rest, of all loaded sites.

    Attributes:
        from_s: the window's first tick, s.
        to_s: its last, s.
        joint: which joint, from 1.
        torque_nm: per loaded site, ON its arm, N m.
        weight: per loaded site pi_i / K_i, the largest of all sites 1; or why there are none.
        imbalance: |sum of weight times torque| / largest |weight times torque|; or why it is not known.
    """

    from_s: float
    to_s: float
    joint: int
    torque_nm: dict[str, float]
    weight: dict[str, Said]
    imbalance: Said


def levers(scenario: Scenario, windows: list[Rest]) -> list[Lever]:
    """Returns the loaded joints of every window at rest."""
    found = []
    for window in windows:
        weights = _weights(scenario, window.alpha)
        for joint in range(JOINTS):
            torque = {site: float(values[joint]) for site, values in window.torque.items()}
            least = max(LEAST_NM, LOADED * max(map(abs, torque.values())))
            loaded = {site: value for site, value in torque.items() if abs(value) >= least}
            if loaded:
                found.append(_lever(window, joint, loaded, weights))
    return found


def resting(absent: list[str], windows: list[Rest]) -> Said:
    """Returns how many windows at rest there are, or why there are none."""
    if absent:
        return Said(None, f"no records of {', '.join(absent)}")
    return said(len(windows) or None, NO_REST)


def of_run(absent: list[str], windows: list[Rest], pairs: list[Shared]) -> Facts:
    """Returns how far force sharing is from the shares, in the pair where it is furthest."""
    offs = [pair.off for pair in pairs if pair.off is not None]
    if offs:
        return {"sharing_off": said(max(offs))}
    whys = dict.fromkeys(pair.expected_nm.why for pair in pairs)
    none = resting(absent, windows)
    unloaded = "no two sites are loaded in a window at rest"
    return {"sharing_off": Said(None, none.why or "; ".join(whys) or unloaded, applies=bool(absent))}


NO_REST = "no second in which all sites rest under torques that stand"


def _lever(window: Rest, joint: int, torque: dict[str, float], weights: Array | str) -> Lever:
    if isinstance(weights, str):
        why = Said(None, weights)
        return Lever(window.from_s, window.to_s, joint + 1, torque, dict.fromkeys(torque, why), why)
    column = weights[:, joint] / weights[:, joint].max()
    weight = dict(zip(window.torque, column.tolist(), strict=True))
    moments = [weight[site] * value for site, value in torque.items()]
    largest = max(map(abs, moments))
    imbalance = said(
        abs(sum(moments)) / largest if largest > 0.0 else None, "nobody who is followed is loaded"
    )
    shown = {site: said(weight[site]) for site in torque}
    return Lever(window.from_s, window.to_s, joint + 1, torque, shown, imbalance)


def shared(scenario: Scenario, windows: list[Rest], found: list[Lever]) -> list[Shared]:
    """Returns who felt what, of every joint in a window at rest at which two sites are loaded.

    The hand that feels is one that is a spring; where both are or none, the slave is the one that is pushed.
    """
    at = {window.from_s: window for window in windows}
    pairs = []
    for lever in found:
        if len(lever.torque_nm) == 2:
            pushed, holds = sorted(lever.torque_nm, key=lambda site: _holds(scenario, site, lever.to_s))
            wall = float(at[lever.from_s].walls[pushed][lever.joint - 1])
            torque = lever.torque_nm[pushed]
            pairs.append(
                Shared(
                    lever.from_s,
                    lever.to_s,
                    lever.joint,
                    pushed,
                    torque,
                    abs(wall) > 0.5 * abs(torque),
                    holds,
                    -lever.torque_nm[holds],
                    _expected(lever, pushed, holds),
                )
            )
    return pairs


def _expected(lever: Lever, pushed: str, holds: str) -> Said:
    one, other = lever.weight[pushed], lever.weight[holds]
    if one.value is None or other.value is None:
        return Said(None, one.why)
    if other.value == 0.0:
        return Said(None, f"nobody ends up following {holds}")
    return said(lever.torque_nm[pushed] * one.value / other.value)


def _holds(scenario: Scenario, site: str, at_s: float) -> tuple[bool, bool]:
    """Returns how much a site is one that holds: a spring's hand is there, and no wall; it is a master."""
    spec = scenario.sites[site]
    springs = any(
        hand.actor.acts in (Acts.HAND, Acts.TASK_HAND) and hand.actor.start_s <= at_s < hand.actor.end_s
        for hand in spec.hands
    )
    return springs and not spec.environment, spec.role == "master"


def _weights(scenario: Scenario, alpha: Array) -> Array | str:
    """Returns pi_i / K_i per joint, shape (N, 2); or why that says nothing of torques."""
    if len(closed_groups(alpha)) > 1:
        return "two groups of sites follow nobody else: who feels whom is not unique"
    stiffness = []
    for site, spec in scenario.sites.items():
        K, why = _stiffness(spec)
        if why:
            return f"{site}: {why}"
        stiffness.append(K)
    return left_vector(alpha)[:, np.newaxis] / np.array(stiffness)


def _stiffness(spec: SiteSpec) -> tuple[Array, str]:
    """Returns what holds e at rest, shape (2,), N m/rad, and why that is not all that acts."""
    gains = spec.control.gains(spec.arm.theta)
    if gains.law is Law.OWN:
        return np.zeros(JOINTS), "a law of somebody's own"
    if not theta_known(spec):
        return np.zeros(JOINTS), "theta of the arm is not known"
    if any(gains.k_f):
        return np.zeros(JOINTS), "it reflects force: e is not all that its law goes by"
    adaptive = gains.law is Law.ADAPTIVE
    estimate, truth = gains.theta_hat0 if adaptive else gains.known, spec.arm.theta
    if adaptive and any(gains.Gamma[n] > 0.0 for n in GRAVITY):
        return np.zeros(JOINTS), "gravity is learnt: the estimates take up the load"
    if any(estimate[n] != truth[n] for n in GRAVITY) and spec.arm.g_m_s2 > 0.0:
        return np.zeros(JOINTS), "gravity is not known exactly"
    K = np.array(gains.Kp) * np.array(gains.Lambda) if adaptive else np.array(gains.K)
    return K, "" if (K > 0.0).all() else "nothing holds its e"

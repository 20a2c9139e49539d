"""Force sharing: the part of a torque at one site that an operator at another site feels, at rest.

Invariant: the torques tau_i ON the arms obey sum_i (pi_i / K_i) tau_i = 0 per joint, pi being the left
Perron vector of the dominance matrix and K_i what holds e_i; nothing is expected if gravity is adapted: the
estimates take up the load. docs/metrics.md derives it.
"""

from typing import NamedTuple

import numpy as np

from ...core.exogenous import TorqueKind
from ...core.site_setup import Law
from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...scenario import Scenario, SiteSpec
from ..lyapunov_weights import find_closed_groups, left_perron_vector
from .metric_catalogue import Metric, MetricValues, metric
from .parameter_error import has_known_theta
from .static_windows import MIN_LOAD_NM, StaticWindow

GRAVITY_THETA = (3, 4)
"""The parameters of gravity, theta_4 and theta_5."""
MIN_LOAD_SHARE = 0.02
"""A site with less than this share of the largest torque is not loaded."""


class SharingRatio(NamedTuple):
    """Two loaded sites in a static window, from its first tick to its last; joints count from 1.

    Attributes:
        pushed, pushed_nm: the site of the torque, and that torque, ON its arm.
        by_wall: True if the environment makes most of it.
        holds, felt_nm: the site of the operator that feels it, and what: the negative of its own ON its arm.
        expected_nm: the torque by the dominance factors.
    """

    from_s: float
    to_s: float
    joint: int
    pushed: str
    pushed_nm: float
    by_wall: bool
    holds: str
    felt_nm: float
    expected_nm: Metric

    @property
    def off(self) -> float | None:
        """Relative deviation of the felt torque from the expected one; None without one."""
        expected = self.expected_nm.value
        return None if expected is None or expected == 0.0 else abs(self.felt_nm / expected - 1.0)


class JointLoad(NamedTuple):
    """The torques of a joint, from 1, in a static window, of all loaded sites.

    Attributes:
        torque_nm: per loaded site, ON its arm.
        weight: per loaded site pi_i / K_i, the largest of all sites 1.
        imbalance: |sum of weight times torque| / largest |weight times torque|.
    """

    from_s: float
    to_s: float
    joint: int
    torque_nm: dict[str, float]
    weight: dict[str, Metric]
    imbalance: Metric


def find_joint_loads(scenario: Scenario, windows: list[StaticWindow]) -> list[JointLoad]:
    """Returns the loaded joints of every static window."""
    loads = []
    for window in windows:
        weights = _torque_weights(scenario, window.alpha)
        for joint in range(JOINTS):
            torque = {site: float(values[joint]) for site, values in window.torque.items()}
            least = max(MIN_LOAD_NM, MIN_LOAD_SHARE * max(map(abs, torque.values())))
            loaded = {site: value for site, value in torque.items() if abs(value) >= least}
            if loaded:
                loads.append(_weigh_load(window, joint, loaded, weights))
    return loads


def count_static_windows(absent: list[str], windows: list[StaticWindow]) -> Metric:
    """Returns the number of static windows."""
    if absent:
        return Metric(None, f"no records of {', '.join(absent)}")
    return metric(len(windows) or None, "no second in which all sites rest under torques that stand")


def measure_force_sharing(
    absent: list[str], windows: list[StaticWindow], pairs: list[SharingRatio]
) -> MetricValues:
    """Returns the largest deviation of force sharing from the dominance factors."""
    offs = [pair.off for pair in pairs if pair.off is not None]
    if offs:
        return {"sharing_off": metric(max(offs))}
    whys = "; ".join(dict.fromkeys(pair.expected_nm.why for pair in pairs))
    why = count_static_windows(absent, windows).why or whys or "no two sites are loaded in a window at rest"
    return {"sharing_off": Metric(None, why, applies=bool(absent))}


def _weigh_load(
    window: StaticWindow, joint: int, torque: dict[str, float], weights: Array | str
) -> JointLoad:
    if isinstance(weights, str):
        why = Metric(None, weights)
        return JointLoad(window.from_s, window.to_s, joint + 1, torque, dict.fromkeys(torque, why), why)
    column = weights[:, joint] / weights[:, joint].max()
    weight = dict(zip(window.torque, column.tolist(), strict=True))
    moments = [weight[site] * value for site, value in torque.items()]
    largest = max(map(abs, moments))
    share = abs(sum(moments)) / largest if largest > 0.0 else None
    imbalance = metric(share, "nobody who is followed is loaded")
    shown = {site: metric(weight[site]) for site in torque}
    return JointLoad(window.from_s, window.to_s, joint + 1, torque, shown, imbalance)


def find_sharing_ratios(
    scenario: Scenario, windows: list[StaticWindow], loads: list[JointLoad]
) -> list[SharingRatio]:
    """Returns the force sharing of every joint in a static window at which two sites are loaded.

    The operator that feels is a spring; if both are or none, the slave is the site of the torque.
    """
    at = {window.from_s: window for window in windows}
    pairs = []
    for load in loads:
        if len(load.torque_nm) == 2:
            pushed, holds = sorted(load.torque_nm, key=lambda site: _holding_rank(scenario, site, load.to_s))
            torque = load.torque_nm[pushed]
            by_wall = abs(float(at[load.from_s].environment[pushed][load.joint - 1])) > 0.5 * abs(torque)
            one, other = load.weight[pushed], load.weight[holds]
            if one.value is None or other.value is None:
                expected = Metric(None, one.why)
            elif other.value == 0.0:
                expected = Metric(None, f"nobody ends up following {holds}")
            else:
                expected = metric(torque * one.value / other.value)
            felt = -load.torque_nm[holds]
            pairs.append(SharingRatio(*load[:3], pushed, torque, by_wall, holds, felt, expected))
    return pairs


def _holding_rank(scenario: Scenario, site: str, at_s: float) -> tuple[bool, bool]:
    """Returns a sort key of the site that feels: a spring is active there and no wall; it is a master."""
    spec = scenario.sites[site]
    springs = (one.actor for one in spec.hands if one.actor.acts in (TorqueKind.HAND, TorqueKind.TASK_HAND))
    held = any(spring.start_s <= at_s < spring.end_s for spring in springs)
    return held and not spec.environment, spec.role == "master"


def _torque_weights(scenario: Scenario, alpha: Array) -> Array | str:
    """Returns pi_i / K_i per joint, shape (N, 2); or the reason why that does not weigh torques."""
    if len(find_closed_groups(alpha)) > 1:
        return "two groups of sites follow nobody else: who feels whom is not unique"
    stiffness = []
    for site, spec in scenario.sites.items():
        K, why = _holding_stiffness(spec)
        if why:
            return f"{site}: {why}"
        stiffness.append(K)
    return left_perron_vector(alpha)[:, np.newaxis] / np.array(stiffness)


def _holding_stiffness(spec: SiteSpec) -> tuple[Array, str]:
    """Returns the stiffness that holds e at rest, shape (2,), N m/rad, and the reason why more acts."""
    gains = spec.control.gains(spec.arm.theta)
    if gains.law is Law.OWN:
        return np.zeros(JOINTS), "a law of somebody's own"
    if not has_known_theta(spec):
        return np.zeros(JOINTS), "theta of the arm is not known"
    if any(gains.k_f):
        return np.zeros(JOINTS), "it reflects force: e is not all that its law goes by"
    adaptive = gains.law is Law.ADAPTIVE
    estimate, truth = gains.theta_hat0 if adaptive else gains.known, spec.arm.theta
    if adaptive and any(gains.Gamma[n] > 0.0 for n in GRAVITY_THETA):
        return np.zeros(JOINTS), "gravity is learnt: the estimates take up the load"
    if any(estimate[n] != truth[n] for n in GRAVITY_THETA) and spec.arm.g_m_s2 > 0.0:
        return np.zeros(JOINTS), "gravity is not known exactly"
    K = np.array(gains.Kp) * np.array(gains.Lambda) if adaptive else np.array(gains.K)
    return K, "" if (K > 0.0).all() else "nothing holds its e"

"""Metrics at rest: windows in which all arms rest under constant torques, rendered stiffness,
force sharing.

Invariant: docs/metrics.md defines and derives each. A stiffness is the operator's own, and is
not given, if anything but that operator changed; it is a secant along the path taken: the other
joint moves as well. The torques tau_i ON the arms obey sum_i (pi_i / K_i) tau_i = 0 per joint,
pi being the left Perron vector of the dominance matrix and K_i what holds e_i; if gravity is
adapted the estimates take up the load.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...core.exogenous import TorqueKind
from ...core.site_setup import Law
from ...core.vectors import Array
from ...log.record_columns import Ints
from ...scenario import Scenario
from ...scenario.laws import identify_law
from ..aligned import find_latest_rows
from ..arm_rows import build_arm_rows
from ..dominance_history import find_closed_groups, left_perron_vector
from ..run_end import STATIC_SPEED_RAD_S
from ..run_view import RunView, SiteRun
from .measures import SHARING, Metric, MetricValues, Quantity, measures, metric

WINDOW_S = 1.0
"""Length of a window, s; an interval must be as long."""
MAX_TORQUE_VARIATION = 0.01
"""Largest variation of a torque in a window, as a share of the largest one there."""
MIN_LOAD_NM = 0.05
"""Smaller torques are no load, N m."""
MOVING_SCRIPT_NM = 1e-9
"""A script that changes by more from tick to tick moves, N m."""
MIN_TORQUE_CHANGE_NM = 0.1
"""Least change of a torque that shows a stiffness, N m."""
MIN_ANGLE_CHANGE_RAD = 1e-4
"""Least change of an angle, rad."""
STILL_SCRIPT_NM = 1e-6
"""An operator whose script changed by no more between windows stood still, N m."""
MIN_LOAD_SHARE = 0.02
"""A site with less than this share of the largest torque is not loaded."""


class StaticWindow(NamedTuple):
    """A static window, from its first tick to its last; per site means over it, shape (n,).

    Attributes:
        torque, environment: of operator and environment ON the arm, and of the environment
        alone, N m.
        script: the operator's script, N m; None if unknown.
        q: the joint angles, rad.
        alpha: the dominance matrix, shape (N, N).
    """

    from_s: float
    to_s: float
    torque: dict[str, Array]
    environment: dict[str, Array]
    script: dict[str, Array | None]
    q: dict[str, Array]
    alpha: Array


def find_static_windows(view: RunView) -> list[StaticWindow]:
    """Returns the static windows of all sites, in order; none if one has no records."""
    if view.absent:
        return []
    runs = view.shared
    first = next(iter(runs.values())).records
    rows = {}
    still = first.known.copy()
    for site, (records, torque, dominance) in runs.items():
        rows[site], recorded = find_latest_rows(records, first.t_s)
        slow = np.abs(records.qd).max(axis=1) < STATIC_SPEED_RAD_S
        static = records.follows & slow & ~dominance.rate.any(axis=1)
        if torque.script is not None:  # without a script the torque decides
            moves = np.abs(np.diff(torque.script, axis=0)).max(axis=1) > MOVING_SCRIPT_NM
            static &= ~(np.append(moves, False) | np.append(False, moves))
        still &= recorded & static[rows[site]]
    need = int(np.ceil(WINDOW_S * first.rate_hz))
    edges = (
        np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
        .reshape(-1, 2)
        .tolist()
    )
    windows = []
    for last in (slice(end - need - 1, end) for begin, end in edges if end - begin > need):
        here = {site: row[last] for site, row in rows.items()}
        pushed = [runs[site].records.tau_x[row] for site, row in here.items()]
        largest = max(float(np.abs(values).max()) for values in pushed)
        variation = max(float(np.ptp(values, axis=0).max()) for values in pushed)
        if not variation > MAX_TORQUE_VARIATION * max(largest, MIN_LOAD_NM):
            windows.append(_average_window(runs, here, first.t_s[last]))
    return windows


def _average_window(
    runs: Mapping[str, SiteRun], rows: Mapping[str, Ints], t_s: Array
) -> StaticWindow:
    names = list(runs)
    window = StaticWindow(
        from_s=float(t_s[0]),
        to_s=float(t_s[-1]),
        torque={},
        environment={},
        script={},
        q={},
        alpha=np.zeros((len(names), len(names))),
    )
    for i, (site, (records, torque, dominance)) in enumerate(runs.items()):
        row = rows[site]
        window.torque[site] = -records.tau_x[row].mean(axis=0)
        window.environment[site] = torque.environment[row].mean(axis=0)
        window.script[site] = None if torque.script is None else torque.script[row].mean(axis=0)
        window.q[site] = records.q[row].mean(axis=0)
        for j, peer in enumerate(records.used):
            window.alpha[i, names.index(peer)] = dominance.alpha[row[-1], j]
    return window


class StiffnessEstimate(NamedTuple):
    """Stiffness that an operator met at a joint, from 1, between the ends of two static windows
    in a row.

    Attributes:
        torque_nm, angle_rad: change of the operator's torque ON its arm, and of the joint's
        angle.
        stiffness_nm_rad: their ratio; None if the joint did not move: too stiff to measure.
    """

    from_s: float
    to_s: float
    site: str
    joint: int
    torque_nm: float
    angle_rad: float
    stiffness_nm_rad: float | None


def estimate_stiffness(view: RunView) -> list[StiffnessEstimate]:
    """Returns the stiffness between each two static windows between which one operator alone
    moved.
    """
    estimates = []
    for before, after in pairwise(view.compute_once(find_static_windows)):
        moved = []
        known = True
        for site, now in after.script.items():
            then = before.script[site]
            if now is None or then is None:
                known = False
            elif np.abs(now - then).max() > STILL_SCRIPT_NM:
                moved.append(site)
        if not known or len(moved) != 1 or (before.alpha != after.alpha).any():
            continue
        site = moved[0]
        operator = [
            window.torque[site] - window.environment[site] for window in (before, after)
        ]
        torques = operator[1] - operator[0]
        angles = after.q[site] - before.q[site]
        for joint in range(len(torques)):
            torque = float(torques[joint])
            angle = float(angles[joint])
            if abs(torque) >= MIN_TORQUE_CHANGE_NM:
                K = torque / angle if abs(angle) >= MIN_ANGLE_CHANGE_RAD else None
                found = StiffnessEstimate(
                    from_s=before.to_s,
                    to_s=after.to_s,
                    site=site,
                    joint=joint + 1,
                    torque_nm=torque,
                    angle_rad=angle,
                    stiffness_nm_rad=K,
                )
                estimates.append(found)
    return estimates


class SharingRatio(NamedTuple):
    """Two loaded sites in a static window, from its first tick to its last; joints count from
    1.

    Attributes:
        pushed, pushed_nm: the site of the torque, and that torque, ON its arm.
        by_wall: True if the environment makes most of it. holds, felt_nm: the site of the
        operator that feels it, and what: the negative of its own ON its arm.
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
        return (
            None if expected is None or expected == 0.0 else abs(self.felt_nm / expected - 1.0)
        )


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


def find_joint_loads(view: RunView) -> list[JointLoad]:
    """Returns the loaded joints of every static window."""
    loads = []
    for window in view.compute_once(find_static_windows):
        weights = _torque_weights(view.scenario, window.alpha)
        for joint in range(min(map(len, window.torque.values()))):
            torque = {site: float(values[joint]) for site, values in window.torque.items()}
            least = max(MIN_LOAD_NM, MIN_LOAD_SHARE * max(map(abs, torque.values())))
            loaded = {site: value for site, value in torque.items() if abs(value) >= least}
            if loaded:
                loads.append(_weigh_load(window, joint, loaded, weights))
    return loads


def count_static_windows(view: RunView) -> Metric:
    """Returns the number of static windows."""
    if view.absent:
        return Metric(None, f"no records of {', '.join(view.absent)}")
    return metric(
        len(view.compute_once(find_static_windows)) or None,
        "no second in which all sites rest under torques that stand",
    )


@measures(
    "run",
    SHARING,
    Quantity("sharing_off", "furthest from tau_s beta_s / beta_i"),
)
def measure_force_sharing(view: RunView, _run: str) -> MetricValues:
    """Returns the largest deviation of force sharing from the dominance factors."""
    pairs = view.compute_once(find_sharing_ratios)
    offs = [pair.off for pair in pairs if pair.off is not None]
    if offs:
        return {"sharing_off": metric(max(offs))}
    whys = "; ".join(dict.fromkeys(pair.expected_nm.why for pair in pairs))
    why = (
        count_static_windows(view).why or whys or "no two sites are loaded in a window at rest"
    )
    return {"sharing_off": Metric(None, why, applies=bool(view.absent))}


def _weigh_load(
    window: StaticWindow, joint: int, torque: dict[str, float], weights: Array | str
) -> JointLoad:
    if isinstance(weights, str):
        why = Metric(None, weights)
        return JointLoad(
            from_s=window.from_s,
            to_s=window.to_s,
            joint=joint + 1,
            torque_nm=torque,
            weight=dict.fromkeys(torque, why),
            imbalance=why,
        )
    column = weights[:, joint] / np.nanmax(weights[:, joint])
    weight = dict(zip(window.torque, column.tolist(), strict=True))
    moments = [weight[site] * value for site, value in torque.items()]
    largest = max(map(abs, moments))
    share = abs(sum(moments)) / largest if largest > 0.0 else None
    imbalance = metric(share, "nobody who is followed is loaded")
    shown = {site: metric(weight[site]) for site in torque}
    return JointLoad(
        from_s=window.from_s,
        to_s=window.to_s,
        joint=joint + 1,
        torque_nm=torque,
        weight=shown,
        imbalance=imbalance,
    )


def find_sharing_ratios(view: RunView) -> list[SharingRatio]:
    """Returns the force sharing of every joint in a static window at which two sites are
    loaded.

    The operator that feels is a spring; if both are or none, the slave is the site of the
    torque.
    """
    scenario = view.scenario
    at = {window.from_s: window for window in view.compute_once(find_static_windows)}
    pairs = []
    for load in view.compute_once(find_joint_loads):
        if len(load.torque_nm) == 2:
            pushed, holds = sorted(
                load.torque_nm, key=lambda site: _holding_rank(scenario, site, load.to_s)
            )
            torque = load.torque_nm[pushed]
            by_wall = abs(
                float(at[load.from_s].environment[pushed][load.joint - 1])
            ) > 0.5 * abs(torque)
            one = load.weight[pushed]
            other = load.weight[holds]
            if one.value is None or other.value is None:
                expected = Metric(None, one.why)
            elif other.value == 0.0:
                expected = Metric(None, f"nobody ends up following {holds}")
            else:
                expected = metric(torque * one.value / other.value)
            felt = -load.torque_nm[holds]
            pairs.append(
                SharingRatio(*load[:3], pushed, torque, by_wall, holds, felt, expected)
            )
    return pairs


def _holding_rank(scenario: Scenario, site: str, at_s: float) -> tuple[bool, bool]:
    """Returns a sort key of the site that feels: a spring is active there and no wall; it is a
    master.
    """
    spec = scenario.sites[site]
    springs = (
        one.actor
        for one in spec.hands
        if one.actor.kind in (TorqueKind.HAND, TorqueKind.TASK_HAND)
    )
    held = any(spring.start_s <= at_s < spring.end_s for spring in springs)
    return held and not spec.environment, spec.role == "master"


def _torque_weights(scenario: Scenario, alpha: Array) -> Array | str:
    """Returns pi_i / K_i per joint, shape (N, n); or the reason why that does not weigh
    torques.
    """
    if len(find_closed_groups(alpha)) > 1:
        return "two groups of sites follow nobody else: who feels whom is not unique"
    stiffness = []
    for site in scenario.names:
        K, why = _holding_stiffness(scenario, site)
        if why:
            return f"{site}: {why}"
        stiffness.append(K)
    return left_perron_vector(alpha)[:, np.newaxis] / np.array(stiffness)


def _holding_stiffness(scenario: Scenario, site: str) -> tuple[Array, str]:
    """Returns the stiffness that holds e at rest, shape (n,), N m/rad, and the reason why more
    acts.
    """
    spec = scenario.sites[site]
    arm = build_arm_rows(scenario, site)
    gains = spec.control.gains(arm.theta)
    none = np.zeros(len(spec.q0_rad))
    if gains.law is Law.USER:
        return (
            none,
            f"the law {identify_law(spec.control)} states no stiffness that holds e at rest",
        )
    if not spec.arm.known:
        return none, "theta of the arm is not known"
    if np.any(gains.k_f):
        return none, "it reflects force: e is not all that its law goes by"
    adaptive = gains.law is Law.ADAPTIVE
    gravity = arm.gravity_parameters
    if adaptive and arm.task is not None:
        return (
            none,
            "in task space what holds the e of this law changes with the pose: J+'Kp J+ Lambda",
        )
    estimate = np.array(gains.theta_hat0 if adaptive else gains.known)
    if adaptive and np.any((np.array(gains.Gamma) > 0.0) & gravity):
        return none, "gravity is learnt: the estimates take up the load"
    if np.any((estimate != arm.theta) & gravity) and spec.arm.g_m_s2 > 0.0:
        return none, "gravity is not known exactly"
    K = np.array(gains.Kp) * np.array(gains.Lambda) if adaptive else np.array(gains.K)
    free = np.array(scenario.arms[site].axes or 1.0) == 0.0
    return np.where(free, np.nan, K), "" if ((K > 0.0) | free).all() else "nothing holds its e"

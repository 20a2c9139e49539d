"""Computes the stiffness that a user feels from intervals in which all arms are at rest.

An interval in which all arms are at rest under constant torques is called a static window. The
stiffness is the ratio of the changes of torque and angle between two static windows.

The module also computes how the arms share a force when an operator holds one arm while a
torque acts on another arm. At rest, the torques tau_i on the arms satisfy

    sum_i (pi_i / K_i) tau_i = 0   for every joint

This equation predicts the torque that the operator feels. pi is the left eigenvector, for the
eigenvalue 1 (Perron vector), of the matrix of dominance factors. K_i is the stiffness, in N
m/rad, with which the controller of arm i pulls its arm towards its reference.
docs/reference/metrics.md derives each metric.

Invariant:
    - A stiffness is reported only if the action of a single operator is the only change between
      the two windows. Other joints of the arm may have moved as well.
    - No torque is predicted if a control law learns the gravity of its arm, because its
      estimates then change under a load.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...core import Array, DominanceMatrix, TorqueKind
from ...log import Ints
from ...scenario import Scenario
from ..aligned import Bools
from ..arm_rows import build_arm_rows
from ..row_reductions import any_in_rows, max_rows
from ..run_end import STATIC_SPEED_RAD_S
from ..run_view import RunView, SiteRun
from .measures import SHARING, Metric, MetricValues, Quantity, measures

WINDOW_S = 1.0
"""Length of a static window, in s."""
MAX_TORQUE_VARIATION = 0.01
"""Largest variation of a torque within a window, as a share of the largest torque in it."""
MIN_LOAD_NM = 0.05
"""Smallest torque that counts as a load, in N m."""
MOVING_SCRIPT_NM = 1e-9
"""Largest change from tick to tick at which a planned torque counts as constant, in N m."""
MIN_TORQUE_CHANGE_NM = 0.1
"""Least change of a torque from which a stiffness is computed, in N m."""
MIN_ANGLE_CHANGE_RAD = 1e-4
"""Least change of an angle from which a stiffness is computed, in rad."""
STILL_SCRIPT_NM = 1e-6
"""Largest change between two windows at which a planned torque counts as constant, in N m."""
MIN_LOAD_SHARE = 0.02
"""Smallest torque of a loaded site, as a share of the largest torque of all sites."""


class _StaticWindow(NamedTuple):
    """Interval of time in which all arms rest, with mean torques and angles of each arm.

    Stiffness and force sharing are measured in such intervals, because inertia has no effect at
    rest.

    Attributes:
        from_s: Time of the first tick, in s.
        to_s: Time of the last tick, in s.
        torque: Torque of operator and environment on the arm, shape (n,), in N m.
        environment: Torque of the environment alone, shape (n,), in N m.
        script: Torque that the scenario plans for the operator, shape (n,), in N m. `None` if
            it is unknown.
        q: Joint angles, shape (n,), in rad.
        alpha: Matrix of the dominance factors, shape (N, N).
    """

    from_s: float
    to_s: float
    torque: dict[str, Array]
    environment: dict[str, Array]
    script: dict[str, Array | None]
    q: dict[str, Array]
    alpha: Array


def _find_static_windows(run_view: RunView) -> list[_StaticWindow]:
    """Finds the windows of time in which all arms rest, in order.

    A window is the last `WINDOW_S` of an interval in which all arms rest. Each interval
    contains at most one window.

    Args:
        run_view: The run.

    Returns:
        The windows. Empty if some site has no records.
    """
    if run_view.absent:
        return []
    runs = run_view.shared
    first_records = next(iter(runs.values())).records
    rows_by_site = {}
    is_still = first_records.known.copy()
    for site, run in runs.items():
        row, recorded = run.records.find_latest_rows(first_records.t_s)
        rows_by_site[site] = row
        is_still &= recorded & _find_resting_rows(run)[row]

    window_ticks = int(np.ceil(WINDOW_S * first_records.rate_hz))
    padded = np.concatenate([[False], is_still, [False]])
    # first tick of each interval and first tick after it, alternately
    change_ticks = np.flatnonzero(np.diff(padded))
    windows = []
    for begin, end in change_ticks.reshape(-1, 2).tolist():
        if end - begin <= window_ticks:
            continue
        ticks = slice(end - window_ticks - 1, end)
        window_rows = {site: row[ticks] for site, row in rows_by_site.items()}

        # arms may rest although a torque still varies
        largest_nm = []
        variation_nm = []
        for site, row in window_rows.items():
            torque = runs[site].records.tau_x[row]
            ranges = np.ptp(torque, axis=0)
            largest_nm.append(float(np.abs(torque).max()))
            variation_nm.append(float(ranges.max()))

        reference_nm = max(max(largest_nm), MIN_LOAD_NM)
        # negated, so that a window whose variation is NaN counts as static
        if not max(variation_nm) > MAX_TORQUE_VARIATION * reference_nm:
            window = _average_window(runs, window_rows, first_records.t_s[ticks])
            windows.append(window)
    return windows


def _find_resting_rows(run: SiteRun) -> Bools:
    """Finds the ticks (control periods) at which an arm rests under constant conditions.

    Neither the operator nor the weights with which the arm follows other arms may change.

    Args:
        run: Records and torques of the site.

    Returns:
        True for each such tick, shape (K,).
    """
    records = run.records
    largest_speed = max_rows(np.abs(records.qd))
    is_slow = largest_speed < STATIC_SPEED_RAD_S
    shares_change = any_in_rows(run.dominance.rate)
    resting: Bools = records.follows & is_slow & ~shares_change
    plan = run.torque.script
    # without a known plan, only the variation of the torque decides
    if plan is not None:
        largest_change = max_rows(np.abs(np.diff(plan, axis=0)))
        plan_changes = largest_change > MOVING_SCRIPT_NM
        changes_after = np.append(plan_changes, False)
        changes_before = np.append(False, plan_changes)
        resting &= ~(changes_after | changes_before)
    return resting


def _average_window(
    runs: Mapping[str, SiteRun],
    rows: Mapping[str, Ints],
    t_s: Array,
) -> _StaticWindow:
    """Returns mean torques and joint angles of all arms over an interval in which they rest.

    Args:
        runs: All sites.
        rows: Rows of the window in the records of each site.
        t_s: Times of the window, in s.
    """
    names = list(runs)
    window = _StaticWindow(
        from_s=float(t_s[0]),
        to_s=float(t_s[-1]),
        torque={},
        environment={},
        script={},
        q={},
        alpha=np.zeros((len(names), len(names))),
    )

    for i, (site, run) in enumerate(runs.items()):
        row = rows[site]
        records = run.records
        torque = run.torque
        window.torque[site] = -records.tau_x[row].mean(axis=0)
        window.environment[site] = torque.environment[row].mean(axis=0)
        window.script[site] = None
        if torque.script is not None:
            window.script[site] = torque.script[row].mean(axis=0)
        window.q[site] = records.q[row].mean(axis=0)
        # shares are constant in the window
        alpha = run.dominance.alpha[row[-1]]
        for peer, share in zip(records.used, alpha.tolist(), strict=True):
            window.alpha[i, names.index(peer)] = share
    return window


class StiffnessEstimate(NamedTuple):
    """Stiffness that an operator felt at a joint, between two consecutive static windows.

    All arms are at rest in a static window. The stiffness is the change of the operator's
    torque divided by the change of the joint angle.

    Attributes:
        from_s: End of the first window, in s.
        to_s: End of the second window, in s.
        site: Site of the operator.
        joint: Number of the joint, from 1.
        torque_nm: Change of the operator's torque on the arm, in N m.
        angle_rad: Change of the joint angle, in rad.
        stiffness_nm_rad: Ratio of the two changes, in N m/rad. `None` if the joint did not
            move, in which case it is too stiff to be measured.
    """

    from_s: float
    to_s: float
    site: str
    joint: int
    torque_nm: float
    angle_rad: float
    stiffness_nm_rad: float | None

    @classmethod
    def list_of_run(cls, view: RunView) -> "list[StiffnessEstimate]":
        """Estimates how stiff the teleoperator feels to an operator who moved it slowly.

        Each estimate compares two consecutive static windows. The stiffness is the change of
        the operator's torque divided by the change of the angle. It is estimated only if a
        single operator moved between the windows.

        Args:
            view: The run.
        """
        estimates = []
        for before, after in pairwise(view.compute_once(_find_static_windows)):
            site = _find_single_mover(before, after)
            if not site or (before.alpha != after.alpha).any():
                continue

            torque_before = before.torque[site] - before.environment[site]
            torque_after = after.torque[site] - after.environment[site]
            torque_changes = (torque_after - torque_before).tolist()
            angle_changes = (after.q[site] - before.q[site]).tolist()
            for joint, torque_nm in enumerate(torque_changes):
                # negated, so that NaN is left out too
                if not abs(torque_nm) >= MIN_TORQUE_CHANGE_NM:
                    continue
                angle_rad = angle_changes[joint]
                stiffness = None
                if abs(angle_rad) >= MIN_ANGLE_CHANGE_RAD:
                    stiffness = torque_nm / angle_rad
                estimate = StiffnessEstimate(
                    from_s=before.to_s,
                    to_s=after.to_s,
                    site=site,
                    joint=joint + 1,
                    torque_nm=torque_nm,
                    angle_rad=angle_rad,
                    stiffness_nm_rad=stiffness,
                )
                estimates.append(estimate)
        return estimates


def _find_single_mover(before: _StaticWindow, after: _StaticWindow) -> str:
    """Returns the site of the only operator that acted differently in two static windows.

    If several operators moved, the stiffness that one of them felt cannot be determined. In
    this case the name is empty. It is also empty if no operator moved, or if the plan of an
    operator is unknown.
    """
    moved_sites = []
    for site, plan_after in after.script.items():
        plan_before = before.script[site]
        if plan_after is None or plan_before is None:
            return ""
        if np.abs(plan_after - plan_before).max() > STILL_SCRIPT_NM:
            moved_sites.append(site)
    return moved_sites[0] if len(moved_sites) == 1 else ""


class SharingRatio(NamedTuple):
    """Measured force sharing at a joint: how much of a torque on another arm an operator feels.

    It is measured while all arms are at rest, at a joint at which exactly two arms are loaded.

    Attributes:
        from_s: Time of the window's first tick, in s.
        to_s: Time of the window's last tick, in s.
        joint: Number of the joint, from 1.
        pushed: Site at which the torque acts.
        pushed_nm: Torque on the arm of this site, in N m.
        by_wall: True if the environment contributes most of this torque.
        holds: Site of the operator who feels the torque.
        felt_nm: Torque that this operator feels, in N m: the negative of the operator's torque
            on the arm.
        expected_nm: Torque that the operator should feel according to the dominance factors, in
            N m.
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
        """Relative deviation of the felt torque from the expected torque.

        For example, 0.1 means that the felt torque is 10 % larger or smaller. `None` if the
        expected torque is unknown or zero.
        """
        expected = self.expected_nm.value
        if expected is None or expected == 0.0:
            return None
        ratio = self.felt_nm / expected
        return abs(ratio - 1.0)

    @classmethod
    def list_of_run(cls, view: RunView) -> "list[SharingRatio]":
        """Compares the torque that an operator feels with the torque on another arm.

        The comparison is made at every joint at which exactly two arms are loaded, while all
        arms are at rest. One of the two operators is assumed to feel the torque that acts on
        the other arm: the operator who is modelled as a spring, at a site without an
        environment. If this condition is met at both sites or at neither, the operator of the
        master is chosen.

        Args:
            view: The recorded run.

        Returns:
            The comparisons in order of time. Empty if there is no such joint.
        """
        static_windows = view.compute_once(_find_static_windows)
        window_by_start = {window.from_s: window for window in static_windows}
        ratios = []
        for load in view.compute_once(JointLoad.list_of_run):
            if len(load.torque_nm) != 2:
                continue

            # the site that is more likely held by a feeling operator comes last
            ranks = {}
            for site in load.torque_nm:
                ranks[site] = _rank_as_holder(view.scenario, site, load.to_s)
            pushed, holds = sorted(load.torque_nm, key=ranks.__getitem__)

            torque = load.torque_nm[pushed]
            environment = window_by_start[load.from_s].environment[pushed]
            wall_torque = float(environment[load.joint - 1])

            pushed_weight = load.weight[pushed]
            holds_weight = load.weight[holds]
            if pushed_weight.value is None or holds_weight.value is None:
                expected = Metric(None, pushed_weight.why)
            elif holds_weight.value == 0.0:
                expected = Metric(None, f"no site depends on {holds} in the end")
            else:
                expected = Metric.of_value(torque * pushed_weight.value / holds_weight.value)

            ratio = SharingRatio(
                from_s=load.from_s,
                to_s=load.to_s,
                joint=load.joint,
                pushed=pushed,
                pushed_nm=torque,
                by_wall=abs(wall_torque) > 0.5 * abs(torque),
                holds=holds,
                felt_nm=-load.torque_nm[holds],
                expected_nm=expected,
            )
            ratios.append(ratio)
        return ratios


class JointLoad(NamedTuple):
    """External torques on all arms at one joint, while all arms are at rest.

    At rest the weighted sum of these torques should be zero, according to the equation in the
    docstring of the module.

    Attributes:
        from_s: Time of the static window's first tick, in s.
        to_s: Time of the static window's last tick, in s.
        joint: Number of the joint, from 1.
        torque_nm: Torque on the arm of each loaded site, in N m, keyed by site name.
        weight: Weight pi_i / K_i of each loaded site in the sum, scaled so that the largest
            weight of all sites is 1. The docstring of the module defines pi and K.
        imbalance: |sum of weight times torque| / largest |weight times torque|. 0 if the
            torques obey the equation.
    """

    from_s: float
    to_s: float
    joint: int
    torque_nm: dict[str, float]
    weight: dict[str, Metric]
    imbalance: Metric

    @classmethod
    def list_of_run(cls, view: RunView) -> "list[JointLoad]":
        """Finds the joints that carry an external torque while all arms are at rest.

        An arm counts as loaded at a joint if the external torque on it is neither small nor
        much smaller than the torque on another arm.

        Args:
            view: The recorded run.

        Returns:
            The loads, ordered by window and joint. Joints without a load are left out.
        """
        loads = []
        for window in view.compute_once(_find_static_windows):
            weights = _compute_torque_weights(view.scenario, window.alpha)
            common_joints = min(map(len, window.torque.values()))
            for joint in range(common_joints):
                torque = {site: float(values[joint]) for site, values in window.torque.items()}
                largest_torque_nm = max(map(abs, torque.values()))
                least_load_nm = max(MIN_LOAD_NM, MIN_LOAD_SHARE * largest_torque_nm)
                loaded = {
                    site: value for site, value in torque.items() if abs(value) >= least_load_nm
                }
                if loaded:
                    load = _weigh_load(window, joint, loaded, weights)
                    loads.append(load)
        return loads


def count_static_windows(view: RunView) -> Metric:
    """Counts the intervals of a run in which all arms are at rest under constant torques.

    Without such an interval, stiffness and force sharing cannot be measured.

    Args:
        view: The recorded run.

    Returns:
        The number of intervals, or the reason why it is zero or unknown.
    """
    if view.absent:
        return Metric(None, f"no records of {', '.join(view.absent)}")
    windows = view.compute_once(_find_static_windows)
    reason = "no second in which all sites rest under constant torques"
    return Metric.of_value(len(windows) or None, reason)


@measures(
    "run",
    SHARING,
    Quantity("sharing_off", "furthest from tau_s beta_s / beta_i"),
)
def _measure_force_sharing(view: RunView, _run: str) -> MetricValues:
    """Measures how well the torques that operators feel agree with the predicted sharing.

    The dominance factors, the weights with which the arms follow each other, determine how
    strongly operators feel torques on other arms.

    Args:
        view: The recorded run.

    Returns:
        The largest relative difference between the felt and the predicted torque, as a metric
        by its key. Without a prediction the metric contains the reason.
    """
    ratios = view.compute_once(SharingRatio.list_of_run)
    deviations = [ratio.off for ratio in ratios if ratio.off is not None]
    if deviations:
        return {"sharing_off": Metric.of_value(max(deviations))}

    reasons = [ratio.expected_nm.why for ratio in ratios]
    why = count_static_windows(view).why
    if not why:
        # each reason once, in order
        why = "; ".join(dict.fromkeys(reasons))
    if not why:
        why = "no two sites are loaded in a window at rest"
    return {"sharing_off": Metric(None, why, applies=bool(view.absent))}


def _weigh_load(
    window: _StaticWindow,
    joint: int,
    torque: dict[str, float],
    weights: Array | str,
) -> JointLoad:
    """Computes how well the torques on all arms balance at one joint while the arms rest.

    The torques are weighted with pi_i / K_i, see the equation in the module's docstring.

    Args:
        window: The static window.
        joint: Index of the joint, from 0.
        torque: Torques of the loaded sites, in N m.
        weights: Weights of all sites and joints, shape (N, n), or the reason why they are
            unknown.
    """
    if isinstance(weights, str):
        unknown = Metric(None, weights)
        weight_metrics = dict.fromkeys(torque, unknown)
        imbalance = unknown
    else:
        joint_weights = weights[:, joint]
        relative_weights = joint_weights / np.nanmax(joint_weights)
        weight = dict(zip(window.torque, relative_weights.tolist(), strict=True))

        weighted = [weight[site] * value for site, value in torque.items()]
        largest = max(map(abs, weighted))

        imbalance_ratio = None
        if largest > 0.0:
            imbalance_ratio = abs(sum(weighted)) / largest
        imbalance = Metric.of_value(
            imbalance_ratio, "no loaded site is followed by other sites"
        )
        weight_metrics = {site: Metric.of_value(weight[site]) for site in torque}

    return JointLoad(
        from_s=window.from_s,
        to_s=window.to_s,
        joint=joint + 1,
        torque_nm=torque,
        weight=weight_metrics,
        imbalance=imbalance,
    )


def _rank_as_holder(scenario: Scenario, site: str, t_s: float) -> tuple[bool, bool]:
    """Returns a sort key that puts the site whose operator feels the torque last.

    The operator of this site holds the arm like a spring at the given time, and no environment
    acts at the site. If this holds for several sites, masters come last.

    Args:
        scenario: Scenario of the run.
        site: Name of the site.
        t_s: The time, in s.
    """
    spec = scenario.sites[site]
    spring_kinds = (TorqueKind.HAND, TorqueKind.TASK_HAND)
    springs = [hand.actor for hand in spec.hands if hand.actor.kind in spring_kinds]
    is_held = any(spring.start_s <= t_s < spring.end_s for spring in springs)
    return is_held and not spec.environment, spec.role == "master"


def _compute_torque_weights(scenario: Scenario, alpha: Array) -> Array | str:
    """Returns the weights pi_i / K_i with which the torques on all arms balance at rest.

    Here pi is the left eigenvector of the matrix alpha of dominance factors, and K_i the
    stiffness of the control law of arm i.

    Args:
        scenario: Scenario of the run.
        alpha: Matrix of the dominance factors, shape (N, N).

    Returns:
        The weights, shape (N, n), or the reason why they are unknown.
    """
    dominance = DominanceMatrix(alpha)
    if len(dominance.closed_groups) > 1:
        return "two groups of sites do not follow each other: it is not unique who feels whom"
    stiffness = []
    for site in scenario.names:
        K, why = _find_holding_stiffness(scenario, site)
        if why:
            return f"{site}: {why}"
        stiffness.append(K)
    pi = dominance.find_pi()
    return pi[:, np.newaxis] / np.array(stiffness)


def _find_holding_stiffness(scenario: Scenario, site: str) -> tuple[Array, str]:
    """Returns the stiffness with which a control law holds a resting arm at its reference.

    Args:
        scenario: Scenario of the run.
        site: Name of the site, the process that controls the arm.

    Returns:
        The stiffness, shape (n,), in N m/rad. NaN along axes that the site does not follow.
        The reason why the stiffness is unknown, empty if the stiffness is known.
    """
    spec = scenario.sites[site]
    arm = build_arm_rows(scenario, site)
    gains = spec.control.gains(arm.theta)
    unknown = np.zeros(len(spec.q0_rad))
    if gains.is_user:
        name = spec.law_name
        return unknown, f"the law {name} states no stiffness that holds e at rest"
    if not spec.arm.known:
        return unknown, "theta of the arm is not known"
    if np.any(gains.k_f):
        return unknown, "the law reflects force: its torque does not depend on e alone"

    is_adaptive = gains.is_adaptive
    has_weight = arm.gravity_parameters
    if is_adaptive and arm.task is not None:
        why = "in task space the stiffness of this law changes with the pose: J+'Kp J+ Lambda"
        return unknown, why

    parameters = np.array(gains.theta_hat0 if is_adaptive else gains.known)
    if is_adaptive:
        adapts = np.array(gains.Gamma) > 0.0
        if np.any(adapts & has_weight):
            return unknown, "gravity is learnt: the estimates take up the load"
    is_wrong = parameters != arm.theta
    if np.any(is_wrong & has_weight) and spec.arm.g_m_s2 > 0.0:
        return unknown, "gravity is not known exactly"
    stiffness = np.array(gains.K)
    if is_adaptive:
        stiffness = np.array(gains.Kp) * np.array(gains.Lambda)

    axes = np.array(scenario.arms[site].axes or 1.0)
    is_free = axes == 0.0
    is_held = (stiffness > 0.0) | is_free
    why = ""
    if not is_held.all():
        why = "the law has no stiffness along a coordinate that the site follows"
    return np.where(is_free, np.nan, stiffness), why

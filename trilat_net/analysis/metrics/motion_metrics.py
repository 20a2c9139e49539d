"""Computes metrics of motion, effort, contact forces, learning, links and control loops.

A metric is a number that describes a recorded run or a part of it, for example the RMS tracking
error of the slave arm in rad. The tracking error is the difference between the joint angles of
an arm and the weighted mean of its peers' angles, which arrive with a delay.
docs/reference/metrics.md defines every metric.

Invariant:
    - The tracking error compares a slave with its master at the time when the state in use was
      sent. The largest distance between the arms (spread) compares all arms at one instant.
    - The effort is computed from the recorded motor torque, after the torque limit and with
      gravity compensation.
    - The force of a wall is computed from the scenario and the recorded motion. Ticks without a
      record contribute nothing.
    - The error of a parameter estimate is reported only if the control law changes the estimate
      and the true value is known. Otherwise only the estimate is reported.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...core import POSE, POSITION, Array
from ...log import Log, RotationVectors, compute_task_errors
from ...results import JsonObject
from ...scenario import END_WINDOW_S, Scenario
from .. import site_signals
from ..aligned import AlignedRecords, Bools, PeerTrajectory, find_common_rows
from ..arm_rows import ArmRows, PlanarArmRows, build_arm_rows
from ..base_parameters import find_base_parameters, find_consistent_links
from ..file_overview import describe_site_health
from ..run_view import RunView
from .measures import (
    CONTACT,
    EFFORT,
    FOLLOWING,
    LEARNING,
    LOOP,
    NETWORK,
    SPREAD,
    TRACKING,
    UNDELAYED,
    Metric,
    MetricValues,
    Quantity,
    measure_shared,
    measures,
    peak,
    rms,
    unavailable,
)

LONG_END_S = 5.0
"""Length of the end of a run in which contact and slopes of estimates are measured, in s."""
_ERRORS = {"rms_error": "RMS e", "max_error": "peak |e|", "max_error_end": "peak |e|, last 1 s"}
_UNDELAYED_ERRORS = {
    "undelayed_rms": "RMS of {0} from the peers at the same time",
    "undelayed_max": "largest distance of {0} from the peers at the same time",
    "undelayed_end": "largest distance of {0} from the peers at the same time, last 1 s",
}
_SPREADS = {
    "spread_rms": "RMS spread, undelayed",
    "spread_max": "largest spread",
    "spread_end": "largest spread, last 1 s",
}
_DELAYED_DISTANCES = {
    "following_rms": "RMS {0}_m(t-T) - {0}_s",
    "following_max": "peak |{0}_m(t-T) - {0}_s|",
    "following_end": "peak |{0}_m(t-T) - {0}_s|, last 1 s",
}
_ERROR_UNITS = {"joints": "rad", "position": "m", "pose": "m or rad"}


@measures(
    "site",
    TRACKING,
    Quantity("settle_s", "settling time", "s"),
    *Quantity.list_shared(_ERRORS),
)
def _measure_tracking(view: RunView, site: str) -> MetricValues:
    """Measures how well an arm tracks its reference: settling time, RMS and peak of the error.

    The reference is the weighted mean of the positions that the other arms sent.

    Args:
        view: The run.
        site: Name of the site.
    """
    log = view.log
    site_log = log[site]
    if not len(site_log):
        return unavailable(TRACKING, f"no records of {site}")

    space = log.scenario.sites[site].task.space
    limit = f"{site_signals.SETTLED_ERROR_RAD:g} {_ERROR_UNITS[space]}"
    metrics = measure_shared(
        group=TRACKING,
        space=space,
        keys=_ERRORS,
        differences=site_signals.joint_errors(site_log),
        at_end=site_log.t_s > site_log.t_s[-1] - END_WINDOW_S,
    )
    metrics["settle_s"] = Metric.of_value(
        site_signals.settling_time_s(site_log), f"|e| exceeds {limit} in the last record"
    )
    return metrics


@measures("site", UNDELAYED, *Quantity.list_shared(_UNDELAYED_ERRORS))
def measure_undelayed_error(view: RunView, site: str, other: Log | None = None) -> MetricValues:
    """Measures how far a site is from the weighted mean of its peers at the same time.

    The error e of a site is the difference between its coordinates and those that its peers
    sent some time ago. For the undelayed error, the coordinates of the peers at the same time t
    are used instead, weighted by the dominance factors:

        q_i(t) - sum_j alpha_ij(t) q_j(t)

    The undelayed error therefore includes the effect of the delay. The motion of a peer is
    interpolated between its ticks.

    Args:
        view: The run.
        site: Name of the site.
        other: Log of a run with the same sites, such as a rerun, which may end earlier. If
            given, only times at which both runs have a record of the site are used.
    """
    followed = _list_followed_peers(view, site)
    missing = [name for name in (site, *followed) if name not in view.sites]
    if missing:
        return unavailable(UNDELAYED, f"no records of {', '.join(missing)}")
    if not followed:
        return unavailable(UNDELAYED, f"{site} follows no other site", applies=False)
    error, known = _compute_undelayed_error(view, site, followed)
    if other is not None:
        # As in aligned records, the last record of a diverged site does not count.
        other_log = other[site]
        other_ticks = other_log.tick[other_log.mode != "diverged"]
        if len(other_ticks):
            # Equal times of different tick rates are equal floats: a division rounds correctly.
            known &= np.isin(view.sites[site].records.t_s, other_ticks / other_log.rate_hz)
    if not known.any():
        return unavailable(UNDELAYED, "there is no time at which every site has a record")
    return measure_shared(
        group=UNDELAYED,
        space=view.scenario.sites[site].task.space,
        keys=_UNDELAYED_ERRORS,
        differences=error[known],
        at_end=view.sites[site].records.known_at_end(END_WINDOW_S)[known],
        why_not_at_end="in the last second there is no time at which every site has a record",
    )


def _compute_undelayed_error(
    view: RunView, site: str, followed: Mapping[str, Array]
) -> tuple[Array, Bools]:
    """Returns the distance of an arm from the weighted mean of the other arms at one time.

    The error of the control law differs: it compares the arm with delayed poses. The distance
    returned here shows how far apart the arms really were.

    Args:
        view: The run, which has records of the site and of the followed peers.
        site: Name of the site.
        followed: Dominance factors of the followed peers over time, shape (K,) each.

    Returns:
        The distance at every tick, shape (K, n).
        True where all positions are known, shape (K,).
    """
    records = view.sites[site].records
    t_s = records.t_s
    is_known = records.known.copy()
    reference = np.zeros_like(records.shared)
    for peer, alpha in followed.items():
        peer_records = view.sites[peer].records
        motion = PeerTrajectory(peer_records).evaluate(t_s)
        is_known &= motion.known & (t_s <= peer_records.t_s[-1])
        positions = motion.q
        if records.x.shape[1] == POSE:
            # a rotation vector and its other branch must not be averaged
            orientations = RotationVectors(positions[:, POSITION:])
            positions[:, POSITION:] = orientations.nearest_to(records.x[:, POSITION:])
        reference += alpha[:, np.newaxis] * positions
    if records.x.size:
        return compute_task_errors(records.x, reference, records.axes), is_known
    return records.q - reference, is_known


def _list_followed_peers(view: RunView, site: str) -> dict[str, Array]:
    """Returns the other arms that an arm follows at some time, with their dominance factors.

    The factors, which are the weights of these arms, have the shape (K,) for K ticks.
    """
    if site not in view.sites:
        return {}
    alpha = view.sites[site].dominance.alpha
    peers = view.scenario.peers(site)
    return {
        peer: factors for peer, factors in zip(peers, alpha.T, strict=True) if factors.any()
    }


@measures("run", SPREAD, *Quantity.list_shared(_SPREADS))
def _measure_spread(view: RunView, _run: str) -> MetricValues:
    """Measures the spread of a run: how far the sites are apart at the same instant.

    It is the largest difference of a joint angle between two sites. In task space the positions
    of end effectors are compared instead, along the axes that all sites follow. The spread is
    evaluated at those ticks of the first site at which every other site has a record of its
    latest tick.

    Args:
        view: The run.
    """
    log = view.log
    if view.absent:
        return unavailable(SPREAD, f"no records of {', '.join(view.absent)}")
    sites = [run.records for run in view.sites.values()]
    rows, known = find_common_rows(sites)

    poses_by_site = []
    for records, row in zip(sites, rows, strict=True):
        poses_by_site.append(records.shared[row])
    if not known.any():
        return unavailable(SPREAD, "there is no time at which every site has a record")

    poses = np.stack(poses_by_site)[:, known]
    # two rotation vectors of nearly the same orientation, on both sides of half a turn, differ
    # by a whole turn
    if sites[0].x.shape[1] == POSE:
        for orientations in poses[1:, :, POSITION:]:
            turns = RotationVectors(orientations)
            orientations[:] = turns.nearest_to(poses[0, :, POSITION:])

    spread = np.ptp(poses, axis=0)
    axes = [records.axes for records in sites]
    if all(axes):
        spread = spread * np.prod(axes, axis=0)

    end_s = min(float(records.t_s[-1]) for records in sites)
    return measure_shared(
        group=SPREAD,
        space=log.scenario.sites[log.sites[0]].task.space,
        keys=_SPREADS,
        differences=spread,
        at_end=sites[0].t_s[known] > end_s - END_WINDOW_S,
        why_not_at_end="in the last second there is no time at which every site has a record",
    )


@measures("link", FOLLOWING, *Quantity.list_shared(_DELAYED_DISTANCES))
def _measure_following(view: RunView, link: str) -> MetricValues:
    """Measures how far a slave is from the delayed motion of its master.

    The distance is q_m(t - T) - q_s, where T is the age of the sample in use, the state of the
    master that the slave has received. At every tick of the slave after its first sample of
    that master, the slave's angles q_s are compared with the angles q_m that the master
    recorded when it sent the sample in use. In task space the poses of the end effectors are
    compared.

    Args:
        view: The run.
        link: Name of the link from the master to the slave, such as "m1->s".
    """
    peer = view.links[link].peer
    site = view.links[link].site
    specs = view.log.scenario.sites
    if specs[peer].role != "master" or specs[site].role != "slave":
        return unavailable(
            FOLLOWING, "the link does not lead from a master to a slave", applies=False
        )
    missing = [name for name in (peer, site) if name not in view.sites]
    if missing:
        return unavailable(FOLLOWING, f"no records of {', '.join(missing)}")

    master = view.sites[peer].records
    slave = view.sites[site].records

    used = slave.used[peer]
    master_row = used - master.first
    clipped_row = np.clip(master_row, 0, len(master.known) - 1)
    is_recorded = (used >= 0) & (clipped_row == master_row)
    is_compared = slave.known & is_recorded & master.known[clipped_row]
    if not is_compared.any():
        return unavailable(FOLLOWING, f"no record of {site} uses a recorded sample of {peer}")

    master_pose = master.shared[clipped_row]
    if slave.x.size:
        distance = compute_task_errors(master_pose, slave.x, slave.axes)
    else:
        distance = master_pose - slave.q
    return measure_shared(
        group=FOLLOWING,
        space=specs[site].task.space,
        keys=_DELAYED_DISTANCES,
        differences=distance[is_compared],
        at_end=slave.known_at_end(END_WINDOW_S)[is_compared],
        why_not_at_end="no sample in the last second",
    )


@measures(
    "site",
    EFFORT,
    Quantity("effort_nm2_s", "effort, int |tau|^2", "N²m²s", "sum"),
    Quantity("rms_tau_nm", "RMS tau", "N m"),
    Quantity("peak_tau_nm", "peak |tau|", "N m"),
    Quantity("saturated_share", "ticks at the limit"),
    Quantity("chatter_nm", "chatter, mean change of tau per tick", "N m"),
)
def _measure_effort(view: RunView, site: str) -> MetricValues:
    """Measures the torque that a controller applies, and how often it is at its limit.

    Args:
        view: The recorded run.
        site: Name of the site, the process that runs one arm.

    Returns:
        The metrics, by key. Without records each contains the reason instead of a value.
    """
    part = view.log[site]
    if not len(part):
        return unavailable(EFFORT, f"no records of {site}")
    tau = part.tau
    limit_nm = view.log.scenario.sites[site].limits.tau_limit_nm
    at_limit = np.any(np.abs(tau) >= limit_nm, axis=1)

    is_successive = np.diff(part.tick) == 1
    changes = np.abs(np.diff(tau, axis=0)[is_successive])
    chatter = None
    if len(changes):
        chatter = float(changes.mean(axis=0).max())

    sum_of_squares = float(np.einsum("kj,kj->", tau, tau))
    return {
        "effort_nm2_s": Metric.of_value(sum_of_squares / part.rate_hz),
        "rms_tau_nm": Metric.of_value(rms(tau)),
        "peak_tau_nm": Metric.of_value(peak(tau)),
        "saturated_share": Metric.of_value(float(at_limit.mean())),
        "chatter_nm": Metric.of_value(chatter, "no two ticks"),
    }


@measures(
    "wall",
    CONTACT,
    Quantity("force_mean_n", "normal force, mean", "N"),
    Quantity("force_deviation_n", "normal force, deviation", "N"),
    Quantity("force_peak_n", "normal force, peak", "N"),
    Quantity("hits", "hits", "", "sum"),
    Quantity("contact_share", "ticks in contact"),
    Quantity("depth_max_m", "deepest", "m"),
    Quantity("end_force_mean_n", "normal force, mean, last 5 s", "N"),
    Quantity("end_force_deviation_n", "normal force, deviation, last 5 s", "N"),
    Quantity("end_force_peak_n", "normal force, peak, last 5 s", "N"),
    Quantity("end_hits", "hits, last 5 s", "", "sum"),
)
def _measure_wall_contact(view: RunView, name: str) -> MetricValues:
    """Measures the contact of an end effector with a virtual wall: force, hits and depth.

    The metrics are computed for the whole run and for its last 5 s. A contact in the first
    record, or in the first record after a gap, is not counted as a hit, because its beginning
    is unknown.

    Args:
        view: The run.
        name: Name of the wall, such as "s/1" for the first wall of site s.
    """
    site, wall = view.walls[name]
    run = view.sites.get(site)
    if run is None:
        return unavailable(CONTACT, "no records of the site")

    t_s = run.records.nominal_s
    known = run.records.known
    end_effector = run.torque.end_effector
    force = wall.find_force(t_s, end_effector)
    touches = force > 0.0

    is_known_free = known & ~touches
    was_known_free = np.concatenate([[False], is_known_free[:-1]])
    is_hit = touches & was_known_free
    depth = wall.find_depth(end_effector)[known]

    # depths are negative outside the wall
    metrics = {
        "contact_share": Metric.of_value(float(touches[known].mean())),
        "depth_max_m": Metric.of_value(max(0.0, float(depth.max()))),
    }
    at_end = known & (t_s > t_s[known][-1] - LONG_END_S)
    for prefix, rows in (("", known), ("end_", at_end)):
        metrics[f"{prefix}force_mean_n"] = Metric.of_value(float(force[rows].mean()))
        metrics[f"{prefix}force_deviation_n"] = Metric.of_value(float(force[rows].std()))
        metrics[f"{prefix}force_peak_n"] = Metric.of_value(float(force[rows].max()))
        metrics[f"{prefix}hits"] = Metric.of_value(float(np.count_nonzero(is_hit[rows])))
    return {key: metrics[key] for key in unavailable(CONTACT, "")}  # in the declared order


class _BaseEstimates(NamedTuple):
    """Estimates of the base parameters of a chain, which are those that torques determine.

    The parameters of neighbouring links act on the torques only in certain combinations, the
    base parameters. Each combination is named after one parameter in it. Lists have the shape
    (B,).

    Attributes:
        parameter: Index in theta of the parameter after which each combination is named.
        theta: True values. `None` if unknown.
        first: Estimates in the first record.
        last: Estimates in the last record.
        consistent_first: For each link, whether some rigid body has the estimated parameters of
            the first record.
        consistent_last: For each link, whether some rigid body has the estimated parameters of
            the last record.
    """

    parameter: list[int]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    consistent_first: list[bool]
    consistent_last: list[bool]


class ParameterEstimates(NamedTuple):
    """Estimates of an arm's dynamic parameters theta, as learnt by an adaptive control law.

    The parameters combine masses, inertias and lengths of the links. Each array has shape (P,).

    Attributes:
        learnt: True for each parameter that the law adapts.
        theta: True parameters, or `None` if unknown.
        first: Estimates in the first record.
        last: Estimates in the last record.
        slope_per_s: Slopes of straight lines fitted to the last 5 s, in 1/s, or `None` with
            fewer than two records.
        base: Estimates of the base parameters, which are the combinations of parameters that
            torques determine. `None` for the planar arm.
    """

    learnt: list[bool]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    slope_per_s: list[float] | None
    base: _BaseEstimates | None = None

    def to_json(self) -> JsonObject:
        """Converts the estimates of the control law to plain values for JSON.

        The key "base" is omitted if there are no base parameters.
        """
        content = self._asdict()
        del content["base"]
        if self.base is not None:
            content["base"] = self.base._asdict()
        return content

    @classmethod
    def by_site(cls, view: RunView) -> "dict[str, ParameterEstimates]":
        """Reads the parameter estimates that adaptive control laws learnt during a run.

        Each entry contains the first, last and true values of masses and inertias.

        Args:
            view: The run.

        Returns:
            A mapping from site name to estimates. Sites without records are missing.
        """
        return {
            site: _read_parameter_estimates(view.scenario, run.records)
            for site, run in view.sites.items()
        }


def _read_parameter_estimates(
    scenario: Scenario, records: AlignedRecords
) -> ParameterEstimates:
    """Reads the parameter estimates of an adaptive control law from the records of an arm.

    The law estimates dynamic parameters, combinations of masses, inertias and lengths.

    Args:
        scenario: The description of the experiment.
        records: Records of the site, the process that runs one arm.

    Returns:
        The estimates in the first and the last record, and the rate at which they change in the
        last 5 s.
    """
    spec = scenario.sites[records.site]
    arm = build_arm_rows(scenario, records.site)
    gains = spec.control.gains(arm.theta)
    theta_hat = records.theta_hat
    if gains.is_adaptive:
        learnt = np.array(gains.Gamma) > 0.0
    else:  # a parameter that changes is learnt
        learnt = (theta_hat != theta_hat[0]).any(axis=0)

    at_end = records.known_at_end(LONG_END_S)
    slopes = None
    if np.count_nonzero(at_end) >= 2:
        # slopes of least-squares lines
        end_s = records.t_s[at_end]
        centred_s = end_s - end_s.mean()
        line_slopes = centred_s @ theta_hat[at_end] / (centred_s @ centred_s)
        slopes = line_slopes.tolist()

    theta = arm.theta.tolist() if spec.arm.known else None
    base = None
    if not isinstance(arm, PlanarArmRows):
        base = _estimate_base_parameters(arm, learnt, theta, theta_hat)
    return ParameterEstimates(
        learnt=learnt.tolist(),
        theta=theta,
        first=theta_hat[0].tolist(),
        last=theta_hat[-1].tolist(),
        slope_per_s=slopes,
        base=base,
    )


def _estimate_base_parameters(
    arm: ArmRows,
    learnt: Bools,
    theta: list[float] | None,
    theta_hat: Array,
) -> _BaseEstimates:
    """Returns the estimates that the law of a chain of joints learnt, in base parameters.

    Base parameters are the combinations of masses and inertias that the motion determines.
    Single masses cannot be learnt from motion alone, see `_BaseEstimates`.

    Args:
        arm: The chain.
        learnt: True for each parameter that the law adapts, shape (P,).
        theta: True parameters. `None` if unknown.
        theta_hat: Estimates in every record, shape (K, P).
    """
    base = find_base_parameters(arm, learnt)
    first_and_last = theta_hat[[0, -1]]
    estimates = base.combination @ first_and_last.T
    first, last = estimates.T.tolist()
    true_values = None
    if theta is not None:
        true_values = (base.combination @ np.array(theta)).tolist()
    return _BaseEstimates(
        parameter=base.kept.tolist(),
        theta=true_values,
        first=first,
        last=last,
        consistent_first=find_consistent_links(theta_hat[0]),
        consistent_last=find_consistent_links(theta_hat[-1]),
    )


@measures(
    "site",
    LEARNING,
    Quantity("theta_error_first", "initial |theta_hat - theta|"),
    Quantity("theta_error_last", "final |theta_hat - theta|"),
    Quantity("theta_energy_first_j", "initial theta~' Gamma^-1 theta~ / 2", "J"),
    Quantity("theta_energy_last_j", "final theta~' Gamma^-1 theta~ / 2", "J"),
    Quantity("theta_slope_per_s", "|theta_hat'|, last 5 s", "1/s"),
    Quantity("unphysical_links", "unphysical links at the end", "", "sum"),
)
def _measure_parameter_error(view: RunView, site: str) -> MetricValues:
    """Measures how far a site's estimates of its arm's parameters are from the true values.

    For a chain of joints the errors are computed in base parameters, which are the combinations
    of parameters that torques determine. Other errors have no effect on the torque.

    Args:
        view: The recorded run.
        site: Name of the site, the process that runs one arm.

    Returns:
        The metrics, by key: the distance and the energy of the errors in the first and the last
        record, the rate at which the estimates still change, and the number of links with
        parameters that no rigid body can have. A metric without a value contains the reason.
    """
    scenario = view.scenario
    estimates = view.compute_once(ParameterEstimates.by_site).get(site)
    if estimates is None:
        return unavailable(LEARNING, "no records of the site")

    arm = build_arm_rows(scenario, site)
    gains = scenario.sites[site].control.gains(arm.theta)
    learnt = np.array(estimates.learnt)
    if not learnt.any():
        return unavailable(LEARNING, "nothing is learnt", applies=False)

    base = estimates.base
    metrics = unavailable(LEARNING, "theta of the arm is not known")
    slope = None
    if estimates.slope_per_s is not None:
        learnt_slopes = np.array(estimates.slope_per_s)[learnt]
        slope = float(np.linalg.norm(learnt_slopes))

    metrics["theta_slope_per_s"] = Metric.of_value(
        slope, "fewer than two records in the last 5 s"
    )
    metrics["unphysical_links"] = Metric(
        None, "the arm is not a chain with ten parameters per link", applies=False
    )
    if base is not None:
        metrics["unphysical_links"] = Metric.of_value(base.consistent_last.count(False))

    if estimates.theta is None:
        return metrics
    if base is None:
        first_and_last = np.array([estimates.first, estimates.last])[:, learnt]
        errors = first_and_last - np.array(estimates.theta)[learnt]
    else:
        errors = np.array([base.first, base.last]) - np.array(base.theta)

    energies: list[float | None] = [None, None]
    why = "the adaptation gains are not known"
    if gains.is_adaptive:
        energies = _compute_parameter_energy(arm, learnt, np.array(gains.Gamma), errors)
        why = "the number is not finite"

    distances = np.linalg.norm(errors, axis=1)
    for end, distance, energy in zip(("first", "last"), distances, energies, strict=True):
        metrics[f"theta_error_{end}"] = Metric.of_value(float(distance))
        metrics[f"theta_energy_{end}_j"] = Metric.of_value(energy, why)
    return metrics


def _compute_parameter_energy(
    arm: ArmRows,
    learnt: Bools,
    Gamma: Array,
    errors: Array,
) -> list[float | None]:
    """Returns the energy of parameter errors, which is a part of the energy function V.

    The energy of the errors d is d' Gamma^-1 d / 2 with the adaptation gains Gamma. Base
    parameters are adapted with the gain B Gamma B', where B is the matrix of their
    combinations.

    Args:
        arm: The arm.
        learnt: True for each parameter that the law adapts, shape (P,).
        Gamma: Adaptation gains, shape (P,).
        errors: Errors of the learnt parameters, for a chain those of its base parameters, shape
            (K, B).

    Returns:
        The energy in J, for each row.
    """
    if isinstance(arm, PlanarArmRows):
        energy = 0.5 * (errors**2 / Gamma[learnt]).sum(axis=1)
    else:
        B = find_base_parameters(arm, learnt).combination
        gain = (B * Gamma) @ B.T
        weighted_errors = np.linalg.solve(gain, errors.T)
        energy = 0.5 * (errors * weighted_errors.T).sum(axis=1)
    return list(energy.tolist())


@measures(
    "link",
    NETWORK,
    Quantity("age_mean_ms", "effective delay, mean", "ms"),
    Quantity("age_p99_ms", "effective delay, p99", "ms"),
    Quantity("age_max_ms", "effective delay, largest", "ms"),
    Quantity("silence_ms", "longest silence", "ms"),
    Quantity("loss", "loss"),
    Quantity("burst", "lost in a row, mean"),
    Quantity("late_samples", "late samples", "", "sum"),
)
def _measure_network(view: RunView, name: str) -> MetricValues:
    """Measures a network link: the effective delay, lost messages and bursts of losses.

    The effective delay is the age of the other arm's state that the receiver uses.

    Args:
        view: The run.
        name: Name of the link, such as "m1->s".
    """
    link = view.links[name]
    age = link.age_ms
    unused = "no sample ever came into use"
    unknown = "for no sample is it known whether it arrived"
    burst = Metric.of_value(link.burst, unknown)
    if link.loss == 0.0:
        burst = Metric(None, "nothing was lost", applies=False)

    late_samples = link.counts.late if link.counts else None
    return {
        "age_mean_ms": Metric.of_value(age.mean if age else None, unused),
        "age_p99_ms": Metric.of_value(age.p99 if age else None, unused),
        "age_max_ms": Metric.of_value(age.max if age else None, unused),
        "silence_ms": Metric.of_value(link.silence_ms, unused),
        "loss": Metric.of_value(link.loss, unknown),
        "burst": burst,
        "late_samples": Metric.of_value(late_samples, f"no records of {link.site}"),
    }


@measures(
    "site",
    LOOP,
    Quantity("late_p99_us", "lateness, p99", "us"),
    Quantity("late_max_us", "lateness, largest", "us"),
    Quantity("busy_p99_us", "computing time, p99", "us"),
    Quantity("overruns", "overruns", "", "sum"),
    Quantity("missing", "missing records", "", "sum"),
)
def _measure_loop(view: RunView, site: str) -> MetricValues:
    """Measures how punctual the control loop of an arm was, and counts its missing records.

    Args:
        view: The recorded run.
        site: Name of the site, the process that runs one arm.

    Returns:
        The metrics, by key. In a simulation that reads no clock, only the number of missing
        records has a value.
    """
    log = view.log
    missing = {"missing": Metric.of_value(log.missing(site))}

    if log.driver != "live":
        return unavailable(LOOP, "no clock was read", applies=False) | missing
    if not len(log[site]):
        return unavailable(LOOP, f"no records of {site}") | missing

    health = describe_site_health(log, site)
    late_us = health["late_us"]
    busy_us = health["busy_us"]
    return {
        "late_p99_us": Metric.of_value(late_us["p99"]),
        "late_max_us": Metric.of_value(late_us["max"]),
        "busy_p99_us": Metric.of_value(busy_us["p99"] if busy_us else None, "no second record"),
        "overruns": Metric.of_value(health["overruns"]),
        **missing,
    }

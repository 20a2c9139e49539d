"""Metrics of motion, links and loops: tracking, spread, following, effort, contact, estimates,
timing.

Invariant: e is Eq. (9) and includes the delay; the spread compares one instant; a slave is
compared with its master as that was when the sample in use was taken. Effort counts the torque
in the record: Eq. (13) within its limit, gravity compensation included. A wall is the
scenario's, at the logged states; ticks without a record contribute nothing. A parameter counts
if the control law adapts it (Gamma > 0); if theta is unknown there is no error, but the
estimates are still reported.

Those of links and of the loops of sites add no definition to docs/definitions.md.
"""

from typing import NamedTuple

import numpy as np

from ...core.site_setup import Law
from ...core.task_space import POSE, POSITION
from ...core.vectors import Array
from ...log.orientations import choose_nearest_vectors
from ...log.site_log import compute_task_errors
from ...results import JsonObject
from ...scenario import Scenario
from ...scenario.expect import END_WINDOW_S
from .. import site_signals
from ..aligned import AlignedRecords, Bools, find_common_rows
from ..arm_rows import (
    ArmRows,
    PlanarArmRows,
    build_arm_rows,
    find_base_parameters,
    find_consistent_links,
)
from ..file_overview import describe_site_health
from ..run_view import RunView
from ..torque_sources import wall_depth, wall_force
from .measures import (
    CONTACT,
    EFFORT,
    FOLLOWING,
    LEARNING,
    LOOP,
    NETWORK,
    SPREAD,
    TRACKING,
    Metric,
    MetricValues,
    Quantity,
    list_shared_quantities,
    measure_shared,
    measures,
    metric,
    peak,
    rms,
    unavailable,
)

LONG_END_S = 5.0
"""Length of the end of a run for slopes of estimates and for contact, s."""
_ERRORS = {"rms_error": "RMS e", "max_error": "peak |e|", "max_error_end": "peak |e|, last 1 s"}
_SPREADS = {
    "spread_rms": "RMS spread, undelayed",
    "spread_max": "largest spread",
    "spread_end": "largest spread, last 1 s",
}
_LAGS = {
    "following_rms": "RMS {0}_m(t-T) - {0}_s",
    "following_max": "peak |{0}_m(t-T) - {0}_s|",
    "following_end": "the same, last 1 s",
}


@measures(
    "site", TRACKING, Quantity("settle_s", "settled", "s"), *list_shared_quantities(_ERRORS)
)
def measure_tracking(view: RunView, site: str) -> MetricValues:
    """Returns settling, RMS and peak of a site's e."""
    log = view.log
    part = log[site]
    if not len(part):
        return unavailable(TRACKING, f"no records of {site}")
    e = site_signals.joint_errors(part)
    space = log.scenario.sites[site].task.space
    unit = "rad" if space == "joints" else "m" if space == "position" else "m or rad"
    unsettled = f"|e| exceeds {site_signals.SETTLED_ERROR_RAD:g} {unit} in the last record"
    at_end = part.t_s > part.t_s[-1] - END_WINDOW_S
    return {
        **measure_shared(group=TRACKING, space=space, keys=_ERRORS, off=e, at_end=at_end),
        "settle_s": metric(site_signals.settling_time_s(part), unsettled),
    }


@measures("run", SPREAD, *list_shared_quantities(_SPREADS))
def measure_spread(view: RunView, _run: str) -> MetricValues:
    """Returns the undelayed spread: the largest difference between sites' angles of a joint at
    an instant.

    In task space between their places, along axes that all follow. Instants are the ticks of
    the first site at which every other site has its own latest tick recorded.
    """
    log = view.log
    runs = view.sites
    if view.absent:
        return unavailable(SPREAD, f"no records of {', '.join(view.absent)}")
    sites = [run.records for run in runs.values()]
    rows, known = find_common_rows(sites)
    poses = [records.shared[row] for records, row in zip(sites, rows, strict=True)]
    if not known.any():
        return unavailable(SPREAD, "no instant of which every site has a record")
    there = np.stack(poses)[:, known]
    # of vectors on both sides of half a turn the difference is a whole turn
    if sites[0].x.shape[1] == POSE:
        for turns in there[1:, :, POSITION:]:
            turns[:] = choose_nearest_vectors(turns, there[0, :, POSITION:])
    apart = np.ptp(there, axis=0)
    axes = [records.axes for records in sites]
    if all(axes):
        apart = apart * np.prod(axes, axis=0)
    end_s = min(float(records.t_s[-1]) for records in sites)
    last = sites[0].t_s[known] > end_s - END_WINDOW_S
    none = "no instant of the last second of which every site has a record"
    return measure_shared(
        group=SPREAD,
        space=log.scenario.sites[log.sites[0]].task.space,
        keys=_SPREADS,
        off=apart,
        at_end=last,
        none=none,
    )


@measures("link", FOLLOWING, *list_shared_quantities(_LAGS))
def measure_following(view: RunView, link: str) -> MetricValues:
    """Returns q_m(t - T) - q_s of a master's link to a slave, T being the effective delay of
    the tick.

    At every tick t_k of the slave from its first sample of that master on: the master's angles
    in the record whose sample the slave has in use, less the slave's own.
    """
    log = view.log
    runs = view.sites
    use = view.links[link]
    peer = use.peer
    site = use.site
    if [log.scenario.sites[name].role for name in (peer, site)] != ["master", "slave"]:
        return unavailable(FOLLOWING, "no link of a master to a slave", applies=False)
    absent = [name for name in (peer, site) if name not in runs]
    if absent:
        return unavailable(FOLLOWING, f"no records of {', '.join(absent)}")
    master = runs[peer].records
    slave = runs[site].records
    row = slave.used[peer] - master.first
    inside = (slave.used[peer] >= 0) & (row >= 0) & (row < len(master.known))
    row = np.clip(row, 0, len(master.known) - 1)
    known = slave.known & inside & master.known[row]
    if not known.any():
        return unavailable(FOLLOWING, f"no record of {site} uses a recorded sample of {peer}")
    there = master.shared[row]
    apart = compute_task_errors(there, slave.x, slave.axes) if slave.x.size else there - slave.q
    off = apart[known]
    last = slave.known_at_end(END_WINDOW_S)[known]
    space = log.scenario.sites[site].task.space
    none = "no sample in the last second"
    return measure_shared(
        group=FOLLOWING, space=space, keys=_LAGS, off=off, at_end=last, none=none
    )


@measures(
    "site",
    EFFORT,
    Quantity("effort_nm2_s", "effort, int |tau|^2", "N²m²s", "sum"),
    Quantity("rms_tau_nm", "RMS tau", "N m"),
    Quantity("peak_tau_nm", "peak |tau|", "N m"),
    Quantity("saturated_share", "ticks at the limit"),
    Quantity("chatter_nm", "chatter, mean change of tau a tick", "N m"),
)
def measure_effort(view: RunView, site: str) -> MetricValues:
    """Returns effort and saturation of a site."""
    log = view.log
    part = log[site]
    if not len(part):
        return unavailable(EFFORT, f"no records of {site}")
    tau = part.tau
    steps = np.diff(tau, axis=0)[np.diff(part.tick) == 1]
    at_limit = np.any(np.abs(tau) >= log.scenario.sites[site].limits.tau_limit_nm, axis=1)
    return {
        "effort_nm2_s": metric(float(np.einsum("kj,kj->", tau, tau)) / part.rate_hz),
        "rms_tau_nm": metric(rms(tau)),
        "peak_tau_nm": metric(peak(tau)),
        "saturated_share": metric(float(at_limit.mean())),
        "chatter_nm": metric(
            float(np.abs(steps).mean(axis=0).max()) if len(steps) else None, "no two ticks"
        ),
    }


@measures(
    "wall",
    CONTACT,
    Quantity("force_mean_n", "normal force, mean", "N"),
    Quantity("force_deviation_n", "its deviation", "N"),
    Quantity("force_peak_n", "its peak", "N"),
    Quantity("hits", "hits", "", "sum"),
    Quantity("contact_share", "ticks in contact"),
    Quantity("depth_max_m", "deepest", "m"),
    Quantity("end_force_mean_n", "normal force, mean, last 5 s", "N"),
    Quantity("end_force_deviation_n", "its deviation, last 5 s", "N"),
    Quantity("end_force_peak_n", "its peak, last 5 s", "N"),
    Quantity("end_hits", "hits, last 5 s", "", "sum"),
)
def measure_wall_contact(view: RunView, name: str) -> MetricValues:
    """Returns force, hits and depth of a wall, over the run and over its last 5 s; None without
    records.

    The first record, of all and after a gap, begins no contact: its beginning is unknown.
    """
    site, wall = view.walls[name]
    run = view.sites.get(site)
    if run is None:
        return unavailable(CONTACT, "no records of the site")
    t_s = run.records.nominal_s
    known = run.records.known
    end_effector = run.torque.end_effector
    force = wall_force(wall, t_s, end_effector)
    touches = force > 0.0
    began = touches & np.concatenate([[False], ~touches[:-1] & known[:-1]])
    metrics = {
        "contact_share": metric(float(touches[known].mean())),
        "depth_max_m": metric(max(0.0, float(wall_depth(wall, end_effector)[known].max()))),
    }
    at_end = known & (t_s > t_s[known][-1] - LONG_END_S)
    for prefix, rows in (("", known), ("end_", at_end)):
        metrics[f"{prefix}force_mean_n"] = metric(float(force[rows].mean()))
        metrics[f"{prefix}force_deviation_n"] = metric(float(force[rows].std()))
        metrics[f"{prefix}force_peak_n"] = metric(float(force[rows].max()))
        metrics[f"{prefix}hits"] = metric(float(np.count_nonzero(began[rows])))
    return {key: metrics[key] for key in unavailable(CONTACT, "")}


class BaseEstimates(NamedTuple):
    """Estimates of a chain in the combinations of learnt parameters that torques determine,
    shape (B,) each.

    Attributes:
        parameter: the parameter that each is named after, by its place in theta, from 0.
        theta: of the true parameters; None if unknown.
        first, last: of the estimates of the first and the last record.
        consistent_first, consistent_last: for each link, if some body has these estimates.
    """

    parameter: list[int]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    consistent_first: list[bool]
    consistent_last: list[bool]


class ParameterEstimates(NamedTuple):
    """Estimates of a site, shape (P,) each.

    Attributes:
        learnt: True for each that the law adapts.
        theta: the true parameters; None if unknown.
        first, last: the estimates of the first and the last record.
        slope_per_s: of straight lines through the last 5 s, 1/s; None with less than two
            records.
        base: the same of a chain, of whose parameters torques determine combinations alone;
            else None.
    """

    learnt: list[bool]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    slope_per_s: list[float] | None
    base: BaseEstimates | None = None

    def to_json(self) -> JsonObject:
        """Returns the estimates, ready for JSON."""
        content = self._asdict()
        base = content.pop("base")
        return content if base is None else {**content, "base": base._asdict()}


def read_parameter_estimates(scenario: Scenario, records: AlignedRecords) -> ParameterEstimates:
    """Returns the estimates of a site, and their least-squares slopes at the end."""
    spec = scenario.sites[records.site]
    arm = build_arm_rows(scenario, records.site)
    gains = spec.control.gains(arm.theta)
    theta_hat = records.theta_hat
    moved = (theta_hat != theta_hat[0]).any(axis=0)
    adapted = np.array(gains.Gamma) > 0.0 if gains.law is Law.ADAPTIVE else moved
    rows = records.known_at_end(LONG_END_S)
    slope = None
    if np.count_nonzero(rows) >= 2:
        x = records.t_s[rows] - records.t_s[rows].mean()
        slope = (x @ theta_hat[rows] / (x @ x)).tolist()
    theta = arm.theta.tolist() if spec.arm.known else None
    base = None if isinstance(arm, PlanarArmRows) else _in_base(arm, adapted, theta, theta_hat)
    ends = theta_hat[0].tolist(), theta_hat[-1].tolist()
    return ParameterEstimates(adapted.tolist(), theta, *ends, slope, base)


def read_all_estimates(view: RunView) -> dict[str, ParameterEstimates]:
    """Returns the estimates of every site with records."""
    return {
        site: read_parameter_estimates(view.scenario, run.records)
        for site, run in view.sites.items()
    }


def _in_base(
    arm: ArmRows, learnt: Bools, theta: list[float] | None, theta_hat: Array
) -> BaseEstimates:
    base = find_base_parameters(arm, learnt)
    first, last = (base.combination @ theta_hat[[0, -1]].T).T.tolist()
    truth = None if theta is None else (base.combination @ np.array(theta)).tolist()
    consistent = map(find_consistent_links, theta_hat[[0, -1]])
    return BaseEstimates(base.kept.tolist(), truth, first, last, *consistent)


@measures(
    "site",
    LEARNING,
    Quantity("theta_error_first", "|theta_hat - theta| at first"),
    Quantity("theta_error_last", "the same at last"),
    Quantity("theta_energy_first_j", "theta~' Gamma^-1 theta~ / 2 at first", "J"),
    Quantity("theta_energy_last_j", "the same at last", "J"),
    Quantity("theta_slope_per_s", "|theta_hat'|, last 5 s", "1/s"),
    Quantity("unphysical_links", "unphysical links, at last", "", "sum"),
)
def measure_parameter_error(view: RunView, site: str) -> MetricValues:
    """Returns the distance of the estimates from theta at both ends, and their rate of change
    at the end.

    Distance and energy of a chain are those of the combinations that torques determine: what
    else its estimates are off by stays as it is, and acts on nothing.
    """
    scenario = view.scenario
    estimates = view.compute_once(read_all_estimates).get(site)
    if estimates is None:
        return unavailable(LEARNING, "no records of the site")
    arm = build_arm_rows(scenario, site)
    gains = scenario.sites[site].control.gains(arm.theta)
    rows = np.array(estimates.learnt)
    if not rows.any():
        return unavailable(LEARNING, "nothing is learnt", applies=False)
    slopes = estimates.slope_per_s
    base = estimates.base
    slope = None if slopes is None else float(np.linalg.norm(np.array(slopes)[rows]))
    metrics = unavailable(LEARNING, "theta of the arm is not known")
    metrics["theta_slope_per_s"] = metric(slope, "less than two records in the last 5 s")
    metrics["unphysical_links"] = Metric(
        None, "it is no chain, of ten parameters a link", applies=False
    )
    if base is not None:
        metrics["unphysical_links"] = metric(base.consistent_last.count(False))
    if estimates.theta is None:
        return metrics
    off = np.array([estimates.first, estimates.last])[:, rows] - np.array(estimates.theta)[rows]
    if base is not None:
        off = np.array([base.first, base.last]) - np.array(base.theta)
    energy: list[float | None] = [None, None]
    if gains.law is Law.ADAPTIVE:
        energy = _find_parameter_energy(arm, rows, np.array(gains.Gamma), off)
    why = (
        "it is no finite number"
        if gains.law is Law.ADAPTIVE
        else "the gains of learning are not known"
    )
    for end, distance, stored in zip(
        ("first", "last"), np.linalg.norm(off, axis=1), energy, strict=True
    ):
        metrics[f"theta_error_{end}"] = metric(float(distance))
        metrics[f"theta_energy_{end}_j"] = metric(stored, why)
    return metrics


def _find_parameter_energy(
    arm: ArmRows, learnt: Bools, Gamma: Array, off: Array
) -> list[float | None]:
    """Returns the part of V of errors of base parameters, which learn with B Gamma B', shape
    (K, B), J.
    """
    if isinstance(arm, PlanarArmRows):
        energy = 0.5 * (off**2 / Gamma[learnt]).sum(axis=1)
    else:
        B = find_base_parameters(arm, learnt).combination
        energy = 0.5 * (off * np.linalg.solve(B * Gamma @ B.T, off.T).T).sum(axis=1)
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
def measure_network(view: RunView, link: str) -> MetricValues:
    """Returns effective delay, loss and bursts of a link."""
    use = view.links[link]
    age = use.age_ms
    never = "no sample ever came into use"
    unknown = "of no sample it is known whether it came"
    lossless = Metric(None, "nothing was lost", applies=False)
    return {
        "age_mean_ms": metric(age.mean if age else None, never),
        "age_p99_ms": metric(age.p99 if age else None, never),
        "age_max_ms": metric(age.max if age else None, never),
        "silence_ms": metric(use.silence_ms, never),
        "loss": metric(use.loss, unknown),
        "burst": lossless if use.loss == 0.0 else metric(use.burst, unknown),
        "late_samples": metric(
            use.counts.late if use.counts else None, f"no records of {use.site}"
        ),
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
def measure_loop(view: RunView, site: str) -> MetricValues:
    """Returns lateness, computing time and overruns of a site's loop, and its missing records."""
    log = view.log
    missing = {"missing": metric(log.missing(site))}
    if log.driver != "live":
        return unavailable(LOOP, "no clock was read", applies=False) | missing
    if not len(log[site]):
        return unavailable(LOOP, f"no records of {site}") | missing
    health = describe_site_health(log, site)
    busy = health["busy_us"]
    return {
        "late_p99_us": metric(health["late_us"]["p99"]),
        "late_max_us": metric(health["late_us"]["max"]),
        "busy_p99_us": metric(busy["p99"] if busy else None, "no second record"),
        "overruns": metric(health["overruns"]),
        **missing,
    }

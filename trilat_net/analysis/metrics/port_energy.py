"""Computes the energy that enters each arm, and the energy that network delays inject.

Delays can make coupled arms unstable, because the control torques then supply energy that no
operator supplied. The metrics in this module show where this energy comes from. Energy enters
an arm from the controller, the operator and the environment. The work of a torque tau during a
small motion dq of the joints is tau'dq. If the torque tau_k is constant during tick k, its work
is exactly tau_k' (q_{k+1} - q_k), where q_k are the joint angles. If the torque follows the
motion, the trapezoidal rule is used, which is exact for springs. The sum of this work over the
ticks is known as a passivity observer (Hannaford and Ryu 2002).

A link carries the state of arm j to arm i with the delay T_ij. The control torque of arm i is
the torque without delay, plus one term per link. The energy of this term is

    E_ij = int qd_i' S_i ( p_j(t - T_ij) - p_j(t) ) dt

where qd_i is the joint velocity of arm i, p_j the signal from arm j that the law uses, such as
its position, and S_i the gain of the law for this signal. docs/reference/metrics.md lists p_j
and S_i for each law, and the literature.
"""

import numpy as np

from ...core import Array, Gains
from ...scenario import Scenario
from ..aligned import AlignedRecords, DelayedPeer, PeerTrajectory, hold_torque
from ..arm_rows import ArmRows, build_arm_rows
from ..following import build_following
from ..run_view import RunView
from .measures import ENERGY, Metric, MetricValues, Quantity, measures, unavailable

_NO_FRICTION = Metric(None, "the joints have no friction", applies=False)


def held_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that is held constant within each tick period, in J.

    The work in period k is exactly tau_k' (q_{k+1} - q_k), whatever the motion within the
    period.

    Args:
        torque: Torque in every period, shape (K - 1, n) or longer, in N m.
        q: Joint angles at the ticks, shape (K, n), in rad.

    Returns:
        Work in each period, shape (K - 1,), in J.
    """
    motion = np.diff(q, axis=0)
    period_torque = torque[: len(motion)]
    work: Array = np.einsum("kj,kj->k", period_torque, motion)
    return work


def trapezoid_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque in each tick period, computed with the trapezoidal rule.

    The torque is assumed to change linearly with the joint angle between two ticks.

    Args:
        torque: Torque at the ticks, shape (K, n), in N m.
        q: Joint angles at the ticks, shape (K, n), in rad.

    Returns:
        Work in each period, shape (K - 1,), in J.
    """
    torque_left = torque[:-1]
    torque_right = torque[1:]
    mean_torque = 0.5 * (torque_left + torque_right)
    return held_work(mean_torque, q)


def _held_control_torque(records: AlignedRecords, scenario: Scenario) -> Array:
    """Returns the torque with which the controller drove an arm in every tick period.

    For an arm that is not simulated, the torque of the drives between two ticks is unknown. The
    mean of the commands at both ticks is used.

    Args:
        records: Records of the site.
        scenario: Scenario of the run.

    Returns:
        Torque, shape (K - 1, n), in N m.
    """
    spec = scenario.sites[records.site]
    tau = records.tau
    if spec.plant != "simulated":
        tau_left = tau[:-1]
        tau_right = tau[1:]
        return 0.5 * (tau_left + tau_right)
    tau_limit = np.asarray(spec.limits.tau_limit_nm)
    digital = scenario.is_digital
    held = hold_torque(tau, tau_limit, digital=digital)
    return held[:-1]


def _mechanical_energy(arm: ArmRows, records: AlignedRecords) -> Array:
    """Computes the kinetic and potential energy of an arm at every record, in J.

    For the planar arm the energy is 1/2 qd'M qd + g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)),
    with the inertia matrix M, the gravitational acceleration g and the parameters theta. The
    potential energy is zero when the arm is level.

    Args:
        arm: The arm.
        records: Records of the site that runs the arm.

    Returns:
        Energy, shape (K,).
    """
    momentum = arm.multiply_inertia(records.q, records.qd)
    qd_M_qd = np.einsum("kj,kj->k", records.qd, momentum)
    kinetic = 0.5 * qd_M_qd
    potential = arm.potential_energy(records.q)
    energy: Array = kinetic + potential
    return energy


@measures(
    "site",
    ENERGY,
    Quantity("controller_j", "given by the controller", "J", "sum"),
    Quantity("hands_j", "given by hands", "J", "sum"),
    Quantity("hands_most_j", "given by hands, most at any time", "J"),
    Quantity("walls_j", "given by environment", "J", "sum"),
    Quantity("walls_most_j", "given by environment, most at any time", "J"),
    Quantity("friction_j", "taken by friction", "J", "sum"),
    Quantity("mechanical_j", "gained by the arm", "J", "sum"),
    Quantity("unaccounted_j", "unaccounted for", "J"),
)
def _measure_port_energy(view: RunView, site: str) -> MetricValues:
    """Measures the energies that an arm exchanged with controller, operator and environment.

    Only tick periods with a record at both ends count. The mechanical stops of joints count as
    environment. Friction absorbs part of the supplied energy. The difference between the energy
    gained and the energy supplied is reported as unaccounted, and should be small.

    Args:
        view: The run.
        site: Name of the site that runs the arm.
    """
    if site not in view.sites:
        return unavailable(ENERGY, f"no records of {site}", of="site")
    scenario = view.scenario
    records = view.sites[site].records
    torque = view.sites[site].torque
    arm = build_arm_rows(scenario, records.site)
    spec = scenario.sites[records.site]
    known = records.known_periods
    q = records.q
    if not known.any():
        return unavailable(ENERGY, "no two records in a row", of="site")

    def accumulate(work: Array) -> Array:
        """Returns the cumulative work over time. Periods without records count as zero."""
        known_work = np.where(known, work, 0.0)
        return np.cumsum(known_work)

    controller_torque = _held_control_torque(records, scenario)
    controller = accumulate(held_work(controller_torque, q))

    operator_now_work = trapezoid_work(torque.operator_now, q)
    operator_held_work = held_work(torque.operator_held, q)
    operator = accumulate(operator_now_work + operator_held_work)

    stop_torque = arm.stop_torque(q, records.qd)
    walls_now_work = trapezoid_work(torque.environment_now + stop_torque, q)
    walls_held_work = held_work(torque.environment_held, q)
    walls = accumulate(walls_now_work + walls_held_work)

    friction_torque = arm.friction(records.qd)
    friction = accumulate(trapezoid_work(friction_torque, q))

    metrics = {
        "controller_j": Metric.of_value(controller[-1]),
        "hands_j": Metric.of_value(operator[-1]),
        "hands_most_j": _measure_most(operator),
    }
    if spec.environment or stop_torque.any():
        metrics["walls_j"] = Metric.of_value(walls[-1])
        metrics["walls_most_j"] = _measure_most(walls)
    else:
        no_walls = Metric(None, "the scenario has no environment at this site", applies=False)
        metrics["walls_j"] = no_walls
        metrics["walls_most_j"] = no_walls

    metrics["friction_j"] = _NO_FRICTION
    if friction_torque.any():
        metrics["friction_j"] = Metric.of_value(friction[-1])
    if not spec.arm.known:
        unknown = Metric(None, "theta of the arm is not known")
        return {**metrics, "mechanical_j": unknown, "unaccounted_j": unknown}

    energy = _mechanical_energy(arm, records)
    gained = accumulate(np.diff(energy))
    unaccounted = gained - controller - operator - walls + friction
    largest_unaccounted = np.abs(unaccounted).max()
    metrics["mechanical_j"] = Metric.of_value(gained[-1])
    metrics["unaccounted_j"] = Metric.of_value(float(largest_unaccounted))
    return metrics


def _measure_most(energy: Array) -> Metric:
    """Returns the largest value of an energy over time as a metric, in J, but at least 0."""
    largest = float(energy.max())
    return Metric.of_value(max(0.0, largest))


@measures(
    "link",
    ENERGY,
    Quantity("delay_j", "given by the delay", "J", "sum"),
    Quantity("delay_most_j", "given by the delay, most at any time", "J"),
)
def _measure_delay_energy(view: RunView, link: str) -> MetricValues:
    """Measures the energy that the delay of a link injects into the receiving arm, in J.

    A site is the process that runs one arm. The delay makes the receiving site follow an old
    position of the sending site (peer). The difference from the torque without delay does work
    on the arm. The torques are those of the control law before they are limited. Only tick
    periods that have a record at both ends and in which the site follows its peers are counted.

    Args:
        view: The recorded run.
        link: Name of the link, such as "m1->s" for the link from site m1 to site s.

    Returns:
        The energy at the end of the run and its maximum, by key. If the energies are unknown,
        each metric contains the reason.
    """
    runs = view.sites
    peer = view.links[link].peer
    site = view.links[link].site
    arm = build_arm_rows(view.scenario, site)
    law = view.scenario.sites[site].control
    gains = law.gains(arm.theta)

    missing = [name for name in (peer, site) if name not in runs]
    if missing:
        return unavailable(ENERGY, f"no records of {', '.join(missing)}", of="link")
    if gains.is_user:
        name = view.scenario.sites[site].law_name
        unknown = f"the law {name} does not say which part of its torque is due to a peer"
        return unavailable(ENERGY, unknown, of="link")

    records = runs[site].records
    peer_records = runs[peer].records
    dominance = runs[site].dominance
    if min(len(records.known), len(peer_records.known)) < 2:
        return unavailable(ENERGY, "no two records in a row", of="link")

    peer_view = records.view_delayed_peer(PeerTrajectory(peer_records))
    is_peer_known = peer_view.delayed.known & peer_view.now.known
    is_known = is_peer_known & records.follows
    is_judged = records.known_periods & is_known[:-1] & is_known[1:]
    if not is_judged.any():
        return unavailable(ENERGY, "no period rests on records of both sites", of="link")

    j = list(records.used).index(peer)
    torque = _compute_delay_torque(
        gains=gains,
        arm=arm,
        records=records,
        peer_records=peer_records,
        peer_motion=peer_view,
        alpha=dominance.alpha[:, [j]],
        alpha_rate=dominance.rate[:, [j]],
    )

    work = trapezoid_work(torque, records.q)
    judged_work = np.where(is_judged, work, 0.0)
    injected = np.cumsum(judged_work)
    return {
        "delay_j": Metric.of_value(injected[-1]),
        "delay_most_j": _measure_most(injected),
    }


def _compute_delay_torque(
    gains: Gains,
    arm: ArmRows,
    records: AlignedRecords,
    peer_records: AlignedRecords,
    peer_motion: DelayedPeer,
    alpha: Array,
    alpha_rate: Array,
) -> Array:
    """Returns the change of a control law's torque that is due to the network delay.

    This change is the torque minus the torque without delay. The effect of the delay on the
    Coulomb friction that a law compensates is left out.

    Args:
        gains: Gains of the law.
        arm: Arm of the site.
        records: Records of the site.
        peer_records: Records of the peer.
        peer_motion: Motion of the peer with the delay as the site receives it, and without
            delay.
        alpha: Dominance factor of the peer, shape (K, 1).
        alpha_rate: Time derivative of the dominance factor, shape (K, 1), in 1/s.

    Returns:
        Torque, shape (K, n), in N m.
    """
    all_rows = slice(None)
    position_lag = peer_motion.delayed.q - peer_motion.now.q
    rate_lag = peer_motion.delayed.qd - peer_motion.now.qd
    # the delay shifts the reference, which is the weighted mean of the peers
    reference_change = alpha * position_lag
    reference_rate_change = alpha * rate_lag + alpha_rate * position_lag

    axes = np.array(records.axes or 1.0)
    Lambda = axes * np.array(gains.Lambda)
    Kd = axes * np.array(gains.Kd)
    following = build_following(arm, records.q, records.qd, Lambda).without_posture()
    if gains.is_adaptive:
        # without gravity the torque is linear in v and a: it is the part due to the shift
        v, a = following.compute_reference(all_rows, -reference_change, -reference_rate_change)
        torque = arm.weightless().law_torque(
            theta_hat=records.theta_hat,
            q=records.q,
            qd=records.qd,
            v=v,
            a=a,
        )
        damping = following.compute_joint_torque(all_rows, Kd * reference_rate_change)
        return torque + np.array(gains.Kp) * v + damping

    K = axes * np.array(gains.K)
    force = K * reference_change + Kd * reference_rate_change
    if np.any(gains.k_f):
        k_f = axes * np.array(gains.k_f)
        torque_lag = _compute_reflected_lag(records, peer_records)
        force = force + k_f * alpha * torque_lag
    return following.compute_joint_torque(all_rows, force)


def _compute_reflected_lag(records: AlignedRecords, peer_records: AlignedRecords) -> Array:
    """Returns the error of a fed-back torque that is due to the network delay.

    A control law can feed back the external torque of another arm. This torque arrives late.
    The error is the delayed torque minus the present one.

    Args:
        records: Records of a site whose law feeds back the external torque of its peer.
        peer_records: Records of the peer.

    Returns:
        The difference, shape (K, n), in N m. Forces in N if the peer measures a wrench.
    """
    peer_torque = peer_records.tau_x
    if peer_records.wrench.size:
        peer_torque = peer_records.wrench

    used = records.used[peer_records.site]
    is_used = used >= 0
    has_arrived = is_used[:, np.newaxis]
    last_row = len(peer_records.known) - 1
    row_of_peer = used - peer_records.first
    clipped_row = np.clip(row_of_peer, 0, last_row)
    reflected = np.where(has_arrived, -peer_torque[clipped_row], 0.0)

    columns = [
        np.interp(records.t_s, peer_records.t_s, -joint_torque)
        for joint_torque in peer_torque.T
    ]
    present = np.stack(columns, axis=1)
    lag: Array = reflected - present
    return lag

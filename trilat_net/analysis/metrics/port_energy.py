"""Metrics of energy: of a site's ports, of its arm, and of the delay of each link.

The work of a torque is int tau' dq. For a torque that is held over a period it is exactly
tau_k' (q_{k+1} - q_k). For a torque that follows the state, the trapezoid rule over dq is used,
which is exact for springs. The running energy of a port is that of a passivity observer
(Hannaford and Ryu 2002).

The control torque is affine in a peer's motion: it equals the torque of the same law without
delay, at the same state and estimate, plus one term per link,

    E_ij = int qd_i' dtau_ij dt,   dtau_ij = S_i ( p_j(t - T_ij) - p_j(t) ),

where p_j is the signal that the link carries, and S_i the law's gain. docs/metrics.md gives
both for each law, and the sources.
"""

import numpy as np

from ...core.site_setup import Gains, Law, Scheme
from ...core.vectors import Array
from ...scenario import Scenario
from ...scenario.laws import identify_law
from ..aligned import (
    AlignedRecords,
    DelayedPeer,
    PeerTrajectory,
    hold_torque,
    view_delayed_peer,
)
from ..arm_rows import ArmRows, build_arm_rows
from ..following import build_following
from ..run_view import RunView
from .measures import ENERGY, Metric, MetricValues, Quantity, measures, metric, unavailable

_NO_FRICTION = Metric(None, "its joints have no friction", applies=False)


def held_work(torque: Array, q: Array) -> Array:
    """Returns the work per period of a torque that is held over every period.

    Args:
        torque: the torque in every period, shape (K - 1, n) or longer, N m.
        q: joint angles at the ticks, shape (K, n), rad.

    Returns:
        Work per period, shape (K - 1,), J.
    """
    work: Array = np.einsum("kj,kj->k", torque[: len(q) - 1], np.diff(q, axis=0))
    return work


def trapezoid_work(torque: Array, q: Array) -> Array:
    """Returns the work per period of a torque that follows the state, by the trapezoid rule.

    Args:
        torque: the torque at the ticks, shape (K, n), N m.
        q: joint angles at the ticks, shape (K, n), rad.

    Returns:
        Work per period, shape (K - 1,), J.
    """
    return held_work(0.5 * (torque[:-1] + torque[1:]), q)


def held_control_torque(records: AlignedRecords, scenario: Scenario) -> Array:
    """Returns the torque that the controller held over every period, shape (K - 1, n), N m.

    The drives of an external arm received tau, but their torque between two ticks is unknown:
    the mean of both ticks is used.
    """
    spec = scenario.sites[records.site]
    if spec.plant != "simulated":
        return 0.5 * (records.tau[:-1] + records.tau[1:])
    digital = Scheme[scenario.scheme.upper()] is Scheme.DIGITAL
    return hold_torque(records.tau, np.asarray(spec.limits.tau_limit_nm), digital=digital)[:-1]


def mechanical_energy(arm: ArmRows, records: AlignedRecords) -> Array:
    """Returns the arm's kinetic and potential energy, shape (K,), J.

    For the planar arm it is 1/2 qd'M qd + g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)): the
    height is zero when the arm is level.
    """
    momentum = arm.multiply_inertia(records.q, records.qd)
    kinetic = 0.5 * np.einsum("kj,kj->k", records.qd, momentum)
    energy: Array = kinetic + arm.potential_energy(records.q)
    return energy


@measures(
    "site",
    ENERGY,
    Quantity("controller_j", "given by the controller", "J", "sum"),
    Quantity("hands_j", "given by hands", "J", "sum"),
    Quantity("hands_most_j", "given by hands at most", "J"),
    Quantity("walls_j", "given by environment", "J", "sum"),
    Quantity("walls_most_j", "given by environment at most", "J"),
    Quantity("friction_j", "taken by friction", "J", "sum"),
    Quantity("mechanical_j", "gained by the arm", "J", "sum"),
    Quantity("unaccounted_j", "unaccounted for", "J"),
)
def measure_port_energy(view: RunView, site: str) -> MetricValues:
    """Returns the energies of a site's ports, over the periods with both ends recorded.

    The stops of joints count as environment. Friction absorbs energy that the arm does not
    gain.
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
        return np.cumsum(np.where(known, work, 0.0))

    controller = accumulate(held_work(held_control_torque(records, scenario), q))
    operator = accumulate(
        trapezoid_work(torque.operator_now, q) + held_work(torque.operator_held, q)
    )
    stop_torque = arm.stop_torque(q, records.qd)
    walls = accumulate(
        trapezoid_work(torque.environment_now + stop_torque, q)
        + held_work(torque.environment_held, q)
    )
    friction_torque = arm.friction(records.qd)
    friction = accumulate(trapezoid_work(friction_torque, q))
    metrics = {
        "controller_j": metric(controller[-1]),
        "hands_j": metric(operator[-1]),
        "hands_most_j": metric(max(0.0, float(operator.max()))),
    }
    if bool(spec.environment) or stop_torque.any():
        metrics["walls_j"] = metric(walls[-1])
        metrics["walls_most_j"] = metric(max(0.0, float(walls.max())))
    else:
        no_walls = Metric(None, "the scenario has no environment here", applies=False)
        metrics["walls_j"] = no_walls
        metrics["walls_most_j"] = no_walls
    metrics["friction_j"] = metric(friction[-1]) if friction_torque.any() else _NO_FRICTION
    if not spec.arm.known:
        unknown = Metric(None, "theta of the arm is not known")
        return {**metrics, "mechanical_j": unknown, "unaccounted_j": unknown}
    gained = accumulate(np.diff(mechanical_energy(arm, records)))
    unaccounted = np.abs(gained - controller - operator - walls + friction)
    return {
        **metrics,
        "mechanical_j": metric(gained[-1]),
        "unaccounted_j": metric(float(unaccounted.max())),
    }


@measures(
    "link",
    ENERGY,
    Quantity("delay_j", "given by the delay", "J", "sum"),
    Quantity("delay_most_j", "given by the delay at most", "J"),
)
def measure_delay_energy(view: RunView, link: str) -> MetricValues:
    """Returns the energy that a link's delay injects: in all, and the most up to any time, J.

    Only periods count that follow from records alone, and in which the site follows its peers.
    The torque is that of the law before its limit.
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
    if gains.law is Law.USER:
        name = identify_law(law)
        unknown = f"the law {name} does not say which part of its torque is due to a peer"
        return unavailable(ENERGY, unknown, of="link")
    records = runs[site].records
    peer_records = runs[peer].records
    dominance = runs[site].dominance
    if min(len(records.known), len(peer_records.known)) < 2:
        return unavailable(ENERGY, "no two records in a row", of="link")
    peer_view = view_delayed_peer(records, PeerTrajectory(peer_records))
    known = peer_view.delayed.known & peer_view.now.known & records.follows
    judged = records.known_periods & known[:-1] & known[1:]
    if not judged.any():
        return unavailable(ENERGY, "no period rests on records of both sites", of="link")
    j = list(records.used).index(peer)
    torque = _compute_delay_torque(
        gains=gains,
        arm=arm,
        records=records,
        peer_records=peer_records,
        view=peer_view,
        alpha=dominance.alpha[:, [j]],
        alpha_rate=dominance.rate[:, [j]],
    )
    injected = np.cumsum(np.where(judged, trapezoid_work(torque, records.q), 0.0))
    return {
        "delay_j": metric(injected[-1]),
        "delay_most_j": metric(max(0.0, float(injected.max()))),
    }


def _compute_delay_torque(
    gains: Gains,
    arm: ArmRows,
    records: AlignedRecords,
    peer_records: AlignedRecords,
    view: DelayedPeer,
    alpha: Array,
    alpha_rate: Array,
) -> Array:
    """Returns the torque that the delay of a link adds to that of the law, shape (K, n), N m.

    Its effect on the Coulomb friction that a law compensates is left out.

    Args:
        gains: gains of the law.
        arm: the site's arm.
        records: the site's records.
        peer_records: the peer's records.
        view: the peer as the site sees it.
        alpha: dominance factor of the peer, shape (K, 1).
        alpha_rate: its derivative, shape (K, 1), 1/s.
    """
    all_rows = slice(None)
    lag = view.delayed.q - view.now.q
    reference_change = alpha * lag
    reference_rate_change = alpha * (view.delayed.qd - view.now.qd) + alpha_rate * lag
    axes = np.array(records.axes or 1.0)
    Lambda = axes * np.array(gains.Lambda)
    Kd = axes * np.array(gains.Kd)
    following = build_following(arm, records.q, records.qd, Lambda).without_posture()
    if gains.law is Law.ADAPTIVE:
        v, a = following.compute_reference(all_rows, -reference_change, -reference_rate_change)
        torque = arm.weightless().law_torque(records.theta_hat, records.q, records.qd, v, a)
        damping = following.compute_joint_torque(all_rows, Kd * reference_rate_change)
        return torque + np.array(gains.Kp) * v + damping
    force = axes * np.array(gains.K) * reference_change + Kd * reference_rate_change
    # a law that reflects force uses the peer's external torque as it arrived, instead of the
    # peer's present one
    if np.any(gains.k_f):
        used = records.used[peer_records.site]
        row = np.clip(used - peer_records.first, 0, len(peer_records.known) - 1)
        peer_torque = peer_records.wrench if peer_records.wrench.size else peer_records.tau_x
        arrived = np.where((used >= 0)[:, None], -peer_torque[row], 0.0)
        columns = [np.interp(records.t_s, peer_records.t_s, -x) for x in peer_torque.T]
        present = np.stack(columns, axis=1)
        force = force + axes * np.array(gains.k_f) * alpha * (arrived - present)
    return following.compute_joint_torque(all_rows, force)

"""Energies of a site's ports, of its arm, and the energy that the delay of each link injects.

Invariant: the work of a torque is int tau' dq: tau_k' (q_k+1 - q_k), exactly, for one held over
a period; the trapezoid rule over dq for one that follows the state, which is exact for springs.
The running energy of a port is that of a passivity observer (Hannaford and Ryu 2002).

The control torque is affine in a peer's motion: that of the same law without delay, at this
state and estimate, plus one term per link, E_ij = int qd_i' dtau_ij dt, dtau_ij = S_i ( p_j(t -
T_ij) - p_j(t) ), p_j being what the link carries and S_i the law's gain; docs/metrics.md has it
for each law, and the sources.
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
    """Returns the work of a torque held over every period, shape (K - 1, n) or more, N m, per
    period, J.
    """
    work: Array = np.einsum("kj,kj->k", torque[: len(q) - 1], np.diff(q, axis=0))
    return work


def trapezoid_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that follows the present, shape (K, n), N m, per period, (K
    - 1,), J.
    """
    return held_work(0.5 * (torque[:-1] + torque[1:]), q)


def held_control_torque(records: AlignedRecords, scenario: Scenario) -> Array:
    """Returns the torque that the controller held over every period, shape (K - 1, n), N m.

    The drives of an arm outside of the program got tau; their torque in between is unknown: the
    trapezoid.
    """
    spec = scenario.sites[records.site]
    if spec.plant != "simulated":
        return 0.5 * (records.tau[:-1] + records.tau[1:])
    digital = Scheme[scenario.scheme.upper()] is Scheme.DIGITAL
    return hold_torque(records.tau, np.asarray(spec.limits.tau_limit_nm), digital=digital)[:-1]


def mechanical_energy(arm: ArmRows, records: AlignedRecords) -> Array:
    """Returns the arm's kinetic and potential energy, shape (K,), J.

    1/2 qd'M qd + g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)) of the planar arm: of height zero
    when level.
    """
    kinetic = 0.5 * np.einsum(
        "kj,kj->k", records.qd, arm.multiply_inertia(records.q, records.qd)
    )
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

    Stops of joints count as environment; friction takes what the arm gains less.
    """
    if site not in view.sites:
        return unavailable(ENERGY, f"no records of {site}", of="site")
    scenario = view.scenario
    (records, torque, _) = view.sites[site]
    arm = build_arm_rows(scenario, records.site)
    spec = scenario.sites[records.site]
    known = records.known_periods
    q = records.q
    if not known.any():
        return unavailable(ENERGY, "no two records in a row", of="site")

    def total(amounts: Array) -> Array:
        return np.cumsum(np.where(known, amounts, 0.0))

    controller = total(held_work(held_control_torque(records, scenario), q))
    operator = total(
        trapezoid_work(torque.operator_now, q) + held_work(torque.operator_held, q)
    )
    stops = arm.stop_torque(q, records.qd)
    rubbed = arm.friction(records.qd)
    walls = total(
        trapezoid_work(torque.environment_now + stops, q)
        + held_work(torque.environment_held, q)
    )
    friction = total(trapezoid_work(rubbed, q))
    no_walls = Metric(None, "the scenario has no environment here", applies=False)
    bounded = bool(spec.environment) or stops.any()
    found = {
        "controller_j": metric(controller[-1]),
        "hands_j": metric(operator[-1]),
        "hands_most_j": metric(max(0.0, float(operator.max()))),
        "walls_j": metric(walls[-1]) if bounded else no_walls,
        "walls_most_j": metric(max(0.0, float(walls.max()))) if bounded else no_walls,
        "friction_j": metric(friction[-1]) if rubbed.any() else _NO_FRICTION,
    }
    if not spec.arm.known:
        unknown = Metric(None, "theta of the arm is not known")
        return {**found, "mechanical_j": unknown, "unaccounted_j": unknown}
    change = total(np.diff(mechanical_energy(arm, records)))
    unaccounted = np.abs(change - controller - operator - walls + friction)
    return {
        **found,
        "mechanical_j": metric(change[-1]),
        "unaccounted_j": metric(float(unaccounted.max())),
    }


@measures(
    "link",
    ENERGY,
    Quantity("delay_j", "given by the delay", "J", "sum"),
    Quantity("delay_most_j", "given by the delay at most", "J"),
)
def measure_delay_energy(view: RunView, link: str) -> MetricValues:
    """Returns the energy that the delay of a link injects: in all, and the most until any time,
    J.

    Over the periods that follow from records alone and in which the site follows its peers; of
    the torque that the law asks for, before its limit.
    """
    runs = view.sites
    peer = view.links[link].peer
    site = view.links[link].site
    arm = build_arm_rows(view.scenario, site)
    law = view.scenario.sites[site].control
    gains = law.gains(arm.theta)
    absent = [name for name in (peer, site) if name not in runs]
    if absent:
        return unavailable(ENERGY, f"no records of {', '.join(absent)}", of="link")
    if gains.law is Law.USER:
        unknown = f"the law {identify_law(law)} does not say which part of its torque is due to a peer"
        return unavailable(ENERGY, unknown, of="link")
    records = runs[site].records
    other = runs[peer].records
    factors = runs[site].dominance
    if min(len(records.known), len(other.known)) < 2:
        return unavailable(ENERGY, "no two records in a row", of="link")
    delayed = view_delayed_peer(records, PeerTrajectory(other))
    known = delayed.delayed.known & delayed.now.known & records.follows
    judged = records.known_periods & known[:-1] & known[1:]
    if not judged.any():
        return unavailable(ENERGY, "no period rests on records of both sites", of="link")
    j = list(records.used).index(peer)
    torque = _delay_torque(
        gains=gains,
        arm=arm,
        records=records,
        other=other,
        view=delayed,
        alpha=factors.alpha[:, [j]],
        rate=factors.rate[:, [j]],
    )
    injected = np.cumsum(np.where(judged, trapezoid_work(torque, records.q), 0.0))
    return {
        "delay_j": metric(injected[-1]),
        "delay_most_j": metric(max(0.0, float(injected.max()))),
    }


def _delay_torque(
    gains: Gains,
    arm: ArmRows,
    records: AlignedRecords,
    other: AlignedRecords,
    view: DelayedPeer,
    alpha: Array,
    rate: Array,
) -> Array:
    """Returns the torque that the delay adds to that of the law, shape (K, n), N m.

    Without what it does to the Coulomb friction that a law compensates.
    """
    late = view.delayed.q - view.now.q
    off = alpha * late
    off_rate = alpha * (view.delayed.qd - view.now.qd) + rate * late
    every = slice(None)
    axes = np.array(records.axes or 1.0)
    follows = build_following(
        arm, records.q, records.qd, axes * np.array(gains.Lambda)
    ).without_posture()
    Kd = axes * np.array(gains.Kd)
    if gains.law is Law.ADAPTIVE:
        v, a = follows.compute_reference(every, -off, -off_rate)
        torque = arm.weightless().law_torque(records.theta_hat, records.q, records.qd, v, a)
        return (
            torque + np.array(gains.Kp) * v + follows.compute_joint_torque(every, Kd * off_rate)
        )
    pull = axes * np.array(gains.K) * off + Kd * off_rate
    # it reflects the torque on the peer: as it came, less the one at the same time
    if np.any(gains.k_f):
        used = records.used[other.site]
        row = np.clip(used - other.first, 0, len(other.known) - 1)
        pushed = other.wrench if other.wrench.size else other.tau_x
        came = np.where((used >= 0)[:, None], -pushed[row], 0.0)
        now = [np.interp(records.t_s, other.t_s, -column) for column in pushed.T]
        pull = pull + axes * np.array(gains.k_f) * alpha * (came - np.stack(now, axis=1))
    return follows.compute_joint_torque(every, pull)

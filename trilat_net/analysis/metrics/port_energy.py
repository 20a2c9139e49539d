"""Energies of a site's ports.

The energy stored in its arm, and the energy that the delay of each link injects.

Invariant: the work of a torque is int tau' dq: tau_k' (q_k+1 - q_k), exactly, for one held over a period;
the trapezoid rule over dq for one that follows the state, which is exact for springs. The running energy
of a port is that of a passivity observer: Hannaford and Ryu, "Time-domain passivity control of haptic
interfaces", IEEE Trans. Robotics and Automation 18 (2002).

The control torque is affine in a peer's motion: the torque of the same law without delay, at this state
and estimate, plus one term per link,

    E_ij = int qd_i' dtau_ij dt,   dtau_ij = S_i ( p_j(t - T_ij) - p_j(t) ),

p_j being what the link carries (q_j, qd_j, for direct force reflection the torque) and S_i the law's
gain. The sum over links is exactly what delays add to the energy of the controller's port. For P+d it is
the term that damping must dominate, K int qd_i' (q_j(t - T) - q_j(t)) dt: Nuno, Basanez, Ortega and
Spong, "Position Tracking for Non-linear Teleoperators with Variable Time Delay", Int. J. Robotics
Research 28 (2009). It assumes nothing about the peers and does not predict the run without delay.
"""

from collections.abc import Mapping

import numpy as np

from ...core.site_setup import Gains, Law, Scheme
from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario import Scenario, SiteSpec
from ..aligned import AlignedRecords, PeerMotion, PeerTrajectory
from ..arm_rows import inertia_product_rows, regressor_rows
from ..dominance_history import DominanceHistory
from ..torque_split import TorqueSplit
from .metric_catalogue import Metric, MetricValues, metric, unavailable
from .parameter_error import has_known_theta

PORT_ENERGY_KEYS = (
    "controller_j",
    "hands_j",
    "hands_most_j",
    "walls_j",
    "walls_most_j",
    "mechanical_j",
    "unaccounted_j",
)


def held_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that is held, of every period, shape (K - 1,), J.

    Args:
        torque: from each row to the next, shape (K - 1, 2) or more rows, N m.
        q: joint angles, shape (K, 2), rad.
    """
    way = np.diff(q, axis=0)
    work: Array = np.einsum("kj,kj->k", torque[: len(way)], way)
    return work


def trapezoid_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that follows the present, of every period, shape (K - 1,), J.

    Args:
        torque: shape (K, 2), N m.
        q: joint angles, shape (K, 2), rad.
    """
    return held_work(0.5 * (torque[:-1] + torque[1:]), q)


def held_control_torque(track: AlignedRecords, scenario: Scenario) -> Array:
    """Returns the torque that the controller held over every period, shape (K - 1, 2), N m.

    tau_k of `digital`; of `second_order` the extrapolated 1.5 tau_k - 0.5 tau_(k-1) within the limit. An arm
    outside of the program was told tau; what its drives made of it in between is not known: the trapezoid.
    """
    spec, tau = scenario.sites[track.site], track.tau
    if spec.plant == "external":
        mean: Array = 0.5 * (tau[:-1] + tau[1:])
        return mean
    u = tau[:-1].copy()
    if Scheme[scenario.scheme.upper()] is Scheme.SECOND_ORDER:
        limit = spec.limits.tau_limit_nm
        u[1:] = np.clip(1.5 * tau[1:-1] - 0.5 * tau[:-2], -limit, limit)
    return u


def mechanical_energy(spec: SiteSpec, track: AlignedRecords) -> Array:
    """Returns the arm's kinetic and potential energy, shape (K,), J; of height zero where it is level.

    1/2 qd'M qd + g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)).
    """
    theta, q = spec.arm.theta, track.q
    kinetic = 0.5 * np.einsum("kj,kj->k", track.qd, inertia_product_rows(theta, q, track.qd))
    height = theta[3] * np.sin(q[:, 0]) + theta[4] * np.sin(q[:, 0] + q[:, 1])
    energy: Array = kinetic + spec.arm.g_m_s2 * height
    return energy


def measure_port_energy(scenario: Scenario, track: AlignedRecords, by: TorqueSplit) -> MetricValues:
    """Returns the energies of a site's ports, over the periods whose both ends are recorded.

    Args:
        scenario: the experiment.
        track: the site's records.
        by: who pushed it.
    """
    spec, there = scenario.sites[track.site], track.known_periods
    if not there.any():
        return unavailable(PORT_ENERGY_KEYS, "no two records in a row")

    def summed(amounts: Array) -> Array:
        return np.cumsum(np.where(there, amounts, 0.0))

    controller = summed(held_work(held_control_torque(track, scenario), track.q))
    hands = summed(trapezoid_work(by.operator_now, track.q) + held_work(by.operator_held, track.q))
    walls = summed(trapezoid_work(by.environment_now, track.q) + held_work(by.environment_held, track.q))
    found = {
        "controller_j": metric(controller[-1]),
        "hands_j": metric(hands[-1]),
        "hands_most_j": metric(max(0.0, float(hands.max()))),
        "walls_j": metric(walls[-1]) if spec.environment else NO_WALLS,
        "walls_most_j": metric(max(0.0, float(walls.max()))) if spec.environment else NO_WALLS,
    }
    if not has_known_theta(spec):
        return {**found, **unavailable(("mechanical_j", "unaccounted_j"), "theta of the arm is not known")}
    change = summed(np.diff(mechanical_energy(spec, track)))
    rest = change - controller - hands - walls
    return {
        **found,
        "mechanical_j": metric(change[-1]),
        "unaccounted_j": metric(float(np.abs(rest).max())),
    }


NO_WALLS = Metric(None, "the scenario has no environment here", applies=False)

DELAY_ENERGY_KEYS = ("delay_j", "delay_most_j")


def measure_delay_energy(
    log: Log,
    found: Mapping[str, AlignedRecords],
    shares: Mapping[str, DominanceHistory],
    peer: str,
    site: str,
) -> MetricValues:
    """Returns the energy that the delay of a link gave: in all, and the most until any time, J.

    Over the periods that rest on records alone and in which the site follows its peers; of the torque that
    the law asks for, before its limit.

    Args:
        log: the log.
        found: the sites' records.
        shares: their shares in their peers.
        peer: who sends.
        site: who receives.
    """
    spec = log.scenario.sites[site]
    absent = [name for name in (peer, site) if name not in found]
    if absent:
        return unavailable(DELAY_ENERGY_KEYS, f"no records of {', '.join(absent)}")
    gains = spec.control.gains(spec.arm.theta)
    if gains.law is Law.OWN:
        return unavailable(DELAY_ENERGY_KEYS, "a law of somebody's own: what it makes of a peer is not known")
    track, other = found[site], found[peer]
    if min(len(track.known), len(other.known)) < 2:
        return unavailable(DELAY_ENERGY_KEYS, "no two records in a row")
    used, past = track.used[peer], PeerTrajectory(other)
    # before its first sample the peer rests at its start pose (L7)
    seen = past.at(np.where(used >= 0, used / other.rate_hz, -1.0))
    now = past.at(track.t_s)
    known = seen.known & now.known & track.follows
    there = track.known_periods & known[:-1] & known[1:]
    if not there.any():
        return unavailable(DELAY_ENERGY_KEYS, "no period rests on records of both sites")
    share, j = shares[site], list(track.used).index(peer)
    torque = _delay_torque(gains, track, other, seen, now, share.alpha[:, j, None], share.rate[:, j, None])
    given = np.cumsum(np.where(there, trapezoid_work(torque, track.q), 0.0))
    return {"delay_j": metric(given[-1]), "delay_most_j": metric(max(0.0, float(given.max())))}


def _delay_torque(
    gains: Gains,
    track: AlignedRecords,
    other: AlignedRecords,
    seen: PeerMotion,
    now: PeerMotion,
    alpha: Array,
    rate: Array,
) -> Array:
    """Returns what the delay adds to the torque of a law, shape (K, 2), N m."""
    late = seen.q - now.q
    off = alpha * late
    off_rate = alpha * (seen.qd - now.qd) + rate * late
    if gains.law is Law.ADAPTIVE:
        Lambda = np.array(gains.Lambda)
        Y = regressor_rows(0.0, track.q, track.qd, Lambda * off, Lambda * off_rate)
        torque = np.einsum("kij,kj->ki", Y, track.theta_hat)
        added: Array = torque + np.array(gains.Kp) * Lambda * off + np.array(gains.Kd) * off_rate
        return added
    added = np.array(gains.K) * off + np.array(gains.Kd) * off_rate
    if any(gains.k_f):
        added = added + np.array(gains.k_f) * alpha * _reflected_delay_torque(track, other)
    return added


def _reflected_delay_torque(track: AlignedRecords, other: AlignedRecords) -> Array:
    """Returns the torque on a peer's arm as it came, less the one at the same time, shape (K, 2), N m."""
    used = track.used[other.site]
    row = np.clip(used - other.first, 0, len(other.known) - 1)
    came = np.where((used >= 0)[:, None], -other.tau_x[row], 0.0)
    now = np.stack([np.interp(track.t_s, other.t_s, -column) for column in other.tau_x.T], axis=1)
    late: Array = came - now
    return late

"""The energy that the delay of a link gave to the arm at its end.

Law: the controller's torque is affine in what it sees of a peer. So it is the torque that the same law would
have had without any delay, at this state and with this estimate, plus one term per link:

    E_ij = int qd_i' dtau_ij dt,   dtau_ij = S_i ( p_j(t - T_ij) - p_j(t) )

with p_j what the link carries (q_j, qd_j, for direct force reflection the torque) and S_i the law's gain from
it. Added up over the links this is exactly what delays add to the energy of the controller's port. For P+d it
is the term that damping has to dominate: K int qd_i' (q_j(t - T) - q_j(t)) dt; Nuno, Basanez, Ortega and
Spong, "Position Tracking for Non-linear Teleoperators with Variable Time Delay", Int. J. Robotics Research 28
(2009). It assumes nothing of the peers, and says nothing of what the run would have been without the delay.
"""

from collections.abc import Mapping

import numpy as np

from ..certificate.dynamics import regressor
from ..certificate.shares import Shares
from ..certificate.track import Moment, Past, Track
from ..core.arm import Array
from ..core.setup import Gains, Law
from ..log.reader import Log
from .energy import work
from .rows import steps
from .said import Facts, said, unsaid

LINK = ("delay_j", "delay_most_j")


def of_link(
    log: Log, found: Mapping[str, Track], shares: Mapping[str, Shares], peer: str, site: str
) -> Facts:
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
        return unsaid(LINK, f"no records of {', '.join(absent)}")
    gains = spec.control.gains(spec.arm.theta)
    if gains.law is Law.OWN:
        return unsaid(LINK, "a law of somebody's own: what it makes of a peer is not known")
    track, other = found[site], found[peer]
    if min(len(track.known), len(other.known)) < 2:
        return unsaid(LINK, "no two records in a row")
    used, past = track.used[peer], Past(other)
    # before its first sample the peer rests at its start pose (L7)
    seen = past.at(np.where(used >= 0, used / other.rate_hz, -1.0))
    now = past.at(track.t_s)
    known = seen.known & now.known & track.follows
    there = steps(track) & known[:-1] & known[1:]
    if not there.any():
        return unsaid(LINK, "no period rests on records of both sites")
    share, j = shares[site], list(track.used).index(peer)
    torque = _torque(gains, track, other, seen, now, share.alpha[:, j, None], share.rate[:, j, None])
    given = np.cumsum(np.where(there, work(torque, track.q), 0.0))
    return {"delay_j": said(given[-1]), "delay_most_j": said(max(0.0, float(given.max())))}


def _torque(
    gains: Gains, track: Track, other: Track, seen: Moment, now: Moment, alpha: Array, rate: Array
) -> Array:
    """Returns what the delay adds to the torque of a law, shape (K, 2), N m."""
    late = seen.q - now.q
    off = alpha * late
    off_rate = alpha * (seen.qd - now.qd) + rate * late
    if gains.law is Law.ADAPTIVE:
        Lambda = np.array(gains.Lambda)
        Y = regressor(0.0, track.q, track.qd, Lambda * off, Lambda * off_rate)
        torque = np.einsum("kij,kj->ki", Y, track.theta_hat)
        added: Array = torque + np.array(gains.Kp) * Lambda * off + np.array(gains.Kd) * off_rate
        return added
    added = np.array(gains.K) * off + np.array(gains.Kd) * off_rate
    if any(gains.k_f):
        added = added + np.array(gains.k_f) * alpha * _late_torque(track, other)
    return added


def _late_torque(track: Track, other: Track) -> Array:
    """Returns the torque on a peer's arm as it came, less the one at the same time, shape (K, 2), N m."""
    used = track.used[other.site]
    row = np.clip(used - other.first, 0, len(other.known) - 1)
    came = np.where((used >= 0)[:, None], -other.tau_x[row], 0.0)
    now = np.stack([np.interp(track.t_s, other.t_s, -column) for column in other.tau_x.T], axis=1)
    late: Array = came - now
    return late

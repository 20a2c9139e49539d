"""Tracking of each site, spread between sites, following of a master by its slaves, and control effort.

Invariant: e is Eq. (9) and includes the delay; the spread compares one instant; a slave is compared with
its master as that was when the sample in use was taken. Effort counts the torque in the record: Eq. (13)
within its limit, gravity compensation included.
"""

from collections.abc import Mapping

import numpy as np

from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario.expect import END_WINDOW_S
from .. import site_signals
from ..aligned import AlignedRecords, find_latest_rows
from .metric_catalogue import (
    EFFORT,
    FOLLOWING,
    SPREAD,
    TRACKING,
    MetricValues,
    metric,
    peak,
    rms,
    unavailable,
)


def measure_tracking(log: Log, site: str) -> MetricValues:
    """Returns settling, RMS and peak of a site's e."""
    part = log[site]
    if not len(part):
        return unavailable(TRACKING, f"no records of {site}")
    errors = site_signals.joint_errors(part)
    unsettled = f"|e| exceeds {site_signals.SETTLED_ERROR_RAD:g} rad in the last record"
    return {
        "settle_s": metric(site_signals.settling_time_s(part), unsettled),
        "rms_error_rad": metric(rms(errors)),
        "max_error_rad": metric(peak(errors)),
        "max_error_end_rad": metric(peak(errors[part.t_s > part.t_s[-1] - END_WINDOW_S])),
    }


def measure_spread(log: Log, aligned: Mapping[str, AlignedRecords]) -> MetricValues:
    """Returns the undelayed spread: the largest difference between sites' angles of a joint at an instant.

    Instants are the ticks of the first site at which every other site has its own latest tick recorded.
    """
    absent = [site for site in log.sites if site not in aligned]
    if absent:
        return unavailable(SPREAD, f"no records of {', '.join(absent)}")
    first = aligned[log.sites[0]]
    known, poses = first.known.copy(), []
    for records in aligned.values():
        row, recorded = find_latest_rows(records, first.t_s)
        known &= recorded
        poses.append(records.q[row])
    if not known.any():
        return unavailable(SPREAD, "no instant of which every site has a record")
    spread: Array = np.ptp(np.stack(poses)[:, known], axis=0)
    end_s = min(float(records.t_s[-1]) for records in aligned.values())
    last = spread[first.t_s[known] > end_s - END_WINDOW_S]
    none = "no instant of the last second of which every site has a record"
    return {
        "spread_rms_rad": metric(rms(spread)),
        "spread_max_rad": metric(peak(spread)),
        "spread_end_rad": metric(peak(last), none),
    }


def measure_following(log: Log, aligned: Mapping[str, AlignedRecords], peer: str, site: str) -> MetricValues:
    """Returns q_m(t - T) - q_s of a master's link to a slave, T being the effective delay of the tick.

    At every tick t_k of the slave from its first sample of that master on: the master's angles in the record
    whose sample the slave has in use, less the slave's own.
    """
    if [log.scenario.sites[name].role for name in (peer, site)] != ["master", "slave"]:
        return unavailable(FOLLOWING, "no link of a master to a slave", applies=False)
    absent = [name for name in (peer, site) if name not in aligned]
    if absent:
        return unavailable(FOLLOWING, f"no records of {', '.join(absent)}")
    master, slave = aligned[peer], aligned[site]
    row = slave.used[peer] - master.first
    inside = (slave.used[peer] >= 0) & (row >= 0) & (row < len(master.known))
    row = np.clip(row, 0, len(master.known) - 1)
    known = slave.known & inside & master.known[row]
    if not known.any():
        return unavailable(FOLLOWING, f"no record of {site} uses a recorded sample of {peer}")
    off = (master.q[row] - slave.q)[known]
    return {
        "following_rms_rad": metric(rms(off)),
        "following_max_rad": metric(peak(off)),
        "following_end_rad": metric(
            peak(off[slave.known_at_end(END_WINDOW_S)[known]]), "no sample in the last second"
        ),
    }


def measure_effort(log: Log, site: str) -> MetricValues:
    """Returns effort and saturation of a site."""
    part = log[site]
    if not len(part):
        return unavailable(EFFORT, f"no records of {site}")
    tau = site_signals.controller_torques(part)
    at_limit = np.any(np.abs(tau) >= log.scenario.sites[site].limits.tau_limit_nm, axis=1)
    return {
        "effort_nm2_s": metric(float(np.einsum("kj,kj->", tau, tau)) / part.rate_hz),
        "rms_tau_nm": metric(rms(tau)),
        "peak_tau_nm": metric(peak(tau)),
        "saturated_share": metric(float(at_limit.mean())),
    }

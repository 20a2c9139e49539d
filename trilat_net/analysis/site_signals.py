"""Signals of a site as columns over its records, and its settling time; empty logs give empty columns.

Invariant: one definition of each signal, for figures, page, summary and metrics. Torques of operators and
environment are those ON the arm, the negative of the record's tau_x of Eq. (8).
"""

from collections.abc import Callable, Sequence
from operator import attrgetter

import numpy as np

from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog

SETTLED_ERROR_RAD = 1e-2
"""A site has settled once no joint's error exceeds this any more, rad, or none along an axis, m."""


Signal = Callable[[SiteLog], Array]
"""A column over the K records of a site."""
joint_angles: Signal = attrgetter("q")
"""q, shape (K, n), rad."""
joint_errors: Signal = attrgetter("e")
"""e = q - q_des, Eq. (9), shape (K, n), rad."""
controller_torques: Signal = attrgetter("tau")
"""tau, Eq. (13), shape (K, n), N m."""
parameter_estimates: Signal = attrgetter("theta_hat")
"""theta_hat, Eq. (15), shape (K, P); P = 5 of the planar arm, kg m^2 and kg m, 10 n of a chain."""


def reference_angles(part: SiteLog) -> Array:
    """Returns q_des, Eq. (6), shape (K, n), rad; in task space, where joints have none, q."""
    return part.q if part.layout.task else part.q_des


def follows_in_task_space(log: Log) -> bool:
    """True if sites follow with their end effectors: an axis has an error then, and no joint."""
    return any(arm.shares_pose for arm in log.scenario.arms.values())


def joint_error_rates(part: SiteLog) -> Array:
    """Returns qd - qd_des, Eq. (18), shape (K, n), rad/s; in task space xd - xd_des, shape (K, m)."""
    return (part.xd - part.qd_des) * np.array(part.axes) if part.layout.task else part.qd - part.qd_des


def shared_unit(log: Log) -> str:
    """Returns the unit of what sites share and of their errors: "rad", "m", or of poses both."""
    return {"joints": "rad", "position": "m"}.get(log.scenario.sites[log.sites[0]].task.space, "m, rad")


def external_torques(part: SiteLog) -> Array:
    """Returns the torque of operator and environment ON the arm, shape (K, n), N m: the negative of tau_x."""
    return 0.0 - part.tau_x  # 0 - 0 is 0, where -0 would print as such


def sample_ages_ms(log: Log, site: str) -> Array:
    """Returns the age of the sample in use per peer, shape (K, N - 1), ms; NaN before the first."""
    part = log[site]
    columns = [part.age_s(peer, log.scenario.sites[peer].rate_hz) * 1e3 for peer in part.peers]
    return np.array(columns).reshape(len(part.peers), len(part)).T


def sites_with_operator(log: Log) -> list[str]:
    """Returns the sites with an operator, by the scenario or by the records."""
    return [name for name in log.sites if log.scenario.sites[name].hands or np.any(log[name].tau_x)]


def largest_magnitude(values: Array) -> Array:
    """Returns the largest absolute value of each row, shape (K,)."""
    found: Array = np.abs(values).max(axis=1, initial=0.0)
    return found


def largest_remaining_error(part: SiteLog) -> Array:
    """Returns the largest error of any joint from each record to the last, shape (K,), rad."""
    largest = largest_magnitude(joint_errors(part))
    return np.maximum.accumulate(largest[::-1])[::-1]


def settling_time_s(part: SiteLog) -> float | None:
    """Returns when an error last exceeded `SETTLED_ERROR_RAD`, s; 0 if none did, None if one still does."""
    if not len(part):
        return None
    above = np.flatnonzero(largest_remaining_error(part) > SETTLED_ERROR_RAD)
    if not len(above):
        return 0.0
    return None if above[-1] == len(part) - 1 else float(part.t_s[above[-1]])


def settling_time_of_all_s(times_s: Sequence[float | None]) -> float | None:
    """Returns when the last of some sites has settled, s; None if one has not."""
    settled = [at_s for at_s in times_s if at_s is not None]
    return max(settled) if len(settled) == len(times_s) else None


def operator_displacement(log: Log, twin: Log, site: str) -> tuple[Ints, Array, Array]:
    """Returns how far operators moved a site: q of the log minus q of its twin without them, (K, n), rad.

    Before it stand the ticks that both logs have, and their times, s.
    """
    part, other = log[site], twin[site]
    tick, ours, theirs = np.intersect1d(part.tick, other.tick, assume_unique=True, return_indices=True)
    return tick, part.t_s[ours], joint_angles(part)[ours] - joint_angles(other)[theirs]


def true_parameters(log: Log, site: str) -> Array:
    """Returns the true parameters of the arm of a site, shape (P,): theta of Eq. (24), or ten a link."""
    return log.scenario.arms[site].theta

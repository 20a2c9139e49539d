"""Computes signals of an arm from its records, such as tracking errors, and its settling time.

A signal is an array with one row per record of the log. The settling time is the time after
which an error stays small. Signals that only figures show are in `presentation.plot_signals`.

Invariant:
    - Each signal has one definition, used by figures, pages, summaries and metrics alike.
    - The torques of operators and environment are reported as they act on the arm. Their sign
      is the opposite of the recorded tau_x, the external torque in Eq. (8) of the paper.
    - Empty logs give empty arrays.
"""

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ..core import Array
from ..log import Ints, Log, SiteLog
from ..scenario import END_WINDOW_S

SETTLED_ERROR_RAD = 1e-2
"""Largest error of a settled site, in rad for joints and in m for axes of end effectors."""

Signal = Callable[[SiteLog], Array]
"""Function that returns a signal of a site, with a row for each of its K records."""
joint_angles: Signal = attrgetter("q")
"""Joint angles q, shape (K, n), in rad."""
joint_errors: Signal = attrgetter("e")
"""Errors e = q - q_des, Eq. (9), shape (K, n), in rad."""
controller_torques: Signal = attrgetter("tau")
"""Control torques tau, Eq. (13), shape (K, n), in N m."""
parameter_estimates: Signal = attrgetter("theta_hat")
"""Parameter estimates theta_hat, Eq. (15), shape (K, P), in kg m^2 and kg m.

P is 5 for the planar arm and 10 n for a chain.
"""


def follows_in_task_space(log: Log) -> bool:
    """Returns True if the arms follow each other with their end effectors.

    In that case, errors are measured along spatial axes. Otherwise, they are differences
    between joint angles.

    Args:
        log: The log of the run.
    """
    arms = log.scenario.arms.values()
    return any(arm.shares_pose for arm in arms)


def external_torques(site_log: SiteLog) -> Array:
    """Returns the torque of operator and environment ON the arm, shape (K, n), in N m.

    The records contain tau_x, which has the opposite sign because Eq. (8) subtracts it.
    """
    return 0.0 - site_log.tau_x  # 0 - 0 is 0, but -0 would be printed as -0


class JointError(NamedTuple):
    """Largest tracking error of an arm, with the joint and the time at which it occurred.

    The tracking error is the difference between the pose of the arm and its reference.

    Attributes:
        value: The error, in the unit of the shared coordinates.
        site: Name of the site.
        joint: Name of the site and of its joint, or of the axis of its end effector.
        t_s: Time of the record, in s.
    """

    value: float
    site: str
    joint: str
    t_s: float

    @classmethod
    def find_largest(cls, site_log: SiteLog, from_s: float = -math.inf) -> "JointError | None":
        """Finds the largest tracking error of an arm.

        If several records have this error, the first one is returned.

        Args:
            site_log: Log of the site.
            from_s: Only records after this time are considered, in s.

        Returns:
            The error, or `None` if no record has a finite error.
        """
        first = int(np.searchsorted(site_log.t_s, from_s, side="right"))
        errors = np.abs(joint_errors(site_log)[first:])
        if not np.isfinite(errors).any():
            return None
        row, column = np.unravel_index(int(np.nanargmax(errors)), errors.shape)
        kind = "axis" if site_log.layout.task else "joint"
        return JointError(
            value=float(errors[row, column]),
            site=site_log.name,
            joint=f"{site_log.name} {kind} {column + 1}",
            t_s=float(site_log.t_s[first + row]),
        )

    @classmethod
    def find_in_last_second(cls, site_log: SiteLog) -> "JointError | None":
        """Finds the largest tracking error of an arm in the last second of its records.

        The last record alone could miss an oscillation.

        Args:
            site_log: Log of the site.

        Returns:
            The error, or `None` if no record of that second has a finite error.
        """
        if not len(site_log):
            return None
        return JointError.find_largest(site_log, from_s=float(site_log.t_s[-1]) - END_WINDOW_S)

    @classmethod
    def find_largest_of_all(cls, log: Log, sites: Sequence[str] = ()) -> "JointError | None":
        """Finds the largest tracking error of several arms in a run.

        Args:
            log: Log of the run.
            sites: Names of the sites to consider. Empty for all sites.

        Returns:
            The earliest occurrence of the largest error. `None` if no record has a finite
            error.
        """
        errors = [JointError.find_largest(log[site]) for site in sites or log.sites]
        known = [error for error in errors if error is not None]
        return max(known, key=lambda error: error.value, default=None)

    @classmethod
    def find_last_of_all(cls, log: Log) -> "JointError | None":
        """Finds the largest tracking error of all arms in the last second of their records.

        This error shows whether the arms agree at the end of the run.

        Args:
            log: Log of the run.

        Returns:
            The error, or `None` if no record of that second has a finite error.
        """
        errors = [JointError.find_in_last_second(log[site]) for site in log.sites]
        known = [error for error in errors if error is not None]
        return max(known, key=lambda error: error.value, default=None)


def largest_magnitude(values: Array) -> Array:
    """Returns the largest absolute value of each row, for example over the joints of an arm.

    For example, the row [0.1, -0.3] gives 0.3.

    Args:
        values: The array, shape (K, n).

    Returns:
        The largest absolute values, shape (K,). Zeros if the rows have no entries.
    """
    magnitudes = np.abs(values)
    largest: Array = magnitudes.max(axis=1, initial=0.0)
    return largest


def largest_remaining_error(site_log: SiteLog) -> Array:
    """Returns the largest error from each record to the end of the run.

    The arm has settled at the first record where this error is below a bound.

    Args:
        site_log: Log of the site.

    Returns:
        Largest error, shape (K,), which never increases.
    """
    largest = largest_magnitude(joint_errors(site_log))
    reversed_largest = largest[::-1]
    from_the_end = np.maximum.accumulate(reversed_largest)
    return from_the_end[::-1]


def settling_time_s(site_log: SiteLog) -> float | None:
    """Returns the time after which the error of an arm stays small (settling time), in s.

    This is the last time at which an error exceeded `SETTLED_ERROR_RAD`.

    Returns:
        The time, or 0 if no error ever exceeded the bound. `None` if the error of the last
        record exceeds it, or if there are no records.
    """
    if not len(site_log):
        return None
    is_above = largest_remaining_error(site_log) > SETTLED_ERROR_RAD
    rows_above = np.flatnonzero(is_above)
    if not len(rows_above):
        return 0.0
    last_row = rows_above[-1]
    if last_row == len(site_log) - 1:
        return None
    return float(site_log.t_s[last_row])


def settling_time_of_all_s(times_s: Sequence[float | None]) -> float | None:
    """Returns the time at which the last arm of a run has settled, in s.

    An arm has settled when its error stays small from then on. For example, 1.2 s and 3.4 s
    give 3.4 s.

    Args:
        times_s: Settling time of each site, from `settling_time_s`. `None` for a site that has
            not settled.

    Returns:
        The largest time, or `None` if a site has not settled.
    """
    settled_s = [time_s for time_s in times_s if time_s is not None]
    if len(settled_s) < len(times_s):
        return None
    return max(settled_s)


def operator_displacement(log: Log, twin: Log, site: str) -> tuple[Ints, Array, Array]:
    """Returns how far operators displaced an arm, compared with a run without operators.

    Arms also move without operators, for example while they synchronise. The difference between
    the two runs is the motion caused by the operators.

    Args:
        log: The log of the run.
        twin: The log of the same run without operators.
        site: Name of the site.

    Returns:
        The ticks present in both logs, shape (K,).
        Their times, shape (K,), in s.
        q of the log minus q of the twin, shape (K, n), in rad.
    """
    site_log = log[site]
    twin_part = twin[site]
    common_tick, rows, twin_rows = np.intersect1d(
        site_log.tick, twin_part.tick, assume_unique=True, return_indices=True
    )
    q = joint_angles(site_log)[rows]
    twin_q = joint_angles(twin_part)[twin_rows]
    return common_tick, site_log.t_s[rows], q - twin_q

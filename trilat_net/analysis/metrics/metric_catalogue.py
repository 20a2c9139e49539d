"""Catalogue of metrics (key, name, unit, reduction to the whole run), and the value of one.

Invariant: a value is a finite number, or None with a reason. Each entry has one definition, in
docs/metrics.md.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Metric(NamedTuple):
    """A number, or why there is none.

    Attributes:
        value: the number, finite; None where there is none.
        why: why there is none, in words; "" where there is one.
        applies: False where there could be none, in whatever log of this experiment: then nothing is unknown.
    """

    value: float | None
    why: str = ""
    applies: bool = True


MetricValues = dict[str, Metric]
"""What was found, by the key of its quantity."""


def metric(value: float | None, why: str = "it is no finite number") -> Metric:
    """Returns a number as it is said; with the reason where there is none."""
    if value is None or not math.isfinite(value):
        return Metric(None, why)
    return Metric(float(value))


def unavailable(keys: Iterable[str], why: str, *, applies: bool = True) -> MetricValues:
    """Returns that none of these is known, and why; or that there are none to know."""
    return {key: Metric(None, why, applies) for key in keys}


def rms(values: ArrayLike) -> float:
    """Returns the root mean square over rows of the column where it is largest; NaN of no rows.

    Args:
        values: shape (K, n).
    """
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return math.nan
    return float(np.sqrt(np.einsum("kj,kj->j", array, array) / len(array)).max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value; NaN of none."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.abs(array).max()) if array.size else math.nan


class Quantity(NamedTuple):
    """What is measured.

    Attributes:
        key: how programs call it; ends in its unit where it has one.
        of: of what there is one: "run", "site", "link" or "wall".
        group: under which heading it stands.
        name: how people call it.
        unit: its unit; "" for a number without.
        whole: how a run has one: "max" and "sum" over all places, "mean".
    """

    key: str
    of: str
    group: str
    name: str
    unit: str = ""
    whole: str = "max"


TRACKING, SPREAD, FOLLOWING = "tracking", "apart", "slave and master"
EFFORT, ENERGY, CONTACT, LEARNING = "effort", "energy", "walls", "learning"
SHARING, NETWORK, LOOP = "force sharing", "network", "loop"

QUANTITIES = (
    Quantity("settle_s", "site", TRACKING, "settled", "s"),
    Quantity("rms_error_rad", "site", TRACKING, "RMS e", "rad"),
    Quantity("max_error_rad", "site", TRACKING, "peak |e|", "rad"),
    Quantity("max_error_end_rad", "site", TRACKING, "peak |e|, last 1 s", "rad"),
    Quantity("spread_rms_rad", "run", SPREAD, "RMS spread, undelayed", "rad"),
    Quantity("spread_max_rad", "run", SPREAD, "largest spread", "rad"),
    Quantity("spread_end_rad", "run", SPREAD, "largest spread, last 1 s", "rad"),
    Quantity("following_rms_rad", "link", FOLLOWING, "RMS q_m(t-T) - q_s", "rad"),
    Quantity("following_max_rad", "link", FOLLOWING, "peak |q_m(t-T) - q_s|", "rad"),
    Quantity("following_end_rad", "link", FOLLOWING, "the same, last 1 s", "rad"),
    Quantity("effort_nm2_s", "site", EFFORT, "effort, int |tau|^2", "N²m²s", "sum"),
    Quantity("rms_tau_nm", "site", EFFORT, "RMS tau", "N m"),
    Quantity("peak_tau_nm", "site", EFFORT, "peak |tau|", "N m"),
    Quantity("saturated_share", "site", EFFORT, "ticks at the limit"),
    Quantity("controller_j", "site", ENERGY, "given by the controller", "J", "sum"),
    Quantity("hands_j", "site", ENERGY, "given by hands", "J", "sum"),
    Quantity("hands_most_j", "site", ENERGY, "given by hands at most", "J"),
    Quantity("walls_j", "site", ENERGY, "given by environment", "J", "sum"),
    Quantity("walls_most_j", "site", ENERGY, "given by environment at most", "J"),
    Quantity("mechanical_j", "site", ENERGY, "gained by the arm", "J", "sum"),
    Quantity("unaccounted_j", "site", ENERGY, "unaccounted for", "J"),
    Quantity("delay_j", "link", ENERGY, "given by the delay", "J", "sum"),
    Quantity("delay_most_j", "link", ENERGY, "given by the delay at most", "J"),
    Quantity("force_mean_n", "wall", CONTACT, "normal force, mean", "N"),
    Quantity("force_deviation_n", "wall", CONTACT, "its deviation", "N"),
    Quantity("force_peak_n", "wall", CONTACT, "its peak", "N"),
    Quantity("hits", "wall", CONTACT, "hits", "", "sum"),
    Quantity("contact_share", "wall", CONTACT, "ticks in contact"),
    Quantity("depth_max_m", "wall", CONTACT, "deepest", "m"),
    Quantity("end_force_mean_n", "wall", CONTACT, "normal force, mean, last 5 s", "N"),
    Quantity("end_force_deviation_n", "wall", CONTACT, "its deviation, last 5 s", "N"),
    Quantity("end_force_peak_n", "wall", CONTACT, "its peak, last 5 s", "N"),
    Quantity("end_hits", "wall", CONTACT, "hits, last 5 s", "", "sum"),
    Quantity("sharing_off", "run", SHARING, "furthest from tau_s beta_s / beta_i"),
    Quantity("theta_error_first", "site", LEARNING, "|theta_hat - theta| at first"),
    Quantity("theta_error_last", "site", LEARNING, "the same at last"),
    Quantity("theta_energy_first_j", "site", LEARNING, "theta~' Gamma^-1 theta~ / 2 at first", "J"),
    Quantity("theta_energy_last_j", "site", LEARNING, "the same at last", "J"),
    Quantity("theta_slope_per_s", "site", LEARNING, "|theta_hat'|, last 5 s", "1/s"),
    Quantity("age_mean_ms", "link", NETWORK, "effective delay, mean", "ms"),
    Quantity("age_p99_ms", "link", NETWORK, "effective delay, p99", "ms"),
    Quantity("age_max_ms", "link", NETWORK, "effective delay, largest", "ms"),
    Quantity("silence_ms", "link", NETWORK, "longest silence", "ms"),
    Quantity("loss", "link", NETWORK, "loss"),
    Quantity("burst", "link", NETWORK, "lost in a row, mean"),
    Quantity("late_samples", "link", NETWORK, "late samples", "", "sum"),
    Quantity("late_p99_us", "site", LOOP, "lateness, p99", "us"),
    Quantity("late_max_us", "site", LOOP, "lateness, largest", "us"),
    Quantity("busy_p99_us", "site", LOOP, "computing time, p99", "us"),
    Quantity("overruns", "site", LOOP, "overruns", "", "sum"),
    Quantity("missing", "site", LOOP, "missing records", "", "sum"),
)
"""In the order in which they are shown."""

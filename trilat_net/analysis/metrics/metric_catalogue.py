"""Catalogue of metrics (key, name, unit, reduction to the whole run), and the value of one.

Invariant: a value is a finite number, or None with a reason. Each entry has one definition, in
docs/metrics.md.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...core.task_space import PLACE
from ..aligned import AlignedRecords
from ..dominance_history import DominanceHistory
from ..torque_sources import TorqueSplit


class SiteRun(NamedTuple):
    """A site with records: these aligned, the torque ON its arm by source, and its dominance factors."""

    records: AlignedRecords
    torque: TorqueSplit
    dominance: DominanceHistory


class Metric(NamedTuple):
    """A number, or the reason why there is none.

    Attributes:
        value, why: the number, finite, or None; the reason, or "".
        applies: False if no log of this experiment could have one: then nothing is unknown.
    """

    value: float | None
    why: str = ""
    applies: bool = True


MetricValues = dict[str, Metric]
"""Metrics by the keys of their quantities."""


def metric(value: float | None, why: str = "it is no finite number") -> Metric:
    """Returns a metric of a number; with the reason if it is None or not finite."""
    return Metric(None, why) if value is None or not math.isfinite(value) else Metric(float(value))


def unavailable(group: str, why: str, *, of: str = "", applies: bool = True) -> MetricValues:
    """Returns the quantities of a group, or those of it that are `of` a kind of place, without a number."""
    return {q.key: Metric(None, why, applies) for q in QUANTITIES if q.group == group and of in ("", q.of)}


def measure_shared(group: str, space: str, measure: Callable[[slice], dict[str, Metric]]) -> MetricValues:
    """Returns the quantities of a group of what sites share: angles, rad, or places, m, or both of a pose.

    `measure` takes the columns of what is shared, and gives the quantities by their keys without the unit.
    """
    found = unavailable(group, "sites share angles, not places", applies=False)
    if space == "joints":
        parts = [("rad", slice(None))]
    else:
        found = unavailable(group, "sites share places, not angles", applies=False)
        parts = [("m", slice(0, PLACE)), ("rad", slice(PLACE, None))][: 1 + (space == "pose")]
    for unit, columns in parts:
        found |= {f"{key}_{unit}": one for key, one in measure(columns).items()}
    return found


def rms(values: ArrayLike) -> float:
    """Returns the root mean square over rows of the column with the largest; NaN of no rows, shape (K, n)."""
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return math.nan
    return float(np.sqrt(np.einsum("kj,kj->j", array, array) / len(array)).max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value; NaN of none."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.abs(array).max()) if array.size else math.nan


class Quantity(NamedTuple):
    """An entry of the catalogue.

    Attributes:
        key: its name in programs; ends in its unit, if any.
        of: the kind of place that has one: "run", "site", "link" or "wall".
        group: its heading.
        name: its name for people.
        unit: its unit; "" for a number without.
        whole: reduction to the run: "max" or "sum" over all places.
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
    Quantity("rms_error_m", "site", TRACKING, "RMS e", "m"),
    Quantity("max_error_m", "site", TRACKING, "peak |e|", "m"),
    Quantity("max_error_end_m", "site", TRACKING, "peak |e|, last 1 s", "m"),
    Quantity("spread_rms_rad", "run", SPREAD, "RMS spread, undelayed", "rad"),
    Quantity("spread_max_rad", "run", SPREAD, "largest spread", "rad"),
    Quantity("spread_end_rad", "run", SPREAD, "largest spread, last 1 s", "rad"),
    Quantity("spread_rms_m", "run", SPREAD, "RMS spread, undelayed", "m"),
    Quantity("spread_max_m", "run", SPREAD, "largest spread", "m"),
    Quantity("spread_end_m", "run", SPREAD, "largest spread, last 1 s", "m"),
    Quantity("following_rms_rad", "link", FOLLOWING, "RMS q_m(t-T) - q_s", "rad"),
    Quantity("following_max_rad", "link", FOLLOWING, "peak |q_m(t-T) - q_s|", "rad"),
    Quantity("following_end_rad", "link", FOLLOWING, "the same, last 1 s", "rad"),
    Quantity("following_rms_m", "link", FOLLOWING, "RMS x_m(t-T) - x_s", "m"),
    Quantity("following_max_m", "link", FOLLOWING, "peak |x_m(t-T) - x_s|", "m"),
    Quantity("following_end_m", "link", FOLLOWING, "the same, last 1 s", "m"),
    Quantity("effort_nm2_s", "site", EFFORT, "effort, int |tau|^2", "N²m²s", "sum"),
    Quantity("rms_tau_nm", "site", EFFORT, "RMS tau", "N m"),
    Quantity("peak_tau_nm", "site", EFFORT, "peak |tau|", "N m"),
    Quantity("saturated_share", "site", EFFORT, "ticks at the limit"),
    Quantity("chatter_nm", "site", EFFORT, "chatter, mean change of tau a tick", "N m"),
    Quantity("controller_j", "site", ENERGY, "given by the controller", "J", "sum"),
    Quantity("hands_j", "site", ENERGY, "given by hands", "J", "sum"),
    Quantity("hands_most_j", "site", ENERGY, "given by hands at most", "J"),
    Quantity("walls_j", "site", ENERGY, "given by environment", "J", "sum"),
    Quantity("walls_most_j", "site", ENERGY, "given by environment at most", "J"),
    Quantity("friction_j", "site", ENERGY, "taken by friction", "J", "sum"),
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
    Quantity("unphysical_links", "site", LEARNING, "unphysical links, at last", "", "sum"),
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

"""Parameter estimation error: distance of theta_hat from theta, and its rate of change at the end of the run.

Invariant: a parameter counts if the control law adapts it (Gamma > 0). If the true theta is unknown there
is no error, but the estimates are still reported.
"""

from typing import NamedTuple

import numpy as np

from ...core.site_setup import Law
from ...core.vectors import Array
from ...scenario import SiteSpec
from ..aligned import AlignedRecords
from .metric_catalogue import Metric, MetricValues, metric, unavailable

ESTIMATE_END_S = 5.0
"""Length of the end of a run over which slopes are fitted, s."""

PARAMETER_ERROR_KEYS = (
    "theta_error_first",
    "theta_error_last",
    "theta_energy_first_j",
    "theta_energy_last_j",
    "theta_slope_per_s",
)


class ParameterEstimates(NamedTuple):
    """The estimates of a site.

    Attributes:
        learnt: whether each is learnt.
        theta: the truth; None where it is not known.
        first: the estimates of the first record, shape (5,).
        last: of the last one, shape (5,).
        slope_per_s: of straight lines through the last 5 s, shape (5,), 1/s; None where there is no line.
    """

    learnt: list[bool]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    slope_per_s: list[float] | None


def read_parameter_estimates(spec: SiteSpec, track: AlignedRecords) -> ParameterEstimates:
    """Returns the estimates of a site, and how they move at the end."""
    gains = spec.control.gains(spec.arm.theta)
    moved = (track.theta_hat != track.theta_hat[0]).any(axis=0)
    learns = np.array(gains.Gamma) > 0.0 if gains.law is Law.ADAPTIVE else moved
    slope = _slope(track)
    return ParameterEstimates(
        learns.tolist(),
        spec.arm.theta.tolist() if has_known_theta(spec) else None,
        track.theta_hat[0].tolist(),
        track.theta_hat[-1].tolist(),
        None if slope is None else slope.tolist(),
    )


def _slope(track: AlignedRecords) -> Array | None:
    """Returns the slopes of least-squares lines through the recorded estimates of the last 5 s, 1/s."""
    t_s = track.t_s
    rows = track.known & (t_s > t_s[-1] - ESTIMATE_END_S)
    if np.count_nonzero(rows) < 2:
        return None
    x = t_s[rows] - t_s[rows].mean()
    slope: Array = x @ track.theta_hat[rows] / (x @ x)
    return slope


def measure_parameter_error(spec: SiteSpec, track: AlignedRecords | None) -> MetricValues:
    """Returns how far the estimates are from the truth, at both ends, and how fast they still move."""
    if track is None:
        return unavailable(PARAMETER_ERROR_KEYS, "no records of the site")
    found, gains = read_parameter_estimates(spec, track), spec.control.gains(spec.arm.theta)
    rows = np.array(found.learnt)
    if not rows.any():
        return unavailable(PARAMETER_ERROR_KEYS, "nothing is learnt", applies=False)
    slope = None if found.slope_per_s is None else float(np.linalg.norm(np.array(found.slope_per_s)[rows]))
    moves = {"theta_slope_per_s": metric(slope, "less than two records in the last 5 s")}
    if found.theta is None:
        return {**unavailable(PARAMETER_ERROR_KEYS[:4], "theta of the arm is not known"), **moves}
    off = np.array([found.first, found.last])[:, rows] - np.array(found.theta)[rows]
    distance = np.linalg.norm(off, axis=1)
    energy: list[Metric] = [Metric(None, "the gains of learning are not known")] * 2
    if gains.law is Law.ADAPTIVE:
        held = 0.5 * (off**2 / np.array(gains.Gamma)[rows]).sum(axis=1)
        energy = [metric(value) for value in held.tolist()]
    return {
        "theta_error_first": metric(distance[0]),
        "theta_error_last": metric(distance[1]),
        "theta_energy_first_j": energy[0],
        "theta_energy_last_j": energy[1],
        **moves,
    }


def has_known_theta(spec: SiteSpec) -> bool:
    """True where the scenario knows the arm's parameters."""
    return bool(getattr(spec.arm, "known", True))

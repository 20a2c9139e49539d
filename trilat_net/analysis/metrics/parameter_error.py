"""Parameter estimation error: distance of theta_hat from theta, and its rate of change at the end of the run.

Invariant: a parameter counts if the control law adapts it (Gamma > 0). If the true theta is unknown there
is no error, but the estimates are still reported.
"""

from typing import NamedTuple

import numpy as np

from ...core.site_setup import Law
from ...scenario import SiteSpec
from ..aligned import AlignedRecords
from .metric_catalogue import LEARNING, MetricValues, metric, unavailable

ESTIMATE_END_S = 5.0
"""Length of the end of a run over which slopes are fitted, s."""


class ParameterEstimates(NamedTuple):
    """Estimates of a site, shape (5,) each.

    Attributes:
        learnt: True for each that the law adapts.
        theta: the true parameters; None if unknown.
        first, last: the estimates of the first and the last record.
        slope_per_s: of straight lines through the last 5 s, 1/s; None with less than two records.
    """

    learnt: list[bool]
    theta: list[float] | None
    first: list[float]
    last: list[float]
    slope_per_s: list[float] | None


def read_parameter_estimates(spec: SiteSpec, records: AlignedRecords) -> ParameterEstimates:
    """Returns the estimates of a site, and their least-squares slopes at the end."""
    gains, theta_hat = spec.control.gains(spec.arm.theta), records.theta_hat
    moved = (theta_hat != theta_hat[0]).any(axis=0)
    adapted = np.array(gains.Gamma) > 0.0 if gains.law is Law.ADAPTIVE else moved
    rows, slope = records.known_at_end(ESTIMATE_END_S), None
    if np.count_nonzero(rows) >= 2:
        x = records.t_s[rows] - records.t_s[rows].mean()
        slope = (x @ theta_hat[rows] / (x @ x)).tolist()
    theta = spec.arm.theta.tolist() if has_known_theta(spec) else None
    return ParameterEstimates(adapted.tolist(), theta, theta_hat[0].tolist(), theta_hat[-1].tolist(), slope)


def measure_parameter_error(spec: SiteSpec, records: AlignedRecords | None) -> MetricValues:
    """Returns the distance of the estimates from theta at both ends, and their rate of change at the end."""
    if records is None:
        return unavailable(LEARNING, "no records of the site")
    estimates, gains = read_parameter_estimates(spec, records), spec.control.gains(spec.arm.theta)
    rows = np.array(estimates.learnt)
    if not rows.any():
        return unavailable(LEARNING, "nothing is learnt", applies=False)
    slopes = estimates.slope_per_s
    slope = None if slopes is None else float(np.linalg.norm(np.array(slopes)[rows]))
    metrics = unavailable(LEARNING, "theta of the arm is not known")
    metrics["theta_slope_per_s"] = metric(slope, "less than two records in the last 5 s")
    if estimates.theta is None:
        return metrics
    off = np.array([estimates.first, estimates.last])[:, rows] - np.array(estimates.theta)[rows]
    distance = np.linalg.norm(off, axis=1).tolist()
    energy: list[float | None] = [None, None]
    if gains.law is Law.ADAPTIVE:
        energy = (0.5 * (off**2 / np.array(gains.Gamma)[rows]).sum(axis=1)).tolist()
    why = "it is no finite number" if gains.law is Law.ADAPTIVE else "the gains of learning are not known"
    for n, end in enumerate(("first", "last")):
        metrics[f"theta_error_{end}"] = metric(distance[n])
        metrics[f"theta_energy_{end}_j"] = metric(energy[n], why)
    return metrics


def has_known_theta(spec: SiteSpec) -> bool:
    """True if the scenario knows the arm's parameters."""
    return bool(getattr(spec.arm, "known", True))

"""How near the estimates came to the truth.

Law: a parameter counts where the law learns it (Gamma > 0); where the truth is not known, nothing is compared
with it, and the estimates are given all the same.
"""

from typing import NamedTuple

import numpy as np

from ..certificate.track import Track
from ..core.arm import Array
from ..core.setup import Law
from ..scenario import SiteSpec
from .energy import theta_known
from .said import Facts, Said, said, unsaid

LAST_S = 5.0
"""Length of the end of a run over which slopes are fitted, s."""

SITE = (
    "theta_error_first",
    "theta_error_last",
    "theta_energy_first_j",
    "theta_energy_last_j",
    "theta_slope_per_s",
)


class Learnt(NamedTuple):
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


def learnt(spec: SiteSpec, track: Track) -> Learnt:
    """Returns the estimates of a site, and how they move at the end."""
    gains = spec.control.gains(spec.arm.theta)
    moved = (track.theta_hat != track.theta_hat[0]).any(axis=0)
    learns = np.array(gains.Gamma) > 0.0 if gains.law is Law.ADAPTIVE else moved
    slope = _slope(track)
    return Learnt(
        learns.tolist(),
        spec.arm.theta.tolist() if theta_known(spec) else None,
        track.theta_hat[0].tolist(),
        track.theta_hat[-1].tolist(),
        None if slope is None else slope.tolist(),
    )


def _slope(track: Track) -> Array | None:
    """Returns the slopes of least-squares lines through the recorded estimates of the last 5 s, 1/s."""
    t_s = track.t_s
    rows = track.known & (t_s > t_s[-1] - LAST_S)
    if np.count_nonzero(rows) < 2:
        return None
    x = t_s[rows] - t_s[rows].mean()
    slope: Array = x @ track.theta_hat[rows] / (x @ x)
    return slope


def of_site(spec: SiteSpec, track: Track | None) -> Facts:
    """Returns how far the estimates are from the truth, at both ends, and how fast they still move."""
    if track is None:
        return unsaid(SITE, "no records of the site")
    found, gains = learnt(spec, track), spec.control.gains(spec.arm.theta)
    rows = np.array(found.learnt)
    if not rows.any():
        return unsaid(SITE, "nothing is learnt", applies=False)
    slope = None if found.slope_per_s is None else float(np.linalg.norm(np.array(found.slope_per_s)[rows]))
    moves = {"theta_slope_per_s": said(slope, "less than two records in the last 5 s")}
    if found.theta is None:
        return {**unsaid(SITE[:4], "theta of the arm is not known"), **moves}
    off = np.array([found.first, found.last])[:, rows] - np.array(found.theta)[rows]
    distance = np.linalg.norm(off, axis=1)
    energy: list[Said] = [Said(None, "the gains of learning are not known")] * 2
    if gains.law is Law.ADAPTIVE:
        held = 0.5 * (off**2 / np.array(gains.Gamma)[rows]).sum(axis=1)
        energy = [said(value) for value in held.tolist()]
    return {
        "theta_error_first": said(distance[0]),
        "theta_error_last": said(distance[1]),
        "theta_energy_first_j": energy[0],
        "theta_energy_last_j": energy[1],
        **moves,
    }

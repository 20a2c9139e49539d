"""The equations of `resting` over the rows of a log, written once more."""

import numpy as np

from trilat_net.core.resting import REST_RATE_1_S
from trilat_net.core.site_setup import LEAST_STOP_S, RestGains
from trilat_net.core.vectors import Array
from trilat_net.log.site_log import SiteLog


def gravity_of(theta: Array, q: Array) -> Array:
    """G of the planar arm, rows of q, by the paper's Eq. (2)."""
    outer = theta[4] * np.cos(q[:, 0] + q[:, 1])
    return 9.81 * np.stack([theta[3] * np.cos(q[:, 0]) + outer, outer], axis=1)


def reference(gains: RestGains, part: SiteLog, first: int, rows: int) -> tuple[Array, Array]:
    """q_ref and qd_ref of an arm that comes to rest from its record `first` on."""
    q, v = part.q[first], part.qd[first]
    stop_s = max(LEAST_STOP_S, float((np.abs(v) / gains.deceleration).max()))
    t = np.minimum(np.arange(rows) / part.rate_hz, stop_s)[:, None]
    return q + v * (t - t**2 / (2.0 * stop_s)), v * (1.0 - t / stop_s)


def rest_torque(gains: RestGains, part: SiteLog, law: Array, first: int) -> tuple[Array, Array]:
    """Law + w - B s from a record on, and w, of a law that does not learn; rows of its law's torque."""
    rows = slice(first, first + len(law))
    q_ref, qd_ref = reference(gains, part, first, len(law))
    B, slip = np.array(gains.damping), part.qd[rows] - qd_ref + REST_RATE_1_S * (part.q[rows] - q_ref)
    taken = np.vstack([np.zeros(2), np.cumsum(slip, axis=0)[:-1]]) * B / (4.0 * gains.time_s) / part.rate_hz
    w = part.tau[first - 1] - law[0] - taken
    return law + w - B * slip, w


def integrals(part: SiteLog, rows: slice) -> Array:
    """w of the records after some: what their `mem` has of the torque at rest."""
    first = 2 * (part.layout.shared + 1) + len(part.peers)
    return np.array(
        [part.mem[row][first : first + part.layout.joints] for row in range(*rows.indices(len(part)))]
    )

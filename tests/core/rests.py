"""An independent version of the equations of `resting`, over the rows of a log."""

import numpy as np

from trilat_net.core.life.resting import REST_RATE_1_S
from trilat_net.core.step.site_setup import LEAST_STOP_S, RestGains
from trilat_net.core.step.vectors import Array
from trilat_net.log.site_log import SiteLog


def gravity_of(theta: Array, q: Array) -> Array:
    """Returns G of the planar arm, rows of q, by the paper's Eq. (2)."""
    outer = theta[4] * np.cos(q[:, 0] + q[:, 1])
    return 9.81 * np.stack([theta[3] * np.cos(q[:, 0]) + outer, outer], axis=1)


def compute_reference(
    gains: RestGains, part: SiteLog, first: int, rows: int
) -> tuple[Array, Array]:
    """Returns q_ref and qd_ref of an arm that comes to rest from record `first` on, with no
    torque at its limit.

    Eq. (1) of docs/theory/coming-to-rest.md, joint by joint; q_ref is the integral of qd_ref.
    """
    h_s = 1.0 / part.rate_hz
    q_ref = [part.q[first].copy()]
    qd_ref = [part.qd[first].copy()]
    for n in range(1, rows):
        left_s = max(
            LEAST_STOP_S - (n - 1) * h_s, float((np.abs(qd_ref[-1]) / gains.deceleration).max())
        )
        share = 1.0 - h_s / left_s if left_s > h_s + 1e-9 else 0.0
        speed = part.qd[first + n]
        slower = np.copysign(np.minimum(np.abs(share * qd_ref[-1]), np.abs(speed)), speed)
        rate = np.where(qd_ref[-1] * speed > 0.0, slower, 0.0) * (share > 0.0)
        q_ref.append(q_ref[-1] + 0.5 * h_s * (qd_ref[-1] + rate))
        qd_ref.append(rate)
    return np.array(q_ref), np.array(qd_ref)


def compute_rest_torque(
    gains: RestGains, part: SiteLog, law: Array, first: int, limit: Array
) -> tuple[Array, Array]:
    """Returns law + w - B s from a record on, and w, of a slow arm whose law does not learn.

    Eq. (2) to (4) of docs/theory/coming-to-rest.md, for rows of its law's torque; w is the
    value at the start of a tick.
    """
    rows = slice(first, first + len(law))
    q_ref, qd_ref = compute_reference(gains, part, first, len(law))
    B = np.array(gains.damping)
    qd = part.qd[rows]
    slip = qd - qd_ref + REST_RATE_1_S * (part.q[rows] - q_ref)
    haste = float((B * np.abs(qd[0]) / limit).max())
    w = (1.0 - haste) * (part.tau[first - 1] - law[0])
    begun = []
    taken = []
    for n in range(len(law)):
        begun.append(w)
        if n < LEAST_STOP_S * part.rate_hz or qd_ref[n].any():
            left = np.copysign(np.maximum(np.abs(w) - B * np.abs(qd[n]), 0.0), w)
            w = np.where(w * qd[n] > 0.0, left, w)
        taken.append(law[n] + w - B * slip[n])
        w = w - B / (4.0 * gains.time_s) * slip[n] / part.rate_hz
    return np.array(taken), np.array(begun)


def read_integrals(part: SiteLog, rows: slice) -> Array:
    """Returns w of the records after a given one, read from the torque at rest in `mem`."""
    first = 2 * (part.layout.shared + 1) + len(part.peers)
    return np.array(
        [
            part.mem[row][first : first + part.layout.joints]
            for row in range(*rows.indices(len(part)))
        ]
    )

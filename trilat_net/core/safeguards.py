"""How fast a reference may change, and a torque that goes back to that of the law.

Invariant: whatever a law asks for, the reference moves no faster than its limit. Without
limits, and in other modes, nothing changes.
"""

from math import inf, isfinite

from .chain import put_three, scale, three
from .jit import leaf
from .rotation import compose_rotations, relative_rotation, rotation_matrix
from .task_space import count_linear_coordinates, has_orientation
from .vectors import Row

BLEND_S = 0.1
"""Time in which a torque goes over from that of an arm at rest to that of the law."""


@leaf
def limit_reference(k: int, site: Row) -> None:
    """Holds the reference back to its limit of speed, from the own pose on; and makes up for it
    so.
    """
    if k == site.first:
        for i in range(site.shared):
            site.q_followed[i] = site.x[i] if site.task else site.q[i]
    if has_orientation(site) and site.qd_des_limit[3] < inf:
        _limit_turn(site)
    for i in range(min(site.shared, count_linear_coordinates(site))):
        limit = site.qd_des_limit[i]
        if limit == inf:
            continue
        step = site.q_des[i] - site.q_followed[i]
        most = limit / site.rate_hz
        if abs(step) > most:
            forward = step > 0.0
            site.q_des[i] = site.q_followed[i] + (most if forward else -most)
            site.qd_des[i] = limit if forward else -limit
        else:
            site.qd_des[i] = min(max(site.qd_des[i], -limit), limit)


@leaf
def _limit_turn(site: Row) -> None:
    """Holds the orientation of the reference back to the limit of its speed about each axis."""
    before = rotation_matrix(three(site.q_followed[3:]))
    turn = relative_rotation(rotation_matrix(three(site.q_des[3:])), before)
    share = 1.0
    for i in range(3):
        most = site.qd_des_limit[3 + i] / site.rate_hz
        if abs(turn[i]) * share > most:
            share = most / abs(turn[i])
    if share < 1.0:
        put_three(
            site.q_des[3:], compose_rotations(scale(share, turn), three(site.q_followed[3:]))
        )
        put_three(site.qd_des[3:], scale(share * site.rate_hz, turn))
    for i in range(3, 6):
        limit = site.qd_des_limit[i]
        site.qd_des[i] = min(max(site.qd_des[i], -limit), limit)


@leaf
def is_torque_finite(site: Row) -> bool:
    """True if the law gave a number for every joint."""
    finite = True
    for i in range(site.joints):
        finite = finite and isfinite(site.tau[i])
    return finite


@leaf
def return_to_law(t_ns: int, site: Row) -> None:
    """Writes the torque of a site that has its law again: from the last one to that of the law."""
    share = min((t_ns - site.return_from_ns) * 1e-9 / BLEND_S, 1.0)
    for i in range(site.joints):
        site.tau[i] = site.tau_held[i] + share * (site.tau[i] - site.tau_held[i])

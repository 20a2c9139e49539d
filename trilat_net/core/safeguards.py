"""Last of all: how fast a reference and a torque may change, and the torque of a site that is stopped.

Invariant: whatever a law asks for, the reference moves no faster than its limit, and the torque differs from
that of the tick before by no more than its rate allows. Without limits, and in other modes, nothing changes.
"""

from math import inf, isfinite

from .control import limit_torque
from .jit import leaf
from .vectors import Row

BLEND_S = 0.1
"""Time in which a torque goes over to damping and gravity, and back to that of the law."""


@leaf
def limit_reference(k: int, site: Row) -> None:
    """Holds the reference back to its limit of speed, from the own pose on; and makes up for it so."""
    for i in range(site.shared):
        if k == site.first:
            site.q_followed[i] = site.x[i] if site.task else site.q[i]
        limit = site.qd_des_limit[i]
        if limit == inf:
            continue
        step, most = site.q_des[i] - site.q_followed[i], limit / site.rate_hz
        if abs(step) > most:
            forward = step > 0.0
            site.q_des[i] = site.q_followed[i] + (most if forward else -most)
            site.qd_des[i] = limit if forward else -limit
        else:
            site.qd_des[i] = min(max(site.qd_des[i], -limit), limit)


@leaf
def is_torque_finite(site: Row) -> bool:
    """True if the law gave a number for every joint."""
    finite = True
    for i in range(site.joints):
        finite = finite and isfinite(site.tau[i])
    return finite


@leaf
def fall_back(t_ns: int, site: Row) -> None:
    """Writes the torque of a site without its law: from the last one to `u`, which is gravity, less B qd.

    A torque that is no number is none.
    """
    share = min((t_ns - site.return_from_ns) * 1e-9 / BLEND_S, 1.0)
    for i in range(site.joints):
        goal = limit_torque(site.u[i] - site.damping[i] * site.qd[i], site.tau_limit[i])
        if not isfinite(goal):
            goal = 0.0
        site.tau[i] = site.tau_held[i] + share * (goal - site.tau_held[i])


@leaf
def return_to_law(t_ns: int, site: Row) -> None:
    """Writes the torque of a site that has its law again: from the last one to that of the law."""
    share = min((t_ns - site.return_from_ns) * 1e-9 / BLEND_S, 1.0)
    for i in range(site.joints):
        site.tau[i] = site.tau_held[i] + share * (site.tau[i] - site.tau_held[i])


@leaf
def limit_torque_rate(site: Row) -> None:
    """Holds the torque within reach of that of the tick before; before the first tick there is none."""
    for i in range(site.joints):
        if site.tau_rate[i] < inf:
            most, before = site.tau_rate[i] / site.rate_hz, site.tau_before[i]
            site.tau[i] = min(max(site.tau[i], before - most), before + most)

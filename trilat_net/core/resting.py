"""How an arm comes to rest where it is, and stays there: while its site waits, holds, is stopped or in fault.

The reference leaves the peers. It begins at the own pose with the own velocity v, and is at rest after T:

    qd_ref = v (1 - t / T),    q_ref = q + v (t - t^2 / 2 T),    T = max(LEAST_STOP_S, max_i |v_i| / a_i)

with a_i the deceleration that half of the torque limit gives. The torque is that of the law on this
reference; of a law that failed, or that does not hold by its reference, it is gravity as far as it is known
or learnt; and in both cases

    + w - B s,    s = qd - qd_ref + Lambda (q - q_ref),    w' = -k B s

where w begins with what the torque of the tick before had besides, so that nothing steps, and takes on what
nobody knew of gravity. Lambda is that of the adaptive law in joint space, and else `REST_RATE_1_S`; in task
space the estimate stays as it is.

Invariant: once the reference rests, S + 1/2 w' (k B)^-1 w of the adaptive law in joint space never rises, S
being its storage: B adds to Kp, and w is one more estimate, of a constant torque whose true value is zero.

The limit of a torque's rate holds, but it never holds back what takes power from the arm: against its motion
the torque of a joint may change by B |qd| more in a tick. That is the step of a viscous brake of B which is
put on at that speed: it brings the joint to rest within `RestGains.time_s`, and it vanishes with the speed.
"""

from math import inf, isfinite

from .control import limit_torque
from .jit import leaf
from .site_setup import LEAST_STOP_S, Law, StaleAction
from .ticks import LifeReason, Mode
from .vectors import Array, Row, put

REST_RATE_1_S = 3.0
"""By how much of the way an arm goes back to its rest in a second, where its law has no Lambda of joints."""

_WAITING, _HOLD = int(Mode.WAITING), int(Mode.HOLD)
_FAULT, _STOPPED = int(Mode.FAULT), int(Mode.STOPPED)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_GLIDE = int(StaleAction.GLIDE)
_ADAPTIVE, _OWN, _KNOWN = int(Law.ADAPTIVE), int(Law.OWN), int(Law.KNOWN)


@leaf
def rests(site: Row) -> bool:
    """True if the arm comes to rest, or stays there."""
    still = site.mode in (_WAITING, _HOLD, _FAULT, _STOPPED)
    return bool(still and site.on_stale == _GLIDE)


@leaf
def rests_by_law(site: Row) -> bool:
    """True if the torque of a site that rests has that of its law in it, which then goes on learning."""
    holds = site.law != _OWN or site.holds != 0
    learns_in_task = site.task != 0 and site.law != _KNOWN
    return bool(holds and not learns_in_task and site.reason != _NOT_FINITE)


@leaf
def begin_rest(t_ns: int, mode: int, reason: int, site: Row) -> None:
    """Enters a mode in which the arm comes to rest; what rests already goes on, unless its law failed."""
    goes_on = rests(site) and reason != _NOT_FINITE and site.reason != _NOT_FINITE
    site.mode, site.reason = mode, reason
    if goes_on:
        return
    site.return_from_ns = t_ns
    if site.task:
        put(site.q_rest, site.q)
        put(site.qd_rest, site.qd)
    else:
        put(site.q_held, site.q)
        put(site.qd_held, site.qd)


@leaf
def _begun_at(site: Row, i: int) -> tuple[float, float]:
    """Returns the angle and the speed with which a joint began to come to rest."""
    if site.task:
        return site.q_rest[i], site.qd_rest[i]
    return site.q_held[i], site.qd_held[i]


@leaf
def _find_reference(t_ns: int, site: Row, i: int) -> tuple[float, float]:
    """Returns the reference of a joint that comes to rest, and its rate."""
    stop_s = LEAST_STOP_S
    for j in range(site.joints):
        stop_s = max(stop_s, abs(_begun_at(site, j)[1]) / site.deceleration[j])
    since_s = min((t_ns - site.return_from_ns) * 1e-9, stop_s)
    q, v = _begun_at(site, i)
    rate = v * (1.0 - since_s / stop_s)
    return q + 0.5 * (v + rate) * since_s, rate


@leaf
def put_rest_reference(t_ns: int, site: Row, q: Array, qd: Array) -> None:
    """Writes the reference of an arm that comes to rest; in task space where its end effector is."""
    for i in range(q.shape[0]):
        if site.task:
            q[i], qd[i] = site.x[i], site.xd[i]
        else:
            q[i], qd[i] = _find_reference(t_ns, site, i)
            site.felt[i] = 0.0


@leaf
def _find_slip(t_ns: int, site: Row, i: int) -> float:
    """Returns s of a joint, rad/s."""
    q, qd = _find_reference(t_ns, site, i)
    rate = site.Lambda[i] if site.law == _ADAPTIVE and not site.task else REST_RATE_1_S
    slip: float = site.qd[i] - qd + rate * (site.q[i] - q)
    return slip


@leaf
def add_rest_torque(k: int, t_ns: int, site: Row) -> None:
    """Adds w - B s to the torque in `tau`; `u` keeps what it would be without limits."""
    for i in range(site.joints):
        if t_ns == site.return_from_ns:
            site.tau_held[i] = site.tau_before[i] - site.tau[i] if k > site.first else 0.0
        goal = site.tau[i] + site.tau_held[i] - site.damping[i] * _find_slip(t_ns, site, i)
        if not isfinite(goal):
            goal = site.tau_held[i] = 0.0
        site.u[i] = goal
        site.tau[i] = limit_torque(goal, site.tau_limit[i])


@leaf
def advance_rest(t_ns: int, site: Row) -> None:
    """Advances w to the next tick, but no farther beyond a limit that already holds the torque back."""
    for i in range(site.joints):
        step = -site.integral[i] * _find_slip(t_ns, site, i) / site.rate_hz
        if isfinite(step) and (site.u[i] - site.tau[i]) * step <= 0.0:
            site.tau_held[i] += step


@leaf
def limit_torque_rate(site: Row) -> None:
    """Holds the torque within reach of that of the tick before; before the first tick there is none."""
    braking = rests(site)
    for i in range(site.joints):
        if site.tau_rate[i] < inf:
            most, before = site.tau_rate[i] / site.rate_hz, site.tau_before[i]
            brake = site.damping[i] * site.qd[i] if braking else 0.0
            low, high = before - most - max(brake, 0.0), before + most - min(brake, 0.0)
            site.tau[i] = min(max(site.tau[i], low), high)

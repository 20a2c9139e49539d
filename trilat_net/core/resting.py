"""How an arm comes to rest where it is, and stays there: while its site waits, holds, is
stopped or in fault.

The reference of a joint begins at the joint's own angle and speed v, and comes to rest within
T:

    |qd_ref| falls by (1 - h / T_left) per period h, T_left = max(LEAST_STOP_S - t, max_i
    |qd_ref_i| / a_i) qd_ref = 0 from the tick on in which the joint turns, and never more than
    the joint's own speed

where a_i is the deceleration that half of the torque limit gives. If nothing slows the joints
down sooner, this is qd_ref = v (1 - t / T) with T = max(LEAST_STOP_S, max_i |v_i| / a_i). q_ref
is the integral of qd_ref; while an arm is fast (see below) or a torque is at its limit, q_ref
moves along with a joint that would otherwise get farther away from it.

The torque is that of the law on this reference. It is gravity, as far as that is known or
learnt, for a law that failed, that does not hold by its reference, and for every law while the
arm is fast: while B |qd| of some joint exceeds the limit of its torque. In both cases

    + w - B s,    s = qd - qd_ref + Lambda (q - q_ref),    w' = -k B s

is added. w begins as the part of the last torque that the law does not account for, times 1 -
max B |qd| /
tau_limit: the torque of a slow arm holds what nobody knew of gravity or hands, that of a fast
arm follows from its motion. While the arm brakes, w loses B |qd| in every tick in which it
works with the motion of its joint. Lambda is that of the adaptive law in joint space, and else
`REST_RATE_1_S`; in task space the estimate stays as it is. docs/links.md derives how much
energy all this can add to an arm.

The limit of a torque's rate never holds back what takes power from the arm: against its motion
the torque of a joint may change by B |qd| more in a tick. That is the step of a viscous brake
of B which is put on at that
speed: it brings the joint to rest within `RestGains.time_s`, and it vanishes with the speed.

Invariant:

- The reference of a joint only slows down, keeps its direction, and is never faster than the
  joint.
- While an arm brakes, no term but w works with the motion of a joint, and w adds at most h w^2
  / 2 B.
- Once the reference rests and no torque is limited, S + 1/2 w' (k B)^-1 w of the adaptive law
  in joint space never rises, S being its storage: B adds to Kp, and w is one more estimate, of
  a constant torque whose true value is zero.
"""

from math import inf, isfinite

from .control import limit_torque
from .jit import leaf
from .site_setup import LEAST_STOP_S, Law, StaleAction
from .ticks import NS_PER_S, LifeReason, Mode
from .vectors import Array, Row

REST_RATE_1_S = 3.0
"""By how much of the way an arm goes back to its rest in a second, where its law has no Lambda
of joints.
"""

_ROUNDING_S = 1e-9
"""By less than this the last step of a reference misses the end of its time."""

_WAITING = int(Mode.WAITING)
_HOLD = int(Mode.HOLD)
_FAULT = int(Mode.FAULT)
_STOPPED = int(Mode.STOPPED)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_GLIDE = int(StaleAction.GLIDE)
_ADAPTIVE = int(Law.ADAPTIVE)
_OWN = int(Law.USER)
_KNOWN = int(Law.KNOWN)


@leaf
def rests(site: Row) -> bool:
    """True if the arm comes to rest, or stays there."""
    still = site.mode in (_WAITING, _HOLD, _FAULT, _STOPPED)
    return bool(still and site.on_stale == _GLIDE)


@leaf
def find_haste(site: Row) -> float:
    """Returns the largest share that B |qd| is of the limit of a joint's torque."""
    haste = 0.0
    for i in range(site.joints):
        haste = max(haste, site.damping[i] * abs(site.qd[i]) / site.tau_limit[i])
    return haste


@leaf
def is_fast(site: Row) -> bool:
    """True if a joint is so fast that B alone would ask for more than the limit of its torque."""
    fast: bool = find_haste(site) > 1.0
    return fast


@leaf
def rests_by_law(site: Row) -> bool:
    """True if the torque of a site that rests has that of its law in it, which then goes on
    learning.
    """
    holds = site.law != _OWN or site.holds != 0
    learns_in_task = site.task != 0 and site.law != _KNOWN
    usable = holds and not learns_in_task and site.reason != _NOT_FINITE
    return bool(usable and not is_fast(site))


@leaf
def enter_rest(t_ns: int, mode: int, reason: int, site: Row) -> None:
    """Enters a mode in which the arm comes to rest; what rests already goes on, unless its law
    failed.
    """
    goes_on = rests(site) and reason != _NOT_FINITE and site.reason != _NOT_FINITE
    site.mode = mode
    site.reason = reason
    if goes_on:
        return
    site.return_from_ns = t_ns
    for i in range(site.joints):
        _write_reference(site, i, site.q[i], site.qd[i])


@leaf
def _read_reference(site: Row, i: int) -> tuple[float, float]:
    """Returns the reference of a joint that comes to rest, rad, and its speed, rad/s."""
    if site.task:
        return site.q_rest[i], site.qd_rest[i]
    return site.q_held[i], site.qd_held[i]


@leaf
def _write_reference(site: Row, i: int, q: float, qd: float) -> None:
    """Writes the reference of a joint where the record's `mem` keeps it from tick to tick."""
    if site.task:
        site.q_rest[i] = q
        site.qd_rest[i] = qd
    else:
        site.q_held[i] = q
        site.qd_held[i] = qd


@leaf
def _find_remaining_s(elapsed_s: float, site: Row) -> float:
    """Returns the time in which the reference comes to rest, `elapsed_s` after its beginning."""
    remaining_s = LEAST_STOP_S - elapsed_s
    for i in range(site.joints):
        remaining_s = max(remaining_s, abs(_read_reference(site, i)[1]) / site.deceleration[i])
    return remaining_s


@leaf
def advance_rest_reference(t_ns: int, ticks: int, site: Row) -> None:
    """Advances the reference of an arm that comes to rest to time t, over a number of ticks."""
    if t_ns == site.return_from_ns:
        return
    step_s = ticks / site.rate_hz
    elapsed_s = (t_ns - site.return_from_ns) * 1e-9 - step_s
    remaining_s = _find_remaining_s(elapsed_s, site)
    share = 1.0 - step_s / remaining_s if remaining_s > step_s + _ROUNDING_S else 0.0
    fast = is_fast(site)
    for i in range(site.joints):
        q_ref, rate_before = _read_reference(site, i)
        rate = share * rate_before
        if rate * site.qd[i] <= 0.0:
            rate = 0.0
        elif abs(rate) > abs(site.qd[i]):
            rate = site.qd[i]
        step = 0.5 * step_s * (rate_before + rate)
        if fast or abs(site.tau[i]) >= site.tau_limit[i]:
            # Without its law, or at its limit, the torque does not pay for a growing distance from the
            # reference, which the spring would give back later as energy of its own.
            own_step = site.q[i] - site.q_before[i]
            if (own_step - step) * (site.q_before[i] - q_ref) >= 0.0:
                step = own_step
        _write_reference(site, i, q_ref + step, rate)


@leaf
def _brakes(t_ns: int, site: Row) -> bool:
    """True until the reference rests, for at least LEAST_STOP_S, and while a joint is fast."""
    brakes = t_ns - site.return_from_ns < LEAST_STOP_S * NS_PER_S or is_fast(site)
    for i in range(site.joints):
        brakes = brakes or _read_reference(site, i)[1] != 0.0
    return brakes


@leaf
def put_rest_reference(site: Row, q: Array, qd: Array) -> None:
    """Writes the reference of an arm that comes to rest; in task space where its end effector
    is.
    """
    for i in range(q.shape[0]):
        if site.task:
            q[i] = site.x[i]
            qd[i] = site.xd[i]
        else:
            q[i], qd[i] = _read_reference(site, i)
            site.felt[i] = 0.0


@leaf
def _find_slip(site: Row, i: int) -> float:
    """Returns s of a joint, rad/s."""
    q, qd = _read_reference(site, i)
    rate = site.Lambda[i] if site.law == _ADAPTIVE and not site.task else REST_RATE_1_S
    slip: float = site.qd[i] - qd + rate * (site.q[i] - q)
    return slip


@leaf
def _shrink(torque: float, change: float) -> float:
    """Returns a torque brought nearer to zero by a change of its own sign, but not beyond."""
    return torque - change if abs(torque) > abs(change) else 0.0


@leaf
def add_rest_torque(k: int, t_ns: int, site: Row) -> None:
    """Adds w - B s to the torque in `tau`; `u` keeps what it would be without limits."""
    brakes = _brakes(t_ns, site)
    share = max(0.0, 1.0 - find_haste(site)) if k > site.first else 0.0
    for i in range(site.joints):
        if t_ns == site.return_from_ns:
            site.tau_held[i] = share * (site.tau_before[i] - site.tau[i])
        if brakes and site.tau_held[i] * site.qd[i] > 0.0:
            site.tau_held[i] = _shrink(site.tau_held[i], site.damping[i] * site.qd[i])
        goal = site.tau[i] + site.tau_held[i] - site.damping[i] * _find_slip(site, i)
        if not isfinite(goal):
            goal = site.tau_held[i] = 0.0
        site.u[i] = goal
        site.tau[i] = limit_torque(goal, site.tau_limit[i])


@leaf
def advance_rest(site: Row) -> None:
    """Advances w to the next tick, but no farther beyond a limit that already holds the torque
    back.
    """
    for i in range(site.joints):
        step = -site.integral[i] * _find_slip(site, i) / site.rate_hz
        if isfinite(step) and (site.u[i] - site.tau[i]) * step <= 0.0:
            site.tau_held[i] += step


@leaf
def limit_torque_rate(site: Row) -> None:
    """Holds the torque within reach of that of the tick before; before the first tick there is
    none.
    """
    braking = rests(site)
    for i in range(site.joints):
        if site.tau_rate[i] < inf:
            most = site.tau_rate[i] / site.rate_hz
            before = site.tau_before[i]
            brake = site.damping[i] * site.qd[i] if braking else 0.0
            low = before - most - max(brake, 0.0)
            high = before + most - min(brake, 0.0)
            site.tau[i] = min(max(site.tau[i], low), high)

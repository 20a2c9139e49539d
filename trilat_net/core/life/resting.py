"""Brings an arm to rest at its current position and holds it there.

An arm rests while its site waits for other sites, is stopped, or has a fault. Each joint
follows a reference (position q_ref, velocity qd_ref) that slows down smoothly to zero.

Reference: The reference starts at the angle q and the velocity qd of the joint. In each control
period h, its speed is multiplied by

    1 - h / T_left,    T_left = max(LEAST_STOP_S - t, max_i |qd_ref_i| / a_i)

where t is the time since the start, in s, and a_i the deceleration of joint i at half of its
torque limit. The reference is never faster than the joint, and stops when the joint reverses.
While the arm is fast or a torque is at its limit, q_ref is carried along by a joint that moves
away from it.

Torque: The control law computes a torque for this reference. If the law cannot be used (see
`rests_by_law`), the known or estimated gravity torque takes its place. In both cases, two terms
are added:

    w - B s,    s = qd - qd_ref + Lambda (q - q_ref),    dw/dt = -k B s

- B is the damping in N m s/rad, and k = 1 / (4 `RestGains.time_s`). Lambda is the convergence
  rate, in 1/s: the rate of the adaptive law in joint space, otherwise `REST_RATE_1_S`.
- w is an integral term that supports a constant load, for example unknown gravity. Its initial
  value is the difference between the last torque and the law's torque for the rest reference,
  times 1 - max B |qd| / tau_limit. While the arm brakes, w is reduced by B |qd| in each period
  in which it acts in the direction of motion.

An arm is fast while B |qd| of any joint exceeds its torque limit `tau_limit`. The torque rate
limit does not delay braking: in the direction that opposes the motion, the torque may change by
an additional B |qd| per period.

Invariant:
    - The reference of a joint keeps its direction and never becomes faster.
    - While an arm brakes, only w can act in the direction of motion, and w adds at most the
      energy h w^2 / 2 B per period (derived in docs/theory/coming-to-rest.md).
    - Once the reference is at rest and no torque is limited, the sum of the adaptive law's
      energy function in joint space and 1/2 w' (k B)^-1 w never increases.
"""

from math import inf, isfinite

from ..step.control import limit_torque
from ..step.jit import leaf
from ..step.row_fields import SiteRow
from ..step.site_setup import LEAST_STOP_S, Law, StaleAction
from ..step.ticks import NS_PER_S, LifeReason, Mode
from ..step.vectors import Array

REST_RATE_1_S = 3.0
"""Lambda for a resting arm if its control law has no such rate for the joints, 1/s."""

_ROUNDING_S = 1e-9
"""Tolerance for rounding errors in the time at which a reference comes to rest, s."""

_WAITING = int(Mode.WAITING)
_HOLD = int(Mode.HOLD)
_FAULT = int(Mode.FAULT)
_STOPPED = int(Mode.STOPPED)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_GLIDE = int(StaleAction.GLIDE)
_ADAPTIVE = int(Law.ADAPTIVE)
_USER = int(Law.USER)
_KNOWN = int(Law.KNOWN)


@leaf
def rests(site: SiteRow) -> bool:
    """Returns True if the arm is at rest or being brought to rest.

    This is the case in the modes WAITING, HOLD, FAULT and STOPPED, provided that the scenario
    uses `StaleAction.GLIDE` for arms that fall silent. With other settings, these modes do not
    bring the arm to rest smoothly.
    """
    still = site.mode in (_WAITING, _HOLD, _FAULT, _STOPPED)
    return bool(still and site.on_stale == _GLIDE)


@leaf
def _find_brake_ratio(site: SiteRow) -> float:
    """Returns the fraction of the torque limit required for braking with damping alone.

    This is the maximum of B |qd| / torque limit over all joints, where B is the damping with
    which the arm comes to rest, and qd the joint velocity. If the ratio exceeds 1, damping
    alone would require more torque than a joint can produce.
    """
    ratio = 0.0
    for i in range(site.joints):
        brake = site.damping[i] * abs(site.qd[i])
        ratio = max(ratio, brake / site.tau_limit[i])
    return ratio


@leaf
def _is_fast(site: SiteRow) -> bool:
    """Returns True if an arm moves so fast that damping would exceed a torque limit.

    Damping requires the torque B |qd|, where B is the damping gain in N m s/rad and qd the
    joint velocity. A single joint that exceeds its limit is sufficient.
    """
    fast: bool = _find_brake_ratio(site) > 1.0
    return fast


@leaf
def rests_by_law(site: SiteRow) -> bool:
    """Returns True if the control law can hold the arm at rest.

    In the following cases, the known or estimated gravity torque holds the arm instead, and the
    estimate of the dynamic parameters is not updated:

    - The law was written by a user and does not declare, with `holds = True`, that it works
      without the motion of other arms.
    - The law works in task space and is not the built-in law with a known gravity torque.
    - The law returned a value that is not finite.
    - The arm is too fast (see `_is_fast`).
    """
    is_declared = site.law != _USER or site.holds != 0
    is_unsuitable_in_task = site.task != 0 and site.law != _KNOWN
    has_failed = site.reason == _NOT_FINITE
    is_usable = is_declared and not is_unsuitable_in_task and not has_failed
    # The costly condition comes last.
    return bool(is_usable and not _is_fast(site))


@leaf
def enter_rest(t_ns: int, mode: int, reason: int, site: SiteRow) -> None:
    """Starts bringing an arm to rest, for example because another arm has fallen silent.

    The joints then follow the rest reference, which slows down until they stand still. An arm
    that is already resting keeps its reference, unless its control law has failed, now or
    earlier.

    Args:
        t_ns: Time, ns since the start of the session.
        mode: The mode to enter.
        reason: Reason for the change of mode, a `LifeReason`.
        site: State of the site; modified.
    """
    failed = reason == _NOT_FINITE or site.reason == _NOT_FINITE
    keeps_reference = rests(site) and not failed
    site.mode = mode
    site.reason = reason
    if keeps_reference:
        return
    site.return_from_ns = t_ns
    for i in range(site.joints):
        _write_rest_reference(site, i, site.q[i], site.qd[i])


@leaf
def _read_rest_reference(site: SiteRow, i: int) -> tuple[float, float]:
    """Returns the reference position and velocity of joint i while the arm comes to rest.

    `_write_rest_reference` explains why joint space and task space use different fields.

    Returns:
        The position, rad or m, and the velocity, rad/s or m/s.
    """
    if site.task:
        return site.q_rest[i], site.qd_rest[i]
    return site.q_held[i], site.qd_held[i]


@leaf
def _write_rest_reference(site: SiteRow, i: int, q: float, qd: float) -> None:
    """Stores the rest reference of a joint, which brings the joint to rest.

    In joint space, the fields `q_held` and `qd_held` have one entry per joint, and are
    otherwise unused while the arm rests. In task space, they have one entry per coordinate of
    the end effector pose, so the joints use `q_rest` and `qd_rest` instead.
    `_read_rest_reference` reads the same fields.

    Args:
        site: State of the site; modified.
        i: Index of the joint.
        q: Position of the reference, rad.
        qd: Velocity of the reference, rad/s.
    """
    if site.task:
        site.q_rest[i] = q
        site.qd_rest[i] = qd
    else:
        site.q_held[i] = q
        site.qd_held[i] = qd


@leaf
def _find_remaining_s(elapsed_s: float, site: SiteRow) -> float:
    """Returns the remaining time T_left until the arm comes to rest, s.

    T_left is at least the remainder of LEAST_STOP_S, and long enough for each joint to stop
    with half of its torque limit.

    Args:
        elapsed_s: Time since the start of the rest, s.
        site: State of the site, with the velocity of the reference.
    """
    remaining_s = LEAST_STOP_S - elapsed_s
    for i in range(site.joints):
        _, rate = _read_rest_reference(site, i)
        remaining_s = max(remaining_s, abs(rate) / site.deceleration[i])
    return remaining_s


@leaf
def advance_rest_reference(t_ns: int, ticks: int, site: SiteRow) -> None:
    """Advances the rest reference, which brings the joints of an arm to rest.

    The rules of the reference are given in the module docstring.

    Args:
        t_ns: Time of the current tick, ns since the start of the session.
        ticks: Number of ticks since the last call, more than 1 if the site was too slow and
            missed ticks.
        site: State of the site; the reference is modified.
    """
    if t_ns == site.return_from_ns:
        return  # the reference starts in this tick

    step_s = ticks / site.rate_hz
    # The time from the start of the rest to the previous tick.
    elapsed_s = (t_ns - site.return_from_ns) * 1e-9 - step_s
    remaining_s = _find_remaining_s(elapsed_s, site)
    factor = 0.0
    if remaining_s > step_s + _ROUNDING_S:
        factor = 1.0 - step_s / remaining_s
    is_fast = _is_fast(site)
    for i in range(site.joints):
        qd = site.qd[i]
        q_ref, rate_before = _read_rest_reference(site, i)
        # The reference stops when the joint reverses, and is never faster than the joint.
        rate = factor * rate_before
        has_joint_reversed = rate * qd <= 0.0
        if has_joint_reversed:
            rate = 0.0
        elif abs(rate) > abs(qd):
            rate = qd
        step = 0.5 * step_s * (rate_before + rate)
        is_limited = abs(site.tau[i]) >= site.tau_limit[i]
        if is_fast or is_limited:
            # Without the law, or at the torque limit, no work is done against the spring while
            # the distance from the reference grows. The spring would later turn this distance
            # into additional energy, so the reference moves along with the joint.
            q_before = site.q_before[i]
            joint_step = site.q[i] - q_before
            distance = q_before - q_ref
            moves_away = (joint_step - step) * distance >= 0.0
            if moves_away:
                step = joint_step
        _write_rest_reference(site, i, q_ref + step, rate)


@leaf
def _brakes(t_ns: int, site: SiteRow) -> bool:
    """Returns True while the arm brakes, which is the first phase of coming to rest.

    The arm brakes for at least LEAST_STOP_S, and for as long as the rest reference of a joint
    moves or the arm is fast (see `_is_fast`).

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site. While the arm is at rest, `return_from_ns` is the start of the
            rest.
    """
    elapsed_ns = t_ns - site.return_from_ns
    brakes = elapsed_ns < LEAST_STOP_S * NS_PER_S or _is_fast(site)
    for i in range(site.joints):
        _, reference_velocity = _read_rest_reference(site, i)
        brakes = brakes or reference_velocity != 0.0
    return brakes


@leaf
def put_rest_reference(site: SiteRow, q: Array, qd: Array) -> None:
    """Computes the reference of a resting arm, in the coordinates of its control law.

    In joint space, this is the rest reference, which brings the joints to rest.

    In task space, the reference is the current pose of the end effector and its velocity, so
    that the law sees no error. The joints are then brought to rest by `add_rest_torque`, with a
    reference in joint coordinates.

    The forces of other arms, which some laws reflect, are reset to zero because they must not
    move a resting arm.

    Args:
        site: State of the site. `task` is 1 in task space, and 0 in joint space. `felt`, the
            weighted sum of the forces on the other arms, is reset.
        q: Receives the reference, one entry per coordinate, rad or m.
        qd: Receives the velocity of the reference, rad/s or m/s.
    """
    for i in range(q.shape[0]):
        if site.task:
            q[i] = site.x[i]
            qd[i] = site.xd[i]
        else:
            q[i], qd[i] = _read_rest_reference(site, i)
        site.felt[i] = 0.0


@leaf
def _find_slip(site: SiteRow, i: int) -> float:
    """Returns the filtered deviation s of joint i from its rest reference, rad/s.

        s = qd - qd_ref + Lambda (q - q_ref)

    The damping and the integral term of a resting arm act on s. Lambda is the rate of the
    adaptive law in joint space, or `REST_RATE_1_S` for other laws, which have no such rate.

    Returns:
        The deviation s, rad/s or m/s.
    """
    q_ref, qd_ref = _read_rest_reference(site, i)
    Lambda = REST_RATE_1_S
    if site.law == _ADAPTIVE and not site.task:
        Lambda = site.Lambda[i]
    error = site.q[i] - q_ref
    slip: float = site.qd[i] - qd_ref + Lambda * error
    return slip


@leaf
def _shrink(torque: float, change: float) -> float:
    """Returns a torque with its magnitude reduced by `change`, but not below zero.

    For example, 3 N m reduced by 2 gives 1 N m, and -1 N m reduced by 2 gives 0.

    Args:
        torque: The torque, N m.
        change: Amount of the reduction, N m, with the sign of the torque.
    """
    return torque - change if abs(torque) > abs(change) else 0.0


@leaf
def add_rest_torque(k: int, t_ns: int, site: SiteRow) -> None:
    """Adds damping and an integral term to the torque of a resting arm, and limits the sum.

    w - B s is added to the torque `tau`, where B is the damping in N m s/rad, and s the
    filtered deviation of a joint from its reference in rad/s. The torque before limiting is
    stored in `u`.

    The integral term w, in N m, supports a constant load, for example unknown gravity:

    - The initial value is the difference between the previous torque and the law's torque for
      the rest reference, scaled down the faster the arm moves. It is zero in the first tick of
      a run, where there is no previous torque.
    - While the arm brakes, w may act in the direction of motion and delay the stop. In that
      case its magnitude is reduced by B |qd| per tick, but not below zero. qd is the joint
      velocity.
    - `advance_rest` integrates w after this tick.

    Args:
        k: Number of the tick.
        t_ns: Time of the tick, ns since the start of the session.
        site: State of the site; modified. `tau_held` is w, and `return_from_ns` the start of
            the rest.
    """
    starts_to_rest = t_ns == site.return_from_ns
    brakes = _brakes(t_ns, site)
    # Factor for the difference between the previous torque and that of the law: smaller for a
    # faster arm.
    unexplained_factor = 0.0
    if k > site.first:
        unexplained_factor = max(0.0, 1.0 - _find_brake_ratio(site))
    for i in range(site.joints):
        qd = site.qd[i]
        damping = site.damping[i]
        w = site.tau_held[i]
        if starts_to_rest:
            unexplained = site.tau_before[i] - site.tau[i]
            w = unexplained_factor * unexplained
        acts_along_motion = w * qd > 0.0
        if brakes and acts_along_motion:
            w = _shrink(w, damping * qd)
        torque = site.tau[i] + w - damping * _find_slip(site, i)
        if not isfinite(torque):
            torque = 0.0
            w = 0.0
        site.tau_held[i] = w
        site.u[i] = torque
        site.tau[i] = limit_torque(torque, site.tau_limit[i])


@leaf
def advance_rest(site: SiteRow) -> None:
    """Updates the integral term w of the torque that holds an arm at rest.

    The term supports a constant load, such as unknown gravity. In each control period h, it
    changes by

        -h k B s,    s = qd - qd_ref + Lambda (q - q_ref)

    where q and qd are the position and velocity of a joint, q_ref and qd_ref those of the rest
    reference, Lambda a rate in 1/s, and k B the integral gain.

    If a torque limit is active, w does not change further in the direction of the limit,
    because it would grow without effect (windup).

    Args:
        site: State of the site. For each joint, `tau_held` is w in N m (modified) and
            `integral` is k B in N m/rad. `u` is the torque before limiting and `tau` the torque
            after it, N m.
    """
    for i in range(site.joints):
        slip = _find_slip(site, i)
        step = -site.integral[i] * slip / site.rate_hz
        cut_off = site.u[i] - site.tau[i]
        # If the motion is not finite, neither is the step, which must then not be added to w.
        if isfinite(step) and cut_off * step <= 0.0:
            site.tau_held[i] += step


@leaf
def limit_torque_rate(site: SiteRow) -> None:
    """Limits the change of the torque between the previous and the current control period.

    The torque before the first period is taken as zero. While an arm comes to rest, a torque
    that opposes the motion of a joint may change by an additional B |qd| per period. B is the
    rest damping in N m s/rad, and qd the joint velocity in rad/s.

    Args:
        site: State of the site, whose torque `tau` is limited.
    """
    braking = rests(site)
    for i in range(site.joints):
        rate_limit = site.tau_rate[i]
        if rate_limit < inf:
            largest_change = rate_limit / site.rate_hz
            before = site.tau_before[i]
            # An arm that brakes may change its torque against the motion by more.
            brake = site.damping[i] * site.qd[i] if braking else 0.0
            low = before - largest_change - max(brake, 0.0)
            high = before + largest_change - min(brake, 0.0)
            tau = site.tau[i]
            site.tau[i] = min(max(tau, low), high)

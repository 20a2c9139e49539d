"""Decides when an arm waits, follows other arms, comes to rest, or stops after a fault.

A peer is heard while its samples arrive, and silent otherwise. The rules of this module, called
`glide`, make an arm start and stop smoothly when its peers appear or fall silent. A site is
always in one of these modes:

- WAITING: The arm rests until all peers that it follows are heard. Then the mode becomes
  RETURN.
- RETURN: The arm aligns smoothly with the peers. Then the mode becomes RUN.
- RUN: The arm follows the peers. If a peer that it follows falls silent, the mode becomes HOLD.
- HOLD: The arm comes to rest. If all peers are heard again, the mode becomes RETURN.
- FAULT: A limit was exceeded, a value was not finite, or the connection to the arm was lost.
  The arm comes to rest. Only the RESET command leads back to WAITING.
- STOPPED: The arm was stopped by a command, or its dead-man switch was released. The arm comes
  to rest. The ENABLE command leads back to WAITING, and so does holding the switch again if its
  release was the only cause.

The reference of a site is the position that its arm follows. In RUN, the reference is the
weighted mean of the peers' positions. In RETURN, an offset is added that decays from its
initial value D to zero within the time T:

    offset(x) = D (1 - 3 x^2 + 2 x^3) + T D' x (1 - x)^2,    x = t / T from 0 to 1
    T = max(MIN_ALIGN_NS, 1.5 |D| / align_speed)

Here t is the time since the start of RETURN, and D' the initial rate of the offset. The factor
1.5 is the maximum slope of the polynomial, so the offset changes no faster than `align_speed`,
apart from the effect of D'. For an orientation, the offset is a rotation vector.

Invariant:
    - In WAITING, HOLD, STOPPED and FAULT, the arm comes to rest in the same way (see
      `resting`).
    - In RETURN and RUN, neither the reference nor its velocity jumps, and the velocity is
      always the derivative of the reference.
    - A resting peer is followed like any other peer.
    - Messages from peers neither cause nor end FAULT and STOPPED.
"""

from math import isfinite

from ..arms.chain import add_vectors, put_three, read_three, scale_vector, subtract_vectors
from ..arms.rotation import (
    angular_velocity,
    compose_rotations,
    length,
    relative_rotation,
    rotate_by_vector,
    rotation_matrix,
    rotation_vector_rate,
)
from ..arms.task_space import count_linear_coordinates, has_orientation
from ..step.jit import leaf
from ..step.row_fields import LinkRow, SiteRow
from ..step.ticks import LifeOrder, LifeReason, Mode, tick_ns
from ..step.vectors import Array, RowArray, put
from .resting import advance_rest_reference, enter_rest, put_rest_reference, rests

MIN_ALIGN_NS = 250_000_000
"""Shortest duration of an alignment, ns."""
RETURN_NS = 100_000_000
"""Duration of the blend from the rest torque to the torque of the law, ns."""
HELD_OVERRUN_TICKS = 20
"""Largest number of missed ticks for which a site with an external arm does not enter HOLD."""
FAULT_OVERRUN_TICKS = 200
"""Largest number of missed ticks for which a site does not enter FAULT."""

_RUN = int(Mode.RUN)
_DIVERGED = int(Mode.DIVERGED)
_HOLD = int(Mode.HOLD)
_ALIGN = int(Mode.RETURN)
_WAITING = int(Mode.WAITING)
_FAULT = int(Mode.FAULT)
_STOPPED = int(Mode.STOPPED)
_START = int(LifeReason.START)
_DROPPED = int(LifeReason.DROPPED)
_RESTORED = int(LifeReason.RESTORED)
_PEERS_HERE = int(LifeReason.PEERS_HERE)
_ALIGNED = int(LifeReason.ALIGNED)
_PEER_SILENT = int(LifeReason.PEER_SILENT)
_PEERS_BACK = int(LifeReason.PEERS_BACK)
_ALIGN_LIMIT = int(LifeReason.ALIGN_LIMIT)
_OVERRUN = int(LifeReason.OVERRUN)
_LIMIT_Q = int(LifeReason.LIMIT_Q)
_LIMIT_QD = int(LifeReason.LIMIT_QD)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_STOP = int(LifeReason.STOP)
_ENABLE = int(LifeReason.ENABLE)
_RESET = int(LifeReason.RESET)
_ARM_SILENT = int(LifeReason.ARM_SILENT)
_ARM_BACK = int(LifeReason.ARM_BACK)
_RELEASED = int(LifeReason.RELEASED)
_STOP_RELEASED = int(LifeReason.STOP_RELEASED)
_HELD = int(LifeReason.HELD)
_ORDER_STOP = int(LifeOrder.STOP)
_ORDER_ENABLE = int(LifeOrder.ENABLE)
_ORDER_RESET = int(LifeOrder.RESET)
_ORDER_ARM_SILENT = int(LifeOrder.ARM_SILENT)
_ORDER_ARM_LOST = int(LifeOrder.ARM_LOST)
_ORDER_ARM_BACK = int(LifeOrder.ARM_BACK)
_ORDER_RELEASED = int(LifeOrder.RELEASED)
_ORDER_HELD = int(LifeOrder.HELD)


@leaf
def _all_heard(t_ns: int, silence_ns: int, links: RowArray) -> bool:
    """Returns True if no peer that this arm follows is silent.

    A peer is silent if none of its samples came into use within the last `silence_ns`. Peers
    with a dominance factor of zero are not followed, and may be silent.

    Args:
        t_ns: Time, ns since the start of the session.
        silence_ns: Longest time without a sample, ns.
        links: State of each link from another site, one row per link.
    """
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        is_silent = link.used < 0 or t_ns - link.used_ns > silence_ns
        if link.alpha > 0.0 and is_silent:
            return False
    return True


@leaf
def _alignment_s(site: SiteRow) -> float:
    """Returns the duration T of an alignment, s.

    An alignment is the smooth return of an arm to its peers in the mode RETURN. An offset is
    added to the reference and decays from its initial value to zero within the time T. The
    maximum slope of its polynomial is 1.5 times its mean slope, so with

        T = 1.5 distance / align_speed

    the offset changes no faster than the limit `align_speed`. T is at least MIN_ALIGN_NS.

    Args:
        site: State of the site. `q_held` is the initial value of the offset, rad or m. For a
            pose, its last three coordinates are a rotation vector, rad. `align_speed` applies
            to each linear coordinate, rad/s or m/s, and to the angle of the rotation, rad/s.
    """
    longest_distance = 0.0
    for i in range(count_linear_coordinates(site)):
        longest_distance = max(longest_distance, abs(site.q_held[i]))
    if has_orientation(site):
        angle = length(read_three(site.q_held[3:]))
        longest_distance = max(longest_distance, angle)
    needed_s = 1.5 * longest_distance / site.align_speed
    duration_s: float = max(MIN_ALIGN_NS * 1e-9, needed_s)
    return duration_s


@leaf
def _start_alignment(t_ns: int, site: SiteRow, reason: int, q: Array, qd: Array) -> None:
    """Starts an alignment, in which the reference of an arm returns smoothly to its peers.

    During the alignment, in the mode RETURN, the reference is that of the peers plus an offset.
    The initial offset is the difference between a given reference and that of the peers, so the
    reference does not jump. The offset decays to zero (see `_find_offset`).

    If a coordinate of the offset, or its angle, exceeds the limit, the mode does not change,
    and only the reason `ALIGN_LIMIT` is stored.

    An orientation is a rotation vector in the coordinates 3 to 5. If R_q and R_p are the
    rotation matrices of the given reference and of the peers' reference, the offset is the
    rotation R_q R_p' from the latter to the former. Its angular velocity is the given angular
    velocity minus that of the peers, rotated by the offset.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site; modified. `q_des` and `qd_des` are the reference of the peers
            and its velocity. If the alignment starts, `q_held` receives the offset, `qd_held`
            its rate, `return_from_ns` its start, and `tau_held` the last torque, from which the
            torque blends to that of the law (`return_to_law`).
        reason: Reason for the change of mode, a `LifeReason`.
        q: Reference from which the alignment starts, rad or m.
        qd: Velocity of this reference, rad/s or m/s.
    """
    turn = (0.0, 0.0, 0.0)
    turn_rate = (0.0, 0.0, 0.0)
    if has_orientation(site):
        site_rotation = rotation_matrix(read_three(q[3:]))
        peers_rotation = rotation_matrix(read_three(site.q_des[3:]))
        turn = relative_rotation(site_rotation, peers_rotation)
        peers_velocity = rotate_by_vector(turn, read_three(site.qd_des[3:]))
        turn_velocity = subtract_vectors(read_three(qd[3:]), peers_velocity)
        turn_rate = rotation_vector_rate(turn, turn_velocity)

    is_near = length(turn) <= site.align_limit
    for i in range(count_linear_coordinates(site)):
        distance = abs(q[i] - site.q_des[i])
        is_near = is_near and distance <= site.align_limit
    if not is_near:
        site.reason = _ALIGN_LIMIT
        return

    for i in range(count_linear_coordinates(site)):
        site.q_held[i] = q[i] - site.q_des[i]
        site.qd_held[i] = qd[i] - site.qd_des[i]
    if has_orientation(site):
        put_three(site.q_held[3:], turn)
        put_three(site.qd_held[3:], turn_rate)
    put(site.tau_held, site.tau_before)
    site.mode = _ALIGN
    site.reason = reason
    site.return_from_ns = t_ns


@leaf
def _leave_rest(t_ns: int, site: SiteRow, reason: int) -> None:
    """Starts the smooth return of a resting arm to its peers (an alignment).

    The alignment starts from the rest reference, which is first written into `q_followed` and
    `qd_followed`.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site; modified.
        reason: Reason for the change of mode, a `LifeReason`.
    """
    put_rest_reference(site, site.q_followed, site.qd_followed)
    _start_alignment(
        t_ns=t_ns, site=site, reason=reason, q=site.q_followed, qd=site.qd_followed
    )


@leaf
def _extrapolate_reference(site: SiteRow) -> None:
    """Extrapolates the previous reference of a moving arm to the current tick.

    The reference computed from the peers jumps if a lost peer is dropped, or restored when it
    comes back. An alignment then leads smoothly to the new reference. It starts from the
    reference of the previous tick, advanced by one control period at its velocity. A resting
    arm needs no extrapolation, because it has a reference of its own.

    An orientation (a rotation vector in the coordinates 3 to 5) is advanced at its angular
    velocity.

    Args:
        site: State of the site. `q_followed` and `qd_followed` are the reference of the
            previous tick and its velocity; `q_followed` is advanced.
    """
    period_s = 1.0 / site.rate_hz
    for i in range(count_linear_coordinates(site)):
        site.q_followed[i] += period_s * site.qd_followed[i]
    if has_orientation(site):
        turn = scale_vector(period_s, read_three(site.qd_followed[3:]))
        orientation = compose_rotations(turn, read_three(site.q_followed[3:]))
        put_three(site.q_followed[3:], orientation)


@leaf
def is_law_returning(t_ns: int, site: SiteRow) -> bool:
    """Returns True while the torque changes gradually from the rest torque to the law's torque.

    This change starts when a resting arm begins to move towards the other arms, and takes
    `RETURN_NS`. It does not take place if an arm realigns with the others because one of them
    was lost or came back, since the arm was not at rest.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site.
    """
    # A site that drops or restores a peer aligns without a rest before.
    rested = site.reason != _DROPPED and site.reason != _RESTORED
    elapsed_ns = t_ns - site.return_from_ns
    returning: bool = site.mode == _ALIGN and rested and elapsed_ns < RETURN_NS
    return returning


@leaf
def latch_mode(t_ns: int, site: SiteRow, mode: int, reason: int) -> None:
    """Enters the mode FAULT or STOPPED, which only an order can end, see `LifeOrder`.

    The arm comes to rest and is then held against gravity. Parameter estimates that are not
    finite are reset to zero, because the gravity torque is computed from them and must be
    finite.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site; modified.
        mode: The mode to enter.
        reason: Reason for the change of mode, a `LifeReason`.
    """
    for p in range(site.theta_hat.shape[0]):
        if not isfinite(site.theta_hat[p]):
            site.theta_hat[p] = 0.0
    enter_rest(t_ns, mode, reason, site)


@leaf
def _find_fault(site: SiteRow) -> int:
    """Returns the `LifeReason` of a fault in the motion of the arm, or -1 if there is none.

    A fault is a value that is not finite, an angle beyond its limits, or a speed above its
    limit.
    """
    for i in range(site.joints):
        q = site.q[i]
        qd = site.qd[i]
        if not (isfinite(q) and isfinite(qd)):
            return _NOT_FINITE
        if not site.q_min[i] <= q <= site.q_max[i]:
            return _LIMIT_Q
        if not abs(qd) <= site.qd_limit[i]:
            return _LIMIT_QD
    return -1


@leaf
def _apply_order(t_ns: int, site: SiteRow) -> None:
    """Changes the mode of an arm after a command, or because its control loop missed ticks.

    Commands are issued by a person (for example, stop) or by the site itself (for example, when
    a real arm is lost). Missed ticks stop a moving arm. At most one branch applies. Commands
    that leave FAULT or STOPPED are checked first; all other commands have no effect in these
    modes.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site, with the command and the number of missed ticks.
    """
    order = site.order
    skipped = site.skipped
    mode = site.mode
    site.order = 0
    site.skipped = 0
    moves = mode in (_RUN, _ALIGN)  # _ALIGN is the mode RETURN
    stops = order in (_ORDER_STOP, _ORDER_RELEASED)
    if order == _ORDER_RESET and mode == _FAULT:
        enter_rest(t_ns, _WAITING, _RESET, site)
    elif order == _ORDER_ENABLE and mode == _STOPPED:
        enter_rest(t_ns, _WAITING, _ENABLE, site)
    elif order == _ORDER_HELD and mode == _STOPPED and site.reason == _RELEASED:
        enter_rest(t_ns, _WAITING, _HELD, site)
    elif mode == _STOPPED and (
        (order == _ORDER_STOP and site.reason == _RELEASED)
        or (order == _ORDER_RELEASED and site.reason == _STOP)
    ):
        # The brakes of a real arm close when the switch is released, and must not open again.
        # Until then, a torque held the arm that was ordered to stop, but with the switch
        # released, nobody supervises this torque.
        site.reason = _STOP_RELEASED
    elif stops and mode != _FAULT and mode != _STOPPED:
        reason = _STOP if order == _ORDER_STOP else _RELEASED
        latch_mode(t_ns, site, _STOPPED, reason)
    elif mode in (_FAULT, _STOPPED):
        return
    elif order == _ORDER_ARM_LOST or skipped > FAULT_OVERRUN_TICKS:
        reason = _ARM_SILENT if order == _ORDER_ARM_LOST else _OVERRUN
        latch_mode(t_ns, site, _FAULT, reason)
    elif order == _ORDER_ARM_SILENT and moves:
        enter_rest(t_ns, _HOLD, _ARM_SILENT, site)
    elif order == _ORDER_ARM_SILENT:
        site.reason = _ARM_SILENT
    elif order == _ORDER_ARM_BACK and site.reason == _ARM_SILENT:
        site.reason = _ARM_BACK
    elif skipped > HELD_OVERRUN_TICKS and moves:
        enter_rest(t_ns, _HOLD, _OVERRUN, site)


@leaf
def _update_mode(t_ns: int, site: SiteRow, links: RowArray) -> None:
    """Changes the mode of an arm after a fault, or because peers fall silent or return.

    The first applicable change in this list is made (the code calls the mode RETURN `_ALIGN`):

        any mode        a fault of the motion                       -> FAULT
        WAITING         all peers are heard                         -> RETURN
        HOLD            all peers are heard, not in the tick        -> RETURN
                        in which HOLD was entered
        RUN, RETURN     a peer is silent                            -> HOLD
        RUN, RETURN     a peer was dropped or restored              -> RETURN
        RETURN          the time of the alignment has passed        -> RUN

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site. `return_from_ns` is the time of the last change to rest, to an
            alignment or to RUN. `regrouped` is the reason if a peer was dropped or restored in
            this tick, otherwise 0.
        links: State of each link, one row per peer.
    """
    fault = _find_fault(site)
    if fault >= 0 and site.mode != _FAULT:
        latch_mode(t_ns, site, _FAULT, fault)
    if site.mode == _FAULT or site.mode == _STOPPED or site.reason == _ARM_SILENT:
        return  # peers do not change these modes

    all_heard = _all_heard(t_ns, site.stale_ns, links)
    moves = site.mode == _RUN or site.mode == _ALIGN
    elapsed_ns = t_ns - site.return_from_ns
    is_first_tick_of_mode = elapsed_ns == 0
    if all_heard and site.mode == _WAITING:
        _leave_rest(t_ns, site, _PEERS_HERE)
    elif all_heard and site.mode == _HOLD and not is_first_tick_of_mode:
        _leave_rest(t_ns, site, _PEERS_BACK)
    elif not all_heard and moves:
        enter_rest(t_ns, _HOLD, _PEER_SILENT, site)
    elif site.regrouped and moves:
        # The set of followed peers has changed: align from where the reference would be now.
        _extrapolate_reference(site)
        _start_alignment(
            t_ns=t_ns, site=site, reason=site.regrouped, q=site.q_followed, qd=site.qd_followed
        )
    elif site.mode == _ALIGN and elapsed_ns * 1e-9 >= _alignment_s(site):
        site.mode = _RUN
        site.reason = _ALIGNED
        site.return_from_ns = t_ns


@leaf
def update_session_life(t_ns: int, site: SiteRow, links: RowArray) -> None:
    """Updates the mode of an arm (such as waiting, following or resting) and its reference.

    The mode changes on a command from a person or from the site itself, on a fault of the arm,
    or when peers fall silent or are heard again.

    Before the call, `q_des` and `qd_des` contain the weighted mean of the other arms' positions
    and the derivative of this mean. After the call, they contain the reference: this mean in
    RUN, the mean plus an offset in RETURN, and the rest reference in all other modes. The
    reference of the previous tick is in `q_followed` and `qd_followed`.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site; modified.
        links: States of the links from the other sites, one row per link.
    """
    if site.mode == _DIVERGED:
        return  # this mode is final
    is_first_tick = t_ns == tick_ns(site.first, site.rate_hz)
    if is_first_tick:
        enter_rest(t_ns, _WAITING, _START, site)
    # Read the missed ticks before `_apply_order` clears them.
    ticks_since_last_call = 1 + site.skipped
    if site.order != 0 or site.skipped != 0:
        _apply_order(t_ns, site)
    # An arm that leaves its rest in this tick starts from its rest reference at this time.
    if rests(site):
        advance_rest_reference(t_ns, ticks_since_last_call, site)
    _update_mode(t_ns, site, links)
    # The mode is now final for this tick.
    if site.mode == _ALIGN:
        _add_offset(t_ns, site)
    elif rests(site):
        put_rest_reference(site, site.q_des, site.qd_des)


@leaf
def _find_offset(t_ns: int, duration_s: float, site: SiteRow, i: int) -> tuple[float, float]:
    """Returns the current alignment offset of one coordinate, and its rate.

    During an alignment, an offset is added to the position computed from the peers. It decays
    to zero within the time T, following the cubic Hermite polynomial with initial value D,
    initial rate D', and zero final value and rate:

        offset(x) = D (1 - 3 x^2 + 2 x^3) + T D' x (1 - x)^2
        d offset / dx = T D' (1 - x) (1 - 3 x) - 6 D x (1 - x)

    Args:
        t_ns: Time, ns since the start of the session.
        duration_s: Duration T of the alignment, s.
        site: State of the site. The alignment started at `return_from_ns`, with D in `q_held`
            and D' in `qd_held`.
        i: Index of the coordinate.

    Returns:
        The offset, rad or m, and its rate, rad/s or m/s.
    """
    x = (t_ns - site.return_from_ns) * 1e-9 / duration_s
    remaining = 1.0 - x
    D = site.q_held[i]
    T_D_rate = duration_s * site.qd_held[i]
    value_part = D * (1.0 - x * x * (3.0 - 2.0 * x))
    rate_part = T_D_rate * x * remaining * remaining
    # The derivatives of both parts with respect to x, the second part with the opposite sign.
    slope_of_rate_part = T_D_rate * remaining * (1.0 - 3.0 * x)
    fall_of_value_part = D * 6.0 * x * remaining
    slope = slope_of_rate_part - fall_of_value_part
    return value_part + rate_part, slope / duration_s


@leaf
def _add_offset(t_ns: int, site: SiteRow) -> None:
    """Adds the alignment offset to the reference of an arm that returns to its peers.

    The offset is added to the position, and its rate to the velocity. Their initial values were
    stored by `_start_alignment`.

    For an orientation, the offset is a rotation T applied after the rotation R of the peers, so
    the rotation matrix of the reference is T R. Its angular velocity is the angular velocity of
    the offset plus that of the peers, rotated by the offset.

    Args:
        t_ns: Time, ns since the start of the session.
        site: State of the site. In a pose, the coordinates 0 to 2 are a position, and 3 to 5 a
            rotation vector in rad. `q_des` and `qd_des` are the reference of the peers and its
            velocity, and receive the sums.
    """
    duration_s = _alignment_s(site)
    for i in range(count_linear_coordinates(site)):
        offset, offset_rate = _find_offset(t_ns, duration_s, site, i)
        site.q_des[i] += offset
        site.qd_des[i] += offset_rate
    if has_orientation(site):
        x, x_rate = _find_offset(t_ns, duration_s, site, 3)
        y, y_rate = _find_offset(t_ns, duration_s, site, 4)
        z, z_rate = _find_offset(t_ns, duration_s, site, 5)
        turn = (x, y, z)
        turn_rate = (x_rate, y_rate, z_rate)
        peers_velocity = rotate_by_vector(turn, read_three(site.qd_des[3:]))
        turn_velocity = angular_velocity(turn, turn_rate)
        orientation = compose_rotations(turn, read_three(site.q_des[3:]))
        put_three(site.q_des[3:], orientation)
        put_three(site.qd_des[3:], add_vectors(turn_velocity, peers_velocity))

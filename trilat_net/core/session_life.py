"""The life of a site under the rule `glide`: it waits, aligns, follows, and holds while a peer
is silent.

    WAITING -> RETURN (aligns) -> RUN (engaged) -> HOLD -> RETURN -> RUN
    any -> FAULT (a limit, a number that is not finite, its arm lost)  -- RESET  -> WAITING
    any -> STOPPED (an order, or nobody holds its dead-man switch) -- ENABLE, HELD -> WAITING

Invariant: in WAITING, HOLD, STOPPED and FAULT the arm comes to rest where it is and stays
there, in one way (`resting`): the reference leaves the peers, begins at the own pose with the
own velocity, and falls to rest. From there to the peers and while it follows them neither it
nor its derivative jumps, and the second is the derivative of the first: while the site aligns,
the way from the peers' reference falls to zero with its rate, no faster than `align_speed`
beyond what it had. Of an orientation the way is the rotation vector of the turn from the peers'
to the own one, and a rate is an angular velocity. A peer that rests or aligns itself is
followed like any other. FAULT and STOPPED are latched. No message of a peer leads there or
back. A switch that is held again ends what its release began, but no stop by order.
"""

from math import isfinite

from .chain import add, put_three, scale, subtract, three
from .jit import leaf
from .resting import advance_rest_reference, enter_rest, put_rest_reference, rests
from .rotation import (
    angular_velocity,
    compose_rotations,
    length,
    relative_rotation,
    rotate_by_vector,
    rotation_matrix,
    rotation_vector_rate,
)
from .task_space import count_linear_coordinates, has_orientation
from .ticks import LifeOrder, LifeReason, Mode, tick_ns
from .vectors import Array, Row, RowArray, put

MIN_ALIGN_NS = 250_000_000
"""The least time of an alignment."""
RETURN_NS = 100_000_000
"""Time in which a torque goes over from that of an arm at rest to that of the law."""
HELD_OVERRUN_TICKS = 20
"""A site at an arm outside that missed more ticks than these holds."""
FAULT_OVERRUN_TICKS = 200
"""One that missed more than these is in FAULT."""

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
_HELD = int(LifeReason.HELD)
_TO_STOP = int(LifeOrder.STOP)
_TO_ENABLE = int(LifeOrder.ENABLE)
_TO_RESET = int(LifeOrder.RESET)
_HEAR_SILENCE = int(LifeOrder.ARM_SILENT)
_LOSE_ARM = int(LifeOrder.ARM_LOST)
_HEAR_ARM = int(LifeOrder.ARM_BACK)
_LET_GO = int(LifeOrder.RELEASED)
_TAKE_HOLD = int(LifeOrder.HELD)


@leaf
def _all_heard(t_ns: int, silence_ns: int, links: RowArray) -> bool:
    """True if of every peer that is followed a sample came into use no longer ago than
    `silence_ns`.
    """
    for j in range(links.shape[0]):
        link: Row = links[j]
        if link.alpha > 0.0 and (link.used < 0 or t_ns - link.used_ns > silence_ns):
            return False
    return True


@leaf
def _align_s(site: Row) -> float:
    """Returns how long the way that is left at its beginning, `q_held`, takes."""
    way = 0.0
    for i in range(count_linear_coordinates(site)):
        way = max(way, abs(site.q_held[i]))
    if has_orientation(site):
        way = max(way, length(three(site.q_held[3:])))
    takes_s: float = max(MIN_ALIGN_NS * 1e-9, 1.5 * way / site.align_speed)
    return takes_s


@leaf
def _begin_aligning(t_ns: int, site: Row, reason: int, q: Array, qd: Array) -> None:
    """Begins to align from a reference q that moves at qd, if the peers are no farther than the
    limit.
    """
    turn = rate = (0.0, 0.0, 0.0)
    if has_orientation(site):
        turn = relative_rotation(
            rotation_matrix(three(q[3:])), rotation_matrix(three(site.q_des[3:]))
        )
        rate = rotation_vector_rate(
            turn, subtract(three(qd[3:]), rotate_by_vector(turn, three(site.qd_des[3:])))
        )
    near = length(turn) <= site.align_limit
    for i in range(count_linear_coordinates(site)):
        near = near and abs(q[i] - site.q_des[i]) <= site.align_limit
    if not near:
        site.reason = _ALIGN_LIMIT
        return
    for i in range(count_linear_coordinates(site)):
        site.q_held[i] = q[i] - site.q_des[i]
        site.qd_held[i] = qd[i] - site.qd_des[i]
    if has_orientation(site):
        put_three(site.q_held[3:], turn)
        put_three(site.qd_held[3:], rate)
    put(site.tau_held, site.tau_before)
    site.mode = _ALIGN
    site.reason = reason
    site.return_from_ns = t_ns


@leaf
def _leave_rest(t_ns: int, site: Row, reason: int) -> None:
    """Begins to align from the reference of an arm at rest."""
    put_rest_reference(site, site.q_followed, site.qd_followed)
    _begin_aligning(t_ns=t_ns, site=site, reason=reason, q=site.q_followed, qd=site.qd_followed)


@leaf
def _carry_on(site: Row) -> None:
    """Moves the reference of the tick before to where its rate takes it until now."""
    h_s = 1.0 / site.rate_hz
    for i in range(count_linear_coordinates(site)):
        site.q_followed[i] += h_s * site.qd_followed[i]
    if has_orientation(site):
        turn = scale(h_s, three(site.qd_followed[3:]))
        put_three(site.q_followed[3:], compose_rotations(turn, three(site.q_followed[3:])))


@leaf
def is_law_returning(t_ns: int, site: Row) -> bool:
    """True if a site aligns that was at rest until a moment ago."""
    rested = site.reason != _DROPPED and site.reason != _RESTORED
    returning: bool = site.mode == _ALIGN and rested and t_ns - site.return_from_ns < RETURN_NS
    return returning


@leaf
def latch_mode(t_ns: int, site: Row, mode: int, reason: int) -> None:
    """Enters FAULT or STOPPED."""
    for p in range(site.theta_hat.shape[0]):
        if not isfinite(site.theta_hat[p]):
            site.theta_hat[p] = 0.0
    enter_rest(t_ns, mode, reason, site)


@leaf
def _find_fault(site: Row) -> int:
    """Returns the reason for a fault that the arm's motion gives, or -1."""
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
def _obey(t_ns: int, site: Row) -> None:
    """Carries out what is ordered, and what the ticks that were not made ask for."""
    order = site.order
    skipped = site.skipped
    mode = site.mode
    site.order = site.skipped = 0
    moves = mode in (_RUN, _ALIGN)
    if order == _TO_RESET and mode == _FAULT:
        enter_rest(t_ns, _WAITING, _RESET, site)
    elif order == _TO_ENABLE and mode == _STOPPED:
        enter_rest(t_ns, _WAITING, _ENABLE, site)
    elif order == _TAKE_HOLD and mode == _STOPPED and site.reason == _RELEASED:
        enter_rest(t_ns, _WAITING, _HELD, site)
    elif order == _TO_STOP and mode == _STOPPED:
        site.reason = _STOP
    elif order in (_TO_STOP, _LET_GO) and mode != _FAULT and mode != _STOPPED:
        latch_mode(t_ns, site, _STOPPED, _STOP if order == _TO_STOP else _RELEASED)
    elif mode in (_FAULT, _STOPPED):
        return
    elif order == _LOSE_ARM or skipped > FAULT_OVERRUN_TICKS:
        latch_mode(t_ns, site, _FAULT, _ARM_SILENT if order == _LOSE_ARM else _OVERRUN)
    elif order == _HEAR_SILENCE and moves:
        enter_rest(t_ns, _HOLD, _ARM_SILENT, site)
    elif order == _HEAR_SILENCE:
        site.reason = _ARM_SILENT
    elif order == _HEAR_ARM and site.reason == _ARM_SILENT:
        site.reason = _ARM_BACK
    elif skipped > HELD_OVERRUN_TICKS and moves:
        enter_rest(t_ns, _HOLD, _OVERRUN, site)


@leaf
def _update_mode(t_ns: int, site: Row, links: RowArray) -> None:
    """Changes the mode where limits or the peers ask for it."""
    fault = _find_fault(site)
    if fault >= 0 and site.mode != _FAULT:
        latch_mode(t_ns, site, _FAULT, fault)
    if site.mode == _FAULT or site.mode == _STOPPED or site.reason == _ARM_SILENT:
        return
    heard = _all_heard(t_ns, site.stale_ns, links)
    if heard and site.mode == _WAITING:
        _leave_rest(t_ns, site, _PEERS_HERE)
    elif heard and site.mode == _HOLD and site.return_from_ns != t_ns:
        _leave_rest(t_ns, site, _PEERS_BACK)
    elif not heard and (site.mode == _RUN or site.mode == _ALIGN):
        enter_rest(t_ns, _HOLD, _PEER_SILENT, site)
    elif site.regrouped and (site.mode == _RUN or site.mode == _ALIGN):
        _carry_on(site)
        _begin_aligning(
            t_ns=t_ns, site=site, reason=site.regrouped, q=site.q_followed, qd=site.qd_followed
        )
    elif site.mode == _ALIGN and (t_ns - site.return_from_ns) * 1e-9 >= _align_s(site):
        site.mode = _RUN
        site.reason = _ALIGNED
        site.return_from_ns = t_ns


@leaf
def update_session_life(t_ns: int, site: Row, links: RowArray) -> None:
    """Changes the mode, and from the peers' reference makes the one that the mode asks for.

    The reference of the tick before is in `q_followed` and `qd_followed`.
    """
    if site.mode == _DIVERGED:
        return
    if t_ns == tick_ns(site.first, site.rate_hz):
        enter_rest(t_ns, _WAITING, _START, site)
    ticks = 1 + site.skipped
    if site.order != 0 or site.skipped != 0:
        _obey(t_ns, site)
    if rests(site):
        advance_rest_reference(t_ns, ticks, site)
    _update_mode(t_ns, site, links)
    if site.mode == _ALIGN:
        _put_aligning(t_ns, site)
    elif rests(site):
        put_rest_reference(site, site.q_des, site.qd_des)


@leaf
def _find_way(t_ns: int, takes_s: float, site: Row, i: int) -> tuple[float, float]:
    """Returns what is left of the way from the peers' reference, and its rate."""
    x = (t_ns - site.return_from_ns) * 1e-9 / takes_s
    way = site.q_held[i]
    rate = takes_s * site.qd_held[i]
    left = way * (1.0 - x * x * (3.0 - 2.0 * x)) + rate * x * (1.0 - x) * (1.0 - x)
    return left, (rate * (1.0 - x) * (1.0 - 3.0 * x) - way * 6.0 * x * (1.0 - x)) / takes_s


@leaf
def _put_aligning(t_ns: int, site: Row) -> None:
    """Adds what is left of the way to the peers' reference, and its rate."""
    takes_s = _align_s(site)
    for i in range(count_linear_coordinates(site)):
        left, rate = _find_way(t_ns, takes_s, site, i)
        site.q_des[i] += left
        site.qd_des[i] += rate
    if has_orientation(site):
        x, wx = _find_way(t_ns, takes_s, site, 3)
        y, wy = _find_way(t_ns, takes_s, site, 4)
        z, wz = _find_way(t_ns, takes_s, site, 5)
        turn = (x, y, z)
        carried = rotate_by_vector(turn, three(site.qd_des[3:]))
        put_three(site.q_des[3:], compose_rotations(turn, three(site.q_des[3:])))
        put_three(site.qd_des[3:], add(angular_velocity(turn, (wx, wy, wz)), carried))

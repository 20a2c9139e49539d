"""The life of a site under the rule `glide`: it waits, aligns, follows, and holds while a peer is silent.

    WAITING -> RETURN (aligns) -> RUN (engaged) -> HOLD -> RETURN -> RUN

Invariant: the reference and its derivative never jump, and the second is the derivative of the first. Held,
the rate of the reference falls to zero over the time after which a peer counts as silent, and the reference
is its integral; while the site aligns, the way from the peers' reference falls to zero with its rate, no
faster than `align_speed` beyond what it had. A peer that holds or aligns itself is followed like any other.
"""

from enum import IntEnum

from .jit import leaf
from .ticks import Mode, tick_ns
from .vectors import Row, RowArray, put


class LifeReason(IntEnum):
    """Why a site last changed its mode."""

    START = 0
    PEERS_HERE = 1
    ALIGNED = 2
    PEER_SILENT = 3
    PEERS_BACK = 4
    ALIGN_LIMIT = 5


MIN_ALIGN_NS = 250_000_000
"""The least time of an alignment."""

_RUN, _DIVERGED, _HOLD = int(Mode.RUN), int(Mode.DIVERGED), int(Mode.HOLD)
_ALIGN, _WAITING = int(Mode.RETURN), int(Mode.WAITING)
_START = int(LifeReason.START)
_PEERS_HERE, _ALIGNED = int(LifeReason.PEERS_HERE), int(LifeReason.ALIGNED)
_PEER_SILENT, _PEERS_BACK = int(LifeReason.PEER_SILENT), int(LifeReason.PEERS_BACK)
_ALIGN_LIMIT = int(LifeReason.ALIGN_LIMIT)


@leaf
def _all_heard(t_ns: int, silence_ns: int, links: RowArray) -> bool:
    """True if of every peer that is followed a sample came into use no longer ago than `silence_ns`."""
    for j in range(links.shape[0]):
        link: Row = links[j]
        if link.alpha > 0.0 and (link.used < 0 or t_ns - link.used_ns > silence_ns):
            return False
    return True


@leaf
def _enter(t_ns: int, mode: int, reason: int, site: Row) -> None:
    site.mode, site.reason, site.return_from_ns = mode, reason, t_ns


@leaf
def _find_held(t_ns: int, site: Row, i: int) -> tuple[float, float]:
    """Returns where the held reference is and its rate: the rate falls to zero over the time of silence."""
    fall_s = site.stale_ns * 1e-9
    since_s = min((t_ns - site.return_from_ns) * 1e-9, fall_s)
    rate = site.qd_held[i] * (1.0 - since_s / fall_s)
    return site.q_held[i] + 0.5 * (site.qd_held[i] + rate) * since_s, rate


@leaf
def _align_s(site: Row) -> float:
    """Returns how long the way that is left at its beginning, `q_held`, takes."""
    way = 0.0
    for i in range(site.q_held.shape[0]):
        way = max(way, abs(site.q_held[i]))
    takes_s: float = max(MIN_ALIGN_NS * 1e-9, 1.5 * way / site.align_speed)
    return takes_s


@leaf
def _begin_aligning(t_ns: int, site: Row, reason: int) -> None:
    """Begins to align from the held reference, if the peers are no farther than the limit."""
    for i in range(site.q_held.shape[0]):
        q, _ = _find_held(t_ns, site, i)
        if not abs(q - site.q_des[i]) <= site.align_limit:
            site.reason = _ALIGN_LIMIT
            return
    for i in range(site.q_held.shape[0]):
        q, qd = _find_held(t_ns, site, i)
        site.q_held[i], site.qd_held[i] = q - site.q_des[i], qd - site.qd_des[i]
    _enter(t_ns, _ALIGN, reason, site)


@leaf
def _update_mode(t_ns: int, before_ns: int, site: Row, links: RowArray) -> None:
    """Changes the mode where the peers ask for it."""
    heard = _all_heard(t_ns, site.stale_ns, links)
    if heard and site.mode == _WAITING:
        _begin_aligning(t_ns, site, _PEERS_HERE)
    elif heard and site.mode == _HOLD:
        _begin_aligning(t_ns, site, _PEERS_BACK)
    elif not heard and (site.mode == _RUN or site.mode == _ALIGN):
        put(site.q_held, site.q_followed)
        put(site.qd_held, site.qd_followed)
        _enter(before_ns, _HOLD, _PEER_SILENT, site)
    elif site.mode == _ALIGN and (t_ns - site.return_from_ns) * 1e-9 >= _align_s(site):
        _enter(t_ns, _RUN, _ALIGNED, site)


@leaf
def update_session_life(t_ns: int, before_ns: int, site: Row, links: RowArray) -> None:
    """Changes the mode, and from the peers' reference makes the one that the mode asks for.

    The tick before was at `before_ns`, and its reference is in `q_followed` and `qd_followed`.
    """
    if site.mode == _DIVERGED:
        return
    if t_ns == tick_ns(site.first, site.rate_hz):  # from its own pose, at rest
        for i in range(site.q_held.shape[0]):
            site.q_held[i] = site.x[i] if site.task else site.q[i]
            site.qd_held[i] = 0.0
        _enter(t_ns, _WAITING, _START, site)
    _update_mode(t_ns, before_ns, site, links)
    if site.mode == _RUN:
        return
    if site.mode != _ALIGN:
        for i in range(site.q_held.shape[0]):
            site.q_des[i], site.qd_des[i] = _find_held(t_ns, site, i)
        return
    takes_s = _align_s(site)
    x = (t_ns - site.return_from_ns) * 1e-9 / takes_s
    for i in range(site.q_held.shape[0]):
        way, rate = site.q_held[i], takes_s * site.qd_held[i]
        site.q_des[i] += way * (1.0 - x * x * (3.0 - 2.0 * x)) + rate * x * (1.0 - x) * (1.0 - x)
        site.qd_des[i] += (rate * (1.0 - x) * (1.0 - 3.0 * x) - way * 6.0 * x * (1.0 - x)) / takes_s

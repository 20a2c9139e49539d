"""What a site does about a peer whose samples have become too old.

Law: the way out is a step to rest, the way back is smooth: the reference goes from the pose that was held
to the peers along 3 x^2 - 2 x^3, and its derivative with it.
"""

from .delay import Row
from .grid import tick_ns
from .jit import leaf
from .link import Rows
from .setup import Stale
from .tick import Mode

_RUN, _DIVERGED = int(Mode.RUN), int(Mode.DIVERGED)
_HOLD, _BRAKE, _RETURN = int(Mode.HOLD), int(Mode.BRAKE), int(Mode.RETURN)
_USE, _ACT_BRAKE = int(Stale.USE), int(Stale.BRAKE)


@leaf
def is_stale(t_ns: int, age_ns: int, links: Rows) -> bool:
    """True where a peer with a share is older than `age_ns`; before its first sample it is as old as t."""
    for j in range(links.shape[0]):
        link: Row = links[j]
        stamp_ns = tick_ns(max(link.used, 0), link.rate_hz)
        if link.alpha > 0.0 and t_ns - stamp_ns > age_ns:
            return True
    return False


@leaf
def mind_stale_peers(t_ns: int, site: Row, links: Rows) -> None:
    """Changes the mode where peers became stale or fresh, and the reference where the mode asks for it.

    Args:
        t_ns: the time, ns since the epoch.
        site: the site's row; its q_des and qd_des are what the peers give, its q_held what was in force.
        links: one row per peer, dtype LINK.
    """
    if site.on_stale == _USE or site.mode == _DIVERGED:
        return
    stale = is_stale(t_ns, site.stale_ns, links)
    if stale and (site.mode == _RUN or site.mode == _RETURN):
        braking = site.on_stale == _ACT_BRAKE
        for i in range(site.q.shape[0]):
            site.q_held[i] = site.q[i] if braking else site.q_followed[i]
        site.mode = _BRAKE if braking else _HOLD
        site.return_from_ns = 0
    elif not stale and (site.mode == _HOLD or site.mode == _BRAKE):
        site.mode = _RETURN
        site.return_from_ns = t_ns
    if site.mode == _RETURN and t_ns - site.return_from_ns >= site.return_ns:
        site.mode = _RUN
    if site.mode == _RUN:
        return
    x = (t_ns - site.return_from_ns) / site.return_ns if site.mode == _RETURN else 0.0
    share = x * x * (3.0 - 2.0 * x)
    share_rate = 6.0 * x * (1.0 - x) / (site.return_ns * 1e-9)
    for i in range(site.q.shape[0]):
        way = site.q_des[i] - site.q_held[i]
        site.q_des[i] = site.q_held[i] + share * way
        site.qd_des[i] = share * site.qd_des[i] + share_rate * way

"""Peers that a site goes on without: a lost master's share goes to the others, until it is
back.

Invariant: what is decided follows from the samples in use and from what is remembered, tick by
tick. Nobody is dropped without whom those that are left would not all reach each other, nor the
last one that is followed: then the site holds. The reference never jumps: the site aligns with
what is left, and with who is back.
"""

from .chain import add, scale, three
from .jit import leaf
from .rotation import length, relative_rotation, rotation_matrix
from .task_space import count_linear_coordinates, has_orientation
from .ticks import LifeReason
from .vectors import Row, RowArray

BACK_NS = 250_000_000
"""One that was dropped has its share again when it was heard for so long."""

_DROPPED = int(LifeReason.DROPPED)
_RESTORED = int(LifeReason.RESTORED)


@leaf
def _can_go_without(lost: int, t_ns: int, site: Row, links: RowArray) -> bool:
    """True if those that are left, without this peer, follow each other, and the site one of
    them.
    """
    everyone = site.bit
    own = 0
    for j in range(links.shape[0]):
        link: Row = links[j]
        if (
            j != lost
            and link.gone == 0.0
            and link.used >= 0
            and t_ns - link.used_ns <= site.stale_ns
        ):
            everyone |= link.bit
            if link.alpha > 0.0:
                own |= link.bit
    ahead = behind = site.bit
    for _ in range(links.shape[0]):
        ahead |= own
        for j in range(links.shape[0]):
            link = links[j]
            if ahead & link.bit:
                ahead |= link.followed & everyone
            if everyone & link.bit and link.followed & behind:
                behind |= link.bit
    return own != 0 and ahead == everyone and behind == everyone


@leaf
def _is_turned_little(back: int, site: Row, links: RowArray) -> bool:
    """True if this peer's share turns the reference by no more than an alignment may.

    The turn between two orientations is no longer than the difference of their vectors from the
    own one.
    """
    own = rotation_matrix(three(site.x[3:]))
    whole = 0.0
    sum_of_turns = (0.0, 0.0, 0.0)
    for j in range(links.shape[0]):
        link: Row = links[j]
        if link.gone == 0.0:
            turn = relative_rotation(own, rotation_matrix(three(link.q[3:])))
            sum_of_turns = add(sum_of_turns, scale(link.alpha, turn))
            whole += link.alpha
    link = links[back]
    turn = relative_rotation(own, rotation_matrix(three(link.q[3:])))
    away = add(turn, scale(-1.0 / whole, sum_of_turns))
    near: bool = length(away) * link.alpha / (whole + link.alpha) <= site.align_limit
    return near


@leaf
def _is_near(back: int, site: Row, links: RowArray) -> bool:
    """True if the reference with this peer is no farther from that without it than an alignment
    may go.
    """
    if has_orientation(site) and not _is_turned_little(back, site, links):
        return False
    for i in range(count_linear_coordinates(site)):
        rest = whole = 0.0
        for j in range(links.shape[0]):
            link: Row = links[j]
            if link.gone == 0.0:
                rest += link.alpha * link.q[i]
                whole += link.alpha
        link = links[back]
        there = (rest + link.alpha * link.q[i]) / (whole + link.alpha)
        if not abs(there - rest / whole) <= site.align_limit:
            return False
    return True


@leaf
def _share_out(links: RowArray) -> bool:
    """Gives the shares of those that are gone to the others; false if nobody is left to have
    them.
    """
    whole = whole_rate = 0.0
    some = False
    for j in range(links.shape[0]):
        link: Row = links[j]
        if link.gone == 0.0:
            whole += link.alpha
            whole_rate += link.alpha_rate
        else:
            some = True
    if some and whole <= 0.0:
        return False
    for j in range(links.shape[0] if some else 0):
        link = links[j]
        if link.gone == 0.0:
            link.alpha_rate = (link.alpha_rate * whole - link.alpha * whole_rate) / (
                whole * whole
            )
            link.alpha /= whole
        else:
            link.alpha = link.alpha_rate = 0.0
    return True


@leaf
def regroup(t_ns: int, site: Row, links: RowArray) -> None:
    """Drops peers that are lost and takes back those that are there again; divides the shares
    among the rest.

    Before it `alpha` of a link is the share that is planned, afterwards the one in force.
    """
    site.regrouped = 0
    for j in range(links.shape[0]):
        link: Row = links[j]
        if not link.alpha > 0.0 or link.used < 0:
            continue
        silent = t_ns - link.used_ns > site.stale_ns
        if link.gone == 0.0:
            if silent and link.dispensable and _can_go_without(j, t_ns, site, links):
                link.gone = -1.0
                site.regrouped = _DROPPED
        elif silent:
            link.gone = -1.0
        elif link.gone < 0.0:
            link.gone = float(t_ns)
        elif t_ns - link.gone >= BACK_NS and _is_near(j, site, links):
            link.gone = 0.0
            site.regrouped = _RESTORED
    if not _share_out(links):  # the shares were changed meanwhile
        for j in range(links.shape[0]):
            link = links[j]
            link.gone = 0.0

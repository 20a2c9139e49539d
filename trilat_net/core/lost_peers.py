"""Lets an arm continue without a lost peer, whose weight the other peers get.

A site is a process that runs one arm. Its peers are the other sites, from which it receives
samples (states of their arms). A site follows each peer with a certain weight, the dominance
factor or share. A peer is lost if no sample of it could be used for some time.

Invariant:
    - All decisions follow from the samples in use and from the stored state of the site. They
      are made in each tick, a period of the control loop.
    - A site only continues without a peer if the remaining sites all reach each other without
      it, and if the site still follows another peer. Otherwise the arm stops.
    - The reference, the position that the arm follows, never jumps. It moves smoothly to the
      position of the remaining peers, and later back if the lost peer returns.

The field `gone` of a link stores the state of the peer. It is 0 while the peer is present, and
-1 while the peer is lost. After the return of the peer, it is the time of the return, in ns
since the start of the session.
"""

from .chain import add, scale, three
from .jit import leaf
from .rotation import length, relative_rotation, rotation_matrix
from .row_fields import LinkRow, SiteRow
from .task_space import count_linear_coordinates, has_orientation
from .ticks import LifeReason
from .vectors import RowArray

BACK_NS = 250_000_000
"""Time for which a dropped peer must be heard before it gets its share again, ns."""

_DROPPED = int(LifeReason.DROPPED)
_RESTORED = int(LifeReason.RESTORED)


@leaf
def _can_drop(lost: int, t_ns: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if the site may go on without a peer.

    The remaining sites must reach each other, and this site must still follow at least one
    peer. Sets of sites are numbers with one bit per site. `forward` are the sites that this
    site reaches, and `backward` the sites that reach this site; both must be all remaining
    sites.

    Args:
        lost: Index of the peer.
        t_ns: Time, ns since the epoch, the common start of the session.
        site: Row of the site.
        links: Rows of the site's links.
    """
    remaining = site.bit
    followed = 0
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        is_heard = link.gone == 0.0 and link.used >= 0
        if j != lost and is_heard and t_ns - link.used_ns <= site.stale_ns:
            remaining |= link.bit
            if link.alpha > 0.0:
                followed |= link.bit
    forward = site.bit
    backward = site.bit
    for _ in range(links.shape[0]):
        forward |= followed
        for j in range(links.shape[0]):
            link = links[j]
            if forward & link.bit:
                forward |= link.followed & remaining
            if remaining & link.bit and link.followed & backward:
                backward |= link.bit
    return followed != 0 and forward == remaining and backward == remaining


@leaf
def _is_orientation_near(back: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if a returning peer turns the reference by at most the alignment limit.

    The turn between two orientations is at most as long as the difference of their rotation
    vectors from the site's own orientation.

    Args:
        back: Index of the returning peer.
        site: Row of the site.
        links: Rows of the site's links.
    """
    orientation = rotation_matrix(three(site.x[3:]))
    total = 0.0
    sum_of_turns = (0.0, 0.0, 0.0)
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        if link.gone == 0.0:
            peer_orientation = rotation_matrix(three(link.q[3:]))
            turn = relative_rotation(orientation, peer_orientation)
            sum_of_turns = add(sum_of_turns, scale(link.alpha, turn))
            total += link.alpha
    link = links[back]
    peer_orientation = rotation_matrix(three(link.q[3:]))
    turn = relative_rotation(orientation, peer_orientation)
    difference = add(turn, scale(-1.0 / total, sum_of_turns))
    turn_of_reference = length(difference) * link.alpha / (total + link.alpha)
    near: bool = turn_of_reference <= site.align_limit
    return near


@leaf
def _is_near(back: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if a returning peer moves the reference by at most the alignment limit.

    Args:
        back: Index of the returning peer.
        site: Row of the site.
        links: Rows of the site's links.
    """
    if has_orientation(site) and not _is_orientation_near(back, site, links):
        return False
    for i in range(count_linear_coordinates(site)):
        weighted = 0.0
        total = 0.0
        for j in range(links.shape[0]):
            link: LinkRow = links[j]
            if link.gone == 0.0:
                weighted += link.alpha * link.q[i]
                total += link.alpha
        link = links[back]
        weighted_with_peer = weighted + link.alpha * link.q[i]
        with_peer = weighted_with_peer / (total + link.alpha)
        without_peer = weighted / total
        if not abs(with_peer - without_peer) <= site.align_limit:
            return False
    return True


@leaf
def _redistribute_shares(links: RowArray) -> bool:
    """Divides the shares of lost peers among the other peers, in proportion to their shares.

        alpha_j / sum alpha,  with the derivative by the quotient rule; 0 for a lost peer

    Returns:
        False, without a change, if no other peer has a share.
    """
    total = 0.0
    total_rate = 0.0
    any_lost = False
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        if link.gone == 0.0:
            total += link.alpha
            total_rate += link.alpha_rate
        else:
            any_lost = True

    if not any_lost:
        return True
    if total <= 0.0:
        return False

    for j in range(links.shape[0]):
        link = links[j]
        if link.gone == 0.0:
            numerator = link.alpha_rate * total - link.alpha * total_rate
            link.alpha_rate = numerator / (total * total)
            link.alpha /= total
        else:
            link.alpha = 0.0
            link.alpha_rate = 0.0
    return True


@leaf
def regroup(t_ns: int, site: SiteRow, links: RowArray) -> None:
    """Adapts the dominance factors of a site to peers that are lost or have returned.

    A dominance factor is the weight with which the site follows a peer. The factors of lost
    peers are redistributed to the others. Before the call `alpha` of a link is the planned
    factor, afterwards the factor in force.

    Args:
        t_ns: Time, ns since the epoch, the common start of the session.
        site: Row of the site; changed.
        links: Rows of the site's links; changed.
    """
    site.regrouped = 0
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        if not link.alpha > 0.0 or link.used < 0:
            continue
        silent = t_ns - link.used_ns > site.stale_ns
        if link.gone == 0.0:
            if silent and link.dispensable and _can_drop(j, t_ns, site, links):
                link.gone = -1.0
                site.regrouped = _DROPPED
        elif silent:
            link.gone = -1.0
        elif link.gone < 0.0:
            link.gone = float(t_ns)
        elif t_ns - link.gone >= BACK_NS and _is_near(j, site, links):
            link.gone = 0.0
            site.regrouped = _RESTORED
    # A change of the shares may leave all of them to lost peers: then no peer counts as lost.
    if not _redistribute_shares(links):
        for j in range(links.shape[0]):
            link = links[j]
            link.gone = 0.0

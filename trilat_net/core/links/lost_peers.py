"""Lets an arm continue when another arm that it follows is lost.

A peer is lost if no sample from it could be used for some time. Its weight (dominance factor)
is then given to the remaining peers. For example, a slave that followed two users with 0.7 and
0.3 follows the second user alone if the first one is lost.

Invariant:
    - All decisions depend only on the samples in use and the stored state of the site. They are
      re-evaluated in each control period.
    - A site continues without a peer only if the remaining sites can all reach each other
      without it, and if the site still follows another peer. Otherwise, the arm stops.
    - The reference never jumps. It moves smoothly to the position of the remaining peers, and
      back again if the lost peer returns.

The field `gone` of a link stores the state of the peer. It is 0 while the peer is present, and
-1 while the peer is lost. After the peer has returned, it is the time of its return, in ns
since the start of the session.
"""

from ..arms.chain import add_vectors, read_three, scale_vector
from ..arms.rotation import length, relative_rotation, rotation_matrix
from ..arms.task_space import count_linear_coordinates, has_orientation
from ..step.jit import leaf
from ..step.row_fields import LinkRow, SiteRow
from ..step.ticks import LifeReason
from ..step.vectors import RowArray

BACK_NS = 250_000_000
"""How long samples from a dropped peer must arrive before it regains its share, ns."""

_DROPPED = int(LifeReason.DROPPED)
_RESTORED = int(LifeReason.RESTORED)


@leaf
def _can_drop(lost: int, t_ns: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if the site may continue without a peer that is lost.

    The remaining sites are this site and the peers whose samples still arrive. This site must
    still follow at least one of them, and they must all reach each other. A site reaches the
    sites that it follows, directly or through others.

    The remaining sites all reach each other if each of them is in both of two sets: the sites
    that this site reaches, and the sites that reach this site. The sets are grown from this
    site until nothing can be added. A set of sites is an integer with one bit per site.

    Args:
        lost: Index of the lost peer.
        t_ns: Time, ns since the epoch (the common start of the session).
        site: State of the site.
        links: State of each link, one row per peer. `bit` is the bit of the peer, `followed`
            the set of sites that the peer follows, and `alpha` the weight with which this site
            follows the peer.
    """
    remaining = site.bit
    followed = 0  # the remaining sites that this site follows
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        is_present = link.gone == 0.0 and link.used >= 0
        if j != lost and is_present and t_ns - link.used_ns <= site.stale_ns:
            remaining |= link.bit
            if link.alpha > 0.0:
                followed |= link.bit

    reached = site.bit
    reaching = site.bit
    # A shortest path has at most one step per peer, and each sweep adds at least one step.
    for _ in range(links.shape[0]):
        reached |= followed
        for j in range(links.shape[0]):
            link = links[j]
            if reached & link.bit:
                reached |= link.followed & remaining
            if remaining & link.bit and link.followed & reaching:
                reaching |= link.bit
    return followed != 0 and reached == remaining and reaching == remaining


@leaf
def _is_orientation_near(back: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if a returning peer turns the reference by at most the alignment limit.

    The reference orientation is a weighted mean of the peers' orientations. With the rotation
    vector u_j from the orientation of peer j to that of this arm, and the weight alpha_j, the
    mean over the present peers is

        mean = sum_j alpha_j u_j / sum_j alpha_j

    A returning peer with rotation vector u and weight alpha changes it by

        |u - mean| alpha / (sum_j alpha_j + alpha)

    The angle between two orientations never exceeds the length of the difference of their
    rotation vectors relative to the site's own orientation.

    Args:
        back: Index of the returning peer.
        site: State of the site, including its own pose x. The last three coordinates of a pose
            are the rotation vector of its orientation, rad. `align_limit` is the limit.
        links: State of each link, one row per peer, including the pose q of the peer. `gone` is
            0 for a present peer. The weights of the present peers must not all be 0.
    """
    orientation = rotation_matrix(read_three(site.x[3:]))
    total = 0.0  # the sum of the weights of the present peers
    sum_of_turns = (0.0, 0.0, 0.0)
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        is_present = link.gone == 0.0
        if is_present:
            peer_orientation = rotation_matrix(read_three(link.q[3:]))
            turn = relative_rotation(orientation, peer_orientation)
            sum_of_turns = add_vectors(sum_of_turns, scale_vector(link.alpha, turn))
            total += link.alpha

    link = links[back]
    peer_orientation = rotation_matrix(read_three(link.q[3:]))
    turn = relative_rotation(orientation, peer_orientation)
    difference = add_vectors(turn, scale_vector(-1.0 / total, sum_of_turns))
    turn_of_reference = length(difference) * link.alpha / (total + link.alpha)
    near: bool = turn_of_reference <= site.align_limit
    return near


@leaf
def _is_near(back: int, site: SiteRow, links: RowArray) -> bool:
    """Returns True if a returning arm would move the reference only slightly.

    The reference is the mean of the peers' positions, weighted by alpha. The alignment limit
    applies to each linear coordinate (a position or a joint angle), and to the orientation as a
    whole.

    Args:
        back: Index of the returning peer.
        site: State of the site, including the limit `align_limit`, m or rad.
        links: State of each link, one row per peer, including the position q of the peer.
            `gone` is 0 for a present peer. The weights of the present peers must not all be 0.
    """
    if has_orientation(site) and not _is_orientation_near(back, site, links):
        return False
    for i in range(count_linear_coordinates(site)):
        # Sums over the present peers, of alpha q and of alpha.
        weighted_sum = 0.0
        total = 0.0
        for j in range(links.shape[0]):
            link: LinkRow = links[j]
            is_present = link.gone == 0.0
            if is_present:
                weighted_sum += link.alpha * link.q[i]
                total += link.alpha
        link = links[back]
        weighted_sum_with_peer = weighted_sum + link.alpha * link.q[i]
        reference_with_peer = weighted_sum_with_peer / (total + link.alpha)
        reference_without_peer = weighted_sum / total
        # The comparison is false for NaN, so NaN is never near.
        is_within_limit = abs(reference_with_peer - reference_without_peer) <= site.align_limit
        if not is_within_limit:
            return False
    return True


@leaf
def _redistribute_shares(links: RowArray) -> bool:
    """Distributes the dominance factors of lost peers among the remaining peers.

    The present peers get the factors of the lost peers in proportion to their own factors
    alpha, which makes the sum 1 again:

        alpha_j / sum alpha,  with the derivative by the quotient rule; 0 for a lost peer

    Returns:
        True if the factors were redistributed. False if all other peers have the factor 0, in
        which case nothing is changed.
    """
    total = 0.0  # the sum of the factors of the present peers, and its derivative
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
    """Transfers the weight of lost peers to the other peers until the lost peers return.

    Before the call, `alpha` of each link is its planned dominance factor; afterwards, it is the
    factor in force.

    The field `gone` of a link is the state of its peer:

    - 0: present. If the peer falls silent and is dispensable, it becomes lost.
    - -1: lost. When samples from the peer arrive again, the field becomes the time of its
      return.
    - Above 0: time of the return, ns. If the peer falls silent again, it is lost again. After
      BACK_NS the peer becomes present, provided that this moves the reference by no more than
      `site.align_limit`.

    Args:
        t_ns: Time, ns since the epoch (the common start of the session).
        site: State of the site; updated in place. `regrouped` is set to the reason if a peer
            was dropped or restored in this tick, otherwise to 0.
        links: State of each link, one row per peer; updated in place. A peer is silent if its
            last sample came into use more than `site.stale_ns` ago. `dispensable` is 1 if the
            site may drop the peer.
    """
    site.regrouped = 0
    for j in range(links.shape[0]):
        link: LinkRow = links[j]
        is_followed = link.alpha > 0.0
        was_ever_heard = link.used >= 0
        if not is_followed or not was_ever_heard:
            continue

        is_silent = t_ns - link.used_ns > site.stale_ns
        is_present = link.gone == 0.0
        is_lost = link.gone < 0.0
        if is_present:
            if is_silent and link.dispensable and _can_drop(j, t_ns, site, links):
                link.gone = -1.0
                site.regrouped = _DROPPED
        elif is_silent:
            link.gone = -1.0
        elif is_lost:
            link.gone = float(t_ns)
        elif t_ns - link.gone >= BACK_NS and _is_near(j, site, links):
            link.gone = 0.0
            site.regrouped = _RESTORED

    # A change of the shares may give all of them to lost peers. In that case, no peer is
    # treated as lost.
    if not _redistribute_shares(links):
        for j in range(links.shape[0]):
            link = links[j]
            link.gone = 0.0

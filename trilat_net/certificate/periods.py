"""The periods between ticks: a smooth way, then a jump at its end.

Law: at the end of a period e is first where the smooth way leads, and then where the record says; the
difference is parted among those who made it: the links, a change of the shares, the rule for stale peers.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .equations import Equations
from .shares import Shares
from .track import Bools, Track
from .views import View


class Booked(NamedTuple):
    """An amount of energy per period, J: what its two ends give to an integral, and a jump at its end.

    Attributes:
        left: of the trapezoid rule, at the beginning, shape (K - 1,).
        right: of the trapezoid rule, before the jump, shape (K - 1,).
        jump: at the end, shape (K - 1,).
    """

    left: Array
    right: Array
    jump: Array

    @property
    def total(self) -> Array:
        """The amount of every period, shape (K - 1,), J."""
        total: Array = self.left + self.right + self.jump
        return total


def smooth(h_s: float, left: Array, right: Array) -> Booked:
    """Returns the integral of a power, W, over every period by the trapezoid rule."""
    return Booked(0.5 * h_s * left, 0.5 * h_s * right, np.zeros(len(left)))


def jumps(amount: Array) -> Booked:
    """Returns amounts that come at once."""
    nothing = np.zeros(len(amount))
    return Booked(nothing, nothing, amount)


class Periods(NamedTuple):
    """The ends of every period, K - 1 rows; `right` is before the jump.

    Attributes:
        following: whether the site followed its peers at both ends.
        link: per peer the jump of e by the age of its sample, shape (P, K - 1, 2), rad.
        shares: the jump of e by a sudden change of shares, shape (K - 1, 2), rad.
        rule: the jump of e by the rule for stale peers, shape (K - 1, 2), rad.
        r_left: r = qd + Lambda e, shape (K - 1, 2), rad/s.
        r_right: shape (K - 1, 2), rad/s.
        r_middle: half-way through the jump, shape (K - 1, 2), rad/s.
        e_middle: half-way through the jump, shape (K - 1, 2), rad.
        qd_des_left: shape (K - 1, 2), rad/s.
        qd_des_right: shape (K - 1, 2), rad/s.
    """

    following: Bools
    link: Array
    shares: Array
    rule: Array
    r_left: Array
    r_right: Array
    r_middle: Array
    e_middle: Array
    qd_des_left: Array
    qd_des_right: Array


def periods(track: Track, eq: Equations, shares: Shares, views: list[View]) -> Periods:
    """Returns the periods of a site.

    While it follows its peers, the smooth way of its reference is Eq. (6) with every stamp moving at rate
    one. Otherwise that is a matter of the rule: the trapezoid rule on the recorded derivative.

    Args:
        track: the site's records.
        eq: its constants.
        shares: its shares in its peers.
        views: what it sees of them, in the same order.
    """
    following = track.follows[:-1] & track.follows[1:]
    here = following[:, np.newaxis]
    before, after, rate = (x[:, :, np.newaxis] for x in (shares.before, shares.alpha[1:], shares.rate[:-1]))
    link = np.array(
        [np.where(here, before[:, j] * (v.kept.q - v.seen.q[1:]), 0.0) for j, v in enumerate(views)]
    )
    sudden = np.sum([(before[:, j] - after[:, j]) * v.seen.q[1:] for j, v in enumerate(views)], axis=0)
    follow = track.follows[:-1, np.newaxis]
    kept_qd = np.sum([before[:, j] * v.kept.qd + rate[:, j] * v.kept.q for j, v in enumerate(views)], axis=0)
    kept_q = np.sum([before[:, j] * v.kept.q for j, v in enumerate(views)], axis=0)
    qd_des_left, qd_des_right = track.qd_des[:-1], np.where(follow, kept_qd, track.qd_des[1:])
    way = track.q_des[:-1] + 0.5 * track.h_s * (qd_des_left + qd_des_right)
    rule = np.where(here, 0.0, np.where(follow, kept_q, way) - track.q_des[1:])
    sudden = np.where(here, sudden, 0.0)
    jump = link.sum(axis=0) + sudden + rule
    r, e_middle = track.qd + eq.Lambda * track.e, track.e[1:] - 0.5 * jump
    r_right, r_middle = r[1:] - eq.Lambda * jump, r[1:] - 0.5 * eq.Lambda * jump
    moved = (link, sudden, rule)
    return Periods(following, *moved, r[:-1], r_right, r_middle, e_middle, qd_des_left, qd_des_right)

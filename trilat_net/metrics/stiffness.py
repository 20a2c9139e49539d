"""The stiffness that a hand feels at rest: what its arm, the links and all that they meet add up to.

Law: the change of a joint's torque from one window at rest to the next over the change of its angle, where
that hand moved and nobody else did, and no share changed: where others move, the ratio is the hand's own.
Walls and hands that stand still are part of what is felt. It is of the way that was gone: the other joint
moved as well.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..core.arm import JOINTS
from .rest import Rest

LEAST_NM = 0.1
"""Least change of a torque that shows a stiffness, N m."""
LEAST_RAD = 1e-4
"""Least change of an angle, rad."""
STILL_NM = 1e-6
"""A hand whose script changed by less stood still, N m."""


class Stiffness(NamedTuple):
    """What a hand felt from one window at rest to the next.

    Attributes:
        from_s: the end of the first window, s.
        to_s: the end of the second one, s.
        site: whose hand.
        joint: which joint, from 1.
        torque_nm: by how much more the hand pushes its arm, N m.
        angle_rad: by how much further the joint is, rad.
        stiffness_nm_rad: their ratio, N m/rad; None where the joint did not move: too stiff to tell.
    """

    from_s: float
    to_s: float
    site: str
    joint: int
    torque_nm: float
    angle_rad: float
    stiffness_nm_rad: float | None


def stiffnesses(windows: list[Rest]) -> list[Stiffness]:
    """Returns what a hand felt between windows at rest between which it moved alone."""
    found = []
    for before, after in pairwise(windows):
        moved = _moved(before, after)
        if moved is None or len(moved) != 1 or (before.alpha != after.alpha).any():
            continue
        site = moved[0]
        hands = [window.torque[site] - window.walls[site] for window in (before, after)]
        more, further = hands[1] - hands[0], after.q[site] - before.q[site]
        for joint in range(JOINTS):
            torque, angle = float(more[joint]), float(further[joint])
            if abs(torque) >= LEAST_NM:
                K = torque / angle if abs(angle) >= LEAST_RAD else None
                found.append(Stiffness(before.to_s, after.to_s, site, joint + 1, torque, angle, K))
    return found


def _moved(before: Rest, after: Rest) -> list[str] | None:
    """Returns whose hands moved; None where it is not known of all."""
    moved = []
    for site, now in after.script.items():
        then = before.script[site]
        if now is None or then is None:
            return None
        if np.abs(now - then).max() > STILL_NM:
            moved.append(site)
    return moved

"""What hands feel over frequency: the impedance of their site, and the force of walls at other sites.

Law: `felt.ratio` decides what can be told, and a pair that nobody drove is named with the reason. An
impedance is driven by the script of the hand that feels it: the ratio of torque to velocity alone would be
the hand's own wherever something else moves the arm. A reflection is driven by the wall, while no hand moves.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ..certificate.track import Bools, Track
from ..core.arm import JOINTS
from .felt import Ratio, Signals, ratio
from .pushing import Pushed
from .tracking import latest

LEAST_NM = 0.05
"""Least amplitude of a torque that drives, N m."""
STILL_NM_S = 1e-6
"""A script that changes by less stands still, N m/s."""
UNTOLD = "what the hand was to do is not in the scenario: nobody knows who drives"


class Felt(NamedTuple):
    """A ratio over frequency.

    Attributes:
        kind: "impedance": torque of a hand ON its arm over the velocity of the joint: what it feels of its
            site and of all behind it, N m s/rad. "reflection": torque that a hand feels over the one that
            walls do ON another arm.
        at: the site whose hand feels it.
        of: of a reflection the site of the walls, else "".
        joint: which joint, from 1.
        ratio: the ratio.
    """

    kind: str
    at: str
    of: str
    joint: int
    ratio: Ratio

    @property
    def unit(self) -> str:
        """The unit of the gain."""
        return "" if self.kind == "reflection" else "N m s/rad"


def felt(found: Mapping[str, Track], by: Mapping[str, Pushed]) -> list[Felt]:
    """Returns what every hand feels over frequency of its site, and of every wall elsewhere.

    Args:
        found: the sites' records.
        by: who pushed them.
    """
    hands = [site for site in found if by[site].by_hand.any()]
    walls = [site for site in found if by[site].by_wall.any()]
    return [
        *(one for site in hands for one in _impedance(found, by, site)),
        *(
            one
            for wall in walls
            for hand in hands
            if hand != wall
            for one in _reflection(found, by, wall, hand)
        ),
    ]


def _impedance(found: Mapping[str, Track], by: Mapping[str, Pushed], site: str) -> Iterator[Felt]:
    track, script = found[site], by[site].script
    others = _still(found, by, track, [name for name in found if name != site])
    for joint in range(JOINTS):
        told = Ratio(why=UNTOLD)
        if script is not None and others is not None:
            torque = by[site].by_hand[:, joint]
            signals = Signals(script[:, joint], track.qd[:, joint], torque, track.known & others)
            told = ratio(signals, track.rate_hz, LEAST_NM)
        yield Felt("impedance", site, "", joint + 1, told)


def _reflection(found: Mapping[str, Track], by: Mapping[str, Pushed], wall: str, hand: str) -> Iterator[Felt]:
    track = found[hand]
    row, there = latest(found[wall], track.t_s)
    nobody = _still(found, by, track, list(found))
    for joint in range(JOINTS):
        told = Ratio(why=UNTOLD)
        if nobody is not None:
            torque = by[wall].by_wall[row, joint]
            signals = Signals(torque, torque, -by[hand].by_hand[:, joint], track.known & there & nobody)
            told = ratio(signals, track.rate_hz, LEAST_NM)
        yield Felt("reflection", hand, wall, joint + 1, told)


def _still(found: Mapping[str, Track], by: Mapping[str, Pushed], at: Track, sites: list[str]) -> Bools | None:
    """Returns at which ticks of a site no hand of some sites moves, shape (K,); None where nobody knows."""
    still = np.ones(len(at.known), dtype=np.bool_)
    for site in sites:
        script = by[site].script
        if script is None:
            return None
        rows, _ = latest(found[site], at.t_s)
        rate = (
            np.abs(np.gradient(script, axis=0)).max(axis=1) * found[site].rate_hz if len(script) > 1 else None
        )
        if rate is not None:
            still &= rate[rows] < STILL_NM_S
    return still

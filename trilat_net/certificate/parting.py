"""Who pushed an arm, over all of its rows at once: hands and environment, apart.

Law: what a scenario cannot tell apart is the hands': the record's torque less that of the environment.
"""

from typing import NamedTuple

import numpy as np

from ..analysis.actors import Tip, tip_of, torque_of
from ..core.arm import Array
from ..core.exogenous import Actor
from ..scenario import SiteSpec
from .track import Track


class Parted(NamedTuple):
    """The torque ON an arm over its rows, shape (K, 2) each, N m; `held` is computed once a tick and held.

    Attributes:
        tip: where the arm's tip was.
        hands: of the hands, a function of the present.
        hands_held: of the hands, held.
        walls: of the environment, a function of the present.
        walls_held: of the environment, held.
    """

    tip: Tip
    hands: Array
    hands_held: Array
    walls: Array
    walls_held: Array


def parted(track: Track, spec: SiteSpec) -> Parted:
    """Returns the torque on an arm, parted into hands and environment, held and not.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.
    """
    tip = tip_of((spec.arm.l1_m, spec.arm.l2_m), track.q, track.qd)
    t_s = track.nominal_s

    def together(actors: list[Actor]) -> Array:
        total = np.zeros_like(track.q)
        for actor in actors:
            total = total + torque_of(actor, t_s, track.q, track.qd, tip)
        return total

    around = [one.actor for one in spec.environment]
    walls = together([actor for actor in around if not actor.sampled])
    walls_held = together([actor for actor in around if actor.sampled])
    hands_held = together([one.actor for one in spec.hands if one.actor.sampled])
    # what is left of the record is the hands', also where nobody has written down whose it was
    hands = -track.tau_x - walls - walls_held - hands_held
    return Parted(tip, hands, hands_held, walls, walls_held)

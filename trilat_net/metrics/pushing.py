"""Who pushed an arm, and what the hands were to do, over all of its rows at once.

Law: a hand has a script only where its torque is what the scenario says.
"""

from typing import NamedTuple

import numpy as np

from ..analysis.actors import spring_of, torque_of
from ..certificate.parting import Parted, parted
from ..certificate.track import Track
from ..core.arm import JOINTS, Array
from ..core.exogenous import Actor, Acts
from ..scenario import SiteSpec

ALIKE = 1e-8
"""Relative difference up to which a torque is what the scenario says."""


def script_of(actor: Actor, t_s: Array, J: Array) -> Array:
    """Returns what a hand is to do, whatever the arm does, shape (K, 2), N m.

    A pulse or a recorded torque itself; of a spring K times the way of its target and B times its speed, one
    in the plane by the Jacobian of one pose. It moves where, and only where, the operator does.

    Args:
        actor: the hand.
        t_s: shape (K,), s.
        J: Jacobian of the tip, shape (2, 2).
    """
    nowhere = np.zeros((len(t_s), JOINTS))
    if actor.acts is Acts.PULSE:
        x = np.clip((t_s - actor.start_s) / (actor.end_s - actor.start_s), 0.0, 1.0)
        intent = np.sin(np.pi * x)[:, None] ** 2 * np.array(actor.a)
    elif actor.acts is Acts.RECORDED and actor.table is not None:
        at_s, rows = actor.table[:, 0], actor.table[:, 1:]
        columns = [np.interp(t_s, at_s, column, left=0.0, right=0.0) for column in rows.T]
        intent = np.stack(columns, axis=1)
    else:
        pull = spring_of(actor, t_s, nowhere, nowhere)
        intent = pull @ J if actor.acts is Acts.TASK_HAND else pull
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    script: Array = np.where(there[:, None], intent, 0.0)
    return script


class Pushed(NamedTuple):
    """The torque ON an arm, and what was meant by it.

    Attributes:
        parts: the torque, parted; without hands there is none of them, not what rounding leaves.
        script: what the hands were to do, whatever the arm does, see `script_of`; None where they did
            something else than the scenario says.
    """

    parts: Parted
    script: Array | None

    @property
    def by_hand(self) -> Array:
        """What all hands do, shape (K, 2), N m."""
        return self.parts.hands + self.parts.hands_held

    @property
    def by_wall(self) -> Array:
        """What all of the environment does, shape (K, 2), N m."""
        return self.parts.walls + self.parts.walls_held


def pushed(track: Track, spec: SiteSpec) -> Pushed:
    """Returns the torque on an arm, parted into hands and environment, with the script of the hands.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.
    """
    who, t_s = parted(track, spec), track.nominal_s
    hands, rest = [one.actor for one in spec.hands], who.hands.copy()
    scripts = [script_of(actor, t_s, who.tip.J[0]) for actor in hands]
    told = sum(
        (
            script
            if actor.acts in (Acts.PULSE, Acts.RECORDED)
            else torque_of(actor, t_s, track.q, track.qd, who.tip)
            for actor, script in zip(hands, scripts, strict=True)
            if not actor.sampled
        ),
        np.zeros_like(track.q),
    )
    as_told = np.abs(rest - told) <= ALIKE * (1.0 + np.abs(track.tau_x))
    if not hands:  # what rounding leaves of nobody
        rest[as_told] = 0.0
    script = sum(scripts, np.zeros_like(track.q)) if as_told[track.known].all() else None
    return Pushed(who._replace(hands=rest), script)

"""Splits the torque on an arm into operator and environment, over all of its rows at once.

Invariant: a torque that the scenario does not explain is the operator's: the record's torque less the
environment's. An operator has a script only if its torque matches the scenario.
"""

from typing import NamedTuple

import numpy as np

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.two_link_arm import JOINTS
from ..core.vectors import Array
from ..scenario import SiteSpec
from .aligned import AlignedRecords
from .arm_rows import EndEffectorRows, compute_end_effector
from .torque_sources import compute_source_torque, compute_spring_effort


class TorqueSplit(NamedTuple):
    """The torque ON an arm over its rows, shape (K, 2) each, N m; `held` is computed once a tick and held.

    Attributes:
        tip: where the arm's tip was.
        hands: of the hands, a function of the present.
        hands_held: of the hands, held.
        walls: of the environment, a function of the present.
        walls_held: of the environment, held.
    """

    tip: EndEffectorRows
    hands: Array
    hands_held: Array
    walls: Array
    walls_held: Array


def split_torque(track: AlignedRecords, spec: SiteSpec) -> TorqueSplit:
    """Returns the torque on an arm, parted into hands and environment, held and not.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.
    """
    tip = compute_end_effector((spec.arm.l1_m, spec.arm.l2_m), track.q, track.qd)
    t_s = track.nominal_s

    def together(actors: list[TorqueSource]) -> Array:
        total = np.zeros_like(track.q)
        for actor in actors:
            total = total + compute_source_torque(actor, t_s, track.q, track.qd, tip)
        return total

    around = [one.actor for one in spec.environment]
    walls = together([actor for actor in around if not actor.sampled])
    walls_held = together([actor for actor in around if actor.sampled])
    hands_held = together([one.actor for one in spec.hands if one.actor.sampled])
    # what is left of the record is the hands', also where nobody has written down whose it was
    hands = -track.tau_x - walls - walls_held - hands_held
    return TorqueSplit(tip, hands, hands_held, walls, walls_held)


SCRIPT_TORQUE_TOLERANCE = 1e-8
"""Relative difference up to which a torque is what the scenario says."""


def compute_operator_script(actor: TorqueSource, t_s: Array, J: Array) -> Array:
    """Returns what a hand is to do, whatever the arm does, shape (K, 2), N m.

    A pulse or a recorded torque itself; of a spring K times the way of its target and B times its speed, one
    in the plane by the Jacobian of one pose. It moves where, and only where, the operator does.

    Args:
        actor: the hand.
        t_s: shape (K,), s.
        J: Jacobian of the tip, shape (2, 2).
    """
    nowhere = np.zeros((len(t_s), JOINTS))
    if actor.acts is TorqueKind.PULSE:
        x = np.clip((t_s - actor.start_s) / (actor.end_s - actor.start_s), 0.0, 1.0)
        intent = np.sin(np.pi * x)[:, None] ** 2 * np.array(actor.a)
    elif actor.acts is TorqueKind.RECORDED and actor.table is not None:
        at_s, rows = actor.table[:, 0], actor.table[:, 1:]
        columns = [np.interp(t_s, at_s, column, left=0.0, right=0.0) for column in rows.T]
        intent = np.stack(columns, axis=1)
    else:
        pull = compute_spring_effort(actor, t_s, nowhere, nowhere)
        intent = pull @ J if actor.acts is TorqueKind.TASK_HAND else pull
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    script: Array = np.where(there[:, None], intent, 0.0)
    return script


class TorqueAttribution(NamedTuple):
    """The torque ON an arm, and what was meant by it.

    Attributes:
        parts: the torque, parted; without hands there is none of them, not what rounding leaves.
        script: what the hands were to do, whatever the arm does, see `script_of`; None where they did
            something else than the scenario says.
    """

    parts: TorqueSplit
    script: Array | None

    @property
    def by_hand(self) -> Array:
        """What all hands do, shape (K, 2), N m."""
        return self.parts.hands + self.parts.hands_held

    @property
    def by_wall(self) -> Array:
        """What all of the environment does, shape (K, 2), N m."""
        return self.parts.walls + self.parts.walls_held


def attribute_torque(track: AlignedRecords, spec: SiteSpec) -> TorqueAttribution:
    """Returns the torque on an arm, parted into hands and environment, with the script of the hands.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.
    """
    who, t_s = split_torque(track, spec), track.nominal_s
    hands, rest = [one.actor for one in spec.hands], who.hands.copy()
    scripts = [compute_operator_script(actor, t_s, who.tip.J[0]) for actor in hands]
    told = sum(
        (
            script
            if actor.acts in (TorqueKind.PULSE, TorqueKind.RECORDED)
            else compute_source_torque(actor, t_s, track.q, track.qd, who.tip)
            for actor, script in zip(hands, scripts, strict=True)
            if not actor.sampled
        ),
        np.zeros_like(track.q),
    )
    as_told = np.abs(rest - told) <= SCRIPT_TORQUE_TOLERANCE * (1.0 + np.abs(track.tau_x))
    if not hands:  # what rounding leaves of nobody
        rest[as_told] = 0.0
    script = sum(scripts, np.zeros_like(track.q)) if as_told[track.known].all() else None
    return TorqueAttribution(who._replace(hands=rest), script)

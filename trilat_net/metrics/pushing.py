"""What hands and environments do to an arm, over all of its rows at once.

Law: written from the definitions of `scenario.actors`, and held against the records by the tests. What a
scenario cannot tell apart is the hands': the record's torque less that of the environment.
"""

from typing import NamedTuple

import numpy as np

from ..certificate.track import Track
from ..core.arm import JOINTS, Array
from ..core.exogenous import Actor, Acts
from ..scenario import SiteSpec
from .rows import nominal_s

ALIKE = 1e-8
"""Relative difference up to which a torque is what the scenario says."""


class Tip(NamedTuple):
    """Where the tip is and how fast, and how it moves with the joints.

    Attributes:
        at: shape (K, 2), m.
        speed: shape (K, 2), m/s.
        J: its Jacobian, shape (K, 2, 2), m/rad: rows x and y, columns the joints.
    """

    at: Array
    speed: Array
    J: Array


def tip_of(lengths: tuple[float, float], q: Array, qd: Array) -> Tip:
    """Returns the tip of an arm.

    Args:
        lengths: of the two links, m.
        q: joint angles, shape (K, 2), rad.
        qd: joint velocities, shape (K, 2), rad/s.
    """
    inner, outer = q[:, 0], q[:, 0] + q[:, 1]
    elbow = lengths[0] * np.stack([np.cos(inner), np.sin(inner)], axis=1)
    reach = lengths[1] * np.stack([np.cos(outer), np.sin(outer)], axis=1)
    at = elbow + reach
    J = np.empty((len(q), 2, JOINTS))
    J[:, 0, 0], J[:, 1, 0] = -at[:, 1], at[:, 0]
    J[:, 0, 1], J[:, 1, 1] = -reach[:, 1], reach[:, 0]
    return Tip(at, np.einsum("kij,kj->ki", J, qd), J)


def wall_depth(actor: Actor, tip: Tip) -> Array:
    """Returns how deep a tip is in a wall, shape (K,), m; negative outside of it."""
    depth: Array = (np.array(actor.a) - tip.at) @ np.array(actor.b)
    return depth


def wall_force(actor: Actor, t_s: Array, tip: Tip) -> Array:
    """Returns the force of a wall along its normal, shape (K,), N: it pushes, and never pulls.

    max(K depth - B outward speed, 0) inside of it, 0 outside, and while it is not there.
    """
    depth = wall_depth(actor, tip)
    push = np.maximum(actor.K[0] * depth - actor.B[0] * (tip.speed @ np.array(actor.b)), 0.0)
    there = (t_s >= actor.start_s) & (t_s < actor.end_s) & (depth > 0.0)
    force: Array = np.where(there, push, 0.0)
    return force


def _way(actor: Actor, t_s: Array) -> tuple[Array, Array]:
    """Returns the share of its way that a target has made, and the rate of that, 1/s: minimum jerk."""
    span_s = actor.move_end_s - actor.move_start_s
    if span_s <= 0.0:
        return (t_s > actor.move_start_s).astype(np.float64), np.zeros(len(t_s))
    x = np.clip((t_s - actor.move_start_s) / span_s, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x**2 * (1.0 - x) ** 2 / span_s


def _spring(actor: Actor, t_s: Array, at: Array, speed: Array) -> Array:
    share, rate = _way(actor, t_s)
    a, way = np.array(actor.a), np.array(actor.b) - np.array(actor.a)
    pull = np.array(actor.K) * (a + share[:, None] * way - at)
    force: Array = pull + np.array(actor.B) * (rate[:, None] * way - speed)
    return force


def torque_of(actor: Actor, t_s: Array, q: Array, qd: Array, tip: Tip) -> Array:
    """Returns what one actor does to the joints, shape (K, 2), N m, ON the arm.

    Springs, dampers and walls: what is a function of the state. Pulses and recorded torques are not.

    Raises:
        ValueError: it acts in another way.
    """
    if actor.acts is Acts.WALL:
        force = wall_force(actor, t_s, tip)[:, None] * np.array(actor.b)
        pushed = np.einsum("kij,ki->kj", tip.J, force)
    elif actor.acts is Acts.VISCOUS:
        pushed = -np.array(actor.B) * qd
    elif actor.acts is Acts.HAND:
        pushed = _spring(actor, t_s, q, qd)
    elif actor.acts is Acts.TASK_HAND:
        pushed = np.einsum("kij,ki->kj", tip.J, _spring(actor, t_s, tip.at, tip.speed))
    else:
        raise ValueError(f"{actor.acts.name} is no function of the state")
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    torque: Array = np.where(there[:, None], pushed, 0.0)
    return torque


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
        pull = _spring(actor, t_s, nowhere, nowhere)
        intent = pull @ J if actor.acts is Acts.TASK_HAND else pull
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    script: Array = np.where(there[:, None], intent, 0.0)
    return script


class Pushed(NamedTuple):
    """The torque ON an arm, shape (K, 2) each, N m; `held` is what is computed once a tick and held.

    Attributes:
        tip: where the arm's tip was.
        hands: of the hands, a function of the present.
        hands_held: of the hands, held.
        walls: of the environment, a function of the present.
        walls_held: of the environment, held.
        script: what the hands were to do, whatever the arm does, see `script_of`; None where they did
            something else than the scenario says.
    """

    tip: Tip
    hands: Array
    hands_held: Array
    walls: Array
    walls_held: Array
    script: Array | None

    @property
    def by_hand(self) -> Array:
        """What all hands do, shape (K, 2), N m."""
        return self.hands + self.hands_held

    @property
    def by_wall(self) -> Array:
        """What all of the environment does, shape (K, 2), N m."""
        return self.walls + self.walls_held


def pushed(track: Track, spec: SiteSpec) -> Pushed:
    """Returns the torque on an arm, parted into hands and environment, held and not.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.
    """
    tip = tip_of((spec.arm.l1_m, spec.arm.l2_m), track.q, track.qd)
    t_s = nominal_s(track)

    def together(actors: list[Actor]) -> Array:
        total = np.zeros_like(track.q)
        for actor in actors:
            total = total + torque_of(actor, t_s, track.q, track.qd, tip)
        return total

    around, hands = [one.actor for one in spec.environment], [one.actor for one in spec.hands]
    walls = together([actor for actor in around if not actor.sampled])
    walls_held = together([actor for actor in around if actor.sampled])
    hands_held = together([actor for actor in hands if actor.sampled])
    rest = -track.tau_x - walls - walls_held - hands_held
    scripts = [script_of(actor, t_s, tip.J[0]) for actor in hands]
    told = sum(
        (
            script
            if actor.acts in (Acts.PULSE, Acts.RECORDED)
            else torque_of(actor, t_s, track.q, track.qd, tip)
            for actor, script in zip(hands, scripts, strict=True)
            if not actor.sampled
        ),
        np.zeros_like(track.q),
    )
    as_told = np.abs(rest - told) <= ALIKE * (1.0 + np.abs(track.tau_x))
    if not hands:  # what rounding leaves of nobody
        rest[as_told] = 0.0
    script = sum(scripts, np.zeros_like(track.q)) if as_told[track.known].all() else None
    return Pushed(tip, rest, hands_held, walls, walls_held, script)

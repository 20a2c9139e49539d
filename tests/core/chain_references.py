"""Chains with their dynamics as computed by Pinocchio (`chain_references.json`) and by the
leaves of the core.

`make_chain_references.py` writes the file; reading needs nothing but the file.
"""

import functools
import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import trilat_net
from trilat_net.core.arms.chain import (
    inverse_dynamics,
    mass_matrix,
    place_joints,
    propagate_motion,
)
from trilat_net.core.step.vectors import RowArray
from trilat_net.scenario.urdf import UrdfChain, UrdfJoint

Array = NDArray[np.float64]

PATH = Path(__file__).with_name("chain_references.json")
ARMS = Path(trilat_net.__file__).with_name("scenarios")


class ChainState(NamedTuple):
    """The state of a chain with Pinocchio's results; frames and units of `UrdfJoint`.

    Velocity terms use Christoffel symbols, so that Mdot - 2C is skew.
    """

    gravity: Array
    """In the base's axes, m/s^2."""
    q: Array
    qd: Array
    v: Array
    a: Array
    r: Array
    tau: Array
    inverse_dynamics: Array
    """M(q) a + C(q, qd) v + G(q)."""
    regressor_transpose_r: Array
    """Y(q, qd, v, a)' r, ten numbers a joint."""
    forward_dynamics: Array
    """Accelerations under tau."""
    inertia: Array
    """M(q)."""
    tip_position: Array
    """Of the end link in the base."""
    tip_rotation: Array
    jacobian: Array
    """Of the end link's origin in the base's axes, (6, n): three linear rows, then three angular ones."""


class ChainReference(NamedTuple):
    """A chain and its states."""

    chain: UrdfChain
    states: list[ChainState]


@functools.cache
def chain_references() -> dict[str, ChainReference]:
    """Returns chains by name: random1, random2, random3, arm6, arm7, random12."""
    return {
        name: ChainReference(
            to_chain(entry),
            [
                ChainState(**{key: np.array(value) for key, value in state.items()})
                for state in entry["states"]
            ],
        )
        for name, entry in json.loads(PATH.read_text())["chains"].items()
    }


def to_chain(entry: dict) -> UrdfChain:
    """Returns a chain from plain numbers, without limits and friction."""
    joints = [
        UrdfJoint(
            joint["name"],
            joint["link"],
            joint["kind"],
            tuple(joint["axis"]),
            _rows(joint["rotation"]),
            tuple(joint["origin_m"]),
            tuple(joint["inertia"]),
            -math.inf,
            math.inf,
            math.inf,
            math.inf,
            0.0,
            0.0,
        )
        for joint in entry["joints"]
    ]
    tip_rotation = _rows(entry["tip_rotation"])
    tip_origin_m = tuple(entry["tip_origin_m"])
    return UrdfChain("base", "tip", tuple(joints), tip_rotation, tip_origin_m, ())


def _rows(matrix: list) -> tuple:
    return tuple(map(tuple, matrix))


class Arm(NamedTuple):
    """A chain's rows, of one layout for all lengths, and its parameters."""

    rows: RowArray
    theta: Array


def propagate_state(arm: Arm, state: ChainState, v: Array) -> None:
    """Places the rows of an arm in a state, and propagates the motion with v."""
    place_joints(arm.rows, state.q)
    propagate_motion(arm.rows, state.gravity, state.qd, v, state.a)


def torque_for(arm: Arm, v: Array, a: Array) -> Array:
    """Returns the torque of inverse dynamics for v and a."""
    torque = np.zeros(len(arm.rows))
    inverse_dynamics(arm.rows, arm.theta, v, a, torque)
    return torque


def full_matrix(arm: Arm) -> Array:
    """Returns M; the leaf fills only its lower half."""
    mass_matrix(arm.rows, arm.theta)
    n = len(arm.rows)
    lower = np.tril(arm.rows["M"][:, :n])
    return lower + np.tril(lower, -1).T


def find_largest_difference(actual: Array, expected: Array) -> float:
    """Returns the largest difference, relative to the largest expected number above 1."""
    return float(np.abs(actual - expected).max() / max(1.0, np.abs(expected).max()))

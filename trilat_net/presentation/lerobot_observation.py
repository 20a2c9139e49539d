"""Computes from a log the observations that the LeRobot plugin provides in a live session.

The plugin `lerobot_robot_trilat` moves the arm of one user. It observes the slave, the arm of
the user, and the operator model that moves this arm. A program trained with the observations
computed here can therefore act through the plugin.

Invariant:
    - The names and their order match `observation_features` of the plugin. A test compares the
      two.
    - Angles are in rad, velocities in rad/s, torques in N m, positions in m, and forces in N.
"""

from collections.abc import Mapping

import numpy as np

from ..analysis import build_arm_rows
from ..core import Array, TorqueSource
from ..errors import UsageError
from ..log import Ints, Log
from ..scenario import TASK_AXES

_HAND_ACTIONS = {"tip": "tip", "joint": "joints"}
"""Kind of exported actions that an operator accepts as commands, keyed by operator mode."""


def _find_plugin_hand(log: Log, site: str) -> tuple[str, TorqueSource]:
    """Finds the operator model through which a plugin's program moves an arm.

    Args:
        log: Log of the run.
        site: Name of the site.

    Returns:
        The mode of the operator: "tip", "joint" or "force". The torque source of the operator,
        which has its stiffness, damping and limit.

    Raises:
        UsageError: The scenario does not allow a program to move the arm of this site.
    """
    hand = log.scenario.sites[site].find_live_hand()
    if hand is None:
        raise UsageError(
            f"{log.source}: observations=plugin needs an operator of kind 'live' or 'own' at "
            f"{site}, which the scenario does not have; choose another user by site=NAME, or "
            "leave observations out"
        )
    return hand.mode, hand.actor


def find_plugin_actions(log: Log, site: str) -> str:
    """Returns the kind of actions to use when exporting a log for the LeRobot plugin.

    Depending on the operator, the actions are positions of the end effector ("tip") or joint
    angles ("joints"). A dataset for training must contain the actions that the operator
    accepts.

    Args:
        log: Log of the run.
        site: Name of the site whose arm the plugin moves.

    Raises:
        UsageError: The operator moves the arm by commanding forces, which are not exported.
    """
    mode, _ = _find_plugin_hand(log, site)
    if mode not in _HAND_ACTIONS:
        raise UsageError(
            f"{log.source}: the operator of {site} is commanded by forces, which are not "
            "exported; set actions to tip or joints"
        )
    return _HAND_ACTIONS[mode]


def observe_as_plugin(
    log: Log, slave: str, site: str, rows: Mapping[str, Ints]
) -> tuple[Array, list[str]]:
    """Returns the observations that the LeRobot plugin would make in every frame of a log.

    A policy can therefore be trained on logs and later run through the plugin.

    Args:
        log: Log of the run.
        slave: Name of the slave.
        site: Name of the site whose arm the plugin moves.
        rows: For each site, the record index of each frame, shape (F,).

    Returns:
        The observations, shape (F, n), and the names of the n components.

    Raises:
        UsageError: The scenario does not allow a program to move the arm of this site.
    """
    mode, source = _find_plugin_hand(log, site)
    columns: list[Array] = []
    names: list[str] = []
    for observed_site in (slave, site):
        records = log[observed_site]
        site_rows = rows[observed_site]
        joints = log.scenario.arms[observed_site].joint_names
        quantities = {
            "pos": records.q,
            "vel": records.qd,
            "tau_x": records.tau_x,
        }
        for quantity, numbers in quantities.items():
            columns.append(numbers[site_rows])
            names += [f"{observed_site}.{joint}.{quantity}" for joint in joints]

    # The coordinates in which the operator moves the arm: joints, or the end effector.
    records = log[site]
    site_rows = rows[site]
    pose = records.q[site_rows]
    pose_rate = records.qd[site_rows]
    axes = tuple(log.scenario.arms[site].joint_names)
    if mode != "joint":
        arm_rows = build_arm_rows(log.scenario, site)
        end_effector = arm_rows.place_end_effector(pose, pose_rate)
        pose = end_effector.position
        pose_rate = end_effector.speed
        axes = TASK_AXES[: pose.shape[1]]

    force = _compute_pull(mode, source, records.hand[site_rows], pose, pose_rate)
    # The operator feels the reaction of the force that moves the arm.
    columns += [pose, -force]
    names += [f"{axis}.pos" for axis in axes]
    names += [f"{axis}.felt" for axis in axes]
    return np.hstack(columns), names


def _compute_pull(
    mode: str, source: TorqueSource, vectors: Array, pose: Array, pose_rate: Array
) -> Array:
    """Computes the force of an operator model on its arm, as `Hand.force` does in a session.

    The operator is modelled as a spring and damper that pulls the arm towards a target. With
    stiffness K and damping B, the force is

        F = K (target - pose) + B (target rate - pose rate)

    The norm of F is limited, and F is multiplied by the grip, a number from 0 to 1.

    Args:
        mode: Mode of the operator.
        source: Torque source of the operator.
        vectors: Field `hand` of the records (`HandInForce`), shape (F, 3 + 2 n).
        pose: Pose of the arm in the coordinates of the operator, shape (F, n).
        pose_rate: Time derivative of the pose, shape (F, n).

    Returns:
        The force in N, or in mode `joint` the torques in N m, shape (F, n).
    """
    coordinate_count = pose.shape[1]
    grip = vectors[:, :1]
    target = vectors[:, 3 : 3 + coordinate_count]
    target_rate = vectors[:, 3 + coordinate_count :]

    unlimited_force = target  # in mode `force`, the target is the force itself
    if mode != "force":
        stiffness = np.array(source.K)
        damping = np.array(source.B)
        spring_force = stiffness * (target - pose)
        damper_force = damping * (target_rate - pose_rate)
        unlimited_force = spring_force + damper_force

    magnitude = np.linalg.norm(unlimited_force, axis=1, keepdims=True)
    is_above_limit = magnitude > source.limit
    scale = np.divide(
        source.limit, magnitude, out=np.ones_like(magnitude), where=is_above_limit
    )
    force: Array = grip * scale * unlimited_force
    return force

"""Static windows of a run, with all arms at rest under constant torques, and the stiffness between two.

Invariant: docs/metrics.md defines both. A stiffness is the operator's own, and is not given, if anything but
that operator changed. It is a secant along the path taken: the other joint moves as well.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...log.record_columns import Ints
from ..aligned import AlignedRecords, find_latest_rows
from ..dominance_history import DominanceHistory
from ..run_end import STATIC_SPEED_RAD_S
from ..torque_split import TorqueSplit

WINDOW_S = 1.0
"""Length of a window, s; an interval must be as long."""
MAX_TORQUE_VARIATION = 0.01
"""Largest variation of a torque in a window, as a share of the largest one there."""
MIN_LOAD_NM = 0.05
"""Smaller torques are no load, N m."""
MOVING_SCRIPT_NM = 1e-9
"""A script that changes by more from tick to tick moves, N m."""
MIN_TORQUE_CHANGE_NM = 0.1
"""Least change of a torque that shows a stiffness, N m."""
MIN_ANGLE_CHANGE_RAD = 1e-4
"""Least change of an angle, rad."""
STILL_SCRIPT_NM = 1e-6
"""An operator whose script changed by no more between windows stood still, N m."""


class StaticWindow(NamedTuple):
    """A static window, from its first tick to its last; per site means over it, shape (2,).

    Attributes:
        torque, environment: of operator and environment ON the arm, and of the environment alone, N m.
        script: the operator's script, N m; None if unknown.
        q: the joint angles, rad.
        alpha: the dominance matrix, shape (N, N).
    """

    from_s: float
    to_s: float
    torque: dict[str, Array]
    environment: dict[str, Array]
    script: dict[str, Array | None]
    q: dict[str, Array]
    alpha: Array


def find_static_windows(
    aligned: Mapping[str, AlignedRecords],
    torques: Mapping[str, TorqueSplit],
    dominance: Mapping[str, DominanceHistory],
) -> list[StaticWindow]:
    """Returns the static windows of all sites, in order."""
    first = next(iter(aligned.values()))
    rows, still = {}, first.known.copy()
    for site, records in aligned.items():
        rows[site], recorded = find_latest_rows(records, first.t_s)
        slow = np.abs(records.qd).max(axis=1) < STATIC_SPEED_RAD_S
        static = records.follows & slow & ~dominance[site].rate.any(axis=1)
        script = torques[site].script
        if script is not None:  # without a script the torque decides
            moves = np.abs(np.diff(script, axis=0)).max(axis=1) > MOVING_SCRIPT_NM
            static &= ~(np.append(moves, False) | np.append(False, moves))
        still &= recorded & static[rows[site]]
    need = int(np.ceil(WINDOW_S * first.rate_hz))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    windows = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if end - begin > need:
            here = {site: row[end - need - 1 : end] for site, row in rows.items()}
            if _torques_are_constant([aligned[site].tau_x[row] for site, row in here.items()]):
                ends = float(first.t_s[end - need - 1]), float(first.t_s[end - 1])
                windows.append(_static_window(*ends, aligned, torques, dominance, here))
    return windows


def _torques_are_constant(torques: list[Array]) -> bool:
    largest = max(float(np.abs(values).max()) for values in torques)
    variation = max(float(np.ptp(values, axis=0).max()) for values in torques)
    return not variation > MAX_TORQUE_VARIATION * max(largest, MIN_LOAD_NM)


def _static_window(
    from_s: float,
    to_s: float,
    aligned: Mapping[str, AlignedRecords],
    torques: Mapping[str, TorqueSplit],
    dominance: Mapping[str, DominanceHistory],
    rows: Mapping[str, Ints],
) -> StaticWindow:
    names = list(aligned)
    alpha = np.zeros((len(names), len(names)))
    scripts = {site: torques[site].script for site in rows}
    for i, site in enumerate(names):
        for j, peer in enumerate(aligned[site].used):
            alpha[i, names.index(peer)] = dominance[site].alpha[rows[site][-1], j]
    return StaticWindow(
        from_s,
        to_s,
        {site: -aligned[site].tau_x[row].mean(axis=0) for site, row in rows.items()},
        {site: torques[site].environment[row].mean(axis=0) for site, row in rows.items()},
        {site: None if one is None else one[rows[site]].mean(axis=0) for site, one in scripts.items()},
        {site: aligned[site].q[row].mean(axis=0) for site, row in rows.items()},
        alpha,
    )


class StiffnessEstimate(NamedTuple):
    """Stiffness that an operator met at a joint, from 1, between the ends of two static windows in a row.

    Attributes:
        torque_nm, angle_rad: change of the operator's torque ON its arm, and of the joint's angle.
        stiffness_nm_rad: their ratio; None if the joint did not move: too stiff to measure.
    """

    from_s: float
    to_s: float
    site: str
    joint: int
    torque_nm: float
    angle_rad: float
    stiffness_nm_rad: float | None


def estimate_stiffness(windows: list[StaticWindow]) -> list[StiffnessEstimate]:
    """Returns the stiffness between each two static windows between which one operator alone moved."""
    estimates = []
    for before, after in pairwise(windows):
        moved = _moved_operators(before, after)
        if moved is None or len(moved) != 1 or (before.alpha != after.alpha).any():
            continue
        site = moved[0]
        operator = [window.torque[site] - window.environment[site] for window in (before, after)]
        torques, angles = operator[1] - operator[0], after.q[site] - before.q[site]
        for joint in range(JOINTS):
            torque, angle = float(torques[joint]), float(angles[joint])
            if abs(torque) >= MIN_TORQUE_CHANGE_NM:
                K = torque / angle if abs(angle) >= MIN_ANGLE_CHANGE_RAD else None
                found = StiffnessEstimate(before.to_s, after.to_s, site, joint + 1, torque, angle, K)
                estimates.append(found)
    return estimates


def _moved_operators(before: StaticWindow, after: StaticWindow) -> list[str] | None:
    """Returns the sites whose operators moved; None if one has no script."""
    moved = []
    for site, now in after.script.items():
        then = before.script[site]
        if now is None or then is None:
            return None
        if np.abs(now - then).max() > STILL_SCRIPT_NM:
            moved.append(site)
    return moved

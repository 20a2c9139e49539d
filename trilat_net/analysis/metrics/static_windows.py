"""Static windows of a run.

In which all arms rest under constant torques, and the stiffness between two of them.

Invariant: a window is the last second of an interval in which no joint of any site moves faster than
`STATIC_SPEED_RAD_S`, no operator's script moves, every site follows its peers with constant dominance
factors, and every tick is recorded; within it no torque varies by more than `MAX_TORQUE_VARIATION` of the
largest one.

A rendered stiffness is the change of a joint's torque over the change of its angle from one window to the
next, if only that operator moved and no dominance factor changed: otherwise the ratio is the operator's
own. Walls and operators at rest contribute to it. It is a secant along the path taken: the other joint
moves as well.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...log.record_columns import Ints
from ..aligned import AlignedRecords, Bools, find_latest_rows
from ..dominance_history import DominanceHistory
from ..run_end import STATIC_SPEED_RAD_S
from ..torque_split import TorqueSplit

WINDOW_S = 1.0
"""Length of a window, s; a stretch must be as long."""
MAX_TORQUE_VARIATION = 0.01
"""Most that a torque may vary in a window, as a share of the largest one there."""
MIN_LOAD_NM = 0.05
"""Torques below this are none, N m."""


MOVING_SCRIPT_NM = 1e-9
"""A script that changes by more from tick to tick moves, N m."""


class StaticWindow(NamedTuple):
    """A window at rest; means over it.

    Attributes:
        from_s: its first tick, s.
        to_s: its last tick, s.
        torque: per site what hands and walls do ON the arm, shape (2,), N m.
        walls: per site what walls do of it, shape (2,), N m.
        script: per site what its hands were to do, whatever the arm does, shape (2,), N m; None where that is
            not known.
        q: per site the joint angles, shape (2,), rad.
        alpha: the dominance matrix, shape (N, N).
    """

    from_s: float
    to_s: float
    torque: dict[str, Array]
    walls: dict[str, Array]
    script: dict[str, Array | None]
    q: dict[str, Array]
    alpha: Array


def find_static_windows(
    found: Mapping[str, AlignedRecords],
    by: Mapping[str, TorqueSplit],
    owned: Mapping[str, DominanceHistory],
) -> list[StaticWindow]:
    """Returns the windows at rest, in order.

    Args:
        found: the records of every site, in scenario order.
        by: who pushed them.
        owned: their shares in their peers.
    """
    first = next(iter(found.values()))
    rows, still = {}, first.known.copy()
    for site, track in found.items():
        rows[site], there = find_latest_rows(track, first.t_s)
        calm = (
            track.follows
            & (np.abs(track.qd).max(axis=1) < STATIC_SPEED_RAD_S)
            & ~owned[site].rate.any(axis=1)
        )
        calm &= ~_moving(by[site])
        still &= there & calm[rows[site]]
    need = int(np.ceil(WINDOW_S * first.rate_hz))
    windows = []
    for begin, end in _stretches(still):
        if end - begin > need:
            here = {site: row[end - need - 1 : end] for site, row in rows.items()}
            ends = float(first.t_s[end - need - 1]), float(first.t_s[end - 1])
            windows.append(_static_window(*ends, found, by, owned, here))
    return [window for window in windows if window is not None]


def _moving(by: TorqueSplit) -> Bools:
    """Returns where a hand moves by its script, shape (K,); of one without a script the torque decides."""
    if by.script is None:
        return np.zeros(len(by.operator), dtype=np.bool_)
    change = np.abs(np.diff(by.script, axis=0)).max(axis=1) > MOVING_SCRIPT_NM
    moving: Bools = np.append(change, False) | np.append(False, change)
    return moving


def _stretches(still: Bools) -> list[tuple[int, int]]:
    """Returns where stretches begin and where they have ended."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _static_window(
    from_s: float,
    to_s: float,
    found: Mapping[str, AlignedRecords],
    by: Mapping[str, TorqueSplit],
    owned: Mapping[str, DominanceHistory],
    rows: Mapping[str, Ints],
) -> StaticWindow | None:
    """Returns a window, or None where its torques do not stand."""
    torque = {site: -found[site].tau_x[row] for site, row in rows.items()}
    largest = max(float(np.abs(values).max()) for values in torque.values())
    varies = max(float(np.ptp(values, axis=0).max()) for values in torque.values())
    if varies > max(MAX_TORQUE_VARIATION * largest, MAX_TORQUE_VARIATION * MIN_LOAD_NM):
        return None
    names = list(found)
    alpha = np.zeros((len(names), len(names)))
    for i, site in enumerate(names):
        for j, peer in enumerate(found[site].used):
            alpha[i, names.index(peer)] = owned[site].alpha[rows[site][-1], j]
    return StaticWindow(
        from_s,
        to_s,
        {site: values.mean(axis=0) for site, values in torque.items()},
        {site: by[site].environment[row].mean(axis=0) for site, row in rows.items()},
        {site: _mean(by[site].script, row) for site, row in rows.items()},
        {site: found[site].q[row].mean(axis=0) for site, row in rows.items()},
        alpha,
    )


def _mean(values: Array | None, rows: Ints) -> Array | None:
    if values is None:
        return None
    mean: Array = values[rows].mean(axis=0)
    return mean


MIN_TORQUE_CHANGE_NM = 0.1
"""Least change of a torque that shows a stiffness, N m."""
MIN_ANGLE_CHANGE_RAD = 1e-4
"""Least change of an angle, rad."""
STILL_SCRIPT_NM = 1e-6
"""A hand whose script changed by less stood still, N m."""


class StiffnessEstimate(NamedTuple):
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


def estimate_stiffness(windows: list[StaticWindow]) -> list[StiffnessEstimate]:
    """Returns what a hand felt between windows at rest between which it moved alone."""
    found = []
    for before, after in pairwise(windows):
        moved = _moved_operators(before, after)
        if moved is None or len(moved) != 1 or (before.alpha != after.alpha).any():
            continue
        site = moved[0]
        hands = [window.torque[site] - window.walls[site] for window in (before, after)]
        more, further = hands[1] - hands[0], after.q[site] - before.q[site]
        for joint in range(JOINTS):
            torque, angle = float(more[joint]), float(further[joint])
            if abs(torque) >= MIN_TORQUE_CHANGE_NM:
                K = torque / angle if abs(angle) >= MIN_ANGLE_CHANGE_RAD else None
                found.append(StiffnessEstimate(before.to_s, after.to_s, site, joint + 1, torque, angle, K))
    return found


def _moved_operators(before: StaticWindow, after: StaticWindow) -> list[str] | None:
    """Returns whose hands moved; None where it is not known of all."""
    moved = []
    for site, now in after.script.items():
        then = before.script[site]
        if now is None or then is None:
            return None
        if np.abs(now - then).max() > STILL_SCRIPT_NM:
            moved.append(site)
    return moved

"""When all arms rest under torques that stand: the windows in which statics can be read off.

Law: a window is the last second of a stretch in which no joint of any site moves faster than `REST_RAD_S`, no
hand moves by its script, every site follows its peers with shares that are constant, and all of it is
recorded; and within it no torque of hands and walls varies by more than `STANDING` of the largest one.
Nothing is inferred from arms that move.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..certificate.shares import Shares
from ..certificate.track import Bools, Track
from ..core.arm import Array
from ..log.reader import Ints
from .pushing import Pushed
from .tracking import latest

REST_RAD_S = 2e-3
"""Slower joints rest, rad/s."""
WINDOW_S = 1.0
"""Length of a window, s; a stretch must be as long."""
STANDING = 0.01
"""Most that a torque may vary in a window, as a share of the largest one there."""
LEAST_NM = 0.05
"""Torques below this are none, N m."""


MOVES_NM = 1e-9
"""A script that changes by more from tick to tick moves, N m."""


class Rest(NamedTuple):
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


def rests(found: Mapping[str, Track], by: Mapping[str, Pushed], owned: Mapping[str, Shares]) -> list[Rest]:
    """Returns the windows at rest, in order.

    Args:
        found: the records of every site, in scenario order.
        by: who pushed them.
        owned: their shares in their peers.
    """
    first = next(iter(found.values()))
    rows, still = {}, first.known.copy()
    for site, track in found.items():
        rows[site], there = latest(track, first.t_s)
        calm = track.follows & (np.abs(track.qd).max(axis=1) < REST_RAD_S) & ~owned[site].rate.any(axis=1)
        calm &= ~_moving(by[site])
        still &= there & calm[rows[site]]
    need = int(np.ceil(WINDOW_S * first.rate_hz))
    windows = []
    for begin, end in _stretches(still):
        if end - begin > need:
            here = {site: row[end - need - 1 : end] for site, row in rows.items()}
            ends = float(first.t_s[end - need - 1]), float(first.t_s[end - 1])
            windows.append(_rest(*ends, found, by, owned, here))
    return [window for window in windows if window is not None]


def _moving(by: Pushed) -> Bools:
    """Returns where a hand moves by its script, shape (K,); of one without a script the torque decides."""
    if by.script is None:
        return np.zeros(len(by.by_hand), dtype=np.bool_)
    change = np.abs(np.diff(by.script, axis=0)).max(axis=1) > MOVES_NM
    moving: Bools = np.append(change, False) | np.append(False, change)
    return moving


def _stretches(still: Bools) -> list[tuple[int, int]]:
    """Returns where stretches begin and where they have ended."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _rest(
    from_s: float,
    to_s: float,
    found: Mapping[str, Track],
    by: Mapping[str, Pushed],
    owned: Mapping[str, Shares],
    rows: Mapping[str, Ints],
) -> Rest | None:
    """Returns a window, or None where its torques do not stand."""
    torque = {site: -found[site].tau_x[row] for site, row in rows.items()}
    largest = max(float(np.abs(values).max()) for values in torque.values())
    varies = max(float(np.ptp(values, axis=0).max()) for values in torque.values())
    if varies > max(STANDING * largest, STANDING * LEAST_NM):
        return None
    names = list(found)
    alpha = np.zeros((len(names), len(names)))
    for i, site in enumerate(names):
        for j, peer in enumerate(found[site].used):
            alpha[i, names.index(peer)] = owned[site].alpha[rows[site][-1], j]
    return Rest(
        from_s,
        to_s,
        {site: values.mean(axis=0) for site, values in torque.items()},
        {site: by[site].by_wall[row].mean(axis=0) for site, row in rows.items()},
        {site: _mean(by[site].script, row) for site, row in rows.items()},
        {site: found[site].q[row].mean(axis=0) for site, row in rows.items()},
        alpha,
    )


def _mean(values: Array | None, rows: Ints) -> Array | None:
    if values is None:
        return None
    mean: Array = values[rows].mean(axis=0)
    return mean

"""Equilibria of the loop: the nearest one to a pose, and the one that a start leads to.

Law: equilibria are not isolated (any pose that the sites agree on may be one), so that "the" equilibrium is
always the nearest to something, and it is said to what.
"""

import numpy as np

from ..core.arm import JOINTS, Array
from .conditions import Conditions
from .field import ESTIMATE, QD, adapts
from .loop import Loop, Rest, arguments, loop_of

ENOUGH = 1e-11
"""A residual below this is rounding: accelerations in rad/s^2."""
STEPS = 60
_LARGEST_STEP = 0.3
_HALVINGS = 20
_FLAT = 1e-8
"""A direction in which the field changes so little, beside the steepest, is one along which all rests."""


def residual_of(now: Conditions, rest: Rest) -> Array:
    """Returns what is left at a rest: accelerations and rates of estimates, as the loop's states lie.

    The derivatives of the angles are zero there and have zeros in their places.
    """
    x = arguments(now, rest)
    parts = []
    for i, site in enumerate(now.sites):
        found = now.rates(i, x[i])
        parts += [np.zeros(JOINTS), found.qdd]
        if adapts(site):
            parts.append(found.estimate)
    return np.concatenate(parts)


def nearest(now: Conditions, rest: Rest) -> Rest:
    """Returns the equilibrium next to a pose, by Gauss and Newton with the least change of every step.

    Args:
        now: what holds.
        rest: the pose to begin from.
    """
    left = residual_of(now, rest)
    for _ in range(STEPS):
        if np.abs(left).max() <= ENOUGH:
            break
        loop = loop_of(now, rest)
        free = _free(loop)
        step = np.zeros(len(loop.names))
        step[free] = np.linalg.lstsq(settled(loop)[:, free], -left, rcond=_FLAT)[0]
        share = min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), _LARGEST_STEP))
        tried, after = rest, left
        for _ in range(_HALVINGS):  # a wall met on the way turns the next step
            tried = moved(now, rest, share * step)
            after = residual_of(now, tried)
            if np.linalg.norm(after) < np.linalg.norm(left):
                break
            share *= 0.5
        else:
            break
        rest, left = tried, after
    return rest._replace(residual=float(np.abs(left).max()))


def _free(loop: Loop) -> list[int]:
    """Returns the states that an equilibrium may be moved along.

    Velocities are zero, and what nothing moves (an estimate without a gain, one held at an end of its box)
    stays where the run has it.
    """
    movers = np.hstack([loop.A, *(delayed.A for delayed in loop.delayed)])
    return [n for n, name in enumerate(loop.names) if ".qd" not in name and np.any(movers[n])]


def settled(loop: Loop) -> Array:
    """Returns A + sum_k A_k: what acts on what does not change."""
    total = loop.A.copy()
    for delayed in loop.delayed:
        total += delayed.A
    return total


def moved(now: Conditions, rest: Rest, step: Array) -> Rest:
    """Returns a rest shifted by a deviation of the loop's states, of which velocities do not count."""
    q, theta_hat = rest.q.copy(), rest.theta_hat.copy()
    first = 0
    for i, site in enumerate(now.sites):
        q[i] += step[first : first + JOINTS]
        first += QD.stop
        if adapts(site):
            theta_hat[i] += step[first : first + ESTIMATE.stop - ESTIMATE.start]
            first += ESTIMATE.stop - ESTIMATE.start
    return rest._replace(q=q, theta_hat=theta_hat)


def predicted(now: Conditions, start: Rest) -> Rest:
    """Returns where the linear loop would come to rest from the start, did its other modes die away.

    A loop with roots at zero keeps something of its history: with null vectors W' S = 0 and S V = 0 of S = A
    + sum_k A_k, and D = I + sum_k T_k A_k, it is V (W' D V)^-1 W' (x(0) + sum_k A_k int_{-T_k}^0 x). Hale
    and Verduyn Lunel, "Introduction to Functional Differential Equations" (1993), chapter 7.

    Args:
        now: what holds.
        start: where all begin, and have been still.
    """
    rest = nearest(now, start)
    for _ in range(3):
        loop = loop_of(now, rest)
        kept = _kept(loop, _deviation(now, start, rest))
        if kept is None:
            break
        rest = nearest(now, moved(now, rest, kept))
    return rest._replace(how="predicted from the start poses: what the linear loop keeps of its start")


def _deviation(now: Conditions, start: Rest, rest: Rest) -> Array:
    """Returns the start as a deviation from a rest; the history is still, and so is what counts of it."""
    parts = []
    for i, site in enumerate(now.sites):
        parts += [start.q[i] - rest.q[i], np.zeros(JOINTS)]
        if adapts(site):
            parts.append(start.theta_hat[i] - rest.theta_hat[i])
    return np.concatenate(parts)


def _kept(loop: Loop, deviation: Array) -> Array | None:
    """Returns the part of a deviation that stays; None where roots at zero have too few vectors."""
    left, values, right = np.linalg.svd(settled(loop))
    count = int(np.sum(values <= _FLAT * values[0]))
    if not count:
        return None
    W, V = left[:, -count:], right[-count:].T
    D = np.eye(len(values))
    for delayed in loop.delayed:
        D += delayed.delay_s * delayed.A
    inner = W.T @ D @ V
    if np.linalg.cond(inner) > 1.0 / _FLAT:
        return None
    found: Array = V @ np.linalg.solve(inner, W.T @ D @ deviation)
    return found

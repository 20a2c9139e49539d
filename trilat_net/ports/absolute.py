"""Absolute stability: whether the loop stays stable with any passive hand at every site.

Law: hands of different sites are apart, so each frequency may weight the sites anew: the loop is absolutely
stable if at every frequency there are weights with D Y + Y^H D >= 0. For up to three sites that is also
necessary; for more it is sufficient.

Source: two scalar ports: Llewellyn, "Some fundamental properties of transmission systems", Proc. IRE 40
(1952); the parameter that must not be below 1: Adams and Hannaford, "Stable haptic interaction with virtual
environments", IEEE Trans. Robotics and Automation 15 (1999). Several joints and sites: Li, Tavakoli and
Huang, "Absolute stability of multi-DOF multilateral haptic systems", IEEE Trans. Control Systems Technology
(2014), treat some classes. Here weights are those of the structured singular value, exact for up to three
blocks: Packard and Doyle, "The complex structured singular value", Automatica 29 (1993).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array
from .passivity import ROUNDING, weighted
from .port import Complex

MOST = 1e6
"""Greatest value of Llewellyn's parameter."""
_REACH = 12.0
"""Logarithm of the largest ratio of two weights."""
_TURNS = 400
_CLOSE = 1e-3


def llewellyn(Y: Complex) -> Array:
    """Returns Llewellyn's stability parameter, shape (F,); at least 1 where the criterion holds.

    2 Re y11 Re y22 - Re(y12 y21) over abs(y12 y21), but at most `MOST`, which stands for a two-port through
    which nothing passes, and at most -1 where Re y11 or Re y22 is negative.

    Args:
        Y: admittance of two scalar ports, shape (F, 2, 2).
    """
    y11, y22, through = Y[:, 0, 0].real, Y[:, 1, 1].real, Y[:, 0, 1] * Y[:, 1, 0]
    own = np.linalg.norm(Y, axis=(1, 2))
    size = np.maximum(np.abs(through), 1e-30 * own**2)
    parameter: Array = np.minimum((2.0 * y11 * y22 - through.real) / size, MOST)
    active = (y11 < -ROUNDING * own) | (y22 < -ROUNDING * own)
    return np.where(active, np.minimum(parameter, -1.0), parameter)


def llewellyn_rounding(Y: Complex) -> Array:
    """Returns by how much rounding may change the parameter, shape (F,): much where next to nothing passes.

    Args:
        Y: as of `llewellyn`.
    """
    through, own = np.abs(Y[:, 0, 1] * Y[:, 1, 0]), np.linalg.norm(Y, axis=(1, 2))
    amount: Array = ROUNDING + 1e-12 * own**2 / np.maximum(through, 1e-30 * own**2)
    return amount


def left_at(Y: Complex, keep: list[int], clamped: list[int]) -> Complex:
    """Returns the admittance at some ports while others are clamped, and hands are off the rest.

    Args:
        Y: shape (F, p, p).
        keep: ports that hands hold.
        clamped: ports that cannot move.
    """
    kept: Complex = Y[:, keep][:, :, keep]
    if not clamped:
        return kept
    across = np.linalg.solve(Y[:, clamped][:, :, clamped], Y[:, clamped][:, :, keep])
    left: Complex = kept - Y[:, keep][:, :, clamped] @ across
    return left


class Weighed(NamedTuple):
    """The best that weights can do.

    Attributes:
        margin: least eigenvalue of Y + Y^H, each site's part scaled to size 1, with the best weights,
            dimensionless, shape (F,); negative where no weights will do.
        weights: those weights, of the first site 1, shape (F, N).
    """

    margin: Array
    weights: Array


def weighed(Y: Complex, owner: NDArray[np.int64]) -> Weighed:
    """Returns the weights of the sites that make the least eigenvalue largest, frequency by frequency.

    The least eigenvalue of D^1/2 Y D^-1/2 + its Hermitian is concave in ln D (a limit of what Sezginer and
    Overton show for norms, IEEE Trans. Automatic Control 35 (1990)), so that the ellipsoid method finds it.

    Args:
        Y: admittance, shape (F, p, p).
        owner: the site of each port, from 0 on, shape (p,).
    """
    scaled = _sized(Y, owner)
    count, free = len(Y), int(owner.max())
    centre, best = np.zeros((count, free)), np.zeros((count, free))
    shape = np.broadcast_to(_REACH**2 * free * np.eye(free), (count, free, free)).copy()
    margin = np.full(count, -np.inf)
    going = np.arange(count)
    for _ in range(_TURNS):
        value, slope = _value_and_slope(scaled[going], centre[going], owner)
        better = value > margin[going]
        margin[going[better]], best[going[better]] = value[better], centre[going[better]]
        along = np.einsum("fij,fj->fi", shape[going], slope)
        reach = np.sqrt(np.maximum(np.einsum("fi,fi->f", slope, along), 0.0))
        # what is left to gain is at most `reach`
        more = reach > _CLOSE * np.maximum(np.abs(margin[going]), 1e-6)
        going, along = going[more], (along[more] / reach[more, np.newaxis])
        if not len(going) or free == 0:
            break
        centre[going] += along / (free + 1.0)
        shape[going] = _halved(shape[going], along, free)
    logs = np.concatenate([np.zeros((count, 1)), best], axis=1)
    return Weighed(margin, np.exp(logs))


def _halved(shape: Array, along: Array, free: int) -> Array:
    """Returns the least ellipsoids about the better halves of some."""
    if free == 1:
        return shape / 4.0
    outer = along[:, :, np.newaxis] * along[:, np.newaxis, :]
    grown: Array = free**2 / (free**2 - 1.0) * (shape - 2.0 / (free + 1.0) * outer)
    return grown


def _sized(Y: Complex, owner: NDArray[np.int64]) -> Complex:
    """Returns Y with each site's rows and columns divided by the root of the size of its own part."""
    size = np.ones(Y.shape[:2])
    for site in range(int(owner.max()) + 1):
        own = np.flatnonzero(owner == site)
        size[:, own] = np.linalg.norm(Y[:, own][:, :, own], axis=(1, 2))[:, np.newaxis]
    root = np.sqrt(np.maximum(size, 1e-300))
    scaled: Complex = Y / (root[:, :, np.newaxis] * root[:, np.newaxis, :])
    return scaled


def _value_and_slope(Y: Complex, logs: Array, owner: NDArray[np.int64]) -> tuple[Array, Array]:
    """Returns the least eigenvalue under weights, and its slope in the logarithm of each but the first.

    d/dx_i of v^H (e^{x/2} Y e^{-x/2} + its Hermitian) v is Re v^H (P_i Y - Y P_i) v, P_i the ports of i.
    """
    full = np.concatenate([np.zeros((len(Y), 1)), logs], axis=1)
    W = weighted(Y, np.exp(full[:, owner]))
    values, vectors = np.linalg.eigh(W + np.conj(np.swapaxes(W, -1, -2)))
    v = vectors[:, :, 0]
    per_port = (np.conj(v) * (W @ v[:, :, np.newaxis])[:, :, 0]).real
    per_port -= ((np.conj(v)[:, np.newaxis, :] @ W)[:, 0, :] * v).real
    member = owner[:, np.newaxis] == np.arange(1, full.shape[1])
    return values[:, 0], per_port @ member.astype(np.float64)

"""Passivity: whether hands could draw energy out of the loop by pushing at their ports.

Law: the power that torques u put in is 1/4 u^H (Y + Y^H) u; a loop that is stable is passive if no frequency
has a negative eigenvalue of Y + Y^H. Sites may be weighted: hands are apart, so the sum of their energies
proves as much with positive weights as without.

Source: for linear loops, Colgate and Hogan, "Robust control of dynamically interacting systems", Int. J.
Control 48 (1988): passive is what is stable with every passive environment.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .curve import Dips, dips
from .port import Complex, Response, inverse

ROUNDING = 1e-8
"""Of the answer's size: eigenvalues that are negative by less are zero but for rounding."""
_FURTHER = 4.0


class Passivity(NamedTuple):
    """The outcome for one set of ports.

    Attributes:
        dips: the least eigenvalue over frequency, rad/s per N m, and where it is negative.
        size: the largest singular value of Y there, shape (F,), rad/s per N m: eigenvalues of Y + Y^H lie
            within twice that.
        lacking_nm_s_rad: the damping that, added at each of the joints, would make it passive, N m s/rad; inf
            where what is lacking grows without end towards the lowest frequencies.
    """

    dips: Dips
    size: Array
    lacking_nm_s_rad: float

    @property
    def passive(self) -> bool:
        """True where no frequency of the grid has a negative eigenvalue."""
        return not self.dips.below


def weighted(Y: Complex, weights: Array) -> Complex:
    """Returns D^1/2 Y D^-1/2 with D = diag(weights): its Hermitian part has the signs of D Y + Y^H D.

    Args:
        Y: shape (F, p, p).
        weights: of the ports, positive, shape (p,) or (F, p).
    """
    root = np.sqrt(weights)
    scaled: Complex = root[..., :, np.newaxis] * Y / root[..., np.newaxis, :]
    return scaled


def least_eigenvalue(Y: Complex) -> Array:
    """Returns the least eigenvalue of Y + Y^H, shape (F,), for Y of shape (F, p, p)."""
    values = np.linalg.eigvalsh(Y + np.conj(np.swapaxes(Y, -1, -2)))
    return np.asarray(values[..., 0], dtype=np.float64)


def lacking_damping(Y: Complex, w_rad_s: Array) -> float:
    """Returns the least b >= 0 with which (Y^-1 + b)^-1 is passive, N m s/rad.

    A damper b at every port adds b to the impedance Z = Y^-1, and Z + Z^H + 2 b >= 0 is the same question.
    An integrator in the law can make Z ~ -K / w^2, a damping that is negative and without bound: then no b
    will do.

    Args:
        Y: shape (F, p, p), rad/s per N m.
        w_rad_s: rising frequencies, shape (F,).
    """
    lacking = -0.5 * least_eigenvalue(inverse(Y))
    further = float(np.interp(_FURTHER * w_rad_s[0], w_rad_s, lacking))
    if lacking[0] > 0.0 and lacking[0] > 2.0 * further:
        return np.inf
    return max(0.0, float(lacking.max()))


def passivity(response: Response, w_rad_s: Array, weights: Array | None = None) -> Passivity:
    """Returns whether a loop is passive at some ports, as far as a grid of frequencies can tell.

    Args:
        response: velocities per torque, or another output of as many entries.
        w_rad_s: frequencies to begin with, shape (F,).
        weights: of the ports, positive, shape (p,); None: all one, which makes it energy.
    """

    def scaled(w: Array) -> Complex:
        Y = response(w)
        return Y if weights is None else weighted(Y, weights)

    def tolerance(w: Array) -> Array:
        size: Array = ROUNDING * np.linalg.norm(response(w), axis=(1, 2))
        return size

    found = dips(lambda w: least_eigenvalue(scaled(w)), w_rad_s, tolerance=tolerance)
    Y = scaled(found.w_rad_s)
    size = np.asarray(np.linalg.norm(Y, 2, axis=(1, 2)), dtype=np.float64)
    return Passivity(found, size, lacking_damping(Y, found.w_rad_s) if found.below else 0.0)

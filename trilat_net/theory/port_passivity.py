"""Passivity and absolute stability at the ports: with passive operators coupled, and with
independent ones.

Invariant: torques u put in the power 1/4 u^H (Y + Y^H) u; a stable loop is passive if Y + Y^H
has no negative eigenvalue at any frequency, and positive weights per site prove as much. It is
absolutely stable if every frequency has weights with D Y + Y^H D >= 0: also necessary for up to
three sites, sufficient beyond.

Sources: Colgate and Hogan, "Robust control of dynamically interacting systems", Int. J. Control
48 (1988): passive loops are stable with every passive environment. Two scalar ports: Llewellyn,
"Some fundamental properties of transmission systems", Proc. IRE 40 (1952); the parameter that
must not be below 1: Adams and Hannaford, "Stable haptic interaction with virtual environments",
IEEE Trans. Robotics and Automation 15 (1999). Several joints and sites: Li, Tavakoli and Huang,
"Absolute stability of multi-DOF multilateral haptic systems", IEEE Trans. Control Systems
Technology (2014), treat some classes; weights here are those of the structured singular value,
exact for up to three blocks: Packard and Doyle, "The complex structured singular value",
Automatica 29 (1993).
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array
from .characteristic_roots import Complex
from .frequency_search import Minima, find_minima
from .port_response import PortResponse

EIGENVALUE_ROUNDING = 1e-8
"""Negative eigenvalues smaller than this, relative to the response, are zero but for rounding.
"""
MAX_LLEWELLYN = 1e6
"""Largest value of Llewellyn's parameter."""
_LOW_BAND = 4.0
"""Ratio of frequencies over which a lack of damping that grows without bound would double."""
_LOG_REACH = 12.0
"""Logarithm of the largest ratio of two weights."""
_MAX_ROUNDS = 400
_WEIGHT_TOLERANCE = 1e-3


class Passivity(NamedTuple):
    """Passivity at one set of ports.

    Attributes:
        minima: the least eigenvalue of Y + Y^H over frequency, rad/s per N m, and the bands
            where it is negative.
        size: the largest singular value of Y there, shape (F,), rad/s per N m: eigenvalues of Y
            + Y^H lie within twice that.
        lacking_nm_s_rad: the damping that, added at each of the joints, would make it passive,
            N m s/rad; inf if it grows without bound towards the lowest frequencies.
    """

    minima: Minima
    size: Array
    lacking_nm_s_rad: float

    @property
    def passive(self) -> bool:
        """True if no frequency of the grid has a negative eigenvalue."""
        return not self.minima.below


class HandMatrices(NamedTuple):
    """A hand at the end effector as somebody measured it: F = -(M a + B v + K x), shape (n, n)
    each.

    Attributes:
        M: mass, kg.
        B: damping, N s/m.
        K: stiffness, N/m.
    """

    M: Array
    B: Array
    K: Array

    def compute_resistance(self, w_rad_s: Array) -> Complex:
        """Returns the Hermitian part of its impedance at some frequencies, N s/m, shape (F, n,
        n).
        """
        w = w_rad_s[:, np.newaxis, np.newaxis]
        Z: Complex = 1j * w * self.M + self.B - 1j * self.K / w
        return 0.5 * (Z + np.conj(np.swapaxes(Z, -1, -2)))


def check_against_hands(
    response: PortResponse,
    w_rad_s: Array,
    held: Sequence[Sequence[HandMatrices]],
    places: Sequence[Array],
) -> Minima | None:
    """Returns the least eigenvalue of Z + Z^H + 2 D over every choice of hands, N m s/rad or N
    s/m.

    D is what the hands at the ports dissipate. Where it is negative at no frequency, Z = Y^-1
    with the shares D of the hands is passive, and so is each hand without its share: the loop
    is stable with any of these hands, and with passive environments where nobody holds on.
    Sufficient, as passivity is. None: no hands.

    Args:
        response: the admittance Y at the ports.
        w_rad_s: frequencies, rising, shape (F,).
        held: the hands that may hold on, for each place.
        places: for each the matrix from velocities at all ports to that of the end effector,
            shape (n, p).
    """
    if not held:
        return None

    def least(w: Array) -> Array:
        Z = np.linalg.inv(response(w)).astype(np.complex128)
        Z += np.conj(np.swapaxes(Z, -1, -2))
        shares = [
            [2.0 * J.T @ one.compute_resistance(w) @ J for one in hands]
            for hands, J in zip(held, places, strict=True)
        ]
        values = [np.linalg.eigvalsh(Z + sum(chosen))[:, 0] for chosen in product(*shares)]
        found: Array = np.min(values, axis=0)
        return found

    def tolerance(w: Array) -> Array:
        size: Array = EIGENVALUE_ROUNDING * np.linalg.norm(
            np.linalg.inv(response(w)), axis=(1, 2)
        )
        return size

    return find_minima(least, w_rad_s, tolerance=tolerance)


def weight_response(Y: Complex, weights: Array) -> Complex:
    """Returns D^1/2 Y D^-1/2 with D = diag(weights): its Hermitian part has the signs of D Y +
    Y^H D.

    Y has shape (F, p, p); the weights of the ports are positive, shape (p,) or (F, p).
    """
    root = np.sqrt(weights)
    return root[..., :, np.newaxis] * Y / root[..., np.newaxis, :]


def find_least_eigenvalue(Y: Complex) -> Array:
    """Returns the least eigenvalue of Y + Y^H, shape (F,), for Y of shape (F, p, p)."""
    values = np.linalg.eigvalsh(Y + np.conj(np.swapaxes(Y, -1, -2)))
    return np.asarray(values[..., 0], dtype=np.float64)


def find_lacking_damping(Y: Complex, w_rad_s: Array) -> float:
    """Returns the least b >= 0 with which (Y^-1 + b)^-1 is passive, N m s/rad.

    A damper b at every port adds b to the impedance Z = Y^-1, and Z + Z^H + 2 b >= 0 is the
    same condition. An integrator in the law can make Z ~ -K / w^2, a negative damping without
    bound: then no b suffices, and the result is inf. Y has shape (F, p, p), rad/s per N m;
    frequencies rise, shape (F,).
    """
    lacking = -0.5 * find_least_eigenvalue(np.linalg.inv(Y).astype(np.complex128))
    further = float(np.interp(_LOW_BAND * w_rad_s[0], w_rad_s, lacking))
    if lacking[0] > 0.0 and lacking[0] > 2.0 * further:
        return np.inf
    return max(0.0, float(lacking.max()))


def check_passivity(
    response: PortResponse, w_rad_s: Array, weights: Array | None = None
) -> Passivity:
    """Returns the passivity at some ports, as far as a grid of frequencies, refined at minima,
    shows.

    The response is velocities per torque, or another output of as many entries; weights of the
    ports are positive, shape (p,); None: all one, which makes it energy.
    """

    def weighted(w: Array) -> Complex:
        Y = response(w)
        return Y if weights is None else weight_response(Y, weights)

    def tolerance(w: Array) -> Array:
        size: Array = EIGENVALUE_ROUNDING * np.linalg.norm(response(w), axis=(1, 2))
        return size

    minima = find_minima(
        lambda w: find_least_eigenvalue(weighted(w)), w_rad_s, tolerance=tolerance
    )
    Y = weighted(minima.w_rad_s)
    size = np.asarray(np.linalg.norm(Y, 2, axis=(1, 2)), dtype=np.float64)
    return Passivity(
        minima, size, find_lacking_damping(Y, minima.w_rad_s) if minima.below else 0.0
    )


def llewellyn_parameter(Y: Complex) -> Array:
    """Returns Llewellyn's parameter of two scalar ports, shape (F,); at least 1 where his
    criterion holds.

    2 Re y11 Re y22 - Re(y12 y21) over abs(y12 y21), but at most `MAX_LLEWELLYN`, which stands
    for a two-port without transmission, and at most -1 where Re y11 or Re y22 is negative.
    """
    y11 = Y[:, 0, 0].real
    y22 = Y[:, 1, 1].real
    through = Y[:, 0, 1] * Y[:, 1, 0]
    norm = np.linalg.norm(Y, axis=(1, 2))
    size = np.maximum(np.abs(through), 1e-30 * norm**2)
    parameter: Array = np.minimum((2.0 * y11 * y22 - through.real) / size, MAX_LLEWELLYN)
    active = (y11 < -EIGENVALUE_ROUNDING * norm) | (y22 < -EIGENVALUE_ROUNDING * norm)
    return np.where(active, np.minimum(parameter, -1.0), parameter)


def llewellyn_rounding(Y: Complex) -> Array:
    """Returns the rounding error of the parameter, shape (F,): large if there is next to no
    transmission.
    """
    through = np.abs(Y[:, 0, 1] * Y[:, 1, 0])
    norm = np.linalg.norm(Y, axis=(1, 2))
    amount: Array = EIGENVALUE_ROUNDING + 1e-12 * norm**2 / np.maximum(through, 1e-30 * norm**2)
    return amount


def clamp_ports(Y: Complex, keep: list[int], clamped: list[int]) -> Complex:
    """Returns the admittance at the ports `keep` with others clamped and no operator at the
    rest.
    """
    kept: Complex = Y[:, keep][:, :, keep]
    if not clamped:
        return kept
    across = np.linalg.solve(Y[:, clamped][:, :, clamped], Y[:, clamped][:, :, keep])
    return kept - Y[:, keep][:, :, clamped] @ across


class BestWeights(NamedTuple):
    """The weights of the sites with the largest margin.

    Attributes:
        margin: least eigenvalue of Y + Y^H, each site's part scaled to size 1, with the best
            weights, dimensionless, shape (F,); negative if no weights suffice.
        weights: those weights, of the first site 1, shape (F, N).
    """

    margin: Array
    weights: Array


def find_best_weights(Y: Complex, owner: NDArray[np.int64]) -> BestWeights:
    """Returns the weights of the sites that make the least eigenvalue largest, frequency by
    frequency.

    The least eigenvalue of D^1/2 Y D^-1/2 + its Hermitian is concave in ln D (a limit of what
    Sezginer and Overton show for norms, IEEE Trans. Automatic Control 35 (1990)), so that the
    ellipsoid method finds it. Y has shape (F, p, p); `owner` is the site of each port, from 0
    on, shape (p,).
    """
    scaled = _scale_sites(Y, owner)
    count = len(Y)
    free = int(owner.max())
    centre = np.zeros((count, free))
    best = np.zeros((count, free))
    shape = np.broadcast_to(_LOG_REACH**2 * free * np.eye(free), (count, free, free)).copy()
    margin = np.full(count, -np.inf)
    active = np.arange(count)
    # their mean, whatever the weights
    most = 2.0 * np.trace(scaled, axis1=1, axis2=2).real / scaled.shape[1]
    for _ in range(_MAX_ROUNDS):
        value, slope = _value_and_slope(scaled[active], centre[active], owner)
        better = value > margin[active]
        margin[active[better]] = value[better]
        best[active[better]] = centre[active[better]]
        along = np.einsum("fij,fj->fi", shape[active], slope)
        gain = np.sqrt(np.maximum(np.einsum("fi,fi->f", slope, along), 0.0))  # at most
        more = gain > _WEIGHT_TOLERANCE * np.maximum(np.abs(margin[active]), 1e-6)
        more &= most[active] - margin[active] > EIGENVALUE_ROUNDING
        active = active[more]
        along = along[more] / gain[more, np.newaxis]
        if not len(active) or free == 0:
            break
        centre[active] += along / (free + 1.0)
        if free == 1:
            shape[active] /= 4.0
        else:
            outer = along[:, :, np.newaxis] * along[:, np.newaxis, :]
            shape[active] = (
                free**2 / (free**2 - 1.0) * (shape[active] - 2.0 / (free + 1.0) * outer)
            )
    return BestWeights(margin, np.exp(np.concatenate([np.zeros((count, 1)), best], axis=1)))


def _scale_sites(Y: Complex, owner: NDArray[np.int64]) -> Complex:
    size = np.ones(Y.shape[:2])
    for site in range(int(owner.max()) + 1):
        own = np.flatnonzero(owner == site)
        size[:, own] = np.linalg.norm(Y[:, own][:, :, own], axis=(1, 2))[:, np.newaxis]
    root = np.sqrt(np.maximum(size, 1e-300))
    scaled: Complex = Y / (root[:, :, np.newaxis] * root[:, np.newaxis, :])
    return scaled


def _value_and_slope(Y: Complex, logs: Array, owner: NDArray[np.int64]) -> tuple[Array, Array]:
    """Returns the least eigenvalue under weights, and its slope in the logarithm of each but
    the first.

    d/dx_i of v^H (e^{x/2} Y e^{-x/2} + its Hermitian) v is Re v^H (P_i Y - Y P_i) v, P_i the
    ports of i.
    """
    full = np.concatenate([np.zeros((len(Y), 1)), logs], axis=1)
    W = weight_response(Y, np.exp(full[:, owner]))
    values, vectors = np.linalg.eigh(W + np.conj(np.swapaxes(W, -1, -2)))
    v = vectors[:, :, 0]
    per_port = (np.conj(v) * (W @ v[:, :, np.newaxis])[:, :, 0]).real
    per_port -= ((np.conj(v)[:, np.newaxis, :] @ W)[:, 0, :] * v).real
    member = owner[:, np.newaxis] == np.arange(1, full.shape[1])
    return values[:, 0], per_port @ member.astype(np.float64)

"""Passivity and absolute stability at the haptic ports.

Torques u at ports with the admittance Y put in the power 1/4 u^H (Y + Y^H) u. A stable loop is
passive if Y + Y^H has no negative eigenvalue at any frequency; a passive loop is stable with
every passive environment, and coupled operators count as one environment. With independent
operators at the sites the condition is weaker. The loop is absolutely stable if every frequency
has positive weights D per site with D Y + Y^H D >= 0.

Sources:
    - Passive environments: Colgate and Hogan, "Robust control of dynamically interacting
      systems", Int. J. Control 48 (1988).
    - Two scalar ports: Llewellyn, "Some fundamental properties of transmission systems", Proc.
      IRE 40 (1952); the parameter that must not be below 1: Adams and Hannaford, "Stable haptic
      interaction with virtual environments", IEEE Trans. Robotics and Automation 15 (1999).
    - Several joints and sites: Li, Tavakoli and Huang, "Absolute stability of multi-DOF
      multilateral haptic systems", IEEE Trans. Control Systems Technology (2014), for some
      classes.
    - Weights: those of the structured singular value, exact for up to three blocks: Packard and
      Doyle, "The complex structured singular value", Automatica 29 (1993).

Invariant:
    - Passivity with positive weights per site proves stability for passive operators that are
      not coupled to each other.
    - The condition of absolute stability is also necessary for up to three sites, and
      sufficient beyond.
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
"""Negative eigenvalues smaller than this, relative to the response, count as rounding."""
MAX_LLEWELLYN = 1e6
"""Largest value of Llewellyn's parameter."""
_LOW_BAND = 4.0
"""Ratio of frequencies over which a lack of damping that grows without bound would double."""
_LOG_REACH = 12.0
"""Logarithm of the largest ratio of two weights."""
_MAX_ROUNDS = 400
"""Largest number of steps of the ellipsoid method."""
_WEIGHT_TOLERANCE = 1e-3
"""The search for weights ends once the margin can grow by less than this share."""


class Passivity(NamedTuple):
    """Passivity at one set of ports.

    Attributes:
        minima: the least eigenvalue of Y + Y^H over frequency, rad/s per N m, and the bands
            where it is negative.
        size: the largest singular value of Y at these frequencies, shape (F,), rad/s per N m;
            the eigenvalues of Y + Y^H lie within twice that.
        lacking_nm_s_rad: the damping that would make the loop passive if each port had it,
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
    """A measured hand at the end effector: F = -(M a + B v + K x), shape (n, n) each.

    Attributes:
        M: mass, kg.
        B: damping, N s/m.
        K: stiffness, N/m.
    """

    M: Array
    B: Array
    K: Array

    def compute_resistance(self, w_rad_s: Array) -> Complex:
        """Returns the Hermitian part of the hand's impedance, shape (F, n, n), N s/m.

        The impedance is Z(j w) = j w M + B + K / (j w).
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
    """Returns the least eigenvalue of Z + Z^H + 2 D over every choice of hands.

    D is the resistance of the hands at the ports. If the eigenvalue is negative at no
    frequency, Z = Y^-1 together with D is passive, and so is each hand without D. The loop is
    then stable with any of these hands, and with passive environments at the other ports. Like
    passivity, the condition is sufficient.

    Args:
        response: the admittance Y at the ports.
        w_rad_s: frequencies, rising, shape (F,).
        held: the hands of which any may hold, for each end effector that is held.
        places: for each of these end effectors, the matrix from the velocities at all ports to
            its own velocity, shape (n, p).

    Returns:
        The least eigenvalue over frequency, N m s/rad or N s/m; None if no hand is known.
    """
    if not held:
        return None

    def find_least(w: Array) -> Array:
        Z = np.linalg.inv(response(w)).astype(np.complex128)
        Z += np.conj(np.swapaxes(Z, -1, -2))
        resistances = []
        for hands, J in zip(held, places, strict=True):
            resistances.append([2.0 * J.T @ hand.compute_resistance(w) @ J for hand in hands])
        values = [np.linalg.eigvalsh(Z + sum(choice))[:, 0] for choice in product(*resistances)]
        least: Array = np.min(values, axis=0)
        return least

    def find_tolerance(w: Array) -> Array:
        norm = np.linalg.norm(np.linalg.inv(response(w)), axis=(1, 2))
        tolerance: Array = EIGENVALUE_ROUNDING * norm
        return tolerance

    return find_minima(find_least, w_rad_s, tolerance=find_tolerance)


def weight_response(Y: Complex, weights: Array) -> Complex:
    """Returns D^1/2 Y D^-1/2 with D = diag(weights), shape (F, p, p).

    Its Hermitian part has the same signs of eigenvalues as D Y + Y^H D.

    Args:
        Y: response, shape (F, p, p).
        weights: positive weights of the ports, shape (p,) or (F, p).
    """
    root = np.sqrt(weights)
    return root[..., :, np.newaxis] * Y / root[..., np.newaxis, :]


def find_least_eigenvalue(Y: Complex) -> Array:
    """Returns the least eigenvalue of Y + Y^H, shape (F,), for Y of shape (F, p, p)."""
    values = np.linalg.eigvalsh(Y + np.conj(np.swapaxes(Y, -1, -2)))
    return np.asarray(values[..., 0], dtype=np.float64)


def find_lacking_damping(Y: Complex, w_rad_s: Array) -> float:
    """Returns the least b >= 0 with which (Y^-1 + b)^-1 is passive, N m s/rad.

    A damper b at every port adds b to the impedance Z = Y^-1, so that the condition is
    Z + Z^H + 2 b >= 0. An integrator in the law can make Z ~ -K / w^2, a negative damping
    without bound: then no b suffices, and the result is inf.

    Args:
        Y: admittance, shape (F, p, p), rad/s per N m.
        w_rad_s: frequencies, rising, shape (F,).
    """
    lacking = -0.5 * find_least_eigenvalue(np.linalg.inv(Y).astype(np.complex128))
    at_higher_frequency = float(np.interp(_LOW_BAND * w_rad_s[0], w_rad_s, lacking))
    if lacking[0] > 0.0 and lacking[0] > 2.0 * at_higher_frequency:
        return np.inf
    return max(0.0, float(lacking.max()))


def check_passivity(
    response: PortResponse, w_rad_s: Array, weights: Array | None = None
) -> Passivity:
    """Returns the passivity at some ports, on a frequency grid that is refined at minima.

    Args:
        response: velocities per torque, or another output with as many entries.
        w_rad_s: frequencies, rising, shape (F,).
        weights: positive weights of the ports, shape (p,); None: all are 1, and the quadratic
            form is energy.
    """

    def evaluate_weighted(w: Array) -> Complex:
        Y = response(w)
        return Y if weights is None else weight_response(Y, weights)

    def find_least(w: Array) -> Array:
        return find_least_eigenvalue(evaluate_weighted(w))

    def find_tolerance(w: Array) -> Array:
        tolerance: Array = EIGENVALUE_ROUNDING * np.linalg.norm(response(w), axis=(1, 2))
        return tolerance

    minima = find_minima(find_least, w_rad_s, tolerance=find_tolerance)
    Y = evaluate_weighted(minima.w_rad_s)
    size = np.asarray(np.linalg.norm(Y, 2, axis=(1, 2)), dtype=np.float64)
    lacking = find_lacking_damping(Y, minima.w_rad_s) if minima.below else 0.0
    return Passivity(minima, size, lacking)


def llewellyn_parameter(Y: Complex) -> Array:
    """Returns Llewellyn's parameter of two scalar ports, shape (F,); the criterion wants >= 1.

    It is (2 Re y11 Re y22 - Re(y12 y21)) / abs(y12 y21). It is at most `MAX_LLEWELLYN`, which
    stands for a two-port without transmission, and at most -1 where Re y11 or Re y22 is
    negative.

    Args:
        Y: admittance, shape (F, 2, 2).
    """
    y11 = Y[:, 0, 0].real
    y22 = Y[:, 1, 1].real
    transmission = Y[:, 0, 1] * Y[:, 1, 0]
    norm = np.linalg.norm(Y, axis=(1, 2))
    size = np.maximum(np.abs(transmission), 1e-30 * norm**2)
    parameter: Array = np.minimum((2.0 * y11 * y22 - transmission.real) / size, MAX_LLEWELLYN)
    is_active = (y11 < -EIGENVALUE_ROUNDING * norm) | (y22 < -EIGENVALUE_ROUNDING * norm)
    return np.where(is_active, np.minimum(parameter, -1.0), parameter)


def llewellyn_rounding(Y: Complex) -> Array:
    """Returns the rounding error of Llewellyn's parameter, shape (F,).

    It is large if there is next to no transmission.
    """
    transmission = np.abs(Y[:, 0, 1] * Y[:, 1, 0])
    norm = np.linalg.norm(Y, axis=(1, 2))
    size = np.maximum(transmission, 1e-30 * norm**2)
    rounding: Array = EIGENVALUE_ROUNDING + 1e-12 * norm**2 / size
    return rounding


def clamp_ports(Y: Complex, keep: list[int], clamped: list[int]) -> Complex:
    """Returns the admittance at some ports with other ports clamped (Schur complement).

    No operator is at the remaining ports.

    Args:
        Y: admittance, shape (F, p, p).
        keep: ports of the result.
        clamped: ports with velocity zero.
    """
    Y_kk: Complex = Y[:, keep][:, :, keep]
    if not clamped:
        return Y_kk
    Y_cc = Y[:, clamped][:, :, clamped]
    Y_ck = Y[:, clamped][:, :, keep]
    Y_kc = Y[:, keep][:, :, clamped]
    return Y_kk - Y_kc @ np.linalg.solve(Y_cc, Y_ck)


class BestWeights(NamedTuple):
    """The weights of the sites with the largest margin.

    Attributes:
        margin: least eigenvalue of Y + Y^H with the best weights and each site's part scaled to
            size 1, dimensionless, shape (F,); negative if no weights suffice.
        weights: the best weights, relative to the first site's, shape (F, N).
    """

    margin: Array
    weights: Array


def find_best_weights(Y: Complex, owner: NDArray[np.int64]) -> BestWeights:
    """Returns the weights of the sites that maximise the least eigenvalue at each frequency.

    The least eigenvalue of D^1/2 Y D^-1/2 + its Hermitian is concave in ln D (a limit of the
    result of Sezginer and Overton for norms, IEEE Trans. Automatic Control 35 (1990)). The
    ellipsoid method therefore finds its maximum.

    Args:
        Y: admittance, shape (F, p, p).
        owner: index of the site of each port, shape (p,).
    """
    scaled = _scale_sites(Y, owner)
    count = len(Y)
    free = int(owner.max())
    centre = np.zeros((count, free))
    best = np.zeros((count, free))
    shape = np.broadcast_to(_LOG_REACH**2 * free * np.eye(free), (count, free, free)).copy()
    margin = np.full(count, -np.inf)
    active = np.arange(count)
    # the mean of the eigenvalues, which no weights change, bounds the least of them
    bound = 2.0 * np.trace(scaled, axis1=1, axis2=2).real / scaled.shape[1]
    for _ in range(_MAX_ROUNDS):
        value, slope = _evaluate_margin(scaled[active], centre[active], owner)
        is_better = value > margin[active]
        margin[active[is_better]] = value[is_better]
        best[active[is_better]] = centre[active[is_better]]
        direction = np.einsum("fij,fj->fi", shape[active], slope)
        # largest possible gain within the ellipsoid
        gain = np.sqrt(np.maximum(np.einsum("fi,fi->f", slope, direction), 0.0))
        needed_gain = _WEIGHT_TOLERANCE * np.maximum(np.abs(margin[active]), 1e-6)
        can_gain = gain > needed_gain
        can_gain &= bound[active] - margin[active] > EIGENVALUE_ROUNDING
        active = active[can_gain]
        direction = direction[can_gain] / gain[can_gain, np.newaxis]
        if not len(active) or free == 0:
            break
        centre[active] += direction / (free + 1.0)
        if free == 1:
            shape[active] /= 4.0
        else:
            outer = direction[:, :, np.newaxis] * direction[:, np.newaxis, :]
            reduced = shape[active] - 2.0 / (free + 1.0) * outer
            shape[active] = free**2 / (free**2 - 1.0) * reduced
    log_weights = np.concatenate([np.zeros((count, 1)), best], axis=1)
    return BestWeights(margin, np.exp(log_weights))


def _scale_sites(Y: Complex, owner: NDArray[np.int64]) -> Complex:
    """Returns the admittance with each site's diagonal block scaled to norm 1."""
    size = np.ones(Y.shape[:2])
    for site in range(int(owner.max()) + 1):
        ports = np.flatnonzero(owner == site)
        block = Y[:, ports][:, :, ports]
        size[:, ports] = np.linalg.norm(block, axis=(1, 2))[:, np.newaxis]
    root = np.sqrt(np.maximum(size, 1e-300))
    scaled: Complex = Y / (root[:, :, np.newaxis] * root[:, np.newaxis, :])
    return scaled


def _evaluate_margin(
    Y: Complex, log_weights: Array, owner: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Returns the least eigenvalue under weights, and its gradient by their logarithms.

    With its eigenvector v and the projection P_i on the ports of site i, the derivative by x_i
    of v^H (e^{x/2} Y e^{-x/2} + its Hermitian) v is Re v^H (P_i Y - Y P_i) v.

    Args:
        Y: response, shape (F, p, p).
        log_weights: logarithms of the weights of all sites but the first, shape (F, N - 1).
        owner: index of the site of each port, shape (p,).
    """
    all_log_weights = np.concatenate([np.zeros((len(Y), 1)), log_weights], axis=1)
    W = weight_response(Y, np.exp(all_log_weights[:, owner]))
    values, vectors = np.linalg.eigh(W + np.conj(np.swapaxes(W, -1, -2)))
    v = vectors[:, :, 0]
    v_conj = np.conj(v)
    per_port = (v_conj * (W @ v[:, :, np.newaxis])[:, :, 0]).real
    per_port -= ((v_conj[:, np.newaxis, :] @ W)[:, 0, :] * v).real
    is_owner = owner[:, np.newaxis] == np.arange(1, all_log_weights.shape[1])
    return values[:, 0], per_port @ is_owner.astype(np.float64)

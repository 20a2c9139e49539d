"""Checks whether coupled arms stay stable with every passive operator, at any frequency.

A passive operator is a person or object that cannot supply net energy. A place where an
operator touches an arm is called a port. The admittance Y of the ports is the matrix that maps
the torques u of the operators to the velocities of the ports at one frequency. The torques
supply the mean power 1/4 u^H (Y + Y^H) u to the arms, where ^H is the conjugate transpose.

For a stable control loop, there are two conditions:

- The loop is passive if Y + Y^H has no negative eigenvalue at any frequency. It is then stable
  with every passive environment, even with operators who are coupled to each other.
- The loop is absolutely stable, that is, stable with independent passive operators, under a
  weaker condition: at each frequency there is a diagonal matrix D of positive weights for which
  D Y + Y^H D has no negative eigenvalue. D has one weight per arm.

Sources:
    - Passivity and passive environments: Colgate and Hogan, "Robust control of dynamically
      interacting systems", Int. J. Control 48 (1988).
    - Absolute stability for two ports with one variable each: Llewellyn, "Some fundamental
      properties of transmission systems", Proc. IRE 40 (1952). The parameter that must be at
      least 1 is from Adams and Hannaford, "Stable haptic interaction with virtual
      environments", IEEE Trans. Robotics and Automation 15 (1999).
    - Absolute stability for several joints and arms, in special cases: Li, Tavakoli and Huang,
      "Absolute stability of multi-DOF multilateral haptic systems", IEEE Trans. Control Systems
      Technology (2014).
    - The weights D, as in the structured singular value: Packard and Doyle, "The complex
      structured singular value", Automatica 29 (1993).

Invariant:
    - Passivity with positive weights per arm proves stability for passive operators that are
      not coupled to each other.
    - The condition of absolute stability is sufficient for any number of arms, and also
      necessary for up to three arms.
"""

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import Array
from ...errors import UsageError
from .characteristic_roots import Complex
from .frequency_search import Minima
from .port_response import PortResponse

EIGENVALUE_ROUNDING = 1e-8
"""Negative eigenvalues smaller than this, relative to the response, count as rounding."""
MAX_LLEWELLYN = 1e6
"""Largest value of Llewellyn's parameter."""
_LOW_BAND = 4.0
"""Ratio of frequencies over which a lack of damping that grows without bound would at least
double.
"""
_LOG_REACH = 12.0
"""Logarithm of the largest ratio of two weights."""
_MAX_ROUNDS = 400
"""Largest number of steps of the ellipsoid method."""
_WEIGHT_TOLERANCE = 1e-3
"""The search for weights ends once the margin can grow by less than this share."""


class Passivity(NamedTuple):
    """Whether coupled arms are passive, meaning that they never supply net energy.

    Y is the admittance over frequency: the velocity at the operators' joints per unit torque.
    The arms are passive if Y + Y^H has no negative eigenvalue, where Y^H is the conjugate
    transpose.

    Attributes:
        minima: Smallest eigenvalue of Y + Y^H over frequency, in rad/s per N m, and the bands
            in which it is negative.
        size: Largest singular value of Y at these frequencies, shape (F,), in rad/s per N m.
            The eigenvalues of Y + Y^H lie within twice this value.
        lacking_nm_s_rad: Damping that, added at each port, would make the loop passive, in N m
            s/rad. Infinite if it grows without bound towards the lowest frequencies.
    """

    minima: Minima
    size: Array
    lacking_nm_s_rad: float

    @property
    def passive(self) -> bool:
        """True if the arms are passive (never supply net energy) at all analysed frequencies.

        This means that Y + Y^H has no negative eigenvalue, where Y is the admittance of the
        ports and Y^H its conjugate transpose.
        """
        return not self.minima.below

    @classmethod
    def check(
        cls,
        response: PortResponse,
        w_rad_s: Array,
        weights: Array | None = None,
    ) -> "Passivity":
        """Checks whether coupled arms are passive at the places (ports) where operators act.

        The arms are passive if they never return more energy than they received. This is
        examined over frequency, with additional frequencies near the minima.

        Args:
            response: Function that returns the response at given frequencies: usually the
                admittance (velocity at the p ports per unit torque). Another output with p
                entries is also allowed.
            w_rad_s: Initial frequencies in ascending order, shape (F,), in rad/s.
            weights: Positive weights of the ports, shape (p,), or `None` if all are 1. With
                unit weights and velocity outputs, the examined sum of torque times output is
                the physical power.

        Returns:
            The smallest eigenvalue over frequency, which determines passivity, and related
            quantities.
        """

        def evaluate_weighted(w: Array) -> Complex:
            """Returns the frequency response, scaled with the port weights, if any."""
            Y = response(w)
            return Y if weights is None else weight_response(Y, weights)

        def find_least(w: Array) -> Array:
            weighted = evaluate_weighted(w)
            return find_least_eigenvalue(weighted)

        def find_tolerance(w: Array) -> Array:
            """Returns the rounding error of the smallest eigenvalue at each frequency w."""
            Y = response(w)
            norm = _find_frobenius_norm(Y)
            return EIGENVALUE_ROUNDING * norm

        minima = Minima.find(find_least, w_rad_s, tolerance=find_tolerance)
        Y = evaluate_weighted(minima.w_rad_s)
        largest_singular_value = np.linalg.norm(Y, 2, axis=(1, 2))
        size = np.asarray(largest_singular_value, dtype=np.float64)
        lacking = 0.0
        if minima.below:
            lacking = _find_lacking_damping(Y, minima.w_rad_s)
        return cls(minima, size, lacking)


_HAND_KEYS = ("mass_kg", "damping_n_s_m", "stiffness_n_m")
"""Keys of the mass, damping and stiffness matrix in the file of a measured hand."""


class HandMatrices(NamedTuple):
    """Measured impedance of an operator who holds the end effector.

    The operator resists a motion with the force F = -(M a + B v + K x), where x is the position
    of the end effector, v its velocity and a its acceleration.

    Attributes:
        M: Mass, shape (n, n), in kg.
        B: Damping, shape (n, n), in N s/m.
        K: Stiffness, shape (n, n), in N/m.
    """

    M: Array
    B: Array
    K: Array

    @classmethod
    def read(cls, file: Path) -> "HandMatrices":
        """Reads the measured mass, damping and stiffness of a person's hand from a JSON file.

        Stability can then be checked for this hand instead of for every passive operator, which
        is a less strict condition.

        Args:
            file: Path of a file that `trilat identify hand --json` wrote.

        Raises:
            UsageError: The file does not contain the dynamics of a hand.
        """
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            M, B, K = (np.array(values[key], dtype=np.float64) for key in _HAND_KEYS)
            have_same_shape = M.shape == B.shape == K.shape
            if not have_same_shape or M.shape not in ((2, 2), (3, 3)):
                raise ValueError("the matrices must all have 2 rows and columns, or all have 3")
            if not np.isfinite([M, B, K]).all():
                raise ValueError("a number is not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            problem = str(error)
            # The text of a KeyError is only the key.
            if isinstance(error, KeyError):
                problem = f"the key {error} is missing"
            raise UsageError(
                f"{file}: does not contain the output of `trilat identify hand --json`: "
                f"{problem}"
            ) from None
        return cls(M, B, K)

    def compute_resistance(self, w_rad_s: Array) -> Complex:
        """Returns the resistive part of a human hand's impedance, shape (F, n, n), in N s/m.

        This is the Hermitian part of Z(j w) = j w M + B + K / (j w), with the mass M, the
        damping B and the stiffness K.

        Args:
            w_rad_s: Frequencies w, shape (F,), in rad/s.
        """
        w = w_rad_s[:, np.newaxis, np.newaxis]
        mass_term = 1j * w * self.M
        stiffness_term = 1j * self.K / w
        Z: Complex = mass_term + self.B - stiffness_term
        Z_H = _conjugate_transpose(Z)
        return 0.5 * (Z + Z_H)


def _conjugate_transpose(Y: Complex) -> Complex:
    """Returns the conjugate transpose Y^H of the matrix at each frequency, shape (F, p, p)."""
    transposed = np.swapaxes(Y, -1, -2)
    conjugate: Complex = np.conj(transposed)
    return conjugate


def _find_frobenius_norm(Y: Complex) -> Array:
    """Returns the Frobenius norm of Y at each frequency, shape (F,)."""
    norm: Array = np.linalg.norm(Y, axis=(1, 2))
    return norm


def check_against_hands(
    response: PortResponse,
    w_rad_s: Array,
    held: Sequence[Sequence[HandMatrices]],
    places: Sequence[Array],
) -> Minima | None:
    """Checks whether the loop is stable whichever measured operators hold the end effectors.

    The result is the smallest eigenvalue of Z + Z^H + 2 D over every choice of operators, where
    Z = Y^-1, and D is the resistance of the operators at the ports. If the eigenvalue is not
    negative at any frequency, Z together with D is passive, and each operator without D is also
    passive. The loop is then stable with any of these operators, and with passive environments
    at the other ports. This condition is sufficient but not necessary, as is passivity.

    Args:
        response: Admittance Y at the ports.
        w_rad_s: Frequencies in ascending order, shape (F,), in rad/s.
        held: For each end effector that is held, the operators who may hold it.
        places: For each of these end effectors, the matrix that maps the velocities at all
            ports to its own velocity, shape (n, p).

    Returns:
        The smallest eigenvalue over frequency, in N m s/rad or N s/m, or `None` if no operator
        is known.
    """
    if not held:
        return None

    def find_least(w: Array) -> Array:
        """Returns the smallest eigenvalue of Z + Z^H + 2 D over all choices of operators."""
        Y = response(w)
        Z = np.linalg.inv(Y).astype(np.complex128)
        Z += _conjugate_transpose(Z)

        resistances = []
        for hands, J in zip(held, places, strict=True):
            at_ports = []
            for hand in hands:
                resistance = hand.compute_resistance(w)
                port_resistance = 2.0 * J.T @ resistance @ J
                at_ports.append(port_resistance)
            resistances.append(at_ports)

        least_per_choice = []
        for choice in product(*resistances):
            held_Z = Z + sum(choice)
            eigenvalues = np.linalg.eigvalsh(held_Z)
            least_per_choice.append(eigenvalues[:, 0])
        least: Array = np.min(least_per_choice, axis=0)
        return least

    def find_tolerance(w: Array) -> Array:
        """Returns the rounding error of the smallest eigenvalue at each frequency w."""
        Y = response(w)
        Z: Complex = np.linalg.inv(Y).astype(np.complex128)
        norm = _find_frobenius_norm(Z)
        return EIGENVALUE_ROUNDING * norm

    return Minima.find(find_least, w_rad_s, tolerance=find_tolerance)


def weight_response(Y: Complex, weights: Array) -> Complex:
    """Scales a frequency response with port weights, for checking weighted passivity.

    The result is D^1/2 Y D^-1/2 with D = diag(weights). The eigenvalues of its Hermitian part
    have the same signs as those of D Y + Y^H D.

    Args:
        Y: Response, shape (F, p, p).
        weights: Positive weights of the ports, shape (p,) or (F, p).

    Returns:
        Scaled response, shape (F, p, p).
    """
    root = np.sqrt(weights)
    rows = root[..., :, np.newaxis]
    columns = root[..., np.newaxis, :]
    return rows * Y / columns


def find_least_eigenvalue(Y: Complex) -> Array:
    """Returns the smallest eigenvalue of Y + Y^H at each frequency, shape (F,).

    Y is the admittance, which maps torques to velocities, and Y^H its conjugate transpose. If
    the eigenvalue is never negative, the arms are passive: they never supply net energy to
    operators.

    Args:
        Y: Response, shape (F, p, p).
    """
    hermitian_sum = Y + _conjugate_transpose(Y)
    eigenvalues = np.linalg.eigvalsh(hermitian_sum)
    # eigvalsh sorts them in rising order
    least = eigenvalues[..., 0]
    return np.asarray(least, dtype=np.float64)


def _find_lacking_damping(Y: Complex, w_rad_s: Array) -> float:
    """Returns the damping that must be added at operators' ports to make arms passive.

    A port is where an operator acts on an arm. A damper b at every port adds b to the impedance
    Z = Y^-1, the inverse of the admittance. The arms are then passive if Z + Z^H + 2 b has no
    negative eigenvalue, where Z^H is the conjugate transpose. A control law with an integrator
    can lack damping without bound towards low frequencies. In that case no b suffices.

    Args:
        Y: Admittance (velocity per torque) of p ports at F frequencies, shape (F, p, p), in
            rad/s per N m.
        w_rad_s: Frequencies, rising, shape (F,), in rad/s.

    Returns:
        The least sufficient b, in N m s/rad. It is 0 if the arms are passive already, and
        infinite if no b suffices.
    """
    Z = np.linalg.inv(Y).astype(np.complex128)
    lacking = -0.5 * find_least_eigenvalue(Z)
    lowest_w = w_rad_s[0]
    higher_w = _LOW_BAND * lowest_w
    at_lowest = lacking[0]
    at_higher = float(np.interp(higher_w, w_rad_s, lacking))
    doubled = 2.0 * at_higher
    grows_without_bound = at_lowest > 0.0 and at_lowest > doubled
    if grows_without_bound:
        return np.inf
    largest = float(lacking.max())
    return max(0.0, largest)


def llewellyn_parameter(Y: Complex) -> Array:
    """Returns Llewellyn's parameter of two scalar ports, shape (F,).

    The parameter is (2 Re y11 Re y22 - Re(y12 y21)) / abs(y12 y21). The criterion of absolute
    stability requires a parameter of at least 1. Values above `MAX_LLEWELLYN`, which occur if
    almost nothing is transmitted between the ports, are replaced by this limit. If Re y11 or Re
    y22 is negative, the result is at most -1.

    Args:
        Y: Admittance, shape (F, 2, 2).
    """
    y11 = Y[:, 0, 0].real
    y22 = Y[:, 1, 1].real
    y12 = Y[:, 0, 1]
    y21 = Y[:, 1, 0]
    transmission = y12 * y21

    norm = _find_frobenius_norm(Y)
    smallest = 1e-30 * norm**2
    size = np.maximum(np.abs(transmission), smallest)

    numerator = 2.0 * y11 * y22 - transmission.real
    quotient = numerator / size
    parameter: Array = np.minimum(quotient, MAX_LLEWELLYN)

    # A port that is active by itself violates the criterion, whatever the quotient is.
    limit = -EIGENVALUE_ROUNDING * norm
    first_is_active = y11 < limit
    second_is_active = y22 < limit
    is_active = first_is_active | second_is_active
    negative_parameter = np.minimum(parameter, -1.0)
    return np.where(is_active, negative_parameter, parameter)


def llewellyn_rounding(Y: Complex) -> Array:
    """Returns the rounding error of Llewellyn's stability parameter, shape (F,).

    If the distance of the parameter from its limit is less than this error, the criterion is
    inconclusive. The error is large if almost nothing is transmitted from one joint to the
    other.

    Args:
        Y: Admittance, shape (F, 2, 2).
    """
    y12 = Y[:, 0, 1]
    y21 = Y[:, 1, 0]
    norm = _find_frobenius_norm(Y)
    smallest = 1e-30 * norm**2
    transmission = np.abs(y12 * y21)
    size = np.maximum(transmission, smallest)
    relative_error = 1e-12 * norm**2 / size
    return EIGENVALUE_ROUNDING + relative_error


def clamp_ports(Y: Complex, keep: list[int], clamped: list[int]) -> Complex:
    """Returns the admittance at some joints while other joints are clamped.

    The admittance is the velocity per unit torque, and a clamp holds the velocity at zero. The
    result is a Schur complement. Joints in neither list move freely.

    Args:
        Y: Admittance at all ports, shape (F, p, p).
        keep: Indices of the ports of the result.
        clamped: Indices of the ports whose velocity is zero.
    """
    kept_rows = Y[:, keep]
    Y_kk: Complex = kept_rows[:, :, keep]
    if not clamped:
        return Y_kk
    clamped_rows = Y[:, clamped]
    Y_cc = clamped_rows[:, :, clamped]
    Y_ck = clamped_rows[:, :, keep]
    Y_kc = kept_rows[:, :, clamped]
    # the torque that holds the clamped ports, per velocity of a kept port
    holding = np.linalg.solve(Y_cc, Y_ck)
    return Y_kk - Y_kc @ holding


class _BestWeights(NamedTuple):
    """Site weights that best prove the stability of coupled arms with passive operators.

    The operators act at ports, whose admittance Y maps their torques to velocities. There are N
    sites (processes that each run one arm).

    Attributes:
        margin: Least eigenvalue of the weighted Y + Y^H, with the conjugate transpose Y^H, at
            each of F frequencies, shape (F,). Y is scaled such that each site's own part has
            size 1. The margin therefore has no unit. The margin is negative if no weights prove
            stability.
        weights: The best weights at each frequency, relative to the weight of the first site,
            shape (F, N).
    """

    margin: Array
    weights: Array


def find_best_weights(Y: Complex, owner: NDArray[np.int64]) -> _BestWeights:
    """Finds the site weights for the sharpest test of absolute stability, at each frequency.

    Each site has one positive weight, shared by all its ports (places where operators act). D
    is the diagonal matrix of these weights. The loop is stable with any passive operators if
    the matrix H = D^1/2 Y D^-1/2 + (D^1/2 Y D^-1/2)^H has no negative eigenvalue, where ^H is
    the conjugate transpose. The smallest eigenvalue of H is concave in ln D (compare Sezginer
    and Overton, IEEE Trans. Automatic Control 35 (1990)). The ellipsoid method can therefore
    find its maximum.

    Args:
        Y: Admittance (velocity per unit torque) of the p ports at F frequencies, shape (F, p,
            p).
        owner: Index of the site of each port, shape (p,).

    Returns:
        The maximum of the smallest eigenvalue at each frequency, and the weights that attain
        it.
    """
    scaled = _scale_sites(Y, owner)
    frequencies = len(Y)
    free_weights = int(owner.max())
    centre = np.zeros((frequencies, free_weights))
    best_logs = np.zeros((frequencies, free_weights))
    # the first ellipsoid is a ball that contains all weights up to the largest ratio
    ball = _LOG_REACH**2 * free_weights * np.eye(free_weights)
    shape = (frequencies, free_weights, free_weights)
    ellipsoids = np.broadcast_to(ball, shape).copy()
    margin = np.full(frequencies, -np.inf)
    # the mean of the eigenvalues, which no weights change, bounds the least of them
    trace = np.trace(scaled, axis1=1, axis2=2)
    upper_bound = 2.0 * trace.real / scaled.shape[1]
    # the frequencies at which the search continues
    active = np.arange(frequencies)

    for _ in range(_MAX_ROUNDS):
        active_Y = scaled[active]
        active_centre = centre[active]
        value, slope = _evaluate_margin(active_Y, active_centre, owner)
        is_better = value > margin[active]
        improved = active[is_better]
        margin[improved] = value[is_better]
        best_logs[improved] = centre[improved]

        direction = np.einsum("fij,fj->fi", ellipsoids[active], slope)
        squared_gain = np.einsum("fi,fi->f", slope, direction)
        # largest possible gain within the ellipsoid
        gain = np.sqrt(np.maximum(squared_gain, 0.0))
        active_margin = margin[active]
        size = np.maximum(np.abs(active_margin), 1e-6)
        can_gain = gain > _WEIGHT_TOLERANCE * size
        reserve = upper_bound[active] - active_margin
        can_gain &= reserve > EIGENVALUE_ROUNDING
        active = active[can_gain]
        if not len(active) or free_weights == 0:
            break

        # move the centre along the ascent, and keep the half that may contain the maximum
        gain_column = gain[can_gain, np.newaxis]
        step = direction[can_gain] / gain_column
        centre[active] += step / (free_weights + 1.0)
        active_ellipsoids = ellipsoids[active]
        ellipsoids[active] = _shrink_ellipsoids(active_ellipsoids, step)
    # the first site's weight is 1
    first_site = np.zeros((frequencies, 1))
    log_weights = np.concatenate([first_site, best_logs], axis=1)
    return _BestWeights(margin, np.exp(log_weights))


def _shrink_ellipsoids(ellipsoids: Array, step: Array) -> Array:
    """Shrinks ellipsoids that contain the maximum of a function, by one step of a search.

    After a step along the gradient, the maximum lies in one half of an ellipsoid. The result is
    the smallest ellipsoid around this half. This is the ellipsoid method of optimisation.

    Args:
        ellipsoids: Matrices of the ellipsoids, shape (F, n, n).
        step: Vector from each centre to the border, along the ascent, shape (F, n).
    """
    n = step.shape[1]
    if n == 1:
        return ellipsoids / 4.0
    rows = step[:, :, np.newaxis]
    columns = step[:, np.newaxis, :]
    outer = rows * columns
    flattened = ellipsoids - 2.0 / (n + 1.0) * outer
    scale = n**2 / (n**2 - 1.0)
    shrunk: Array = scale * flattened
    return shrunk


def _scale_sites(Y: Complex, owner: NDArray[np.int64]) -> Complex:
    """Scales the admittance so that the block of each site on the diagonal has norm 1.

    The search for weights then starts with sites of equal size.
    """
    size = np.ones(Y.shape[:2])
    sites = int(owner.max()) + 1
    for site in range(sites):
        ports = np.flatnonzero(owner == site)
        rows = Y[:, ports]
        block = rows[:, :, ports]
        block_norm = _find_frobenius_norm(block)
        size[:, ports] = block_norm[:, np.newaxis]

    positive_size = np.maximum(size, 1e-300)
    root = np.sqrt(positive_size)
    row_roots = root[:, :, np.newaxis]
    column_roots = root[:, np.newaxis, :]
    scaled: Complex = Y / (row_roots * column_roots)
    return scaled


def _evaluate_margin(
    Y: Complex,
    log_weights: Array,
    owner: NDArray[np.int64],
) -> tuple[Array, Array]:
    """Returns the least eigenvalue under weights, and its gradient with respect to their logs.

    With the eigenvector v and the projection P_i on the ports of site i, the derivative of v^H
    (e^{x/2} Y e^{-x/2} + its conjugate transpose) v with respect to x_i is Re v^H (P_i Y - Y
    P_i) v.

    Args:
        Y: Response, shape (F, p, p).
        log_weights: Logarithms of the weights of all sites but the first, shape (F, N - 1).
        owner: Index of the site of each port, shape (p,).
    """
    # the first site's weight is 1
    first_site = np.zeros((len(Y), 1))
    all_log_weights = np.concatenate([first_site, log_weights], axis=1)
    port_weights = np.exp(all_log_weights[:, owner])
    W = weight_response(Y, port_weights)
    W_H = _conjugate_transpose(W)
    eigenvalues, eigenvectors = np.linalg.eigh(W + W_H)

    v = eigenvectors[:, :, 0]
    v_conj = np.conj(v)
    column = v[:, :, np.newaxis]
    row = v_conj[:, np.newaxis, :]
    W_v = (W @ column)[:, :, 0]
    v_conj_W = (row @ W)[:, 0, :]
    per_port = (v_conj * W_v).real
    per_port -= (v_conj_W * v).real

    sites = np.arange(1, all_log_weights.shape[1])
    is_owner = owner[:, np.newaxis] == sites
    gradient = per_port @ is_owner.astype(np.float64)
    return eigenvalues[:, 0], gradient
